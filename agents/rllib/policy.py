"""Policies of RLlib's PPO: the settings of their training runs, their networks, and agents out of files.

Nothing here needs RLlib: its default module is a plain network, and ``policy.pt`` holds its parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, Field, model_validator

from agents.batch_training import BatchTraining, load_batched
from agents.checkpoint import load_weights, policy_mismatch, read_checkpoint
from agents.config import (
    MOST_ENVS,
    ClipRange,
    Discount,
    EntropyWeight,
    GaeLambda,
    LogStd,
    ValueWeight,
    Widths,
    multi_game,
)
from agents.evaluate import Agent
from agents.files import CHECKPOINT
from agents.sb3.workers import components
from piavatar_envs.config import FROZEN, ConfigError
from piavatar_envs.core.reading import UNREADABLE
from piavatar_envs.envs.observations import ObservationLayout
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task

#: RLlib's name of the policy where there is one avatar.
SINGLE = "default_policy"


class RLlibPPOSettings(BaseModel):
    """Hyper-parameters of RLlib's PPO."""

    model_config = FROZEN

    rollout_steps: int = Field(32, ge=2, description="steps of every environment between two updates")
    epochs: int = Field(8, ge=1, description="passes over a rollout")
    minibatches: int = Field(4, ge=1, description="minibatches in a pass")
    learning_rate: float = Field(7.0e-4, gt=0.0, description="Adam's learning rate [-]")
    discount: Discount = 0.9
    gae_lambda: GaeLambda = 0.8
    clip_range: ClipRange = 0.2
    value_weight: ValueWeight = 1.0
    entropy_weight: EntropyWeight = 0.0
    largest_gradient: float = Field(1.0, gt=0.0, description="norm to which gradients are clipped [-]")
    log_std: LogStd = -0.5
    hidden: Widths = Field((128, 128), min_length=1, description="widths of the hidden layers of both networks")


class RLlibTraining(BatchTraining):
    """Settings of a training run with RLlib."""

    env_id: str = Field("PIAvatar/Reach-v0", description="registered id, or a module of piavatar_envs.multi")
    num_envs: int = Field(16, ge=1, le=MOST_ENVS, description="environments of every env runner")
    env_runners: int = Field(
        0, ge=0, le=1024, description="processes that play, each with a CPU; 0 to play in the training's own"
    )
    policies: Literal["shared", "independent"] = Field(
        "shared", description="whether agents of a game share a policy or learn one each"
    )
    ppo: RLlibPPOSettings = Field(default_factory=RLlibPPOSettings, description="the algorithm")

    @model_validator(mode="after")
    def _check_seeds(self) -> RLlibTraining:
        """Refuse more environments than a training run has seeds."""
        if self.total_envs > MOST_ENVS:
            raise ConfigError(
                f"env_runners={self.env_runners} with num_envs={self.num_envs} are {self.total_envs} environments, at "
                f"most {MOST_ENVS} are possible; use fewer"
            )
        return self

    @property
    def total_envs(self) -> int:
        """Return the number of environments of all env runners."""
        return self.num_envs * max(self.env_runners, 1)


def find_task(env_id: str) -> type[Task]:
    """Return the task of an id or of a game.

    Raises:
        ValueError: there is no such task.
    """
    return load_task(env_id) if "/" in env_id else multi_game(env_id).TASK


def load_rllib(source: Mapping[str, Any] | str | Path | None = None) -> RLlibTraining:
    """Load a configuration; the argument and errors are those of :func:`agents.batch_training.load_batched`."""
    return load_batched(RLlibTraining, find_task, source)


def actors(weights: Mapping[str, Mapping[str, Any]]) -> dict[str, torch.nn.Sequential]:
    """Build the networks of mean actions from the parameters of RLlib's default module, by policy."""
    built = {}
    for name, own in weights.items():
        tensors = {key: torch.as_tensor(np.array(value)) for key, value in own.items()}
        hidden = [key for key in tensors if key.startswith("encoder.actor_encoder.") and key.endswith(".weight")]
        keys = [*sorted(hidden, key=lambda key: int(key.split(".")[-2])), "pi.net.mlp.0.weight"]
        built[name] = _network([tensors[keys[0]].shape[1], *(len(tensors[key]) for key in keys)])
        layers = built[name][::2]
        for layer, key in zip(layers, keys, strict=True):
            layer.load_state_dict({"weight": tensors[key], "bias": tensors[key.removesuffix("weight") + "bias"]})
    return built


def _network(sizes: Sequence[int]) -> torch.nn.Sequential:
    """Build a network of layers of ``sizes``, from its input to its output, with tanh between them."""
    layers = [(torch.nn.Linear(inputs, outputs), torch.nn.Tanh()) for inputs, outputs in pairwise(sizes)]
    return torch.nn.Sequential(*[part for pair in layers for part in pair][:-1])


def load_agent(path: Path, config: RLlibTraining, layout: ObservationLayout, action_size: int) -> Agent:
    """Load the agent of an earlier training of one avatar, on the CPU.

    Args:
        path: of its ``policy.pt``, or of the checkpoint of one that was interrupted; nothing in it is unpickled.
        config: resolved.
        layout: of the observation.
        action_size: length of an action.

    Raises:
        ConfigError: the file holds no policy of that configuration.
    """
    seen = components(layout, config.observe)
    network = _network([len(seen), *config.ppo.hidden, action_size])
    try:
        interrupted = path.name == CHECKPOINT
        network.load_state_dict(
            actors(read_checkpoint(path)["state"]["learner"]["rl_module"])[SINGLE].state_dict()
            if interrupted
            else load_weights(path, "cpu")[SINGLE]
        )
    except UNREADABLE as error:
        raise policy_mismatch(path, len(seen), action_size, error) from None
    return mean_agent({SINGLE: network}, [SINGLE], seen)


def mean_agent(networks: Mapping[str, torch.nn.Module], names: Sequence[str], seen: list[int]) -> Agent:
    """Return an agent of all mean actions, from observations ``(n, agents, size)`` to ``(n, agents, action_size)``.

    Args:
        networks: by policy.
        names: of the agents.
        seen: components of the flat observation that the networks see.
    """
    own = [networks[name] if name in networks else next(iter(networks.values())) for name in names]

    def act(observation: np.ndarray) -> np.ndarray:
        shown = torch.as_tensor(observation[..., seen])
        with torch.no_grad():
            means = [network(shown[:, index]) for index, network in enumerate(own)]
        return torch.stack(means, dim=1).clamp(-1.0, 1.0).numpy()  # RLlib clips what its policies do

    return act
