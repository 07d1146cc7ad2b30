"""Runs of a task that is looked at: in a batch, and in the single environments that the batch must equal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from piavatar_envs.api.batched import BatchedEpisodes
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.finite import FiniteWatch

#: Environments of the batch; each is compared with a single one.
NUM_ENVS = 3
#: What is compared of a run, arrays of the batch.
TOLD = (
    "observation", "reward", "cost", "terms", "cost_terms", "metrics", "success", "terminated", "truncated", "failure"
)  # fmt: skip

#: A run: arrays ``(steps, num_envs, ...)`` by name, and under ``"start"`` what was seen before the first step.
Run = dict[str, np.ndarray]


@dataclass(frozen=True)
class Trial:
    """What is looked at.

    Attributes:
        many: a batch of :data:`NUM_ENVS`.
        one: a single environment of the same settings.
        watch: what ``many`` wrote that was not finite.
        actions: random ones, ``(steps, num_envs, num_agents, action_size)``.
        seed: of the first environment.
        reward_range: that every reward must be in, or None.
        constant: terms of the observation that may stay as they are.
    """

    many: BatchedEpisodes
    one: BatchedEpisodes
    watch: FiniteWatch
    actions: np.ndarray
    seed: int
    reward_range: tuple[float, float] | None
    constant: Sequence[str]

    @cached_property
    def run(self) -> Run:
        """All actions in the batch, the first time."""
        return self.play()

    def play(self) -> Run:
        """All actions in the batch."""
        return play(self.many, self.actions, self.seed)

    def difference(self, now: Run, then: Run, env: int | None = None) -> str | None:
        """The first of what differs between two runs of the batch, or of its environment ``env`` and a single one."""
        for name, value in now.items():
            a, b = (value if env is None else value[:, env : env + 1]), then[name]
            unlike = (a != b) & ~(np.isnan(a) & np.isnan(b)) if a.dtype.kind == "f" else a != b
            if unlike.any():
                at = tuple(int(i) for i in np.argwhere(unlike)[0])
                return f"{self._place(name, at, env)} is {a[at]}, not {b[at]}"
        return None

    def _place(self, name: str, at: tuple[int, ...], env: int | None) -> str:
        """What an element of a run is called."""
        task, what = self.many.task, name
        names = {"terms": task.reward_terms, "cost_terms": task.cost_terms, "metrics": task.metrics}.get(name, ())
        if name in ("start", "observation"):
            what = f"observation {component(self.many, at[3])}"
        elif names:  # without there is a column that means nothing
            what = f"{name} {names[at[3]]!r}"
        when = "before the first step" if name == "start" else f"in step {at[0] + 1}"
        agent = f" of {task.agent_names[at[2]]}" if len(at) > 2 and self.many.num_agents > 1 else ""
        return f"{when} {what}{agent} in environment {at[1] if env is None else env}"


def component(episodes: BatchedEpisodes, index: int) -> str:
    """Name of a component of the flat observation: its term, and where it is in it."""
    for name, term in episodes.layout.items():
        if term.slice.start <= index < term.slice.stop:
            return f"{name}[{index - term.slice.start}]"
    raise IndexError(f"the observation has no component {index}; it has {episodes.layout.size}")


def play(episodes: BatchedEpisodes, actions: np.ndarray, seed: int) -> Run:
    """Begin with ``seed``, act, and go on with the next episode wherever one ends."""
    episodes.reset(seed)
    start = episodes.observation()[None]
    return {"start": start, **go_on(episodes, actions)}


def go_on(episodes: BatchedEpisodes, actions: np.ndarray) -> Run:
    """Act from where the environments are."""
    rows = []
    for action in actions:
        episodes.step(action)
        rows.append({name: episodes.read(array_of(name)) for name in TOLD})
        if episodes.find_ended().any():
            episodes.reset_ended()
    return {name: np.stack([row[name] for row in rows]) for name in TOLD}


def array_of(name: str) -> Callable[[BatchEnv], Any]:
    """Says which array of a batch is called ``name``."""
    return lambda batch: getattr(batch, name)
