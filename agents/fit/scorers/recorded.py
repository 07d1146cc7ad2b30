"""Distance from a recorded motion as a judge: identification of a system from what was observed, without gradients."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel, Field

from agents.fit.recordings import MARKERS, read_recording
from piavatar_envs.config import FROZEN, ConfigError

if TYPE_CHECKING:
    from agents.fit.rollout import Episode, World


class Config(BaseModel):
    """Settings of the scorer."""

    model_config = FROZEN

    path: Path = Field(..., strict=False, description="recording, .npz; see docs/fit.md for its arrays")
    arrays: tuple[str, ...] = Field((), description="arrays that are compared, by name; empty for all of the file")
    start: float = Field(0.0, ge=0.0, description="time from which they are compared [s]")
    end: float | None = Field(None, gt=0.0, description="time up to which they are compared; null for all of it [s]")


def at_times(values: np.ndarray, dt: float, time: np.ndarray) -> np.ndarray:
    """Interpolate positions of control steps linearly; after the last one they stay.

    Args:
        values: shape ``(steps + 1, ...)``.
        dt: time of a control step [s].
        time: shape ``(times,)`` [s].
    """
    place = np.clip(time / dt, 0.0, len(values) - 1)
    below = np.minimum(place.astype(int), max(len(values) - 2, 0))
    above = np.minimum(below + 1, len(values) - 1)
    share = (place - below).reshape(-1, *(1,) * (values.ndim - 1))
    return (1.0 - share) * values[below] + share * values[above]


class RecordedScorer:
    """Mean distance of an episode from a recording [m]: over times and points, then over arrays."""

    Config = Config
    direction = "minimize"
    unit = "m"
    pictures = 0

    def __init__(self, config: Config) -> None:
        """Read the recording.

        Raises:
            ConfigError: it cannot be read, or has none of the arrays.
        """
        self.config, self.recording = config, read_recording(config.path)
        missing = [name for name in config.arrays if name not in self.recording.positions]
        if missing:
            known = ", ".join(self.recording.positions)
            raise ConfigError(f"scorers.recorded.arrays: {config.path} has no {missing[0]}; it has {known}")
        self.names = config.arrays or tuple(self.recording.positions)
        self.readings = self.recording.readings

    def connect(self, world: World) -> None:
        """Choose the entries that are compared.

        Raises:
            ConfigError: the recording is longer than an episode, or has nothing in the chosen time.
        """
        self.dt, seconds = world.config.physics.control_dt, world.config.episode_seconds
        count = len(self.recording.positions[self.names[0]])
        time = self.recording.time if self.recording.time is not None else self.dt * np.arange(count)
        end = self.config.end if self.config.end is not None else time[-1]
        self.kept = np.flatnonzero((time >= self.config.start) & (time <= end + 1e-9))
        if not len(self.kept):
            raise ConfigError(
                f"scorers.recorded: nothing is recorded from start={self.config.start:g} to end={end:g} s"
            )
        self.time = time[self.kept]
        if self.time[-1] > seconds + 0.5 * self.dt:
            raise ConfigError(
                f"scorers.recorded: {self.config.path} lasts {self.time[-1]:g} s and env.episode_seconds={seconds:g}; "
                "make episodes as long, or set scorers.recorded.end"
            )

    def score(self, episode: Episode) -> float:
        """Return the mean distance [m].

        Raises:
            ConfigError: the recording has other numbers of points than the world.
        """
        return float(np.mean([np.nanmean(np.linalg.norm(part, axis=-1)) for part in self._differences(episode)]))

    def residuals(self, episode: Episode) -> np.ndarray:
        """Return the differences from the recording, each array with the same weight, shape ``(K,)`` float32 [m].

        Raises:
            ConfigError: as :meth:`score`.
        """
        parts = self._differences(episode)
        weighted = [np.nan_to_num(part).ravel() / np.sqrt(np.isfinite(part).sum()) for part in parts]
        return np.concatenate(weighted).astype(np.float32)

    def _differences(self, episode: Episode) -> list[np.ndarray]:
        """Return the differences of each array, shape ``(times, points, 3)``; NaN where not seen [m]."""
        found = []
        for name in self.names:
            recorded = self.recording.positions[name]
            played = self._markers(episode) if name == MARKERS else episode.readings[name]
            if played.shape[1] != recorded.shape[1]:
                raise ConfigError(
                    f"{self.config.path}: {name} has {recorded.shape[1]} points and the environment {played.shape[1]}"
                )
            found.append(at_times(played, self.dt, self.time) - recorded[self.kept])
        return found

    def _markers(self, episode: Episode) -> np.ndarray:
        """Return the positions of the markers in every step, shape ``(steps + 1, markers, 3)`` [m].

        Raises:
            ConfigError: a marker follows a particle that there is not.
        """
        x, followed = episode.readings["particle_position"], self.recording.marker_particle
        if followed is not None:
            if not ((followed >= 0) & (followed < x.shape[1])).all():
                raise ConfigError(f"{self.config.path}: marker_particle must be in [0, {x.shape[1]}), as particles are")
            return x[:, followed]
        first = self.recording.positions[MARKERS][0]
        nearest = np.argmin(np.linalg.norm(first[:, None] - x[0], axis=-1), axis=1)
        return x[:, nearest] + (first - x[0, nearest])


SCORER = RecordedScorer
