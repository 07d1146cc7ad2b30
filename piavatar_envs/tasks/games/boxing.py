"""Points by blows: who has struck whom, where and how hard, from the impulses that body parts feel.

Boxing: strike the other's head and trunk with the arms, and keep one's own out of the way.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import BODY_PARTS
from piavatar_envs.avatar.motion.keyframes import Arm, Foot, Key
from piavatar_envs.config import ConfigError, ControlConfig, EnvConfig, PoseControlConfig, SceneConfig
from piavatar_envs.config.schema import select_joints
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.task import Task
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.fall import UNDER_TORQUES_DOC, FallConfig
from piavatar_envs.tasks.common.fights import (
    FIGHT_FALL,
    RING_CENTRE,
    Referee,
    Stance,
    circle_radius,
    has_won,
    on_circle,
    others_in,
    others_in_terms,
    part_impulse_by,
    record_centre,
    record_others_in,
)
from piavatar_envs.tasks.common.leash import record_leash
from piavatar_envs.tasks.common.ranges import Margin, Weight
from piavatar_envs.tasks.common.rewards import mean_square_action

wp.set_module_options({"enable_backward": False})


_PARTS = tuple(BODY_PARTS)
_HEAD, _TORSO = wp.constant(_PARTS.index("head")), wp.constant(_PARTS.index("torso"))
_LEFT_ARM, _RIGHT_ARM = wp.constant(_PARTS.index("left_arm")), wp.constant(_PARTS.index("right_arm"))
#: Share of the impulse that counts for nothing, below which a contact is over.
RELEASE = wp.constant(0.5)


@wp.struct
class Scale:
    """What a blow is worth."""

    least: float  # impulse up to which it counts for nothing, half of a full one [N s]
    points: wp.vec2  # of a full blow on head and trunk


@wp.struct
class Tally:
    """What has been counted, over ``(num_envs, num_agents, ...)``."""

    impulse: wp.array3d(dtype=wp.vec2)  # of an agent on head and trunk of another in the last step [N s]
    peak: wp.array3d(dtype=wp.vec2)  # the greatest since this contact began [N s]
    points: wp.array3d(dtype=float)  # what the last step was worth
    score: wp.array2d(dtype=float)  # sum of an agent's points in this bout


@wp.kernel
def begin_bout(
    mask: wp.array(dtype=wp.bool),
    # out
    peak: wp.array3d(dtype=wp.vec2),
    score: wp.array2d(dtype=float),
):
    """No blows and no points so far."""
    e, agent = wp.tid()
    if mask[e]:
        score[e, agent] = 0.0
        for other in range(peak.shape[2]):
            peak[e, agent, other] = wp.vec2(0.0, 0.0)


@wp.func
def landed(sensors: Sensors, e: int, agent: int, other: int):
    """Impulse of ``agent`` on head and trunk of ``other`` [N s], as far as its own arms have felt it."""
    left = part_impulse_by(sensors, e, agent, _LEFT_ARM, other)
    right = part_impulse_by(sensors, e, agent, _RIGHT_ARM, other)
    arms = wp.length(left) + wp.length(right)
    head = wp.length(part_impulse_by(sensors, e, other, _HEAD, agent))
    torso = wp.length(part_impulse_by(sensors, e, other, _TORSO, agent))
    return wp.vec2(wp.min(head, arms), wp.min(torso, arms))


@wp.func
def worth(scale: Scale, impulse: wp.vec2):
    """Points of blows of these impulses [N s] on head and trunk."""
    full = impulse / scale.least - wp.vec2(1.0, 1.0)
    return wp.dot(scale.points, wp.vec2(wp.clamp(full[0], 0.0, 1.0), wp.clamp(full[1], 0.0, 1.0)))


@wp.kernel
def count_points(
    scale: Scale,
    alive: wp.array2d(dtype=wp.bool),
    failure: wp.array(dtype=int),
    sensors: Sensors,
    # in and out
    peak: wp.array3d(dtype=wp.vec2),
    score: wp.array2d(dtype=float),
    # out
    impulse: wp.array3d(dtype=wp.vec2),
    points: wp.array3d(dtype=float),
):
    """Points of every agent on every other: a contact counts once, by its greatest impulse, as that is reached."""
    e, agent = wp.tid()
    for other in range(alive.shape[1]):
        now = wp.vec2(0.0, 0.0)
        if other != agent and failure[e] == 0:
            now = landed(sensors, e, agent, other)
        before = peak[e, agent, other]
        most = wp.max(now, before)
        gain = worth(scale, most) - worth(scale, before)
        if not (alive[e, agent] and alive[e, other]):
            gain = 0.0
        points[e, agent, other] = gain
        score[e, agent] = score[e, agent] + gain
        impulse[e, agent, other] = now
        # who stays in touch has not struck again
        for target in range(2):
            if now[target] < RELEASE * scale.least:
                most[target] = 0.0
        peak[e, agent, other] = most


@wp.func
def leads(e: int, agent: int, alive: wp.array2d(dtype=wp.bool), score: wp.array2d(dtype=float)):
    """Whether nobody else who is in has as many points."""
    best = bool(alive.shape[1] > 1)
    for other in range(alive.shape[1]):
        if other != agent and alive[e, other] and score[e, other] >= score[e, agent]:
            best = False
    return best


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
#: Room that a boxer takes up beside the pelvis, to the ropes [m].
ROOM = 0.4


class BoxingConfig(EnvConfig):
    """Settings of Boxing."""

    # spine, shoulder, elbow and root add up: with a second spinal joint as fast as this, full actions could move a fist
    # by more than a grid spacing a substep
    control: ControlConfig = Field(
        default_factory=lambda: PoseControlConfig(joint_speed_limit=6.0), description="how actions move the body"
    )
    episode_seconds: float = Field(10.0, gt=0.0, le=3600.0, description="simulated time until the gong [s]")
    num_agents: int = Field(2, ge=1, le=8, description="number of avatars")
    ring_size: float = Field(3.2, ge=1.6, le=10.0, description="side of the square ring [m]")
    start_distance: float = Field(1.0, ge=0.6, le=5.0, description="between neighbours at the start [m]")
    joints: tuple[str, ...] | None = Field(JOINTS, description="joints that act, besides the root; null for all 21")
    root_speed: float = Field(1.0, gt=0.0, le=5.0, description="speed of the root at action 1 [m/s]")
    leash: float = Field(
        0.08, gt=0.0, le=0.4, description="greatest lead of the commanded root on the body before an action [m]"
    )
    leash_turn: float = Field(0.5, gt=0.0, le=1.5, description="greatest lead in turning before an action [rad]")
    blow_impulse: Margin = Field(
        1.0,
        description="impulse on a target up to which a blow counts for nothing; twice that is a full blow [N s]",
    )
    head_points: Weight = Field(1.0, description="points of a full blow on the head [-]")
    torso_points: Weight = Field(0.4, description="points of a full blow on the trunk [-]")
    taken_weight: Weight = Field(0.8, description="cost of the points that others score on oneself [-]")
    fall: FallConfig = Field(FIGHT_FALL, description="what counts as a knock-down under torques")
    win_reward: Weight = Field(5.0, description="reward of the last one on the feet [-]")
    down_cost: Weight = Field(5.0, description="what it costs to be knocked down [-]")
    control_cost: Weight = Field(0.01, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle off the first stance [rad]")
    place_noise: float = Field(0.05, ge=0.0, le=0.3, description="greatest displacement along x and y at the start [m]")


@wp.struct
class Rules:
    """Constants of the bout."""

    taken_weight: float
    win_reward: float
    down_cost: float
    control_cost: float
    max_steps: int


@wp.kernel
def judge(
    rules: Rules,
    tally: Tally,
    out: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
    failure: wp.array(dtype=int),
    step_count: wp.array(dtype=int),
    action: wp.array3d(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
    success: wp.array2d(dtype=wp.bool),
    terminated: wp.array2d(dtype=wp.bool),
):
    """What blows, a fall and a win are worth."""
    e, agent = wp.tid()
    others = others_in(e, agent, alive, out)
    won = has_won(e, agent, others, out, failure)
    hit = float(0.0)
    taken = float(0.0)
    given_impulse = float(0.0)
    taken_impulse = float(0.0)
    for other in range(alive.shape[1]):
        hit += tally.points[e, agent, other]
        taken += tally.points[e, other, agent]
        given_impulse = wp.max(given_impulse, wp.max(tally.impulse[e, agent, other]))
        taken_impulse = wp.max(taken_impulse, wp.max(tally.impulse[e, other, agent]))
    terms[e, agent, 0] = hit
    terms[e, agent, 1] = -rules.taken_weight * taken
    terms[e, agent, 2] = wp.where(won, rules.win_reward, 0.0)
    terms[e, agent, 3] = wp.where(out[e, agent] and failure[e] == 0, -rules.down_cost, 0.0)
    terms[e, agent, 4] = -rules.control_cost * mean_square_action(action, e, agent)
    metrics[e, agent, 0] = tally.score[e, agent]
    metrics[e, agent, 1] = given_impulse
    metrics[e, agent, 2] = taken_impulse
    # the step counter has not moved yet
    gong = step_count[e] + 1 >= rules.max_steps and failure[e] == 0 and not out[e, agent]
    success[e, agent] = won or (gong and leads(e, agent, alive, tally.score))
    terminated[e, agent] = won or out[e, agent]


class BoxingTask(Task):
    """Strike, and do not get struck."""

    Config = BoxingConfig
    description = "strike the other's head and trunk with the arms, and keep one's own out of the way"
    observation_terms = (RING_CENTRE,)
    reward_terms = ("hit", "taken", "win", "down", "control")
    metrics = ("score", "given_impulse", "taken_impulse")
    observes_contact = True
    observes_others = True
    camera_position = (3.7, -1.5, 1.8)
    camera_target = (0.0, 0.0, 0.85)
    camera_follows = False

    summary = """`num_agents` avatars stand on guard, `start_distance` apart around the centre of a square ring of
`ring_size`, each displaced by up to `place_noise`; smooth walls stand in for the ropes. The trunk, the arms and the
root act. A blow is an impulse on the other's head or trunk, in one control step, that one's own arms have felt as well.
It is worth nothing up to `blow_impulse` and `head_points` or `torso_points` from twice that on. A contact counts once,
by its strongest step, and is over when the impulse has fallen below half of `blow_impulse`: leaning scores nothing
more. Who is knocked down is out, and its body stays where it fell; the last one on the feet has won. Under torques, who
kneels or can reach the ground with the hands is down, and it takes legs that act (`joints=None`) to stay up. A good
agent strikes fast, at the head, and withdraws."""
    reward_docs: ClassVar[Mapping[str, str]] = {
        "hit": "the points of this step's blows, at most `head_points + torso_points` for each other agent",
        "taken": "`-taken_weight` times the points that others have scored on oneself",
        "win": "`win_reward` for the last one on the feet, once",
        "down": "`-down_cost` when one is knocked down, once",
        "control": "`-control_cost` times the mean of the squared action components",
    }
    metric_docs: ClassVar[Mapping[str, str]] = {
        "score": "points of this bout so far [-]",
        "given_impulse": "greatest impulse of one's own arms on a head or trunk in this step [N s]",
        "taken_impulse": "greatest impulse of another's arms on one's own head or trunk in this step [N s]",
    }
    success_doc = "all others are down, or the clock has run out and nobody else on the feet has as many points"
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
        need = 2.0 * (circle_radius(config.num_agents, config.start_distance) + ROOM)
        if need > config.ring_size:
            raise ConfigError(
                f"num_agents={config.num_agents} at start_distance={config.start_distance} m need a ring of "
                f"{need:.3g} m, more than ring_size={config.ring_size} m; use ring_size >= {need + 0.05:.2g}"
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
        """The ring; the walls of the domain are the ropes."""
        side, box = 0.5 * self.config.ring_size, Domain()
        return Domain((-side, -side, box.lower[2]), (side, side, box.upper[2]), fenced=True)

    def allocate(self, env) -> None:
        config, scale, rules, tally = self.config, Scale(), Rules(), Tally()
        scale.least, scale.points = config.blow_impulse, wp.vec2(config.head_points, config.torso_points)
        rules.taken_weight, rules.win_reward = config.taken_weight, config.win_reward
        rules.down_cost, rules.control_cost, rules.max_steps = config.down_cost, config.control_cost, env.max_steps
        pairs = env.num_envs, env.num_agents, env.num_agents
        tally.impulse, tally.peak = (wp.zeros(pairs, dtype=wp.vec2, device=env.device) for _ in range(2))
        tally.points = wp.zeros(pairs, dtype=float, device=env.device)
        tally.score = wp.zeros(pairs[:2], dtype=float, device=env.device)
        self.scale, self.rules, self.tally, self.referee = scale, rules, tally, Referee(env, config.fall)

    def arrays(self) -> dict[str, wp.array]:
        return {"peak": self.tally.peak, "score": self.tally.score}

    def record_reset(self, env, graph) -> None:
        self.stance.record(env, graph, self.config.pose_noise, self.config.place_noise)
        graph.launch(begin_bout, (env.num_envs, env.num_agents), [env.mask], [self.tally.peak, self.tally.score])

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        return record_leash(env, graph, self.config.leash, self.config.leash_turn)

    def record_outcome(self, env, graph) -> None:
        agents = env.num_envs, env.num_agents
        self.referee.record(env, graph)
        graph.launch(
            count_points,
            agents,
            [self.scale, env.alive, env.failure, env.simulation.sensors],
            [self.tally.peak, self.tally.score, self.tally.impulse, self.tally.points],
        )
        graph.launch(
            judge,
            agents,
            [self.rules, self.tally, self.referee.out, env.alive, env.failure, env.step_count, env.action],
            [env.terms, env.metrics, env.success, env.terminated],
        )

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        record_centre(env, graph, agent)
        record_others_in(env, graph, agent)

    def markers(self, env, index: int) -> list[tuple[np.ndarray, float, tuple[float, float, float]]]:
        side = 0.5 * self.config.ring_size
        corners = [(x, y, z) for x in (-side, side) for y in (-side, side) for z in (0.0, 0.45, 0.9, 1.35)]
        return [(np.array(corner), 0.03, (0.75, 0.20, 0.20)) for corner in corners]


TASK = BoxingTask
