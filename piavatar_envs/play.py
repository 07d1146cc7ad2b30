"""Rollout of any environment, of one agent or several: return, metrics and an optional video."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from tqdm import tqdm

import piavatar_envs  # noqa: F401 - registers the ids
from piavatar_envs.core.rng import check_seeds
from piavatar_envs.core.writing import check_writable
from piavatar_envs.mpm.types import failure_name
from piavatar_envs.multi import load_game
from piavatar_envs.render.video import check_suffix, write_video
from piavatar_envs.tasks import listed_name, task_modules

if TYPE_CHECKING:
    from piavatar_envs.api.pettingzoo import AvatarParallelEnv


@dataclass
class Rollout:
    """Result of a rollout.

    Attributes:
        steps: steps played.
        returns: undiscounted return of each episode that began, in order; the last may be incomplete.
        failures: causes of the episodes that failed, in order.
        metrics: the numbers of the last step's ``info``, by dotted name.
        interrupted: whether Ctrl-C ended it.
    """

    steps: int = 0
    returns: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    metrics: dict[str, float] = field(default_factory=dict)
    interrupted: bool = False


def play(
    env_id: str,
    agent: str = "random",
    video: Path | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    color: str = "skin",
    overrides: Mapping[str, Any] | None = None,
) -> Rollout:
    """Play ``env_id`` for some steps, beginning a new episode whenever one ends; without ``steps``, one episode.

    Ctrl-C ends it early, with a video of what was played.

    Args:
        env_id: a registered id, or a module of several agents such as ``sumo_v0``, with or without its package.
        agent: "random" (uniform in the action space) or "zero".
        video: the .mp4 or .gif to write, or None.
        steps: number of steps.
        seed: of the first reset and of the random actions; later episodes go on from it.
        device: a Warp device.
        color: "skin" or "strain", for the video.
        overrides: settings of the environment's configuration.

    Raises:
        ValueError: an unknown module, agent or suffix, a video that cannot be written, a number of steps below 1, a
            seed or a setting out of range.
    """
    check_agent(agent, seed)
    check_steps(steps)
    if video is not None:  # before the kernels are compiled
        check_suffix(video)
        check_writable(video)
    settings = settings_of(device, overrides)
    if video is not None:
        settings = {"render_mode": "rgb_array", "color": color, **settings}
    env = make(env_id, settings)
    rollout = Rollout()
    try:
        pictures = frames(env, agent, steps, seed, rollout)
        if video is None:
            deque(pictures, maxlen=0)
        else:
            write_video(video, pictures, env.metadata["render_fps"])
    finally:
        env.close()
    return rollout


def check_agent(agent: str, seed: int) -> None:
    """Refuse an unknown agent, and a seed out of range.

    Raises:
        ValueError: it is neither random nor zero, or the seed is outside [0, 2^32).
    """
    if agent not in ("random", "zero"):
        raise ValueError(f"no agent {agent!r}; there are random and zero")
    check_seeds(seed)


def check_steps(steps: int | None) -> None:
    """Refuse a number of steps below 1; None stands for one episode.

    Raises:
        ValueError: it is below 1.
    """
    if steps is not None and steps < 1:
        raise ValueError(f"steps={steps} must be >= 1")


def settings_of(device: str, overrides: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the arguments that an environment is made with.

    Raises:
        ValueError: the overrides set the render mode.
    """
    if "render_mode" in (overrides or {}):
        raise ValueError("render_mode is not a setting here; use play --video FILE for a film, watch for the live view")
    return {"device": device, **(overrides or {})}


def make(env_id: str, settings: Mapping[str, Any]) -> gymnasium.Env | JointEnv:
    """Make the environment of a registered id, or of a module of several agents.

    Raises:
        ImportError: an extra is not installed.
        ValueError: an unknown module, a setting out of range.
    """
    name = listed_name(env_id)
    return gymnasium.make(name, **settings) if "/" in name else JointEnv(name, settings)


class JointEnv:
    """Several agents played as one: rewards are summed, actions have a row for each agent."""

    def __init__(self, name: str, settings: Mapping[str, Any]) -> None:
        """Build the module ``name`` of :mod:`piavatar_envs.multi`.

        Raises:
            ValueError: there is no such module.
            ImportError: PettingZoo is not installed.
        """
        self.env = load_game(name, task_modules()).parallel_env(**settings)
        self.name, self.metadata, self.render_mode = name, self.env.metadata, self.env.render_mode
        first = self.env.action_space(self.env.possible_agents[0])
        self.action_space = gymnasium.vector.utils.batch_space(first, len(self.env.possible_agents))

    @property
    def unwrapped(self) -> AvatarParallelEnv:
        """The environment of the module."""
        return self.env

    def reset(self, seed: int | None = None) -> tuple[None, dict[str, Any]]:
        """Begin an episode; ``info`` is by agent."""
        return None, self.env.reset(seed=seed)[1]

    def step(self, actions: np.ndarray) -> tuple[None, float, bool, bool, dict[str, Any]]:
        """Advance the agents that are still in; ``info`` is by agent."""
        index = {name: row for row, name in enumerate(self.env.possible_agents)}
        chosen = {name: actions[index[name]] for name in self.env.agents}
        _, rewards, _, truncations, infos = self.env.step(chosen)
        failures = [info["failure"] for info in infos.values() if info.get("failure")]
        info = {**infos, "failure": failures[0] if failures else 0}
        over = not self.env.agents
        return None, sum(rewards.values()), over and not any(truncations.values()), over, info

    def render(self) -> np.ndarray | None:
        """Draw the scene."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def frames(env: gymnasium.Env | JointEnv, agent: str, steps: int | None, seed: int, rollout: Rollout) -> Iterator[Any]:
    """Play, add to ``rollout``, and yield a picture of each state (None without a render mode)."""
    env.action_space.seed(seed)
    still = np.zeros(env.action_space.shape, dtype=env.action_space.dtype)
    finished = True
    name = env.name if isinstance(env, JointEnv) else env.spec.id
    try:
        with tqdm(total=steps, desc=name, unit="step", disable=None) as bar:
            while steps is None or rollout.steps < steps:
                if finished:
                    env.reset(seed=seed if rollout.steps == 0 else None)
                    rollout.returns.append(0.0)
                    yield env.render() if env.render_mode else None
                _, reward, terminated, truncated, info = env.step(
                    env.action_space.sample() if agent == "random" else still
                )
                rollout.steps += 1
                rollout.returns[-1] += float(reward)
                rollout.metrics = numbers(info)
                if info.get("failure"):
                    rollout.failures.append(failure_name(info["failure"]))
                yield env.render() if env.render_mode else None
                bar.update()
                finished = terminated or truncated
                if finished and steps is None:
                    break
    except KeyboardInterrupt:
        rollout.interrupted = True


def numbers(info: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Return the scalars of a nested ``info``, by dotted name; vectors and text are left out."""
    found: dict[str, float] = {}
    for key, value in info.items():
        if isinstance(value, Mapping):
            found |= numbers(value, f"{prefix}{key}.")
        elif isinstance(value, (bool, int, float, np.generic)) or (isinstance(value, np.ndarray) and value.ndim == 0):
            scalar = np.asarray(value)
            if np.issubdtype(scalar.dtype, np.number) or scalar.dtype == bool:
                found[f"{prefix}{key}"] = float(scalar)
    return found


def show(rollout: Rollout, video: Path | None = None) -> None:
    """Print a rollout's return and metrics; of an interrupted one, a line.

    Raises:
        KeyboardInterrupt: it was interrupted; what it has reached.
    """
    if rollout.interrupted:
        kept = "" if video is None or not rollout.steps else f", filmed in {video}"
        raise KeyboardInterrupt(f"after {rollout.steps} steps{kept}")
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_row("steps", str(rollout.steps))
    table.add_row("episodes", str(len(rollout.returns)))
    table.add_row("return", ", ".join(f"{value:.3f}" for value in rollout.returns))
    if rollout.failures:
        table.add_row("failures", ", ".join(rollout.failures))
    for name, value in rollout.metrics.items():
        table.add_row(name, f"{value:.4g}")
    if video is not None:
        table.add_row("video", str(video))
    Console(highlight=False, soft_wrap=True, markup=False).print(table)
