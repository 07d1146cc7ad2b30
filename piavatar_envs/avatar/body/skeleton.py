"""The skeleton every avatar shares: joint names, parents and forward kinematics (NumPy).

The 22 body joints are named and ordered as in SMPL-H (Romero et al., "Embodied Hands", 2017), so that
AMASS motions need no renaming. A *bone* is a joint together with the flesh it moves: bone ``b`` rotates about
joint ``b``. World axes: metres, right-handed, z up; in the rest pose the avatar faces -y and its left is +x.

Ranges of the joints: bounds on the rotation vector of every joint relative to the rest pose.

The rest pose stands with the arms lowered by some 45 degrees and elbows bent by as much, so the ranges of the arms are
those of an adult counted from there. Axes are the world's in the rest pose: +x to the left, -y forward, +z up. Values
follow the ranges of motion of the American Academy of Orthopaedic Surgeons (Greene & Heckman, "The Clinical Measurement
of Joint Motion", 1994), rounded to 5 degrees. Those of the trunk, 80 and 30 degrees of flexion and extension, 35 of
lateral bending, 45 of axial rotation, are sums over the three joints of the spine: for the lower lumbar spine, for its
upper part with the lowest thoracic vertebrae, and for the thorax. Lumbar segments bend by some 14 degrees each in the
sagittal plane, more in flexion than in extension (Pearcy, Portek & Shepherd, "Three-dimensional x-ray analysis of
normal movement in the lumbar spine", Spine 9 (1984), pp. 294-297), and hardly rotate, which the thorax does; how the
sums are split further is an *estimate*. Those of the neck are split evenly over its two joints. Ankles bend up by 30
degrees, as under the weight of a body that leans forward (an *estimate*), not by the 20 of an unloaded foot.

Limb groups: the parts of a body that move through the grid apart, so that an arm can touch the belly.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

JOINT_NAMES: tuple[str, ...] = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
)
PARENTS: tuple[int, ...] = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
NUM_JOINTS = len(JOINT_NAMES)
NUM_ACTUATED = NUM_JOINTS - 1  # every joint but the root


def _beyond() -> np.ndarray:
    """Return whether a bone is moved by a joint; ``(joint, bone)``."""
    beyond = np.eye(NUM_JOINTS, dtype=bool)
    for joint in range(NUM_JOINTS - 1, 0, -1):
        beyond[PARENTS[joint]] |= beyond[joint]
    beyond.setflags(write=False)
    return beyond


#: Whether a bone hangs on a joint, or is what it moves; ``(joint, bone)``.
BEYOND = _beyond()

#: Coarse regions of the body for sensors and metrics: name -> joints.
BODY_PARTS: dict[str, tuple[str, ...]] = {
    "head": ("neck", "head"),
    "torso": ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar"),
    "left_arm": ("left_shoulder", "left_elbow", "left_wrist"),
    "right_arm": ("right_shoulder", "right_elbow", "right_wrist"),
    "left_leg": ("left_hip", "left_knee", "left_ankle", "left_foot"),
    "right_leg": ("right_hip", "right_knee", "right_ankle", "right_foot"),
}


def joint_index(name: str) -> int:
    """Return the index of the joint ``name``.

    Raises:
        KeyError: the name is not one of :data:`JOINT_NAMES`.
    """
    try:
        return JOINT_NAMES.index(name)
    except ValueError:
        raise KeyError(f"unknown joint {name!r}; the joints are {', '.join(JOINT_NAMES)}") from None


def body_part_of_joint() -> np.ndarray:
    """Return the index into :data:`BODY_PARTS` of every joint, shape ``(22,)`` int32."""
    part = np.empty(NUM_JOINTS, dtype=np.int32)
    for index, joints in enumerate(BODY_PARTS.values()):
        part[[joint_index(name) for name in joints]] = index
    return part


def forward_kinematics(
    local_rotations: np.ndarray, root_position: np.ndarray, rest_joints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return world rotations and joint positions of poses with fixed bone offsets.

    Args:
        local_rotations: rotation of every joint relative to its parent (the root: to the world), identity in the
            rest pose, shape ``(..., 22, 3, 3)``.
        root_position: world position of the pelvis joint [m], shape ``(..., 3)``.
        rest_joints: joint positions in the rest pose [m], shape ``(22, 3)``.

    Returns:
        World rotations ``(..., 22, 3, 3)`` and joint positions [m] ``(..., 22, 3)``. The rest-to-world skinning
        transform of bone ``b`` is ``x -> rotations[b] @ (x - rest_joints[b]) + positions[b]``.
    """
    rotations = np.array(local_rotations, dtype=np.float64)
    positions = np.empty(rotations.shape[:-2] + (3,))
    positions[..., 0, :] = root_position
    for joint in range(1, NUM_JOINTS):
        parent = PARENTS[joint]
        rotations[..., joint, :, :] = rotations[..., parent, :, :] @ rotations[..., joint, :, :]
        offset = rest_joints[joint] - rest_joints[parent]
        positions[..., joint, :] = positions[..., parent, :] + rotations[..., parent, :, :] @ offset
    return rotations, positions


def local_rotations(rotations: np.ndarray) -> np.ndarray:
    """Return rotations of the joints relative to their parents from those of the bones, both shape ``(22, 3, 3)``."""
    return np.concatenate([rotations[:1], rotations[list(PARENTS[1:])].transpose(0, 2, 1) @ rotations[1:]])


def bone_maps(rotations: np.ndarray, positions: np.ndarray, rest_joints: np.ndarray) -> np.ndarray:
    """Return the affine maps of the bones from rest to world, shape ``(22, 3, 4)``; arguments as for :func:`skin`."""
    translations = positions - np.einsum("bij,bj->bi", rotations, rest_joints)
    return np.concatenate([rotations, translations[..., None]], axis=2)


def blended_maps(weights: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Return the affine maps of points by linear blend skinning, shape ``(N, 3, 4)``.

    Args:
        weights: of all bones, rows sum to one, shape ``(N, 22)``.
        maps: of the bones, from :func:`bone_maps`.
    """
    return (weights @ maps.reshape(NUM_JOINTS, 12)).reshape(-1, 3, 4)


def skin(
    points: np.ndarray,
    skin_joints: np.ndarray,
    skin_weights: np.ndarray,
    rotations: np.ndarray,
    positions: np.ndarray,
    rest_joints: np.ndarray,
) -> np.ndarray:
    """Apply linear blend skinning to rest-pose points.

    Args:
        points: rest positions [m], shape ``(N, 3)``.
        skin_joints: joints that move each point, shape ``(N, K)`` int.
        skin_weights: their weights, rows sum to one, shape ``(N, K)``.
        rotations: world rotations of the bones, shape ``(22, 3, 3)``.
        positions: world positions of the joints [m], shape ``(22, 3)``.
        rest_joints: joint positions in the rest pose [m], shape ``(22, 3)``.

    Returns:
        World positions [m], shape ``(N, 3)``.
    """
    translations = bone_maps(rotations, positions, rest_joints)[..., 3]
    blended_rotation = np.einsum("nk,nkij->nij", skin_weights, rotations[skin_joints])
    blended_translation = np.einsum("nk,nki->ni", skin_weights, translations[skin_joints])
    return np.einsum("nij,nj->ni", blended_rotation, points) + blended_translation


Bounds = tuple[tuple[float, float], ...]

# Degrees about x (bending forward is positive for the trunk, backward for hip and knee), y and z, for the left side.
_LEFT_DEGREES: dict[str, Bounds] = {
    "hip": ((-120.0, 30.0), (-45.0, 30.0), (-45.0, 45.0)),
    "knee": ((-5.0, 140.0), (-5.0, 5.0), (-15.0, 15.0)),
    "ankle": ((-30.0, 50.0), (-30.0, 20.0), (-20.0, 20.0)),
    "foot": ((-40.0, 40.0), (-5.0, 5.0), (-5.0, 5.0)),
    "collar": ((-10.0, 10.0), (-30.0, 10.0), (-20.0, 20.0)),
    "shoulder": ((-120.0, 60.0), (-120.0, 50.0), (-90.0, 90.0)),
    "elbow": ((-140.0, 30.0), (-60.0, 60.0), (-140.0, 30.0)),
    "wrist": ((-70.0, 70.0), (-70.0, 70.0), (-70.0, 70.0)),
}
_CENTER_DEGREES: dict[str, Bounds] = {
    "spine1": ((-10.0, 30.0), (-12.0, 12.0), (-5.0, 5.0)),
    "spine2": ((-10.0, 30.0), (-12.0, 12.0), (-10.0, 10.0)),
    "spine3": ((-10.0, 20.0), (-11.0, 11.0), (-30.0, 30.0)),
    "neck": ((-30.0, 25.0), (-20.0, 20.0), (-40.0, 40.0)),
    "head": ((-30.0, 25.0), (-20.0, 20.0), (-40.0, 40.0)),
}


def left_and_right(
    center: Mapping[str, Bounds], left: Mapping[str, Bounds], root: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds of all joints about x, y and z, each ``(22, 3)``, from those of the middle and the left.

    Args:
        center: by joint.
        left: by joint without its side.
        root: of the pelvis, about every axis.
    """
    bounds = np.zeros((len(JOINT_NAMES), 3, 2))
    for index, name in enumerate(JOINT_NAMES):
        side, _, joint = name.partition("_")
        if name == "pelvis":
            bounds[index] = root
        elif name in center:
            bounds[index] = center[name]
        else:
            bounds[index] = left[joint]
            if side == "right":
                # mirrored in x: rotations about y and z change sign
                bounds[index, 1:] = -bounds[index, 1:, ::-1]
    return bounds[..., 0], bounds[..., 1]


def joint_limits() -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds of the joints' rotation vectors [rad], each of shape ``(22, 3)``.

    The root is unbounded here; tasks bound its speed.
    """
    lower, upper = left_and_right(_CENTER_DEGREES, _LEFT_DEGREES, (-180.0, 180.0))
    return np.radians(lower), np.radians(upper)
