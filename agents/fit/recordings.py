"""Recordings of positions over time, ``.npz``: bones, props, particles, markers, or states of an environment.

A recording has arrays ``(times, points, 3)`` [m] by the names in :data:`POSITIONS`, markers as ``marker_position``, and
the ``time`` [s] of each entry since the reset. Without ``time`` entries are control steps. Markers follow particles,
``marker_particle`` by index; without it each follows the particle that is nearest to it at the reset, at its distance
from there, which the first entry must show. A position that is NaN was not seen. Arrays of :meth:`get_state`, one state
after the other, are read too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from piavatar_envs.config import ConfigError
from piavatar_envs.core.reading import numbers, reading

#: Readings that are positions.
POSITIONS = ("bone_position", "prop_position", "particle_position")
#: Names of the same arrays in states.
OF_STATE = {
    "avatar_0.tracked.position": "bone_position",
    "props.position": "prop_position",
    "particles.x": "particle_position",
}
MARKERS = "marker_position"
#: Arrays that are read; others may be there, such as those of a state.
_READ = (*POSITIONS, MARKERS, "time", "marker_particle")


@dataclass(frozen=True)
class Recording:
    """Positions over time.

    Attributes:
        time: of each entry since the reset [s], shape ``(times,)``; None where entries are control steps.
        positions: by name, those of markers too, shape ``(times, points, 3)`` [m]; NaN where not seen.
        marker_particle: particle that each marker follows, shape ``(markers,)``; None for the nearest one.
    """

    time: np.ndarray | None
    positions: Mapping[str, np.ndarray]
    marker_particle: np.ndarray | None = None

    @property
    def readings(self) -> tuple[str, ...]:
        """Names of the readings that it is compared with."""
        names = ["particle_position" if name == MARKERS else name for name in self.positions]
        return tuple(dict.fromkeys(names))


def read_recording(path: Path) -> Recording:
    """Read a recording; nothing is unpickled.

    Raises:
        ConfigError: the file cannot be read, has no positions, or arrays of other shapes.
    """
    try:
        with reading(path, "a recording"), np.load(path, allow_pickle=False) as file:
            named = {OF_STATE.get(name, name): name for name in file.files}
            found = {name: numbers(file, named[name]) for name in _READ if name in named}
    except (OSError, ValueError) as error:
        raise ConfigError(f"path={str(path)!r}: {error}") from None
    positions = {}
    for name in (*POSITIONS, MARKERS):
        if name in found:
            array = found[name]
            if array.ndim == 4 and array.shape[1] == 1:  # of states, whose first dimension is the environment
                array = array[:, 0]
            if array.ndim != 3 or array.shape[2] != 3 or not array.size or not np.isfinite(array).any():
                raise ConfigError(
                    f"{path}: {name} has shape {array.shape}; use (times, points, 3), with positions in m"
                )
            positions[name] = array.astype(np.float64)
    if not positions:
        raise ConfigError(f"{path} has no positions; save {', '.join((*POSITIONS, MARKERS))} or states of get_state()")
    count = len(next(iter(positions.values())))
    time, particles = found.get("time"), found.get("marker_particle")
    if time is not None and (time.shape != (count,) or not (np.diff(time) > 0.0).all() or time[0] < 0.0):
        raise ConfigError(f"{path}: time has shape {time.shape}; use ({count},) increasing seconds since the reset")
    if any(len(array) != count for array in positions.values()):
        lengths = {name: len(array) for name, array in positions.items()}
        raise ConfigError(f"{path}: arrays have different numbers of times: {lengths}")
    if particles is not None and (particles.dtype.kind not in "iu" or (particles < 0).any()):
        raise ConfigError(f"{path}: marker_particle must be indices of particles, integers from 0 on")
    if particles is not None and particles.shape != positions.get(MARKERS, np.empty((0, 0))).shape[1:2]:
        raise ConfigError(f"{path}: marker_particle has shape {particles.shape}; use one particle a marker")
    if particles is None and MARKERS in positions and not np.isfinite(positions[MARKERS][0]).all():
        raise ConfigError(f"{path}: every marker must be seen in the first entry, or have an entry in marker_particle")
    return Recording(time, positions, particles)
