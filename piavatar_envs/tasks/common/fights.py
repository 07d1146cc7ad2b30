"""What fights have in common: a circle to stand on, a stance, a referee, and the last one in."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion.keyframes import Key, animate
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import AvatarConfig, ConfigError, SceneConfig, replace
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.mpm.types import Sensors, row
from piavatar_envs.tasks.common.cooperation import record_shift
from piavatar_envs.tasks.common.fall import FallConfig, heights_of, is_down, least_heights
from piavatar_envs.tasks.common.spawn import record_standing

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})

_LEFT_ANKLE, _RIGHT_ANKLE = wp.constant(joint_index("left_ankle")), wp.constant(joint_index("right_ankle"))
NUM_PARTS = wp.constant(len(BODY_PARTS))

#: Where there are more than two: who is still in, counted on from oneself. Of two, the other always is.
OTHERS_IN = "others_in"


def circle_radius(count: int, apart: float) -> float:
    """Radius of a circle on which ``count`` stand ``apart`` from their neighbours [m]."""
    return 0.5 * apart / math.sin(math.pi / count) if count > 1 else 0.5 * apart


def on_circle(scene: SceneConfig, count: int, apart: float) -> SceneConfig:
    """The scene with ``count`` avatars around the origin, facing it, unless it places them itself.

    Raises:
        ConfigError: it places another number of them.
    """
    if scene.avatars:
        if len(scene.avatars) != count:
            raise ConfigError(
                f"scene.avatars has {len(scene.avatars)} entries and num_agents={count}; give as many, or none"
            )
        return scene
    radius, avatars = circle_radius(count, apart), []
    for index in range(count):
        turn = 2.0 * math.pi * index / count
        x, y = (round(radius * value, 6) + 0.0 for value in (-math.sin(turn), math.cos(turn)))  # no minus zero
        avatars.append(AvatarConfig(position=(x, y), yaw=turn))
    return replace(scene, avatars=avatars)


#: What is observed of the ring, whose centre is the origin.
RING_CENTRE = ObservationTerm("ring_centre", 3, "m", "root", "centre of the ring, on the ground, from the pelvis")


def others_in_terms(count: int) -> tuple[ObservationTerm, ...]:
    """What is observed of who is still in, among ``count`` agents."""
    if count < 3:
        return ()
    return (ObservationTerm(OTHERS_IN, count - 1, "-", "-", "1 for each of the others that is still in"),)


class Stance:
    """A pose to start from, feet on the ground whatever the body's shape.

    Attributes:
        local_rotations: of all joints, wxyz, the root's relative to the heading, shape ``(22, 4)``.
    """

    def __init__(self, key: Key) -> None:
        """Pose the mean body.

        Args:
            key: the pose, at any time.
        """
        joints = load_asset().mean_body().joints
        keys = [dataclasses.replace(key, time=time) for time in (0.0, 1.0)]
        self.local_rotations = animate("stance", keys, joints).local_rotations[0]

    def record(self, env: BatchEnv, graph: LaunchGraph, pose_noise: float, place_noise: float) -> None:
        """Append, at a reset: all avatars take the stance where the scene puts them.

        Args:
            env: the batch.
            graph: records.
            pose_noise: greatest turn of every joint about each axis [rad].
            place_noise: greatest displacement along x and y [m].
        """
        record_standing(env, graph, pose_noise)
        record_shift(env, graph, place_noise)
        xyzw = np.ascontiguousarray(np.roll(self.local_rotations, -1, axis=-1), np.float32)
        self._stance = wp.array(xyzw, dtype=wp.quat, device=env.device)  # a graph keeps its address only
        for avatar in env.simulation.avatars:
            state = avatar.state
            graph.launch(
                take_stance,
                (env.num_envs, NUM_JOINTS),
                [env.mask, avatar.body, self._stance],
                [state.command_rotation, state.command_root],
            )


#: Who ducks is not down: so low is a head only when the hands can reach the ground.
FIGHT_FALL = FallConfig(fall_head=0.5)


class Referee:
    """Sees where everybody is, and who is out.

    Attributes:
        pelvis: tracked pelvis joints [m], ``(num_envs, num_agents)``.
        out: whether the root has let go, somebody has fallen, or the pelvis is too far from the origin, ``(num_envs,
            num_agents)``.
    """

    def __init__(self, env: BatchEnv, fall: FallConfig, radius: float = math.inf) -> None:
        """Allocate.

        Args:
            env: the batch.
            fall: what counts as a fall under torques.
            radius: horizontal distance from the origin beyond which a pelvis is out [m].
        """
        agents = env.num_envs, env.num_agents
        self.radius, self.least = radius, least_heights(env.config, fall)
        self.pelvis = wp.zeros(agents, dtype=wp.vec3, device=env.device)
        self.out = wp.zeros(agents, dtype=wp.bool, device=env.device)

    def record(self, env: BatchEnv, graph: LaunchGraph) -> None:
        """Append, after the physics: look."""
        for agent, avatar in enumerate(env.simulation.avatars):
            graph.launch(
                look,
                env.num_envs,
                [agent, self.radius, self.least, avatar.body, avatar.tracked.position, avatar.state.let_go],
                [self.pelvis, self.out],
            )


def record_centre(env: BatchEnv, graph: LaunchGraph, agent: int) -> None:
    """Append: write the term ``RING_CENTRE``."""
    tracked = env.simulation.avatars[agent].tracked
    start = env.layout[RING_CENTRE.name].slice.start
    graph.launch(observe_centre, env.num_envs, [agent, start, tracked.rotation, tracked.position], [env.observation])


def record_others_in(env: BatchEnv, graph: LaunchGraph, agent: int) -> None:
    """Append: write the term of :func:`others_in_terms`, if there is one."""
    if OTHERS_IN in env.layout:
        graph.launch(
            observe_others_in,
            (env.num_envs, env.num_agents - 1),
            [agent, env.layout[OTHERS_IN].slice.start, env.alive],
            [env.observation],
        )


@wp.func
def ankle_height(body: Body, e: int, stance: wp.array(dtype=wp.quat), ankle: int):
    """Height of an ankle over the pelvis joint in a stance [m], by forward kinematics."""
    r = row(e, body.rest_joint.shape[0])
    at = wp.vec3()
    b = ankle
    while b > 0:
        up = body.parent[b]
        at = wp.quat_rotate(stance[up], at + body.rest_joint[r, b] - body.rest_joint[r, up])
        b = up
    return at[2]


@wp.kernel
def take_stance(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    stance: wp.array(dtype=wp.quat),
    # in and out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """Turn the joints of a body standing in (nearly) its rest pose, and lower it onto its feet."""
    e, b = wp.tid()
    if not mask[e]:
        return
    if b > 0:
        command_rotation[e, b] = stance[b] * command_rotation[e, b]
        return
    command_rotation[e, 0] = command_rotation[e, 0] * stance[0]
    r = row(e, body.rest_joint.shape[0])
    left = body.rest_joint[r, _LEFT_ANKLE][2] - ankle_height(body, e, stance, _LEFT_ANKLE)
    right = body.rest_joint[r, _RIGHT_ANKLE][2] - ankle_height(body, e, stance, _RIGHT_ANKLE)
    command_root[e] = wp.vec3(command_root[e][0], command_root[e][1], wp.max(left, right))


@wp.func
def from_centre(at: wp.vec3):
    """Horizontal distance from the origin [m]."""
    return wp.sqrt(at[0] * at[0] + at[1] * at[1])


@wp.kernel
def look(
    agent: int,
    radius: float,
    least: wp.vec2,
    body: Body,
    position: wp.array2d(dtype=wp.vec3),
    let_go: wp.array(dtype=int),
    # out
    pelvis: wp.array2d(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.bool),
):
    """Where an agent is, and whether it is down (lower than ``least``) or beyond ``radius`` [m]."""
    e = wp.tid()
    pelvis[e, agent] = position[e, 0]
    down = let_go[e] != 0 or is_down(heights_of(body, e, position), least)
    out[e, agent] = down or from_centre(position[e, 0]) > radius


@wp.func
def others_in(e: int, agent: int, alive: wp.array2d(dtype=wp.bool), out: wp.array2d(dtype=wp.bool)):
    """How many others were in before this step, and how many still are."""
    before = int(0)
    after = int(0)
    for other in range(alive.shape[1]):
        if other != agent and alive[e, other]:
            before += 1
            if not out[e, other]:
                after += 1
    return wp.vec2i(before, after)


@wp.func
def has_won(e: int, agent: int, others: wp.vec2i, out: wp.array2d(dtype=wp.bool), failure: wp.array(dtype=int)):
    """Whether the last of the others has gone out in this step, and oneself has not."""
    return others[0] > 0 and others[1] == 0 and not out[e, agent] and failure[e] == 0


@wp.kernel
def observe_centre(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """The term ``RING_CENTRE``."""
    e = wp.tid()
    write_vector(observation, e, agent, start, wp.quat_rotate(wp.quat_inverse(rotation[e, 0]), -position[e, 0]))


@wp.kernel
def observe_others_in(
    agent: int,
    start: int,
    alive: wp.array2d(dtype=wp.bool),
    # out
    observation: wp.array3d(dtype=float),
):
    """1 for every other agent that is still in, counted on from oneself."""
    e, index = wp.tid()
    other = (agent + 1 + index) % alive.shape[1]
    observation[e, agent, start + index] = wp.where(alive[e, other], 1.0, 0.0)


@wp.func
def part_impulse_by(sensors: Sensors, e: int, agent: int, part: int, other: int):
    """Impulse of one avatar on a body part of another in the last control step [N s]."""
    return sensors.part_impulse[e, agent * NUM_PARTS + part, other]
