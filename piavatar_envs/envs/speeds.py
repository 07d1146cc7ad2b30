"""How fast things will be, as far as settings tell beforehand: with the waves it decides how long substeps may be."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from piavatar_envs.envs.config import ColliderConfig, DriveConfig, PropConfig, SceneConfig
from piavatar_envs.envs.domain import Domain
from piavatar_envs.props.geometry import PropPoints

#: How far all joints together are from what they turn, at most [m]: random commands of 4 rad/s move a hand by 13 m/s.
COMMANDED_LEVER = 3.75
#: What fast things strike leaves them faster than they came: bodies that colliders of 20 to 60 m/s ran into still went
#: further than a grid spacing in a substep in which the collider went 0.8 of one, and no longer where it went 2/3.
STRUCK = 1.5


def commanded_speed(drive: DriveConfig) -> float:
    """Greatest speed that commands give the flesh of a posed body [m/s]; under torques there are none."""
    return COMMANDED_LEVER * drive.joint_speed_limit if drive.control == "pose" else 0.0


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
