"""Moments of what two bones both move as records: how they move from joint to joint, and where an environment has them.

See :mod:`piavatar_envs.avatar.mass_matrix`.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import vec16

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def two_sided(m: float, first: wp.vec3, second: wp.mat33):
    """Moments of two joints as one record: ``sum m``, ``sum m a`` and, by rows, ``sum m b a^T``."""
    # fmt: off
    return vec16(
        m, first[0], first[1], first[2],
        second[0, 0], second[0, 1], second[0, 2],
        second[1, 0], second[1, 1], second[1, 2],
        second[2, 0], second[2, 1], second[2, 2],
        0.0, 0.0, 0.0,
    )
    # fmt: on


@wp.func
def second_moment(s: vec16):
    """``sum m b a^T`` of a record."""
    return wp.mat33(s[4], s[5], s[6], s[7], s[8], s[9], s[10], s[11], s[12])


@wp.func
def moved(s: vec16, alpha: wp.vec3, beta: wp.vec3):
    """The record with ``a + alpha`` and ``b + beta``: of a joint with itself, of any two where ``alpha`` is zero."""
    m = s[0]
    first = wp.vec3(s[1], s[2], s[3])
    both = second_moment(s) + wp.outer(first, alpha) + wp.outer(beta, first) + m * wp.outer(beta, alpha)
    return two_sided(m, first + m * alpha, both)


# Records of the pairs of bones lie in shared memory on a GPU, word by word, rows an odd number of words apart: threads
# read from different banks, whether theirs are the pairs of one bone or those of all with one.
_ROW, _WORDS = NUM_JOINTS + 1 - NUM_JOINTS % 2, 13
_WORD = _ROW * NUM_JOINTS
#: Where the joints' places are, behind all records.
PLACES = wp.constant(_WORDS * _WORD)


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
__shared__ float __align__(16) words[{_WORDS * _WORD + 3 * NUM_JOINTS}];
return reinterpret_cast<wp::uint64>(words + at);
#else
return reinterpret_cast<wp::uint64>(scratch.data);
#endif
""")
def room_of_records(scratch: wp.array(dtype=vec16), at: int) -> wp.uint64:
    """Where an environment's records are: from word ``at`` of a CUDA block's shared memory; on a CPU in ``scratch``."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
const float* const from = reinterpret_cast<const float*>(records) + {_ROW} * c + d;
wp::vec_t<16, wp::float32> value;
#pragma unroll
for (int k = 0; k < {_WORDS}; ++k) value[k] = from[{_WORD} * k];
return value;
#else
return reinterpret_cast<const wp::vec_t<16, wp::float32>*>(records)[{NUM_JOINTS} * c + d];
#endif
""")
def read_pair(records: wp.uint64, c: int, d: int) -> vec16:
    """The record of bones ``c`` and ``d``."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
float* const to = reinterpret_cast<float*>(records) + {_ROW} * c + d;
#pragma unroll
for (int k = 0; k < {_WORDS}; ++k) to[{_WORD} * k] = value[k];
#else
reinterpret_cast<wp::vec_t<16, wp::float32>*>(records)[{NUM_JOINTS} * c + d] = value;
#endif
""")
def write_pair(records: wp.uint64, c: int, d: int, value: vec16):
    """Write what :func:`read_pair` reads."""
    ...


@wp.func
def lift(s: vec16, step: wp.vec3, away: wp.vec3):
    """The record with ``a + step``; ``away`` is ``b - a``."""
    first = wp.vec3(s[1], s[2], s[3])
    return two_sided(s[0], first + s[0] * step, second_moment(s) + wp.outer(first + s[0] * away, step))


@wp.func
def transposed(s: vec16, away: wp.vec3):
    """The record with ``a`` and ``b`` exchanged; ``away`` is ``b - a``."""
    return two_sided(s[0], wp.vec3(s[1], s[2], s[3]) + s[0] * away, wp.transpose(second_moment(s)))
