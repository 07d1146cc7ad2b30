"""The sums of a group of particles in shared memory: added to as integers, and put down on the nodes.

What particles add has a scalar and a vector that is linear over the stencil. It is counted in units of the group: 2^-25
of the most that any of its particles of a field has, a power of two, and not less than what the sums outside count. So
integers are added in any order, and put down exactly. A weight is 27/64 at most: 128 summands stay below 2^31. (Units
four times as large would do with a fused addition to make an integer of a summand, but a body that drifts through the
grid makes the same errors again and again: it lost 1e-5 of its momentum in 300 substeps.)
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.group_bricks import POWER, in_group
from piavatar_envs.mpm.types import FAILURE_CFL, Grid, Sums

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    in_group("""
float value[4], along[3][3], f[3];
int brick[4], parity = 4 * (base[0] & 1) + 2 * (base[1] & 1) + (base[2] & 1);
value[0] = s[0] * per_scalar;
for (int c = 0; c < 3; ++c) {
    value[1 + c] = s[1 + c] * per_vector;
    for (int d = 0; d < 3; ++d) along[c][d] = A.data[c][d] * per_vector;
    f[c] = at[c];
}
for (int n = 0; n < 4; ++n) brick[n] = bricks[n];
// in small groups, a thread takes a plane of a particle instead, and half of the threads perhaps another
const bool splits = share <= MOST_SPLIT;
int t = threadIdx.x;
asm volatile("" : "+r"(t));  // what follows from it is not kept from kind to kind, in registers that there are not
if (splits) {
    int* handed = room + HANDED + t;
    if (t < share) {
        for (int n = 0; n < 4; ++n, handed += share) *handed = __float_as_int(value[n]);
        for (int n = 0; n < 9; ++n, handed += share) *handed = __float_as_int(along[n / 3][n % 3]);
        for (int n = 0; n < 3; ++n, handed += share) *handed = __float_as_int(f[n]);
        for (int n = 0; n < 4; ++n, handed += share) *handed = brick[n];
        *handed = takes ? parity : -1;
    }
    __syncthreads();
}
// neighbours, which are often in the same cell, take its nodes in another order: who adds to the same word waits
int i = t / 9 % 3;
const int first_j = t / 3 % 3, first_l = t % 3, items = splits ? 3 * share : (int)blockDim.x;
auto spline = [](float f, int n) {
    const float edge = n == 0 ? 1.5f - f : f - 0.5f;
    return n == 1 ? 0.75f - (f - 1.0f) * (f - 1.0f) : 0.5f * edge * edge;
};
#pragma unroll 1
for (int item = t; item < items; item += blockDim.x) {
if (splits) {
    i = item / share;
    const int* handed = room + HANDED + item - i * share;
    for (int n = 0; n < 4; ++n, handed += share) value[n] = __int_as_float(*handed);
    for (int n = 0; n < 9; ++n, handed += share) along[n / 3][n % 3] = __int_as_float(*handed);
    for (int n = 0; n < 3; ++n, handed += share) f[n] = __int_as_float(*handed);
    for (int n = 0; n < 4; ++n, handed += share) brick[n] = *handed;
    parity = *handed;
    takes = parity >= 0;
}
if (!takes) continue;
const int px = parity >> 2, py = parity >> 1 & 1, pz = parity & 1;
float weight_y[3], weight_z[3], at_y[3], at_z[3];
int word_y[3], word_z[3];
bool upper_y[3], upper_z[3];
for (int n = 0, j = first_j, l = first_l; n < 3; ++n, j = j == 2 ? 0 : j + 1, l = l == 2 ? 0 : l + 1) {
    weight_y[n] = spline(f[1], j), weight_z[n] = spline(f[2], l);
    at_y[n] = (float)j, at_z[n] = (float)l;
    word_y[n] = (py + j & 1) * 2, word_z[n] = pz + l & 1;
    upper_y[n] = py + j > 1, upper_z[n] = pz + l > 1;
}
#pragma unroll 1
for (int n = splits ? 2 : 0; n < 3; ++n, i = i == 2 ? 0 : i + 1) {
    const float wi = spline(f[0], i), at_x = (float)i;
    const bool far = px + i > 1;
    const int lower = far ? brick[2] : brick[0], upper = far ? brick[3] : brick[1];
    int* const plane = room + NODES + (px + i & 1) * 4;
    float corner[3];
    for (int c = 0; c < 3; ++c) corner[c] = value[1 + c] + at_x * along[c][0];
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        const int both = upper_y[j] ? upper : lower;
        int* const near = plane + word_y[j] + (both & 0xffff);
        int* const next = plane + word_y[j] + (both >> 16);
        const float w = wi * weight_y[j];
        float q[3];
        for (int c = 0; c < 3; ++c) q[c] = corner[c] + at_y[j] * along[c][1];
#pragma unroll
        for (int l = 0; l < 3; ++l) {
            int* const node = (upper_z[l] ? next : near) + word_z[l];
            const float wl = w * weight_z[l];
            auto count = [=](float x) { return __float2int_rn(wl * x); };
            atomicAdd(node, count(value[0]));
            for (int c = 0; c < 3; ++c) atomicAdd(node + (1 + c) * ALONG, count(q[c] + at_z[l] * along[c][2]));
        }
    }
}
}
""")
)
def add_to_nodes(
    share: int,
    takes: bool,
    bricks: wp.vec4i,
    base: wp.vec3i,
    at: wp.vec3,
    s: wp.vec4,
    A: wp.mat33,
    per_scalar: float,
    per_vector: float,
):
    """Add to the 27 nodes of a stencil a scalar and a vector, ``s`` at the lowest node, the latter changing by ``A``.

    ``at`` is the position from there. In groups of a ``share`` of up to half of the threads, these take a plane of a
    particle each; so all of them come here.
    """
    ...


@wp.func_native(
    in_group(f"""
{POWER}
const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5, warps = blockDim.x >> 5, c = lane & 3, corner = lane >> 2;
const bool is_place = kind == PLACE, of_mass = c == 0 || is_place;
const int most = of_mass ? HEAVIEST : kind == KINEMATIC ? DRIVEN : FASTEST;
const int word = c > 0 ? c - (kind != 0) : kind == 0 ? 0 : 3;  // of four that lie together
const int halves = kind == KINEMATIC ? 64 : 0;
const int within = ((corner & 4) << 2) + ((corner & 2) << 1) + (corner & 1);
const bool is_fixed = sums.is_fixed != 0;
char* const to = (is_place ? (char*)&wp::index(sums.offset_fixed, is_fixed ? e : 0, 0)
                           : (char*)&wp::index(sums.fixed, is_fixed ? e : 0, 0))
    + 32 * (within + halves) + 8 * word;
float unit = 0.0f;
int shift = 0, most_counted = 0;
auto count_in = [&](int field) {{  // the group's units are not smaller than those of the sums: shifted, they are exact
    unit = power_of_two(room[most + field]) * (is_place && c > 0 ? 0x1p-24f : 0x1p-25f);
    const int counted = room[(of_mass ? MASS_UNIT : MOMENTUM_UNIT) + field];
    shift = (__float_as_int(unit) - counted) >> 23;
    most_counted = shift > 48 ? 0 : shift < 18 ? 0x7fffffff : 1 << (48 - shift);
}};
const int bricks = room[COUNT];
int counted_in = num_fields > 1 && bricks > 0 ? room[BRICKS] : 0;  // where nobody takes part, nothing is there
count_in(counted_in);
bool too_much = false;
int* at = room + NODES + c * ALONG + 8 * warp + corner;
int next = warp < bricks ? *at : 0, next_record = warp < bricks ? room[RECORDS + warp] : 0;  // one ahead: less to wait
for (int place = warp; place < bricks; place += warps) {{
    int sum = next;
    if (sum != 0) *at = 0;
    at += 8 * warps;
    const unsigned record = next_record & ~SHARED;
    if (place + warps < bricks) next = *at, next_record = room[RECORDS + place + warps];
    unsigned massive = __ballot_sync(ALL, sum != 0);  // who adds no mass adds nothing
    if (kind != 0) massive = room[MASSIVE + place];
    if (kind == 0 && lane == 0) room[MASSIVE + place] = massive;
    if (num_fields > 1 && room[BRICKS + place] != counted_in) count_in(counted_in = room[BRICKS + place]);
    if (!(massive >> (lane & 28) & 1u)) sum = 0;
    if (is_fixed) {{
        if (abs(sum) > most_counted) {{
            too_much = true;
            sum = 0;
        }}
        const size_t at = is_place ? record : record + (record & ~63u);
        const long long added = (long long)sum << shift;  // memory takes the four numbers of a node at a time
        if (sum != 0) atomicAdd((unsigned long long*)(to + 32 * at), added);
    }} else if (sum == 0)
        continue;
    else if (is_place)
        atomicAdd((float*)&wp::index(sums.offset, e, record + within) + word, sum * (c > 0 ? unit * grid.dx : unit));
    else
        atomicAdd((float*)&wp::index(sums.value, e, halves + record + (record & ~63) + within) + word, sum * unit);
}}
if (too_much) atomicOr(&wp::index(failure, e), {FAILURE_CFL});
""")
)
def put_down(grid: Grid, sums: Sums, num_fields: int, failure: wp.array(dtype=int), e: int, kind: int):
    """Add what the nodes have got of a ``kind`` to the sums outside, and forget it; sums that are too large are not.

    Four threads a node. Masses come first.
    """
    ...
