"""Sumo: push the others out of the ring, or over, and stay in it oneself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.motion.keyframes import Arm, Foot, Key
from piavatar_envs.config import ConfigError, EnvConfig, SceneConfig
from piavatar_envs.config.schema import select_joints
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.task import Task
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.fall import UNDER_TORQUES_DOC, FallConfig
from piavatar_envs.tasks.common.fights import (
    FIGHT_FALL,
    NUM_PARTS,
    RING_CENTRE,
    Referee,
    Stance,
    circle_radius,
    from_centre,
    has_won,
    on_circle,
    others_in,
    others_in_terms,
    part_impulse_by,
    record_centre,
    record_others_in,
)
from piavatar_envs.tasks.common.leash import record_leash
from piavatar_envs.tasks.common.ranges import Weight
from piavatar_envs.tasks.common.rewards import mean_square_action

wp.set_module_options({"enable_backward": False})

JOINTS = ("spine1", "spine2", "spine3", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow")
_PALMS_OUT = Arm((0.40, -0.62, -0.55), (-0.12, -0.92, 0.35))
STANCE = Key(
    0.0,
    pelvis=(0.0, 0.02, -0.14),
    turns={"spine1": (8.0, 0.0, 0.0), "spine2": (8.0, 0.0, 0.0), "neck": (-10.0, 0.0, 0.0)},
    left_foot=Foot((0.20, 0.0, 0.0)),
    right_foot=Foot((-0.20, 0.0, 0.0)),
    left_arm=_PALMS_OUT,
    right_arm=_PALMS_OUT,
)
#: Room beyond the ring: who is out lies there, and the walls of the domain keep it there [m].
ROOM = 1.2
RIM_MARKERS = 48


class SumoConfig(EnvConfig):
    """Settings of Sumo."""

    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until the draw [s]")
    num_agents: int = Field(2, ge=1, le=8, description="number of avatars")
    ring_radius: float = Field(1.2, ge=0.5, le=5.0, description="radius of the ring [m]")
    start_distance: float = Field(1.1, ge=0.6, le=5.0, description="between neighbours at the start [m]")
    joints: tuple[str, ...] | None = Field(JOINTS, description="joints that act, besides the root; null for all 21")
    root_speed: float = Field(1.5, gt=0.0, le=5.0, description="speed of the root at action 1 [m/s]")
    leash: float = Field(
        0.12, gt=0.0, le=0.4, description="greatest lead of the commanded root on the body before an action [m]"
    )
    leash_turn: float = Field(0.5, gt=0.0, le=1.5, description="greatest lead in turning before an action [rad]")
    fall: FallConfig = Field(FIGHT_FALL, description="what counts as being pushed over under torques")
    win_reward: Weight = Field(10.0, description="reward of the last one standing [-]")
    out_cost: Weight = Field(10.0, description="what it costs to be out [-]")
    push_weight: Weight = Field(0.02, description="weight of being nearer to the centre than the others [-]")
    control_cost: Weight = Field(0.01, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle off the first stance [rad]")
    place_noise: float = Field(0.05, ge=0.0, le=0.3, description="greatest displacement along x and y at the start [m]")


@wp.struct
class Ring:
    """Constants of the rules."""

    radius: float
    win_reward: float
    out_cost: float
    push_weight: float
    control_cost: float


@wp.kernel
def judge(
    ring: Ring,
    pelvis: wp.array2d(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
    failure: wp.array(dtype=int),
    sensors: Sensors,
    action: wp.array3d(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
    terminated: wp.array2d(dtype=wp.bool),
):
    """What it is worth to be in, out, or the last one in."""
    e, agent = wp.tid()
    others = others_in(e, agent, alive, out)
    won = has_won(e, agent, others, out, failure)
    own = from_centre(pelvis[e, agent])
    theirs = float(0.0)
    pushed = wp.vec3()
    for other in range(alive.shape[1]):
        if other != agent:
            for part in range(NUM_PARTS):
                pushed += part_impulse_by(sensors, e, agent, part, other)
            if alive[e, other]:
                theirs += wp.min(from_centre(pelvis[e, other]), ring.radius)
    lead = float(0.0)
    if others[0] > 0:
        lead = (theirs / float(others[0]) - wp.min(own, ring.radius)) / ring.radius
    terms[e, agent, 0] = wp.where(won, ring.win_reward, 0.0)
    terms[e, agent, 1] = wp.where(out[e, agent] and failure[e] == 0, -ring.out_cost, 0.0)
    terms[e, agent, 2] = ring.push_weight * lead
    terms[e, agent, 3] = -ring.control_cost * mean_square_action(action, e, agent)
    metrics[e, agent, 0] = ring.radius - own
    metrics[e, agent, 1] = wp.length(wp.vec3(pushed[0], pushed[1], 0.0))
    metrics[e, agent, 2] = float(others[1]) + wp.where(out[e, agent], 0.0, 1.0)
    success[e, agent] = won
    terminated[e, agent] = won or out[e, agent]


@wp.kernel
def observe_rim(
    agent: int,
    place: int,
    radius: float,
    position: wp.array2d(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """The term ``rim_distance``."""
    e = wp.tid()
    observation[e, agent, place] = radius - from_centre(position[e, 0])


class SumoTask(Task):
    """Be the last one in the ring."""

    Config = SumoConfig
    description = "push the others out of the ring, or over, and stay in it oneself"
    observation_terms = (
        RING_CENTRE,
        ObservationTerm("rim_distance", 1, "m", "-", "from the pelvis to the rim, horizontally; negative outside"),
    )
    reward_terms = ("win", "out", "push", "control")
    metrics = ("rim_distance", "push_impulse", "standing")
    observes_contact = True
    observes_others = True
    camera_position = (3.4, -3.0, 2.7)
    camera_target = (0.0, 0.0, 0.5)
    camera_follows = False

    summary = """`num_agents` avatars crouch `start_distance` apart around the centre of a ring of `ring_radius`, facing
it, each displaced by up to `place_noise`. The trunk, the arms and the root act: a root that walks into another body
pushes it, the harder the farther the command is ahead of the body, up to `leash`. Who has the pelvis beyond the ring,
or has been pushed over, is out, and its body stays where it fell. Under torques, who kneels or can reach the ground
with the hands has been pushed over, and it takes legs that act (`joints=None`) to stay up. The last one in has won;
when the clock runs out it is a draw. A good agent keeps to the centre, gets the others off it and does not lose its
balance."""
    reward_docs: ClassVar[Mapping[str, str]] = {
        "win": "`win_reward` for the last one in, once",
        "out": "`-out_cost` when one is out, once; also for all who go out in the same step",
        "push": "`push_weight` times how much farther from the centre the others are than oneself, on average, over "
        "`ring_radius`; between `-push_weight` and `push_weight`",
        "control": "`-control_cost` times the mean of the squared action components",
    }
    metric_docs: ClassVar[Mapping[str, str]] = {
        "rim_distance": "from the pelvis to the rim, horizontally; negative outside [m]",
        "push_impulse": "horizontal impulse by all other avatars in this step [N s]",
        "standing": "number of agents that are still in [-]",
    }
    success_doc = "all others are out"
    termination_doc = f"the pelvis is beyond `ring_radius`, or all others are out;\n- {UNDER_TORQUES_DOC}"
    picture_seconds = 0.6
    picture_actions: ClassVar[Mapping[str, float]] = {"root.y": -1.0}
    picture_settings: ClassVar[Mapping[str, Any]] = {"place_noise": 0.0}

    config: SumoConfig

    def __init__(self, config: SumoConfig) -> None:
        super().__init__(config)
        start = circle_radius(config.num_agents, config.start_distance)
        if start >= config.ring_radius:
            raise ConfigError(
                f"num_agents={config.num_agents} at start_distance={config.start_distance} m stand on a circle of "
                f"{start:.3g} m, outside ring_radius={config.ring_radius} m; use ring_radius >= {start + 0.3:.2g}"
            )
        self.joints, self.stance = select_joints(config.joints), Stance(STANCE)

    def build_scene(self) -> SceneConfig:
        return on_circle(self.config.scene, self.config.num_agents, self.config.start_distance)

    def terms(self) -> tuple[ObservationTerm, ...]:
        return (*self.observation_terms, *others_in_terms(self.config.num_agents))

    def action_spec(self) -> ActionSpec:
        speed = self.config.control.joint_speed_limit
        return ActionSpec(self.joints, root=True, joint_speed=speed, root_speed=self.config.root_speed)

    def domain(self) -> Domain:
        side = self.config.ring_radius + ROOM
        height = Domain().upper[2]
        return super().domain().including((-side, -side, 0.0), (side, side, height))

    def allocate(self, env) -> None:
        config, ring = self.config, Ring()
        ring.radius, ring.win_reward, ring.out_cost = config.ring_radius, config.win_reward, config.out_cost
        ring.push_weight, ring.control_cost = config.push_weight, config.control_cost
        self.ring, self.referee = ring, Referee(env, config.fall, config.ring_radius)

    def record_reset(self, env, graph) -> None:
        self.stance.record(env, graph, self.config.pose_noise, self.config.place_noise)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        return record_leash(env, graph, self.config.leash, self.config.leash_turn)

    def record_outcome(self, env, graph) -> None:
        self.referee.record(env, graph)
        graph.launch(
            judge,
            (env.num_envs, env.num_agents),
            [
                self.ring, self.referee.pelvis, self.referee.out, env.alive, env.failure, env.simulation.sensors,
                env.action,
            ],
            [env.terms, env.metrics, env.success, env.terminated],
        )  # fmt: skip

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        record_centre(env, graph, agent)
        graph.launch(
            observe_rim,
            env.num_envs,
            [agent, start + RING_CENTRE.size, self.ring.radius, env.simulation.avatars[agent].tracked.position],
            [env.observation],
        )
        record_others_in(env, graph, agent)

    def markers(self, env, index: int) -> list[tuple[np.ndarray, float, tuple[float, float, float]]]:
        turns = 2.0 * np.pi * np.arange(RIM_MARKERS) / RIM_MARKERS
        rim = self.config.ring_radius * np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=-1)
        return [(at, 0.03, (0.85, 0.65, 0.30)) for at in rim]


TASK = SumoTask
