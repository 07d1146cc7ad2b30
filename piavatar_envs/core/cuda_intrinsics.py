"""Threads of a launch: their indices, barriers, and reductions over the threads that share a piece of work.

Such threads are a warp or a part of one on a GPU, and a single thread on a CPU. They are consecutive in the last
dimension of the launch, a power of two, at most 32, and all call a reduction together. A sum is added in an order that
is fixed, whatever the schedule and the number of environments.

``wp.tid()`` of two dimensions divides 64-bit numbers, about sixty dependent instructions; the index functions here
divide 32-bit numbers, or none at all for a single environment.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.arrays import vec8, vec12, vec16

wp.set_module_options({"enable_backward": False})


def cuda_native(cuda: str, otherwise: str = "") -> str:
    """Return a snippet that is ``cuda`` on a GPU and ``otherwise`` on a CPU."""
    return f"#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{otherwise}\n#endif\n"


@wp.func_native(cuda_native("__syncwarp();"))
def sync_warp():
    """Wait for the other threads of the warp; all that have not ended must call this."""
    ...


@wp.func_native(cuda_native("return threadIdx.x;", "return 0;"))
def thread_of_block() -> int:
    """Return the index of a thread in its CUDA block."""
    ...


@wp.func_native(cuda_native("return blockIdx.x;", "return 0;"))
def block_of_launch() -> int:
    """Return the index of a CUDA block in its launch."""
    ...


@wp.func_native(cuda_native("return blockDim.x;", "return 1;"))
def threads_of_block() -> int:
    """Return the number of threads of a CUDA block."""
    ...


@wp.func_native(cuda_native("__syncthreads();"))
def sync_block():
    """Wait for the other threads of the CUDA block."""
    ...


# the masks let the compiler assume that neither is negative, which removes Warp's handling of negative indices
@wp.func_native("""
const unsigned all = (unsigned)thread, each = (unsigned)per_env;
unsigned e = 0u;
if (all >= each) e = all / each;
return wp::vec2i((int)(e & 0x7fffffffu), (int)((all - e * each) & 0x7fffffffu));
""")
def environment_of(thread: int, per_env: int) -> wp.vec2i:
    """Return environment and index within it of a thread of a launch over ``num_envs * per_env`` threads."""
    ...


#: Threads of a CUDA block in a controller's launches over particles and over sums.
BLOCK = 128
#: Most particles of a thread in passes bound by memory latency, where it loads the next particle ahead of time.
ROUNDS = 6
#: Threads sharing the chunks of a bone from which on each bone has its own warp.
MANY_THREADS = 8
#: Threads that a multiprocessor can have.
RESIDENT = 2048


def warp_threads(device: str) -> int:
    """Return how many threads share a chunk of a bone's particles, or the bones of an environment: a warp on a GPU."""
    return 32 if wp.get_device(device).is_cuda else 1


def chunk_threads(device: str, chunks: int) -> int:
    """Return how many threads add up the ``chunks`` of a bone, about two chunks each; 0 if each bone has its own warp.

    A warp that visits one bone after another waits for memory at each.
    """
    threads = min(warp_threads(device), 1 << max(0, (chunks - 1) // 2).bit_length())
    return threads if threads < MANY_THREADS else 0


def particle_rounds(device: str, particles: int) -> int:
    """Return how many particles a thread processes: as many as still fill a GPU, at most :data:`ROUNDS`."""
    gpu = wp.get_device(device)
    return min(ROUNDS, max(1, particles // (gpu.sm_count * RESIDENT))) if gpu.is_cuda else 1


def particle_threads(device: str, count: int, rounds: int) -> int:
    """Return how many threads share ``count`` particles in ``rounds`` rounds: whole CUDA blocks, one on a CPU."""
    return -(-count // (BLOCK * rounds)) * BLOCK if wp.get_device(device).is_cuda else 1


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
const unsigned blocks = ((unsigned)threads + {BLOCK - 1}u) / {BLOCK}u, row = blockIdx.x / blocks;
return wp::vec_t<2, wp::int32>((int)row, (int)((blockIdx.x - row * blocks) * {BLOCK}u + threadIdx.x));
#else
return wp::vec_t<2, wp::int32>(e, 0);
#endif
""")
def first_particle(e: int, threads: int) -> wp.vec2i:
    """Return environment and first particle of one of ``threads`` threads; the particle may not exist."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
return (int)(gridDim.x / (unsigned)num_envs * {BLOCK}u);
#else
return 1;
#endif
""")
def threads_of_environment(num_envs: int) -> int:
    """Return :func:`particle_threads` of the running launch over ``(num_envs, particle_threads)``."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const unsigned warp = blockIdx.x * (blockDim.x >> 5) + (threadIdx.x >> 5), row = warp / (unsigned)chunks;
return wp::vec_t<3, wp::int32>((int)row, (int)(warp - row * (unsigned)chunks), (int)(threadIdx.x & 31));
#else
return wp::vec_t<3, wp::int32>(e, c, thread);
#endif
""")
def place_in_chunks(e: int, c: int, thread: int, chunks: int) -> wp.vec3i:
    """Return environment, warp and lane in a launch over ``(num_envs, chunks, warp_threads)``."""
    ...


# Constants at compile time let the compiler drop loops over bones that have one round, and the code of single threads.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
return wp::vec_t<3, wp::int32>((int)blockIdx.x, (int)threadIdx.x & (block - 1), block);
#else
return wp::vec_t<3, wp::int32>(e, 0, 1);
#endif
""")
def place_in_block(e: int, block: int) -> wp.vec3i:
    """Return environment, thread and number of threads in a launch over ``(num_envs, block)``, a CUDA block each.

    On a CPU the launch is over ``(num_envs, 1)`` and the result is ``(e, 0, 1)``.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return wp::vec_t<2, wp::int32>((int)(threadIdx.x >> 5), (int)(blockDim.x >> 5));
#else
return wp::vec_t<2, wp::int32>(0, 1);
#endif
""")
def warp_of_block() -> wp.vec2i:
    """Return index and number of warps of a thread's CUDA block; ``(0, 1)`` on a CPU."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return wp::vec_t<2, wp::int32>((int)(threadIdx.x & 31), 32);
#else
return wp::vec_t<2, wp::int32>(0, 1);
#endif
""")
def lane_of_warp() -> wp.vec2i:
    """Return index and number of threads of a thread's warp; ``(0, 1)`` on a CPU."""
    ...


# Each round doubles the distance to the ancestor whose value is accumulated.
_OVER_ANCESTORS = """
#if defined(__CUDA_ARCH__)
int up = parent;
for (int reach = 1; reach < levels; reach *= 2) {
    const int from = up < 0 ? 0 : up;
    auto before = value;
#pragma unroll
    for (int k = 0; k < %(count)d; ++k) {
        const float more = __shfl_sync(0xffffffffu, value[k], from);
        %(each)s
    }
    %(then)s
    const int next = __shfl_sync(0xffffffffu, up, from);
    up = up < 0 ? -1 : next;
}
#endif
return value;
"""


def over_ancestors(count: int, each: str, then: str = "") -> str:
    """Return a snippet that accumulates ``value``, one bone a lane, from the root to each bone by pointer doubling.

    Args:
        count: numbers of a value.
        each: statement for number ``k``, given that of ancestor ``up`` as ``more``; ``up`` is negative above the root.
        then: statement after all numbers; ``each`` may keep values in ``before``, of the type of ``value``.
    """
    return _OVER_ANCESTORS % {"count": count, "each": each, "then": then}


_SUM = """
#if defined(__CUDA_ARCH__)
const unsigned group = threads >= 32 ? 0xffffffffu : ((1u << threads) - 1u) << (threadIdx.x & 31 & -threads);
for (int distance = threads >> 1; distance > 0; distance >>= 1)
%s;
#endif
return value;
"""
_SUM_ONE = _SUM % "    value += __shfl_xor_sync(group, value, distance)"
_SUM_MANY = (
    _SUM
    % """#pragma unroll
    for (int c = 0; c < %d; ++c) value[c] += __shfl_xor_sync(group, value[c], distance)"""
)


# Each step halves both the numbers a thread keeps and the threads that share them: 16 exchanges instead of 80.
_HALVE = """
    const int lane = threadIdx.x & 31;
    float part[16];
#pragma unroll
    for (int k = 0; k < 16; ++k) part[k] = k < WORDS ? value[k] : 0.0f;
#define HALVE(half)                                                                                  \\
    _Pragma("unroll") for (int k = 0; k < half; ++k) {                                               \\
        const bool upper = lane & 2 * half;                                                          \\
        const float away = upper ? part[k] : part[k + half];                                         \\
        part[k] = (upper ? part[k + half] : part[k]) + __shfl_xor_sync(0xffffffffu, away, 2 * half); \\
    }
    HALVE(8) HALVE(4) HALVE(2) HALVE(1)
    part[0] += __shfl_xor_sync(0xffffffffu, part[0], 1);
"""
_SUM_OF_WARP = (
    "#if defined(__CUDA_ARCH__)\nif (threads == 32) {\n    constexpr int WORDS = 16;"
    + _HALVE
    + """
#pragma unroll
    for (int k = 0; k < WORDS; ++k) value[k] = __shfl_sync(0xffffffffu, part[0], 2 * k);
    return value;
}
#endif
"""
)


@wp.func_native(_SUM_ONE)
def sum_threads(value: float, threads: int) -> float:
    """Return the sum over ``threads`` threads to all of them."""
    ...


@wp.func_native(_SUM_MANY % 6)
def sum_threads6(value: vec8, threads: int) -> vec8:
    """Return the sum of six numbers over ``threads`` threads to all of them."""
    ...


@wp.func_native(_SUM_MANY % 12)
def sum_threads12(value: vec12, threads: int) -> vec12:
    """Return the sum of twelve numbers over ``threads`` threads to all of them."""
    ...


@wp.func_native(_SUM_OF_WARP + _SUM_MANY % 16)
def sum_threads16(value: vec16, threads: int) -> vec16:
    """Return the sum of sixteen numbers over ``threads`` threads to all of them."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int distance = threads >> 1; distance > 0; distance >>= 1) bits |= __shfl_xor_sync(0xffffffffu, bits, distance);
#endif
return bits;
""")
def or_of_threads(bits: int, threads: int) -> int:
    """Return the bitwise or over ``threads`` threads to all of them."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int distance = threads >> 1; distance > 0; distance >>= 1) {
    const float other = __shfl_xor_sync(0xffffffffu, value, distance);
    const int other_which = __shfl_xor_sync(0xffffffffu, which, distance);
    if (other > value || (other == value && other_which < which)) value = other, which = other_which;
}
#endif
return wp::vec_t<2, wp::float32>(value, (float)which);
""")
def max_of_threads(value: float, which: int, threads: int) -> wp.vec2:
    """Return the largest value over ``threads`` threads, and its ``which``, the lower one of equals."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
if (threads > 1) __syncwarp();
#endif
""")
def sync_threads(threads: int):
    """Make what a thread of the warp has stored visible to the others."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 31 - __clz(bits);
#else
return 0;
#endif
""")
def highest_bit(bits: int) -> int:
    """Return the index of the highest set bit, on a GPU; ``bits`` must not be 0."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return threadIdx.x & 31;
#else
return 0;
#endif
""")
def lane_of_thread() -> int:
    """Return the index of a thread in its warp; 0 on a CPU."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __any_sync(0xffffffffu, here);
#else
return here;
#endif
""")
def any_lane(here: bool) -> bool:
    """Return whether ``here`` holds in any thread of the warp; all of its threads must call this."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return (int)__ballot_sync(0xffffffffu, here);
#else
return here;
#endif
""")
def lanes_with(here: bool) -> int:
    """Return a mask of the threads of the warp for which ``here`` holds; all must call this. One bit on a CPU."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 32;
#else
return 1;
#endif
""")
def lanes_of_warp() -> int:
    """Return the number of threads of a warp; 1 on a CPU."""
    ...
