"""Motion of a file's own skeleton, and its way to ours: nodes, unit, axes and zero pose are found from the figure.

Retargeting counts turns from a *zero pose* in which the limbs point where our rest pose can be brought
(:mod:`piavatar_envs.avatar.motion.retarget`). It is the pose of the file's skeleton without turns, where that is a
standing figure. Some skeletons have none: all offsets lie along one axis. Their zero pose is the frame in which the
figure stands most like our rest pose.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.rigs import JointMap, axes_of, joints_of, map_joints
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS, joint_index
from piavatar_envs.avatar.motion.motion import Motion
from piavatar_envs.avatar.motion.retarget import (
    LIMB_ENDS,
    align_limbs,
    leg_length,
    retarget,
    root_path,
    shortest_rotation,
)

#: Metres in a unit of length.
UNITS: dict[str, float] = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254}
RATE_DIGITS = 5e-4  # relative
LEGS = 0.55, 1.1  # [m] hip to knee to ankle, from a child of eight years to a very tall adult
STRAIGHT = 0.7  # cosine between trunk and each leg bone of a standing figure, at least
ERECT = 0.8  # mean cosine between trunk and an axis that is taken for up
GROUND = 0.25  # lengths of the leg from the origin's height, within which the lowest joint of a standing figure is
REST_BEND = np.radians(15.0)  # of elbows and knees in a frame that shows the zero pose
LEAST_JUMP = 5.0  # [rad/s] slower steps after the first frame are no jumps
JUMP_RATIO = 4.0  # how much faster than the next steps a jump is
_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_SEARCHED = 400  # frames among which a zero pose is looked for


def whole_rate(rate: float) -> float:
    """Return a rate [1/s], or the whole number that it is but for the digits of the time between its frames."""
    return float(round(rate)) if abs(round(rate) - rate) < RATE_DIGITS * rate else rate


@dataclass(frozen=True, eq=False)
class Recording:
    """Motion of ``N`` nodes in the unit and axes of a file.

    Attributes:
        name: of the clip.
        fps: frames per second [1/s].
        names: of the nodes.
        parents: node that each hangs on, -1 for a root, shape ``(N,)``.
        zero: positions in the zero pose, shape ``(N, 3)``.
        turns: for each node its world rotations since the zero pose, ``num_frames`` in each.
        positions: shape ``(num_frames, N, 3)``.
        source: file that it comes from.
        joint_map: nodes of our joints, where the file's reader finds them.
        world: rotation from the file's world to ours, where the format fixes it; else the zero pose is upright in it.

    Raises:
        ValueError: positions that are not finite.
    """

    name: str
    fps: float
    names: tuple[str, ...]
    parents: np.ndarray
    zero: np.ndarray
    turns: list[Rotation]
    positions: np.ndarray
    source: str
    joint_map: JointMap | None = None
    world: Rotation | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.positions).all() and np.isfinite(self.zero).all()):
            raise ValueError("its lengths are too large to add up")

    def from_frame(self, first: int) -> Recording:
        """Return the recording without the frames before ``first``."""
        return replace(self, turns=[turn[first:] for turn in self.turns], positions=self.positions[first:])

    def since(self, frame: int) -> Recording:
        """Return the recording with the pose of a frame as its zero pose."""
        turns = [turn * turn[frame].inv() for turn in self.turns]
        return replace(self, zero=self.positions[frame], turns=turns)

    def mirrored(self) -> Recording:
        """Return the recording seen in a mirror normal to its x axis; names stay."""
        turns = [Rotation.from_quat(turn.as_quat() * [1.0, -1.0, -1.0, 1.0]) for turn in self.turns]
        flip = np.array([-1.0, 1.0, 1.0])
        return replace(self, zero=self.zero * flip, turns=turns, positions=self.positions * flip)


def to_motion(recording: Recording, rest_joints: np.ndarray, mapping: Mapping[str, str] | None = None) -> Motion:
    """Retarget a recording to our skeleton; the ground offset is the caller's.

    A first frame that shows the zero pose, from which the figure jumps into the motion, is dropped.

    Args:
        recording: the motion of a skeleton.
        rest_joints: joints of the body it shall move [m], shape ``(22, 3)``.
        mapping: names of nodes by joint, where the names say too little.

    Raises:
        ValueError: nodes for the limbs are not found, or the legs have no length.
    """
    joint_map = recording.joint_map
    if joint_map is None:
        joint_map = map_joints(recording.names, recording.parents, recording.zero, mapping=mapping)
    notes = list(joint_map.notes)
    if shows_rest_first(recording, joint_map):
        recording = recording.from_frame(1)
        notes.append("frame 0 shows the zero pose: dropped")
    stands = is_standing(joint_map, recording.zero)
    if not stands:
        recording = recording.since(most_upright(recording, joint_map, rest_joints))
        notes.append("the skeleton's zero pose is not a standing figure: the frame most like one is taken")
    if axes_of(joint_map, recording.zero)[1]:
        recording = recording.mirrored()
        notes.append("the file is left-handed: mirrored")
    axes = axes_of(joint_map, recording.zero)[0] if stands else _upright_axes(recording, joint_map)
    from_rest = Rotation.from_matrix(axes.T)
    to_world, note = _to_world(recording, joint_map, from_rest.inv())
    zero = joints_of(joint_map, recording.zero) @ axes.T
    leg = leg_length(zero)
    if not 0.0 < leg < np.inf:
        raise ValueError(f"{recording.source}: legs of length {leg:g} in its zero pose; it is not a figure")
    directions: dict[str, np.ndarray | None] = {
        start: zero[joint_index(end)] - zero[joint_index(start)] for start, end in LIMB_ENDS.items()
    }
    directions |= {"left_ankle": None, "right_ankle": None}
    rotations = retarget(
        _turns_of_joints(recording, joint_map), align_limbs(rest_joints, directions), to_world, from_rest
    )
    hip_centre = to_world.apply(_hip_centre(joint_map, recording.positions)) * leg_length(rest_joints) / leg
    return Motion(
        name=recording.name,
        fps=recording.fps,
        local_rotations=rotations,
        root_position=root_path(hip_centre, Rotation.from_quat(rotations[:, 0], scalar_first=True), rest_joints),
        source=recording.source,
        notes=(*notes, *note, _unit_note(leg)),
    )


def shows_rest_first(recording: Recording, joint_map: JointMap) -> bool:
    """Return whether frame 0 has straight limbs, and the figure jumps from it into the motion."""
    if len(recording.positions) < 4:
        return False
    for side in ("left", "right"):
        for limb in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")):
            places = recording.positions[0, [joint_map.nodes[f"{side}_{joint}"] for joint in limb]]
            if _cosine(places[1] - places[0], places[2] - places[1]) < np.cos(REST_BEND):
                return False
    steps = [
        (recording.turns[node][:11].inv()[:-1] * recording.turns[node][1:11]).magnitude()
        for node in joint_map.nodes.values()
    ]
    speeds = recording.fps * np.max(steps, axis=0)
    return bool(speeds[0] > max(LEAST_JUMP, JUMP_RATIO * speeds[1:].max()))


def is_standing(joint_map: JointMap, zero: np.ndarray) -> bool:
    """Return whether a pose is that of a standing figure: both legs straight down from the trunk."""
    trunk = zero[joint_map.nodes["head"]] - _hip_centre(joint_map, zero)
    bones = [
        zero[joint_map.nodes[f"{side}_{end}"]] - zero[joint_map.nodes[f"{side}_{start}"]]
        for side in ("left", "right")
        for start, end in (("hip", "knee"), ("knee", "ankle"))
    ]
    across = zero[joint_map.nodes["left_hip"]] - zero[joint_map.nodes["right_hip"]]
    return min(_cosine(-trunk, bone) for bone in bones) > STRAIGHT and abs(_cosine(trunk, across)) < STRAIGHT


def most_upright(recording: Recording, joint_map: JointMap, rest_joints: np.ndarray) -> int:
    """Return the frame in which the limbs point most as in our rest pose."""
    frames = np.unique(np.linspace(0, len(recording.positions) - 1, _SEARCHED).astype(int))
    up = _up_of_frames(recording, joint_map)
    errors = []
    for frame in frames:
        places = recording.positions[frame]
        axes = _axes(up, places[joint_map.nodes["left_hip"]] - places[joint_map.nodes["right_hip"]])
        angles = [
            np.arccos(
                np.clip(
                    _cosine(
                        axes @ (places[joint_map.nodes[end]] - places[joint_map.nodes[start]]),
                        rest_joints[joint_index(end)] - rest_joints[joint_index(start)],
                    ),
                    -1.0,
                    1.0,
                )
            )
            for start, end in LIMB_ENDS.items()
        ]
        errors.append(np.linalg.norm(angles))
    return int(frames[np.argmin(errors)])


def _upright_axes(recording: Recording, joint_map: JointMap) -> np.ndarray:
    """Return the matrix that takes the recording's axes to those of its figure in the zero pose."""
    across = recording.zero[joint_map.nodes["left_hip"]] - recording.zero[joint_map.nodes["right_hip"]]
    return _axes(_up_of_frames(recording, joint_map), across)


def _axes(up: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return rows left, back and up for an axis that points up and a vector to the left."""
    left = across - (across @ up) * up
    left = left / max(np.linalg.norm(left), 1e-12)
    return np.stack([left, np.cross(up, left), up])


def _up_of_frames(recording: Recording, joint_map: JointMap) -> np.ndarray:
    """Return the signed axis along which the trunk points most, over all frames."""
    if recording.world is not None:
        return recording.world.inv().apply([0.0, 0.0, 1.0])
    return _nearest_axis(_mean_trunk(recording, joint_map))


def _to_world(recording: Recording, joint_map: JointMap, from_zero: Rotation) -> tuple[Rotation, tuple[str, ...]]:
    """Return the rotation from the recording's world to ours, and a note where its up is not what it should be.

    Some programs write a zero pose that is y-up into a world that is z-up, and stand the figure up by its root.
    """
    usual = from_zero
    # a zero pose that faces backwards is turned forwards, one that lies leaves the world as it is
    if recording.world is not None and (from_zero * recording.world.inv()).apply([0.0, 0.0, 1.0])[2] < 1.0 - 1e-6:
        usual = recording.world
    trunk = usual.apply(_mean_trunk(recording, joint_map))
    axis = _nearest_axis(trunk)
    if axis[2] != 0.0 or np.abs(trunk).max() < ERECT:
        return usual, ()
    places = usual.apply(recording.positions[:, list(joint_map.nodes.values())].reshape(-1, 3))
    heights = (places @ axis).reshape(len(recording.positions), -1)
    leg = leg_length(joints_of(joint_map, recording.zero))
    if abs(np.median(heights.min(axis=1))) > GROUND * leg:  # a figure that stands does so near the origin's height
        return usual, ()
    note = "the figure stands along another axis than its zero pose or its format: that axis is taken for up"
    warnings.warn(f"{recording.source}: {note}", stacklevel=4)
    return shortest_rotation(axis, np.array([0.0, 0.0, 1.0])) * usual, (note,)


def _nearest_axis(vector: np.ndarray) -> np.ndarray:
    """Return the signed axis that is nearest to a vector, shape ``(3,)``."""
    place = int(np.abs(vector).argmax())
    return np.sign(vector[place]) * np.eye(3)[place]


def _mean_trunk(recording: Recording, joint_map: JointMap) -> np.ndarray:
    """Return the mean direction from the hips to the head, shape ``(3,)``."""
    trunk = recording.positions[:, joint_map.nodes["head"]] - _hip_centre(joint_map, recording.positions)
    return (trunk / np.maximum(np.linalg.norm(trunk, axis=1, keepdims=True), 1e-12)).mean(axis=0)


def _hip_centre(joint_map: JointMap, positions: np.ndarray) -> np.ndarray:
    return 0.5 * (positions[..., joint_map.nodes["left_hip"], :] + positions[..., joint_map.nodes["right_hip"], :])


def _turns_of_joints(recording: Recording, joint_map: JointMap) -> list[Rotation]:
    """Return the world rotations of our 22 joints since the zero pose.

    A joint of the trunk that the rig lacks turns with those around it, in equal shares; another follows its parent.
    """
    nodes = dict(joint_map.nodes)
    nodes.setdefault("pelvis", _common_ancestor(recording.parents, nodes["left_hip"], nodes["right_hip"]))
    turns: dict[str, Rotation] = {}
    for joint in _TRUNK:
        if joint in nodes:
            turns[joint] = recording.turns[nodes[joint]]
            continue
        place = _TRUNK.index(joint)
        above = next(name for name in _TRUNK[place:] if name in nodes)
        start, share = turns[_TRUNK[place - 1]], 1.0 / (_TRUNK.index(above) - place + 1)
        turns[joint] = start * Rotation.from_rotvec(share * (start.inv() * recording.turns[nodes[above]]).as_rotvec())
    for index, joint in enumerate(JOINT_NAMES):
        if joint not in turns:
            own = joint in nodes
            turns[joint] = recording.turns[nodes[joint]] if own else turns[JOINT_NAMES[PARENTS[index]]]
    return [turns[joint] for joint in JOINT_NAMES]


def _common_ancestor(parents: np.ndarray, first: int, second: int) -> int:
    """Return the lowest node that two nodes hang on."""
    above = []
    node = int(parents[first])
    while node >= 0:
        above.append(node)
        node = int(parents[node])
    node = int(parents[second])
    while node >= 0 and node not in above:
        node = int(parents[node])
    return node if node >= 0 else first


def _unit_note(leg: float) -> str:
    """Describe the unit of length, by the legs; the motion is scaled by them whatever it is."""
    for name, metres in UNITS.items():
        if LEGS[0] <= leg * metres <= LEGS[1]:
            return f"lengths are in {name}: its legs have {leg * metres:.2f} m"
    return f"the unit of length is unknown: legs of {leg:.3g}, which the body's legs scale"


def _cosine(first: np.ndarray, second: np.ndarray) -> float:
    return float(first @ second / max(np.linalg.norm(first) * np.linalg.norm(second), 1e-12))
