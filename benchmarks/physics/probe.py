"""One avatar in an environment of the suite, stepped through its public interface and measured in double precision."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from agents.pid.tissue import Tissue
from benchmarks.physics.checks import Options, SimulationFailed
from piavatar_envs.api.gym_env import AvatarEnv
from piavatar_envs.avatar.body.asset import dense_weights
from piavatar_envs.avatar.body.muscles import REFERENCE_HEIGHT, REFERENCE_MASS, make_muscles
from piavatar_envs.avatar.body.skeleton import joint_index, skin
from piavatar_envs.core.arrays import matrices_of
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.sim.world import Simulation

#: Empty space: settings of a scene in which nothing weighs anything.
EMPTY: dict[str, Any] = {"gravity": 0.0, "scene": {"ground": False}}
GRAVITY = 9.81
#: Pose control in which joints resist contact.
JOINTS = "pose, joints"
#: Middles of chest and head, x and z [m].
CHEST, HEAD = (0.0, 1.28), (0.0, 1.55)
#: Greatest volume fraction of a particle at the surface of a body, over the median of the body's.
AT_SURFACE = 0.93


def empty(*props: dict[str, Any], **scene: Any) -> dict[str, Any]:
    """Return settings of empty space with props in it."""
    return {"gravity": 0.0, "scene": {"ground": False, "props": list(props), **scene}}


class Measurements:
    """Measurements of the first environment of a batch with one avatar.

    Attributes:
        batch: the batch.
        simulation: its physics.
        dt: of a control step [s].
    """

    def __init__(self, batch: BatchEnv) -> None:
        self.batch, self.simulation = batch, batch.simulation
        self.dt = float(self.simulation.model.control_dt)

    @cached_property
    def body(self) -> slice:
        """Particles of the avatar."""
        return slice(0, self.simulation.avatar.num_points)

    def prop(self, index: int = 0) -> slice:
        """Return the particles of a prop."""
        prop = self.simulation.props.props[index]
        return slice(prop.first, prop.first + prop.count)

    def constants(self, name: str) -> np.ndarray:
        """Return ``mass`` [kg], ``volume`` [m^3], ``mu`` or ``lam`` [Pa] of all particles."""
        return getattr(self.simulation.model.particles, name).numpy()[0].astype(float)

    @cached_property
    def mass(self) -> np.ndarray:
        """Mass of every particle [kg]."""
        return self.constants("mass")

    @cached_property
    def volume(self) -> np.ndarray:
        """Rest volume of every particle [m^3]."""
        return self.constants("volume")

    @property
    def x(self) -> np.ndarray:
        """Places of the particles [m]."""
        return self.simulation.state.x.numpy()[0].astype(float)

    @property
    def velocity(self) -> np.ndarray:
        """Total velocities of the particles, physical and kinematic [m/s]."""
        state = self.simulation.state
        return (state.u.numpy() + state.vk.numpy())[0].astype(float)

    @property
    def F(self) -> np.ndarray:
        """Deformation gradients of the particles."""
        return matrices_of(self.simulation.state.F)[0].astype(float)

    def give(self, chosen: slice | np.ndarray, velocity: np.ndarray) -> None:
        """Add physical velocities to some particles [m/s], as initial conditions."""
        u = self.simulation.state.u.numpy()
        u[0, chosen] += velocity
        self.simulation.state.u.assign(u)

    def center(self, chosen: slice) -> np.ndarray:
        """Return the centre of mass of some particles [m]."""
        return self.mass[chosen] @ self.x[chosen] / self.mass[chosen].sum()

    def momentum(self, chosen: slice) -> np.ndarray:
        """Return the momentum of some particles [N s]."""
        return self.mass[chosen] @ self.velocity[chosen]

    def strain(self, chosen: slice | None = None) -> np.ndarray:
        """Return the strain of particles, by default of the avatar's: the norm of the principal stretches less one."""
        return np.linalg.norm(np.linalg.svd(self.F[chosen or self.body], compute_uv=False) - 1.0, axis=1)

    def volume_ratio(self, chosen: slice) -> np.ndarray:
        """Return the ratio ``J`` of the volume of particles to that at rest."""
        return np.linalg.det(self.F[chosen])

    def elastic_energy(self, chosen: slice) -> float:
        """Return the elastic energy of Neo-Hookean particles [J]."""
        F, mu, lam = self.F[chosen], self.constants("mu")[chosen], self.constants("lam")[chosen]
        log_J = np.log(np.linalg.det(F))
        return float(self.volume[chosen] @ (0.5 * mu * ((F**2).sum((1, 2)) - 3.0) - mu * log_J + 0.5 * lam * log_J**2))

    @property
    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """World rotations ``(22, 3, 3)`` and joints ``(22, 3)`` [m] of the tracked bones."""
        tracked = self.simulation.avatar.tracked
        rotation = Rotation.from_quat(tracked.rotation.numpy()[0].astype(float)).as_matrix()
        return rotation, tracked.position.numpy()[0].astype(float)

    @property
    def local(self) -> np.ndarray:
        """Rotation vectors of the tracked joints against their parents [rad], shape ``(22, 3)``."""
        return Rotation.from_quat(self.simulation.avatar.tracked.local.numpy()[0].astype(float)).as_rotvec()

    @property
    def errors(self) -> np.ndarray:
        """Rotation vectors from the commanded to the tracked pose of each joint [rad], shape ``(22, 3)``."""
        state = self.simulation.avatar.state
        goal = state.command_rotation if self.batch.config.control.mode == "pose" else state.goal_rotation
        wanted = Rotation.from_quat(goal.numpy()[0].astype(float))
        return (wanted.inv() * Rotation.from_rotvec(self.local)).as_rotvec()

    @cached_property
    def points(self) -> Any:
        """Rest particles of the avatar and what they are skinned to (NumPy)."""
        return self.simulation.flesh[0].points

    @cached_property
    def shares(self) -> np.ndarray:
        """Skinning weight of every bone on each particle of the avatar, shape ``(P, 22)``."""
        shares = dense_weights(self.points.skin_joints, self.points.skin_weights)
        return shares / shares.sum(1, keepdims=True)

    @cached_property
    def main_bone(self) -> np.ndarray:
        """Bone with the greatest share of each particle of the avatar, shape ``(P,)``."""
        return self.shares.argmax(1)

    def particles_of(self, *bones: str) -> np.ndarray:
        """Return the indices of the avatar's particles that belong to bones by name."""
        return np.flatnonzero(np.isin(self.main_bone, [joint_index(bone) for bone in bones]))

    def homes(self) -> np.ndarray:
        """Return the skinned place of each particle of the avatar on the tracked bones [m], shape ``(P, 3)``."""
        points, (rotation, position) = self.points, self.pose
        weights = points.skin_weights.astype(float)
        weights /= weights.sum(1, keepdims=True)
        rest, joints = corrected_rest(self.simulation), points.joints[0].astype(float)
        return skin(rest, points.skin_joints, weights, rotation, position, joints)

    def displacement(self) -> np.ndarray:
        """Return the distance of each particle of the avatar from its skinned place [m], shape ``(P,)``."""
        return np.linalg.norm(self.x[self.body] - self.homes(), axis=1)

    @cached_property
    def size(self) -> float:
        """Mass times height over those of the reference adult, by which muscles scale."""
        height = float(np.ptp(self.points.rest[0][:, 2]))
        return float(self.mass[self.body].sum() * height / (REFERENCE_MASS * REFERENCE_HEIGHT))

    def spring(self, joint: str) -> float:
        """Return the stiffness of a joint of this body by the table of muscles [N m/rad]."""
        return float(self.size * make_muscles().stiffness[joint_index(joint)])

    @cached_property
    def tissue(self) -> Tissue:
        """Tissue of the joints of this body."""
        return Tissue(self.size, self.simulation.flesh[0].torque_control().tissue.flesh)

    def sensor(self, name: str) -> np.ndarray:
        """Return a contact sensor of the last control step."""
        return getattr(self.simulation.sensors, name).numpy()[0].astype(float)

    def overlap(self, chosen: slice, other: slice) -> tuple[float, float]:
        """Return the share of the volume of ``chosen`` that lies inside ``other``, and the depth of the deepest [m].

        Independent of the grid: a particle is inside where the other's volume fraction, summed with the cubic spline of
        smoothed-particle hydrodynamics over a particle spacing, is above half. Volumes are those of the deformed
        matter: squeezed matter is denser, but does not reach further.
        """
        x, spacing = self.x, float(np.mean(self.volume[other])) ** (1.0 / 3.0)
        volume = self.volume[other] * np.maximum(self.volume_ratio(other), 0.0)
        places, tree = x[chosen], cKDTree(x[other])
        inside = _fraction(tree, x[other], volume, places, spacing) > 0.5
        if not inside.any():
            return 0.0, 0.0
        own = _fraction(tree, x[other], volume, x[other], spacing)
        surface = x[other][own < AT_SURFACE * np.median(own)]
        depth = cKDTree(surface).query(places[inside])[0].max() + 0.5 * spacing
        volume = self.volume[chosen]
        return float(volume[inside].sum() / volume.sum()), float(depth)


class Probe(Measurements):
    """An environment with one avatar, and measurements of its state.

    Attributes:
        env: the environment.
        info: of the last step.
        action: of steps without one of their own; zeros at first.
    """

    def __init__(self, env: AvatarEnv) -> None:
        """Begin an episode of the environment."""
        super().__init__(env.batch)
        self.env = env
        _, self.info = env.reset(seed=0)
        self.action = np.zeros(env.action_space.shape, np.float32)

    @classmethod
    def of(cls, options: Options, task: str, **settings: Any) -> Probe:
        """Build the environment ``PIAvatar/<task>-v0``; ``settings`` win over the defaults."""
        settings = {"fidelity": options.fidelity, "episode_seconds": 3600.0, **settings}
        return cls(gymnasium.make(f"PIAvatar/{task}-v0", device=options.device, **settings).unwrapped)

    @classmethod
    def under(cls, options: Options, control: str, held: bool = True, **settings: Any) -> Probe:
        """Build a body that stands under ``control``, or :data:`JOINTS`; ``held`` says whether its pelvis is."""
        if control == "pose":
            return cls.of(options, "Reach", **({"root": "wrench" if held else "free"} | settings))
        if control == JOINTS:
            joints = {"mode": "pose", "resistance": "joints", "root": "wrench" if held else "free"}
            return cls.of(options, "Stand", control=joints, pose_noise=0.0, **settings)
        return cls.of(options, "Stand", control=control, root_assist=float(held), pose_noise=0.0, **settings)

    def step(self, action: np.ndarray | None = None) -> dict[str, Any]:
        """Take a control step with an action, or with :attr:`action`, and return its info.

        Raises:
            SimulationFailed: the simulation has failed.
        """
        self.info = self.env.step(self.action if action is None else action)[-1]
        if self.info["failure"]:
            raise SimulationFailed(f"failure {self.info['failure']!r}")
        return self.info

    def run(self, seconds: float) -> None:
        """Take control steps for some time."""
        for _ in range(round(seconds / self.dt)):
            self.step()


def corrected_rest(simulation: Simulation) -> np.ndarray:
    """Return the rest positions that the particles of the first avatar are skinned from now [m], shape ``(P, 3)``."""
    points, avatar = simulation.flesh[0].points, simulation.avatars[0]
    rest = points.rest[0].astype(float)
    if points.correctives is not None:
        rest += points.correctives.displacement(avatar.state.corrected_rotation.numpy()[0])
    return rest


def _fraction(tree: cKDTree, x: np.ndarray, volume: np.ndarray, places: np.ndarray, h: float) -> np.ndarray:
    """Return the volume fraction of particles at ``places``, by the cubic spline of smoothing length ``h`` [m]."""
    found = np.zeros(len(places))
    for index, near in enumerate(tree.query_ball_point(places, 2.0 * h)):
        q = np.linalg.norm(x[near] - places[index], axis=1) / h
        weight = np.where(q < 1.0, 1.0 - 1.5 * q**2 + 0.75 * q**3, 0.25 * np.maximum(0.0, 2.0 - q) ** 3)
        found[index] = volume[near] @ weight / (np.pi * h**3)
    return found


def ball(mass: float, speed: float, at: Sequence[float], distance: float = 0.45, **more: Any) -> dict[str, Any]:
    """Return a ball of 22 cm that flies at the front of the body at ``at`` (x, z) [m]."""
    place, velocity = [at[0], -distance, at[1]], [0.0, speed, 0.0]
    return {"name": "ball", "mass": mass, "size": [0.11], "position": place, "velocity": velocity, **more}
