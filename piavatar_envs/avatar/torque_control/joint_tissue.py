"""Tissue of the joints: passive moments of muscles and ligaments, resistance of bent flesh, and the ends of ranges.

Moments are minus the gradient of an energy of the joints' rotation vectors ``q`` relative to the rest pose, which
:func:`~piavatar_envs.avatar.rotation.torques_of_vector` turns into torques: passive moments of
:mod:`piavatar_envs.avatar.body.passive`, of the size of the body, and the flesh's of
:mod:`piavatar_envs.avatar.body.flesh_stiffness`, which couples neighbouring joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.passive import PassiveMoments, no_moments
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.rotation import quat_log, short_of_pi
from piavatar_envs.avatar.types import Body, Pose
from piavatar_envs.core.structs import make_struct

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Inertia of a locked joint, far above that of any body [kg m^2].
LOCK = 1.0e6
#: Damping over stiffness of tissue [s].
RETARDATION_TIME = wp.constant(0.03)
#: Growth of a passive moment beyond the end of its range, as an exponent, after which it is constant.
_MOST_GROWTH = wp.constant(1.0)
#: Least coupling of two joints by flesh, over the geometric mean of their stiffnesses.
_LEAST_COUPLING = 0.01


@wp.struct
class Tissue:
    """Passive resistance of the joints, and the ends of their ranges; ``(bones,)``, see :func:`make_tissue`."""

    damping: wp.array(dtype=float)  # [N m s/rad]
    lower: wp.array(dtype=wp.vec3)  # range of the rotation vector relative to the rest pose [rad]
    upper: wp.array(dtype=wp.vec3)
    lock: wp.array(dtype=float)  # inertia of locked joints, else 0 [kg m^2]
    # passive moments at the ends of the ranges [N m], and their growth rates [1/rad]
    lower_moment: wp.array(dtype=wp.vec3)
    upper_moment: wp.array(dtype=wp.vec3)
    lower_rate: wp.array(dtype=wp.vec3)
    upper_rate: wp.array(dtype=wp.vec3)
    # (n,) muscles that span two joints: these and their shares; angle [rad], moment [N m], growth rate [1/rad]
    spanned: wp.array(dtype=wp.vec2i)
    shares: wp.array(dtype=wp.vec2)
    span: wp.array(dtype=wp.vec3)
    # flesh: joint b resists turns of coupled[first[b] : first[b + 1]], the first of which is itself
    first: wp.array(dtype=int)
    coupled: wp.array(dtype=int)
    block: wp.array(dtype=wp.mat33)  # [N m/rad]


@dataclass(frozen=True)
class JointTissue:
    """Passive resistance of a body's joints on the host.

    Attributes:
        damping: of all joints, shape ``(22,)`` [N m s/rad].
        lower, upper: ends of their ranges, shape ``(22, 3)`` [rad].
        locked: joints that do not move: the bones beyond them are rigid extensions of their parents.
        moments: passive moments; None for none.
        flesh: stiffness of the joints by flesh, shape ``(22, 3, 22, 3)`` [N m/rad]; None for none.
    """

    damping: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    locked: Sequence[int]
    moments: PassiveMoments | None = None
    flesh: np.ndarray | None = None


def _couplings(flesh: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ``first``, ``coupled`` and ``block`` of :class:`Tissue`, without negligible blocks."""
    size = np.abs(flesh).max(axis=(1, 3))
    least = _LEAST_COUPLING * np.sqrt(np.outer(np.diag(size), np.diag(size)))
    lists = [[b, *(c for c in np.flatnonzero(size[b] > least[b]) if c != b)] for b in range(NUM_JOINTS)]
    coupled = np.concatenate(lists)
    own = np.repeat(np.arange(NUM_JOINTS), [len(c) for c in lists])
    return np.cumsum([0, *map(len, lists)]), coupled, flesh[own, :, coupled]


def make_tissue(tissue: JointTissue, device: str) -> Tissue:
    """Upload the passive resistance of the joints."""
    lock = np.zeros(NUM_JOINTS)
    lock[list(tissue.locked)] = LOCK
    m = tissue.moments or no_moments()
    flesh = np.zeros((NUM_JOINTS, 3, NUM_JOINTS, 3)) if tissue.flesh is None else tissue.flesh
    first, coupled, block = _couplings(flesh)

    def upload(values: np.ndarray, dtype: type, scalar: type = np.float32) -> wp.array:
        return wp.array(np.ascontiguousarray(values, scalar), dtype=dtype, device=device)

    vectors = {"lower": tissue.lower, "upper": tissue.upper, "lower_moment": m.lower, "upper_moment": m.upper}
    vectors |= {"lower_rate": m.lower_rate, "upper_rate": m.upper_rate}
    vectors["span"] = np.stack([m.ends, m.moments, m.rates], axis=-1)
    return make_struct(
        Tissue,
        damping=upload(tissue.damping, float),
        lock=upload(lock, float),
        spanned=upload(m.joints, wp.vec2i, np.int32),
        shares=upload(m.shares, wp.vec2),
        first=upload(first, int, np.int32),
        coupled=upload(coupled, int, np.int32),
        block=upload(block, wp.mat33),
        **{name: upload(values, wp.vec3) for name, values in vectors.items()},
    )


@wp.func
def above(body: Body, rotation: wp.array2d(dtype=wp.quat), e: int, b: int):
    """Return the rotation of a bone's parent; the pelvis has the world as its parent."""
    if b == 0:
        return wp.quat(0.0, 0.0, 0.0, 1.0)
    return rotation[e, body.parent[b]]


@wp.func
def beyond(v: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """Return the change of the rotation vector ``v`` that leads back into the range [rad]; zero within it.

    The range ends before half a turn, even at the corners of the box: there rotation vectors jump, and a stop would
    push outwards.
    """
    return short_of_pi(wp.max(lower, wp.min(v, upper))) - v


@wp.func
def bend_of(body: Body, pose: Pose, e: int, b: int):
    """Return the rotation vector of a joint relative to the rest pose [rad]; zero for the pelvis."""
    if b == 0:
        return wp.vec3()
    return quat_log(wp.quat_inverse(pose.rotation[e, body.parent[b]]) * pose.rotation[e, b])


@wp.func
def growing_moment(s: float, end: float, moment: float, rate: float):
    """Return a passive moment at ``s`` [N m], and its slope [N m/rad]; both are zero where ``s`` is negative."""
    if s <= 0.0 or moment == 0.0:
        return wp.vec2()
    grown = wp.exp(wp.min(rate * (s - end), _MOST_GROWTH))
    return wp.vec2(moment * (grown - wp.exp(-rate * end)), moment * rate * grown)


@wp.func
def spanning_moment(tissue: Tissue, bend: wp.array2d(dtype=wp.vec3), e: int, k: int):
    """Return the moment of a muscle that spans two joints, and its slope, as :func:`growing_moment`."""
    joints = tissue.spanned[k]
    shares = tissue.shares[k]
    span = tissue.span[k]
    s = shares[0] * bend[e, joints[0]][0] + shares[1] * bend[e, joints[1]][0]
    return growing_moment(s, span[0], span[1], span[2])


@wp.func
def share_of_joint(tissue: Tissue, k: int, b: int):
    """Return the share that joint ``b`` has in a muscle that spans two joints."""
    joints = tissue.spanned[k]
    shares = tissue.shares[k]
    return wp.where(joints[0] == b, shares[0], 0.0) + wp.where(joints[1] == b, shares[1], 0.0)


@wp.func
def moment_along(tissue: Tissue, v: wp.vec3, b: int, i: int):
    """Return the passive moment towards the rest pose about an axis [N m], and its slope [N m/rad]."""
    low = v[i] < 0.0
    end = wp.where(low, -tissue.lower[b][i], tissue.upper[b][i])
    moment = wp.where(low, tissue.lower_moment[b][i], tissue.upper_moment[b][i])
    rate = wp.where(low, tissue.lower_rate[b][i], tissue.upper_rate[b][i])
    grown = growing_moment(wp.abs(v[i]), end, moment, rate)
    return wp.vec2(wp.where(low, grown[0], -grown[0]), grown[1])


@wp.func
def tissue_pull(tissue: Tissue, bend: wp.array2d(dtype=wp.vec3), factor: float, e: int, b: int):
    """Return minus the gradient of the tissue's energy by the rotation vector of a joint [N m].

    ``factor`` is that of the body's size, on all but the flesh.
    """
    v = bend[e, b]
    pull = wp.vec3()
    for i in range(3):
        pull[i] = factor * moment_along(tissue, v, b, i)[0]
    for k in range(tissue.spanned.shape[0]):
        share = share_of_joint(tissue, k, b)
        if share != 0.0:
            pull[0] = pull[0] - factor * share * spanning_moment(tissue, bend, e, k)[0]
    own = tissue.block[tissue.first[b]] * v
    t = 2.0 + wp.length_sq(v)
    pull -= (2.0 - 2.0 / t) * own + (2.0 * wp.dot(v, own) / (t * t)) * v
    for n in range(tissue.first[b] + 1, tissue.first[b + 1]):
        pull -= tissue.block[n] * bend[e, tissue.coupled[n]]
    return pull


@wp.func
def tissue_stiffness(tissue: Tissue, bend: wp.array2d(dtype=wp.vec3), factor: float, e: int, b: int):
    """Return the greatest stiffness of a joint's tissue about an axis, estimated from above [N m/rad]."""
    v = bend[e, b]
    most = float(0.0)
    own = tissue.block[tissue.first[b]]
    for i in range(3):
        slope = 2.0 * own[i, i] + factor * moment_along(tissue, v, b, i)[1]
        if i == 0:
            for k in range(tissue.spanned.shape[0]):
                share = share_of_joint(tissue, k, b)
                if share != 0.0:
                    slope += factor * share * share * spanning_moment(tissue, bend, e, k)[1]
        most = wp.max(most, slope)
    return most


@wp.func
def tissue_damping(tissue: Tissue, stiffness: float, factor: float, b: int):
    """Return the damping of a joint by tissue of a ``stiffness`` [N m s/rad], in a body of a size ``factor``.

    Moments of a body scale with its mass times its height, and times are those of the reference adult (Hof, "Scaling
    gait data to body size", Gait & Posture 4, 1996, but for his factor of sqrt(height) on times): so does damping.
    """
    return factor * tissue.damping[b] + RETARDATION_TIME * stiffness
