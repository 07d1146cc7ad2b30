"""Which nodes of a particle's stencil each of its threads has in relays, where these are, and what they weigh.

A node's sums are half a sector of memory, see :mod:`piavatar_envs.mpm.counts`. Of the three nodes in a row along z,
two share one, the row's pair: the first two where the stencil begins at an even place, the last two where it does not.
So the 27 nodes are the 18 of pairs, in order of their rows, and then the 9 third ones. Of a team, of eight threads or
of four, thread ``t`` has those of number ``t``, ``t + team``, ``t + 2 team`` and so on. Each has looked one of eight
blocks up, or two: see :func:`piavatar_envs.mpm.singles.slots_of_thread`.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.counts import NUMBERS_OF, Counts
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.types import vec8, vec8i

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Nodes that a thread of a team of four has at most, and one of eight.
MOST_OF_FOUR, MOST_OF_EIGHT = wp.constant(7), wp.constant(4)
#: The four numbers of that many nodes.
mat84i = wp.types.matrix(shape=(8, 4), dtype=wp.int32)

#: In CUDA: of the node at place ``l`` in a row, where it is in each of the four blocks that the row may lie in, by
#: whether that is upper along x and y; ``apart`` is from the records of a slot to those of the next.
FIND_ROW = """
struct Row { int in[4]; };
auto find_row = [&](int l, int apart) {
    const int k = (base[2] & 3) + l;
    Row row;
#pragma unroll
    for (int n = 0; n < 4; ++n) {
        const int place = 2 * n + (k > 3 ? 1 : 0), from = threadIdx.x & 32 - team | place & team - 1;
        row.in[n] = apart * __shfl_sync(0xffffffffu, team == 4 && n > 1 ? record[1] : record[0], from) + (k & 3);
    }
    return row;
};
auto in_row = [&](const Row& row, int bx, int by, int i, int j) {
    const bool is_upper = bx + i > 3, is_far = by + j > 3;
    const int first = is_upper ? (is_far ? row.in[3] : row.in[2]) : is_far ? row.in[1] : row.in[0];
    return first + 16 * (bx + i & 3) + 4 * (by + j & 3);
};
"""
#: In CUDA: what a thread has for its ``n``-th node, of what ``pair`` and ``third`` say of each of the nine rows.
_OWN = """
const int t = threadIdx.x & team - 1;
const bool is_odd = base[2] & 1;
const int l_pair = (t & 1) + is_odd, l_third = is_odd ? 0 : 2;
auto choose = [&](int row, int count, int at, auto of) {
    auto value = of(row);
#pragma unroll
    for (int next = 1; next < 8; ++next)
        if (next < count && row + next < 9 && at >= next) value = of(row + next);
    return value;
};
auto own = [&](int n, auto pair, auto third) {
    const int first = n * team;
    if (first + team <= 18) return choose(first / 2, team / 2, t >> 1, pair);
    if (first >= 18) return choose(first - 18, team, t, third);
    auto later = choose(0, team - 2, t - 2, third);
    return t < 2 ? pair(8) : later;
};
"""


@wp.func_native(
    native(
        """
const int node = (threadIdx.x & team - 1) + team * n;
if (node > 26) return wp::vec_t<3, wp::int32>(-1, 0, 0);
const bool is_pair = node < 18, is_odd = base[2] & 1;
const int row = is_pair ? node >> 1 : node - 18, i = row * 11 >> 5;  // a third
return wp::vec_t<3, wp::int32>(i, row - 3 * i, is_pair ? (node & 1) + is_odd : is_odd ? 0 : 2);
""",
        "return wp::vec_t<3, wp::int32>(-1, 0, 0);",
    )
)
def node_of_thread(team: int, base: wp.vec3i, n: int) -> wp.vec3i:
    """Place in the stencil at ``base`` of the ``n``-th node that a thread has; -1 along x if it has none."""
    ...


@wp.func_native(
    native(
        _OWN
        + """
return own(
    n, [&](int row) { return wp::vec_t<3, wp::float32>(row / 3, row % 3, l_pair); },
    [&](int row) { return wp::vec_t<3, wp::float32>(row / 3, row % 3, l_third); });
""",
        "return wp::vec_t<3, wp::float32>();",
    )
)
def place_of_node(team: int, base: wp.vec3i, n: int) -> wp.vec3:
    """:func:`node_of_thread` for a constant ``n``, in floating point; some place where a thread has none."""
    ...


@wp.func_native(
    native(
        _OWN
        + FIND_ROW
        + """
const int bx = base[0] & 3, by = base[1] & 3;
const Row pairs = find_row(l_pair, 1), thirds = find_row(l_third, 1);
wp::vec_t<8, wp::int32> records;
#pragma unroll
for (int n = 0; n < 7; ++n)
    if (n * team < 27)
        records[n] = own(
            n, [&](int row) { return in_row(pairs, bx, by, row / 3, row % 3); },
            [&](int row) { return in_row(thirds, bx, by, row / 3, row % 3); });
return records;
""",
        "return wp::vec_t<8, wp::int32>();",
    )
)
def records_of_thread(team: int, base: wp.vec3i, record: wp.vec2i) -> vec8i:
    """Records of a thread's nodes in the stencil at ``base``, of one twice where it has fewer than others.

    ``record`` are the first of the blocks that the thread has looked up. All threads of a warp come here.
    """
    ...


@wp.func_native(
    native(
        _OWN
        + """
const float w_pair = is_odd ? (t & 1 ? wz[2] : wz[1]) : t & 1 ? wz[1] : wz[0], w_third = is_odd ? wz[0] : wz[2];
wp::vec_t<8, wp::float32> weights;
#pragma unroll
for (int n = 0; n < 7; ++n) {
    if (n * team >= 27) break;
    weights[n] = own(
        n, [&](int row) { return wx[row / 3] * wy[row % 3] * w_pair; },
        [&](int row) { return wx[row / 3] * wy[row % 3] * w_third; });
    if (n * team + t > 26) weights[n] = 0.0f;
}
return weights;
""",
        "return wp::vec_t<8, wp::float32>();",
    )
)
def weights_of_thread(team: int, base: wp.vec3i, wx: wp.vec3, wy: wp.vec3, wz: wp.vec3) -> vec8:
    """Weights of a thread's nodes in the stencil at ``base``, 0 of those that it has not."""
    ...


@wp.func_native(
    native(
        NUMBERS_OF
        + """
wp::mat_t<8, 4, wp::int32> numbers;
#pragma unroll
for (int n = 0; n < 7; ++n) {
    if (n * team >= 27) break;
    const int r = records[n];
    const int4 four = numbers_of(&wp::index(counts.sum, e, r + (r & ~63)));
    numbers.data[n][0] = four.x, numbers.data[n][1] = four.y, numbers.data[n][2] = four.z, numbers.data[n][3] = four.w;
}
return numbers;
""",
        "return wp::mat_t<8, 4, wp::int32>();",
    )
)
def numbers_of_thread(team: int, counts: Counts, e: int, records: vec8i) -> mat84i:
    """Mass and physical momentum of a thread's nodes; all are asked for before the first has answered."""
    ...


@wp.func_native(
    native(
        """
const int i = (base[0] & 3) + node[0], j = (base[1] & 3) + node[1], k = (base[2] & 3) + node[2];
const int block = (i & 4) | (j >> 1 & 2) | (k >> 2 & 1), from = (threadIdx.x & 32 - team) | (block & team - 1);
int first = __shfl_sync(0xffffffffu, record[0], from);
if (team == 4) {
    const int second = __shfl_sync(0xffffffffu, record[1], from);
    if (block & 4) first = second;
}
return first + 16 * (i & 3) + 4 * (j & 3) + (k & 3);
""",
        "return record[0];",
    )
)
def record_in_team(team: int, base: wp.vec3i, node: wp.vec3i, record: wp.vec2i) -> int:
    """Record of a ``node`` of the stencil at ``base``.

    ``record`` are the first of the blocks that the thread has looked up, see
    :func:`piavatar_envs.mpm.singles.slots_of_thread`. All threads of a warp come here.
    """
    ...


@wp.func_native("return n == 0 ? w[0] : n == 1 ? w[1] : w[2];")
def weight_at(w: wp.vec3, n: int) -> float:
    """``w[n]`` out of registers."""
    ...
