"""The scatter of a warp, 32 threads that work together, in CUDA: Warp's own language has no words for what they share.

A thread that adds its particle to 27 nodes by atomic operations waits for them, and so do all the others. Here a warp
puts its particles into shared memory and adds those of the same cell up in registers: a thread has the three nodes of a
line of the stencil along z, and one component of the momenta. Such runs meet in a brick of 6 x 6 x 6 nodes in shared
memory, which lies wherever the warp's particles do. Nodes are touched when it is full, by eight threads a node.
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
// a staged particle: weights along z and mass; three times a momentum at the lowest node and its change along x, y, z;
// kinematic momentum and the mass that tells its place; weights along x and y, and the seam's mass that tells its place
constexpr int QUADS = 7;  // odd, for the banks
// a brick's nodes have seven sums each; strides along z, y and x for which the lanes of a run meet in no bank
constexpr int NODES = 216, ALONG_Z = 7, ALONG_Y = 42, ALONG_X = 259, BRICK = 1556;
__shared__ float4 stages[4 * 32 * QUADS];
__shared__ __align__(16) float bricks[4 * BRICK];
__shared__ int records[4 * NODES];
__shared__ unsigned short places[4 * NODES];
__shared__ int4 helds[4];
const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
float4* const stage = stages + warp * 32 * QUADS;
float* const brick = bricks + warp * BRICK;
int* const record_of_node = records + warp * NODES;
unsigned short* const place_of_node = places + warp * NODES;

// lanes of the same cell get neighbouring places, the cells in the order of their first lanes
const int x = s.base[0], y = s.base[1], z = s.base[2];
const long long cell = (long long)x | (long long)y << 19 | (long long)z << 38 | (long long)field << 57;
const unsigned same = __match_any_sync(ALL, (unsigned long long)(takes ? cell : -1));
const int first = __ffs(same) - 1;
const bool leads = takes && first == lane;
int before = leads ? __popc(same) : 0;
for (int d = 1; d < 32; d <<= 1) {
    const int left = __shfl_up_sync(ALL, before, d);
    if (lane >= d) before += left;
}
before -= leads ? __popc(same) : 0;
const int place = __shfl_sync(ALL, before, first) + __popc(same & ((1u << lane) - 1u));
float4* const mine = stage + place * QUADS;
if (takes) {
    mine[0] = make_float4(wz[0], wz[1], wz[2], s.at_base[0]);
    for (int c = 0; c < 3; ++c)
        mine[1 + c] = make_float4(s.at_base[1 + c], s.A.data[c][0], s.A.data[c][1], s.A.data[c][2]);
    mine[4] = make_float4(s.at_base[4], s.at_base[5], s.at_base[6], 0.0f);
    mine[5] = make_float4(wx[0], wx[1], wx[2], wy[0]);
    mine[6] = make_float4(wy[1], wy[2], 0.0f, 0.0f);
}
// a lane's line of nodes (i, j, 0 to 2) and its component of the vectors; five have none
const bool on = lane < 27;
const int li = on ? lane / 9 : 0, lj = on ? lane / 3 % 3 : 0, lc = on ? lane % 3 : 0;
const float ri = li, rj = lj;
// of a power of two: exact, however the module divides
auto one_over = [](float unit) { return __int_as_float(0x7f000000 - __float_as_int(unit)); };
// the two integers of so many units
auto high = [](float units) { return rintf(units * 0x1p-20f); };
auto low = [](float units, float high) { return __float2int_rn(fmaf(high, -0x1p20f, units)); };
// the brick at hand: its field, -1 for none, and its lowest node
int f = begins ? -1 : helds[warp].w, ox = helds[warp].x, oy = helds[warp].y, oz = helds[warp].z;
unsigned waiting = __ballot_sync(ALL, leads);
for (;;) {
    const bool fits = waiting >> lane & 1u && field == f && (unsigned)(x - ox) < 4u && (unsigned)(y - oy) < 4u &&
                      (unsigned)(z - oz) < 4u;
    const unsigned fitting = __ballot_sync(ALL, fits);
    // lane 9 i + 3 j + k knows the slot of block (i, j, k) from the brick's first; of one that is not needed, nonsense
    const int bx = min((ox >> 2) + li, grid.blocks[0] - 1), by = min((oy >> 2) + lj, grid.blocks[1] - 1);
    const int bz = min((oz >> 2) + lc, grid.blocks[2] - 1);
    const int block = (bx * grid.blocks[1] + by) * grid.blocks[2] + bz;
    const int slot = f < 0 ? 0 : wp::index(blocks.slot, e, f * grid.num_blocks + block);
    auto record_at = [&](int i, int j, int k) {  // of the brick's node; all lanes ask
        i += ox, j += oy, k += oz;
        const int from = ((i >> 2) - (ox >> 2)) * 9 + ((j >> 2) - (oy >> 2)) * 3 + (k >> 2) - (oz >> 2);
        return 64 * __shfl_sync(ALL, slot, from) + ((i & 3) * 4 + (j & 3)) * 4 + (k & 3);
    };
    if (fitting == 0) {
        if (f >= 0 && (waiting || ends)) {
            // which nodes have got something: who adds no mass adds nothing
            const float per_mass = one_over(wp::index(sums.mass_unit, min(e, sums.mass_unit.shape[0] - 1), f));
            const float per_momentum =
                one_over(wp::index(sums.momentum_unit, min(e, sums.momentum_unit.shape[0] - 1), f));
            int count = 0;
#pragma unroll 1
            for (int t = lane; t < 7 * 32; t += 32) {
                const int at_brick = t / 36 * ALONG_X + t / 6 % 6 * ALONG_Y + t % 6 * ALONG_Z;
                const bool has = t < NODES && brick[t < NODES ? at_brick : 0] * per_mass > 0.5f;
                const unsigned having = __ballot_sync(ALL, has);
                const int record = record_at(t / 36, t / 6 % 6, t % 6);
                if (has) {
                    const int at = count + __popc(having & ((1u << lane) - 1u));
                    record_of_node[at] = record;
                    place_of_node[at] = (unsigned short)at_brick;
                }
                count += __popc(having);
            }
            __syncwarp();
            const int c = lane & 7;
            const float per_unit = c == 0 ? per_mass : per_momentum;
            int* const fixed = (int*)&wp::index(sums.fixed, sums.is_fixed ? e : 0, 0) + c;
            float* const value = (float*)&wp::index(sums.value, sums.is_fixed ? 0 : e, 0) + c;
            if (c < 7)
                for (int n = lane >> 3; n < count; n += 4) {
                    const float added = brick[c + place_of_node[n]];
                    const int record = record_of_node[n];
                    if (added == 0.0f) continue;  // kinematic momentum, but near contact
                    if (sums.is_fixed) {
                        const float units = added * per_unit, part = high(units);
                        atomicAdd(fixed + 16 * record, (int)part);
                        atomicAdd(fixed + 16 * record + 8, low(units, part));
                    } else
                        atomicAdd(value + 8 * record, added);
                }
            __syncwarp();
        }
        if (waiting == 0) break;
        // a brick for the first cell that waits, put so that the others of its field fit in if they can
        const int leader = __ffs(waiting) - 1;
        f = __shfl_sync(ALL, field, leader);
        const bool waits = waiting >> lane & 1u && field == f;
        auto corner = [&](int at) {
            int least = waits ? at : 0x7fffffff;
#if __CUDA_ARCH__ >= 800
            least = __reduce_min_sync(ALL, least);
#else
            for (int d = 16; d > 0; d >>= 1) least = min(least, __shfl_xor_sync(ALL, least, d));
#endif
            const int own = __shfl_sync(ALL, at, leader);
            return own - least > 3 ? own - 1 : least;
        };
        ox = corner(x), oy = corner(y), oz = corner(z);
        for (int n = lane; n < BRICK / 4; n += 32)
            reinterpret_cast<float4*>(brick)[n] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        continue;
    }
    waiting &= ~fitting;
    // a particle tells its place if a boundary is near, or if a block that it touches has matter of another field
    bool tells = takes && fitting >> first & 1u && near;
    if (num_fields > 1) {
        const int others = wp::index(blocks.fields, e, block) & ~(1 << f);
        const unsigned shared = __ballot_sync(ALL, on && others != 0);
        if (shared && takes && fitting >> first & 1u) {
            const int i = (x >> 2) - (ox >> 2), j = (y >> 2) - (oy >> 2), k = (z >> 2) - (oz >> 2);
            unsigned touched = 1u << k | ((z & 3) > 1 ? 2u << k : 0u);
            touched = touched << 3 * j | ((y & 3) > 1 ? touched << 3 * j + 3 : 0u);
            touched = touched << 9 * i | ((x & 3) > 1 ? touched << 9 * i + 9 : 0u);
            tells = tells || (shared & touched) != 0;
        }
    }
    const unsigned telling = __ballot_sync(ALL, tells);
    if (telling && takes) {
        mine[4].w = tells ? s.at_base[0] : 0.0f;
        mine[6].z = tells ? seam * s.at_base[0] : 0.0f;
    }
    __syncwarp();

    // where a run begins, how long it is, and where its cell is in the brick
    const int corner_node = (x - ox) * ALONG_X + (y - oy) * ALONG_Y + (z - oz) * ALONG_Z;
    const int run = before | __popc(same) << 5 | (same & telling ? 1 << 11 : 0) | corner_node << 12;
    for (unsigned runs = fitting; runs; runs &= runs - 1) {
        const int now = __shfl_sync(ALL, run, __ffs(runs) - 1);
        const int begin = now & 31, end = begin + (now >> 5 & 63);
        float m[3] = {0.0f, 0.0f, 0.0f}, q[3] = {0.0f, 0.0f, 0.0f}, k[3] = {0.0f, 0.0f, 0.0f};
#pragma unroll 1
        for (int n = begin; n < end; ++n) {
            const float4* const a = stage + n * QUADS;
            const float* const b = reinterpret_cast<const float*>(a + 4);
            const float4 of_z = a[0], line = a[1 + lc];
            const float w = b[4 + li] * b[7 + lj], kinematic = b[lc];
            const float w0 = w * of_z.x, w1 = w * of_z.y, w2 = w * of_z.z;
            const float at = line.x + line.y * ri + line.z * rj;
            m[0] += w0 * of_z.w, m[1] += w1 * of_z.w, m[2] += w2 * of_z.w;
            q[0] += w0 * at, q[1] += w1 * (at + line.w), q[2] += w2 * (at + 2.0f * line.w);
            k[0] += w0 * kinematic, k[1] += w1 * kinematic, k[2] += w2 * kinematic;
        }
        float* const into = brick + (now >> 12) + li * ALONG_X + lj * ALONG_Y;
        if (on) {  // all reads before the first write, or each would wait for the one before it
            for (int c = 0; c < 3; ++c) {
                q[c] += into[1 + lc + c * ALONG_Z];
                k[c] += into[4 + lc + c * ALONG_Z];
                if (lc == 0) m[c] += into[c * ALONG_Z];
            }
            for (int c = 0; c < 3; ++c) {
                into[1 + lc + c * ALONG_Z] = q[c];
                into[4 + lc + c * ALONG_Z] = k[c];
                if (lc == 0) into[c * ALONG_Z] = m[c];
            }
        }
        if (now >> 11 & 1) {  // sums of w m (x_i - x_p), and of w m of seam particles, straight to the nodes
            float offset[3] = {0.0f, 0.0f, 0.0f}, grown[3] = {0.0f, 0.0f, 0.0f};
            for (int n = begin; n < end; ++n) {
                const float* const a = reinterpret_cast<const float*>(stage + n * QUADS);
                const float* const along = a + (lc == 0 ? 20 : lc == 1 ? 23 : 0);
                const float from = (lc == 0 ? ri : lc == 1 ? rj : 0.0f) - (1.0f + along[2] - along[0]);  // - f
                const float w = a[20 + li] * a[23 + lj];
                for (int c = 0; c < 3; ++c) {
                    offset[c] += w * a[c] * a[19] * (lc == 2 ? from + c : from);
                    grown[c] += w * a[c] * a[26];
                }
            }
            const float per_mass = one_over(wp::index(sums.mass_unit, min(e, sums.mass_unit.shape[0] - 1), f));
            const int at = now >> 12, i = at / ALONG_X + li, j = at % ALONG_X / ALONG_Y + lj;
            for (int c = 0; c < 3; ++c) {
                const int record = record_at(i, j, at % ALONG_X % ALONG_Y / ALONG_Z + c);
                if (!on) continue;
                if (sums.is_fixed) {
                    int* const at = (int*)&wp::index(sums.offset_fixed, e, record);
                    const float o = offset[c] * per_mass, g = grown[c] * per_mass;
                    atomicAdd(at + lc, (int)high(o)), atomicAdd(at + 4 + lc, low(o, high(o)));
                    if (lc == 0) atomicAdd(at + 3, (int)high(g)), atomicAdd(at + 7, low(g, high(g)));
                } else {
                    float* const at = (float*)&wp::index(sums.offset, e, record);
                    atomicAdd(at + lc, offset[c] * grid.dx);
                    if (lc == 0) atomicAdd(at + 3, grown[c]);
                }
            }
        }
        __syncwarp();
    }
}
if (lane == 0) helds[warp] = make_int4(ox, oy, oz, f);
__syncwarp();
#endif
"""


@wp.func_native(_SCATTER_RUNS)
def scatter_runs(
    grid: Grid,
    blocks: Blocks,
    sums: Sums,
    num_fields: int,
    e: int,
    begins: bool,
    ends: bool,
    takes: bool,
    near: bool,
    field: int,
    seam: float,
    s: Scattered,
    wx: wp.vec3,
    wy: wp.vec3,
    wz: wp.vec3,
):
    """Scatter the particles of a warp, one a lane, all of environment ``e``; lanes that do not ``take`` part have none.

    One with a boundary ``near`` adds to the nodes' offsets, too, as does one in whose blocks there are other fields.
    The brick is kept from call to call of a warp, from that which ``begins`` to that which ``ends``.
    """
    ...
