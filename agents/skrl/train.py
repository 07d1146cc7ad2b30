"""Multi-Agent PPO with skrl on a batch of worlds: ``python -m agents.skrl.train configs/skrl/high_five_mappo.yaml``.

MAPPO (Yu et al., "The Surprising Effectiveness of PPO in Cooperative Multi-Agent Games", 2022): every agent has a
policy of what it sees itself and a critic of what all of them see. Leaves in the folder: the resolved configuration,
the networks, TensorBoard's files with networks on the way there, every training episode's return, and the evaluation.
What was killed goes on with ``--resume``, from the latest checkpoint and as if nothing had happened.
``torchrun --nproc-per-node=2 -m agents.skrl.train ...`` trains on two GPUs.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field
from skrl import config as skrl_config
from skrl.envs.wrappers.torch import wrap_env
from skrl.multi_agents.torch.mappo import MAPPO
from skrl.trainers.torch import SequentialTrainer

from agents.batch_training import BatchTraining, Learned, iterations_of, run
from agents.checkpoint import Checkpoint, as_arrays, check_finite, random_states, seed_all, set_random_states
from agents.config import multi_game
from agents.evaluate import Agent
from agents.files import write_atomically, write_config
from agents.ranks import ALONE, Ranks
from agents.report import Curve
from agents.sb3.workers import components
from agents.skrl.networks import ActedMemory, Critic, MAPPOSettings, Policy
from piavatar_envs.api.skrl import AvatarSkrlMultiEnv
from piavatar_envs.envs.task import Task

#: Parts of skrl's MAPPO that are not used.
_OPTIONAL = ("learning_rate_scheduler", "observation_preprocessor", "state_preprocessor", "value_preprocessor")


class MAPPOTraining(BatchTraining):
    """Settings of a training run with MAPPO."""

    env_id: str = Field("high_five_v0", description="module of piavatar_envs.multi")
    mappo: MAPPOSettings = Field(default_factory=MAPPOSettings, description="the algorithm")


def find_world(env_id: str) -> type[Task]:
    """Return the task of a world.

    Raises:
        ValueError: there is no such world, or PettingZoo is not installed.
    """
    return multi_game(env_id).TASK


class Worlds(AvatarSkrlMultiEnv):
    """Worlds that return to the state of a checkpoint at the first reset, with which skrl's trainer begins.

    Attributes:
        saved: the state of the worlds; None for new episodes.
    """

    saved: dict[str, np.ndarray] | None = None

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode in every world, or resume."""
        begun = super().reset(seed, options)
        if self.saved is None:
            return begun
        self.host.set_state(self.saved)
        return self._now()


class WorldMAPPO(MAPPO):
    """skrl's MAPPO with masks of the agents that acted, true episode ends, and checkpoints.

    Without that it would take the first observation of the next episode for the last one of a truncated episode.

    Attributes:
        curve: of the training.
        iterations: how many it has had.
    """

    def __init__(self, env: Worlds, checkpoint: Checkpoint | None, checkpoint_every: int, **arguments: Any) -> None:
        """Build the agents; :meth:`resume` restores a checkpoint.

        Args:
            env: the worlds.
            checkpoint: from which to go on, and which to keep up; None for neither.
            checkpoint_every: iterations.
            **arguments: of skrl's MAPPO.
        """
        super().__init__(**arguments)
        self.env, self.checkpoint, self.checkpoint_every = env, checkpoint, checkpoint_every
        self.ranks = checkpoint.ranks if checkpoint else ALONE
        self.curve, self.iterations = Curve(), 0
        self._merged = 0  # episodes of the curve that are of all ranks
        self._first_step, self._steps, self._totals = 0, 0, torch.zeros(env.num_envs, device=self.device)
        self._begun = time.monotonic()

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
        """Add the mean over agents to the returns of the episodes, and log those that have ended."""
        self._steps += self.ranks.size * len(ended)
        self._totals = self._totals + torch.cat(list(rewards.values()), dim=1).mean(dim=1)
        returns = self._totals[ended].tolist()
        self.curve.steps += [self._steps] * len(returns)
        self.curve.returns += returns
        self._totals[ended] = 0.0

    def _merge_curves(self) -> None:
        """Add the episodes of this rollout that have ended on other ranks to the curve of rank 0."""
        new, curve = slice(self._merged, None), self.curve
        parts = self.ranks.gather(list(zip(curve.steps[new], curve.returns[new], strict=True)))
        if self.ranks.first:
            ended = sorted(chain(*parts), key=itemgetter(0))
            curve.steps[new], curve.returns[new] = [steps for steps, _ in ended], [value for _, value in ended]
        self._merged = len(curve.steps)

    def post_interaction(self, *, timestep: int, timesteps: int) -> None:
        """Learn at the end of a rollout, and write the checkpoint every so many iterations and at the end.

        Raises:
            Diverged: the networks are not finite any more.
            KeyboardInterrupt: Ctrl-C, after a checkpoint was written.
        """
        super().post_interaction(timestep=self._first_step + timestep, timesteps=timesteps)
        if self._rollout % self.cfg.rollouts == 0:
            self.iterations += 1
            self._check_finite()
            self._merge_curves()
            self.curve.seconds = time.monotonic() - self._begun
            if self.checkpoint is None:
                return
            ends = self.checkpoint.stop.asked() or timestep + 1 == timesteps
            if ends or self.iterations % self.checkpoint_every == 0:
                self.checkpoint.save(self._shared_state(), self._own_state())
                self.checkpoint.stop.obey(self.checkpoint.reached)

    def _check_finite(self) -> None:
        networks = {f"{name} {part}": network for name, own in self.models.items() for part, network in own.items()}
        actions = torch.as_tensor(joint_agent(self)(self.env.host.observation()))
        rate = "mappo.learning_rate", self.cfg.learning_rate[self.possible_agents[0]][0]
        check_finite(networks, {"an action": actions}, self._steps, rate, self.checkpoint and self.checkpoint.path)

    def _shared_state(self) -> dict[str, Any]:
        """Return what is the same on all ranks, or rank 0's to write."""
        return {
            "iterations": self.iterations,
            "agents": {
                name: {part: module.state_dict() for part, module in modules.items()}
                for name, modules in self._modules()
            },
            "curve": self.curve.state(),
        }

    def _own_state(self) -> dict[str, Any]:
        """Return what every rank has of its own."""
        return {
            "envs": self.env.host.get_state(),
            "playing": [self._steps, self._totals],
            "random": random_states(),
        }

    def _modules(self) -> Iterable[tuple[str, dict[str, Any]]]:
        """Yield networks and optimizers of every agent."""
        for name, modules in self.checkpoint_modules.items():
            yield name, {part: module for part, module in modules.items() if hasattr(module, "state_dict")}

    def resume(self) -> None:
        """Restore the checkpoint, if there is one; call it after everything that draws random numbers."""
        saved = self.checkpoint.state if self.checkpoint else None
        if saved is None:
            return
        for name, modules in self._modules():
            for part, module in modules.items():
                module.load_state_dict(saved["agents"][name][part])
        self.env.saved = as_arrays(saved["envs"])
        self.iterations = saved["iterations"]
        self._first_step = self.iterations * self.cfg.rollouts
        self._steps, totals = saved["playing"]
        self._totals = totals.to(self.device)
        self.curve.load(saved["curve"])
        self._merged = len(self.curve.steps)
        self._begun = time.monotonic() - self.curve.seconds
        set_random_states(saved["random"])


def learn(config: MAPPOTraining, task: Task, folder: Path, device: str, checkpoint: Checkpoint) -> Learned:
    """Train the agents of a world; to be called on all ranks.

    Args:
        config: resolved.
        task: the world's.
        folder: where rank 0 writes; exists.
        device: where to simulate and to learn.
        checkpoint: from which to go on, and which to keep up.

    Raises:
        ConfigError: an unknown term to observe, or a checkpoint with more iterations than are configured.
        Diverged: the networks are not finite any more.
    """
    ranks = checkpoint.ranks
    enter(ranks)
    with ranks.leaders_first():
        env = Worlds(type(task), config.num_envs, device, task.config, ranks.threads)
    seed_all(config.seed)
    skrl_config.torch.key = config.first_seed_on(ranks)  # what skrl's wrapper seeds the worlds with
    mappo = build(config, env, folder, checkpoint)
    config.seed_draws(ranks)
    left = config.iterations - iterations_of(checkpoint, config.iterations)
    trainer = SequentialTrainer(
        env=wrap_env(env, wrapper="isaaclab-multi-agent", verbose=False),
        agents=mappo,
        cfg={
            "timesteps": left * config.mappo.rollout_steps,
            "headless": True,
            "disable_progressbar": None,
            "close_environment_at_exit": False,
        },
    )
    if ranks.first:
        write_config(folder, config)
    mappo.resume()
    with checkpoint.stop.listening():
        trainer.train()
    mappo.curve.train_steps = ranks.size * config.iterations * config.num_envs * config.mappo.rollout_steps
    if ranks.first:
        write_atomically(folder / "policy.pt", mappo.save)
    env.close()
    return Learned(joint_agent(mappo), mappo.curve)


def enter(ranks: Ranks) -> None:
    """Let skrl reduce gradients over the group that has been joined."""
    own = skrl_config.torch
    own._rank, own._local_rank, own._world_size = ranks.rank, ranks.local_rank, ranks.size
    own._is_distributed = ranks.size > 1


def build(config: MAPPOTraining, env: Worlds, folder: Path, checkpoint: Checkpoint | None = None) -> WorldMAPPO:
    """Build untrained agents.

    Raises:
        ConfigError: there is no such term to observe.
    """
    settings, layout, names = config.mappo, env.observation_layout, env.possible_agents
    ranks = checkpoint.ranks if checkpoint else ALONE
    seen = components(layout, config.observe)
    of_all = [agent * layout.size + index for agent in range(env.num_agents) for index in seen]
    return WorldMAPPO(
        env,
        checkpoint,
        config.checkpoint_every,
        possible_agents=names,
        models={
            name: {
                "policy": Policy(env.observation_spaces[name], env.action_spaces[name], seen, settings, env.device),
                "value": Critic(env.state_space, of_all, settings, env.device),
            }
            for name in names
        },
        memories={name: ActedMemory(settings.rollout_steps, config.num_envs, env.device, ranks) for name in names},
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
    """Return an agent of all mean actions, from observations ``(n, agents, size)`` to ``(n, agents, action_size)``."""

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
    """Run the command line."""
    run("skrl.train", MAPPOTraining, find_world, learn, args)


if __name__ == "__main__":
    main()
