"""A control step of cloth: small steps of extended position-based dynamics (XPBD).

    every few substeps      a = (f_bend + f_air) / m
    in each substep         u = v + dt (g + a);  z = x + dt u;  held vertices go with the skin
    sweeps over the edges   dl = (l0 - |d| - l / (k dt^2)) / (w_i + w_j + 1 / (k dt^2)), k = E h (A1 + A2) / l0^2
                            c_i += w_i dl d/|d|,  c_j -= w_j dl d/|d|,  d = z_i + c_i - z_j - c_j
    contact                 on z + c, with velocity u + c / dt

Macklin, Mueller and Chentanez, "XPBD: position-based simulation of compliant constrained dynamics" (2016), and Macklin
et al., "Small steps in physics simulation" (2019). Corrections ``c`` are added up apart from positions, and velocities
get ``c / dt``: a difference of positions in single precision would lose momentum. Bending is
``f_i = -D sum_j q_ij (x_j - x_i)``, so that a vertex gets bit for bit what another loses.

Everything is divided by the mass per area: ``w`` is 1 / area, and the multipliers ``l`` are in m^3.

An environment is a CUDA block, or one thread on a CPU. Edges of a color share no vertex, so that no sum depends on the
order of the threads. What a step needs besides the state exists only as often as environments run at the same time:
once on a CPU, and on a GPU once for each block that it has room for, which takes one environment after the other.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from piavatar_envs.cloth.contact import (
    Pushed,
    Touches,
    add_to_slot,
    book,
    book_slot,
    is_near_collider,
    obstacle_patch,
    push_by_colliders,
    push_by_slot,
    search,
)
from piavatar_envs.cloth.obstacles import Obstacles
from piavatar_envs.cloth.self_contact import (
    APPROACH,
    SelfContacts,
    corrected,
    insert_vertex,
    keep_apart,
    search_self,
    take_correction,
)
from piavatar_envs.cloth.types import ClothState, Fabrics
from piavatar_envs.core.arrays import float_at, int_at, number_at, set_vector, vector_at
from piavatar_envs.core.cuda_intrinsics import sync_block, thread_of_block, threads_of_block
from piavatar_envs.mpm.types import Boundaries, row

wp.set_module_options({"enable_backward": False, "max_unroll": 0, "default_grid_stride": False})

#: Threads of an environment on a GPU: a CUDA block, of one size, because a module is compiled for each size.
THREADS = 256
#: CUDA blocks that share a multiprocessor: more hide more of the latency of its barriers.
BLOCKS = 4
#: CUDA blocks of this size that a multiprocessor has room for.
ROOM = 2048 // THREADS
#: Shorter edges [m] have no direction.
_NO_LENGTH = wp.constant(1.0e-12)


@wp.struct
class Pattern:
    """Constants of the garments of a world: ``V`` vertices, ``M`` edges, ``H`` held vertices, ``G`` garments."""

    edges: wp.array(dtype=wp.vec2i)  # (M,) by color
    color_start: wp.array(dtype=int)  # (C + 1,)
    length: wp.array2d(dtype=float)  # (rows, M) at rest [m]
    slackness: wp.array(dtype=float)  # (M,) compliance of an edge times E h
    edge_garment: wp.array(dtype=int)  # (M,)
    area: wp.array(dtype=float)  # (V,) [m^2]
    inverse_area: wp.array(dtype=float)  # (V,) 0 for held vertices
    garment: wp.array(dtype=int)  # (V,)
    bending_start: wp.array(dtype=int)  # (V + 1,) rows of Q
    bending_column: wp.array(dtype=int)
    bending_value: wp.array(dtype=float)  # [1/m^2]
    fan_start: wp.array(dtype=int)  # (V + 1,)
    fan: wp.array(dtype=wp.vec2i)  # the other two corners of a vertex's triangles
    sees: wp.array(dtype=int)  # (V,) bits of the wearer's parts that it touches
    wearer: wp.array(dtype=int)  # (G,) piece of the obstacles, -1 for none
    thickness: wp.array(dtype=float)  # (G,) [m]
    held: wp.array(dtype=int)  # (V,) index of a held vertex, -1 for others
    held_vertex: wp.array(dtype=int)  # (H,)
    held_triangle: wp.array(dtype=int)  # (H,) of the obstacles
    held_weights: wp.array(dtype=wp.vec3)  # (H,)
    held_offset: wp.array(dtype=float)  # (H,) along the normal [m]


@wp.struct
class Constants:
    """Numbers of the solver; see :class:`piavatar_envs.cloth.types.ClothSettings`."""

    dt: float  # substep [s]
    gravity: wp.vec3
    wind: wp.vec3
    substeps: int
    sweeps: int
    look_every: int
    forces_every: int
    pop: float
    keep: float  # share of the velocity that a substep leaves


@wp.struct
class Workspace:
    """Arrays that a control step fills before it reads them, in row ``b`` of ``B``: see :func:`rows_of`."""

    acceleration: wp.array2d(dtype=wp.vec3)  # (B, V) by bending and air [m/s^2]
    correction: wp.array2d(dtype=wp.vec3)  # (B, V) by the edges in this substep [m]
    multiplier: wp.array2d(dtype=float)  # (B, M)
    softness: wp.array2d(dtype=float)  # (B, G) sigma / (E h dt^2)
    pull: wp.array2d(dtype=wp.vec3)  # (B, H) on a held vertex in this substep [N s]
    held_impulse: wp.array2d(dtype=wp.vec3)  # (B, H) in the control step [N s]
    held_moment: wp.array2d(dtype=wp.vec3)  # (B, H) about the place at its end [N m s]


def rows_of(num_envs: int, device: str) -> int:
    """Return the number of environments that a device may advance at the same time: rows of the workspace."""
    owner = wp.get_device(device)
    return min(num_envs, round(ROOM * owner.sm_count) if owner.is_cuda else 1)


@wp.func
def bending_force(p: Pattern, e: int, i: int, ahead: float, s: ClothState):
    """Return the force of bending on a vertex over the bending stiffness [m/m^2], ``ahead`` [s] of now.

    In the middle of the time for which it stays, it takes no energy to or from the fastest waves to first order; at its
    beginning it would feed them.
    """
    here = vector_at(s.x, e, i) + ahead * vector_at(s.v, e, i)
    f = wp.vec3(0.0)
    for k in range(int_at(p.bending_start, i), int_at(p.bending_start, i + 1)):
        j = int_at(p.bending_column, k)
        f -= float_at(p.bending_value, k) * (vector_at(s.x, e, j) + ahead * vector_at(s.v, e, j) - here)
    return f


@wp.func
def air_acceleration(
    p: Pattern, c: Constants, fabric: Fabrics, r: int, e: int, i: int, here: wp.vec3, v: wp.vec3,
    x: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """Return the acceleration of a vertex by the air: quadratic drag along its normal and along the cloth.

    Each is divided by ``1 + T k``, its rate ``k`` times the time ``T`` between evaluations: drag alone then slows the
    vertex as the exact solution does. The velocity is that of half of ``T`` later by gravity, which makes the speed at
    which it balances drag exact to second order.
    """
    g = int_at(p.garment, i)
    n = wp.vec3()
    for k in range(int_at(p.fan_start, i), int_at(p.fan_start, i + 1)):
        n += wp.cross(vector_at(x, e, p.fan[k][0]) - here, vector_at(x, e, p.fan[k][1]) - here)
    six_areas = wp.length(n)
    n = n / wp.max(six_areas, _NO_LENGTH)
    T = c.dt * float(c.forces_every)
    u = v + 0.5 * T * c.gravity - c.wind
    along = wp.dot(u, n)
    tangent = u - along * n
    over_mass = six_areas / 6.0 * float_at(p.inverse_area, i) / fabric.areal_density[r, g]
    normal_rate = fabric.drag[r, g] * wp.abs(along) * over_mass
    tangent_rate = fabric.skin_drag[r, g] * wp.length(tangent) * over_mass
    return (-normal_rate / (1.0 + T * normal_rate) * along) * n - (tangent_rate / (1.0 + T * tangent_rate)) * tangent


@wp.func
def renew_forces(
    p: Pattern, c: Constants, fabric: Fabrics, s: ClothState, w: Workspace, e: int, b: int, i: int, remaining: int
):
    """Store the acceleration of a vertex by bending and air; a held one passes the force on."""
    here = vector_at(s.x, e, i)
    g = int_at(p.garment, i)
    r = row(e, fabric.bending.shape[0])
    period = c.dt * float(wp.min(c.forces_every, remaining))
    force = fabric.bending[r, g] * bending_force(p, e, i, 0.5 * period, s)
    h = int_at(p.held, i)
    if h >= 0:
        w.pull[b, h] = w.pull[b, h] + period * force
    else:
        a = (float_at(p.inverse_area, i) / fabric.areal_density[r, g]) * force
        a += air_acceleration(p, c, fabric, r, e, i, here, vector_at(s.v, e, i), s.x)
        set_vector(w.acceleration, b, i, a)


@wp.func
def held_place(p: Pattern, o: Obstacles, e: int, h: int, share: float):
    """Return the place of a held vertex when ``share`` of the control step has passed [m]."""
    point, normal = obstacle_patch(o, e, o.faces[p.held_triangle[h]], share, p.held_weights[h])
    return point + p.held_offset[h] * normal


@wp.func
def predict(p: Pattern, c: Constants, o: Obstacles, s: ClothState, w: Workspace, e: int, b: int, i: int, share: float):
    """Move a vertex by its velocity and the forces, or with the skin that holds it."""
    h = int_at(p.held, i)
    if h >= 0:
        z = held_place(p, o, e, h, share)
        set_vector(s.v, e, i, (z - vector_at(s.x, e, i)) / c.dt)
        set_vector(s.x, e, i, z)
    else:
        u = vector_at(s.v, e, i) + c.dt * (c.gravity + vector_at(w.acceleration, b, i))
        set_vector(s.v, e, i, u)
        set_vector(s.x, e, i, vector_at(s.x, e, i) + c.dt * u)
    set_vector(w.correction, b, i, wp.vec3(0.0))


@wp.func
def project_edge(
    p: Pattern,
    c: Constants,
    fabric: Fabrics,
    s: ClothState,
    w: Workspace,
    e: int,
    b: int,
    r: int,
    k: int,
    first: bool,
):
    """Correct the two vertices of an edge; ``first`` in a substep the multiplier is 0."""
    edge = p.edges[k]
    i = edge[0]
    j = edge[1]
    wi = float_at(p.inverse_area, i)
    wj = float_at(p.inverse_area, j)
    ci = vector_at(w.correction, b, i)
    cj = vector_at(w.correction, b, j)
    d = (vector_at(s.x, e, i) - vector_at(s.x, e, j)) + (ci - cj)
    length = wp.max(wp.length(d), _NO_LENGTH)
    g = int_at(p.edge_garment, k)
    a = float_at(p.slackness, k) * number_at(w.softness, b, g)
    before = float(0.0)
    if not first:
        before = number_at(w.multiplier, b, k)
    change = (number_at(p.length, r, k) - length - a * before) / (wi + wj + a)
    w.multiplier[b, k] = before + change
    d = (change / length) * d
    set_vector(w.correction, b, i, ci + wi * d)
    set_vector(w.correction, b, j, cj - wj * d)
    if wi == 0.0 or wj == 0.0:
        impulse = (fabric.areal_density[row(e, fabric.areal_density.shape[0]), g] / c.dt) * d
        if wi == 0.0:
            h = int_at(p.held, i)
            w.pull[b, h] = w.pull[b, h] + impulse
        if wj == 0.0:
            h = int_at(p.held, j)
            w.pull[b, h] = w.pull[b, h] - impulse


@wp.func
def touch(
    p: Pattern, c: Constants, fabric: Fabrics, o: Obstacles, boundaries: Boundaries, s: ClothState, w: Workspace,
    touches: Touches, e: int, b: int, i: int, step: int,
):  # fmt: skip
    """Move a vertex by the corrections and out of obstacles."""
    correction = vector_at(w.correction, b, i)
    g = int_at(p.garment, i)
    moved = Pushed()
    moved.z = vector_at(s.x, e, i) + correction
    moved.u = vector_at(s.v, e, i) + correction / c.dt
    moved.way = c.dt * moved.u
    k1 = s.x.shape[1] + i
    ahead = c.dt * float(c.substeps - 1 - step)
    if step % c.look_every == 0:
        if p.wearer[g] >= 0:
            s.near[e, i, 0] = search(
                o, e, b, i, 0, p.wearer[g], int_at(p.sees, i), moved.z, step, c.substeps, c.look_every, c.dt,
                s.near[e, i, 0], touches,
            )  # fmt: skip
        if touches.slots == 2:
            s.near[e, i, 1] = search(
                o, e, b, k1, 1, p.wearer[g], -1, moved.z, step, c.substeps, c.look_every, c.dt, s.near[e, i, 1],
                touches,
            )  # fmt: skip
        near = is_near_collider(boundaries, e, moved.z, ahead, c.dt * float(c.look_every))
        touches.near_collider[b, i] = wp.where(near, 1, 0)
    since = float(step % c.look_every + 1)
    r = row(e, fabric.friction.shape[0])
    friction = fabric.friction[r, g]
    thickness = p.thickness[g]
    by_wearer = push_by_slot(touches, b, i, moved, since, thickness, friction, c.pop, c.dt)
    by_others = by_wearer
    if touches.slots == 2:
        by_others = push_by_slot(touches, b, k1, by_wearer, since, thickness, friction, c.pop, c.dt)
    end = by_others
    if touches.near_collider[b, i] != 0:
        end = push_by_colliders(boundaries, e, by_others, ahead, thickness, friction, c.pop, c.dt)
    if end.squeezed == 0 and wp.length_sq(end.normal) > 0.0:
        mass = fabric.areal_density[r, g] * float_at(p.area, i)
        if touches.triangle[b, i] >= 0:
            add_to_slot(touches, b, i, mass, moved, by_wearer)
        if touches.slots == 2:  # noqa: SIM102 - Warp evaluates both sides of an `and`
            if touches.triangle[b, k1] >= 0:
                add_to_slot(touches, b, k1, mass, by_wearer, by_others)
    set_vector(s.x, e, i, end.z)
    set_vector(s.v, e, i, c.keep * end.u)


@wp.func
def collect_pull(p: Pattern, s: ClothState, o: Obstacles, w: Workspace, e: int, b: int, h: int):
    """Add the impulse on a held vertex in a substep, which acts at its place then."""
    i = p.held_vertex[h]
    J = w.pull[b, h]
    way_to_go = held_place(p, o, e, h, 1.0) - vector_at(s.x, e, i)
    w.held_impulse[b, h] = w.held_impulse[b, h] + J
    w.held_moment[b, h] = w.held_moment[b, h] - wp.cross(way_to_go, J)
    w.pull[b, h] = wp.vec3(0.0)


@wp.func
def inverse_mass(p: Pattern, fabric: Fabrics, r: int, i: int):
    """Return the inverse of a vertex's mass [1/kg], 0 for held ones."""
    return float_at(p.inverse_area, i) / fabric.areal_density[r, int_at(p.garment, i)]


@wp.func
def search_all_selves(
    p: Pattern, c: Constants, s: ClothState, w: Workspace, contacts: SelfContacts, e: int, b: int, thread: int,
    threads: int,
):  # fmt: skip
    """Search the triangles that vertices may touch until the next search; all threads of a block call this."""
    for n in range(thread, contacts.first.shape[1], threads):
        contacts.first[b, n] = -1
    sync_block()
    for i in range(thread, s.x.shape[1], threads):
        insert_vertex(contacts, b, i, corrected(s.x, w.correction, e, b, i))
    sync_block()
    for i in range(thread, s.x.shape[1], threads):
        reach = p.thickness[int_at(p.garment, i)] + APPROACH * c.dt * float(c.look_every)
        search_self(contacts, p.fan_start, p.fan, s.x, w.correction, e, b, i, reach)


@wp.func
def push_self(
    p: Pattern, c: Constants, fabric: Fabrics, s: ClothState, w: Workspace, contacts: SelfContacts, e: int, b: int,
    i: int,
):  # fmt: skip
    """Push a vertex and the triangle that it touches apart."""
    f = contacts.corners[b, i]
    if f[0] >= 0:
        r = row(e, fabric.areal_density.shape[0])
        g = int_at(p.garment, i)
        masses = wp.vec4(
            inverse_mass(p, fabric, r, i),
            inverse_mass(p, fabric, r, f[0]),
            inverse_mass(p, fabric, r, f[1]),
            inverse_mass(p, fabric, r, f[2]),
        )
        friction = fabric.friction[r, g]
        keep_apart(contacts, s.x, w.correction, s.v, masses, e, b, i, p.thickness[g], friction, c.pop, c.dt)


@wp.func
def apply_self(p: Pattern, c: Constants, fabric: Fabrics, w: Workspace, contacts: SelfContacts, e: int, b: int, i: int):
    """Correct a vertex by all of its contacts with cloth; a held one passes the impulse on."""
    P = take_correction(contacts, b, i)
    h = int_at(p.held, i)
    if h >= 0:
        w.pull[b, h] = w.pull[b, h] + P / c.dt
    else:
        change = inverse_mass(p, fabric, row(e, fabric.areal_density.shape[0]), i) * P
        set_vector(w.correction, b, i, vector_at(w.correction, b, i) + change)


@wp.func
def advance(
    p: Pattern,
    c: Constants,
    fabric: Fabrics,
    boundaries: Boundaries,
    failure_bit: int,
    # in and out
    o: Obstacles,
    s: ClothState,
    w: Workspace,
    touches: Touches,
    contacts: SelfContacts,
    failure: wp.array(dtype=int),
    e: int,
    b: int,
    self_collision: bool,
):
    """Advance the cloth of an environment by a control step in row ``b`` of the workspace, unless it has failed."""
    if failure[e] != 0:
        return
    thread = thread_of_block()
    threads = threads_of_block()
    vertices = s.x.shape[1]
    r = row(e, p.length.shape[0])
    q = row(e, fabric.stretch.shape[0])
    for g in range(thread, p.wearer.shape[0], threads):
        w.softness[b, g] = fabric.areal_density[q, g] / (fabric.stretch[q, g] * c.dt * c.dt)
    for h in range(thread, p.held_vertex.shape[0], threads):
        w.pull[b, h] = wp.vec3(0.0)
        w.held_impulse[b, h] = wp.vec3(0.0)
        w.held_moment[b, h] = wp.vec3(0.0)
    sync_block()
    for step in range(c.substeps):
        share = float(step + 1) / float(c.substeps)
        if step % c.forces_every == 0:
            for i in range(thread, vertices, threads):
                renew_forces(p, c, fabric, s, w, e, b, i, c.substeps - step)
            sync_block()
        for i in range(thread, vertices, threads):
            predict(p, c, o, s, w, e, b, i, share)
        sync_block()
        for sweep in range(c.sweeps):
            for color in range(p.color_start.shape[0] - 1):
                for k in range(p.color_start[color] + thread, p.color_start[color + 1], threads):
                    project_edge(p, c, fabric, s, w, e, b, r, k, sweep == 0)
                sync_block()
        if self_collision:
            if step % c.look_every == 0:
                search_all_selves(p, c, s, w, contacts, e, b, thread, threads)
            for i in range(thread, vertices, threads):
                push_self(p, c, fabric, s, w, contacts, e, b, i)
            sync_block()
            for i in range(thread, vertices, threads):
                apply_self(p, c, fabric, w, contacts, e, b, i)
            sync_block()
        for i in range(thread, vertices, threads):
            if int_at(p.held, i) < 0:
                touch(p, c, fabric, o, boundaries, s, w, touches, e, b, i, step)
        for h in range(thread, p.held_vertex.shape[0], threads):
            collect_pull(p, s, o, w, e, b, h)
        sync_block()
    finite = bool(True)
    for i in range(thread, vertices, threads):
        for slot in range(touches.slots):
            book_slot(o, touches, e, b, slot * vertices + i)
        finite = finite and wp.isfinite(s.x[e, i]) and wp.isfinite(s.v[e, i])
    for h in range(thread, p.held_vertex.shape[0], threads):
        z = vector_at(s.x, e, p.held_vertex[h])
        book(o, e, p.held_triangle[h], p.held_weights[h], z, w.held_impulse[b, h], w.held_moment[b, h])
    if not finite:
        wp.atomic_or(failure, e, failure_bit)


@cache
def advance_kernel(self_collision: bool) -> wp.Kernel:
    """Return :func:`advance` as a kernel over ``(B, threads)``, created on first use; a block has every B-th env."""

    @wp.kernel(
        name="advance_cloth_apart" if self_collision else "advance_cloth",
        module="unique",
        launch_bounds=(THREADS, BLOCKS),
        module_options={"enable_backward": False, "max_unroll": 0, "default_grid_stride": False, "fast_math": True},
    )
    def advance_cloth(
        p: Pattern,
        c: Constants,
        fabric: Fabrics,
        boundaries: Boundaries,
        failure_bit: int,
        # in and out
        o: Obstacles,
        s: ClothState,
        w: Workspace,
        touches: Touches,
        contacts: SelfContacts,
        failure: wp.array(dtype=int),
    ):
        b, _ = wp.tid()
        rows = w.softness.shape[0]
        for e in range(b, failure.shape[0], rows):
            advance(p, c, fabric, boundaries, failure_bit, o, s, w, touches, contacts, failure, e, b, self_collision)

    return advance_cloth
