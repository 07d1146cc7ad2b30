"""Parts of games of several avatars: places on a circle, a stance, the referee, and rings where the last one wins."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.skeleton import BODY_PARTS, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion.keyframes import Key, animate
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import AvatarConfig, ConfigError, EnvConfig, SceneConfig, replace
from piavatar_envs.config.schema import select_joints
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.envs.task import Task
from piavatar_envs.mpm.types import Sensors, row
from piavatar_envs.sim.bodies import load_avatar
from piavatar_envs.tasks.common.fall import FallConfig, heights_of, is_down, least_heights
from piavatar_envs.tasks.common.ranges import Weight
from piavatar_envs.tasks.common.root_command import record_root_clamp
from piavatar_envs.tasks.common.spawn import record_shift, record_standing

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.episodes import EpisodeArrays

wp.set_module_options({"enable_backward": False})

_LEFT_ANKLE, _RIGHT_ANKLE = wp.constant(joint_index("left_ankle")), wp.constant(joint_index("right_ankle"))
NUM_PARTS = wp.constant(len(BODY_PARTS))


def circle_radius(count: int, apart: float) -> float:
    """Return the radius of a circle on which ``count`` avatars are ``apart`` from their neighbours [m]."""
    return 0.5 * apart / math.sin(math.pi / count) if count > 1 else 0.5 * apart


def on_circle(scene: SceneConfig, count: int, apart: float) -> SceneConfig:
    """Return the scene with ``count`` avatars around the origin, facing it, unless it places them itself.

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


class Stance:
    """A first pose with the feet on the ground, whatever the body's shape.

    Attributes:
        local_rotations: of all joints, wxyz, the root's relative to the heading, shape ``(22, 4)``.
    """

    def __init__(self, key: Key, asset: AvatarAsset | None = None) -> None:
        """Pose the mean body.

        Args:
            key: the pose, at any time.
            asset: the body; the embedded one if not given.
        """
        joints = (asset or load_asset()).mean_body().joints
        keys = [dataclasses.replace(key, time=time) for time in (0.0, 1.0)]
        self.local_rotations = animate("stance", keys, joints).local_rotations[0]

    def record(self, env: EpisodeArrays, graph: LaunchGraph, pose_noise: float, place_noise: float) -> None:
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
        self._stance = wp.array(xyzw, dtype=wp.quat, device=env.device)  # a graph keeps only its address
        for avatar in env.simulation.avatars:
            state = avatar.state
            graph.launch(
                take_stance,
                (env.num_envs, NUM_JOINTS),
                [env.episodes, avatar.body, self._stance],
                [state.command_rotation, state.command_root],
            )


class Referee:
    """Places of all agents, and the agents that are out.

    Attributes:
        pelvis: tracked pelvis joints [m], ``(num_envs, num_agents)``.
        out: whether the root is released, the avatar has fallen, or its pelvis is too far from the origin, ``(num_envs,
            num_agents)``.
    """

    def __init__(self, env: EpisodeArrays, fall: FallConfig, radius: float = math.inf) -> None:
        """Allocate.

        Args:
            env: the batch.
            fall: limits of a fall under torques.
            radius: horizontal distance from the origin beyond which a pelvis is out [m].
        """
        agents = env.num_envs, env.num_agents
        self.radius, self.least = radius, least_heights(env.config, fall)
        self.pelvis = wp.zeros(agents, dtype=wp.vec3, device=env.device)
        self.out = wp.zeros(agents, dtype=wp.bool, device=env.device)

    def record(self, env: EpisodeArrays, graph: LaunchGraph) -> None:
        """Append, after the physics: update both arrays."""
        for agent, avatar in enumerate(env.simulation.avatars):
            graph.launch(
                find_out,
                env.num_envs,
                [agent, self.radius, self.least, env.bones[agent], avatar.state.released],
                [self.pelvis, self.out],
            )

    def record_shared_end(self, env: EpisodeArrays, graph: LaunchGraph) -> None:
        """Append, after the task has judged: where one agent is out, the episode ends for all of them."""
        graph.launch(end_for_all, env.num_envs, [self.out], [env.outcome])


@wp.kernel
def end_for_all(
    out: wp.array2d(dtype=wp.bool),
    # in and out
    outcome: Outcome,
):
    """Terminate all agents of an environment in which one is out."""
    e = wp.tid()
    fallen = bool(False)
    for agent in range(out.shape[1]):
        fallen = fallen or out[e, agent]
    for agent in range(out.shape[1]):
        outcome.terminated[e, agent] = outcome.terminated[e, agent] or fallen


@wp.func
def part_impulse_by(sensors: Sensors, e: int, agent: int, part: int, other: int):
    """Return the impulse of the avatar ``other`` on a body part of ``agent`` in the last control step [N s]."""
    return sensors.part_impulse[e, agent * NUM_PARTS + part, other]


@wp.func
def ankle_height(body: Body, e: int, stance: wp.array(dtype=wp.quat), ankle: int):
    """Return the height of an ankle over the pelvis joint in a stance [m], by forward kinematics."""
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
    episodes: Episodes,
    body: Body,
    stance: wp.array(dtype=wp.quat),
    # in and out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
):
    """Turn the joints of a body that stands nearly in its rest pose, and lower it onto its feet."""
    e, b = wp.tid()
    if not episodes.mask[e]:
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
    """Return the horizontal distance from the origin [m]."""
    return wp.sqrt(at[0] * at[0] + at[1] * at[1])


@wp.kernel
def find_out(
    agent: int,
    radius: float,
    least: wp.vec2,
    bones: Bones,
    released: wp.array(dtype=int),
    # out
    pelvis: wp.array2d(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.bool),
):
    """Write an agent's pelvis, and whether it is down (lower than ``least``) or beyond ``radius`` [m]."""
    e = wp.tid()
    pelvis[e, agent] = bones.position[e, 0]
    down = released[e] != 0 or is_down(heights_of(bones, e), least)
    out[e, agent] = down or from_centre(bones.position[e, 0]) > radius


#: Observed of a ring, whose centre is the origin.
RING_CENTRE = ObservationTerm("ring_centre", 3, "m", "root", "centre of the ring, on the ground, from the pelvis")
#: Observed among more than two agents; of two, the other one is always in.
OTHERS_IN = "others_in"
#: Limits of a fall in a ring: an avatar that ducks is not down; at this height its hands can reach the ground.
RING_FALL = FallConfig(fall_head=0.5)


class RingConfig(EnvConfig):
    """Settings of all games in a ring."""

    num_agents: int = Field(2, ge=1, le=8, description="number of avatars")
    start_distance: float = Field(1.1, ge=0.6, le=5.0, description="between neighbours at the start [m]")
    root_speed: float = Field(1.5, gt=0.0, le=5.0, description="speed of the root at action 1 [m/s]")
    root_lead_limit: float = Field(
        0.12, gt=0.0, le=0.4, description="greatest lead of the commanded root on the body before an action [m]"
    )
    root_turn_lead_limit: float = Field(
        0.5, gt=0.0, le=1.5, description="greatest lead in turning before an action [rad]"
    )
    control_cost: Weight = Field(0.01, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle off the first stance [rad]")
    place_noise: float = Field(0.05, ge=0.0, le=0.3, description="greatest displacement along x and y at the start [m]")


class RingTask(Task):
    """Base of games in a ring: avatars take a stance on a circle, and the last one that is in wins.

    Class attributes:
        stance_key: the first pose.
    """

    stance_key: Key
    observes_contact = True
    observes_others = True
    camera_follows = False

    config: RingConfig

    def __init__(self, config: RingConfig) -> None:
        super().__init__(config)
        self.joints, self.stance = select_joints(config.joints), Stance(self.stance_key, load_avatar(config.avatar))

    @property
    def start_radius(self) -> float:
        """Radius of the circle on which the avatars begin [m]."""
        return circle_radius(self.config.num_agents, self.config.start_distance)

    def build_scene(self) -> SceneConfig:
        return on_circle(self.config.scene, self.config.num_agents, self.config.start_distance)

    def terms(self) -> tuple[ObservationTerm, ...]:
        others = self.config.num_agents - 1
        if others < 2:
            return self.observation_terms
        return (
            *self.observation_terms,
            ObservationTerm(OTHERS_IN, others, "-", "-", "1 for each of the others that is still in"),
        )

    def action_spec(self) -> ActionSpec:
        speed = self.config.control.joint_speed_limit
        return ActionSpec(self.joints, root=True, joint_speed=speed, root_speed=self.config.root_speed)

    def record_reset(self, env, graph) -> None:
        self.stance.record(env, graph, self.config.pose_noise, self.config.place_noise)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        return record_root_clamp(env, graph, self.config.root_lead_limit, self.config.root_turn_lead_limit)

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        inputs = [env.bones[agent], agent, env.layout[RING_CENTRE.name].slice.start]
        graph.launch(observe_centre, env.num_envs, inputs, [env.observation])
        if OTHERS_IN in env.layout:
            inputs = [env.episodes, agent, env.layout[OTHERS_IN].slice.start]
            graph.launch(observe_others_in, (env.num_envs, env.num_agents - 1), inputs, [env.observation])


@wp.func
def others_in(episodes: Episodes, out: wp.array2d(dtype=wp.bool), e: int, agent: int):
    """Return the number of others that were in before this step, and of those that still are."""
    before = int(0)
    after = int(0)
    for other in range(episodes.alive.shape[1]):
        if other != agent and episodes.alive[e, other]:
            before += 1
            if not out[e, other]:
                after += 1
    return wp.vec2i(before, after)


@wp.func
def has_won(episodes: Episodes, out: wp.array2d(dtype=wp.bool), e: int, agent: int, others: wp.vec2i):
    """Return whether the last of the others has gone out in this step while the agent is in."""
    return others[0] > 0 and others[1] == 0 and not out[e, agent] and episodes.failure[e] == 0


@wp.kernel
def observe_centre(
    bones: Bones,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the term :data:`RING_CENTRE`."""
    e = wp.tid()
    write_vector(
        observation, e, agent, start, wp.quat_rotate(wp.quat_inverse(bones.rotation[e, 0]), -bones.position[e, 0])
    )


@wp.kernel
def observe_others_in(
    episodes: Episodes,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write 1 for every other agent that is still in, counted on from the observing one."""
    e, index = wp.tid()
    other = (agent + 1 + index) % episodes.alive.shape[1]
    observation[e, agent, start + index] = wp.where(episodes.alive[e, other], 1.0, 0.0)
