"""Bodies whose joints move under torques (:mod:`piavatar_envs.avatar.articulated`): momentum, sag, gaps and cost.

``python -m benchmarks.torque --out FILE.json``. The parts that need no balance: a body that flails in empty space, one
whose pelvis is held while it stretches its arms out or presses its toes on the floor, and one that is asked for the
rest pose (``control="pd"``, zero actions), with an assisted pelvis and without.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import runner, timing
from benchmarks.poses import random_pose
from benchmarks.rig import Rig, World
from piavatar_envs.avatar import articulated, cholesky, joint_momentum, joint_motion, joint_torques, mass_matrix
from piavatar_envs.avatar.articulated import ArticulatedBody
from piavatar_envs.avatar.asset import load_body
from piavatar_envs.avatar.rigid_fit import sum_moments
from piavatar_envs.avatar.settings import DriveSettings
from piavatar_envs.avatar.skeleton import NUM_JOINTS, PARENTS, forward_kinematics, joint_index
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.config import load_config
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep
from piavatar_envs.tasks import load_task

FLAILING = 100.0, 10.0  # springs and dampers of a flailing body [N m/rad, N m s/rad]
FLAIL_EVERY = 5  # control steps after which it is given another pose
STIFFNESSES = (50.0, 200.0, 1000.0)  # of all joints of a body with stretched arms [N m/rad]
PRESSING = 300.0  # stiffness of ankles that press [N m/rad]
DAMPINGS = (2.0, 20.0, 200.0)  # of the same [N m s/rad]
ANKLES = ("left_ankle", "right_ankle")
STAND_SECONDS, FALLEN = 10.0, 30.0  # how long a body is to stand [s], and the tilt of the pelvis at which it has not
HOLD = 1e5, 1e4  # spring and damper of a held pelvis, of its place and of its turn [SI units]
RATE = 300.0  # of the pulls that hold flesh to bones [1/s]
MODULES = (articulated, cholesky, joint_momentum, joint_motion, joint_torques, mass_matrix)


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the torque benchmark."""

    #: resolution of the body
    fidelity: str = "coarse"
    #: control steps of each case
    steps: int = 45
    #: substeps between two mass matrices
    refresh: int = 2


class Limbs:
    """One body whose joints move under torques, at rest in a pose.

    Attributes:
        rig: the world; its own drive does not act.
        body: the joints.
        program: a control step.
    """

    def __init__(
        self, options: Options, gravity: float, rotations: np.ndarray, rate: float = 0.0, ground: bool = False
    ) -> None:
        """Build it in a pose of rotation vectors ``(22, 3)``; ``rate`` holds flesh to bones, where it is not zero."""
        world = World(
            fidelity=options.fidelity, num_substeps=None, gravity=gravity, ground=ground, device=options.device
        )
        asset = load_body()
        self.rig = Rig(world, DriveSettings(), asset.parameters()[None])
        self.rig.reset(rotations[None])
        rates = np.full((1, self.rig.points.num_points), rate) if rate > 0.0 else None
        none = np.zeros((1, 1 + NUM_JOINTS))
        self.body = ArticulatedBody(self.rig.points, self.rig.avatar.body, self.rig.model, none, none, rates)
        local, joints = Rotation.from_rotvec(rotations), self.rig.points.joints[0].astype(float)
        world_rotations, positions = forward_kinematics(local.as_matrix(), joints[0], joints)
        self.body.state.rotation.assign(Rotation.from_matrix(world_rotations).as_quat()[None].astype(np.float32))
        self.body.state.position.assign(positions[None].astype(np.float32))
        self.body.target.root.assign(positions[None, 0].astype(np.float32))
        self.aim(rotations)
        self._run("record_mass")
        self.program = self._record(options.refresh)

    def _run(self, part: str) -> None:
        program = Program(self.rig.model.device)
        getattr(self.body, part)(program, self.rig.state)
        program.run()

    def _record(self, refresh: int) -> Program:
        rig, program = self.rig, Program(self.rig.model.device)
        record_begin(program, rig.model, rig.state, rig.scratch)
        for step in range(rig.model.num_substeps):
            self.body.record_substep(program, rig.state, refresh=step % refresh == 0)
            record_substep(program, rig.model, rig.state, rig.scratch, step)
        record_end(program, rig.model, rig.state, rig.scratch)
        return program

    def set_springs(self, stiffness: float, damping: np.ndarray | float, held: bool = False) -> None:
        """Springs and dampers of all joints; those of the pelvis hold it, or are none."""
        values = np.zeros((2, 1, 1 + NUM_JOINTS), np.float32)
        values[0, 0, 2:], values[1, 0, 2:] = stiffness, damping
        values[:, 0, :2] = np.array(HOLD)[:, None] * held
        self.body.springs.stiffness.assign(values[0])
        self.body.springs.damping.assign(values[1])

    def aim(self, rotations: np.ndarray) -> None:
        """Let the springs pull to a pose, rotation vectors ``(22, 3)``."""
        self.body.target.rotation.assign(Rotation.from_rotvec(rotations).as_quat()[None].astype(np.float32))

    def inertia(self) -> np.ndarray:
        """Mean moment of inertia of all that each joint but the pelvis carries [kg m^2], shape ``(21,)``."""
        diagonal = np.diagonal(self.body.mass.matrix.numpy()[0])
        return diagonal[6:].reshape(-1, 3).mean(1).astype(float)

    def arm(self, side: str) -> np.ndarray:
        """From shoulder to wrist [m]."""
        position = self.body.state.position.numpy()[0]
        return (position[joint_index(f"{side}_wrist")] - position[joint_index(f"{side}_shoulder")]).astype(float)

    def gaps(self) -> np.ndarray:
        """How far tracked joints are from where their parents have them [m], shape ``(21,)``."""
        program = Program(self.rig.model.device)
        self.rig.avatar.record_tracking(program, self.rig.state)
        program.run()
        return self.rig.pose_errors()["relative_translation"][0]


def flail(options: Options, rate: float) -> dict[str, Any]:
    """A body in empty space is given one random pose after the other."""
    limbs, rng = Limbs(options, 0.0, np.zeros((NUM_JOINTS, 3)), rate), np.random.default_rng(0)
    limbs.set_springs(*FLAILING)
    rig = limbs.rig
    start, scale, drift = totals(rig.model, rig.state), 0.0, np.zeros(2)
    for step in range(options.steps):
        if step % FLAIL_EVERY == 0:
            limbs.aim(random_pose(rng)[0] * (np.arange(NUM_JOINTS) > 0)[:, None])
        limbs.program.run()
        now = totals(rig.model, rig.state)
        scale = max(scale, now.momentum_scale)
        changes = now.momentum - start.momentum, now.angular_momentum - start.angular_momentum
        drift = np.maximum(drift, [np.linalg.norm(change) for change in changes])
    return {
        "case": f"free_float_{'attached' if rate > 0.0 else 'loose'}",
        "linear_momentum_rel": drift[0] / scale,
        "angular_momentum_rel": drift[1] / scale,
        "momentum_scale": scale,
        "failed": bool(rig.state.failure.numpy()[0]),
    }


def stretch_arms(options: Options, stiffness: float) -> dict[str, Any]:
    """A body whose pelvis is held stretches its arms to the sides, under gravity and against springs alone."""
    joints, rotations = load_body().mean_body().joints.astype(float), np.zeros((NUM_JOINTS, 3))
    for side, outwards in (("left", 1.0), ("right", -1.0)):
        shoulder = joint_index(f"{side}_shoulder")
        hanging = joints[joint_index(f"{side}_wrist")] - joints[shoulder]
        turn, _ = Rotation.align_vectors([[outwards, 0.0, 0.0]], [hanging / np.linalg.norm(hanging)])
        rotations[shoulder] = turn.as_rotvec()
    limbs = Limbs(options, 9.81, rotations, RATE)
    limbs.set_springs(stiffness, 2.0 * np.sqrt(stiffness * limbs.inertia()), held=True)  # critically damped
    before = {side: limbs.arm(side) for side in ("left", "right")}
    for _ in range(options.steps):
        limbs.program.run()
    sag = [_angle(before[side], limbs.arm(side)) for side in before]
    return {
        "case": f"t_pose_kp_{stiffness:g}",
        "arm_sag_deg": float(np.mean(sag)),
        "largest_gap_mm": float(1e3 * limbs.gaps().max()),
        "speed_m_s": float(np.abs(limbs.rig.state.u.numpy() + limbs.rig.state.vk.numpy()).max()),
        "failed": bool(limbs.rig.state.failure.numpy()[0]),
    }


def press(options: Options, damping: float) -> dict[str, Any]:
    """Ankles press the toes of a held, weightless body on the floor: what of their springs' torque arrives."""
    limbs, ankles = Limbs(options, 0.0, np.zeros((NUM_JOINTS, 3)), RATE, ground=True), [*map(joint_index, ANKLES)]
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
        limbs.program.run()
    world = Rotation.from_quat(limbs.body.state.rotation.numpy()[0].astype(float))
    impulse = limbs.body.impulse.numpy()[0].astype(float).reshape(-1, 3)[1:] / limbs.rig.model.step.dt
    turned = np.array([(world[PARENTS[b]].inv() * world[b]).as_rotvec()[0] for b in ankles])
    torque = np.array([world[PARENTS[b]].inv().apply(impulse[b])[0] for b in ankles])
    return {
        "case": f"press_kd_{damping:g}",
        "torque_nm": float(torque.mean()),
        "torque_over_spring": float((torque / (PRESSING * (0.3 - turned))).mean()),
        "floor_n": float(limbs.rig.scratch.sensors.boundary_impulse.numpy()[0, 0, 2] / limbs.rig.model.control_dt),
        "failed": bool(limbs.rig.state.failure.numpy()[0]),
    }


def stand(options: Options, assist: float) -> dict[str, Any]:
    """Ten seconds of zero actions under ``control="pd"``, in the default environment of that resolution."""
    task = load_task("PIAvatar/Reach-v0")
    settings = {"control": "pd", "root_assist": assist, "fidelity": options.fidelity, "pose_noise": 0.0}
    env = BatchEnv(task(load_config(task.Config, None, settings)), 1, options.device)
    env.reset(seeds=[0])
    tracked, state, dt = env.simulation.avatar.tracked, env.simulation.state, env.config.physics.control_dt
    stood = 0.0
    for _ in range(round(STAND_SECONDS / dt)):
        env.step()
        up = Rotation.from_quat(tracked.rotation.numpy()[0, 0].astype(float)).apply([0.0, 0.0, 1.0])[2]
        if up < np.cos(np.radians(FALLEN)):
            break
        stood += dt
    return {
        "case": f"stand_assist_{assist:g}",
        "stood_s": stood,
        "tilt_deg": float(np.degrees(np.arccos(min(1.0, up)))),
        "speed_m_s": float(np.abs(state.u.numpy() + state.vk.numpy()).max()),
        "failed": bool(env.failure.numpy()[0]),
    }


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0))))


def cost(options: Options) -> dict[str, Any]:
    """What the joints cost beside the Material Point Method alone."""
    limbs = Limbs(options, 9.81, np.zeros((NUM_JOINTS, 3)), RATE)
    limbs.set_springs(*FLAILING, held=True)
    limbs.program.run()
    kernels = {kernel for module in MODULES for kernel in vars(module) if hasattr(vars(module)[kernel], "adj")}
    times = timing.kernel_times(limbs.program, repeats=5)
    joints = sum(time.ms for name, time in times.items() if name in kernels or name == sum_moments.key)
    whole = sum(time.ms for time in times.values())
    return {"case": "cost", "joints_ms": joints, "mpm_ms": whole - joints, "joints_over_mpm": joints / (whole - joints)}


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Free float with flesh loose and attached, arms by stiffness, pressing toes by damping, standing, the cost."""
    for rate in (0.0, RATE):
        yield flail(options, rate)
    for stiffness in STIFFNESSES:
        yield stretch_arms(options, stiffness)
    for damping in DAMPINGS:
        yield press(options, damping)
    for assist in (0.0, 1.0):
        yield stand(options, assist)
    yield cost(options)


if __name__ == "__main__":
    runner.main("torque", cases, Options)
