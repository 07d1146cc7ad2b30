"""The scene: the domain, and all matter of a world in one list, with its velocity fields, friction and sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from piavatar_envs.avatar.body.sampling import LIMB_GROUPS, limb_groups
from piavatar_envs.config import ConfigError, PhysicsConfig, SceneConfig
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.model import Fields, MaterialPoints
from piavatar_envs.sim.bodies import NUM_PARTS, Flesh

#: The name of the floor.
GROUND = "ground"
#: Distance by which the domain of bodies without a held root is wider: the reach of a falling body [m].
FALL = 1.2
#: Height of the bodies for which the default domain has room [m].
TALLEST = 2.0


@dataclass(frozen=True)
class Domain:
    """Box in which particles may move [m]; a particle that leaves it ends the episode with a failure.

    The default has room for a body with outstretched limbs wherever its root may be before the wrench is released.

    Attributes:
        lower, upper: corners [m].
        fenced: whether walls belong to the world, such as ropes around a ring, so that they stand there for a single
            body as well, and the domain is not widened for falls.
    """

    lower: tuple[float, float, float] = (-1.6, -1.6, -0.3)
    upper: tuple[float, float, float] = (1.6, 1.6, 2.6)
    fenced: bool = False

    def around(self, places: Sequence[Sequence[float]]) -> Domain:
        """Return the box that contains this one moved to each of ``places`` (x, y) [m]."""
        at = np.array([(*place[:2], 0.0) for place in places])
        lower, upper = np.array(self.lower) + at.min(0), np.array(self.upper) + at.max(0)
        return Domain(tuple(lower.tolist()), tuple(upper.tolist()))

    def including(self, *points: Sequence[float]) -> Domain:
        """Return the smallest box that contains this one and ``points`` [m]."""
        every = np.array([self.lower, self.upper, *points])
        return Domain(tuple(every.min(0).tolist()), tuple(every.max(0).tolist()))

    def for_falls(self, walled: bool) -> Domain:
        """Return the box for bodies without a held root, wider by :data:`FALL` unless it is fenced and ``walled``."""
        if walled and self.fenced:
            return self
        aside = np.array([FALL, FALL, 0.0])
        return Domain(tuple((np.array(self.lower) - aside).tolist()), tuple((np.array(self.upper) + aside).tolist()))

    def for_height(self, height: float) -> Domain:
        """Return the box for bodies of a height [m], larger as the default one would be beyond :data:`TALLEST`."""
        more = max(height / TALLEST - 1.0, 0.0)
        usual = Domain()
        aside = () if self.fenced else (0, 1)
        lower = [at + more * usual.lower[axis] if axis in aside else at for axis, at in enumerate(self.lower)]
        upper = [at + more * usual.upper[axis] if axis in (*aside, 2) else at for axis, at in enumerate(self.upper)]
        return replace(self, lower=tuple(lower), upper=tuple(upper))

    def walls(self) -> tuple[Collider, ...]:
        """Return smooth planes at the sides and the top of the box."""
        walls = []
        for axis in range(3):
            normal = np.eye(3)[axis]
            walls += [Collider.plane(normal, self.lower[axis])] if axis < 2 else []
            walls += [Collider.plane(-normal, -self.upper[axis])]
        return tuple(walls)


@dataclass(frozen=True)
class Subjects:
    """The matter of a world: avatars, then props, each a subject.

    Attributes:
        names: of the subjects.
        first: index of the first particle of every subject, and the number of particles.
        matter: all particles.
        fields: velocity fields, friction between them, sensors (``NUM_PARTS`` rows per avatar).
        colliders: the ground and the scene's colliders, with their friction for every field, and the walls.
        collider_names: of the colliders but the walls.
    """

    names: tuple[str, ...]
    first: tuple[int, ...]
    matter: MaterialPoints
    fields: Fields
    colliders: tuple[Collider, ...]
    collider_names: tuple[str, ...]

    def stiffest(self) -> tuple[str, float]:
        """Return the name of the subject in which elastic waves are fastest, and its Young's modulus there [Pa]."""
        particle, young_modulus = self.matter.fastest()
        return self.names[int(np.searchsorted(self.first, particle, side="right")) - 1], young_modulus


def assemble(
    scene: SceneConfig,
    physics: PhysicsConfig,
    avatar_names: Sequence[str],
    flesh: Sequence[Flesh],
    props: Sequence[MaterialPoints],
    walls: Sequence[Collider],
    rows: int,
) -> Subjects:
    """Assemble the matter of a world.

    Args:
        scene: props in the order of ``props``, colliders, friction.
        physics: friction of the flesh on the ground.
        avatar_names: names of the avatars.
        flesh: matter of the avatars.
        props: matter of the scene's props.
        walls: further colliders, without friction.
        rows: rows of the arrays of matter, 1 or ``num_envs``.

    Raises:
        ConfigError: a name is given twice, or a pair of friction is unknown or impossible.
    """
    names = (*avatar_names, *(prop.name for prop in scene.props))
    solids = ((GROUND,) if scene.ground else ()) + tuple(collider.name for collider in scene.colliders)
    _check_names((*names, *solids))
    parts = [body.matter() for body in flesh] + list(props)
    first = np.cumsum([0, *(part.num_particles for part in parts)])
    owner, field, seam = _velocity_fields(scene, flesh, parts)
    frictions = _frictions(scene, physics, names, solids)
    fields = Fields(
        subject=tuple(owner.tolist()),
        friction=frictions[: len(names), : len(names)][np.ix_(owner, owner)],
        density=np.array([_mean_density(part) for part in parts])[owner],
        gate=scene.contact_gate,
        normals=scene.contact_normals,
        num_sensors=len(flesh) * NUM_PARTS,
    )
    colliders = (*_colliders(scene, frictions[: len(names), len(names) :][owner]), *walls)
    matter = replace(join(parts, rows), field=field, seam=seam, sensor=_sensors(flesh, first))
    return Subjects(names, tuple(int(i) for i in first), matter, fields, colliders, solids)


def _check_names(names: Sequence[str]) -> None:
    """Refuse a name that is given twice.

    Raises:
        ConfigError: there is one.
    """
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ConfigError(f"scene: the name {twice[0]!r} is given twice; avatars, props and colliders need their own")


def _velocity_fields(
    scene: SceneConfig, flesh: Sequence[Flesh], parts: Sequence[MaterialPoints]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the subject of every velocity field, and field and seam of every particle.

    A subject has one field, or with ``self_contact`` an avatar has one for torso, arms and legs each.
    """
    owner, field, seam = [], [], []
    for subject, part in enumerate(parts):
        if subject < len(flesh) and scene.self_contact:
            sampled = flesh[subject].sampled
            group, grown = limb_groups(sampled.skin_joints, sampled.skin_weights)
            count = len(LIMB_GROUPS)
        else:
            group, grown = np.zeros(part.num_particles, np.int32), np.zeros(part.num_particles, np.float32)
            count = 1
        field.append(len(owner) + group)
        seam.append(grown)
        owner += [subject] * count
    return np.array(owner), np.concatenate(field), np.concatenate(seam)


def _sensors(flesh: Sequence[Flesh], first: np.ndarray) -> np.ndarray:
    """Return the contact sensor of every particle: that of its body part, -1 for props."""
    sensor = np.full(first[-1], -1)
    for index, body in enumerate(flesh):
        sensor[first[index] : first[index + 1]] = index * NUM_PARTS + body.part
    return sensor


def _mean_density(part: MaterialPoints) -> float:
    """Return the mean density of a subject [kg/m^3], in its first row."""
    return float((part.density[0] * part.volume[0]).sum() / part.volume[0].sum())


def _frictions(scene: SceneConfig, physics: PhysicsConfig, names: Sequence[str], solids: Sequence[str]) -> np.ndarray:
    """Return Coulomb coefficients of subjects (rows) on subjects and solids (columns)."""
    everything = [*names, *solids]
    table = np.full((len(names), len(everything)), scene.body_friction)
    for column, name in enumerate(solids, start=len(names)):
        table[:, column] = next((c.friction for c in scene.colliders if c.name == name), physics.friction)
    for prop in scene.props:
        # the smoother of two surfaces decides
        row = names.index(prop.name)
        table[row, len(names) :] = np.minimum(table[row, len(names) :], prop.friction)
    _check_pairs(scene, names, everything)
    for pair in scene.pair_friction:
        a, b = everything.index(pair.a), everything.index(pair.b)
        for row, column in ((a, b), (b, a)):
            if row < len(names):
                table[row, column] = pair.friction
    return table


def _check_pairs(scene: SceneConfig, names: Sequence[str], everything: Sequence[str]) -> None:
    """Refuse pairs with an unknown name, pairs that cannot touch, and pairs that are given twice.

    Raises:
        ConfigError: there is one.
    """
    known: set[frozenset[str]] = set()
    for pair in scene.pair_friction:
        for name in (pair.a, pair.b):
            if name not in everything:
                raise ConfigError(f"scene.pair_friction: there is no {name!r}; use two of {', '.join(everything)}")
        if frozenset((pair.a, pair.b)) in known:
            raise ConfigError(f"scene.pair_friction: {pair.a!r} and {pair.b!r} are given twice; leave one of them out")
        known.add(frozenset((pair.a, pair.b)))
        is_prop = pair.a in (prop.name for prop in scene.props)
        if pair.a == pair.b and (is_prop or not scene.self_contact):
            remedy = "leave it out" if is_prop else "leave it out, or set scene.self_contact=true"
            raise ConfigError(f"scene.pair_friction: {pair.a!r} cannot touch itself; {remedy}")
        if pair.a not in names and pair.b not in names:
            raise ConfigError(
                f"scene.pair_friction: {pair.a!r} and {pair.b!r} are both solids, which cannot touch; leave them out"
            )


def _colliders(scene: SceneConfig, frictions: np.ndarray) -> tuple[Collider, ...]:
    """Return the ground and the scene's colliders; ``frictions`` has shape ``(fields, solids)``.

    Raises:
        ConfigError: a collider is not a valid solid.
    """
    ground = [Collider.plane((0.0, 0.0, 1.0), 0.0, tuple(frictions[:, 0]))] if scene.ground else []
    others = [
        Collider(c.kind, c.size, c.position, c.rotation, c.velocity, c.spin, tuple(frictions[:, column]), True)
        for column, c in enumerate(scene.colliders, start=len(ground))
    ]
    for config, collider in zip(scene.colliders, others, strict=True):
        try:
            collider.check()
        except ValueError as error:
            raise ConfigError(f"collider {config.name!r}: {error}") from None
    return (*ground, *others)


def join(parts: Sequence[MaterialPoints], rows: int) -> MaterialPoints:
    """Concatenate the matter of several subjects."""

    def side_by_side(name: str) -> np.ndarray:
        arrays = [getattr(part, name) for part in parts]
        return np.concatenate([np.broadcast_to(a, (max(rows, len(a)), a.shape[1])) for a in arrays], axis=1)

    names = ("volume", "density", "young_modulus", "poisson_ratio", "material", "retardation")
    return MaterialPoints(**{name: side_by_side(name) for name in names})
