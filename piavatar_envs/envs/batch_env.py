"""THE step and reset: a batch of environments, everything on the device. The views in ``api/`` only reshape this."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.envs.actions import apply_actions, refuse_nonfinite
from piavatar_envs.envs.observer import Observer
from piavatar_envs.envs.simulation import Simulation
from piavatar_envs.mpm.program import Program
from piavatar_envs.tasks.base import Task

wp.set_module_options({"enable_backward": False})


class BatchEnv:
    """``num_envs`` copies of a task. Never resets by itself.

    Arrays live on ``device`` and are overwritten by the next call; copy what you keep. The second dimension counts the
    agents of an environment, one for each avatar.

    Attributes:
        action: ``(num_envs, num_agents, action_size)`` float32, written by the caller before :meth:`step`.
        observation: ``(num_envs, num_agents, observation_size)`` float32.
        reward: ``(num_envs, num_agents)`` float32, the sum of ``terms`` ``(num_envs, num_agents, reward terms)``.
        cost: ``(num_envs, num_agents)`` float32, the sum of ``cost_terms``; not part of the reward.
        metrics: ``(num_envs, num_agents, metrics)`` float32.
        terminated, success: ``(num_envs, num_agents)`` bool.
        alive: ``(num_envs, num_agents)`` bool. Where there are several agents, one that has terminated stays in the
            world as a passive body: its actions count as zero, nothing holds its root, its reward is zero.
        truncated: ``(num_envs,)`` bool, the clock has run out for those still alive.
        failure: ``(num_envs,)`` int32, bits ``FAILURE_*``.
    """

    def __init__(self, task: Task, num_envs: int = 1, device: str = "cpu", seed: int = 0) -> None:
        """Build everything; call :meth:`reset` before :meth:`step`.

        Raises:
            ValueError: a bad device, batch or time step; see :class:`Simulation`.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1")
        self.task, self.config, self.num_envs = task, task.config, num_envs
        self.simulation = Simulation(
            task.config, num_envs, device, task.domain(), task.scene, avatar_names=task.agent_names
        )
        self.device, self.num_agents = self.simulation.device, len(self.simulation.avatars)
        self.action_spec = task.action_spec()
        self.observer = Observer(self.simulation, task)
        self.layout = self.observer.layout
        self.max_steps = max(1, round(task.config.episode_seconds / task.config.physics.control_dt))
        self._seeds = np.arange(seed, seed + num_envs, dtype=np.int64)
        self._episodes = np.full(num_envs, -1, np.int64)
        self._allocate()
        task.allocate(self)
        self.reset_program, self.step_program, self.observe_program = (Program(self.device) for _ in range(3))
        self._record()

    @property
    def failure(self) -> wp.array:
        """Bits ``FAILURE_*`` of every environment."""
        return self.simulation.state.failure

    def _allocate(self) -> None:
        n, device, task = self.num_envs, self.device, self.task

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        agents = (n, self.num_agents)
        self.mask, self.seed, self.episode = zeros(n, wp.bool), zeros(n, int), zeros(n, int)
        self.step_count, self.truncated = zeros(n, int), zeros(n, wp.bool)
        self.action = zeros((*agents, self.action_spec.size), float)
        self.observation = zeros((*agents, self.layout.size), float)
        self.reward, self.cost = zeros(agents, float), zeros(agents, float)
        self.terms = zeros((*agents, max(1, len(task.reward_terms))), float)
        self.cost_terms = zeros((*agents, max(1, len(task.cost_terms))), float)
        self.metrics = zeros((*agents, max(1, len(task.metrics))), float)
        self.terminated, self.success, self.alive = (zeros(agents, wp.bool) for _ in range(3))
        self.action_map = self.action_spec.upload(self.config.physics.control_dt, task.limits(), device)

    def _record(self) -> None:
        n, sim = self.num_envs, self.simulation
        agents = (n, self.num_agents)
        program = self.reset_program
        flags = [self.step_count, self.terminated, self.truncated, self.success, self.alive]
        program.launch(begin_episode, agents, [self.mask], flags)
        self.task.record_reset(self, program)
        sim.record_reset(program, self.mask)
        self._record_observation(program)
        self._record_observation(self.observe_program)

        program = self.step_program
        references = self.task.record_references(self, program)
        for agent, (avatar, reference) in enumerate(zip(sim.avatars, references, strict=True)):
            program.launch(
                refuse_nonfinite, (n, self.action_spec.size), [self.action, agent, self.alive], [self.failure]
            )
            program.launch(
                apply_actions,
                (n, NUM_JOINTS),
                [self.action_map, self.action, agent, self.alive, *reference, avatar.tracked.rotation],
                [avatar.state.goal_rotation, avatar.state.goal_root],
            )
            if self.num_agents > 1:
                program.launch(retire, n, [agent, self.alive], [avatar.state.let_go])
        sim.record_control_step(program)
        self.task.record_outcome(self, program)
        for agent, avatar in enumerate(sim.avatars):
            program.launch(
                end_agent,
                n,
                [agent, self.num_agents, self.failure, avatar.state.let_go, self.terms, self.cost_terms],
                [self.reward, self.cost, self.terminated, self.alive],
            )
        program.launch(end_step, n, [self.max_steps, self.terminated], [self.step_count, self.truncated])
        self._record_observation(program)

    def _record_observation(self, program: Program) -> None:
        """Append what writes the observation; it changes nothing else."""
        for agent in range(self.num_agents):
            self.observer.record(program, agent, self.observation)
            if self.task.terms():
                self.task.record_observe(self, program, agent, self.observer.task_start)
        self.observer.record_clean(program, self.observation)

    def reset(self, env_mask: np.ndarray | None = None, seeds: Sequence[int] | np.ndarray | None = None) -> wp.array:
        """Begin new episodes.

        Args:
            env_mask: environments to reset, shape ``(num_envs,)`` bool; all if not given.
            seeds: new seeds of the environments, shape ``(num_envs,)``; those not reset keep theirs. Without seeds an
                environment goes on to its next episode.

        Returns:
            The observation array, of all environments.

        Raises:
            ValueError: a mask or seeds of the wrong shape, or a seed outside 32 bits.
        """
        mask = np.ones(self.num_envs, bool) if env_mask is None else np.asarray(env_mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"env_mask has shape {mask.shape} and type {mask.dtype}; use ({self.num_envs},) bool")
        if seeds is not None:
            seeds = np.asarray(seeds, np.int64)
            if seeds.shape != (self.num_envs,) or (seeds < 0).any() or (seeds >= 2**32).any():
                raise ValueError(f"seeds={seeds} must have shape ({self.num_envs},) and be in [0, 2^32)")
            self._seeds = np.where(mask, seeds, self._seeds)
            self._episodes = np.where(mask, 0, self._episodes)
        else:
            self._episodes = np.where(mask, self._episodes + 1, self._episodes)
        self.mask.assign(mask)
        self.seed.assign(self._seeds.astype(np.uint32).view(np.int32))
        self.episode.assign(self._episodes.astype(np.int32))
        self._draw_shapes(np.flatnonzero(mask))
        self.reset_program.run()
        return self.observation

    def _draw_shapes(self, envs: np.ndarray) -> None:
        """Random bodies for ``envs``, from their seeds and episodes, for the avatars whose shape is random."""
        for avatar, flesh in enumerate(self.simulation.flesh):
            for env in envs if flesh.shape.randomize else ():
                key = [int(self._seeds[env]), int(self._episodes[env])]
                rng = np.random.default_rng([*key, avatar] if avatar else key)
                self.simulation.set_shape(int(env), flesh.draw_parameters(rng), avatar)

    def step(self) -> None:
        """Advance every environment by one control step under :attr:`action`."""
        self.step_program.run()

    def arrays(self) -> dict[str, wp.array]:
        """Every array a checkpoint holds, by name."""
        own = {
            name: getattr(self, name)
            for name in ("step_count", "seed", "episode", "terminated", "truncated", "success", "alive")
        }
        return (
            self.simulation.arrays()
            | {f"env.{name}": array for name, array in own.items()}
            | {f"task.{name}": array for name, array in self.task.arrays().items()}
        )

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as copies on the host."""
        state = {name: array.numpy().copy() for name, array in self.arrays().items()}
        for avatar in self._random_shapes():
            state[f"shape.{avatar}"] = self.simulation.flesh[avatar].shape_parameters.copy()
        return state

    def _random_shapes(self) -> list[int]:
        """Avatars whose shape is random."""
        return [index for index, flesh in enumerate(self.simulation.flesh) if flesh.shape.randomize]

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`get_state` returned; the observation follows. On the CPU the future is bit-identical.

        Raises:
            ValueError: arrays are missing, unknown, or of the wrong shape or type; nothing has changed then.
        """
        present = self.get_state()
        if set(state) != set(present):
            missing, unknown = sorted(set(present) - set(state)), sorted(set(state) - set(present))
            raise ValueError(f"the state is of another environment: missing {missing}, unknown {unknown}")
        for name, have in present.items():
            if np.shape(state[name]) != have.shape or np.asarray(state[name]).dtype != have.dtype:
                raise ValueError(
                    f"state[{name!r}] has shape {np.shape(state[name])} and type {np.asarray(state[name]).dtype}, "
                    f"expected {have.shape} and {have.dtype}"
                )
        for name, array in self.arrays().items():
            array.assign(state[name])
        for avatar in self._random_shapes():
            self.simulation.adopt_shapes(avatar, state[f"shape.{avatar}"])
        self._seeds = np.asarray(state["env.seed"]).view(np.uint32).astype(np.int64)
        self._episodes = np.asarray(state["env.episode"], np.int64).copy()
        self.observe_program.run()


@wp.kernel
def begin_episode(
    mask: wp.array(dtype=wp.bool),
    # out
    step_count: wp.array(dtype=int),
    terminated: wp.array2d(dtype=wp.bool),
    truncated: wp.array(dtype=wp.bool),
    success: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
):
    """Clocks and flags of the masked environments back to the start."""
    e, agent = wp.tid()
    if mask[e]:
        step_count[e] = 0
        truncated[e] = False
        terminated[e, agent] = False
        success[e, agent] = False
        alive[e, agent] = True


@wp.kernel
def retire(agent: int, alive: wp.array2d(dtype=wp.bool), let_go: wp.array(dtype=int)):
    """Nothing holds the root of an agent that is out."""
    e = wp.tid()
    if not alive[e, agent]:
        let_go[e] = 1


@wp.kernel
def end_agent(
    agent: int,
    num_agents: int,
    failure: wp.array(dtype=int),
    let_go: wp.array(dtype=int),
    terms: wp.array3d(dtype=float),
    cost_terms: wp.array3d(dtype=float),
    # out
    reward: wp.array2d(dtype=float),
    cost: wp.array2d(dtype=float),
    # in and out
    terminated: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
):
    """Sum the terms of an agent; a fall and a failure terminate it. What is out among several earns nothing."""
    e = wp.tid()
    out = num_agents > 1 and not alive[e, agent]
    total = float(0.0)
    for n in range(terms.shape[2]):
        if out or not wp.isfinite(terms[e, agent, n]):
            terms[e, agent, n] = 0.0
        total += terms[e, agent, n]
    reward[e, agent] = total
    total = float(0.0)
    for n in range(cost_terms.shape[2]):
        if out or not wp.isfinite(cost_terms[e, agent, n]):
            cost_terms[e, agent, n] = 0.0
        total += cost_terms[e, agent, n]
    cost[e, agent] = total
    terminated[e, agent] = failure[e] != 0 or let_go[e] != 0 or terminated[e, agent] or out
    alive[e, agent] = not terminated[e, agent]


@wp.kernel
def end_step(
    max_steps: int,
    terminated: wp.array2d(dtype=wp.bool),
    # in and out
    step_count: wp.array(dtype=int),
    # out
    truncated: wp.array(dtype=wp.bool),
):
    """Count the step; the clock truncates where an agent is still in."""
    e = wp.tid()
    step_count[e] = step_count[e] + 1
    left = int(0)
    for agent in range(terminated.shape[1]):
        if not terminated[e, agent]:
            left += 1
    truncated[e] = step_count[e] >= max_steps and left > 0
