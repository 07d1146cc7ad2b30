"""Particle-to-grid transfer (P2G) of the plain path; the way back is in :mod:`piavatar_envs.mpm.g2p`.

The plain path runs on CPUs, and is the fallback on GPUs below compute capability 7.0.
:mod:`piavatar_envs.mpm.cuda` reuses its functions for single particles.

APIC (Jiang et al., "The Affine Particle-In-Cell Method", 2015) with the MLS form of the stress force (Hu et al., "A
Moving Least Squares Material Point Method", 2018, eq. 16). Physical and kinematic momentum share one pass.

The sums over a stencil are written as native code with vectors of four numbers: of operations in separate functions, a
C++ compiler for a CPU makes neither four-wide vectors nor fused multiply-adds.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import matrix_at, vec8
from piavatar_envs.mpm.bspline import BLOCK_NODES, Stencil, grid_position, stencil_at
from piavatar_envs.mpm.colliders import NEAR_PARTICLE, nearest_boundary
from piavatar_envs.mpm.compression import shock_pressure
from piavatar_envs.mpm.grid_arrays import TO_KINEMATIC
from piavatar_envs.mpm.materials import kirchhoff_stress, viscous_stress
from piavatar_envs.mpm.sparse_grid import HALVES, VECTORS, fields_around, slab_records, store_candidate
from piavatar_envs.mpm.types import (
    FAILURE_BLOCKS,
    FAILURE_CFL,
    FAILURE_NONFINITE,
    NO_STRESS,
    PAPER,
    Accumulators,
    Blocks,
    Boundaries,
    Contact,
    Grid,
    Moving,
    Particles,
    Step,
    row,
)

# Warp's own unrolling hides the loops over the stencil from the C++ compiler, which turns them into vector code
wp.set_module_options({"enable_backward": False, "max_unroll": 0})

#: Most momentum quanta of a particle: those of 4,000 full cells that move a grid spacing a time step.
MAX_QUANTA = wp.constant(float(2**48))
#: A particle that would move or is driven further in a substep [grid spacings] has failed.
MOST_CELLS = wp.constant(8.0)
_NONFINITE = wp.constant(FAILURE_NONFINITE)
_BLOCKS = wp.constant(FAILURE_BLOCKS)
_CFL = wp.constant(FAILURE_CFL)


@wp.struct
class Lines:
    """The nine lines of a stencil along z: indices of their nodes in an array, and weights."""

    of: Stencil
    slab0: wp.vec4i  # places of the three planes, see :func:`piavatar_envs.mpm.sparse_grid.slab_records`
    slab1: wp.vec4i
    slab2: wp.vec4i


@wp.struct
class Deposit:
    """Contribution of a particle to its nodes; the momentum ``m u + affine (x_i - x_p)`` is linear over the stencil."""

    base: wp.vec3i  # lowest node of the stencil
    f: wp.vec3  # position from there, in grid spacings
    at_base: vec8  # mass, physical and kinematic momentum, at the lowest node
    A: wp.mat33  # change of physical momentum from node to node, along the columns


# Iteration over the nine lines of a stencil, with indices as in piavatar_envs.mpm.sparse_grid.
_LINES = """
#if defined(__clang__) && !defined(__CUDA_ARCH__)
#pragma clang fp contract(fast)
typedef float four __attribute__((vector_size(16), aligned(4)));
auto vector = [](float a, float b, float c, float d) { return four{a, b, c, d}; };
#else
typedef wp::vec_t<4, wp::float32> four;
auto vector = [](float a, float b, float c, float d) { return four(a, b, c, d); };
#endif
const int bx = lines.of.base[0] & 3, by = lines.of.base[1] & 3, bz = lines.of.base[2] & 3;
const wp::vec3 wx = lines.of.wx, wy = lines.of.wy, wz = lines.of.wz;
// calls visit with the indices of the three nodes of line j of plane i
auto with_line = [&](int i, int j, auto visit) {
    const wp::vec_t<4, wp::int32>& slab = i == 0 ? lines.slab0 : i == 1 ? lines.slab1 : lines.slab2;
    const bool upper = by + j > 3;
    const int within = 16 * ((bx + i) & 3) + 4 * ((by + j) & 3) + bz;
    const int first = slab[upper ? 2 : 0] + within, last = slab[upper ? 3 : 1] + within;
    visit(first, (bz == 3 ? last : first) + 1, last + 2);
};
"""


@wp.func
def lines_of(grid: Grid, blocks: Blocks, e: int, field: int, stencil: Stencil, of_block: int):
    """Return the lines of a stencil in an array of ``of_block`` entries a block."""
    base = stencil.base
    s = Lines()
    s.of = stencil
    s.slab0 = slab_records(grid, blocks, e, field, base, 0, of_block)
    s.slab1 = s.slab0
    s.slab2 = s.slab0
    if ((base[0] + 1) & 3) == 0:
        s.slab1 = slab_records(grid, blocks, e, field, base, 1, of_block)
        s.slab2 = s.slab1
    elif ((base[0] + 2) & 3) == 0:
        s.slab2 = slab_records(grid, blocks, e, field, base, 2, of_block)
    return s


# Atomic on a GPU; on a CPU no two threads have particles of the same environment.
_ADDING = """
auto adding_to = [](auto& vectors, int e) {
    four* const first = reinterpret_cast<four*>(&wp::index(vectors, e, 0));
    return [=](int at, four value) {
#if defined(__CUDA_ARCH__)
        for (int c = 0; c < 4; ++c) atomicAdd(reinterpret_cast<float*>(first + at) + c, value[c]);
#else
        first[at] = first[at] + value;
#endif
    };
};
"""


@wp.func_native(
    _LINES
    + _ADDING
    + f"""
constexpr int TO_KINEMATIC = {int(TO_KINEMATIC)};
const auto add = adding_to(accumulators.value, e);
auto along = [&](int axis) {{ return vector(0.0f, A.data[0][axis], A.data[1][axis], A.data[2][axis]); }};
const four along_x = along(0), along_y = along(1), along_z = along(2);
const four kinematic = vector(at_base[4], at_base[5], at_base[6], 0.0f);
four plane = vector(at_base[0], at_base[1], at_base[2], at_base[3]);
#pragma unroll
for (int i = 0; i < 3; ++i) {{
    four line = plane;
#pragma unroll
    for (int j = 0; j < 3; ++j) {{
        const float w = wx[i] * wy[j];
        with_line(i, j, [&](int first, int middle, int last) {{
            add(first, line * (w * wz[0]));
            add(middle, (line + along_z) * (w * wz[1]));
            add(last, (line + along_z * 2.0f) * (w * wz[2]));
            if (driven) {{
                add(first + TO_KINEMATIC, kinematic * (w * wz[0]));
                add(middle + TO_KINEMATIC, kinematic * (w * wz[1]));
                add(last + TO_KINEMATIC, kinematic * (w * wz[2]));
            }}
        }});
        line = line + along_y;
    }}
    plane = plane + along_x;
}}
"""
)
def add_lines(
    accumulators: Accumulators,
    e: int,
    lines: Lines,
    at_base: vec8,
    A: wp.mat33,
    driven: bool,
):
    """Add mass, momentum (``at_base`` plus ``A`` a node) and, if ``driven``, kinematic momentum to the nodes."""
    ...


@wp.func_native(
    _LINES
    + _ADDING
    + """
const auto add = adding_to(accumulators.offset, e);
const wp::vec3 f = lines.of.f;
#pragma unroll
for (int i = 0; i < 3; ++i)
#pragma unroll
    for (int j = 0; j < 3; ++j)
        with_line(i, j, [&](int first, int middle, int last) {
            const float w = wx[i] * wy[j] * mass;
            const four place = vector(dx * ((float)i - f[0]), dx * ((float)j - f[1]), -dx * f[2], seam);
            const four up = vector(0.0f, 0.0f, dx, 0.0f);
            add(first, place * (w * wz[0]));
            add(middle, (place + up) * (w * wz[1]));
            add(last, (place + up * 2.0f) * (w * wz[2]));
        });
"""
)
def add_offset_lines(
    accumulators: Accumulators,
    e: int,
    lines: Lines,
    mass: float,
    seam: float,
    dx: float,
):
    """Add the offsets of a contact candidate to the nodes; ``lines`` are of :data:`VECTORS`."""
    ...


@wp.func
def flag_candidate_blocks(accumulators: Accumulators, e: int, lines: Lines):
    """Flag the active blocks of a stencil as holding offsets; ``lines`` are of :data:`VECTORS`."""
    for n in range(4):  # the +4 undoes the shift of upper blocks along z, see slab_records
        accumulators.candidates[e, (lines.slab0[n] + 4) // BLOCK_NODES] = 1
        accumulators.candidates[e, (lines.slab2[n] + 4) // BLOCK_NODES] = 1


@wp.func
def empty_deposit(grid: Grid, x: wp.vec3):
    """Return the deposit of a massless particle at ``x``."""
    s = Deposit()
    stencil = stencil_at(grid_position(grid, x))
    s.base = stencil.base
    s.f = stencil.f
    return s


@wp.func
def impulse_of_stress(grid: Grid, step: Step, volume: float, tau: wp.mat33):
    """Return the change of affine momentum by a Kirchhoff stress over a substep [kg/s] (Hu et al. 2018, eq. 16)."""
    return (4.0 * step.dt * grid.inv_dx * grid.inv_dx * volume) * tau


@wp.func
def affine_momentum(grid: Grid, m: float, C: wp.mat33, stress: wp.mat33):
    """Return the change of momentum from node to node: that of the affine velocity less the impulse of ``stress``."""
    return grid.dx * (m * C - stress)


@wp.func
def with_momentum(s: Deposit, m: float, u: wp.vec3, k: wp.vec3, A: wp.mat33):
    """Return ``s`` with mass, physical momentum, which changes by ``A`` from node to node, and kinematic momentum."""
    s.A = A
    q = m * u - A * s.f
    s.at_base = vec8(m, q[0], q[1], q[2], k[0], k[1], k[2], 0.0)
    return s


@wp.func
def stress_impulse(grid: Grid, step: Step, particles: Particles, e: int, p: int, m: float, F: wp.mat33, C: wp.mat33):
    """Return :func:`impulse_of_stress` of a particle of mass ``m``.

    ``F`` and ``C`` are its gradients of deformation and velocity.
    """
    mu = particles.mu[row(e, particles.mu.shape[0]), p]
    lam = particles.lam[row(e, particles.lam.shape[0]), p]
    tau = kirchhoff_stress(particles.material[row(e, particles.material.shape[0]), p], F, mu, lam)
    retardation = particles.retardation[row(e, particles.retardation.shape[0]), p]
    if retardation > 0.0:
        tau += viscous_stress(C, wp.determinant(F), mu, lam, retardation)
    volume = particles.volume[row(e, particles.volume.shape[0]), p]
    q = shock_pressure(-wp.trace(C), m / volume, lam + 2.0 * mu, retardation, grid.dx, step.dt)
    return impulse_of_stress(grid, step, volume, tau - wp.diag(wp.vec3(q)))


@wp.func
def deposit_of(grid: Grid, step: Step, particles: Particles, moving: Moving, e: int, p: int, candidate: bool):
    """Return the deposit of particle ``p`` of environment ``e``.

    Contact acts on the total velocity; away from it, kinematic momentum would be added and subtracted again. So only
    contact candidates carry it (all particles with the ``"paper"`` decoupling, which needs its gradient).
    """
    s = empty_deposit(grid, moving.x[e, p])
    m = particles.mass[row(e, particles.mass.shape[0]), p]
    C = matrix_at(moving.C, e, p)  # loaded before the stress, which hides its latency
    stress = wp.mat33()
    if step.decoupling != NO_STRESS:
        stress = stress_impulse(grid, step, particles, e, p, m, matrix_at(moving.F, e, p), C)
    k = wp.vec3()
    if candidate or step.decoupling == PAPER:
        k = m * moving.vk[e, p]
    return with_momentum(s, m, moving.u[e, p], k, affine_momentum(grid, m, C, stress))


@wp.func
def momentum_bounds(s: Deposit):
    """Return bounds of the components of physical momentum anywhere in the stencil [kg m/s]."""
    bounds = wp.vec3()
    for c in range(3):
        reach = wp.abs(s.A[c, 0]) + wp.abs(s.A[c, 1]) + wp.abs(s.A[c, 2])
        center = s.at_base[1 + c] + s.A[c, 0] + s.A[c, 1] + s.A[c, 2]
        bounds[c] = wp.abs(center) + reach
    return bounds


@wp.func
def fault_of_sums(s: Deposit, quantum: float):
    """Return why a particle must not be added to fixed-point sums: bits ``FAILURE_*`` for not finite, or too large."""
    columns = s.A * wp.vec3(1.0, 1.0, 1.0)
    momentum = wp.vec3(s.at_base[1], s.at_base[2], s.at_base[3])
    kinematic = wp.vec3(s.at_base[4], s.at_base[5], s.at_base[6])
    if not wp.isfinite(wp.dot(momentum + kinematic + columns, wp.vec3(1.0, 1.0, 1.0))):
        return _NONFINITE
    most = wp.max(wp.max(wp.abs(momentum)), wp.max(wp.abs(kinematic)))
    for i in range(3):
        for j in range(3):
            most = wp.max(most, wp.abs(s.A[i, j]))
    return wp.where(most > MAX_QUANTA * quantum, _CFL, 0)


@wp.func
def fault_within(s: Deposit, bounds: wp.vec3, quantum: float):
    """Return :func:`fault_of_sums`, evaluated only if the ``bounds`` of the momentum do not rule a fault out."""
    fault = int(0)
    if not bounds[0] + bounds[1] + bounds[2] < MAX_QUANTA * quantum:  # also true for NaN
        fault = fault_of_sums(s, quantum)
    return fault


@wp.func
def takes_part(blocks: Blocks, e: int, failure: wp.array(dtype=int)):
    """Return whether an environment takes part: it is not frozen, and has enough active blocks.

    G2P of another part of the world may exhaust the active blocks in a parallel branch; particles processed earlier
    continue, and the grid update discards their contributions.
    """
    return (blocks.frozen[e] | (failure[e] & _BLOCKS)) == 0


@wp.func
def has_finite_velocity(moving: Moving, e: int, p: int):
    """Return whether the velocities of a particle are finite."""
    return wp.isfinite(wp.length_sq(moving.u[e, p]) + wp.length_sq(moving.vk[e, p]))


@wp.func
def admitted(takes: bool, moves: bool, e: int, failure: wp.array(dtype=int)):
    """Return whether a particle is added; flags the environment if it takes part but does not move finitely."""
    if takes and not moves:
        wp.atomic_or(failure, e, _NONFINITE)
    return takes and moves


@wp.func
def deposits(blocks: Blocks, moving: Moving, e: int, p: int, failure: wp.array(dtype=int)):
    """Return whether a particle is added; flags its environment if its velocity is not finite."""
    moves = has_finite_velocity(moving, e, p)  # loaded before takes_part is known, to hide its latency
    return admitted(takes_part(blocks, e, failure), moves, e, failure)


@wp.func
def near_boundary(grid: Grid, boundaries: Boundaries, e: int, x: wp.vec3):
    """Return whether a collider is near enough to a particle at ``x`` to make it a contact candidate."""
    return nearest_boundary(boundaries, e, x) < NEAR_PARTICLE * grid.dx


@wp.func
def is_near_field(grid: Grid, particles: Particles, contact: Contact, blocks: Blocks, e: int, p: int, base: wp.vec3i):
    """Return whether another field is active in a block of a particle's stencil."""
    return contact.num_fields > 1 and fields_around(grid, blocks, base, e) != (1 << particles.field[p])


@wp.func
def is_contact_candidate(
    grid: Grid,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    blocks: Blocks,
    e: int,
    p: int,
    x: wp.vec3,
    base: wp.vec3i,
):
    """Return whether another field or a collider is near a particle, so that it adds offsets and kinematic momentum."""
    if is_near_field(grid, particles, contact, blocks, e, p, base):
        return True
    return near_boundary(grid, boundaries, e, x)


@wp.kernel
def p2g(
    grid: Grid,
    step: Step,
    particles: Particles,
    boundaries: Boundaries,
    contact: Contact,
    moving: Moving,
    blocks: Blocks,
    # in and out
    failure: wp.array(dtype=int),
    accumulators: Accumulators,
):
    """Add mass, physical momentum with the stress impulse, and kinematic momentum to the nodes, a thread a particle."""
    e, p = wp.tid()
    if not deposits(blocks, moving, e, p, failure):
        return
    x = moving.x[e, p]
    stencil = stencil_at(grid_position(grid, x))
    near_field = is_near_field(grid, particles, contact, blocks, e, p, stencil.base)
    candidate = near_field or near_boundary(grid, boundaries, e, x)
    store_candidate(blocks, e, p, candidate, near_field)
    s = deposit_of(grid, step, particles, moving, e, p, candidate)
    field = particles.field[p]
    driven = candidate or step.decoupling == PAPER
    add_lines(accumulators, e, lines_of(grid, blocks, e, field, stencil, HALVES), s.at_base, s.A, driven)
    if candidate:
        lines = lines_of(grid, blocks, e, field, stencil, VECTORS)
        add_offset_lines(accumulators, e, lines, s.at_base[0], particles.seam[p], grid.dx)
        flag_candidate_blocks(accumulators, e, lines)
