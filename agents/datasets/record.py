"""Episodes of a level of play, and the Minari dataset that they become."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from tqdm import tqdm

from agents.datasets.levels import Source
from agents.evaluate import begin_round
from agents.files import git_commit
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import ConfigError
from piavatar_envs.core.extras import missing
from piavatar_envs.doctor import package_version
from piavatar_envs.tasks import listed_name

#: Version of the layout of the datasets; rises with every change.
VERSION = 0
#: Variable by which Minari finds its datasets.
ROOT_VARIABLE = "MINARI_DATASETS_PATH"


@dataclass(frozen=True)
class Play:
    """One complete episode.

    Attributes:
        seed: of the episode.
        observations: before every step and after the last, shape ``(steps + 1, size)``.
        actions: within the action space, shape ``(steps, action_size)``.
        rewards, success: of every step, shape ``(steps,)``.
        terminated: whether it ended before its time.
    """

    seed: int
    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    success: np.ndarray
    terminated: bool


def record(source: Source, episodes: int, first_seed: int, num_envs: int, device: str) -> list[Play]:
    """Play episodes in rounds of at most ``num_envs`` at a time.

    Args:
        source: environment and agent.
        episodes: how many.
        first_seed: of the first; each episode has its own, counted upwards.
        num_envs: environments that play at a time.
        device: where to simulate.

    Raises:
        RuntimeError: a simulation has failed.
    """
    host = EpisodeHost(source.task, min(num_envs, episodes), device)
    agent = source.make(host)
    plays: list[Play] = []
    with tqdm(total=episodes, desc=f"record {source.name}", unit="episode", dynamic_ncols=True) as bar:
        for first in range(first_seed, first_seed + episodes, host.num_envs):
            begin_round(agent, host.num_envs)
            count = min(host.num_envs, first_seed + episodes - first)
            plays += _play_round(host, agent, first)[:count]
            bar.update(count)
    host.close()
    return plays


def _play_round(host: EpisodeHost, agent: Any, first_seed: int) -> list[Play]:
    """Play one episode in every environment, to the end of the longest."""
    seeds = [first_seed + env for env in range(host.num_envs)]
    host.reset(seeds)
    seen, done, rewards, success = [host.observation()[:, 0]], [], [], []
    lengths = np.zeros(host.num_envs, int)
    playing = np.ones(host.num_envs, bool)
    while playing.any():
        action = np.clip(np.asarray(agent(seen[-1][:, None]), np.float32), -1.0, 1.0)
        host.step(action)
        seen.append(host.observation()[:, 0])
        done.append(action[:, 0])
        rewards.append(host.reward()[:, 0])
        success.append(host.read(lambda group: group.success)[:, 0].astype(bool))
        lengths += playing
        playing &= ~host.find_ended()
    failures = host.read(lambda group: group.failure)
    if failures.any():
        raise RuntimeError(f"the simulation of seed {seeds[int(np.argmax(failures != 0))]} failed; leave it out")
    over = host.terminated().reshape(host.num_envs, -1).all(axis=1)
    arrays = [np.stack(own, axis=1) for own in (seen, done, rewards, success)]
    return [
        Play(seed, *(own[env, : lengths[env] + (place == 0)] for place, own in enumerate(arrays)), bool(over[env]))
        for env, seed in enumerate(seeds)
    ]


def dataset_id(env_id: str, level: str) -> str:
    """Return the name of a dataset, as ``piavatar/kick-ball/expert-v0``."""
    name = listed_name(env_id).rpartition("/")[2].rpartition("-v")[0]
    words = "".join(f"-{letter.lower()}" if letter.isupper() else letter for letter in name).strip("-")
    return f"piavatar/{words}/{level}-v{VERSION}"


@contextmanager
def datasets_in(folder: Path) -> Iterator[None]:
    """Let Minari read and write its datasets in ``folder``."""
    before = os.environ.get(ROOT_VARIABLE)
    os.environ[ROOT_VARIABLE] = str(folder.resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ[ROOT_VARIABLE]
        else:
            os.environ[ROOT_VARIABLE] = before


def import_minari() -> Any:
    """Import Minari.

    Raises:
        ImportError: it is not installed.
    """
    try:
        import minari
    except ImportError as error:
        raise missing("a dataset", "minari", "datasets") from error
    return minari


def check_new(folder: Path, name: str) -> None:
    """Refuse a dataset that there is already.

    Raises:
        ConfigError: see above.
    """
    if (folder / name).exists():
        raise ConfigError(f"{folder / name} is a dataset already; delete it, or write elsewhere with --out")


def write(folder: Path, name: str, env_id: str, source: Source, plays: list[Play]) -> Any:
    """Write episodes as a dataset and return it.

    Args:
        folder: of all datasets.
        name: as :func:`dataset_id` returns it.
        env_id: registered id.
        source: environment and agent.
        plays: the episodes.

    Raises:
        ImportError: Minari is not installed.
    """
    minari = import_minari()
    from minari.data_collector import EpisodeBuffer

    buffers = [
        EpisodeBuffer(
            id=index,
            seed=play.seed,
            observations=play.observations,
            actions=play.actions,
            rewards=play.rewards.astype(np.float64),
            terminations=_at_end(len(play.rewards), play.terminated),
            truncations=_at_end(len(play.rewards), not play.terminated),
            infos={"success": np.concatenate([[False], play.success])},
        )
        for index, play in enumerate(plays)
    ]
    settings = source.task.config.model_dump(mode="json", exclude_defaults=True)
    env = gym.make(f"piavatar_envs:{env_id}", config=settings)
    commit, _ = git_commit()
    folder.mkdir(parents=True, exist_ok=True)
    with datasets_in(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about an author's name and address
        dataset = minari.create_dataset_from_buffers(
            name,
            buffers,
            env=env,
            algorithm_name=source.name,
            description=f"{len(plays)} complete episodes of {env_id} by {source.name}, seeds from {plays[0].seed} on; "
            f"commit {commit}",
            requirements=[f"piavatar-envs=={package_version('piavatar-envs')}"],
        )
    env.close()
    return dataset


def _at_end(steps: int, value: bool) -> np.ndarray:
    flags = np.zeros(steps, bool)
    flags[-1] = value
    return flags
