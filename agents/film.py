"""A video of two agents in the same episodes, side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from agents.evaluate import Agent
from agents.workers import EnvFactory, start_workers
from piavatar_envs.render import label, side_by_side, write_video


def film(path: Path, make: EnvFactory, agents: dict[str, Agent], seeds: Sequence[int], fps: float) -> Path:
    """Write a video in which both agents play the episodes ``seeds``, each in a process of its own.

    Args:
        path: ``.mp4`` or ``.gif``.
        make: makes the environments.
        agents: two of them, by the text that stands in their half.
        seeds: of the episodes.
        fps: control steps a second, so that the video runs as fast as life.

    Raises:
        ImportError: the extra ``render`` is not installed.
        ValueError: not two agents.
    """
    if len(agents) != 2:
        raise ValueError(f"{len(agents)} agents; a film shows two side by side")
    halves = start_workers(replace(make, render_mode="rgb_array"), 2)
    try:
        return write_video(path, _frames(halves, agents, seeds), fps)
    finally:
        halves.close()


def _frames(halves: VecEnv, agents: dict[str, Agent], seeds: Sequence[int]) -> Iterator[np.ndarray]:
    for seed in tqdm(seeds, desc="film", unit="episode"):
        observation = np.stack([first for first, _ in halves.env_method("reset", seed=int(seed))])
        totals, playing = np.zeros(2), np.ones(2, bool)
        shown: list[np.ndarray] = []
        while playing.any():
            pictures = halves.env_method("render")
            # a half that has ended stands still until the other one has
            shown = [pictures[i] if playing[i] else shown[i] for i in range(2)]
            texts = [f"{name}: {total:.0f}" for name, total in zip(agents, totals, strict=True)]
            yield side_by_side(*(label(picture, text) for picture, text in zip(shown, texts, strict=True)))
            action = np.stack([agent(observation[i : i + 1])[0] for i, agent in enumerate(agents.values())])
            observation, rewards, dones, _ = halves.step(action)
            totals += rewards * playing
            playing &= ~dones
