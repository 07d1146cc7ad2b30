"""A clip at the control rate, in kernels: where an episode enters it, its increments, its poses."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.rotation import MAX_ANGLE, quat_log, turn_about_z
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.rng import STREAM_TASK, generator
from piavatar_envs.envs.actions import ActionMap, keep_within
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})


@wp.struct
class Clip:
    """A motion at the control rate."""

    rotation: wp.array2d(dtype=wp.quat)  # (frames, 22) local
    root: wp.array(dtype=wp.vec3)  # (frames,) [m]
    pelvis_height: float  # of the body that the clip was loaded for, at rest [m]
    starts: int  # an episode begins at a frame below this
    success: float
    fail: float
    control_cost: float


@wp.func
def frame_of(clip: Clip, start: int, step: int):
    """Frame after ``step`` steps; the last is held. Whatever a state that was set says, it is one of the clip's."""
    return wp.clamp(start + step, 0, clip.root.shape[0] - 1)


@wp.func
def root_of(clip: Clip, body: Body, e: int, frame: int):
    """The clip's root for the body of an environment: legs of another length scale its path, so that all stand."""
    height = body.rest_joint[row(e, body.rest_joint.shape[0]), 0][2]
    return (height / clip.pelvis_height) * clip.root[frame]


@wp.kernel
def draw_start(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    clip: Clip,
    body: Body,
    # out
    start: wp.array(dtype=int),
    origin: wp.array(dtype=wp.vec3),
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """Where the episode enters the clip; the body starts there, over the world's origin."""
    e, b = wp.tid()
    if not mask[e]:
        return
    random = generator(seed[e], episode[e], STREAM_TASK, 0)
    first = wp.randi(random, 0, clip.starts)
    command_rotation[e, b] = clip.rotation[first, b]
    if b == 0:
        start[e] = first
        at = root_of(clip, body, e, first)
        origin[e] = wp.vec3(at[0], at[1], 0.0)
        command_root[e] = wp.vec3(0.0, 0.0, at[2])


@wp.kernel
def advance_reference(
    clip: Clip,
    body: Body,
    action_map: ActionMap,
    start: wp.array(dtype=int),
    step_count: wp.array(dtype=int),
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    # out
    reference_rotation: wp.array2d(dtype=wp.quat),
    reference_root: wp.array(dtype=wp.vec3),
):
    """The command plus the clip's own increment of this step.

    Joint limits hold for the sum, or a clip that swings would carry what actions have added past them; they are
    widened to the clip's own pose.
    """
    e, b = wp.tid()
    now = frame_of(clip, start[e], step_count[e])
    after = frame_of(clip, start[e], step_count[e] + 1)
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
    start: wp.array(dtype=int),
    origin: wp.array(dtype=wp.vec3),
    step_count: wp.array(dtype=int),
    # out
    rotation: wp.array2d(dtype=wp.quat),
    root: wp.array(dtype=wp.vec3),
):
    """The clip's pose one step ahead of the step counter."""
    e, b = wp.tid()
    frame = frame_of(clip, start[e], step_count[e] + 1)
    rotation[e, b] = clip.rotation[frame, b]
    if b == 0:
        root[e] = root_of(clip, body, e, frame) - origin[e]
