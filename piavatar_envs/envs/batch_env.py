"""THE step and reset: a batch of environments, everything on the device. The views in ``api/`` only reshape this."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from piavatar_envs.avatar.skeleton import BODY_PARTS, NUM_JOINTS, body_part_of_joint
from piavatar_envs.envs.actions import apply_actions, refuse_nonfinite
from piavatar_envs.envs.observations import (
    SELF_TERMS,
    ObservationLayout,
    clean_observation,
    clear_stress,
    observe_body,
    observe_stress,
    tracked_arrays,
)
from piavatar_envs.envs.simulation import Simulation
from piavatar_envs.mpm.program import Program
from piavatar_envs.tasks.base import Task

wp.set_module_options({"enable_backward": False})

AGENT = 0


class BatchEnv:
    """``num_envs`` copies of a task. Never resets by itself.

    Arrays live on ``device`` and are overwritten by the next call; copy what you keep. The second dimension counts the
    agents of an environment.

    Attributes:
        action: ``(num_envs, 1, action_size)`` float32, written by the caller before :meth:`step`.
        observation: ``(num_envs, 1, observation_size)`` float32.
        reward: ``(num_envs, 1)`` float32; terms: ``(num_envs, reward terms)``; metrics: ``(num_envs, metrics)``.
        terminated, truncated: ``(num_envs,)`` bool; success: ``(num_envs,)`` bool.
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
        self.simulation = Simulation(task.config, num_envs, device, task.domain())
        self.device = self.simulation.device
        self.action_spec = task.action_spec()
        self.layout = ObservationLayout((*SELF_TERMS, *task.observation_terms))
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

        self.mask, self.seed, self.episode = zeros(n, wp.bool), zeros(n, int), zeros(n, int)
        self.step_count = zeros(n, int)
        self.action = zeros((n, 1, self.action_spec.size), float)
        self.observation = zeros((n, 1, self.layout.size), float)
        self.reward = zeros((n, 1), float)
        self.terms = zeros((n, max(1, len(task.reward_terms))), float)
        self.metrics = zeros((n, max(1, len(task.metrics))), float)
        self.terminated, self.truncated, self.success = (zeros(n, wp.bool) for _ in range(3))
        self.action_map = self.action_spec.upload(self.config.physics.control_dt, task.limits(), device)
        part = body_part_of_joint()[self.simulation.particles.skin_joints[:, 0]]
        self.part = wp.array(part, dtype=int, device=device)

    def _record(self) -> None:
        n, sim = self.num_envs, self.simulation
        program = self.reset_program
        program.launch(begin_episode, n, [self.mask], [self.step_count, self.terminated, self.truncated, self.success])
        self.task.record_reset(self, program)
        sim.record_reset(program, self.mask)
        self._record_observation(program)
        self._record_observation(self.observe_program)

        program = self.step_program
        program.launch(refuse_nonfinite, (n, self.action_spec.size), [self.action, AGENT], [self.failure])
        reference = self.task.record_reference(self, program)
        drive = sim.avatar.state
        program.launch(
            apply_actions,
            (n, NUM_JOINTS),
            [self.action_map, self.action, AGENT, *reference, sim.avatar.tracked.rotation],
            [drive.goal_rotation, drive.goal_root],
        )
        sim.record_control_step(program)
        self.task.record_outcome(self, program)
        program.launch(
            end_step,
            n,
            [self.max_steps, self.failure, drive.let_go, self.terms],
            [self.step_count, self.reward, self.terminated, self.truncated],
        )
        self._record_observation(program)

    def _record_observation(self, program: Program) -> None:
        """Append what writes the observation; it changes nothing else."""
        n, sim = self.num_envs, self.simulation
        start = self.layout["stress"].slice.start
        program.launch(observe_body, (n, NUM_JOINTS), [AGENT, *tracked_arrays(sim.avatar.tracked)], [self.observation])
        program.launch(clear_stress, (n, len(BODY_PARTS)), [AGENT, start], [self.observation])
        program.launch(
            observe_stress,
            (n, sim.avatar.num_points),
            [
                sim.avatar.body, sim.model.particles, sim.state.F, self.part, AGENT, start,
                1.0 / self.config.physics.young_modulus,
            ],
            [self.observation],
        )  # fmt: skip
        if self.task.observation_terms:
            first = self.layout[self.task.observation_terms[0].name].slice.start
            self.task.record_observe(self, program, AGENT, first)
        program.launch(clean_observation, (n, 1, self.layout.size), [], [self.observation])

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
        if self.config.shape.randomize:
            self._draw_shapes(np.flatnonzero(mask))
        self.reset_program.run()
        return self.observation

    def _draw_shapes(self, envs: np.ndarray) -> None:
        """A random body for each of ``envs``, from its seed and episode; named parameters of the config are kept."""
        shape, asset = self.config.shape, self.simulation.asset
        for env in envs:
            rng = np.random.default_rng([int(self._seeds[env]), int(self._episodes[env])])
            parameters = asset.sample_parameters(rng, scale=shape.scale)
            for name, value in shape.parameters.items():
                parameters[asset.shape_names.index(name)] = value
            self.simulation.set_shape(int(env), parameters)

    def step(self) -> None:
        """Advance every environment by one control step under :attr:`action`."""
        self.step_program.run()

    def arrays(self) -> dict[str, wp.array]:
        """Every array a checkpoint holds, by name."""
        own = {
            name: getattr(self, name)
            for name in ("step_count", "seed", "episode", "terminated", "truncated", "success")
        }
        return (
            self.simulation.arrays()
            | {f"env.{name}": array for name, array in own.items()}
            | {f"task.{name}": array for name, array in self.task.arrays().items()}
        )

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as copies on the host."""
        state = {name: array.numpy().copy() for name, array in self.arrays().items()}
        if self.config.shape.randomize:
            state["shape.parameters"] = self.simulation.shape_parameters.copy()
        return state

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
        if self.config.shape.randomize:
            self.simulation.adopt_shapes(state["shape.parameters"])
        self._seeds = np.asarray(state["env.seed"]).view(np.uint32).astype(np.int64)
        self._episodes = np.asarray(state["env.episode"], np.int64).copy()
        self.observe_program.run()


@wp.kernel
def begin_episode(
    mask: wp.array(dtype=wp.bool),
    # out
    step_count: wp.array(dtype=int),
    terminated: wp.array(dtype=wp.bool),
    truncated: wp.array(dtype=wp.bool),
    success: wp.array(dtype=wp.bool),
):
    """Clocks and flags of the masked environments back to the start."""
    e = wp.tid()
    if mask[e]:
        step_count[e] = 0
        terminated[e] = False
        truncated[e] = False
        success[e] = False


@wp.kernel
def end_step(
    max_steps: int,
    failure: wp.array(dtype=int),
    let_go: wp.array(dtype=int),
    terms: wp.array2d(dtype=float),
    # in and out
    step_count: wp.array(dtype=int),
    # out
    reward: wp.array2d(dtype=float),
    terminated: wp.array(dtype=wp.bool),
    truncated: wp.array(dtype=wp.bool),
):
    """Sum the reward's terms, count the step, end the episode: a fall and a failure terminate, the clock truncates."""
    e = wp.tid()
    total = float(0.0)
    for n in range(terms.shape[1]):
        if not wp.isfinite(terms[e, n]):
            terms[e, n] = 0.0
        total += terms[e, n]
    reward[e, 0] = total
    step_count[e] = step_count[e] + 1
    terminated[e] = failure[e] != 0 or let_go[e] != 0 or terminated[e]
    truncated[e] = step_count[e] >= max_steps and not terminated[e]
