"""A rollout of any registered environment: return, metrics and, if asked, a video."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from tqdm import tqdm

import piavatar_envs  # noqa: F401 - registers the ids
from piavatar_envs.render.video import SUFFIXES, write_video


@dataclass
class Rollout:
    """What a rollout came to.

    Attributes:
        steps: steps played.
        returns: undiscounted return of each episode that was begun, in order; the last may be cut short.
        failures: what ended episodes that failed, in order.
        metrics: the numbers of the last step's ``info``, by dotted name.
    """

    steps: int = 0
    returns: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    metrics: dict[str, float] = field(default_factory=dict)


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

    Args:
        env_id: a registered id.
        agent: "random" (uniform in the action space) or "zero".
        video: the .mp4 or .gif to write, or None.
        steps: number of steps.
        seed: of the first reset and of the random actions; later episodes go on from it.
        device: a Warp device.
        color: "skin" or "strain", for the video.
        overrides: settings of the environment's configuration.

    Raises:
        ValueError: an unknown agent, a number of steps below 1, an unknown suffix, a setting out of range.
    """
    if agent not in ("random", "zero"):
        raise ValueError(f"no agent {agent!r}; there are random and zero")
    if steps is not None and steps < 1:
        raise ValueError(f"steps={steps} must be >= 1")
    if video is not None and video.suffix not in SUFFIXES:  # before the kernels are compiled, not after the rollout
        raise ValueError(f"video {video} ends in {video.suffix!r}; use {' or '.join(SUFFIXES)}")
    settings = {"device": device, **(overrides or {})}
    if video is not None:
        settings = {"render_mode": "rgb_array", "color": color, **settings}
    env = gymnasium.make(env_id, **settings)
    rollout = Rollout()
    try:
        frames = _frames(env, agent, steps, seed, rollout)
        if video is None:
            deque(frames, maxlen=0)
        else:
            write_video(video, frames, env.metadata["render_fps"])
    finally:
        env.close()
    return rollout


def _frames(env: gymnasium.Env, agent: str, steps: int | None, seed: int, rollout: Rollout) -> Iterator[Any]:
    """Play, book into ``rollout``, and yield a picture of each state (None without a render mode)."""
    env.action_space.seed(seed)
    still = np.zeros(env.action_space.shape, dtype=env.action_space.dtype)
    finished = True
    with tqdm(total=steps, desc=env.spec.id, unit="step", disable=None) as bar:
        while steps is None or rollout.steps < steps:
            if finished:
                env.reset(seed=seed if rollout.steps == 0 else None)
                rollout.returns.append(0.0)
                yield env.render() if env.render_mode else None
            _, reward, terminated, truncated, info = env.step(env.action_space.sample() if agent == "random" else still)
            rollout.steps += 1
            rollout.returns[-1] += float(reward)
            rollout.metrics = numbers(info)
            if info.get("failure"):
                rollout.failures.append(str(info["failure"]))
            yield env.render() if env.render_mode else None
            bar.update()
            finished = terminated or truncated
            if finished and steps is None:
                break


def numbers(info: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """The finite scalars of a nested ``info``, by dotted name; vectors and text are left out."""
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
    """Print a rollout's return and metrics."""
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
