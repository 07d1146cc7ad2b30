"""Flesh: its softness, by which it lags behind commanded motion and jiggles, and how firmly bones hold it.

Soft flesh misses a share ``amount * softness`` of every *change* of the kinematic velocity; what it misses becomes
physical velocity, which strains the flesh, drags on the bones and swings back. (Attenuating the kinematic velocity
itself, as one would with a single velocity, leaves flesh behind unstrained in the split scheme: 16 cm in a squat.)

The softness is 0 at the bones and rises smoothly to 1 at ``FULL_DEPTH`` from the nearest bone particle, for flesh of
the trunk, hips and upper legs; arms, lower legs and head keep to their bones.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index

#: Distance from the nearest bone particle at which flesh is fully soft [m].
FULL_DEPTH = 0.10
SOFT_JOINTS = ("pelvis", "spine1", "spine2", "spine3", "left_hip", "right_hip")
#: Bones of these fill their flesh: a foot must bear the body. If it were as soft as the rest, it would turn about its
#: bones by 1 rad under some 70 N m, an eighth of what standing takes.
FIRM_JOINTS = ("left_ankle", "right_ankle", "left_foot", "right_foot")


def bone_distance(rest: np.ndarray, bone: np.ndarray) -> np.ndarray:
    """Return the distance of particles from the nearest bone particle [m], shape ``(P,)``.

    Args:
        rest: rest positions [m], shape ``(P, 3)``.
        bone: joint a particle tracks, -1 for flesh, shape ``(P,)``.
    """
    return cKDTree(rest[bone >= 0]).query(rest)[0]


def softness(rest: np.ndarray, bone: np.ndarray, skin_joints: np.ndarray, skin_weights: np.ndarray) -> np.ndarray:
    """Return the softness of particles in [0, 1], shape ``(P,)`` float32.

    Args:
        rest: rest positions [m], shape ``(P, 3)``.
        bone: joint a particle tracks, -1 for flesh, shape ``(P,)``.
        skin_joints: bones that move a particle, shape ``(P, 4)``.
        skin_weights: their weights, shape ``(P, 4)``.
    """
    ramp = np.clip(bone_distance(rest, bone) / FULL_DEPTH, 0.0, 1.0)
    ramp = ramp * ramp * (3.0 - 2.0 * ramp)
    soft = np.isin(skin_joints, [joint_index(name) for name in SOFT_JOINTS])
    share = np.where(soft, skin_weights, 0.0).sum(axis=1)
    return (ramp * share * (bone < 0)).astype(np.float32)


def velocity_lag(amount: float, soft: np.ndarray) -> np.ndarray:
    """Return the share of a change of commanded motion that particles miss, in the shape of ``soft``.

    Raises:
        ValueError: the amount is outside [0, 1].
    """
    if not 0.0 <= amount <= 1.0:
        raise ValueError(f"soft_tissue={amount} is outside [0, 1]")
    return (amount * soft).astype(np.float32)


def firmness(skin_joints: np.ndarray, skin_weights: np.ndarray) -> np.ndarray:
    """Return the share of particles in :data:`FIRM_JOINTS`, ``(P,)``, from joints and weights ``(P, 4)`` of each."""
    return np.where(np.isin(skin_joints, [joint_index(name) for name in FIRM_JOINTS]), skin_weights, 0.0).sum(1)


def weight_loads(mass: np.ndarray, bone: np.ndarray, skin_joints: np.ndarray, skin_weights: np.ndarray) -> np.ndarray:
    """Return the accelerations of particles by weight and support, over gravity, if bones bear their flesh; ``(P,)``.

    Flesh has its weight. The support of each bone's whole mass acts on the bone particles of that mass, and on the
    flesh of :data:`FIRM_JOINTS`, so that the loads of a bone add up to zero.

    Args:
        mass: of particles [kg], shape ``(P,)``.
        bone: joint a particle tracks, -1 for flesh, shape ``(P,)``.
        skin_joints: bones that move a particle, shape ``(P, 4)``.
        skin_weights: their weights, shape ``(P, 4)``.
    """
    bears = np.where(bone >= 0, 1.0, firmness(skin_joints, skin_weights))
    shares = mass[:, None] * skin_weights
    whole, core = (np.bincount(skin_joints.ravel(), s.ravel(), NUM_JOINTS) for s in (shares, bears[:, None] * shares))
    support = (skin_weights * (whole / np.maximum(core, 1e-9))[skin_joints]).sum(1)
    return (1.0 - bears * support).astype(np.float32)


def attachment_rates(
    depth: np.ndarray, bone_distance: np.ndarray, firm: np.ndarray, skin: float, core: float
) -> np.ndarray:
    """Return rates of the pulls that hold flesh to bones [1/s], ``(P,)``: ``skin`` at the skin, ``core`` at the bone.

    Between them they grow geometrically with the share of the way from the skin to the bone, so that a thin wrist is
    held as a thigh is.

    Args:
        depth: of particles below the skin [m], shape ``(P,)``.
        bone_distance: from the nearest bone particle [m], shape ``(P,)``.
        firm: share that is held as firmly as bone throughout, shape ``(P,)``.
        skin: rate at the skin [1/s]; 0 for no pull at all.
        core: rate at the bone [1/s].
    """
    if skin == 0.0:
        return np.zeros(len(depth))
    share = depth / np.maximum(depth + bone_distance, 1e-9)
    return skin * (core / skin) ** (1.0 - (1.0 - share) * (1.0 - np.clip(firm, 0.0, 1.0)))
