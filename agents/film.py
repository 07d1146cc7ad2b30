"""A video of one agent, or of two in the same episodes side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from agents.evaluate import Agent, begin_round
from agents.folders import check_writable
from agents.workers import EnvFactory, start_workers
from piavatar_envs.config import ConfigError
from piavatar_envs.render import label, side_by_side, write_video
from piavatar_envs.render.video import check_suffix


def film(
    path: Path, make: EnvFactory, agents: dict[str, Agent], seeds: Sequence[int], fps: float, every: int = 1
) -> Path:
    """Write a video in which all agents play the episodes ``seeds``; two have a process each.

    Args:
        path: ``.mp4`` or ``.gif``.
        make: makes the environments.
        agents: one or two of them, by the text that stands in their half.
        seeds: of the episodes.
        fps: control steps a second, so that the video runs as fast as life.
        every: control steps between two pictures.

    Raises:
        ImportError: the extra ``render`` is not installed.
        ValueError: no agents, or more than two.
    """
    if len(agents) not in (1, 2):
        raise ValueError(f"{len(agents)} agents; a film shows one, or two side by side")
    halves = start_workers(replace(make, render_mode="rgb_array"), len(agents))
    try:
        return write_video(path, _frames(halves, agents, seeds, every), fps / every)
    finally:
        halves.close()


def check_film(path: Path | None, every: int, episodes: int = 1) -> None:
    """Refuse a video without pictures, or that cannot be written, before there is anything to film.

    Raises:
        ConfigError: ``every`` or ``episodes`` is less than 1, or nothing can be written there.
        ValueError: an unknown suffix.
    """
    for name, value in (("film_every", every), ("film_episodes", episodes)):
        if value < 1:
            raise ConfigError(f"{name}={value} must be >= 1")
    if path is not None:
        check_suffix(path)
        check_writable(path)


def _frames(halves: VecEnv, agents: dict[str, Agent], seeds: Sequence[int], every: int) -> Iterator[np.ndarray]:
    for seed in tqdm(seeds, desc="film", unit="episode"):
        for agent in agents.values():
            begin_round(agent, 1)
        observation = np.stack([first for first, _ in halves.env_method("reset", seed=int(seed))])
        totals, playing = np.zeros(len(agents)), np.ones(len(agents), bool)
        shown: list[np.ndarray] = []
        for step in count():
            if step % every == 0:
                pictures = halves.env_method("render")
                # a half that has ended stands still until the other one has
                shown = [pictures[i] if playing[i] else shown[i] for i in range(len(agents))]
                texts = [f"{name}: {total:.0f}" for name, total in zip(agents, totals, strict=True)]
                labelled = [label(picture, text) for picture, text in zip(shown, texts, strict=True)]
                yield side_by_side(*labelled) if len(agents) == 2 else labelled[0]
            action = np.stack([agent(observation[i : i + 1])[0] for i, agent in enumerate(agents.values())])
            observation, rewards, dones, _ = halves.step(action)
            totals += rewards * playing
            playing &= ~dones
            if not playing.any():
                break
