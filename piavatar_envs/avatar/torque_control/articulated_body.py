"""Articulated body: joints that move under torques, in a body of flesh that moves with them.

The velocity of a particle is split into two parts, ``v = u + J qdot``, with the skinning Jacobian ``J`` at the
particles. ``J qdot`` is the part the joints can produce, ``u`` the remainder, which the MPM substep advances as the
physical velocity. Moving velocity from one part to the other changes the velocity of no particle. Torques act on the
joints; gravity, the ground and other bodies act on the particles, and reach the joints by the projection (step 3).

A substep, see :meth:`ArticulatedBody.record_substep`:

1. *Pull of the flesh* (:func:`~piavatar_envs.avatar.torque_control.flesh_coupling.attach_flesh`). The change of
   ``J qdot`` with the pose is added to ``u``: these are the centrifugal forces. Flesh may be pulled to the bones,
   implicitly and critically damped, ``u' = (u + dt w^2 s) / (1 + dt w)^2``, with the displacement ``s`` from the
   particle to its skinned place. The reaction on the joints, ``M^-1 J^T m (u - u')``, corrected by a rigid motion to
   exactly its momentum, is added to ``qdot`` and to ``c``.
2. *Mass matrix* ``M = J^T m J``, if due; see :mod:`piavatar_envs.avatar.torque_control.mass_matrix`.
3. *Projection.* The joints take over what they can of the physical velocity::

       M dq = J^T m u,   qdot <- qdot + dq,   u <- u - J dq,   c <- c + dq + dt M^-1 h / 2

   ``h`` are the bias forces ``J^T m Jdot qdot``
   (:func:`~piavatar_envs.avatar.torque_control.joint_momentum.bias_forces`). The change of ``J qdot`` with the pose
   enters ``u`` in two halves: one in step 5, before the particles move, one in step 1 of the next substep. The
   projection counts both in ``c``, but only the second is still to come when step 5 predicts it. Predicted twice, the
   first half would move particles in ``u`` and bones in ``vk`` against each other, and strain the flesh by
   ``dt (omega A)^2`` in every swing of amplitude ``A``.

   For light joints inertia is added for the projection only; the torque solve omits it
   (:func:`~piavatar_envs.avatar.torque_control.mass_matrix.grid_inertia`).
4. *Torques*, springs, tissue, ends of ranges and bone contact, implicit in time
   (:mod:`~piavatar_envs.avatar.torque_control.joint_torques`,
   :mod:`~piavatar_envs.avatar.torque_control.joint_tissue`,
   :mod:`~piavatar_envs.avatar.torque_control.joint_stops`,
   :mod:`~piavatar_envs.avatar.torque_control.bone_contact`)::

       (M + A) d = dt (K e + tau) + J_b^T p + N s + J_f^T F dt - A (qdot + c),   A = dt D + dt^2 K

   Torques between bones must change neither momentum nor angular momentum. Because ``M`` may be a few substeps old, the
   rigid motion that ``J d`` has in excess is subtracted, computed from the current moments of the bones.
5. *Advance.* The joints move on with the predicted velocity, and particles get the rest::

       qdot <- qdot + d + c,   u <- u - J c,   vk = (LBS' - LBS) / dt + ((R - I) / dt) (x - LBS)

   The predicted reaction ``-J c`` is added to ``u``, so that contact can cancel it. For a free limb ``c = 0``; a limb
   blocked by the ground does not move. If the predicted change does not occur, the next projection takes ``-J c`` back.
   ``vk`` leads particles from their skinned places ``LBS`` to those at the end of the substep, ``LBS'``, and turns what
   lies between with the rotation ``R`` of their bones
   (:func:`~piavatar_envs.avatar.torque_control.flesh_coupling.split_velocity`). Its difference from ``J qdot`` goes to
   ``u``.
6. *Fit*, after a new mass matrix: the pose is moved by a share of ``M^-1 J^T m (x - LBS)``, with the particles'
   displacements from their skinned places ``LBS`` at the beginning of the substep, but no joint beyond its range.

After a control step, ``F`` approaches the strain measured against the skinned places, and hourglass modes of the
particles are taken back (:mod:`~piavatar_envs.mpm.measured_strain`). Then
:func:`~piavatar_envs.avatar.torque_control.flesh_coupling.put_in_place` moves firm particles,
those of bones, to their skinned places, but not beyond boundaries. It changes no velocity; the angular
momentum ``m s x v`` of displacement ``s`` is compensated in the affine velocity ``C``. ``slip`` stores the
displacement, so that the pull stays the same and feet come to rest.

Symbols:

===========  ===========================================================================================
``qdot``     generalised velocity of the joints, see :mod:`~piavatar_envs.avatar.torque_control.mass_matrix`
``M``        mass matrix of the joints
``K e``      torque of springs ``K`` with the error ``e`` between target and pose
``D``        damping
``A``        implicit inertia of springs and dampers
``tau``      torques of the joints
``p, J_b``   impulses on points of bones that touch a boundary, and the Jacobian of these points
``s, N``     impulses of the stops at the ends of ranges, and their directions
``F, J_f``   external forces (:mod:`piavatar_envs.sim.forces`), and the Jacobian of the points where they act
``d``        velocity change by step 4
``h``        bias forces: centripetal and Coriolis forces of the bones at constant ``qdot``
``c``        velocity change from contact, gravity and flesh in the previous substep, the prediction for this one
===========  ===========================================================================================

Limits:

- Muscles have a greatest torque. There is no external support except ``root_assist``, springs on the pelvis that serve
  as a curriculum: at 1 they nearly hold the pelvis alone, at 0 there are none.
- Centrifugal forces are explicit in time, so light limbs that nothing damps gain a little energy, and fast limbs become
  unstable with a mass matrix older than :data:`~piavatar_envs.avatar.torque_control.mass_matrix.LONGEST_REFRESH`.
- Moving firm particles shifts the centre of mass by the mean of their displacements.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.device import BodyPoints, partition_body
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.bone_hulls import BoneHulls
from piavatar_envs.avatar.segment_sums import ALL_WORDS, PARTITION_THREADS, sum_moments, warps_of
from piavatar_envs.avatar.torque_control.bone_contact import Ground
from piavatar_envs.avatar.torque_control.commanded_motion import (
    CommandedMotion,
    aim_joints,
    follow_command,
    recoil,
    split_commanded,
)
from piavatar_envs.avatar.torque_control.flesh_coupling import attach_flesh, find_places, put_in_place, split_velocity
from piavatar_envs.avatar.torque_control.joint_tissue import JointTissue, make_tissue
from piavatar_envs.avatar.torque_control.joint_torques import UNBOUNDED, Springs, Target, make_strength
from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF, MassMatrix, grid_inertia
from piavatar_envs.avatar.torque_control.stages import MASS_BLOCK, Support, act, begin_substep, build_mass
from piavatar_envs.avatar.torque_control.workspace import TorqueWorkspace
from piavatar_envs.avatar.types import Body, Command, JointState, Pose, allocate
from piavatar_envs.core.cuda_intrinsics import BLOCK, particle_rounds, particle_threads, warp_threads
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.measured_strain import MeasuredStrain
from piavatar_envs.mpm.types import Model, Scratch, State


class ArticulatedBody:
    """Joints of one avatar in every environment, with the springs, torques and contacts that move them.

    Attributes:
        state: pose of the bones, generalised velocity and torques; stored in checkpoints.
        target: target pose of the springs, and the torques.
        springs: of the pelvis and of all joints.
        strength: limits of the torques of the joints, springs included; none until :meth:`set_strength`.
        tissue: passive resistance of the joints; none until :meth:`set_tissue`.
        attachment: rates of the pulls that hold flesh to bones, ``(1 or num_envs, num_points)`` [1/s].
        firm: particles that are moved to their skinned places, by index in the body.
        solid: whether bones stop at boundaries.
        mass: the mass matrix.
        impulse: of muscles and tissue in the last substep, ``(num_envs, 69)``; ``[:, :6]`` of the pelvis springs.
        support: force and torque of the pelvis springs: every substep adds its share of a control step's mean.
        motion: commanded motion, in whose frame the joints move; None until :meth:`follow`.
    """

    def __init__(
        self,
        points: BodyPoints,
        body: Body,
        model: Model,
        stiffness: np.ndarray,
        damping: np.ndarray,
        attachment: np.ndarray | None = None,
        firm: np.ndarray | None = None,
        solid: bool = False,
        links: np.ndarray | None = None,
    ) -> None:
        """Allocate the joints of a body in every environment.

        Args:
            points: the body on the host.
            body: the same on the device.
            model: of the world.
            stiffness: of the springs, as :class:`Springs` has it, shape ``(1 or num_envs, 23)``.
            damping: likewise.
            attachment: rates of the pulls that hold flesh to bones, shape ``(1 or num_envs, num_points)`` [1/s];
                without them, or where they are 0, flesh is held by its own stiffness only.
            firm: flags of the particles that are moved to their skinned places after every control step, shape
                ``(num_points,)`` bool; none if not given.
            solid: whether bones stop at boundaries, see :mod:`piavatar_envs.avatar.torque_control.bone_contact`.
            links: pairs of neighbouring particles, shape ``(L, 2)``, from which their strain is measured after every
                control step; without them it is integrated only.

        Raises:
            ValueError: a stiffness, damping or rate is negative or not finite, or a shape is wrong.
        """
        n, device = model.num_envs, model.device
        rates = np.zeros((1, points.num_points)) if attachment is None else attachment
        sizes = (("stiffness", stiffness, 1 + NUM_JOINTS), ("damping", damping, 1 + NUM_JOINTS))
        for name, value, size in (*sizes, ("attachment", rates, points.num_points)):
            if value.shape not in ((1, size), (n, size)):
                raise ValueError(f"{name} has shape {value.shape}, expected (1 or {n}, {size})")
            if not (np.isfinite(value).all() and (value >= 0.0).all()):
                raise ValueError(f"{name} must be finite and not negative, its least is {value.min():g}")
        if firm is not None and firm.shape != (points.num_points,):
            raise ValueError(f"firm has shape {firm.shape}, expected ({points.num_points},): one per particle")
        self.body, self._partitions = partition_body(points, body, device)
        self.model, self.threads = model, warp_threads(device)
        self._points = (n, particle_threads(device, body.count, particle_rounds(device, n * body.count)))
        self.springs = make_struct(Springs, stiffness=self._upload(stiffness), damping=self._upload(damping))
        self.attachment = self._upload(rates)
        chosen = np.flatnonzero(np.zeros(points.num_points) if firm is None else firm)
        self.firm = wp.array(chosen.astype(np.int32), dtype=int, device=device)

        slip = 1 + int(chosen.max(initial=0))
        self.state: JointState = allocate(JointState, n, device, velocity=NUM_DOF, outside=NUM_DOF, slip=slip)
        self.pose = make_struct(Pose, rotation=self.state.rotation, position=self.state.position)
        given = {"torque": self.state.torque, "factor": self._upload(np.ones(1))}
        self.target = allocate(Target, n, device, **given)
        self.target.rotation.fill_(wp.quat_identity())
        self.solid = solid
        self._hulls = BoneHulls(body, model, solid)
        self.mass = MassMatrix(points, body, model)
        self._inertia = grid_inertia(points, model.grid.dx)
        words = ALL_WORDS * points.num_points if self.threads == 1 else 0
        self._scratch = wp.zeros(words, dtype=float, device=device)
        self.impulse = wp.zeros((n, NUM_DOF), dtype=float, device=device)
        self.support = allocate(Support, n, device)
        self._strain = None if links is None else MeasuredStrain(model, links, body.first, points.num_points)
        self._places = wp.zeros((n, 0 if links is None else points.num_points), dtype=wp.vec3, device=device)
        self._workspace = self._allocate()
        self.motion: CommandedMotion | None = None
        self._free = False
        without, everywhere = np.zeros((NUM_JOINTS, 3)), np.full((NUM_JOINTS, 3), UNBOUNDED)
        self.set_strength(-everywhere, everywhere, 1)
        self.set_tissue(JointTissue(without[:, 0], -everywhere, everywhere, []))

    def _allocate(self) -> TorqueWorkspace:
        """Return the zeroed arrays of a substep."""
        n, s, mass, device = self.model.num_envs, self.state, self.mass, self.model.device

        def rows(count: int, columns: int, dtype: type = float) -> wp.array:
            return wp.zeros((count * n, columns), dtype=dtype, device=device)

        chunks = self.body.chunk_bone.shape[0]
        return allocate(
            TorqueWorkspace,
            n,
            device,
            pose=self.pose,
            velocity=s.velocity,
            outside=s.outside,
            slip=s.slip,
            impulse=self.impulse,
            pair_sums=mass.sums,
            records=mass.records,
            pattern=mass.pattern,
            matrix=mass.matrix,
            factors=mass.make_factors(2 * n + 1),
            diagonals=rows(2, NUM_DOF),
            moments=chunks,
            other_moments=chunks,
            linear=rows(4, NUM_JOINTS, wp.vec3),
            angular=rows(4, NUM_JOINTS, wp.vec3),
            shares=rows(4, NUM_DOF),
            touch=rows(3, NUM_DOF),
            whole=NUM_DOF,
            muscle=NUM_DOF,
            left=NUM_DOF,
            push=rows(0, NUM_DOF),
            reference=rows(0, NUM_DOF),
            commanded=0,
        )

    def _upload(self, value: np.ndarray, dtype: type = float) -> wp.array:
        return wp.array(np.ascontiguousarray(value, np.float32), dtype=dtype, device=self.model.device)

    def set_strength(self, lower: np.ndarray, upper: np.ndarray, rows: int) -> None:
        """Limit the torques of the joints, see :func:`make_strength`; call it before anything is recorded."""
        self.strength = make_strength(lower, upper, rows, self.model.device)

    def set_tissue(self, tissue: JointTissue) -> None:
        """Set the passive resistance; call it before anything is recorded."""
        self.tissue = make_tissue(tissue, self.model.device)
        besides = np.r_[np.zeros(3), np.repeat(self._inertia + self.tissue.lock.numpy(), 3)]
        own = self._workspace.diagonals[: self.model.num_envs]
        own.assign(np.broadcast_to(besides.astype(np.float32), own.shape))

    def allocate_push(self) -> wp.array:
        """Return an array of impulses of external forces, ``(num_envs, 69)``, for launches recorded from now on.

        In every substep its generalised impulses join those that the joints solve for (step 4).
        """
        self._workspace.push = wp.zeros((self.model.num_envs, NUM_DOF), dtype=float, device=self.model.device)
        return self._workspace.push

    def follow(self, command: Command, free: bool, released: wp.array) -> CommandedMotion:
        """Let the joints move in the frame of a ``command``, and return its motion.

        Launches recorded from now on read its increments. :attr:`JointState.velocity` is the deviation from it.

        Args:
            command: what is commanded in a control step.
            free: whether nothing supports the body in any environment.
            released: nonzero in the environments in which nothing supports it, ``(num_envs,)``.
        """
        n, device, count = self.model.num_envs, self.model.device, self.body.count
        self._workspace.reference = wp.zeros((n, NUM_DOF), dtype=float, device=device)
        self._workspace.commanded = wp.zeros((n, count), dtype=wp.vec3, device=device)
        self.target.rotation = wp.zeros((n, NUM_JOINTS), dtype=wp.quat, device=device)  # of a substep
        given = {"command": command, "change": count, "released": released, "momenta": 2, "recoil": 6}
        self.motion, self._free = allocate(CommandedMotion, n, device, **given), free
        return self.motion

    @property
    def commanded(self) -> wp.array:
        """Return the commanded velocity of the particles in the last substep, ``(num_envs, num_points)`` [m/s]."""
        return self._workspace.commanded

    @property
    def workspace(self) -> TorqueWorkspace:
        """Return the arrays of a substep."""
        return self._workspace

    def record_pose(self, graph: LaunchGraph, state: State) -> None:
        """Append the computation of the bones' places and motion, for joints that were not moved by a substep."""
        hulls = int(self._hulls.deepest.size > 0)
        self._record_stage(graph, begin_substep, [self.body, hulls], state)

    def record_mass(self, graph: LaunchGraph, state: State) -> None:
        """Append the sums of the bones' moments and the mass matrix, outside of a substep."""
        w = self._workspace
        graph.launch(
            sum_moments,
            (self.model.num_envs, warps_of(self.body.quarters, self.threads), self.threads),
            [self.body, self.model.particles, state.x, state.u, self.state.position, state.failure, self.threads],
            [w.moments],
            block_dim=BLOCK,
        )
        self._record_mass(graph, state)

    def _record_mass(self, graph: LaunchGraph, state: State) -> None:
        """Append the mass matrix from the bones' moments, and its factors."""
        self.mass.record_sums(graph, state, self.state.position)
        threads = int(MASS_BLOCK) if self.threads > 1 else 1
        inputs = [self.body, self.mass.pairs, self.model.step.dt, self.target, self.springs, self.tissue, state.failure]
        graph.launch(build_mass, (self.model.num_envs, threads), inputs, [self._workspace], block_dim=threads)

    def _record_stage(self, graph: LaunchGraph, stage: wp.Kernel, inputs: list, state: State, *more: Any) -> None:
        """Append ``stage`` with one warp an environment."""
        inputs, outputs = [*inputs, state.failure], [*more, self._workspace]
        graph.launch(stage, (self.model.num_envs, self.threads), inputs, outputs, block_dim=self.threads)

    def record_substep(self, graph: LaunchGraph, state: State, scratch: Scratch, step: int) -> None:
        """Append the stages that precede an MPM substep: pull, mass matrix, projection, torques, and the new pose.

        Args:
            graph: receives the launches.
            state: of the particles.
            scratch: of the world, whose sensors record the impulses on bones.
            step: index of the substep in its control step. The first one recomputes places and motion of the bones; all
                others use those that the substep before has left.
        """
        model, w, fit = self.model, self._workspace, self.mass.is_due(step)
        if step == 0:
            self.record_pose(graph, state)
        if self.motion is not None:
            inputs = [step / model.num_substeps, 1.0 / model.control_dt, self.motion, state.failure]
            graph.launch(aim_joints, (model.num_envs, NUM_JOINTS), inputs, [self.target.rotation, w])
        self._record_pull(graph, state, step / model.num_substeps)
        if fit:
            self._record_mass(graph, state)
        self._hulls.record(graph, self.pose, state.failure)
        if self.motion is not None:
            self._record_stage(graph, recoil, [self.body, int(self._free)], state, self.motion)
        inputs = [self.body, model.step.dt, 1.0 / model.control_dt, 3 if fit else 2]
        inputs += [self.target, self.springs, self.tissue, self.strength]
        self._record_stage(graph, act, inputs, state, self._ground(scratch), self.support)
        after = (step + 1) / model.num_substeps
        if self.motion is None:
            inputs = [self.body, model.step.dt, after, state.x, w, state.failure]
            self.launch_over_points(graph, split_velocity, inputs, [state.u, state.kinematic])
            return
        inputs = [self.body, model.step.dt, 1.0 / model.num_substeps]
        self._record_stage(graph, follow_command, inputs, state, self.motion)
        inputs = [self.body, model.step.dt, step / model.num_substeps, after, state.x, state.failure]
        self.launch_over_points(graph, split_commanded, inputs, [self.motion, w, state.u, state.kinematic])

    def launch_over_points(self, graph: LaunchGraph, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        """Append a kernel whose threads share the particles of the body in every environment."""
        graph.launch(kernel, self._points, inputs, outputs, block_dim=BLOCK)

    def _ground(self, scratch: Scratch) -> Ground:
        """Return the boundaries and sensors that bone contact uses."""
        model = self.model
        return make_struct(
            Ground,
            solid=int(self.solid),
            boundaries=model.boundaries,
            deepest=self._hulls.deepest,
            field=model.particles.field,
            subject=model.contact.subject,
            sensors=scratch.sensors,
        )

    def _record_pull(self, graph: LaunchGraph, state: State, elapsed: float) -> None:
        """Append the pass that pulls particles to the bones, and sums the momenta that are projected on the joints.

        A share ``elapsed`` of the control step is over.
        """
        block = PARTITION_THREADS if self.threads > 1 else 1
        dim = (self.model.num_envs, self._partitions.start.shape[0] - 1, block)
        model = self.model
        per_time = 1.0 / model.control_dt if self.motion is None else 0.0  # commanded motion has corrections of its own
        inputs = [self.body, self._partitions, model.step.dt, elapsed, per_time, model.particles.mass]
        inputs += [state.x, self.attachment, state.failure, self._scratch]
        graph.launch(
            attach_flesh, dim, inputs, [state.u, state.kinematic, self._workspace], block_dim=PARTITION_THREADS
        )

    def record_end(self, graph: LaunchGraph, state: State) -> None:
        """Append the end of a control step: strain is measured, and firm particles are moved to their skinned places.

        Grid blocks are not activated for the new positions; the next control step activates all.
        """
        model, w = self.model, self._workspace
        if self._strain is not None:
            dim = (model.num_envs, self.body.count)
            graph.launch(find_places, dim, [self.body, w.place, state.failure], [self._places])
            self._strain.record(graph, state, self.body.rest, self._places)
        if self.firm.size == 0:
            return
        inputs = [self.body, model.grid, model.boundaries, self.firm, w.place, w.pose.position, state.u, state.vk]
        inputs += [state.failure]
        graph.launch(put_in_place, model.num_envs * self.firm.size, inputs, [state.x, state.C, self.state.slip])
