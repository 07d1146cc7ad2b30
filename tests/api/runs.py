"""Actions of seeded runs, and parts of the answers, for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

#: An episode of six steps: several fit into a test.
SHORT = {"episode_seconds": 0.2}


def actions_of(view, steps: int, seed: int = 0) -> np.ndarray:
    """Return random actions of a Gymnasium view, ``(steps, *action_space.shape)``."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, *view.action_space.shape)).astype(np.float32)


def bytes_of(state: Mapping[str, np.ndarray]) -> dict[str, bytes]:
    """Return a copy of a state that ``==`` compares bit for bit."""
    return {name: value.tobytes() for name, value in state.items()}


def arrays_in(answer) -> Iterator:
    """Yield every array or tensor in an answer of ``reset`` or ``step``, also those in mappings and object arrays."""
    if hasattr(answer, "items"):
        answer = tuple(answer.values())
    if isinstance(answer, (tuple, list)) or getattr(getattr(answer, "dtype", None), "kind", "") == "O":
        for value in answer:
            yield from arrays_in(value)
    elif hasattr(answer, "shape"):
        yield answer


def on_host(array) -> np.ndarray:
    """Return an array or a tensor as a NumPy array, without a copy on a CPU."""
    return np.asarray(array) if isinstance(array, (np.ndarray, np.generic)) else array.cpu().numpy()
