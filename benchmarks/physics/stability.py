"""The longest time step and the largest gains at which bodies under springs stay stable.

Stable means that for a second nothing fails, and two things of the energy. Springs that are asked for a pose hold
``sum(K e^2) / 2``, a weight that sinks gives what it has: motion and strain together never have more than that. And
nothing hums: the body comes to rest, but for 1 J (0.17 m/s of 70 kg). The interval between a value that is stable and
one that is not is halved, so "largest" means below the failure that was found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.paper.poses import JOINT_RANGE, random_pose
from benchmarks.paper.stage import Act, Stage, standing
from benchmarks.physics.blows import SPACE
from benchmarks.physics.limbs import Options
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.config import SceneConfig
from piavatar_envs.mpm import model as build
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.mpm.types import failure_name
from piavatar_envs.sim import time_step

SECONDS, CALM = 1.0, 1.0  # how long a body is watched [s], and what it may have left [J]
GRAVITY = 9.81
LONG = 0.1  # control steps of a time step that is sought [s]: more substeps to choose from
COURANT = (0.4, 1.6)  # between which c dt / dx the largest stable one lies
SOFT = 1.0e4  # Young's modulus of flesh whose waves are slow [Pa]
MOST = 1.0e6  # greatest factor on gains that is tried
BOUNDLESS = 1.0e6  # factor on the torques of muscles that are not to be the limit
NUDGE = 0.025  # share of the joints' ranges that muscles without limit are asked for: speeds stay those of limbs
KINDS = {"kp": (True, False), "kd": (False, True), "kp_kd": (True, True)}  # which gains a factor is on


@dataclass(frozen=True)
class Trial:
    """A body under springs.

    Attributes:
        grounded: it stands under its weight on a floor, its pelvis assisted; else it floats and is asked for poses.
        stiffness, damping: factors on the gains.
        strength: factor on the greatest torques.
        reach: share of the joints' ranges in which poses lie.
        young: Young's modulus [Pa].
        substeps: a control step; None for the environments' own.
        control_dt: time between two looks at the energy [s].
    """

    grounded: bool = False
    stiffness: float = 1.0
    damping: float = 1.0
    strength: float = 1.0
    reach: float = JOINT_RANGE
    young: float = 1.0e5
    substeps: int | None = None
    control_dt: float = 1.0 / 30.0

    def stage(self, options: Options, pose: np.ndarray) -> Stage:
        """Build the body at rest in the rest pose; its springs pull to ``pose`` (22, 3) [rad]."""
        rest = standing(0.0)
        physics = {"control_dt": self.control_dt, "young_modulus": self.young, "num_substeps": self.substeps}
        control = {"joint_stiffness": self.stiffness, "joint_damping": self.damping, "strength": self.strength}
        act = Act(
            "trial",
            SECONDS,
            scene=SceneConfig(ground=self.grounded, walls=False),
            script=lambda time: (pose if time > 0.0 else rest[0], rest[1]),
            physics={**physics, "gravity": GRAVITY * self.grounded},
            control={**control, "mode": "pd", "root_assist": float(self.grounded)},
            domain=SPACE,
        )
        return Stage(act, options.fidelity, options.device)

    def fault(self, options: Options, seed: int) -> str | None:
        """Return the reason for instability: a failure by name, ``"energy"`` or ``"hum"``; None if stable."""
        pose = random_pose(np.random.default_rng(seed), self.reach)[0] * (np.arange(NUM_JOINTS) > 0)[:, None]
        stage = self.stage(options, pose * (not self.grounded))
        simulation, controller = stage.simulation, stage.simulation.controllers[0]
        state, mass = simulation.state, simulation.model.particles.mass.numpy()[0].astype(float)

        def potential() -> float:
            return GRAVITY * float(mass @ state.x.numpy()[0, :, 2]) if self.grounded else 0.0

        start, kinetic = potential(), np.inf
        for _ in range(round(SECONDS / stage.dt)):
            stage.step()
            if failure := int(state.failure.numpy()[0]):
                return failure_name(failure)
            error = np.linalg.norm(pose, axis=1)[1:] * (not self.grounded)
            held = 0.5 * float(controller.joints.springs.stiffness.numpy()[0, 2:] @ error**2)
            now = totals(simulation.model, state)
            kinetic = now.kinetic
            if kinetic + now.elastic > held + start - potential() + CALM:
                return "energy"
        return None if kinetic < CALM else "hum"


@dataclass(frozen=True)
class Edge:
    """Boundary between stable and unstable values.

    Attributes:
        stable: the largest value found stable.
        unstable: the least found not to be; None if none was.
        fault: of that.
    """

    stable: float
    unstable: float | None = None
    fault: str | None = None


def halve(fault: Callable[[float], str | None], low: float, high: float, halvings: int) -> Edge:
    """Find the boundary between ``low`` and ``high`` by bisection on a logarithmic scale.

    Raises:
        RuntimeError: ``low`` is not stable.
    """
    why = fault(high)
    if why is None:
        return Edge(high)
    if (found := fault(low)) is not None:
        raise RuntimeError(f"{low:g} is not stable ({found}): look for the edge below it")
    for _ in range(halvings):
        middle = float(np.sqrt(low * high))
        if (found := fault(middle)) is None:
            low = middle
        else:
            high, why = middle, found
    return Edge(low, high, why)


def first_fault(trials: Iterable[Trial], options: Options) -> str | None:
    """Return the first fault of trials, each with as many poses as the options have; None without any."""
    pairs = [(trial, seed) for trial in trials for seed in range(1 if trial.grounded else options.poses)]
    return next(filter(None, (trial.fault(options, seed) for trial, seed in pairs)), None)


@contextmanager
def unrefused() -> Iterator[None]:
    """Disable :func:`~piavatar_envs.mpm.model.check_num_substeps`, so that unstable time steps can be built."""
    with mock.patch.object(build, "CFL_STABLE", np.inf), mock.patch.object(time_step, "LONGEST_SUBSTEP", np.inf):
        yield


def longest_step(options: Options, name: str, grounded: bool, young: float) -> dict[str, Any]:
    """Find the longest stable substep under the environments' own gains."""
    first = Trial(grounded, young=young).stage(options, np.zeros((NUM_JOINTS, 3))).simulation
    speed, dx = first.model.sound_speed, first.dx

    def substeps(courant: float) -> int:
        return max(1, round(LONG * speed / (courant * dx)))

    def fault(courant: float) -> str | None:
        trial = Trial(grounded, young=young, substeps=substeps(courant), control_dt=LONG)
        return first_fault([trial], options)

    with unrefused():
        edge = halve(fault, *COURANT, options.halvings)
    dt = LONG / substeps(edge.stable)
    beyond = None if edge.unstable is None else LONG / substeps(edge.unstable)
    return {
        "case": f"longest_step_{name}",
        "stable_dt_ms": 1e3 * dt,
        "stable_c_dt_over_dx": speed * dt / dx,
        "unstable_c_dt_over_dx": beyond and speed * beyond / dx,
        "fault": edge.fault,
        "refused_from_c_dt_over_dx": build.CFL_STABLE,
        "chosen_dt_ms": 1e3 * first.model.step.dt,
    }


def largest_gains(options: Options, kind: str, limited: bool) -> dict[str, Any]:
    """Find the largest stable factor on stiffness, damping or both, with the limits of muscles or without."""
    on_stiffness, on_damping = KINDS[kind]
    strength, reach = (1.0, JOINT_RANGE) if limited else (BOUNDLESS, NUDGE)

    def trial(factor: float, grounded: bool) -> Trial:
        gains = factor if on_stiffness else 1.0, factor if on_damping else 1.0
        return Trial(grounded, *gains, strength, reach)

    edge = halve(
        lambda factor: first_fault([trial(factor, True), trial(factor, False)], options), 1.0, MOST, options.halvings
    )
    stage = trial(edge.stable, False).stage(options, np.zeros((NUM_JOINTS, 3)))
    stage.step()
    springs, hip = stage.simulation.controllers[0].joints.springs, 1 + joint_index("left_hip")
    return {
        "case": f"largest_{kind}_{'limited' if limited else 'boundless'}",
        "stable_factor": edge.stable,
        "unstable_factor": edge.unstable,
        "fault": edge.fault,
        "hip_stiffness_nm_rad": float(springs.stiffness.numpy()[0, hip]),
        "hip_damping_nms_rad": float(springs.damping.numpy()[0, hip]),
        "dt_ms": 1e3 * stage.simulation.model.step.dt,
    }


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield rows of time steps in flight, on the floor and in soft flesh, and of gains of every kind."""
    for name, grounded, young in (("floating", False, 1e5), ("standing", True, 1e5), ("soft_floating", False, SOFT)):
        yield longest_step(options, name, grounded, young)
    for limited in (True, False):
        for kind in KINDS:
            yield largest_gains(options, kind, limited)
