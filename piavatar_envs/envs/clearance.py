"""Things that would begin inside one another, from which they fly apart or in which they stick.

Contact is allowed, and more: what reaches less than a grid spacing into another is pushed out, and arms, which hold and
embrace, may be anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.skeleton import JOINT_NAMES
from piavatar_envs.envs.config import AvatarConfig, ColliderConfig, ConfigError, PropConfig, SceneConfig
from piavatar_envs.envs.subjects import GROUND
from piavatar_envs.mpm.colliders import COLLIDER_KINDS
from piavatar_envs.props.geometry import PropPoints, primitive_distance

if TYPE_CHECKING:
    from piavatar_envs.envs.simulation import Simulation

#: Joints whose flesh is where it is, whichever way arms are held.
_FIRM = [
    index
    for index, name in enumerate(JOINT_NAMES)
    if not any(part in name for part in ("collar", "shoulder", "elbow", "wrist"))
]
#: Middles of small things that are so near to a particle of flesh are inside [grid spacings]. The lattice of flesh is
#: 0.57 wide: no point in it is farther than 0.5 from a particle, and the skin is some 0.3 from the outermost.
WITHIN = 0.4
#: How far the message looks for room [m].
_FARTHEST_MOVE = 3.0


@dataclass(frozen=True)
class _Solid:
    """A prop or a collider as a shape.

    Attributes:
        name: what messages call it.
        middle: of its shape [m].
        distance: signed distance of points from its surface, negative inside, ``(N, 3)`` to ``(N,)`` [m].
        bounded: whether it has a middle; a plane has none.
    """

    name: str
    middle: np.ndarray
    distance: Callable[[np.ndarray], np.ndarray]
    bounded: bool = True


def _solid(name: str, thing: PropConfig | ColliderConfig, kind: str) -> _Solid:
    size = (*thing.size, 0.0, 0.0, 0.0)[:3]
    turn, middle = Rotation.from_quat(np.roll(thing.rotation, -1)), np.array(thing.position)
    local = primitive_distance(kind, size)
    return _Solid(name, middle, lambda points: local(turn.inv().apply(points - middle)), kind != "plane")


def _colliders(scene: SceneConfig) -> list[_Solid]:
    return [_solid(f"collider {collider.name!r}", collider, collider.kind) for collider in scene.colliders]


def check_beside_solids(dx: float, scene: SceneConfig, points: Sequence[PropPoints]) -> None:
    """Refuse props that would begin in the floor or in a collider.

    Args:
        dx: grid spacing [m].
        scene: what is in the world.
        points: particles of its props.

    Raises:
        ConfigError: there are such.
    """
    solids = _colliders(scene)
    if scene.ground:
        solids.insert(0, _solid(GROUND, ColliderConfig(name=GROUND, kind="plane"), "plane"))
    for prop, rest in zip(scene.props, points, strict=True):
        matter = prop.position + Rotation.from_quat(np.roll(prop.rotation, -1)).apply(rest.rest)
        for solid in solids:
            deep = -solid.distance(np.vstack([matter, prop.position]))
            # most of it is, or more than contact is
            if deep[-1] > 0.0 or deep.max() > dx:
                way = _way_out(solid, np.array(prop.position), dx)
                move = _room(lambda s, solid=solid, matter=matter, way=way: solid.distance(matter + s * way), dx)
                _refuse(f"prop {prop.name!r}", deep.max(), solid.name, dx, move, way)


def check_beside_standing(simulation: Simulation) -> None:
    """Refuse props and colliders that would begin in an avatar that stands where the scene puts it.

    The props are those that are configured: a task places its own at every reset.

    Raises:
        ConfigError: there are such.
    """
    own = {prop.name for prop in simulation.config.scene.props}
    solids = _colliders(simulation.scene)
    solids += [
        _solid(f"prop {prop.name!r}", prop, prop.shape)
        for prop in simulation.scene.props
        if prop.name in own and prop.shape in COLLIDER_KINDS
    ]
    if not solids:
        return
    names = simulation.subjects.names
    for name, avatar, flesh in zip(names, simulation.scene.avatars, simulation.flesh, strict=False):
        firm = np.isin(flesh.sampled.skin_joints[:, 0], _FIRM)
        body = _standing(avatar, flesh.points.rest[0][firm])
        tree = cKDTree(body)
        for solid in solids:
            deep = -solid.distance(body)
            inside = solid.bounded and tree.query(solid.middle)[0] < WITHIN * simulation.dx
            if inside or deep.max() > simulation.dx:
                way = -_way_out(solid, np.array([*avatar.position, solid.middle[2]]), simulation.dx)
                move = _room(lambda s, solid=solid, body=body, way=way: solid.distance(body - s * way), simulation.dx)
                _refuse(solid.name, max(deep.max(), 0.0), name, simulation.dx, move, way)


def _standing(avatar: AvatarConfig, rest: np.ndarray) -> np.ndarray:
    """Flesh in the rest pose where an avatar stands [m], shape ``(P, 3)``."""
    return Rotation.from_rotvec([0.0, 0.0, avatar.yaw]).apply(rest) + np.array([*avatar.position, 0.0])


def _way_out(solid: _Solid, middle: np.ndarray, dx: float) -> np.ndarray:
    """Unit vector along which what has its ``middle`` [m] there leaves a solid: aside; of a plane, up its slope."""
    if not solid.bounded:
        ends = solid.distance(np.array([middle + dx * axis for axis in np.eye(3)])) - solid.distance(middle[None])
        return ends / np.linalg.norm(ends)
    way = (middle - solid.middle) * (1.0, 1.0, 0.0)
    length = np.linalg.norm(way)
    return way / length if length > 0.01 else np.array([0.0, 1.0, 0.0])


def _room(distances: Callable[[float], np.ndarray], dx: float) -> float | None:
    """How far to move until nothing is inside any more [m]; None where that is too far."""
    for step in range(1, math.ceil(_FARTHEST_MOVE / (0.25 * dx))):
        if distances(0.25 * dx * step).min() >= 0.0:
            return 0.25 * dx * step
    return None


def _refuse(what: str, deep: float, where: str, dx: float, move: float | None, way: np.ndarray) -> None:
    """Say how deep something begins in something else, and how to get it out.

    Raises:
        ConfigError: always.
    """
    along = [round(float(part), 2) + 0.0 for part in way]
    remedy = "place it elsewhere, or make it smaller" if move is None else f"move it by {move:.2g} m along {along}"
    inside = f"{deep:.2g} m deep inside {where}" if deep > dx else f"with its middle inside {where}"
    raise ConfigError(f"{what} would begin {inside}; less than a grid spacing ({dx:.2g} m) is contact; {remedy}")
