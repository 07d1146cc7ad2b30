"""Resolutions of the grid, and the least sizes of props and colliders that they suit."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable

import numpy as np

from piavatar_envs.avatar.body.sampling import spacing_for
from piavatar_envs.config import ColliderConfig, ConfigError, PropConfig
from piavatar_envs.sim.prop_geometry import PropPoints

#: Grid spacings in a standing mean body, by fidelity; "fine" is the paper's scale, about 1 cm.
GRID_PER_HEIGHT: dict[str, float] = {
    "tiny": 12.0,
    "coarse": 32.0,
    "medium": 64.0,
    "fine": 166.0,
}
#: Least thickness of a prop [grid spacings]: smaller ones stop a quarter of a spacing and more above what they touch.
LEAST_PROP = 0.5
#: Extents [grid spacings] below which colliders part the particles of soft bodies, so that only cores and bones stop
#: them: plates, struck at an edge, by their least extent; poles by the middle one; what is small all around by the
#: greatest.
PARTING = (0.6, 1.2, 2.4)
#: Fidelity at which arms are as thin as a cell: under pose control, poles of 2 and 6 cm passed them in 14 and 8 of 15
#: places (at coarse, poles of 2 cm in 2).
THIN_LIMBS = "tiny"
#: Greatest extent below which a ball at 3 m/s swallows a collider and hangs [grid spacings].
SWALLOWED = 1.2


def check_sizes(
    dx: float,
    fidelity: str,
    colliders: Iterable[ColliderConfig],
    props: Iterable[tuple[PropConfig, PropPoints]],
) -> None:
    """Refuse what is too small for the grid, and warn of colliders that part the particles of what strikes them.

    Faces stop matter at any thickness; poles and edges stop the cores of props and the bones of avatars, but not those
    of limbs as thin as a cell under pose control.

    Args:
        dx: grid spacing [m].
        fidelity: the resolution that it belongs to.
        colliders: colliders of valid sizes.
        props: props, each with its particles.

    Raises:
        ConfigError: a collider or a prop is too small.
    """
    for collider in colliders:
        what, extents = f"collider {collider.name!r}", _extents(collider)
        _, pole, ball = extents
        if ball < SWALLOWED * dx:  # first, because its remedy is also that of a pole
            _refuse(what, ball, SWALLOWED * dx, "of 1.2 grid spacings, so that matter would swallow it", fidelity)
        if fidelity == THIN_LIMBS and pole < spacing_for(dx):
            reason = "that particles are apart, so that limbs would pass it at this fidelity"
            _refuse(what, pole, spacing_for(dx), reason, fidelity)
        for extent, cells, struck in reversed([*zip(extents, PARTING, ("its edge", "it", "it"), strict=True)]):
            if extent < cells * dx:
                warnings.warn(
                    f"{what} is {extent:.3g} m thick, less than {cells * dx:.3g} m: soft bodies that strike {struck} "
                    f"fast are dented too deeply, as far as the core of a prop or the bones, and rebound too slowly; "
                    f"{_remedy(extent, cells * dx, fidelity)}",
                    stacklevel=2,
                )
                break
    for prop, points in props:
        extent = float(np.ptp(points.vertices, axis=0).min())
        if extent < LEAST_PROP * dx:
            reason = "of half a grid spacing, so that it would stop above what it touches"
            _refuse(f"prop {prop.name!r}", extent, LEAST_PROP * dx, reason, fidelity)


def _extents(collider: ColliderConfig) -> list[float]:
    """Return the extents of a collider along its axes, the least first [m]; infinity for a plane."""
    if collider.kind == "plane":
        return [math.inf] * 3
    if collider.kind == "box":
        return sorted(2.0 * half for half in collider.size)
    across = 2.0 * collider.size[0]
    return [across, across, across + 2.0 * sum(collider.size[1:])]


def _remedy(extent: float, least: float, fidelity: str) -> str:
    """Return the remedies for an extent below ``least`` [m]: the size, and the coarsest fidelity that suits it."""
    cells = GRID_PER_HEIGHT[fidelity]
    finer = [name for name, count in GRID_PER_HEIGHT.items() if least * cells / count <= extent]
    return f"make it {_round_up(least):g} m thick" + (f", or set fidelity={finer[0]!r}" if finer else "")


def _round_up(value: float) -> float:
    """Return the next number of two significant digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit - 1.0e-9) * unit


def _refuse(what: str, extent: float, least: float, reason: str, fidelity: str) -> None:
    """Refuse a prop or collider that is thinner than ``least`` [m].

    Raises:
        ConfigError: always.
    """
    raise ConfigError(
        f"{what} is {extent:.3g} m thick, less than the {least:.3g} m {reason}; {_remedy(extent, least, fidelity)}"
    )
