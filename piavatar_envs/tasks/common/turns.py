"""Balls that are thrown in turn, one in every interval: when, and what is seen of it."""

from __future__ import annotations

import warp as wp

from piavatar_envs.core.rng import STREAM_BALL, generator
from piavatar_envs.tasks.common.throws import MASSES, Throws, throw_or_catch

wp.set_module_options({"enable_backward": False})

#: The draw of the first throw's time in the stream of the balls, before their masses; the throws come after those.
_TIME = wp.constant(0)


@wp.func
def first_throw(throws: Throws, seed: int, episode: int):
    """Control step of an episode's first throw, in the first half of an interval."""
    random = generator(seed, episode, STREAM_BALL, _TIME)
    return wp.randi(random, 1, throws.interval // 2 + 2)


@wp.func
def steps_to_throw(throws: Throws, first: int, step: int, ball: int):
    """Control steps from ``step`` to the next throw of a ball; 0 if it is thrown in this one."""
    period = throws.interval * throws.num_balls
    wait = (first + ball * throws.interval - step) % period
    return wp.where(wait < 0, wait + period, wait)


@wp.kernel
def throw_balls(
    throws: Throws,
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    step_count: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    joints: wp.array2d(dtype=wp.vec3),
    ball_position: wp.array2d(dtype=wp.vec3),
    ball_velocity: wp.array2d(dtype=wp.vec3),
    # out
    placed: wp.array2d(dtype=wp.bool),
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
    spin: wp.array2d(dtype=wp.vec3),
):
    """Which balls are placed anew before this step, and how; over ``(E, num_balls)``.

    One whose time has come is thrown from before the avatar at where its chest and head are now. One that has flown
    past is caught, and waits.
    """
    e, ball = wp.tid()
    placed[e, ball] = False
    if failure[e] != 0:
        return
    first = first_throw(throws, seed[e], episode[e])
    due = steps_to_throw(throws, first, step_count[e], ball) == 0
    number = (step_count[e] - first) // throws.interval
    random = generator(seed[e], episode[e], STREAM_BALL, MASSES + throws.num_balls + number)
    placed[e, ball] = throw_or_catch(
        throws, due, random, e, ball, joints, ball_position, ball_velocity, position, velocity, spin
    )


@wp.kernel
def observe_throws(
    throws: Throws,
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    step_count: wp.array(dtype=int),
    density: wp.array2d(dtype=float),
    control_dt: float,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Time to the next throw of every ball [s], then their masses [kg]; over ``(E, num_balls)``."""
    e, ball = wp.tid()
    first = first_throw(throws, seed[e], episode[e])
    steps = steps_to_throw(throws, first, step_count[e], ball)
    observation[e, agent, start + ball] = control_dt * float(steps)
    observation[e, agent, start + throws.num_balls + ball] = throws.volume * density[e, ball]
