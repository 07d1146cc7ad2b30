"""Articulated momentum projection: joints that move under torques, in a body of flesh that moves with them.

The velocity of a particle is ``v = u + J qdot``: what the joints cannot do, and what they do, with the skinning
Jacobian ``J`` at the particles. Every substep gives the joints what they can take over of the physical velocity, and
lets torques act on them:

    dq = M^-1 J^T m u,   u <- u - J dq,   qdot <- qdot + dq
    (M + dt D + dt^2 K) d = dt (K e - (D + dt K) qdot + tau),   qdot <- qdot + d
    vk = J qdot

``K e`` is a spring towards a target pose and ``D`` a damper, both implicit in time, ``tau`` a torque, a joint each; the
pelvis may be held by springs from outside. The first line moves velocity from one share to the other and changes no
particle's, whatever the mass matrix. Torques between bones must change neither momentum nor angular momentum. With the
mass matrix of this moment they would not; it may be a few substeps old, so what rigid motion ``J d`` has too much comes
off, found from the bones' moments as they are. When the mass matrix is built anew the pose is fitted to the particles,
too (``dq = M^-1 J^T m (x - LBS)``).

Flesh may be held to the bones by a pull, implicit and critically damped, ``u' = (u + dt w^2 d)/(1 + dt w)^2`` with
``d`` from the particle to its skinned place; the joints get the reaction, ``qdot <- qdot + M^-1 J^T m (u - u')``, with
exactly its momentum.

Whenever ``J`` has changed, and it does with every move, the change of ``J qdot`` goes to ``u``: these are the
centrifugal forces. They are explicit in time, so light limbs that nothing damps gain a little energy, and a mass matrix
of more than some 5 ms ago makes fast limbs unstable.

No environment is driven this way yet.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.avatar.cholesky import factorize, solve
from piavatar_envs.avatar.joint_momentum import balance, gather_momentum
from piavatar_envs.avatar.joint_motion import (
    attach_flesh,
    find_displacement,
    hand_back,
    move_joints,
    part_of,
    set_part,
    spread_motion,
    take_over,
)
from piavatar_envs.avatar.lanes import warp_threads
from piavatar_envs.avatar.mass_matrix import (
    NUM_DOF,
    build_pairs,
    compose_moments,
    fill_mass_matrix,
    place_pairs,
    sum_pairs,
)
from piavatar_envs.avatar.rigid_fit import BLOCK, sum_moments
from piavatar_envs.avatar.rotation import quat_log
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import Body, vec8, vec12, vec16
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Model, State, group, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class Springs:
    """Springs and dampers: of the pelvis' place, then of all joints, ``(1 or num_envs, 1 + bones)``.

    Those of the pelvis, ``[:, :2]``, act from outside: a body that nobody holds has none.
    """

    stiffness: wp.array2d(dtype=float)  # [N/m], then [N m/rad]
    damping: wp.array2d(dtype=float)  # [N s/m], then [N m s/rad]


@wp.struct
class Target:
    """Where springs pull to; ``(num_envs, bones)`` and ``(num_envs,)``."""

    rotation: wp.array2d(dtype=wp.quat)  # local; of the pelvis in the world
    root: wp.array(dtype=wp.vec3)  # of the pelvis joint [m]


@wp.kernel
def add_change(change: wp.array2d(dtype=float), q: wp.array2d(dtype=float)):
    """``q += change``."""
    e, i = wp.tid()
    q[e, i] = q[e, i] + change[e, i]


@wp.kernel
def torque_impulse(
    body: Body,
    dt: float,
    gravity: wp.vec3,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    target: Target,
    springs: Springs,
    torque: wp.array2d(dtype=wp.vec3),
    q: wp.array2d(dtype=float),
    # out
    impulse: wp.array2d(dtype=float),
):
    """``dt (K e - (D + dt K) qdot + tau)`` of the pelvis' place, then of all joints; over ``(num_envs, 1 + bones)``.

    ``torque`` [N m] is in the world's axes; that of the pelvis, which would come from outside, is not asked for. The
    fall of this substep is still to come and counts as velocity: else a held body would rise as fast as it falls, and
    its damper would resist that.
    """
    e, n = wp.tid()
    r = row(e, springs.stiffness.shape[0])
    K = springs.stiffness[r, n]
    D = springs.damping[r, n]
    error = target.root[e] - position[e, 0]
    push = wp.vec3()
    v = part_of(q, e, 3 * n)
    if n == 0:
        v += dt * gravity
    else:
        c = n - 1
        above = wp.quat(0.0, 0.0, 0.0, 1.0)
        if c > 0:
            above = rotation[e, body.parent[c]]
            push = torque[e, c]
        error = wp.quat_rotate(
            above, quat_log(target.rotation[e, c] * wp.quat_inverse(wp.quat_inverse(above) * rotation[e, c]))
        )
    push += K * error - (D + dt * K) * v
    set_part(impulse, e, 3 * n, dt * push)


@wp.kernel
def implicit_diagonal(dt: float, springs: Springs, diagonal: wp.array2d(dtype=float)):
    """``dt D + dt^2 K``; launched over ``(rows, 1 + bones)``."""
    r, n = wp.tid()
    value = dt * springs.damping[r, n] + dt * dt * springs.stiffness[r, n]
    set_part(diagonal, r, 3 * n, wp.vec3(value))


@wp.kernel
def find_support(
    impulse: wp.array2d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    change: wp.array2d(dtype=float),
    # out
    support: wp.array2d(dtype=float),
):
    """What the pelvis' springs really give, implicit as they are: the only impulse from outside; ``(num_envs, 6)``."""
    e, i = wp.tid()
    support[e, i] = impulse[e, i] - diagonal[row(e, diagonal.shape[0]), i] * change[e, i]


class ArticulatedBody:
    """Joints of one avatar in every environment, and what moves them.

    Attributes:
        rotation, position: pose of the bones in the world, ``(num_envs, 22)`` quaternions and [m].
        velocity: generalised velocity, ``(num_envs, 69)``: the pelvis' [m/s], then spins of the joints [rad/s].
        target: where the springs pull to.
        torque: torques on the joints, ``(num_envs, 22)`` vectors in the world's axes [N m]; that of the pelvis is none.
        springs: of the pelvis and of all joints.
        attachment: rates of the pulls that hold flesh to bones, ``(1 or num_envs, num_points)`` [1/s], or None.
        mass: the mass matrix, ``(num_envs, 69, 69)``.
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
        """Allocate; :meth:`record_refresh` must run before anything else.

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
        self.pairs = build_pairs(points, device)
        self.springs = group(
            Springs,
            stiffness=wp.array(stiffness.astype(np.float32), dtype=float, device=device),
            damping=wp.array(damping.astype(np.float32), dtype=float, device=device),
        )
        self.attachment = None
        if attachment is not None:
            self.attachment = wp.array(attachment.astype(np.float32), dtype=float, device=device)

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        bones = (n, NUM_JOINTS)
        self.rotation = zeros(bones, wp.quat)
        self.target = group(Target, rotation=zeros(bones, wp.quat), root=zeros(n, wp.vec3))
        self.target.rotation.fill_(wp.quat_identity())
        self.position, self.torque = zeros(bones, wp.vec3), zeros(bones, wp.vec3)
        self.velocity, self.mass = zeros((n, NUM_DOF), float), zeros((n, NUM_DOF, NUM_DOF), float)
        self._factor, self._driven = zeros(self.mass.shape, float), zeros(self.mass.shape, float)
        self._none, self._diagonal = zeros((1, NUM_DOF), float), zeros((len(stiffness), NUM_DOF), float)
        self._right, self._change = zeros((n, NUM_DOF), float), zeros((n, NUM_DOF), float)
        self._support, self._nothing = zeros((n, 6), float), zeros((n, 6), float)
        self._taken, self._moving = zeros(bones, vec8), zeros(bones, vec8)
        self._linear, self._angular = zeros(bones, wp.vec3), zeros(bones, wp.vec3)
        self._displacement = zeros((n, model.num_particles), wp.vec3)
        self._chunks, self._bones = zeros((n, body.chunk_bone.shape[0]), vec16), zeros(bones, vec16)
        self._pair_sums = zeros((n, len(self.pairs.entry_start) - 1), vec12)
        self._pair_moments = zeros((n, NUM_JOINTS * NUM_JOINTS), vec16)

    def record_refresh(self, program: Program, state: State, fit: bool = True) -> None:
        """Append: fit the pose to the particles (``fit``), and build the mass matrix where they are.

        No velocity changes; what those of the joints do from here :meth:`record_substep` finds. The pose can be fitted
        once there is a mass matrix.
        """
        n = self.model.num_envs
        if fit:
            pose = [self.rotation, self.position]
            program.launch(find_displacement, (n, self.body.count), [self.body, state.x, *pose], [self._displacement])
            self._record_share(program, state, self._displacement)
            program.launch(spread_motion, n, [self.body, self.position, self._change], [self._taken])
            program.launch(move_joints, n, [self.body, 1.0, self._taken], pose)
        self._record_mass(program, state)

    def _record_mass(self, program: Program, state: State) -> None:
        n, m = self.model.num_envs, self.model
        program.launch(
            sum_pairs,
            (*self._pair_sums.shape, self.threads),
            [self.body, self.pairs, m.particles, state.x, self.position, self.threads],
            [self._pair_sums],
        )
        moments = self._pair_moments
        program.launch(place_pairs, moments.shape, [self.pairs, self._pair_sums, self.position], [moments])
        for columns in (0, 1):
            program.launch(compose_moments, (n, NUM_JOINTS), [self.body, self.position, columns], [moments])
        program.launch(fill_mass_matrix, moments.shape, [moments], [self.mass])
        program.launch(implicit_diagonal, self.springs.stiffness.shape, [m.step.dt, self.springs], [self._diagonal])
        for diagonal, factor in ((self._none, self._factor), (self._diagonal, self._driven)):
            program.launch(factorize, (n, self.threads), [self.mass, diagonal, self.threads], [factor])

    def _record_share(self, program: Program, state: State, vectors: wp.array) -> None:
        """Append: the share ``dq = M^-1 J^T m v`` that the joints can take of vectors at the particles."""
        n = self.model.num_envs
        program.launch(
            sum_moments,
            (*self._chunks.shape, self.threads),
            [self.body, self.model.particles, state.x, vectors, self.position, state.failure, self.threads],
            [self._chunks],
            block_dim=BLOCK,
        )
        outputs = [self._linear, self._angular, self._bones, self._right]
        program.launch(gather_momentum, n, [self.body, self.position, self._chunks], outputs)
        program.launch(solve, (n, self.threads), [self._factor, self._right, self.threads], [self._change])

    def _record_attachment(self, program: Program, state: State) -> None:
        """Append: flesh is pulled to the bones, and the bones to the flesh."""
        n, points = self.model.num_envs, (self.model.num_envs, self.body.count)
        pose = [self.rotation, self.position]
        program.launch(find_displacement, points, [self.body, state.x, *pose], [self._displacement])
        inputs = [self.body, self.model.step.dt, self.attachment, state.failure]
        program.launch(attach_flesh, points, inputs, [state.u, self._displacement])
        self._record_share(program, state, self._displacement)
        program.launch(spread_motion, n, [self.body, self.position, self._change], [self._moving])
        inputs = [self.position, self._bones, 1.0, self._nothing, self._moving]
        program.launch(balance, n, inputs, [self._change])
        program.launch(add_change, (n, NUM_DOF), [self._change], [self.velocity])

    def record_substep(self, program: Program, state: State) -> None:
        """Append what the joints do before an MPM substep: take over, act, and move the pose on."""
        n, dt, pose = self.model.num_envs, self.model.step.dt, [self.rotation, self.position]
        program.launch(spread_motion, n, [self.body, self.position, self.velocity], [self._moving])
        inputs = [self.body, state.x, self.position, self._moving, state.failure]
        program.launch(hand_back, (n, self.body.count), inputs, [state.u, state.vk])
        if self.attachment is not None:
            self._record_attachment(program, state)
        self._record_share(program, state, state.u)
        program.launch(spread_motion, n, [self.body, self.position, self._change], [self._taken])
        program.launch(add_change, (n, NUM_DOF), [self._change], [self.velocity])
        program.launch(
            torque_impulse,
            (n, 1 + NUM_JOINTS),
            [self.body, dt, self.model.step.gravity, *pose, self.target, self.springs, self.torque, self.velocity],
            [self._right],
        )
        program.launch(solve, (n, self.threads), [self._driven, self._right, self.threads], [self._change])
        program.launch(spread_motion, n, [self.body, self.position, self._change], [self._moving])
        program.launch(find_support, (n, 6), [self._right, self._diagonal, self._change], [self._support])
        inputs = [self.position, self._bones, 0.0, self._support, self._moving]
        program.launch(balance, n, inputs, [self._change])
        program.launch(add_change, (n, NUM_DOF), [self._change], [self.velocity])
        program.launch(spread_motion, n, [self.body, self.position, self.velocity], [self._moving])
        inputs = [self.body, state.x, self.position, self._taken, self._moving, state.failure]
        program.launch(take_over, (n, self.body.count), inputs, [state.u, state.vk])
        program.launch(move_joints, n, [self.body, dt, self._moving], pose)
