"""Recordings of a study's environment with known parameters: ``python -m agents.fit.record CONFIG.yaml FILE.npz``.

The file holds bones, props, and markers on particles drawn at random, with noise if asked for; the scorer ``recorded``
reads it. So a study can be tried on parameters that are known, before it is trusted with a recording of something real.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from agents.command import one_line_errors, read_options
from agents.config import check_imports
from agents.files import write_atomically
from agents.fit.config import load_fit
from agents.fit.recordings import MARKERS
from agents.fit.rollout import TIME, Player
from agents.fit.space import Space
from piavatar_envs.config import ConfigError, parse_assignments, read_yaml
from piavatar_envs.core.writing import check_writable
from piavatar_envs.doctor import quiet_warp

#: Readings of a recording.
READINGS = ("bone_position", "prop_position", "particle_position", TIME)


@dataclass(frozen=True)
class Options:
    """Record an episode of a study's environment with given parameters."""

    #: YAML file of the study
    config: tyro.conf.Positional[Path]
    #: recording to write, .npz
    file: tyro.conf.Positional[Path]
    #: settings of the study that override the file's: env.fidelity=tiny
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: value of every parameter, as scene.props.0.mass=3.5
    values: tuple[str, ...] = ()
    #: number of markers, on particles drawn at random
    markers: int = 60
    #: standard deviation of the noise along each axis [m]
    noise: float = 0.0
    #: seed of markers and noise
    seed: int = 0
    #: where to simulate
    device: str = "cpu"
    #: module of a task of your own, which the study may import
    imports: tuple[str, ...] = ()


def record(
    player: Player, values: Mapping[str, float], markers: int, noise: float, seed: int = 0
) -> dict[str, np.ndarray]:
    """Play an episode and return the arrays of its recording.

    Args:
        player: of a study, which reads :data:`READINGS`.
        values: of all parameters.
        markers: number of markers.
        noise: standard deviation of the noise along each axis [m].
        seed: of markers and noise.

    Raises:
        ConfigError: a parameter is missing or out of its range, or the simulation fails.
    """
    for axis in player.space.axes:
        value = values.get(axis.name)
        if value is None or not axis.low <= value <= axis.high:
            raise ConfigError(f"values: {axis.name}={value} must be given, in [{axis.low:g}, {axis.high:g}]")
    ((_, episodes),) = player.play([dict(values)], [0])
    episode = episodes[0]
    if episode.failure:
        raise ConfigError(f"the simulation failed: {episode.failure}; record other values")
    rng = np.random.default_rng(seed)
    particles = episode.readings["particle_position"]
    followed = np.sort(rng.choice(particles.shape[1], min(markers, particles.shape[1]), replace=False))
    arrays = {name: episode.readings[name] for name in ("bone_position", "prop_position")}
    arrays[MARKERS] = particles[:, followed]
    found = {name: array + rng.normal(0.0, noise, array.shape) for name, array in arrays.items() if array.size}
    return found | {TIME: episode.readings[TIME], "marker_particle": followed}


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    options = read_options(Options, "fit.record", args)
    quiet_warp()
    with one_line_errors(ValueError, ImportError, OSError):
        if options.file.suffix != ".npz":
            raise ConfigError(f"{options.file} must be a .npz file")
        if options.markers < 1 or options.noise < 0.0:
            raise ConfigError(f"markers={options.markers} must be >= 1 and noise={options.noise:g} >= 0")
        check_writable(options.file)
        overrides = parse_assignments(options.settings)
        named = {**read_yaml(options.config), **overrides}.get("env_id", "")
        check_imports(named, options.config, options.imports)
        # the recording that a study is compared with need not exist yet
        config = load_fit(options.config, {"scorer": "measured", **overrides})
        player = Player(config, Space(config), READINGS, device=options.device)
        arrays = record(player, parse_assignments(options.values), options.markers, options.noise, options.seed)
        player.close()
        write_atomically(options.file, lambda file: np.savez_compressed(file, **arrays))
    shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
    print(f"wrote {options.file}: {shapes}")


if __name__ == "__main__":
    main()
