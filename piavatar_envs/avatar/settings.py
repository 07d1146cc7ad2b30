"""Parameters of a drive: in user terms, and as a kernel argument."""

from __future__ import annotations

import math
from dataclasses import dataclass

from piavatar_envs.avatar.types import Drive
from piavatar_envs.mpm.types import Model

#: Tone 1 pulls bones to the commanded pose at this natural frequency [1/s].
TONE_RATE = 30.0
#: Natural frequency of the root wrench [1/s].
ROOT_RATE = 10.0
#: Decay of motion between bones at any tone [1/s]; without it a limp body rings like rubber.
DAMPING = 3.0
STANDARD_GRAVITY = 9.81


@dataclass(frozen=True)
class DriveSettings:
    """Parameters of a drive in user terms.

    Attributes:
        mode: ``"increment"``, or ``"target"``: velocity from the tracked pose to the goal itself, the protocol of the
            paper's Table 2, for undisturbed reproduction only (on a disturbed body it fights the physical velocity);
            or ``"reference"``: velocity from the last commanded pose to the next, whatever the body did (open loop).
        tone: how firmly bones return to the commanded pose, 0 to 1.
        alpha: share of a shape error that shape preservation may undo in a control step, 0 to 1.
        shape_preservation: ``"physical"`` (keeps momentum) or ``"kinematic"`` (the paper's term in ``vk``).
        root: ``"wrench"`` holds the commanded root, ``"free"`` lets the body fly.
        free_motion: take the rigid part out of commanded motion, so that it carries no unreacted momentum. A body
            whose root has let go moves so in any case.
        max_force: limit of the root force, in units of mass times standard gravity.
        max_torque: limit of the root torque, in units of mass times standard gravity times one metre.
        max_tilt: tilt error at which the root lets go [rad].
        max_horizontal_error: horizontal root error at which it lets go [m].
        max_height_error: height error at which it lets go [m].
    """

    mode: str = "increment"
    tone: float = 1.0
    alpha: float = 0.3
    shape_preservation: str = "physical"
    root: str = "wrench"
    free_motion: bool = False
    max_force: float = 2.0
    max_torque: float = 0.7
    max_tilt: float = math.radians(45.0)
    max_horizontal_error: float = 0.5
    max_height_error: float = 0.4

    def kernel_parameters(self, model: Model) -> Drive:
        """The same as a kernel argument."""
        drive = Drive()
        drive.dt, drive.control_dt, drive.num_substeps = model.step.dt, model.control_dt, model.num_substeps
        drive.mode = {"increment": 0, "target": 1, "reference": 2}[self.mode]
        rate = self.alpha / model.control_dt
        drive.shape_rate = rate if self.shape_preservation == "physical" else 0.0
        drive.kinematic_shape_rate = rate if self.shape_preservation == "kinematic" else 0.0
        drive.tone_rate, drive.damping = TONE_RATE * self.tone, DAMPING
        drive.free_motion = int(self.free_motion)
        drive.gravity = model.step.gravity
        drive.root_rate = ROOT_RATE if self.root == "wrench" else 0.0
        drive.max_force = self.max_force * STANDARD_GRAVITY
        drive.max_torque = self.max_torque * STANDARD_GRAVITY
        drive.max_tilt_cos = math.cos(self.max_tilt)
        drive.max_horizontal_error, drive.max_height_error = self.max_horizontal_error, self.max_height_error
        return drive
