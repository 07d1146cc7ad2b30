"""Gaps between the bones of a body on the floor, and how far its feet slide and sink in; of :mod:`benchmarks.torque`.

No particle is put beyond a boundary, not even a firm one: where the skeleton came below the floor, particles of its
bones would lie on it, and the joints that are tracked from them would gape. So a body is measured while the floor bears
it: as it stands by its own torques, as it falls down limp, and as it thrashes about where it lies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from agents.pid_agent import PIDAgent
from benchmarks.blows import HOLDS
from benchmarks.limbs import Options, widest
from benchmarks.rig import joint_gaps
from benchmarks.wear import homes, make
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.envs.batch_env import BatchEnv

#: From observations ``(1, size)`` to actions ``(1, action_size)``.
Act = Callable[[np.ndarray], np.ndarray]
BALLS = [joint_index(f"{side}_foot") for side in ("left", "right")]  # of the feet: what bears most of a body
WANTED = 1.0  # gaps that were wanted at most [mm]
SETTLING = 0.25  # first share of the time, in which soft soles give way until they bear what stands on them


def standing(env: BatchEnv) -> Act:
    """A PID agent keeps its balance; nothing helps it."""
    return PIDAgent(env)


def limp(env: BatchEnv) -> Act:
    """A body without torques."""
    return lambda _observation: np.zeros((1, env.action_spec.size))


def thrashing(env: BatchEnv) -> Act:
    """Random torques of all that muscles have, new ones in every control step."""
    rng = np.random.default_rng(0)
    return lambda _observation: rng.uniform(-1.0, 1.0, (1, env.action_spec.size))


#: By the row's name: the task in which a body begins, and what moves it.
WAYS = {
    "standing": ("PIAvatar/Stand-v0", standing),
    "falling": ("PIAvatar/Stand-v0", limp),
    "lying": ("PIAvatar/GetUp-v0", thrashing),
}


def on_floor(options: Options, way: str, hold: str) -> dict[str, Any]:
    """A body on the floor moves as a key of :data:`WAYS` says; ``hold`` is a key of :data:`HOLDS`."""
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


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """A body that stands, one that falls and one that lies; with bones that are firm and stop, and without either."""
    for hold in HOLDS:
        for way in WAYS:
            yield on_floor(options, way, hold)
