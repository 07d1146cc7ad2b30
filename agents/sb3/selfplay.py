"""Self-play against earlier versions of the policy: a pool of snapshots, and the opponents drawn from it."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from pydantic import BaseModel, Field
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy

from agents.checkpoint import load_weights
from agents.files import write_atomically
from agents.sb3.parallel import AgentVecEnv
from piavatar_envs.config import FROZEN, ConfigError

_NAME = re.compile(r"snapshot_(\d+)_steps\.pt")


class SelfPlaySettings(BaseModel):
    """Settings of self-play: opponents during training and at the end."""

    model_config = FROZEN

    duel_share: float = Field(
        0.5,
        ge=0.0,
        le=1.0,
        description="share of the worlds with one learner among snapshots of earlier policies, drawn for every "
        "episode; in the other worlds all agents learn [-]",
    )
    snapshot_every: int = Field(20_000, ge=1, description="steps between two snapshots, taken between rollouts")
    evaluate_against: tuple[Literal["zero", "random", "first", "latest"], ...] = Field(
        ("zero", "first", "latest"),
        min_length=1,
        description="opponents at the end: zero or random actions, the first or the latest snapshot",
    )

    def num_duels(self, num_worlds: int) -> int:
        """Return the number of worlds with one learner: at least one, unless the share is zero."""
        return min(num_worlds, max(round(self.duel_share * num_worlds), int(self.duel_share > 0.0)))


class Pool:
    """Pool of snapshots of a policy, each a file with its weights.

    Attributes:
        folder: where the files are.
        steps: for which the policies had been trained, in ascending order.
    """

    def __init__(self, folder: Path, steps: Iterable[int] = ()) -> None:
        """Open a pool in ``folder``; other snapshots in it are removed.

        Args:
            folder: made if there is none.
            steps: of the snapshots that the pool begins with; their files exist.

        Raises:
            ConfigError: one of them has no file.
        """
        self.folder, self.steps = folder, sorted(steps)
        missing = sorted(set(self.steps) - set(_snapshots(folder)))
        if missing:
            raise ConfigError(f"{folder} has no {_file_name(missing[0])}; resume in the folder of the run")
        folder.mkdir(parents=True, exist_ok=True)
        for found in set(_snapshots(folder)) - set(self.steps):
            self._path(found).unlink()

    def add(self, policy: BasePolicy, steps: int) -> None:
        """Add the policy as it is now."""
        write_atomically(self._path(steps), lambda file: torch.save(policy.state_dict(), file))
        self.steps.append(steps)

    def load(self, policy: BasePolicy, steps: int) -> None:
        """Load the weights of a snapshot into ``policy``."""
        policy.load_state_dict(load_weights(self._path(steps), "cpu"))

    def _path(self, steps: int) -> Path:
        return self.folder / _file_name(steps)


def _file_name(steps: int) -> str:
    return f"snapshot_{steps}_steps.pt"


def _snapshots(folder: Path) -> list[int]:
    matches = (_NAME.fullmatch(path.name) for path in folder.glob("snapshot_*"))
    return sorted(int(match[1]) for match in matches if match)


class Opponents:
    """Opponents in the worlds with one learner: one snapshot in each, acting as noisily as the learner.

    Attributes:
        drawn: steps of the snapshot that plays in a world.
    """

    def __init__(self, pool: Pool, policy: BasePolicy, worlds: Iterable[int]) -> None:
        self.pool = pool
        self.drawn: dict[int, int] = {}
        self._policies = {world: copy.deepcopy(policy) for world in worlds}

    def draw(self, world: int, rng: np.random.Generator) -> None:
        """Draw the snapshot, uniformly, that plays the next episode in ``world``."""
        steps = self.pool.steps[rng.integers(len(self.pool.steps))]
        if self.drawn.get(world) != steps:
            self.pool.load(self._policies[world], steps)
            self.drawn[world] = steps

    def seat(self, drawn: Mapping[int, int]) -> None:
        """Restore the snapshots that were drawn for the worlds, by their steps."""
        for world, steps in drawn.items():
            self.pool.load(self._policies[world], steps)
        self.drawn = dict(drawn)

    def act(self, world: int, observation: np.ndarray) -> np.ndarray:
        """Return actions for observations ``(n, observation_size)``."""
        return self._policies[world].predict(observation)[0]


class Snapshots(BaseCallback):
    """Callback that adds the policy to the pool every so many steps."""

    def __init__(self, pool: Pool, every: int) -> None:
        super().__init__()
        self.pool, self.every = pool, every

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self.pool.steps[-1] >= self.every:
            self.pool.add(self.model.policy, self.num_timesteps)

    def _on_step(self) -> bool:
        return True


def enter(
    settings: SelfPlaySettings, venv: AgentVecEnv, model: PPO, folder: Path, steps: Iterable[int] = ()
) -> Snapshots:
    """Seat the opponents before the training begins, and return the callback that extends their pool.

    Args:
        settings: of self-play.
        venv: the worlds, reset afterwards.
        model: untrained.
        folder: of the run; the pool is in its folder ``pool``.
        steps: of the snapshots of a training run that goes on.

    Raises:
        ConfigError: one of them has no file.
    """
    pool = Pool(folder / "pool", steps)
    if not pool.steps:
        pool.add(model.policy, model.num_timesteps)
    venv.opponents = Opponents(pool, model.policy, venv.duels)
    return Snapshots(pool, settings.snapshot_every)
