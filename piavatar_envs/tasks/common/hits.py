"""Being hit: what thrown balls do to the avatar, as costs and as a count."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.avatar.body.skeleton import BODY_PARTS
from piavatar_envs.envs.observer import clear_stress, observe_stress
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.tasks.common.throws import Throws
from piavatar_envs.tasks.common.turns import first_throw, steps_to_throw

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})

#: Body parts whose stress counts, the first of ``BODY_PARTS``: all but the legs, whose soles the floor strains.
_ABOVE_LEGS = wp.constant(list(BODY_PARTS).index("left_leg"))


@wp.struct
class HitRule:
    """Constants of what a hit is and costs."""

    first: int  # subject of the first ball; the avatar is subject 0
    impulse: float  # in one step that counts as a hit [N s]
    impulse_scale: float  # that costs 1 [N s]
    stress_limit: float  # that costs nothing; twice that costs 1 [young_modulus]


class Hits:
    """What has hit the avatar of every environment.

    Attributes:
        struck: which balls have hit since they were thrown, shape ``(num_envs, num_balls)``.
        count: hits of the episode, shape ``(num_envs,)``.
    """

    def __init__(self, env: BatchEnv, throws: Throws) -> None:
        """Allocate; the balls are the first props of ``env``, whose task's configuration says what counts."""
        n, device, config = env.num_envs, env.device, env.task.config
        self.throws, self.rule = throws, HitRule()
        self.rule.first, self.rule.impulse = env.num_agents, config.hit_impulse
        self.rule.impulse_scale, self.rule.stress_limit = config.impulse_scale, config.stress_limit
        self.struck = wp.zeros((n, config.num_balls), dtype=int, device=device)
        self.count = wp.zeros(n, dtype=int, device=device)
        self._stress = wp.zeros((n, 1, len(BODY_PARTS)), dtype=float, device=device)
        self._part = wp.array(env.simulation.flesh[0].part, dtype=int, device=device)

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of a checkpoint, by name."""
        return {"struck": self.struck, "hits": self.count}

    def record_reset(self, env: BatchEnv, graph: LaunchGraph) -> None:
        """Append: nothing has hit in the masked environments."""
        graph.launch(forget_hits, self.struck.shape, [env.mask], [self.struck, self.count])

    def record_outcome(self, env: BatchEnv, graph: LaunchGraph) -> None:
        """Append: costs, the metrics from the third on, and success."""
        sim = env.simulation
        graph.launch(clear_stress, (env.num_envs, len(BODY_PARTS)), [env.observer.all_envs, 0, 0], [self._stress])
        graph.launch(
            observe_stress,
            env.num_envs * sim.avatar.num_points,
            [
                env.observer.all_envs, sim.avatar.body, sim.model.particles, sim.state.F, self._part, 0, 0,
                1.0 / sim.flesh[0].physics.young_modulus,
            ],
            [self._stress],
        )  # fmt: skip
        graph.launch(
            judge_hits,
            env.num_envs,
            [self.rule, self.throws, env.seed, env.episode, env.step_count, sim.sensors, self._stress],
            [self.struck, self.count, env.cost_terms, env.metrics, env.success],
        )


@wp.kernel
def forget_hits(
    mask: wp.array(dtype=wp.bool),
    # out
    struck: wp.array2d(dtype=int),
    count: wp.array(dtype=int),
):
    """Nothing has hit yet; over ``(E, num_balls)``."""
    e, ball = wp.tid()
    if mask[e]:
        struck[e, ball] = 0
        count[e] = 0


@wp.kernel
def judge_hits(
    rule: HitRule,
    throws: Throws,
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    step_count: wp.array(dtype=int),
    sensors: Sensors,
    stress: wp.array3d(dtype=float),
    # in and out
    struck: wp.array2d(dtype=int),
    count: wp.array(dtype=int),
    # out
    cost_terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
):
    """Cost of being hit. A ball counts once a throw; the step counter is still the one of the throw."""
    e = wp.tid()
    first = first_throw(throws, seed[e], episode[e])
    total = float(0.0)
    missed = bool(True)
    for ball in range(throws.num_balls):
        size = wp.length(sensors.pair_impulse[e, rule.first + ball])
        total += size
        if steps_to_throw(throws, first, step_count[e], ball) == 0:
            struck[e, ball] = 0
        if struck[e, ball] == 0 and size > rule.impulse:
            struck[e, ball] = 1
            count[e] = count[e] + 1
        missed = missed and struck[e, ball] == 0
    peak = float(0.0)
    for part in range(_ABOVE_LEGS):
        peak = wp.max(peak, stress[e, 0, part])
    cost_terms[e, 0, 0] = total / rule.impulse_scale
    cost_terms[e, 0, 1] = wp.max(peak / rule.stress_limit - 1.0, 0.0)
    metrics[e, 0, 2] = total
    metrics[e, 0, 3] = peak
    metrics[e, 0, 4] = float(count[e])
    success[e, 0] = missed
