"""One avatar that acts by a script among props and colliders: no task, no reward; everything it does is recorded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from benchmarks.physics.rig import joint_gaps
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index, skin
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import Motion
from piavatar_envs.avatar.motion.motion import ease
from piavatar_envs.config import BodyColor, EnvConfig, RenderConfig, SceneConfig, load_config
from piavatar_envs.config.schema import GarmentConfig
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.render.quantities import of_particles
from piavatar_envs.sim.scene import Domain
from piavatar_envs.sim.world import Simulation

#: A pose: rotation vectors of the joints relative to their parents (22, 3) [rad], and the pelvis joint (3,) [m].
Pose = tuple[np.ndarray, np.ndarray]
#: The pose commanded at a time [s].
Script = Callable[[float], Pose]


def standing(_time: float) -> Pose:
    """Return the rest pose, upright."""
    return np.zeros((NUM_JOINTS, 3)), load_asset().joints[0].astype(float)


def keyed(*keys: tuple[float, dict[str, Sequence[float]]]) -> Script:
    """Interpolate poses at times: joints by name with rotation vectors [rad], and ``root``, a shift of the pelvis [m].

    Between them every joint moves straight and evenly eased; before the first and after the last the body holds.
    """
    times, poses = [], []
    for time, joints in keys:
        rotation, root = standing(time)
        for name, value in joints.items():
            if name == "root":
                root = root + np.asarray(value, float)
            else:
                rotation[joint_index(name)] = value
        times.append(time)
        poses.append(np.concatenate([rotation.ravel(), root]))

    def script(time: float) -> Pose:
        after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
        span = times[after] - times[after - 1]
        share = ease(np.clip((time - times[after - 1]) / span, 0.0, 1.0))
        pose = (1.0 - share) * poses[after - 1] + share * poses[after]
        return pose[:-3].reshape(NUM_JOINTS, 3), pose[-3:]

    return script


def played(motion: Motion, start: float = 0.0) -> Script:
    """Return a script that follows a clip from its time ``start`` [s] on."""

    def script(time: float) -> Pose:
        rotation, root = motion.sample(start + time)
        return Rotation.from_quat(rotation, scalar_first=True).as_rotvec(), root

    return script


@dataclass(frozen=True)
class View:
    """Camera and moments of a picture.

    Attributes:
        eye, target: the camera and what it looks at [m].
        moments: times of the pictures [s].
        colors: of the body; each moment is drawn in all of them, see :mod:`piavatar_envs.render.quantities`.
    """

    eye: tuple[float, float, float] = (1.9, -3.1, 1.5)
    target: tuple[float, float, float] = (0.0, -0.1, 0.85)
    moments: tuple[float, ...] = (0.2,)
    colors: tuple[BodyColor, ...] = ("skin",)


@dataclass(frozen=True)
class Act:
    """Props, colliders, script and duration of a scene.

    Attributes:
        name: of the act.
        seconds: how long it is.
        scene: avatar, props and colliders.
        garments: that the avatar wears.
        script: commanded poses.
        physics, control: settings that differ from the environments' own.
        domain: where matter may go; the usual one if not given.
        view: for pictures.
        tags: what a row of results says about the act.
    """

    name: str
    seconds: float
    scene: SceneConfig = field(default_factory=SceneConfig)
    garments: tuple[GarmentConfig, ...] = ()
    script: Script = standing
    physics: dict[str, Any] = field(default_factory=dict)
    control: dict[str, Any] = field(default_factory=dict)
    domain: Domain | None = None
    view: View = View()
    tags: dict[str, Any] = field(default_factory=dict)


@dataclass
class _Backdrop:
    """Stand-in for the task that a renderer needs."""

    config: EnvConfig
    camera_position: tuple[float, float, float]
    camera_target: tuple[float, float, float]
    camera_follows: bool = False

    def place_camera(self, _aspect: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Return the camera's position and target, which the act chooses for any picture."""
        return self.camera_position, self.camera_target

    def marker_specs(self) -> tuple:
        """Return no markers, as only matter is drawn."""
        return ()

    def markers(self, _stage: Stage, _env: int) -> tuple:
        """Return no markers, as only matter is drawn."""
        return ()


class Stage:
    """The world of an act, stepped one control step at a time.

    Attributes:
        simulation: the physics.
        config, task: what a :class:`~piavatar_envs.api.pictures.Picture` of the stage reads.
    """

    def __init__(self, act: Act, fidelity: str = "coarse", device: str = "cpu") -> None:
        """Build the world; the avatar stands in the script's first pose."""
        self.act = act
        physics = {"fidelity": fidelity, **act.physics}
        render = {"camera_position": act.view.eye, "camera_target": act.view.target}
        settings = {"physics": physics, "control": act.control, "scene": act.scene, "render": render}
        settings["garments"] = act.garments
        self.config = config = load_config(EnvConfig, settings)
        self.simulation = Simulation(config, 1, device, act.domain)
        self.task = _Backdrop(config, act.view.eye, act.view.target)
        self.dt, self.steps_done = config.physics.control_dt, 0
        self._reset, self._step = LaunchGraph(self.simulation.device), LaunchGraph(self.simulation.device)
        everyone = wp.array([True], dtype=wp.bool, device=self.simulation.device)
        self.simulation.record_reset(self._reset, everyone)
        self.simulation.record_step(self._step)
        self._command("command", act.script(0.0))
        self._reset.run()

    def step(self) -> None:
        """Take one control step of the script."""
        self.steps_done += 1
        self._command("goal", self.act.script(self.steps_done * self.dt))
        self._step.run()

    def gaps(self) -> np.ndarray:
        """Return the distance of joints from their places on the parents' bones [m], shape ``(21,)``."""
        avatar = self.simulation.avatar
        return joint_gaps(avatar.tracked, avatar.body.rest_joint.numpy().astype(float))[0]

    def _command(self, which: str, pose: Pose) -> None:
        state = self.simulation.avatar.state
        rotation = Rotation.from_rotvec(pose[0]).as_quat()
        getattr(state, f"{which}_rotation").assign(rotation.astype(np.float32)[None])
        getattr(state, f"{which}_root").assign(np.asarray(pose[1], np.float32)[None])


@dataclass(frozen=True)
class Course:
    """Record of an act: an entry at the start and one after each control step; ``T`` of them.

    Attributes:
        stage: the world at the end.
        time: [s], shape ``(T,)``.
        x: particles [m], shape ``(T, P, 3)``.
        local, goal: tracked and commanded joint rotations, ``xyzw``, shape ``(T, 22, 4)``.
        bones, joints: tracked world rotations ``(T, 22, 4)`` and joint positions ``(T, 22, 3)`` [m].
        place, speed: of the props, shape ``(T, B, 3)`` [m], [m/s].
        dent: of the props: distance of their particles from their rest shape, RMS, shape ``(T, B)`` [m].
        impulse: on the body parts from every subject, shape ``(T, 6, S, 3)`` [N s].
        penetration: depth of the subjects in each other, shape ``(T, S)`` [m].
        distortion: ``|F - R|`` of the avatar's particles, shape ``(T, A)``.
        cloth: vertices of all garments [m], shape ``(T, V, 3)``.
        frames: pictures at the view's moments, in the view's colours.
    """

    stage: Stage
    time: np.ndarray
    x: np.ndarray
    local: np.ndarray
    goal: np.ndarray
    bones: np.ndarray
    joints: np.ndarray
    place: np.ndarray
    speed: np.ndarray
    dent: np.ndarray
    impulse: np.ndarray
    penetration: np.ndarray
    distortion: np.ndarray
    cloth: np.ndarray
    frames: tuple[np.ndarray, ...] = ()

    @property
    def failed(self) -> bool:
        """Return whether the simulation failed."""
        return bool(self.stage.simulation.state.failure.numpy()[0])

    @property
    def released(self) -> bool:
        """Return whether the avatar was knocked over."""
        return bool(self.stage.simulation.avatar.state.released.numpy()[0])

    @cached_property
    def joint_errors(self) -> np.ndarray:
        """Return angles between tracked and commanded rotations of all joints [deg], shape ``(T, 21)``."""
        tracked, goal = (Rotation.from_quat(q[:, 1:].reshape(-1, 4).astype(float)) for q in (self.local, self.goal))
        return np.degrees((tracked.inv() * goal).magnitude()).reshape(len(self.time), NUM_JOINTS - 1)

    def errors_of(self, *names: str) -> np.ndarray:
        """Return the sum of the angles of some joints [deg], shape ``(T,)``."""
        return self.joint_errors[:, [JOINT_NAMES.index(name) - 1 for name in names]].sum(1)

    def displacements(self, chosen: np.ndarray) -> np.ndarray:
        """Return the distance of ``chosen`` flesh from its skinned place on the tracked bones [m], ``(T, n)``."""
        points = self.stage.simulation.flesh[0].points
        found = []
        for x, local, turn, at in zip(self.x, self.local, self.bones, self.joints, strict=True):
            turned = Rotation.from_quat(turn.astype(float)).as_matrix()
            joints, weights = points.skin_joints[chosen], points.skin_weights[chosen]
            rest = points.rest[0]
            if points.correctives is not None:
                rest = rest + points.correctives.displacement(local)
            place = skin(rest[chosen], joints, weights, turned, at.astype(float), points.joints[0])
            found.append(np.linalg.norm(x[: len(chosen)][chosen] - place, axis=1))
        return np.array(found)


def perform(act: Act, fidelity: str = "coarse", device: str = "cpu", steps: int | None = None, size: int = 0) -> Course:
    """Play an act.

    Args:
        act: the act.
        fidelity: resolution, as in the environments.
        device: Warp device.
        steps: control steps; the whole act if not given.
        size: of the pictures at the view's moments [px]; 0 for none.
    """
    stage = Stage(act, fidelity, device)
    count = steps or round(act.seconds / stage.dt)
    moments = {round(moment / stage.dt) for moment in act.view.moments} if size else set()
    pictures, frames, seen, shown = [], [], [], 0
    for step in range(count + 1):
        if step:
            stage.step()
        seen.append(_look(stage))
        if step in moments:
            from piavatar_envs.api.pictures import Picture

            looks = [RenderConfig(width=size, height=size, color=color) for color in act.view.colors]
            pictures = pictures or [Picture(stage, look) for look in looks]
            frames += [picture.frame(0, stage.dt * (step - shown)) for picture in pictures]
            shown = step
    for picture in pictures:
        picture.close()
    columns = {name: np.array([entry[name] for entry in seen]) for name in seen[0]}
    return Course(stage, stage.dt * np.arange(count + 1), **columns, frames=tuple(frames))


def _look(stage: Stage) -> dict[str, np.ndarray]:
    """Copy everything that a course records."""
    simulation = stage.simulation
    avatar, props, sensors = simulation.avatar, simulation.props.state, simulation.sensors
    arrays = {
        "x": simulation.state.x,
        "local": avatar.tracked.local,
        "goal": avatar.state.goal_rotation,
        "bones": avatar.tracked.rotation,
        "joints": avatar.tracked.position,
        "place": props.position,
        "speed": props.velocity,
        "dent": props.deformation,
        "impulse": sensors.part_impulse,
        "penetration": sensors.penetration,
    }
    copies = {name: array.numpy()[0].copy() for name, array in arrays.items()}
    worn = simulation.garments
    copies["cloth"] = np.zeros((0, 3), np.float32) if worn is None else worn.cloth.state.x.numpy()[0].copy()
    own = slice(avatar.body.first, avatar.body.first + avatar.body.count)
    return copies | {"distortion": of_particles(simulation, 0, own, "distortion")}
