"""Twirl: turn such that the hem of a skirt rises to a height."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import warp as wp
from pydantic import Field

from piavatar_envs.cloth.garment import Garment
from piavatar_envs.cloth.remesh import boundary_loops
from piavatar_envs.config import ConfigError, EnvConfig, GarmentConfig
from piavatar_envs.core.rng import STREAM_TASK
from piavatar_envs.core.structs import fill
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.episodes import Bones, Episodes, Outcome, random_of
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.task import Metric, Task, Term
from piavatar_envs.tasks.common.ranges import DistanceRange, Margin, Weight, check_ranges
from piavatar_envs.tasks.common.rewards import CONTROL, mean_square_action, tolerance
from piavatar_envs.tasks.common.root_command import record_root_clamp
from piavatar_envs.tasks.common.spawn import record_standing

wp.set_module_options({"enable_backward": False})

#: Greatest distance of the commanded root from the tracked one [m], and greatest turn between them [rad].
ROOT_LEAD, ROOT_TURN_LEAD = 0.2, 0.6


#: Joints that act by default; the root turns the body.
UPPER_BODY = ("spine1", "spine2", "spine3", "left_shoulder", "right_shoulder")


class TwirlConfig(EnvConfig):
    """Settings of Twirl."""

    garments: tuple[GarmentConfig, ...] = Field(
        (GarmentConfig(kind="skirt", length=0.5, flare=0.75),),
        description="garments of every avatar; the hem is that of the first",
    )
    joints: tuple[str, ...] | None = Field(UPPER_BODY, description="joints that act; null for all 21")
    lift: DistanceRange = Field((0.05, 0.16), description="range of the height to which the hem shall rise [m]")
    period: float = Field(2.5, ge=0.1, le=3600.0, description="time after which another height is drawn [s]")
    lift_radius: float = Field(0.02, gt=0.0, le=1.0, description="distance from that height that counts as there [m]")
    margin: Margin = Field(0.1, description="distance beyond it at which the reward has fallen to 0.1 [m]")
    turn_speed: float = Field(8.0, gt=0.0, le=20.0, description="speed by which the root turns at action 1 [rad/s]")
    control_cost: Weight = Field(0.05, description="weight of the mean squared action [-]")
    pose_noise: float = Field(0.05, ge=0.0, le=0.5, description="greatest joint angle of the first pose [rad]")


_REMEDY = 'use garments=[{"kind": "skirt"}]'


@wp.struct
class Wanted:
    """Heights that are wanted, and their reward, as in the settings."""

    lift: wp.vec2  # range [m]
    steps: int  # control steps of a height
    lift_radius: float
    margin: float
    control_cost: float


@wp.struct
class Hem:
    """Lower border of a garment."""

    vertex: wp.array(dtype=int)  # indices in the cloth
    hangs: float  # its mean height over the pelvis in the drape [m]
    x: wp.array2d(dtype=wp.vec3)  # (num_envs, V) positions of the cloth [m]
    v: wp.array2d(dtype=wp.vec3)  # [m/s]


@wp.func
def wanted_at(wanted: Wanted, episodes: Episodes, e: int, step: int):
    """Return the height that is wanted at a step of the episode [m]."""
    random = random_of(episodes, e, STREAM_TASK, step / wanted.steps)
    return wp.randf(random, wanted.lift[0], wanted.lift[1])


@wp.func
def motion_of_hem(hem: Hem, bones: Bones, e: int):
    """Return lift [m], its rate [m/s] and angular speed of the hem about the vertical through the pelvis [rad/s]."""
    center = bones.position[e, 0]
    moves = bones.velocity[e, 0]
    lift = float(0.0)
    rate = float(0.0)
    moment = float(0.0)
    inertia = float(0.0)
    for k in range(hem.vertex.shape[0]):
        r = hem.x[e, hem.vertex[k]] - center
        v = hem.v[e, hem.vertex[k]] - moves
        lift += r[2]
        rate += v[2]
        moment += r[0] * v[1] - r[1] * v[0]
        inertia += r[0] * r[0] + r[1] * r[1]
    count = float(hem.vertex.shape[0])
    return wp.vec3(lift / count - hem.hangs, rate / count, moment / wp.max(inertia, 1.0e-6))


@wp.kernel
def judge(
    wanted: Wanted,
    hem: Hem,
    bones: Bones,
    episodes: Episodes,
    action: wp.array3d(dtype=float),
    # out
    outcome: Outcome,
):
    """Reward a hem at the height that is wanted."""
    e = wp.tid()
    motion = motion_of_hem(hem, bones, e)
    off = wp.abs(motion[0] - wanted_at(wanted, episodes, e, episodes.step_count[e]))
    outcome.terms[e, 0, TwirlTask.rewards.height] = tolerance(off, wanted.lift_radius, wanted.margin)
    outcome.terms[e, 0, TwirlTask.rewards.control] = -wanted.control_cost * mean_square_action(action, e, 0)
    outcome.metrics[e, 0, TwirlTask.metrics.off] = off
    outcome.metrics[e, 0, TwirlTask.metrics.lift] = motion[0]
    outcome.metrics[e, 0, TwirlTask.metrics.hem_spin] = motion[2]
    outcome.success[e, 0] = off <= wanted.lift_radius


@wp.kernel
def observe(
    wanted: Wanted,
    hem: Hem,
    bones: Bones,
    episodes: Episodes,
    agent: int,
    start: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write ``TwirlTask.observation_terms`` from component ``start``."""
    e = wp.tid()
    motion = motion_of_hem(hem, bones, e)
    observation[e, agent, start] = wanted_at(wanted, episodes, e, episodes.step_count[e])
    for k in range(3):
        observation[e, agent, start + 1 + k] = motion[k]


def hem_of(garment: Garment) -> np.ndarray:
    """Return the vertices of the border that hangs lowest, shape ``(H,)``.

    Raises:
        ValueError: the garment has no border that is free.
    """
    loops = [loop for loop in boundary_loops(garment.mesh.faces) if not np.isin(loop, garment.held.vertices).any()]
    if not loops:
        raise ValueError(f"the garment {garment.kind!r} has no free border")
    return min(loops, key=lambda loop: garment.draped[loop, 2].mean())


class TwirlTask(Task):
    """Turn, faster or slower, such that the hem rises as high as wanted and stays there."""

    Config = TwirlConfig
    description = "turn so that the hem of a skirt rises to a changing height"
    observation_terms = (
        ObservationTerm("wanted_lift", 1, "m", "world", "height over its place at rest to which the hem should rise"),
        ObservationTerm("lift", 1, "m", "world", "height of the hem over its place at rest, on average"),
        ObservationTerm("lift_rate", 1, "m/s", "world", "rate of that"),
        ObservationTerm("hem_spin", 1, "rad/s", "world", "angular speed of the hem about the vertical"),
    )
    rewards = (
        Term("height", "1 while `off` is at most `lift_radius`; beyond it a Gaussian, 0.1 at another `margin`"),
        CONTROL,
    )
    metrics = (
        Metric("off", "m", "difference of the hem's lift from the wanted one"),
        Metric("lift", "m", "height of the hem over its place at rest, on average"),
        Metric("hem_spin", "rad/s", "angular speed of the hem about the vertical"),
    )
    summary = """The avatar wears a skirt of three quarters of a circle, and turns about the vertical as the action
`root.yaw` says. Cloth that turns is thrown outwards: its hem rises with the speed, later than the hips, and swings.
Every `period` another height in the range `lift` is wanted. A good agent finds the speed that holds the hem
there, and brakes before a lower height. Lift counts from where the garment hangs on the body at rest."""
    success_doc = "`off` is at most `lift_radius`"
    picture_seconds = 1.5
    picture_actions: ClassVar[Mapping[str, float]] = {"root.yaw": 0.8, "left_shoulder.y": -0.2, "right_shoulder.y": 0.2}

    config: TwirlConfig

    def __init__(self, config) -> None:
        super().__init__(config)
        check_ranges(config, "lift")

    def action_spec(self) -> ActionSpec:
        speed = self.config.control.joint_speed_limit
        return ActionSpec(self.joints, root=True, joint_speed=speed, root_turn_speed=self.config.turn_speed)

    def allocate(self, env) -> None:
        simulation, config = env.simulation, self.config
        if simulation.garments is None:
            raise ConfigError(f"garments=() has no hem to lift; {_REMEDY}")
        garment, cloth = simulation.garments.garments[0], simulation.garments.cloth
        try:
            hem = hem_of(garment)
        except ValueError as error:
            raise ConfigError(f"{error}; {_REMEDY}") from None
        pelvis = simulation.flesh[0].points.joints[0, 0, 2]
        self.hem = fill(
            Hem(),
            vertex=wp.array(hem.astype(np.int32), dtype=int, device=env.device),
            hangs=float(garment.draped[hem, 2].mean() - pelvis),
            x=cloth.state.x,
            v=cloth.state.v,
        )
        steps = max(1, round(config.period / config.physics.control_dt))
        wanted = fill(Wanted(), config, lift=wp.vec2(*config.lift), steps=steps)
        self.inputs = [wanted, self.hem, env.bones[0], env.episodes]

    def record_reset(self, env, graph) -> None:
        record_standing(env, graph, self.config.pose_noise)

    def record_references(self, env, graph) -> list[tuple[wp.array, wp.array]]:
        return record_root_clamp(env, graph, ROOT_LEAD, ROOT_TURN_LEAD)

    def record_outcome(self, env, graph) -> None:
        graph.launch(judge, env.num_envs, [*self.inputs, env.action], [env.outcome])

    def record_observe(self, env, graph, agent: int, start: int) -> None:
        graph.launch(observe, env.num_envs, [*self.inputs, agent, start], [env.observation])


TASK = TwirlTask
