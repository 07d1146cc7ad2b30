"""Randomised episodes: factors on mass, stiffness and friction, drawn at every reset.

The masked environments draw factors, uniform in their logarithm, on the device and from (seed, episode) alone, so that
environment ``i`` of a batch draws what a single environment of its seed draws. A factor multiplies all constants that
depend on it, each from its nominal value, so that none of them drifts:

- *mass*: an avatar's density, and with it the mass of its particles and bones, the limits of the root wrench (which are
  in body weights), strength and springs of its joints under torque control (a heavier body is a stronger one), and the
  reference density of its velocity fields;
- *stiffness*: the moduli of its flesh, and with them its viscosity;
- *ground friction*: coefficients on the ground, walls and colliders; *body friction*: those between bodies;
- *cloth mass*: the mass per area of all garments; *cloth stiffness*: their stretch and bending stiffness; *cloth
  friction*: their friction.

Only constants that vary get a row for each environment. The time step is that of the stiffest and lightest body that
can be drawn (:func:`fastest_wave`), not of a sample, since otherwise an environment of a batch would differ from the
single environment.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.cloth.types import Fabrics
from piavatar_envs.config.schema import UNCHANGED, RandomizeConfig
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.rng import STREAM_PARAMETERS, generator
from piavatar_envs.mpm.model import MaterialPoints
from piavatar_envs.mpm.types import Model, row

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class Parameter:
    """A number that every episode draws from a range, or that may be set to anything in it.

    Attributes:
        name: its name in the observation.
        unit: physical unit, ``"-"`` if it has none.
        low, high: bounds of the range, in that unit.
        description: one line.
        log: whether it is drawn, and observed, on a logarithmic scale.
    """

    name: str
    unit: str
    low: float
    high: float
    description: str
    log: bool = False

    def value(self, observed: float | np.ndarray) -> float | np.ndarray:
        """Return the parameter in its unit from its observed value in [-1, 1]."""
        share = 0.5 * (np.asarray(observed, float) + 1.0)
        if self.log:
            return self.low * np.exp(share * math.log(self.high / self.low))
        return self.low + share * (self.high - self.low)


#: Factors of a world, then those of each avatar: setting and description, in the order of the columns.
OF_WORLD = {
    "ground_friction_factor": "friction with the ground, walls and colliders",
    "body_friction_factor": "friction between bodies",
}
OF_AVATAR = {"mass_factor": "density", "stiffness_factor": "Young's modulus"}
#: Factors of all garments, in the order of the columns, which are the last: what each multiplies, and its description.
OF_CLOTH = {
    "cloth_mass_factor": (("areal_density",), "mass of garments"),
    "cloth_stiffness_factor": (("stretch", "bending"), "stretch and bending stiffness of garments"),
    "cloth_friction_factor": (("friction",), "friction of garments"),
}


def fastest_wave(config: RandomizeConfig, flesh: Iterable[MaterialPoints]) -> float:
    """Return the speed of the fastest elastic wave [m/s] in ``flesh`` that ``config`` can draw."""
    return _greatest_factor(config) * max(matter.sound_speed() for matter in flesh)


def limiting_wave(config: RandomizeConfig, flesh: Iterable[MaterialPoints], dx: float) -> float:
    """Return the greatest :meth:`.MaterialPoints.limiting_speed` of ``flesh`` that ``config`` can draw [m/s]."""
    return max(matter.limiting_speed(dx, _greatest_factor(config)) for matter in flesh)


def _greatest_factor(config: RandomizeConfig) -> float:
    """Return the greatest factor on the speeds of elastic waves in the flesh."""
    return math.sqrt(config.stiffness_factor[1] / config.mass_factor[0])


@dataclass
class _Scaled:
    """Constants that a factor multiplies, ``value = factor * nominal``.

    Attributes:
        factor: column of the factor.
        nominal: shape ``(1 or num_envs, K)``.
        value: the product, which kernels read, shape ``(num_envs, K)``.
    """

    factor: int
    nominal: wp.array
    value: wp.array


@dataclass
class _Body:
    """Nominal masses of an avatar of random mass [kg]: of particles, of bones, and in total."""

    mass: wp.array
    bone_mass: wp.array
    body_mass: wp.array


@dataclass
class Randomization:
    """The factors of every environment, and the constants of the world that they scale.

    Attributes:
        config: ranges of the factors.
        model, avatars: the world, whose randomised constants get rows of their own.
        factors: shape ``(num_envs, factors)``, 1 until a reset; the world's, then those of each avatar, then those of
            garments, if there are any whose fabrics vary.
    """

    config: RandomizeConfig
    model: Model
    avatars: Sequence[Avatar]
    factors: wp.array = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.avatars)
        self._allocate([*OF_WORLD, *(list(OF_AVATAR) * count)])
        self._scales_cloth = False
        self._kept: dict[str, wp.array] = {}
        self._scaled: list[_Scaled] = []
        self._bodies: dict[int, _Body] = {}
        if self._varies("ground_friction_factor"):
            self._scale(0, self.model.boundaries, "friction", "colliders.friction")
        if self._varies("body_friction_factor"):
            self._scale(1, self.model.contact, "friction", "contact.friction")
        for index, avatar in enumerate(self.avatars):
            column = len(OF_WORLD) + index * len(OF_AVATAR)
            if self._varies("mass_factor"):
                self._scale_mass(column, index, avatar)
            if self._varies("stiffness_factor"):
                own = slice(avatar.body.first, avatar.body.first + avatar.body.count)
                for name in ("mu", "lam"):
                    self._scale(column + 1, self.model.particles, name, f"matter.{name}", own)

    def _allocate(self, names: Sequence[str]) -> None:
        """Allocate the factors of some settings."""
        n, device = self.model.num_envs, self.model.device
        bounds = [getattr(self.config, name) for name in names]
        self.factors = wp.array(np.ones((n, len(names)), np.float32), dtype=float, device=device)
        bounds = np.repeat([bounds], n, 0).astype(np.float32)
        self._names, self._bounds = tuple(names), wp.array(bounds, dtype=wp.vec2, device=device)

    def scale_cloth(self, fabric: Fabrics) -> None:
        """Let factors multiply the properties of all garments; to be called before a launch binds them."""
        if not any(self._varies(name) for name in OF_CLOTH):
            return
        self._scales_cloth = True
        first = self.factors.shape[1]
        self._allocate([*OF_WORLD, *(list(OF_AVATAR) * len(self.avatars)), *OF_CLOTH])
        for index, (setting, (names, _)) in enumerate(OF_CLOTH.items()):
            for name in names if self._varies(setting) else ():
                self._scale(first + index, fabric, name, f"cloth.{name}")

    def _varies(self, name: str) -> bool:
        """Return whether the range of a factor is more than 1."""
        return getattr(self.config, name) != UNCHANGED

    def parameters(self) -> tuple[tuple[Parameter, ...], tuple[Parameter, ...]]:
        """Return the drawn parameters of the world, and those of each avatar."""
        found = [
            tuple(
                Parameter(name, "-", *getattr(self.config, name), f"factor on {what}", log=True)
                for name, what in names.items()
                if self._varies(name)
            )
            for names in (OF_WORLD | self._of_cloth, OF_AVATAR)
        ]
        return found[0], found[1]

    @property
    def _of_cloth(self) -> dict[str, str]:
        """Return the descriptions of the factors on garments, if there are any."""
        return {name: what for name, (_, what) in OF_CLOTH.items()} if self._scales_cloth else {}

    def column(self, name: str, avatar: int = 0) -> wp.array:
        """Return the factor of the setting ``name`` in every environment, shape ``(num_envs,)``."""
        if name in OF_WORLD:
            return self.factors[:, list(OF_WORLD).index(name)]
        if name in OF_CLOTH:
            return self.factors[:, list(OF_CLOTH).index(name) - len(OF_CLOTH) + self.factors.shape[1]]
        return self.factors[:, len(OF_WORLD) + avatar * len(OF_AVATAR) + list(OF_AVATAR).index(name)]

    def fix(self, name: str, values: np.ndarray) -> None:
        """Set a factor of every environment, of all its avatars, from the next reset on; it is drawn no more.

        Args:
            name: of a factor that varies.
            values: factor of each environment, shape ``(num_envs,)``.

        Raises:
            ValueError: the factor does not vary, or a value lies outside the range that the time step is chosen for.
        """
        low, high = getattr(self.config, name)
        values = np.asarray(values, np.float64)
        if not self._varies(name) or not ((low <= values) & (values <= high)).all():
            raise ValueError(f"{name}={values.tolist()} must lie in the range randomize.{name}=[{low:g}, {high:g}]")
        bounds = self._bounds.numpy().copy()
        bounds[:, [own == name for own in self._names]] = values[:, None, None]
        self._bounds.assign(bounds)

    def _scale(self, factor: int, holder: Any, name: str, key: str, part: slice = slice(None)) -> wp.array:
        """Let a factor multiply columns ``part`` of the array ``name`` of ``holder``; return their nominal values."""
        array = _own_rows(holder, name, self.model.num_envs)
        self._kept[key] = array
        return self._add(factor, array[:, part], array.numpy()[:1, part])

    def _add(self, factor: int, value: wp.array, nominal: np.ndarray) -> wp.array:
        """Let a factor multiply an array; return its uploaded nominal values."""
        copy = wp.array(np.ascontiguousarray(nominal, np.float32), dtype=float, device=self.model.device)
        self._scaled.append(_Scaled(factor, copy, value))
        return copy

    def _scale_mass(self, factor: int, index: int, avatar: Avatar) -> None:
        """Let a factor multiply all constants that depend on an avatar's density.

        Masses of random shapes have nominal rows of their own.
        """
        n, body, contact = self.model.num_envs, avatar.body, self.model.contact
        own = slice(body.first, body.first + body.count)
        rows = body.rest.shape[0]
        mass = _own_rows(self.model.particles, "mass", n)
        bone_mass = _own_rows(body, "bone_mass", n)
        _own_rows(body, "rest_center", n)  # kernels read masses and centres of bones by the same row
        avatar.body_mass = total = wp.array(
            np.broadcast_to(avatar.body_mass.numpy(), n).copy(), dtype=float, device=self.model.device
        )
        self._bodies[index] = _Body(
            self._add(factor, mass[:, own], mass.numpy()[:rows, own]),
            self._add(factor, bone_mass, bone_mass.numpy()[:rows]),
            self._add(factor, total.reshape((n, 1)), total.numpy()[:rows, None]),
        )
        bones = {f"body_{index}.bone_mass": bone_mass, f"body_{index}.body_mass": total}
        self._kept |= {"matter.mass": mass, **bones}
        fields = np.unique(self.model.particles.field.numpy()[own])  # next to each other; garments have their own
        self._scale(factor, contact, "density", "contact.density", slice(int(fields[0]), int(fields[-1]) + 1))

    def set_nominal_mass(self, avatar: int, env: int, mass: np.ndarray, bone_mass: np.ndarray) -> None:
        """Set the nominal masses of an avatar in ``env``, for another shape, from the next reset on.

        Args:
            avatar: index of the avatar, whose shape must be random.
            env: index of the environment.
            mass: masses of its particles [kg], shape ``(P,)``.
            bone_mass: masses of its bones [kg], shape ``(22,)``.
        """
        if avatar in self._bodies:
            body = self._bodies[avatar]
            for array, value in (
                (body.mass, mass),
                (body.bone_mass, bone_mass),
                (body.body_mass, mass.sum(keepdims=True)),
            ):
                array[env].assign(np.ascontiguousarray(value, np.float32))

    def nominal_mass(self, avatar: int) -> dict[str, wp.array]:
        """Return the arrays of an avatar's masses [kg] before a factor multiplies them, ``(num_envs, ...)`` by name.

        They are those of its particles, of its bones, and the total; its shape must be random.
        """
        if avatar in self._bodies:
            return dict(vars(self._bodies[avatar]))
        drive, n = self.avatars[avatar], self.model.num_envs
        own = slice(drive.body.first, drive.body.first + drive.body.count)
        mass = self.model.particles.mass[:, own]
        return {"mass": mass, "bone_mass": drive.body.bone_mass, "body_mass": drive.body_mass.reshape((n, 1))}

    def record_reset(self, graph: LaunchGraph, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Record the launches by which the masked environments draw factors and scale their constants."""
        if not self._scaled:
            return
        graph.launch(draw_factors, self.factors.shape, [mask, seed, episode, self._bounds], [self.factors])
        for scaled in self._scaled:
            factor = self.factors[:, scaled.factor]
            graph.launch(scale_rows, scaled.value.shape, [mask, factor, scaled.nominal], [scaled.value])

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint by name: factors, and the constants that they scale."""
        return {"randomize.factors": self.factors, **self._kept} if self._scaled else {}


def _own_rows(holder: Any, name: str, rows: int) -> wp.array:
    """Return the array ``name`` of ``holder`` with ``rows`` rows; to be called before a launch binds the array."""
    array = getattr(holder, name)
    if array.shape[0] != rows:
        array = wp.array(np.repeat(array.numpy(), rows, 0), dtype=array.dtype, device=array.device)
        setattr(holder, name, array)
    return array


@wp.kernel
def draw_factors(
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    bounds: wp.array2d(dtype=wp.vec2),
    # out
    factors: wp.array2d(dtype=float),
):
    """Draw the factors of the masked environments, uniform in their logarithm; over ``(num_envs, factors)``.

    The bounds are those of each environment.

    Each factor has an index of its own, so that it does not depend on which others vary.
    """
    e, n = wp.tid()
    if not mask[e]:
        return
    low = bounds[e, n][0]
    high = bounds[e, n][1]
    random = generator(seed[e], episode[e], STREAM_PARAMETERS, n)
    factors[e, n] = wp.clamp(wp.exp(wp.randf(random, wp.log(low), wp.log(high))), low, high)


@wp.kernel
def scale_rows(
    mask: wp.array(dtype=wp.bool),
    factor: wp.array(dtype=float),
    nominal: wp.array2d(dtype=float),
    # out
    value: wp.array2d(dtype=float),
):
    """Set ``value = factor * nominal`` in the masked environments; over ``(num_envs, K)``."""
    e, k = wp.tid()
    if mask[e]:
        value[e, k] = factor[e] * nominal[row(e, nominal.shape[0]), k]
