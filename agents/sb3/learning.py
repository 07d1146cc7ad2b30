"""Learning with stable-baselines3: begin or resume, log episodes, write checkpoints and policies.

What a training run with stable-baselines3 depends on, taken out of a model and put back.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from agents.checkpoint import Checkpoint, as_arrays, check_finite, random_states, set_random_states
from agents.files import write_atomically, write_config
from agents.report import Curve
from agents.sb3 import ppo, sac
from agents.sb3.config import TrainingConfig
from agents.sb3.parallel import WAITING, AgentVecEnv
from agents.sb3.ppo import MarkPlayed
from agents.sb3.workers import EnvFacts, components
from piavatar_envs.api.sb3 import SB3VecEnv
from piavatar_envs.config import ConfigError

#: Returns the end of a training run by ``time.monotonic()``, given the steps and the seconds [s] that it has had.
Deadline = Callable[[int, float], float]


class Events(TensorBoardOutputFormat):
    """TensorBoard's files of a run, also of one that was killed and resumed."""

    def __init__(self, folder: Path, steps: int) -> None:
        """Open the files of a folder.

        Args:
            folder: for the files; those of the run's earlier parts stay.
            steps: that the run has had; what it logged of later ones, before it was killed, is no longer shown.
        """
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=steps + 1 if steps else None)
        self._is_closed = False


class ScaledMonitor(VecMonitor):
    """Monitor that logs the environments' own rewards and returns scaled ones."""

    def __init__(self, venv: VecEnv, reward_scale: float) -> None:
        """Wrap environments."""
        super().__init__(venv)
        self.reward_scale = reward_scale

    def step_wait(self) -> VecEnvStepReturn:
        """Finish a step and scale its rewards."""
        observations, rewards, dones, infos = super().step_wait()
        return observations, self.reward_scale * rewards, dones, infos


class Progress(BaseCallback):
    """Callback that logs the episodes, shows a bar, and ends the training at its deadline."""

    def __init__(self, curve: Curve, total_steps: int, start: float, deadline: Deadline | None) -> None:
        """Configure the callback.

        Args:
            curve: where to book.
            total_steps: at which the bar is full.
            start: of the training by ``time.monotonic()``, earlier parts of a resumed one included.
            deadline: of the training, or None.
        """
        super().__init__()
        self.bar: tqdm | None = None
        self.curve, self.total_steps, self.start, self.deadline = curve, total_steps, start, deadline

    def _on_training_start(self) -> None:
        # a log needs a line now and then only
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
        return self.deadline is None or time.monotonic() < self.deadline(self.num_timesteps, self.curve.seconds)

    def _on_training_end(self) -> None:
        self.close()

    def close(self) -> None:
        """Close the bar, if there is one; closing twice is allowed."""
        if self.bar is not None:
            self.bar.close()


def begin(config: TrainingConfig, venv: VecEnv, facts: EnvFacts, checkpoint: Checkpoint | None = None) -> BaseAlgorithm:
    """Build an untrained agent of the configured algorithm.

    Args:
        config: resolved.
        venv: where to train: the workers, or the learning agents of their worlds.
        facts: of their environment.
        checkpoint: from which :func:`learn` will go on, or None.

    Raises:
        ConfigError: an unknown term to observe, or a checkpoint with more steps than are configured.
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
    deadline: Deadline | None = None,
    watchers: Sequence[BaseCallback] = (),
) -> Curve:
    """Train until the steps or the time are over.

    Leaves the configuration, policies, the curve and TensorBoard's files in ``folder``; no setting is refused any more.

    Args:
        config: resolved.
        model: from :func:`begin`, with the same checkpoint.
        folder: where to write; exists.
        checkpoint: from which to go on, and which to keep up; None for a training run that cannot be resumed.
        deadline: when to end before all steps, or None.
        watchers: what else to call at every step, before the checkpoint is written.

    Raises:
        Diverged: the networks are not finite any more.
        KeyboardInterrupt: Ctrl-C, after a checkpoint was written.
    """
    write_config(folder, config)
    curve = Curve()
    if checkpoint is not None and checkpoint.state is not None:
        restore(model, curve, checkpoint.state)
    start = time.monotonic() - curve.seconds
    model.set_logger(Logger(folder=None, output_formats=[Events(folder / "tensorboard", model.num_timesteps)]))
    snapshots = CheckpointCallback(max(1, config.checkpoint_every // model.n_envs), str(folder / "checkpoints"))
    snapshots.n_calls = model.num_timesteps // model.n_envs
    watch = [MarkPlayed()] if isinstance(model, PPO) else []
    progress = Progress(curve, config.total_steps, start, deadline)
    check = partial(_check_finite, config, model, checkpoint)
    watch += [snapshots, *watchers, progress]
    if checkpoint is not None:
        watch.append(KeepCheckpoint(checkpoint, config.checkpoint_every, curve, check))
    listening = nullcontext() if checkpoint is None else checkpoint.stop.listening()
    try:
        with listening:
            left = config.total_steps - model.num_timesteps
            model.learn(left, callback=CallbackList(watch), reset_num_timesteps=False)
    except ValueError:  # torch's message about broken networks does not name the cause
        check()
        raise
    finally:
        progress.close()
    check()
    curve.seconds, curve.train_steps = time.monotonic() - start, model.num_timesteps
    model.logger.close()
    write_atomically(folder / "policy.zip", model.save)
    curve.save(folder / "curve.csv")
    if checkpoint is not None:
        checkpoint.stop.obey(checkpoint.reached)
    return curve


def _check_finite(config: TrainingConfig, model: BaseAlgorithm, checkpoint: Checkpoint | None) -> None:
    """Raise an error if the networks have diverged.

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
    """Refuse a checkpoint with more steps than the configuration sets."""
    had = checkpoint.state["steps"]
    rollout = model.n_envs * (model.n_steps if isinstance(model, PPO) else model.train_freq.frequency)
    if had >= config.total_steps + rollout:
        raise ConfigError(
            f"{checkpoint.path} has had {had} steps, total_steps={config.total_steps}; ask for as many or more of them"
        )


_TRANSITIONS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def capture(model: BaseAlgorithm, curve: Curve) -> dict[str, Any]:
    """Return everything that the rest of a training run depends on, between two rollouts."""
    monitor = _monitor(model)
    modules, variables = model._get_torch_save_params()
    return {
        "steps": model.num_timesteps,
        "updates": model._n_updates,
        "episodes": model._episode_num,
        "modules": {name: attrgetter(name)(model).state_dict() for name in modules},
        "variables": {name: attrgetter(name)(model).detach().clone() for name in variables},
        "observation": model._last_obs,
        "starts": model._last_episode_starts,
        "replay": _replay(model),
        "envs": env_state(monitor.venv),
        "monitor": [monitor.episode_returns, monitor.episode_lengths, monitor.episode_count],
        "latest": [[float(e["r"]), int(e["l"]), float(e["t"])] for e in model.ep_info_buffer],
        "successes": [bool(success) for success in model.ep_success_buffer],
        "action_space": model.action_space.np_random.bit_generator.state,
        "random": random_states(),
        "curve": curve.state(),
    }


def restore(model: BaseAlgorithm, curve: Curve, state: dict[str, Any]) -> None:
    """Restore what :func:`capture` returned; call it after everything that draws random numbers.

    Args:
        model: built as the one that was captured; self-play's opponents have taken their seats.
        curve: empty.
        state: as a checkpoint gives it back.
    """
    monitor = _monitor(model)
    monitor.reset()  # what is in the environments' wrappers and in the workers stands at a first step
    set_env_state(monitor.venv, state["envs"])
    returns, lengths, monitor.episode_count = as_arrays(state["monitor"])
    monitor.episode_returns, monitor.episode_lengths = returns, lengths
    for name, saved in state["modules"].items():
        attrgetter(name)(model).load_state_dict(saved)
    with torch.no_grad():
        for name, saved in state["variables"].items():
            attrgetter(name)(model).copy_(saved)
    if state["replay"] is not None:
        _refill(model, as_arrays(state["replay"]))
    model.num_timesteps, model._n_updates, model._episode_num = state["steps"], state["updates"], state["episodes"]
    model._last_obs, model._last_episode_starts = as_arrays([state["observation"], state["starts"]])
    window = model._stats_window_size
    model.ep_info_buffer = deque(({"r": r, "l": n, "t": t} for r, n, t in state["latest"]), maxlen=window)
    model.ep_success_buffer = deque(state["successes"], maxlen=window)
    model.action_space.np_random.bit_generator.state = state["action_space"]
    curve.load(state["curve"])
    set_random_states(state["random"])


def _monitor(model: BaseAlgorithm) -> VecMonitor:
    env = model.get_env()
    if not isinstance(env, VecMonitor):
        raise TypeError(f"the model trains in a {type(env).__name__}; wrap its environments in a VecMonitor first")
    return env


def _replay(model: BaseAlgorithm) -> dict[str, Any] | None:
    """Return the filled part of the replay buffer, or nothing for an algorithm without one."""
    if not isinstance(model, OffPolicyAlgorithm):
        return None
    buffer = model.replay_buffer
    size = buffer.size()
    own = {name: getattr(buffer, name)[:size] for name in _TRANSITIONS}
    return own | {"position": buffer.pos, "full": buffer.full}


def _refill(model: OffPolicyAlgorithm, replay: dict[str, Any]) -> None:
    buffer = model.replay_buffer
    for name in _TRANSITIONS:
        getattr(buffer, name)[: len(replay[name])] = replay[name]
    buffer.pos, buffer.full = replay["position"], replay["full"]


def env_state(venv: VecEnv) -> Any:
    """Return the state of all environments: of a batch, of the workers, or of worlds and their seats."""
    if isinstance(venv, SB3VecEnv):
        return venv.vector.get_state()
    if isinstance(venv, AgentVecEnv):
        return {"folded": venv.get_state(), "worlds": env_state(venv.worlds)}
    return venv.env_method("get_state")


def set_env_state(venv: VecEnv, state: Any) -> None:
    """Restore what :func:`env_state` returned, as a checkpoint holds it.

    Raises:
        ValueError: the state is of other environments.
    """
    if isinstance(venv, SB3VecEnv):
        venv.vector.set_state(as_arrays(state))
    elif isinstance(venv, AgentVecEnv):
        set_env_state(venv.worlds, state["worlds"])
        venv.set_state(as_arrays(state["folded"]))
    else:
        for index, own in enumerate(as_arrays(state)):
            venv.env_method("set_state", own, indices=index)


class KeepCheckpoint(BaseCallback):
    """Callback that writes the checkpoint between rollouts, every so many steps, and at the end."""

    def __init__(self, checkpoint: Checkpoint, every: int, curve: Curve, check: Callable[[], None]) -> None:
        """Configure the callback.

        Args:
            checkpoint: where to write.
            every: steps between two of them, at least.
            curve: of the training.
            check: refuses to keep a model that is not worth it.
        """
        super().__init__()
        self.checkpoint, self.every, self.curve, self.check = checkpoint, every, curve, check
        self._in_rollout = False

    def _on_training_start(self) -> None:
        self._kept = self.model.num_timesteps

    def _on_rollout_start(self) -> None:
        stop = self.checkpoint.stop
        if self.model.num_timesteps - self._kept >= self.every or stop.made:
            self._keep()
        stop.obey(self.checkpoint.reached)
        self._in_rollout = True

    def _on_rollout_end(self) -> None:
        self._in_rollout = False

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        # a deadline ends a training within a rollout, and what was played of that is in no checkpoint
        if not self._in_rollout:
            self._keep()

    def _keep(self) -> None:
        self.check()
        self.checkpoint.save(capture(self.model, self.curve))
        self._kept = self.model.num_timesteps
