"""Episodes of trials: builds that trials share, threads on a CPU, and records of what scorers read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from agents.evaluate import begin_round, seen_by
from agents.fit.actors import make_actor
from agents.fit.config import FitConfig
from agents.fit.space import Space
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import ConfigError, EnvConfig
from piavatar_envs.core.launch_graph import available_cores
from piavatar_envs.mpm.types import failure_name
from piavatar_envs.sim.world import check_device

#: Reading of scorers that has the time of each entry, beside those of :mod:`piavatar_envs.api.readings`.
TIME = "time"
Values = Mapping[str, float]


@dataclass(frozen=True)
class World:
    """Constants of the trials' world, which scorers may need.

    Attributes:
        config: settings of the environment.
        props, subjects: names of the props, and of all that touch each other: avatars, then props.
        particle_bone: bone with the greatest weight of every particle of the first avatar, shape ``(particles,)``.
    """

    config: EnvConfig
    props: tuple[str, ...]
    subjects: tuple[str, ...]
    particle_bone: np.ndarray

    def prop(self, name: str | None) -> int:
        """Return the index of a prop, the only one if no name is given.

        Raises:
            ConfigError: there is no such prop, or no single one.
        """
        if name is None and len(self.props) == 1:
            return 0
        if name not in self.props:
            raise ConfigError(f"prop={name!r} must be one of the props of the scene: {', '.join(self.props) or 'none'}")
        return self.props.index(name)


@dataclass
class Episode:
    """Record of an episode of a trial.

    Attributes:
        seed: of the episode.
        readings: by name, the reset's first and then one entry per control step, shape ``(steps + 1, ...)``.
        pictures: frames ``(count, height, width, 3)`` uint8, evenly spaced in time; None where none are wanted.
        failure: name of the simulation's failure, or an empty string.
    """

    seed: int
    readings: dict[str, np.ndarray] = field(default_factory=dict)
    pictures: np.ndarray | None = None
    failure: str = ""


def describe_world(space: Space, host: EpisodeHost) -> World:
    """Describe the world of a host."""
    simulation = host.groups[0].simulation
    points = simulation.flesh[0].points
    names = (*host.task.agent_names, *simulation.props.names)
    return World(space.base, simulation.props.names, names, points.skin_joints[:, 0].astype(int))


class Player:
    """Plays trials.

    Attributes:
        world: constants of the world, once something was built.
        builds: number of environments that were built so far, of any size.
    """

    def __init__(
        self, config: FitConfig, space: Space, readings: Sequence[str], pictures: int = 0, device: str = "cpu"
    ) -> None:
        """Set what is played and recorded.

        Args:
            config: of the study.
            space: its parameters.
            readings: names of what is recorded, see :mod:`piavatar_envs.api.readings`.
            pictures: number of frames of an episode; 0 for none.
            device: Warp device.
        """
        self.config, self.space, self.device = config, space, check_device(device)
        self.readings, self.pictures = tuple(readings), pictures
        self.world: World | None = None
        self.builds = 0
        # a renderer and a GPU are shared by all threads
        threaded = wp.get_device(self.device).is_cpu and not pictures and available_cores() > 1
        self._pool = ThreadPoolExecutor(available_cores(), "trial") if threaded else None

    def probe(self) -> World:
        """Build the environment of the middle of all ranges, and describe it."""
        if self.world is None:
            middle = self.space.values([0.5] * len(self.space.axes))
            host = self._build([middle], threads=1)
            host.close()
        return self.world

    def time_step(self, values: Values) -> dict[str, int]:
        """Return the substeps of the build of a trial, and those whose damping they keep, as settings."""
        host = self._build([values], threads=1)
        host.close()
        model = host.groups[0].simulation.model
        return {f"physics.{name}": getattr(model, name) for name in ("num_substeps", "reference_substeps")}

    def play(self, trials: Sequence[Values], wanted: Sequence[int]) -> Iterator[tuple[int, list[Episode]]]:
        """Play the ``wanted`` of the trials and yield their indices, in order, and their episodes.

        A build that one of them needs plays all trials that share it, so that results do not depend on which are
        wanted.
        """
        groups: dict[str, list[int]] = {}
        for index, values in enumerate(trials):
            groups.setdefault(self.space.build_key(values), []).append(index)
        group_of = {index: group for group in groups.values() for index in group}
        played = [group for group in groups.values() if set(group) & set(wanted)]
        futures: dict[int, Future] = {}
        if self._pool and len(played) > 1:  # small builds have a thread each, while a single one splits itself
            futures = {group[0]: self._pool.submit(self._play_group, [trials[i] for i in group], 1) for group in played}
        found: dict[int, list[Episode]] = {}
        for index in sorted(wanted):
            if index not in found:
                group = group_of[index]
                future = futures.get(group[0])
                episodes = future.result() if future else self._play_group([trials[i] for i in group], None)
                found |= dict(zip(group, episodes, strict=True))
            yield index, found.pop(index)

    def close(self) -> None:
        """End the threads."""
        if self._pool:
            self._pool.shutdown(cancel_futures=True)

    def _build(self, trials: Sequence[Values], threads: int | None) -> EpisodeHost:
        """Build the environments of trials that can share a build."""
        task = self.space.task_class(self.space.build_settings(trials[0]))
        render = "rgb_array" if self.pictures else None
        count = len(trials) * self.config.repeats
        host = EpisodeHost(task, count, self.device, num_threads=threads, render_mode=render)
        rows = [values for values in trials for _ in range(self.config.repeats)]
        first = 0
        for group in host.groups:
            self.space.place(group, rows[first : first + group.num_envs])
            first += group.num_envs
        self.builds += 1
        if self.world is None:
            self.world = describe_world(self.space, host)
        return host

    def _play_group(self, trials: Sequence[Values], threads: int | None) -> list[list[Episode]]:
        """Play the trials of one build; returns the episodes of each."""
        host = self._build(trials, threads)
        try:
            repeats = self.config.repeats
            seeds = [self.config.first_seed + repeat for _ in trials for repeat in range(repeats)]
            episodes = self._record(host, seeds)
        finally:
            host.close()
        return [episodes[repeats * index : repeats * (index + 1)] for index in range(len(trials))]

    def _record(self, host: EpisodeHost, seeds: list[int]) -> list[Episode]:
        """Play an episode in every environment and record it."""
        steps = host.groups[0].max_steps
        shown = set(np.unique(np.linspace(0, steps, self.pictures).round().astype(int))) if self.pictures else set()
        actor = make_actor(self.config.actor, host, seeds)
        names = [name for name in self.readings if name != TIME]
        recorded: dict[str, list[np.ndarray]] = {name: [] for name in names}
        frames: list[list[np.ndarray]] = [[] for _ in seeds]
        host.reset(seeds)
        begin_round(actor, host.num_envs)
        lengths = np.zeros(host.num_envs, int)
        playing = np.ones(host.num_envs, bool)
        for step in range(steps + 1):
            if step:
                host.step(actor(seen_by(host)))
                lengths[playing] = step
            for name in names:
                recorded[name].append(host.reading(name))
            if step in shown:
                for env in np.flatnonzero(playing):
                    frames[env].append(host.pictures.frame(env))
            playing &= ~host.find_ended()
            if not playing.any():
                break
        failures = host.read(lambda group: group.failure)
        times = np.arange(steps + 1) * host.config.physics.control_dt
        episodes = []
        for env, seed in enumerate(seeds):
            own = slice(0, lengths[env] + 1)
            readings = {name: np.stack([entry[env] for entry in values[own]]) for name, values in recorded.items()}
            if TIME in self.readings:
                readings[TIME] = times[own]
            pictures = np.stack(frames[env]) if self.pictures else None
            episodes.append(Episode(seed, readings, pictures, failure_name(failures[env]) or ""))
        return episodes
