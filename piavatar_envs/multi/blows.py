"""Points by blows: who has struck whom, where and how hard, from the impulses that body parts feel."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.skeleton import BODY_PARTS
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.multi.versus import part_impulse_by

wp.set_module_options({"enable_backward": False})

_PARTS = tuple(BODY_PARTS)
_HEAD, _TORSO = wp.constant(_PARTS.index("head")), wp.constant(_PARTS.index("torso"))
_LEFT_ARM, _RIGHT_ARM = wp.constant(_PARTS.index("left_arm")), wp.constant(_PARTS.index("right_arm"))
#: Share of the impulse that counts for nothing, below which a contact is over.
RELEASE = wp.constant(0.5)


@wp.struct
class Scale:
    """What a blow is worth."""

    least: float  # impulse up to which it counts for nothing, half of a full one [N s]
    points: wp.vec2  # of a full blow on head and trunk


@wp.struct
class Tally:
    """What has been counted, over ``(num_envs, num_agents, ...)``."""

    impulse: wp.array3d(dtype=wp.vec2)  # of an agent on head and trunk of another in the last step [N s]
    peak: wp.array3d(dtype=wp.vec2)  # the greatest since this contact began [N s]
    points: wp.array3d(dtype=float)  # what the last step was worth
    score: wp.array2d(dtype=float)  # sum of an agent's points in this bout


@wp.kernel
def begin_bout(
    mask: wp.array(dtype=wp.bool),
    # out
    peak: wp.array3d(dtype=wp.vec2),
    score: wp.array2d(dtype=float),
):
    """No blows and no points so far."""
    e, agent = wp.tid()
    if mask[e]:
        score[e, agent] = 0.0
        for other in range(peak.shape[2]):
            peak[e, agent, other] = wp.vec2(0.0, 0.0)


@wp.func
def landed(sensors: Sensors, e: int, agent: int, other: int):
    """Impulse of ``agent`` on head and trunk of ``other`` [N s], as far as its own arms have felt it."""
    left = part_impulse_by(sensors, e, agent, _LEFT_ARM, other)
    right = part_impulse_by(sensors, e, agent, _RIGHT_ARM, other)
    arms = wp.length(left) + wp.length(right)
    head = wp.length(part_impulse_by(sensors, e, other, _HEAD, agent))
    torso = wp.length(part_impulse_by(sensors, e, other, _TORSO, agent))
    return wp.vec2(wp.min(head, arms), wp.min(torso, arms))


@wp.func
def worth(scale: Scale, impulse: wp.vec2):
    """Points of blows of these impulses [N s] on head and trunk."""
    full = impulse / scale.least - wp.vec2(1.0, 1.0)
    return wp.dot(scale.points, wp.vec2(wp.clamp(full[0], 0.0, 1.0), wp.clamp(full[1], 0.0, 1.0)))


@wp.kernel
def count_points(
    scale: Scale,
    alive: wp.array2d(dtype=wp.bool),
    failure: wp.array(dtype=int),
    sensors: Sensors,
    # in and out
    peak: wp.array3d(dtype=wp.vec2),
    score: wp.array2d(dtype=float),
    # out
    impulse: wp.array3d(dtype=wp.vec2),
    points: wp.array3d(dtype=float),
):
    """Points of every agent on every other: a contact counts once, by its greatest impulse, as that is reached."""
    e, agent = wp.tid()
    for other in range(alive.shape[1]):
        now = wp.vec2(0.0, 0.0)
        if other != agent and failure[e] == 0:
            now = landed(sensors, e, agent, other)
        before = peak[e, agent, other]
        most = wp.max(now, before)
        gain = worth(scale, most) - worth(scale, before)
        if not (alive[e, agent] and alive[e, other]):
            gain = 0.0
        points[e, agent, other] = gain
        score[e, agent] = score[e, agent] + gain
        impulse[e, agent, other] = now
        # who stays in touch has not struck again
        for target in range(2):
            if now[target] < RELEASE * scale.least:
                most[target] = 0.0
        peak[e, agent, other] = most


@wp.func
def leads(e: int, agent: int, alive: wp.array2d(dtype=wp.bool), score: wp.array2d(dtype=float)):
    """Whether nobody else who is in has as many points."""
    best = bool(alive.shape[1] > 1)
    for other in range(alive.shape[1]):
        if other != agent and alive[e, other] and score[e, other] >= score[e, agent]:
            best = False
    return best
