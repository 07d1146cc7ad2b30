"""Sums over the lines of nodes of a stencil, on a CPU four numbers at a time.

Of products and sums of ``vec4`` in functions of their own, a compiler for a CPU makes operations on two numbers, and
none that multiplies and adds; here it sees all of them together.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.records import TO_KINEMATIC
from piavatar_envs.mpm.stencil import BLOCK_NODES, Stencil
from piavatar_envs.mpm.stencil_records import slab_records
from piavatar_envs.mpm.types import Blocks, Grid, Sums, vec8

wp.set_module_options({"enable_backward": False})

# Places of a line's nodes as piavatar_envs.mpm.stencil_records has them, of all nine lines, one after the other.
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
// calls what is to be done with the places of the three nodes of line j of plane i
auto with_line = [&](int i, int j, auto visit) {
    const wp::vec_t<4, wp::int32>& slab = i == 0 ? lines.slab0 : i == 1 ? lines.slab1 : lines.slab2;
    const bool upper = by + j > 3;
    const int within = 16 * ((bx + i) & 3) + 4 * ((by + j) & 3) + bz;
    const int first = slab[upper ? 2 : 0] + within, last = slab[upper ? 3 : 1] + within;
    visit(first, (bz == 3 ? last : first) + 1, last + 2);
};
"""


@wp.struct
class Lines:
    """The nine lines of a stencil: where their nodes are in an array, and what they weigh."""

    of: Stencil
    slab0: wp.vec4i  # places of the three planes, see :func:`piavatar_envs.mpm.stencil_records.slab_records`
    slab1: wp.vec4i
    slab2: wp.vec4i


@wp.func
def lines_of(grid: Grid, blocks: Blocks, e: int, field: int, stencil: Stencil, of_block: int):
    """Lines of a stencil in an array of ``of_block`` entries a block."""
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
def gather_lines(
    nodes: wp.uint64,
    lines: Lines,
) -> wp.mat44:
    """Weighted sum of the halves of records in ``nodes``, and those times the nodes' places along x, y and z."""
    ...


# Who adds to the vectors of an environment; on a CPU no two threads have particles of the same.
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
const auto add = adding_to(sums.value, e);
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
def scatter_lines(
    sums: Sums,
    e: int,
    lines: Lines,
    at_base: vec8,
    A: wp.mat33,
    driven: bool,
):
    """Add mass, momentum that is ``at_base`` and changes by ``A``, and if ``driven`` kinematic momentum to nodes."""
    ...


@wp.func_native(
    _LINES
    + _ADDING
    + """
const auto add = adding_to(sums.offset, e);
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
def scatter_places(
    sums: Sums,
    e: int,
    lines: Lines,
    mass: float,
    seam: float,
    dx: float,
):
    """Tell the nodes where a particle is; ``lines`` are of ``VECTORS``."""
    ...


@wp.func
def note_told(sums: Sums, e: int, lines: Lines):
    """Note that nodes in the blocks of a stencil have been told something; ``lines`` are of ``VECTORS``."""
    for n in range(4):  # what is less by 4 is the last of two along z, see slab_records
        sums.told[e, (lines.slab0[n] + 4) // BLOCK_NODES] = 1
        sums.told[e, (lines.slab2[n] + 4) // BLOCK_NODES] = 1
