"""Bone contact under pose control: colliders stop bones by impulses, where they would part the flesh and pass.

Contact on the grid and at thin colliders stops particles, each by its own nearest face. A pole that is driven into a
limb so parts its particles and comes out behind it: the flesh of a limb weighs little, and no bone resists. Therefore
the deepest point of each bone in a collider, see :mod:`piavatar_envs.avatar.bone_hulls`, may approach it in a substep
by no more than the distance to a thin layer, as under torque control. Commanded and physical motion count together.

In the impulse that stops it by Coulomb's law a bone is a free rigid body with the mass and inertia of its flesh; flesh
and tone carry it on to the other bones. The flesh takes the change of motion by its skinning weights, which gives it
exactly the impulse and its moment, bone by bone.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, body_part_of_joint, joint_index
from piavatar_envs.avatar.bone_hulls import NOWHERE, BoneHulls
from piavatar_envs.avatar.pose_control.kernels import bone_change
from piavatar_envs.avatar.pose_control.root import is_free
from piavatar_envs.avatar.skinning import SPIN, STEP, TURN, VELOCITY, blend_changes, motion_at
from piavatar_envs.avatar.torque_control.bone_contact import TOLERANCE, Touch, least_speed, stopping_impulse
from piavatar_envs.avatar.tracking import point_inertia, spin_of, track_bones
from piavatar_envs.avatar.types import Body, Pose, PoseControl, PoseWorkspace, RemovedMotion, RigidFits, vec44
from piavatar_envs.core.arrays import store_vector, vec8, vector_at
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.colliders import signed_distance, surface_velocity
from piavatar_envs.mpm.contact_sensors import add_impulse, boundary_entry, moment_entry
from piavatar_envs.mpm.types import Boundaries, Contact, Model, Scratch, Sensors, State, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Most impulses on a bone in a substep.
MOST_STOPS = wp.constant(8)


class PoseBoneContact:
    """Contact of the bones of one avatar under pose control with colliders that are not planes.

    Attributes:
        used: whether there are such colliders; otherwise nothing is recorded.
    """

    def __init__(self, body: Body, control: PoseControl, model: Model) -> None:
        """Allocate the arrays of a substep."""
        self._body, self._control, self._model = body, control, model
        self._hulls = BoneHulls(body, model)
        self.used = self._hulls.deepest.size > 0
        n, bones, device = model.num_envs, int(self.used) * body.parent.shape[0], model.device
        rows = {"rotation": wp.quat, "position": wp.vec3}
        self._pose = make_struct(Pose, **{k: wp.zeros((n, bones), dtype=t, device=device) for k, t in rows.items()})
        self._velocity = wp.zeros((n, bones), dtype=wp.vec3, device=device)
        self._hit = wp.zeros((n, bones), dtype=vec8, device=device)
        roots = [joint_index(names[0]) for names in BODY_PARTS.values()]
        self._parts = [wp.array(of, dtype=int, device=device) for of in (body_part_of_joint(), roots)]

    def record(self, graph: LaunchGraph, state: State, scratch: Scratch, w: PoseWorkspace, released: wp.array) -> None:
        """Append the contact of a substep, after the stages in which the controller has used ``w``."""
        if not self.used:
            return
        body, model, s = self._body, self._model, state
        bones = self._hit.shape
        outputs = [self._pose.rotation, self._pose.position, self._velocity]
        graph.launch(track_bones, bones, [body, s.x, s.u, s.vk, s.failure], outputs)
        self._hulls.record(graph, self._pose, s.failure)
        inputs = [body, self._control, model.boundaries, model.contact, model.particles.field, *self._parts]
        inputs += [
            self._pose.position,
            self._hulls.deepest,
            w.record,
            w.bones,
            w.change,
            w.removed,
            released,
            s.failure,
        ]
        graph.launch(stop_bones, model.num_envs, inputs, [scratch.sensors, self._hit])
        inputs = [body, s.x, w.bones, self._hit, s.failure]
        graph.launch(apply_hits, (model.num_envs, body.count), inputs, [s.u])


@wp.func
def velocity_of_bone(
    control: PoseControl,
    record: wp.array2d(dtype=vec44),
    bones: RigidFits,
    change: wp.array2d(dtype=vec8),
    removed: RemovedMotion,
    free: bool,
    e: int,
    b: int,
    x: wp.vec3,
):
    """Return the total velocity of a bone at ``x`` [m/s]: commanded, physical, and its correction in this substep."""
    s = record[e, b]
    arm = x - bones.center[e, 0]
    v = wp.vec3(s[STEP], s[STEP + 1], s[STEP + 2])
    for i in range(3):
        for j in range(3):
            v[i] = v[i] + s[TURN + 3 * i + j] * x[j]
    if free:
        v -= removed.velocity[e]
        v += removed.turn[e] * (x - removed.center[e] + control.dt * v)
    v += wp.vec3(s[VELOCITY], s[VELOCITY + 1], s[VELOCITY + 2])
    v += wp.cross(wp.vec3(s[SPIN], s[SPIN + 1], s[SPIN + 2]), arm)
    return v + motion_at(change[e, b], arm)


@wp.struct
class Rigid:
    """Some bones as one rigid body."""

    mass: float  # [kg]
    center: wp.vec3  # [m]
    inertia: wp.mat33  # about the centre [kg m^2]


@wp.struct
class Push:
    """Impulse on a rigid body: sum and moment about its centre."""

    linear: wp.vec3  # [N s]
    angular: wp.vec3  # [N m s]


@wp.func
def rigid_bones(body: Body, bones: RigidFits, part_of: wp.array(dtype=int), part: int, inside: bool, e: int) -> Rigid:
    """Return the bones of a ``part``, or all others, as a rigid body."""
    r = row(e, body.bone_mass.shape[0])
    s = Rigid()
    for b in range(body.parent.shape[0]):
        if (part_of[b] == part) == inside:
            s.mass += body.bone_mass[r, b]
            s.center += body.bone_mass[r, b] * bones.center[e, b]
    s.mass = wp.max(s.mass, 1.0e-12)
    s.center = s.center / s.mass
    for b in range(body.parent.shape[0]):
        if (part_of[b] == part) == inside:
            s.inertia += bones.inertia[e, b] + point_inertia(body.bone_mass[r, b], bones.center[e, b] - s.center)
    return s


@wp.func
def response_at(s: Rigid, by: wp.vec3, at: wp.vec3):
    """Return the matrix that takes an impulse ``by`` a point to the velocity ``at`` another of a rigid body [1/kg]."""
    W = wp.diag(wp.vec3(1.0 / s.mass))
    for axis in range(3):
        along = wp.vec3()
        along[axis] = 1.0
        turning = wp.cross(spin_of(s.inertia, wp.cross(by - s.center, along)), at - s.center)
        for i in range(3):
            W[i, axis] = W[i, axis] + turning[i]
    return W


@wp.func
def pushed(s: Rigid, by: wp.vec3, p: wp.vec3, center: wp.vec3):
    """Return the change of motion of a rigid body by an impulse ``p`` at ``by``, with the velocity at ``center``."""
    return bone_change(p / s.mass, spin_of(s.inertia, wp.cross(by - s.center, p)), center - s.center)


@wp.kernel
def stop_bones(
    body: Body,
    control: PoseControl,
    boundaries: Boundaries,
    contact: Contact,
    fields: wp.array(dtype=int),
    part_of: wp.array(dtype=int),
    root_of: wp.array(dtype=int),
    joints: wp.array2d(dtype=wp.vec3),
    deepest: wp.array2d(dtype=wp.vec3),
    record: wp.array2d(dtype=vec44),
    bones: RigidFits,
    change: wp.array2d(dtype=vec8),
    removed: RemovedMotion,
    released: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    # in and out
    sensors: Sensors,
    # out
    hit: wp.array2d(dtype=vec8),
):
    """Compute the change of every bone's motion by the impulses of colliders; over ``num_envs``.

    The deepest point that lacks most of the speed it must have is stopped first. ``fields`` are those of particles;
    ``part_of`` is the part of every bone, ``root_of`` the joint of every part, 0 for the torso; ``joints`` are where
    they are [m].
    """
    e = wp.tid()
    if failure[e] != 0:
        return
    free = is_free(control, released[e])
    center = bones.center[e, 0]
    count = boundaries.count
    for b in range(body.parent.shape[0]):
        hit[e, b] = vec8()
    for _ in range(MOST_STOPS):
        most = float(TOLERANCE)
        which = int(-1)
        for n in range(deepest.shape[1]):
            if deepest[e, n][0] < NOWHERE:
                touch = touch_of_bone(control, boundaries, record, bones, change, removed, free, hit, deepest, e, n)
                lacking = least_speed(touch.distance, control.dt) - wp.dot(touch.velocity, touch.normal)
                if lacking > most:
                    most = lacking
                    which = n
        if which < 0:
            break
        touch = touch_of_bone(control, boundaries, record, bones, change, removed, free, hit, deepest, e, which)
        part = part_of[which // count]
        own = rigid_bones(body, bones, part_of, part, True, e)
        others = rigid_bones(body, bones, part_of, part, False, e)
        joint = joints[e, root_of[part]]
        held = wp.mat33()
        if root_of[part] == 0:  # the torso takes all other parts along
            own = rigid_bones(body, bones, part_of, -1, False, e)
        else:  # the joint passes on the impulse -held p
            both = response_at(own, joint, joint) + response_at(others, joint, joint)
            held = wp.inverse(both) * response_at(own, touch.place, joint)
        mobility = response_at(own, touch.place, touch.place) - response_at(own, joint, touch.place) * held
        field = fields[body.first + body.tracker[body.tracker_start[which // count]]]
        friction = boundaries.friction[row(e, boundaries.friction.shape[0]), field * count + which % count]
        least = least_speed(touch.distance, control.dt)
        p = stopping_impulse(mobility, touch.velocity, touch.normal, least, friction)
        passed = held * p
        of_part = pushed(own, touch.place, p, center) - pushed(own, joint, passed, center)
        of_others = pushed(others, joint, passed, center)
        for b in range(body.parent.shape[0]):
            hit[e, b] = hit[e, b] + wp.where(part_of[b] == part or root_of[part] == 0, of_part, of_others)
        subject = contact.subject[field]
        add_impulse(sensors, e, boundary_entry(sensors, subject), p)
        add_impulse(sensors, e, moment_entry(sensors, subject), wp.cross(touch.place, p))


@wp.func
def touch_of_bone(
    control: PoseControl,
    boundaries: Boundaries,
    record: wp.array2d(dtype=vec44),
    bones: RigidFits,
    change: wp.array2d(dtype=vec8),
    removed: RemovedMotion,
    free: bool,
    hit: wp.array2d(dtype=vec8),
    deepest: wp.array2d(dtype=wp.vec3),
    e: int,
    n: int,
) -> Touch:
    """Return the contact of the deepest point ``n`` of a bone in a collider, with the impulses so far."""
    b = n // boundaries.count
    k = n % boundaries.count
    touch = Touch()
    touch.place = deepest[e, n]
    d = signed_distance(boundaries, e, k, touch.place)
    touch.normal = wp.vec3(d[0], d[1], d[2])
    touch.distance = d[3]
    touch.velocity = velocity_of_bone(control, record, bones, change, removed, free, e, b, touch.place)
    touch.velocity += motion_at(hit[e, b], touch.place - bones.center[e, 0])
    touch.velocity -= surface_velocity(boundaries, e, k, touch.place)
    return touch


@wp.kernel
def apply_hits(
    body: Body,
    x: wp.array2d(dtype=wp.vec3),
    bones: RigidFits,
    hit: wp.array2d(dtype=vec8),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
):
    """Change the physical velocity of every particle by the motion that its bones got; over ``(num_envs, count)``."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    n = body.first + p
    field = motion_at(blend_changes(hit, e, body.skin, p), vector_at(x, e, n) - bones.center[e, 0])
    store_vector(u, e, n, vector_at(u, e, n) + field, True)
