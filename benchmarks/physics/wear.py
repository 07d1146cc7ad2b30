"""Gaps between bones on the floor, drift of matter from its bones; of :mod:`benchmarks.physics.torque`.

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
from benchmarks.physics.probe import corrected_rest
from benchmarks.physics.rig import joint_gaps
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index, skin
from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task

SECONDS = 10.0
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
    rest, weights = corrected_rest(simulation), points.skin_weights.astype(float)
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


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield rows of bodies that thrash, with firm bones and slipping ones."""
    for hold in HOLDS:
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
