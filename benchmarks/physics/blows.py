"""Bodies under springs that soft balls hit, and that kick them: deflection of joints, and exchange of momentum.

Nothing weighs anything and there is no floor: the body floats, so what a ball loses is what the body gets. A kick is
measured twice, floating and with a pelvis that the assisting springs hold.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.paper.acts import BALL_RADIUS, CHEST, ball
from benchmarks.paper.stage import Act, Stage, keyed
from benchmarks.physics.limbs import Options, critical_damping, widest
from piavatar_envs.avatar.body.muscles import spring_rows
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.config import PhysicsConfig, PropConfig, SceneConfig
from piavatar_envs.mpm.diagnostics import Totals, totals
from piavatar_envs.sim.scene import Domain

BALLS = (0.45, 1.5, 8.0)  # [kg]
SPEED, DISTANCE = 5.0, 0.1  # of a ball that is thrown at the chest [m/s], and its way there [m]
STIFFNESSES = (100.0, 300.0, 1000.0)  # of all joints of a body that is hit [N m/rad]
BOUNDLESS = 1000.0  # factor on the torques of muscles, which are not to be the limit here
# settings of ``control``: particles of bones are put into their places after a control step, and bones stop at the
# floor; or they slip under load, and the floor stops only flesh
HOLDS: dict[str, dict[str, Any]] = {"": {}, "_slipping": {"firm_bones": False, "bone_contact": False}}
FINER = 4  # control steps in one of the environments': peaks are short
SETTLING = 0.2  # last share of the time over which an error is averaged
SPACE = Domain().including((-3.0, -10.0, -2.5), (3.0, 4.0, 5.0))  # room for what flies off
# a leg swings from behind the body to its front [s], [rad]
SWING = (
    (0.0, {"right_hip": (0.6, 0.0, 0.0), "right_knee": (0.8, 0.0, 0.0)}),
    (0.1, {"right_hip": (-1.0, 0.0, 0.0)}),
)
KICK_SECONDS = 0.9  # until the pelvis is back at rest where it is held
FOOT = joint_index("right_foot")
LEAD = 0.06  # from where the toes are fastest to the ball's surface [m]: they hit it at about that speed


def afloat(name: str, *props: PropConfig, **settings: Any) -> Act:
    """Build a body under springs in empty space; ``settings`` are those of an act."""
    scene = SceneConfig(ground=False, walls=False, props=props)
    control = {"mode": "pd", **settings.pop("control", {})}
    physics = {"gravity": 0.0, **settings.pop("physics", {})}
    return Act(name, seconds=0.0, scene=scene, domain=SPACE, control=control, physics=physics, **settings)


def subject_totals(stage: Stage, subject: int) -> Totals:
    """Return momentum and energy of the body (0) or of the ball (1)."""
    simulation = stage.simulation
    first = simulation.subjects.first
    return totals(simulation.model, simulation.state, 0, slice(first[subject], first[subject + 1]))


def joint_errors(stage: Stage) -> np.ndarray:
    """Return the angle of every joint from the pose of its spring [deg], shape ``(21,)``."""
    avatar, above = stage.simulation.avatar, list(PARENTS[1:])
    world = Rotation.from_quat(stage.simulation.controllers[0].state.rotation.numpy()[0].astype(float))
    goal = Rotation.from_quat(avatar.state.goal_rotation.numpy()[0].astype(float))
    return np.degrees(((world[above].inv() * world[1:]).inv() * goal[1:]).magnitude())


def set_stiffness(stage: Stage, stiffness: float) -> None:
    """Set one stiffness of all joints [N m/rad], and the damping that is critical for each."""
    controller = stage.simulation.controllers[0]
    size = float(controller.joints.strength.factor.numpy()[0])  # gains are the reference adult's
    values = np.stack([np.full(NUM_JOINTS - 1, stiffness), critical_damping(controller.joints, stiffness)]) / size
    for array, row in zip((controller.gains.stiffness, controller.gains.damping), values, strict=True):
        array.assign(spring_rows(np.r_[0.0, row]).astype(np.float32))


def hit(options: Options, mass: float, stiffness: float, hold: str = "") -> dict[str, Any]:
    """Throw a ball at the chest of a floating body, whose bones are held as a key of :data:`HOLDS` says."""
    start = (0.0, CHEST[1] - BALL_RADIUS - DISTANCE, CHEST[2])
    prop = ball(mass, start, (0.0, SPEED, 0.0))
    control = {"strength": BOUNDLESS, **HOLDS[hold]}
    act = afloat("hit", prop, control=control, physics={"control_dt": PhysicsConfig().control_dt / FINER})
    stage = Stage(act, options.fidelity, options.device)
    before = subject_totals(stage, 1)
    stage.step()  # which builds the mass matrix; the ball is still on its way
    set_stiffness(stage, stiffness)
    errors, gaps = [], []
    for _ in range(FINER * options.steps):
        stage.step()
        errors.append(joint_errors(stage))
        gaps.append(stage.gaps())
    errors, last = np.array(errors), max(1, round(SETTLING * len(errors)))
    body, after = subject_totals(stage, 0), subject_totals(stage, 1)
    lost = before.momentum - after.momentum
    return {
        "case": f"ball_{mass:g}_kp_{stiffness:g}{hold}",
        "peak_deg": float(errors.max()),
        "worst_joint": JOINT_NAMES[1 + int(errors.max(0).argmax())],
        "settled_deg": float(errors[-last:].mean(0).max()),
        "body_got_n_s": float(np.linalg.norm(body.momentum)),
        "ball_lost_n_s": float(np.linalg.norm(lost)),
        "mismatch_rel": float(np.linalg.norm(body.momentum - lost) / np.linalg.norm(lost)),
        "ball_speed_m_s": float(after.momentum[1] / after.mass),
        **widest(gaps),
        "failed": bool(stage.simulation.state.failure.numpy()[0]),
    }


@dataclass(frozen=True)
class Kick:
    """Motion of a swinging leg: one entry per control step, ``T`` of them.

    Attributes:
        stage: the world at the end.
        toes: of the right foot, shape ``(T, 3)`` [m].
        pelvis: its velocity and spin, shape ``(T, 6)`` [m/s], [rad/s].
        support: force and torque of the springs that hold the pelvis, shape ``(T, 6)`` [N s], [N m s].
        gaps: between bones, shape ``(T, 21)`` [m].
    """

    stage: Stage
    toes: np.ndarray
    pelvis: np.ndarray
    support: np.ndarray
    gaps: np.ndarray


def swing(options: Options, held: bool, hold: str, *props: PropConfig) -> Kick:
    """Swing the leg, with a ball in its way or none."""
    act = afloat("kick", *props, script=keyed(*SWING), control={"root_assist": float(held), **HOLDS[hold]})
    stage = Stage(act, options.fidelity, options.device)
    drive, joints = stage.simulation.avatar.state, stage.simulation.controllers[0].state
    toes, pelvis, support, gaps = [], [], [], []
    for _ in range(round(KICK_SECONDS / stage.dt)):
        stage.step()
        toes.append(joints.position.numpy()[0, FOOT].copy())
        pelvis.append(joints.velocity.numpy()[0, :6].copy())
        wrench = np.r_[drive.wrench_force.numpy()[0], drive.wrench_torque.numpy()[0]]
        support.append(stage.dt * wrench)
        gaps.append(stage.gaps())
    return Kick(stage, np.array(toes), np.array(pelvis), np.array(support), np.array(gaps))


def kick(options: Options, mass: float, held: bool, hold: str, alone: Kick) -> dict[str, Any]:
    """Kick a ball where the toes would be fastest; ``alone`` is the same swing without one."""
    step = np.diff(alone.toes, axis=0)
    fastest = int(np.linalg.norm(step, axis=1).argmax())
    place = alone.toes[fastest] + (BALL_RADIUS + LEAD) * step[fastest] / np.linalg.norm(step[fastest])
    seen = swing(options, held, hold, ball(mass, tuple(place.tolist())))
    body, kicked = subject_totals(seen.stage, 0), subject_totals(seen.stage, 1)
    # the body began at rest: what it has, and has not from its support, is the ball's doing
    recoil, size = body.momentum - seen.support.sum(0)[:3], np.linalg.norm(kicked.momentum)
    change = seen.support - alone.support
    felt = seen.pelvis - alone.pelvis
    return {
        "case": f"kick_{mass:g}_{'held' if held else 'floating'}{hold}",
        "toes_m_s": float(np.linalg.norm(step[fastest]) / seen.stage.dt),
        "ball_m_s": float(size / kicked.mass),
        "ball_n_s": float(size),
        "body_n_s": float(np.linalg.norm(recoil)),
        "mismatch_rel": float(np.linalg.norm(recoil + kicked.momentum) / size),
        "pelvis_recoil_m_s": float(np.linalg.norm(felt[:, :3], axis=1).max()),
        "pelvis_recoil_rad_s": float(np.linalg.norm(felt[:, 3:], axis=1).max()),
        "support_n_s": float(np.linalg.norm(change[:, :3].sum(0))),
        "support_peak_n": float(np.linalg.norm(change[:, :3], axis=1).max() / seen.stage.dt),
        **widest(seen.gaps),
        "gap_without_ball_mm": float(1e3 * alone.gaps.max()),
        "failed": bool(seen.stage.simulation.state.failure.numpy()[0]),
    }


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield rows of balls of every mass at joints of every stiffness, and of kicks, floating and held."""
    for hold in HOLDS:
        for mass in BALLS:
            for stiffness in STIFFNESSES:
                yield hit(options, mass, stiffness, hold)
        for held in (False, True):
            alone = swing(options, held, hold)
            for mass in BALLS:
                yield kick(options, mass, held, hold, alone)
