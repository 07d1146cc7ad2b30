"""From another skeleton's rotations to ours: one formula for every source.

A source skeleton has its own zero pose (DeepMimic: arms hanging; SMPL: a T-pose), its own body axes and its own world.
With ``R_j`` a joint's world rotation in the source, the bone of ours turns by::

    G_j = to_world R_j from_rest A_j

where ``A_j`` (:func:`align_limbs`) moves our rest pose onto the source's zero pose, ``from_rest`` takes our body axes
to the source's, and ``to_world`` takes the source's world to ours.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index

#: The joint at the far end of each limb bone.
LIMB_ENDS: dict[str, str] = {
    f"{side}_{joint}": f"{side}_{end}"
    for side in ("left", "right")
    for joint, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
}


def shortest_rotation(start: np.ndarray, end: np.ndarray) -> Rotation:
    """Return the rotation without twist that takes the direction ``start`` to ``end``, both shape ``(3,)``.

    Raises:
        ValueError: the directions are opposite, so that the axis is undefined.
    """
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    quaternion = np.append(1.0 + a @ b, np.cross(a, b))
    if quaternion[0] < 1e-9:
        raise ValueError(f"no shortest rotation from {a} to its opposite {b}; the rest pose cannot be aligned")
    return Rotation.from_quat(quaternion, scalar_first=True)


def align_limbs(rest_joints: np.ndarray, directions: Mapping[str, np.ndarray | None]) -> Rotation:
    """Return world rotations of our bones that bring limbs of the rest pose onto given directions.

    Down each limb the rotation added at a joint is the shortest one, so that an elbow straightens about its own hinge
    and no twist is brought in. A joint not named follows its parent.

    Args:
        rest_joints: joints of our rest pose [m], shape ``(22, 3)``.
        directions: for limb joints (:data:`LIMB_ENDS`) the direction of their bone in the source's zero pose, in our
            axes, shape ``(3,)``; ``None`` for a joint that is not turned at all (a level foot).

    Returns:
        22 rotations.
    """
    rest = np.asarray(rest_joints, dtype=np.float64)
    aligned: list[Rotation] = [Rotation.identity()]
    for joint in range(1, NUM_JOINTS):
        name, parent = JOINT_NAMES[joint], aligned[PARENTS[joint]]
        if name not in directions:
            aligned.append(parent)
        elif directions[name] is None:
            aligned.append(Rotation.identity())
        else:
            bone = parent.apply(rest[joint_index(LIMB_ENDS[name])] - rest[joint])
            aligned.append(shortest_rotation(bone, np.asarray(directions[name], dtype=np.float64)) * parent)
    return Rotation.concatenate(aligned)


def retarget(
    world_rotations: list[Rotation], alignment: Rotation, to_world: Rotation, from_rest: Rotation
) -> np.ndarray:
    """Return local rotations of our skeleton from the world rotations of another.

    Args:
        world_rotations: for each of our 22 joints the source's world rotations, ``num_frames`` in each.
        alignment: 22 rotations, :func:`align_limbs`.
        to_world: source world to our world.
        from_rest: our body axes to the source's.

    Returns:
        wxyz, shape ``(num_frames, 22, 4)``.
    """
    ours = [to_world * source * (from_rest * align) for source, align in zip(world_rotations, alignment, strict=True)]
    local = [ours[0]] + [ours[PARENTS[joint]].inv() * ours[joint] for joint in range(1, NUM_JOINTS)]
    return np.stack([rotation.as_quat(scalar_first=True) for rotation in local], axis=1)


def leg_length(rest_joints: np.ndarray) -> float:
    """Return the length from hip over knee to ankle, the mean of both legs [m]."""
    rest = np.asarray(rest_joints, dtype=np.float64)
    bones = [f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee")]
    return 0.5 * sum(
        float(np.linalg.norm(rest[joint_index(LIMB_ENDS[name])] - rest[joint_index(name)])) for name in bones
    )


def root_path(hip_centre: np.ndarray, root_rotations: Rotation, rest_joints: np.ndarray) -> np.ndarray:
    """Return the path of our pelvis joint that leads the midpoint of the hip joints along ``hip_centre``.

    Skeletons agree on where the hips are, not on where above them the root is put.

    Args:
        hip_centre: midpoint of the hip joints in our world, for a body of our size [m], shape ``(num_frames, 3)``.
        root_rotations: world rotations of our root, ``num_frames`` of them.
        rest_joints: joints of our rest pose [m], shape ``(22, 3)``.
    """
    rest = np.asarray(rest_joints, dtype=np.float64)
    hips = 0.5 * (rest[joint_index("left_hip")] + rest[joint_index("right_hip")])
    return hip_centre - root_rotations.apply(hips - rest[0])
