"""Pictures of the pages: one moment of an episode at the default resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from scripts.pages.entries import Entry, step

PERIOD, SWING = 2.0, 0.3  # of random actions [s], [-]: with them the joints swing by up to 0.4 rad about their start
SIZE = {"width": 640, "height": 480}


def draw(entry: Entry, path: Path, device: str = "cpu", seed: int = 0) -> None:
    """Play to the moment of the task's picture, or to the end of the episode, and write a PNG.

    Raises:
        ImportError: the extra ``render`` is not installed.
    """
    from PIL import Image

    task = entry.task
    env = entry.make(render_mode="rgb_array", device=device, **{**SIZE, **task.picture_settings})
    try:
        env.reset(seed=seed)
        dt, names = env.batch.config.physics.control_dt, env.batch.action_spec.names()
        for action in actions(task.picture_actions, names, task.picture_seconds, dt, seed):
            _, _, terminated, truncated, _ = step(env, action)
            if np.any(_values(terminated)) or np.any(_values(truncated)):
                break
        picture = env.render()
    finally:
        env.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, optimize=True)


def actions(kind: str | Mapping[str, float], names: Sequence[str], seconds: float, dt: float, seed: int) -> np.ndarray:
    """Return the actions until the picture, shape ``(steps, len(names))``: zero, random swings, or constant.

    Raises:
        ValueError: an unknown kind or component.
    """
    steps = round(seconds / dt)
    rows = np.zeros((steps, len(names)), np.float32)
    if isinstance(kind, Mapping):
        for name, value in kind.items():
            if name not in names:
                raise ValueError(f"picture_actions: there is no component {name!r}; there are {', '.join(names)}")
            rows[:, names.index(name)] = value
    elif kind == "random":
        rng = np.random.default_rng(seed)
        amplitude, phase = rng.uniform(-SWING, SWING, len(names)), rng.uniform(0.0, 2.0 * np.pi, len(names))
        time = dt * np.arange(steps)[:, None]
        rows[:] = amplitude * np.cos(2.0 * np.pi * time / PERIOD + phase)
    elif kind != "zero":
        raise ValueError(f"picture_actions={kind!r}; use 'zero', 'random' or a mapping of components to numbers")
    return rows


def _values(flags: bool | Mapping[str, bool]) -> list[bool]:
    return list(flags.values()) if isinstance(flags, Mapping) else [flags]
