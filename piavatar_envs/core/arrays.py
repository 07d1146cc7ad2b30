"""Vector types, and access to arrays with dense rows.

Warp's own indexing supports any strides and negative indices, which costs ten instructions an address on a GPU. All
arrays of this package have dense rows, so one multiplication finds an address.

Matrices of particles are stored by component, ``(num_envs, 9, num_particles)``, row-major: neighbouring threads then
read and write neighbouring words. Each component begins at a multiple of :data:`LINE` numbers, so that the store of a
warp never straddles cache lines.
"""

from __future__ import annotations

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


#: A symmetric 3 x 3 matrix: xx, xy, xz, yy, yz, zz.
vec6 = wp.types.vector(length=6, dtype=wp.float32)


vec12 = wp.types.vector(length=12, dtype=wp.float32)


vec16 = wp.types.vector(length=16, dtype=wp.float32)


#: A node record (see :mod:`piavatar_envs.mpm.grid_arrays`), or up to eight numbers that are summed together.
vec8 = wp.types.vector(length=8, dtype=wp.float32)


#: Half of a node record in fixed point.
vec4l = wp.types.vector(length=4, dtype=wp.int64)


#: One integer for each of the eight blocks, subblocks or nodes around a particle.
vec8i = wp.types.vector(length=8, dtype=wp.int32)


_ROW = "rows.data[rows.shape[1] * e + p]"


@wp.func_native("return values.data[n];")
def int_at(values: wp.array(dtype=int), n: int) -> int:
    """Return ``values[n]``."""
    ...


@wp.func_native("return values.data[n];")
def float_at(values: wp.array(dtype=float), n: int) -> float:
    """Return ``values[n]``."""
    ...


@wp.func_native(f"return {_ROW};")
def number_at(rows: wp.array2d(dtype=float), e: int, p: int) -> float:
    """Return ``rows[e, p]``."""
    ...


@wp.func_native(f"return {_ROW};")
def vector_at(rows: wp.array2d(dtype=wp.vec3), e: int, p: int) -> wp.vec3:
    """Return ``rows[e, p]``."""
    ...


@wp.func_native(f"wp::vec3 value;\nif (p >= first) value = {_ROW};\nreturn value;")
def vector_from(rows: wp.array2d(dtype=wp.vec3), first: int, e: int, p: int) -> wp.vec3:
    """Return ``rows[e, p]``, or zero for ``p < first``, without a branch that waits for the load."""
    ...


@wp.func_native(f"{_ROW} = value;")
def set_vector(rows: wp.array2d(dtype=wp.vec3), e: int, p: int, value: wp.vec3):
    """Write ``rows[e, p] = value``."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const char* const line = reinterpret_cast<const char*>(&rows.data[rows.shape[1] * e + p]) + 128 * thread;
if (128 * thread < (int)sizeof(*rows.data) * count) asm volatile("prefetch.global.L2 [%0];" :: "l"(line));
#endif
""")
def prefetch_rows(rows: wp.array2d(dtype=wp.vec3), e: int, p: int, count: int, thread: int):
    """Prefetch ``rows[e, p : p + count]`` into the L2 cache of a GPU, one line of 128 bytes a thread."""
    ...


# Unrolled loads of 16 bytes keep several rows in flight.
_ADD_ROWS = """
constexpr int WORDS = %d;
wp::vec_t<WORDS, wp::float32> sum;
const auto* const from = &wp::index(rows, e, 0);
#if defined(__CUDA_ARCH__)
#pragma unroll 4
for (int n = first; n < last; ++n)
#pragma unroll
    for (int q = 0; q < WORDS / 4; ++q) {
        const float4 four = reinterpret_cast<const float4*>(from + n)[q];
        sum[4 * q] += four.x, sum[4 * q + 1] += four.y, sum[4 * q + 2] += four.z, sum[4 * q + 3] += four.w;
    }
#else
for (int n = first; n < last; ++n)
    for (int k = 0; k < WORDS; ++k) sum[k] += from[n][k];
#endif
return sum;
"""


@wp.func_native(_ADD_ROWS % 12)
def add_rows12(rows: wp.array2d(dtype=vec12), e: int, first: int, last: int) -> vec12:
    """Return the sum of ``rows[e, first : last]``, added in order."""
    ...


@wp.func_native(_ADD_ROWS % 16)
def add_rows16(rows: wp.array2d(dtype=vec16), e: int, first: int, last: int) -> vec16:
    """Return the sum of ``rows[e, first : last]``, added in order."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const float4 v = *reinterpret_cast<const float4*>(&wp::index(node, e, r));
return wp::vec_t<4, wp::float32>(v.x, v.y, v.z, v.w);
#else
return wp::index(node, e, r);
#endif
""")
def read_vec4(node: wp.array2d(dtype=wp.vec4), e: int, r: int) -> wp.vec4:
    """Return ``node[e, r]``, on a GPU with one load of 16 bytes."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
*reinterpret_cast<float4*>(&wp::index(node, e, r)) = make_float4(value[0], value[1], value[2], value[3]);
#else
wp::index(node, e, r) = value;
#endif
""")
def write_vec4(node: wp.array2d(dtype=wp.vec4), e: int, r: int, value: wp.vec4):
    """Write ``node[e, r] = value``, on a GPU with one store of 16 bytes."""
    ...


_STORE = """
#if defined(__CUDA_ARCH__)
constexpr unsigned ALL = 0xffffffffu;
constexpr int STAGE = 96;  // words of a warp: 32 vectors
__shared__ float stages[WP_TILE_BLOCK_DIM / 32 * STAGE];  // as many threads as the module is compiled for
const int lane = threadIdx.x & 31;
float* const stage = stages + (threadIdx.x >> 5) * STAGE;
const bool whole = __activemask() == ALL && blockDim.x <= WP_TILE_BLOCK_DIM;
bool together = false;
if (whole) {  // every thread of the warp must reach each exchange, or the warp deadlocks
    const int first = __shfl_sync(ALL, p, 0), row = __shfl_sync(ALL, e, 0);
    together = __all_sync(ALL, store && p == first + lane && e == row);
}
auto put = [&](auto& into, const auto& value) {
    if (!together) {
        if (store) wp::index(into, e, p) = value;
        return;
    }
    float* const first = reinterpret_cast<float*>(&wp::index(into, e, p - lane));
#pragma unroll
    for (int c = 0; c < 3; ++c) stage[3 * lane + c] = value[c];
    __syncwarp();
#pragma unroll
    for (int c = 0; c < 3; ++c) first[32 * c + lane] = stage[32 * c + lane];
    __syncwarp();
};
%s
#else
auto put = [&](auto& into, const auto& value) {
    if (store) wp::index(into, e, p) = value;
};
%s
#endif
"""


@wp.func_native(_STORE % (("put(into, value);",) * 2))
def store_vector(into: wp.array2d(dtype=wp.vec3), e: int, p: int, value: wp.vec3, store: bool):
    """Write ``into[e, p] = value`` if ``store``, in whole cache lines if all threads of the warp call this together."""
    ...


@wp.func_native(_STORE % (("put(first, one); if (second_too) put(second, other);",) * 2))
def store_pair(
    first: wp.array2d(dtype=wp.vec3),
    second: wp.array2d(dtype=wp.vec3),
    e: int,
    p: int,
    one: wp.vec3,
    other: wp.vec3,
    second_too: bool,
    store: bool,
):
    """Write one vector, and a second one if ``second_too``, equal for all threads; see :func:`store_vector`."""
    ...


@wp.func_native(_STORE % (("put(first, one); put(second, two); put(third, three);",) * 2))
def store_triple(
    first: wp.array2d(dtype=wp.vec3),
    second: wp.array2d(dtype=wp.vec3),
    third: wp.array2d(dtype=wp.vec3),
    e: int,
    p: int,
    one: wp.vec3,
    two: wp.vec3,
    three: wp.vec3,
    store: bool,
):
    """Write three vectors; see :func:`store_vector`."""
    ...


#: Numbers in a cache line of a GPU; components begin at multiples of it.
LINE = 32


_COMPONENTS = """
char* const first = reinterpret_cast<char*>(rows.data) + wp::int64(rows.strides[0]) * e;
wp::float32* const at = reinterpret_cast<wp::float32*>(first) + p;
const int n = rows.strides[1] / 4;
"""


@wp.func_native(
    _COMPONENTS
    + "return wp::mat33(at[0], at[n], at[2 * n], at[3 * n], at[4 * n], at[5 * n], at[6 * n], at[7 * n], at[8 * n]);"
)
def matrix_at(rows: wp.array3d(dtype=float), e: int, p: int) -> wp.mat33:
    """Return the matrix of particle ``p`` in environment ``e``."""
    ...


@wp.func_native(
    _COMPONENTS
    + """
#pragma unroll
for (int c = 0; c < 9; ++c) at[c * n] = value.data[c / 3][c % 3];
"""
)
def store_matrix(rows: wp.array3d(dtype=float), e: int, p: int, value: wp.mat33):
    """Write the matrix of particle ``p`` in environment ``e``."""
    ...


def whole_lines(num_particles: int) -> int:
    """Return how many numbers a component of ``num_particles`` particles occupies."""
    return -(-num_particles // LINE) * LINE


def allocate_matrices(num_envs: int, num_particles: int, device: str) -> wp.array:
    """Allocate zeros of shape ``(num_envs, 9, num_particles)``, each component aligned to :data:`LINE`."""
    return wp.zeros((num_envs, 9, whole_lines(num_particles)), dtype=float, device=device)[:, :, :num_particles]


def matrices_of(components: wp.array | np.ndarray) -> np.ndarray:
    """Convert components to matrices, ``(..., 9, num_particles)`` to ``(..., num_particles, 3, 3)``; returns a copy."""
    values = components if isinstance(components, np.ndarray) else components.numpy()
    matrices = np.ascontiguousarray(np.moveaxis(values, -2, -1))  # on a CPU the values are the array's own memory
    return matrices.reshape(*values.shape[:-2], values.shape[-1], 3, 3)


def components_of(matrices: np.ndarray) -> np.ndarray:
    """Convert matrices to components in single precision: the inverse of :func:`matrices_of`."""
    values = np.asarray(matrices, np.float32)
    return np.ascontiguousarray(np.moveaxis(values.reshape(*values.shape[:-2], 9), -1, -2))
