"""Gaps between bones on the floor, drift of matter from its bones; of :mod:`benchmarks.physics.torque`.

Flesh must not wear out: limbs that swing or spin in empty space are strained by their own inertia, and by no more after
minutes than after seconds. Energy that stays in the flesh of a body that comes to rest is an error.

A spinning body must not swell: moved straight on in every substep, what rotates with ``omega`` would grow by
``exp(omega^2 dt T / 2)`` in ``T`` seconds without any stress.

No particle is put beyond a boundary, not even one of a firm bone: where the skeleton came below the floor, particles of
its bones would lie on it, and the joints that are tracked from them would gape. So a body is measured while the floor
bears it: standing by its own torques, falling limp, and thrashing where it lies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from agents.pid.agent import PIDAgent
from benchmarks.physics.blows import HOLDS
from benchmarks.physics.limbs import Options, widest
from benchmarks.physics.rig import joint_gaps
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index, skin
from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task

SECONDS = 10.0
SPIN = 8.0  # of a whole body in empty space [rad/s]
SPIN_SECONDS = 1.5
SWING_SECONDS = (10.0, 60.0)  # of legs that swing, after which strain is measured
SWING_RATE, SWING = 1.0, 0.5  # their frequency [Hz], and amplitude as a share of the actions
#: Where a body thrashes: held upright by its pelvis, or on the ground.
PLACES = {"upright": ("PIAvatar/Reach-v0", {"joints": None, "root_assist": 1.0}), "lying": ("PIAvatar/GetUp-v0", {})}


def make(options: Options, task: str, **settings: Any) -> BatchEnv:
    """Build one environment under torques, and reset it."""
    found = load_task(task)
    settings = {"fidelity": options.fidelity, "control": "torque", "pose_noise": 0.0, **settings}
    env = BatchEnv(found(load_config(found.Config, None, settings)), 1, options.device)
    env.reset(seeds=[0])
    return env


def homes(env: BatchEnv) -> np.ndarray:
    """Return the place of each particle of the avatar on its bones, shape ``(P, 3)`` [m]."""
    simulation = env.simulation
    pose, points = simulation.controllers[0].state, simulation.flesh[0].points
    world = Rotation.from_quat(pose.rotation.numpy()[0].astype(float)).as_matrix()
    rest, weights = points.rest[0].astype(float), points.skin_weights.astype(float)
    position, joints = pose.position.numpy()[0].astype(float), points.joints[0].astype(float)
    return skin(rest, points.skin_joints, weights / weights.sum(1, keepdims=True), world, position, joints)


def ways(env: BatchEnv) -> np.ndarray:
    """Return the distance of each particle of the avatar from its place on the bones, shape ``(P,)`` [m]."""
    home = homes(env)
    return np.linalg.norm(env.simulation.state.x.numpy()[0, : len(home)] - home, axis=1)


def rms(values: np.ndarray) -> float:
    """Return the root mean square in millimetres of lengths in metres."""
    return float(1e3 * np.sqrt((values**2).mean()))


def thrash(options: Options, place: str, hold: str) -> dict[str, Any]:
    """Apply random torques up to the muscles' limits, new ones in every control step."""
    task, settings = PLACES[place]
    env, rng = make(options, task, **settings, **HOLDS[hold]), np.random.default_rng(0)
    bone = env.simulation.flesh[0].sampled.bone
    for _ in range(round(SECONDS / env.config.physics.control_dt)):
        env.action.assign(rng.uniform(-1.0, 1.0, env.action.shape).astype(np.float32))
        env.step()
    off = ways(env)
    of_bones = [rms(off[bone == b]) for b in range(NUM_JOINTS)]
    return {
        "case": f"thrash_{place}{hold}",
        "seconds": SECONDS,
        "bones_off_mm": rms(off[bone >= 0]),
        "flesh_off_mm": rms(off[bone < 0]),
        "forearms_off_mm": rms(off[np.isin(bone, [JOINT_NAMES.index(f"{side}_elbow") for side in ("left", "right")])]),
        "furthest_bone": JOINT_NAMES[int(np.argmax(of_bones))],
        "furthest_bone_off_mm": max(of_bones),
        "failed": bool(env.failure.numpy()[0]),
    }


def widths(env: BatchEnv) -> np.ndarray:
    """Return the root-mean-square width of every bone's particles across the bone [m], shape ``(22,)``."""
    x, bone = env.simulation.state.x.numpy()[0].astype(float), env.simulation.flesh[0].sampled.bone
    spread = [np.linalg.svd(x[bone == b] - x[bone == b].mean(0), compute_uv=False) for b in range(NUM_JOINTS)]
    return np.array([np.hypot(*values[1:]) for values in spread])


def set_spinning(env: BatchEnv, rate: float) -> None:
    """Set a spin of the whole body about the vertical through its centre of mass [rad/s]."""
    state, model = env.simulation.state, env.simulation.model
    x, mass = state.x.numpy()[0].astype(float), model.particles.mass.numpy()[0].astype(float)
    state.u.assign(np.cross((0.0, 0.0, rate), x - mass @ x / mass.sum())[None].astype(np.float32))
    C = np.zeros((9, 1), np.float32)
    C[1], C[3] = -rate, rate
    state.C.assign(np.broadcast_to(C, state.C.shape).copy())


def straight_growth(env: BatchEnv, rate: float, steps: int) -> float:
    """Return the relative growth of spinning limbs whose particles move straight on."""
    physics = env.simulation.model
    return float(np.expm1(0.5 * rate**2 * physics.step.dt * steps * physics.control_dt))


def spin(options: Options, hold: str) -> dict[str, Any]:
    """Spin a body in empty space that holds its pose by springs."""
    empty = {"gravity": 0.0, "scene": {"ground": False, "walls": False}, "root_assist": 0.0, "control": "pd"}
    env = make(options, "PIAvatar/Reach-v0", **empty, **HOLDS[hold])
    before, steps = widths(env), round(SPIN_SECONDS / env.config.physics.control_dt)
    set_spinning(env, SPIN)
    for _ in range(steps):
        env.step()
    grown = widths(env) / before - 1.0
    return {
        "case": f"spin{hold}",
        "rad_s": SPIN,
        "seconds": SPIN_SECONDS,
        "largest_growth": float(np.abs(grown).max()),
        "straight_growth": straight_growth(env, SPIN, steps),
        "strain": float(strain(env).mean()),
        "failed": bool(env.failure.numpy()[0]),
    }


def strain(env: BatchEnv) -> np.ndarray:
    """Return the strain of every particle of the avatar, the norm of its principal stretches less one, ``(P,)``."""
    F = env.simulation.state.numpy()["F"][0, : env.simulation.avatar.num_points]
    return np.linalg.norm(np.linalg.svd(F, compute_uv=False) - 1.0, axis=1)


def stored_energy(env: BatchEnv) -> float:
    """Return the elastic energy of the flesh (neo-Hookean) [J]."""
    count, particles = env.simulation.avatar.num_points, env.simulation.model.particles
    F = env.simulation.state.numpy()["F"][0, :count].astype(float)
    mu, lam, volume = (getattr(particles, name).numpy()[0, :count].astype(float) for name in ("mu", "lam", "volume"))
    log_J = np.log(np.linalg.det(F))
    return float(volume @ (0.5 * mu * ((F**2).sum((1, 2)) - 3.0) - mu * log_J + 0.5 * lam * log_J**2))


def swing_legs(env: BatchEnv, seconds: float, start: float = 0.0) -> None:
    """Swing hips and knees of a body under ``pd`` control against each other, from time ``start`` on."""
    index, step = env.action_spec.names().index, env.config.physics.control_dt
    for n in range(round(seconds / step)):
        phase = np.sin(2.0 * np.pi * SWING_RATE * (start + n * step))
        action = np.zeros(env.action.shape, np.float32)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            action[..., index(f"{side}_hip.x")] = SWING * sign * phase
            action[..., index(f"{side}_knee.x")] = 0.25 * SWING * (1.0 + sign * phase)
        env.action.assign(action)
        env.step()


def swinging(options: Options, hold: str) -> dict[str, Any]:
    """Swing the legs of a body whose pelvis is held, in empty space; then let it rest for a second."""
    empty = {"gravity": 0.0, "scene": {"ground": False, "walls": False}, "root_assist": 1.0, "control": "pd"}
    env = make(options, "PIAvatar/Stand-v0", **empty, **HOLDS[hold])
    row, done = {"case": f"swing{hold}"}, 0.0
    for seconds in SWING_SECONDS:
        swing_legs(env, seconds - done, done)
        row[f"strain_after_{seconds:g}_s"], done = float(strain(env).mean()), seconds
    env.action.zero_()
    for _ in range(round(1.0 / env.config.physics.control_dt)):
        env.step()
    left = {"strain_at_rest": float(strain(env).mean()), "energy_at_rest_j": stored_energy(env)}
    return row | left | {"failed": bool(env.failure.numpy()[0])}


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield rows of a spinning body and of bodies that swing or thrash, with firm bones and slipping ones."""
    for hold in HOLDS:
        yield spin(options, hold)
        yield swinging(options, hold)
        for place in PLACES:
            yield thrash(options, place, hold)


#: From observations ``(1, size)`` to actions ``(1, action_size)``.
Act = Callable[[np.ndarray], np.ndarray]
BALLS = [joint_index(f"{side}_foot") for side in ("left", "right")]  # of the feet: what bears most of a body
WANTED = 1.0  # gaps that were wanted at most [mm]
SETTLING = 0.25  # first share of the time, in which soft soles give way until they bear what stands on them


def standing(env: BatchEnv) -> Act:
    """Return a PID agent that keeps its balance unassisted."""
    return PIDAgent(env)


def limp(env: BatchEnv) -> Act:
    """Return zero torques."""
    return lambda _observation: np.zeros((1, env.action_spec.size))


def thrashing(env: BatchEnv) -> Act:
    """Return random torques up to the muscles' limits, new ones in every control step."""
    rng = np.random.default_rng(0)
    return lambda _observation: rng.uniform(-1.0, 1.0, (1, env.action_spec.size))


#: By the row's name: the task in which a body begins, and what moves it.
WAYS = {
    "standing": ("PIAvatar/Stand-v0", standing),
    "falling": ("PIAvatar/Stand-v0", limp),
    "lying": ("PIAvatar/GetUp-v0", thrashing),
}


def on_floor(options: Options, way: str, hold: str) -> dict[str, Any]:
    """Move a body on the floor as a key of :data:`WAYS` says; ``hold`` is a key of :data:`HOLDS`."""
    task, begin = WAYS[way]
    env = make(options, task, **HOLDS[hold])
    act, avatar = begin(env), env.simulation.avatar
    tracked, joints = avatar.tracked, avatar.body.rest_joint.numpy().astype(float)
    bones = env.simulation.flesh[0].sampled.bone >= 0
    steps, gaps, balls, below = 3 * options.steps, [], [], 0.0
    for _ in range(steps):
        env.action.assign(act(env.observation.numpy()[:, 0])[:, None].astype(np.float32))
        env.step()
        gaps.append(joint_gaps(tracked, joints)[0])
        balls.append(tracked.position.numpy()[0, BALLS, :2])
        below = max(below, -float(homes(env)[bones, 2].min()))
    settled = np.array(balls[int(SETTLING * steps) :])
    largest = 1e3 * np.max(gaps, axis=1)
    return {
        "case": f"floor_{way}{hold}",
        "pelvis_m": float(tracked.position.numpy()[0, 0, 2]),
        **widest(gaps),
        "median_gap_mm": float(np.median(largest)),
        "share_of_time_beyond_wanted": float((largest > WANTED).mean()),
        "bones_below_floor_mm": 1e3 * below,
        "feet_slid_mm": float(1e3 * np.linalg.norm(settled - settled[0], axis=2).max()),
        "failed": bool(env.failure.numpy()[0]),
    }


def floor_cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield rows of bodies that stand, fall and lie, with firm bones that stop at the floor and without."""
    for hold in HOLDS:
        for way in WAYS:
            yield on_floor(options, way, hold)
