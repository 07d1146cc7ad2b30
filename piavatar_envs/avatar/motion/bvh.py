"""Biovision hierarchy files (BVH): a tree of joints with offsets and channels, and a row of numbers for every frame.

After the format's description in Meredith & Maddock, "Motion capture file formats explained", 2001: a joint's rotation
is the product of those of its channels in their order, in degrees, about its own axes; positions of channels take the
place of its offset. Units and axes are those of the program that wrote the file;
:mod:`piavatar_envs.avatar.motion.recording` finds them.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.motion.recording import Recording, whole_rate
from piavatar_envs.core.reading import reading

MAX_BYTES = 2**28  # of a file: an hour of capture at 120 frames per second has half of it
MAX_JOINTS = 2000
LEAST_SHARE = 0.5  # of the frames that a header announces; a file with fewer was cut off
_CHANNEL = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)
_FRAMES = re.compile(r"\s*Frames\s*:\s*(\S+)\s+Frame\s+Time\s*:\s*(\S+)", re.IGNORECASE)


@dataclass
class _Joint:
    """A joint of the hierarchy: channels are pairs of axis and kind, such as ``("Z", "rotation")``."""

    name: str
    parent: int
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    channels: tuple[tuple[str, str], ...] = ()


def read_bvh(path: str | Path) -> Recording:
    """Read a BVH file.

    A header that announces another number of frames than there are is warned of, and those that are there count.

    Raises:
        ValueError: it is no BVH file, is cut off, holds numbers that are not finite, or more than is sensible.
        FileNotFoundError: there is no such file.
    """
    path = Path(path)
    with reading(path, "a BVH motion"):
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes, the limit is {MAX_BYTES}; cut it into clips")
        header, motion, body = re.sub(r"([{}])", r"\n\1\n", path.read_text("utf-8", "replace")).partition("MOTION")
        if not motion:
            raise ValueError("it has no MOTION")
        joints = _hierarchy(iter(header.splitlines()))
        fps, frames = _frames(path, body, joints)
        turns, positions = _forward_kinematics(joints, frames)
        zero = np.zeros((len(joints), 3))
        for index, joint in enumerate(joints):
            zero[index] = np.add(joint.offset, zero[joint.parent] if index else 0.0)
        return Recording(
            name=path.stem,
            fps=fps,
            names=tuple(joint.name for joint in joints),
            parents=np.array([joint.parent for joint in joints]),
            zero=zero,
            turns=turns,
            positions=positions,
            source=f"BVH {path}",
        )


def _hierarchy(lines: Iterator[str]) -> list[_Joint]:
    """Read the joints, parents before children; end sites are left out."""
    joints: list[_Joint] = []
    open_joints: list[_Joint | None] = []  # None stands for an end site
    indices: list[int] = []
    latest: _Joint | None = None
    for line in filter(None, map(str.strip, lines)):
        word, *rest = line.split(maxsplit=1)
        text = rest[0] if rest else ""
        if word.upper() in ("ROOT", "JOINT"):
            if not indices and joints:
                raise ValueError(f"{text!r} is a second root; give every figure a file of its own")
            if len(joints) == MAX_JOINTS:
                raise ValueError(f"it has more than {MAX_JOINTS} joints")
            latest = _Joint(text, indices[-1] if indices else -1)
            joints.append(latest)
        elif word.upper() == "END":
            latest = None
        elif word == "{":
            open_joints.append(latest)
            indices.append(len(joints) - 1)
        elif word == "}":
            open_joints.pop()
            indices.pop()
        elif word.upper() == "OFFSET" and open_joints:
            offset = tuple(map(float, text.split()))
            if len(offset) != 3 or not np.isfinite(offset).all():
                raise ValueError(f"an offset is {text!r}, expected three numbers")
            if open_joints[-1] is not None:
                open_joints[-1].offset = offset
        elif word.upper() == "CHANNELS" and open_joints and open_joints[-1] is not None:
            open_joints[-1].channels = _channels(open_joints[-1].name, text)
        elif word.upper() != "HIERARCHY":
            raise ValueError(f"the hierarchy has {line[:40]!r}, expected ROOT, JOINT, End Site, OFFSET or CHANNELS")
    if open_joints or not joints:
        raise ValueError(f"the hierarchy ends within {len(open_joints)} braces, after {len(joints)} joints")
    return joints


def _channels(joint: str, text: str) -> tuple[tuple[str, str], ...]:
    """Return the channels of a joint from ``"3 Zrotation Xrotation Yrotation"``."""
    count, *names = text.split()
    found = [_CHANNEL.fullmatch(name) for name in names]
    channels = tuple((match[1].upper(), match[2].lower()) for match in found if match)
    if int(count) != len(names) or len(channels) != len(names) or len(set(channels)) != len(names):
        raise ValueError(f"channels of {joint!r} are {text[:80]!r}, expected their number and as many different names")
    return channels


def _frames(path: Path, body: str, joints: list[_Joint]) -> tuple[float, np.ndarray]:
    """Return the rate [1/s] and the rows of numbers, ``(num_frames, channels)``."""
    header = _FRAMES.match(body)
    if header is None:
        raise ValueError("MOTION is not followed by 'Frames: COUNT' and 'Frame Time: SECONDS'")
    announced, frame_time = int(header[1]), float(header[2])
    if not 0.0 < frame_time < np.inf:
        raise ValueError(f"the frame time is {frame_time:g} s, it must be > 0")
    values = np.array(body[header.end() :].split(), dtype=np.float64)
    channels = [f"{axis}{kind} of {joint.name!r}" for joint in joints for axis, kind in joint.channels]
    if not channels or len(values) % len(channels):
        raise ValueError(f"it has {len(values)} numbers, no multiple of its {len(channels)} channels; it was cut off")
    frames = values.reshape(-1, len(channels))
    if len(frames) < 2 or not 0 <= announced <= len(frames) / LEAST_SHARE:
        raise ValueError(f"it has {len(frames)} frames, and its header says {announced}; at least 2 are needed")
    if announced != len(frames):
        warnings.warn(f"{path}: the header says {announced} frames, there are {len(frames)}", stacklevel=2)
    if not np.isfinite(frames).all():
        frame, channel = np.argwhere(~np.isfinite(frames))[0]
        raise ValueError(f"{channels[channel]} is {frames[frame, channel]} in frame {frame}")
    return whole_rate(1.0 / frame_time), frames


def _forward_kinematics(joints: list[_Joint], frames: np.ndarray) -> tuple[list[Rotation], np.ndarray]:
    """Return world rotations of every joint, and positions ``(num_frames, joints, 3)``."""
    turns: list[Rotation] = []
    positions = np.empty((len(frames), len(joints), 3))
    column = 0
    for index, joint in enumerate(joints):
        values = frames[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        offset = np.tile(joint.offset, (len(frames), 1))
        angles = []
        for (axis, kind), value in zip(joint.channels, values.T, strict=True):
            if kind == "position":
                offset[:, "XYZ".index(axis)] = value
            else:
                angles.append((axis, value))
        local = Rotation.identity(len(frames))
        if angles:
            order = "".join(axis for axis, _ in angles)
            local = Rotation.from_euler(order, np.stack([value for _, value in angles], axis=1), degrees=True)
        if index:
            positions[:, index] = positions[:, joint.parent] + turns[joint.parent].apply(offset)
            turns.append(turns[joint.parent] * local)
        else:
            positions[:, index] = offset
            turns.append(local)
    return turns, positions
