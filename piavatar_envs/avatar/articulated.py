"""Articulated momentum projection: joints that move under torques, in a body of flesh that moves with them.

The velocity of a particle is ``v = u + J qdot``: what the joints cannot do, and what they do, with the skinning
Jacobian ``J`` at the particles. Every substep gives the joints what they can take over of the physical velocity, and
lets torques act on them:

    M dq = J^T m u,   qdot <- qdot + dq,   u <- u - J dq,   c <- c + dq
    (M + A) d = dt (K e + tau) + J_b^T p - A (qdot + c),   A = dt D + dt^2 K
    qdot <- qdot + d + c,   u <- u - J c,   vk = J qdot

``K e`` is a spring towards a target pose and ``D`` a damper, both implicit in time, ``tau`` a torque, a joint each;
``p`` are impulses on points of bones that come to a boundary, see :mod:`piavatar_envs.avatar.bone_contact`.
Light joints take over less than all: to the first ``M = J^T m J`` some inertia is added, of which torques know nothing,
see :func:`piavatar_envs.avatar.joint_mass.grid_inertia`.
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
are. At the end of a substep that had a new one the pose is fitted to the particles, too (``dq = M^-1 J^T m (x - LBS)``,
with what they were off their places at its beginning).

Flesh may be held to the bones by a pull, implicit and critically damped, ``u' = (u + dt w^2 d)/(1 + dt w)^2`` with
``d`` from the particle to its skinned place; the joints get the reaction, ``qdot <- qdot + M^-1 J^T m (u - u')``, with
exactly its momentum. The grid blurs what a pull gives a single particle, and under load a particle slips from its place
for the pull to carry it: by millimetres where cells have centimetres. After every control step firm particles, those of
bones, may be put into their places, if these are not beyond a boundary. No velocity changes, and no momentum; what a
way ``d`` has of angular momentum, ``m d x v``, the affine velocity of the particle takes back. The centre of mass moves
by the mean of these ways: hundredths of a millimetre, in all directions. The pull, and the fit of the pose, go on as if
the particle were where it was: it remembers the way. Else the load would begin to slip anew, and feet that press on the
ground would not come to rest.

The last ``J`` is that of the middle of the substep, particles and pose half a step on, by the velocity they begin with
(the explicit midpoint rule): limbs that turn keep their width. To it comes what skinning does besides: where bones have
a particle at different places, each turns its own (:func:`piavatar_envs.avatar.joint_motion.motion_apart`). So ``vk``
takes particles from their skinned places to their skinned places, however joints turn and bend. The velocity of a
particle stays what it was; what ``vk`` is less is more in ``u``.

Whenever ``J`` has changed, and it does with every move, the change of ``J qdot`` goes to ``u``: these are the
centrifugal forces. They are explicit in time, so light limbs that nothing damps gain a little energy, and a mass matrix
of more than some 5 ms ago makes fast limbs unstable.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.avatar.attachment import attach_flesh, put_in_place
from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.avatar.bone_sums import sum_moments
from piavatar_envs.avatar.bone_touch import Ground
from piavatar_envs.avatar.joint_bench import JointBench
from piavatar_envs.avatar.joint_mass import JointMass, grid_inertia
from piavatar_envs.avatar.joint_motion import take_over
from piavatar_envs.avatar.joint_stages import MASS_BLOCK, Support, act, begin_substep, build_mass
from piavatar_envs.avatar.joint_torques import UNBOUNDED, Springs, Target, make_strength, make_tissue
from piavatar_envs.avatar.lanes import BLOCK, particle_rounds, particle_threads, warp_threads
from piavatar_envs.avatar.mass_matrix import NUM_DOF
from piavatar_envs.avatar.part_sums import ALL_WORDS, PART_BLOCK, divide
from piavatar_envs.avatar.quarters import warps_of
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import Body, JointState, Pose, vec8, vec12, vec16
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Model, Scratch, State, group


class ArticulatedBody:
    """Joints of one avatar in every environment, and what moves them.

    Attributes:
        state: pose of the bones, generalised velocity and torques; what a checkpoint holds.
        target: where the springs pull to, and the torques.
        springs: of the pelvis and of all joints.
        strength: limits of what springs and torques of the joints do; none until :meth:`set_strength`.
        tissue: what resists in the joints; nothing until :meth:`set_tissue`.
        attachment: rates of the pulls that hold flesh to bones, ``(1 or num_envs, num_points)`` [1/s].
        firm: particles that are put into their places on the bones, by index in the body.
        solid: whether bones stop at boundaries.
        mass: the mass matrix.
        impulse: of muscles and tissue in the last substep, ``(num_envs, 69)``; ``[:, :6]`` is what held the pelvis.
        support: force and torque of what holds the pelvis: every substep adds its share of a control step's mean.
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
    ) -> None:
        """Allocate.

        Args:
            points: the body as its drive was built from it.
            body: the same on the device.
            model: of the world.
            stiffness: of the springs, as :class:`Springs` has it, shape ``(1 or num_envs, 23)``.
            damping: likewise.
            attachment: rates of the pulls that hold flesh to bones, shape ``(1 or num_envs, num_points)`` [1/s];
                without them, or where they are 0, flesh is held by its own stiffness only.
            firm: which particles are put into their places on the bones after every control step, shape
                ``(num_points,)`` bool; none if not given.
            solid: whether bones stop at boundaries, see :mod:`piavatar_envs.avatar.bone_contact`.

        Raises:
            ValueError: a stiffness, damping or rate is negative or not finite, or the shape of one, or of ``firm``, is
                another one.
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
            raise ValueError(f"firm has shape {firm.shape}, expected ({points.num_points},): one a particle")
        self.body, self._parts = divide(points, body, device)
        self.model, self.threads = model, warp_threads(device)
        self._points = (n, particle_threads(device, body.count, particle_rounds(device, n * body.count)))
        self.springs = group(Springs, stiffness=self._upload(stiffness), damping=self._upload(damping))
        self.attachment = self._upload(rates)
        chosen = np.flatnonzero(np.zeros(points.num_points) if firm is None else firm)
        self.firm = wp.array(chosen.astype(np.int32), dtype=int, device=device)

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        bones = (n, NUM_JOINTS)
        self.state = JointState(
            rotation=zeros(bones, wp.quat),
            position=zeros(bones, wp.vec3),
            velocity=zeros((n, NUM_DOF), float),
            outside=zeros((n, NUM_DOF), float),
            torque=zeros(bones, wp.vec3),
            slip=zeros((n, 1 + chosen.max(initial=0)), wp.vec3),
        )
        self.pose = group(Pose, rotation=self.state.rotation, position=self.state.position)
        target = {"rotation": zeros(bones, wp.quat), "root": zeros(n, wp.vec3)}
        self.target = group(Target, **target, torque=self.state.torque, factor=self._upload(np.ones(1)))
        self.target.rotation.fill_(wp.quat_identity())
        self.solid = solid
        self.mass = JointMass(points, body, model)
        self._inertia = grid_inertia(points, model.grid.dx)
        self._scratch = zeros(ALL_WORDS * points.num_points if self.threads == 1 else 0, float)
        self.impulse = zeros((n, NUM_DOF), float)
        self.support = group(Support, force=zeros(n, wp.vec3), torque=zeros(n, wp.vec3))
        self._bench = self._allocate()
        without, everywhere = np.zeros((NUM_JOINTS, 3)), np.full((NUM_JOINTS, 3), UNBOUNDED)
        self.set_strength(-everywhere, everywhere, 1)
        self.set_tissue(without[:, 0], without[:, 0], -everywhere, everywhere, [])

    def _allocate(self) -> JointBench:
        """What a substep works on."""
        n, s, mass = self.model.num_envs, self.state, self.mass

        def zeros(dtype, *shape):
            return wp.zeros(shape, dtype=dtype, device=self.model.device)

        chunks = self.body.chunk_bone.shape[0]
        return group(
            JointBench,
            pose=self.pose,
            velocity=s.velocity,
            outside=s.outside,
            pair_sums=mass.sums,
            records=mass.records,
            pattern=mass.pattern,
            matrix=mass.matrix,
            diagonals=zeros(float, 2 * n, NUM_DOF),
            factors=mass.make_factors(2 * n + 1),
            stop=zeros(float, n, NUM_JOINTS),
            moments=zeros(vec16, n, chunks),
            other_moments=zeros(vec12, n, chunks),
            bones=zeros(vec16, n, NUM_JOINTS),
            linear=zeros(wp.vec3, 3 * n, NUM_JOINTS),
            angular=zeros(wp.vec3, 3 * n, NUM_JOINTS),
            shares=zeros(float, 3 * n, NUM_DOF),
            touch=zeros(float, 3 * n, NUM_DOF),
            whole=zeros(float, n, NUM_DOF),
            middle=zeros(wp.vec3, n, NUM_JOINTS),
            half=zeros(wp.vec3, n, NUM_JOINTS),
            muscle=zeros(float, n, NUM_DOF),
            impulse=self.impulse,
            left=zeros(float, n, NUM_DOF),
            place=zeros(wp.mat44, n, NUM_JOINTS),
            moving=zeros(vec8, n, NUM_JOINTS),
            steps=zeros(vec12, n, NUM_JOINTS),
            slip=self.state.slip,
            pelvis=zeros(wp.vec3, n),
        )

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
        besides = np.r_[np.zeros(3), np.repeat(self._inertia + self.tissue.lock.numpy(), 3)]
        own = self._bench.diagonals[: self.model.num_envs]
        own.assign(np.broadcast_to(besides.astype(np.float32), own.shape))

    def record_pose(self, program: Program, state: State) -> None:
        """Append: places and motion of the bones as the joints are now, if something else than a substep moved them."""
        self._record_stage(program, begin_substep, [self.body], state)

    def record_mass(self, program: Program, state: State) -> None:
        """Append: build the mass matrix where particles and joints are, if no substep does."""
        w = self._bench
        program.launch(
            sum_moments,
            (self.model.num_envs, warps_of(self.body.quarters, self.threads), self.threads),
            [self.body, self.model.particles, state.x, state.u, self.state.position, state.failure, self.threads],
            [w.moments],
            block_dim=BLOCK,
        )
        self._record_mass(program, state)

    def _record_mass(self, program: Program, state: State) -> None:
        """Append: build the mass matrix from the bones' moments, and what follows from it."""
        self.mass.record_sums(program, state, self.state.position)
        threads = int(MASS_BLOCK) if self.threads > 1 else 1
        inputs = [self.body, self.mass.pairs, self.model.step.dt, self.springs, self.tissue, state.failure]
        program.launch(build_mass, (self.model.num_envs, threads), inputs, [self._bench], block_dim=threads)

    def _record_stage(self, program: Program, stage: wp.Kernel, inputs: list, state: State, *more: Any) -> None:
        """Append what a warp does for an environment."""
        inputs, outputs = [*inputs, state.failure], [*more, self._bench]
        program.launch(stage, (self.model.num_envs, self.threads), inputs, outputs, block_dim=self.threads)

    def record_substep(self, program: Program, state: State, scratch: Scratch, step: int) -> None:
        """Append what the joints do before an MPM substep: take over, act, and move the pose on.

        Args:
            program: records.
            state: of the particles.
            scratch: of the world, whose sensors are told what bones meet.
            step: which substep of its control step it is. The first one finds joints wherever they are; all others go
                on from the one before.
        """
        model, w, fit = self.model, self._bench, self.mass.is_due(step)
        if step == 0:
            self.record_pose(program, state)
        self._record_pull(program, state)
        if fit:
            self._record_mass(program, state)
        inputs = [self.body, model.step.dt, 1.0 / model.control_dt, 3 if fit else 2]
        inputs += [self.target, self.springs, self.tissue, self.strength]
        self._record_stage(program, act, inputs, state, self._ground(scratch), self.support)
        inputs = [self.body, model.step.dt, state.x, w.pelvis, w.steps, state.failure]
        program.launch(take_over, self._points, inputs, [state.u, state.kinematic], block_dim=BLOCK)

    def _ground(self, scratch: Scratch) -> Ground:
        """What bones meet."""
        model = self.model
        return group(
            Ground,
            solid=int(self.solid),
            boundaries=model.boundaries,
            field=model.particles.field,
            subject=model.contact.subject,
            sensors=scratch.sensors,
        )

    def _record_pull(self, program: Program, state: State) -> None:
        """Append the pass over particles that pulls them to the bones, and sums what joints are to take over."""
        block = PART_BLOCK if self.threads > 1 else 1
        dim = (self.model.num_envs, self._parts.start.shape[0] - 1, block)
        inputs = [self.body, self._parts, self.model.step.dt, self.model.particles.mass]
        inputs += [state.x, self.attachment, state.failure, self._scratch]
        program.launch(attach_flesh, dim, inputs, [state.u, state.vk, self._bench], block_dim=PART_BLOCK)

    def record_end(self, program: Program, state: State) -> None:
        """Append what ends a control step: firm particles are put into their places on the bones as they are now.

        Blocks of the grid are not marked where they come to: the next control step marks all anew.
        """
        if self.firm.size == 0:
            return
        model, w = self.model, self._bench
        inputs = [self.body, model.grid, model.boundaries, self.firm, w.place, w.pose.position, state.u, state.vk]
        inputs += [state.failure]
        program.launch(put_in_place, model.num_envs * self.firm.size, inputs, [state.x, state.C, self.state.slip])
