"""Muscles: strength and resistance of the joints of an adult of 75 kg and 1.75 m, by joint and direction.

Axes are those of the rest pose, as the parent bone has turned them, and signs those of
:mod:`piavatar_envs.avatar.body.skeleton`: +x bends the trunk forward, hip and knee backward, points the toe down. The
numbers are means of young men under isometric load, at the best angle, where nothing else is said:

- hip, knee and ankle about x: Anderson, Madigan & Nussbaum, "Maximum voluntary joint torque as a function of joint
  angle and angular velocity", J. Biomech. 40 (2007), table 3: hip 0.161 (extension) and 0.113 (flexion), knee 0.163 and
  0.087, ankle 0.095 (toe down) and 0.033 (toe up) of weight times height, which is 1287 N m here. What lies between
  angles and velocities (their other coefficients) is left out.
- shoulder: Holzbaur, Delp, Gold & Murray, "Moment-generating capacity of upper limb muscles in healthy adults",
  J. Biomech. 40 (2007), pp. 2442-2449: adduction, the strongest group that they measured, 67.9 N m with a standard
  deviation of 28.4 over ten young adults, from a woman of the 20th percentile of size to a man of the 97th. About x are
  90 N m, 0.8 standard deviations above, as of a man: static flexion of 26 young men with the arm hanging was 89.9 N m
  (68.6 raised by 45 degrees) in "Dynamic shoulder flexion strength for use in occupational risk analysis and clinical
  assessment", of which only the abstract is available, without authors and date. The same for extension is an
  estimate, and so are 75 N m about y, a quarter of a standard deviation above that adduction, and 60 N m about z.
- elbow: flexion 0.78 and extension 0.67 N m a kilogram (Lategan & Krueger, AJPHERD 2003).
- wrist: flexion 12.2, extension 7.1, radial 11.0, ulnar 9.5 N m (Delp, Grigg & Buchanan, J. Biomech. 29, 1996).

All else is *estimated* after the size that textbooks give (Chaffin, Andersson & Martin, "Occupational Biomechanics",
for the trunk; Vasavada, Li & Delp, "Three-dimensional isometric strength of neck muscles in humans", Spine 2001, for
the neck): trunk, neck, collars, and hip, knee and ankle about y and z. Joints in a row each carry the whole torque. In
the rest pose the arms are lowered by 45 degrees, so that flexing and twisting an elbow or a wrist are mixtures of x and
z: the bounds hold each axis, not each movement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, Bounds, joint_limits, left_and_right

REFERENCE_MASS = 75.0  # [kg]
REFERENCE_HEIGHT = 1.75  # [m]

_TRUNK = ((-235.0, 145.0), (-150.0, 150.0), (-75.0, 75.0))
_NECK = ((-52.0, 30.0), (-36.0, 36.0), (-15.0, 15.0))
# Lower and upper torque [N m] about x, y and z, for the left side.
_LEFT_TORQUES: dict[str, Bounds] = {
    "hip": ((-145.0, 207.0), (-120.0, 120.0), (-60.0, 60.0)),
    "knee": ((-210.0, 112.0), (-60.0, 60.0), (-40.0, 40.0)),
    "ankle": ((-42.0, 122.0), (-35.0, 35.0), (-35.0, 35.0)),
    "foot": ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),  # locked
    "collar": ((-90.0, 90.0), (-90.0, 90.0), (-90.0, 90.0)),
    "shoulder": ((-90.0, 90.0), (-75.0, 75.0), (-60.0, 60.0)),
    "elbow": ((-58.0, 50.0), (-40.0, 40.0), (-58.0, 50.0)),
    "wrist": ((-12.2, 7.1), (-11.0, 9.5), (-12.2, 7.1)),
}
_CENTER_TORQUES: dict[str, Bounds] = {
    "spine1": _TRUNK,
    "spine2": _TRUNK,
    "spine3": _TRUNK,
    "neck": _NECK,
    "head": _NECK,
}

#: Joints that do not move under torques: toes are smaller than a cell of the grid through which the ground pushes.
LOCKED_JOINTS = ("left_foot", "right_foot")

#: Error at which a spring reaches the greatest torque of its joint [rad].
FULL_TORQUE_ANGLE = 0.3
#: Damping over stiffness of a spring [s].
DAMPING_TIME = 0.1
#: Speed at which a muscle that shortens has no force left [rad/s]; about that of a knee that extends. An estimate: the
#: article above has half of the torque left at 3 to 4 rad/s for hip and knee.
FASTEST = 20.0
#: Damping of tissue over the greatest torque of a joint [s].
TISSUE_TIME = 0.005


def joint_torques() -> tuple[np.ndarray, np.ndarray]:
    """Return the least (negative) and greatest torques of the joints but the pelvis [N m], each ``(22, 3)``."""
    return left_and_right(_CENTER_TORQUES, _LEFT_TORQUES, (0.0, 0.0))


@dataclass(frozen=True)
class Muscles:
    """Constants of the joints of the reference adult; ``(22,)``, bounds ``(22, 3)``.

    Attributes:
        stiffness: of springs that hold a pose [N m/rad].
        damping: of the same [N m s/rad].
        lower, upper: greatest torques [N m].
        tissue_damping: of a joint at rest [N m s/rad].
        range_lower, range_upper: ends of the ranges [rad].
    """

    stiffness: np.ndarray
    damping: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    tissue_damping: np.ndarray
    range_lower: np.ndarray
    range_upper: np.ndarray


def make_muscles(stiffness: float = 1.0, damping: float = 1.0, strength: float = 1.0) -> Muscles:
    """Return the muscles of the reference adult.

    Every gain is proportional to the strength of its joint, and thus to its usual load: a spring reaches the greatest
    torque at :data:`FULL_TORQUE_ANGLE`, and an error decays with the time constant :data:`DAMPING_TIME` where only the
    damper resists the spring.

    Args:
        stiffness: factor on the springs [-].
        damping: factor on their dampers [-].
        strength: factor on the greatest torques [-].
    """
    lower, upper = joint_torques()
    most = np.maximum(-lower, upper).max(axis=1)
    springs = stiffness * most / FULL_TORQUE_ANGLE
    range_lower, range_upper = joint_limits()
    return Muscles(
        stiffness=springs,
        damping=damping * DAMPING_TIME * most / FULL_TORQUE_ANGLE,
        lower=strength * lower,
        upper=strength * upper,
        tissue_damping=TISSUE_TIME * most,
        range_lower=range_lower,
        range_upper=range_upper,
    )


def spring_rows(joints: np.ndarray) -> np.ndarray:
    """Return values of joints ``(22,)`` as rows of ``Springs``, shape ``(1, 23)``."""
    rows = np.zeros((1, 1 + NUM_JOINTS))
    rows[0, 2:] = joints[1:]
    return rows
