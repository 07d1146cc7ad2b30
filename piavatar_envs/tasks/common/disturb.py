"""Disturbances: impulses from random directions on random bones."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.skinning import bones_of, weights_of
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.rng import STREAM_DISTURBANCE, generator
from piavatar_envs.mpm.types import row

wp.set_module_options({"enable_backward": False})


@wp.func
def offset_of(seed: int, episode: int, interval: int):
    """How many steps of the first interval are over when an episode begins."""
    random = generator(seed, episode, STREAM_DISTURBANCE, 0)
    return wp.randi(random, 0, interval)


@wp.kernel
def draw_offset(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    interval: int,
    # out
    offset: wp.array(dtype=int),
):
    """The moment of the impulses, to be observed, in the masked environments."""
    e = wp.tid()
    if mask[e]:
        offset[e] = offset_of(seed[e], episode[e], interval)


@wp.kernel
def draw_impulse(
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    step_count: wp.array(dtype=int),
    interval: int,
    magnitude: float,
    bones: wp.array(dtype=int),
    # out
    impulse: wp.array(dtype=wp.vec3),
    struck: wp.array(dtype=int),
):
    """Every ``interval`` steps, at a moment of the episode's own, an impulse [N s] on one of ``bones``; else none."""
    e = wp.tid()
    impulse[e] = wp.vec3(0.0)
    struck[e] = bones[0]
    step = step_count[e] + offset_of(seed[e], episode[e], interval)
    if magnitude <= 0.0 or step % interval != interval - 1:
        return
    random = generator(seed[e], episode[e], STREAM_DISTURBANCE, 1 + step)
    direction = wp.sample_unit_sphere_surface(random)
    impulse[e] = magnitude * wp.randf(random, 0.3, 1.0) * direction
    struck[e] = bones[wp.randi(random, 0, bones.shape[0])]


@wp.kernel
def apply_impulse(
    body: Body,
    impulse: wp.array(dtype=wp.vec3),
    struck: wp.array(dtype=int),
    failure: wp.array(dtype=int),
    # in and out
    u: wp.array2d(dtype=wp.vec3),
):
    """Spread an impulse over the particles of the struck bone by their skinning weights; its sum is exact."""
    e, p = wp.tid()
    if failure[e] != 0:
        return
    b = struck[e]
    bones = bones_of(body.skin, p)
    weights = weights_of(body.skin, p)
    share = float(0.0)
    for n in range(4):
        if bones[n] == b:
            share += weights[n]
    if share > 0.0:
        mass = body.bone_mass[row(e, body.bone_mass.shape[0]), b]
        u[e, body.first + p] = u[e, body.first + p] + (share / mass) * impulse[e]
