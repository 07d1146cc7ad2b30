"""Sizes that a grid cannot hold are refused, with a size and a resolution that can."""

from __future__ import annotations

import itertools
import re
import warnings

import numpy as np
import pytest

from piavatar_envs.config import ColliderConfig, ConfigError, PropConfig
from piavatar_envs.sim.prop_geometry import PropPoints, box, capsule, sphere
from piavatar_envs.sim.resolution import GRID_PER_HEIGHT, check_sizes

HEIGHT = 1.66
#: Kind of a collider, and its size from a thickness; the limits in grid spacings.
POLES = {
    "capsule": lambda t: ("capsule", (t / 2, 0.5)),
    "rod": lambda t: ("box", (t / 2, 0.5, t / 2)),
}
BALLS = {
    "sphere": lambda t: ("sphere", (t / 2,)),
    "capsule": lambda t: ("capsule", (0.4 * t, 0.1 * t)),
    "cube": lambda t: ("box", (t / 2, t / 2, t / 2)),
}
COLLIDERS = [pytest.param("tiny", make, 0.57, id=f"tiny pole: {name}") for name, make in POLES.items()]
COLLIDERS += [
    pytest.param(fidelity, make, 1.2, id=f"{fidelity} ball: {name}")
    for fidelity, (name, make) in itertools.product(("tiny", "coarse", "medium"), BALLS.items())
]
PROPS = {
    "sphere": lambda t: sphere(t / 2, 0.02),
    "box": lambda t: box((0.3, t / 2, 0.2), 0.02),
    "capsule": lambda t: capsule(t / 2, 0.2, 0.02),
}


def check(fidelity, collider=None, points: PropPoints | None = None):
    colliders = [] if collider is None else [ColliderConfig(name="own", kind=collider[0], size=collider[1])]
    props = [] if points is None else [(PropConfig(name="own"), points)]
    check_sizes(HEIGHT / GRID_PER_HEIGHT[fidelity], fidelity, colliders, props)


def remedies(error) -> tuple[float, str | None]:
    """Return the thickness [m] and, if there is one, the resolution that a message suggests."""
    thickness, fidelity = re.search(r"make it (\S+) m thick(?:, or set fidelity='(\w+)')?$", str(error)).groups()
    return float(thickness), fidelity


@pytest.mark.parametrize("share", [0.999, 0.7, 0.3])
@pytest.mark.parametrize(("fidelity", "make", "cells"), COLLIDERS)
def test_small_colliders_are_refused_and_both_remedies_help(fidelity, make, cells, share):
    thickness = share * cells * HEIGHT / GRID_PER_HEIGHT[fidelity]
    with pytest.raises(ConfigError, match=r"collider 'own' is \S+ m thick") as refused:
        check(fidelity, make(thickness))
    found, limit = re.search(r"is (\S+) m thick, less than the (\S+) m", str(refused.value)).groups()
    assert float(found) < float(limit) or share > 0.99
    larger, finer = remedies(refused.value)
    with pytest.warns(UserWarning, match="dented too deeply"):
        check(fidelity, make(larger))
    assert finer or share < 0.5
    if finer:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check(finer, make(thickness))


@pytest.mark.parametrize("make", PROPS.values(), ids=PROPS)
@pytest.mark.parametrize("fidelity", ["tiny", "coarse", "medium"])
def test_small_props_are_refused_and_both_remedies_help(make, fidelity):
    thickness = 0.45 * HEIGHT / GRID_PER_HEIGHT[fidelity]
    with pytest.raises(ConfigError, match=r"prop 'own' is \S+ m thick") as refused:
        check(fidelity, points=make(thickness))
    larger, finer = remedies(refused.value)
    check(fidelity, points=make(larger))
    check(finer, points=make(thickness))


def test_no_resolution_is_suggested_where_none_helps():
    for refused in ({"points": sphere(1e-6, 0.02)}, {"collider": ("sphere", (1e-6,))}):
        with pytest.raises(ConfigError, match=r"make it .* m thick$"):
            check("coarse", **refused)


def test_colliders_that_part_particles_are_accepted_with_a_warning():
    with pytest.warns(UserWarning, match=r"strike its edge .* set fidelity='medium'"):
        check("coarse", ("box", (0.01, 0.5, 0.5)))
    for make in POLES.values():
        with pytest.warns(UserWarning, match=r"strike it fast .* set fidelity='fine'"):
            check("coarse", make(0.02))
    for pole in (("capsule", (0.025, 0.5)), ("sphere", (0.05,))):
        with pytest.warns(UserWarning, match=r"strike it fast .* set fidelity='medium'"):
            check("coarse", pole)


def test_what_is_large_enough_is_accepted_silently():
    dx = HEIGHT / GRID_PER_HEIGHT["coarse"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for make in POLES.values():
            check("coarse", make(1.21 * dx))
        for make in BALLS.values():
            check("coarse", make(2.41 * dx))
        for size in np.eye(3)[:, [1, 0, 2]] * (0.31 * dx - 0.5) + 0.5:
            check("coarse", ("box", tuple(size)))
        check("coarse", ("plane", ()))
