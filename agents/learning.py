"""What every training does: begin or go on, watch, book the episodes, leave checkpoints and the policy."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from tqdm import tqdm

from agents import ppo
from agents.config import TrainingConfig
from agents.parallel import WAITING
from agents.rollouts import MarkPlayed
from agents.workers import EnvFacts, components


@dataclass
class Curve:
    """Returns of the training episodes, as they ended.

    Attributes:
        steps: control steps taken by then, over all workers and their learning agents.
        returns: undiscounted returns, of actions that were drawn at random from the policy.
        seconds: time that the training took [s].
    """

    steps: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    seconds: float = 0.0

    def save(self, path: Path) -> None:
        """Write it as CSV."""
        rows = [f"{step},{value:.6g}" for step, value in zip(self.steps, self.returns, strict=True)]
        path.write_text("\n".join(["step,return", *rows]) + "\n", encoding="utf-8")


class Progress(BaseCallback):
    """Books the episodes, shows a bar, and ends the training when its time is over."""

    def __init__(self, curve: Curve, total_steps: int, deadline: float | None) -> None:
        """Watch a training.

        Args:
            curve: where to book.
            total_steps: at which the bar is full.
            deadline: by ``time.monotonic()``, or None.
        """
        super().__init__()
        self.curve, self.total_steps, self.deadline = curve, total_steps, deadline

    def _on_training_start(self) -> None:
        # where nobody watches, a line now and then will do
        interval = 0.5 if sys.stderr.isatty() else 30.0
        self.bar = tqdm(
            total=self.total_steps, initial=self.num_timesteps, desc="train", unit="step", mininterval=interval
        )

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info and WAITING not in info:
                self.curve.steps.append(self.num_timesteps)
                self.curve.returns.append(float(info["episode"]["r"]))
                self.bar.set_postfix({"return": f"{np.mean(self.curve.returns[-20:]):.1f}"}, refresh=False)
        self.bar.update(self.num_timesteps - self.bar.n)
        return self.deadline is None or time.monotonic() < self.deadline

    def _on_training_end(self) -> None:
        self.bar.close()


def begin(config: TrainingConfig, venv: VecEnv, facts: EnvFacts, resume: Path | None = None) -> PPO:
    """An agent that has steps to learn from before it.

    Args:
        config: resolved.
        venv: where to train: the workers, or the learning agents of their worlds.
        facts: of their environment.
        resume: a checkpoint to go on from, or None.

    Raises:
        ValueError: the checkpoint has had all its steps already.
        FileNotFoundError: there is no such checkpoint.
    """
    monitored = VecMonitor(venv)
    if resume is not None:
        model = ppo.resume(resume, monitored, config.seed)
    else:
        model = ppo.build(config.ppo, monitored, components(facts.layout, config.observe), config.seed)
    if model.num_timesteps >= config.total_steps:
        raise ValueError(
            f"{resume} has had {model.num_timesteps} steps, total_steps={config.total_steps}; ask for more of them"
        )
    return model


def learn(
    config: TrainingConfig,
    model: PPO,
    folder: Path,
    deadline: float | None = None,
    watchers: Sequence[BaseCallback] = (),
) -> Curve:
    """Train until the steps or the time are over; leaves checkpoints, curve and policy in ``folder``.

    Args:
        config: resolved.
        model: from :func:`begin`.
        folder: where to write; exists.
        deadline: by ``time.monotonic()``, or None.
        watchers: what else to call at every step.
    """
    curve, start = Curve(), time.monotonic()
    checkpoints = CheckpointCallback(max(1, config.checkpoint_every // model.n_envs), str(folder / "checkpoints"))
    watch = CallbackList([MarkPlayed(), checkpoints, *watchers, Progress(curve, config.total_steps, deadline)])
    model.learn(config.total_steps - model.num_timesteps, callback=watch, reset_num_timesteps=False)
    curve.seconds = time.monotonic() - start
    model.save(folder / "policy.zip")
    curve.save(folder / "curve.csv")
    return curve
