"""Balance of a standing body: the ankle strategy, and beyond a threshold the hip strategy, in both planes.

Pushed a little, a person stays stiff and turns about the ankles; pushed harder, or on a short support, a person bends
at the hips (Horak & Nashner, "Central programming of postural movements", J. Neurophysiology 55, 1986). Forward and
backward the ankles press toes or heels, sideways the hips load one leg and unload the other (Winter, "Human balance and
posture control during standing and walking", Gait & Posture 3, 1995).

In each plane the body is a linear inverted pendulum with a flywheel (Pratt, Carff, Drakunov & Goswami, "Capture point:
a step toward humanoid push recovery", 2006), its centre of mass at ``x`` from the ankles::

    x'' = w^2 (x - p) - torque / (m h),   w = sqrt(g / h)

``p`` is the centre of pressure, which cannot leave the feet, and ``torque`` turns the trunk in the direction of the
fall. The motion that grows is that of ``xi = x + x'/w`` (Hof, Gazendam & Sinke, "The condition for dynamic stability",
J. Biomechanics 38, 2005), ``xi' = w (xi - p) - torque / (m h w)``. With ``p = goal + (1 + gain)(xi - goal)`` it decays
as ``exp(-gain w t)``; while ``xi`` is within the feet the ankles alone can bring it back, and outside they never can.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_index

GRAVITY = 9.81
#: Planes, the last dimension of all arrays here.
SAGITTAL, FRONTAL = 0, 1
_SIDES = ("left", "right")


@dataclass(frozen=True)
class Stance:
    """Geometry and mass of a standing body. Forward and left are positive.

    Attributes:
        mass: of the body [kg].
        height: of its centre of mass over the ankles [m].
        behind: from the ankles to the hindmost place that bears, such as the heels [m]; negative where that lies ahead
            of the ankles.
        ahead: from the ankles to the balls of the toes [m].
        beside: from the midst of the ankles to the outer edge of a foot [m].
        foot_width: of one foot, whose ankle is in its midst [m].
    """

    mass: float
    height: float
    behind: float
    ahead: float
    beside: float
    foot_width: float

    def __post_init__(self) -> None:
        """Refuse lengths and masses that are not positive.

        Raises:
            ValueError: a value that is not positive, or feet that bear nowhere.
        """
        for name, value in vars(self).items():
            if name != "behind" and not value > 0.0:
                raise ValueError(f"{name}={value} must be > 0")
        if not self.behind > -self.ahead:
            raise ValueError(f"behind={self.behind} must be > -ahead={-self.ahead}, or the feet have no length")

    @property
    def rate(self) -> float:
        """Return ``w`` of the pendulum [1/s]."""
        return float(np.sqrt(GRAVITY / self.height))

    @property
    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the largest place of the centre of pressure in each plane [m], ``(2,)`` each."""
        return np.array([-self.behind, -self.beside]), np.array([self.ahead, self.beside])


@dataclass(frozen=True)
class Effort:
    """Forces and torques that keep the balance; every array is ``(n, 2)``, a column per plane.

    Attributes:
        pressure: place of the centre of pressure that the ankles (sideways also the hips) bring about [m].
        ankle: torque of both feet on the ground about the ankles, by that pressure [N m].
        hip: torque that turns the trunk, forward and to the left positive [N m].
        margin: from ``xi`` to the nearer edge of the feet [m]; negative where the ankles alone cannot recover.
    """

    pressure: np.ndarray
    ankle: np.ndarray
    hip: np.ndarray
    margin: np.ndarray


class Balance:
    """Feedback from the centre of mass to ankles and hips.

    Attributes:
        stance: how the body stands.
    """

    def __init__(
        self,
        stance: Stance,
        gain: float = 1.0,
        goal: tuple[float, float] | None = None,
        hip_threshold: float = 0.8,
        hip_gain: float = 10.0,
        hip_limit: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Configure the feedback.

        Args:
            stance: how the body stands.
            gain: decay of the error of ``xi`` in units of the pendulum's own rate [-].
            goal: where ``xi`` is to rest [m]; by default in the midst of the feet.
            hip_threshold: share of the way from the goal to an edge of the feet beyond which the hips act too [-].
            hip_gain: of the hips' torque, in units of the body's weight times the way beyond the threshold [-].
            hip_limit: largest torque that turns the trunk, in each plane [N m]; zero for the ankle strategy alone.

        Raises:
            ValueError: a gain that does not bring back, a goal outside the feet, a threshold or a limit below zero.
        """
        low, high = stance.edges
        self.stance, self.gain, self.hip_gain = stance, gain, hip_gain
        self.goal = (low + high) / 2.0 if goal is None else np.asarray(goal, float)
        self.hip_threshold, self.hip_limit = hip_threshold, np.asarray(hip_limit, float)
        if not gain > 0.0:
            raise ValueError(f"gain={gain} must be > 0, or the body drifts")
        if ((self.goal <= low) | (self.goal >= high)).any():
            raise ValueError(f"goal={self.goal.tolist()} must lie within the feet, {low.tolist()} to {high.tolist()}")
        if hip_threshold < 0.0 or hip_gain < 0.0 or (self.hip_limit < 0.0).any():
            raise ValueError(f"hip_threshold={hip_threshold}, hip_gain={hip_gain}, hip_limit={hip_limit} must be >= 0")

    def step(self, offset: np.ndarray, velocity: np.ndarray) -> Effort:
        """Compute the effort for a state of the centre of mass.

        Args:
            offset: of the centre of mass from the midst of the ankles, forward and to the left [m], ``(n, 2)``.
            velocity: of the centre of mass, forward and to the left [m/s], ``(n, 2)``.
        """
        stance = self.stance
        low, high = stance.edges
        xi = offset + velocity / stance.rate
        error = xi - self.goal
        pressure = np.clip(self.goal + (1.0 + self.gain) * error, low, high)
        reach = self.hip_threshold * np.where(error > 0.0, high - self.goal, self.goal - low)
        beyond = np.sign(error) * np.maximum(np.abs(error) - reach, 0.0)
        weight = stance.mass * GRAVITY
        hip = np.clip(self.hip_gain * weight * beyond, -self.hip_limit, self.hip_limit)
        return Effort(pressure, weight * pressure, hip, np.minimum(xi - low, high - xi))

    def joint_torques(self, effort: Effort) -> np.ndarray:
        """Convert the effort to torques on the bones of a body in its rest pose [N m], ``(n, 21, 3)``.

        In all joints but the root, in the order of the skeleton, for the ``feedforward`` of a
        :class:`~agents.pid.controller.PosePID` of these joints; the legs get what the trunk gets with the other sign.
        Forward is -y, left is +x: a torque about +x presses the toes down, and one about -y a leg outward to the left.
        Both feet bear the same. Sideways the ankles give what half the width of a foot allows, and the hips the rest:
        with both feet on the ground pelvis and legs are a parallelogram, which the hips push as the ankles would (one
        leg is loaded, the other relieved). The hip strategy turns the trunk against both legs.

        With a PD of stiffness ``kp`` in place of torques, shift the targets by this divided by ``kp``.
        """
        torques = np.zeros((len(effort.ankle), len(JOINT_NAMES), 3))
        sideways = effort.ankle[:, FRONTAL]
        most = self.stance.mass * GRAVITY * self.stance.foot_width / 2.0
        by_ankles = np.clip(sideways, -most, most)
        for side in _SIDES:
            ankle, hip = joint_index(f"{side}_ankle"), joint_index(f"{side}_hip")
            torques[:, ankle, 0] = effort.ankle[:, SAGITTAL] / 2.0
            torques[:, ankle, 1] = by_ankles / 2.0
            torques[:, hip, 0] = -effort.hip[:, SAGITTAL] / 2.0
            torques[:, hip, 1] = -(sideways - by_ankles + effort.hip[:, FRONTAL]) / 2.0
        return torques[:, 1:]
