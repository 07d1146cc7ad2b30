// The threads of a CUDA block on a CPU: what the package's snippets in CUDA ask for, on the fibers of Warp's runtime.
//
// The modules that Warp generates include it, see __init__.py. A block's threads run one at a time, and others go on
// where one waits; so nothing here need be atomic. Every other block begins with its last thread: where results hang on
// who comes first, most tests see it. Shared memory begins with what is no number, and nobody may write behind it.
#pragma once

namespace gpu {

constexpr int THREADS = WP_TILE_BLOCK_DIM;
enum State { RUNS, MEETS_BLOCK, MEETS_WARP, LOOKS_AROUND, GONE };

struct Thread {
    State state;
    unsigned mask;  // whom it meets; then who has come
    int place;  // where in the source it looks around
    unsigned long long value;  // what it tells the others
    unsigned long long told[32];  // what those who have come have told
};

constexpr int GUARD = 1024, BLANK = 0x7fc0dead;
constexpr int MOST_TURNS = 4096 * THREADS;  // far more than it takes all to come where they wait for each other

static Thread threads[THREADS];
static unsigned block, blocks, blocks_begun;
static int count, left, turns;
alignas(16) static int room[GPU_ROOM_WORDS + GUARD];  // the block's shared memory, and what must stay as it is

// place in the block of the fiber that runs
inline int own()
{
    const int fiber = wp_cpu_get_thread_idx();
    return blocks_begun % 2 != 0 ? fiber : count - 1 - fiber;
}

// a fiber begins; the first does so first, and says which of all threads the block begins with
inline void begin(int fiber, size_t all, size_t first)
{
    if (fiber != 0) return;
    count = left = all - first < THREADS ? (int)(all - first) : THREADS;
    for (int t = 0; t < THREADS; ++t) threads[t].state = t < count ? RUNS : GONE;
    for (int& word : room) word = BLANK;
    block = first / THREADS, blocks = (all + THREADS - 1) / THREADS, turns = 0;
    ++blocks_begun;
}

inline void end()
{
    threads[own()].state = GONE;
    turns = 0;
    if (--left > 0) return;
    for (int n = 0; n < GUARD; ++n)
        if (room[GPU_ROOM_WORDS + n] != BLANK) _wp_assert("shared memory is written beyond its end", __FILE__, __LINE__);
}

// let others go on
inline void wait()
{
    if (++turns > MOST_TURNS) _wp_assert("threads of a block wait for each other for ever", __FILE__, __LINE__);
    wp_cpu_tile_sync();
}

inline void go_on(Thread& thread) { thread.state = RUNS, turns = 0; }

// those of a warp, by its first thread, of whom something is so
template <class F> unsigned who(int first, F is_so)
{
    unsigned mask = 0;
    for (int lane = 0; lane < 32 && first + lane < THREADS; ++lane)
        if (is_so(threads[first + lane])) mask |= 1u << lane;
    return mask;
}

// those of a warp who have come go on together
inline void go_on(int first, unsigned here)
{
    for (int lane = 0; lane < 32; ++lane)
        if (here >> lane & 1u) {
            threads[first + lane].mask = here;
            go_on(threads[first + lane]);
        }
}

// all that have not ended come here
inline void meet_block()
{
    Thread& self = threads[own()];
    self.state = MEETS_BLOCK;
    while (self.state == MEETS_BLOCK) {
        bool all = true;
        for (int t = 0; t < THREADS && all; ++t) all = threads[t].state == MEETS_BLOCK || threads[t].state == GONE;
        if (all) {
            for (int t = 0; t < THREADS; ++t)
                if (threads[t].state == MEETS_BLOCK) go_on(threads[t]);
        } else
            wait();
    }
}

// all of a mask that have not ended come here, and learn what the others tell
inline Thread& meet_warp(unsigned mask, unsigned long long value)
{
    const int t = own(), first = t & ~31;
    Thread& self = threads[t];
    self.value = value, self.mask = mask, self.state = MEETS_WARP;
    while (self.state == MEETS_WARP) {
        const unsigned others = mask & who(first, [](const Thread& one) { return one.state != GONE; });
        const auto comes = [=](const Thread& one) { return one.state == MEETS_WARP && one.mask == mask; };
        const unsigned here = others & who(first, comes);
        if (here == others) {
            for (int lane = 0; lane < 32; ++lane)
                for (int n = 0; here >> lane & 1u && n < 32; ++n)
                    threads[first + lane].told[n] = here >> n & 1u ? threads[first + n].value : 0;
            go_on(first, here);
        } else
            wait();
    }
    return self;
}

// who has come to the same place when nobody of the warp can go on: they are as much together as they can be
inline unsigned look_around(int place)
{
    const int t = own(), first = t & ~31;
    Thread& self = threads[t];
    self.place = place, self.state = LOOKS_AROUND;
    while (self.state == LOOKS_AROUND) {
        if (who(first, [](const Thread& one) { return one.state == RUNS; }) == 0)
            go_on(first, who(first, [=](const Thread& one) { return one.state == LOOKS_AROUND && one.place == place; }));
        else
            wait();
    }
    return self.mask;
}

template <class T> unsigned long long bits_of(T value)
{
    static_assert(sizeof(T) <= 8, "up to 64 bits");
    unsigned long long bits = 0;
    memcpy(&bits, &value, sizeof(T));
    return bits;
}

template <class T> T from_bits(unsigned long long bits)
{
    T value;
    memcpy(&value, &bits, sizeof(T));
    return value;
}

struct Index { unsigned x; };

}  // namespace gpu

#define GPU_ARCH 900
#define threadIdx (gpu::Index{(unsigned)gpu::own()})
#define blockDim (gpu::Index{(unsigned)gpu::THREADS})
#define blockIdx (gpu::Index{gpu::block})
#define gridDim (gpu::Index{gpu::blocks})
#define __shared__ static
#define __align__(bytes) __attribute__((aligned(bytes)))
#define __syncthreads() gpu::meet_block()
#define __activemask() gpu::look_around(__LINE__)

struct alignas(16) int4 { int x, y, z, w; };
struct alignas(16) longlong2 { long long x, y; };
inline int4 make_int4(int x, int y, int z, int w) { return {x, y, z, w}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

inline int __float_as_int(float x) { return gpu::from_bits<int>(gpu::bits_of(x)); }
inline unsigned __float_as_uint(float x) { return gpu::from_bits<unsigned>(gpu::bits_of(x)); }
inline float __int_as_float(int x) { return gpu::from_bits<float>(gpu::bits_of(x)); }
inline float __uint_as_float(unsigned x) { return gpu::from_bits<float>(gpu::bits_of(x)); }
inline int __float2int_rn(float x)
{
    if (x != x) return 0;
    return x >= 0x1p31f ? 0x7fffffff : x < -0x1p31f ? (int)0x80000000 : (int)rintf(x);
}
inline long long __float2ll_rn(float x)  // what is no number becomes the least, unlike in 32 bits
{
    if (x != x || x < -0x1p63f) return -0x7fffffffffffffffll - 1;
    return x >= 0x1p63f ? 0x7fffffffffffffffll : (long long)rintf(x);
}
inline float rsqrtf(float x) { return 1.0f / sqrtf(x); }
inline float __fmaf_rn(float a, float b, float c) { return fmaf(a, b, c); }
#pragma clang optimize off
// rounded, never fused with what comes after
inline float __fadd_rn(float a, float b) { volatile float sum = a + b; return sum; }
inline float __fmul_rn(float a, float b) { volatile float product = a * b; return product; }
#pragma clang optimize on
inline float fminf(float a, float b) { return a != a || b < a ? b : a; }
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __clz(int x) { return x == 0 ? 32 : __builtin_clz((unsigned)x); }
inline int __ffs(unsigned x) { return __builtin_ffs((int)x); }
template <class T> T __ldg(const T* at) { return *at; }

inline int min(int a, int b) { return a < b ? a : b; }
inline int max(int a, int b) { return a > b ? a : b; }
inline unsigned min(unsigned a, unsigned b) { return a < b ? a : b; }
inline unsigned max(unsigned a, unsigned b) { return a > b ? a : b; }

inline void __syncwarp(unsigned mask = 0xffffffffu) { gpu::meet_warp(mask, 0); }
inline unsigned __ballot_sync(unsigned mask, bool yes)
{
    const auto& self = gpu::meet_warp(mask, yes);
    unsigned all = 0;
    for (int n = 0; n < 32; ++n) all |= (unsigned)self.told[n] << n;
    return all;
}
inline bool __any_sync(unsigned mask, bool yes) { return __ballot_sync(mask, yes) != 0u; }
inline bool __all_sync(unsigned mask, bool yes) { return __ballot_sync(mask, !yes) == 0u; }
template <class T> T __shfl_sync(unsigned mask, T value, int lane)
{
    return gpu::from_bits<T>(gpu::meet_warp(mask, gpu::bits_of(value)).told[lane & 31]);
}
template <class T> T __shfl_xor_sync(unsigned mask, T value, int distance)
{
    return __shfl_sync(mask, value, (gpu::own() ^ distance) & 31);
}
template <class T> unsigned __match_any_sync(unsigned mask, T value)
{
    const auto& self = gpu::meet_warp(mask, gpu::bits_of(value));
    unsigned same = 0;
    for (int n = 0; n < 32; ++n)
        if (self.mask >> n & 1u && self.told[n] == gpu::bits_of(value)) same |= 1u << n;
    return same;
}
template <class T> unsigned __match_all_sync(unsigned mask, T value, int* all)
{
    const unsigned same = __match_any_sync(mask, value), here = gpu::threads[gpu::own()].mask;
    *all = same == here;
    return *all ? here : 0u;
}
template <class T, class F> T reduced(unsigned mask, T value, F of)
{
    const auto& self = gpu::meet_warp(mask, gpu::bits_of(value));
    T result = value;
    for (int n = 0; n < 32; ++n)
        if (self.mask >> n & 1u) result = of(result, gpu::from_bits<T>(self.told[n]));
    return result;
}
template <class T> T __reduce_max_sync(unsigned mask, T value)
{
    return reduced(mask, value, [](T a, T b) { return a > b ? a : b; });
}
template <class T> T __reduce_min_sync(unsigned mask, T value)
{
    return reduced(mask, value, [](T a, T b) { return a < b ? a : b; });
}
inline unsigned __reduce_or_sync(unsigned mask, unsigned value)
{
    return reduced(mask, value, [](unsigned a, unsigned b) { return a | b; });
}

template <class T, class F> T changed(T* at, F to)
{
    const T before = *at;
    *at = to(before);
    return before;
}
template <class T, class V> T atomicAdd(T* at, V v) { return changed(at, [=](T b) { return (T)(b + (T)v); }); }
template <class T, class V> T atomicMax(T* at, V v) { return changed(at, [=](T b) { return b > (T)v ? b : (T)v; }); }
template <class T, class V> T atomicMin(T* at, V v) { return changed(at, [=](T b) { return b < (T)v ? b : (T)v; }); }
template <class T, class V> T atomicOr(T* at, V v) { return changed(at, [=](T b) { return (T)(b | (T)v); }); }
template <class T> T atomicCAS(T* at, T expected, T v) { return changed(at, [=](T b) { return b == expected ? v : b; }); }

inline size_t __cvta_generic_to_global(const void* at) { return (size_t)at; }
inline size_t __cvta_generic_to_shared(const void* at) { return (size_t)((const char*)at - (const char*)gpu::room); }
