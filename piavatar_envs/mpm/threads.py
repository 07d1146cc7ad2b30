"""Which environment a thread of a launch takes part in.

``wp.tid()`` of two dimensions divides 64-bit numbers, which costs a thread some sixty instructions, one after the
other; 32 bits are enough, and a single environment needs no division.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


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
