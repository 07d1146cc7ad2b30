"""Rollouts in which not every slot plays every step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import RolloutBufferSamples

from agents.parallel import WAITING

_COLUMNS = ("observations", "actions", "values", "log_probs", "advantages", "returns")


class PlayedBuffer(RolloutBuffer):
    """Gives the loss only the steps that were played; :class:`MarkPlayed` says which.

    Where all were, the minibatches are those of its base, as long as their size divides the rollout; else they are
    of nearly equal sizes, without a last one of a few steps.
    """

    def reset(self) -> None:
        """Empty it."""
        super().reset()
        self.played = np.zeros((self.buffer_size, self.n_envs), bool)

    def get(self, batch_size: int | None = None) -> Iterator[RolloutBufferSamples]:
        """Minibatches of at most ``batch_size`` steps, in random order; all in one for None.

        Raises:
            RuntimeError: the buffer is not full, or nobody has marked what was played.
        """
        if not self.full or not self.played.any():
            raise RuntimeError(f"{self.pos} of {self.buffer_size} steps, {self.played.sum()} of them marked as played")
        if not self.generator_ready:
            for name in _COLUMNS:
                setattr(self, name, self.swap_and_flatten(getattr(self, name)))
            self.generator_ready = True
        rows = np.random.permutation(np.flatnonzero(self.swap_and_flatten(self.played)))
        for batch in np.array_split(rows, -(-len(rows) // (batch_size or len(rows)))):
            yield self._get_samples(batch)


class MarkPlayed(BaseCallback):
    """Tells a :class:`PlayedBuffer` which slots played the step that it is about to be given."""

    def _on_step(self) -> bool:
        buffer = self.model.rollout_buffer
        buffer.played[buffer.pos] = [WAITING not in info for info in self.locals["infos"]]
        return True
