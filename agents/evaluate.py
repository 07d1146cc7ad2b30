"""The protocol by which agents are compared: the same fresh episodes for all, and intervals over episodes.

An agent is anything that is called with observations ``(n, observation_size)`` and returns actions
``(n, action_size)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import stats
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from benchmarks.runner import Estimate, mean_and_interval

Agent = Callable[[np.ndarray], np.ndarray]


@dataclass
class Episode:
    """One episode of an evaluation.

    Attributes:
        seed: of the episode.
        total: undiscounted return.
        steps: its length.
        successes: steps in which the task was fulfilled.
        success_at_end: whether it was in the last step.
        distance: mean over the steps of the task's ``distance`` [m], where it has one.
        failure: why the simulation gave up, or None.
        agent_totals: undiscounted return of every agent of a world, shape ``(agents,)``; None where there is one.
        agent_success: whether each had fulfilled its task in its last step, shape ``(agents,)``, or None.
    """

    seed: int
    total: float = 0.0
    steps: int = 0
    successes: int = 0
    success_at_end: bool = False
    distance: float = 0.0
    failure: str | None = None
    agent_totals: np.ndarray | None = None
    agent_success: np.ndarray | None = None

    def book(self, reward: float, info: dict[str, Any]) -> None:
        """Add a step."""
        self.total += reward
        self.steps += 1
        self.success_at_end = bool(info.get("success", False))
        self.successes += self.success_at_end
        self.distance += (float(info.get("distance", np.nan)) - self.distance) / self.steps
        self.failure = info.get("failure")
        if "rewards" in info:
            self.agent_totals = info["rewards"] + (0.0 if self.agent_totals is None else self.agent_totals)
            self.agent_success = info["successes"]


@dataclass
class Evaluation:
    """An agent's episodes, by seed."""

    agent: str
    episodes: list[Episode] = field(default_factory=list)

    @property
    def returns(self) -> np.ndarray:
        """Return of every episode, shape ``(episodes,)``."""
        return np.array([episode.total for episode in self.episodes])

    def estimate(self) -> Estimate:
        """Mean return and its 95 % interval over episodes."""
        return mean_and_interval(self.returns)

    def share(self, what: Callable[[Episode], float]) -> float:
        """Mean of ``what`` over the episodes."""
        return float(np.mean([what(episode) for episode in self.episodes]))

    def row(self) -> dict[str, Any]:
        """The figures for a table or a JSON file."""
        estimate, distance = self.estimate(), self.share(lambda e: e.distance)
        row = {
            "case": self.agent,
            "return_mean": estimate.mean,
            "return_interval": [estimate.low, estimate.high],
            "return_std": float(self.returns.std(ddof=1)),
            "success_once": self.share(lambda e: e.successes > 0),
            "success_once_interval": share_interval([e.successes > 0 for e in self.episodes]),
            "success_at_end": self.share(lambda e: e.success_at_end),
            "success_at_end_interval": share_interval([e.success_at_end for e in self.episodes]),
            "success_share_of_steps": self.share(lambda e: e.successes / e.steps),
            "mean_distance_m": distance if np.isfinite(distance) else None,
            "failures": sum(episode.failure is not None for episode in self.episodes),
            "episodes": len(self.episodes),
            "first_seed": self.episodes[0].seed,
        }
        if self.episodes[0].agent_totals is not None:
            of_agents = [mean_and_interval(totals) for totals in np.transpose([e.agent_totals for e in self.episodes])]
            row["agent_return_mean"] = [one.mean for one in of_agents]
            row["agent_return_interval"] = [[one.low, one.high] for one in of_agents]
        return row


def share_interval(outcomes: Sequence[bool]) -> list[float]:
    """Wilson's 95 % interval of the share of episodes with an outcome: not empty where all or none had it."""
    found = stats.binomtest(int(np.sum(outcomes)), len(outcomes)).proportion_ci(0.95, method="wilson")
    return [float(found.low), float(found.high)]


def evaluate(
    name: str, agent: Agent, venv: VecEnv, episodes: int, first_seed: int, progress: bool = True
) -> Evaluation:
    """Let an agent play episodes ``first_seed``, ``first_seed + 1``, ... to their ends.

    The outcome does not depend on the number of workers: every episode has a seed of its own.

    Args:
        name: the agent's, for tables.
        agent: from observations to actions.
        venv: workers; whatever they were playing is given up.
        episodes: how many episodes.
        first_seed: of the first.
        progress: whether to show a bar.
    """
    finished: list[Episode] = []
    waiting = list(range(first_seed, first_seed + episodes))[::-1]
    running: list[Episode | None] = [None] * venv.num_envs
    observation = np.zeros((venv.num_envs, *venv.observation_space.shape), np.float32)

    def begin(worker: int) -> None:
        running[worker] = Episode(waiting.pop()) if waiting else None
        seed = running[worker].seed if running[worker] else 0
        observation[worker] = venv.env_method("reset", seed=seed, indices=worker)[0][0]

    for worker in range(venv.num_envs):
        begin(worker)
    with tqdm(total=episodes, desc=f"evaluate {name}", unit="episode", disable=None if progress else True) as bar:
        while len(finished) < episodes:
            observation, rewards, dones, infos = venv.step(np.asarray(agent(observation), np.float32))
            observation = observation.copy()
            for worker, episode in enumerate(running):
                if episode is not None:
                    episode.book(float(rewards[worker]), infos[worker])
                if dones[worker]:
                    if episode is not None:
                        finished.append(episode)
                        bar.update()
                    begin(worker)
    return Evaluation(name, sorted(finished, key=lambda episode: episode.seed))


def zero_agent(action_size: int) -> Agent:
    """Does nothing: the commanded pose stays."""
    return lambda observation: np.zeros((len(observation), action_size), np.float32)


def random_agent(action_size: int, seed: int) -> Agent:
    """Uniformly random in the whole action space."""
    rng = np.random.default_rng(seed)
    return lambda observation: rng.uniform(-1.0, 1.0, (len(observation), action_size)).astype(np.float32)


def policy_agent(model: Any) -> Agent:
    """The mean action of a trained stable-baselines3 policy."""
    return lambda observation: model.predict(observation, deterministic=True)[0]


def separated(better: Evaluation, others: Sequence[Evaluation]) -> bool:
    """Whether the interval of ``better`` lies wholly above all others'."""
    return all(better.estimate().low > other.estimate().high for other in others)
