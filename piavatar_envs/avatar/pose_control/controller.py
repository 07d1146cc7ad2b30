"""Pose controller: an action is an increment of a pose, whose motion is prescribed to the flesh.

A control step starts from the pose tracked at the end of the one before. The stages before every MPM substep are in
:mod:`piavatar_envs.avatar.pose_control.kernels`.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar, reset_vectors
from piavatar_envs.avatar.body.device import BodyPoints
from piavatar_envs.avatar.body.flesh import weight_loads
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.correctives import turn_joints
from piavatar_envs.avatar.pose_control.bone_contact import PoseBoneContact
from piavatar_envs.avatar.pose_control.bones import begin_control, end_control
from piavatar_envs.avatar.pose_control.injection import bone_matrices, inject_velocity
from piavatar_envs.avatar.pose_control.kernels import (
    add_to_bones,
    apply_corrections,
    command_body,
    command_particles,
    correct_body,
    fit_bones,
    prepare_body,
    remove_motions,
    warps_of_body,
)
from piavatar_envs.avatar.segment_sums import GROUPS, sum_corrections, sum_moments, sum_motion, warps_of
from piavatar_envs.avatar.types import COMMANDS, Command, PoseControl, PoseWorkspace, RootState, allocate
from piavatar_envs.core.cuda_intrinsics import BLOCK, chunk_threads, particle_rounds, particle_threads
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import DECOUPLING, Scratch, State


class PoseController:
    """Controller that moves one avatar along a commanded pose in every environment.

    Attributes:
        avatar: the avatar.
        parameters: settings of the control, in the form of the kernels.
        workspace: arrays of a substep, with the order of the kinematic poses in even substeps.
        motion: kinematic velocity in the last substep of flesh with a velocity lag, before its rigid part was taken
            out, ``(num_envs, num_points)`` [m/s]; stored in checkpoints, except where velocity is injected.
        in_one_launch: whether one launch runs all stages before a substep, as on a CPU.
    """

    #: The end of a control step only takes over the command.
    moves_particles = False
    #: Flesh takes the forces on bones.
    joints = None

    def __init__(
        self, avatar: Avatar, points: BodyPoints, parameters: PoseControl, shape_rates: np.ndarray | None = None
    ) -> None:
        """Allocate the arrays of a substep.

        Args:
            avatar: the avatar.
            points: the body that it was built from.
            parameters: of the pulls and the root.
            shape_rates: physical and kinematic shape preservation of every particle [1/s], shape ``(P, 2)``; those of
                the parameters if there are no rows.
        """
        self.avatar, self.parameters, model = avatar, parameters, avatar.model
        self.in_one_launch = wp.get_device(model.device).is_cpu
        self._injects = model.step.decoupling in (DECOUPLING["paper"], DECOUPLING["none"])
        self._chunk_threads = chunk_threads(model.device, int(np.diff(avatar.body.chunk_start.numpy()).max()))
        n, state, tracked = model.num_envs, avatar.state, avatar.tracked
        if parameters.command == COMMANDS["reference"]:
            self._start = state.command_rotation, state.command_root
        else:
            self._start = tracked.local, tracked.position[:, 0]
        self._root = make_struct(
            RootState, released=state.released, wrench_force=state.wrench_force, wrench_torque=state.wrench_torque
        )
        command = make_struct(
            Command,
            rotation=state.command_rotation,
            increment=wp.zeros((n, NUM_JOINTS), dtype=wp.vec3, device=model.device),
            root=state.command_root,
            goal_root=state.goal_root,
        )
        chunks, held = avatar.body.chunk_bone.shape[0], int(parameters.root_rate > 0.0)
        self.workspace = allocate(
            PoseWorkspace,
            n,
            model.device,
            start_rotation=self._start[0],
            start_root=self._start[1],
            command=command,
            tracked=tracked.position,
            moments=chunks,
            corrections=chunks,
            pull=avatar.num_points,
            lean=avatar.num_points,
            load=self._loads(points),
            jump=held * avatar.num_points,
            jumps=held * chunks,
        )
        rates = np.zeros((0, 2)) if shape_rates is None else shape_rates
        self._shape_rates = wp.array(rates, dtype=wp.vec2, device=model.device)
        self.motion = wp.zeros((n, avatar.num_points), dtype=wp.vec3, device=model.device)
        w = self.workspace
        swapped = {name: getattr(w, name) for name in PoseWorkspace.vars} | {"now": w.after, "after": w.now}
        self._workspaces = w, make_struct(PoseWorkspace, **swapped)
        self._contact = PoseBoneContact(avatar.body, parameters, model)
        # only injection blends whole matrices
        matrices = (n, NUM_JOINTS if self._injects else 0)
        self._bone_from, self._bone_step = (wp.zeros(matrices, dtype=wp.mat44, device=model.device) for _ in range(2))

    def _loads(self, points: BodyPoints) -> wp.array:
        """Return :func:`.weight_loads` on the device; empty where the root's support bears every particle."""
        loads = np.zeros(0, np.float32)
        if self.parameters.bones_bear:
            loads = weight_loads(points.mass[0], points.bone, points.skin_joints, points.skin_weights)
        return wp.array(loads, dtype=float, device=self.avatar.model.device)

    def record_reset(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Append the reset of the masked environments' :attr:`motion`; a control step begins from the tracked pose."""
        graph.launch(reset_vectors, self.motion.shape, [mask], [self.motion])

    def record_begin(self, graph: LaunchGraph) -> None:
        """Append the start of a control step: the increments from the tracked pose towards the goal."""
        avatar, w, d, t = self.avatar, self.workspace, self.avatar.state, self.avatar.tracked
        avatar.record_clear_support(graph)
        graph.launch(
            begin_control,
            (avatar.model.num_envs, NUM_JOINTS),
            [self.parameters, t.local, t.position, d.command_rotation, d.command_root, d.goal_rotation, d.goal_root],
            [w.increment, w.command.increment, w.root_increment, w.carry.rotation, w.carry.translation],
        )
        avatar.record_pose(graph, 0.0, self._start, (w.increment, w.root_increment), w.now)
        if not self._injects:
            inputs = [self._start[0], w.increment]
            avatar.record_corrections(graph, turn_joints, inputs)

    def record_before_substep(self, graph: LaunchGraph, state: State, scratch: Scratch, step: int) -> None:
        """Append the stages before MPM substep ``step``: velocities of the particles, in the scheme of the model."""
        if self._injects:
            if step == 0:
                self._record_injection(graph, state)
        elif self.in_one_launch:
            avatar, particles = self.avatar, self.avatar.model.particles
            own = [avatar.body, self.parameters, self._shape_rates]
            inputs = [*own, particles, avatar.body_mass, step, state.x, state.failure]
            outputs = [self._workspaces[step % 2], self._root, self.motion, state.u, state.kinematic]
            graph.launch(command_body, avatar.model.num_envs, inputs, outputs)
        else:
            self._record_passes(graph, state, step)
        if not self._injects:
            self._contact.record(graph, state, scratch, self._workspaces[step % 2], self._root.released)

    def _record_passes(self, graph: LaunchGraph, state: State, step: int) -> None:
        """Append the stages of :func:`command_body`, with a launch for each pass over particles."""
        avatar, model, w, root = self.avatar, self.avatar.model, self._workspaces[step % 2], self._root
        n, threads, body, particles = model.num_envs, avatar.threads, avatar.body, model.particles
        parameters, released, failure = self.parameters, avatar.state.released, state.failure
        chunks = (n, warps_of(body.quarters, threads), threads)
        rounds = particle_rounds(model.device, n * avatar.num_points)
        points = (n, particle_threads(model.device, avatar.num_points, rounds))
        bones, many_chunks = (n, NUM_JOINTS, threads), self._chunk_threads == 0

        inputs = [body, particles, state.x, state.u, w.tracked, failure, threads]
        graph.launch(sum_moments, chunks, inputs, [w.moments], block_dim=BLOCK)
        if many_chunks:
            graph.launch(fit_bones, bones, [body, failure, threads], [w], block_dim=threads)
        block = warps_of_body(model.device, n) * threads
        inputs = [body, parameters, avatar.body_mass, step, self._chunk_threads, failure]
        graph.launch(prepare_body, (n, block), inputs, [w, root], block_dim=block)

        inputs = [body, parameters, self._shape_rates, state.x, w.record, w.load, w.bones, released]
        inputs += [step / model.num_substeps, failure]
        outputs = [state.u, self.motion, state.kinematic, w.pull, w.lean, w.jump]
        graph.launch(command_particles, points, inputs, outputs, block_dim=BLOCK)
        if parameters.free_motion or parameters.root_rate > 0.0:  # a released root leaves an unsupported body
            inputs = [body, parameters, particles, state.x, state.vk, w.bones.center, released, failure, threads]
            graph.launch(sum_motion, (n, int(GROUPS), threads), inputs, [w.corrections], block_dim=BLOCK)
            graph.launch(remove_motions, (n, threads), [body, parameters, failure, threads], [w, root], block_dim=BLOCK)

        inputs = [body, particles, state.x, w.bones.center, w.pull, w.lean, w.jump, failure, threads]
        graph.launch(sum_corrections, chunks, inputs, [w.corrections, w.jumps], block_dim=BLOCK)
        if many_chunks:
            graph.launch(add_to_bones, bones, [body, failure, threads], [w], block_dim=threads)
        inputs = [body, parameters, self._chunk_threads, failure, threads]
        graph.launch(correct_body, (n, threads), inputs, [w, root], block_dim=threads)
        inputs = [body, parameters, state.x, w.pull, w.bones, w.change, w.removed, released, failure]
        graph.launch(apply_corrections, points, inputs, [state.u, state.kinematic], block_dim=BLOCK)

    def _record_injection(self, graph: LaunchGraph, state: State) -> None:
        """Append the paper's scheme: one injection of velocity, before the plain substeps of a control step."""
        avatar, w, n = self.avatar, self.workspace, self.avatar.model.num_envs
        avatar.record_pose(graph, 1.0, self._start, (w.increment, w.root_increment), w.after)
        inputs = [avatar.body, avatar.model.control_dt, w.now, w.after, w.carry]
        graph.launch(bone_matrices, (n, NUM_JOINTS), inputs, [self._bone_from, self._bone_step])
        inputs = [avatar.body, self.parameters, self._shape_rates, state.x, self._bone_from, self._bone_step]
        graph.launch(inject_velocity, (n, avatar.num_points), [*inputs, state.failure], [state.u, state.vk])

    def record_end(self, graph: LaunchGraph, state: State) -> None:
        """Append the end of a control step: the goal becomes the commanded pose."""
        d = self.avatar.state
        graph.launch(
            end_control,
            (self.avatar.model.num_envs, NUM_JOINTS),
            [d.goal_rotation, d.goal_root, state.failure],
            [d.command_rotation, d.command_root],
        )

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint, by name."""
        return {} if self._injects else {"motion": self.motion}
