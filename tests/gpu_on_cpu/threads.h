// Threads of a CUDA block on a CPU: the CUDA functions that the package's snippets use, on the fibers of Warp's runtime.
//
// Included by the modules that Warp generates, see __init__.py. The threads of a block run one at a time and switch
// where one waits, so nothing here is atomic. Every other block starts with its last thread, which reveals results that
// depend on the order of threads. Shared memory is initialised with NaN, and a guard behind it must stay unchanged.
#pragma once

namespace gpu {

constexpr int THREADS = WP_TILE_BLOCK_DIM;
enum State { RUNS, AT_BLOCK_BARRIER, AT_WARP_BARRIER, AT_ACTIVE_MASK, ENDED };

struct Thread {
    State state;
    unsigned mask;  // lanes that it waits for; afterwards those that arrived
    int place;  // source line of its query of active lanes
    unsigned long long value;  // value that it exchanges
    unsigned long long received[32];  // values of the lanes that arrived
};

constexpr int GUARD = 1024, BLANK = 0x7fc0dead;
constexpr int MAX_SWITCHES = 4096 * THREADS;  // far more switches than any barrier needs

static Thread threads[THREADS];
static unsigned block, blocks, blocks_begun;
static int count, left, switches;
alignas(16) static int arena[GPU_ARENA_WORDS + GUARD];  // the block's shared memory and the guard

// index in the block of the running fiber
inline int own()
{
    const int fiber = wp_cpu_get_thread_idx();
    return blocks_begun % 2 != 0 ? fiber : count - 1 - fiber;
}

// begins a fiber; fiber 0 begins first and sets up the block
inline void begin(int fiber, size_t all, size_t first)
{
    if (fiber != 0) return;
    count = left = all - first < THREADS ? (int)(all - first) : THREADS;
    for (int t = 0; t < THREADS; ++t) threads[t].state = t < count ? RUNS : ENDED;
    for (int& word : arena) word = BLANK;
    block = first / THREADS, blocks = (all + THREADS - 1) / THREADS, switches = 0;
    ++blocks_begun;
}

inline void end()
{
    threads[own()].state = ENDED;
    switches = 0;
    if (--left > 0) return;
    for (int n = 0; n < GUARD; ++n)
        if (arena[GPU_ARENA_WORDS + n] != BLANK) _wp_assert("shared memory is written beyond its end", __FILE__, __LINE__);
}

// switch to other fibers
inline void wait()
{
    if (++switches > MAX_SWITCHES) _wp_assert("threads of a block wait for each other for ever", __FILE__, __LINE__);
    wp_cpu_tile_sync();
}

inline void resume(Thread& thread) { thread.state = RUNS, switches = 0; }

// mask of the lanes of a warp, by its first thread, for which a predicate holds
template <class F> unsigned lanes_where(int first, F holds)
{
    unsigned mask = 0;
    for (int lane = 0; lane < 32 && first + lane < THREADS; ++lane)
        if (holds(threads[first + lane])) mask |= 1u << lane;
    return mask;
}

// resume the lanes that have arrived together
inline void resume(int first, unsigned here)
{
    for (int lane = 0; lane < 32; ++lane)
        if (here >> lane & 1u) {
            threads[first + lane].mask = here;
            resume(threads[first + lane]);
        }
}

// barrier of all threads that have not ended
inline void block_barrier()
{
    Thread& self = threads[own()];
    self.state = AT_BLOCK_BARRIER;
    while (self.state == AT_BLOCK_BARRIER) {
        bool all = true;
        for (int t = 0; t < THREADS && all; ++t) all = threads[t].state == AT_BLOCK_BARRIER || threads[t].state == ENDED;
        if (all) {
            for (int t = 0; t < THREADS; ++t)
                if (threads[t].state == AT_BLOCK_BARRIER) resume(threads[t]);
        } else
            wait();
    }
}

// barrier of the lanes of a mask that have not ended, with an exchange of values
inline Thread& warp_exchange(unsigned mask, unsigned long long value)
{
    const int t = own(), first = t & ~31;
    Thread& self = threads[t];
    self.value = value, self.mask = mask, self.state = AT_WARP_BARRIER;
    while (self.state == AT_WARP_BARRIER) {
        const unsigned expected = mask & lanes_where(first, [](const Thread& one) { return one.state != ENDED; });
        const auto arrives = [=](const Thread& one) { return one.state == AT_WARP_BARRIER && one.mask == mask; };
        const unsigned here = expected & lanes_where(first, arrives);
        if (here == expected) {
            for (int lane = 0; lane < 32; ++lane)
                for (int n = 0; here >> lane & 1u && n < 32; ++n)
                    threads[first + lane].received[n] = here >> n & 1u ? threads[first + n].value : 0;
            resume(first, here);
        } else
            wait();
    }
    return self;
}

// lanes at the same source line when no lane of the warp can run: the largest set that can be active together
inline unsigned active_mask(int place)
{
    const int t = own(), first = t & ~31;
    Thread& self = threads[t];
    self.place = place, self.state = AT_ACTIVE_MASK;
    while (self.state == AT_ACTIVE_MASK) {
        if (lanes_where(first, [](const Thread& one) { return one.state == RUNS; }) == 0)
            resume(first, lanes_where(first, [=](const Thread& one) { return one.state == AT_ACTIVE_MASK && one.place == place; }));
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
#define __syncthreads() gpu::block_barrier()
#define __activemask() gpu::active_mask(__LINE__)

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
inline float rsqrtf(float x) { return 1.0f / sqrtf(x); }
#pragma clang optimize off
// rounded, never fused
inline float __fmul_rn(float a, float b) { volatile float product = a * b; return product; }
#pragma clang optimize on
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __clz(int x) { return x == 0 ? 32 : __builtin_clz((unsigned)x); }
inline int __ffs(unsigned x) { return __builtin_ffs((int)x); }

inline int min(int a, int b) { return a < b ? a : b; }
inline int max(int a, int b) { return a > b ? a : b; }
inline unsigned min(unsigned a, unsigned b) { return a < b ? a : b; }
inline unsigned max(unsigned a, unsigned b) { return a > b ? a : b; }

inline void __syncwarp(unsigned mask = 0xffffffffu) { gpu::warp_exchange(mask, 0); }
inline unsigned __ballot_sync(unsigned mask, bool yes)
{
    const auto& self = gpu::warp_exchange(mask, yes);
    unsigned all = 0;
    for (int n = 0; n < 32; ++n) all |= (unsigned)self.received[n] << n;
    return all;
}
inline bool __any_sync(unsigned mask, bool yes) { return __ballot_sync(mask, yes) != 0u; }
inline bool __all_sync(unsigned mask, bool yes) { return __ballot_sync(mask, !yes) == 0u; }
template <class T> T __shfl_sync(unsigned mask, T value, int lane)
{
    return gpu::from_bits<T>(gpu::warp_exchange(mask, gpu::bits_of(value)).received[lane & 31]);
}
template <class T> T __shfl_xor_sync(unsigned mask, T value, int distance)
{
    return __shfl_sync(mask, value, (gpu::own() ^ distance) & 31);
}
template <class T> unsigned __match_any_sync(unsigned mask, T value)
{
    const auto& self = gpu::warp_exchange(mask, gpu::bits_of(value));
    unsigned same = 0;
    for (int n = 0; n < 32; ++n)
        if (self.mask >> n & 1u && self.received[n] == gpu::bits_of(value)) same |= 1u << n;
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
    const auto& self = gpu::warp_exchange(mask, gpu::bits_of(value));
    T result = value;
    for (int n = 0; n < 32; ++n)
        if (self.mask >> n & 1u) result = of(result, gpu::from_bits<T>(self.received[n]));
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

inline size_t __cvta_generic_to_global(const void* at) { return (size_t)at; }
inline size_t __cvta_generic_to_shared(const void* at) { return (size_t)((const char*)at - (const char*)gpu::arena); }
