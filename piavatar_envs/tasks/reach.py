"""Reach: move either hand to a target that moves on a sphere around the body."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import warp as wp
from pydantic import Field

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import EnvConfig
from piavatar_envs.core.rng import STREAM_TASK
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, random_of, rest_joint, write_in_root
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.sim.markers import Markers, MarkerSpec
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.tasks.common.hands import LEFT_WRIST, RIGHT_WRIST, flesh_middle
from piavatar_envs.tasks.common.ranges import Margin, Weight
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance
from piavatar_envs.tasks.common.spawn import record_standing

wp.set_module_options({"enable_backward": False})

SIDE = wp.constant(1.6)  # greatest azimuth of the swing's middle [rad]
BELOW, ABOVE = wp.constant(-0.7), wp.constant(0.9)  # its least and greatest elevation [rad]
SLOWEST = wp.constant(0.3)  # least bound of the target's speed over `target_speed` [-]
TURN = wp.constant(6.2831853)  # a whole turn [rad]
CHEST = wp.constant(joint_index("spine3"))  # at the centre of the target's sphere
COURSE = (
    Parameter("target_azimuth", "rad", -SIDE, SIDE, "middle of the swing, from the front"),
    Parameter("target_elevation", "rad", BELOW, ABOVE, "middle of the swing, upwards"),
    Parameter("target_pace", "-", SLOWEST, 1.0, "bound of the target's speed over `target_speed`"),
    Parameter("target_tilt", "rad", 0.0, TURN, "direction of the swing in azimuth and elevation"),
)
PHASE = (
    Parameter("target_phase_azimuth", "rad", 0.0, TURN, "first phase of the swing in azimuth"),
    Parameter("target_phase_elevation", "rad", 0.0, TURN, "first phase of the swing in elevation"),
)


class ReachConfig(EnvConfig):
    """Settings of Reach."""

    radius: float = Field(0.45, gt=0.0, le=1.0, description="radius of the target's sphere about the chest [m]")
    target_speed: float = Field(0.3, ge=0.0, le=5.0, description="bound of the target's speed [m/s]")
    target_radius: float = Field(0.08, gt=0.0, le=0.5, description="distance that counts as reached [m]")
    margin: Margin = Field(0.4, description="distance beyond it at which the reward has fallen to 0.1 [m]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.1, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


@wp.struct
class Target:
    """Constants of the target's motion and of its reward, as in the settings."""

    radius: float
    target_speed: float
    target_radius: float
    margin: float
    control_cost: float
    control_dt: float


@wp.struct
class Swing:
    """Motion of the target, ``(num_envs,)``."""

    course: wp.array(dtype=wp.vec4)  # parameters COURSE
    phase: wp.array(dtype=wp.vec2)  # parameters PHASE


@wp.kernel
def draw_target(
    episodes: Episodes,
    # out
    swing: Swing,
):
    """Draw course and phase in the masked environments."""
    e = wp.tid()
    if episodes.mask[e]:
        random = random_of(episodes, e, STREAM_TASK, 0)
        azimuth, elevation = wp.randf(random, -SIDE, SIDE), wp.randf(random, BELOW, ABOVE)
        swing.course[e] = wp.vec4(azimuth, elevation, wp.randf(random, SLOWEST, 1.0), wp.randf(random, 0.0, TURN))
        swing.phase[e] = wp.vec2(wp.randf(random, 0.0, TURN), wp.randf(random, 0.0, TURN))


@wp.func
def goal_at(target: Target, swing: Swing, bones: Bones, e: int, time: float):
    """Return the target's position: both angles swing by 0.35 rad about the course, within the bound of the speed."""
    course, phase, size = swing.course[e], swing.phase[e], 0.35
    rate = target.target_speed * course[2] / (size * target.radius * 1.4143)
    azimuth = course[0] + size * wp.cos(course[3]) * wp.sin(rate * time + phase[0])
    elevation = course[1] + size * wp.sin(course[3]) * wp.sin(rate * time + phase[1])
    out = wp.vec3(wp.sin(azimuth) * wp.cos(elevation), -wp.cos(azimuth) * wp.cos(elevation), wp.sin(elevation))
    return rest_joint(bones.body, e, CHEST) + target.radius * out


@wp.kernel
def judge(
    target: Target,
    swing: Swing,
    bones: Bones,
    episodes: Episodes,
    action: wp.array3d(dtype=float),
    # out
    outcome: Outcome,
):
    """Reward the nearer hand. `step_count` is incremented after the outcome: the state is one step ahead of it."""
    e = wp.tid()
    goal = goal_at(target, swing, bones, e, target.control_dt * float(episodes.step_count[e] + 1))
    left = wp.length(flesh_middle(bones, e, LEFT_WRIST) - goal)
    right = wp.length(flesh_middle(bones, e, RIGHT_WRIST) - goal)
    distance = wp.min(left, right)
    outcome.terms[e, 0, ReachTask.rewards.reach] = tolerance(distance, target.target_radius, target.margin)
    outcome.terms[e, 0, ReachTask.rewards.control] = -target.control_cost * mean_square_action(action, e, 0)
    outcome.metrics[e, 0, ReachTask.metrics.distance] = distance
    outcome.metrics[e, 0, ReachTask.metrics.left_distance] = left
    outcome.metrics[e, 0, ReachTask.metrics.right_distance] = right
    outcome.success[e, 0] = distance <= target.target_radius


@wp.kernel
def observe(
    target: Target,
    swing: Swing,
    bones: Bones,
    episodes: Episodes,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the target's position, and ``ReachTask.observation_terms`` from component ``start``."""
    e = wp.tid()
    time = target.control_dt * float(episodes.step_count[e])
    here = goal_at(target, swing, bones, e, time)
    later = goal_at(target, swing, bones, e, time + target.control_dt)
    write_in_root(observation, e, agent, start, bones, here - bones.position[e, 0])
    write_in_root(observation, e, agent, start + 3, bones, (later - here) / target.control_dt)
    write_in_root(observation, e, agent, start + 6, bones, here - flesh_middle(bones, e, LEFT_WRIST))
    write_in_root(observation, e, agent, start + 9, bones, here - flesh_middle(bones, e, RIGHT_WRIST))


@wp.kernel
def place_target(
    target: Target,
    swing: Swing,
    bones: Bones,
    episodes: Episodes,
    # out
    markers: Markers,
):
    """Place the marker of the target."""
    e = wp.tid()
    markers.position[e, 0] = goal_at(target, swing, bones, e, target.control_dt * float(episodes.step_count[e]))


class ReachTask(Task):
    """Move either hand to the target and keep it there."""

    Config = ReachConfig
    description = "move either hand to a target that moves on a sphere around the body"
    observation_terms = (
        ObservationTerm("target_position", 3, "m", "root", "the target from the pelvis"),
        ObservationTerm("target_velocity", 3, "m/s", "root", "velocity of the target"),
        ObservationTerm("target_from_left_hand", 3, "m", "root", "the target from the left hand"),
        ObservationTerm("target_from_right_hand", 3, "m", "root", "the target from the right hand"),
    )
    rewards = (
        Term("reach", "1 while `distance` is at most `target_radius`; beyond it a Gaussian, 0.1 at another `margin`"),
        CONTROL,
    )
    metrics = (
        Metric("distance", "m", "from the middle of the nearer hand to the target"),
        Metric("left_distance", "m", "from the middle of the left hand to the target"),
        Metric("right_distance", "m", "from the middle of the right hand to the target"),
    )
    state_arrays = (TaskArray("course", wp.vec4, drawn=COURSE), TaskArray("phase", wp.vec2, drawn=PHASE))

    summary = """A target swings on a sphere of `radius` about the chest, in front of the body or beside it, at up to
0.7 of `target_speed`. The avatar stands upright, its joints slightly bent at random (`pose_noise`). A good agent moves
the middle of either hand to the target and keeps it there."""
    success_doc = "`distance` is at most `target_radius`"
    picture_seconds = 1.0
    picture_actions: ClassVar[Mapping[str, float]] = {
        "left_shoulder.z": -0.3, "left_elbow.x": -0.4, "left_elbow.z": 0.3, "spine3.z": -0.3,
    }  # fmt: skip

    def allocate(self, env) -> None:
        self.swing, target = fill(Swing(), self), fill(Target(), self.config, self.config.physics)
        self.inputs = [target, self.swing, env.bones[0], env.episodes]

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        graph.launch(draw_target, env.num_envs, [env.episodes], [self.swing])

    def record_outcome(self, env, graph) -> None:
        graph.launch(judge, env.num_envs, [*self.inputs, env.action], [env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        graph.launch(observe, env.num_envs, [*self.inputs, agent, start], [env.observation])

    def marker_specs(self) -> tuple[MarkerSpec, ...]:
        return (MarkerSpec("sphere", (self.config.target_radius,), (0.95, 0.35, 0.2)),)

    def record_markers(self, env, graph, markers) -> None:
        graph.launch(place_target, env.num_envs, self.inputs, [markers])


TASK = ReachTask
