"""Worlds with garments: a ball for them, and steps of random actions."""

from __future__ import annotations

import numpy as np

#: A light ball in front of the pelvis.
BALL = {"name": "ball", "shape": "sphere", "size": [0.12], "mass": 0.5, "position": [0.0, -0.75, 0.75]}


def moved(batch, steps: int, seed: int = 5, envs=None, of: int = 3) -> dict[str, np.ndarray]:
    """Step with random actions, those of ``envs`` in a batch ``of`` so many, and return the state."""
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        actions = rng.uniform(-1.0, 1.0, (of, *batch.action.shape[1:])).astype(np.float32)
        batch.action.assign(actions[envs] if envs is not None else actions)
        batch.step()
    return batch.get_state()
