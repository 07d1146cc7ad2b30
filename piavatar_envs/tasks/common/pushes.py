"""Pushes: a ball that is thrown at the body at moments nobody can foresee, and what impulse it has given."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.core.rng import STREAM_BALL, STREAM_DISTURBANCE, generator
from piavatar_envs.envs.observations import write_vector
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.tasks.common.throws import Throws, record_balls, throw_or_catch

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})

#: The ball is the only one: prop 0, and the subject after the avatar.
_BALL, _SUBJECT = wp.constant(0), wp.constant(1)
#: Draws of the stream before those of the throws: the ball's mass comes among them.
_THROWS = wp.constant(2)


@wp.func
def moment_of(throws: Throws, seed: int, episode: int, number: int):
    """Control step of a push: in every interval one, somewhere in its first half, never in its first step."""
    random = generator(seed, episode, STREAM_DISTURBANCE, number)
    return number * throws.interval + wp.randi(random, 1, throws.interval // 2 + 2)


@wp.kernel
def forget_pushes(
    mask: wp.array(dtype=wp.bool),
    # out
    flying: wp.array(dtype=int),
    push: wp.array(dtype=wp.vec3),
    strongest: wp.array(dtype=float),
):
    """No push yet in the masked environments."""
    e = wp.tid()
    if mask[e]:
        flying[e] = 0
        push[e] = wp.vec3(0.0)
        strongest[e] = 0.0


@wp.kernel
def throw_push(
    throws: Throws,
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    step_count: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    joints: wp.array2d(dtype=wp.vec3),
    ball_position: wp.array2d(dtype=wp.vec3),
    ball_velocity: wp.array2d(dtype=wp.vec3),
    # out
    placed: wp.array(dtype=wp.bool),
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
    spin: wp.array2d(dtype=wp.vec3),
):
    """Whether the ball is placed anew before this step: thrown if its moment has come, caught if it flies on."""
    e = wp.tid()
    placed[e] = False
    if failure[e] != 0:
        return
    number = step_count[e] // throws.interval
    due = step_count[e] == moment_of(throws, seed[e], episode[e], number)
    random = generator(seed[e], episode[e], STREAM_BALL, _THROWS + number)
    placed[e] = throw_or_catch(
        throws, due, random, e, _BALL, joints, ball_position, ball_velocity, position, velocity, spin
    )


@wp.kernel
def begin_push(
    placed: wp.array(dtype=wp.bool),
    velocity: wp.array2d(dtype=wp.vec3),
    # in and out
    flying: wp.array(dtype=int),
    push: wp.array(dtype=wp.vec3),
):
    """A ball that has been placed flies if it has been thrown, and waits if it has been caught."""
    e = wp.tid()
    if placed[e]:
        flying[e] = 0
        if wp.length_sq(velocity[e, _BALL]) > 0.0:
            flying[e] = 1
            push[e] = wp.vec3(0.0)


@wp.kernel
def judge_push(
    first: int,
    sensors: Sensors,
    # in and out
    push: wp.array(dtype=wp.vec3),
    strongest: wp.array(dtype=float),
    # out
    metrics: wp.array3d(dtype=float),
):
    """Metrics of the pushes, from number ``first``: impulse of the step, of the last throw so far, the greatest."""
    e = wp.tid()
    impulse = sensors.pair_impulse[e, _SUBJECT]
    push[e] = push[e] + impulse
    strongest[e] = wp.max(strongest[e], wp.length(push[e]))
    metrics[e, 0, first] = wp.length(impulse)
    metrics[e, 0, first + 1] = wp.length(push[e])
    metrics[e, 0, first + 2] = strongest[e]


@wp.kernel
def need_push(strongest: wp.array(dtype=float), least: float, success: wp.array2d(dtype=wp.bool)):
    """Nobody has withstood a push that has not come."""
    e = wp.tid()
    success[e, 0] = success[e, 0] and strongest[e] >= least


@wp.kernel
def observe_push(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
    flying: wp.array(dtype=int),
    ball_position: wp.array2d(dtype=wp.vec3),
    ball_velocity: wp.array2d(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """The ball from the pelvis, and its velocity relative to it, while it has been thrown; else zeros."""
    e = wp.tid()
    way = wp.vec3(0.0)
    speed = wp.vec3(0.0)
    if flying[e] != 0:
        way = wp.quat_rotate_inv(rotation[e, 0], ball_position[e, _BALL] - position[e, 0])
        speed = wp.quat_rotate_inv(rotation[e, 0], ball_velocity[e, _BALL] - velocity[e, 0])
    write_vector(observation, e, agent, start, way)
    write_vector(observation, e, agent, start + 3, speed)


class Pushes:
    """The ball of every environment.

    Attributes:
        flying: 1 from a throw until the ball is caught, shape ``(num_envs,)``.
        push: impulse on the body since the ball was thrown last [N s].
        strongest: greatest size of that in the episode [N s].
    """

    def __init__(self, env: BatchEnv, throws: Throws) -> None:
        """Allocate; the ball is the first prop of ``env``."""
        n, device = env.num_envs, env.device
        self.throws = throws
        self.flying = wp.zeros(n, dtype=int, device=device)
        self.push = wp.zeros(n, dtype=wp.vec3, device=device)
        self.strongest = wp.zeros(n, dtype=float, device=device)
        self._placed = wp.zeros(n, dtype=wp.bool, device=device)

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of a checkpoint, by name."""
        return {"flying": self.flying, "push": self.push, "strongest": self.strongest}

    def record_reset(self, env: BatchEnv, graph: LaunchGraph) -> None:
        """Append: in the masked environments the ball is given its mass, and waits."""
        record_balls(env, graph, self.throws)
        graph.launch(forget_pushes, env.num_envs, [env.mask], [self.flying, self.push, self.strongest])

    def record_throw(self, env: BatchEnv, graph: LaunchGraph) -> None:
        """Append, before the physics: throw the ball, or catch it."""
        n, props, tracked = env.num_envs, env.simulation.props, env.simulation.avatar.tracked
        graph.launch(
            throw_push,
            n,
            [
                self.throws, env.seed, env.episode, env.step_count, env.failure, tracked.position,
                props.state.position, props.state.velocity,
            ],
            [self._placed, props.spawn.position, props.spawn.velocity, props.spawn.spin],
        )  # fmt: skip
        graph.launch(begin_push, n, [self._placed, props.spawn.velocity], [self.flying, self.push])
        props.record_place(graph, env.simulation.state, self._placed, 0)

    def record_outcome(self, env: BatchEnv, graph: LaunchGraph, first: int, least: float) -> None:
        """Append: three metrics from number ``first``; no success before a push of ``least`` [N s]."""
        n, sensors = env.num_envs, env.simulation.sensors
        graph.launch(judge_push, n, [first, sensors], [self.push, self.strongest, env.metrics])
        graph.launch(need_push, n, [self.strongest, least], [env.success])

    def record_observe(self, env: BatchEnv, graph: LaunchGraph, agent: int, start: int) -> None:
        """Append: the ball's position and velocity from component ``start``, as long as it flies."""
        tracked, ball = env.simulation.avatars[agent].tracked, env.simulation.props.state
        graph.launch(
            observe_push,
            env.num_envs,
            [
                agent, start, tracked.rotation, tracked.position, tracked.velocity, self.flying, ball.position,
                ball.velocity,
            ],
            [env.observation],
        )  # fmt: skip
