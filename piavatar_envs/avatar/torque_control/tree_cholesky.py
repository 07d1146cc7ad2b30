"""Cholesky factors of small sparse matrices of kinematic trees, one per environment, and solutions with them.

The matrix is ``L^T L`` with a lower triangle ``L``: rows are eliminated from the last one up. Where children come after
their parents, limbs are eliminated before the bones that they hang on, so that separate limbs cause no fill-in in each
other's rows (Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 6.5). The nonzero blocks of 3 x 3, the axes of
two joints, are found once, on the host.

Matrices and factors store only these blocks, row by row, the diagonal block last in its row. In a matrix the diagonal
block is complete; in a factor it is the inverse ``L_kk^-1`` (lower), the only form that solutions use.

On a GPU a warp has a factor in shared memory, its *arena*, because each row depends on the one before and would wait
for global memory. An arena has :data:`ARENA_WORDS` words: those of a factor, and from :data:`SPARE` on the right-hand
sides. On a CPU a single thread works on factors and vectors in place.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.core.cuda_intrinsics import lane_of_warp, sync_threads

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


#: Rows of the largest matrix that fits an arena: those of an avatar.
MOST_ROWS = 69
_JOINTS = MOST_ROWS // 3
#: Words of a warp's arena: all blocks that a factor may have, and three vectors with four words a joint.
SPARE = 9 * _JOINTS * (_JOINTS + 1) // 2
COLUMN = 4 * _JOINTS
ARENA_WORDS = SPARE + 4 * COLUMN
_ARENA = """
float* const arena = reinterpret_cast<float*>(at);
#if defined(__CUDA_ARCH__)
const int lane = threadIdx.x & 31;
constexpr int LANES = 32;
const auto sync = [] { __syncwarp(); };
const auto over_root = [](float x) { return rsqrtf(x); };
#else
constexpr int lane = 0, LANES = 1;
const auto sync = [] {};
const auto over_root = [](float x) { return 1.0f / sqrtf(x); };
#endif
"""


# A single warp is bound by latency. Therefore offsets are in bytes, the plan of a round is loaded two rounds ahead,
# from lists that end in two empty rounds, and all values are read before any is written. In a row all lanes compute the
# inverse of the diagonal block, then each lane a column of the other blocks; then each lane subtracts the product of
# two of these blocks from a third.
@wp.func_native(
    _ARENA
    + """
#if defined(__CUDA_ARCH__)
using Step = int4;
#else
struct Step { int x, y, z, w; };
#endif
struct Block { float number[9]; };
const Step* const all_steps = reinterpret_cast<const Step*>(steps.data);
const auto at_byte = [&](int n) { return reinterpret_cast<float*>(reinterpret_cast<char*>(arena) + n); };
const int column = 9 * (lane / 3) + lane % 3;
const auto block_at = [](const float* from) {
    Block block;
#pragma unroll
    for (int c = 0; c < 9; ++c) block.number[c] = from[c];
    return block;
};
const auto subtract = [&](const float* row, int word, const Block& before) {
    const Block first = block_at(row + (word >> 8 & 255)), second = block_at(row + (word & 255));
    const float* const a = first.number;
    const float* const b = second.number;
    float* const to = at_byte(word >> 16);
#pragma unroll
    for (int c = 0; c < 9; ++c)
        to[c] = before.number[c] - a[c / 3] * b[c % 3] - a[3 + c / 3] * b[3 + c % 3] - a[6 + c / 3] * b[6 + c % 3];
};
Step now = all_steps[0], next = all_steps[1];
int word = pair.data[lane], next_word = pair.data[32 + lane];
#pragma unroll 1
for (int round = 0; round < steps.shape[0] - 2; ++round) {
    const Step after = all_steps[round + 2];
    const int after_word = pair.data[32 * (round + 2) + lane];
    float* const row = at_byte(now.x);
#if defined(__CUDA_ARCH__)
    const Block before = block_at(at_byte(word < 0 ? 0 : word >> 16));  // loaded while the row is computed
#endif
    if (now.w == 0) {
        float* const d = at_byte(now.y);
        const float d0 = d[0], d3 = d[3], d4 = d[4], d6 = d[6], d7 = d[7], d8 = d[8];
        float* const m = row + column;
        float m0 = 0.0f, m1 = 0.0f, m2 = 0.0f;
        if (lane < now.z) m0 = m[0], m1 = m[3], m2 = m[6];
        const float o2 = over_root(d8), l21 = d7 * o2, l20 = d6 * o2;
        const float o1 = over_root(d4 - l21 * l21), l10 = (d3 - l21 * l20) * o1;
        const float o0 = over_root(d0 - l20 * l20 - l10 * l10);
        const float w10 = -o1 * l10 * o0, w21 = -o2 * l21 * o1, w20 = -o2 * (l20 * o0 + l21 * w10);
        sync();
        if (lane == 0) d[0] = o0, d[3] = w10, d[4] = o1, d[6] = w20, d[7] = w21, d[8] = o2;
        const auto put = [&](float* to, float m0, float m1, float m2) {
            to[0] = o0 * m0 + w10 * m1 + w20 * m2, to[3] = o1 * m1 + w21 * m2, to[6] = o2 * m2;
        };
        if (lane < now.z) put(m, m0, m1, m2);
#pragma unroll 1
        for (int n = lane + LANES; n < now.z; n += LANES) {
            float* const more = row + 9 * (n / 3) + n % 3;
            put(more, more[0], more[3], more[6]);
        }
        sync();
    }
#if defined(__CUDA_ARCH__)
    if (word >= 0) subtract(row, word, before);
#else
    for (const int* own = pair.data + 32 * round; own < pair.data + 32 * (round + 1) && *own >= 0; ++own)
        subtract(row, *own, block_at(at_byte(*own >> 16)));
#endif
    sync();
    now = next, next = after, word = next_word, next_word = after_word;
}
"""
)
def eliminate(steps: wp.array(dtype=wp.vec4i), pair: wp.array(dtype=int), at: wp.uint64):
    """Factorize the matrix in an arena, in place."""
    ...


@wp.func_native(
    _ARENA
    + """
for (int i = lane; i < diagonal.shape[1]; i += LANES) arena[entry.data[i]] += wp::index(diagonal, e, i);
sync();
"""
)
def add_diagonal(entry: wp.array(dtype=int), diagonal: wp.array2d(dtype=float), e: int, at: wp.uint64):
    """Add row ``e`` of ``diagonal`` to the diagonal of the matrix in an arena, at the words ``entry``."""
    ...


@wp.func_native(
    _ARENA
    + """
for (int i = lane; i < 9 * blocks.shape[1]; i += LANES) {
    const int n = i / 9 + first, k = i % 9;
    arena[entry.data[3 * n] + k] += wp::index(blocks, e, i / 9).data[k / 3][k % 3];
}
sync();
"""
)
def add_blocks(entry: wp.array(dtype=int), blocks: wp.array2d(dtype=wp.mat33), e: int, first: int, at: wp.uint64):
    """Add row ``e`` of ``blocks`` to the diagonal blocks of the matrix in an arena, from triple ``first`` on."""
    ...


@wp.func_native(f"""
float* const to = reinterpret_cast<float*>(at) + 9 * block;
if (block < 0) return;
for (int n = 0; n < 9; ++n) {{
    to[n] = value.data[n / 3][n % 3];
#if defined(__CUDA_ARCH__)
    to[n + {ARENA_WORDS}] = to[n];
#endif
}}
""")
def set_in_arenas(at: wp.uint64, block: int, value: wp.mat33):
    """Write a block, if its number is not negative, to the matrix in an arena; on a GPU also to the next arena."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
float4* const to = reinterpret_cast<float4*>(&wp::index(rows, n, 0));
for (int k = thread; k < rows.shape[1] / 4; k += threads) to[k] = reinterpret_cast<const float4*>(at)[k];
#endif
""")
def store_arena(at: wp.uint64, n: int, thread: int, threads: int, rows: wp.array2d(dtype=float)):
    """Copy an arena to row ``n``; on a CPU it is that row."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const float4* const from = reinterpret_cast<const float4*>(&wp::index(rows, n, 0));
__syncwarp();
#pragma unroll 10
for (int k = threadIdx.x & 31; k < rows.shape[1] / 4; k += 32) reinterpret_cast<float4*>(at)[k] = from[k];
__syncwarp();
#else
float* const to = reinterpret_cast<float*>(at);
if (to != &wp::index(rows, n, 0)) memcpy(to, &wp::index(rows, n, 0), sizeof(float) * rows.shape[1]);
#endif
""")
def load_arena(rows: wp.array2d(dtype=float), n: int, at: wp.uint64):
    """Copy row ``n`` to an arena."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return arena;
#else
return reinterpret_cast<wp::uint64>(&wp::index(factor, f, 0));
#endif
""")
def place_of_factor(factor: wp.array2d(dtype=float), f: int, arena: wp.uint64) -> wp.uint64:
    """Return the address of factor ``f``: in the arena of a warp, or on a CPU in the array itself."""
    ...


# All lanes solve for the triple of a joint, each subtracts its contribution from one number of another joint: on the
# way down along the columns of its row, on the way up along the rows of its column. Others than ``wanted`` are skipped.
_TRIPLES = (
    _ARENA
    + f"""
constexpr int VECTORS = COUNT, STRIDE = {COLUMN};
#if defined(__CUDA_ARCH__)
float* const spare = arena + {SPARE};
const auto triple = [&](int v, int n) {{
    return reinterpret_cast<float*>(reinterpret_cast<char*>(spare + STRIDE * v) + n);
}};
#else
const auto triple = [&](int v, int n) {{ return &wp::index(x, first + v * step, 3 * (n >> 4) + (n >> 2 & 3)); }};
#endif
"""
)
_SWEEPS = """
const auto at_byte = [&](int n) { return reinterpret_cast<const float*>(reinterpret_cast<const char*>(arena) + n); };
float y[VECTORS][3];
const auto subtract = [&](int word, float m0, float m1, float m2) {
#pragma unroll
    for (int v = 0; v < VECTORS; ++v) {
        float* const other = triple(v, word & 1023);
        *other = *other - m0 * y[v][0] - m1 * y[v][1] - m2 * y[v][2];
    }
};
bool skipped = false;
const auto run_round = [&](auto direction, int& head, int& word, int round) {
    constexpr int ALONG = decltype(direction)::value;
    if (head >= 0) skipped = !(wanted >> (head >> 4 & 63) & 1);
    if (!skipped) {
#if defined(__CUDA_ARCH__)
        const float* const m = at_byte(word < 0 ? 0 : word >> 10);  // loaded while the other is computed
        const float m0 = m[0], m1 = m[ALONG], m2 = m[2 * ALONG];
#endif
        if (head >= 0) {
            const float* const w = at_byte(head >> 10);
            float b[VECTORS][3];
            const float w0 = w[0], w3 = w[3], w4 = w[4], w6 = w[6], w7 = w[7], w8 = w[8];
#pragma unroll
            for (int v = 0; v < VECTORS; ++v)
                for (int c = 0; c < 3; ++c) b[v][c] = triple(v, head & 1023)[c];
#pragma unroll
            for (int v = 0; v < VECTORS; ++v) {
                if (ALONG == 3) {
                    y[v][0] = w0 * b[v][0] + w3 * b[v][1] + w6 * b[v][2];
                    y[v][1] = w4 * b[v][1] + w7 * b[v][2];
                    y[v][2] = w8 * b[v][2];
                } else {
                    y[v][0] = w0 * b[v][0];
                    y[v][1] = w3 * b[v][0] + w4 * b[v][1];
                    y[v][2] = w6 * b[v][0] + w7 * b[v][1] + w8 * b[v][2];
                }
            }
            sync();
            if (lane == 0)
#pragma unroll
                for (int v = 0; v < VECTORS; ++v)
                    for (int c = 0; c < 3; ++c) triple(v, head & 1023)[c] = y[v][c];
        }
#if defined(__CUDA_ARCH__)
        if (word >= 0) subtract(word, m0, m1, m2);
#else
        for (const int* own = words.data + 32 * round; own < words.data + 32 * (round + 1) && *own >= 0; ++own) {
            const float* const m = at_byte(*own >> 10);
            subtract(*own, m[0], m[ALONG], m[2 * ALONG]);
        }
#endif
    }
    head = heads.data[round + 2];  // into its own copy, see sweep: a move between copies would wait for the load
    word = words.data[32 * (round + 2) + lane];
    if (!skipped) sync();
};
const auto sweep = [&](auto direction, int begin, int end) {
    int even = heads.data[begin], odd = heads.data[begin + 1];
    int even_word = words.data[32 * begin + lane], odd_word = words.data[32 * begin + 32 + lane];
#pragma unroll 1
    for (int round = begin; round < end; round += 2) {
        run_round(direction, even, even_word, round);
        run_round(direction, odd, odd_word, round + 1);
    }
};
struct Down { enum { value = 3 }; };
struct Up { enum { value = 1 }; };
"""
_DOWN, _UP = "sweep(Down{}, 0, down_rounds);", "sweep(Up{}, down_rounds, heads.shape[0] - 2);"
_ALL = "constexpr int wanted = -1;"
_LOAD = """
#if defined(__CUDA_ARCH__)
const int size = x.shape[1];
for (int v = 0; v < VECTORS; ++v)
    for (int n = lane; n < size; n += LANES) spare[STRIDE * v + n + n / 3] = wp::index(x, first + v * step, n);
sync();
#endif
"""
_STORE = """
#if defined(__CUDA_ARCH__)
for (int v = 0; v < VECTORS; ++v)
    for (int n = lane; n < size; n += LANES) wp::index(x, first + v * step, n) = spare[STRIDE * v + n + n / 3];
sync();
#endif
"""
_SOLVE = _ALL + _TRIPLES + _LOAD + _SWEEPS + _DOWN + _UP + _STORE


@wp.func_native(_SOLVE.replace("COUNT", "1"))
def solve_one(
    heads: wp.array(dtype=int), words: wp.array(dtype=int), down_rounds: int, at: wp.uint64, first: int, step: int,
    x: wp.array2d(dtype=float),
):  # fmt: skip
    """Solve for row ``first`` with the factor in an arena, in place."""
    ...


@wp.func_native(_SOLVE.replace("COUNT", "4"))
def solve_four(
    heads: wp.array(dtype=int), words: wp.array(dtype=int), down_rounds: int, at: wp.uint64, first: int, step: int,
    x: wp.array2d(dtype=float),
):  # fmt: skip
    """Solve like :func:`solve_one` for four rows, a ``step`` apart."""
    ...


@wp.func_native((_TRIPLES + _SWEEPS + _DOWN).replace("COUNT", "3"))
def descend_three(
    heads: wp.array(dtype=int), words: wp.array(dtype=int), down_rounds: int, at: wp.uint64, first: int, step: int,
    wanted: int, x: wp.array2d(dtype=float),
):  # fmt: skip
    """Multiply three vectors by ``L^-T``; only joints whose bits are ``wanted`` have entries.

    A warp has the vectors in its arena, a single thread in rows of ``x`` as in :func:`solve_four`.
    """
    ...


@wp.func_native((_ALL + "constexpr int step = 0;" + _TRIPLES + _SWEEPS + _UP).replace("COUNT", "1"))
def ascend_one(
    heads: wp.array(dtype=int), words: wp.array(dtype=int), down_rounds: int, at: wp.uint64, first: int,
    x: wp.array2d(dtype=float),
):  # fmt: skip
    """Multiply the first of the vectors of :func:`descend_three` by ``L^-1``, in place."""
    ...


@wp.struct
class Pattern:
    """Nonzero blocks of ``L``, and the plan of elimination and solution for the lanes of a warp, in rounds.

    All rounds of a kind are followed by two empty ones, because they are loaded ahead. The word of an idle lane is -1.
    """

    block: wp.array(dtype=int)  # (joints * joints,) number of the block of two joints, -1 without one
    entry: wp.array(dtype=int)  # (rows,) indices of the diagonal's entries
    # (rounds,) of the elimination of a row: bytes to its first block, bytes to that of the diagonal, columns before
    # that, and 1 if the round continues the row before it
    step: wp.array(dtype=wp.vec4i)
    # (rounds * 32,) a block that changes by the product of two of the row: 2^16 times the bytes to it, 2^8 times the
    # numbers from the row's first block to the first, those to the second
    pair: wp.array(dtype=int)
    # (rounds,) of a solution: 2^10 times the bytes to the diagonal's block, and to the joint's part of a vector that
    # has sixteen a joint; -1 if the round continues the joint before it
    head: wp.array(dtype=int)
    # (rounds * 32,) bytes to the part of the vector that changes, plus 2^10 times those to the first of three numbers
    word: wp.array(dtype=int)
    down_rounds: int  # rounds on the way down, an even number; those on the way up are as well
    reach: wp.array(dtype=int)  # (joints,) bits of the joints that an entry of a joint reaches on the way down


#: Lanes of a warp, and the bytes of a number and of a block.
LANES, NUMBER, BLOCK = 32, 4, 36


def in_rounds(words: np.ndarray) -> np.ndarray:
    """Pad ``words`` with -1 to whole rounds, at least one."""
    return np.pad(words, (0, max(LANES, -(-len(words) // LANES) * LANES) - len(words)), constant_values=-1)


def find_pattern(filled: np.ndarray, device: str) -> Pattern:
    """Find the entries of ``L`` by elimination, from those of the matrix, ``filled``, shape ``(N, N)`` bool.

    Raises:
        ValueError: ``filled`` is not made of filled and empty blocks of 3 x 3, or has too many rows.
    """
    filled = filled | filled.T
    joints = filled[::3, ::3].copy()
    if len(filled) > MOST_ROWS or not np.array_equal(np.kron(joints, np.ones((3, 3), bool)), filled):
        raise ValueError(f"filled has shape {filled.shape}, expected at most {MOST_ROWS} rows, in blocks of 3 x 3")
    for k in reversed(range(len(joints))):
        found = np.flatnonzero(joints[k, :k])
        joints[np.ix_(found, found)] = True
    row, column = np.nonzero(np.tril(joints))
    block = np.full(joints.shape, -1)
    block[row, column] = np.arange(len(row))
    steps, pairs = plan_elimination(block)
    heads, words, down_rounds = plan_solution(block)
    entries = 9 * np.diag(block)[:, None] + np.array([0, 4, 8])
    lists = {"block": block.ravel(), "entry": entries.ravel(), "pair": pairs, "head": heads, "word": words}
    lists["reach"] = plan_reach(block)
    pattern = Pattern()
    for name, numbers in lists.items():
        setattr(pattern, name, wp.array(numbers.astype(np.int32), dtype=int, device=device))
    pattern.step, pattern.down_rounds = wp.array(steps.astype(np.int32), dtype=wp.vec4i, device=device), down_rounds
    return pattern


def plan_elimination(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and pairs of :class:`Pattern`, from the ``block`` of every two joints."""
    steps, pairs = [], []
    for k in reversed(range(len(block))):
        own = np.flatnonzero(block[k, :k] >= 0)
        i, j = np.nonzero(np.tri(len(own), dtype=bool))
        pairs.append(in_rounds(BLOCK * block[own[i], own[j]] << 16 | 9 * i << 8 | 9 * j))
        first = BLOCK * (block[k, k] - len(own))
        steps += [(first, BLOCK * block[k, k], 3 * len(own), n > 0) for n in range(len(pairs[-1]) // LANES)]
    return np.array(steps + 2 * [(0, 0, 0, 1)]), np.concatenate([*pairs, np.full(2 * LANES, -1)])


def plan_solution(block: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return ``head``, ``word`` and ``down_rounds`` of :class:`Pattern`, from the ``block`` of every two joints."""
    count, axis, heads, words, down_rounds = len(block), np.arange(3), [], [], 0
    for up in (False, True):
        down_rounds = len(heads)  # even
        for k in range(count) if up else reversed(range(count)):
            blocks = block[:, k] if up else block[k]
            others = np.flatnonzero((blocks >= 0) & (np.arange(count) != k))
            numbers = BLOCK * blocks[others][:, None] + NUMBER * (3 if up else 1) * axis
            words.append(in_rounds((numbers << 10 | 16 * others[:, None] + NUMBER * axis).ravel()))
            heads += [BLOCK * block[k, k] << 10 | 16 * k] + [-1] * (len(words[-1]) // LANES - 1)
        nothing = (2 if up else 0) + len(heads) % 2
        heads += nothing * [-1]
        words.append(np.full(nothing * LANES, -1))
    return np.array(heads), np.concatenate(words), down_rounds


def plan_reach(block: np.ndarray) -> np.ndarray:
    """Return ``reach`` of :class:`Pattern`, from the ``block`` of every two joints."""
    reach = 1 << np.arange(len(block))
    for k, own in enumerate(block):
        reach[k] |= np.bitwise_or.reduce(reach[:k][own[:k] >= 0], initial=0)
    return reach


def factor_size(pattern: Pattern) -> int:
    """Return the length of a stored matrix or factor, a multiple of four."""
    return -(-9 * (1 + int(pattern.block.numpy().max())) // 4) * 4


def lower_entries(pattern: Pattern) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows and columns of the stored entries of the lower triangle, and their numbers."""
    row, column = np.nonzero(np.tril(pattern.block.numpy().reshape(2 * [pattern.entry.shape[0] // 3]) >= 0))
    axis = np.arange(9)
    i, j = (3 * row[:, None] + axis // 3).ravel(), (3 * column[:, None] + axis % 3).ravel()
    return i[i >= j], j[i >= j], np.flatnonzero(i >= j)


def pack(pattern: Pattern, matrices: np.ndarray) -> np.ndarray:
    """Pack symmetric matrices ``(n, N, N)`` into the stored form, ``(n, factor_size)`` float32."""
    rows, columns, numbers = lower_entries(pattern)
    packed = np.zeros((len(matrices), factor_size(pattern)), np.float32)
    packed[:, numbers] = matrices[:, rows, columns]
    return packed


@wp.func
def factorize(
    pattern: Pattern,
    matrix: wp.array2d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    source: int,
    e: int,
    arena: wp.uint64,
    f: int,
    # out
    factor: wp.array2d(dtype=float),
):
    """Compute ``L`` of ``L^T L = matrix + diag(diagonal)``, of matrix ``source`` and row ``e`` of the ``diagonal``.

    ``matrix`` is ``(num_envs, factor_size)``. A single thread writes factor ``f`` of the same size; a warp leaves it in
    its arena, from where :func:`store_factor` writes it.
    """
    at = place_of_factor(factor, f, arena)
    load_arena(matrix, source, at)
    factorize_in_arena(pattern, diagonal, e, at)


@wp.func
def factorize_in_arena(pattern: Pattern, diagonal: wp.array2d(dtype=float), e: int, at: wp.uint64):
    """Run :func:`factorize` for the matrix in the arena."""
    add_diagonal(pattern.entry, diagonal, e, at)
    eliminate(pattern.step, pattern.pair, at)


@wp.func
def store_factor(arena: wp.uint64, f: int, factor: wp.array2d(dtype=float)):
    """Write factor ``f`` from the arena after :func:`factorize`; on a CPU it is in place already."""
    lane = lane_of_warp()
    store_arena(arena, f, lane[0], lane[1], factor)
    sync_threads(lane[1])  # the arena may be reused


@wp.func
def load_factor(factor: wp.array2d(dtype=float), f: int, arena: wp.uint64):
    """Load factor ``f`` into the arena of a warp."""
    load_arena(factor, f, place_of_factor(factor, f, arena))


@wp.func
def solve(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    f: int,
    right: wp.array2d(dtype=float),
    e: int,
    row: int,
    thread: int,
    threads: int,
    arena: wp.uint64,
    # out
    x: wp.array2d(dtype=float),
):
    """Solve ``L^T L x[row] = right[e]`` with factor ``f``; a warp uses the factor in its arena."""
    sync_threads(threads)
    for i in range(thread, x.shape[1], threads):
        x[row, i] = right[e, i]
    sync_threads(threads)
    solve_one(pattern.head, pattern.word, pattern.down_rounds, place_of_factor(factor, f, arena), row, 0, x)


@wp.func
def solve_four_in_place(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    f: int,
    first: int,
    step: int,
    threads: int,
    arena: wp.uint64,
    # in and out
    x: wp.array2d(dtype=float),
):
    """Run :func:`solve` for four right-hand sides in ``x``, from ``first`` on, ``step`` rows apart."""
    sync_threads(threads)
    solve_four(pattern.head, pattern.word, pattern.down_rounds, place_of_factor(factor, f, arena), first, step, x)


@wp.func
def begin_solution(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    f: int,
    wanted: int,
    first: int,
    step: int,
    threads: int,
    arena: wp.uint64,
    # in and out
    x: wp.array2d(dtype=float),
):
    """Compute ``Y = L^-T B`` of three right-hand sides ``B`` in ``x``, with which ``B^T M^-1 B = Y^T Y``.

    Both have entries only in joints whose bits are ``wanted``, see ``Pattern.reach``; other joints are neither read nor
    written. A warp has them in its arena, see
    :func:`piavatar_envs.avatar.torque_control.workspace.view_columns`.
    """
    sync_threads(threads)
    at = place_of_factor(factor, f, arena)
    descend_three(pattern.head, pattern.word, pattern.down_rounds, at, first, step, wanted, x)


@wp.func
def end_solution(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    f: int,
    first: int,
    threads: int,
    arena: wp.uint64,
    # in and out
    x: wp.array2d(dtype=float),
):
    """Multiply the first of the columns of :func:`begin_solution` by ``L^-1``."""
    sync_threads(threads)
    ascend_one(pattern.head, pattern.word, pattern.down_rounds, place_of_factor(factor, f, arena), first, x)
