"""Counter-based random numbers: a number depends on seed, episode, stream and index, and on nothing else.

Environment ``i`` of a batch therefore draws the same numbers as a single environment of the same seed.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

#: One stream for each use of random numbers, so that the uses are independent.
STREAM_POSE = wp.constant(0)
STREAM_TASK = wp.constant(1)
STREAM_DISTURBANCE = wp.constant(2)
STREAM_BALL = wp.constant(3)
STREAM_PARAMETERS = wp.constant(4)

#: Number of seeds: kernels hold a seed in 32 bits.
NUM_SEEDS = 2**32


def check_seeds(first: int, count: int = 1, name: str = "seed") -> None:
    """Refuse seeds outside of their range.

    Args:
        first: the first of ``count`` consecutive seeds.
        count: number of seeds.
        name: name of the first seed in the message.

    Raises:
        ValueError: a seed is outside [0, 2^32).
    """
    if not 0 <= first <= NUM_SEEDS - count:
        raise ValueError(f"{name}={first} must be >= 0 and <= {NUM_SEEDS - count}")


@wp.func
def generator(seed: int, episode: int, stream: int, index: int):
    """Return the state of a random generator for ``wp.randf`` and ``wp.randn``.

    The numbers are hashed one after the other, because packed into one offset of 32 bits they would repeat after some
    thousand episodes.
    """
    of_episode = int(wp.rand_init(seed, episode))
    of_stream = int(wp.rand_init(of_episode, stream))
    return wp.rand_init(of_stream, index)
