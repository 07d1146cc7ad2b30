"""TODO."""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.cuda_intrinsics import cuda_native

wp.set_module_options({"enable_backward": False})


def native(cuda: str, otherwise: str = "") -> str:
    """A snippet that finds the room as ``arena``; on a CPU, where nobody launches it, ``otherwise``."""
    start = "extern __shared__ int piavatar_arena[];\nint* const arena = piavatar_arena;\n"
    return cuda_native(start + cuda, otherwise)


#: In CUDA: the place of thread ``of`` among those of a warp in ``all``, which count on in a word, one after the other.
APPEND = """
auto append = [](int* count, unsigned all, int of) {
    int begin = 0;
    if ((threadIdx.x & 31) == 0 && all != 0u) begin = atomicAdd(count, __popc(all));
    return __shfl_sync(0xffffffffu, begin, 0) + __popc(all & ((1u << of) - 1u));
};
"""


@wp.func_native(native("return arena[at];", "return 0;"))
def word(at: int) -> int:
    """Word ``at``."""
    ...


@wp.func_native(native("arena[at] = value;"))
def set_word(at: int, value: int):
    """Write word ``at``."""
    ...


@wp.func_native(native("atomicOr(arena + at, bits);"))
def or_word(at: int, bits: int):
    """Set bits of word ``at``."""
    ...


@wp.func_native(native("atomicAdd(arena + at, value);"))
def add_word(at: int, value: int):
    """Add to word ``at``."""
    ...


@wp.func_native(native("return (arena[bits + (n >> 5)] >> (n & 31)) & 1;", "return false;"))
def has_bit(bits: int, n: int) -> bool:
    """Bit ``n`` of those that begin at a word."""
    ...


@wp.func_native(native("return reinterpret_cast<const unsigned short*>(arena + at)[n];", "return 0;"))
def half_word(at: int, n: int) -> int:
    """Half word ``n`` after word ``at``."""
    ...


@wp.func_native(native("reinterpret_cast<unsigned short*>(arena + at)[n] = (unsigned short)value;"))
def set_half_word(at: int, n: int, value: int):
    """Write half word ``n`` after word ``at``."""
    ...


@wp.func_native(native("return reinterpret_cast<const unsigned char*>(arena + at)[n];", "return 0;"))
def byte(at: int, n: int) -> int:
    """Byte ``n`` after word ``at``."""
    ...


@wp.func_native(native("reinterpret_cast<unsigned char*>(arena + at)[n] = (unsigned char)value;"))
def set_byte(at: int, n: int, value: int):
    """Write byte ``n`` after word ``at``."""
    ...


@wp.func_native(native("if (value > __int_as_float(arena[at])) atomicMax(arena + at, __float_as_int(value));"))
def max_float_word(at: int, value: float):
    """Make the number in word ``at`` at least ``value``, which is not negative."""
    ...


@wp.func_native(native("return __int_as_float(arena[at]);", "return 0.0f;"))
def float_word(at: int) -> float:
    """The number in word ``at``."""
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
    """Write ``value`` to ``words`` words, a multiple of four; ``start`` is one, too."""
    ...


@wp.func
def clear_words(start: int, words: int):
    """Zero ``words`` words, a multiple of four; ``start`` is one, too."""
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
    """Write which bits of ``words`` words are set to half words from word ``at`` on, in any order.

    How many is added to word ``count``. All threads come here.
    """
    ...
