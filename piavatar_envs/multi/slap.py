"""Kernels of HighFive: where the hands are, and whether they have slapped."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.skeleton import BODY_PARTS
from piavatar_envs.avatar.types import Body
from piavatar_envs.envs.draws import STREAM_TASK, generator
from piavatar_envs.envs.observations import write_vector
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.multi.versus import part_impulse_by
from piavatar_envs.tasks.hands import LEFT_WRIST, RIGHT_WRIST, flesh_middle
from piavatar_envs.tasks.rewards import mean_square_action, tolerance

wp.set_module_options({"enable_backward": False})

_LEFT_ARM = wp.constant(list(BODY_PARTS).index("left_arm"))
#: Way that a hand which points straight down instead of straight up seems to have to go [m].
_TURN = wp.constant(0.4)


@wp.struct
class SlapRule:
    """Constants of what counts as a slap, and what it is worth."""

    window: float
    reach: float
    height: float
    upright: float
    margin: float
    approach_weight: float
    slap_bonus: float
    control_cost: float


@wp.struct
class Hands:
    """The hands that the two shall raise, in the world; ``(num_envs, 2)``."""

    middle: wp.array2d(dtype=wp.vec3)  # of the flesh [m]
    direction: wp.array2d(dtype=wp.vec3)  # unit vector from the wrist to the middle
    velocity: wp.array2d(dtype=wp.vec3)  # [m/s]


@wp.kernel
def draw_slap(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    sides: wp.vec2i,
    impulse: wp.vec2,
    # out
    side: wp.array(dtype=int),
    least: wp.array(dtype=float),
):
    """Which hands (0 left, 1 right) and the weakest slap that counts [N s], each between two bounds."""
    e = wp.tid()
    if mask[e]:
        random = generator(seed[e], episode[e], STREAM_TASK, 0)
        side[e] = wp.randi(random, sides[0], sides[1] + 1)
        least[e] = wp.randf(random, impulse[0], impulse[1])


@wp.kernel
def locate_hand(
    agent: int,
    body: Body,
    side: wp.array(dtype=int),
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
    # out
    hands: Hands,
):
    """Find the hand that an agent shall raise."""
    e = wp.tid()
    wrist = wp.where(side[e] == 0, LEFT_WRIST, RIGHT_WRIST)
    middle = flesh_middle(body, e, wrist, rotation, position)
    hands.middle[e, agent] = middle
    hands.direction[e, agent] = wp.normalize(middle - position[e, wrist])
    hands.velocity[e, agent] = velocity[e, wrist]


@wp.func
def arm_impulse(sensors: Sensors, e: int, agent: int, side: int):
    """Impulse of the other agent on the arm that an agent shall raise [N s]."""
    return wp.length(part_impulse_by(sensors, e, agent, _LEFT_ARM + side, 1 - agent))


@wp.kernel
def judge(
    rule: SlapRule,
    side: wp.array(dtype=int),
    least: wp.array(dtype=float),
    hands: Hands,
    sensors: Sensors,
    action: wp.array3d(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
    terminated: wp.array2d(dtype=wp.bool),
):
    """The same for both: how far the hands still have to go, and whether they have slapped."""
    e = wp.tid()
    distance = wp.length(hands.middle[e, 0] - hands.middle[e, 1])
    height = wp.min(hands.middle[e, 0][2], hands.middle[e, 1][2])
    upright = wp.min(hands.direction[e, 0][2], hands.direction[e, 1][2])
    # what has struck only one of the two arms is no slap
    impulse = wp.min(arm_impulse(sensors, e, 0, side[e]), arm_impulse(sensors, e, 1, side[e]))
    placed = distance <= rule.reach and height >= rule.height and upright >= rule.upright
    too_hard = impulse > rule.window * least[e]
    done = placed and impulse >= least[e] and not too_hard
    to_go = distance + wp.max(rule.height - height, 0.0) + 0.5 * _TURN * wp.max(rule.upright - upright, 0.0)
    control = 0.5 * (mean_square_action(action, e, 0) + mean_square_action(action, e, 1))
    for agent in range(2):
        terms[e, agent, 0] = rule.approach_weight * tolerance(to_go, rule.reach, rule.margin)
        terms[e, agent, 1] = wp.where(done, rule.slap_bonus, 0.0)
        terms[e, agent, 2] = -rule.control_cost * control
        metrics[e, agent, 0] = distance
        metrics[e, agent, 1] = height
        metrics[e, agent, 2] = upright
        metrics[e, agent, 3] = impulse
        success[e, agent] = done
        # a second chance after too hard a blow would make the upper bound a matter of patience
        terminated[e, agent] = done or too_hard


@wp.kernel
def observe_hands(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    hands: Hands,
    # out
    observation: wp.array3d(dtype=float),
):
    """The terms of ``HighFiveTask.observation_terms``, from component ``start``."""
    e = wp.tid()
    to_root = wp.quat_inverse(rotation[e, 0])
    own = hands.middle[e, agent]
    other = 1 - agent
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, own - position[e, 0]))
    write_vector(observation, e, agent, start + 3, wp.quat_rotate(to_root, hands.direction[e, agent]))
    write_vector(observation, e, agent, start + 6, wp.quat_rotate(to_root, hands.middle[e, other] - own))
    write_vector(observation, e, agent, start + 9, wp.quat_rotate(to_root, hands.velocity[e, other]))


@wp.kernel
def observe_draws(
    agent: int,
    side_at: int,
    least_at: int,
    side: wp.array(dtype=int),
    least: wp.array(dtype=float),
    # out
    observation: wp.array3d(dtype=float),
):
    """What was drawn for the episode; -1 where it has no place in the observation."""
    e = wp.tid()
    if side_at >= 0:
        observation[e, agent, side_at] = 2.0 * float(side[e]) - 1.0
    if least_at >= 0:
        observation[e, agent, least_at] = least[e]
