"""Things that would begin inside one another, from which they fly apart or in which they stick.

Contact is allowed, and more: what reaches less than a grid spacing into another is pushed out, and arms, which hold and
embrace, may be anywhere. Only what is configured is looked at: a task places what it adds itself at every reset.

How fast things will be, as far as settings tell beforehand: with the waves it decides how long substeps may be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.device import bone_masses
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS, joint_index
from piavatar_envs.config import AvatarConfig, ColliderConfig, ConfigError, ControlConfig, PropConfig, SceneConfig
from piavatar_envs.mpm.colliders import COLLIDER_KINDS
from piavatar_envs.sim.prop_geometry import PropPoints, primitive_distance
from piavatar_envs.sim.props import turn_of
from piavatar_envs.sim.scene import GROUND, Domain

if TYPE_CHECKING:
    from piavatar_envs.sim.bodies import Flesh
    from piavatar_envs.sim.world import Simulation

#: Joints whose flesh is where it is, whichever way arms are held.
_FIRM = [
    index
    for index, name in enumerate(JOINT_NAMES)
    if not any(part in name for part in ("collar", "shoulder", "elbow", "wrist"))
]
#: Middles of small things that are so near to a particle of flesh are inside [grid spacings]. The lattice of flesh is
#: 0.57 wide: no point in it is farther than 0.5 from a particle, and the skin is some 0.3 from the outermost.
WITHIN = 0.4
#: Points along half of a box's edge, at most.
MOST_POINTS = 20
#: How far the message looks for room [m].
_FARTHEST_MOVE = 3.0


@dataclass(frozen=True)
class _Thing:
    """A prop or a collider where it is.

    Attributes:
        name: what messages call it.
        middle: of its shape [m].
        distance: signed distance of points from its surface, negative inside, ``(N, 3)`` to ``(N,)`` [m].
        inner: points all over it, ``(N, 3)`` [m]; a plane, which has no middle, has none.
        lift: the way in which it is moved where aside is farther: props up, colliders down.
    """

    name: str
    middle: np.ndarray
    distance: Callable[[np.ndarray], np.ndarray]
    inner: np.ndarray
    lift: float

    @property
    def bounded(self) -> bool:
        """Whether it has an end, as all but planes have."""
        return len(self.inner) > 0


def _distance(kind: str, thing: PropConfig | ColliderConfig, turn: Rotation) -> Callable[[np.ndarray], np.ndarray]:
    """Signed distances [m] from where a thing is; none from a mesh, which is known by its particles alone."""
    if kind not in COLLIDER_KINDS:
        return lambda points: np.full(len(points), np.inf)
    local = primitive_distance(kind, (*thing.size, 0.0, 0.0, 0.0)[:3])  # a size of another length is refused later
    return lambda points: local(turn.inv().apply(points - np.array(thing.position)))


def _collider(collider: ColliderConfig, dx: float) -> _Thing:
    turn, middle = turn_of(collider), np.array(collider.position)
    size = (*collider.size, 0.0, 0.0, 0.0)[:3]
    ends = {"box": size, "capsule": (0.0, 0.0, size[1]), "sphere": (0.0, 0.0, 0.0)}
    inner = np.empty((0, 3))
    if collider.kind in ends:
        axes = [np.linspace(-end, end, 1 + 2 * min(math.ceil(end / dx), MOST_POINTS)) for end in ends[collider.kind]]
        inner = middle + turn.apply(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3))
    name = GROUND if collider.name == GROUND else f"collider {collider.name!r}"
    return _Thing(name, middle, _distance(collider.kind, collider, turn), inner, -1.0)


def _prop(prop: PropConfig, rest: PropPoints) -> _Thing:
    turn, middle = turn_of(prop), np.array(prop.position)
    inner = middle + turn.apply(rest.rest)
    return _Thing(f"prop {prop.name!r}", middle, _distance(prop.shape, prop, turn), inner, 1.0)


def check_beside_solids(
    dx: float, ground: bool, colliders: Sequence[ColliderConfig], props: Sequence[tuple[PropConfig, PropPoints]]
) -> None:
    """Refuse props that would begin in the floor or in a collider.

    Args:
        dx: grid spacing [m].
        ground: whether there is a floor.
        colliders: those that are configured.
        props: likewise, each with its particles.

    Raises:
        ConfigError: there are such.
    """
    floor = [ColliderConfig(name=GROUND, kind="plane")] if ground else []
    solids = [_collider(collider, dx) for collider in (*floor, *colliders)]
    for prop, rest in props:
        thing = _prop(prop, rest)
        matter = np.vstack([thing.inner, thing.middle])
        for solid in solids:
            deep = -solid.distance(matter)
            # most of it is, or more than contact is
            if deep[-1] > 0.0 or deep.max() > dx:
                ways = _ways(solid, thing.middle, thing.lift, dx)
                move = _shortest(
                    ways, lambda by, solid=solid, matter=matter: solid.distance(matter + by).min() >= 0, dx
                )
                _refuse(thing.name, deep.max(), solid.name, dx, move)


def check_beside_standing(simulation: Simulation) -> None:
    """Refuse props and colliders that would begin in an avatar that stands where the scene puts it.

    Raises:
        ConfigError: there are such.
    """
    dx, given = simulation.dx, simulation.config.scene
    points = dict(zip((prop.name for prop in simulation.scene.props), simulation.props.points, strict=True))
    things = [_collider(collider, dx) for collider in given.colliders]
    things += [_prop(prop, points[prop.name]) for prop in given.props]
    if not things:
        return
    names = simulation.subjects.names
    for name, avatar, flesh in zip(names, simulation.scene.avatars, simulation.flesh, strict=False):
        body = _Body.standing(avatar, flesh, dx)
        for thing in things:
            deep = max(body.depth_in(thing), body.depth_at(thing.inner).max(initial=0.0))
            if deep > dx or (thing.bounded and body.depth_at(thing.middle) > 0.0):
                # away from the body, which is as seen from a plane below its slope
                ways = [-way for way in _ways(thing, np.array([*avatar.position, thing.middle[2]]), -thing.lift, dx)]
                move = _shortest(ways, lambda by, body=body, thing=thing: body.is_clear_of(thing, by), dx)
                _refuse(thing.name, max(deep, 0.0), name, dx, move)


@dataclass(frozen=True)
class _Body:
    """The flesh of an avatar that stands, but for its arms.

    Attributes:
        places: of its particles [m], shape ``(P, 3)``.
        depth: of these below the skin [m], shape ``(P,)``.
        tree: of the places.
        near: how far a particle reaches [m].
    """

    places: np.ndarray
    depth: np.ndarray
    tree: cKDTree
    near: float

    @classmethod
    def standing(cls, avatar: AvatarConfig, flesh: Flesh, dx: float) -> _Body:
        """The body in the rest pose where an avatar stands."""
        firm = np.isin(flesh.sampled.skin_joints[:, 0], _FIRM)
        turn = Rotation.from_rotvec([0.0, 0.0, avatar.yaw])
        places = turn.apply(flesh.points.rest[0][firm]) + np.array([*avatar.position, 0.0])
        return cls(places, flesh.sampled.depth[firm], cKDTree(places), WITHIN * dx)

    def depth_at(self, points: np.ndarray) -> np.ndarray:
        """How deep points are below the skin [m], 0 outside."""
        away, index = self.tree.query(points)
        return np.where(away < self.near, self.depth[index], 0.0)

    def depth_in(self, thing: _Thing) -> float:
        """How deep the body is inside of a thing [m]; negative outside."""
        return float((-thing.distance(self.places)).max())

    def is_clear_of(self, thing: _Thing, by: np.ndarray) -> bool:
        """Whether nothing of a thing is inside any more once it has been moved ``by`` [m]."""
        return thing.distance(self.places - by).min() >= 0.0 and not self.depth_at(thing.inner + by).any()


def _ways(thing: _Thing, middle: np.ndarray, lift: float, dx: float) -> list[np.ndarray]:
    """Unit vectors along which what has its ``middle`` [m] there may leave a thing: aside, up or down by ``lift``.

    Of a plane it is up its slope.
    """
    if not thing.bounded:
        ends = thing.distance(np.array([middle + dx * axis for axis in np.eye(3)])) - thing.distance(middle[None])
        return [ends / np.linalg.norm(ends)]
    way = (middle - thing.middle) * (1.0, 1.0, 0.0)
    length = np.linalg.norm(way)
    aside = way / length if length > 0.01 else np.array([0.0, 1.0, 0.0])
    return [aside, np.array([0.0, 0.0, lift])]


def _shortest(ways: Sequence[np.ndarray], is_out: Callable[[np.ndarray], bool], dx: float) -> np.ndarray | None:
    """The shortest move after which nothing is inside any more [m], ``(3,)``; None where all are too far."""
    for step in range(1, math.ceil(_FARTHEST_MOVE / (0.25 * dx))):
        for way in ways:
            if is_out(0.25 * dx * step * way):
                return 0.25 * dx * step * way
    return None


def _refuse(what: str, deep: float, where: str, dx: float, move: np.ndarray | None) -> None:
    """Say how deep something begins in something else, and how to get it out.

    Raises:
        ConfigError: always.
    """
    remedy = "place it elsewhere, or make it smaller"
    if move is not None:
        length = float(np.linalg.norm(move))
        remedy = f"move it by {length:.2g} m along {[round(float(part), 2) + 0.0 for part in move / length]}"
    inside = f"{deep:.2g} m deep inside {where}" if deep > dx else f"with its middle inside {where}"
    raise ConfigError(f"{what} would begin {inside}; less than a grid spacing ({dx:.2g} m) is contact; {remedy}")


if TYPE_CHECKING:
    from piavatar_envs.sim.bodies import Flesh

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


def commanded_speed(control: ControlConfig, joints: Sequence[str], flesh: Sequence[Flesh]) -> float:
    """Greatest speed that commands to the acting joints give the flesh of posed bodies [m/s]; 0 under torques."""
    if control.mode != "pose":
        return 0.0
    levers = [lever(joints, one.points.rest[0], one.points.joints[0], one.sampled.skin_joints[:, 0]) for one in flesh]
    return control.joint_speed_limit * max(levers)


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
