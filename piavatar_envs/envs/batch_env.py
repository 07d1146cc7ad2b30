"""Step and reset of a batch of environments, everything on the device. The views in ``api/`` only reshape it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.avatar.torque_control.controller import checked_assist
from piavatar_envs.core.launch_graph import LaunchGraph, compile_graphs
from piavatar_envs.core.rng import NUM_SEEDS
from piavatar_envs.envs.actions import apply_actions, apply_targets, apply_torques, follow_reference, refuse_nonfinite
from piavatar_envs.envs.episodes import (
    EpisodeArrays,
    begin_episode,
    clear_words,
    count_episodes,
    end_agent,
    end_step,
    find_ended,
    retire,
    seeds_as_int32,
)
from piavatar_envs.envs.observer import Observer
from piavatar_envs.envs.state import (
    SETTINGS,
    add_forces,
    check_arrays,
    check_settings,
    file_digests,
    has_forces,
    settings_rows,
)
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.checks import check_places
from piavatar_envs.sim.forces import Target
from piavatar_envs.sim.tuning import Tuning
from piavatar_envs.sim.world import Simulation

if TYPE_CHECKING:
    from piavatar_envs.envs.pixels import PixelObserver


def check_count(name: str, count: Any, otherwise: str = "") -> None:
    """Refuse a count that is not a whole number of at least 1.

    Args:
        name: of the count, for the message.
        count: the value.
        otherwise: appended to the message: another value that is accepted.

    Raises:
        ValueError: it is not a whole number, or less than 1.
    """
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise ValueError(f"{name}={count!r} must be a whole number, at least 1{otherwise}")


class BatchEnv(EpisodeArrays):
    """``num_envs`` copies of a task; nothing resets by itself.

    :meth:`reset` begins episodes, :meth:`step` advances all of them by one control step under :attr:`action`. Each runs
    a launch graph that is recorded once, in :meth:`_record_reset` and :meth:`_record_step`. For the arrays see
    :class:`~piavatar_envs.envs.episodes.EpisodeArrays`.

    Attributes:
        task: the task.
        config: its settings.
        control: ``"pose"``, ``"pd"`` or ``"torque"``.
        action_spec: the joints that act.
        action_map: from action components to joints, on the device.
        observer: writes the observation.
        pixels: draws the pictures that agents observe, or None.
        files: digests of the files that settings name.
        restarts: number of calls that made time jump: of :meth:`reset` and :meth:`set_state`.
    """

    def __init__(self, task: Task, num_envs: int = 1, device: str = "cpu", seed: int = 0) -> None:
        """Build everything; call :meth:`reset` before :meth:`step`.

        Raises:
            ConfigError: the task would place a prop outside the domain.
            ValueError: a bad device, batch or time step; see :class:`Simulation`.
        """
        check_count("num_envs", num_envs)
        self.task, self.config, self.control = task, task.config, task.config.control.mode
        simulation = Simulation(
            task.config,
            num_envs,
            device,
            task.domain(),
            task.scene,
            avatar_names=task.agent_names,
            largest_impulses=task.impulses(),
        )
        places = simulation.props.points, task.prop_places()
        check_places(simulation.domain, simulation.dx, task.scene.props, *places)
        self.action_spec = task.action_spec().under(self.control)
        if self.control == "torque":
            for controller in simulation.controllers:
                controller.release([joint_index(name) for name in self.action_spec.joints])
        self.observer = Observer(simulation, task)
        names = len(task.rewards), len(task.costs), len(task.metrics)
        max_steps = max(1, round(task.config.episode_seconds / task.config.physics.control_dt))
        super().__init__(simulation, self.observer.layout, self.action_spec.size, names, max_steps, seed)
        self.action_map = self.action_spec.upload(self.config.physics.control_dt, task.limits(), self.device)
        self.restarts, self.files = 0, file_digests(self.config)
        task.allocate_declared(self)
        task.allocate(self)
        self.observer.connect(self)
        self.pixels: PixelObserver | None = None
        if self.config.observes_pixels:
            from piavatar_envs.envs.pixels import PixelObserver  # the renderer, which other environments do without

            self.pixels = PixelObserver(self, task)
        self.reset_graph = LaunchGraph(self.device, condition=self.begins)
        self.step_graph, self.observe_graph = LaunchGraph(self.device), LaunchGraph(self.device)
        self.count_graph, self.ended_graph = LaunchGraph(self.device), LaunchGraph(self.device)
        self.end_forces_graph = LaunchGraph(self.device)
        self._record_reset()
        self._record_observation(self.observe_graph)
        self._record_step(self.step_graph)
        compile_graphs((self.reset_graph, self.step_graph, self.observe_graph, self.count_graph, self.ended_graph))

    # the reset

    def _record_reset(self) -> None:
        """Record the reset: find the environments that have ended, count their episodes, begin these."""
        n, sim, graph = self.num_envs, self.simulation, self.reset_graph
        self.ended_graph.launch(find_ended, n, [self.terminated, self.truncated], [self.mask])
        counters = [self.seeded, self.seed, self.episode, self.begins]
        self.count_graph.launch(count_episodes, n, [self.mask, self.new_seed], counters)

        clocks, flags = [self.step_count, self.head_start], [self.terminated, self.truncated, self.success, self.alive]
        graph.launch(begin_episode, (n, self.num_agents), [self.mask], [*clocks, *flags, self.begins])
        sim.record_randomization(graph, self.mask, self.seed, self.episode)
        for words in self.task.cleared_words():
            graph.launch(clear_words, words.shape, [self.mask], [words])
        self.task.record_reset(self, graph)
        sim.record_reset(graph, self.mask)
        self.observer.record_reset(graph, self.mask)
        self._record_observation(graph, self.mask)

    def reset(
        self, env_mask: np.ndarray | None = None, seeds: Sequence[int | None] | np.ndarray | None = None
    ) -> wp.array:
        """Begin new episodes.

        Args:
            env_mask: environments to reset, shape ``(num_envs,)`` bool; all if not given.
            seeds: new seeds of the environments, shape ``(num_envs,)``; those not reset keep theirs. Without seeds, or
                where one is None, an environment goes on to its next episode.

        Returns:
            The observation array, of all environments.

        Raises:
            ValueError: a mask or seeds of the wrong shape, or a seed outside 32 bits.
        """
        n = self.num_envs
        mask = np.ones(n, bool) if env_mask is None else np.asarray(env_mask)
        if mask.shape != (n,) or mask.dtype != bool:
            raise ValueError(f"env_mask has shape {mask.shape} and type {mask.dtype}; use ({n},) bool")
        if seeds is not None:
            given = np.array([seed is not None for seed in seeds])
            values = np.array([0 if seed is None else seed for seed in seeds], np.int64)
            if values.shape != (n,) or (values < 0).any() or (values >= NUM_SEEDS).any():
                raise ValueError(f"seeds={seeds} must have shape ({n},) and be in [0, 2^32)")
            self.new_seed.assign(seeds_as_int32(values))
            self.seeded.assign(mask & given)
        self.mask.assign(mask)
        self.restarts += 1
        self.begins.fill_(1)  # with an empty mask, too, the observations returned are the present ones
        return self.reset_masked()

    def find_ended(self) -> wp.array:
        """Write into :attr:`mask`, and return, the environments whose agents are all out or whose clock has run out.

        Nothing leaves the device.
        """
        self.ended_graph.run()
        return self.mask

    def reset_masked(self) -> wp.array:
        """Begin the next episode where :attr:`mask` is set; returns the observation array, of all environments.

        Nothing leaves the device, unless shapes are random and not from a pool: those are drawn on the host.
        """
        self.count_graph.run()
        self.simulation.shapes.draw(self.mask, self.seed, self.episode)
        self.reset_graph.run()
        if self.simulation.forces:
            self.end_forces_graph.run()
        self.simulation.shapes.mark_stale()
        return self.observation

    # the step

    def step(self) -> None:
        """Advance every environment by one control step under :attr:`action`."""
        self.step_graph.run()

    def _record_step(self, graph: LaunchGraph) -> None:
        """Record the step: actions to goals, the physics, the outcome, the observation."""
        n, sim = self.num_envs, self.simulation
        references = self.task.record_references(self, graph)
        for agent, (avatar, reference) in enumerate(zip(sim.avatars, references, strict=True)):
            graph.launch(refuse_nonfinite, (n, self.action_spec.size), [self.action, agent, self.alive], [self.failure])
            self._record_actions(graph, agent, avatar, reference)
            if self.num_agents > 1:
                graph.launch(retire, n, [agent, self.alive], [avatar.state.released])
        sim.record_step(graph)
        self.task.record_outcome(self, graph)
        for agent, avatar in enumerate(sim.avatars):
            graph.launch(
                end_agent,
                n,
                [agent, self.num_agents, self.failure, avatar.state.released, self.terms, self.cost_terms],
                [self.reward, self.cost, self.terminated, self.alive],
            )
        ends = [self.max_steps, self.terminated, self.head_start]
        graph.launch(end_step, n, ends, [self.step_count, self.truncated])
        self._record_observation(graph)

    def _record_actions(self, graph: LaunchGraph, agent: int, avatar: Avatar, reference: tuple) -> None:
        """Append the launches that turn an agent's action into its goal, relative to the reference pose."""
        bones, goal = (self.num_envs, NUM_JOINTS), [avatar.state.goal_rotation, avatar.state.goal_root]
        acting = [self.action_map, self.action, agent, self.alive]
        if self.control == "pose":
            graph.launch(apply_actions, bones, [*acting, *reference, avatar.tracked.rotation], goal)
            return
        command = [avatar.state.command_rotation, avatar.state.command_root]
        inputs = [int(not self.task.targets_about_reference), *reference, self.failure]
        graph.launch(follow_reference, bones, inputs, [*command, *goal])
        if self.control == "pd":
            graph.launch(apply_targets, bones, acting, goal[:1])
        else:
            joints = self.simulation.controllers[agent].joints
            graph.launch(apply_torques, bones, [*acting, joints.strength], [joints.state.torque])

    def _record_observation(self, graph: LaunchGraph, mask: wp.array | None = None) -> None:
        """Append the launches that write the observation and change nothing else; only ``mask`` was reset, if given."""
        self.observer.record_settings(graph)
        for agent in range(self.num_agents):
            self.observer.record(graph, agent, self.observation, mask)
            if self.task.terms():
                self.task.record_observe(self, graph, agent, self.observer.task_start)
            self.observer.record_parameters(graph, self, agent)
        self.observer.record_clean(graph, self.observation)
        if self.pixels:
            self.pixels.record(graph, mask)

    # state

    def assist_root(self, share: float | np.ndarray) -> None:
        """Set the share of root assistance from now on (``control.root_assist``); not for ``control="pose"``.

        Args:
            share: from 0, none, to 1; of all environments, or of each, shape ``(num_envs,)``. Resets leave it.

        Raises:
            ValueError: it is out of range, of another shape, or the pose is driven.
        """
        if self.control == "pose":
            raise ValueError('control="pose" has a root wrench; root_assist is for "pd" and "torque"')
        shares = checked_assist(share, self.num_envs)
        for controller in self.simulation.controllers:
            controller.assist.assign(shares)

    def enable_forces(self) -> None:
        """Record the step anew with external forces, unless it has them; takes the time of a recording, once.

        Before, steps have no launches for forces, and states no arrays of them.
        """
        if self.simulation.forces:
            return
        self.simulation.enable_forces().record_reset(self.end_forces_graph, self.mask)
        compile_graphs((self.end_forces_graph,))
        self._record_step_anew()

    def _record_step_anew(self) -> None:
        """Replace the graph of the step, whose launches hold the numbers of the time when they were recorded."""
        self.step_graph = LaunchGraph(self.device)
        self._record_step(self.step_graph)
        compile_graphs((self.step_graph,))

    @cached_property
    def tuning(self) -> Tuning:
        """Settings that may change while the world runs."""
        return Tuning(self.simulation)

    def tune(self, values: Mapping[str, float]) -> None:
        """Change settings of the running world, by their names; see :class:`~piavatar_envs.sim.tuning.Tuning`.

        Raises:
            ValueError: a value is out of range or needs an environment of its own; nothing has changed then.
        """
        if self.tuning.set(values):
            self._record_step_anew()

    def apply_force(self, target: Target, steps: int, at_point: bool) -> None:
        """Let the force in ``simulation.forces.call`` act for ``steps`` control steps, once forces are enabled.

        For the arguments see :meth:`piavatar_envs.sim.forces.Forces.add`. A reset ends it.
        """
        self.simulation.enable_forces().add(target, steps, at_point, self.failure)

    def arrays(self) -> dict[str, wp.array]:
        """Return every array of a checkpoint, by name."""
        clocks, flags = ("step_count", "head_start"), ("terminated", "truncated", "success", "alive")
        own = {name: getattr(self, name) for name in (*clocks, "seed", "episode", *flags)}
        return (
            self.simulation.arrays()
            | {f"env.{name}": array for name, array in (own | self.observer.arrays()).items()}
            | {f"task.{name}": array for name, array in self.task.arrays().items()}
        )

    def get_state(self) -> dict[str, np.ndarray]:
        """Copy everything that the future depends on to the host, the settings too."""
        state = {name: array.numpy().copy() for name, array in self.arrays().items()}
        state[SETTINGS] = settings_rows(self.config, self.num_envs, self.files)
        for avatar in self.simulation.shapes.of_host:
            state[f"shape.{avatar}"] = self.simulation.flesh[avatar].shape_parameters.copy()
        return state

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`get_state` returned; the observation follows. On the CPU the future is bit-identical.

        Raises:
            ValueError: it was saved under other settings, or arrays are missing, unknown, or of the wrong shape or
                type; nothing has changed then.
        """
        check_settings(state, self.config, self.files)
        if has_forces(state):
            self.enable_forces()
        present = self.get_state()
        state = state if has_forces(state) else add_forces(state, present)
        check_arrays(state, present)
        for name, array in self.arrays().items():
            array.assign(state[name])
        for avatar in self.simulation.shapes.of_host:
            self.simulation.shapes.adopt(avatar, state[f"shape.{avatar}"])
        self.simulation.shapes.mark_stale()
        self.restarts += 1
        self.observe_graph.run()
