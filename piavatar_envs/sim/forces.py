"""External forces on bones and props, each for a number of control steps.

A force ``F`` is constant in the world and acts at a point that moves with its target. In every substep ``dt`` it gives
the impulse ``F dt``:

- to a prop, or a bone under pose control, as the rigid acceleration of the matter that the target moves::

      u_p += w_p dt (F / m + alpha x (x_p - c)),   I alpha = r x F,

  with the target's weight ``w_p`` in a particle (1 in a prop), its mass ``m = sum w_p m_p``, centre of mass ``c`` and
  inertia ``I`` about it, and the arm ``r`` from there to the point. Summed with ``m_p``, this has exactly the momentum
  ``F dt`` and the angular momentum ``r x F dt`` about ``c``;
- to a bone under torque control as the generalised impulse ``J_b^T F dt`` with the Jacobian of the point: joint ``c``
  that carries the bone gets ``(x - p_c) x F dt``, the pelvis ``F dt``. It joins the impulses that the joints solve for
  (:func:`~piavatar_envs.avatar.torque_control.stages.apply_torques`), so that springs respond within the substep and
  carry the moment of a static load.

An environment has a fixed number of slots. No launch of this is recorded before the first force, see
:meth:`~piavatar_envs.envs.batch_env.BatchEnv.enable_forces`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS
from piavatar_envs.avatar.controller import Controller
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.skinning import unpack
from piavatar_envs.avatar.torque_control.bone_contact import moves_bone
from piavatar_envs.avatar.torque_control.joint_motion import set_triple
from piavatar_envs.avatar.tracking import fit_moments, moments_of, spin_of
from piavatar_envs.avatar.types import Body, Pose
from piavatar_envs.core.arrays import vec16
from piavatar_envs.core.cuda_intrinsics import (
    BLOCK,
    first_particle,
    particle_rounds,
    particle_threads,
    sum_threads16,
    threads_of_environment,
    warp_threads,
)
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import DECOUPLING, FAILURE_FORCE, Model, Particles, State, row
from piavatar_envs.sim.props import PropSet

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Most forces that act at the same time in an environment.
SLOTS = 32
_SLOTS, _FORCE = wp.constant(SLOTS), wp.constant(FAILURE_FORCE)
_JOINTS = wp.constant(NUM_JOINTS)
#: Entries of a chunk of a target's particle list, which a warp sums on a GPU.
CHUNK = 256


@wp.struct
class Slots:
    """Forces of every environment, ``(num_envs, SLOTS)``."""

    remaining: wp.array2d(dtype=int)  # control steps left; 0: the slot is free
    target: wp.array2d(dtype=int)  # bone ``NUM_JOINTS * avatar + b``, or after all bones a prop
    force: wp.array2d(dtype=wp.vec3)  # in the world [N]
    point: wp.array2d(dtype=wp.vec3)  # where it acts: from the bone's joint or the prop's centre, in its frame [m]


@wp.struct
class Call:
    """Arguments of a call of :meth:`Forces.add`, ``(num_envs,)``."""

    mask: wp.array(dtype=wp.bool)  # environments in which the force acts
    force: wp.array(dtype=wp.vec3)  # in the world [N]
    point: wp.array(dtype=wp.vec3)  # in the world [m]


@wp.struct
class Targets:
    """Particles of all targets: lists in chunks, as those of a body, and the targets of each particle."""

    start: wp.array(dtype=int)  # (targets + 1,) target t has the chunks start[t] : start[t + 1]
    of_chunk: wp.array(dtype=int)  # (chunks,) target of a chunk
    entry_start: wp.array(dtype=int)  # (chunks + 1,)
    entry: wp.array(dtype=int)  # particle
    weight: wp.array(dtype=float)  # of the target in it
    own: wp.array(dtype=wp.vec4i)  # (num_particles,) targets that move a particle
    own_weight: wp.array(dtype=wp.vec4)  # their weights, zeros last


@wp.struct
class Fields:
    """Rigid accelerations over matter in a substep, ``(num_envs, SLOTS)``."""

    held: wp.array(dtype=int)  # (targets,) 1 if the joints of an articulated body take the target's force instead
    at: wp.array2d(dtype=wp.vec3)  # where the force acts at the start of a control step [m]
    arm: wp.array2d(dtype=wp.vec3)  # from the centre of mass to the point [m]
    center: wp.array2d(dtype=wp.vec3)  # centre of mass [m]
    velocity: wp.array2d(dtype=wp.vec3)  # velocity change of the centre [m/s]
    spin: wp.array2d(dtype=wp.vec3)  # change of the angular velocity [rad/s]
    moments: wp.array2d(dtype=vec16)  # (num_envs, chunks)


@dataclass(frozen=True)
class Target:
    """Bone or prop that a force acts on.

    Attributes:
        index: as in :class:`Slots`.
        frame: of its kind, ``(num_envs, columns)``.
        column: its column there.
        body: of a bone, whose centre of mass it has; an empty one of a prop, whose frame begins there.
        is_prop: whether it is a prop.
    """

    index: int
    frame: Pose
    column: int
    body: Body
    is_prop: bool


class Receivers:
    """Bones and props of a world, on which external forces can act.

    Attributes:
        avatars, controllers, props: of the world.
        frames: of bones and props, by the index of the first target in each.
        jointed: whether the joints of an avatar take the forces on its bones.
    """

    def __init__(self, avatars: Sequence[Avatar], controllers: Sequence[Controller], props: PropSet) -> None:
        self.avatars, self.controllers, self.props = tuple(avatars), tuple(controllers), props
        self.jointed = [controller.joints is not None for controller in controllers]
        self.frames = {
            NUM_JOINTS * index: controller.joints.pose
            if controller.joints is not None
            else make_struct(Pose, rotation=avatar.tracked.rotation, position=avatar.tracked.position)
            for index, (avatar, controller) in enumerate(zip(avatars, controllers, strict=True))
        }
        if props:
            self.frames[self.first_prop] = make_struct(
                Pose, rotation=props.state.rotation, position=props.state.position
            )

    @property
    def first_prop(self) -> int:
        """Index of the first prop among the targets."""
        return NUM_JOINTS * len(self.avatars)

    def find(self, name: str, agent: int | None = None) -> Target:
        """Return the bone or prop ``name``.

        Args:
            name: of a bone, which is that of its joint, or of a prop.
            agent: whose bone it is; None for a prop, or if there is only one avatar.

        Raises:
            ValueError: there is no such target, or it is unclear whose bone is meant.
        """
        if name in self.props.names and agent is None:
            column = self.props.index(name)
            return Target(self.first_prop + column, self.frames[self.first_prop], column, Body(), is_prop=True)
        if name not in JOINT_NAMES:
            props = ", ".join(self.props.names)
            choices = f"a bone ({', '.join(JOINT_NAMES)})" + (f" or, without agent, a prop ({props})" if props else "")
            raise ValueError(f"there is no target {name!r}; use {choices}")
        if agent is None and len(self.avatars) > 1:
            raise ValueError(f"target {name!r} is a bone of {len(self.avatars)} agents; give the name of one as agent")
        first, bone = NUM_JOINTS * (agent or 0), JOINT_NAMES.index(name)
        return Target(first + bone, self.frames[first], bone, self.avatars[agent or 0].body, is_prop=False)

    def weights(self, num_particles: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the targets that move each particle, and their weights, zero where there are fewer; ``(P, 4)``."""
        own, share = np.zeros((num_particles, 4), np.int32), np.zeros((num_particles, 4), np.float32)
        for index, avatar in enumerate(self.avatars):
            particles = slice(avatar.body.first, avatar.body.first + avatar.body.count)
            bones, share[particles] = unpack(avatar.body.skin)
            own[particles] = NUM_JOINTS * index + bones
        for index, prop in enumerate(self.props.props):
            particles = slice(prop.first, prop.first + prop.count)
            own[particles, 0], share[particles, 0] = self.first_prop + index, 1.0
        return own, share


def list_targets(own: np.ndarray, share: np.ndarray, count: int, device: str) -> Targets:
    """Upload the particles of ``count`` targets, from the targets of each particle and their weights."""
    start, of_chunk, entry_start, entries, weights = [0], [], [0], [], []
    for target in range(count):
        particle, column = np.nonzero((own == target) & (share > 0.0))
        for begin in range(0, len(particle), CHUNK):
            inside = slice(begin, begin + CHUNK)
            entries.append(particle[inside])
            weights.append(share[particle[inside], column[inside]])
            entry_start.append(entry_start[-1] + len(entries[-1]))
            of_chunk.append(target)
        start.append(len(of_chunk))
    numbers = {"start": start, "of_chunk": of_chunk, "entry_start": entry_start, "entry": np.concatenate(entries)}
    return make_struct(
        Targets,
        **{name: wp.array(np.array(value, np.int32), dtype=int, device=device) for name, value in numbers.items()},
        weight=wp.array(np.concatenate(weights), dtype=float, device=device),
        own=wp.array(own, dtype=wp.vec4i, device=device),
        own_weight=wp.array(share, dtype=wp.vec4, device=device),
    )


class Forces:
    """External forces in every environment of a world.

    Attributes:
        receivers: what they can act on.
        slots: forces that act.
        call: arguments of the next :meth:`add`.
    """

    def __init__(self, model: Model, receivers: Receivers) -> None:
        """Allocate slots without forces; control steps that are recorded from now on apply them."""
        n, device = model.num_envs, model.device
        self.model, self.receivers, self._threads = model, receivers, warp_threads(device)
        self.slots = make_struct(Slots, **_columns(Slots.vars, n, SLOTS, device))
        self._used = wp.zeros(n, dtype=int, device=device)
        self.call = make_struct(
            Call,
            mask=wp.zeros(n, dtype=wp.bool, device=device),
            force=wp.zeros(n, dtype=wp.vec3, device=device),
            point=wp.zeros(n, dtype=wp.vec3, device=device),
        )
        self._push = {
            index: controller.joints.allocate_push()
            for index, controller in enumerate(receivers.controllers)
            if controller.joints is not None
        }
        count = receivers.first_prop + len(receivers.props)
        self._targets = list_targets(*receivers.weights(model.num_particles), count, device)
        held = np.zeros(count, np.int32)
        held[: receivers.first_prop] = np.repeat(receivers.jointed, NUM_JOINTS)
        self._any_field = not held.all()
        own = {name: kind for name, kind in Fields.vars.items() if name not in ("held", "moments")}
        self._fields = make_struct(
            Fields,
            held=wp.array(held, dtype=int, device=device),
            moments=wp.zeros((n, self._targets.of_chunk.shape[0]), dtype=vec16, device=device),
            **_columns(own, n, SLOTS, device),
        )

    def add(self, target: Target, steps: int, at_point: bool, failure: wp.array) -> None:
        """Let the force of :attr:`call` act in the masked environments, from the next control step on.

        Nothing leaves the device.

        Args:
            target: what it acts on.
            steps: number of control steps.
            at_point: whether it acts at the point of the call; otherwise at the target's centre of mass, a bone's at
                rest.
            failure: of the environments. Where force or point are not finite, or all slots are taken, it gets
                :data:`~piavatar_envs.mpm.types.FAILURE_FORCE`.
        """
        inputs = [self.call, target.body, target.frame, target.column, int(target.is_prop), int(at_point)]
        inputs += [target.index, min(steps, 2**31 - 1)]
        wp.launch(add_force, self.model.num_envs, inputs, [self.slots, failure], device=self.model.device)

    def record_begin(self, graph: LaunchGraph) -> None:
        """Append the start of a control step: find the points of forces on matter, from the tracked targets."""
        graph.launch(find_used_slots, self.model.num_envs, [self.slots.remaining], [self._used])
        for first, frame in self.receivers.frames.items():
            if first // NUM_JOINTS not in self._push:
                graph.launch(place_points, (self.model.num_envs, SLOTS), [self.slots, first, frame], [self._fields])

    def record_before_controllers(self, graph: LaunchGraph, state: State) -> None:
        """Append the impulses that the joints under torque control get in this substep."""
        for index, push in self._push.items():
            first, body = NUM_JOINTS * index, self.receivers.avatars[index].body
            pose, dt = self.receivers.frames[first], self.model.step.dt
            inputs = [self.slots, self._used, body, first, dt, pose, state.failure]
            graph.launch(push_joints, (self.model.num_envs, 1 + NUM_JOINTS), inputs, [push])

    def record_before_substep(self, graph: LaunchGraph, state: State, step: int) -> None:
        """Append the velocity that forces on matter give in this substep, after the controllers have written theirs."""
        if not self._any_field:
            return
        model, threads, common = self.model, self._threads, [self.slots, self._used, self._targets]
        n, chunks = model.num_envs, self._targets.of_chunk.shape[0]
        # a model of one velocity has the prescribed part in it
        prescribed = 0.0 if model.step.decoupling in (DECOUPLING["paper"], DECOUPLING["none"]) else 1.0
        moving = [state.x, state.u, state.vk, prescribed]
        inputs = [*common, self._fields.held, model.particles, *moving, state.failure, threads]
        graph.launch(sum_targets, (n, chunks, threads), inputs, [self._fields.moments], block_dim=threads)
        inputs = [*common, model.step.dt, step, state.x, state.failure]
        graph.launch(solve_fields, (n, SLOTS), inputs, [self._fields])
        rounds = particle_rounds(model.device, n * model.num_particles)
        points = (n, particle_threads(model.device, model.num_particles, rounds))
        inputs = [*common, self._fields, state.x, state.failure]
        graph.launch(accelerate, points, inputs, [state.u], block_dim=BLOCK)

    def record_end(self, graph: LaunchGraph, state: State) -> None:
        """Append the end of a control step: count it, except where an environment has failed."""
        graph.launch(count_step, (self.model.num_envs, SLOTS), [state.failure], [self.slots.remaining])

    def record_reset(self, graph: LaunchGraph, mask: wp.array) -> None:
        """Append the end of all forces in the masked environments."""
        graph.launch(end_forces, (self.model.num_envs, SLOTS), [mask], [self.slots.remaining])

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint, by name."""
        return {f"forces.{name}": getattr(self.slots, name) for name in Slots.vars}


def _columns(declared: Mapping[str, Any], num_envs: int, columns: int, device: str) -> dict[str, wp.array]:
    """Return zeroed arrays ``(num_envs, columns)`` of the types of a struct's members."""
    return {
        name: wp.zeros((num_envs, columns), dtype=member.type.dtype, device=device) for name, member in declared.items()
    }


@wp.kernel
def add_force(
    call: Call,
    body: Body,
    frame: Pose,
    column: int,
    is_prop: int,
    at_point: int,
    target: int,
    steps: int,
    # in and out
    slots: Slots,
    failure: wp.array(dtype=int),
):
    """Write the force of a call to the first free slot of the masked environments; over ``(num_envs,)``."""
    e = wp.tid()
    if not call.mask[e] or failure[e] != 0:
        return
    local = wp.vec3()
    if at_point != 0:
        local = wp.quat_rotate_inv(frame.rotation[e, column], call.point[e] - frame.position[e, column])
    elif is_prop == 0:
        local = body.rest_center[row(e, body.rest_center.shape[0]), column]
        local -= body.rest_joint[row(e, body.rest_joint.shape[0]), column]
    free = int(_SLOTS)
    for back in range(_SLOTS):
        s = _SLOTS - 1 - back
        if slots.remaining[e, s] <= 0:
            free = s
    if free == _SLOTS or not (wp.isfinite(call.force[e]) and wp.isfinite(local)):
        failure[e] = failure[e] | _FORCE
        return
    slots.remaining[e, free] = steps
    slots.target[e, free] = target
    slots.force[e, free] = call.force[e]
    slots.point[e, free] = local


@wp.func
def acts_on(slots: Slots, e: int, s: int, target: int):
    """Return whether the force in slot ``s`` acts on ``target``."""
    return slots.remaining[e, s] > 0 and slots.target[e, s] == target


@wp.func
def acts_on_matter(slots: Slots, held: wp.array(dtype=int), e: int, s: int):
    """Return whether slot ``s`` has a force that accelerates matter."""
    t = slots.target[e, s]
    if slots.remaining[e, s] <= 0 or t < 0 or t >= held.shape[0]:
        return False
    return held[t] == 0


@wp.kernel
def find_used_slots(
    remaining: wp.array2d(dtype=int),
    # out
    used: wp.array(dtype=int),
):
    """Count the slots up to the last one with a force, which every substep then reads; over ``(num_envs,)``."""
    e = wp.tid()
    last = int(0)
    for s in range(_SLOTS):
        if remaining[e, s] > 0:
            last = s + 1
    used[e] = last


@wp.kernel
def place_points(
    slots: Slots,
    first: int,
    frame: Pose,
    # out
    fields: Fields,
):
    """Compute where forces act whose targets, from index ``first`` on, are in ``frame``; over ``(num_envs, SLOTS)``."""
    e, s = wp.tid()
    column = slots.target[e, s] - first
    if slots.remaining[e, s] > 0 and column >= 0 and column < frame.rotation.shape[1]:
        point = wp.quat_rotate(frame.rotation[e, column], slots.point[e, s])
        fields.at[e, s] = frame.position[e, column] + point


@wp.kernel
def push_joints(
    slots: Slots,
    used: wp.array(dtype=int),
    body: Body,
    first: int,
    dt: float,
    pose: Pose,
    failure: wp.array(dtype=int),
    # out
    push: wp.array2d(dtype=float),
):
    """Sum the generalised impulses ``J_b^T F dt`` of the forces on a body's bones; over ``(num_envs, 1 + bones)``.

    The body's targets begin at index ``first``. Row 0 of the second dimension is the pelvis' position, joints follow.
    """
    e, n = wp.tid()
    if failure[e] != 0:
        return
    total = wp.vec3()
    for s in range(used[e]):
        b = slots.target[e, s] - first
        if slots.remaining[e, s] > 0 and b >= 0 and b < _JOINTS:
            if n == 0:
                total += slots.force[e, s]
            else:
                at = pose.position[e, b] + wp.quat_rotate(pose.rotation[e, b], slots.point[e, s])
                total += moves_bone(body, n - 1, b) * wp.cross(at - pose.position[e, n - 1], slots.force[e, s])
    set_triple(push, e, 3 * n, dt * total)


@wp.func
def origin_of(targets: Targets, x: wp.array2d(dtype=wp.vec3), e: int, target: int):
    """Return the position of a target's first particle, about which sums lose few digits [m]."""
    return x[e, targets.entry[targets.entry_start[targets.start[target]]]]


@wp.kernel
def sum_targets(
    slots: Slots,
    used: wp.array(dtype=int),
    targets: Targets,
    held: wp.array(dtype=int),
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    prescribed: float,
    failure: wp.array(dtype=int),
    threads: int,
    # out
    moments: wp.array2d(dtype=vec16),
):
    """Sum the moments of the chunks of targets that forces act on, with the total velocity ``u + prescribed vk``.

    Over ``(num_envs, chunks, threads)``, a warp a chunk on a GPU.
    """
    e, c, thread = wp.tid()
    count = used[e]
    if count == 0 or failure[e] != 0:
        return
    target = targets.of_chunk[c]
    if held[target] != 0:
        return
    wanted = bool(False)
    for s in range(count):
        if acts_on(slots, e, s, target):
            wanted = True
    if not wanted:
        return
    r = row(e, particles.mass.shape[0])
    origin = origin_of(targets, x, e, target)
    total = vec16()
    for n in range(targets.entry_start[c] + thread, targets.entry_start[c + 1], threads):
        p = targets.entry[n]
        total += moments_of(targets.weight[n] * particles.mass[r, p], x[e, p] - origin, u[e, p] + prescribed * vk[e, p])
    total = sum_threads16(total, threads)
    if thread == 0:
        moments[e, c] = total


@wp.kernel
def solve_fields(
    slots: Slots,
    used: wp.array(dtype=int),
    targets: Targets,
    dt: float,
    step: int,
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    fields: Fields,
):
    """Solve for the rigid acceleration by each force on matter in substep ``step``; over ``(num_envs, SLOTS)``.

    Then the arm turns with the target, for the next substep.
    """
    e, i = wp.tid()
    if i >= used[e] or failure[e] != 0:
        return
    if not acts_on_matter(slots, fields.held, e, i):
        return
    target = slots.target[e, i]
    s = vec16()
    for c in range(targets.start[target], targets.start[target + 1]):
        s += fields.moments[e, c]
    motion = fit_moments(s)
    center = origin_of(targets, x, e, target) + motion.center
    arm = fields.arm[e, i]
    if step == 0:
        arm = fields.at[e, i] - center
    fields.center[e, i] = center
    fields.velocity[e, i] = dt / motion.mass * slots.force[e, i]
    spin = spin_of(motion.inertia, dt * wp.cross(arm, slots.force[e, i]))
    fields.spin[e, i] = spin
    fields.arm[e, i] = wp.quat_rotate(quat_exp(dt * (motion.spin + spin)), arm)


@wp.kernel(launch_bounds=(BLOCK, 8))
def accelerate(
    slots: Slots,
    used: wp.array(dtype=int),
    targets: Targets,
    fields: Fields,
    x: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
):
    """Add the rigid accelerations to the particles' velocities, over ``(num_envs, particle_threads)``."""
    i, _ = wp.tid()
    threads = threads_of_environment(x.shape[0])
    own = first_particle(i, threads)
    e = own[0]
    count = used[e]
    if count == 0 or failure[e] != 0:
        return
    for s in range(count):
        if acts_on_matter(slots, fields.held, e, s):
            target = slots.target[e, s]
            p = own[1]
            while p < x.shape[1]:
                weight = float(0.0)
                for k in range(4):
                    if targets.own[p][k] == target:
                        weight += targets.own_weight[p][k]
                if weight > 0.0:
                    arm = x[e, p] - fields.center[e, s]
                    u[e, p] = u[e, p] + weight * (fields.velocity[e, s] + wp.cross(fields.spin[e, s], arm))
                p += threads


@wp.kernel
def count_step(failure: wp.array(dtype=int), remaining: wp.array2d(dtype=int)):
    """Subtract a control step from the forces of environments that have not failed; over ``(num_envs, SLOTS)``."""
    e, s = wp.tid()
    if failure[e] == 0:
        remaining[e, s] = wp.max(remaining[e, s] - 1, 0)


@wp.kernel
def end_forces(mask: wp.array(dtype=wp.bool), remaining: wp.array2d(dtype=int)):
    """End the forces of the masked environments; over ``(num_envs, SLOTS)``."""
    e, s = wp.tid()
    if mask[e]:
        remaining[e, s] = 0
