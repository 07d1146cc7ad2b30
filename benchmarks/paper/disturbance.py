"""Struck bodies: what goes in comes out, the pose gives way, and then it recovers, or not, as tone and alpha have it.

An undisturbed body could follow its pose without any physics. These cases show that it is there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.paper.poses import random_directions, random_poses, random_shapes
from benchmarks.physics.rig import Rig, World
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_index
from piavatar_envs.config import PoseControlConfig
from piavatar_envs.mpm.diagnostics import Totals, totals

CONTROL_STEPS = 45  # one and a half seconds
LAST = 15  # control steps over which a settled value is averaged
RECOVERED_DEG = 2.0  # a pose whose worst joint is nearer than this has recovered
TONES = ALPHAS = (0.0, 0.3, 1.0)
STRIKES = {"spine3": 20.0, "left_elbow": 3.0}  # impulses [N s] on the chest and on a forearm
POSE_RANGE = 0.15  # of the joints' ranges: the struck body stands in a random, moderate pose

# A ball of mass m and speed v gives a body it meets J = (1 + e) m v / (1 + m / M). Restitution and effective mass of a
# chest were measured with real contact on a capsule body: e = 0.46, and 8 kg at 5 m/s gave 44 N s.
RESTITUTION, CHEST_MASS = 0.46, 25.0


@dataclass(frozen=True)
class Ball:
    """A ball thrown at the chest.

    Attributes:
        mass: [kg].
        speed: [m/s].
        measured: peak and settled error of the worst joint [deg] by tone, with a real ball on a capsule body.
    """

    mass: float
    speed: float
    measured: dict[float, tuple[float, float]]

    @property
    def impulse(self) -> float:
        """Return the impulse on the chest [N s]."""
        return (1.0 + RESTITUTION) * self.mass * self.speed / (1.0 + self.mass / CHEST_MASS)


BALLS = (
    Ball(0.45, 10.0, {0.0: (17.0, 15.0), 0.3: (3.9, 0.4), 1.0: (1.6, 0.15)}),
    Ball(1.5, 10.0, {0.0: (57.0, 51.0), 0.3: (11.8, 1.5), 1.0: (4.7, 0.5)}),
    Ball(8.0, 5.0, {0.0: (88.0, 65.0), 0.3: (23.6, 3.9), 1.0: (9.3, 0.9)}),
    Ball(8.0, 10.0, {0.0: (128.0, 59.0), 0.3: (41.0, 6.6), 1.0: (19.0, 1.6)}),
)


@dataclass
class Course:
    """Motion of a struck body: one entry per control step, shape ``(CONTROL_STEPS, num_envs)``."""

    joint_error: np.ndarray  # worst joint [rad]
    last_errors: np.ndarray  # of every joint at the end [rad], shape (num_envs, 21)
    shape_error: np.ndarray  # mean distance to the tracked pose [m]
    strain: np.ndarray
    impulse: np.ndarray  # what the strike was to bring [N s], shape (num_envs, 3)
    ledger: list[list[Totals]]  # of every body: before the strike, after it, then after each control step
    released: np.ndarray  # shape (num_envs,)
    alive: np.ndarray  # shape (num_envs,)


def plan(seeds: int, quick: bool, world: World) -> Iterator[Callable[[], Iterator[dict[str, Any]]]]:
    """Yield every case, as a function that yields its rows."""
    steps = 4 if quick else CONTROL_STEPS
    free = replace(world, num_substeps=None)
    standing = replace(free, gravity=9.81, ground=True)
    for tone in TONES:
        for alpha in ALPHAS:
            control = PoseControlConfig(tone=tone, alpha=alpha, root="free", free_motion=False)
            yield lambda control=control: struck_free(free, control, seeds, steps)
    for tone in TONES:
        yield lambda tone=tone: hit_by_balls(standing, PoseControlConfig(tone=tone), seeds, steps)


def struck_free(world: World, control: PoseControlConfig, seeds: int, steps: int) -> Iterator[dict[str, Any]]:
    """Yield rows of a body adrift without gravity, struck on the chest or on a forearm."""
    rng = np.random.default_rng(3)
    bones = np.repeat([joint_index(name) for name in STRIKES], seeds)
    size = np.repeat(list(STRIKES.values()), seeds)
    directions = np.tile(random_directions(rng, seeds), (len(STRIKES), 1))
    shapes = np.tile(random_shapes(world.asset, rng, seeds), (len(STRIKES), 1))
    poses = np.tile(random_poses(rng, seeds, POSE_RANGE)[0], (len(STRIKES), 1, 1))
    rig = Rig(world, control, shapes)
    course = follow(rig, poses, bones, size[:, None] * directions, steps)
    for index, (name, impulse) in enumerate(STRIKES.items()):
        mine = slice(index * seeds, (index + 1) * seeds)
        row = _row(f"struck {name}, {impulse:g} N s, adrift", world, control, course, mine, seeds)
        yield row | {"bone": name, "impulse_n_s": impulse} | _conservation(course, mine)


def hit_by_balls(world: World, control: PoseControlConfig, seeds: int, steps: int) -> Iterator[dict[str, Any]]:
    """Yield rows of a standing body, its root held by the wrench, under the impulses of balls on its chest."""
    rng = np.random.default_rng(4)
    shapes = np.tile(random_shapes(world.asset, rng, seeds), (len(BALLS), 1))
    size = np.repeat([ball.impulse for ball in BALLS], seeds)
    rig = Rig(world, control, shapes)
    bones = np.full(len(shapes), joint_index("spine3"))
    poses = np.zeros((len(shapes), 22, 3))
    course = follow(rig, poses, bones, size[:, None] * np.array([0.0, 1.0, 0.0]), steps)
    for index, ball in enumerate(BALLS):
        mine = slice(index * seeds, (index + 1) * seeds)
        row = _row(f"ball {ball.mass:g} kg at {ball.speed:g} m/s, standing", world, control, course, mine, seeds)
        peak, settled = ball.measured[control.tone]
        yield row | {
            "bone": "spine3",
            "ball_kg": ball.mass,
            "ball_m_s": ball.speed,
            "impulse_n_s": ball.impulse,
            "root_released": int(course.released[mine].sum()),
            "measured_with_real_ball": {"peak_joint_error_deg": peak, "settled_joint_error_deg": settled},
        }


def follow(rig: Rig, poses: np.ndarray, bones: np.ndarray, impulses: np.ndarray, steps: int) -> Course:
    """Strike every body once, then hold the pose and record."""
    rig.reset(poses)
    rig.step(poses)
    ledger = [_totals(rig)]
    rig.strike(bones, impulses)
    ledger.append(_totals(rig))
    seen: dict[str, list[np.ndarray]] = {"joint_error": [], "shape_error": [], "strain": []}
    for _ in range(steps):
        rig.step()
        ledger.append(_totals(rig))
        seen["joint_error"].append(rig.pose_errors()["relative_rotation"].max(1))
        seen["shape_error"].append(rig.shape_errors().mean(1))
        seen["strain"].append(rig.strain())
    return Course(
        **{name: np.array(values) for name, values in seen.items()},
        last_errors=rig.pose_errors()["relative_rotation"],
        impulse=impulses,
        ledger=ledger,
        released=rig.avatar.state.released.numpy(),
        alive=rig.alive,
    )


def _row(
    case: str, world: World, control: PoseControlConfig, course: Course, mine: slice, seeds: int
) -> dict[str, Any]:
    """Return mean and standard deviation over seeds of all figures of struck bodies."""
    alive = np.arange(len(course.alive))[mine][course.alive[mine]]
    error, shape = np.degrees(course.joint_error[:, alive]), 1e3 * course.shape_error[:, alive]
    strain = course.strain[:, alive]
    recovery = [_recovery_time(error[:, seed]) for seed in range(error.shape[1])]
    known = [value for value in recovery if value is not None]
    values = {
        "peak_joint_error_deg": error.max(0),
        "settled_joint_error_deg": error[-LAST:].mean(0),
        "peak_shape_error_mm": shape.max(0),
        "settled_shape_error_mm": shape[-LAST:].mean(0),
        "peak_strain": strain.max(0),
        "settled_strain": strain[-LAST:].mean(0),
    }
    row: dict[str, Any] = {
        "case": f"{case}, tone {control.tone:g}, alpha {control.alpha:g}",
        "table": None,
        "study": "recovery",
        "decoupling": world.decoupling,
        "fidelity": world.fidelity,
        "disturbed": True,
        "tone": control.tone,
        "alpha": control.alpha,
        "seeds": seeds,
        "failed_bodies": seeds - len(alive),
        "recovered": f"{len(known)}/{len(recovery)}",
        "recovery_s": float(np.mean(known)) if recovery and len(known) == len(recovery) else None,
    }
    for name, sample in values.items():
        row[name] = float(sample.mean()) if len(sample) else None
        row[f"{name}_std"] = float(sample.std(ddof=1)) if len(sample) > 1 else None
    if len(alive):
        row["worst_joint_at_the_end"] = JOINT_NAMES[1 + int(course.last_errors[alive].mean(0).argmax())]
    return row | {"joint_error_deg": np.round(error.mean(1), 3).tolist()}


def _conservation(course: Course, mine: slice) -> dict[str, float]:
    """Return the worst errors of momentum and energy of free bodies, relative to what the strike brought."""
    linear, angular, rises = [0.0], [0.0], [0.0]
    for env in np.arange(len(course.alive))[mine][course.alive[mine]]:
        before, struck, *later = (totals_of[env] for totals_of in course.ledger)
        impulse = course.impulse[env]
        linear.append(np.linalg.norm(later[-1].momentum - before.momentum - impulse) / np.linalg.norm(impulse))
        turn = struck.angular_momentum - before.angular_momentum
        angular.append(np.linalg.norm(later[-1].angular_momentum - struck.angular_momentum) / np.linalg.norm(turn))
        energy = np.array([entry.kinetic + entry.elastic for entry in (struck, *later)])
        rises.append(np.diff(energy).max() / energy[0])
    return {
        "momentum_error": float(max(linear)),
        "angular_momentum_error": float(max(angular)),
        "largest_energy_rise": float(max(rises)),
    }


def _recovery_time(error: np.ndarray) -> float | None:
    """Return the time from the strike until the worst joint stays within :data:`RECOVERED_DEG` [s], or None."""
    outside = np.flatnonzero(error >= RECOVERED_DEG)
    if len(outside) == 0:
        return 0.0
    return None if outside[-1] == len(error) - 1 else float((outside[-1] + 1) / 30.0)


def _totals(rig: Rig) -> list[Totals]:
    """Return the totals of every body; of none in a world that adds momentum of its own."""
    if rig.world.gravity or rig.world.ground:
        return []
    return [totals(rig.model, rig.state, env) for env in range(rig.num_envs)]
