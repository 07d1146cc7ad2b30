"""How far legs and trunk are bent beyond what people do as they walk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import Bounds, joint_index
from piavatar_envs.avatar.torque_control.dynamics import beyond

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv

wp.set_module_options({"enable_backward": False})

_UPRIGHT: Bounds = ((-5.0, 5.0), (-5.0, 5.0), (-5.0, 5.0))
#: Ranges of rotation vectors from the rest pose, about axes as in :mod:`piavatar_envs.avatar.body.skeleton` [deg]:
#: those of adults at 1 to 1.5 m/s (Perry & Burnfield, "Gait Analysis", 2010), some degrees wider.
_WALKING: dict[str, Bounds] = {
    "hip": ((-40.0, 20.0), (-15.0, 15.0), (-15.0, 15.0)),
    "knee": ((-3.0, 75.0), (-5.0, 5.0), (-10.0, 10.0)),
    "ankle": ((-20.0, 25.0), (-20.0, 20.0), (-20.0, 20.0)),
}
#: By the names of the joints.
EASY: dict[str, Bounds] = {f"{side}_{name}": _WALKING[name] for name in _WALKING for side in ("left", "right")} | {
    f"spine{n}": _UPRIGHT for n in (1, 2, 3)
}


def _ranges() -> str:
    """In words."""
    ranges = {f"{name}s": _WALKING[name] for name in _WALKING} | {"the spine": _UPRIGHT}
    axes = {name: ", ".join(f"{low:g} to {high:g}" for low, high in bounds) for name, bounds in ranges.items()}
    return "; ".join(f"{name} {said}" for name, said in axes.items()) + " degrees about x, y and z"


EASE_DOC = (
    "`-ease_cost` times the mean square of how far joints are bent beyond what people do as they walk [rad^2], over "
    f"the axes of hips, knees, ankles and the spine's three: {_ranges()}"
)


@wp.struct
class Ease:
    """Constants of it."""

    cost: float  # of a mean square of 1 rad^2
    joint: wp.array(dtype=int)
    lower: wp.array(dtype=wp.vec3)  # [rad]
    upper: wp.array(dtype=wp.vec3)  # [rad]


def ease_rule(cost: float, device: str) -> Ease:
    """Kernel argument."""
    rule = Ease()
    ends = np.radians(np.array(list(EASY.values()), dtype=np.float32))
    rule.cost, rule.joint = cost, wp.array([joint_index(name) for name in EASY], dtype=int, device=device)
    rule.lower, rule.upper = (wp.array(ends[..., end], dtype=wp.vec3, device=device) for end in (0, 1))
    return rule


@wp.kernel
def judge_ease(ease: Ease, term: int, local: wp.array2d(dtype=wp.quat), terms: wp.array3d(dtype=float)):
    """Reward term of how far joints are beyond their ranges."""
    e = wp.tid()
    count = ease.joint.shape[0]
    total = float(0.0)
    for n in range(count):
        total += wp.length_sq(beyond(local[e, ease.joint[n]], ease.lower[n], ease.upper[n]))
    terms[e, 0, term] = -ease.cost * total / float(3 * count)


def record_ease(env: BatchEnv, graph: LaunchGraph, ease: Ease, term: int) -> None:
    """Append: write the reward ``term``."""
    inputs = [ease, term, env.simulation.avatar.tracked.local]
    graph.launch(judge_ease, env.num_envs, inputs, [env.terms])
