"""Cholesky factors in the shared memory of a warp, which has a CUDA block of its own. Nothing here runs on a CPU.

See :mod:`piavatar_envs.avatar.cholesky`, which has the same in plain Warp. A warp has :data:`ROOM` words, where a
factor stays until the next one comes: what is solved with it need not fetch it again.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Rows of the largest matrix that there is room for.
MOST_ROWS = 72
_FACTOR = MOST_ROWS * (MOST_ROWS + 1) // 2
#: Words of shared memory of a warp: a factor, and three rows of it by columns.
ROOM = _FACTOR + 4 * MOST_ROWS
_AT = "float* const room = reinterpret_cast<float*>(at);"


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
__shared__ float __align__(16) room[{ROOM}];
return reinterpret_cast<wp::uint64>(room);
#else
return 0;
#endif
""")
def room_of_warp() -> wp.uint64:
    """Room of a warp that has a CUDA block of its own."""
    ...


# The rows of a joint are eliminated together, so that an entry is read and written once for three of them. Lanes have
# columns; the three numbers of a row i, and where it starts, all lanes read at once. Four rows are read before one is
# written, or each would wait for the one before.
@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
{_AT}
float4* const joint = reinterpret_cast<float4*>(room + {_FACTOR});
const int lane = threadIdx.x & 31, size = matrix.shape[1];
const float* const from = &wp::index(matrix, source, 0, 0);
const float* const more = &wp::index(diagonal, e, 0);
for (int part = 0; part < size; part += 32) {{
    const int j = part + lane;
#pragma unroll 8
    for (int i = part; i < size; ++i)
        if (j <= i) room[i * (i + 1) / 2 + j] = from[i * size + j] + (j == i ? more[i] : 0.0f);
}}
__syncwarp();
for (int k = size - 3; k >= 0; k -= 3) {{
    const int first = __ldg(start.data + k), count = __ldg(start.data + k + 1) - first;
    const int* const column = columns.data + first;
    float* const row0 = room + k * (k + 1) / 2;
    float* const row1 = row0 + k + 1;
    float* const row2 = row1 + k + 2;
    const float d2 = sqrtf(row2[k + 2]), over2 = 1.0f / d2, l21 = row2[k + 1] * over2, l20 = row2[k] * over2;
    const float d1 = sqrtf(row1[k + 1] - l21 * l21), over1 = 1.0f / d1, l10 = (row1[k] - l21 * l20) * over1;
    const float d0 = sqrtf(row0[k] - l20 * l20 - l10 * l10), over0 = 1.0f / d0;
    __syncwarp();
    if (lane == 0) {{
        row2[k + 2] = d2; row2[k + 1] = l21; row2[k] = l20;
        row1[k + 1] = d1; row1[k] = l10;
        row0[k] = d0;
    }}
    for (int n = lane; n < count; n += 32) {{
        const int j = __ldg(column + n);
        const float a2 = row2[j] * over2, a1 = (row1[j] - l21 * a2) * over1;
        const float a0 = (row0[j] - l20 * a2 - l10 * a1) * over0;
        row2[j] = a2; row1[j] = a1; row0[j] = a0;
        joint[n] = make_float4(a0, a1, a2, __int_as_float(j * (j + 1) / 2));
    }}
    __syncwarp();
    for (int part = 0; part < count; part += 32) {{
        const int n = part + lane;
        const bool has = n < count;
        const int j = has ? __ldg(column + n) : 0;
        const float4 own = joint[has ? n : 0];
        for (int m = part; m < count; m += 4) {{
            float value[4];
            int at[4];
#pragma unroll
            for (int q = 0; q < 4; ++q) {{
                const bool mine = has && m + q >= n && m + q < count;
                const float4 a = joint[m + q < count ? m + q : 0];
                at[q] = mine ? __float_as_int(a.w) + j : -1;
                value[q] = (mine ? room[at[q]] : 0.0f) - a.x * own.x - a.y * own.y - a.z * own.z;
            }}
#pragma unroll
            for (int q = 0; q < 4; ++q)
                if (at[q] >= 0) room[at[q]] = value[q];
        }}
    }}
    __syncwarp();
}}
#endif
""")
def factorize_together(
    start: wp.array(dtype=int),
    columns: wp.array(dtype=int),
    matrix: wp.array3d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    source: int,
    e: int,
    at: wp.uint64,
):
    """The factor of matrix ``source`` and diagonal ``e``, as :mod:`piavatar_envs.avatar.cholesky` has it."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
{_AT}
float4* const to = reinterpret_cast<float4*>(&wp::index(factor, f, 0));
for (int n = threadIdx.x & 31; n < factor.shape[1] / 4; n += 32) to[n] = reinterpret_cast<const float4*>(room)[n];
__syncwarp();  // the room is free
#endif
""")
def store_factor(at: wp.uint64, f: int, factor: wp.array2d(dtype=float)):
    """Write factor ``f`` from a warp's room."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
{_AT}
const float4* const from = reinterpret_cast<const float4*>(&wp::index(factor, f, 0));
__syncwarp();
#pragma unroll 4
for (int n = threadIdx.x & 31; n < factor.shape[1] / 4; n += 32) reinterpret_cast<float4*>(room)[n] = from[n];
__syncwarp();
#endif
""")
def load_factor(factor: wp.array2d(dtype=float), f: int, at: wp.uint64):
    """Read factor ``f`` into a warp's room."""
    ...


# Lanes have the components of x in registers, and tell each other the one that is found next. Both substitutions go by
# columns of what is left: triangular numbers of 32 rows differ modulo 32, so lanes read from different banks.
@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
{_AT}
const int lane = threadIdx.x & 31, size = x.shape[1];
float* const result = &wp::index(x, e, 0);
constexpr int PARTS = {-(-MOST_ROWS // 32)};
float value[PARTS], over[PARTS];
__syncwarp();
#pragma unroll
for (int q = 0; q < PARTS; ++q) {{
    const int i = 32 * q + lane;
    value[q] = i < size ? result[i] : 0.0f;
    over[q] = i < size ? 1.0f / room[i * (i + 1) / 2 + i] : 0.0f;
}}
#pragma unroll
for (int part = PARTS - 1; part >= 0; --part)
    for (int k = min(size, 32 * part + 32) - 1; k >= 32 * part; --k) {{
        const float found = __shfl_sync(0xffffffffu, value[part] * over[part], k & 31);
        if (lane == (k & 31)) value[part] = found;
#pragma unroll
        for (int q = 0; q <= part; ++q)
            if (32 * q + lane < k) value[q] -= room[k * (k + 1) / 2 + 32 * q + lane] * found;
    }}
#pragma unroll
for (int part = 0; part < PARTS; ++part)
    for (int k = 32 * part; k < min(size, 32 * part + 32); ++k) {{
        const float found = __shfl_sync(0xffffffffu, value[part] * over[part], k & 31);
        if (lane == (k & 31)) value[part] = found;
#pragma unroll
        for (int q = part; q < PARTS; ++q) {{
            const int i = 32 * q + lane;
            if (i > k && i < size) value[q] -= room[i * (i + 1) / 2 + k] * found;
        }}
    }}
#pragma unroll
for (int q = 0; q < PARTS; ++q)
    if (32 * q + lane < size) result[32 * q + lane] = value[q];
#endif
""")
def solve_together(at: wp.uint64, e: int, x: wp.array2d(dtype=float)):
    """What is solved with the factor in a warp's room; ``x[e]`` has the right-hand side at first."""
    ...
