"""Bodies whose joints move under torques: momentum, sag, gaps and cost.

``python -m benchmarks.physics.torque --out FILE.json``. A body that flails in empty space, one whose pelvis is held
while it stretches its arms out or presses its toes on the floor, and one that is asked for the rest pose
(``control="pd"``, zero actions), with an assisted pelvis and without; what balls do to it and what it does to balls
(:mod:`benchmarks.physics.blows`), whether its matter stays at the bones (:mod:`benchmarks.physics.wear`) and its bones
together on the floor (:mod:`benchmarks.physics.wear`), and up to which time step and gains it is stable
(:mod:`benchmarks.physics.stability`). All but stability is measured both ways of
:data:`benchmarks.physics.blows.HOLDS`: with firm bones that stop at the floor, as environments have them, and with
slipping ones that do not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import runner
from benchmarks.paper.poses import random_pose
from benchmarks.paper.stage import Pose, Stage, standing
from benchmarks.physics import blows, stability, wear
from benchmarks.physics.blows import HOLDS, afloat
from benchmarks.physics.limbs import Limbs, Options, critical_damping, widest
from benchmarks.physics.rig import joint_gaps
from benchmarks.speed import timing
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.torque_control import flesh_coupling, joint_motion, mass_matrix, stages
from piavatar_envs.config import PhysicsConfig, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.mpm.types import Model, State
from piavatar_envs.tasks import load_task

FLAILING = 100.0, 10.0  # springs and dampers of a flailing body [N m/rad, N m s/rad]
FLAIL_EVERY = 5  # control steps after which it is given another pose
STIFFNESSES = (50.0, 200.0, 1000.0)  # of the joints of stretched arms [N m/rad]
TRUNK = 1000.0  # of all others then: at 50 the trunk, an inverted pendulum of 67, would buckle [N m/rad]
PRESSING = 300.0  # stiffness of ankles that press [N m/rad]
DAMPINGS = (2.0, 20.0, 200.0)  # of the same [N m s/rad]
ARM = ("collar", "shoulder", "elbow", "wrist")
ANKLES = ("left_ankle", "right_ankle")
STAND_SECONDS, FALLEN = 10.0, 30.0  # how long a body is to stand [s], and the tilt of the pelvis at which it has not
RATE = 300.0  # of the pulls that hold flesh to bones [1/s]
# settings of ``control``: flesh is held to bones as in environments, or by its own stiffness only
FLESH: dict[str, dict[str, Any]] = {"_loose": {"flesh_rate": (0.0, 0.0)}, "": {}}
REPLAYS = 30  # of a control step whose cost is measured
MODULES = (flesh_coupling, joint_motion, stages, mass_matrix)


def flail(options: Options, rate: float, hold: str) -> dict[str, Any]:
    """Drive a body in empty space to one random pose after the other; ``hold`` is a key of :data:`HOLDS`."""
    limbs, poses = Limbs(options, 0.0, np.zeros((NUM_JOINTS, 3)), rate, **HOLDS[hold]), flailing(options)
    limbs.set_springs(*FLAILING)

    def step(index: int) -> None:
        limbs.aim(poses[index // FLAIL_EVERY])
        limbs.graph.run()

    row = {"case": f"free_float_{'attached' if rate > 0.0 else 'loose'}{hold}"}
    return row | drift(options, limbs.rig.model, limbs.rig.state, step, limbs.gaps)


def flail_under_pd(options: Options, flesh: str, hold: str) -> dict[str, Any]:
    """Repeat :func:`flail` under ``control="pd"`` of the environments: muscle limits, tissue, locked feet."""
    poses, (rest, root) = flailing(options), standing(0.0)
    interval = FLAIL_EVERY * PhysicsConfig().control_dt

    def script(time: float) -> Pose:
        return (rest if time == 0.0 else poses[int(time / interval - 1e-6)]), root

    act = afloat("flail", script=script, control={**FLESH[flesh], **HOLDS[hold]})
    stage = Stage(act, options.fidelity, options.device)
    simulation = stage.simulation
    row = {"case": f"free_float_pd{flesh}{hold}"}
    return row | drift(options, simulation.model, simulation.state, lambda _index: stage.step(), stage.gaps)


def flailing(options: Options) -> list[np.ndarray]:
    """Return random poses for a case, rotation vectors ``(22, 3)`` [rad]."""
    rng, joints = np.random.default_rng(0), (np.arange(NUM_JOINTS) > 0)[:, None]
    return [random_pose(rng)[0] * joints for _ in range(1 + options.steps // FLAIL_EVERY)]


def drift(
    options: Options, model: Model, state: State, step: Callable[[int], None], gaps: Callable[[], np.ndarray]
) -> dict[str, Any]:
    """Measure drift of momenta and gaps between bones, while ``step(index)`` moves a body from rest."""
    start, scale, found, apart = totals(model, state), 0.0, np.zeros(2), []
    for index in range(options.steps):
        step(index)
        now = totals(model, state)
        scale = max(scale, now.momentum_scale)
        changes = now.momentum - start.momentum, now.angular_momentum - start.angular_momentum
        found = np.maximum(found, [np.linalg.norm(change) for change in changes])
        apart.append(gaps())
    return {
        "linear_momentum_rel": found[0] / scale,
        "angular_momentum_rel": found[1] / scale,
        "momentum_scale": scale,
        **widest(apart),
        "failed": bool(state.failure.numpy()[0]),
    }


def stretch_arms(options: Options, stiffness: float, hold: str) -> dict[str, Any]:
    """Stretch the arms of a body with a held pelvis to the sides, under gravity and against springs alone.

    Only the springs of the arms have the ``stiffness`` [N m/rad]; those of trunk and legs have :data:`TRUNK`.
    """
    joints, rotations = load_asset().mean_body().joints.astype(float), np.zeros((NUM_JOINTS, 3))
    for side, outwards in (("left", 1.0), ("right", -1.0)):
        shoulder = joint_index(f"{side}_shoulder")
        hanging = joints[joint_index(f"{side}_wrist")] - joints[shoulder]
        turn, _ = Rotation.align_vectors([[outwards, 0.0, 0.0]], [hanging / np.linalg.norm(hanging)])
        rotations[shoulder] = turn.as_rotvec()
    limbs = Limbs(options, 9.81, rotations, RATE, **HOLDS[hold])
    of_arms = np.isin(JOINT_NAMES[1:], [f"{side}_{name}" for side in ("left", "right") for name in ARM])
    springs = np.where(of_arms, stiffness, TRUNK)
    limbs.set_springs(springs, critical_damping(limbs.body, springs), held=True)
    before = {side: limbs.arm(side) for side in ("left", "right")}
    for _ in range(options.steps):
        limbs.graph.run()
    sag = [_angle(before[side], limbs.arm(side)) for side in before]
    return {
        "case": f"t_pose_kp_{stiffness:g}{hold}",
        "arm_sag_deg": float(np.mean(sag)),
        **widest([limbs.gaps()]),
        "speed_m_s": float(np.abs(limbs.rig.state.u.numpy() + limbs.rig.state.vk.numpy()).max()),
        "failed": bool(limbs.rig.state.failure.numpy()[0]),
    }


def press(options: Options, damping: float, hold: str) -> dict[str, Any]:
    """Press the toes of a held, weightless body on the floor, and measure the share of the springs' torque."""
    ankles = [*map(joint_index, ANKLES)]
    limbs = Limbs(options, 0.0, np.zeros((NUM_JOINTS, 3)), RATE, ground=True, **HOLDS[hold])
    limbs.set_springs(3000.0, 100.0, held=True)
    springs = limbs.body.springs
    for array, value in ((springs.stiffness, PRESSING), (springs.damping, damping)):
        values = array.numpy()
        values[0, [1 + ankle for ankle in ankles]] = value
        array.assign(values)
    rotations = np.zeros((NUM_JOINTS, 3))
    rotations[ankles, 0] = 0.3
    limbs.aim(rotations)
    for _ in range(3 * options.steps):
        limbs.graph.run()
    world = Rotation.from_quat(limbs.body.state.rotation.numpy()[0].astype(float))
    impulse = limbs.body.impulse.numpy()[0].astype(float).reshape(-1, 3)[1:] / limbs.rig.model.step.dt
    turned = np.array([(world[PARENTS[b]].inv() * world[b]).as_rotvec()[0] for b in ankles])
    torque = np.array([world[PARENTS[b]].inv().apply(impulse[b])[0] for b in ankles])
    return {
        "case": f"press_kd_{damping:g}{hold}",
        "torque_nm": float(torque.mean()),
        "torque_over_spring": float((torque / (PRESSING * (0.3 - turned))).mean()),
        "floor_n": float(limbs.rig.scratch.sensors.boundary_impulse.numpy()[0, 0, 2] / limbs.rig.model.control_dt),
        "speed_m_s": float(np.abs(limbs.rig.state.u.numpy() + limbs.rig.state.vk.numpy()).max()),
        "failed": bool(limbs.rig.state.failure.numpy()[0]),
    }


def stand(options: Options, assist: float, hold: str) -> dict[str, Any]:
    """Run ten seconds of zero actions under ``control="pd"``, in the default environment of the resolution."""
    task = load_task("PIAvatar/Reach-v0")
    settings = {"control": "pd", "root_assist": assist, "fidelity": options.fidelity, "pose_noise": 0.0} | HOLDS[hold]
    env = BatchEnv(task(load_config(task.Config, None, settings)), 1, options.device)
    env.reset(seeds=[0])
    avatar, state, dt = env.simulation.avatar, env.simulation.state, env.config.physics.control_dt
    tracked = avatar.tracked
    stood = 0.0
    for _ in range(round(STAND_SECONDS / dt)):
        env.step()
        up = Rotation.from_quat(tracked.rotation.numpy()[0, 0].astype(float)).apply([0.0, 0.0, 1.0])[2]
        if up < np.cos(np.radians(FALLEN)):
            break
        stood += dt
    return {
        "case": f"stand_assist_{assist:g}{hold}",
        "stood_s": stood,
        "tilt_deg": float(np.degrees(np.arccos(min(1.0, up)))),
        "speed_m_s": float(np.abs(state.u.numpy() + state.vk.numpy()).max()),
        **widest([joint_gaps(tracked, avatar.body.rest_joint.numpy().astype(float))[0]]),
        "failed": bool(env.failure.numpy()[0]),
    }


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0))))


def cost(options: Options, hold: str) -> dict[str, Any]:
    """Measure the cost of joints on top of the Material Point Method: whole control steps, and by kernel.

    Steps are replayed as they are in environments, with joints and without in turn, and the fastest of each
    counts: what interrupts a thread is not its cost. Nothing weighs anything: the body stays where it is in either.
    """
    limbs = Limbs(options, 0.0, np.zeros((NUM_JOINTS, 3)), RATE, **HOLDS[hold])
    limbs.set_springs(*FLAILING, held=True)
    graphs = limbs.graph, limbs.record(joints=False)
    times = [[timing.wall_times(options.device, graph.run, 1)[0] for graph in graphs] for _ in range(REPLAYS)]
    whole, alone = 1e3 * np.min(times, axis=0)
    kernels = {kernel for module in MODULES for kernel in vars(module) if hasattr(vars(module)[kernel], "adj")}
    launched = timing.kernel_times(limbs.graph, repeats=5)
    joints = sum(time.ms for name, time in launched.items() if name in kernels)
    return {
        "case": f"cost{hold}",
        "joints_ms": whole - alone,
        "mpm_ms": alone,
        "joints_over_mpm": whole / alone - 1.0,
        "launched_joints_over_mpm": joints / (sum(time.ms for time in launched.values()) - joints),
    }


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield all rows: floating, arms, toes, standing, balls, kicks, wear, floor, stability, cost."""
    for hold in HOLDS:
        for rate in (0.0, RATE):
            yield flail(options, rate, hold)
        for flesh in FLESH:
            yield flail_under_pd(options, flesh, hold)
        for stiffness in STIFFNESSES:
            yield stretch_arms(options, stiffness, hold)
        for damping in DAMPINGS:
            yield press(options, damping, hold)
        for assist in (0.0, 1.0):
            yield stand(options, assist, hold)
    yield from blows.cases(options)
    yield from wear.cases(options)
    yield from wear.floor_cases(options)
    yield from stability.cases(options)
    for hold in HOLDS:
        yield cost(options, hold)


if __name__ == "__main__":
    runner.main("torque", cases, Options)
