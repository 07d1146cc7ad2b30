"""Torque controller: an action becomes targets of springs and torques of the joints of an articulated body.

It gives :class:`~piavatar_envs.avatar.torque_control.articulated_body.ArticulatedBody` the muscles and springs of each
body's size, the assistance of the pelvis, and the pose at a reset.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar, reset_vectors
from piavatar_envs.avatar.body.device import BodyPoints
from piavatar_envs.avatar.body.muscles import (
    FASTEST,
    REFERENCE_HEIGHT,
    REFERENCE_MASS,
    Muscles,
    spring_rows,
)
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.avatar.correctives import predict_joints
from piavatar_envs.avatar.rotation import quat_log
from piavatar_envs.avatar.torque_control.articulated_body import ArticulatedBody
from piavatar_envs.avatar.torque_control.joint_motion import set_triple
from piavatar_envs.avatar.torque_control.joint_tissue import JointTissue
from piavatar_envs.avatar.torque_control.joint_torques import Springs, Target
from piavatar_envs.avatar.torque_control.stages import Support
from piavatar_envs.avatar.types import ROOT_RATE, Body, JointState, Pose, allocate
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import Scratch, State, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: Longest substep with joints under torques [s].
LONGEST_SUBSTEP = 0.004
#: Stiffness of the assisting spring that turns the pelvis upright [N m/rad].
ASSIST_TORQUE = 1500.0
_FASTEST = wp.constant(FASTEST)
_ASSIST_TORQUE, _ASSIST_RATE = wp.constant(ASSIST_TORQUE), wp.constant(ROOT_RATE)
_HEAD, _FOOT = wp.constant(joint_index("head")), wp.constant(joint_index("left_foot"))


@dataclass(frozen=True, eq=False)
class TorqueControl:
    """Parameters of a torque controller, named like the settings of ``control`` that they follow from.

    Attributes:
        muscles: those of the reference adult; the body's are scaled by its mass times its height.
        root_assist: initial assistance of the pelvis, 0 to 1.
        flesh_rate: rates of the pulls that hold flesh to bones, shape ``(P,)`` [1/s].
        firm_bones: particles that are moved to their skinned places after every control step, ``(P,)`` bool.
        links: pairs of neighbouring particles, from which strain is measured, shape ``(L, 2)``.
        bone_contact: whether bones stop at boundaries.
        tissue: passive resistance of the joints.
    """

    muscles: Muscles
    root_assist: float
    flesh_rate: np.ndarray
    firm_bones: np.ndarray
    links: np.ndarray
    bone_contact: bool
    tissue: JointTissue


@wp.kernel
def set_springs(
    body: Body,
    gains: Springs,
    body_mass: wp.array(dtype=float),
    per_size: float,
    tone: float,
    assist: wp.array(dtype=float),
    released: wp.array(dtype=int),
    torque: wp.array2d(dtype=wp.vec3),
    # out
    factor: wp.array(dtype=float),
    springs: Springs,
):
    """Set strength and springs of every body by its mass times its height; over ``(num_envs, 1 + bones)``.

    ``tone`` is a factor on the springs. A muscle that shortens at its greatest speed has no force left, so each torque
    adds a damper. The pelvis is assisted unless it has been released.
    """
    e, n = wp.tid()
    m = body_mass[row(e, body_mass.shape[0])]
    r = row(e, body.rest_joint.shape[0])
    size = per_size * m * (body.rest_joint[r, _HEAD][2] - body.rest_joint[r, _FOOT][2])
    K = tone * (size * gains.stiffness[0, n])
    D = tone * (size * gains.damping[0, n])
    if n == 0:
        factor[e] = size
    if n < 2:
        K = wp.where(n == 0, m * _ASSIST_RATE * _ASSIST_RATE, _ASSIST_TORQUE)
        K *= wp.where(released[e] != 0, 0.0, assist[e])
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
    """Put the joints of the masked environments into a pose, at rest; over ``(num_envs, 1 + bones)``."""
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
    """Return the constant angular velocity that turns ``before`` into ``after`` within ``time`` [rad/s]."""
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
    """Set the joint velocity that reaches the pose ``after`` within ``time`` [s], if masked; over ``(E, bones)``.

    Otherwise the projection would count this velocity as an external change ``c``.
    """
    e, b = wp.tid()
    if not mask[e]:
        return
    spin = spin_between(pose.rotation[e, b], after.rotation[e, b], time)
    if b == 0:
        set_triple(velocity, e, 0, (after.position[e, 0] - pose.position[e, 0]) / time)
    else:
        a = body.parent[b]
        spin -= spin_between(pose.rotation[e, a], after.rotation[e, a], time)
    set_triple(velocity, e, 3 + 3 * b, spin)


class TorqueController:
    """Controller that applies torques between the bones of one avatar in every environment.

    Attributes:
        avatar: the avatar.
        joints: its articulated body.
        assist: assistance of the pelvis, ``(num_envs,)``, 0 to 1; may be written at any time.
        gains: springs and dampers of the reference adult's joints, ``(1, 23)``.
        first: the pose that bodies reach one control step after an episode begins: local rotations and root, as
            commands; None for a start at rest. Set it before a reset is recorded.
    """

    #: The end of a control step takes back hourglass modes, and moves firm particles.
    moves_particles = True

    def __init__(self, avatar: Avatar, points: BodyPoints, parameters: TorqueControl) -> None:
        """Connect the joints to the goals of the avatar.

        Args:
            avatar: the avatar; its goals are the targets of the springs.
            points: the body that it was built from.
            parameters: muscles, assistance and coupling of the flesh.
        """
        n, model, muscles = avatar.model.num_envs, avatar.model, parameters.muscles
        self.avatar = avatar
        rows = np.zeros((n, 1 + NUM_JOINTS))
        flesh = parameters.flesh_rate[None], parameters.firm_bones
        self.joints = ArticulatedBody(
            points, avatar.body, model, rows, rows, *flesh, parameters.bone_contact, parameters.links
        )
        self.joints.set_strength(muscles.lower, muscles.upper, n)
        self.joints.set_tissue(parameters.tissue)
        state = avatar.state
        self.joints.support = make_struct(Support, force=state.wrench_force, torque=state.wrench_torque)
        self.joints.target = make_struct(
            Target,
            rotation=state.goal_rotation,
            root=state.goal_root,
            torque=self.state.torque,
            factor=self.joints.strength.factor,
        )
        gains = [spring_rows(values).astype(np.float32) for values in (muscles.stiffness, muscles.damping)]
        stiffness, damping = (wp.array(values, dtype=float, device=model.device) for values in gains)
        self.gains = make_struct(Springs, stiffness=stiffness, damping=damping)
        self.assist = wp.full(n, parameters.root_assist, dtype=float, device=model.device)
        # height over the span from foot to head joint, in the first body
        joints, rest = points.joints[0], points.rest[0]
        span = float(joints[joint_index("head"), 2] - joints[joint_index("left_foot"), 2])
        self._per_size = float(np.ptp(rest[:, 2])) / span / (REFERENCE_MASS * REFERENCE_HEIGHT)
        self.first: tuple[wp.array, wp.array] | None = None
        self._first_pose = allocate(Pose, n, model.device)

    @property
    def state(self) -> JointState:
        """Return the joints' state, which checkpoints store together with :attr:`assist`."""
        return self.joints.state

    def release(self, joints: list[int]) -> None:
        """Remove the springs of ``joints``, by index, so that torques alone move them."""
        for array in (self.gains.stiffness, self.gains.damping):
            values = array.numpy()
            values[0, [1 + joint for joint in joints]] = 0.0
            array.assign(values)

    def record_reset(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Append the reset of the masked environments: joints take the pose in which the avatar has been placed.

        They start at rest, or with the velocity that reaches :attr:`first`.
        """
        avatar, s = self.avatar, self.state
        n, placed = avatar.model.num_envs, avatar.placed
        outputs = [s.rotation, s.position, s.torque, s.velocity, s.outside]
        graph.launch(reset_joints, (n, 1 + NUM_JOINTS), [mask, placed.rotation, placed.position], outputs)
        graph.launch(reset_vectors, s.slip.shape, [mask], [s.slip])
        if self.first:
            avatar.record_still_pose(graph, self.first, self._first_pose)
            avatar.record_set_in_motion(graph, state, mask, self._first_pose)
            inputs = [mask, avatar.body, avatar.model.control_dt, self.joints.pose, self._first_pose]
            graph.launch(set_joints_in_motion, (n, NUM_JOINTS), inputs, [s.velocity])

    def record_begin(self, graph: LaunchGraph) -> None:
        """Append the start of a control step: strength and springs for the current bodies."""
        avatar, joints = self.avatar, self.joints
        avatar.record_clear_support(graph)
        inputs = [avatar.body, avatar.model.control_dt, joints.pose, self.state.velocity]
        avatar.record_corrections(graph, predict_joints, inputs)
        self.record_springs(graph, 1.0)

    def record_springs(self, graph: LaunchGraph, tone: float) -> None:
        """Append strength and springs for the current bodies; ``tone`` is a factor on the springs."""
        avatar, joints = self.avatar, self.joints
        inputs = [avatar.body, self.gains, avatar.body_mass, self._per_size, tone, self.assist, avatar.state.released]
        graph.launch(
            set_springs,
            (avatar.model.num_envs, 1 + NUM_JOINTS),
            [*inputs, self.state.torque],
            [joints.strength.factor, joints.springs],
        )

    def record_before_substep(self, graph: LaunchGraph, state: State, scratch: Scratch, step: int) -> None:
        """Append the stages that precede MPM substep ``step`` of a control step."""
        self.joints.record_substep(graph, state, scratch, step)

    def record_end(self, graph: LaunchGraph, state: State) -> None:
        """Append the end of a control step: firm particles are moved to their skinned places."""
        self.joints.record_end(graph, state)

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint, by name."""
        return {field.name: getattr(self.state, field.name) for field in fields(self.state)} | {"assist": self.assist}


def checked_assist(share: float | np.ndarray, num_envs: int) -> np.ndarray:
    """Return the assistance in every environment, ``(num_envs,)`` float32, from one share or one for each.

    Raises:
        ValueError: a share is outside of [0, 1], or the shape is wrong.
    """
    shares = np.asarray(share, np.float32)
    if shares.shape not in ((), (num_envs,)) or not ((shares >= 0.0) & (shares <= 1.0)).all():
        raise ValueError(f"root_assist={share} must be in [0, 1], one number or {num_envs}")
    return np.broadcast_to(shares, num_envs).copy()
