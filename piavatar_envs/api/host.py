"""Host side of the environments: one :class:`EpisodeHost` holds one or many, the views of this folder reshape it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np
import warp as wp
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding

from piavatar_envs.api.arrays import Array, find_array_api
from piavatar_envs.api.pictures import Live, Pictures, check_extra
from piavatar_envs.api.readings import find_reading
from piavatar_envs.avatar.torque_control.controller import checked_assist
from piavatar_envs.config import ConfigError, EnvConfig, PixelsConfig
from piavatar_envs.config import replace as replace_settings
from piavatar_envs.config.load import plain
from piavatar_envs.core.capture_lock import CAPTURE
from piavatar_envs.core.launch_graph import available_cores
from piavatar_envs.core.rng import NUM_SEEDS, check_seeds
from piavatar_envs.envs.batch_env import BatchEnv, check_count
from piavatar_envs.envs.observations import ObservationLayout
from piavatar_envs.envs.state import add_forces, check_settings, check_state, has_forces
from piavatar_envs.envs.task import COST, REWARD, Task
from piavatar_envs.sim.world import check_device

#: Types in which settings are given.
Settings = EnvConfig | Mapping[str, Any] | str | Path | None
#: Substeps a control step above which an environment is worth a warning: several times those of the finest bodies.
MANY_SUBSTEPS = 300
#: Time of a particle's substep on a CPU core, of default bodies [s]; see docs/performance.md.
SUBSTEP_TIME = 2.5e-7
Limited = TypeVar("Limited", bound=EnvConfig)


def _alone(method: Callable[..., Any]) -> Callable[..., Any]:
    """Let a method exclude the environments of other threads: it builds, captures, or launches kernels one by one."""

    @functools.wraps(method)
    def locked(*args: Any, **kwargs: Any) -> Any:
        with CAPTURE.exclusive():
            return method(*args, **kwargs)

    return locked


def check_mosaic(mosaic: int | None, num_envs: int) -> None:
    """Refuse a picture of more environments than there are.

    Raises:
        ConfigError: see above.
    """
    if mosaic is not None and mosaic > num_envs:
        remedy = f"at most {num_envs}" if num_envs > 1 else "a vector, as gym.make_vec makes it"
        raise ConfigError(f"render.mosaic={mosaic} of num_envs={num_envs}; use {remedy}, or leave it out")


class EpisodeHost:
    """``num_envs`` environments of a task: arrays in, copies out. Nothing resets by itself.

    Environments and agents are counted from 0; the first dimension of every array is the environment, the second (where
    there is one) the agent. With ``array_api="torch"`` neither :meth:`step` nor :meth:`reset_ended` nor any of the
    arrays makes the host wait for the device, unless bodies have random shapes: those are drawn on the host.

    On a CPU the environments are split into groups, each stepped by its own thread, because Warp's launches release the
    GIL. Environments are independent, so the results are the same for any number of threads.

    Attributes:
        groups: the batches, one after the other; one on a GPU.
        api: the kind of arrays.
        task, config: the task and its settings.
        num_envs, num_agents: number of environments, and of agents in each.
        layout, action_size, action_names: of an agent's flat observation and of its action.
        device: name of the Warp device.
        ready: whether there has been a reset.
        closed: whether :meth:`close` was called, after which nothing is played.
        pictures: draws single environments.
        live: the live view of the only environment, or None.
    """

    @_alone
    def __init__(
        self,
        task: Task,
        num_envs: int = 1,
        device: str = "cpu",
        array_api: str = "numpy",
        num_threads: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Build the environments.

        Args:
            task: the task.
            num_envs: number of environments.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            array_api: ``"numpy"`` or ``"torch"``.
            num_threads: threads on a CPU; as many as there are cores if not given. A GPU needs none.
            render_mode: None, ``"rgb_array"`` or, of one environment, ``"human"``.

        Raises:
            ConfigError: settings that contradict each other.
            ImportError: ``array_api="torch"`` without torch, or a render mode without its extra: ``render``, ``live``.
            ValueError: no environments or threads, an unknown device or kind of arrays.
        """
        check_extra(render_mode, task.config.render.color)
        check_count("num_envs", num_envs)
        check_mosaic(task.config.render.mosaic, num_envs)
        if num_threads is not None:
            check_count("num_threads", num_threads, ", or None for one per core")
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
        self._seen = tuple(self.groups[0].pixels.arrays) if self.groups[0].pixels else ()
        self.task, self.config, self.num_envs, self.device = task, task.config, num_envs, device
        first = self.groups[0]
        self.num_agents, self.layout, self.action_size = first.num_agents, first.layout, first.action_spec.size
        self.action_names: tuple[str, ...] = tuple(first.action_spec.names())
        self._warn_of_many_substeps(first)
        self.ready, self.closed, self.render_mode = False, False, render_mode
        self.pictures = Pictures(self.group_of, self.config.render)
        self.live = Live(first, self.apply_force, self.config.render.color) if render_mode == "human" else None

    @staticmethod
    def _warn_of_many_substeps(batch: BatchEnv) -> None:
        """Warn of a control step that is slow because matter is stiff or fast, or the resolution fine."""
        model, physics = batch.simulation.model, batch.config.physics
        count = model.num_substeps
        if count > MANY_SUBSTEPS:
            seconds = SUBSTEP_TIME * count * model.num_particles
            name, stiffness = batch.simulation.subjects.stiffest()
            cause = f"the stiffest matter is that of {name!r} (young_modulus={stiffness:.3g} Pa)"
            if physics.num_substeps is not None:
                cause = f"physics.num_substeps={physics.num_substeps} is set"
            gym.logger.warn(
                f"a control step takes {count} substeps, about {seconds:.1g} s on a free CPU core: {cause}, and "
                f"fidelity={physics.fidelity!r}; softer or slower matter, or a coarser fidelity, needs fewer"
            )

    @property
    def frame_rate(self) -> float:
        """Control steps per second; an integer where it is whole, but for the rounding of ``control_dt``."""
        rate = 1.0 / self.config.physics.control_dt
        return round(rate) if abs(rate - round(rate)) < 1e-6 * rate else rate

    # spaces

    def action_space(self) -> gym.spaces.Box:
        """Return a new space of the actions of one agent of one environment."""
        return gym.spaces.Box(-1.0, 1.0, (self.action_size,), np.float32)

    def observation_space(self) -> gym.Space:
        """Return a new space of the observations of one agent, as ``obs_mode`` has it.

        A Box, or a Dict: by term with ``"dict"``; with pictures of ``"pixels"`` and, where they are observed,
        ``"depth"``, ``"segmentation"`` and ``"state"``.
        """
        mode, flat = self.config.obs_mode, _unbounded(self.layout.size)
        if mode == "flat":
            return flat
        if mode == "dict":
            return gym.spaces.Dict({name: _unbounded(term.size) for name, term in self.layout.items()})
        spaces: dict[str, gym.Space[Any]] = {**picture_spaces(self.config.pixels)}
        if mode == "pixels":
            return gym.spaces.Dict(spaces) if len(spaces) > 1 else spaces["pixels"]
        return gym.spaces.Dict(spaces | {"state": flat})

    def state_space(self) -> gym.spaces.Box:
        """Return a new space of the flat observations of all agents of one environment, one after the other."""
        return _unbounded(self.num_agents * self.layout.size)

    # episodes

    @_alone
    def reset(self, seeds: int | Sequence[int | None] | None = None, mask: np.ndarray | None = None) -> None:
        """Begin new episodes.

        Environments that were never seeded are different every time, as Gymnasium requires.

        Args:
            seeds: of the environments' next and all following episodes: of environment ``i`` it is ``seeds + i``, or
                ``seeds[i]``. Without seeds, or where one is None, the next episode of the seed before.
            mask: environments to reset, shape ``(num_envs,)`` bool; all if not given.

        Raises:
            ValueError: a mask or seeds of the wrong shape, or a seed outside [0, 2^32); nothing has changed then.
            gymnasium.error.Error: a seed that is not a whole number.
            gymnasium.error.ResetNeeded: the first reset is not of all environments.
            gymnasium.error.ClosedEnvironmentError: after :meth:`close`.
        """
        self.check_open("reset")
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
        if self.live:
            self.live.begin()

    def _checked_seeds(self, seeds: int | Sequence[int | None] | None) -> list[int | None]:
        n = self.num_envs
        if seeds is None:
            seeds = [None] * n
        elif isinstance(seeds, (Set, Mapping)):  # without an order that the caller has chosen
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

    def check_open(self, call: str) -> None:
        """Refuse ``call`` after :meth:`close`.

        Raises:
            gymnasium.error.ClosedEnvironmentError: the environments were closed.
        """
        if self.closed:
            raise gym.error.ClosedEnvironmentError(f"{call}() after close(): make a new environment")

    def check_ready(self, call: str) -> None:
        """Refuse ``call`` before the first reset, and after the environments were closed.

        Raises:
            gymnasium.error.ClosedEnvironmentError: they were.
            gymnasium.error.ResetNeeded: there was no reset.
        """
        self.check_open(call)
        if not self.ready:
            raise gym.error.ResetNeeded(f"call reset() before {call}()")

    def step(self, actions: Any) -> None:
        """Advance all environments by one control step; one whose episode has ended stays ended.

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
        """Advance by one control step under actions that the caller has checked; at most in real time with a view."""
        if self.live:
            self.live.before_step()
        with CAPTURE.shared():
            self.api.write(actions, [group.action for group in self.groups])
        self._run(BatchEnv.step)
        if self.live:
            self.live.step()

    def find_ended(self) -> Array:
        """Find the environments whose agents are all out or whose clock has run out, ``(num_envs,)`` bool.

        :meth:`reset_ended` resets these, also when other steps have come in between.
        """
        self._run(BatchEnv.find_ended)
        return self.read(lambda group: group.mask)

    def reset_ended(self) -> None:
        """Begin the next episode of the environments found by :meth:`find_ended`, and of no others.

        Rewards, terms and metrics stay those of the last step; flags and observations are of the new episode.
        """
        self._run(BatchEnv.reset_masked)

    def step_and_reset(self, actions: Array) -> Transition:
        """Advance all environments, and begin the next episode of those that end (SAME_STEP, as Gymnasium calls it).

        Args:
            actions: as :meth:`step` takes them.

        Raises:
            ValueError: actions of a wrong shape, type or device; nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        self.check_ready("step")
        acted = self.alive()
        self.step(actions)
        terminated, final, last_seen = self.terminated(), self.observation(), self._all_pictures()
        truncated = self.truncated()[:, None] & ~terminated
        infos = [self.status(agent) | self.outcome(agent) for agent in range(self.num_agents)]
        ended = self.find_ended()
        self.reset_ended()
        now = self.observation(), self._all_pictures()
        return Transition(*now, final, last_seen, self.reward(), terminated, truncated, ended, acted, infos)

    def _all_pictures(self) -> list[dict[str, Array]]:
        return [self.observed_pictures(agent) for agent in range(self.num_agents)]

    def _run(self, graph: Callable[[BatchEnv], Any]) -> None:
        """Run a method of every group, each in its own thread."""
        if graph not in self._captured:
            with CAPTURE.exclusive():
                self.api.begin()
                for group in self.groups:
                    graph(group)
                self.api.end()
            self._captured.add(graph)
            return
        with CAPTURE.shared():
            self.api.begin()
            running = [self._pool.submit(graph, group) for group in self.groups[1:]] if self._pool else []
            graph(self.groups[0])
            for result in running:
                result.result()
            self.api.end()

    # arrays of all environments, always copies

    def read(self, array_of: Callable[[BatchEnv], wp.array]) -> Array:
        """Copy an array of all environments; ``array_of`` selects it in a group."""
        return self.api.read([array_of(group) for group in self.groups])

    def observation(self) -> Array:
        """Return flat observations ``(num_envs, num_agents, observation_size)`` float32."""
        return self.read(lambda group: group.observation)

    def observed_pictures(self, agent: int) -> dict[str, Array]:
        """Return the pictures that an agent observes, ``(num_envs, height, width, channels)`` by name; or none."""
        return {name: self.read(functools.partial(_picture, name=name, agent=agent)) for name in self._seen}

    def named(self, observation: Array, pictures: Mapping[str, Array] | None = None) -> dict[str, Array] | Array:
        """Return an observation in the form that ``obs_mode`` has.

        Args:
            observation: flat along its last axis.
            pictures: that belong to it, by name.
        """
        mode, seen = self.config.obs_mode, dict(pictures or {})
        if mode == "dict":
            return self.api.split(observation, self.layout)
        if mode == "flat":
            return observation
        if mode == "pixels":
            return seen if len(seen) > 1 else seen["pixels"]
        return {**seen, "state": observation}

    def reward(self) -> Array:
        """Return the reward of the last step, ``(num_envs, num_agents)`` float32."""
        return self.read(lambda group: group.reward)

    def terminated(self) -> Array:
        """Return whether the episode has ended for an agent, ``(num_envs, num_agents)`` bool."""
        return self.read(lambda group: group.terminated)

    def truncated(self) -> Array:
        """Return whether the clock has run out for agents that are still in, ``(num_envs,)`` bool."""
        return self.read(lambda group: group.truncated)

    def alive(self) -> Array:
        """Return which agents act in the next step if the clock has not run out, ``(num_envs, num_agents)`` bool."""
        return self.read(lambda group: group.alive)

    def reading(self, name: str, agent: str | None = None) -> Array:
        """Copy a quantity of the world; see :meth:`HostView.read`."""
        self.check_ready("read")
        reading, names = find_reading(name), self.task.agent_names
        if agent is not None and not reading.of_bones:
            raise ValueError(f"{name} is of the world, not of an agent; leave out agent={agent!r}")
        if reading.of_bones and agent not in names and (agent is not None or len(names) > 1):
            raise ValueError(f"agent={agent!r} is not one of {', '.join(names)}")
        index = 0 if agent is None else names.index(agent)
        values = self.read(lambda group: reading.array_of(group.simulation, index))
        return reading.converted(values, len(self.groups[0].simulation.props))

    # infos

    def status(self, agent: int) -> dict[str, Array]:
        """Return the part of an agent's info that holds at any time, a row per environment.

        ``failure`` is a code, see :func:`piavatar_envs.failure_name`.
        """

        def drive(name: str) -> Array:
            return self.read(lambda batch: getattr(batch.simulation.avatars[agent].state, name))

        return {
            "success": self.read(lambda batch: batch.success)[:, agent],
            "failure": self.read(lambda batch: batch.failure),
            "limited_share": self.read(lambda batch: batch.simulation.sensors.limited),
            # a failed environment may hold numbers that are not finite, which must not leave the suite
            "root_force": self.api.finite(drive("wrench_force")),
            "root_torque": self.api.finite(drive("wrench_torque")),
            "root_released": drive("released") != 0,
        }

    def outcome(self, agent: int) -> dict[str, Array]:
        """Return the part of an agent's info that is of the last step, a row per environment.

        That is metrics, the terms of the reward as ``reward_<name>``, ``cost`` and its terms as ``cost_<name>``.
        """

        def named(names: Sequence[str], prefix: str, array_of: Callable[[BatchEnv], wp.array]) -> dict[str, Array]:
            # an array without names has one column without meaning
            values = self.read(array_of)[:, agent] if names else np.empty((0, 0))
            return {f"{prefix}{name}": values[:, index] for index, name in enumerate(names)}

        task = self.task
        found = named(task.metric_names, "", lambda batch: batch.metrics)
        found |= named(task.reward_names, REWARD, lambda batch: batch.terms)
        if task.costs:
            found["cost"] = self.read(lambda batch: batch.cost)[:, agent]
            found |= named(task.cost_names, COST, lambda batch: batch.cost_terms)
        return found

    # state

    def get_state(self) -> dict[str, np.ndarray]:
        """Copy everything that the future depends on to the host; the first dimension is the environment."""
        states = [group.get_state() for group in self.groups]
        return {name: np.concatenate([state[name] for state in states]) for name in states[0]}

    @_alone
    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore the result of :meth:`get_state`, under any number of threads.

        Raises:
            ValueError: the state is of another environment, another number or other settings, or not finite; nothing
                has changed then.
        """
        self.check_open("set_state")
        check_state(state, self.num_envs)
        check_settings(
            state, self.config, self.groups[0].files
        )  # of all environments, before any of the groups has changed
        self.adopt(state, ready=True)
        if self.live:
            self.live.begin()

    @_alone
    def adopt(self, state: dict[str, np.ndarray], ready: bool) -> None:
        """Take over the state of another host and whether it is ready; a live view opens at the next reset."""
        state = self.with_forces(state)
        parts = {name: np.split(np.asarray(value), self._splits) for name, value in state.items()}
        self.api.begin()
        for index, group in enumerate(self.groups):
            group.set_state({name: part[index] for name, part in parts.items()})
        self.api.end()
        self.ready = ready

    @_alone
    def assist_root(self, share: float | np.ndarray) -> None:
        """Set the share of root assistance from now on; see :meth:`BatchEnv.assist_root`.

        Raises:
            ValueError: it is out of range, of another shape, or the control has none; nothing has changed then.
        """
        parts = np.split(checked_assist(share, self.num_envs), self._splits)
        for group, part in zip(self.groups, parts, strict=True):
            group.assist_root(part)

    @_alone
    def tune(self, values: Mapping[str, float]) -> None:
        """Change settings of all running worlds, by name; see :class:`~piavatar_envs.sim.tuning.Tuning`.

        States do not hold these changes, and :attr:`config` stays that of the beginning.

        Raises:
            ValueError: a value is out of range, or needs environments of its own; nothing has changed then.
        """
        for group in self.groups:
            group.tune(values)
        self._captured.discard(BatchEnv.step)  # steps may have new graphs

    def weigh_motions(self, weights: Any) -> None:
        """Set the weights by which episodes draw their motions; see :meth:`HostView.weigh_motions`.

        Raises:
            ValueError: weights that are refused; nothing has changed then.
        """
        names = self.task.motion_names
        if not names:
            raise ValueError(f"{type(self.task).__name__} draws no motions to be weighed; TrackMotion does")
        shares = self.api.shares("weights", weights, (self.num_envs, len(names)))
        self.api.write(shares, [group.task.motion_shares for group in self.groups])

    @_alone
    def apply_force(
        self,
        target: str,
        force: Any,
        point: Any = None,
        steps: int = 1,
        agent: str | None = None,
        envs: Any = None,
    ) -> None:
        """Let a force act on a bone or a prop; for arguments and errors see :meth:`HostView.apply_force`."""
        self.check_ready("apply_force")
        check_count("steps", steps)
        names = self.task.agent_names
        if agent is not None and agent not in names:
            raise ValueError(f"agent={agent!r} is not one of {', '.join(names)}")
        index = None if agent is None else names.index(agent)
        targets = [group.simulation.receivers.find(target, index) for group in self.groups]
        mask, force = self.api.mask(envs, self.num_envs), self.api.vectors("force", force, self.num_envs)
        at = force if point is None else self.api.vectors("point", point, self.num_envs)
        if self.api.name == "numpy" and self.groups[0].simulation.forces:
            forces = [group.simulation.forces for group in self.groups if group.simulation.forces]
            taken = self.api.read([one.slots.remaining for one in forces]) > 0
            full = np.flatnonzero(taken.all(1) & mask)
            if full.size:
                raise ValueError(
                    f"environments {full.tolist()} have {taken.shape[1]} forces, the most that act at the same time; "
                    "use fewer, or fewer steps"
                )
        self._enable_forces()
        calls = [group.simulation.forces.call for group in self.groups if group.simulation.forces]
        for name, values in (("mask", mask), ("force", force), ("point", at)):
            self.api.write(values, [getattr(call, name) for call in calls])
        self.api.begin()
        for group, own in zip(self.groups, targets, strict=True):
            group.apply_force(own, steps, point is not None)
        self.api.end()

    def _enable_forces(self) -> None:
        """Record the steps of all groups anew with external forces, unless they have them."""
        if not self.groups[0].simulation.forces:
            for group in self.groups:
                group.enable_forces()
            self._captured.clear()  # their steps and resets have new graphs

    def with_forces(self, state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return ``state`` with arrays of external forces if the environments have some, and give them some if it has.

        Where they were missing, no force acts.
        """
        if has_forces(state):
            self._enable_forces()
            return state
        return add_forces(state, self.get_state()) if self.groups[0].simulation.forces else state

    def group_of(self, env: int) -> tuple[BatchEnv, int]:
        """Return the batch that holds environment ``env``, and its index there."""
        group = int(np.searchsorted(self._splits, env, side="right"))
        return self.groups[group], env - ([0, *self._splits][group])

    # pictures

    @_alone
    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw every environment, ``(height, width, 3)`` uint8, with ``render_mode="rgb_array"``; else return None.

        With ``render.mosaic`` every entry is the same picture, of several environments side by side. With ``"human"``
        resets and steps update the live view.

        Raises:
            ImportError: pictures have text, and Pillow is not installed (extra ``render``).
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn('render() needs an environment made with render_mode="rgb_array"')
            return None
        self.check_ready("render")
        if self.live:
            return None
        if self.config.render.mosaic:
            return (self.pictures.mosaic(self.config.render.mosaic),) * self.num_envs
        return tuple(self.pictures.frame(env) for env in range(self.num_envs))

    def close(self) -> None:
        """Free the renderers, stop the live view and end the threads; closing twice is fine.

        Later resets and steps are refused.
        """
        self.closed = True
        self.pictures.close()
        if self.live:
            self.live.close()
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


@dataclass(frozen=True)
class Transition:
    """A control step of all environments, after which those that ended stand at the start of their next episode.

    Attributes:
        observation: from which the next step begins, ``(num_envs, num_agents, observation_size)``.
        pictures: that belong to it, by agent and name; see :meth:`EpisodeHost.observed_pictures`.
        final_observation, final_pictures: to which this step led; where nothing ended they are the same.
        reward: ``(num_envs, num_agents)``; zero for an agent that was out before.
        terminated: ``(num_envs, num_agents)`` bool; stays True while the others go on.
        truncated: ``(num_envs, num_agents)`` bool, the clock has run out for an agent that was still in.
        ended: ``(num_envs,)`` bool, the next episode has begun: the last agent is out, or the clock has run out.
        acted: ``(num_envs, num_agents)`` bool, agents that were in when the step began.
        infos: of every agent, a row per environment, as they were when the step ended.
    """

    observation: Array
    pictures: Sequence[dict[str, Array]]
    final_observation: Array
    final_pictures: Sequence[dict[str, Array]]
    reward: Array
    terminated: Array
    truncated: Array
    ended: Array
    acted: Array
    infos: Sequence[dict[str, Any]]

    def means(self, metrics: Sequence[str]) -> dict[str, Array]:
        """Average over environments and agents, for loggers: success, the reward's terms and ``metrics``, by name.

        Of tensors only.
        """
        infos = self.infos
        shown = {"Task/success": [info["success"].float() for info in infos]}
        shown |= {f"Task/{name}": [info[name] for info in infos] for name in metrics}
        names = [key.removeprefix(REWARD) for key in infos[0] if key.startswith(REWARD)]
        shown |= {f"Reward/{name}": [info[f"{REWARD}{name}"] for info in infos] for name in names}
        return {
            name: sum(value.nan_to_num(0.0, 0.0, 0.0).mean() for value in values) / len(infos)
            for name, values in shown.items()
        }


class HostView:
    """Base of all views of an :class:`EpisodeHost`; ``copy.deepcopy`` and ``pickle`` copy it.

    A copy goes on as the view does, on a CPU bit for bit. Devices, graphs and threads cannot be copied, so a copy is
    built anew with the same arguments, and gets the view's state and all its other attributes: agents that act, random
    generators, spaces, and attributes that users have added. Pictures begin anew: windows, the camera's glide, the live
    view.

    Attributes:
        host: holds the environments.
        _build: the constructor, or as much of it as makes ``_built``, with all arguments but the view; importable, so
            that another process can call it.
        _built: names of the attributes that are not copied; a copy of a closed view is open.
    """

    host: EpisodeHost
    _spec: EnvSpec | None = None
    _build: Callable[[Any], None]
    _built: ClassVar[tuple[str, ...]] = ("host", "closed")

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in vars(self).items() if name not in self._built}
        return {"kept": kept, "ready": self.host.ready, "state": self.host.get_state()}

    def __setstate__(self, copied: dict[str, Any]) -> None:
        kept = copied["kept"]
        kept["_build"](self)
        vars(self).update(kept)
        self.host.adopt(copied["state"], copied["ready"])

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's description of how this was made, None without it; its time limit is that of the settings.

        Arguments that JSON cannot hold (paths, arrays, configurations) are in it as what makes the same environment.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        # Gymnasium sets it without a limit, because the limit is part of the environment and not of a wrapper
        if spec is not None:
            kwargs = {name: json_form(value) for name, value in spec.kwargs.items()}
            spec = replace(spec, max_episode_steps=self.host.groups[0].max_steps, kwargs=kwargs)
        self._spec = spec

    @property
    def observation_layout(self) -> ObservationLayout:
        """Name, slice, unit and frame of every term in the flat observation of an agent."""
        return self.host.layout

    @property
    def segmentation_names(self) -> tuple[str, ...]:
        """Names by label of the observed ``segmentation``, the ground first; empty where no pictures are observed."""
        pixels = self.host.groups[0].pixels
        return pixels.stage.subjects if pixels else ()

    def assist_root(self, share: float | np.ndarray) -> None:
        """Set the share of root assistance from now on, in [0, 1]; for ``control="pd"`` and ``"torque"``.

        Every avatar of an environment gets its share, and resets keep it.

        Args:
            share: of all environments, or of each, shape ``(num_envs,)``.

        Raises:
            ValueError: it is out of range, of another shape, or the control is ``"pose"``.
        """
        self.host.assist_root(share)

    def weigh_motions(self, weights: Any) -> None:
        """Set the weights by which later episodes of TrackMotion draw their motions; they are part of the state.

        Resets keep them. The motions and their order are ``task.motion_names`` of the host.

        Args:
            weights: of all motions, at least 0, shape ``(motions,)``, or of each environment, ``(num_envs, motions)``;
                a motion is drawn with its share of their sum. None draws all with equal probability, as at first.

        Raises:
            ValueError: a task that draws no motions, a wrong shape, or weights that are negative, not finite or all
                zero; nothing has changed then. The values of tensors are not checked on the host: where their sum is
                not positive, all motions are drawn with equal probability.
        """
        self.host.weigh_motions(weights)

    def apply_force(
        self,
        target: str,
        force: Any,
        point: Any = None,
        steps: int = 1,
        agent: str | None = None,
        envs: Any = None,
    ) -> None:
        """Let a constant force act on a bone or a prop, from the next step on; a reset ends it.

        Forces add up, at most :data:`~piavatar_envs.sim.forces.SLOTS` in an environment. The first call takes the time
        of a recording. See :mod:`piavatar_envs.sim.forces`.

        Args:
            target: a bone, by the name of its joint, or a prop.
            force: in the world [N], shape ``(3,)``, or one for every environment, ``(num_envs, 3)``.
            point: where it acts, in the world at the time of the call [m], shaped like ``force``; it moves with the
                target from there. The target's centre of mass if not given, of a bone as in the rest pose.
            steps: number of control steps.
            agent: whose bone it is, by name, where there are several agents; not for a prop.
            envs: environments in which it acts: a mask ``(num_envs,)`` bool, or indices; all if not given.

        Raises:
            ValueError: an unknown target, agent or environment, a wrong shape, type or device, less than one step, or
                (NumPy) a component that is not finite, or an environment with too many forces; nothing has changed
                then. The values of tensors are not checked on the host: such an environment ends with the failure
                ``"force"``.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        self.host.apply_force(target, force, point, steps, agent, envs)

    def read(self, name: str, agent: str | None = None) -> Array:
        """Return a copy of a quantity of the world by name, a row per environment; docs/scenes.md lists them.

        Quaternions are ``wxyz``. The names are those of :data:`piavatar_envs.api.readings.READINGS`.

        Args:
            name: of the quantity: ``"bone_position"``, ``"particle_position"``, ``"prop_velocity"``, ...
            agent: whose bones, by name, where there are several agents.

        Raises:
            ValueError: an unknown name or agent.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        return self.host.reading(name, agent)

    def get_state(self) -> dict[str, np.ndarray]:
        """Return everything that the future depends on; ``set_state()`` restores it, bit for bit.

        The first dimension of every array is the environment; a pending reset is part of it.
        """
        return self.host.get_state()


class SingleView(HostView):
    """Base of the views of one environment."""

    @property
    def batch(self) -> BatchEnv:
        """The environment on the device, a batch of one."""
        return self.host.groups[0]

    def read(self, name: str, agent: str | None = None) -> np.ndarray:
        """Return a NumPy copy of a quantity of the world by name; docs/scenes.md lists them.

        Quaternions are ``wxyz``. The names are those of :data:`piavatar_envs.api.readings.READINGS`.

        Args:
            name: of the quantity: ``"bone_position"``, ``"particle_position"``, ``"prop_velocity"``, ...
            agent: whose bones, by name, where there are several agents.

        Raises:
            ValueError: an unknown name or agent.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        return self.host.reading(name, agent)[0]

    def _observation(self, agent: int) -> Any:
        """Copy the observation of an agent, in the form that ``obs_mode`` has."""
        pictures = {name: values[0] for name, values in self.host.observed_pictures(agent).items()}
        return self.host.named(self.host.observation()[0, agent], pictures)

    def _info(self, agent: int, stepped: bool = False) -> dict[str, Any]:
        """Return the info of an agent as numbers and vectors; the outcome of a step is zero at a reset.

        A real number is a NumPy float64, which is a Python float and has the ``dtype`` that TorchRL's reader needs.
        """
        outcome = self.host.outcome(agent)
        if not stepped:
            outcome = {name: np.zeros_like(value) for name, value in outcome.items()}
        values = self.host.status(agent) | outcome
        return {name: _single(value[0]) for name, value in values.items()}

    def render(self) -> np.ndarray | None:
        """Draw the scene as ``(height, width, 3)`` uint8 with ``render_mode="rgb_array"``; else return None.

        With ``"human"`` resets and steps update the live view.

        Raises:
            ImportError: pictures have text, and Pillow is not installed (extra ``render``).
            gymnasium.error.ResetNeeded: before the first reset.
        """
        frames = self.host.render()
        return frames[0] if frames else None

    def close(self) -> None:
        """Free the renderer's window, and stop the live view; later calls are refused. Closing twice is fine."""
        self.host.close()


def json_form(value: Any) -> Any:
    """Return what JSON can hold instead of an argument of a view; a class of a task stays as it is."""
    if isinstance(value, Enum):
        return value.value
    if callable(value):
        return value
    try:
        return plain(value)
    except ConfigError:
        return str(value)  # a torch.device


def limited(config: Limited, name: str, steps: int | None) -> Limited:
    """Return a configuration whose episodes last ``steps`` control steps; the same one for None.

    Args:
        config: the settings.
        name: of the argument, for the message.
        steps: control steps until truncation, instead of ``episode_seconds``.

    Raises:
        ConfigError: more steps than an episode may have.
        ValueError: it is not a whole number, or less than 1.
    """
    if steps is None:
        return config
    check_count(name, steps, ", or None for episode_seconds")
    return replace_settings(config, episode_seconds=steps * config.physics.control_dt)


def checked_seed(seed: Any) -> int:
    """Return a seed as Gymnasium takes it, below 2^32.

    Raises:
        ValueError: a seed outside [0, 2^32).
        gymnasium.error.Error: it is not a whole number.
    """
    seed = int(seed) if isinstance(seed, np.integer) else seed
    if isinstance(seed, int):
        check_seeds(seed)  # first, because Gymnasium raises its own Error for a negative one
    seeding.np_random(seed)
    return seed


def _picture(group: BatchEnv, name: str, agent: int) -> wp.array:
    """Return the pictures that an agent of a group observes, ``(num_envs, height, width, channels)``."""
    assert group.pixels is not None
    return group.pixels.arrays[name][agent]


def _unbounded(size: int) -> gym.spaces.Box:
    """Return the space of all vectors of ``size`` float32."""
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def picture_spaces(settings: PixelsConfig) -> dict[str, gym.spaces.Box]:
    """Return the spaces of the observed pictures, by name."""

    def box(channels: int, highest: float, kind: type) -> gym.spaces.Box:
        return gym.spaces.Box(0, highest, (settings.height, settings.width, channels), kind)

    spaces = {"pixels": box(3, 255, np.uint8)}
    if settings.depth:
        spaces["depth"] = box(1, settings.farthest, np.float32)
    if settings.segmentation:
        spaces["segmentation"] = box(1, 255, np.uint8)  # the whole range of bytes, by which learners tell an image
    return spaces


def _single(value: np.ndarray | np.generic) -> Any:
    """Return a vector as it is, a real number as NumPy's float64, an integer or a truth value as Python's."""
    if np.ndim(value):
        return value
    return np.float64(value) if np.issubdtype(value.dtype, np.floating) else value.item()
