"""The protocol by which agents are compared: the same fresh episodes for all, and 95 % intervals.

Episodes are played in rounds. A round begins with a reset of all environments and ends when the last of their episodes
has: no environment begins another one in between, so that short episodes (a fall) get no more weight than long ones,
and every episode that was begun counts once. What is counted is the return, the length, ``success_once`` and
``success_at_end`` (whether the task was fulfilled in any step, and in the last one).

An agent is anything that is called with observations ``(n, observation_size)`` and returns actions
``(n, action_size)``. One that remembers also has ``begin(n)``, which is called at the start of every round.

Results of one training run vary with its seed: :func:`over_seeds` sums up several seeds.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from agents.intervals import (
    NORMAL,
    Estimate,
    mean_and_interval,
    mean_over_seeds,
    share_interval,
    share_interval_over_seeds,
    wilson,
)
from piavatar_envs.api.host import EpisodeHost

#: An observation: an array, or a mapping of ``"state"`` to it and of pictures by their names.
Seen = np.ndarray | Mapping[str, np.ndarray]
Agent = Callable[[Seen], np.ndarray]
#: Width of a class of pushes [N s].
PUSH_CLASS = 5.0
#: Metrics of TrackMotion, their names in rows, and factors to the units of Luo et al., "Perpetual humanoid control for
#: real-time simulated avatars", 2023, which measures an imitation by them and by the share that is not given up.
TRACKING = {
    "mpjpe": ("g_mpjpe_mm", 1000.0),
    "local_mpjpe": ("mpjpe_mm", 1000.0),
    "acceleration_error": ("acceleration_error_mm", 1.0),
}
#: Metrics of tasks that evaluations read.
EVALUATED_METRICS = ("distance", "strongest_push", "motion", *TRACKING)
#: Seconds between two updates of the bar in a log.
_LOG_SECONDS = 30.0


@dataclass
class Episode:
    """One episode of an evaluation.

    Attributes:
        seed: of the episode.
        total: undiscounted return.
        steps: its length.
        successes: steps in which the task was fulfilled.
        success_at_end: whether it was in the last step.
        terminated: whether it ended before its time, as by a fall.
        distance: mean over the steps of the task's ``distance`` [m], where it has one.
        push: greatest impulse of a push [N s], where the task pushes, or None.
        tracking: means over the steps of the metrics in :data:`TRACKING`, where the task has them.
        motion: index of the motion that it followed, where the task draws one, or None.
        failure: whether the simulation has failed.
        agent_totals: undiscounted return of every agent of a world, shape ``(agents,)``; None where there is one.
        agent_success: whether each had fulfilled its task in its last step, shape ``(agents,)``, or None.
    """

    seed: int
    total: float = 0.0
    steps: int = 0
    successes: int = 0
    success_at_end: bool = False
    terminated: bool = False
    distance: float = 0.0
    push: float | None = None
    tracking: dict[str, float] = field(default_factory=dict)
    motion: int | None = None
    failure: bool = False
    agent_totals: np.ndarray | None = None
    agent_success: np.ndarray | None = None

    def book(self, reward: float, info: dict[str, Any], terminated: bool = False) -> None:
        """Add a step."""
        self.terminated = terminated
        self.total += reward
        self.steps += 1
        self.success_at_end = bool(info.get("success", False))
        self.successes += self.success_at_end
        self.distance += (float(info.get("distance", np.nan)) - self.distance) / self.steps
        self.push = info.get("strongest_push")
        if "motion" in info:
            self.motion = int(info["motion"])
        for name in TRACKING.keys() & info.keys():
            mean = self.tracking.get(name, 0.0)
            self.tracking[name] = mean + (float(info[name]) - mean) / self.steps
        self.failure = bool(info.get("failure"))
        if "rewards" in info:
            self.agent_totals = info["rewards"] + (0.0 if self.agent_totals is None else self.agent_totals)
            self.agent_success = info["successes"]


@dataclass
class Evaluation:
    """An agent's episodes, by seed.

    Attributes:
        agent: its name.
        episodes: that it has played.
        motions: names of the motions of which each episode follows one, where there are any.
    """

    agent: str
    episodes: list[Episode] = field(default_factory=list)
    motions: tuple[str, ...] = ()

    @property
    def returns(self) -> np.ndarray:
        """Return the return of every episode, shape ``(episodes,)``."""
        return np.array([episode.total for episode in self.episodes])

    def estimate(self) -> Estimate:
        """Return the mean return and its 95 % interval over episodes."""
        return mean_and_interval(self.returns)

    def share(self, what: Callable[[Episode], float]) -> float:
        """Return the mean of ``what`` over the episodes."""
        return float(np.mean([what(episode) for episode in self.episodes]))

    def row(self) -> dict[str, Any]:
        """Return the figures for a table or a JSON file."""
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
            "failures": sum(episode.failure for episode in self.episodes),
            "episodes": len(self.episodes),
            "first_seed": self.episodes[0].seed,
        }
        if self.episodes[0].push is not None:
            row["by_push"] = by_push(self.episodes)
        if self.episodes[0].tracking:
            row |= tracking_of(self.episodes)
        if len(self.motions) > 1:
            row["by_motion"] = by_motion(self.episodes, self.motions)
        if self.episodes[0].agent_totals is not None:
            of_agents = [mean_and_interval(totals) for totals in np.transpose([e.agent_totals for e in self.episodes])]
            row["agent_return_mean"] = [one.mean for one in of_agents]
            row["agent_return_interval"] = [[one.low, one.high] for one in of_agents]
        return row


def tracking_of(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Return the share of episodes that were followed to the end, and means of the figures in :data:`TRACKING`."""
    kept = [not episode.terminated for episode in episodes]
    figures = {
        key: factor * float(np.mean([episode.tracking[name] for episode in episodes]))
        for name, (key, factor) in TRACKING.items()
    }
    return {"followed": float(np.mean(kept)), "followed_interval": share_interval(kept), **figures}


def by_motion(episodes: Sequence[Episode], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return the figures of :func:`tracking_of` by motion, the least followed first; one without episodes is left out.

    Args:
        episodes: of a task with several motions.
        names: of all its motions.
    """
    groups: dict[int, list[Episode]] = {}
    for episode in episodes:
        groups.setdefault(episode.motion, []).append(episode)
    rows = [
        {"motion": names[motion], "episodes": len(own), **tracking_of(own)} for motion, own in sorted(groups.items())
    ]
    return _least_followed_first(rows)


def _least_followed_first(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(rows, key=lambda row: (row["followed"], -row["g_mpjpe_mm"]))


def by_push(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Count the episodes that lasted, by the greatest impulse of a push in them.

    A push that fells a body counts with what it has given until then. Classes are :data:`PUSH_CLASS` wide; empty ones
    are left out.
    """
    classes: dict[int, list[bool]] = {}
    for episode in episodes:
        classes.setdefault(int(episode.push // PUSH_CLASS), []).append(not episode.terminated)
    return [
        _push_row((PUSH_CLASS * place, PUSH_CLASS * (place + 1)), lasted, 1)
        for place, lasted in sorted(classes.items())
    ]


def _push_row(bounds: tuple[float, float], lasted: Sequence[bool], seeds: int) -> dict[str, Any]:
    share = float(np.mean(lasted))
    return {
        "impulse_n_s": list(bounds),
        "episodes": len(lasted),
        "lasted": share,
        "lasted_interval": wilson(share, len(lasted) / seeds, NORMAL),
    }


def over_seeds(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sum up rows of several seeds in one, with intervals over seeds and episodes.

    Returns and lengths have that of :func:`mean_over_seeds`, success that of :func:`share_interval_over_seeds`.
    (Student's intervals are robust to what such distributions are like: Colas, Sigaud & Oudeyer, "How many random
    seeds?", arXiv 1806.08295.)

    Args:
        rows: of the same agent in the same episodes, as :meth:`Evaluation.row` gives them, one per seed.

    Raises:
        ValueError: no rows, or of different agents or numbers of episodes.
    """
    about = {(row["case"], row["episodes"]) for row in rows}
    if len(about) != 1:
        raise ValueError(f"rows of one agent and one number of episodes are needed, these have {sorted(about)}")
    (case, episodes), *_ = about
    summed: dict[str, Any] = {"case": case, "seeds": len(rows), "episodes": episodes}
    for mean, interval in (("return_mean", "return_interval"), ("mean_steps", "steps_interval")):
        halves = [(row[interval][1] - row[interval][0]) / 2.0 for row in rows]
        estimate = mean_over_seeds([row[mean] for row in rows], halves, episodes)
        finite = np.isfinite(estimate.half_width)
        summed |= {mean: estimate.mean, interval: [estimate.low, estimate.high] if finite else None}
    for name in ("success_once", "success_at_end"):
        shares = [row[name] for row in rows]
        summed |= {name: float(np.mean(shares)), f"{name}_interval": share_interval_over_seeds(shares, episodes)}
    if all("followed" in row for row in rows):
        summed |= _tracking_over_seeds(rows, episodes)
    if all("by_motion" in row for row in rows):
        summed["by_motion"] = _motions_over_seeds([row["by_motion"] for row in rows])
    if "by_push" in rows[0]:
        summed["by_push"] = _pooled([push for row in rows for push in row["by_push"]], len(rows))
    return summed | {"failures": sum(row["failures"] for row in rows)}


def _motions_over_seeds(tables: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Average rows of :func:`by_motion` of several training runs in the same episodes."""
    of_motion: dict[str, list[Mapping[str, Any]]] = {}
    for row in (row for table in tables for row in table):
        of_motion.setdefault(row["motion"], []).append(row)
    averaged = [
        {"motion": name, "episodes": rows[0]["episodes"], **_tracking_over_seeds(rows, rows[0]["episodes"])}
        for name, rows in of_motion.items()
    ]
    return _least_followed_first(averaged)


def _tracking_over_seeds(rows: Sequence[Mapping[str, Any]], episodes: int) -> dict[str, Any]:
    """Average figures of :func:`tracking_of` of several training runs in the same ``episodes``."""
    shares = [row["followed"] for row in rows]
    figures = {key: float(np.mean([row[key] for row in rows])) for key, _ in TRACKING.values()}
    interval = share_interval_over_seeds(shares, episodes)
    return {"followed": float(np.mean(shares)), "followed_interval": interval, **figures}


def _pooled(pushes: Sequence[Mapping[str, Any]], seeds: int) -> list[dict[str, Any]]:
    """Pool classes of pushes of several training runs in the same episodes; intervals are those of one run."""
    classes: dict[tuple[float, float], list[bool]] = {}
    for push in pushes:
        lasted = round(push["lasted"] * push["episodes"])
        own = [True] * lasted + [False] * (push["episodes"] - lasted)
        classes.setdefault(tuple(push["impulse_n_s"]), []).extend(own)
    return [_push_row(bounds, lasted, seeds) for bounds, lasted in sorted(classes.items())]


def evaluate(
    name: str,
    agent: Agent,
    venv: VecEnv,
    episodes: int,
    first_seed: int,
    progress: bool = True,
    motions: tuple[str, ...] = (),
) -> Evaluation:
    """Play episodes ``first_seed``, ``first_seed + 1``, ... to their ends.

    Every episode has a seed of its own, so what an agent does that draws nothing does not depend on the number of
    workers. (Random actions come from one stream for all.)

    Args:
        name: the agent's, for tables.
        agent: from observations to actions.
        venv: workers; whatever they were playing is given up.
        episodes: how many episodes.
        first_seed: of the first.
        progress: whether to show a bar.
        motions: names of the task's motions, if it has any.
    """
    played: list[Episode] = []
    with episode_bar(name, episodes, disable=None if progress else True) as bar:
        for first in range(first_seed, first_seed + episodes, venv.num_envs):
            # where the last round has environments to spare, they play, too, and do not count
            counted = min(venv.num_envs, first_seed + episodes - first)
            played += _play_round(agent, venv, first)[:counted]
            bar.update(counted)
    return Evaluation(name, played, motions)


def episode_bar(name: str, episodes: int, **how: Any) -> tqdm:
    """Return a progress bar of an agent's finished episodes, on stderr; ``how`` is passed to tqdm."""
    return tqdm(total=episodes, desc=f"evaluate {name}", unit="episode", **how)


def _play_round(agent: Agent, venv: VecEnv, first_seed: int) -> list[Episode]:
    """Play one episode in every environment, from a reset of all to the end of the last."""
    episodes = [Episode(first_seed + env) for env in range(venv.num_envs)]
    playing = np.ones(venv.num_envs, bool)
    venv.seed(first_seed)
    observation = venv.reset()
    begin_round(agent, venv.num_envs)
    while playing.any():
        observation, rewards, dones, infos = venv.step(np.asarray(agent(observation), np.float32))
        for env in np.flatnonzero(playing):
            ended = bool(dones[env]) and not infos[env].get("TimeLimit.truncated", False)
            episodes[env].book(float(rewards[env]), infos[env], ended)
        playing &= ~dones
    return episodes


def play(name: str, agent: Agent, batch: EpisodeHost, first_seed: int) -> Evaluation:
    """Play one episode in every environment of a batch, to their ends.

    Args:
        name: the agent's, for tables.
        agent: from observations ``(num_envs, num_agents, size)`` to actions ``(num_envs, num_agents, action_size)``;
            where pictures are observed, from a mapping of ``"state"`` to these and of pictures by their names.
        batch: of NumPy arrays; whatever it was playing is given up.
        first_seed: environment ``i`` plays the episode of ``first_seed + i``.
    """
    episodes = [Episode(first_seed + env) for env in range(batch.num_envs)]
    batch.reset([episode.seed for episode in episodes])
    places = {
        name: batch.task.metric_names.index(name) for name in EVALUATED_METRICS if name in batch.task.metric_names
    }
    success = np.zeros((batch.num_envs, batch.num_agents), bool)
    playing = np.ones(batch.num_envs, bool)
    begin_round(agent, batch.num_envs)
    seconds = 0.1 if sys.stderr.isatty() else _LOG_SECONDS
    with episode_bar(name, batch.num_envs, mininterval=seconds, dynamic_ncols=True) as bar:
        while playing.any():
            acted = batch.alive()
            batch.step(agent(seen_by(batch)))
            # that of an agent that is out is what it was in its last step
            success = np.where(acted, batch.read(lambda group: group.success), success)
            metrics = batch.read(lambda group: group.metrics)
            rewards, failures = batch.reward(), batch.read(lambda group: group.failure)
            over = batch.read(lambda group: group.terminated).all(axis=1)
            for env in np.flatnonzero(playing):
                info: dict[str, Any] = {"success": success[env].all(), "failure": int(failures[env])}
                info |= {name: float(metrics[env, acted[env], place].mean()) for name, place in places.items()}
                if batch.num_agents > 1:
                    info |= {"rewards": rewards[env].astype(np.float64), "successes": success[env].copy()}
                episodes[env].book(float(rewards[env].mean()), info, bool(over[env]))
            ended = playing & batch.find_ended()
            playing &= ~ended
            # all go on at once, and often end at once
            bar.set_postfix(longest=max(episode.steps for episode in episodes), refresh=False)
            bar.update(int(ended.sum()))
    return Evaluation(name, episodes, batch.task.motion_names)


def seen_by(batch: EpisodeHost) -> Seen:
    """Return the present observations of a batch, as :func:`play` gives them to agents."""
    pictures = batch.observed_pictures(0)  # no learner here has both pictures and several agents
    flat = batch.observation()
    return {"state": flat, **{name: values[:, None] for name, values in pictures.items()}} if pictures else flat


def each_array(function: Callable[..., np.ndarray], *observations: Seen) -> Seen:
    """Apply a function to the arrays of observations, those of mappings by name."""
    if isinstance(observations[0], Mapping):
        return {name: function(*(own[name] for own in observations)) for name in observations[0]}
    return function(*observations)


def play_with_baselines(name: str, agent: Agent, batch: EpisodeHost, first_seed: int) -> list[Evaluation]:
    """Play zero actions, random actions and the agent in the same episodes; arguments as for :func:`play`."""
    players = {other: for_all_seats(player) for other, player in baselines(batch.action_size, first_seed).items()}
    return [play(player, act, batch, first_seed) for player, act in {**players, name: agent}.items()]


def for_all_seats(agent: Agent) -> Agent:
    """Turn an agent for observations ``(n, size)`` into one that :func:`play` takes."""

    def act(observation: Seen) -> np.ndarray:
        observation = observation["state"] if isinstance(observation, Mapping) else observation
        envs, agents = observation.shape[:2]
        return agent(observation.reshape(envs * agents, -1)).reshape(envs, agents, -1)

    return act


def begin_round(agent: Agent, num_envs: int) -> None:
    """Notify an agent with memory that ``num_envs`` episodes begin."""
    begin = getattr(agent, "begin", None)
    if begin is not None:
        begin(num_envs)


def zero_agent(action_size: int) -> Agent:
    """Return an agent of zero actions, which keeps the commanded pose."""
    return lambda observation: np.zeros((len(observation), action_size), np.float32)


def random_agent(action_size: int, seed: int) -> Agent:
    """Return an agent of uniformly random actions in the whole action space."""
    rng = np.random.default_rng(seed)
    return lambda observation: rng.uniform(-1.0, 1.0, (len(observation), action_size)).astype(np.float32)


def baselines(action_size: int, seed: int) -> dict[str, Agent]:
    """Return the agents that every other one is compared with: zero and random actions."""
    return {"zero": zero_agent(action_size), "random": random_agent(action_size, seed)}


def separated(better: Evaluation, others: Sequence[Evaluation]) -> bool:
    """Return whether the interval of ``better`` lies wholly above all others'."""
    return all(better.estimate().low > other.estimate().high for other in others)
