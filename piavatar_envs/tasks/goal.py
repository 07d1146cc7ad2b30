"""Sending a ball through a gate: settings, documentation and launches that such tasks share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import warp as wp

from piavatar_envs.envs.config import PropConfig, SceneConfig
from piavatar_envs.envs.domain import Domain
from piavatar_envs.envs.observations import Parameter
from piavatar_envs.envs.parameters import Drawn, component
from piavatar_envs.tasks.gate import Ball, Course, Gate, draw_gate, judge_ball, measure_ball, observe_gate

if TYPE_CHECKING:
    from piavatar_envs.envs.batch_env import BatchEnv
    from piavatar_envs.mpm.program import Program
    from piavatar_envs.render import Ring

BALL = "ball"
#: Of the ball on the ground; a rough soft ball loses much of its speed to rolling.
BALL_FRICTION = 0.2
#: Room behind a gate and above a ball; aside of and above the ground below a body whose root and arms do not act [m].
BEHIND, ASIDE, ABOVE = 0.3, 1.25, 2.3

REWARD_DOCS: Mapping[str, str] = {
    "approach": "0.1 times what the approach has gained on the best of the episode: 1 in touch with the ball, falling "
    "as a Gaussian to 0.1 at 0.4 m",
    "aim": "0.4 times what the ball's promise has gained on the best of the episode: 1 if it will pass the gate's "
    "centre within half of `target_radius` in the next second, falling to 0 at the distance it started from; drag and "
    "bounces are not foreseen",
    "goal": "0.5 in the step in which the ball passes the gate",
    "control": "`-control_cost` times the mean of the squared action components",
}
METRIC_DOCS: Mapping[str, str] = {
    "ball_speed": "speed of the ball [m/s]",
    "distance_to_target": "from the ball to the centre of the gate [m]",
    "ball_mass": "mass of the ball [kg]",
    "contact_impulse": "size of the impulse between ball and body in this step [N s]",
}
SUCCESS_DOC = "the ball's centre has passed the gate within `target_radius` of its centre, away from where it started"
TERMINATION_DOC = "the ball has passed the gate"


class BallConfig(Protocol):
    """Settings of a ball."""

    ball_radius: float
    ball_mass: tuple[float, float]


class GateConfig(BallConfig, Protocol):
    """Settings that tasks with a gate have in common."""

    joints: tuple[str, ...] | None
    ball_place: tuple[float, float]
    ball_jitter: float
    target_distance: tuple[float, float]
    target_angle: float
    target_height: float
    target_radius: float
    control_cost: float


def ball_config(config: BallConfig, position: Sequence[float], top_speed: float = 0.0) -> PropConfig:
    """The ball in the scene, of middling mass; episodes weigh it anew, and make any part of it so fast [m/s]."""
    mass = math.sqrt(math.prod(config.ball_mass))
    return PropConfig(
        name=BALL,
        size=(config.ball_radius,),
        mass=mass,
        position=tuple(position),
        top_speed=top_speed,
        friction=BALL_FRICTION,
    )


def gate_domain(config: GateConfig, scene: SceneConfig, top: float) -> Domain:
    """Room for balls to start at the height ``top`` [m] and to pass any gate, no larger than it must be.

    Memory goes with the volume. Arms that do not act and a root that stays need less than a body that moves freely.
    """
    x, y = config.ball_place
    way = config.target_distance[1] + config.ball_jitter + BEHIND
    aside = abs(x) + config.ball_jitter + config.target_distance[1] * math.sin(config.target_angle) + BEHIND
    body = Domain().around([avatar.position for avatar in scene.avatars])
    if config.joints is not None:
        at = scene.avatars[0].position
        body = Domain((at[0] - ASIDE, at[1] - ASIDE, body.lower[2]), (at[0] + ASIDE, at[1] + ASIDE, ABOVE))
    return body.including((-aside, y - way, 0.0), (aside, 0.0, top + BEHIND))


def ball_places(config: GateConfig, *heights: float, drift: float = 0.0) -> Mapping[str, Sequence[Sequence[float]]]:
    """Corners of where the ball may begin, for :meth:`Task.prop_places`.

    Args:
        config: the task's settings.
        heights: the least and the greatest, or all there is [m].
        drift: how much farther aside than its jitter it may begin [m].
    """
    (x, y), aside = config.ball_place, config.ball_jitter + drift
    return {BALL: [(x + i * aside, y + j * aside, z) for i in (-1, 1) for j in (-1, 1) for z in heights]}


def drawn_goal(config: GateConfig) -> tuple[Parameter, ...]:
    """What episodes draw of ball and gate."""
    side = math.sin(config.target_angle)
    return (
        Parameter("ball_mass", "kg", *config.ball_mass, "mass of the ball", log=True),
        Parameter("target_distance", "m", *config.target_distance, "of the gate from where the ball started"),
        Parameter("target_side", "-", -side, side, "x of the way to the gate, a unit vector: the sine of its angle"),
    )


class Goal:
    """Ball and gate of every environment, and what tasks record about them.

    Attributes:
        index: of the ball among the props.
        gate: constants.
        course: the gates and what the balls have done.
        ball: constants of how it is drawn, by the task.
        gap: from the striking bone to the ball's surface [m], written by the task.
    """

    def __init__(self, env: BatchEnv, config: GateConfig, height: float) -> None:
        """Allocate.

        Args:
            env: the batch.
            config: its task's settings.
            height: of the middle of the ball's places [m].
        """
        n, device, simulation = env.num_envs, env.device, env.simulation
        self.env = env
        self.index = simulation.props.index(BALL)
        gate, course, ball = Gate(), Course(), Ball()
        gate.radius, gate.height, gate.spread = config.target_radius, config.target_height, config.target_angle
        gate.near, gate.far = config.target_distance
        gate.ball_radius, gate.control_cost = config.ball_radius, config.control_cost
        gate.gravity = env.config.physics.gravity
        gate.ball_volume = float(simulation.props.points[self.index].volume.sum())
        for name, dtype in (("center", wp.vec3), ("forward", wp.vec3), ("length", float), ("last", wp.vec3)):
            setattr(course, name, wp.zeros(n, dtype=dtype, device=device))
        course.best = wp.zeros(n, dtype=wp.vec2, device=device)
        ball.prop, ball.jitter, ball.place = self.index, config.ball_jitter, wp.vec3(*config.ball_place, height)
        ball.light, ball.heavy = (math.log(mass / gate.ball_volume) for mass in config.ball_mass)
        self.gate, self.course, self.ball = gate, course, ball
        self.gap = wp.zeros(n, dtype=float, device=device)

    def column(self, name: str) -> wp.array:
        """The ball's column of the tracked props' array ``name``."""
        return getattr(self.env.simulation.props.state, name)[:, self.index]

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of a checkpoint."""
        return {name: getattr(self.course, name) for name in ("center", "forward", "length", "last", "best")}

    def drawn_values(self) -> tuple[Drawn, ...]:
        """Where the parameters of :func:`drawn_goal` are."""
        density = self.env.simulation.props.density[:, self.index]
        side = component(self.course.forward, 0)
        return Drawn(density, self.gate.ball_volume), Drawn(self.course.length), Drawn(side)

    def record_reset(self, program: Program) -> None:
        """Append: gates before the balls that ``props.spawn`` has in the masked environments."""
        env = self.env
        start = env.simulation.props.spawn.position[:, self.index]
        program.launch(draw_gate, env.num_envs, [env.mask, env.seed, env.episode, self.gate, start], [self.course])

    def record_outcome(self, program: Program) -> None:
        """Append: reward, metrics, success and termination."""
        env, simulation = self.env, self.env.simulation
        position, velocity = self.column("position"), self.column("velocity")
        program.launch(
            judge_ball,
            env.num_envs,
            [self.gate, position, velocity, self.gap, env.action],
            [self.course, env.terms, env.success, env.terminated],
        )
        pair = simulation.subjects.names.index(BALL)  # of the first subject, the avatar, with the ball
        density = simulation.props.density[:, self.index]
        program.launch(
            measure_ball,
            env.num_envs,
            [self.gate, self.course, position, velocity, density, simulation.sensors, pair],
            [env.metrics],
        )

    def record_observe(self, program: Program, agent: int, start: int) -> None:
        """Append: the terms :data:`GATE_TERMS`."""
        env, simulation = self.env, self.env.simulation
        tracked = simulation.avatars[agent].tracked
        density = simulation.props.density[:, self.index]
        program.launch(
            observe_gate,
            env.num_envs,
            [
                self.gate, self.course, agent, start, tracked.rotation, tracked.position, self.column("position"),
                density,
            ],
            [env.observation],
        )  # fmt: skip

    def markers(self, index: int) -> list[Ring]:
        """The gate of environment ``index`` as a ring, the part of it that is above the ground."""
        from piavatar_envs.render import Ring

        center, forward = (getattr(self.course, name).numpy()[index].copy() for name in ("center", "forward"))
        return [Ring(center, forward, self.gate.radius)]
