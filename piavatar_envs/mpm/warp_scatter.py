"""The scatter of a warp, 32 threads that work together, in CUDA: Warp's own language has no words for what they share.

A thread that adds its particle to 27 nodes by atomic operations waits for them, and so do all the others. Here a warp
puts 32 particles into shared memory, finds those of the same cell and adds each such run up in registers, a thread a
node of the stencil. Runs of the same block of 4 x 4 x 4 cells meet in a brick of 6 x 6 x 6 nodes in shared memory, and
nodes are touched when the warp goes on to another block, by as many threads a node as its record has parts.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.transfer import Scattered
from piavatar_envs.mpm.types import Blocks, Grid, Sums

wp.set_module_options({"enable_backward": False})

# Empty on a CPU, where this module is compiled with the others, and never launched.
_SCATTER_RUNS = """
#if defined(__CUDA_ARCH__)
constexpr unsigned ALL = 0xffffffffu;
constexpr int WORDS = 31;  // of a staged particle: 7 sums, 9 of A, 9 weights, 5 of its place; odd, for the banks
constexpr int BRICK = 216;
__shared__ float stages[4 * 32 * WORDS];
__shared__ float bricks[4 * 7 * BRICK];
__shared__ unsigned char lists[4 * BRICK];
__shared__ long long holds[4];
const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
float* const stage = stages + warp * 32 * WORDS;
float* const brick = bricks + warp * 7 * BRICK;
unsigned char* const list = lists + warp * BRICK;

// what is known of the block that a key is of
int env = 0, field = 0, x = 0, y = 0, z = 0, around = 0;
float per_mass = 0.0f, per_momentum = 0.0f;
auto look_up = [&](long long of) {
    const int block = (int)(of % grid.num_blocks), of_field = (int)(of / grid.num_blocks);
    env = of_field / num_fields;
    field = of_field % num_fields;
    z = block % grid.blocks[2];
    y = block / grid.blocks[2] % grid.blocks[1];
    x = block / (grid.blocks[2] * grid.blocks[1]);
    // lane 4 i + 2 j + k knows the slot of its neighbour (i, j, k); of one that has none, nothing is asked
    const int i = min(x + (lane >> 2 & 1), grid.blocks[0] - 1), j = min(y + (lane >> 1 & 1), grid.blocks[1] - 1);
    const int k = min(z + (lane & 1), grid.blocks[2] - 1);
    around = wp::index(blocks.slot, env, field * grid.num_blocks + (i * grid.blocks[1] + j) * grid.blocks[2] + k);
    per_mass = 1.0f / wp::index(sums.mass_unit, min(env, sums.mass_unit.shape[0] - 1), field);
    per_momentum = 1.0f / wp::index(sums.momentum_unit, min(env, sums.momentum_unit.shape[0] - 1), field);
};
// the high or the low part of a number of units
auto piece = [](float units, int low) {
    const long long n = __float2ll_rn(units);
    return low ? (int)(n & 0xfffff) : (int)(n >> 20);
};
// adds a part of component c to node (i, j, k) from the lowest of the block looked up: 0 to 7 are the high parts of a
// record or its floating-point numbers, 8 to 15 the low parts; all lanes take part, some do not add
auto add = [&](bool adds, int i, int j, int k, int part, float value) {
    const int c = part & 7;
    const int slot = __shfl_sync(ALL, around, (i >> 2) * 4 + (j >> 2) * 2 + (k >> 2));
    const int record = 64 * slot + ((i & 3) * 4 + (j & 3)) * 4 + (k & 3);
    if (!adds) return;
    const float units = value * (c == 0 ? per_mass : per_momentum);
    if (sums.is_fixed)
        atomicAdd((int*)&wp::index(sums.fixed, env, record) + part, piece(units, part >> 3));
    else
        atomicAdd((float*)&wp::index(sums.value, env, record) + c, value);
};
// adds the brick to the nodes, by a quarter of the warp each, and empties it
auto put_down = [&](long long of) {
    look_up(of);
    int count = 0;
    for (int t = lane; t < 7 * 32; t += 32) {
        const bool has = t < BRICK && brick[t] * per_mass > 0.5f;  // who adds no mass adds nothing
        const unsigned having = __ballot_sync(ALL, has);
        if (has) list[count + __popc(having & ((1u << lane) - 1u))] = (unsigned char)t;
        count += __popc(having);
    }
    __syncwarp();
    // as many lanes a node as its record has parts
    const int log_parts = sums.is_fixed ? 4 : 3, parts = 1 << log_parts;
    for (int u = 0; u < parts * count; u += 32) {
        const bool adds = u + lane < parts * count && (lane & 7) < 7;
        const int n = adds ? list[(u + lane) >> log_parts] : 0;
        add(adds, n / 36, n / 6 % 6, n % 6, lane & (parts - 1), adds ? brick[(lane & 7) * BRICK + n] : 0.0f);
    }
    __syncwarp();
    for (int n = lane; n < 7 * BRICK; n += 32) brick[n] = 0.0f;
    __syncwarp();
};

const long long per_env = (long long)num_fields * grid.num_blocks;
long long held = begins ? -1 : holds[warp];
if (begins)
    for (int n = lane; n < 7 * BRICK; n += 32) brick[n] = 0.0f;
// lanes of the same cell get neighbouring places, the cells in the order of their first lanes
const unsigned same = __match_any_sync(ALL, (unsigned long long)key);
const int first = __ffs(same) - 1;
const bool leads = key >= 0 && first == lane;
const int size = leads ? __popc(same) : 0;
int before = size;
for (int d = 1; d < 32; d <<= 1) {
    const int left = __shfl_up_sync(ALL, before, d);
    if (lane >= d) before += left;
}
before -= size;
const int place = __shfl_sync(ALL, before, first) + __popc(same & ((1u << lane) - 1u));
if (key >= 0) {
    float* const mine = stage + place * WORDS;
    for (int c = 0; c < 7; ++c) mine[c] = s.at_base[c];
    for (int c = 0; c < 3; ++c) {
        for (int d = 0; d < 3; ++d) mine[7 + 3 * c + d] = s.A.data[c][d];
        mine[16 + c] = wx[c];
        mine[19 + c] = wy[c];
        mine[22 + c] = wz[c];
        mine[25 + c] = tells ? s.f[c] * s.at_base[0] : 0.0f;
    }
    mine[28] = tells ? s.at_base[0] : 0.0f;
    mine[29] = tells ? seam * s.at_base[0] : 0.0f;
}
__syncwarp();

const bool on = lane < 27;
const int li = on ? lane / 9 : 0, lj = on ? (lane / 3) % 3 : 0, lk = on ? lane % 3 : 0;
const float ri = li, rj = lj, rk = lk;
unsigned runs = __ballot_sync(ALL, leads);
while (runs) {
    const int leader = __ffs(runs) - 1;
    runs &= runs - 1;
    const int begin = __shfl_sync(ALL, before, leader), end = begin + __shfl_sync(ALL, size, leader);
    const long long cell = __shfl_sync(ALL, (long long)key, leader), of = cell >> 6;
    // what another environment holds is put down at once: whether it does is not this one's business
    const bool other = held < 0 || of / per_env != held / per_env;
    if (of != held && (other || __popc(__ballot_sync(ALL, key >= 0 && (key >> 6) == of)) >= worth_a_brick)) {
        if (held >= 0) put_down(held);
        held = of;
    }
    float sum[7] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll 2
    for (int n = begin; n < end; ++n) {
        const float* const a = stage + n * WORDS;
        const float w = a[16 + li] * a[19 + lj] * a[22 + lk];
        sum[0] += w * a[0];
        sum[1] += w * (a[1] + a[7] * ri + a[8] * rj + a[9] * rk);
        sum[2] += w * (a[2] + a[10] * ri + a[11] * rj + a[12] * rk);
        sum[3] += w * (a[3] + a[13] * ri + a[14] * rj + a[15] * rk);
        sum[4] += w * a[4];
        sum[5] += w * a[5];
        sum[6] += w * a[6];
    }
    const int i = ((int)cell >> 4 & 3) + li, j = ((int)cell >> 2 & 3) + lj, k = ((int)cell & 3) + lk;
    if (of == held) {
        float* const node = brick + (i * 6 + j) * 6 + k;
        if (on)
            for (int c = 0; c < 7; ++c) node[c * BRICK] += sum[c];
    } else {
        look_up(of);
        const bool adds = on && sum[0] * per_mass > 0.5f;
        for (int c = 0; c < 7; ++c) {
            add(adds, i, j, k, c, sum[c]);
            if (sums.is_fixed) add(adds, i, j, k, 8 + c, sum[c]);
        }
    }
    if (__ballot_sync(ALL, tells && first == leader)) {
        float m = 0.0f, place[3] = {0.0f, 0.0f, 0.0f}, grown = 0.0f;
        for (int n = begin; n < end; ++n) {
            const float* const a = stage + n * WORDS;
            const float w = a[16 + li] * a[19 + lj] * a[22 + lk];
            m += w * a[28];
            grown += w * a[29];
            for (int c = 0; c < 3; ++c) place[c] += w * a[25 + c];
        }
        look_up(of);
        const int slot = __shfl_sync(ALL, around, (i >> 2) * 4 + (j >> 2) * 2 + (k >> 2));
        const int record = 64 * slot + ((i & 3) * 4 + (j & 3)) * 4 + (k & 3);
        const float value[4] = {m * ri - place[0], m * rj - place[1], m * rk - place[2], grown};
        if (on)
            for (int c = 0; c < 4; ++c)
                if (sums.is_fixed) {
                    int* const into = (int*)&wp::index(sums.offset_fixed, env, record);
                    atomicAdd(into + c, piece(value[c] * per_mass, 0));
                    atomicAdd(into + 4 + c, piece(value[c] * per_mass, 1));
                } else {
                    float* const into = (float*)&wp::index(sums.offset, env, record);
                    atomicAdd(into + c, c < 3 ? value[c] * grid.dx : value[c]);
                }
    }
    __syncwarp();
}
if (ends && held >= 0) put_down(held);
if (lane == 0) holds[warp] = held;
__syncwarp();
#endif
"""


@wp.func_native(_SCATTER_RUNS)
def scatter_runs(
    grid: Grid,
    blocks: Blocks,
    sums: Sums,
    num_fields: int,
    worth_a_brick: int,
    begins: bool,
    ends: bool,
    key: wp.int64,
    tells: bool,
    seam: float,
    s: Scattered,
    wx: wp.vec3,
    wy: wp.vec3,
    wz: wp.vec3,
):
    """Scatter the particles of a warp, one a lane; those with a negative ``key`` do not take part.

    One that ``tells`` its place adds to the nodes' offsets, too.

    The brick is kept from call to call of a warp, from that which ``begins`` to that which ``ends``.
    """
    ...
