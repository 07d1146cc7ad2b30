"""Articulated momentum projection: joints that move under torques, in a body of flesh that moves with them.

The velocity of a particle is ``v = u + J qdot``: what the joints cannot do, and what they do, with the skinning
Jacobian ``J`` at the particles. Every substep gives the joints what they can take over of the physical velocity, and
lets torques act on them:

    dq = M^-1 J^T m u,   u <- u - J dq,   qdot <- qdot + dq
    (M + dt D + dt^2 K) d = dt (K e - (D + dt K) qdot + tau),   qdot <- qdot + d
    vk = J qdot

``K e`` is a spring towards a target pose and ``D`` a damper, both implicit in time, ``tau`` a torque, a joint each. The
first line moves velocity from one share to the other and changes no particle's, whatever the mass matrix. Torques
between bones must change neither momentum nor angular momentum. With the mass matrix of this moment they would not; it
may be a few substeps old, so what rigid motion ``J d`` has comes off, found from the bones' moments as they are. When
the mass matrix is built anew the pose is fitted to the particles, too (``dq = M^-1 J^T m (x - LBS)``).

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
from piavatar_envs.avatar.joint_motion import (
    find_displacement,
    hand_back,
    joint_part,
    move_joints,
    set_part,
    spread_motion,
    take_over,
)
from piavatar_envs.avatar.lanes import warp_threads
from piavatar_envs.avatar.mass_matrix import (
    BONES,
    I3,
    NUM_DOF,
    build_pairs,
    compose_moments,
    fill_mass_matrix,
    place_pairs,
    sum_pairs,
)
from piavatar_envs.avatar.rigid_fit import BLOCK, point_inertia, spin_of, sum_moments
from piavatar_envs.avatar.rotation import quat_log
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import Body, vec8, vec12, vec16
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Model, State, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def gather_momentum(
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    moments: wp.array2d(dtype=vec16),
    # scratch
    linear: wp.array2d(dtype=wp.vec3),
    angular: wp.array2d(dtype=wp.vec3),
    # out
    bones: wp.array2d(dtype=vec16),
    momentum: wp.array2d(dtype=float),
):
    """``J^T m u`` from the moments of the bones about their joints: each joint has what all beyond it have."""
    e = wp.tid()
    for b in range(BONES):
        s = vec16()
        for c in range(body.chunk_start[b], body.chunk_start[b + 1]):
            s += moments[e, c]
        bones[e, b] = s
        linear[e, b] = wp.vec3(s[4], s[5], s[6])
        angular[e, b] = wp.vec3(s[13], s[14], s[15])
    for n in range(BONES - 1):
        b = BONES - 1 - n  # children come after their parents
        a = body.parent[b]
        angular[e, a] = angular[e, a] + angular[e, b] + wp.cross(position[e, b] - position[e, a], linear[e, b])
        linear[e, a] = linear[e, a] + linear[e, b]
        set_part(momentum, e, 3 + 3 * b, angular[e, b])
    set_part(momentum, e, 0, linear[e, 0])
    set_part(momentum, e, 3, angular[e, 0])


@wp.kernel
def add_change(change: wp.array2d(dtype=float), q: wp.array2d(dtype=float)):
    """``q += change``."""
    e, i = wp.tid()
    q[e, i] = q[e, i] + change[e, i]


@wp.kernel
def torque_impulse(
    body: Body,
    dt: float,
    rotation: wp.array2d(dtype=wp.quat),
    target: wp.array2d(dtype=wp.quat),
    stiffness: wp.array2d(dtype=float),
    damping: wp.array2d(dtype=float),
    torque: wp.array2d(dtype=wp.vec3),
    q: wp.array2d(dtype=float),
    # out
    impulse: wp.array2d(dtype=float),
):
    """``dt (K e - (D + dt K) qdot + tau)`` of every joint but the pelvis; launched over ``(num_envs, bones)``.

    ``target`` are local rotations, ``torque`` [N m] in the world's axes.
    """
    e, c = wp.tid()
    if c == 0:
        set_part(impulse, e, 0, wp.vec3(0.0))
        set_part(impulse, e, 3, wp.vec3(0.0))
        return
    r = row(e, stiffness.shape[0])
    K = stiffness[r, c]
    above = rotation[e, body.parent[c]]
    error = quat_log(target[e, c] * wp.quat_inverse(wp.quat_inverse(above) * rotation[e, c]))
    push = K * wp.quat_rotate(above, error) - (damping[r, c] + dt * K) * joint_part(q, e, c) + torque[e, c]
    set_part(impulse, e, 3 + 3 * c, dt * push)


@wp.kernel
def balance(
    position: wp.array2d(dtype=wp.vec3),
    bones: wp.array2d(dtype=vec16),
    field: wp.array2d(dtype=vec8),
    # in and out
    change: wp.array2d(dtype=float),
):
    """Take the body's rigid motion out of a change of the joints' velocities, whose motion of the bones is ``field``.

    The blend of the bones' motions has the momenta of the bones' own sums, because weights add up to one.
    """
    e = wp.tid()
    m = float(0.0)
    first = wp.vec3()
    I = wp.mat33()
    P = wp.vec3()
    L = wp.vec3()
    for b in range(BONES):
        s = bones[e, b]
        arm = position[e, b] - position[e, 0]
        d = wp.vec3(s[1], s[2], s[3])  # first moment about the joint, as are the others
        w = wp.vec3(field[e, b][3], field[e, b][4], field[e, b][5])
        v = wp.vec3(field[e, b][0], field[e, b][1], field[e, b][2]) + wp.cross(w, arm)  # at the joint
        # fmt: off
        second = wp.mat33(
            s[7], s[12], s[11],
            s[12], s[8], s[10],
            s[11], s[10], s[9],
        )
        # fmt: on
        inertia = wp.diag(wp.vec3(wp.trace(second))) - second
        p = s[0] * v + wp.cross(w, d)
        P += p
        L += wp.cross(d, v) + inertia * w + wp.cross(arm, p)
        m += s[0]
        first += d + s[0] * arm
        I += inertia + s[0] * (wp.dot(arm, arm) * I3 - wp.outer(arm, arm))
        I += 2.0 * wp.dot(d, arm) * I3 - wp.outer(d, arm) - wp.outer(arm, d)
    center = first / m
    W = spin_of(I - point_inertia(m, center), L - wp.cross(center, P))
    V = P / m - wp.cross(W, center)
    for i in range(3):
        change[e, i] = change[e, i] - V[i]
        change[e, 3 + i] = change[e, 3 + i] - W[i]


@wp.kernel
def implicit_diagonal(
    dt: float, stiffness: wp.array2d(dtype=float), damping: wp.array2d(dtype=float), diagonal: wp.array2d(dtype=float)
):
    """``dt D + dt^2 K``; launched over ``(rows, bones)``."""
    r, c = wp.tid()
    value = wp.where(c > 0, dt * damping[r, c] + dt * dt * stiffness[r, c], 0.0)
    set_part(diagonal, r, 3 + 3 * c, wp.vec3(value))


class ArticulatedBody:
    """Joints of one avatar in every environment, and what moves them.

    Attributes:
        rotation, position: pose of the bones in the world, ``(num_envs, 22)`` quaternions and [m].
        velocity: generalised velocity, ``(num_envs, 69)``: the pelvis' [m/s], then spins of the joints [rad/s].
        target: local rotations to which the springs pull, ``(num_envs, 22)``.
        torque: torques on the joints, ``(num_envs, 22)`` vectors in the world's axes [N m]; that of the pelvis is none.
        stiffness, damping: of the springs, ``(1 or num_envs, 22)`` [N m/rad, N m s/rad].
        mass: the mass matrix, ``(num_envs, 69, 69)``.
    """

    def __init__(
        self, points: BodyPoints, body: Body, model: Model, stiffness: np.ndarray, damping: np.ndarray
    ) -> None:
        """Allocate; :meth:`record_refresh` must run before anything else.

        Args:
            points: the body as its drive was built from it.
            body: the same on the device.
            model: of the world.
            stiffness: of the joints, shape ``(1 or num_envs, 22)`` [N m/rad].
            damping: likewise [N m s/rad].

        Raises:
            ValueError: a stiffness or damping is negative or not finite, or the shape is another one.
        """
        for name, value in (("stiffness", stiffness), ("damping", damping)):
            if value.shape not in ((1, NUM_JOINTS), (model.num_envs, NUM_JOINTS)):
                raise ValueError(f"{name} has shape {value.shape}, expected (1 or {model.num_envs}, {NUM_JOINTS})")
            if not (np.isfinite(value).all() and (value >= 0.0).all()):
                raise ValueError(f"{name} must be finite and not negative, its least is {value.min():g}")
        n, device = model.num_envs, model.device
        self.body, self.model, self.threads = body, model, warp_threads(device)
        self.pairs = build_pairs(points, device)
        self.stiffness, self.damping = (
            wp.array(value.astype(np.float32), dtype=float, device=device) for value in (stiffness, damping)
        )

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        bones = (n, NUM_JOINTS)
        self.rotation, self.target = zeros(bones, wp.quat), zeros(bones, wp.quat)
        self.target.fill_(wp.quat_identity())
        self.position, self.torque = zeros(bones, wp.vec3), zeros(bones, wp.vec3)
        self.velocity, self.mass = zeros((n, NUM_DOF), float), zeros((n, NUM_DOF, NUM_DOF), float)
        self._factor, self._driven = zeros(self.mass.shape, float), zeros(self.mass.shape, float)
        self._none, self._diagonal = zeros((1, NUM_DOF), float), zeros((len(stiffness), NUM_DOF), float)
        self._right, self._change = zeros((n, NUM_DOF), float), zeros((n, NUM_DOF), float)
        self._taken, self._moving = zeros(bones, vec8), zeros(bones, vec8)
        self._linear, self._angular = zeros(bones, wp.vec3), zeros(bones, wp.vec3)
        self._displacement = zeros((n, model.num_particles), wp.vec3)
        self._chunks, self._bones = zeros((n, body.chunk_bone.shape[0]), vec16), zeros(bones, vec16)
        self._pair_sums = zeros((n, len(self.pairs.entry_start) - 1), vec12)
        self._pair_moments = zeros((n, NUM_JOINTS * NUM_JOINTS), vec16)

    def record_refresh(self, program: Program, state: State, fit: bool = True) -> None:
        """Append: fit the pose to the particles (``fit``), and build the mass matrix where they are.

        The total velocity of every particle stays as it is. The pose can be fitted once there is a mass matrix.
        """
        n = self.model.num_envs
        if fit:
            pose = [self.rotation, self.position]
            program.launch(find_displacement, (n, self.body.count), [self.body, state.x, *pose], [self._displacement])
            self._record_share(program, state, self._displacement)
            program.launch(spread_motion, n, [self.body, self.position, self._change], [self._taken])
            program.launch(move_joints, n, [self.body, 1.0, self._taken], pose)
        self._record_mass(program, state)
        self._record_hand_back(program, state)

    def _record_hand_back(self, program: Program, state: State) -> None:
        """Append: ``J qdot`` where the particles and the pose are now; the change goes to the physical velocity."""
        n = self.model.num_envs
        program.launch(spread_motion, n, [self.body, self.position, self.velocity], [self._moving])
        inputs = [self.body, state.x, self.position, self._moving, state.failure]
        program.launch(hand_back, (n, self.body.count), inputs, [state.u, state.vk])

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
        gains = [m.step.dt, self.stiffness, self.damping]
        program.launch(implicit_diagonal, self.stiffness.shape, gains, [self._diagonal])
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

    def record_substep(self, program: Program, state: State) -> None:
        """Append what the joints do before an MPM substep: take over, act, and move the pose on."""
        n, dt = self.model.num_envs, self.model.step.dt
        self._record_hand_back(program, state)
        self._record_share(program, state, state.u)
        program.launch(spread_motion, n, [self.body, self.position, self._change], [self._taken])
        program.launch(add_change, (n, NUM_DOF), [self._change], [self.velocity])
        program.launch(
            torque_impulse,
            (n, NUM_JOINTS),
            [self.body, dt, self.rotation, self.target, self.stiffness, self.damping, self.torque, self.velocity],
            [self._right],
        )
        program.launch(solve, (n, self.threads), [self._driven, self._right, self.threads], [self._change])
        program.launch(spread_motion, n, [self.body, self.position, self._change], [self._moving])
        program.launch(balance, n, [self.position, self._bones, self._moving], [self._change])
        program.launch(add_change, (n, NUM_DOF), [self._change], [self.velocity])
        program.launch(spread_motion, n, [self.body, self.position, self.velocity], [self._moving])
        inputs = [self.body, state.x, self.position, self._taken, self._moving, state.failure]
        program.launch(take_over, (n, self.body.count), inputs, [state.u, state.vk])
        program.launch(move_joints, n, [self.body, dt, self._moving], [self.rotation, self.position])
