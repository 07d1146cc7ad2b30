"""Cholesky factors in the shared memory of a warp, which has a CUDA block of its own. Nothing here runs on a CPU.

See :mod:`piavatar_envs.avatar.cholesky`, which has the same in plain Warp. A warp has :data:`ROOM` words, where a
factor stays until the next one comes: what is solved with it need not fetch it again.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Rows of the largest matrix that there is room for: as many as an avatar has. 16 warps have room in a multiprocessor,
#: so that those of 2,048 environments are all at work at once.
MOST_ROWS = 69
_FACTOR = -(-MOST_ROWS * (MOST_ROWS + 1) // 2 // 4) * 4
#: Words of shared memory of a warp: a factor, and from :data:`SPARE` on three rows of it by columns, while it is found,
#: or what is divided by, while it is solved with.
SPARE = _FACTOR
ROOM = SPARE + 4 * MOST_ROWS
_AT = "float* const room = reinterpret_cast<float*>(at);"


# The rows of a joint are eliminated together, so that an entry is read and written once for three of them. What it
# loses is the product of two of the joint's columns: which, and where it is, a list says, or most lanes of a warp would
# go through rows that have no entries. A lane has three entries of a row at a time, of which those beyond the diagonal
# are none; two of these are read before one is written, or each would wait for the one before.
_ELIMINATE = f"""
float4* const joint = reinterpret_cast<float4*>(room + {_FACTOR});
for (int k = size - 3; k >= 0; k -= 3) {{
    const int first = __ldg(start.data + k), count = __ldg(start.data + k + 1) - first;
    const int last_pair = __ldg(pair_start.data + k / 3 + 1);
    const int* const column = columns.data + first;
    float* const row0 = room + k * (k + 1) / 2;
    float* const row1 = row0 + k + 1;
    float* const row2 = row1 + k + 2;
    const float s2 = row2[k + 2], over2 = rsqrtf(s2), l21 = row2[k + 1] * over2, l20 = row2[k] * over2;
    const float s1 = row1[k + 1] - l21 * l21, over1 = rsqrtf(s1), l10 = (row1[k] - l21 * l20) * over1;
    const float s0 = row0[k] - l20 * l20 - l10 * l10, over0 = rsqrtf(s0);
    __syncwarp();
    if (lane == 0) {{
        row2[k + 2] = s2 * over2; row2[k + 1] = l21; row2[k] = l20;
        row1[k + 1] = s1 * over1; row1[k] = l10;
        row0[k] = s0 * over0;
    }}
    for (int n = lane; n < count; n += 32) {{
        const int j = __ldg(column + n);
        const float a2 = row2[j] * over2, a1 = (row1[j] - l21 * a2) * over1;
        const float a0 = (row0[j] - l20 * a2 - l10 * a1) * over0;
        row2[j] = a2; row1[j] = a1; row0[j] = a0;
        joint[n] = make_float4(a0, a1, a2, 0.0f);
    }}
    __syncwarp();
    for (int n = __ldg(pair_start.data + k / 3) + lane; n < last_pair; n += 64) {{
        float value[2][3];
        int at[2], own[2];
#pragma unroll
        for (int q = 0; q < 2; ++q) {{
            const int which = n + 32 * q < last_pair ? __ldg(pair.data + n + 32 * q) : 0;
            const int i = which >> 8 & 255, j = which & 255;
            const float4 a = joint[i];
            at[q] = which >> 16;
            own[q] = n + 32 * q < last_pair ? i - j : -1;
#pragma unroll
            for (int c = 0; c < 3; ++c) {{
                const float4 b = joint[j + c];
                value[q][c] = room[at[q] + c] - a.x * b.x - a.y * b.y - a.z * b.z;
            }}
        }}
#pragma unroll
        for (int q = 0; q < 2; ++q)
#pragma unroll
            for (int c = 0; c < 3; ++c)
                if (c <= own[q]) room[at[q] + c] = value[q][c];
    }}
    __syncwarp();
}}
"""


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
{_AT}
const int lane = threadIdx.x & 31, size = matrix.shape[1], entries = entry.shape[0];
const float* const from = &wp::index(matrix, source, 0, 0);
const float* const more = &wp::index(diagonal, e, 0);
for (int n = lane; n < {_FACTOR} / 4; n += 32) reinterpret_cast<float4*>(room)[n] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
__syncwarp();
#pragma unroll 8
for (int n = lane; n < entries; n += 32) {{
    const int i = __ldg(entry.data + n) >> 8, j = __ldg(entry.data + n) & 255;
    room[i * (i + 1) / 2 + j] = from[i * size + j] + (j == i ? more[i] : 0.0f);
}}
__syncwarp();
{_ELIMINATE}
#endif
""")
def factorize_together(
    start: wp.array(dtype=int),
    columns: wp.array(dtype=int),
    entry: wp.array(dtype=int),
    pair_start: wp.array(dtype=int),
    pair: wp.array(dtype=int),
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
const int lane = threadIdx.x & 31, size = diagonal.shape[1];
for (int i = lane; i < size; i += 32) room[i * (i + 1) / 2 + i] += wp::index(diagonal, e, i);
for (int n = size * (size + 1) / 2 + lane; n < {_FACTOR}; n += 32) room[n] = 0.0f;
__syncwarp();
{_ELIMINATE}
#endif
""")
def eliminate_together(
    start: wp.array(dtype=int),
    columns: wp.array(dtype=int),
    pair_start: wp.array(dtype=int),
    pair: wp.array(dtype=int),
    diagonal: wp.array2d(dtype=float),
    e: int,
    at: wp.uint64,
):
    """:func:`factorize_together` of the matrix that :func:`set_in_rooms` has written to the room."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
{_AT}
#pragma unroll
for (int a = 0; a < 3; ++a)
#pragma unroll
    for (int b = 0; b < 3; ++b)
        if (j + b <= i + a) {{
            float* const to = room + (i + a) * (i + a + 1) / 2 + j + b;
            to[0] = to[{ROOM}] = block.data[a][b];
        }}
#endif
""")
def set_in_rooms(at: wp.uint64, i: int, j: int, block: wp.mat33):
    """Write 3 x 3 entries, from row ``i`` and column ``j`` on, to a matrix in each of two rooms, if in the triangle."""
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
#pragma unroll 10
for (int n = threadIdx.x & 31; n < factor.shape[1] / 4; n += 32) reinterpret_cast<float4*>(room)[n] = from[n];
__syncwarp();
#endif
""")
def load_factor(factor: wp.array2d(dtype=float), f: int, at: wp.uint64):
    """Read factor ``f`` into a warp's room."""
    ...


# Lanes have the components of one or more vectors in registers, thirty of a part so that those of a joint are together,
# and tell each other the three of a joint at once. Both substitutions go by columns of what is left: triangular numbers
# of 32 rows differ modulo 32, so lanes read from different banks.
_SOLVE = """
#if defined(__CUDA_ARCH__)
%(at)s
constexpr int VECTORS = %(vectors)d, PARTS = %(parts)d, PART = 30;
const int lane = threadIdx.x & 31, size = x.shape[1];
float* const over = room + %(factor)d;
float value[VECTORS][PARTS];
for (int i = lane; i < size; i += 32) over[i] = 1.0f / room[i * (i + 1) / 2 + i];
#pragma unroll
for (int q = 0; q < PARTS; ++q)
#pragma unroll
    for (int v = 0; v < VECTORS; ++v)
        value[v][q] = lane < PART && PART * q + lane < size ? wp::index(x, first + v * step, PART * q + lane) : 0.0f;
__syncwarp();
#pragma unroll
for (int part = PARTS - 1; part >= 0; --part)
    for (int k = min(size, PART * part + PART) - 3; k >= PART * part; k -= 3) {
        const float* const row0 = room + k * (k + 1) / 2;
        const float* const row1 = row0 + k + 1;
        const float* const row2 = row1 + k + 2;
        const float o0 = over[k], o1 = over[k + 1], o2 = over[k + 2], l10 = row1[k], l20 = row2[k], l21 = row2[k + 1];
        const int own = k - PART * part;
#pragma unroll
        for (int v = 0; v < VECTORS; ++v) {
            const float f0 = __shfl_sync(0xffffffffu, value[v][part], own);
            const float f1 = __shfl_sync(0xffffffffu, value[v][part], own + 1);
            const float x2 = __shfl_sync(0xffffffffu, value[v][part], own + 2) * o2;
            const float x1 = (f1 - l21 * x2) * o1, x0 = (f0 - l20 * x2 - l10 * x1) * o0;
            if (lane >= own && lane < own + 3) value[v][part] = lane == own ? x0 : lane == own + 1 ? x1 : x2;
#pragma unroll
            for (int q = 0; q <= part; ++q) {
                const int j = PART * q + lane;
                if (lane < PART && j < k) value[v][q] -= row2[j] * x2 + row1[j] * x1 + row0[j] * x0;
            }
        }
    }
#pragma unroll
for (int part = 0; part < PARTS; ++part)
    for (int k = PART * part; k < min(size, PART * part + PART); k += 3) {
        const float* const row1 = room + (k + 1) * (k + 2) / 2;
        const float* const row2 = row1 + k + 2;
        const float o0 = over[k], o1 = over[k + 1], o2 = over[k + 2], l10 = row1[k], l20 = row2[k], l21 = row2[k + 1];
        const int own = k - PART * part;
#pragma unroll
        for (int v = 0; v < VECTORS; ++v) {
            const float f1 = __shfl_sync(0xffffffffu, value[v][part], own + 1);
            const float f2 = __shfl_sync(0xffffffffu, value[v][part], own + 2);
            const float x0 = __shfl_sync(0xffffffffu, value[v][part], own) * o0;
            const float x1 = (f1 - l10 * x0) * o1, x2 = (f2 - l20 * x0 - l21 * x1) * o2;
            if (lane >= own && lane < own + 3) value[v][part] = lane == own ? x0 : lane == own + 1 ? x1 : x2;
#pragma unroll
            for (int q = part; q < PARTS; ++q) {
                const int i = PART * q + lane;
                const float* const row = room + i * (i + 1) / 2 + k;
                if (lane < PART && i > k + 2 && i < size) value[v][q] -= row[0] * x0 + row[1] * x1 + row[2] * x2;
            }
        }
    }
#pragma unroll
for (int q = 0; q < PARTS; ++q)
#pragma unroll
    for (int v = 0; v < VECTORS; ++v)
        if (lane < PART && PART * q + lane < size) wp::index(x, first + v * step, PART * q + lane) = value[v][q];
__syncwarp();  // over is free
#endif
"""
_SIZES = {"at": _AT, "factor": _FACTOR, "parts": -(-MOST_ROWS // 30)}


@wp.func_native(_SOLVE % (_SIZES | {"vectors": 1}))
def solve_together(at: wp.uint64, first: int, step: int, x: wp.array2d(dtype=float)):
    """Row ``first`` of what is solved with the factor in a warp's room; it has the right-hand side at first."""
    ...


@wp.func_native(_SOLVE % (_SIZES | {"vectors": 3}))
def solve_three_together(at: wp.uint64, first: int, step: int, x: wp.array2d(dtype=float)):
    """:func:`solve_together` of three rows, a ``step`` from one to the next."""
    ...
