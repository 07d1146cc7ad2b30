"""What a training with stable-baselines3 depends on, taken out of a model and put back."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from operator import attrgetter
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from agents.checkpoint import Checkpoint, as_arrays, random_states, set_random_states
from agents.curve import Curve
from agents.parallel import AgentVecEnv
from piavatar_envs.api.sb3 import SB3VecEnv

_TRANSITIONS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def capture(model: BaseAlgorithm, curve: Curve) -> dict[str, Any]:
    """Everything that the future of a training depends on, between two rollouts."""
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
    """Go on where :func:`capture` was; the last of all that draws random numbers before the training.

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
    """The filled part of the replay buffer, where there is one."""
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
    """The state of all environments: of one batch, of the workers, or of worlds and who sits where in them."""
    if isinstance(venv, SB3VecEnv):
        return venv.vector.get_state()
    if isinstance(venv, AgentVecEnv):
        return {"folded": venv.get_state(), "worlds": env_state(venv.worlds)}
    return venv.env_method("get_state")


def set_env_state(venv: VecEnv, state: Any) -> None:
    """Put back what :func:`env_state` returned, as a checkpoint holds it.

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
    """Writes the checkpoint between rollouts, when its time has come, and at the end."""

    def __init__(self, checkpoint: Checkpoint, every: int, curve: Curve, check: Callable[[], None]) -> None:
        """Watch a training.

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
        if self.model.num_timesteps - self._kept >= self.every:
            self._keep()
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
