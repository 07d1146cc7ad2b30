"""Sumo: push the others out of the ring, or over, and stay in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.motion.keyframes import Arm, Foot, Key
from piavatar_envs.config import ConfigError
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome
from piavatar_envs.envs.framing import Sphere
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.task import Metric, Term
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.markers import MarkerSpec
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.fall import UNDER_TORQUES_DOC, FallConfig
from piavatar_envs.tasks.common.multi_agent import (
    NUM_PARTS,
    RING_CENTRE,
    RING_FALL,
    Referee,
    RingConfig,
    RingTask,
    from_centre,
    has_won,
    others_in,
    part_impulse_by,
)
from piavatar_envs.tasks.common.ranges import Weight
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action

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
#: Room beyond the ring, in which the avatars that are out lie, up to the walls of the domain [m].
ROOM = 1.2
RIM_MARKERS = 48
MARKER = 0.03  # radius of one [m]


class SumoConfig(RingConfig):
    """Settings of Sumo."""

    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until the draw [s]")
    joints: tuple[str, ...] | None = Field(JOINTS, description="joints that act, besides the root; null for all 21")
    ring_radius: float = Field(1.2, ge=0.5, le=5.0, description="radius of the ring [m]")
    fall: FallConfig = Field(RING_FALL, description="limits of being pushed over, under torques")
    win_reward: Weight = Field(10.0, description="reward of the last one standing [-]")
    out_cost: Weight = Field(10.0, description="cost of going out [-]")
    push_weight: Weight = Field(0.02, description="weight of being nearer to the centre than the others [-]")


@wp.struct
class Ring:
    """Constants of the rules."""

    ring_radius: float
    win_reward: float
    out_cost: float
    push_weight: float
    control_cost: float


@wp.kernel
def judge(
    ring: Ring,
    pelvis: wp.array2d(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.bool),
    episodes: Episodes,
    sensors: Sensors,
    action: wp.array3d(dtype=float),
    # out
    outcome: Outcome,
):
    """Reward the last one in, cost going out, and compare the distances from the centre."""
    e, agent = wp.tid()
    others = others_in(episodes, out, e, agent)
    won = has_won(episodes, out, e, agent, others)
    lost = out[e, agent] and episodes.failure[e] == 0
    own = from_centre(pelvis[e, agent])
    theirs = float(0.0)
    pushed = wp.vec3()
    for other in range(episodes.alive.shape[1]):
        if other != agent:
            for part in range(NUM_PARTS):
                pushed += part_impulse_by(sensors, e, agent, part, other)
            if episodes.alive[e, other]:
                theirs += wp.min(from_centre(pelvis[e, other]), ring.ring_radius)
    lead = float(0.0)
    if others[0] > 0:
        lead = (theirs / float(others[0]) - wp.min(own, ring.ring_radius)) / ring.ring_radius
    outcome.terms[e, agent, SumoTask.rewards.win] = wp.where(won, ring.win_reward, 0.0)
    outcome.terms[e, agent, SumoTask.rewards.out] = wp.where(lost, -ring.out_cost, 0.0)
    outcome.terms[e, agent, SumoTask.rewards.push] = ring.push_weight * lead
    outcome.terms[e, agent, SumoTask.rewards.control] = -ring.control_cost * mean_square_action(action, e, agent)
    outcome.metrics[e, agent, SumoTask.metrics.rim_distance] = ring.ring_radius - own
    outcome.metrics[e, agent, SumoTask.metrics.push_impulse] = wp.length(wp.vec3(pushed[0], pushed[1], 0.0))
    outcome.metrics[e, agent, SumoTask.metrics.standing] = float(others[1]) + wp.where(out[e, agent], 0.0, 1.0)
    outcome.success[e, agent] = won
    outcome.terminated[e, agent] = won or out[e, agent]


@wp.kernel
def observe_rim(
    radius: float,
    bones: Bones,
    agent: int,
    place: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the term ``rim_distance``."""
    e = wp.tid()
    observation[e, agent, place] = radius - from_centre(bones.position[e, 0])


class SumoTask(RingTask):
    """Be the last one in the ring."""

    Config = SumoConfig
    description = "push the others out of the ring, or over, and stay in it"
    observation_terms = (
        RING_CENTRE,
        ObservationTerm("rim_distance", 1, "m", "-", "from the pelvis to the rim, horizontally; negative outside"),
    )
    rewards = (
        Term("win", "`win_reward` for the last one in, once"),
        Term("out", "`-out_cost` when the agent goes out, once; for each of several that go out in the same step"),
        Term(
            "push",
            "`push_weight` times the others' mean distance from the centre less the agent's own, over `ring_radius`; "
            "between `-push_weight` and `push_weight`",
        ),
        CONTROL,
    )
    metrics = (
        Metric("rim_distance", "m", "from the pelvis to the rim, horizontally; negative outside"),
        Metric("push_impulse", "N s", "horizontal impulse of all other avatars in this step"),
        Metric("standing", "-", "number of agents that are still in"),
    )
    stance_key = STANCE
    camera_direction = (3.4, -3.0, 2.2)
    camera_follows = False

    summary = """`num_agents` avatars crouch `start_distance` apart around the centre of a ring of `ring_radius`, facing
it, each displaced by up to `place_noise`. The trunk, the arms and the root act. A root that moves into another body
pushes it, the harder the farther the command is ahead of the body, up to `root_lead_limit`. An agent is out when its
pelvis leaves the ring or when it has been pushed over; its body stays where it fell. Under torques, an avatar that
kneels or can reach the ground with its hands has been pushed over, and legs must act (`joints=None`) for it to stay up.
The last one in wins; when the clock runs out it is a draw. A good agent keeps to the centre, gets the others off it and
does not lose its balance."""
    success_doc = "all others are out"
    termination_doc = f"the pelvis is beyond `ring_radius`, or all others are out;\n- {UNDER_TORQUES_DOC}"
    picture_seconds = 0.6
    picture_actions: ClassVar[Mapping[str, float]] = {"root.y": -1.0}
    picture_settings: ClassVar[Mapping[str, Any]] = {"place_noise": 0.0}

    config: SumoConfig

    def __init__(self, config: SumoConfig) -> None:
        super().__init__(config)
        if self.start_radius >= config.ring_radius:
            raise ConfigError(
                f"num_agents={config.num_agents} at start_distance={config.start_distance} m stand on a circle of "
                f"{self.start_radius:.3g} m, outside ring_radius={config.ring_radius} m; use ring_radius >= "
                f"{self.start_radius + 0.3:.2g}"
            )

    def shown(self) -> list[Sphere]:
        """Return avatars and ring."""
        turns = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
        rim = self.config.ring_radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
        return super().shown() + [(x, y, 0.0, MARKER) for x, y in rim.tolist()]

    def domain(self) -> Domain:
        side = self.config.ring_radius + ROOM
        height = Domain().upper[2]
        return super().domain().including((-side, -side, 0.0), (side, side, height))

    def allocate(self, env) -> None:
        self.ring = fill(Ring(), self.config)
        self.referee = Referee(env, self.config.fall, self.config.ring_radius)

    def record_outcome(self, env, graph) -> None:
        referee, agents = self.referee, (env.num_envs, env.num_agents)
        referee.record(env, graph)
        inputs = [self.ring, referee.pelvis, referee.out, env.episodes, env.simulation.sensors, env.action]
        graph.launch(judge, agents, inputs, [env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        super().record_observe(env, graph, agent, start)
        inputs = [self.config.ring_radius, env.bones[agent], agent, start + RING_CENTRE.size]
        graph.launch(observe_rim, env.num_envs, inputs, [env.observation])

    def marker_specs(self) -> tuple[MarkerSpec, ...]:
        """Return the rim of the ring, as balls."""
        turns = 2.0 * np.pi * np.arange(RIM_MARKERS) / RIM_MARKERS
        rim = self.config.ring_radius * np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=-1)
        return tuple(MarkerSpec("sphere", (MARKER,), (0.85, 0.65, 0.30), tuple(at)) for at in rim.tolist())


TASK = SumoTask
