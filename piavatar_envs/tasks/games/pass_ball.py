"""PassBall: a circle of avatars passes a ball around, each to the next."""

from __future__ import annotations

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.config import EnvConfig, SceneConfig, replace
from piavatar_envs.config.schema import select_joints
from piavatar_envs.core.rng import STREAM_BALL
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.actions import ActionSpec, speed_within
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, Props, random_of, write_in_root
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain
from piavatar_envs.tasks.common.ball_goal import BALL, FEET_TERMS, ball_config, observe_feet
from piavatar_envs.tasks.common.fall import UNDER_TORQUES_DOC, FallConfig
from piavatar_envs.tasks.common.multi_agent import Referee, on_circle
from piavatar_envs.tasks.common.ranges import Margin, MassRange, SpeedRange, Weight, check_ranges
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action
from piavatar_envs.tasks.common.root_command import clamp_to_circle, record_root_clamp
from piavatar_envs.tasks.common.spawn import record_shift, record_standing

wp.set_module_options({"enable_backward": False})

#: Impulse of ball and body in a control step above which they have touched [N s].
TOUCH = wp.constant(1.0e-3)


@wp.struct
class Serve:
    """Constants of the serve from the middle of the circle."""

    prop: int
    radius: float  # of the ball [m]
    slow: float  # least speed [m/s]
    fast: float  # greatest speed [m/s]
    spread: float  # greatest angle off the way to the first passer [rad]
    light: float  # natural logarithm of the least density in kg/m^3
    heavy: float  # and of the greatest


@wp.struct
class PassRule:
    """Constants of the game."""

    subject: int  # the ball among the subjects of the scene
    ball_volume: float  # [m^3]
    reach: float  # distance from a pelvis at which the ball has arrived [m]
    least_pass: float  # least way of a pass from the passer's last touch [m]
    fetch: float  # distance from a pelvis at which a slow ball can still be fetched [m]
    rim: float  # distance from the origin at which the ball is out [m]
    dead_speed: float  # [m/s]
    goal_passes: int
    progress_weight: float
    pass_bonus: float
    control_cost: float


@wp.struct
class Play:
    """State of the game in every environment."""

    passer: wp.array(dtype=int)  # (num_envs,) the agent whose turn it is
    touched: wp.array(dtype=int)  # (num_envs,) 1 if the passer has touched the ball in this turn
    passes: wp.array(dtype=int)  # (num_envs,) completed passes
    left: wp.array(dtype=wp.vec3)  # (num_envs,) place of the ball at the passer's last touch [m], if there was one
    gap: wp.array(dtype=float)  # (num_envs,) from the ball to its receiver [m]; negative: not yet known
    contact: wp.array2d(dtype=int)  # (num_envs, num_agents) 1 for a touch in the last step
    touches: wp.array2d(dtype=int)  # (num_envs, num_agents) so far


@wp.kernel
def serve_ball(
    episodes: Episodes,
    serve: Serve,
    places: wp.array(dtype=wp.vec3),
    # out
    first: Props,
    play: Play,
):
    """Roll a ball from the middle of ``places`` towards one of them, in the masked environments."""
    e = wp.tid()
    if not episodes.mask[e]:
        return
    random = random_of(episodes, e, STREAM_BALL, 0)
    agents = places.shape[0]
    passer = wp.randi(random, 0, agents)
    speed = wp.randf(random, serve.slow, serve.fast)
    angle = wp.randf(random, -serve.spread, serve.spread)
    middle = wp.vec3()
    for agent in range(agents):
        middle += places[agent] / float(agents)
    up = wp.vec3(0.0, 0.0, 1.0)
    way = wp.quat_rotate(wp.quat_from_axis_angle(up, angle), wp.normalize(places[passer] - middle))
    first.position[e, serve.prop] = middle + serve.radius * up
    first.velocity[e, serve.prop] = speed * way
    first.spin[e, serve.prop] = (speed / serve.radius) * wp.cross(up, way)
    first.density[e, serve.prop] = wp.exp(wp.randf(random, serve.light, serve.heavy))
    play.passer[e] = passer
    play.gap[e] = -1.0


@wp.kernel
def keep_near(
    place: wp.vec3,
    reach: float,
    command_root: wp.array(dtype=wp.vec3),
    # out
    reference_root: wp.array(dtype=wp.vec3),
):
    """Clamp the commanded root to within ``reach`` [m] of its place."""
    e = wp.tid()
    reference_root[e] = clamp_to_circle(command_root[e], place, reach)


@wp.func
def flat_distance(a: wp.vec3, b: wp.vec3):
    """Return the length of the horizontal part of ``a - b``."""
    return wp.length(wp.vec2(a[0] - b[0], a[1] - b[1]))


@wp.func
def goes_to(play: Play, e: int, agents: int):
    """Return the ball's receiver: the passer until it has touched the ball, then the next agent."""
    return (play.passer[e] + play.touched[e]) % agents


@wp.func
def way_come(play: Play, e: int, ball: wp.vec3):
    """Return the ball's distance from its place at the passer's last touch [m]; 0 before that."""
    return wp.where(play.touched[e] == 1, flat_distance(ball, play.left[e]), 0.0)


@wp.func
def update_touches(rule: PassRule, sensors: Sensors, e: int, play: Play):
    """Update contacts with the ball; a touch counts when it begins."""
    for agent in range(play.contact.shape[1]):
        impulse = sensors.pair_impulse[e, agent * sensors.boundary_impulse.shape[1] + rule.subject]
        touching = wp.where(wp.length(impulse) > TOUCH, 1, 0)
        if touching == 1 and play.contact[e, agent] == 0:
            play.touches[e, agent] += 1
        play.contact[e, agent] = touching


@wp.kernel
def judge(
    rule: PassRule,
    ball: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    pelvis: wp.array2d(dtype=wp.vec3),
    sensors: Sensors,
    action: wp.array3d(dtype=float),
    # in and out
    play: Play,
    # out
    outcome: Outcome,
):
    """Advance the game: reward progress and passes, and end it when no agent can reach the ball."""
    e = wp.tid()
    agents = pelvis.shape[1]
    update_touches(rule, sensors, e, play)
    gap = flat_distance(ball[e], pelvis[e, goes_to(play, e, agents)])
    progress = wp.where(play.gap[e] < 0.0, 0.0, play.gap[e] - gap)
    passer = play.passer[e]
    receiver = (passer + 1) % agents
    if play.contact[e, passer] == 1:
        play.touched[e] = 1
        play.left[e] = ball[e]
    arrived = flat_distance(ball[e], pelvis[e, receiver]) <= rule.reach or play.contact[e, receiver] == 1
    # feet that meet around a ball, and tap or hold it, do not pass it
    passed = play.touched[e] == 1 and arrived and way_come(play, e, ball[e]) >= rule.least_pass
    if passed:
        play.passes[e] += 1
        play.passer[e] = receiver
        play.touched[e] = play.contact[e, receiver]
        play.left[e] = ball[e]
    play.gap[e] = flat_distance(ball[e], pelvis[e, goes_to(play, e, agents)])
    nearest = float(1.0e6)
    for agent in range(agents):
        nearest = wp.min(nearest, flat_distance(ball[e], pelvis[e, agent]))
    slow = flat_distance(velocity[e], wp.vec3()) < rule.dead_speed
    over = (slow and nearest > rule.fetch) or flat_distance(ball[e], wp.vec3()) > rule.rim
    for agent in range(agents):
        outcome.terms[e, agent, PassBallTask.rewards.progress] = rule.progress_weight * progress
        outcome.terms[e, agent, PassBallTask.rewards.passed] = wp.where(passed, rule.pass_bonus, 0.0)
        effort = mean_square_action(action, e, agent)
        outcome.terms[e, agent, PassBallTask.rewards.control] = -rule.control_cost * effort
        outcome.metrics[e, agent, PassBallTask.metrics.passes] = float(play.passes[e])
        outcome.metrics[e, agent, PassBallTask.metrics.touches] = float(play.touches[e, agent])
        outcome.metrics[e, agent, PassBallTask.metrics.distance] = play.gap[e]
        outcome.metrics[e, agent, PassBallTask.metrics.ball_speed] = wp.length(velocity[e])
        outcome.success[e, agent] = play.passes[e] >= rule.goal_passes
        if over:
            outcome.terminated[e, agent] = True


@wp.kernel
def observe_game(
    rule: PassRule,
    bones: Bones,
    pelvis: wp.array2d(dtype=wp.vec3),
    ball: wp.array(dtype=wp.vec3),
    density: wp.array(dtype=float),
    place: wp.vec3,
    play: Play,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the state of the game from component ``start``; agents are counted on from the observing one."""
    e = wp.tid()
    agents = pelvis.shape[1]
    own = pelvis[e, agent]
    to = pelvis[e, goes_to(play, e, agents)]
    home = wp.vec3(place[0] - own[0], place[1] - own[1], 0.0)
    write_in_root(observation, e, agent, start, bones, to - own)
    write_in_root(observation, e, agent, start + 3, bones, to - ball[e])
    write_in_root(observation, e, agent, start + 6, bones, home)
    # a tenth and ten times the mass differ by as much, as the effects of a kick do
    observation[e, agent, start + 9] = wp.log10(density[e] * rule.ball_volume)
    observation[e, agent, start + 10] = float(play.touched[e])
    observation[e, agent, start + 11] = way_come(play, e, ball[e])
    for n in range(agents):
        turn = play.passer[e] == (agent + n) % agents
        observation[e, agent, start + 12 + n] = wp.where(turn, 1.0, 0.0)


JOINTS = tuple(f"{side}_{joint}" for joint in ("hip", "knee", "ankle") for side in ("left", "right"))
#: Distance beyond the avatars' circle to which the ball is in play, and to the walls [m].
RIM, ROOM = 0.5, 1.3


class PassBallConfig(EnvConfig):
    """Settings of PassBall."""

    episode_seconds: float = Field(8.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    num_agents: int = Field(3, ge=2, le=4, description="number of avatars")
    spacing: float = Field(1.6, ge=1.2, le=4.0, description="between neighbours on the circle [m]")
    joints: tuple[str, ...] | None = Field(JOINTS, description="joints that act, besides the root; null for all 21")
    root_speed: float = Field(1.5, gt=0.0, le=5.0, description="speed of the root at action 1 [m/s]")
    root_range: float = Field(0.4, ge=0.0, le=1.0, description="how far the root may be steered from its place [m]")
    root_lead_limit: float = Field(
        0.12, gt=0.0, le=0.4, description="greatest lead of the commanded root on the body before an action [m]"
    )
    root_turn_lead_limit: float = Field(
        0.5, gt=0.0, le=1.5, description="greatest lead in turning before an action [rad]"
    )
    ball_mass: MassRange = Field((0.4, 2.0), description="range of the ball's mass, uniform in its log [kg]")
    ball_radius: float = Field(0.11, ge=0.06, le=0.3, description="radius of the ball [m]")
    serve_speed: SpeedRange = Field((1.0, 1.6), description="range of the ball's speed at the start [m/s]")
    serve_angle: float = Field(0.15, ge=0.0, le=0.5, description="greatest angle off the way to the first passer [rad]")
    reach: float = Field(0.4, gt=0.1, le=1.0, description="distance from a pelvis at which the ball has arrived [m]")
    least_pass: float = Field(
        0.5, ge=0.0, le=2.0, description="least way of a pass from the passer's last touch of the ball [m]"
    )
    dead_speed: Margin = Field(0.1, description="horizontal speed below which a ball out of reach is dead [m/s]")
    goal_passes: int = Field(2, ge=1, le=1000, description="passes that count as a success [-]")
    progress_weight: Weight = Field(1.0, description="reward for a metre of the ball's way to its receiver [1/m]")
    pass_bonus: Weight = Field(2.0, description="reward of a completed pass [-]")
    control_cost: Weight = Field(0.01, description="weight of the mean squared action [-]")
    fall: FallConfig = Field(default_factory=FallConfig, description="limits of a fall under torques")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")
    place_noise: float = Field(0.05, ge=0.0, le=0.3, description="greatest displacement of each along x and y [m]")


class PassBallTask(Task):
    """Pass the ball to the next agent."""

    Config = PassBallConfig
    description = "avatars on a circle pass a soft ball to each other, in turn"
    rewards = (
        Term(
            "progress",
            "`progress_weight` times the metres that the ball has come nearer, horizontally, to its receiver: the "
            "passer until it has touched the ball, then the next agent",
        ),
        Term("passed", "`pass_bonus` in the step that completes a pass"),
        CONTROL,
    )
    metrics = (
        Metric("passes", "-", "completed passes so far"),
        Metric("touches", "-", "number of touches of the ball that the agent has begun so far"),
        Metric("distance", "m", "horizontal distance of the ball from its receiver's pelvis"),
        Metric("ball_speed", "m/s", "speed of the ball"),
    )
    state_arrays = (
        TaskArray("passer", int),
        TaskArray("touched", int, cleared=True),
        TaskArray("passes", int, cleared=True),
        TaskArray("left", wp.vec3, cleared=True),
        TaskArray("gap"),
        TaskArray("contact", int, ("num_agents",), cleared=True),
        TaskArray("touches", int, ("num_agents",), cleared=True),
    )
    observes_contact = True
    observes_others = True
    camera_direction = (3.9, 2.7, 1.75)
    camera_follows = False

    summary = """`num_agents` avatars stand on a circle, `spacing` apart and facing its middle. From there a soft ball
of a mass drawn from `ball_mass` rolls towards one of them, the first passer. It has to kick or push the ball to the
next agent, counterclockwise from above, whose turn it then is. A pass is complete when the ball, after the passer has
touched it, comes within `reach` of the next one's pelvis or touches that avatar, at least `least_pass` from its place
at the passer's last touch: the ball must roll, not be carried or held by feet that meet around it. Legs and root act; a
root goes no farther than `root_range` from its place. All agents get the same reward, except for the cost of their
actions."""
    success_doc = "`passes` is at least `goal_passes`"
    termination_doc = (
        "all agents at once: when the ball is slower than `dead_speed` and farther than `reach + root_range` from "
        "every agent, when it is 0.5 m outside the circle, and when an avatar falls;\n- "
        f"{UNDER_TORQUES_DOC}"
    )
    picture_seconds = 0.4
    picture_actions = "zero"

    config: PassBallConfig

    def __init__(self, config: PassBallConfig) -> None:
        check_ranges(config, "ball_mass", "serve_speed")
        super().__init__(config)
        self.joints = select_joints(config.joints)
        self.rim = max(float(np.hypot(*avatar.position)) for avatar in self.scene.avatars) + RIM

    def build_scene(self) -> SceneConfig:
        config = self.config
        scene = on_circle(config.scene, config.num_agents, config.spacing)
        # it rolls: its top goes twice as fast as its middle
        ball = ball_config(config, (0.0, 0.0, config.ball_radius), 2.0 * config.serve_speed[1])
        return replace(scene, props=[ball, *scene.props])

    def terms(self) -> tuple[ObservationTerm, ...]:
        agents = len(self.scene.avatars)
        return (
            ObservationTerm("receiver", 3, "m", "root", "pelvis of the ball's receiver, from the agent's own"),
            ObservationTerm("receiver_from_ball", 3, "m", "root", "the same from the ball"),
            ObservationTerm("place", 3, "m", "root", "the agent's place, from the pelvis, horizontally"),
            ObservationTerm("ball_mass", 1, "-", "-", "decimal logarithm of the ball's mass in kg"),
            ObservationTerm("touched", 1, "-", "-", "1 if the passer has touched the ball in this turn"),
            ObservationTerm("ball_travel", 1, "m", "-", "horizontal distance of the ball from that touch; 0 before"),
            ObservationTerm("passer", agents, "-", "-", "1 for the passer, counted on from the observing agent"),
            *FEET_TERMS,
        )

    def drawn(self) -> tuple[Parameter, ...]:
        return (Parameter("ball_mass", "kg", *self.config.ball_mass, "mass of the ball", log=True),)

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        return (Drawn(env.simulation.props.density[:, self.index], self.rule.ball_volume),)

    def action_spec(self) -> ActionSpec:
        config = self.config
        speed = speed_within(config.root_range, config.root_speed, config.physics.control_dt)
        return ActionSpec(self.joints, root=True, joint_speed=config.control.joint_speed_limit, root_speed=speed)

    def domain(self) -> Domain:
        side = self.rim - RIM + ROOM
        box = Domain()
        return Domain((-side, -side, box.lower[2]), (side, side, box.upper[2]))

    def allocate(self, env) -> None:
        config, props = self.config, env.simulation.props
        self.index = props.index(BALL)
        volume, (slow, fast) = float(props.volume[self.index]), config.serve_speed
        light, heavy = (float(np.log(mass / volume)) for mass in config.ball_mass)
        self.serve = fill(
            Serve(), prop=self.index, radius=config.ball_radius, spread=config.serve_angle, slow=slow, fast=fast,
            light=light, heavy=heavy,
        )  # fmt: skip
        subject, fetch = env.simulation.subjects.names.index(BALL), config.reach + config.root_range
        self.rule = fill(PassRule(), config, subject=subject, ball_volume=volume, fetch=fetch, rim=self.rim)
        self.play, self.referee = fill(Play(), self), Referee(env, config.fall)
        places = [(*avatar.position, 0.0) for avatar in self.scene.avatars]
        self.places = wp.array(places, dtype=wp.vec3, device=env.device)
        self.reference_root = [wp.zeros(env.num_envs, dtype=wp.vec3, device=env.device) for _ in places]

    def _ball(self, env, name: str) -> wp.array:
        """Return the ball's column of the tracked props' array ``name``."""
        return getattr(env.props, name)[:, self.index]

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)
        record_shift(env, graph, self.config.place_noise)
        inputs = [env.episodes, self.serve, self.places]
        graph.launch(serve_ball, env.num_envs, inputs, [env.first_props, self.play])

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        config = self.config
        references = record_root_clamp(env, graph, config.root_lead_limit, config.root_turn_lead_limit)
        # the action comes on top of the clamped root
        reach = config.root_range - self.action_spec().greatest_speed * config.physics.control_dt
        kept = []
        for (rotation, root), own, avatar in zip(references, self.reference_root, self.scene.avatars, strict=True):
            graph.launch(keep_near, env.num_envs, [wp.vec3(*avatar.position, 0.0), reach, root], [own])
            kept.append((rotation, own))
        return kept

    def record_outcome(self, env, graph) -> None:
        self.referee.record(env, graph)
        ball = [self._ball(env, "position"), self._ball(env, "velocity")]
        inputs = [self.rule, *ball, self.referee.pelvis, env.simulation.sensors, env.action]
        graph.launch(judge, env.num_envs, inputs, [self.play, env.outcome])
        self.referee.record_shared_end(env, graph)

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        self.referee.record(env, graph)
        bones, ball, density = env.bones[agent], self._ball(env, "position"), self._ball(env, "density")
        place = wp.vec3(*self.scene.avatars[agent].position, 0.0)
        inputs = [bones, self.referee.pelvis, ball, density, place, self.play, agent, start]
        graph.launch(observe_game, env.num_envs, [self.rule, *inputs], [env.observation])
        inputs = [bones, ball, agent, env.layout[FEET_TERMS[0].name].slice.start]
        graph.launch(observe_feet, env.num_envs, inputs, [env.observation])


TASK = PassBallTask
