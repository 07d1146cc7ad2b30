"""Counter-based random numbers: a draw depends on (seed, episode, stream, index) and on nothing else.

Nothing depends on the batch, so environment ``i`` of a batch draws what a single environment of the same seed draws.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Streams keep the uses of randomness apart.
STREAM_POSE = wp.constant(0)
STREAM_TASK = wp.constant(1)
STREAM_DISTURBANCE = wp.constant(2)
STREAM_BALL = wp.constant(3)
STREAM_PARAMETERS = wp.constant(4)

#: Seeds of environments count from 0 and end before this, because kernels hold them in 32 bits.
NUM_SEEDS = 2**32


def check_seeds(first: int, count: int = 1, name: str = "seed") -> None:
    """Refuse seeds that environments cannot have.

    Args:
        first: of ``count`` seeds one after the other.
        count: how many.
        name: by which the first one was given.

    Raises:
        ValueError: one is outside [0, 2^32).
    """
    if not 0 <= first <= NUM_SEEDS - count:
        raise ValueError(f"{name}={first} must be >= 0 and <= {NUM_SEEDS - count}")


@wp.func
def generator(seed: int, episode: int, stream: int, index: int):
    """State of a random generator for ``wp.randf`` and ``wp.randn``.

    Each number is hashed in turn: packed into one offset of 32 bits, they would repeat after some thousand episodes.
    """
    of_episode = int(wp.rand_init(seed, episode))
    of_stream = int(wp.rand_init(of_episode, stream))
    return wp.rand_init(of_stream, index)
