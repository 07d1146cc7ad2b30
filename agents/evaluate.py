"""The protocol by which agents are compared: the same fresh episodes for all, and 95 % intervals.

Episodes are played in rounds. A round begins with a reset of all environments and ends when the last of their episodes
has: no environment begins another one in between, so that short episodes (a fall) get no more weight than long ones,
and every episode that was begun counts once. What is counted is the return, the length, ``success_once`` and
``success_at_end`` (whether the task was fulfilled in any step, and in the last one).

An agent is anything that is called with observations ``(n, observation_size)`` and returns actions
``(n, action_size)``. One that remembers also has ``begin(n)``, which is called at the start of every round.

One training says little of an algorithm: :func:`over_seeds` sums up several, of different seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
        steps = mean_and_interval([episode.steps for episode in self.episodes])
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
            "mean_steps": steps.mean,
            "steps_interval": [steps.low, steps.high],
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
    return wilson(float(np.mean(outcomes)), len(outcomes), float(stats.norm.ppf(0.975)))


def wilson(share: float, size: float, quantile: float) -> list[float]:
    """The interval of a share whose ends differ from it by ``quantile`` of their own standard errors.

    Wilson, "Probable inference, the law of succession, and statistical inference", J. Am. Stat. Assoc. 22, 1927.

    Args:
        share: that was found, in [0, 1].
        size: of the sample; need not be whole.
        quantile: of the normal, or of Student's distribution.
    """
    if np.isinf(quantile):
        return [0.0, 1.0]
    square = quantile**2 / size
    centre = (share + square / 2.0) / (1.0 + square)
    half = np.sqrt(square * (share * (1.0 - share) + square / 4.0)) / (1.0 + square)
    return [max(0.0, float(centre - half)), min(1.0, float(centre + half))]


def share_interval_over_seeds(shares: Sequence[float], episodes: int) -> list[float]:
    """The 95 % interval of a share that trainings of several seeds have on average.

    Episodes of one training are alike, so all of them together are worth fewer: as many as would scatter as much as the
    seeds' own shares do (Wilson's interval with the effective sample size; Franco, Little, Louis & Slud, "Comparative
    study of confidence intervals for proportions in complex sample surveys", J. Survey Stat. Methodol. 7, 2019). The
    quantile is Student's, of one degree of freedom less than there are seeds.

    Args:
        shares: of every seed.
        episodes: of every seed.
    """
    seeds, mean = len(shares), float(np.mean(shares))
    size, alone = float(seeds * episodes), mean * (1.0 - mean)
    if seeds > 1 and alone > 0.0:
        size = min(size, alone / max(float(np.var(shares, ddof=1)) / seeds, 1e-12))
    return wilson(mean, size, float(stats.t.ppf(0.975, seeds - 1)) if seeds > 1 else np.inf)


def over_seeds(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One row for trainings of several seeds, with intervals over the seeds.

    Returns and lengths have Student's interval of the seeds' means, which is robust to what such distributions are like
    (Colas, Sigaud & Oudeyer, "How many random seeds?", arXiv 1806.08295), success that of
    :func:`share_interval_over_seeds`.

    Args:
        rows: of the same agent, as :meth:`Evaluation.row` gives them, one a seed.

    Raises:
        ValueError: no rows, or of different agents or numbers of episodes.
    """
    about = {(row["case"], row["episodes"]) for row in rows}
    if len(about) != 1:
        raise ValueError(f"rows of one agent and one number of episodes are needed, these have {sorted(about)}")
    (case, episodes), *_ = about
    summed: dict[str, Any] = {"case": case, "seeds": len(rows), "episodes": episodes}
    for mean, interval in (("return_mean", "return_interval"), ("mean_steps", "steps_interval")):
        estimate = mean_and_interval([row[mean] for row in rows])
        finite = np.isfinite(estimate.half_width)
        summed |= {mean: estimate.mean, interval: [estimate.low, estimate.high] if finite else None}
    for name in ("success_once", "success_at_end"):
        shares = [row[name] for row in rows]
        summed |= {name: float(np.mean(shares)), f"{name}_interval": share_interval_over_seeds(shares, episodes)}
    return summed | {"failures": sum(row["failures"] for row in rows)}


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
    played: list[Episode] = []
    with tqdm(total=episodes, desc=f"evaluate {name}", unit="episode", disable=None if progress else True) as bar:
        for first in range(first_seed, first_seed + episodes, venv.num_envs):
            # where the last round has environments to spare, they play, too, and do not count
            counted = min(venv.num_envs, first_seed + episodes - first)
            played += _play_round(agent, venv, first)[:counted]
            bar.update(counted)
    return Evaluation(name, played)


def _play_round(agent: Agent, venv: VecEnv, first_seed: int) -> list[Episode]:
    """One episode in every environment, from a reset of all of them to the end of the last."""
    episodes = [Episode(first_seed + env) for env in range(venv.num_envs)]
    playing = np.ones(venv.num_envs, bool)
    venv.seed(first_seed)
    observation = venv.reset()
    begin_round(agent, venv.num_envs)
    while playing.any():
        observation, rewards, dones, infos = venv.step(np.asarray(agent(observation), np.float32))
        for env in np.flatnonzero(playing):
            episodes[env].book(float(rewards[env]), infos[env])
        playing &= ~dones
    return episodes


def begin_round(agent: Agent, num_envs: int) -> None:
    """Tell an agent that remembers that ``num_envs`` episodes begin."""
    begin = getattr(agent, "begin", None)
    if begin is not None:
        begin(num_envs)


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


def baselines(action_size: int, seed: int) -> dict[str, Agent]:
    """What every agent is compared with: zero and random actions."""
    return {"zero": zero_agent(action_size), "random": random_agent(action_size, seed)}


def separated(better: Evaluation, others: Sequence[Evaluation]) -> bool:
    """Whether the interval of ``better`` lies wholly above all others'."""
    return all(better.estimate().low > other.estimate().high for other in others)
