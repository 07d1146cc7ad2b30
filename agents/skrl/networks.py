"""Networks and memory of a training run with skrl: policies of what an agent sees, critics of what all see."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import gymnasium as gym
import torch
from pydantic import BaseModel, Field
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model

from agents.config import ClipRange, Discount, EntropyWeight, GaeLambda, LogStd, ValueWeight, Widths
from agents.ranks import ALONE, Ranks
from piavatar_envs.config import FROZEN


class MAPPOSettings(BaseModel):
    """Hyper-parameters of MAPPO."""

    model_config = FROZEN

    rollout_steps: int = Field(32, ge=2, description="steps of every world between two updates")
    epochs: int = Field(8, ge=1, description="passes over a rollout")
    minibatches: int = Field(4, ge=1, description="minibatches in a pass")
    learning_rate: float = Field(5.0e-4, gt=0.0, description="Adam's learning rate [-]")
    discount: Discount = 0.95
    gae_lambda: GaeLambda = 0.9
    clip_range: ClipRange = 0.2
    value_weight: ValueWeight = 0.5
    entropy_weight: EntropyWeight = 0.0
    largest_gradient: float = Field(0.5, ge=0.0, description="norm to which gradients are clipped [-]; 0 for never")
    log_std: LogStd = -0.7
    hidden: Widths = Field((128, 128), description="widths of the hidden layers of both networks")


def layers(seen: int, hidden: Sequence[int], out: int) -> torch.nn.Sequential:
    """Build a network with tanh between its layers, whose first outputs are near zero."""
    widths = [seen, *hidden]
    inner = [module for size, width in pairwise(widths) for module in (torch.nn.Linear(size, width), torch.nn.Tanh())]
    last = torch.nn.Linear(widths[-1], out)
    torch.nn.init.orthogonal_(last.weight, 0.01)
    torch.nn.init.zeros_(last.bias)
    return torch.nn.Sequential(*inner, last)


class Policy(GaussianMixin, Model):
    """Policy with normally distributed actions from some components of the agent's observation."""

    def __init__(
        self, observation: gym.Space, action: gym.Space, seen: Sequence[int], settings: MAPPOSettings, device: Any
    ) -> None:
        Model.__init__(self, observation_space=observation, action_space=action, device=device)
        GaussianMixin.__init__(self)
        self.register_buffer("seen", torch.as_tensor(list(seen)))
        self.net = layers(len(seen), settings.hidden, self.num_actions)
        self.log_std = torch.nn.Parameter(torch.full((self.num_actions,), settings.log_std))

    def compute(self, inputs: dict[str, torch.Tensor], role: str = "") -> tuple[torch.Tensor, dict[str, Any]]:
        """Return mean actions and the logarithm of their standard deviation."""
        return self.net(inputs["observations"][:, self.seen]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    """Critic of a world for one agent, from the same components of all agents' observations."""

    def __init__(self, state: gym.Space, seen: Sequence[int], settings: MAPPOSettings, device: Any) -> None:
        Model.__init__(self, state_space=state, device=device)
        DeterministicMixin.__init__(self)
        self.register_buffer("seen", torch.as_tensor(list(seen)))
        self.net = layers(len(seen), settings.hidden, 1)

    def compute(self, inputs: dict[str, torch.Tensor], role: str = "") -> tuple[torch.Tensor, dict[str, Any]]:
        """Return the value."""
        return self.net(inputs["states"][:, self.seen]), {}


class ActedMemory(RandomMemory):
    """Memory that samples only the steps that the agent took itself, not those after it left."""

    def __init__(self, memory_size: int, num_envs: int, device: Any, ranks: Ranks = ALONE) -> None:
        super().__init__(memory_size=memory_size, num_envs=num_envs, device=device)
        self.ranks = ranks
        self.acted = torch.ones(memory_size, num_envs, dtype=torch.bool, device=self.device)

    def set_tensor_by_name(self, name: str, tensor: torch.Tensor) -> None:
        """Set a tensor; advantages are normalised over the steps that count."""
        if name == "advantages" and self.acted.any():
            counted = tensor[self.acted]
            tensor = (tensor - counted.mean()) / (counted.std(unbiased=False) + 1e-8)
        super().set_tensor_by_name(name, tensor)

    def sample(
        self, names: list[str], *, batch_size: int, mini_batches: int = 1, sequence_length: int = 1
    ) -> list[list[torch.Tensor]]:
        """Sample minibatches in random order, as many on all ranks; none if the agent was out all the time on one."""
        rows = self.acted.flatten().nonzero().flatten().cpu()
        rows = rows[torch.randperm(len(rows))]
        count = self.ranks.least(min(mini_batches, len(rows)))
        return self.sample_by_index(names, indexes=rows, mini_batches=count) if count else []
