"""PassBall: a ball goes round a circle of avatars, each of whom sends it on to the next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.api.pettingzoo import AECEnv, AvatarParallelEnv, parallel_to_aec
from piavatar_envs.envs.actions import ActionSpec, select_joints, speed_within
from piavatar_envs.envs.config import EnvConfig, SceneConfig, replace
from piavatar_envs.envs.domain import Domain
from piavatar_envs.envs.observations import ObservationTerm, Parameter
from piavatar_envs.envs.parameters import Drawn
from piavatar_envs.multi.passing import PassRule, Play, Serve, judge, keep_near, observe_game, serve_ball
from piavatar_envs.multi.together import record_fall_together, record_shift
from piavatar_envs.multi.versus import Referee, on_circle
from piavatar_envs.tasks.base import Task
from piavatar_envs.tasks.fall import UNDER_TORQUES_DOC, FallConfig
from piavatar_envs.tasks.goal import BALL, ball_config
from piavatar_envs.tasks.kick_ball import observe_feet
from piavatar_envs.tasks.leash import record_leash
from piavatar_envs.tasks.ranges import Margin, MassRange, SpeedRange, Weight, check_ranges
from piavatar_envs.tasks.spawn import record_standing

JOINTS = tuple(f"{side}_{joint}" for joint in ("hip", "knee", "ankle") for side in ("left", "right"))
#: How far beyond the avatars' circle the ball is still in play, and how far behind it the walls are [m].
RIM, ROOM = 0.5, 1.3


class PassBallConfig(EnvConfig):
    """Settings of PassBall."""

    episode_seconds: float = Field(8.0, gt=0.0, le=3600.0, description="simulated time until truncation [s]")
    num_agents: int = Field(3, ge=2, le=4, description="number of avatars")
    spacing: float = Field(1.6, ge=1.2, le=4.0, description="between neighbours on the circle [m]")
    joints: tuple[str, ...] | None = Field(JOINTS, description="joints that act, besides the root; null for all 21")
    root_speed: float = Field(1.5, gt=0.0, le=5.0, description="speed of the root at action 1 [m/s]")
    roam: float = Field(0.4, ge=0.0, le=1.0, description="how far the root may be steered from its place [m]")
    leash: float = Field(
        0.12, gt=0.0, le=0.4, description="greatest lead of the commanded root on the body before an action [m]"
    )
    leash_turn: float = Field(0.5, gt=0.0, le=1.5, description="greatest lead in turning before an action [rad]")
    ball_mass: MassRange = Field((0.4, 2.0), description="range of the ball's mass, uniform in its log [kg]")
    ball_radius: float = Field(0.11, ge=0.06, le=0.3, description="radius of the ball [m]")
    serve_speed: SpeedRange = Field((1.0, 1.6), description="range of the ball's speed at the start [m/s]")
    serve_angle: float = Field(0.15, ge=0.0, le=0.5, description="greatest angle off the way to the first passer [rad]")
    reach: float = Field(0.4, gt=0.1, le=1.0, description="distance from a pelvis at which the ball has arrived [m]")
    sent: float = Field(
        0.5, ge=0.0, le=2.0, description="how far a pass must go from where the passer touched the ball last [m]"
    )
    dead_speed: Margin = Field(0.1, description="horizontal speed below which a ball out of reach is dead [m/s]")
    goal_passes: int = Field(2, ge=1, le=1000, description="passes that count as a success [-]")
    progress_weight: Weight = Field(1.0, description="reward for a metre of the ball's way to its goal [1/m]")
    pass_bonus: Weight = Field(2.0, description="reward of a completed pass [-]")
    control_cost: Weight = Field(0.01, description="weight of the mean squared action [-]")
    fall: FallConfig = Field(default_factory=FallConfig, description="what counts as a fall under torques")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")
    place_noise: float = Field(0.05, ge=0.0, le=0.3, description="greatest displacement of each along x and y [m]")


class PassBallTask(Task):
    """Send the ball on to the next."""

    Config = PassBallConfig
    description = "avatars on a circle send a ball of unknown mass on to each other, in turn"
    reward_terms = ("progress", "pass", "control")
    metrics = ("passes", "touches", "distance", "ball_speed")
    observes_contact = True
    observes_others = True
    camera_position = (3.9, 2.7, 2.4)
    camera_target = (0.0, 0.0, 0.65)
    camera_follows = False

    summary = """`num_agents` avatars stand around a circle, `spacing` apart and facing its middle. From there a soft
ball of 0.4 to 2 kg (`ball_mass`) rolls towards one of them, the first passer, who shall kick or push it on to the next,
counterclockwise from above, whose turn it then is. A pass is complete when the ball, after the passer has touched it,
comes within `reach` of the next one's pelvis or touches them, and is at least `sent` from where the passer touched it
last: it must be sent, not carried, and not held by feet that meet around it. Legs and root act; a root goes no farther
than `roam` from its place. All are paid alike, but for the cost of their actions."""
    reward_docs: ClassVar[Mapping[str, str]] = {
        "progress": "`progress_weight` times the metres that the ball has come nearer, horizontally, to whoever shall "
        "have it: the passer until they have touched it, then the next",
        "pass": "`pass_bonus` in the step that completes a pass",
        "control": "`-control_cost` times the mean of the agent's own squared action components",
    }
    metric_docs: ClassVar[Mapping[str, str]] = {
        "passes": "completed passes so far [-]",
        "touches": "how often the agent has begun to touch the ball so far [-]",
        "distance": "horizontally from the ball to the pelvis of whoever shall have it [m]",
        "ball_speed": "speed of the ball [m/s]",
    }
    success_doc = "there have been `goal_passes` passes"
    termination_doc = (
        "all agents' ends when the ball is slower than `dead_speed` and farther than `reach + roam` from everybody, "
        "when it is 0.5 m outside the circle, and when one of them falls;\n- "
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
            ObservationTerm("receiver", 3, "m", "root", "pelvis of whoever shall have the ball, from one's own"),
            ObservationTerm("receiver_from_ball", 3, "m", "root", "the same from the ball"),
            ObservationTerm("place", 3, "m", "root", "one's place, from the pelvis, horizontally"),
            ObservationTerm("ball_mass", 1, "-", "-", "decimal logarithm of the ball's mass in kg"),
            ObservationTerm("touched", 1, "-", "-", "1 if the passer has touched the ball in this turn"),
            ObservationTerm("way", 1, "m", "-", "how far the ball has come from there, horizontally; 0 before"),
            ObservationTerm("turn", agents, "-", "-", "1 for the passer, counted on from oneself"),
            ObservationTerm("ball_from_left_foot", 3, "m", "root", "the ball from the left foot's ball"),
            ObservationTerm("ball_from_right_foot", 3, "m", "root", "the ball from the right foot's ball"),
        )

    def drawn(self) -> tuple[Parameter, ...]:
        return (Parameter("ball_mass", "kg", *self.config.ball_mass, "mass of the ball", log=True),)

    def drawn_values(self, env) -> tuple[Drawn, ...]:
        return (Drawn(env.simulation.props.density[:, self.index], self.rule.ball_volume),)

    def action_spec(self) -> ActionSpec:
        config = self.config
        speed = speed_within(config.roam, config.root_speed, config.physics.control_dt)
        return ActionSpec(self.joints, root=True, joint_speed=config.drive.joint_speed_limit, root_speed=speed)

    def domain(self) -> Domain:
        side = self.rim - RIM + ROOM
        box = Domain()
        return Domain((-side, -side, box.lower[2]), (side, side, box.upper[2]))

    def allocate(self, env) -> None:
        n, device, config, props = env.num_envs, env.device, self.config, env.simulation.props
        self.index = props.index(BALL)
        volume, serve, rule, play = float(props.volume[self.index]), Serve(), PassRule(), Play()
        serve.prop, serve.radius, serve.spread = self.index, config.ball_radius, config.serve_angle
        serve.slow, serve.fast = config.serve_speed
        serve.light, serve.heavy = (float(np.log(mass / volume)) for mass in config.ball_mass)
        rule.subject, rule.ball_volume = env.simulation.subjects.names.index(BALL), volume
        rule.reach, rule.fetch, rule.rim = config.reach, config.reach + config.roam, self.rim
        rule.sent, rule.dead_speed, rule.goal_passes = config.sent, config.dead_speed, config.goal_passes
        rule.progress_weight, rule.pass_bonus = config.progress_weight, config.pass_bonus
        rule.control_cost = config.control_cost
        for name in ("passer", "touched", "passes"):
            setattr(play, name, wp.zeros(n, dtype=int, device=device))
        play.left = wp.zeros(n, dtype=wp.vec3, device=device)
        play.gap = wp.zeros(n, dtype=float, device=device)
        play.contact, play.touches = (wp.zeros((n, env.num_agents), dtype=int, device=device) for _ in range(2))
        self.serve, self.rule, self.play, self.referee = serve, rule, play, Referee(env, self.config.fall)
        places = [(*avatar.position, 0.0) for avatar in self.scene.avatars]
        self.places = wp.array(places, dtype=wp.vec3, device=device)
        self.reference_root = [wp.zeros(n, dtype=wp.vec3, device=device) for _ in places]

    def arrays(self) -> dict[str, wp.array]:
        names = ("passer", "touched", "passes", "left", "gap", "contact", "touches")
        return {name: getattr(self.play, name) for name in names}

    def record_reset(self, env, program) -> None:
        record_standing(env, program, self.config.pose_noise)
        record_shift(env, program, self.config.place_noise)
        props = env.simulation.props
        program.launch(
            serve_ball,
            env.num_envs,
            [env.mask, env.seed, env.episode, self.serve, self.places],
            [props.spawn.position, props.spawn.velocity, props.spawn.spin, props.density, self.play],
        )

    def record_references(self, env, program) -> list[tuple[wp.array, wp.array]]:
        references = record_leash(env, program, self.config.leash, self.config.leash_turn)
        # the action comes on top of what is kept within reach
        reach = self.config.roam - self.action_spec().greatest_speed * self.config.physics.control_dt
        kept = []
        for (rotation, root), own, avatar in zip(references, self.reference_root, self.scene.avatars, strict=True):
            program.launch(keep_near, env.num_envs, [wp.vec3(*avatar.position, 0.0), reach, root], [own])
            kept.append((rotation, own))
        return kept

    def record_outcome(self, env, program) -> None:
        self.referee.record(env, program)
        state, sim = env.simulation.props.state, env.simulation
        program.launch(
            judge,
            env.num_envs,
            [
                self.rule, state.position[:, self.index], state.velocity[:, self.index], self.referee.pelvis,
                sim.sensors, env.action,
            ],
            [self.play, env.terms, env.metrics, env.success, env.terminated],
        )  # fmt: skip
        record_fall_together(env, program, self.referee.out)

    def record_observe(self, env, program, agent: int, start: int) -> None:
        self.referee.record(env, program)
        props, tracked = env.simulation.props, env.simulation.avatars[agent].tracked
        ball = props.state.position[:, self.index]
        place = wp.vec3(*self.scene.avatars[agent].position, 0.0)
        program.launch(
            observe_game,
            env.num_envs,
            [
                self.rule, agent, start, tracked.rotation, self.referee.pelvis, ball, props.density[:, self.index],
                place, self.play,
            ],
            [env.observation],
        )  # fmt: skip
        feet = env.layout["ball_from_left_foot"].slice.start
        program.launch(
            observe_feet, env.num_envs, [agent, feet, tracked.rotation, tracked.position, ball], [env.observation]
        )


TASK = PassBallTask


def parallel_env(**settings: Any) -> AvatarParallelEnv:
    """The world; for the settings see :class:`~piavatar_envs.api.pettingzoo.AvatarParallelEnv`."""
    return AvatarParallelEnv(TASK, **settings)


def env(**settings: Any) -> AECEnv:
    """The same world, one agent after the other."""
    return parallel_to_aec(parallel_env(**settings))
