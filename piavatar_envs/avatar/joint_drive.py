"""A drive whose joints move under torques: joint targets or torques in, forces of muscles out, nothing held by magic.

The other way to drive an avatar; see :mod:`piavatar_envs.avatar.drive`. Gravity, the ground and other bodies act on the
whole body, and only torques between its bones act back. An assisting spring may help the pelvis, as a curriculum: at
``assist`` 1 it nearly holds the pelvis alone, at 0 there is none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar.articulated import ArticulatedBody
from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.avatar.joint_motion import set_part
from piavatar_envs.avatar.joint_stages import Support
from piavatar_envs.avatar.joint_torques import Springs, Target
from piavatar_envs.avatar.muscles import FASTEST, LOCKED_JOINTS, REFERENCE_HEIGHT, REFERENCE_MASS, Muscles, spring_rows
from piavatar_envs.avatar.rotation import quat_log
from piavatar_envs.avatar.settings import ROOT_RATE
from piavatar_envs.avatar.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.avatar.types import Body, Pose
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Scratch, State, group, row

if TYPE_CHECKING:
    from piavatar_envs.avatar.drive import AvatarDrive

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Longest substep with joints under torques [s].
LONGEST_SUBSTEP = 0.004
#: Of the assisting spring that turns the pelvis upright [N m/rad].
ASSIST_TORQUE = 1500.0
_FASTEST = wp.constant(FASTEST)
_ASSIST_TORQUE, _ASSIST_RATE = wp.constant(ASSIST_TORQUE), wp.constant(ROOT_RATE)
_HEAD, _FOOT = wp.constant(joint_index("head")), wp.constant(joint_index("left_foot"))


@dataclass(frozen=True, eq=False)
class JointSettings:
    """How the joints of an avatar are driven.

    Attributes:
        muscles: of the reference adult; those of the body follow from its weight times its height.
        assist: of the pelvis at first, 0 to 1.
        attachment: rates of the pulls that hold flesh to bones, shape ``(P,)`` [1/s].
        firm: which particles are put into their places on the bones after every control step, shape ``(P,)`` bool.
        solid: whether bones stop at boundaries.
    """

    muscles: Muscles
    assist: float
    attachment: np.ndarray
    firm: np.ndarray
    solid: bool


@wp.kernel
def set_springs(
    body: Body,
    gains: Springs,
    body_mass: wp.array(dtype=float),
    per_size: float,
    assist: wp.array(dtype=float),
    let_go: wp.array(dtype=int),
    torque: wp.array2d(dtype=wp.vec3),
    # out
    factor: wp.array(dtype=float),
    springs: Springs,
):
    """Strength and springs of every body, by its weight times its height; over ``(num_envs, 1 + bones)``.

    A muscle that shortens at its greatest speed has no force left: what a torque loses to speed is a damper. The pelvis
    is assisted where it has not been let go.
    """
    e, n = wp.tid()
    m = body_mass[row(e, body_mass.shape[0])]
    r = row(e, body.rest_joint.shape[0])
    size = per_size * m * (body.rest_joint[r, _HEAD][2] - body.rest_joint[r, _FOOT][2])
    K = size * gains.stiffness[0, n]
    D = size * gains.damping[0, n]
    if n == 0:
        factor[e] = size
    if n < 2:
        K = wp.where(n == 0, m * _ASSIST_RATE * _ASSIST_RATE, _ASSIST_TORQUE)
        K *= wp.where(let_go[e] != 0, 0.0, assist[e])
        D = 2.0 * K / _ASSIST_RATE
    else:
        share = wp.abs(torque[e, n - 1])
        D += size * wp.max(share[0], wp.max(share[1], share[2])) / _FASTEST
    springs.stiffness[e, n] = K
    springs.damping[e, n] = D


@wp.kernel
def reset_joints(
    mask: wp.array(dtype=wp.bool),
    pose_rotation: wp.array2d(dtype=wp.quat),
    pose_position: wp.array2d(dtype=wp.vec3),
    # out
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    torque: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=float),
    outside: wp.array2d(dtype=float),
):
    """Joints of the masked environments into a pose, at rest; launched over ``(num_envs, 1 + bones)``."""
    e, n = wp.tid()
    if not mask[e]:
        return
    for i in range(3):
        velocity[e, 3 * n + i] = 0.0
        outside[e, 3 * n + i] = 0.0
    if n > 0:
        rotation[e, n - 1] = pose_rotation[e, n - 1]
        position[e, n - 1] = pose_position[e, n - 1]
        torque[e, n - 1] = wp.vec3(0.0)


@wp.func
def spin_between(before: wp.quat, after: wp.quat, time: float):
    """Constant angular velocity by which a rotation becomes another one in a ``time`` [rad/s]."""
    return quat_log(after * wp.quat_inverse(before)) / time


@wp.kernel
def set_joints_in_motion(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    time: float,
    pose: Pose,
    after: Pose,
    # out
    velocity: wp.array2d(dtype=float),
):
    """Joints of the masked environments on their way to the pose ``after`` a ``time`` [s] later; over ``(E, bones)``.

    Joints that only found it in their particles would take it for what the world does to them in every substep.
    """
    e, b = wp.tid()
    if not mask[e]:
        return
    spin = spin_between(pose.rotation[e, b], after.rotation[e, b], time)
    if b == 0:
        set_part(velocity, e, 0, (after.position[e, 0] - pose.position[e, 0]) / time)
    else:
        a = body.parent[b]
        spin -= spin_between(pose.rotation[e, a], after.rotation[e, a], time)
    set_part(velocity, e, 3 + 3 * b, spin)


@wp.kernel
def forget_slip(mask: wp.array(dtype=wp.bool), slip: wp.array2d(dtype=wp.vec3)):
    """No particle of the masked environments has slipped."""
    e, p = wp.tid()
    if mask[e]:
        slip[e, p] = wp.vec3(0.0)


class JointDrive:
    """What turns the joints of one avatar in every environment.

    Attributes:
        body: the joints.
        assist: of the pelvis, ``(num_envs,)``, 0 to 1; what is written here holds until it is written again.
        gains: springs and dampers of the reference adult's joints, ``(1, 23)``.
        first: the pose that bodies are on their way to when an episode begins, and reach after a control step: local
            rotations and root, as commands; None where they begin at rest. To be set before a reset is recorded.
    """

    def __init__(self, points: BodyPoints, drive: AvatarDrive, settings: JointSettings) -> None:
        """Allocate.

        Args:
            points: the body as its drive was built from it.
            drive: the avatar's, whose goals the springs pull to.
            settings: of the joints.
        """
        n, model, muscles = drive.model.num_envs, drive.model, settings.muscles
        self.drive = drive
        rows = np.zeros((n, 1 + NUM_JOINTS))
        flesh = settings.attachment[None], settings.firm
        self.body = ArticulatedBody(points, drive.body, model, rows, rows, *flesh, settings.solid)
        self.body.set_strength(muscles.lower, muscles.upper, n)
        ranges = muscles.range_lower, muscles.range_upper
        locked = [joint_index(name) for name in LOCKED_JOINTS]
        self.body.set_tissue(muscles.tissue_damping, muscles.stop, *ranges, locked)
        goal = {"rotation": drive.state.goal_rotation, "root": drive.state.goal_root}
        self.body.support = group(Support, force=drive.state.wrench_force, torque=drive.state.wrench_torque)
        torques = {"torque": self.state.torque, "factor": self.body.strength.factor}
        self.body.target = group(Target, **goal, **torques)
        gains = [spring_rows(values).astype(np.float32) for values in (muscles.stiffness, muscles.damping)]
        stiffness, damping = (wp.array(values, dtype=float, device=model.device) for values in gains)
        self.gains = group(Springs, stiffness=stiffness, damping=damping)
        self.assist = wp.full(n, settings.assist, dtype=float, device=model.device)
        # the height that goes with the joints' span in the first body
        joints, rest = points.joints[0], points.rest[0]
        span = float(joints[joint_index("head"), 2] - joints[joint_index("left_foot"), 2])
        self._per_size = float(np.ptp(rest[:, 2])) / span / (REFERENCE_MASS * REFERENCE_HEIGHT)
        self.first: tuple[wp.array, wp.array] | None = None

    @property
    def state(self):
        """What a checkpoint holds."""
        return self.body.state

    def release(self, joints: list[int]) -> None:
        """Take the springs from joints, by index, that torques alone shall move."""
        for array in (self.gains.stiffness, self.gains.damping):
            values = array.numpy()
            values[0, [1 + joint for joint in joints]] = 0.0
            array.assign(values)

    def record_reset(self, program: Program, mask: wp.array) -> None:
        """Append: joints of the masked environments into the pose that the drive has posed them in."""
        s, posed = self.state, self.drive.scratch
        program.launch(
            reset_joints,
            (self.drive.model.num_envs, 1 + NUM_JOINTS),
            [mask, posed.pose_rotation, posed.pose_position],
            [s.rotation, s.position, s.torque, s.velocity, s.outside],
        )
        program.launch(forget_slip, s.slip.shape, [mask], [s.slip])

    def record_motion(self, program: Program, mask: wp.array, after: Pose) -> None:
        """Append: joints of the masked environments, reset already, reach a pose after a control step."""
        model, body = self.drive.model, self.drive.body
        inputs = [mask, body, model.control_dt, self.body.pose, after]
        program.launch(set_joints_in_motion, (model.num_envs, NUM_JOINTS), inputs, [self.state.velocity])

    def record_begin(self, program: Program) -> None:
        """Append what begins a control step: strength and springs of the bodies as they are."""
        drive, body = self.drive, self.body
        program.launch(
            set_springs,
            (drive.model.num_envs, 1 + NUM_JOINTS),
            [
                drive.body,
                self.gains,
                drive.body_mass,
                self._per_size,
                self.assist,
                drive.state.let_go,
                self.state.torque,
            ],
            [body.strength.factor, body.springs],
        )

    def record_substep(self, program: Program, state: State, scratch: Scratch, step: int) -> None:
        """Append what the joints do before substep ``step`` of a control step."""
        self.body.record_substep(program, state, scratch, step)

    def record_end(self, program: Program, state: State) -> None:
        """Append what ends a control step: particles of bones are in their places."""
        self.body.record_end(program, state)


def checked_assist(share: float | np.ndarray, num_envs: int) -> np.ndarray:
    """Help for the pelvis in every environment, ``(num_envs,)`` float32, from one share or as many.

    Raises:
        ValueError: it is out of range, or of another shape.
    """
    shares = np.asarray(share, np.float32)
    if shares.shape not in ((), (num_envs,)) or not ((shares >= 0.0) & (shares <= 1.0)).all():
        raise ValueError(f"root_assist={share} must be in [0, 1], one number or {num_envs}")
    return np.broadcast_to(shares, num_envs).copy()
