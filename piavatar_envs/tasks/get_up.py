"""GetUp: from lying on the ground, face down or face up, to standing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.rotation import quat_exp
from piavatar_envs.avatar.types import Body
from piavatar_envs.config import ControlConfig, EnvConfig, TorqueControlConfig
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Task
from piavatar_envs.mpm.types import row
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.ground import Grounding
from piavatar_envs.tasks.common.lying import first_poses, lying_rule, spawn_lying
from piavatar_envs.tasks.common.ranges import Margin, Weight
from piavatar_envs.tasks.common.rising import RISING_DOCS, RISING_TERMS, record_rising_outcome
from piavatar_envs.tasks.common.upright import (
    METRIC_DOCS,
    METRICS,
    STANDING_DOC,
    UPRIGHT_TERMS,
    StillConfig,
    UprightConfig,
    record_observe_upright,
    still_rule,
    upright_rule,
)

wp.set_module_options({"enable_backward": False})

#: How far the assisted pelvis is led: upwards [m] and towards upright [rad].
LEAD, LEAD_TURN = wp.constant(0.15), wp.constant(0.3)
#: Room to each side, besides what a fall takes: bodies that have got up seldom stand still at once [m].
ASIDE = 3.0


class GetUpConfig(EnvConfig):
    """Settings of GetUp."""

    control: ControlConfig = Field(default_factory=TorqueControlConfig, description="how actions move the body")
    upright: UprightConfig = Field(default_factory=UprightConfig, description="what counts as standing")
    still: StillConfig = Field(default_factory=StillConfig, description="where rewards of standing still end")
    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    hold_seconds: Margin = Field(1.0, description="how long it must stand [s]")
    face_up: float = Field(0.5, ge=0.0, le=1.0, description="share of episodes that begin face up [-]")
    halfway: float = Field(
        0.0, ge=0.0, le=1.0, description="share of episodes that begin on the way up, as a curriculum [-]"
    )
    feet_margin: Margin = Field(
        0.6,
        description="how much further off the pelvis than in standing feet have a reward of 0.1, in its heights [-]",
    )
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle off the lying pose [rad]")


@wp.kernel
def lead_up(
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    # in and out
    reference_rotation: wp.array2d(dtype=wp.quat),
    reference_root: wp.array(dtype=wp.vec3),
):
    """Where assistance pulls the pelvis: from where it is a little upwards and towards upright, no higher than that.

    The joints' references are those of the rest pose. Over ``(E, bones)``.
    """
    e, b = wp.tid()
    if b > 0:
        reference_rotation[e, b] = wp.quat_identity()
        return
    at = position[e, 0]
    height = body.rest_joint[row(e, body.rest_joint.shape[0]), 0][2]
    reference_root[e] = wp.vec3(at[0], at[1], wp.min(at[2] + LEAD, height))
    q = rotation[e, 0]
    up = wp.quat_rotate(q, wp.vec3(0.0, 0.0, 1.0))
    axis = wp.cross(up, wp.vec3(0.0, 0.0, 1.0))
    angle = wp.atan2(wp.length(axis), up[2])
    turn = wp.min(angle, LEAD_TURN) / wp.max(wp.length(axis), 1.0e-6)
    reference_rotation[e, 0] = wp.normalize(quat_exp(turn * axis) * q)


@wp.kernel
def forget_hold(
    mask: wp.array(dtype=wp.bool),
    # out
    held: wp.array(dtype=int),
):
    """Nobody stands yet in the masked environments."""
    e = wp.tid()
    if mask[e]:
        held[e] = 0


@wp.kernel
def judge_hold(
    steps: int,
    control_dt: float,
    metric: int,
    failure: wp.array(dtype=int),
    # in and out: success is standing, and becomes having stood long enough
    held: wp.array(dtype=int),
    success: wp.array2d(dtype=wp.bool),
    # out
    metrics: wp.array3d(dtype=float),
):
    """How long the avatar has been standing without a break."""
    e = wp.tid()
    if failure[e] == 0:
        held[e] = wp.where(success[e, 0], held[e] + 1, 0)
    success[e, 0] = held[e] >= steps
    metrics[e, 0, metric] = control_dt * float(held[e])


class GetUpTask(Task):
    """Stand up."""

    Config = GetUpConfig
    description = "from lying on the ground, face down or up, to standing"
    observation_terms = UPRIGHT_TERMS
    reward_terms = RISING_TERMS
    metrics = (*METRICS, "held_seconds")

    camera_position = (2.4, -3.6, 1.6)
    camera_target = (0.0, 0.0, 0.78)

    summary = """The avatar lies on the ground, face down or face up (`face_up`), turned about the vertical at random,
its arms beside it, its joints up to `pose_noise` off that pose; or (`halfway`, a curriculum) it is on the way up from
there: on all fours or on a knee, sitting or squatting, or half up. It shall stand up by the strength
of its joints, to the rest pose, and stay there for `hold_seconds`. Nothing but the clock ends an episode; a fall costs
time. Where it stands in the end does not matter. `root_assist` helps here in its own way: it leads the pelvis, from
wherever it is, upwards and towards upright. With `control="pose"` the root wrench keeps the pelvis where it lies, and
there is nothing to be learnt."""
    reward_docs: ClassVar[Mapping[str, str]] = RISING_DOCS
    metric_docs: ClassVar[Mapping[str, str]] = {
        **METRIC_DOCS,
        "held_seconds": "how long it has been standing without a break [s]",
    }
    success_doc = f"for `hold_seconds` without a break {STANDING_DOC}"
    picture_seconds = 1.0
    picture_actions = "zero"

    config: GetUpConfig

    def drawn(self) -> tuple[Parameter, ...]:
        return (
            Parameter(
                "face_up", "-", 0.0, 1.0, "1 if the episode began face up, or on the way up from there; 0 if face down"
            ),
        )

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        return (Drawn(self.lies_up),)

    def domain(self) -> Domain:
        places = [avatar.position for avatar in self.scene.avatars]
        return Domain().around([(x + way, y + way) for x, y, *_ in places for way in (-ASIDE, ASIDE)])

    def allocate(self, env) -> None:
        n, device, config = env.num_envs, env.device, self.config
        self.rule, self.still = upright_rule(config.upright, config.control_cost), still_rule(config.still)
        self.grounding = Grounding(env)
        self.steps = max(1, round(config.hold_seconds / config.physics.control_dt))
        self.held = wp.zeros(n, dtype=int, device=device)
        self.lies_up = wp.zeros(n, dtype=float, device=device)
        self.reference_rotation = wp.zeros((n, NUM_JOINTS), dtype=wp.quat, device=device)
        self.reference_root = wp.zeros(n, dtype=wp.vec3, device=device)
        self.poses = first_poses(device)

    def arrays(self) -> dict[str, wp.array]:
        return {"held": self.held}

    def record_reset(self, env, graph) -> None:
        state, avatar = env.simulation.avatar.state, self.scene.avatars[0]
        limits, config = env.action_map, self.config
        rule = lying_rule(config.face_up, config.halfway, config.pose_noise)
        graph.launch(
            spawn_lying,
            (env.num_envs, NUM_JOINTS),
            [
                env.mask, env.seed, env.episode, rule, limits.lower, limits.upper, self.poses,
                wp.vec3(*avatar.position, 0.0),
            ],
            [state.command_rotation, state.command_root, self.lies_up],
        )  # fmt: skip
        self.grounding.record_reset(env, graph)
        graph.launch(forget_hold, env.num_envs, [env.mask], [self.held])

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        if env.control == "pose":
            return super().record_references(env, graph)
        avatar = env.simulation.avatar
        graph.launch(
            lead_up,
            (env.num_envs, NUM_JOINTS),
            [avatar.body, avatar.tracked.rotation, avatar.tracked.position],
            [self.reference_rotation, self.reference_root],
        )
        return [(self.reference_rotation, self.reference_root)]

    def record_outcome(self, env, graph) -> None:
        record_rising_outcome(env, graph, self.rule, self.still, self.config.feet_margin)
        dt = self.config.physics.control_dt
        graph.launch(
            judge_hold,
            env.num_envs,
            [self.steps, dt, len(METRICS), env.failure],
            [self.held, env.success, env.metrics],
        )

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        record_observe_upright(env, graph, agent, start)


TASK = GetUpTask
