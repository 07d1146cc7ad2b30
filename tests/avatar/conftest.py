"""A rig: one avatar in empty space or on a floor, stepped by the pose controller and read back in NumPy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.device import BodyPoints
from piavatar_envs.avatar.body.pose_correctives import pose_correctives
from piavatar_envs.avatar.body.sampling import morph, sample_particles, spacing_for
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, forward_kinematics, joint_index, skin
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.pose_control.controller import PoseController
from piavatar_envs.config import PoseControlConfig
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.diagnostics import Totals, totals
from piavatar_envs.mpm.memory import allocate
from piavatar_envs.mpm.model import MaterialPoints, build_model, make_grid
from piavatar_envs.mpm.types import Model, Scratch, State
from piavatar_envs.sim.bodies import pose_control
from piavatar_envs.sim.world import record_control_step

DENSITY = 1000.0
#: Where a ball hits: skin over the breastbone [m].
CHEST = (0.0, -0.12, 1.28)
TORSO = [joint_index(n) for n in ("pelvis", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar")]


def mean_rigid_motion(mass, x, v):
    """Return the centre, its velocity and angular velocity of the least-squares rigid motion (double precision)."""
    c = mass @ x / mass.sum()
    V = mass @ v / mass.sum()
    d = x - c
    second = np.einsum("p,pi,pj->ij", mass, d, d)
    L = mass @ np.cross(d, v - V)
    return c, V, np.linalg.solve(np.trace(second) * np.eye(3) - second, L)


def blended_rigid_part(weights, mass, x, v):
    """Return least-squares rigid motions of ``v``, bone by bone, blended by the skinning weights."""
    blended = np.zeros_like(v)
    for bone in range(weights.shape[1]):
        c, V, W = mean_rigid_motion(mass * weights[:, bone], x, v)
        blended += weights[:, bone, None] * (V + np.cross(W, x - c))
    return blended


@dataclass
class Rig:
    """One avatar in each environment, with the graphs that reset and step it."""

    model: Model
    state: State
    scratch: Scratch
    points: BodyPoints
    avatar: Avatar
    controller: PoseController
    mask: wp.array
    reset_graph: LaunchGraph
    step_graph: LaunchGraph

    # ---- running
    def reset(self, rotvec=None, root=None, mask=None) -> Rig:
        """Stand (or pose by local rotation vectors) the masked environments."""
        n = self.model.num_envs
        mask = np.ones(n, bool) if mask is None else np.asarray(mask)
        self.mask.assign(mask)
        d = self.avatar.state
        rotations, roots = d.command_rotation.numpy(), d.command_root.numpy()
        rotations[mask] = self.quaternions(np.zeros((NUM_JOINTS, 3)) if rotvec is None else rotvec)[mask]
        roots[mask] = np.broadcast_to(self.points.joints[:, 0] if root is None else root, (n, 3))[mask]
        d.command_rotation.assign(rotations)
        d.command_root.assign(roots)
        self.reset_graph.run()
        return self

    def run_part_of_step(self, kernel: str, count: int) -> None:
        """Run a control step up to and with the ``count``-th launch of a kernel."""
        for name, launch in self.step_graph.launches:
            launch()
            count -= name == kernel
            if count == 0:
                return
        raise ValueError(f"a control step has {count} launches of {kernel} fewer than asked for")

    def run_substeps(self, count: int) -> None:
        """Run the first substeps of a control step."""
        names = {name for name, _ in self.step_graph.launches}
        (last,) = names & {"g2p", "tiled_g2p", "substep_in_small_arena", "substep_in_large_arena"}
        self.run_part_of_step(last, count)

    def run_controller(self) -> None:
        """Run a control step up to the first MPM substep."""
        self.run_part_of_step("command_body" if self.controller.in_one_launch else "apply_corrections", 1)

    def track(self) -> None:
        """Track the particles where they are now."""
        graph = LaunchGraph(self.model.device)
        self.avatar.record_tracking(graph, self.state)
        graph.run()

    def command(self, rotvec=None, root=None) -> None:
        """Set the goal of the next control steps: local rotation vectors ``(22, 3)``, pelvis position."""
        if rotvec is not None:
            self.avatar.state.goal_rotation.assign(self.quaternions(rotvec))
        if root is not None:
            n = self.model.num_envs
            self.avatar.state.goal_root.assign(np.ascontiguousarray(np.broadcast_to(root, (n, 3)), np.float32))

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            self.step_graph.run()

    def quaternions(self, rotvec) -> np.ndarray:
        """Return Warp's quaternions of local rotation vectors, one set per environment."""
        rotvec = np.array(np.broadcast_to(rotvec, (self.model.num_envs, NUM_JOINTS, 3)))
        return Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_quat().reshape(-1, NUM_JOINTS, 4).astype(np.float32)

    # ---- reading
    @property
    def mass(self) -> np.ndarray:
        """Return mass of every particle of the first environment [kg], double precision."""
        return self.points.mass[0].astype(float)

    @property
    def weights(self) -> np.ndarray:
        """Return the dense skinning weights, shape ``(P, 22)``."""
        dense = np.zeros((self.points.num_points, NUM_JOINTS))
        for slot in range(4):
            rows = np.arange(self.points.num_points)
            np.add.at(dense, (rows, self.points.skin_joints[:, slot]), self.points.skin_weights[:, slot])
        return dense

    def read(self, name: str, env: int = 0) -> np.ndarray:
        """Return one array of the state, double precision."""
        return self.state.numpy()[name][env].astype(float)

    def skinned(self, rotations, root, env: int = 0) -> np.ndarray:
        """Return particles of a pose by NumPy's forward kinematics and skinning."""
        p, row = self.points, min(env, len(self.points.rest) - 1)
        joints = p.joints[min(env, len(p.joints) - 1)].astype(float)
        world, positions = forward_kinematics(rotations, root, joints)
        rest = p.rest[row].astype(float)
        if p.correctives is not None:
            rest = rest + p.correctives.displacement(Rotation.from_matrix(rotations).as_quat())
        return skin(rest, p.skin_joints, p.skin_weights.astype(float), world, positions, joints)

    def target(self, env: int = 0) -> np.ndarray:
        """Return particles of the commanded pose."""
        d = self.avatar.state
        rotations = Rotation.from_quat(d.goal_rotation.numpy()[env].astype(float)).as_matrix()
        return self.skinned(rotations, d.goal_root.numpy()[env].astype(float), env)

    def tracked_world(self, env: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return the tracked world rotations ``(22, 3, 3)`` and joint positions."""
        t = self.avatar.tracked
        return Rotation.from_quat(t.rotation.numpy()[env].astype(float)).as_matrix(), t.position.numpy()[env].astype(
            float
        )

    def tracked_local(self, env: int = 0) -> np.ndarray:
        """Return the tracked local rotations, shape ``(22, 3, 3)``."""
        world = self.tracked_world(env)[0]
        return np.stack([world[0], *(world[PARENTS[b]].T @ world[b] for b in range(1, NUM_JOINTS))])

    def joint_errors(self, env: int = 0) -> np.ndarray:
        """Return the angle between commanded and tracked local rotation of every joint but the root [rad]."""
        command = Rotation.from_quat(self.avatar.state.command_rotation.numpy()[env].astype(float))
        return (command.inv() * Rotation.from_matrix(self.tracked_local(env))).magnitude()[1:]

    def shape_error(self, env: int = 0) -> np.ndarray:
        """Return the distance of the particles from the skinned tracked pose [m]."""
        root = self.tracked_world(env)[1][0]
        return np.linalg.norm(self.read("x", env) - self.skinned(self.tracked_local(env), root, env), axis=1)

    def pose_error(self, env: int = 0) -> np.ndarray:
        """Return the distance of the particles from the skinned commanded pose [m]."""
        return np.linalg.norm(self.read("x", env) - self.target(env), axis=1)

    def everything(self) -> dict[str, np.ndarray]:
        """Return all that a checkpoint would hold, and the tracked pose."""
        command, tracked = (
            {field.name: getattr(group, field.name).numpy().copy() for field in fields(group)}
            for group in (self.avatar.state, self.avatar.tracked)
        )
        return {**self.state.numpy(), **command, **tracked}

    def totals(self, about=(0.0, 0.0, 0.0), env: int = 0) -> Totals:
        return totals(self.model, self.state, env, about=about)

    def energy(self) -> float:
        """Return the kinetic and elastic energy [J]."""
        t = self.totals()
        return t.kinetic + t.elastic

    def rigid_motion(self, total: bool = True):
        """Return the centre, velocity, angular velocity of the whole body (of ``u + vk``, or of ``u`` alone)."""
        v = self.read("u") + (self.read("vk") if total else 0.0)
        return mean_rigid_motion(self.mass, self.read("x"), v)

    # ---- disturbing
    def add_velocity(self, dv: np.ndarray, env: int | None = None) -> None:
        """Add a velocity to the particles, shape ``(P, 3)``, in one environment or all."""
        u = self.state.u.numpy()
        u[slice(None) if env is None else env] += dv.astype(np.float32)
        self.state.u.assign(u)

    def set_rigid_velocity(self, velocity, spin) -> None:
        """Give the body exactly a rigid motion, with the affine velocity that goes with it."""
        spin = np.asarray(spin, float)
        x = self.read("x")
        center = self.mass @ x / self.mass.sum()
        self.state.u.assign((np.asarray(velocity) + np.cross(spin, x - center)).astype(np.float32)[None])
        C = np.cross(np.eye(3), -spin).T.reshape(9, 1)
        self.state.C.assign(np.broadcast_to(C, self.state.C.shape).astype(np.float32).copy())

    def strike(self, momentum, at=CHEST, radius: float = 0.16, internal: bool = False) -> None:
        """Hit the skin near ``at`` with a momentum [N s], spread over the particles of the torso that a ball covers.

        ``internal`` takes the rigid part out again: the body is bent and dented, but neither flies off nor spins.
        """
        rest = self.points.rest[0].astype(float)
        spread = np.exp(-2.0 * ((rest - np.asarray(at)) ** 2).sum(1) / radius**2) * (
            self.weights[:, TORSO].sum(1) > 0.5
        )
        dv = spread[:, None] / (self.mass @ spread) * np.asarray(momentum, float)
        if internal:
            x = self.read("x")
            c, V, W = mean_rigid_motion(self.mass, x, dv)
            dv -= V + np.cross(W, x - c)
        self.add_velocity(dv)

    def push(self, force, joint: str = "spine3") -> None:
        """Push the flesh of a bone with a force [N] for a control step."""
        w = self.weights[:, joint_index(joint)]
        impulse = np.asarray(force, float) * self.model.control_dt
        self.add_velocity(w[:, None] / (self.mass @ w) * impulse)


def build_rig(
    device: str,
    *,
    cells: int = 24,
    num_envs: int = 1,
    shapes: Sequence[dict[str, float]] | None = None,
    gravity: float = 0.0,
    floor: bool = False,
    decoupling: str = "split",
    num_substeps: int | None = None,
    half_width: float = 1.3,
    others: int = 0,
    young_modulus: float = 1e5,
    colliders: Sequence[Collider] = (),
    keeps_volume: bool = False,
    alpha_of: Callable[[np.ndarray], np.ndarray] | None = None,
    **settings,
) -> Rig:
    """Build a standing avatar ``cells`` grid spacings tall.

    ``shapes`` are shape parameters by name, one set per environment; ``half_width`` is that of the domain [m];
    ``others`` is the number of particles before the avatar's, in a row in the domain's corner. ``colliders`` follow
    the ``floor``. ``keeps_volume`` corrects the rest pose. ``alpha_of`` returns the shape preservation of
    particles by their rest positions.
    """
    asset = load_asset()
    dx = float(np.ptp(asset.vertices[:, 2])) / cells
    particles = sample_particles(asset, spacing_for(dx))
    if shapes is None:
        rest, volume, joints = particles.rest_positions[None], particles.volumes[None], asset.joints[None]
    else:
        bodies = [asset.shape(asset.parameters(**shape)) for shape in shapes]
        morphed = [morph(asset, particles, body) for body in bodies]
        rest, volume = (np.stack([m[k] for m in morphed]) for k in (0, 1))
        joints = np.stack([body.joints for body in bodies])
    model = build_model(
        MaterialPoints.uniform(np.pad(volume, ((0, 0), (others, 0)), mode="mean"), DENSITY, young_modulus),
        make_grid(
            (-half_width, -half_width, 0.0 if floor else -half_width), (half_width, half_width, 1.2 + half_width), dx
        ),
        num_envs=num_envs,
        device=device,
        gravity=(0.0, 0.0, -gravity),
        decoupling=decoupling,
        num_substeps=num_substeps,
        colliders=[*([Collider.plane((0.0, 0.0, 1.0), 0.0, 0.8)] if floor else ()), *colliders],
    )
    state, scratch = allocate(model)
    x = state.x.numpy()
    x[:, :others] = [0.7 * half_width, 0.7 * half_width, 0.5] + np.linspace(0.0, 0.2, others)[:, None] * [0.0, 0.0, 1.0]
    state.x.assign(x)
    velocity_lag = np.zeros((1, volume.shape[1]), np.float32)
    mass = volume * np.float32(DENSITY)
    correctives = pose_correctives(asset, particles) if keeps_volume else None
    skinning = particles.skin_joints, particles.skin_weights
    points = BodyPoints(rest, mass, joints, *skinning, particles.bone, velocity_lag, correctives)
    avatar = Avatar(points, others, model)
    control = pose_control(PoseControlConfig(**{"free_motion": False} | settings), model)
    rates = None
    if alpha_of is not None:
        kinematic = settings.get("shape_preservation") == "kinematic"
        alpha = alpha_of(rest[0]) / model.control_dt
        rates = np.stack([alpha * (not kinematic), alpha * kinematic], axis=1)
    controller = PoseController(avatar, points, control, rates)
    mask = wp.zeros(num_envs, dtype=wp.bool, device=device)
    reset_graph, step_graph = LaunchGraph(device), LaunchGraph(device)
    avatar.record_reset(reset_graph, state, mask)
    avatar.record_tracking(reset_graph, state)
    record_control_step(step_graph, [avatar], [controller], model, state, scratch)
    return Rig(model, state, scratch, points, avatar, controller, mask, reset_graph, step_graph).reset()


@pytest.fixture(scope="session")
def make_rig(device: str) -> Callable[..., Rig]:
    """Return :func:`build_rig` on the device under test; every call builds another rig."""

    def make(**options) -> Rig:
        return build_rig(device, **options)

    return make


def random_pose(rng: np.random.Generator, scale: float = 0.6) -> np.ndarray:
    """Return rotation vectors of a wild pose, shape ``(22, 3)``: limbs up to 1.5 rad, spine and head 0.4 of it."""
    rotvec = rng.normal(size=(NUM_JOINTS, 3)) * scale
    rotvec[[joint_index(n) for n in ("spine1", "spine2", "spine3", "neck", "head", "left_collar", "right_collar")]] *= (
        0.4
    )
    length = np.linalg.norm(rotvec, axis=1, keepdims=True)
    return rotvec * np.minimum(1.0, 1.5 / np.maximum(length, 1e-9))


@pytest.fixture(scope="session")
def wild_pose() -> Callable[..., np.ndarray]:
    """Return :func:`random_pose`."""
    return random_pose
