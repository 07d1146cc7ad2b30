"""Pose control in which joints resist contact as they do under ``"pd"``: by springs, in N m/rad.

It composes the commands of :class:`~piavatar_envs.avatar.pose_control.controller.PoseController` with the mechanics of
:class:`~piavatar_envs.avatar.torque_control.controller.TorqueController`. The body moves as commanded
(:mod:`piavatar_envs.avatar.torque_control.commanded_motion`), and the joints' springs, of the table of muscles times
``tone``, pull it back to that pose where contact has moved it away. The root's wrench holds and carries the whole
(:mod:`piavatar_envs.avatar.pose_control.support`).

A command that runs into an obstacle would wind the springs up. So it does not move further away from the pose than
:data:`MOST_ERROR`, where the springs of tone 1 reach the greatest torques of the muscles.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.avatar import Avatar, reset_vectors
from piavatar_envs.avatar.body.device import BodyPoints
from piavatar_envs.avatar.body.flesh import weight_loads
from piavatar_envs.avatar.body.muscles import FULL_TORQUE_ANGLE
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.correctives import turn_joints
from piavatar_envs.avatar.pose_control.bones import begin_control
from piavatar_envs.avatar.pose_control.support import GROUPS, Support, move_body, sum_body, support_body
from piavatar_envs.avatar.rotation import quat_exp, quat_log
from piavatar_envs.avatar.torque_control.articulated_body import ArticulatedBody
from piavatar_envs.avatar.torque_control.commanded_motion import CommandedMotion
from piavatar_envs.avatar.torque_control.controller import TorqueControl, TorqueController
from piavatar_envs.avatar.torque_control.joint_tissue import above
from piavatar_envs.avatar.types import (
    TONE_RATE,
    Body,
    Carry,
    Command,
    Pose,
    PoseControl,
    RootState,
    Wrench,
    allocate,
)
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import Scratch, State

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Greatest angle between a joint and its command after a control step [rad].
MOST_ERROR = FULL_TORQUE_ANGLE
_MOST_ERROR = wp.constant(MOST_ERROR)


@wp.kernel
def bound_command(
    body: Body,
    pose: Pose,
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    command_rotation: wp.array2d(dtype=wp.quat),
    # out
    command_root: wp.array(dtype=wp.vec3),
):
    """Make the goal the commanded pose, as far as it does not wind up springs; over ``(num_envs, bones)``.

    A joint that is beyond the bound stays as far from its command as the last command was: an obstacle alone drags no
    command along, and a joint that it releases returns.
    """
    e, b = wp.tid()
    if failure[e] != 0:
        return
    goal = goal_rotation[e, b]
    if b == 0:
        command_root[e] = goal_root[e]
    else:
        local = wp.quat_inverse(above(body, pose.rotation, e, b)) * pose.rotation[e, b]
        back = wp.quat_inverse(local)
        error = quat_log(back * goal)
        angle = wp.length(error)
        most = wp.max(_MOST_ERROR, wp.length(quat_log(back * command_rotation[e, b])))
        if angle > most:
            goal = wp.normalize(local * quat_exp((most / angle) * error))
    command_rotation[e, b] = goal


class ResistingPoseController:
    """Pose controller whose joints resist contact by springs.

    Attributes:
        avatar: the avatar.
        parameters: settings of the control, in the form of the kernels.
        springs: muscles, flesh and the articulated body.
    """

    #: The end of a control step moves firm particles, as under torque control.
    moves_particles = True

    def __init__(self, avatar: Avatar, points: BodyPoints, parameters: PoseControl, muscles: TorqueControl) -> None:
        """Connect the joints to the command of the avatar.

        Args:
            avatar: the avatar.
            points: the body that it was built from.
            parameters: of the root.
            muscles: muscles and coupling of the flesh.
        """
        self.avatar, self.parameters = avatar, parameters
        model, state = avatar.model, avatar.state
        n, device = model.num_envs, model.device
        self.springs = TorqueController(avatar, points, muscles)
        self._root = make_struct(
            RootState, released=state.released, wrench_force=state.wrench_force, wrench_torque=state.wrench_torque
        )
        self._command = make_struct(
            Command,
            rotation=state.command_rotation,
            increment=wp.zeros((n, NUM_JOINTS), dtype=wp.vec3, device=device),
            root=state.command_root,
            goal_root=state.goal_root,
        )
        free = bool(parameters.free_motion) or parameters.root_rate <= 0.0
        self._motion: CommandedMotion = self.joints.follow(self._command, free, state.released)
        self._increment = wp.zeros((n, NUM_JOINTS), dtype=wp.vec3, device=device)
        self._carry, self._wrench = allocate(Carry, n, device), allocate(Wrench, n, device)
        loads = wp.zeros(0, dtype=float, device=device)
        if parameters.bones_bear:
            values = weight_loads(points.mass[0], points.bone, points.skin_joints, points.skin_weights)
            loads = wp.array(values, dtype=float, device=device)
        sums = dict.fromkeys(("moments", "momenta", "changes"), int(GROUPS))
        self._support = allocate(Support, n, device, load=loads, **sums)

    @property
    def joints(self) -> ArticulatedBody:
        """Return the articulated body, whose velocity is the deviation from commanded motion."""
        return self.springs.joints

    def record_reset(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Append the reset of the masked environments: joints take the placed pose, and nothing moves."""
        self.springs.record_reset(graph, state, mask)
        for vectors in (self.joints.commanded, self._motion.momenta):
            graph.launch(reset_vectors, vectors.shape, [mask], [vectors])

    def record_begin(self, graph: LaunchGraph) -> None:
        """Append the start of a control step: springs of the current bodies, and the increments of the command."""
        avatar, d, t = self.avatar, self.avatar.state, self.avatar.tracked
        avatar.record_clear_support(graph)
        self.springs.record_springs(graph, self.parameters.tone_rate / TONE_RATE)
        graph.launch(
            begin_control,
            (avatar.model.num_envs, NUM_JOINTS),
            [self.parameters, t.local, t.position, d.command_rotation, d.command_root, d.goal_rotation, d.goal_root],
            [self._increment, self._command.increment, self._motion.root_increment, *_arrays(self._carry)],
        )
        avatar.record_corrections(graph, turn_joints, [d.command_rotation, self._command.increment])

    def record_before_substep(self, graph: LaunchGraph, state: State, scratch: Scratch, step: int) -> None:
        """Append the stages before MPM substep ``step``: joints, commanded motion, and the root's support."""
        avatar, joints, model = self.avatar, self.joints, self.avatar.model
        joints.record_substep(graph, state, scratch, step)
        w, motion, support, failure = joints.workspace, self._motion, self._support, state.failure
        inputs = [avatar.body, model.particles, state.x, state.u, state.vk, failure, avatar.threads, w, motion]
        graph.launch(sum_body, (model.num_envs, int(GROUPS), avatar.threads), inputs, [support])
        inputs = [self.parameters, (step + 1) / model.num_substeps, int(step == 0), failure]
        graph.launch(support_body, model.num_envs, inputs, [w, motion, self._wrench, self._root, support])
        inputs = [avatar.body, self.parameters, state.x, avatar.state.released, failure, w, support]
        joints.launch_over_points(graph, move_body, inputs, [state.u])

    def record_end(self, graph: LaunchGraph, state: State) -> None:
        """Append the end of a control step: the goal becomes the command, and firm particles are put in place."""
        d = self.avatar.state
        inputs = [self.avatar.body, self.joints.pose, d.goal_rotation, d.goal_root, state.failure]
        outputs = [d.command_rotation, d.command_root]
        graph.launch(bound_command, (self.avatar.model.num_envs, NUM_JOINTS), inputs, outputs)
        self.joints.record_end(graph, state)

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint, by name."""
        own = self.springs.arrays()
        del own["assist"]
        return own | {"commanded": self.joints.commanded, "commanded_momenta": self._motion.momenta}


def _arrays(carry: Carry) -> list[wp.array]:
    """Return the arrays of a carry, which nothing here reads: contact carries the joints."""
    return [carry.rotation, carry.translation]
