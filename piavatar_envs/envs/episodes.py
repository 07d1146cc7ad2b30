"""Episodes of a batch: their arrays, and the kernels by which they begin, are counted and end."""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.types import Body
from piavatar_envs.core.rng import generator
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.observations import ObservationLayout, write_vector
from piavatar_envs.mpm.types import row
from piavatar_envs.sim.world import Simulation

wp.set_module_options({"enable_backward": False})


@wp.struct
class Episodes:
    """Clocks and flags of the environments, for kernels; see :class:`EpisodeArrays`."""

    mask: wp.array(dtype=wp.bool)
    seed: wp.array(dtype=int)
    episode: wp.array(dtype=int)
    step_count: wp.array(dtype=int)
    failure: wp.array(dtype=int)
    alive: wp.array2d(dtype=wp.bool)


@wp.struct
class Bones:
    """An avatar as kernels read it: the constants of its body, and its tracked bones, ``(num_envs, bones)``."""

    body: Body
    rotation: wp.array2d(dtype=wp.quat)  # in the world
    position: wp.array2d(dtype=wp.vec3)  # of the joint [m]
    velocity: wp.array2d(dtype=wp.vec3)  # [m/s]
    local: wp.array2d(dtype=wp.quat)  # relative to the parent bone


@wp.struct
class Props:
    """Motion of the props, ``(num_envs, num_props)``."""

    position: wp.array2d(dtype=wp.vec3)  # centre of mass [m]
    rotation: wp.array2d(dtype=wp.quat)  # rest frame to world
    velocity: wp.array2d(dtype=wp.vec3)  # [m/s]
    spin: wp.array2d(dtype=wp.vec3)  # angular velocity [rad/s]
    density: wp.array2d(dtype=float)  # [kg/m^3]


@wp.struct
class Outcome:
    """Results of a step, which a task writes; see :class:`EpisodeArrays`."""

    terms: wp.array3d(dtype=float)
    cost_terms: wp.array3d(dtype=float)
    metrics: wp.array3d(dtype=float)
    success: wp.array2d(dtype=wp.bool)
    terminated: wp.array2d(dtype=wp.bool)


@wp.func
def random_of(episodes: Episodes, e: int, stream: int, index: int):
    """Return the generator of random numbers ``index`` of a stream, of the present episode."""
    return generator(episodes.seed[e], episodes.episode[e], stream, index)


@wp.func
def rest_joint(body: Body, e: int, b: int):
    """Return the position of a joint in the rest pose [m]."""
    return body.rest_joint[row(e, body.rest_joint.shape[0]), b]


@wp.func
def write_in_root(observation: wp.array3d(dtype=float), e: int, agent: int, start: int, bones: Bones, v: wp.vec3):
    """Write a vector of the world, turned into the frame of the pelvis, from component ``start``."""
    write_vector(observation, e, agent, start, wp.quat_rotate(wp.quat_inverse(bones.rotation[e, 0]), v))


class EpisodeArrays:
    """Arrays of a batch of environments: all that a task reads and writes.

    They live on ``device`` and are overwritten by the next step or reset; copy what you keep. The second dimension
    counts the agents of an environment, one for each avatar.

    Attributes:
        simulation: the simulated world.
        layout: of the flat observation of an agent.
        num_envs, num_agents: number of environments, and of agents in each.
        device: the Warp device.
        max_steps: control steps until the clock runs out.
        mask: ``(num_envs,)`` bool, environments whose next episode begins.
        seed, episode: ``(num_envs,)`` int32, by which an episode draws its random numbers.
        step_count: ``(num_envs,)`` int32, control steps since the reset.
        head_start: ``(num_envs,)`` int32, control steps that the time limit is ahead of ``step_count``.
        action: ``(num_envs, num_agents, action_size)`` float32, written by the caller before a step.
        observation: ``(num_envs, num_agents, observation_size)`` float32.
        reward: ``(num_envs, num_agents)`` float32, the sum of ``terms`` ``(num_envs, num_agents, reward terms)``.
        cost: ``(num_envs, num_agents)`` float32, the sum of ``cost_terms``; not part of the reward.
        metrics: ``(num_envs, num_agents, metrics)`` float32.
        terminated, success: ``(num_envs, num_agents)`` bool.
        alive: ``(num_envs, num_agents)`` bool. Where there are several agents, one that has terminated stays in the
            world as a passive body: its actions count as zero (targets: the rest pose), nothing holds its root, its
            reward is zero.
        truncated: ``(num_envs,)`` bool, the clock has run out for agents that are still alive.
        episodes, outcome: the arrays that a task's kernels read and write, as structs.
        bones: tracked bones of every agent, as structs.
        props, first_props: motion of the props, now and after a reset, as structs.
    """

    def __init__(
        self,
        simulation: Simulation,
        layout: ObservationLayout,
        action_size: int,
        names: tuple[int, int, int],
        max_steps: int,
        seed: int = 0,
    ) -> None:
        """Allocate the arrays.

        Args:
            simulation: the simulated world.
            layout: of the flat observation of an agent.
            action_size: number of components of an agent's action.
            names: number of reward terms, cost terms and metrics.
            max_steps: control steps until the clock runs out.
            seed: of the first environment; the others count on from it.
        """
        self.simulation, self.layout, self.max_steps = simulation, layout, max_steps
        self.num_envs, self.num_agents = simulation.num_envs, len(simulation.avatars)
        self.device = simulation.device
        n, agents = self.num_envs, (self.num_envs, self.num_agents)
        self.mask, self.new_seed, self.seeded = self._zeros(n, wp.bool), self._zeros(n, int), self._zeros(n, wp.bool)
        self.begins = self._zeros(1, int)  # whether any episode does
        self.seed = wp.array(seeds_as_int32(seed + np.arange(n)), dtype=int, device=self.device)
        self.episode = wp.full(n, -1, dtype=int, device=self.device)
        self.step_count, self.head_start, self.truncated = (
            self._zeros(n, int),
            self._zeros(n, int),
            self._zeros(n, wp.bool),
        )
        self.action = self._zeros((*agents, action_size), float)
        self.observation = self._zeros((*agents, layout.size), float)
        self.reward, self.cost = self._zeros(agents, float), self._zeros(agents, float)
        # a launch takes no array without columns
        self.terms, self.cost_terms, self.metrics = (self._zeros((*agents, max(1, count)), float) for count in names)
        self.terminated, self.success, self.alive = (self._zeros(agents, wp.bool) for _ in range(3))
        props = simulation.props
        self.episodes, self.outcome = fill(Episodes(), self), fill(Outcome(), self)
        self.bones = [fill(Bones(), avatar.tracked, body=avatar.body) for avatar in simulation.avatars]
        self.props, self.first_props = (fill(Props(), motion, props) for motion in (props.state, props.initial))

    def _zeros(self, shape: int | tuple[int, ...], dtype: type) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    @property
    def failure(self) -> wp.array:
        """Bits ``FAILURE_*`` of every environment, ``(num_envs,)`` int32."""
        return self.simulation.state.failure


def seeds_as_int32(seeds: np.ndarray) -> np.ndarray:
    """Convert seeds in [0, 2^32) to the 32 bits that kernels read."""
    return np.asarray(seeds, np.int64).astype(np.uint32).view(np.int32)


@wp.kernel
def clear_words(
    mask: wp.array(dtype=wp.bool),
    # out
    words: wp.array2d(dtype=int),
):
    """Zero an array, read as 32-bit words, in the masked environments."""
    e, n = wp.tid()
    if mask[e]:
        words[e, n] = 0


@wp.kernel
def count_episodes(
    mask: wp.array(dtype=wp.bool),
    new_seed: wp.array(dtype=int),
    # in and out
    seeded: wp.array(dtype=wp.bool),
    # out
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    begins: wp.array(dtype=int),
):
    """Advance the episode count of the masked environments, from 0 after a new seed; flag that one ``begins``."""
    e = wp.tid()
    if not mask[e]:
        return
    begins[0] = 1
    episode[e] = episode[e] + 1
    if seeded[e]:
        seeded[e] = False
        seed[e] = new_seed[e]
        episode[e] = 0


@wp.kernel
def find_ended(
    terminated: wp.array2d(dtype=wp.bool),
    truncated: wp.array(dtype=wp.bool),
    # out
    mask: wp.array(dtype=wp.bool),
):
    """Set the mask where every agent has terminated or the clock has run out."""
    e = wp.tid()
    ended = bool(True)
    for agent in range(terminated.shape[1]):
        if not terminated[e, agent]:
            ended = False
    mask[e] = ended or truncated[e]


@wp.kernel
def begin_episode(
    mask: wp.array(dtype=wp.bool),
    # out
    step_count: wp.array(dtype=int),
    head_start: wp.array(dtype=int),
    terminated: wp.array2d(dtype=wp.bool),
    truncated: wp.array(dtype=wp.bool),
    success: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
    begins: wp.array(dtype=int),
):
    """Reset clocks and flags of the masked environments; clear ``begins``, which the graph has read by now."""
    e, agent = wp.tid()
    begins[0] = 0
    if mask[e]:
        step_count[e] = 0
        head_start[e] = 0
        truncated[e] = False
        terminated[e, agent] = False
        success[e, agent] = False
        alive[e, agent] = True


@wp.kernel
def retire(agent: int, alive: wp.array2d(dtype=wp.bool), released: wp.array(dtype=int)):
    """Release the root of an agent that is out."""
    e = wp.tid()
    if not alive[e, agent]:
        released[e] = 1


@wp.kernel
def end_agent(
    agent: int,
    num_agents: int,
    failure: wp.array(dtype=int),
    released: wp.array(dtype=int),
    terms: wp.array3d(dtype=float),
    cost_terms: wp.array3d(dtype=float),
    # out
    reward: wp.array2d(dtype=float),
    cost: wp.array2d(dtype=float),
    # in and out
    terminated: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
):
    """Sum the terms of an agent; a fall or a failure terminates it. Among several, one that is out earns nothing."""
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
    terminated[e, agent] = failure[e] != 0 or released[e] != 0 or terminated[e, agent] or out
    alive[e, agent] = not terminated[e, agent]


@wp.kernel
def end_step(
    max_steps: int,
    terminated: wp.array2d(dtype=wp.bool),
    head_start: wp.array(dtype=int),
    # in and out
    step_count: wp.array(dtype=int),
    # out
    truncated: wp.array(dtype=wp.bool),
):
    """Count the step; truncate where the clock has run out and an agent is still in."""
    e = wp.tid()
    step_count[e] = step_count[e] + 1
    left = int(0)
    for agent in range(terminated.shape[1]):
        if not terminated[e, agent]:
            left += 1
    truncated[e] = step_count[e] + head_start[e] >= max_steps and left > 0
