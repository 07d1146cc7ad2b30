"""Articulated momentum projection: joints that move under torques, in a body of flesh that moves with them.

The velocity of a particle is ``v = u + J qdot``: what the joints cannot do, and what they do, with the skinning
Jacobian ``J`` at the particles. Every substep gives the joints what they can take over of the physical velocity, and
lets torques act on them:

    dq = M^-1 J^T m u,   qdot <- qdot + dq,   u <- u - J dq,   c <- c + dq
    (M + A) d = dt (K e + tau) - A (qdot + c),   A = dt D + dt^2 K
    qdot <- qdot + d + c,   u <- u - J c,   vk = J qdot

``K e`` is a spring towards a target pose and ``D`` a damper, both implicit in time, ``tau`` a torque, a joint each.
``c`` is what all else, contact, weight and flesh, did to the joints in the last substep, and is expected to do again.
The springs know of it, see :mod:`piavatar_envs.avatar.joint_torques`, and so does the split: the joints go on with
the velocity that will be left of their push, and the rest of the push, ``-J c``, waits in ``u`` for what is to stop
it. A free limb has ``c = 0``; of one that stands on the ground nothing moves. (All of ``d`` put into ``qdot``, the
push of a foot and the answer of the ground are two large opposite velocities, of which one strains the foot: it is
torn to pieces. All of it put into ``u``, the grid blurs it, and light limbs shake.) If what is expected does not
come, ``-J c`` is taken over in the next substep: nothing is lost.

Muscles have limits. The pelvis may be held by springs from outside.

The first line moves velocity from one share to the other and changes no particle's, whatever the mass matrix. Torques
between bones must change neither momentum nor angular momentum. With the mass matrix of this moment they would not; it
may be a few substeps old, so what rigid motion ``J d`` has too much comes off, found from the bones' moments as they
are. When the mass matrix is built anew the pose is fitted to the particles, too (``dq = M^-1 J^T m (x - LBS)``).

Flesh may be held to the bones by a pull, implicit and critically damped, ``u' = (u + dt w^2 d)/(1 + dt w)^2`` with
``d`` from the particle to its skinned place; the joints get the reaction, ``qdot <- qdot + M^-1 J^T m (u - u')``, with
exactly its momentum.

Whenever ``J`` has changed, and it does with every move, the change of ``J qdot`` goes to ``u``: these are the
centrifugal forces. They are explicit in time, so light limbs that nothing damps gain a little energy, and a mass matrix
of more than some 5 ms ago makes fast limbs unstable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.avatar.bone_sums import sum_moments, sum_moments_of_both
from piavatar_envs.avatar.joint_mass import JointMass
from piavatar_envs.avatar.joint_momentum import balance, gather_momentum
from piavatar_envs.avatar.joint_motion import (
    add_change,
    attach_flesh,
    find_displacement,
    go_on,
    hand_back,
    move_joints,
    spread_motion,
    take_over,
)
from piavatar_envs.avatar.joint_torques import (
    UNBOUNDED,
    Springs,
    Target,
    find_given,
    implicit_diagonals,
    joint_impulse,
    limit_torques,
    make_strength,
    make_tissue,
)
from piavatar_envs.avatar.lanes import BLOCK, warp_threads
from piavatar_envs.avatar.mass_matrix import NUM_DOF
from piavatar_envs.avatar.posing import rest_matrices
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import Body, JointState, Pose, vec8, vec12, vec16
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Model, State, group

#: Share of what the pose is off the particles that one fit takes away. Those of a fast, light joint (a head, a hand)
#: are not where it has them for other reasons, too: to follow them at once throws it about.
FIT_SHARE = 0.2


class ArticulatedBody:
    """Joints of one avatar in every environment, and what moves them.

    Attributes:
        state: pose of the bones, generalised velocity and torques; what a checkpoint holds.
        target: where the springs pull to, and the torques.
        springs: of the pelvis and of all joints.
        strength: limits of what springs and torques of the joints do; none until :meth:`set_strength`.
        tissue: what resists in the joints; nothing until :meth:`set_tissue`.
        attachment: rates of the pulls that hold flesh to bones, ``(1 or num_envs, num_points)`` [1/s], or None.
        mass: the mass matrix.
        impulse: of muscles and tissue in the last substep, ``(num_envs, 69)``; ``[:, :6]`` is what held the pelvis.
    """

    def __init__(
        self,
        points: BodyPoints,
        body: Body,
        model: Model,
        stiffness: np.ndarray,
        damping: np.ndarray,
        attachment: np.ndarray | None = None,
    ) -> None:
        """Allocate.

        Args:
            points: the body as its drive was built from it.
            body: the same on the device.
            model: of the world.
            stiffness: of the springs, as :class:`Springs` has it, shape ``(1 or num_envs, 23)``.
            damping: likewise.
            attachment: rates of the pulls that hold flesh to bones, shape ``(1 or num_envs, num_points)`` [1/s];
                without them flesh is held by its own stiffness only.

        Raises:
            ValueError: a stiffness, damping or rate is negative or not finite, or the shape is another one.
        """
        n, device = model.num_envs, model.device
        rates = np.zeros((1, points.num_points)) if attachment is None else attachment
        sizes = (("stiffness", stiffness, 1 + NUM_JOINTS), ("damping", damping, 1 + NUM_JOINTS))
        for name, value, size in (*sizes, ("attachment", rates, points.num_points)):
            if value.shape not in ((1, size), (n, size)):
                raise ValueError(f"{name} has shape {value.shape}, expected (1 or {n}, {size})")
            if not (np.isfinite(value).all() and (value >= 0.0).all()):
                raise ValueError(f"{name} must be finite and not negative, its least is {value.min():g}")
        self.body, self.model, self.threads = body, model, warp_threads(device)
        self.springs = group(Springs, stiffness=self._upload(stiffness), damping=self._upload(damping))
        self.attachment = None if attachment is None else self._upload(attachment)

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        bones = (n, NUM_JOINTS)
        self.state = JointState(
            rotation=zeros(bones, wp.quat),
            position=zeros(bones, wp.vec3),
            velocity=zeros((n, NUM_DOF), float),
            outside=zeros((n, NUM_DOF), float),
            torque=zeros(bones, wp.vec3),
        )
        self.pose = group(Pose, rotation=self.state.rotation, position=self.state.position)
        target = {"rotation": zeros(bones, wp.quat), "root": zeros(n, wp.vec3)}
        self.target = group(Target, **target, torque=self.state.torque, factor=self._upload(np.ones(1)))
        self.target.rotation.fill_(wp.quat_identity())
        self.mass = JointMass(points, body, model)
        # where there are two of a kind, they are worked on together: those of all environments, then the others
        self._factors, self._cut = self.mass.make_factors(2 * n), self.mass.make_factors(n)
        self._factor, self._driven = self._factors[:n], self._factors[n:]
        self._diagonals = zeros((2 * n, NUM_DOF), float)
        self._locks, self._diagonal = self._diagonals[:n], self._diagonals[n:]
        self._momentum, self._shares = zeros((2, n, NUM_DOF), float), zeros((2 * n, NUM_DOF), float)
        self._change, self._taken = self._shares[:n], self._shares[n:]
        self._left, self._limited = zeros((n, NUM_DOF), float), zeros(n, int)
        self._muscle, self.impulse = zeros((n, NUM_DOF), float), zeros((n, NUM_DOF), float)
        self._stop, self._nothing = zeros(bones, float), zeros((n, NUM_DOF), float)
        self._place = zeros(bones, wp.mat44)
        self._leaving, self._moving = zeros(bones, vec8), zeros(bones, vec8)
        self._linear, self._angular = zeros((2, *bones), wp.vec3), zeros((2, *bones), wp.vec3)
        self._displacement = zeros((n, model.num_particles), wp.vec3)
        chunks = (n, body.chunk_bone.shape[0])
        self._chunks, self._other_chunks = zeros(chunks, vec16), zeros(chunks, vec12)
        self._bones = zeros(bones, vec16)
        without, everywhere = np.zeros((NUM_JOINTS, 3)), np.full((NUM_JOINTS, 3), UNBOUNDED)
        self.set_strength(-everywhere, everywhere, 1)
        self.set_tissue(without[:, 0], without[:, 0], -everywhere, everywhere, [])

    def _upload(self, value: np.ndarray, dtype: type = float) -> wp.array:
        return wp.array(np.ascontiguousarray(value, np.float32), dtype=dtype, device=self.model.device)

    def set_strength(self, lower: np.ndarray, upper: np.ndarray, rows: int) -> None:
        """Limit the torques of the joints; see :func:`make_strength`. To be called before anything is recorded."""
        self.strength = make_strength(lower, upper, rows, self.model.device)

    def set_tissue(
        self, damping: np.ndarray, stop: np.ndarray, lower: np.ndarray, upper: np.ndarray, locked: Sequence[int]
    ) -> None:
        """Let joints resist; see :func:`make_tissue`. To be called before anything is recorded."""
        self.tissue = make_tissue(damping, stop, lower, upper, locked, self.model.device)
        locks = np.r_[np.zeros(3), np.repeat(self.tissue.lock.numpy(), 3)]
        self._locks.assign(np.broadcast_to(locks.astype(np.float32), self._locks.shape))

    def record_mass(self, program: Program, state: State) -> None:
        """Append: build the mass matrix where particles and joints are, and what follows from it."""
        self.mass.record(program, state, self.state.position)
        inputs = [self.body, self.model.step.dt, self.pose, self.springs, self.tissue]
        outputs = [self._stop, self._diagonal]
        program.launch(implicit_diagonals, (self.model.num_envs, 1 + NUM_JOINTS), inputs, outputs)
        self.mass.record_factors(program, self._diagonals, self._factors)

    def _record_fit(self, program: Program, state: State) -> None:
        """Append: fit the pose to the particles, by a share. No velocity changes."""
        n, s = self.model.num_envs, self.state
        pose = [s.rotation, s.position]
        self._record_place(program)
        inputs = [self.body, state.x, self._place]
        program.launch(find_displacement, (n, self.body.count), inputs, [self._displacement])
        self._record_shares(program, state, [self._displacement], self._change)
        self._record_spread(program, self._change, self._moving)
        inputs = [self.body, FIT_SHARE, self._moving, state.failure, self.threads]
        program.launch(move_joints, (n, self.threads), inputs, pose)

    def _record_spread(self, program: Program, q: wp.array, field: wp.array) -> None:
        """Append: motion of the bones under a generalised velocity."""
        inputs = [self.body, self.state.position, q, self.threads]
        program.launch(spread_motion, (self.model.num_envs, self.threads), inputs, [field])

    def _record_place(self, program: Program) -> None:
        """Append: matrices that take the bones from rest to where they are."""
        inputs = [self.body, self.state.rotation, self.state.position]
        program.launch(rest_matrices, self._place.shape, inputs, [self._place])

    def _record_shares(self, program: Program, state: State, vectors: Sequence[wp.array], shares: wp.array) -> None:
        """Append: the shares ``dq = M^-1 J^T m v`` that the joints can take of one or two vectors at the particles."""
        n, position = self.model.num_envs, self.state.position
        sums = [self._chunks, self._other_chunks][: len(vectors)]
        program.launch(
            sum_moments if len(vectors) == 1 else sum_moments_of_both,
            (*self._chunks.shape, self.threads),
            [self.body, self.model.particles, state.x, *vectors, position, state.failure, self.threads],
            sums,
            block_dim=BLOCK,
        )
        outputs = [self._linear, self._angular, self._bones, self._momentum]
        inputs = [self.body, position, self._chunks, self._other_chunks, self.threads]
        program.launch(gather_momentum, (len(vectors), n, self.threads), inputs, outputs)
        momenta = self._momentum.reshape((-1, NUM_DOF))[: shares.shape[0]]
        self.mass.record_solve(program, self._factor, momenta, shares)

    def _record_attachment(self, program: Program, state: State) -> None:
        """Append: hand back, then flesh is pulled to the bones, and the bones to the flesh.

        And what the joints can take of the velocity that this leaves: one pass over the particles sums both.
        """
        n, s, points = self.model.num_envs, self.state, (self.model.num_envs, self.body.count)
        self._record_place(program)
        where = [state.x, s.position, self._place, self._moving]
        inputs = [self.body, self.model.step.dt, *where, self.attachment, state.vk, state.failure]
        program.launch(attach_flesh, points, inputs, [state.u, self._displacement])
        self._record_shares(program, state, [self._displacement, state.u], self._shares)
        self._record_spread(program, self._change, self._moving)
        inputs = [s.position, self._bones, 1.0, self._nothing, self._moving, self.threads]
        program.launch(balance, (n, self.threads), inputs, [self._change])
        program.launch(add_change, (n, NUM_DOF), [self._change, state.failure], [s.velocity, s.outside])

    def _record_torques(self, program: Program, state: State) -> None:
        """Append: springs, torques and tissue change the velocity of the joints."""
        n, s, dt, each = self.model.num_envs, self.state, self.model.step.dt, (self.model.num_envs, 1 + NUM_JOINTS)
        inputs = [self.body, dt, self.pose, self.target, self.springs, self.tissue, self._stop]
        outputs = [self._muscle, self.impulse, self._limited]
        program.launch(joint_impulse, each, [*inputs, s.velocity, s.outside], outputs)
        self.mass.record_solve(program, self._driven, self.impulse, self._change)
        inputs = [self.body, dt, self.pose, self.springs, self.strength, self._muscle, self._diagonal, self._change]
        program.launch(limit_torques, each, inputs, [self.impulse, self._left, self._limited])
        self.mass.record_factors(program, self._left, self._cut, self._limited)
        self.mass.record_solve(program, self._cut, self.impulse, self._change, self._limited)
        program.launch(find_given, (n, NUM_DOF), [self._left, self._change], [self.impulse])
        self._record_spread(program, self._change, self._moving)
        inputs = [s.position, self._bones, 0.0, self.impulse, self._moving, self.threads]
        program.launch(balance, (n, self.threads), inputs, [self._change])

    def record_substep(self, program: Program, state: State, refresh: bool) -> None:
        """Append what the joints do before an MPM substep: take over, act, and move the pose on.

        Args:
            program: records.
            state: of the particles.
            refresh: build the mass matrix anew, and fit the pose to the particles; to be done in the first substep of a
                program and every few milliseconds.
        """
        n, s, pose = self.model.num_envs, self.state, [self.state.rotation, self.state.position]
        points = (n, self.body.count)
        if refresh:
            self.record_mass(program, state)
            self._record_fit(program, state)
        self._record_spread(program, s.velocity, self._moving)
        if self.attachment is not None:
            self._record_attachment(program, state)
        else:
            inputs = [self.body, state.x, s.position, self._moving, state.vk, state.failure]
            program.launch(hand_back, points, inputs, [state.u])
            self._record_shares(program, state, [state.u], self._taken)
        program.launch(add_change, (n, NUM_DOF), [self._taken, state.failure], [s.velocity, s.outside])
        self._record_torques(program, state)
        inputs = [self._change, s.outside, state.failure]
        program.launch(go_on, (n, NUM_DOF), inputs, [s.velocity, self._taken])
        self._record_spread(program, self._taken, self._leaving)
        self._record_spread(program, s.velocity, self._moving)
        inputs = [self.body, state.x, s.position, self._leaving, self._moving, state.failure]
        program.launch(take_over, points, inputs, [state.u, state.kinematic])
        inputs = [self.body, self.model.step.dt, self._moving, state.failure, self.threads]
        program.launch(move_joints, (n, self.threads), inputs, pose)
