"""Passive moments of the joints of an adult of 75 kg and 1.75 m: what muscles at rest, ligaments and capsules resist.

Towards the end of a range the moment grows exponentially with the component ``s`` of the joint's rotation vector,

    m(s) = M (exp(r (s - end)) - exp(-r end))   for s > 0,

nothing at rest and nearly ``M`` at the end of the range. Muscles that span two joints couple them: their ``s`` is a sum
over both. All are gradients of energies, so that passive joints give back what they take, except for their damping.

- hip, knee and ankle about x: Riener & Edrich, "Identification of passive elastic joint moments in the lower
  extremities", J. Biomech. 32 (1999), pp. 539-544, ten healthy subjects. Of their exponentials these are taken: hip
  extension exp(1.466 + 0.0750 e), hamstrings exp(1.340 + 0.0305 h - 0.0226 k), knee flexion
  exp(-3.971 + 0.0495 k - 0.0128 h), calf exp(2.102 + 0.0843 d - 0.0176 k), toe down exp(-7.976 + 0.1949 p) [N m], with
  the angles of hip flexion ``h = -e``, knee flexion ``k``, ankle dorsiflexion ``d = -p`` in degrees. Their fits of two
  joints that a muscle spans agree with one energy: the hamstrings' ratio is 0.74 from the hip, 0.71 from the knee. The
  coefficients are those of an implementation for sprinting models; the article itself was not at hand.
- trunk, as measured in living people and collected by Watt, Callaway & Williams, "In vivo through-range passive
  stiffness of the lumbar spine", Med. Biol. Eng. Comput. 60 (2022): flexion 0.0, 0.1 and 0.7 N m per percent of the
  range in its low, transition and high zones (Beach et al.); lateral bending 0.25, 0.6, 1.7 and 5.1 N m per degree in
  its quarters (Gombatto et al.), 38 N m at 20 degrees. Joints of the spine in a row each carry the whole moment, so
  that they share the angle as their ranges do. Axial rotation is less stiff than both; 10 N m are an *estimate*.

All else is *estimated*: :data:`SHARE` of the greatest torque that the muscles have about the axis, which is the mean of
those above, and :data:`STEEPNESS`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from piavatar_envs.avatar.body.muscles import joint_torques
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_index, joint_limits

#: Passive moment at the end of a range over the greatest torque of muscles about the axis.
SHARE = 0.2
#: Growth rate times the range: quarters of it are as stiff as 1 : 2.8 : 7.8 : 21.
STEEPNESS = 4.1

_PER_DEGREE = 180.0 / np.pi
#: Moments at the ends of ranges [N m] and their growth rates [1/rad], by joint, axis and sign of the direction.
_KNOWN = {
    ("hip", 0, 1): (41.1, 0.0750 * _PER_DEGREE),
    ("ankle", 0, 1): (5.9, 0.1949 * _PER_DEGREE),
} | {
    (f"spine{n}", axis, sign): (moment, None)
    for n in (1, 2, 3)
    for axis, moment in enumerate((14.0, 38.0, 10.0))
    for sign in (-1, 1)
}
#: Muscles of two joints, about x: joints, shares, angle [deg], moment there [N m], and growth rate [1/rad].
_SPANNING = (
    (("hip", "knee"), (-1.0, -0.741), 90.0, 59.4, 0.0305 * _PER_DEGREE),
    (("knee", "hip"), (1.0, 0.259), 140.0, 19.3, 0.0495 * _PER_DEGREE),
    (("ankle", "knee"), (-1.0, -0.209), 20.0, 44.1, 0.0843 * _PER_DEGREE),
)
#: Directions in which a muscle of two joints alone resists.
_SPANNED = {("hip", 0, -1), ("knee", 0, 1), ("ankle", 0, -1)}


@dataclass(frozen=True)
class PassiveMoments:
    """Passive moments of the reference adult.

    Attributes:
        lower, upper: at the lower and at the upper end of the ranges, shape ``(22, 3)`` [N m].
        lower_rate, upper_rate: their growth rates, shape ``(22, 3)`` [1/rad].
        joints: of muscles that span two joints, shape ``(n, 2)`` int.
        shares: of the two rotation vectors' x components, shape ``(n, 2)``.
        ends: angles, shape ``(n,)`` [rad].
        moments: at these angles, shape ``(n,)`` [N m].
        rates: their growth rates, shape ``(n,)`` [1/rad].
    """

    lower: np.ndarray
    upper: np.ndarray
    lower_rate: np.ndarray
    upper_rate: np.ndarray
    joints: np.ndarray
    shares: np.ndarray
    ends: np.ndarray
    moments: np.ndarray
    rates: np.ndarray


def no_moments() -> PassiveMoments:
    """Return joints without passive moments."""
    nothing, none = np.zeros((len(JOINT_NAMES), 3)), np.zeros(0)
    return PassiveMoments(
        nothing, nothing, nothing + 1.0, nothing + 1.0, np.zeros((0, 2), int), np.zeros((0, 2)), none, none, none
    )


def passive_moments() -> PassiveMoments:
    """Return the passive moments of the reference adult."""
    torques = np.maximum(*(np.abs(bound) for bound in joint_torques()))
    found = []
    for sign, bound in zip((-1, 1), joint_limits(), strict=True):
        end = np.maximum(np.abs(bound), 1e-3)
        moment, rate = SHARE * torques, STEEPNESS / end
        for index, name in enumerate(JOINT_NAMES):
            joint = name.partition("_")[2] or name
            for axis in range(3):
                if (joint, axis, sign) in _SPANNED:
                    moment[index, axis] = 0.0
                known = _KNOWN.get((joint, axis, sign))
                if known:
                    moment[index, axis] = known[0]
                    rate[index, axis] = known[1] or rate[index, axis]
        moment[0] = 0.0
        found += [moment, rate]
    spanning = [
        ([joint_index(f"{side}_{name}") for name in names], *numbers)
        for names, *numbers in _SPANNING
        for side in ("left", "right")
    ]
    joints, shares, ends, moments, rates = (np.array(column) for column in zip(*spanning, strict=True))
    return PassiveMoments(found[0], found[2], found[1], found[3], joints, shares, np.radians(ends), moments, rates)
