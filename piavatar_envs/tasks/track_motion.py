"""TrackMotion: follow a clip while impulses from random directions disturb the body."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.rigs import read_mapping
from piavatar_envs.avatar.body.skeleton import NUM_ACTUATED, NUM_JOINTS, joint_index
from piavatar_envs.avatar.kinematics import pose_body
from piavatar_envs.avatar.motion.collection import Sampling, Split, chosen, find_motions, load_frames
from piavatar_envs.avatar.rotation import MAX_ANGLE, quat_log, turn_about_z
from piavatar_envs.avatar.skinning import bones_of, weights_of
from piavatar_envs.avatar.torque_control.controller import TorqueController
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import ConfigError, EnvConfig
from piavatar_envs.config import replace as changed
from piavatar_envs.core.rng import STREAM_DISTURBANCE, STREAM_TASK
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.actions import ActionMap, ActionSpec, keep_within
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, random_of, rest_joint
from piavatar_envs.envs.observations import ObservationTerm, write_rotation, write_vector
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.mpm.types import row
from piavatar_envs.sim.bodies import load_avatar, shape_parameters
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.ranges import Margin, Weight
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance

wp.set_module_options({"enable_backward": False})

#: Bones that impulses strike: heavy enough not to be torn off by a few N s.
STRUCK = ("pelvis", "spine2", "spine3", "head", "left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_knee")
#: Legs of the longest-legged random body, over those of the mean one.
LONGEST_LEGS = 1.3


class TrackMotionConfig(EnvConfig):
    """Settings of TrackMotion."""

    motion: str | Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        "step",
        description="name of a clip, path of a motion file, or of a folder of them (with a slash: ./walks), or a list "
        "of these; each episode draws one motion of all",
    )
    split: Split = Field("all", description="motions to draw from: all, or a part by the hash of their names")
    held_out_share: float = Field(0.2, ge=0.0, le=1.0, description="share of motions that a split holds out [-]")
    loop: bool = Field(False, description="close clips whose end nearly meets their start, and go on")
    motion_mapping: str | None = Field(
        None,
        description="JSON file that names nodes of BVH and glTF skeletons by joint; null finds them by their names",
    )
    random_start: bool = Field(True, description="begin anywhere in a clip that loops, or is longer than the episode")
    root_action: bool = Field(True, description="whether x, y and yaw of the root act too")
    impulse: float = Field(20.0, ge=0.0, le=1000.0, description="greatest impulse on the body, 0 for none [N s]")
    impulse_interval: float = Field(1.0, gt=0.0, le=3600.0, description="time between impulses [s]")
    success_distance: Margin = Field(0.1, description="MPJPE up to which the motion counts as followed [m]")
    fail_distance: Margin = Field(0.5, description="MPJPE at which the episode ends [m]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")


@wp.struct
class Clip:
    """Motions at the control rate, one after the other, and constants of the reward."""

    rotation: wp.array2d(dtype=wp.quat)  # (frames, 22) local
    root: wp.array(dtype=wp.vec3)  # (frames,) [m]
    first: wp.array(dtype=int)  # frame of each motion, and the number of all frames
    starts: wp.array(dtype=int)  # an episode begins at a frame of its motion below this
    pelvis_height: float  # of the body that the motions were loaded for, at rest [m]
    success_distance: float
    fail_distance: float
    control_cost: float


@wp.func
def frame_of(clip: Clip, playing: int, start: int, step: int):
    """Return the frame after ``step`` steps: clamped, because a restored state may hold any motion and frame."""
    motion = wp.clamp(playing, 0, clip.starts.shape[0] - 1)
    first = clip.first[motion]
    return first + wp.clamp(start + step, 0, clip.first[motion + 1] - first - 1)


@wp.func
def root_of(clip: Clip, body: Body, e: int, frame: int):
    """Return the clip's root, scaled by the length of the body's legs."""
    height = rest_joint(body, e, 0)[2]
    return (height / clip.pelvis_height) * clip.root[frame]


@wp.func
def draw_motion(random: wp.uint32, shares: wp.array2d(dtype=float), e: int):
    """Return a motion by the cumulative shares of all, where these are set; else any, with equal probability."""
    count = shares.shape[1]
    if not shares[e, count - 1] > 0.0:
        return wp.randi(random, 0, count)
    drawn = wp.randf(random) * shares[e, count - 1]
    least = int(0)
    most = int(count - 1)
    while least < most:  # the first motion whose cumulative share exceeds the number
        middle = (least + most) // 2
        if shares[e, middle] > drawn:
            most = middle
        else:
            least = middle + 1
    return least


@wp.kernel
def draw_start(
    episodes: Episodes,
    clip: Clip,
    body: Body,
    shares: wp.array2d(dtype=float),
    # out
    playing: wp.array(dtype=int),
    start: wp.array(dtype=int),
    origin: wp.array(dtype=wp.vec3),
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """Draw a motion, and the frame at which the episode enters it; the body starts in its pose, over the origin."""
    e, b = wp.tid()
    if not episodes.mask[e]:
        return
    of_motion = random_of(episodes, e, STREAM_TASK, 1)
    motion = draw_motion(of_motion, shares, e)
    random = random_of(episodes, e, STREAM_TASK, 0)
    entered = wp.randi(random, 0, clip.starts[motion])
    frame = clip.first[motion] + entered
    command_rotation[e, b] = clip.rotation[frame, b]
    if b == 0:
        playing[e] = motion
        start[e] = entered
        at = root_of(clip, body, e, frame)
        origin[e] = wp.vec3(at[0], at[1], 0.0)
        command_root[e] = wp.vec3(0.0, 0.0, at[2])


@wp.kernel
def advance_reference(
    clip: Clip,
    body: Body,
    action_map: ActionMap,
    playing: wp.array(dtype=int),
    start: wp.array(dtype=int),
    episodes: Episodes,
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    # out
    reference_rotation: wp.array2d(dtype=wp.quat),
    reference_root: wp.array(dtype=wp.vec3),
):
    """Add the clip's increment of this step to the command.

    Joint limits hold for the sum; otherwise action offsets accumulate past the limits as the clip moves. They are
    widened to the clip's own pose.
    """
    e, b = wp.tid()
    now = frame_of(clip, playing[e], start[e], episodes.step_count[e])
    after = frame_of(clip, playing[e], start[e], episodes.step_count[e] + 1)
    step = wp.quat_inverse(clip.rotation[now, b]) * clip.rotation[after, b]
    q = wp.normalize(command_rotation[e, b] * step)
    own = quat_log(clip.rotation[after, b])
    if action_map.offset[b] >= 0 and wp.length(own) < MAX_ANGLE:
        q = keep_within(q, action_map.lower[b], action_map.upper[b], own)
    reference_rotation[e, b] = q
    if b == 0:
        turn = turn_about_z(command_rotation[e, 0] * wp.quat_inverse(clip.rotation[now, 0]))
        way = root_of(clip, body, e, after) - root_of(clip, body, e, now)
        reference_root[e] = command_root[e] + wp.quat_rotate(turn, way)


@wp.kernel
def read_clip(
    clip: Clip,
    body: Body,
    playing: wp.array(dtype=int),
    start: wp.array(dtype=int),
    origin: wp.array(dtype=wp.vec3),
    episodes: Episodes,
    # out
    rotation: wp.array2d(dtype=wp.quat),
    root: wp.array(dtype=wp.vec3),
):
    """Read the clip's pose one step ahead of the step counter."""
    e, b = wp.tid()
    frame = frame_of(clip, playing[e], start[e], episodes.step_count[e] + 1)
    rotation[e, b] = clip.rotation[frame, b]
    if b == 0:
        root[e] = root_of(clip, body, e, frame) - origin[e]


@wp.func
def offset_of(episodes: Episodes, e: int, interval: int):
    """Return the number of steps already elapsed in the first interval."""
    random = random_of(episodes, e, STREAM_DISTURBANCE, 0)
    return wp.randi(random, 0, interval)


@wp.kernel
def draw_offset(
    episodes: Episodes,
    interval: int,
    # out
    offset: wp.array(dtype=int),
):
    """Write the offset of the first impulse, to be observed, in the masked environments."""
    e = wp.tid()
    if episodes.mask[e]:
        offset[e] = offset_of(episodes, e, interval)


@wp.kernel
def draw_impulse(
    episodes: Episodes,
    interval: int,
    magnitude: float,
    bones: wp.array(dtype=int),
    # out
    impulse: wp.array(dtype=wp.vec3),
    struck: wp.array(dtype=int),
):
    """Draw an impulse [N s] on one of ``bones`` every ``interval`` steps, at the episode's offset; else none."""
    e = wp.tid()
    impulse[e] = wp.vec3(0.0)
    struck[e] = bones[0]
    step = episodes.step_count[e] + offset_of(episodes, e, interval)
    if magnitude <= 0.0 or step % interval != interval - 1:
        return
    random = random_of(episodes, e, STREAM_DISTURBANCE, 1 + step)
    direction = wp.sample_unit_sphere_surface(random)
    impulse[e] = magnitude * wp.randf(random, 0.3, 1.0) * direction
    struck[e] = bones[wp.randi(random, 0, bones.shape[0])]


@wp.kernel
def apply_impulse(
    body: Body,
    impulse: wp.array(dtype=wp.vec3),
    struck: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
):
    """Distribute an impulse over the particles of the struck bone by their skinning weights; its sum is exact."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    b = struck[e]
    bones = bones_of(body.skin, p)
    weights = weights_of(body.skin, p)
    share = float(0.0)
    for n in range(4):
        if bones[n] == b:
            share += weights[n]
    if share > 0.0:
        mass = body.bone_mass[row(e, body.bone_mass.shape[0]), b]
        u[e, body.first + p] = u[e, body.first + p] + (share / mass) * impulse[e]


@wp.kernel
def judge(
    clip: Clip,
    bones: Bones,
    clip_rotation: wp.array2d(dtype=wp.quat),
    clip_position: wp.array2d(dtype=wp.vec3),
    impulse: wp.array(dtype=wp.vec3),
    playing: wp.array(dtype=int),
    action: wp.array3d(dtype=float),
    # in and out
    errors: wp.array3d(dtype=wp.vec3),
    # out
    outcome: Outcome,
):
    """Reward positions and rotations close to the clip's.

    The error of an acceleration is the second difference of the error of a position; ``errors`` holds those of the
    last two steps. Before an episode they are zero, because its body begins in the clip's pose.
    """
    e = wp.tid()
    count = bones.local.shape[1]
    distance = float(0.0)
    local = float(0.0)
    acceleration = float(0.0)
    angle = float(0.0)
    root = bones.position[e, 0] - clip_position[e, 0]
    for b in range(count):
        error = bones.position[e, b] - clip_position[e, b]
        distance += wp.length(error) / float(count)
        local += wp.length(error - root) / float(count)
        acceleration += wp.length(error - 2.0 * errors[e, 0, b] + errors[e, 1, b]) / float(count)
        errors[e, 1, b] = errors[e, 0, b]
        errors[e, 0, b] = error
        angle += wp.length(quat_log(wp.quat_inverse(clip_rotation[e, b]) * bones.local[e, b])) / float(count)
    outcome.terms[e, 0, TrackMotionTask.rewards.position] = 0.6 * tolerance(distance, 0.01, 0.3)
    outcome.terms[e, 0, TrackMotionTask.rewards.rotation] = 0.4 * tolerance(angle, 0.01, 0.5)
    outcome.terms[e, 0, TrackMotionTask.rewards.control] = -clip.control_cost * mean_square_action(action, e, 0)
    outcome.metrics[e, 0, TrackMotionTask.metrics.mpjpe] = distance
    outcome.metrics[e, 0, TrackMotionTask.metrics.local_mpjpe] = local
    outcome.metrics[e, 0, TrackMotionTask.metrics.acceleration_error] = 1000.0 * acceleration
    outcome.metrics[e, 0, TrackMotionTask.metrics.rotation_error_deg] = wp.degrees(angle)
    outcome.metrics[e, 0, TrackMotionTask.metrics.root_error] = wp.length(bones.position[e, 0] - clip_position[e, 0])
    outcome.metrics[e, 0, TrackMotionTask.metrics.impulse] = wp.length(impulse[e])
    outcome.metrics[e, 0, TrackMotionTask.metrics.motion] = float(playing[e])
    outcome.success[e, 0] = distance <= clip.success_distance
    outcome.terminated[e, 0] = distance > clip.fail_distance


@wp.kernel
def observe(
    bones: Bones,
    clip_rotation: wp.array2d(dtype=wp.quat),
    clip_world: wp.array2d(dtype=wp.quat),
    clip_position: wp.array2d(dtype=wp.vec3),
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write ``TrackMotionTask.observation_terms`` from component ``start``."""
    e, b = wp.tid()
    count = bones.rotation.shape[1]
    to_root = wp.quat_inverse(bones.rotation[e, 0])
    error = wp.quat_rotate(to_root, clip_position[e, b] - bones.position[e, b])
    write_vector(observation, e, agent, start + 3 * b, error)
    turn_at = start + 3 * count
    if b == 0:
        write_rotation(observation, e, agent, turn_at, to_root * clip_world[e, 0])
    else:
        step = quat_log(wp.quat_inverse(bones.local[e, b]) * clip_rotation[e, b])
        write_vector(observation, e, agent, turn_at + 6 + 3 * (b - 1), step)


class TrackMotionTask(Task):
    """Follow a clip; actions are added to its increments."""

    Config = TrackMotionConfig
    description = "follow a clip while impulses from random directions disturb the body"
    observation_terms = (
        ObservationTerm("reference_positions", 3 * NUM_JOINTS, "m", "root", "the clip's next joints from the avatar's"),
        ObservationTerm("reference_root", 6, "-", "root", "the clip's next pelvis orientation, two columns"),
        ObservationTerm("reference_turns", 3 * NUM_ACTUATED, "rad", "bone", "rotation vectors to the clip's next pose"),
    )
    rewards = (
        Term("position", "0.6 while `mpjpe` is at most 0.01 m; beyond it a Gaussian that has fallen to 0.06 at 0.31 m"),
        Term(
            "rotation",
            "0.4 while the mean rotation error of the joints is at most 0.01 rad; beyond it a Gaussian that has fallen "
            "to 0.04 at 0.51 rad",
        ),
        CONTROL,
    )
    metrics = (
        Metric("mpjpe", "m", "mean distance of the joints from the clip's, in the world (PHC's G-MPJPE)"),
        Metric("local_mpjpe", "m", "the same with both pelvis joints at one place (PHC's MPJPE)"),
        Metric("acceleration_error", "mm/frame^2", "mean error of the joints' accelerations (PHC's), frames are steps"),
        Metric("rotation_error_deg", "deg", "mean angle between the joints' local rotations and the clip's"),
        Metric("root_error", "m", "distance of the pelvis from the clip's"),
        Metric("impulse", "N s", "impulse that struck the body in this step, 0 for none"),
        Metric("motion", "-", "index of the clip that the episode follows, in the order of their names"),
    )
    state_arrays = (
        TaskArray("playing", int),
        TaskArray("start", int),
        TaskArray("origin", wp.vec3),
        TaskArray("errors", wp.vec3, (2, NUM_JOINTS), cleared=True),
    )
    scratch_arrays = (
        TaskArray("reference_rotation", wp.quat, (NUM_JOINTS,)),
        TaskArray("reference_root", wp.vec3),
        TaskArray("clip_rotation", wp.quat, (NUM_JOINTS,)),
        TaskArray("clip_root", wp.vec3),
        TaskArray("clip_world", wp.quat, (NUM_JOINTS,)),
        TaskArray("clip_position", wp.vec3, (NUM_JOINTS,)),
        TaskArray("still", wp.vec3, (NUM_JOINTS,)),
        TaskArray("impulse", wp.vec3),
        TaskArray("struck", int),
        TaskArray("offset", int),
    )
    targets_about_reference = True

    summary = """The reference pose follows a clip (each episode draws one where `motion` names several), and every
`impulse_interval` an impulse of 0.3 to 1 times `impulse` and of random direction strikes trunk, head, shoulders, hips
or left knee. Actions are added to the clip's own increments: with zero actions the commanded pose is the clip's, and a
disturbance decays only as firmly as `tone` and the root wrench pull. A good agent steers against the disturbance and
stays on the clip. With `control="torque"` or `"pd"` only the joints move the body, which begins with the clip's own
velocity. Files and folders of motions, their split and the figures that PHC reports:
[avatars.md](../avatars.md#motions)."""
    success_doc = "`mpjpe` is at most `success_distance`"
    termination_doc = "`mpjpe` exceeds `fail_distance`"
    picture_seconds = 1.5
    picture_actions = "zero"
    picture_settings: ClassVar[Mapping[str, Any]] = {"motion": "kick", "random_start": False}

    config: TrackMotionConfig

    def __init__(self, config: TrackMotionConfig) -> None:
        super().__init__(config)
        dt = config.physics.control_dt
        own = self.scene.avatars[0]
        asset = load_avatar(config.avatar.of_avatar(own.avatar))
        parameters = shape_parameters(asset, changed(config.shape, own.shape))
        self.pelvis_height = float(asset.shape(parameters).joints[0, 2])
        self.interval = max(1, round(config.impulse_interval / dt))
        sampling = Sampling(dt, max(1, round(config.episode_seconds / dt)), config.random_start)
        try:
            mapping = None if config.motion_mapping is None else read_mapping(config.motion_mapping)
            entries = chosen(find_motions(config.motion), config.split, config.held_out_share)
            self.frames = load_frames(entries, asset, parameters, mapping, config.loop, sampling)
        except (ValueError, FileNotFoundError) as error:
            raise ConfigError(f"motion: {error}") from None
        self.motion_names = self.frames.names

    def drawn(self) -> tuple[Parameter, ...]:
        dt = self.config.physics.control_dt
        last = (self.interval - 1) * dt if self.config.impulse > 0.0 else 0.0
        latest = float(self.frames.starts.max() - 1) * dt
        return (
            Parameter("motion", "-", 0.0, len(self.frames.names) - 1.0, "index of the clip"),
            Parameter("motion_start", "s", 0.0, latest, "where the episode enters the clip"),
            Parameter("impulse_offset", "s", 0.0, last, "time of the first interval that is over at the start"),
        )

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        dt = self.config.physics.control_dt
        return Drawn(self.playing), Drawn(self.start, dt), Drawn(self.offset, dt)

    def action_spec(self) -> ActionSpec:
        speed = self.config.control.joint_speed_limit
        return ActionSpec(self.joints, root=self.config.root_action, joint_speed=speed)

    def domain(self) -> Domain:
        """Move the default box along the clip; random bodies may take longer steps than the body of the clip."""
        least, most = self.frames.reach()
        scale = LONGEST_LEGS if self.config.shape.randomize else 1.0
        box = Domain()
        lower = (*(np.asarray(box.lower[:2]) + scale * least).tolist(), box.lower[2])
        top = max(box.upper[2], self.frames.roots[:, 2].max() + 1.3)
        return Domain(lower, (*(np.asarray(box.upper[:2]) + scale * most).tolist(), top))

    def impulses(self) -> dict[str, float]:
        """Return the impulse on any of the bones in :data:`STRUCK`."""
        return dict.fromkeys(STRUCK, self.config.impulse)

    def allocate(self, env) -> None:
        device = env.device
        frames = self.frames
        xyzw = np.ascontiguousarray(frames.rotations[..., [1, 2, 3, 0]], np.float32)
        self.clip = fill(
            Clip(),
            self.config,
            rotation=wp.array(xyzw, dtype=wp.quat, device=device),
            root=wp.array(frames.roots.astype(np.float32), dtype=wp.vec3, device=device),
            first=wp.array(frames.first.astype(np.int32), dtype=int, device=device),
            starts=wp.array(frames.starts.astype(np.int32), dtype=int, device=device),
            pelvis_height=self.pelvis_height,
        )
        controller = env.simulation.controllers[0]
        if isinstance(controller, TorqueController):  # torques could not reach the clip's speed at once
            controller.first = self.clip_rotation, self.clip_root
        self.bones = wp.array([joint_index(name) for name in STRUCK], dtype=int, device=device)
        self.motion_shares = wp.zeros((env.num_envs, len(self.motion_names)), dtype=float, device=device)

    def arrays(self) -> dict[str, wp.array]:
        return {**super().arrays(), "motion_shares": self.motion_shares}

    def record_reset(self, env, graph) -> None:
        drive = env.simulation.avatar.state
        graph.launch(
            draw_start,
            (env.num_envs, NUM_JOINTS),
            [env.episodes, self.clip, env.simulation.avatar.body, self.motion_shares],
            [self.playing, self.start, self.origin, drive.command_rotation, drive.command_root],
        )
        graph.launch(draw_offset, env.num_envs, [env.episodes, self.interval], [self.offset])
        if isinstance(env.simulation.controllers[0], TorqueController):
            self._record_next_pose(env, graph)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        drive, config = env.simulation.avatar.state, self.config
        graph.launch(
            advance_reference,
            (env.num_envs, NUM_JOINTS),
            [
                self.clip, env.simulation.avatar.body, env.action_map, self.playing, self.start, env.episodes,
                drive.command_rotation, drive.command_root,
            ],
            [self.reference_rotation, self.reference_root],
        )  # fmt: skip
        graph.launch(
            draw_impulse,
            env.num_envs,
            [env.episodes, self.interval, config.impulse, self.bones],
            [self.impulse, self.struck],
        )
        avatar = env.simulation.avatar
        graph.launch(
            apply_impulse,
            (env.num_envs, avatar.num_points),
            [avatar.body, self.impulse, self.struck, env.simulation.state.failure],
            [env.simulation.state.u],
        )
        return [(self.reference_rotation, self.reference_root)]

    def _record_next_pose(self, env, graph) -> None:
        """Append: read the clip's pose one step ahead of the counter."""
        graph.launch(
            read_clip,
            (env.num_envs, NUM_JOINTS),
            [self.clip, env.simulation.avatar.body, self.playing, self.start, self.origin, env.episodes],
            [self.clip_rotation, self.clip_root],
        )

    def _record_clip(self, env, graph) -> None:
        """Append: read that pose, and find its bones in the world."""
        n = env.num_envs
        self._record_next_pose(env, graph)
        avatar = env.simulation.avatar
        graph.launch(
            pose_body,
            (n, avatar.threads),
            [avatar.body, 0.0, self.clip_rotation, self.clip_root, self.still, self.still[:, 0], avatar.threads],
            [self.clip_world, self.clip_position],
        )

    def record_outcome(self, env, graph) -> None:
        self._record_clip(env, graph)
        inputs = [self.clip, env.bones[0], self.clip_rotation, self.clip_position, self.impulse, self.playing]
        graph.launch(judge, env.num_envs, [*inputs, env.action], [self.errors, env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        self._record_clip(env, graph)
        inputs = [env.bones[agent], self.clip_rotation, self.clip_world, self.clip_position, agent, start]
        graph.launch(observe, (env.num_envs, NUM_JOINTS), inputs, [env.observation])


TASK = TrackMotionTask
