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


@wp.func
def generator(seed: int, episode: int, stream: int, index: int):
    """State of a random generator for ``wp.randf`` and ``wp.randn``.

    Each number is hashed in turn: packed into one offset of 32 bits, they would repeat after some thousand episodes.
    """
    of_episode = int(wp.rand_init(seed, episode))
    of_stream = int(wp.rand_init(of_episode, stream))
    return wp.rand_init(of_stream, index)
