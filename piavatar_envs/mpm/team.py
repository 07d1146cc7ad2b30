"""What the eight threads that a particle has do together: they share the nodes of its stencil, and what it becomes.

A thread has the nodes ``t``, ``t + 8``, ``t + 16`` and, if it is one of the first three, ``t + 24`` of the 27, in the
order of x, y and z. What they find is added up by exchanges, after which all of them know it.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.gather import Gathered
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.types import Moving, Particles, Sums

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Nodes that a thread has.
NODES = wp.constant(4)
#: Where the numbers of a particle begin among those that its threads have read, three each: see :func:`read_by_team`.
_F, _VK, _SPIN, _MASS, _VOLUME, _MU, _LAM, _MATERIAL, _UNITS = (
    wp.constant(n) for n in (0, 9, 12, 15, 16, 17, 18, 19, 20)
)
KINEMATIC_VELOCITY, SPIN, MASS = _VK, _SPIN, _MASS


@wp.func_native(
    native(
        """
const int node = (threadIdx.x & 7) + 8 * n;
if (node > 26) return wp::vec_t<3, wp::int32>(-1, 0, 0);
const int line = node * 11 >> 5;  // a third
const int plane = node * 57 >> 9;  // a ninth
return wp::vec_t<3, wp::int32>(plane, line - 3 * plane, node - 3 * line);
""",
        "return wp::vec_t<3, wp::int32>(-1, 0, 0);",
    )
)
def node_of_thread(n: int) -> wp.vec3i:
    """Place in the stencil of the ``n``-th node that a thread has; -1 along x if it has none."""
    ...


@wp.func_native(
    native(
        """
const int i = (base[0] & 3) + node[0], j = (base[1] & 3) + node[1], k = (base[2] & 3) + node[2];
const int from = (threadIdx.x & 24) | (i & 4) | (j >> 1 & 2) | (k >> 2 & 1);
return __shfl_sync(0xffffffffu, record, from) + 16 * (i & 3) + 4 * (j & 3) + (k & 3);
""",
        "return record;",
    )
)
def record_in_team(base: wp.vec3i, node: wp.vec3i, record: int) -> int:
    """Record of a ``node`` of the stencil at ``base``.

    ``record`` is the first of the block that the thread has looked up, see
    :func:`piavatar_envs.mpm.singles.block_of_thread`. All threads of a warp come here.
    """
    ...


@wp.func_native("return n == 0 ? w[0] : n == 1 ? w[1] : w[2];")
def weight_at(w: wp.vec3, n: int) -> float:
    """``w[n]`` out of registers."""
    ...


@wp.func_native(
    native(
        """
wp::mat_t<4, 4, wp::float32> sums = own;
#pragma unroll
for (int distance = 1; distance < 8; distance *= 2)
#pragma unroll
    for (int i = 0; i < 4; ++i)
#pragma unroll
        for (int c = 1; c < 4; ++c) sums.data[i][c] += __shfl_xor_sync(0xffffffffu, sums.data[i][c], distance);
return sums;
""",
        "return own;",
    )
)
def sum_of_team(own: wp.mat44) -> wp.mat44:
    """Sum of the last three columns over the threads of a particle; all threads of a warp come here."""
    ...


def _vector_sum(threads: int) -> str:
    return native(
        f"""
wp::vec_t<3, wp::float32> sum = own;
#pragma unroll
for (int distance = 1; distance < {threads}; distance *= 2)
#pragma unroll
    for (int c = 0; c < 3; ++c) sum[c] += __shfl_xor_sync(0xffffffffu, sum[c], distance);
return sum;
""",
        "return own;",
    )


@wp.func_native(_vector_sum(8))
def vector_sum_of_team(own: wp.vec3) -> wp.vec3:
    """Sum over the threads of a particle; all threads of a warp come here."""
    ...


@wp.func_native(_vector_sum(32))
def vector_sum_of_warp(own: wp.vec3) -> wp.vec3:
    """Sum over the threads of a warp; all of them come here."""
    ...


@wp.func_native(
    native("""
int4* const first = reinterpret_cast<int4*>(&wp::index(sums.fixed, e, 2 * record)) + (threadIdx.x & 31);
const int4 zero = make_int4(0, 0, 0, 0);  // two for each of the 64 physical halves, then as many kinematic ones
#pragma unroll
for (int n = 0; n < 128; n += 32) first[n] = zero;
if (driven)
#pragma unroll 1
    for (int n = 128; n < 256; n += 32) first[n] = zero;
""")
)
def clear_halves(sums: Sums, e: int, record: int, driven: bool):
    """Zero the sums of a slot's nodes, from its first ``record``, the kinematic ones only if any were ``driven``."""
    ...


@wp.func_native(
    native(
        """
const int row = threadIdx.x & 7, matrix = row < 5 ? row - 2 : row - 5;
const int apart = moved.C.strides[1] / 4;  // the components of both matrices
float a[3];
#pragma unroll
for (int c = 0; c < 3; ++c) {
    a[c] = row == 0 ? s.x[c] : s.u[c];
#pragma unroll
    for (int r = 0; r < 3; ++r) {
        if (row == 2 + r) a[c] = s.C.data[r][c];
        if (row == 5 + r) a[c] = s.F.data[r][c];
    }
}
// an array chosen by a thread would be copied to its own memory, so addresses are
auto at = [=](const auto& array, int words) {
    return (float*)((char*)array.data + (wp::int64)array.strides[0] * e) + words;
};
float* to = at(moved.x, 3 * p);
if (row == 1) to = at(moved.u, 3 * p);
if (row > 1) to = at(moved.C, 3 * matrix * apart + p);
if (row > 4) to = at(moved.F, 3 * matrix * apart + p);
const int next = row < 2 ? 1 : apart;
#pragma unroll
for (int c = 0; c < 3; ++c) to[c * next] = a[c];
""",
        "",
    )
)
def store_by_team(moved: Moving, e: int, p: int, s: Gathered):
    """Write what a particle has become, a vector or a row of a matrix a thread."""
    ...


@wp.func_native(
    native(
        f"""
const int t = threadIdx.x & 7;
// an array chosen by a thread would be copied to its own memory, so addresses are
auto at = [=](const auto& array, int words) {{
    return (const float*)((const char*)array.data + (wp::int64)array.strides[0] * e) + words;
}};
auto constant = [=](const auto& array, int word) {{
    const int row = min(e, (int)array.shape[0] - 1);
    return (const float*)((const char*)array.data + (wp::int64)array.strides[0] * row) + word;
}};
const int apart = moved.F.strides[1] / 4;
const float* second = at(moved.F, 8 * apart + p);
if (t >= {int(_VK) - 8}) second = at(moved.vk, 3 * p + t - {int(_VK) - 8});
if (t >= {int(_SPIN) - 8}) second = at(moved.spin, 3 * p + t - {int(_SPIN) - 8});
if (t == {int(_MASS) - 8}) second = constant(particles.mass, p);
const float* third = constant(particles.volume, p);
if (t == {int(_MU) - 16}) third = constant(particles.mu, p);
if (t == {int(_LAM) - 16}) third = constant(particles.lam, p);
if (t == {int(_MATERIAL) - 16}) third = constant(particles.material, p);
if (t == {int(_UNITS) - 16}) third = constant(sums.mass_unit, field);
if (t == {int(_UNITS) - 15}) third = constant(sums.momentum_unit, field);
return wp::vec_t<3, wp::float32>(*at(moved.F, t * apart + p), *second, *third);
""",
        "return wp::vec_t<3, wp::float32>();",
    )
)
def read_by_team(particles: Particles, moved: Moving, sums: Sums, e: int, p: int, field: int) -> wp.vec3:
    """A thread's three of the numbers of a particle of a ``field``.

    Those are its deformation, kinematic velocity, spin and substance, and the units of its sums: they would take many
    registers of every thread until it needs them, and as many loads.
    """
    ...


def _of_team(result: str, otherwise: str) -> str:
    share = "auto number = [=](int n) { return __shfl_sync(0xffffffffu, read[n >> 3], (threadIdx.x & 24) | (n & 7)); };"
    return native(f"{share}\nreturn {result};", f"return {otherwise};")


@wp.func_native(_of_team("wp::mat33(" + ", ".join(f"number({n})" for n in range(9)) + ")", "wp::mat33()"))
def deformation_of_team(read: wp.vec3) -> wp.mat33:
    """Deformation gradient out of what the threads have :func:`read_by_team`, as are those below."""
    ...


@wp.func_native(_of_team("wp::vec3(number(first), number(first + 1), number(first + 2))", "wp::vec3()"))
def vector_of_team(read: wp.vec3, first: int) -> wp.vec3:
    """The vector whose numbers begin at ``first``."""
    ...


@wp.func_native(_of_team("number(n)", "0.0f"))
def number_of_team(read: wp.vec3, n: int) -> float:
    """The ``n``-th number."""
    ...


@wp.func_native(_of_team(f"__float_as_int(number({int(_MATERIAL)}))", "0"))
def material_of_team(read: wp.vec3) -> int:
    """The particle's material."""
    ...


@wp.struct
class Substance:
    """What a particle is made of, see :class:`piavatar_envs.mpm.types.Particles`."""

    mass: float
    volume: float
    mu: float
    lam: float
    material: int


@wp.func
def substance_of_team(read: wp.vec3):
    """What the particle is made of."""
    s = Substance()
    s.mass = number_of_team(read, _MASS)
    s.volume = number_of_team(read, _VOLUME)
    s.mu = number_of_team(read, _MU)
    s.lam = number_of_team(read, _LAM)
    s.material = material_of_team(read)
    return s


@wp.func
def units_of_team(read: wp.vec3):
    """Units of mass [kg] and of momentum [kg m/s]."""
    return wp.vec2(number_of_team(read, _UNITS), number_of_team(read, _UNITS + 1))


@wp.func
def field_of(several: bool, particles: Particles, p: int):
    """Field of a particle; nothing is read where there are not ``several``."""
    field = int(0)
    if several:
        field = particles.field[p]
    return field
