"""HighFive: two avatars face each other and slap one hand each, high up and neither too softly nor too hard."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import BODY_PARTS
from piavatar_envs.config import AvatarConfig, ConfigError, EnvConfig, SceneConfig, replace
from piavatar_envs.config.schema import select_joints
from piavatar_envs.core.rng import STREAM_TASK
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, random_of, write_in_root
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.tasks.common.fall import UNDER_TORQUES_DOC, FallConfig
from piavatar_envs.tasks.common.hands import LEFT_WRIST, RIGHT_WRIST, flesh_middle
from piavatar_envs.tasks.common.multi_agent import Referee, part_impulse_by
from piavatar_envs.tasks.common.ranges import ImpulseRange, Margin, Weight, check_ranges
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance
from piavatar_envs.tasks.common.spawn import record_shift, record_standing

wp.set_module_options({"enable_backward": False})

_LEFT_ARM = wp.constant(list(BODY_PARTS).index("left_arm"))
#: Added to the way to go of a hand that points straight down instead of straight up [m].
_TURN = wp.constant(0.4)


@wp.struct
class SlapRule:
    """Constants of a slap and its reward, as in the settings."""

    impulse_window: float
    reach: float
    least_height: float
    upright: float
    margin: float
    approach_weight: float
    slap_bonus: float
    control_cost: float


@wp.struct
class Hands:
    """The hands to raise, in the world; ``(num_envs, 2)``."""

    middle: wp.array2d(dtype=wp.vec3)  # of the flesh [m]
    direction: wp.array2d(dtype=wp.vec3)  # unit vector from the wrist to the middle
    velocity: wp.array2d(dtype=wp.vec3)  # [m/s]


@wp.kernel
def draw_slap(
    episodes: Episodes,
    sides: wp.vec2i,
    impulse: wp.vec2,
    # out
    side: wp.array(dtype=int),
    least: wp.array(dtype=float),
):
    """Draw the hands (0 left, 1 right) and the weakest slap that counts [N s], each between two bounds."""
    e = wp.tid()
    if episodes.mask[e]:
        random = random_of(episodes, e, STREAM_TASK, 0)
        side[e] = wp.randi(random, sides[0], sides[1] + 1)
        least[e] = wp.randf(random, impulse[0], impulse[1])


@wp.kernel
def locate_hand(
    agent: int,
    bones: Bones,
    side: wp.array(dtype=int),
    # out
    hands: Hands,
):
    """Find the hand that an agent has to raise."""
    e = wp.tid()
    wrist = wp.where(side[e] == 0, LEFT_WRIST, RIGHT_WRIST)
    middle = flesh_middle(bones, e, wrist)
    hands.middle[e, agent] = middle
    hands.direction[e, agent] = wp.normalize(middle - bones.position[e, wrist])
    hands.velocity[e, agent] = bones.velocity[e, wrist]


@wp.func
def arm_impulse(sensors: Sensors, e: int, agent: int, side: int):
    """Return the impulse of the other agent on the arm that an agent has to raise [N s]."""
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
    outcome: Outcome,
):
    """Reward both agents alike, by the way that the hands have to go and by the slap."""
    e = wp.tid()
    distance = wp.length(hands.middle[e, 0] - hands.middle[e, 1])
    height = wp.min(hands.middle[e, 0][2], hands.middle[e, 1][2])
    upright = wp.min(hands.direction[e, 0][2], hands.direction[e, 1][2])
    # an impulse on only one of the two arms is not a slap
    impulse = wp.min(arm_impulse(sensors, e, 0, side[e]), arm_impulse(sensors, e, 1, side[e]))
    placed = distance <= rule.reach and height >= rule.least_height and upright >= rule.upright
    too_hard = impulse > rule.impulse_window * least[e]
    done = placed and impulse >= least[e] and not too_hard
    to_go = distance + wp.max(rule.least_height - height, 0.0) + 0.5 * _TURN * wp.max(rule.upright - upright, 0.0)
    control = 0.5 * (mean_square_action(action, e, 0) + mean_square_action(action, e, 1))
    near = tolerance(to_go, rule.reach, rule.margin)
    for agent in range(2):
        outcome.terms[e, agent, HighFiveTask.rewards.approach] = rule.approach_weight * near
        outcome.terms[e, agent, HighFiveTask.rewards.slap] = wp.where(done, rule.slap_bonus, 0.0)
        outcome.terms[e, agent, HighFiveTask.rewards.control] = -rule.control_cost * control
        outcome.metrics[e, agent, HighFiveTask.metrics.distance] = distance
        outcome.metrics[e, agent, HighFiveTask.metrics.hand_height] = height
        outcome.metrics[e, agent, HighFiveTask.metrics.hand_upright] = upright
        outcome.metrics[e, agent, HighFiveTask.metrics.slap_impulse] = impulse
        outcome.success[e, agent] = done
        # a second chance after too hard a blow would make the upper bound a matter of patience
        outcome.terminated[e, agent] = done or too_hard


@wp.kernel
def observe_hands(
    bones: Bones,
    hands: Hands,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write ``HighFiveTask.observation_terms`` from component ``start``."""
    e = wp.tid()
    own = hands.middle[e, agent]
    other = 1 - agent
    write_in_root(observation, e, agent, start, bones, own - bones.position[e, 0])
    write_in_root(observation, e, agent, start + 3, bones, hands.direction[e, agent])
    write_in_root(observation, e, agent, start + 6, bones, hands.middle[e, other] - own)
    write_in_root(observation, e, agent, start + 9, bones, hands.velocity[e, other])


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
    """Write the drawn hand and impulse; a component of -1 is not observed."""
    e = wp.tid()
    if side_at >= 0:
        observation[e, agent, side_at] = 2.0 * float(side[e]) - 1.0
    if least_at >= 0:
        observation[e, agent, least_at] = least[e]


SIDES = ("left", "right")
#: Joints that act by default: those between the hand and the pelvis.
SPINE, ARM = ("spine1", "spine2", "spine3"), ("collar", "shoulder", "elbow", "wrist")


class HighFiveConfig(EnvConfig):
    """Settings of HighFive."""

    episode_seconds: float = Field(2.5, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    joints: tuple[str, ...] | None = Field(None, description="joints that act; null for the spine and the hand's arm")
    hand: Literal["left", "right", "random"] = Field("right", description="hand that each of them has to raise")
    spacing: float = Field(0.8, ge=0.5, le=2.0, description="between the two, where the scene does not place them [m]")
    place_noise: float = Field(0.05, ge=0.0, le=0.3, description="greatest displacement of each along x and y [m]")
    pose_noise: float = Field(0.1, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")
    impulse: ImpulseRange = Field(
        (1.0, 1.0), description="range from which the weakest slap that counts is drawn, for each episode [N s]"
    )
    impulse_window: float = Field(
        4.0, gt=1.0, le=1000.0, description="strongest slap that counts, over the weakest [-]"
    )
    reach: Margin = Field(0.15, description="distance of the hands' middles up to which a slap counts [m]")
    least_height: float = Field(1.35, ge=0.0, le=10.0, description="least height of both hands for a slap to count [m]")
    upright: float = Field(
        0.5, ge=-1.0, le=1.0, description="least upward part of both hands' directions for a slap to count [-]"
    )
    margin: Margin = Field(0.8, description="way to go, beyond `reach`, at which the reward has fallen to 0.1 [m]")
    approach_weight: Weight = Field(0.2, description="greatest reward of a step without a slap [-]")
    slap_bonus: Weight = Field(20.0, description="reward of a slap that counts [-]")
    control_cost: Weight = Field(0.02, description="weight of the mean squared action [-]")
    fall: FallConfig = Field(default_factory=FallConfig, description="limits of a fall under torques")


class HighFiveTask(Task):
    """Meet the other's hand with a slap."""

    Config = HighFiveConfig
    description = "two avatars slap hands, high up and neither too softly nor too hard"
    observation_terms = (
        ObservationTerm("own_hand", 3, "m", "root", "middle of the hand to raise, from the pelvis"),
        ObservationTerm("own_hand_direction", 3, "-", "root", "unit vector from its wrist to its middle"),
        ObservationTerm("partner_hand", 3, "m", "root", "middle of the partner's hand, from that of the own hand"),
        ObservationTerm("partner_hand_velocity", 3, "m/s", "root", "velocity of the partner's hand"),
    )
    rewards = (
        Term(
            "approach",
            "`approach_weight` while the way to go is at most `reach`; beyond it a Gaussian that has fallen to a tenth "
            "at `reach + margin`. The way is `distance`, plus the deficit of `hand_height` to `least_height`, plus 0.2 "
            "m times the deficit of `hand_upright` to `upright`",
        ),
        Term("slap", "`slap_bonus` in the step that is a success"),
        Term("control", f"{CONTROL.description} of both agents"),
    )
    metrics = (
        Metric("distance", "m", "between the middles of the two hands"),
        Metric("hand_height", "m", "height of the lower hand"),
        Metric("hand_upright", "-", "upward part of the unit vector from wrist to hand, the lesser of the two"),
        Metric("slap_impulse", "N s", "impulse between the arms in this step, the lesser of those on the two arms"),
    )
    state_arrays = (TaskArray("side", int), TaskArray("least"))
    scratch_arrays = tuple(TaskArray(name, wp.vec3, (2,)) for name in ("middle", "direction", "velocity"))
    observes_contact = True
    observes_others = True
    camera_direction = (2.9, -0.9, 0.8)

    summary = """Two avatars stand face to face, `spacing` apart and each displaced by up to `place_noise`, with their
arms down. Each has to raise its `hand` and slap the other's. It is a high five when the impulse of arm on arm, summed
over one control step, is at least `impulse` and at most `impulse_window` times that, while the hands are within `reach`
of each other, both `least_height` or higher and both pointing up (`upright`). Both agents get the same reward. Holding
the hands together is not enough: they must swing, at the same moment."""
    success_doc = (
        "`slap_impulse` is between the episode's `impulse` and `impulse_window` times that, while `distance` is at "
        "most `reach`, `hand_height` at least `least_height` and `hand_upright` at least `upright`"
    )
    termination_doc = (
        "both agents at once: with a success, with a blow above the upper bound, and when either falls;\n- "
        f"{UNDER_TORQUES_DOC}"
    )
    picture_seconds = 0.3
    picture_actions: ClassVar[Mapping[str, float]] = {
        "right_shoulder.x": -0.68, "right_shoulder.y": -0.61, "right_shoulder.z": 0.65, "right_elbow.x": -0.33,
        "right_elbow.y": -0.15, "right_elbow.z": 0.34, "right_wrist.x": -0.54, "right_wrist.y": 0.15,
        "right_wrist.z": 0.14,
    }  # fmt: skip
    picture_settings: ClassVar[Mapping[str, Any]] = {"place_noise": 0.0, "pose_noise": 0.0}

    config: HighFiveConfig

    def __init__(self, config: HighFiveConfig) -> None:
        super().__init__(config)
        check_ranges(config, "impulse")
        self.sides = (0, 1) if config.hand == "random" else (SIDES.index(config.hand),) * 2
        arms = [f"{SIDES[side]}_{joint}" for side in sorted(set(self.sides)) for joint in ARM]
        self.joints = select_joints(config.joints or (*SPINE, *arms))

    def build_scene(self) -> SceneConfig:
        scene, apart = self.config.scene, 0.5 * self.config.spacing
        if len(scene.avatars) not in (0, 2):
            raise ConfigError(f"scene.avatars has {len(scene.avatars)} entries; HighFive takes two, or none")
        facing = [AvatarConfig(position=(0.0, apart)), AvatarConfig(position=(0.0, -apart), yaw=math.pi)]
        return scene if scene.avatars else replace(scene, {"avatars": facing})

    def terms(self) -> tuple[ObservationTerm, ...]:
        drawn = []
        if self.sides[0] != self.sides[1]:
            drawn.append(ObservationTerm("hand_side", 1, "-", "-", "the hand to raise: -1 the left, 1 the right"))
        if self.config.impulse[0] != self.config.impulse[1]:
            drawn.append(ObservationTerm("least_impulse", 1, "N s", "-", "the weakest slap that counts"))
        return (*self.observation_terms, *drawn)

    def drawn(self) -> tuple[Parameter, ...]:
        return (
            Parameter("hand_side", "-", *self.sides, "the hand to raise: 0 the left, 1 the right"),
            Parameter("least_impulse", "N s", *self.config.impulse, "the weakest slap that counts"),
        )

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        return Drawn(self.side), Drawn(self.least)

    def allocate(self, env) -> None:
        self.rule, self.hands = fill(SlapRule(), self.config), fill(Hands(), self)
        self.referee = Referee(env, self.config.fall)

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        record_shift(env, graph, self.config.place_noise)
        bounds = [wp.vec2i(*self.sides), wp.vec2(*self.config.impulse)]
        inputs = [env.episodes, *bounds]
        graph.launch(draw_slap, env.num_envs, inputs, [self.side, self.least])

    def _record_hands(self, env, graph) -> None:
        for agent, bones in enumerate(env.bones):
            graph.launch(locate_hand, env.num_envs, [agent, bones, self.side], [self.hands])

    def record_outcome(self, env, graph) -> None:
        self._record_hands(env, graph)
        inputs = [self.rule, self.side, self.least, self.hands, env.simulation.sensors, env.action]
        graph.launch(judge, env.num_envs, inputs, [env.outcome])
        self.referee.record(env, graph)
        self.referee.record_shared_end(env, graph)

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        self._record_hands(env, graph)
        graph.launch(observe_hands, env.num_envs, [env.bones[agent], self.hands, agent, start], [env.observation])
        at = [env.layout[name].slice.start if name in env.layout else -1 for name in ("hand_side", "least_impulse")]
        graph.launch(observe_draws, env.num_envs, [agent, *at, self.side, self.least], [env.observation])


TASK = HighFiveTask
