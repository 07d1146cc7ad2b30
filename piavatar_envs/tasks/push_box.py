"""PushBox: walk up to a soft box and push it to a place on the floor, bent over it and with both hands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.config import ConfigError, EnvConfig, PropConfig, SceneConfig, replace
from piavatar_envs.config.schema import Length
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.leash import record_leash
from piavatar_envs.tasks.common.pushing import Push, draw_push, find_hands, judge, observe, observe_lead
from piavatar_envs.tasks.common.ranges import DistanceRange, Margin, MassRange, Weight, check_ranges
from piavatar_envs.tasks.common.spawn import record_standing

if TYPE_CHECKING:
    from piavatar_envs.render.scene import Marker

#: Name of the box among the props; it is the first.
NAME = "box"
#: Joints that act by default: all above the legs, which the root carries along.
UPPER_BODY = (
    *("spine1", "spine2", "spine3", "neck", "head"),
    *(f"{side}_{joint}" for side in ("left", "right") for joint in ("collar", "shoulder", "elbow", "wrist")),
)
#: Speeds of the root at action 1 [m/s] and [rad/s].
WALK, TURN = 1.0, 1.5
#: How far the command may be ahead of the body [m] and [rad]: a pull of some 600 N at most.
LEASH, LEASH_TURN = 0.1, 0.3
#: How far the body reaches in its first pose, with hands and feet [m], and behind a box that it pushes.
REACH, BEHIND = 0.4, 0.4


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


class PushBoxTask(Task):
    """Push the box to the target."""

    Config = PushBoxConfig
    description = "walk up to a soft box of 5 to 20 kg and push it to a place on the floor"
    observation_terms = (
        ObservationTerm("target_position", 3, "m", "root", "the target from the pelvis"),
        ObservationTerm("target_from_box", 3, "m", "root", "the target from the box, horizontally"),
        ObservationTerm("box_from_left_hand", 3, "m", "root", "the box's middle from the left hand"),
        ObservationTerm("box_from_right_hand", 3, "m", "root", "the box's middle from the right hand"),
        ObservationTerm("box_mass", 1, "kg", "-", "mass of the box"),
        ObservationTerm("command_lead", 3, "m, rad", "root", "x, y and yaw of the commanded root from the tracked one"),
    )
    reward_terms = ("push", "hands", "control")
    metrics = ("distance", "left_hand_gap", "right_hand_gap", "box_speed", "push_impulse")

    camera_position = (3.0, -2.5, 1.75)
    camera_target = (0.0, -0.55, 0.65)

    summary = """A soft box stands before the avatar, turned a little (`box_turn`) and of a mass that is drawn from
`box_mass` and observed. Within `target_angle` of straight ahead, `target_distance` from the box, a place on the floor
is marked: the box shall stand there. The avatar walks as root actions say, up to 1 m/s and 1.5 rad/s, its legs carried
along; trunk and arms act. It has to get behind the box, bend over it, push it with hands and body in the right
direction, and stop in time: the box slides on with friction `box_friction`. What blocks the body holds back the command
of the root, too: before each action it is brought back to within 0.1 m and 0.3 rad of the body."""
    reward_docs: ClassVar[Mapping[str, str]] = {
        "push": "0.8 while `distance` is at most `target_radius`; beyond it a Gaussian that has fallen to 0.08 at the "
        "distance where the box started",
        "hands": "0.1 for each hand within 0.1 m of the box's surface; beyond it a Gaussian that has fallen to 0.01 "
        "after another `hand_margin`",
        "control": "`-control_cost` times the mean of the squared action components",
    }
    metric_docs: ClassVar[Mapping[str, str]] = {
        "distance": "horizontal distance of the box's middle from the target [m]",
        "left_hand_gap": "from the middle of the left hand to the box's surface [m]",
        "right_hand_gap": "from the middle of the right hand to the box's surface [m]",
        "box_speed": "speed of the box [m/s]",
        "push_impulse": "impulse between body and box in this step [N s]",
    }
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
        """What is ``distance`` [m] before the avatar's place, ``angle`` [rad] from straight ahead."""
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

    def domain(self) -> Domain:
        """Room for the body wherever it may have to push from."""
        config, (x, y, _) = self.config, self.place
        box = np.array(self._ahead(config.box_distance[1]))
        spread = np.linspace(-config.target_angle, config.target_angle, 9)
        ways = np.array([self._ahead(1.0, angle) for angle in spread]) - [x, y]
        return Domain().around([(x, y), *(box + (config.target_distance[1] - BEHIND) * ways).tolist()])

    def allocate(self, env) -> None:
        n, device, config, push = env.num_envs, env.device, self.config, Push()
        simulation = env.simulation
        push.box, push.pair = simulation.props.index(NAME), simulation.subjects.names.index(NAME)
        push.half_size, push.volume = wp.vec3(*config.box_half_size), float(simulation.props.volume[push.box])
        push.place, push.mass, push.turn = wp.vec3(*self.place), wp.vec2(*config.box_mass), config.box_turn
        push.distance, push.way = wp.vec2(*config.box_distance), wp.vec2(*config.target_distance)
        push.angle, push.reached = config.target_angle, config.target_radius
        push.hand_margin, push.control_cost = config.hand_margin, config.control_cost
        self.push = push
        self.target = wp.zeros(n, dtype=wp.vec3, device=device)
        self.way = wp.zeros(n, dtype=float, device=device)
        self.hands = wp.zeros((n, 2), dtype=wp.vec3, device=device)

    def arrays(self) -> dict[str, wp.array]:
        return {"target": self.target, "way": self.way}

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        props = env.simulation.props
        graph.launch(
            draw_push,
            env.num_envs,
            [env.mask, env.seed, env.episode, self.push],
            [props.spawn.position, props.spawn.rotation, props.density, self.target, self.way],
        )

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        return record_leash(env, graph, LEASH, LEASH_TURN)

    def _record_hands(self, env, graph) -> None:
        avatar = env.simulation.avatar
        inputs = [avatar.body, avatar.tracked.rotation, avatar.tracked.position]
        graph.launch(find_hands, env.num_envs, inputs, [self.hands])

    def record_outcome(self, env, graph) -> None:
        self._record_hands(env, graph)
        box = env.simulation.props.state
        graph.launch(
            judge,
            env.num_envs,
            [
                self.push, box.position, box.rotation, box.velocity, self.hands, self.target, self.way,
                env.simulation.sensors, env.action,
            ],
            [env.terms, env.metrics, env.success],
        )  # fmt: skip

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        self._record_hands(env, graph)
        avatar, props = env.simulation.avatar, env.simulation.props
        here = [avatar.tracked.rotation, avatar.tracked.position]
        graph.launch(
            observe,
            env.num_envs,
            [self.push, agent, start, *here, props.state.position, props.density, self.hands, self.target],
            [env.observation],
        )
        last = start + sum(term.size for term in self.observation_terms[:-1])
        graph.launch(
            observe_lead,
            env.num_envs,
            [agent, last, *here, avatar.state.command_rotation, avatar.state.command_root],
            [env.observation],
        )

    def markers(self, env, index: int) -> list[Marker]:
        from piavatar_envs.render.scene import Ring

        at = self.target.numpy()[index] + np.float32([0.0, 0.0, 0.01])
        return [Ring(at, np.array([0.0, 0.0, 1.0]), self.config.target_radius)]


TASK = PushBoxTask
