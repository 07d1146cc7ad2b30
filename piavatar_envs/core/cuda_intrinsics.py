"""The dynamic shared memory of a CUDA block, its room, as words of 4 bytes; a kernel reserves it as a tile.

Warp's tiles are read and written by all threads together; here each goes its own way. Nothing here runs on a CPU.

Which environment a thread of a launch takes part in.

``wp.tid()`` of two dimensions divides 64-bit numbers, which costs a thread some sixty instructions, one after the
other; 32 bits are enough, and a single environment needs no division.

Reads and writes of arrays whose rows are dense, as all of this package's are: their address is one multiplication.

An array of Warp may have any strides and be indexed from its end, which costs ten instructions an address on a GPU:
half of what a sum over scattered particles would do. Rows of the same length have the same index then, too, where a
loop over particles would keep an address for each of its arrays, more than it has registers for.

Sums over the threads that share a piece of work: a warp, or a part of one, on a GPU; one thread on a CPU.

A sum runs in an order that never changes, whatever the schedule and the number of environments. Threads that share a
sum follow each other in the last dimension of the launch, are a power of two and at most 32, and all come to it.
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
    """Wait for the other threads of the warp; all that have not ended come here."""
    ...


@wp.func_native(cuda_native("return threadIdx.x;", "return 0;"))
def thread_of_block() -> int:
    """Place of a thread in its CUDA block."""
    ...


@wp.func_native(cuda_native("return blockIdx.x;", "return 0;"))
def block_of_launch() -> int:
    """Place of a CUDA block among those of a launch."""
    ...


@wp.func_native(cuda_native("return blockDim.x;", "return 1;"))
def threads_of_block() -> int:
    """Threads of a CUDA block."""
    ...


@wp.func_native(cuda_native("__syncthreads();"))
def sync_block():
    """Wait for the other threads of the CUDA block."""
    ...


# the masks tell the compiler that neither is negative: array indices are not to be counted from the end
@wp.func_native("""
const unsigned all = (unsigned)thread, each = (unsigned)per_env;
unsigned e = 0u;
if (all >= each) e = all / each;
return wp::vec2i((int)(e & 0x7fffffffu), (int)((all - e * each) & 0x7fffffffu));
""")
def environment_of(thread: int, per_env: int) -> wp.vec2i:
    """Environment, and place among its threads, of a thread of a launch over ``num_envs * per_env``."""
    ...


#: Threads of a CUDA block in the drive's launches over particles and over sums.
BLOCK = 128
#: Particles of a thread, at most, in passes that wait for memory: it asks for what the next one has before it goes on
#: with one. On an H200 of 1, 3 and 6 the last was best.
ROUNDS = 6
#: Threads that would share the chunks of a bone, from which on each bone has a warp.
MANY_THREADS = 8
#: Threads that a multiprocessor can have.
RESIDENT = 2048


def warp_threads(device: str) -> int:
    """Threads that share a chunk of a bone's particles, or the bones of an environment: a warp on a GPU."""
    return 32 if wp.get_device(device).is_cuda else 1


def chunk_threads(device: str, chunks: int) -> int:
    """Threads of a warp that add up the ``chunks`` of a bone, about two each; 0 if each bone has a warp of its own.

    A warp that goes from bone to bone waits for memory every time.
    """
    threads = min(warp_threads(device), 1 << max(0, (chunks - 1) // 2).bit_length())
    return threads if threads < MANY_THREADS else 0


def particle_rounds(device: str, particles: int) -> int:
    """Particles of a thread where there are so many in all: as many as leave a GPU full, up to :data:`ROUNDS`."""
    gpu = wp.get_device(device)
    return min(ROUNDS, max(1, particles // (gpu.sm_count * RESIDENT))) if gpu.is_cuda else 1


def particle_threads(device: str, count: int, rounds: int) -> int:
    """Threads that share ``count`` particles of a body in so many ``rounds``: on a GPU in whole CUDA blocks.

    On a CPU it is one: there a thread costs 7 ns before it does anything, as much as what is done for a particle.
    """
    return -(-count // (BLOCK * rounds)) * BLOCK if wp.get_device(device).is_cuda else 1


# Warp finds a thread's place by divisions of 64 bits, which take a tenth of a short kernel's instructions.
@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
const unsigned blocks = ((unsigned)threads + {BLOCK - 1}u) / {BLOCK}u, row = blockIdx.x / blocks;
return wp::vec_t<2, wp::int32>((int)row, (int)((blockIdx.x - row * blocks) * {BLOCK}u + threadIdx.x));
#else
return wp::vec_t<2, wp::int32>(e, 0);
#endif
""")
def first_particle(e: int, threads: int) -> wp.vec2i:
    """Environment, on a CPU ``e``, and first particle of one of so many :func:`particle_threads`; there may be none."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
return (int)(gridDim.x / (unsigned)num_envs * {BLOCK}u);
#else
return 1;
#endif
""")
def threads_of_environment(num_envs: int) -> int:
    """:func:`particle_threads` in a launch over ``(num_envs, particle_threads)``, by what is launched."""
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
    """Environment, warp and lane in a launch over ``(num_envs, chunks, warp_threads)``, as Warp says, too."""
    ...


# As numbers that are known when a kernel is compiled: loops over a body's bones have one round then or are gone, as is
# all that a thread that is alone would do. That is a third of the instructions, and they must all be fetched.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
return wp::vec_t<3, wp::int32>((int)blockIdx.x, (int)threadIdx.x & (block - 1), block);
#else
return wp::vec_t<3, wp::int32>(e, 0, 1);
#endif
""")
def place_in_block(e: int, block: int) -> wp.vec3i:
    """Environment, thread and number of threads in a launch over ``(num_envs, block)``, a CUDA block each; or 0 of 1.

    On a CPU the launch is over ``(num_envs, 1)``, ``e`` as Warp says.
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
    """Which warp of its CUDA block a thread is in, and of how many; on a CPU of one."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return wp::vec_t<2, wp::int32>((int)(threadIdx.x & 31), 32);
#else
return wp::vec_t<2, wp::int32>(0, 1);
#endif
""")
def lane_of_warp() -> wp.vec2i:
    """Which thread of its warp a thread is, and of how many; on a CPU of one."""
    ...


# In every round a bone takes what its ancestor has found, who is twice as far as in the round before.
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
    """A snippet for what the lanes of a warp have, a bone each, in ``value``, gathered from the root to the own bone.

    Args:
        count: numbers of a value.
        each: what is done with number ``k`` of the ancestor ``up``, ``more``; below 0 there is none.
        then: what is done after all of them, with what ``each`` may have kept in ``before``, of the value's own kind.
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


# Each step halves the numbers that a thread goes on with, as well as the threads that go on with the same: 16 exchanges
# instead of 80, and each of the numbers ends up with two threads.
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
    """Sum over ``threads`` threads, told to all of them."""
    ...


@wp.func_native(_SUM_MANY % 6)
def sum_threads6(value: vec8, threads: int) -> vec8:
    """:func:`sum_threads` of six numbers."""
    ...


@wp.func_native(_SUM_MANY % 12)
def sum_threads12(value: vec12, threads: int) -> vec12:
    """:func:`sum_threads` of twelve numbers."""
    ...


@wp.func_native(_SUM_OF_WARP + _SUM_MANY % 16)
def sum_threads16(value: vec16, threads: int) -> vec16:
    """:func:`sum_threads` of sixteen numbers."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int distance = threads >> 1; distance > 0; distance >>= 1) bits |= __shfl_xor_sync(0xffffffffu, bits, distance);
#endif
return bits;
""")
def or_of_threads(bits: int, threads: int) -> int:
    """All bits that any thread of a warp has set, told to all of them."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int distance = threads >> 1; distance > 0; distance >>= 1) {
    const float other = __shfl_xor_sync(0xffffffffu, value, distance);
    const int whose = __shfl_xor_sync(0xffffffffu, which, distance);
    if (other > value || (other == value && whose < which)) value = other, which = whose;
}
#endif
return wp::vec_t<2, wp::float32>(value, (float)which);
""")
def max_of_threads(value: float, which: int, threads: int) -> wp.vec2:
    """The largest value of the threads of a warp, and ``which`` of theirs it is, the lower of two; told to all."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
if (threads > 1) __syncwarp();
#endif
""")
def sync_threads(threads: int):
    """What one thread of a warp has stored, the others see from here on."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 31 - __clz(bits);
#else
return 0;
#endif
""")
def highest_bit(bits: int) -> int:
    """The highest of ``bits``, of which there are any; on a CPU nobody asks."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return threadIdx.x & 31;
#else
return 0;
#endif
""")
def lane_of_thread() -> int:
    """Place of a thread in its warp; 0 on a CPU."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __any_sync(0xffffffffu, here);
#else
return here;
#endif
""")
def any_lane(here: bool) -> bool:
    """Whether it is so ``here`` in any thread of the warp; all of its threads must come here."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return (int)__ballot_sync(0xffffffffu, here);
#else
return here;
#endif
""")
def lanes_with(here: bool) -> int:
    """A bit for each thread of a warp, whether it is so ``here``; all of them come here. One bit on a CPU."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 32;
#else
return 1;
#endif
""")
def lanes_of_warp() -> int:
    """Threads of a warp; 1 on a CPU."""
    ...
