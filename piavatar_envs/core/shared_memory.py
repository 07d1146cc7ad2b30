"""Dynamic shared memory of a CUDA block, addressed in words of 4 bytes.

A kernel reserves the memory as a Warp tile; the functions here let every thread access it on its own, which Warp's
tile operations do not. They do nothing on a CPU.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.cuda_intrinsics import cuda_native

wp.set_module_options({"enable_backward": False})


def native(cuda: str, otherwise: str = "") -> str:
    """Return a CUDA snippet with the shared memory in scope as ``arena``, and ``otherwise`` for a CPU."""
    start = "extern __shared__ int piavatar_arena[];\nint* const arena = piavatar_arena;\n"
    return cuda_native(start + cuda, otherwise)


#: CUDA helper: rank of lane ``of`` among the lanes set in ``all``, after reserving places for them in a counter.
APPEND = """
auto append = [](int* count, unsigned all, int of) {
    int begin = 0;
    if ((threadIdx.x & 31) == 0 && all != 0u) begin = atomicAdd(count, __popc(all));
    return __shfl_sync(0xffffffffu, begin, 0) + __popc(all & ((1u << of) - 1u));
};
"""


@wp.func_native(native("return arena[at];", "return 0;"))
def word(at: int) -> int:
    """Return word ``at``."""
    ...


@wp.func_native(native("arena[at] = value;"))
def set_word(at: int, value: int):
    """Write word ``at``."""
    ...


@wp.func_native(native("atomicOr(arena + at, bits);"))
def or_word(at: int, bits: int):
    """Set bits of word ``at`` atomically."""
    ...


@wp.func_native(native("atomicAdd(arena + at, value);"))
def add_word(at: int, value: int):
    """Add to word ``at`` atomically."""
    ...


@wp.func_native(native("return (arena[bits + (n >> 5)] >> (n & 31)) & 1;", "return false;"))
def has_bit(bits: int, n: int) -> bool:
    """Return bit ``n`` of the bit field that begins at word ``bits``."""
    ...


@wp.func_native(native("return reinterpret_cast<const unsigned short*>(arena + at)[n];", "return 0;"))
def half_word(at: int, n: int) -> int:
    """Return half word ``n`` of the list that begins at word ``at``."""
    ...


@wp.func_native(native("reinterpret_cast<unsigned short*>(arena + at)[n] = (unsigned short)value;"))
def set_half_word(at: int, n: int, value: int):
    """Write half word ``n`` of the list that begins at word ``at``."""
    ...


@wp.func_native(native("return reinterpret_cast<const unsigned char*>(arena + at)[n];", "return 0;"))
def byte(at: int, n: int) -> int:
    """Return byte ``n`` of the list that begins at word ``at``."""
    ...


@wp.func_native(native("reinterpret_cast<unsigned char*>(arena + at)[n] = (unsigned char)value;"))
def set_byte(at: int, n: int, value: int):
    """Write byte ``n`` of the list that begins at word ``at``."""
    ...


@wp.func_native(native("if (value > __int_as_float(arena[at])) atomicMax(arena + at, __float_as_int(value));"))
def max_float_word(at: int, value: float):
    """Raise the number in word ``at`` to at least ``value``, which must not be negative."""
    ...


@wp.func_native(native("return __int_as_float(arena[at]);", "return 0.0f;"))
def float_word(at: int) -> float:
    """Return the number in word ``at``."""
    ...


@wp.func_native(native("arena[at] = __float_as_int(value);"))
def set_float_word(at: int, value: float):
    """Write a number to word ``at``."""
    ...


@wp.func_native(
    native("""
int4* const first = reinterpret_cast<int4*>(arena + start);
const int4 four = make_int4(value, value, value, value);
for (int n = threadIdx.x; n < words / 4; n += blockDim.x) first[n] = four;
""")
)
def fill_words(start: int, words: int, value: int):
    """Write ``value`` to ``words`` words from ``start`` on, both multiples of four; all threads share the work."""
    ...


@wp.func
def clear_words(start: int, words: int):
    """Zero ``words`` words from ``start`` on, both multiples of four; all threads share the work."""
    fill_words(start, words, 0)


@wp.func_native(
    native(
        APPEND
        + """
unsigned short* const list = reinterpret_cast<unsigned short*>(arena + at);
const int lane = threadIdx.x & 31, warps = blockDim.x >> 5;
for (int n = threadIdx.x >> 5; n < words; n += warps) {
    const unsigned some = (unsigned)arena[bits + n];
    const int place = append(arena + count, some, lane);
    if (some >> lane & 1u) list[place] = (unsigned short)(32 * n + lane);
}
"""
    )
)
def list_bits(bits: int, words: int, at: int, count: int):
    """Write the indices of the set bits in ``words`` words as half words from word ``at`` on, in any order.

    Their number is added to word ``count``. Every thread of the block must call this.
    """
    ...
