"""The box in which bodies may move.

All matter of a world in one list: avatars first, then props; their velocity fields, friction and sensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from piavatar_envs.avatar.body.sampling import LIMB_GROUPS, limb_groups
from piavatar_envs.config import ConfigError, PhysicsConfig, PropConfig, SceneConfig
from piavatar_envs.config.schema import LEAST_DENSITY, MOST_DENSITY
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.model import Fields, MaterialPoints
from piavatar_envs.sim import prop_geometry as geometry
from piavatar_envs.sim.bodies import NUM_PARTS, Flesh
from piavatar_envs.sim.prop_geometry import PropPoints

#: More room for bodies that nothing holds up: as far as one reaches when it falls [m].
FALL = 1.2


@dataclass(frozen=True)
class Domain:
    """Box in which particles may move [m]; leaving it is a failure.

    The default holds a body with outstretched limbs wherever its root may be before it lets go.

    Attributes:
        lower, upper: corners [m].
        fenced: whether walls belong to the world, such as ropes around a ring: they stand there also for one body
            alone, and where nothing holds bodies up.
    """

    lower: tuple[float, float, float] = (-1.6, -1.6, -0.3)
    upper: tuple[float, float, float] = (1.6, 1.6, 2.6)
    fenced: bool = False

    def around(self, places: Sequence[Sequence[float]]) -> Domain:
        """The box moved to every one of ``places`` (x, y) [m], and what holds them all."""
        at = np.array([(*place[:2], 0.0) for place in places])
        lower, upper = np.array(self.lower) + at.min(0), np.array(self.upper) + at.max(0)
        return Domain(tuple(lower.tolist()), tuple(upper.tolist()))

    def including(self, *points: Sequence[float]) -> Domain:
        """The smallest box that holds this one and ``points`` [m]."""
        every = np.array([self.lower, self.upper, *points])
        return Domain(tuple(every.min(0).tolist()), tuple(every.max(0).tolist()))

    def for_falls(self, walled: bool) -> Domain:
        """The box for bodies that nothing holds up; ``walled`` says whether walls stand around it."""
        if walled and self.fenced:
            return self
        aside = np.array([FALL, FALL, 0.0])
        return Domain(tuple((np.array(self.lower) - aside).tolist()), tuple((np.array(self.upper) + aside).tolist()))

    def walls(self) -> tuple[Collider, ...]:
        """Smooth planes at the sides and the top of the box."""
        walls = []
        for axis in range(3):
            normal = np.eye(3)[axis]
            walls += [Collider.plane(normal, self.lower[axis])] if axis < 2 else []
            walls += [Collider.plane(-normal, -self.upper[axis])]
        return tuple(walls)


GROUND = "ground"


@dataclass(frozen=True)
class Subjects:
    """The matter of a world.

    Attributes:
        names: of the subjects, avatars first.
        first: first particle of every subject, and one past the last.
        matter: all particles.
        fields: velocity fields, friction between them, sensors (``NUM_PARTS`` rows an avatar).
        colliders: the ground, the scene's own, with their friction for every field, and the walls.
        collider_names: of those but the walls.
    """

    names: tuple[str, ...]
    first: tuple[int, ...]
    matter: MaterialPoints
    fields: Fields
    colliders: tuple[Collider, ...]
    collider_names: tuple[str, ...]


def prop_points(prop: PropConfig, spacing: float) -> PropPoints:
    """Particles of a prop.

    Raises:
        ConfigError: the size does not fit the shape, a mesh has no file, or the solid is too thin.
    """
    sizes = {"sphere": 1, "box": 3, "capsule": 2, "mesh": 1}
    if len(prop.size) != sizes[prop.shape]:
        raise ConfigError(f"prop {prop.name}: size={list(prop.size)} of a {prop.shape} has {sizes[prop.shape]} numbers")
    try:
        if prop.shape == "mesh":
            if prop.file is None:
                raise ValueError("shape='mesh' needs a file")
            return geometry.mesh(prop.file, spacing, scale=prop.size[0])
        if prop.shape == "box":
            return geometry.box(prop.size, spacing)
        return getattr(geometry, prop.shape)(*prop.size, spacing)
    except (ValueError, OSError) as error:
        raise ConfigError(f"prop {prop.name}: {error}") from None


def prop_matter(prop: PropConfig, points: PropPoints, physics: PhysicsConfig) -> MaterialPoints:
    """A prop as matter. Without a modulus of its own its waves are as fast as the flesh's.

    Raises:
        ConfigError: its mass is too small or too great for its size.
    """
    volume = float(points.volume.sum())
    density = prop.density if prop.mass is None else prop.mass / volume
    if not LEAST_DENSITY <= density <= MOST_DENSITY:
        raise ConfigError(
            f"prop {prop.name!r}: mass={prop.mass:.3g} kg in {volume:.3g} m^3 is a density of {density:.3g} kg/m^3, "
            f"which must be in [{LEAST_DENSITY:g}, {MOST_DENSITY:g}]; use a mass in "
            f"[{LEAST_DENSITY * volume:.3g}, {MOST_DENSITY * volume:.3g}] kg, or another size"
        )
    young = prop.young_modulus
    if young is None:
        # the P-wave modulus over the density is the flesh's
        young = physics.young_modulus * density / physics.density
        young *= _wave_factor(physics.poisson_ratio) / _wave_factor(prop.poisson_ratio)
    return MaterialPoints.uniform(points.volume, density, young, prop.poisson_ratio, prop.material)


def _wave_factor(poisson_ratio: float) -> float:
    """P-wave modulus over Young's modulus."""
    return (1.0 - poisson_ratio) / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))


def assemble(
    scene: SceneConfig,
    physics: PhysicsConfig,
    avatar_names: Sequence[str],
    flesh: Sequence[Flesh],
    props: Sequence[MaterialPoints],
    walls: Sequence[Collider],
    rows: int,
) -> Subjects:
    """Put all matter together.

    Args:
        scene: props and colliders in the order of ``props``.
        physics: friction of the flesh on the ground.
        avatar_names: names of the avatars.
        flesh: their matter.
        props: matter of the scene's props.
        walls: solids besides the scene's, without friction.
        rows: rows of the arrays of matter, 1 or ``num_envs``.

    Raises:
        ConfigError: a name is given twice, or a pair names what is not there.
    """
    names = (*avatar_names, *(prop.name for prop in scene.props))
    solids = ((GROUND,) if scene.ground else ()) + tuple(collider.name for collider in scene.colliders)
    everything = names + solids
    twice = [name for name in everything if everything.count(name) > 1]
    if twice:
        raise ConfigError(f"scene: the name {twice[0]!r} is given twice; avatars, props and colliders need their own")
    parts = [body.matter() for body in flesh] + list(props)
    first = np.cumsum([0, *(part.num_particles for part in parts)])
    owner, local, seam = [], [], []  # subject of every field; field within the subject and seam of every particle
    for subject, part in enumerate(parts):
        if subject < len(flesh) and scene.self_contact:
            sampled = flesh[subject].sampled
            group, grown = limb_groups(sampled.skin_joints, sampled.skin_weights)
            owner += [subject] * len(LIMB_GROUPS)
        else:
            group, grown = np.zeros(part.num_particles, np.int32), np.zeros(part.num_particles, np.float32)
            owner += [subject]
        local.append(owner.index(subject) + group)
        seam.append(grown)
    sensor = np.full(first[-1], -1)
    for index, body in enumerate(flesh):
        sensor[first[index] : first[index + 1]] = index * NUM_PARTS + body.part
    density = [float((p.density[0] * p.volume[0]).sum() / p.volume[0].sum()) for p in parts]
    pairs = _frictions(scene, physics, names, solids)
    owner_index = np.array(owner)
    fields = Fields(
        subject=tuple(owner),
        friction=pairs[: len(names), : len(names)][np.ix_(owner_index, owner_index)],
        density=np.array(density)[owner_index],
        gate=scene.contact_gate,
        normals=scene.contact_normals,
        num_sensors=len(flesh) * NUM_PARTS,
    )
    colliders = (*_colliders(scene, pairs[: len(names), len(names) :][owner_index]), *walls)
    matter = replace(_join(parts, rows), field=np.concatenate(local), seam=np.concatenate(seam), sensor=sensor)
    return Subjects(names, tuple(int(i) for i in first), matter, fields, colliders, solids)


def _frictions(scene: SceneConfig, physics: PhysicsConfig, names: Sequence[str], solids: Sequence[str]) -> np.ndarray:
    """Coulomb coefficients of subjects (rows) on subjects and solids (columns)."""
    everything = [*names, *solids]
    table = np.full((len(names), len(everything)), scene.body_friction)
    for column, name in enumerate(solids, start=len(names)):
        table[:, column] = next((c.friction for c in scene.colliders if c.name == name), physics.friction)
    for prop in scene.props:
        # two surfaces rub as much as the smoother of them
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
    """Refuse pairs of what is not there, of two that cannot touch, and such as come twice.

    Raises:
        ConfigError: there is one.
    """
    told: set[frozenset[str]] = set()
    for pair in scene.pair_friction:
        for name in (pair.a, pair.b):
            if name not in everything:
                raise ConfigError(f"scene.pair_friction: there is no {name!r}; there are {', '.join(everything)}")
        if frozenset((pair.a, pair.b)) in told:
            raise ConfigError(f"scene.pair_friction: {pair.a!r} and {pair.b!r} come twice; leave one of them out")
        told.add(frozenset((pair.a, pair.b)))
        is_prop = pair.a in (prop.name for prop in scene.props)
        if pair.a == pair.b and (is_prop or not scene.self_contact):
            remedy = "leave it out" if is_prop else "leave it out, or set scene.self_contact=true"
            raise ConfigError(f"scene.pair_friction: {pair.a!r} does not touch itself; {remedy}")
        if pair.a not in names and pair.b not in names:
            raise ConfigError(f"scene.pair_friction: {pair.a!r} and {pair.b!r} are solids, they never touch")


def _colliders(scene: SceneConfig, frictions: np.ndarray) -> tuple[Collider, ...]:
    """The ground and the scene's solids, ``frictions`` of shape ``(fields, solids)``.

    Raises:
        ConfigError: one of the scene's is none.
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


def _join(parts: Sequence[MaterialPoints], rows: int) -> MaterialPoints:
    """Matter of several subjects side by side."""

    def side_by_side(name: str) -> np.ndarray:
        arrays = [getattr(part, name) for part in parts]
        return np.concatenate([np.broadcast_to(a, (max(rows, len(a)), a.shape[1])) for a in arrays], axis=1)

    names = ("volume", "density", "young_modulus", "poisson_ratio", "material")
    return MaterialPoints(**{name: side_by_side(name) for name in names})
