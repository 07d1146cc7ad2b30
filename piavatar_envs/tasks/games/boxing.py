"""Boxing: strike the other's head and trunk with the arms, and guard your own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import BODY_PARTS
from piavatar_envs.avatar.motion.keyframes import Arm, Foot, Key
from piavatar_envs.config import ConfigError, ControlConfig, PoseControlConfig
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Episodes, Outcome
from piavatar_envs.envs.framing import Sphere
from piavatar_envs.envs.task import Metric, TaskArray, Term
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.markers import MarkerSpec
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.fall import UNDER_TORQUES_DOC, FallConfig
from piavatar_envs.tasks.common.multi_agent import (
    RING_CENTRE,
    RING_FALL,
    Referee,
    RingConfig,
    RingTask,
    has_won,
    others_in,
    part_impulse_by,
)
from piavatar_envs.tasks.common.ranges import Margin, Weight
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action

wp.set_module_options({"enable_backward": False})

#: Height of the posts of the ring, and of its ropes; radii of both [m].
TOP, ROPES, POST, ROPE = 1.3, (0.45, 0.85, 1.25), 0.04, 0.012
RED, DARK = (0.75, 0.20, 0.20), (0.22, 0.23, 0.26)
#: Turns of a rope from the z axis, wxyz.
ALONG_X, ALONG_Y = (0.5**0.5, 0.0, 0.5**0.5, 0.0), (0.5**0.5, -(0.5**0.5), 0.0, 0.0)
_PARTS = tuple(BODY_PARTS)
_HEAD, _TORSO = wp.constant(_PARTS.index("head")), wp.constant(_PARTS.index("torso"))
_LEFT_ARM, _RIGHT_ARM = wp.constant(_PARTS.index("left_arm")), wp.constant(_PARTS.index("right_arm"))
#: Share of `blow_impulse` below which a contact is over.
RELEASE = wp.constant(0.5)
JOINTS = ("spine2", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow")
STANCE = Key(
    0.0,
    pelvis=(0.0, 0.0, -0.06),
    turns={"spine1": (5.0, 0.0, 0.0), "spine2": (5.0, 0.0, 0.0), "neck": (-4.0, 0.0, 0.0)},
    left_foot=Foot((0.04, -0.22, 0.0)),
    right_foot=Foot((-0.06, 0.20, 0.0)),
    left_arm=Arm((0.35, -0.62, -0.70), (-0.10, -0.72, 0.69)),
    right_arm=Arm((0.35, -0.50, -0.80), (-0.08, -0.70, 0.71)),
)
#: Least distance of a pelvis from the ropes at the start [m].
ROOM = 0.4


class BoxingConfig(RingConfig):
    """Settings of Boxing."""

    # spine, shoulder, elbow and root add up: with a second spinal joint as fast as this, full actions could move a fist
    # by more than a grid spacing a substep
    control: ControlConfig = Field(
        default_factory=lambda: PoseControlConfig(joint_speed_limit=6.0), description="how actions move the body"
    )
    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until the gong [s]")
    start_distance: float = Field(1.0, ge=0.6, le=5.0, description="between neighbours at the start [m]")
    joints: tuple[str, ...] | None = Field(JOINTS, description="joints that act, besides the root; null for all 21")
    root_speed: float = Field(1.0, gt=0.0, le=5.0, description="speed of the root at action 1 [m/s]")
    root_lead_limit: float = Field(
        0.08, gt=0.0, le=0.4, description="greatest lead of the commanded root on the body before an action [m]"
    )
    ring_size: float = Field(3.2, ge=1.6, le=10.0, description="side of the square ring [m]")
    blow_impulse: Margin = Field(
        1.0, description="impulse on a target up to which a blow is worth nothing; twice that is a full blow [N s]"
    )
    head_points: Weight = Field(1.0, description="points of a full blow on the head [-]")
    torso_points: Weight = Field(0.4, description="points of a full blow on the trunk [-]")
    taken_weight: Weight = Field(0.8, description="cost of a point that another agent scores on the agent [-]")
    fall: FallConfig = Field(RING_FALL, description="limits of a knock-down, under torques")
    win_reward: Weight = Field(5.0, description="reward of the last one on its feet [-]")
    down_cost: Weight = Field(5.0, description="cost of being knocked down [-]")


@wp.struct
class Rules:
    """Constants of the bout, as in the settings."""

    blow_impulse: float  # [N s]
    points: wp.vec2  # of a full blow on head and trunk
    taken_weight: float
    win_reward: float
    down_cost: float
    control_cost: float
    max_steps: int


@wp.func
def landed(sensors: Sensors, e: int, agent: int, other: int):
    """Return the impulse of ``agent`` on head and trunk of ``other`` [N s], at most that on its own arms."""
    left = part_impulse_by(sensors, e, agent, _LEFT_ARM, other)
    right = part_impulse_by(sensors, e, agent, _RIGHT_ARM, other)
    arms = wp.length(left) + wp.length(right)
    head = wp.length(part_impulse_by(sensors, e, other, _HEAD, agent))
    torso = wp.length(part_impulse_by(sensors, e, other, _TORSO, agent))
    return wp.vec2(wp.min(head, arms), wp.min(torso, arms))


@wp.func
def worth(rules: Rules, impulse: wp.vec2):
    """Return the points of blows of these impulses [N s] on head and trunk."""
    full = impulse / rules.blow_impulse - wp.vec2(1.0, 1.0)
    return wp.dot(rules.points, wp.vec2(wp.clamp(full[0], 0.0, 1.0), wp.clamp(full[1], 0.0, 1.0)))


@wp.kernel
def count_points(
    rules: Rules,
    episodes: Episodes,
    sensors: Sensors,
    # in and out
    peak: wp.array3d(dtype=wp.vec2),
    score: wp.array2d(dtype=float),
    # out
    impulse: wp.array3d(dtype=wp.vec2),
    points: wp.array3d(dtype=float),
):
    """Count the points of every agent on every other: a contact counts once, by its greatest impulse so far."""
    e, agent = wp.tid()
    for other in range(episodes.alive.shape[1]):
        now = wp.vec2(0.0, 0.0)
        if other != agent and episodes.failure[e] == 0:
            now = landed(sensors, e, agent, other)
        before = peak[e, agent, other]
        most = wp.max(now, before)
        gain = worth(rules, most) - worth(rules, before)
        if not (episodes.alive[e, agent] and episodes.alive[e, other]):
            gain = 0.0
        points[e, agent, other] = gain
        score[e, agent] = score[e, agent] + gain
        impulse[e, agent, other] = now
        # a contact that lasts is not a new blow
        for target in range(2):
            if now[target] < RELEASE * rules.blow_impulse:
                most[target] = 0.0
        peak[e, agent, other] = most


@wp.func
def leads(episodes: Episodes, score: wp.array2d(dtype=float), e: int, agent: int):
    """Return whether no other agent that is in has as many points."""
    best = bool(episodes.alive.shape[1] > 1)
    for other in range(episodes.alive.shape[1]):
        if other != agent and episodes.alive[e, other] and score[e, other] >= score[e, agent]:
            best = False
    return best


@wp.kernel
def judge(
    rules: Rules,
    impulse: wp.array3d(dtype=wp.vec2),
    points: wp.array3d(dtype=float),
    score: wp.array2d(dtype=float),
    out: wp.array2d(dtype=wp.bool),
    episodes: Episodes,
    action: wp.array3d(dtype=float),
    # out
    outcome: Outcome,
):
    """Reward blows and the last one on its feet, cost blows taken and falls."""
    e, agent = wp.tid()
    others = others_in(episodes, out, e, agent)
    won = has_won(episodes, out, e, agent, others)
    down = out[e, agent] and episodes.failure[e] == 0
    hit = float(0.0)
    taken = float(0.0)
    given_impulse = float(0.0)
    taken_impulse = float(0.0)
    for other in range(episodes.alive.shape[1]):
        hit += points[e, agent, other]
        taken += points[e, other, agent]
        given_impulse = wp.max(given_impulse, wp.max(impulse[e, agent, other]))
        taken_impulse = wp.max(taken_impulse, wp.max(impulse[e, other, agent]))
    outcome.terms[e, agent, BoxingTask.rewards.hit] = hit
    outcome.terms[e, agent, BoxingTask.rewards.taken] = -rules.taken_weight * taken
    outcome.terms[e, agent, BoxingTask.rewards.win] = wp.where(won, rules.win_reward, 0.0)
    outcome.terms[e, agent, BoxingTask.rewards.down] = wp.where(down, -rules.down_cost, 0.0)
    outcome.terms[e, agent, BoxingTask.rewards.control] = -rules.control_cost * mean_square_action(action, e, agent)
    outcome.metrics[e, agent, BoxingTask.metrics.score] = score[e, agent]
    outcome.metrics[e, agent, BoxingTask.metrics.given_impulse] = given_impulse
    outcome.metrics[e, agent, BoxingTask.metrics.taken_impulse] = taken_impulse
    # `step_count` is incremented after the outcome
    gong = episodes.step_count[e] + 1 >= rules.max_steps and episodes.failure[e] == 0 and not out[e, agent]
    outcome.success[e, agent] = won or (gong and leads(episodes, score, e, agent))
    outcome.terminated[e, agent] = won or out[e, agent]


class BoxingTask(RingTask):
    """Strike, and do not get struck."""

    Config = BoxingConfig
    description = "strike the other's head and trunk with the arms, and guard your own"
    observation_terms = (RING_CENTRE,)
    rewards = (
        Term("hit", "the points of this step's blows, at most `head_points + torso_points` for each other agent"),
        Term("taken", "`-taken_weight` times the points that others have scored on the agent"),
        Term("win", "`win_reward` for the last one on its feet, once"),
        Term("down", "`-down_cost` when the agent is knocked down, once"),
        CONTROL,
    )
    metrics = (
        Metric("score", "-", "points of this bout so far"),
        Metric("given_impulse", "N s", "greatest impulse of the agent's arms on a head or trunk in this step"),
        Metric("taken_impulse", "N s", "greatest impulse of another's arms on the agent's head or trunk in this step"),
    )
    # over pairs, an agent's impulse on head and trunk of another [N s]: the greatest of the present contact
    state_arrays = (
        TaskArray("peak", wp.vec2, ("num_agents", "num_agents"), cleared=True),
        TaskArray("score", float, ("num_agents",), cleared=True),
    )
    # and that of the last step, with its points
    scratch_arrays = (
        TaskArray("impulse", wp.vec2, ("num_agents", "num_agents")),
        TaskArray("points", float, ("num_agents", "num_agents")),
    )
    stance_key = STANCE
    camera_direction = (3.7, -0.9, 1.2)
    camera_follows = False

    summary = """`num_agents` avatars stand on guard, `start_distance` apart around the centre of a square ring of
`ring_size`, each displaced by up to `place_noise`; smooth walls stand in for the ropes. The trunk, the arms and the
root act. A blow is an impulse on the other's head or trunk, in one control step, that acts on the striking arms as
well. It is worth nothing up to `blow_impulse`, and `head_points` or `torso_points` from twice that on. A contact counts
once, by its strongest step, and is over when the impulse has fallen below half of `blow_impulse`: leaning scores
nothing more. An agent that is knocked down is out, and its body stays where it fell; the last one on its feet wins.
Under torques, an avatar that kneels or can reach the ground with its hands is down, and legs must act (`joints=None`)
for it to stay up. A good agent strikes fast, at the head, and withdraws."""
    success_doc = "all others are down, or the clock has run out and no other agent on its feet has as many points"
    termination_doc = f"all others are down;\n- {UNDER_TORQUES_DOC}"
    picture_seconds = 0.33
    picture_actions: ClassVar[Mapping[str, float]] = {
        "right_shoulder.y": 0.42, "right_shoulder.z": 0.85, "right_elbow.x": 0.65, "right_elbow.z": -0.58,
        "spine2.z": 0.2, "root.y": -0.5,
    }  # fmt: skip
    picture_settings: ClassVar[Mapping[str, Any]] = {"place_noise": 0.0}

    config: BoxingConfig

    def __init__(self, config: BoxingConfig) -> None:
        super().__init__(config)
        need = 2.0 * (self.start_radius + ROOM)
        if need > config.ring_size:
            raise ConfigError(
                f"num_agents={config.num_agents} at start_distance={config.start_distance} m need a ring of "
                f"{need:.3g} m, more than ring_size={config.ring_size} m; use ring_size >= {need + 0.05:.2g}"
            )

    def shown(self) -> list[Sphere]:
        """Return avatars and ropes."""
        side = 0.5 * self.config.ring_size
        corners = [(x, y, z, POST) for x in (-side, side) for y in (-side, side) for z in (0.0, TOP)]
        return super().shown() + corners

    def domain(self) -> Domain:
        """Return the ring; the walls of the domain are the ropes."""
        side, box = 0.5 * self.config.ring_size, Domain()
        return Domain((-side, -side, box.lower[2]), (side, side, box.upper[2]), fenced=True)

    def allocate(self, env) -> None:
        points = wp.vec2(self.config.head_points, self.config.torso_points)
        self.rules, self.referee = fill(Rules(), self.config, env, points=points), Referee(env, self.config.fall)

    def record_outcome(self, env, graph) -> None:
        agents = env.num_envs, env.num_agents
        self.referee.record(env, graph)
        inputs = [self.rules, env.episodes, env.simulation.sensors]
        graph.launch(count_points, agents, inputs, [self.peak, self.score, self.impulse, self.points])
        inputs = [self.rules, self.impulse, self.points, self.score, self.referee.out, env.episodes, env.action]
        graph.launch(judge, agents, inputs, [env.outcome])

    def marker_specs(self) -> tuple[MarkerSpec, ...]:
        """Return the posts at the corners of the ring, and its ropes."""
        side, half = 0.5 * self.config.ring_size, 0.5 * TOP
        corners = [(x, y) for x in (-side, side) for y in (-side, side)]
        posts = [MarkerSpec("capsule", (POST, half - POST), DARK, (x, y, half)) for x, y in corners]
        ropes = [
            MarkerSpec("capsule", (ROPE, side), RED, place, turn)
            for height in ROPES
            for at in (-side, side)
            for place, turn in (((at, 0.0, height), ALONG_Y), ((0.0, at, height), ALONG_X))
        ]
        return (*posts, *ropes)


TASK = BoxingTask
