"""DeepMimic's motion clips, read from an installed ``pybullet`` and retargeted.

Format and zero pose after Peng et al., "DeepMimic: Example-guided deep reinforcement learning of physics-based
character skills", 2018. The clips are read from the user's own installation, nothing of them is shipped here.

A frame is 44 numbers: duration [s], root position [m], root wxyz, chest wxyz, neck wxyz, then for the right and the
left side hip wxyz, knee [rad], ankle wxyz, shoulder wxyz, elbow [rad]. The world is y-up; the character faces +x, its
right is +z, and in the zero pose its arms and legs hang straight down.

The character's arms end at the wrist, with which it pushes itself up. Our hand is 18 cm longer, and would enter the
ground there or lift the whole body off it; :func:`lay_hands_on_ground` bends the wrists.
"""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_index
from piavatar_envs.avatar.motion.ground import ground_level, lowest_heights, padded
from piavatar_envs.avatar.motion.motion import GREATEST_TURN, Motion, ease, hemisphere_consistent, slerp
from piavatar_envs.avatar.motion.retarget import align_limbs, leg_length, retarget, root_path
from piavatar_envs.core.extras import missing
from piavatar_envs.core.reading import reading

NUM_CHANNELS = 44
LEG_LENGTH = 0.8314  # [m] hip to knee to ankle of DeepMimic's humanoid (0.4215 + 0.4099)
JUMP_SPEED = 4.0  # [rad/s] slower steps are no jumps
JUMP_RATIO = 2.5  # how much faster than its neighbours a jump is
MEND_TIME = 0.15  # [s] how far to each side a jump is spread
_PREFIX, _SUFFIX = "humanoid3d_", ".txt"
_DOWN = np.array([0.0, 0.0, -1.0])
#: DeepMimic's world to ours: forward +x -> -y, up +y -> +z, right +z -> -x.
_TO_WORLD = Rotation.from_matrix([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_ZERO_POSE = {
    **{f"{side}_{j}": _DOWN for side in ("left", "right") for j in ("hip", "knee", "shoulder", "elbow")},
    "left_ankle": None,
    "right_ankle": None,
}
_QUATERNION_STARTS = (4, 8, 12, 16, 21, 25, 30, 35, 39)
_HINGES = (20, 29, 34, 43)  # knees and elbows


def clip_folder() -> Path | None:
    """Return the folder of the clips in an installed ``pybullet``, or ``None``. Imports nothing."""
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or not spec.submodule_search_locations:
        return None
    for location in spec.submodule_search_locations:
        folder = Path(location) / "data" / "motions"
        if folder.is_dir():
            return folder
    return None


def list_clips() -> tuple[str, ...]:
    """Return the names of the clips that are installed, without prefix; empty when there are none."""
    folder = clip_folder()
    if folder is None:
        return ()
    return tuple(sorted(p.stem.removeprefix(_PREFIX) for p in folder.glob(f"{_PREFIX}*{_SUFFIX}")))


def load_installed(name: str, rest_joints: np.ndarray) -> Motion:
    """Load an installed clip, e.g. ``"walk"``.

    Args:
        name: one of :func:`list_clips`.
        rest_joints: joints of the body it shall move [m], shape ``(22, 3)``.

    Raises:
        ImportError: ``pybullet`` is not installed.
        ValueError: there is no such clip.
    """
    folder = clip_folder()
    if folder is None:
        raise missing(f"the DeepMimic clip {name!r}", "pybullet (which has wheels for Python 3.10 and 3.11)", "motions")
    if name not in list_clips():
        raise ValueError(f"no DeepMimic clip {name!r}; installed are {', '.join(list_clips())}")
    return load_file(folder / f"{_PREFIX}{name}{_SUFFIX}", rest_joints)


def load_file(path: str | Path, rest_joints: np.ndarray) -> Motion:
    """Load one DeepMimic file and retarget it; the ground offset is the caller's.

    Args:
        path: a text file with JSON in it.
        rest_joints: joints of the body it shall move [m], shape ``(22, 3)``.

    Raises:
        ValueError: the file does not hold frames of 44 finite numbers with positive durations.
    """
    path = Path(path)
    loop, fps, frames = _read(path)
    world, root = _world_rotations(frames)
    rotations = retarget(world, align_limbs(rest_joints, _ZERO_POSE), _TO_WORLD, _TO_WORLD.inv())
    rotations = mend_jumps(rotations, fps)
    name = path.stem.removeprefix(_PREFIX)
    # DeepMimic's root is the midpoint of its hips.
    hip_centre = _TO_WORLD.apply(root) * leg_length(rest_joints) / LEG_LENGTH
    motion = Motion(
        name=f"deepmimic:{name}",
        fps=fps,
        local_rotations=rotations,
        root_position=root_path(hip_centre, Rotation.from_quat(rotations[:, 0], scalar_first=True), rest_joints),
        source=f"DeepMimic {path.stem}",
    )
    # The clips that wrap jump there, by up to 58 degrees, and walk on straight though the hips end turned a little.
    return motion.closed(heading=0.0) if loop else motion


def mend_jumps(rotations: np.ndarray, fps: float) -> np.ndarray:
    """Spread single-frame jumps of a joint over their neighbourhood.

    Some clips were spliced (walk turns a shoulder by 29 degrees within one frame). A jump is a step much faster than
    the two before and the two after it; what it has too much is shared by the frames around it.

    Args:
        rotations: wxyz, shape ``(num_frames, 22, 4)``.
        fps: frames per second [1/s].

    Returns:
        Rotations of the same shape.
    """
    first, second = (
        Rotation.from_quat(part.reshape(-1, 4), scalar_first=True) for part in (rotations[:-1], rotations[1:])
    )
    steps = (first.inv() * second).as_rotvec().reshape(-1, *rotations.shape[1:2], 3)
    speed = fps * np.linalg.norm(steps, axis=-1)
    padded = np.pad(speed, ((2, 2), (0, 0)), mode="edge")
    around = np.max([padded[i : i + len(speed)] for i in (0, 1, 3, 4)], axis=0)
    frame = np.arange(len(rotations))
    change = np.zeros((*rotations.shape[:2], 3))
    for jump, joint in np.argwhere((speed > JUMP_SPEED) & (speed > JUMP_RATIO * around)):
        excess = steps[jump, joint] * (1.0 - around[jump, joint] / speed[jump, joint])
        before = 0.5 * ease(1.0 - (jump - frame) / (MEND_TIME * fps)) * (frame <= jump)
        after = 0.5 * ease(1.0 - (frame - jump - 1) / (MEND_TIME * fps)) * (frame > jump)
        change[:, joint] += (before - after)[:, None] * excess
    mended = Rotation.from_quat(rotations.reshape(-1, 4), scalar_first=True) * Rotation.from_rotvec(
        change.reshape(-1, 3)
    )
    return mended.as_quat(scalar_first=True).reshape(rotations.shape)


def _read(path: Path) -> tuple[bool, float, np.ndarray]:
    """Return whether it loops, its rate and its frames ``(num_frames, 44)`` at that constant rate."""
    what = f'a DeepMimic clip (JSON with "Loop" of "wrap" or "none" and "Frames" of {NUM_CHANNELS} numbers each)'
    with reading(path, what):
        content = json.loads(path.read_text(encoding="utf-8"))
        loop = {"wrap": True, "none": False}[content["Loop"]]
        frames = np.array(content["Frames"], dtype=np.float64)
    if frames.ndim != 2 or frames.shape[1] != NUM_CHANNELS or len(frames) < 2:
        raise ValueError(f"{path}: frames of shape {frames.shape}, expected (at least 2, {NUM_CHANNELS})")
    if not np.isfinite(frames).all():
        raise ValueError(f"{path}: frame {np.argwhere(~np.isfinite(frames))[0][0]} holds a value that is not finite")
    durations = frames[:-1, 0]
    if durations.min() <= 0.0:
        raise ValueError(f"{path}: frame {durations.argmin()} lasts {durations.min()} s, it must be > 0")
    turns = np.abs(frames[:, _HINGES])
    if turns.max() > GREATEST_TURN:
        raise ValueError(
            f"{path}: a knee or an elbow turns by {turns.max():.3g} rad in frame {turns.max(axis=1).argmax()}, it must "
            f"be <= {GREATEST_TURN:.3g}; angles may be in degrees, and must be in radians"
        )
    for start in _QUATERNION_STARTS:
        norms = np.linalg.norm(frames[:, start : start + 4], axis=1)
        if norms.min() < 0.5:
            frame = norms.argmin()
            raise ValueError(f"{path}: the quaternion at channel {start} of frame {frame} has norm {norms[frame]}")
        frames[:, start : start + 4] = hemisphere_consistent(frames[:, start : start + 4] / norms[:, None])
    return loop, *_at_constant_rate(frames)


def _at_constant_rate(frames: np.ndarray) -> tuple[float, np.ndarray]:
    """Interpolate to the mean frame rate, because frame times vary within some clips."""
    times = np.concatenate([[0.0], np.cumsum(frames[:-1, 0])])
    fps = (len(frames) - 1) / times[-1]
    wanted = np.arange(len(frames)) / fps
    first = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(frames) - 2)
    blend = np.clip((wanted - times[first]) / (times[first + 1] - times[first]), 0.0, 1.0)
    result = frames[first] + blend[:, None] * (frames[first + 1] - frames[first])
    for start in _QUATERNION_STARTS:
        part = slice(start, start + 4)
        result[:, part] = slerp(frames[first, part], frames[first + 1, part], blend)
    return float(fps), result


def _world_rotations(frames: np.ndarray) -> tuple[list[Rotation], np.ndarray]:
    """Return world rotations of our 22 joints in DeepMimic's axes, and the root position ``(num_frames, 3)``."""

    def ball(start: int, fraction: float = 1.0) -> Rotation:
        rotation = Rotation.from_quat(frames[:, start : start + 4], scalar_first=True)
        return Rotation.from_rotvec(fraction * rotation.as_rotvec())

    def hinge(channel: int) -> Rotation:
        return Rotation.from_rotvec(frames[:, channel, None] * np.array([0.0, 0.0, 1.0]))

    # One joint there is several here: the chest's turn is shared by three spine joints, the neck's by neck and head.
    world = {"pelvis": ball(4)}
    world["spine1"] = world["pelvis"] * ball(8, 1.0 / 3.0)
    world["spine2"] = world["pelvis"] * ball(8, 2.0 / 3.0)
    world["spine3"] = world["pelvis"] * ball(8)
    world["neck"] = world["spine3"] * ball(12, 0.5)
    world["head"] = world["spine3"] * ball(12)
    for side, start in (("right", 16), ("left", 30)):
        world[f"{side}_hip"] = world["pelvis"] * ball(start)
        world[f"{side}_knee"] = world[f"{side}_hip"] * hinge(start + 4)
        world[f"{side}_ankle"] = world[f"{side}_foot"] = world[f"{side}_knee"] * ball(start + 5)
        world[f"{side}_collar"] = world["spine3"]
        world[f"{side}_shoulder"] = world["spine3"] * ball(start + 9)
        world[f"{side}_elbow"] = world[f"{side}_wrist"] = world[f"{side}_shoulder"] * hinge(start + 13)
    return [world[name] for name in JOINT_NAMES], frames[:, 1:4]


if TYPE_CHECKING:
    from piavatar_envs.avatar.body.asset import AvatarAsset, ShapedBody
    from piavatar_envs.avatar.motion.motion import Motion

MAX_BEND = np.radians(85.0)  # of a wrist
CLEARANCE = 0.03  # [m] of the hand's middle line above the ground: half its thickness
_SMOOTHING = 0.08  # [s] reach of the average over time


def lay_hands_on_ground(motion: Motion, asset: AvatarAsset, body: ShapedBody | None, window: float) -> Motion:
    """Bend the wrists, towards the back of the hand where it can be chosen, until the fingers are above the ground.

    Args:
        motion: a clip; its wrists must be where the ground is meant to be, hands apart.
        asset: the avatar.
        body: one of its shapes; without it the mean shape.
        window: of the ground level, as in :meth:`Motion.on_ground` [s].
    """
    wrists = (joint_index("left_wrist"), joint_index("right_wrist"))
    level = ground_level(lowest_heights(motion, asset, body, ignored=wrists), motion.fps, window, motion.loop)
    shape = asset if body is None else body
    rest = np.asarray(shape.joints, dtype=np.float64)
    quaternions = motion.local_rotations.copy()
    turns, positions = motion.joint_frames(rest)
    for wrist in wrists:
        middle, back = _hand(shape.vertices, asset, rest, wrist)
        length = np.linalg.norm(middle)
        along, across = turns[:, wrist, 2] @ (middle / length), turns[:, wrist, 2] @ back
        wanted = np.clip((CLEARANCE - (positions[:, wrist, 2] - level)) / length, -1.0, 1.0)
        angle = _smoothed(_bend(along, across, wanted), motion.fps, motion.loop)
        axis = np.cross(middle / length, back)
        bent = Rotation.from_quat(quaternions[:, wrist], scalar_first=True) * Rotation.from_rotvec(
            angle[:, None] * axis
        )
        quaternions[:, wrist] = bent.as_quat(scalar_first=True)
    return replace(motion, local_rotations=quaternions)


def _bend(along: np.ndarray, across: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the smallest angle [rad] that makes the fingers' rise ``along cos + across sin`` at least ``wanted``.

    Args:
        along: rise of the fingers' direction, shape ``(num_frames,)``.
        across: rise of the back of the hand.
        wanted: the least rise.
    """
    swing = np.hypot(along, across)
    # The angle at which the fingers point highest; a hand that hangs straight down bends to its back.
    highest = np.arctan2(across, along)
    highest = np.where(highest < -0.8 * np.pi, highest + 2.0 * np.pi, highest)
    reached = np.arccos(np.clip(wanted / np.maximum(swing, 1e-9), -1.0, 1.0))
    angle = np.sign(highest) * np.maximum(np.abs(highest) - reached, 0.0)
    return np.clip(np.where(along >= wanted, 0.0, angle), -MAX_BEND, MAX_BEND)


def _hand(vertices: np.ndarray, asset: AvatarAsset, rest: np.ndarray, wrist: int) -> tuple[np.ndarray, np.ndarray]:
    """Return wrist to middle fingertip [m] and the unit normal of the back of the hand, at rest, each ``(3,)``."""
    weight = np.where(asset.skin_joints == wrist, asset.skin_weights, 0.0).sum(axis=1)
    offsets = np.asarray(vertices, dtype=np.float64)[weight > 0.9] - rest[wrist]
    centre = offsets.mean(axis=0)
    middle = centre / np.linalg.norm(centre) * (offsets @ centre).max() / np.linalg.norm(centre)
    # A hand is flat: its thinnest direction is the normal. At rest palms look down and inwards.
    normal = np.linalg.svd(offsets - centre, full_matrices=False)[2][2]
    normal = normal - (normal @ middle) / (middle @ middle) * middle
    return middle, normal / np.linalg.norm(normal) * np.sign(normal[2])


def _smoothed(values: np.ndarray, fps: float, loop: bool) -> np.ndarray:
    radius = int(np.ceil(_SMOOTHING * fps))
    kernel = np.hanning(2 * radius + 3)[1:-1]
    return np.convolve(padded(values, radius, loop), kernel / kernel.sum(), mode="valid")
