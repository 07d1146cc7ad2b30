"""How fast things will be, as far as settings tell beforehand: with the waves it decides how long substeps may be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from piavatar_envs.avatar.body import bone_masses
from piavatar_envs.avatar.skeleton import JOINT_NAMES, PARENTS, joint_index
from piavatar_envs.envs.config import ColliderConfig, DriveConfig, PropConfig, SceneConfig
from piavatar_envs.envs.domain import Domain
from piavatar_envs.props.geometry import PropPoints

if TYPE_CHECKING:
    from piavatar_envs.envs.flesh import Flesh

#: Joints about whose other axes people turn by a few degrees at most.
HINGES = ("left_knee", "right_knee", "left_elbow", "right_elbow")
#: What fast things strike leaves them faster than they came: bodies that colliders of 20 to 60 m/s ran into still went
#: further than a grid spacing in a substep in which the collider went 0.8 of one, and no longer where it went 2/3.
STRUCK = 1.5
#: Mass of a bone with its flesh in the lightest random body, over that in the body that was built.
LIGHTEST = 0.5


def lever(joints: Sequence[str], rest: np.ndarray, places: np.ndarray, bones: np.ndarray) -> float:
    """Greatest speed of any flesh over that about each axis of the acting joints [m]: as if all turned it one way.

    Knees and elbows turn about one axis, other joints about three at once. Random commands come to some 0.6 of it.

    Args:
        joints: those that act, by name.
        rest: particles [m], shape ``(P, 3)``.
        places: of all joints [m], shape ``(22, 3)``.
        bones: which joint moves a particle most, shape ``(P,)``.
    """
    turns = np.where(np.isin(JOINT_NAMES, joints), np.where(np.isin(JOINT_NAMES, HINGES), 1.0, math.sqrt(3.0)), 0.0)
    total, at = np.zeros(len(rest)), bones.astype(int)
    while (at >= 0).any():  # from every particle to the pelvis
        total += np.where(at >= 0, turns[at] * np.linalg.norm(rest - places[at], axis=1), 0.0)
        at = np.where(at >= 0, np.take(PARENTS, at), -1)
    return float(total.max())


def commanded_speed(drive: DriveConfig, joints: Sequence[str], flesh: Sequence[Flesh]) -> float:
    """Greatest speed that commands to the acting joints give the flesh of posed bodies [m/s]; 0 under torques."""
    if drive.control != "pose":
        return 0.0
    levers = [lever(joints, one.points.rest[0], one.points.joints[0], one.sampled.skin_joints[:, 0]) for one in flesh]
    return drive.joint_speed_limit * max(levers)


def fastest_thing(
    scene: SceneConfig, solids: Sequence[PropPoints], domain: Domain, gravity: float
) -> tuple[str, float]:
    """Which of the props and colliders may be the fastest, and how fast any of its parts may be [m/s].

    From bounds, never from a draw: environments of a batch must be single environments.

    Args:
        scene: what is in the world.
        solids: particles of its props.
        domain: where particles may go; what is thrown in it falls no deeper than it is high.
        gravity: gravitational acceleration [m/s^2].

    Returns:
        Its name and its speed; no name and 0 where there is neither prop nor collider.
    """
    drop = domain.upper[2] - domain.lower[2]
    speeds = {
        prop.name: _prop_speed(prop, solid, drop, gravity) for prop, solid in zip(scene.props, solids, strict=True)
    }
    speeds |= {collider.name: _collider_speed(collider, domain) for collider in scene.colliders}
    return max(speeds.items(), key=lambda item: item[1], default=("", 0.0))


def fastest_blow(impulses: Mapping[str, float], flesh: Sequence[Flesh], mass_factor: float) -> tuple[str, float]:
    """Which of a task's impulses may make flesh the fastest, and by how much [m/s].

    Args:
        impulses: the greatest on each bone [N s], by joint.
        flesh: of the avatars.
        mass_factor: the least on their masses.

    Returns:
        Its name and the change of velocity; no name and 0 where there are no impulses.
    """
    speeds = {}
    for name, impulse in impulses.items():
        of_bone = [bone_masses(one.points)[0][:, joint_index(name)].min() for one in flesh]
        lightest = [mass * (LIGHTEST if one.shape.randomize else 1.0) for mass, one in zip(of_bone, flesh, strict=True)]
        speeds[f"the impulse on {name}"] = impulse / (mass_factor * min(lightest))
    return max(speeds.items(), key=lambda item: item[1], default=("", 0.0))


def _prop_speed(prop: PropConfig, solid: PropPoints, drop: float, gravity: float) -> float:
    """Of a prop that has fallen by ``drop`` [m]."""
    reach = float(np.linalg.norm(solid.rest, axis=1).max())
    thrown = max(math.hypot(*prop.velocity) + math.hypot(*prop.spin) * reach, prop.top_speed)
    return math.sqrt(thrown**2 + 2.0 * gravity * drop)


def _collider_speed(collider: ColliderConfig, domain: Domain) -> float:
    """Of the part of a collider that is farthest from its origin; of a plane, in the domain."""
    reach = math.hypot(*collider.size)
    if collider.kind == "plane":
        corner = np.maximum(np.subtract(domain.upper, collider.position), np.subtract(collider.position, domain.lower))
        reach = float(np.linalg.norm(corner))
    elif collider.kind == "capsule":
        reach = sum(collider.size)
    return max(math.hypot(*collider.velocity) + math.hypot(*collider.spin) * reach, collider.top_speed)
