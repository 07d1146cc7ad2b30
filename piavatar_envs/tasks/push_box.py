"""PushBox: walk up to a soft box and push it to a place on the floor, bent over it and with both hands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.rotation import quat_exp, quat_log, turn_about_z
from piavatar_envs.config import ConfigError, EnvConfig, PropConfig, SceneConfig, replace
from piavatar_envs.config.schema import Length
from piavatar_envs.core.rng import STREAM_TASK
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, Props, random_of, write_in_root
from piavatar_envs.envs.framing import Sphere
from piavatar_envs.envs.observations import ObservationTerm, write_vector
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.mpm.colliders import BOX, solid_distance
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.markers import WIRE, Markers, MarkerSpec
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.hands import write_hands
from piavatar_envs.tasks.common.ranges import DistanceRange, Margin, MassRange, Weight, check_ranges
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance
from piavatar_envs.tasks.common.root_command import record_root_clamp
from piavatar_envs.tasks.common.spawn import forward_of, record_standing

wp.set_module_options({"enable_backward": False})

#: Name of the box among the props; it is the first.
NAME = "box"
#: Joints that act by default: all above the legs, which the root carries along.
UPPER_BODY = (
    *("spine1", "spine2", "spine3", "neck", "head"),
    *(f"{side}_{joint}" for side in ("left", "right") for joint in ("collar", "shoulder", "elbow", "wrist")),
)
#: Speeds of the root at action 1 [m/s] and [rad/s].
WALK, TURN = 1.0, 1.5
#: Greatest lead of the commanded root on the body [m] and [rad]: a pull of some 600 N.
ROOT_LEAD, ROOT_TURN_LEAD = 0.1, 0.3
#: Reach of the body in its first pose, with hands and feet, and its room behind a box that it pushes [m].
REACH, BEHIND = 0.4, 0.4
#: Least margin of the reward, for a box that starts at its target [m].
LEAST_MARGIN = wp.constant(0.1)


class PushBoxConfig(EnvConfig):
    """Settings of PushBox."""

    episode_seconds: float = Field(8.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    joints: tuple[str, ...] | None = Field(UPPER_BODY, description="joints that act; null for all 21")
    box_half_size: tuple[Length, Length, Length] = Field(
        (0.24, 0.24, 0.33), description="half its width, depth, height [m]"
    )
    box_mass: MassRange = Field((5.0, 20.0), description="range that the box's mass is drawn from [kg]")
    box_friction: float = Field(0.2, ge=0.0, le=10.0, description="Coulomb coefficient of box and floor [-]")
    box_distance: DistanceRange = Field((0.8, 0.95), description="range of the box's distance at the start [m]")
    box_turn: float = Field(0.4, ge=0.0, le=math.pi, description="greatest turn of the box at the start [rad]")
    target_distance: DistanceRange = Field((0.5, 1.2), description="range of the way to push it [m]")
    target_angle: float = Field(
        1.0, ge=0.0, le=math.pi, description="greatest angle of that way from straight ahead [rad]"
    )
    target_radius: float = Field(0.15, gt=0.0, le=1.0, description="distance of box and target that is a success [m]")
    hand_margin: Margin = Field(0.6, description="distance of a hand at which its reward has, likewise [m]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


@wp.struct
class Push:
    """Constants of the task, as in the settings. Ranges are a lower and an upper bound."""

    box: int  # index among the props
    pair: int  # sensor of the avatar with the box
    volume: float  # [m^3]
    place: wp.vec3  # of the avatar at the start: x, y [m] and yaw [rad]
    box_half_size: wp.vec3
    box_mass: wp.vec2
    box_distance: wp.vec2
    box_turn: float
    target_distance: wp.vec2
    target_angle: float
    target_radius: float
    hand_margin: float
    control_cost: float


@wp.kernel
def draw_push(
    episodes: Episodes,
    push: Push,
    # out
    first: Props,
    target: wp.array(dtype=wp.vec3),
    way: wp.array(dtype=float),
):
    """Draw a box in front of the avatar, its mass, its target, and the distance between them [m]."""
    e = wp.tid()
    if not episodes.mask[e]:
        return
    random = random_of(episodes, e, STREAM_TASK, 0)
    out = wp.randf(random, push.box_distance[0], push.box_distance[1]) * forward_of(push.place[2])
    at = wp.vec3(push.place[0] + out[0], push.place[1] + out[1], push.box_half_size[2])
    first.position[e, push.box] = at
    turn = push.place[2] + wp.randf(random, -push.box_turn, push.box_turn)
    first.rotation[e, push.box] = quat_exp(wp.vec3(0.0, 0.0, turn))
    first.density[e, push.box] = wp.randf(random, push.box_mass[0], push.box_mass[1]) / push.volume
    way[e] = wp.randf(random, push.target_distance[0], push.target_distance[1])
    to = at + way[e] * forward_of(push.place[2] + wp.randf(random, -push.target_angle, push.target_angle))
    target[e] = wp.vec3(to[0], to[1], 0.0)


@wp.kernel
def find_hands(
    bones: Bones,
    # out
    hands: wp.array2d(dtype=wp.vec3),
):
    """Find the middles of both hands in the world."""
    e = wp.tid()
    write_hands(bones, e, hands)


@wp.func
def to_go(box: wp.vec3, target: wp.vec3):
    """Return the horizontal vector from the box to the target [m]."""
    return wp.vec3(target[0] - box[0], target[1] - box[1], 0.0)


@wp.func
def gap_to_box(push: Push, props: Props, e: int, hand: wp.vec3):
    """Return the distance of the middle of a hand from the box's surface [m], 0 inside."""
    at = wp.quat_rotate_inv(props.rotation[e, push.box], hand - props.position[e, push.box])
    return wp.max(solid_distance(BOX, push.box_half_size, at)[3], 0.0)


@wp.kernel
def judge(
    push: Push,
    props: Props,
    hands: wp.array2d(dtype=wp.vec3),
    target: wp.array(dtype=wp.vec3),
    way: wp.array(dtype=float),
    sensors: Sensors,
    action: wp.array3d(dtype=float),
    # out
    outcome: Outcome,
):
    """Reward a box near its target and hands near the box."""
    e = wp.tid()
    distance = wp.length(to_go(props.position[e, push.box], target[e]))
    left, right = gap_to_box(push, props, e, hands[e, 0]), gap_to_box(push, props, e, hands[e, 1])
    near = 0.5 * (tolerance(left, 0.1, push.hand_margin) + tolerance(right, 0.1, push.hand_margin))
    outcome.terms[e, 0, PushBoxTask.rewards.push] = 0.8 * tolerance(
        distance, push.target_radius, wp.max(way[e] - push.target_radius, LEAST_MARGIN)
    )
    outcome.terms[e, 0, PushBoxTask.rewards.hands] = 0.2 * near
    outcome.terms[e, 0, PushBoxTask.rewards.control] = -push.control_cost * mean_square_action(action, e, 0)
    outcome.metrics[e, 0, PushBoxTask.metrics.distance] = distance
    outcome.metrics[e, 0, PushBoxTask.metrics.left_hand_gap] = left
    outcome.metrics[e, 0, PushBoxTask.metrics.right_hand_gap] = right
    outcome.metrics[e, 0, PushBoxTask.metrics.box_speed] = wp.length(props.velocity[e, push.box])
    outcome.metrics[e, 0, PushBoxTask.metrics.push_impulse] = wp.length(sensors.pair_impulse[e, push.pair])
    outcome.success[e, 0] = distance <= push.target_radius


@wp.kernel
def observe(
    push: Push,
    bones: Bones,
    props: Props,
    hands: wp.array2d(dtype=wp.vec3),
    target: wp.array(dtype=wp.vec3),
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write all but the last of ``PushBoxTask.observation_terms`` from component ``start``."""
    e = wp.tid()
    box = props.position[e, push.box]
    write_in_root(observation, e, agent, start, bones, target[e] - bones.position[e, 0])
    write_in_root(observation, e, agent, start + 3, bones, to_go(box, target[e]))
    write_in_root(observation, e, agent, start + 6, bones, box - hands[e, 0])
    write_in_root(observation, e, agent, start + 9, bones, box - hands[e, 1])
    observation[e, agent, start + 12] = push.volume * props.density[e, push.box]


@wp.kernel
def observe_lead(
    bones: Bones,
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the command's lead on the pelvis: to its left and backwards [m], and its turn [rad]."""
    e = wp.tid()
    heading = turn_about_z(bones.rotation[e, 0])
    lead = wp.quat_rotate_inv(heading, command_root[e] - bones.position[e, 0])
    turn = quat_log(turn_about_z(command_rotation[e, 0]) * wp.quat_inverse(heading))
    write_vector(observation, e, agent, start, wp.vec3(lead[0], lead[1], turn[2]))


@wp.kernel
def place_target(
    target: wp.array(dtype=wp.vec3),
    # out
    markers: Markers,
):
    """Place the marker of the target just above the ground."""
    e = wp.tid()
    markers.position[e, 0] = target[e] + wp.vec3(0.0, 0.0, 0.01)


class PushBoxTask(Task):
    """Push the box to the target."""

    Config = PushBoxConfig
    description = "walk up to a soft box and push it to a place on the floor"
    observation_terms = (
        ObservationTerm("target_position", 3, "m", "root", "the target from the pelvis"),
        ObservationTerm("target_from_box", 3, "m", "root", "the target from the box, horizontally"),
        ObservationTerm("box_from_left_hand", 3, "m", "root", "the box's middle from the left hand"),
        ObservationTerm("box_from_right_hand", 3, "m", "root", "the box's middle from the right hand"),
        ObservationTerm("box_mass", 1, "kg", "-", "mass of the box"),
        ObservationTerm("command_lead", 3, "m, rad", "root", "x, y and yaw of the commanded root from the tracked one"),
    )
    rewards = (
        Term(
            "push",
            "0.8 while `distance` is at most `target_radius`; beyond it a Gaussian that has fallen to 0.08 at the "
            "distance where the box started",
        ),
        Term(
            "hands",
            "0.1 for each hand within 0.1 m of the box's surface; beyond it a Gaussian that has fallen to 0.01 after "
            "another `hand_margin`",
        ),
        CONTROL,
    )
    metrics = (
        Metric("distance", "m", "horizontal distance of the box's middle from the target"),
        Metric("left_hand_gap", "m", "from the middle of the left hand to the box's surface"),
        Metric("right_hand_gap", "m", "from the middle of the right hand to the box's surface"),
        Metric("box_speed", "m/s", "speed of the box"),
        Metric("push_impulse", "N s", "impulse between body and box in this step"),
    )
    state_arrays = (TaskArray("target", wp.vec3), TaskArray("way"))
    scratch_arrays = (TaskArray("hands", wp.vec3, (2,)),)

    camera_direction = (3.0, -1.95, 1.1)

    summary = """A soft box stands in front of the avatar, turned at random by up to `box_turn`; its mass is drawn from
`box_mass` and observed. Its target is a place on the floor at a `target_distance` from the box, within `target_angle`
of straight ahead. Root actions move the avatar, at up to 1 m/s and 1.5 rad/s, its legs carried along; trunk and
arms act. A good agent gets behind the box, bends over it, pushes it with hands and body in the right direction, and
stops in time: the box slides on with friction `box_friction`. A blocked body also holds back the root command: before
each action the command is clamped to within 0.1 m and 0.3 rad of the body."""
    success_doc = "`distance` is at most `target_radius`"
    picture_seconds = 1.6
    picture_actions: ClassVar[Mapping[str, float]] = {
        "spine1.x": 0.08, "spine2.x": 0.08, "spine3.x": 0.08, "neck.x": -0.06, "head.x": -0.06,
        "left_collar.y": -0.09, "left_shoulder.x": -0.15, "left_shoulder.z": -0.13, "left_elbow.z": 0.06,
        "right_collar.y": 0.09, "right_shoulder.x": -0.15, "right_shoulder.z": 0.13, "right_elbow.z": -0.06,
        "root.y": -0.4,
    }  # fmt: skip

    config: PushBoxConfig

    def __init__(self, config: PushBoxConfig) -> None:
        check_ranges(config, "box_mass", "box_distance", "target_distance")
        least = REACH + math.hypot(*config.box_half_size[:2])
        if config.box_distance[0] < least:
            raise ConfigError(
                f"box_distance={list(config.box_distance)} would put a box of half size {list(config.box_half_size)} m "
                f"into the avatar; use at least {least:.2f} m"
            )
        super().__init__(config)

    def build_scene(self) -> SceneConfig:
        scene, config = super().build_scene(), self.config
        avatar = scene.avatars[0]
        self.place = (*avatar.position, avatar.yaw)
        x, y = self._ahead(float(np.mean(config.box_distance)))
        box = PropConfig(
            name=NAME,
            shape="box",
            size=config.box_half_size,
            mass=float(np.mean(config.box_mass)),
            position=(x, y, config.box_half_size[2]),
            friction=config.box_friction,
        )
        return replace(scene, props=[box, *scene.props])

    def prop_places(self) -> Mapping[str, Sequence[Sequence[float]]]:
        height = self.config.box_half_size[2]
        return {NAME: [(*self._ahead(distance), height) for distance in self.config.box_distance]}

    def _ahead(self, distance: float, angle: float = 0.0) -> tuple[float, float]:
        """Return the point ``distance`` [m] in front of the avatar's place, ``angle`` [rad] from straight ahead."""
        x, y, yaw = self.place
        return x + distance * math.sin(yaw + angle), y - distance * math.cos(yaw + angle)

    def drawn(self) -> tuple[Parameter, ...]:
        return (
            Parameter("box_mass", "kg", *self.config.box_mass, "mass of the box"),
            Parameter("target_distance", "m", *self.config.target_distance, "of the target from where the box started"),
        )

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        return Drawn(env.simulation.props.density[:, self.push.box], self.push.volume), Drawn(self.way)

    def action_spec(self) -> ActionSpec:
        joint_speed = self.config.control.joint_speed_limit
        return ActionSpec(self.joints, root=True, joint_speed=joint_speed, root_speed=WALK, root_turn_speed=TURN)

    def shown(self) -> list[Sphere]:
        """Return avatar, box, and the mark of the target at its places."""
        config, (x, y) = self.config, self.place[:2]
        marks = []
        for angle in (-config.target_angle, 0.0, config.target_angle):
            far, box = np.array(self._ahead(config.target_distance[1], angle)), self._ahead(config.box_distance[1])
            marks.append((*(far + box - [x, y]).tolist(), 0.0, config.target_radius))
        return super().shown() + marks

    def domain(self) -> Domain:
        """Include every place from which the body may have to push."""
        config, (x, y, _) = self.config, self.place
        box = np.array(self._ahead(config.box_distance[1]))
        spread = np.linspace(-config.target_angle, config.target_angle, 9)
        ways = np.array([self._ahead(1.0, angle) for angle in spread]) - [x, y]
        return Domain().around([(x, y), *(box + (config.target_distance[1] - BEHIND) * ways).tolist()])

    def allocate(self, env) -> None:
        props, subjects = env.simulation.props, env.simulation.subjects
        box = props.index(NAME)
        constants = {"box": box, "pair": subjects.names.index(NAME), "volume": float(props.volume[box])}
        self.push = fill(Push(), self.config, place=wp.vec3(*self.place), **constants)

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        outputs = [env.first_props, self.target, self.way]
        graph.launch(draw_push, env.num_envs, [env.episodes, self.push], outputs)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        return record_root_clamp(env, graph, ROOT_LEAD, ROOT_TURN_LEAD)

    def _record_hands(self, env, graph) -> None:
        graph.launch(find_hands, env.num_envs, [env.bones[0]], [self.hands])

    def record_outcome(self, env, graph) -> None:
        self._record_hands(env, graph)
        inputs = [self.push, env.props, self.hands, self.target, self.way, env.simulation.sensors, env.action]
        graph.launch(judge, env.num_envs, inputs, [env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        self._record_hands(env, graph)
        state, bones = env.simulation.avatar.state, env.bones[agent]
        inputs = [self.push, bones, env.props, self.hands, self.target, agent, start]
        graph.launch(observe, env.num_envs, inputs, [env.observation])
        last = start + sum(term.size for term in self.observation_terms[:-1])
        inputs = [bones, state.command_rotation, state.command_root, agent, last]
        graph.launch(observe_lead, env.num_envs, inputs, [env.observation])

    def marker_specs(self) -> tuple[MarkerSpec, ...]:
        return (MarkerSpec("ring", (self.config.target_radius, WIRE)),)

    def record_markers(self, env, graph, markers) -> None:
        graph.launch(place_target, env.num_envs, [self.target], [markers])


TASK = PushBoxTask
