"""Checks of initial placements: props outside the domain, and matter inside other matter.

Overlaps of less than a grid spacing are contact, and arms may be anywhere, as they hold and embrace. Only configured
props and colliders are checked here: a task places its own at every reset.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.config import AvatarConfig, ColliderConfig, ConfigError, PropConfig, SceneConfig
from piavatar_envs.mpm.colliders import COLLIDER_KINDS, half_thickness
from piavatar_envs.sim.bodies import Flesh
from piavatar_envs.sim.prop_geometry import PropPoints, primitive_distance
from piavatar_envs.sim.props import turn_of
from piavatar_envs.sim.scene import GROUND, Domain

#: How far a prop may reach out of the domain at the start [grid spacings]: the grid has room, and walls push it back.
OVERLAP = 0.5
#: Joints whose flesh does not move with the arms.
_FIRM = [
    index
    for index, name in enumerate(JOINT_NAMES)
    if not any(part in name for part in ("collar", "shoulder", "elbow", "wrist"))
]
#: Distance from a particle of flesh within which a point is inside [grid spacings]. The lattice of flesh is 0.57 wide,
#: so no point within it is farther than 0.5 from a particle, and the skin is some 0.3 from the outermost particles.
WITHIN = 0.4
#: Greatest number of points along half of a box's edge.
MOST_POINTS = 20
#: Points of a way at which the distance from a collider is evaluated, and the error of where it ends [m].
TRACES, WAY_ERROR = 40, 1.0e-3
#: Longest move that a message suggests [m].
_FARTHEST_MOVE = 3.0


def check_places(
    domain: Domain,
    dx: float,
    configs: Sequence[PropConfig],
    points: Sequence[PropPoints],
    places: Mapping[str, Sequence[Sequence[float]]],
) -> None:
    """Refuse props that would begin outside the domain, where the first step would fail.

    Args:
        domain: the box of the particles.
        dx: grid spacing [m].
        configs: settings of each prop, with its initial rotation.
        points: particles of each.
        places: initial centres of mass [m] by name of the prop.

    Raises:
        ConfigError: a prop would reach out of the domain, or a name is unknown.
    """
    solids = {config.name: (config, solid.rest) for config, solid in zip(configs, points, strict=True)}
    box = np.array([domain.lower, domain.upper])
    for name, centres in places.items():
        if name not in solids:
            raise ConfigError(f"there is no prop {name!r} to place; use one of {', '.join(solids) or 'none'}")
        config, rest = solids[name]
        turned = _turned(config, rest)
        reach = np.array([turned.min(0), turned.max(0)])
        for centre in centres:
            inside = (centre + reach[0] >= box[0] - OVERLAP * dx) & (centre + reach[1] <= box[1] + OVERLAP * dx)
            if not inside.all():
                _refuse_place(name, centre, int(np.argmin(inside)), box, box - reach)


def _refuse_place(name: str, centre: Sequence[float], axis: int, box: np.ndarray, room: np.ndarray) -> None:
    """Refuse a prop at ``centre`` that reaches out of ``box`` along ``axis``; ``room`` bounds its centre [m].

    Raises:
        ConfigError: always.
    """
    along, at = "xyz"[axis], [round(float(value), 3) for value in centre]
    low, high = room[:, axis]
    remedy = f"place it with {along} in [{low:.3g}, {high:.3g}] m" if low <= high else "make it smaller"
    raise ConfigError(
        f"prop {name!r} would begin at {at} m and reach out of the domain, which ends at "
        f"{along}={box[0, axis]:.3g} and {box[1, axis]:.3g} m; {remedy}"
    )


def check_apart(dx: float, configs: Sequence[PropConfig], points: Sequence[PropPoints]) -> None:
    """Refuse props of which one would begin with its centre in another.

    Args:
        dx: grid spacing [m].
        configs: settings of each prop.
        points: particles of each.

    Raises:
        ConfigError: there are such props.
    """
    turned = [_turned(config, solid.rest) for config, solid in zip(configs, points, strict=True)]
    for (one, _), (other, rest) in permutations(zip(configs, turned, strict=True), 2):
        middle = np.subtract(one.position, other.position)
        # names are checked with the scene
        if one.name != other.name and np.linalg.norm(rest - middle, axis=1).min() < dx:
            at = [round(float(value), 3) for value in one.position]
            raise ConfigError(
                f"prop {one.name!r} would begin at {at} m, inside {other.name!r}; place them side by side"
            )


def _turned(config: PropConfig, rest: np.ndarray) -> np.ndarray:
    """Return the particles of a prop about its centre of mass in its initial rotation [m], shape ``(P, 3)``."""
    return turn_of(config).apply(rest)


def check_beside_solids(
    dx: float, ground: bool, colliders: Sequence[ColliderConfig], props: Sequence[tuple[PropConfig, PropPoints]]
) -> None:
    """Refuse props that would begin in the floor or in a collider.

    Args:
        dx: grid spacing [m].
        ground: whether there is a floor.
        colliders: configured colliders.
        props: configured props, each with its particles.

    Raises:
        ConfigError: there are such props.
    """
    floor = [ColliderConfig(name=GROUND, kind="plane")] if ground else []
    solids = [_collider(collider, dx) for collider in (*floor, *colliders)]
    for prop, rest in props:
        thing = _prop(prop, rest)
        matter = np.vstack([thing.inner, thing.middle])
        for solid in solids:
            # a mesh may be a ring around a pole
            depths = _depths_through if solid.thickness < 2.0 * dx and prop.shape != "mesh" else _depths
            deep = depths(solid, matter)
            # its centre, or more than the depth of contact
            if deep[-1] > 0.0 or deep.max() > dx:
                ways = _ways(solid, thing.middle, thing.lift, dx)
                move = _shortest(
                    ways,
                    lambda by, depths=depths, solid=solid, matter=matter: depths(solid, matter + by).max() <= 0.0,
                    dx,
                )
                _refuse(thing.name, deep.max(), solid.name, dx, move)


def check_beside_standing(
    given: SceneConfig,
    scene: SceneConfig,
    points: Sequence[PropPoints],
    flesh: Sequence[Flesh],
    names: Sequence[str],
    dx: float,
) -> None:
    """Refuse configured props and colliders that would begin in an avatar in the rest pose.

    Args:
        given: the configured scene, whose props and colliders are checked.
        scene: the scene with the avatars and props of the task.
        points: particles of the props of ``scene``.
        flesh: of the avatars.
        names: of the avatars.
        dx: grid spacing [m].

    Raises:
        ConfigError: there are such props or colliders.
    """
    points = dict(zip((prop.name for prop in scene.props), points, strict=True))
    things = [_collider(collider, dx) for collider in given.colliders]
    things += [_prop(prop, points[prop.name]) for prop in given.props]
    if not things:
        return
    for name, avatar, own in zip(names, scene.avatars, flesh, strict=False):
        body = _Body.standing(avatar, own, dx)
        for thing in things:
            deep = max(body.depth_in(thing), body.depth_at(thing.inner).max(initial=0.0))
            if deep > dx or (thing.bounded and body.depth_at(thing.middle) > 0.0):
                # away from the body, which for a plane is down its slope
                ways = [-way for way in _ways(thing, np.array([*avatar.position, thing.middle[2]]), -thing.lift, dx)]
                move = _shortest(ways, lambda by, body=body, thing=thing: body.is_clear_of(thing, by), dx)
                _refuse(thing.name, max(deep, 0.0), name, dx, move)


@dataclass(frozen=True)
class _Thing:
    """A prop or a collider in its initial pose.

    Attributes:
        name: its name in messages.
        middle: centre of its shape [m].
        distance: signed distance of points from its surface, negative inside, ``(N, 3)`` to ``(N,)`` [m].
        inner: points within it, ``(N, 3)`` [m]; empty for a plane.
        lift: vertical direction in which messages suggest to move it: 1 for props, -1 for colliders.
        thickness: of a collider at its thinnest [m].
    """

    name: str
    middle: np.ndarray
    distance: Callable[[np.ndarray], np.ndarray]
    inner: np.ndarray
    lift: float
    thickness: float = math.inf

    @property
    def bounded(self) -> bool:
        """Whether it is finite; a plane is not."""
        return len(self.inner) > 0


def _distance(kind: str, thing: PropConfig | ColliderConfig, turn: Rotation) -> Callable[[np.ndarray], np.ndarray]:
    """Return the signed distance from a posed thing; infinity from a mesh, of which only particles are known."""
    if kind not in COLLIDER_KINDS:
        return lambda points: np.full(len(points), np.inf)
    local = primitive_distance(kind, (*thing.size, 0.0, 0.0, 0.0)[:3])  # the number of sizes is checked later
    return lambda points: local(turn.inv().apply(points - np.array(thing.position)))


def _collider(collider: ColliderConfig, dx: float) -> _Thing:
    """Pose a collider, with inner points at most ``dx`` [m] apart where :data:`MOST_POINTS` allows."""
    turn, middle = turn_of(collider), np.array(collider.position)
    size = (*collider.size, 0.0, 0.0, 0.0)[:3]
    ends = {"box": size, "capsule": (0.0, 0.0, size[1]), "sphere": (0.0, 0.0, 0.0)}
    inner = np.empty((0, 3))
    if collider.kind in ends:
        axes = [np.linspace(-end, end, 1 + 2 * min(math.ceil(end / dx), MOST_POINTS)) for end in ends[collider.kind]]
        inner = middle + turn.apply(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3))
    name = GROUND if collider.name == GROUND else f"collider {collider.name!r}"
    thickness = 2.0 * half_thickness(collider.kind, collider.size)
    return _Thing(name, middle, _distance(collider.kind, collider, turn), inner, -1.0, thickness)


def _prop(prop: PropConfig, rest: PropPoints) -> _Thing:
    """Pose a prop, with its particles as inner points."""
    turn, middle = turn_of(prop), np.array(prop.position)
    inner = middle + turn.apply(rest.rest)
    return _Thing(f"prop {prop.name!r}", middle, _distance(prop.shape, prop, turn), inner, 1.0)


def _depths(solid: _Thing, matter: np.ndarray) -> np.ndarray:
    """Return the depths of points in a collider [m], shape ``(N,)``, negative outside."""
    return -solid.distance(matter)


def _depths_through(solid: _Thing, matter: np.ndarray) -> np.ndarray:
    """Return :func:`_depths`, or the length of the way from the last point [m] that is in or behind the collider.

    The collider is thin: matter that is beyond it is not in it. The way enters where sphere tracing ends, as in
    :mod:`piavatar_envs.mpm.thin_colliders`.
    """
    way = matter - matter[-1]
    length = np.maximum(np.linalg.norm(way, axis=1), 1.0e-9)
    share = np.zeros(len(matter))
    for _ in range(TRACES):
        share += np.maximum(solid.distance(matter[-1] + share[:, None] * way), 0.0) / length
        share = np.minimum(share, 1.0)
    behind = (1.0 - share) * length
    return np.where(behind > WAY_ERROR, behind, _depths(solid, matter))


@dataclass(frozen=True)
class _Body:
    """Flesh of a standing avatar without its arms.

    Attributes:
        places: positions of its particles [m], shape ``(P, 3)``.
        depth: their depth below the skin [m], shape ``(P,)``.
        tree: search tree of the positions.
        near: distance from a particle within which a point is inside [m].
    """

    places: np.ndarray
    depth: np.ndarray
    tree: cKDTree
    near: float

    @classmethod
    def standing(cls, avatar: AvatarConfig, flesh: Flesh, dx: float) -> _Body:
        """Place the body in the rest pose."""
        firm = np.isin(flesh.sampled.skin_joints[:, 0], _FIRM)
        turn = Rotation.from_rotvec([0.0, 0.0, avatar.yaw])
        places = turn.apply(flesh.points.rest[0][firm]) + np.array([*avatar.position, 0.0])
        return cls(places, flesh.sampled.depth[firm], cKDTree(places), WITHIN * dx)

    def depth_at(self, points: np.ndarray) -> np.ndarray:
        """Return the depth of points below the skin [m], 0 outside."""
        away, index = self.tree.query(points)
        return np.where(away < self.near, self.depth[index], 0.0)

    def depth_in(self, thing: _Thing) -> float:
        """Return the greatest depth of the body in a thing [m]; negative outside."""
        return float((-thing.distance(self.places)).max())

    def is_clear_of(self, thing: _Thing, by: np.ndarray) -> bool:
        """Return whether a thing is clear of the body once it has been moved ``by`` [m]."""
        return thing.distance(self.places - by).min() >= 0.0 and not self.depth_at(thing.inner + by).any()


def _ways(thing: _Thing, middle: np.ndarray, lift: float, dx: float) -> list[np.ndarray]:
    """Return directions in which matter with its centre at ``middle`` [m] may leave a thing, as unit vectors.

    They are sideways, and up or down by ``lift``; for a plane, along its normal.
    """
    if not thing.bounded:
        ends = thing.distance(np.array([middle + dx * axis for axis in np.eye(3)])) - thing.distance(middle[None])
        return [ends / np.linalg.norm(ends)]
    way = (middle - thing.middle) * (1.0, 1.0, 0.0)
    length = np.linalg.norm(way)
    aside = way / length if length > 0.01 else np.array([0.0, 1.0, 0.0])
    return [aside, np.array([0.0, 0.0, lift])]


def _shortest(ways: Sequence[np.ndarray], is_out: Callable[[np.ndarray], bool], dx: float) -> np.ndarray | None:
    """Return the shortest move [m] after which nothing is inside, ``(3,)``; None if all exceed the limit."""
    for step in range(1, math.ceil(_FARTHEST_MOVE / (0.25 * dx))):
        for way in ways:
            if is_out(0.25 * dx * step * way):
                return 0.25 * dx * step * way
    return None


def _refuse(what: str, deep: float, where: str, dx: float, move: np.ndarray | None) -> None:
    """Refuse matter that begins in other matter, with the depth and a move that frees it.

    Raises:
        ConfigError: always.
    """
    remedy = "place it elsewhere, or make it smaller"
    if move is not None:
        length = float(np.linalg.norm(move))
        remedy = f"move it by {length:.2g} m along {[round(float(part), 2) + 0.0 for part in move / length]}"
    inside = f"{deep:.2g} m deep inside {where}" if deep > dx else f"with its centre inside {where}"
    raise ConfigError(f"{what} would begin {inside}; less than a grid spacing ({dx:.2g} m) is contact; {remedy}")
