"""Grid-to-particle transfer (G2P), the advance of particles, and the update of the deformation gradient.

APIC (Jiang et al., "The Affine Particle-In-Cell Method", 2015). Commanded motion must not strain the flesh of an
avatar, contact must. PIAvatar (Han et al., arXiv 2606.21162) decouples the two by ``F <- F (F^k)^-1`` with the
deformation gradient ``F^k`` of the kinematic velocity. Variants:

- ``"split"`` (default): physical and kinematic velocity are never mixed into one state, and prescribed motion only
  rotates the elastic deformation: ``F <- (I + dt grad u) Q F Q^T`` with ``Q = Cayley(dt w)`` and the spin ``w`` of the
  bones that a particle follows. This is the paper's decoupling without its round-off. (Half the curl of the grid's
  ``vk`` would serve as well, but every node would need it.)
- ``"paper"``: one velocity state, ``v += vk_new - vk_old`` once a control step,
  ``F <- (I + dt grad v) F (I + dt grad vk)^-1``, with ``F^k`` restarting at the identity each substep.
- ``"none"``: the same injection without decoupling, the plain MPM that the paper compares with. (Overwriting the
  velocity instead of adding the difference gives about 0.05 m where the paper prints 0.25.)
- ``"no_stress"``: as ``"split"`` without stress, the paper's motivation figure: bodies merge.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import matrix_at, store_matrix, store_pair
from piavatar_envs.mpm.bspline import Stencil, base_node, grid_position, in_same_subblock, stencil_at, stencil_inside
from piavatar_envs.mpm.colliders import COLLIDER_CONTACT_GATE, nearest_boundary, remove_approach
from piavatar_envs.mpm.contact_sensors import HELD, SLOWED, STRETCHED, add_limited
from piavatar_envs.mpm.grid_arrays import TO_KINEMATIC, first_of_halves, read_half_from
from piavatar_envs.mpm.p2g import _LINES, MOST_CELLS, Lines, lines_of
from piavatar_envs.mpm.sparse_grid import (
    HALVES,
    activate_stencil,
    candidate_bits,
    ends_of_line,
    line_of_records,
    slab_records,
)
from piavatar_envs.mpm.types import (
    CANDIDATE,
    FAILURE_CFL,
    FAILURE_NONFINITE,
    NO_STRESS,
    PAPER,
    SPLIT,
    Blocks,
    Boundaries,
    Grid,
    Moving,
    Particles,
    Sensors,
    Step,
)

# Warp's own unrolling hides the loops over the stencil from the C++ compiler, which turns them into vector code
wp.set_module_options({"enable_backward": False, "max_unroll": 0})

I3 = wp.constant(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
_NONFINITE = wp.constant(FAILURE_NONFINITE)
_CFL = wp.constant(FAILURE_CFL)
#: Greatest squared norm of a deformation gradient, 3 at rest. A stretch of 2.6 quadruples the stiffness of a
#: Neo-Hookean solid, which is what the time step is stable for.
MOST_STRETCH = wp.constant(9.0)
#: Greatest strain of a substep, below 1, at which matter would turn inside out.
MOST_STRAIN = wp.constant(0.5)


@wp.struct
class Advanced:
    """A particle at the end of a substep; see :class:`piavatar_envs.mpm.types.State`."""

    fault: int  # why it cannot go on: bits FAILURE_*; then it stays as it is
    limited: int  # what has been limited: SLOWED, HELD or STRETCHED, 0 for nothing
    x: wp.vec3
    u: wp.vec3
    C: wp.mat33
    F: wp.mat33


@wp.struct
class Gradients:
    """Weighted sums over a stencil of a velocity (components 1 to 3), and of its products with the nodes' positions."""

    mean: wp.vec4
    along_x: wp.vec4  # by places from the lowest node [grid spacings]
    along_y: wp.vec4
    along_z: wp.vec4


@wp.func
def cayley(turn: wp.vec3):
    """Return the rotation ``(I - W/2)^-1 (I + W/2)`` with ``W = skew(turn)`` [rad], orthogonal for any ``turn``.

    With ``a = turn / 2`` and ``A = skew(a)`` the closed form is ``I + 2 (A + A A) / (1 + a.a)``, ``A A = a a^T - a.a
    I``; written out, it takes a third of the operations.
    """
    a = 0.5 * turn
    square = wp.dot(a, a)
    share = 2.0 / (1.0 + square)
    b = share * a
    rest = 1.0 - share * square
    # fmt: off
    return wp.mat33(
        rest + b[0] * a[0], b[0] * a[1] - b[2], b[0] * a[2] + b[1],
        b[0] * a[1] + b[2], rest + b[1] * a[1], b[1] * a[2] - b[0],
        b[0] * a[2] - b[1], b[1] * a[2] + b[0], rest + b[2] * a[2],
    )


@wp.func
def advance_deformation(F: wp.mat33, grad_v: wp.mat33, grad_vk: wp.mat33, spin: wp.vec3, dt: float, decoupling: int):
    """Return the deformation gradient after one substep.

    Args:
        F: deformation gradient before.
        grad_v: gradient of the physical velocity (``"split"``) or of the one velocity state [1/s].
        grad_vk: gradient of the kinematic velocity [1/s]; for ``"paper"``.
        spin: of the prescribed motion [rad/s]; for ``"split"``.
        dt: substep [s].
        decoupling: one of :data:`piavatar_envs.mpm.types.DECOUPLING`.
    """
    step = I3 + dt * grad_v
    if decoupling == SPLIT:
        Q = cayley(dt * spin)
        return step * (Q * F * wp.transpose(Q))
    if decoupling == PAPER:
        return step * F * wp.inverse(I3 + dt * grad_vk)
    return step * F


@wp.func
def fault_of(grid: Grid, F: wp.mat33, reach: float):
    """Return why a particle cannot go on: bits ``FAILURE_*``, 0 if it can.

    ``F`` is its deformation gradient, ``reach`` its velocity times the substep [m].
    """
    if not wp.isfinite(wp.ddot(F, F) + reach):
        return _NONFINITE
    if reach > MOST_CELLS * grid.dx:
        return _CFL
    return 0


@wp.func
def strain_rate(C: wp.mat33):
    """Return the norm of the symmetric part of a velocity gradient [1/s]."""
    D = 0.5 * (C + wp.transpose(C))
    return wp.sqrt(wp.ddot(D, D))


@wp.func
def limit_strain_rate(C: wp.mat33, share: float):
    """Return ``C`` with a ``share`` of its symmetric part. Its spin stays, and with it angular momentum.

    The kinetic energy of an affine velocity falls with its norm.
    """
    return C - (0.5 * (1.0 - share)) * (C + wp.transpose(C))


@wp.func
def relax_stretch(F: wp.mat33, square: float):
    """Return ``F`` with a squared norm of nearly :data:`MOST_STRETCH`, from ``square``, by a flow that keeps volume.

    ``F <- F - k dev(B) / tr(B) F`` with ``B = F F^T``, the plastic flow of a solid that yields to the greatest stretch.
    Its work ``-tau : dev(B)`` is never positive, and momentum does not depend on ``F``.
    """
    B = F * wp.transpose(F)
    spread = wp.ddot(B, B) / square - square / 3.0
    k = wp.min(0.5 * (square - MOST_STRETCH) / wp.max(spread, 1.0e-6), 0.5)
    return F - (k / square) * (B - (square / 3.0) * I3) * F


@wp.func
def gradient_of(grid: Grid, g: Gradients, f: wp.vec3):
    """Return the velocity gradient ``(4 / dx^2) sum w v (x_i - x_p)^T`` of quadratic splines, as in APIC [1/s].

    ``f`` is the position of the particle from the lowest node of its stencil.
    """
    scale = 4.0 * grid.inv_dx
    gx = scale * (g.along_x - f[0] * g.mean)
    gy = scale * (g.along_y - f[1] * g.mean)
    gz = scale * (g.along_z - f[2] * g.mean)
    return wp.mat33(gx[1], gy[1], gz[1], gx[2], gy[2], gz[2], gx[3], gy[3], gz[3])


@wp.func
def needs_kinematic(grid: Grid, step: Step, distance: float):
    """Return whether a particle needs the grid's kinematic velocity: ``"paper"``, or a collider at ``distance`` [m]."""
    if step.decoupling == PAPER:
        return True
    split = step.decoupling == SPLIT or step.decoupling == NO_STRESS
    return split and distance < COLLIDER_CONTACT_GATE * grid.dx


@wp.func
def velocity_of(grid: Grid, physical: Gradients, f: wp.vec3):
    """Return a particle with the physical velocity and gradient of the sums; ``f`` as in :func:`gradient_of`."""
    s = Advanced()
    s.u = wp.vec3(physical.mean[1], physical.mean[2], physical.mean[3])
    s.C = gradient_of(grid, physical, f)
    return s


@wp.func
def carried_velocity(
    grid: Grid, boundaries: Boundaries, e: int, x: wp.vec3, vk: wp.vec3, kinematic: Gradients, needed: bool
):
    """Return the kinematic velocity that carries a particle at ``x``, which must not enter colliders.

    Contact acts on the nodes' kinematic velocity; from the rest of the particle's own ``vk`` the approach is removed.
    ``kinematic`` is empty unless it is ``needed``, see :func:`needs_kinematic`.
    """
    if not needed:
        return vk
    seen = wp.vec3(kinematic.mean[1], kinematic.mean[2], kinematic.mean[3])
    return seen + remove_approach(boundaries, e, x, vk - seen, COLLIDER_CONTACT_GATE * grid.dx)


@wp.func
def complete_advance(
    grid: Grid,
    step: Step,
    s: Advanced,
    x: wp.vec3,
    advection: wp.vec3,
    F: wp.mat33,
    grad_vk: wp.mat33,
    spin: wp.vec3,
):
    """Return ``s`` with deformation gradient, position and fault, for a move from ``x`` with ``advection``.

    A particle moves at most a grid spacing, so that contact acts before it has passed another body, and stays inside
    the grid. Its velocity stays, and the path is cut along it, so that neither linear nor angular momentum changes. Its
    strain is limited in a substep, and its stretch to that at which the elastic wave would be too fast for the substep,
    where there is stress.
    """
    decoupling = wp.where(step.decoupling == NO_STRESS, SPLIT, step.decoupling)
    most = MOST_STRAIN / step.dt
    if wp.ddot(s.C, s.C) > most * most and step.decoupling == SPLIT:
        rate = strain_rate(s.C)
        if rate > most:
            s.C = limit_strain_rate(s.C, most / rate)
            s.limited = STRETCHED
    s.F = advance_deformation(F, s.C, grad_vk, spin, step.dt, decoupling)
    square = wp.ddot(s.F, s.F)
    if square > MOST_STRETCH and step.decoupling == SPLIT:
        s.F = relax_stretch(s.F, square)
        s.limited = STRETCHED
    way = step.dt * advection
    reach = wp.length(way)
    if reach > grid.dx:
        way *= grid.dx / reach
        s.limited = SLOWED
    s.x = x + way
    s.fault = fault_of(grid, s.F, reach)
    if s.fault == 0 and not stencil_inside(grid, base_node(grid_position(grid, s.x))):
        s.x = x
        s.limited = HELD
    return s


@wp.func
def advance_particle(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    sensors: Sensors,
    e: int,
    p: int,
    physical: Gradients,
    kinematic: Gradients,
    needed: bool,
    stencil: Stencil,
):
    """Return particle ``p`` after the substep; activates the blocks that it enters.

    A particle moves with its *own* kinematic velocity, not with the grid-smoothed one, which makes tracking exact
    (1e-5 m against 1e-2 m).
    """
    x = moved.x[e, p]
    s = velocity_of(grid, physical, stencil.f)
    advection = s.u
    grad_vk = wp.mat33()
    if step.decoupling == PAPER:
        grad_vk = gradient_of(grid, kinematic, stencil.f)
    elif step.decoupling == SPLIT or step.decoupling == NO_STRESS:
        advection += carried_velocity(grid, boundaries, e, x, moved.vk[e, p], kinematic, needed)
    s = complete_advance(grid, step, s, x, advection, matrix_at(moved.F, e, p), grad_vk, moved.spin[e, p])
    if s.fault != 0:
        wp.atomic_or(failure, e, s.fault)
    else:
        if s.limited != 0:
            add_limited(sensors, particles, e, p, s.limited)
        to = base_node(grid_position(grid, s.x))
        if not in_same_subblock(to, stencil.base):
            activate_stencil(grid, blocks, to, particles.field[p], e, failure)
    return s


@wp.func_native(
    _LINES
    + """
const four* const halves = reinterpret_cast<const four*>(nodes);
four mean = vector(0.0f, 0.0f, 0.0f, 0.0f), along_x = mean, along_y = mean, along_z = mean;
#pragma unroll
for (int i = 0; i < 3; ++i) {
    four plane = vector(0.0f, 0.0f, 0.0f, 0.0f), plane_y = plane, plane_z = plane;
#pragma unroll
    for (int j = 0; j < 3; ++j)
        with_line(i, j, [&](int first, int middle, int last) {
            const four second = halves[middle] * wz[1], third = halves[last] * wz[2];
            const four line = halves[first] * wz[0] + second + third;
            plane = plane + line * wy[j];
            plane_y = plane_y + line * ((float)j * wy[j]);
            plane_z = plane_z + (second + third * 2.0f) * wy[j];
        });
    mean = mean + plane * wx[i];
    along_x = along_x + plane * ((float)i * wx[i]);
    along_y = along_y + plane_y * wx[i];
    along_z = along_z + plane_z * wx[i];
}
wp::mat_t<4, 4, wp::float32> sums;
for (int c = 0; c < 4; ++c)
    sums.data[0][c] = mean[c], sums.data[1][c] = along_x[c], sums.data[2][c] = along_y[c], sums.data[3][c] = along_z[c];
return sums;
"""
)
def sum_lines(
    nodes: wp.uint64,
    lines: Lines,
) -> wp.mat44:
    """Return the sums over a stencil of halves of records at address ``nodes``: mean, and times x, y and z."""
    ...


@wp.func
def sum_physical(
    grid: Grid,
    blocks: Blocks,
    nodes: wp.uint64,
    e: int,
    field: int,
    stencil: Stencil,
):
    """Return the sums of physical velocity over a stencil, on a GPU.

    :func:`sum_lines` does so on the plain path, and :mod:`piavatar_envs.mpm.cuda.block_g2p` in shared memory: they
    differ in how a record is addressed, and in the order of products that needs fewest registers.
    """
    base = stencil.base
    wx = stencil.wx
    wy = stencil.wy
    wz = stencil.wz
    g = Gradients()
    slab = wp.vec4i()
    planes = int(3)  # a variable, to keep the loop: unrolled, its loads need too many registers
    for i in range(planes):
        wi = wp.where(i == 0, wx[0], wp.where(i == 1, wx[1], wx[2]))
        plane = wp.vec4()
        if i == 0 or ((base[0] + i) & 3) == 0:
            slab = slab_records(grid, blocks, e, field, base, i, HALVES)
        for j in range(3):
            ends = ends_of_line(slab, base, i, j)
            middle = wp.where((base[2] & 3) == 3, ends[1], ends[0])
            w = wi * wy[j]
            second = (w * wz[1]) * read_half_from(nodes, middle, 1)
            third = (w * wz[2]) * read_half_from(nodes, ends[1], 2)
            line = (w * wz[0]) * read_half_from(nodes, ends[0], 0) + second + third
            plane += line
            g.along_y += float(j) * line
            g.along_z += second + 2.0 * third
        g.mean += plane
        g.along_x += float(i) * plane
    return g


@wp.func
def sum_kinematic(
    grid: Grid,
    blocks: Blocks,
    nodes: wp.uint64,
    e: int,
    field: int,
    stencil: Stencil,
):
    """Return the sums of kinematic velocity over a stencil; compact code, because few particles need it."""
    base = stencil.base
    wz = stencil.wz
    g = Gradients()
    lines = int(9)  # a variable, to keep the loop
    for n in range(lines):
        i = n // 3
        j = n % 3
        at = line_of_records(slab_records(grid, blocks, e, field, base, i, HALVES), base, i, j)
        w = stencil.wx[i] * stencil.wy[j]
        for l in range(3):
            k = read_half_from(nodes, at[l], TO_KINEMATIC)
            s = (w * wz[l]) * wp.vec4(0.0, k[0], k[1], k[2])
            g.mean += s
            g.along_x += float(i) * s
            g.along_y += float(j) * s
            g.along_z += float(l) * s
    return g


@wp.func
def store_particle(moved: Moving, e: int, p: int, s: Advanced, store: bool):
    """Write particle ``p`` if ``store``; all threads of a warp should call this together."""
    store_pair(moved.x, moved.u, e, p, s.x, s.u, True, store)
    if store:
        store_matrix(moved.C, e, p, s.C)
        store_matrix(moved.F, e, p, s.F)


@wp.func
def g2p_particle(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=wp.vec4),
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    sensors: Sensors,
    e: int,
    p: int,
):
    """Return particle ``p`` after the substep, and its distance from the nearest collider [m], on a GPU."""
    x = moved.x[e, p]
    stencil = stencil_at(grid_position(grid, x))
    field = particles.field[p]
    nodes = first_of_halves(node_velocity, e)
    physical = sum_physical(grid, blocks, nodes, e, field, stencil)
    kinematic = Gradients()
    distance = nearest_boundary(boundaries, e, x)
    needed = needs_kinematic(grid, step, distance)
    if needed:
        kinematic = sum_kinematic(grid, blocks, nodes, e, field, stencil)
    s = advance_particle(
        grid, step, particles, boundaries, blocks, moved, failure, sensors, e, p, physical, kinematic, needed,
        stencil,
    )  # fmt: skip
    return s, distance


@wp.kernel
def g2p(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    node_velocity: wp.array2d(dtype=wp.vec4),
    # in and out; vk is read
    blocks: Blocks,
    moved: Moving,
    failure: wp.array(dtype=int),
    sensors: Sensors,
):
    """Move every particle with the grid, on the plain path, whose P2G has stored the contact candidates."""
    e, p = wp.tid()
    if blocks.frozen[e] != 0:
        return
    x = moved.x[e, p]
    stencil = stencil_at(grid_position(grid, x))
    field = particles.field[p]
    nodes = first_of_halves(node_velocity, e)
    sums = sum_lines(nodes, lines_of(grid, blocks, e, field, stencil, HALVES))
    physical = Gradients(sums[0], sums[1], sums[2], sums[3])
    kinematic = Gradients()
    needed = bool(False)
    if step.decoupling == PAPER or (candidate_bits(blocks, e, p) & CANDIDATE) != 0:
        needed = needs_kinematic(grid, step, nearest_boundary(boundaries, e, x))
    if needed:
        kinematic = sum_kinematic(grid, blocks, nodes, e, field, stencil)
    s = advance_particle(
        grid, step, particles, boundaries, blocks, moved, failure, sensors, e, p, physical, kinematic, needed,
        stencil,
    )  # fmt: skip
    if s.fault == 0:
        moved.x[e, p] = s.x
        moved.u[e, p] = s.u
        store_matrix(moved.C, e, p, s.C)
        store_matrix(moved.F, e, p, s.F)
