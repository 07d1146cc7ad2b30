"""Many environments as the host sees them: what all views of a batch have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp
from gymnasium.utils import seeding

from piavatar_envs.api import spaces
from piavatar_envs.api.arrays import Array, find_array_api
from piavatar_envs.api.copies import check_state
from piavatar_envs.api.seeds import checked_seed
from piavatar_envs.avatar.torque_control.controller import checked_assist
from piavatar_envs.core.launch_graph import available_cores
from piavatar_envs.core.rng import NUM_SEEDS, check_seeds
from piavatar_envs.envs.batch_env import BatchEnv, check_count
from piavatar_envs.envs.state import check_settings
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.world import check_device


class BatchedEpisodes:
    """``num_envs`` environments of a task, with arrays in and copies out. Nothing resets by itself.

    Environments and agents are counted from 0; the first dimension of every array is the environment, the second (where
    there is one) the agent. With ``array_api="torch"`` neither :meth:`step` nor :meth:`reset_ended` nor any of the
    arrays makes the host wait for the device, unless bodies have random shapes: those are drawn on the host.

    On a CPU the environments are split into groups, each stepped by its own thread (Warp's launches release the GIL).
    An environment knows nothing of the others, so the results are the same for any number of threads.

    Attributes:
        groups: the batches, one after the other; one on a GPU.
        api: the kind of arrays.
        action_names: of every component of an agent's action.
        ready: whether there has been a reset.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int = 1,
        device: str = "cpu",
        array_api: str = "numpy",
        num_threads: int | None = None,
    ) -> None:
        """Build the environments.

        Args:
            task: the task.
            num_envs: number of environments.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            array_api: ``"numpy"`` or ``"torch"``.
            num_threads: threads on a CPU; as many as there are cores if not given. A GPU needs none.

        Raises:
            ConfigError: a scene that cannot be.
            ImportError: torch is asked for and not installed.
            ValueError: no environments or threads, an unknown device or kind of arrays.
        """
        check_count("num_envs", num_envs)
        if num_threads is not None:
            check_count("num_threads", num_threads, ", or None for one a core")
        device = check_device(device)
        self.api = find_array_api(array_api, device)
        threads = min(num_threads or available_cores(), num_envs) if wp.get_device(device).is_cpu else 1
        sizes = [len(part) for part in np.array_split(np.arange(num_envs), threads)]
        # a task holds the arrays of one batch
        tasks = [task, *(type(task)(task.config) for _ in sizes[1:])]
        self.groups = [BatchEnv(own, size, device) for own, size in zip(tasks, sizes, strict=True)]
        self._splits = np.cumsum(sizes)[:-1]
        self._pool = ThreadPoolExecutor(threads - 1, "piavatar") if threads > 1 else None
        self._captured: set[Callable[[BatchEnv], Any]] = set()
        self.task, self.config, self.num_envs, self.device = task, task.config, num_envs, device
        first = self.groups[0]
        self.num_agents, self.layout, self.action_size = first.num_agents, first.layout, first.action_spec.size
        self.action_names: tuple[str, ...] = tuple(first.action_spec.names())
        self.ready = False

    # what an agent does and sees

    def action_space(self) -> gym.spaces.Box:
        """A new space for the actions of one agent of one environment."""
        return spaces.action_space(self.groups[0])

    def observation_space(self) -> gym.Space:
        """A new space for the observations of one agent of one environment: a Box, or a Dict with ``obs_mode``."""
        return spaces.observation_space(self.groups[0])

    # episodes

    def reset(self, seeds: int | Sequence[int | None] | None = None, mask: np.ndarray | None = None) -> None:
        """Begin new episodes.

        Environments that were never seeded are different every time, as Gymnasium asks.

        Args:
            seeds: of the environments' next and all following episodes: of environment ``i`` it is ``seeds + i``, or
                ``seeds[i]``. Without seeds, or where one is None, the next episode of the seed before.
            mask: environments to reset, shape ``(num_envs,)`` bool; all if not given.

        Raises:
            ValueError: a mask or seeds of the wrong shape, or a seed outside [0, 2^32); nothing has changed then.
            gymnasium.error.Error: what is no seed.
            gymnasium.error.ResetNeeded: the first reset is not of all environments.
        """
        mask = np.ones(self.num_envs, bool) if mask is None else np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"the mask has shape {mask.shape} and type {mask.dtype}; use ({self.num_envs},) bool")
        if not (self.ready or mask.all()):
            raise gym.error.ResetNeeded("the first reset() must be of all environments: leave out the mask")
        seeds = self._checked_seeds(seeds)
        self.api.begin()
        starts = np.split(np.arange(self.num_envs), self._splits)
        for group, own in zip(self.groups, starts, strict=True):
            group.reset(mask[own], [seeds[env] for env in own])
        self.api.end()
        self._captured.add(BatchEnv.reset_masked)
        self.ready = True

    def _checked_seeds(self, seeds: int | Sequence[int | None] | None) -> list[int | None]:
        n = self.num_envs
        if seeds is None:
            seeds = [None] * n
        elif isinstance(seeds, (Set, Mapping)):  # in an order of its own
            raise ValueError(f"seed is a {type(seeds).__name__}; use a whole number, or a list of one an environment")
        elif isinstance(seeds, (str, bytes)) or not np.iterable(seeds):
            first = checked_seed(seeds)
            check_seeds(first, n)
            seeds = [first + env for env in range(n)]
        else:
            seeds = [None if seed is None else checked_seed(seed) for seed in seeds]
        if len(seeds) != n:
            raise ValueError(f"there are {len(seeds)} seeds for num_envs={n} environments")
        if not self.ready:
            drawn = seeding.np_random(None)[0].integers(NUM_SEEDS, size=n)
            seeds = [int(own) if seed is None else seed for seed, own in zip(seeds, drawn, strict=True)]
        return seeds

    def check_ready(self, call: str) -> None:
        """Refuse ``call`` before the first reset.

        Raises:
            gymnasium.error.ResetNeeded: there was none.
        """
        if not self.ready:
            raise gym.error.ResetNeeded(f"call reset() before {call}()")

    def step(self, actions: Any) -> None:
        """One control step of all environments; one whose episode has ended stays ended.

        Args:
            actions: shape ``(num_envs, num_agents, action_size)``: an array of NumPy, or a float32 tensor on the
                environments' device.

        Raises:
            ValueError: a wrong shape, type or device, or (NumPy) a component that is not finite; nothing has changed
                then. A tensor's component that is not finite acts as zero and ends its environment with
                ``failure="action"``.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        self.check_ready("step")
        self.advance(self.api.actions(actions, (self.num_envs, self.num_agents, self.action_size), self.action_names))

    def advance(self, actions: Array) -> None:
        """One control step under ``actions`` as :meth:`step` takes them, that the caller has checked."""
        self.api.write(actions, [group.action for group in self.groups])
        self._run(BatchEnv.step)

    def find_ended(self) -> Array:
        """Which environments have ended, ``(num_envs,)`` bool: all agents are out, or the clock has run out.

        These are what :meth:`reset_ended` resets, also when other steps have come in between.
        """
        self._run(BatchEnv.find_ended)
        return self.read(lambda group: group.mask)

    def reset_ended(self) -> None:
        """Begin the next episode of the environments that :meth:`find_ended` has found, and of no others.

        Rewards, terms and metrics stay those of the last step; flags and observations are of the new episode.
        """
        self._run(BatchEnv.reset_masked)

    def _run(self, graph: Callable[[BatchEnv], Any]) -> None:
        """Run something of every group, each in its own thread."""
        self.api.begin()
        if self._pool is None or graph not in self._captured:
            # Warp records one graph at a time: the first runs are not at once
            for group in self.groups:
                graph(group)
            self._captured.add(graph)
        else:
            running = [self._pool.submit(graph, group) for group in self.groups[1:]]
            graph(self.groups[0])
            for result in running:
                result.result()
        self.api.end()

    # what is there to see, always copies

    def read(self, array_of: Callable[[BatchEnv], wp.array]) -> Array:
        """An array of all environments, a copy: ``array_of`` says which one of a group."""
        return self.api.read([array_of(group) for group in self.groups])

    def observation(self) -> Array:
        """Flat observations ``(num_envs, num_agents, observation_size)`` float32."""
        return self.read(lambda group: group.observation)

    def named(self, observation: Array) -> dict[str, Array] | Array:
        """``observation`` (flat along its last axis) as copies by name with ``obs_mode="dict"``, else as it is."""
        return self.api.split(observation, self.layout) if self.config.obs_mode == "dict" else observation

    def reward(self) -> Array:
        """Of the last step, ``(num_envs, num_agents)`` float32."""
        return self.read(lambda group: group.reward)

    def terminated(self) -> Array:
        """Whether the episode has ended for an agent, ``(num_envs, num_agents)`` bool."""
        return self.read(lambda group: group.terminated)

    def truncated(self) -> Array:
        """Whether the clock has run out for those still in, ``(num_envs,)`` bool."""
        return self.read(lambda group: group.truncated)

    def alive(self) -> Array:
        """Who acts in the next step if the clock has not run out, ``(num_envs, num_agents)`` bool."""
        return self.read(lambda group: group.alive)

    # leaving and coming back

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, on the host; the first dimension is the environment."""
        states = [group.get_state() for group in self.groups]
        return {name: np.concatenate([state[name] for state in states]) for name in states[0]}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`get_state` returned, under any number of threads.

        Raises:
            ValueError: the state is of another environment, another number or other settings, or not finite; nothing
                has changed then.
        """
        check_state(state, self.num_envs)
        check_settings(state, self.config)  # of all, before any of the groups has changed
        self.adopt(state, ready=True)

    def adopt(self, state: dict[str, np.ndarray], ready: bool) -> None:
        """Be a copy of others, given their state and whether they are ready."""
        parts = {name: np.split(np.asarray(value), self._splits) for name, value in state.items()}
        self.api.begin()
        for index, group in enumerate(self.groups):
            group.set_state({name: part[index] for name, part in parts.items()})
        self.api.end()
        self.ready = ready

    def assist_root(self, share: float | np.ndarray) -> None:
        """Help the pelvis from now on; see :meth:`BatchEnv.assist_root`.

        Raises:
            ValueError: as there; nothing has changed then.
        """
        parts = np.split(checked_assist(share, self.num_envs), self._splits)
        for group, part in zip(self.groups, parts, strict=True):
            group.assist_root(part)

    def group_of(self, env: int) -> tuple[BatchEnv, int]:
        """The batch in which environment ``env`` lives, and its number there."""
        group = int(np.searchsorted(self._splits, env, side="right"))
        return self.groups[group], env - ([0, *self._splits][group])

    def close(self) -> None:
        """End the threads; closing twice is fine. Who goes on has one thread."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
