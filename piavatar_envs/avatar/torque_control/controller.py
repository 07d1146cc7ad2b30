"""Articulated momentum projection: joints that move under torques, in a body of flesh that moves with them.

The velocity of a particle is ``v = u + J qdot``: what the joints cannot do, and what they do, with the skinning
Jacobian ``J`` at the particles. Every substep gives the joints what they can take over of the physical velocity, and
lets torques act on them:

    M dq = J^T m u,   qdot <- qdot + dq,   u <- u - J dq,   c <- c + dq
    (M + A) d = dt (K e + tau) + J_b^T p - A (qdot + c),   A = dt D + dt^2 K
    qdot <- qdot + d + c,   u <- u - J c,   vk = J qdot

``K e`` is a spring towards a target pose and ``D`` a damper, both implicit in time, ``tau`` a torque, a joint each;
``p`` are impulses on points of bones that come to a boundary, see
:mod:`piavatar_envs.avatar.torque_control.bone_contact`. Light joints take over less than all: to the first ``M = J^T m
J`` some inertia is added, which torques are not divided by, see
:func:`piavatar_envs.avatar.torque_control.mass_matrix.grid_inertia`. ``c`` is what all else, contact, weight and
flesh, did to the joints in the last substep, and is expected to do again. The springs take it into account, see
:mod:`piavatar_envs.avatar.torque_control.dynamics`, and so does the split: the joints go on with the velocity that
will be left of their push, and the rest of the push, ``-J c``, waits in ``u`` for what is to stop it. A free limb has
``c = 0``; of one that stands on the ground nothing moves. (All of ``d`` put into ``qdot``, the push of a foot and the
answer of the ground are two large opposite velocities, of which one strains the foot: it is torn to pieces. All of it
put into ``u``, the grid blurs it, and light limbs shake.) If what is expected does not come, ``-J c`` is taken over in
the next substep: nothing is lost.

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
a particle at different places, each turns its own (:func:`piavatar_envs.avatar.torque_control.dynamics.motion_apart`).
So ``vk`` takes particles from their skinned places to their skinned places, however joints turn and bend. The velocity
of a particle stays what it was; what ``vk`` is less is more in ``u``.

Whenever ``J`` has changed, and it does with every move, the change of ``J qdot`` goes to ``u``: these are the
centrifugal forces. They are explicit in time, so light limbs that nothing damps gain a little energy, and a mass matrix
of more than some 5 ms ago makes fast limbs unstable.

The controller takes joint targets or torques and returns forces of muscles. Gravity, the ground and
other bodies act on the whole body, and only torques between its bones act back. An assisting spring may help the
pelvis, as a curriculum: at ``assist`` 1 it nearly holds the pelvis alone, at 0 there is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.device import BodyPoints, partition_body
from piavatar_envs.avatar.body.muscles import (
    FASTEST,
    LOCKED_JOINTS,
    REFERENCE_HEIGHT,
    REFERENCE_MASS,
    Muscles,
    spring_rows,
)
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.avatar.rotation import quat_log
from piavatar_envs.avatar.segment_sums import ALL_WORDS, PARTITION_THREADS, sum_moments, warps_of
from piavatar_envs.avatar.torque_control.bone_contact import Ground
from piavatar_envs.avatar.torque_control.dynamics import (
    UNBOUNDED,
    Springs,
    Target,
    make_strength,
    make_tissue,
    set_triple,
    take_over,
)
from piavatar_envs.avatar.torque_control.flesh_coupling import attach_flesh, put_in_place
from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF, MassMatrix, grid_inertia
from piavatar_envs.avatar.torque_control.stages import MASS_BLOCK, Support, act, begin_substep, build_mass
from piavatar_envs.avatar.torque_control.workspace import TorqueWorkspace
from piavatar_envs.avatar.types import ROOT_RATE, Body, JointState, Pose, allocate
from piavatar_envs.core.cuda_intrinsics import BLOCK, particle_rounds, particle_threads, warp_threads
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import Model, Scratch, State, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


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
            solid: whether bones stop at boundaries, see :mod:`piavatar_envs.avatar.torque_control.bone_contact`.

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
        self.mass = MassMatrix(points, body, model)
        self._inertia = grid_inertia(points, model.grid.dx)
        words = ALL_WORDS * points.num_points if self.threads == 1 else 0
        self._scratch = wp.zeros(words, dtype=float, device=device)
        self.impulse = wp.zeros((n, NUM_DOF), dtype=float, device=device)
        self.support = allocate(Support, n, device)
        self._workspace = self._allocate()
        without, everywhere = np.zeros((NUM_JOINTS, 3)), np.full((NUM_JOINTS, 3), UNBOUNDED)
        self.set_strength(-everywhere, everywhere, 1)
        self.set_tissue(without[:, 0], without[:, 0], -everywhere, everywhere, [])

    def _allocate(self) -> TorqueWorkspace:
        """Return the arrays of a substep."""
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
            linear=rows(3, NUM_JOINTS, wp.vec3),
            angular=rows(3, NUM_JOINTS, wp.vec3),
            shares=rows(3, NUM_DOF),
            touch=rows(3, NUM_DOF),
            whole=NUM_DOF,
            muscle=NUM_DOF,
            left=NUM_DOF,
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
        own = self._workspace.diagonals[: self.model.num_envs]
        own.assign(np.broadcast_to(besides.astype(np.float32), own.shape))

    def record_pose(self, graph: LaunchGraph, state: State) -> None:
        """Append: places and motion of the bones as the joints are now, if something else than a substep moved them."""
        self._record_stage(graph, begin_substep, [self.body], state)

    def record_mass(self, graph: LaunchGraph, state: State) -> None:
        """Append: build the mass matrix where particles and joints are, if no substep does."""
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
        """Append: build the mass matrix from the bones' moments, and what follows from it."""
        self.mass.record_sums(graph, state, self.state.position)
        threads = int(MASS_BLOCK) if self.threads > 1 else 1
        inputs = [self.body, self.mass.pairs, self.model.step.dt, self.springs, self.tissue, state.failure]
        graph.launch(build_mass, (self.model.num_envs, threads), inputs, [self._workspace], block_dim=threads)

    def _record_stage(self, graph: LaunchGraph, stage: wp.Kernel, inputs: list, state: State, *more: Any) -> None:
        """Append what a warp does for an environment."""
        inputs, outputs = [*inputs, state.failure], [*more, self._workspace]
        graph.launch(stage, (self.model.num_envs, self.threads), inputs, outputs, block_dim=self.threads)

    def record_substep(self, graph: LaunchGraph, state: State, scratch: Scratch, step: int) -> None:
        """Append what the joints do before an MPM substep: take over, act, and move the pose on.

        Args:
            graph: records.
            state: of the particles.
            scratch: of the world, whose sensors record what bones meet.
            step: which substep of its control step it is. The first one finds joints wherever they are; all others go
                on from the one before.
        """
        model, w, fit = self.model, self._workspace, self.mass.is_due(step)
        if step == 0:
            self.record_pose(graph, state)
        self._record_pull(graph, state)
        if fit:
            self._record_mass(graph, state)
        inputs = [self.body, model.step.dt, 1.0 / model.control_dt, 3 if fit else 2]
        inputs += [self.target, self.springs, self.tissue, self.strength]
        self._record_stage(graph, act, inputs, state, self._ground(scratch), self.support)
        inputs = [self.body, model.step.dt, state.x, w.pelvis, w.steps, state.failure]
        graph.launch(take_over, self._points, inputs, [state.u, state.kinematic], block_dim=BLOCK)

    def _ground(self, scratch: Scratch) -> Ground:
        """Return the boundaries that bones meet, and the sensors."""
        model = self.model
        return make_struct(
            Ground,
            solid=int(self.solid),
            boundaries=model.boundaries,
            field=model.particles.field,
            subject=model.contact.subject,
            sensors=scratch.sensors,
        )

    def _record_pull(self, graph: LaunchGraph, state: State) -> None:
        """Append the pass over particles that pulls them to the bones, and sums what joints are to take over."""
        block = PARTITION_THREADS if self.threads > 1 else 1
        dim = (self.model.num_envs, self._partitions.start.shape[0] - 1, block)
        inputs = [self.body, self._partitions, self.model.step.dt, self.model.particles.mass]
        inputs += [state.x, self.attachment, state.failure, self._scratch]
        graph.launch(attach_flesh, dim, inputs, [state.u, state.vk, self._workspace], block_dim=PARTITION_THREADS)

    def record_end(self, graph: LaunchGraph, state: State) -> None:
        """Append what ends a control step: firm particles are put into their places on the bones as they are now.

        Blocks of the grid are not marked where they come to: the next control step marks all anew.
        """
        if self.firm.size == 0:
            return
        model, w = self.model, self._workspace
        inputs = [self.body, model.grid, model.boundaries, self.firm, w.place, w.pose.position, state.u, state.vk]
        inputs += [state.failure]
        graph.launch(put_in_place, model.num_envs * self.firm.size, inputs, [state.x, state.C, self.state.slip])


#: Longest substep with joints under torques [s].
LONGEST_SUBSTEP = 0.004
#: Of the assisting spring that turns the pelvis upright [N m/rad].
ASSIST_TORQUE = 1500.0
_FASTEST = wp.constant(FASTEST)
_ASSIST_TORQUE, _ASSIST_RATE = wp.constant(ASSIST_TORQUE), wp.constant(ROOT_RATE)
_HEAD, _FOOT = wp.constant(joint_index("head")), wp.constant(joint_index("left_foot"))


@dataclass(frozen=True, eq=False)
class TorqueControl:
    """Parameters of a torque controller, named like the settings of ``control`` that they follow from.

    Attributes:
        muscles: of the reference adult; those of the body follow from its weight times its height.
        root_assist: of the pelvis at first, 0 to 1.
        flesh_rate: rates of the pulls that hold flesh to bones, shape ``(P,)`` [1/s].
        firm_bones: particles that are put into their places on the bones after every control step, ``(P,)`` bool.
        bone_contact: whether bones stop at boundaries.
    """

    muscles: Muscles
    root_assist: float
    flesh_rate: np.ndarray
    firm_bones: np.ndarray
    bone_contact: bool


@wp.kernel
def set_springs(
    body: Body,
    gains: Springs,
    body_mass: wp.array(dtype=float),
    per_size: float,
    assist: wp.array(dtype=float),
    released: wp.array(dtype=int),
    torque: wp.array2d(dtype=wp.vec3),
    # out
    factor: wp.array(dtype=float),
    springs: Springs,
):
    """Strength and springs of every body, by its weight times its height; over ``(num_envs, 1 + bones)``.

    A muscle that shortens at its greatest speed has no force left: what a torque loses to speed is a damper. The pelvis
    is assisted where it has not been released.
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
    """Set the velocity of the masked joints that reaches the pose ``after`` in a ``time`` [s]; over ``(E, bones)``.

    Joints that only found it in their particles would take it for what the world does to them in every substep.
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


@wp.kernel
def clear_slip(mask: wp.array(dtype=wp.bool), slip: wp.array2d(dtype=wp.vec3)):
    """Clear the slip of the particles of the masked environments."""
    e, p = wp.tid()
    if mask[e]:
        slip[e, p] = wp.vec3(0.0)


class TorqueController:
    """Lets torques act between the bones of one avatar in every environment.

    Attributes:
        avatar: the avatar.
        joints: its articulated body.
        assist: of the pelvis, ``(num_envs,)``, 0 to 1; what is written here holds until it is written again.
        gains: springs and dampers of the reference adult's joints, ``(1, 23)``.
        first: the pose that bodies are on their way to when an episode begins, and reach after a control step: local
            rotations and root, as commands; None where they begin at rest. To be set before a reset is recorded.
    """

    def __init__(self, avatar: Avatar, points: BodyPoints, parameters: TorqueControl) -> None:
        """Allocate.

        Args:
            avatar: the avatar, whose goals the springs pull to.
            points: the body that it was built from.
            parameters: of the joints.
        """
        n, model, muscles = avatar.model.num_envs, avatar.model, parameters.muscles
        self.avatar = avatar
        rows = np.zeros((n, 1 + NUM_JOINTS))
        flesh = parameters.flesh_rate[None], parameters.firm_bones
        self.joints = ArticulatedBody(points, avatar.body, model, rows, rows, *flesh, parameters.bone_contact)
        self.joints.set_strength(muscles.lower, muscles.upper, n)
        ranges = muscles.range_lower, muscles.range_upper
        locked = [joint_index(name) for name in LOCKED_JOINTS]
        self.joints.set_tissue(muscles.tissue_damping, muscles.stop, *ranges, locked)
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
        # the height that goes with the joints' span in the first body
        joints, rest = points.joints[0], points.rest[0]
        span = float(joints[joint_index("head"), 2] - joints[joint_index("left_foot"), 2])
        self._per_size = float(np.ptp(rest[:, 2])) / span / (REFERENCE_MASS * REFERENCE_HEIGHT)
        self.first: tuple[wp.array, wp.array] | None = None
        self._first_pose = allocate(Pose, n, model.device)

    @property
    def state(self) -> JointState:
        """Return the joints' state: all that a checkpoint holds besides :attr:`assist`."""
        return self.joints.state

    @property
    def moves_particles(self) -> bool:
        """Return whether the end of a control step puts firm particles into their places."""
        return self.joints.firm.size > 0

    def release(self, joints: list[int]) -> None:
        """Take the springs from joints, by index, that torques alone shall move."""
        for array in (self.gains.stiffness, self.gains.damping):
            values = array.numpy()
            values[0, [1 + joint for joint in joints]] = 0.0
            array.assign(values)

    def record_reset(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Append: put the joints of the masked environments into the pose in which the avatar has been placed.

        They are at rest, or on their way to :attr:`first`.
        """
        avatar, s = self.avatar, self.state
        n, placed = avatar.model.num_envs, avatar.placed
        outputs = [s.rotation, s.position, s.torque, s.velocity, s.outside]
        graph.launch(reset_joints, (n, 1 + NUM_JOINTS), [mask, placed.rotation, placed.position], outputs)
        graph.launch(clear_slip, s.slip.shape, [mask], [s.slip])
        if self.first:
            avatar.record_still_pose(graph, self.first, self._first_pose)
            avatar.record_set_in_motion(graph, state, mask, self._first_pose)
            inputs = [mask, avatar.body, avatar.model.control_dt, self.joints.pose, self._first_pose]
            graph.launch(set_joints_in_motion, (n, NUM_JOINTS), inputs, [s.velocity])

    def record_begin(self, graph: LaunchGraph) -> None:
        """Append what begins a control step: strength and springs of the bodies as they are."""
        avatar, joints = self.avatar, self.joints
        avatar.record_clear_support(graph)
        inputs = [avatar.body, self.gains, avatar.body_mass, self._per_size, self.assist, avatar.state.released]
        graph.launch(
            set_springs,
            (avatar.model.num_envs, 1 + NUM_JOINTS),
            [*inputs, self.state.torque],
            [joints.strength.factor, joints.springs],
        )

    def record_before_substep(self, graph: LaunchGraph, state: State, scratch: Scratch, step: int) -> None:
        """Append what the joints do before MPM substep ``step`` of a control step."""
        self.joints.record_substep(graph, state, scratch, step)

    def record_end(self, graph: LaunchGraph, state: State) -> None:
        """Append what ends a control step: firm particles are put into their places."""
        self.joints.record_end(graph, state)

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint, by name."""
        return {field.name: getattr(self.state, field.name) for field in fields(self.state)} | {"assist": self.assist}


def checked_assist(share: float | np.ndarray, num_envs: int) -> np.ndarray:
    """Help for the pelvis in every environment, ``(num_envs,)`` float32, from one share or as many.

    Raises:
        ValueError: it is out of range, or of another shape.
    """
    shares = np.asarray(share, np.float32)
    if shares.shape not in ((), (num_envs,)) or not ((shares >= 0.0) & (shares <= 1.0)).all():
        raise ValueError(f"root_assist={share} must be in [0, 1], one number or {num_envs}")
    return np.broadcast_to(shares, num_envs).copy()
