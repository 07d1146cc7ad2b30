"""What every training with stable-baselines3 does: begin or go on, watch, book the episodes, leave policies."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from agents import ppo, resume, sac
from agents.checkpoint import Checkpoint
from agents.config import TrainingConfig
from agents.curve import Curve
from agents.divergence import check_finite
from agents.folders import write_config, write_whole
from agents.parallel import WAITING
from agents.rollouts import MarkPlayed
from agents.workers import EnvFacts, components
from piavatar_envs.config import ConfigError


class Events(TensorBoardOutputFormat):
    """TensorBoard's files of a run, also of one that was killed and goes on."""

    def __init__(self, folder: Path, steps: int) -> None:
        """Write to a folder.

        Args:
            folder: for the files; those of the run's earlier parts stay.
            steps: that the run has had; what it logged of later ones, before it was killed, is no longer shown.
        """
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=steps + 1 if steps else None)
        self._is_closed = False


class ScaledMonitor(VecMonitor):
    """Books the environments' own rewards, and hands on scaled ones."""

    def __init__(self, venv: VecEnv, reward_scale: float) -> None:
        """Watch environments."""
        super().__init__(venv)
        self.reward_scale = reward_scale

    def step_wait(self) -> VecEnvStepReturn:
        """The end of a step."""
        observations, rewards, dones, infos = super().step_wait()
        return observations, self.reward_scale * rewards, dones, infos


class Progress(BaseCallback):
    """Books the episodes, shows a bar, and ends the training when its time is over."""

    def __init__(self, curve: Curve, total_steps: int, start: float, deadline: float | None) -> None:
        """Watch a training.

        Args:
            curve: where to book.
            total_steps: at which the bar is full.
            start: of the training by ``time.monotonic()``, earlier parts of a resumed one included.
            deadline: by ``time.monotonic()``, or None.
        """
        super().__init__()
        self.bar: tqdm | None = None
        self.curve, self.total_steps, self.start, self.deadline = curve, total_steps, start, deadline

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
        self.curve.seconds = time.monotonic() - self.start
        return self.deadline is None or time.monotonic() < self.deadline

    def _on_training_end(self) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the bar's line, if there is one; closing twice is fine."""
        if self.bar is not None:
            self.bar.close()


def begin(config: TrainingConfig, venv: VecEnv, facts: EnvFacts, checkpoint: Checkpoint | None = None) -> BaseAlgorithm:
    """An untrained agent, of the algorithm that the configuration names.

    Args:
        config: resolved.
        venv: where to train: the workers, or the learning agents of their worlds.
        facts: of their environment.
        checkpoint: from which :func:`learn` will go on, or None.

    Raises:
        ConfigError: there is no such term to observe, or the checkpoint has had more steps than are asked for.
    """
    seen = components(facts.layout, config.observe)
    build, settings = (ppo.build, config.ppo) if config.sac is None else (sac.build, config.sac)
    model = build(settings, ScaledMonitor(venv, settings.reward_scale), seen, config.seed)
    if checkpoint is not None and checkpoint.state is not None:
        _check_steps(config, model, checkpoint)
    return model


def learn(
    config: TrainingConfig,
    model: BaseAlgorithm,
    folder: Path,
    checkpoint: Checkpoint | None = None,
    deadline: float | None = None,
    watchers: Sequence[BaseCallback] = (),
) -> Curve:
    """Train until the steps or the time are over.

    Leaves the configuration, policies, the curve and TensorBoard's files in ``folder``; no setting is refused any more.

    Args:
        config: resolved.
        model: from :func:`begin`, with the same checkpoint.
        folder: where to write; exists.
        checkpoint: from which to go on, and which to keep up; None for a training that cannot be resumed.
        deadline: by ``time.monotonic()``, or None.
        watchers: what else to call at every step, before the checkpoint is written.

    Raises:
        Diverged: the networks are not finite any more.
    """
    write_config(folder, config)
    curve = Curve()
    if checkpoint is not None and checkpoint.state is not None:
        resume.restore(model, curve, checkpoint.state)
    start = time.monotonic() - curve.seconds
    model.set_logger(Logger(folder=None, output_formats=[Events(folder / "tensorboard", model.num_timesteps)]))
    snapshots = CheckpointCallback(max(1, config.checkpoint_every // model.n_envs), str(folder / "checkpoints"))
    snapshots.n_calls = model.num_timesteps // model.n_envs
    watch = [MarkPlayed()] if isinstance(model, PPO) else []
    progress = Progress(curve, config.total_steps, start, deadline)
    check = partial(_check_finite, config, model, checkpoint)
    watch += [snapshots, *watchers, progress]
    if checkpoint is not None:
        watch.append(resume.KeepCheckpoint(checkpoint, config.checkpoint_every, curve, check))
    try:
        model.learn(config.total_steps - model.num_timesteps, callback=CallbackList(watch), reset_num_timesteps=False)
    except ValueError:  # what torch says of broken networks says nothing to whoever trains
        check()
        raise
    finally:
        progress.close()
    check()
    curve.seconds, curve.train_steps = time.monotonic() - start, model.num_timesteps
    model.logger.close()
    write_whole(folder / "policy.zip", model.save)
    curve.save(folder / "curve.csv")
    return curve


def _check_finite(config: TrainingConfig, model: BaseAlgorithm, checkpoint: Checkpoint | None) -> None:
    """Refuse to go on with networks that have diverged, or to keep them.

    Raises:
        Diverged: they have.
    """
    if model._last_obs is None:  # nothing has been observed, or learned
        return
    try:
        actions, _ = model.predict(model._last_obs, deterministic=True)
    except ValueError:  # torch's distributions refuse them
        actions = np.nan
    name, settings = ("ppo", config.ppo) if config.sac is None else ("sac", config.sac)
    rate = f"{name}.learning_rate", settings.learning_rate
    path = None if checkpoint is None else checkpoint.path
    check_finite(
        {"policy": model.policy},
        {"the distribution of actions": torch.as_tensor(actions)},
        model.num_timesteps,
        rate,
        path,
    )


def _check_steps(config: TrainingConfig, model: BaseAlgorithm, checkpoint: Checkpoint) -> None:
    """Refuse to take back what was trained too much."""
    had = checkpoint.state["steps"]
    rollout = model.n_envs * (model.n_steps if isinstance(model, PPO) else model.train_freq.frequency)
    if had >= config.total_steps + rollout:
        raise ConfigError(
            f"{checkpoint.path} has had {had} steps, total_steps={config.total_steps}; ask for as many or more of them"
        )
