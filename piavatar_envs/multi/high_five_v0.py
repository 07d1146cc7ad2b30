"""HighFive: two avatars face each other and slap one hand each, high up and neither too softly nor too hard."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import warp as wp
from pydantic import Field

from piavatar_envs.api.pettingzoo import AECEnv, AvatarParallelEnv, parallel_to_aec
from piavatar_envs.envs.actions import select_joints
from piavatar_envs.envs.config import AvatarConfig, ConfigError, EnvConfig, SceneConfig, replace
from piavatar_envs.envs.observations import ObservationTerm, Parameter
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.multi.slap import Hands, SlapRule, draw_slap, judge, locate_hand, observe_draws, observe_hands
from piavatar_envs.multi.together import record_fall_together, record_shift
from piavatar_envs.multi.versus import Referee
from piavatar_envs.tasks.base import Task
from piavatar_envs.tasks.fall import UNDER_TORQUES_DOC, FallConfig
from piavatar_envs.tasks.ranges import ImpulseRange, Margin, Weight, check_ranges
from piavatar_envs.tasks.spawn import record_standing

SIDES = ("left", "right")
#: Joints that act by default: those between the hand and the pelvis.
SPINE, ARM = ("spine1", "spine2", "spine3"), ("collar", "shoulder", "elbow", "wrist")


class HighFiveConfig(EnvConfig):
    """Settings of HighFive."""

    episode_seconds: float = Field(2.5, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    joints: tuple[str, ...] | None = Field(None, description="joints that act; null for the spine and the hand's arm")
    hand: Literal["left", "right", "random"] = Field("right", description="hand that each of them shall raise")
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
    margin: Margin = Field(0.8, description="way to go beyond reach at which the reward has fallen to 0.1 [m]")
    approach_weight: Weight = Field(0.2, description="greatest reward of a step without a slap [-]")
    slap_bonus: Weight = Field(20.0, description="reward of a slap that counts [-]")
    control_cost: Weight = Field(0.02, description="weight of the mean squared action [-]")
    fall: FallConfig = Field(default_factory=FallConfig, description="what counts as a fall under torques")


class HighFiveTask(Task):
    """Meet the other's hand with a slap."""

    Config = HighFiveConfig
    description = "two avatars slap one hand each, high up and neither too softly nor too hard"
    observation_terms = (
        ObservationTerm("own_hand", 3, "m", "root", "middle of the hand to raise, from the pelvis"),
        ObservationTerm("own_hand_direction", 3, "-", "root", "unit vector from its wrist to its middle"),
        ObservationTerm("partner_hand", 3, "m", "root", "middle of the partner's hand, from that of one's own"),
        ObservationTerm("partner_hand_velocity", 3, "m/s", "root", "velocity of the partner's hand"),
    )
    reward_terms = ("approach", "slap", "control")
    metrics = ("distance", "hand_height", "hand_upright", "slap_impulse")
    observes_contact = True
    observes_others = True
    camera_position = (2.9, -0.9, 1.75)
    camera_target = (0.0, 0.0, 0.95)

    summary = """Two avatars stand face to face, `spacing` apart and each displaced by up to `place_noise`, with their
arms down. Each shall raise its `hand` and slap the other's. It is a high five when the impulse of arm on arm, summed
over one control step, is at least `impulse` and at most `impulse_window` times that, while the hands are within
`reach` of each other, both `least_height` or higher and both pointing up (`upright`). Both agents are paid the same.
Holding the hands together is not enough: they must swing, at the same moment."""
    reward_docs: ClassVar[Mapping[str, str]] = {
        "approach": "`approach_weight` while the way to go is at most `reach`; beyond it a Gaussian that has fallen to "
        "a tenth at `reach + margin`. The way is `distance`, plus what `hand_height` lacks of `least_height`, plus "
        "0.2 m times what `hand_upright` lacks of `upright`",
        "slap": "`slap_bonus` in the step that is a success",
        "control": "`-control_cost` times the mean of the squared action components of both agents",
    }
    metric_docs: ClassVar[Mapping[str, str]] = {
        "distance": "between the middles of the two hands [m]",
        "hand_height": "height of the lower hand [m]",
        "hand_upright": "upward part of the unit vector from wrist to hand, the lesser of the two [-]",
        "slap_impulse": "impulse between the arms in this step, the lesser of what the two have felt [N s]",
    }
    success_doc = (
        "`slap_impulse` is between the episode's `impulse` and `impulse_window` times that, while `distance` is at "
        "most `reach`, `hand_height` at least `least_height` and `hand_upright` at least `upright`"
    )
    termination_doc = (
        "both agents' ends with a success, with a blow above the upper bound, and when either falls;\n- "
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
        n, device = env.num_envs, env.device
        config, rule, hands = self.config, SlapRule(), Hands()
        rule.window, rule.reach, rule.height = config.impulse_window, config.reach, config.least_height
        rule.upright, rule.margin, rule.approach_weight = config.upright, config.margin, config.approach_weight
        rule.slap_bonus, rule.control_cost = config.slap_bonus, config.control_cost
        hands.middle, hands.direction, hands.velocity = (
            wp.zeros((n, 2), dtype=wp.vec3, device=device) for _ in range(3)
        )
        self.rule, self.hands, self.referee = rule, hands, Referee(env, config.fall)
        self.side, self.least = wp.zeros(n, dtype=int, device=device), wp.zeros(n, dtype=float, device=device)

    def arrays(self) -> dict[str, wp.array]:
        return {"side": self.side, "least": self.least}

    def record_reset(self, env, program) -> None:
        record_standing(env, program, self.config.pose_noise)
        record_shift(env, program, self.config.place_noise)
        program.launch(
            draw_slap,
            env.num_envs,
            [env.mask, env.seed, env.episode, wp.vec2i(*self.sides), wp.vec2(*self.config.impulse)],
            [self.side, self.least],
        )

    def _record_hands(self, env, program) -> None:
        for agent, avatar in enumerate(env.simulation.avatars):
            tracked = avatar.tracked
            program.launch(
                locate_hand,
                env.num_envs,
                [agent, avatar.body, self.side, tracked.rotation, tracked.position, tracked.velocity],
                [self.hands],
            )

    def record_outcome(self, env, program) -> None:
        self._record_hands(env, program)
        program.launch(
            judge,
            env.num_envs,
            [self.rule, self.side, self.least, self.hands, env.simulation.sensors, env.action],
            [env.terms, env.metrics, env.success, env.terminated],
        )
        self.referee.record(env, program)
        record_fall_together(env, program, self.referee.out)

    def record_observe(self, env, program, agent: int, start: int) -> None:
        self._record_hands(env, program)
        tracked = env.simulation.avatars[agent].tracked
        program.launch(
            observe_hands,
            env.num_envs,
            [agent, start, tracked.rotation, tracked.position, self.hands],
            [env.observation],
        )
        at = [env.layout[name].slice.start if name in env.layout else -1 for name in ("hand_side", "least_impulse")]
        program.launch(observe_draws, env.num_envs, [agent, *at, self.side, self.least], [env.observation])


TASK = HighFiveTask


def parallel_env(**settings: Any) -> AvatarParallelEnv:
    """The world; for the settings see :class:`~piavatar_envs.api.pettingzoo.AvatarParallelEnv`."""
    return AvatarParallelEnv(TASK, **settings)


def env(**settings: Any) -> AECEnv:
    """The same world, one agent after the other."""
    return parallel_to_aec(parallel_env(**settings))
