"""Whether a task keeps what every environment of the suite promises; for tasks of one's own, see docs/tasks.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from piavatar_envs.api.batched import BatchedEpisodes
from piavatar_envs.api.episode import Settings
from piavatar_envs.api.promises import PROMISES
from piavatar_envs.api.trial import NUM_ENVS, Trial
from piavatar_envs.envs.config import load_config
from piavatar_envs.envs.finite import FiniteWatch
from piavatar_envs.tasks import load_task
from piavatar_envs.tasks.base import Task


class TaskError(ValueError):
    """A task that does not keep what it should.

    Attributes:
        problems: what is wrong, a sentence each.
    """

    def __init__(self, task: str, problems: Sequence[str]) -> None:
        super().__init__("\n- ".join([f"{task} does not keep what environments promise:", *problems]))
        self.problems = tuple(problems)


def check_task(
    task: str | type[Task],
    steps: int = 30,
    device: str = "cpu",
    config: Settings = None,
    reward_range: tuple[float, float] | None = None,
    constant: Sequence[str] = (),
    fidelity: str = "tiny",
    seed: int = 0,
    **overrides: Any,
) -> None:
    """See whether a task keeps what all environments promise, under random actions.

    That the same seed and actions give the same run; that environment ``i`` of a batch is the single environment of
    seed + ``i``; that what the task observes is in its space and changes, and all its numbers are finite and have
    names; that returned arrays are the caller's own; that bad actions are refused; that a masked reset and an
    observation leave everything else alone; and that a restored state goes on as it did.

    Args:
        task: its id, its class, or ``"module:id"``; of one agent or several.
        steps: control steps of a run.
        device: Warp device, ``"cpu"`` or ``"cuda:0"``.
        config: settings as a mapping, a YAML file or a configuration.
        reward_range: lower and upper bound of the reward, of every agent; not looked at if not given.
        constant: names of the task's observation terms that may stay as they are.
        fidelity: of the bodies; wins over ``config``.
        seed: of the first environment.
        **overrides: settings that win over ``config``.

    Raises:
        TaskError: the task does not; says all that is wrong.
        ValueError: fewer than two steps, an unknown term or a range that falls, or what building environments refuses.
    """
    if steps < 2:
        raise ValueError(f"steps={steps} must be >= 2")
    if reward_range is not None and not reward_range[0] <= reward_range[1]:
        raise ValueError(f"reward_range={list(reward_range)} falls; give the lower bound first")
    task_class = load_task(task)
    settings = load_config(task_class.Config, config, {**overrides, "physics.fidelity": fidelity})
    watched = task_class(settings)
    terms = [term.name for term in watched.terms()]
    for name in constant:
        if name not in terms:
            raise ValueError(f"constant={name!r} is no term that the task observes; there are {', '.join(terms)}")
    watch = FiniteWatch(watched)
    many = BatchedEpisodes(watched, NUM_ENVS, device, num_threads=1)
    one = BatchedEpisodes(task_class(settings), 1, device)
    shape = steps, NUM_ENVS, many.num_agents, many.action_size
    drawn = np.random.default_rng(seed).uniform(-1.0, 1.0, shape).astype(np.float32)
    trial = Trial(many, one, watch, drawn, seed, reward_range, constant)
    try:
        problems = [problem for check in PROMISES for problem in check(trial)]
    finally:
        many.close()
        one.close()
    if problems:
        raise TaskError(task if isinstance(task, str) else task.__name__, problems)
