"""Multi-Agent PPO by skrl on a batch of worlds: ``python -m agents.skrl_mappo configs/skrl/high_five_mappo.yaml``.

MAPPO (Yu et al., "The Surprising Effectiveness of PPO in Cooperative Multi-Agent Games", 2022): every agent has a
policy of what it sees itself and a critic of what all of them see. Leaves in the folder: the resolved configuration,
the networks, TensorBoard's files with skrl's checkpoints, every training episode's return, and the evaluation.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from pydantic import BaseModel, Field
from skrl import config as skrl_config
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.multi_agents.torch.mappo import MAPPO
from skrl.trainers.torch import SequentialTrainer

from agents.batches import BatchTraining, Learned, run
from agents.config import multi_module
from agents.curve import Curve
from agents.evaluate import Agent
from agents.workers import components
from piavatar_envs.api.skrl import AvatarSkrlMultiEnv
from piavatar_envs.envs.config import FROZEN
from piavatar_envs.tasks.base import Task

#: Parts of skrl's MAPPO that are not used.
_OPTIONAL = ("learning_rate_scheduler", "observation_preprocessor", "state_preprocessor", "value_preprocessor")


class MAPPOSettings(BaseModel):
    """Hyper-parameters of MAPPO."""

    model_config = FROZEN

    rollout_steps: int = Field(32, ge=2, description="steps of every world between two updates")
    epochs: int = Field(8, ge=1, description="passes over a rollout")
    minibatches: int = Field(4, ge=1, description="minibatches in a pass")
    learning_rate: float = Field(5.0e-4, gt=0.0, description="Adam's learning rate [-]")
    discount: float = Field(0.95, gt=0.0, le=1.0, description="discount of a step's reward, gamma [-]")
    gae_lambda: float = Field(0.9, ge=0.0, le=1.0, description="bias against variance of the advantage [-]")
    clip_range: float = Field(0.2, gt=0.0, description="largest change of an action's probability ratio [-]")
    value_weight: float = Field(0.5, ge=0.0, description="weight of the critic's squared error [-]")
    entropy_weight: float = Field(0.0, ge=0.0, description="weight of the entropy bonus [-]")
    largest_gradient: float = Field(0.5, ge=0.0, description="norm to which gradients are clipped [-]; 0 for never")
    log_std: float = Field(-0.7, ge=-10.0, le=2.0, description="logarithm of the first actions' standard deviation [-]")
    hidden: tuple[int, ...] = Field((128, 128), description="widths of the hidden layers of both networks")


class MAPPOTraining(BatchTraining):
    """Everything that a training with MAPPO depends on."""

    env_id: str = Field("high_five_v0", description="module of piavatar_envs.multi")
    mappo: MAPPOSettings = Field(default_factory=MAPPOSettings, description="the algorithm")


def find_world(env_id: str) -> type[Task]:
    """The task of a world.

    Raises:
        ValueError: there is no such world, or PettingZoo is not installed.
    """
    return multi_module(env_id).TASK


def layers(seen: int, hidden: Sequence[int], out: int) -> torch.nn.Sequential:
    """A network with tanh between its layers, whose first answers are near zero."""
    widths = [seen, *hidden]
    inner = [module for size, width in pairwise(widths) for module in (torch.nn.Linear(size, width), torch.nn.Tanh())]
    last = torch.nn.Linear(widths[-1], out)
    torch.nn.init.orthogonal_(last.weight, 0.01)
    torch.nn.init.zeros_(last.bias)
    return torch.nn.Sequential(*inner, last)


class Policy(GaussianMixin, Model):
    """Normally distributed actions from some components of the agent's observation."""

    def __init__(
        self, observation: gym.Space, action: gym.Space, seen: Sequence[int], settings: MAPPOSettings, device: Any
    ) -> None:
        Model.__init__(self, observation_space=observation, action_space=action, device=device)
        GaussianMixin.__init__(self)
        self.register_buffer("seen", torch.as_tensor(list(seen)))
        self.net = layers(len(seen), settings.hidden, self.num_actions)
        self.log_std = torch.nn.Parameter(torch.full((self.num_actions,), settings.log_std))

    def compute(self, inputs: dict[str, torch.Tensor], role: str = "") -> tuple[torch.Tensor, dict[str, Any]]:
        """Mean actions and the logarithm of their spread."""
        return self.net(inputs["observations"][:, self.seen]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    """The value of a world for one agent, from the same components of all agents' observations."""

    def __init__(self, state: gym.Space, seen: Sequence[int], settings: MAPPOSettings, device: Any) -> None:
        Model.__init__(self, state_space=state, device=device)
        DeterministicMixin.__init__(self)
        self.register_buffer("seen", torch.as_tensor(list(seen)))
        self.net = layers(len(seen), settings.hidden, 1)

    def compute(self, inputs: dict[str, torch.Tensor], role: str = "") -> tuple[torch.Tensor, dict[str, Any]]:
        """The value."""
        return self.net(inputs["states"][:, self.seen]), {}


class ActedMemory(RandomMemory):
    """Gives the loss only the steps that the agent took itself, not those for which it was out."""

    def __init__(self, memory_size: int, num_envs: int, device: Any) -> None:
        super().__init__(memory_size=memory_size, num_envs=num_envs, device=device)
        self.acted = torch.ones(memory_size, num_envs, dtype=torch.bool, device=self.device)

    def set_tensor_by_name(self, name: str, tensor: torch.Tensor) -> None:
        """As its base does, but advantages are normalised over the steps that count."""
        if name == "advantages" and self.acted.any():
            counted = tensor[self.acted]
            tensor = (tensor - counted.mean()) / (counted.std(unbiased=False) + 1e-8)
        super().set_tensor_by_name(name, tensor)

    def sample(
        self, names: list[str], *, batch_size: int, mini_batches: int = 1, sequence_length: int = 1
    ) -> list[list[torch.Tensor]]:
        """Minibatches in random order; none at all where the agent was out all the time."""
        rows = self.acted.flatten().nonzero().flatten().cpu()
        rows = rows[torch.randperm(len(rows))]
        return self.sample_by_index(names, indexes=rows, mini_batches=min(mini_batches, len(rows))) if len(rows) else []


class WorldMAPPO(MAPPO):
    """skrl's MAPPO, told by the view who acted and where the episodes really ended.

    Without that it would take the first observation of the next episode for the last one of a truncated episode.
    """

    def __init__(self, curve: Curve, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.curve, self._steps, self._totals = curve, 0, 0.0

    def record_transition(self, *, infos: dict[str, Any], rewards: dict[str, torch.Tensor], **transition: Any) -> None:
        """Store a step."""
        self._book(rewards, infos["_final_obs"])
        for name, memory in self.memories.items():
            memory.acted[memory.memory_index] = infos["acted"][name]
        transition |= {
            "next_observations": infos["final_obs"],
            "next_states": dict.fromkeys(self.possible_agents, infos["final_state"]),
        }
        super().record_transition(infos=infos, rewards=rewards, **transition)

    def _book(self, rewards: dict[str, torch.Tensor], ended: torch.Tensor) -> None:
        """Add the mean over agents to the returns of the episodes, and book those that have ended."""
        self._steps += len(ended)
        self._totals = self._totals + torch.cat(list(rewards.values()), dim=1).mean(dim=1)
        returns = self._totals[ended].tolist()
        self.curve.steps += [self._steps] * len(returns)
        self.curve.returns += returns
        self._totals[ended] = 0.0


def learn(config: MAPPOTraining, task: Task, folder: Path, device: str) -> Learned:
    """Train the agents of a world.

    Args:
        config: resolved.
        task: the world's.
        folder: where to write; exists.
        device: where to simulate and to learn.

    Raises:
        ConfigError: there is no such term to observe.
    """
    env = AvatarSkrlMultiEnv(type(task), config.num_envs, device, task.config)
    torch.manual_seed(config.seed)
    skrl_config.torch.key = config.first_seed  # what skrl's wrapper seeds the worlds with
    mappo = build(config, env, folder)
    trainer = SequentialTrainer(
        env=wrap_env(env, wrapper="isaaclab-multi-agent", verbose=False),
        agents=mappo,
        cfg={
            "timesteps": config.iterations * config.mappo.rollout_steps,
            "headless": True,
            "disable_progressbar": None,
            "close_environment_at_exit": False,
        },
    )
    start = time.monotonic()
    trainer.train()
    mappo.curve.seconds = time.monotonic() - start
    mappo.save(str(folder / "policy.pt"))
    env.close()
    return Learned(joint_agent(mappo), mappo.curve)


def build(config: MAPPOTraining, env: AvatarSkrlMultiEnv, folder: Path) -> WorldMAPPO:
    """Untrained agents.

    Raises:
        ConfigError: there is no such term to observe.
    """
    settings, layout, names = config.mappo, env.observation_layout, env.possible_agents
    seen = components(layout, config.observe)
    of_all = [agent * layout.size + index for agent in range(env.num_agents) for index in seen]
    return WorldMAPPO(
        Curve(),
        possible_agents=names,
        models={
            name: {
                "policy": Policy(env.observation_spaces[name], env.action_spaces[name], seen, settings, env.device),
                "value": Critic(env.state_space, of_all, settings, env.device),
            }
            for name in names
        },
        memories={name: ActedMemory(settings.rollout_steps, config.num_envs, env.device) for name in names},
        observation_spaces=env.observation_spaces,
        state_spaces=dict.fromkeys(names, env.state_space),
        action_spaces=env.action_spaces,
        device=env.device,
        cfg={
            "rollouts": settings.rollout_steps,
            "learning_epochs": settings.epochs,
            "mini_batches": settings.minibatches,
            "discount_factor": settings.discount,
            "gae_lambda": settings.gae_lambda,
            "learning_rate": settings.learning_rate,
            "grad_norm_clip": settings.largest_gradient,
            "ratio_clip": settings.clip_range,
            "value_clip": 0.0,
            "entropy_loss_scale": settings.entropy_weight,
            "value_loss_scale": settings.value_weight,
            "time_limit_bootstrap": True,
            # skrl takes its own default, an empty dictionary, for one by agent that lacks them all
            **{f"{what}_kwargs": {name: {} for name in names} for what in _OPTIONAL},
            "experiment": {
                "directory": str(folder),
                "experiment_name": "skrl",
                "write_interval": settings.rollout_steps,
                "checkpoint_interval": settings.rollout_steps * max(1, config.iterations // 10),
            },
        },
    )


def joint_agent(mappo: MAPPO) -> Agent:
    """All agents' mean actions, from observations ``(n, agents, size)`` to ``(n, agents, action_size)``."""

    def act(observation: np.ndarray) -> np.ndarray:
        seen = torch.as_tensor(observation, device=mappo.device)
        with torch.no_grad():
            means = [
                mappo.policies[name].compute({"observations": seen[:, index]})[0]
                for index, name in enumerate(mappo.possible_agents)
            ]
        return torch.stack(means, dim=1).cpu().numpy()

    return act


def main(args: list[str] | None = None) -> None:
    """The command line."""
    run("skrl_mappo", MAPPOTraining, find_world, learn, args)


if __name__ == "__main__":
    main()
