"""Reads and writes of arrays whose rows are dense, as all of this package's are: their address is one multiplication.

An array of Warp may have any strides and be indexed from its end, which costs ten instructions an address on a GPU:
half of what a sum over scattered particles would do. Rows of the same length have the same index then, too, where a
loop over particles would keep an address for each of its arrays, more than it has registers for.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

_ROW = "rows.data[rows.shape[1] * e + p]"


@wp.func_native("return values.data[n];")
def int_at(values: wp.array(dtype=int), n: int) -> int:
    """``values[n]``."""
    ...


@wp.func_native("return values.data[n];")
def float_at(values: wp.array(dtype=float), n: int) -> float:
    """``values[n]``."""
    ...


@wp.func_native(f"return {_ROW};")
def number_at(rows: wp.array2d(dtype=float), e: int, p: int) -> float:
    """``rows[e, p]``."""
    ...


@wp.func_native(f"return {_ROW};")
def vector_at(rows: wp.array2d(dtype=wp.vec3), e: int, p: int) -> wp.vec3:
    """``rows[e, p]``."""
    ...


@wp.func_native(f"wp::vec3 value;\nif (p >= first) value = {_ROW};\nreturn value;")
def vector_from(rows: wp.array2d(dtype=wp.vec3), first: int, e: int, p: int) -> wp.vec3:
    """``rows[e, p]``, or zero before ``first``: a branch of Warp's own would wait for what is asked for."""
    ...


@wp.func_native(f"{_ROW} = value;")
def set_vector(rows: wp.array2d(dtype=wp.vec3), e: int, p: int, value: wp.vec3):
    """``rows[e, p] = value``."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const char* const line = reinterpret_cast<const char*>(&rows.data[rows.shape[1] * e + p]) + 128 * thread;
if (128 * thread < (int)sizeof(*rows.data) * count) asm volatile("prefetch.global.L2 [%0];" :: "l"(line));
#endif
""")
def ask_ahead(rows: wp.array2d(dtype=wp.vec3), e: int, p: int, count: int, thread: int):
    """Let a GPU fetch ``rows[e, p : p + count]`` into its second-level cache: each thread a line of it."""
    ...
