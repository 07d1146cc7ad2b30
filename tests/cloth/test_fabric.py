"""Fabrics: units of their sources, what the solver resolves, and fabrics of one's own."""

from __future__ import annotations

import pytest

from piavatar_envs.cloth import fabric
from piavatar_envs.cloth.fabric import FABRICS, MOST_STRETCH, Fabric, check_fabric, fabric_of, register_fabric

G = 9.81
#: A gram-force [N].
GF = 9.81e-3


@pytest.mark.parametrize(("name", "bending_length"), [("cotton", 0.020), ("silk", 0.015), ("linen", 0.025)])
def test_bending_is_that_of_peirces_bending_length(name, bending_length):
    own = FABRICS[name]
    assert (own.bending / (own.areal_density * G)) ** (1 / 3) == pytest.approx(bending_length, rel=0.02)


def test_wool_is_kawabatas_mean_suiting():
    own = FABRICS["wool"]
    assert own.areal_density == pytest.approx(26.4e-6 / 1e-4, rel=0.01)  # mg/cm^2
    assert own.bending == pytest.approx(0.136 * GF * 1e-4 / 1e-2, rel=0.01)  # gf cm^2/cm


def test_no_fabric_is_stiffer_than_the_solver_resolves():
    assert all(0.0 < own.stretch <= MOST_STRETCH for own in FABRICS.values())
    assert all(0.25 <= own.friction <= 0.8 for own in FABRICS.values())
    assert all(0.0 <= part <= 1.0 for own in FABRICS.values() for color in (own.front, own.back) for part in color)


def test_a_fabric_of_ones_own_is_found_by_its_name(monkeypatch):
    monkeypatch.setattr(fabric, "_registered", {})
    tulle = Fabric(0.02, 100.0, 1e-6)
    register_fabric("tulle", tulle)
    assert fabric_of("tulle") is tulle and check_fabric("tulle") == "tulle"
    with pytest.raises(ValueError, match="'cotton' is one of this package"):
        register_fabric("cotton", tulle)
    with pytest.raises(TypeError, match="pass a Fabric"):
        register_fabric("net", 0.02)


@pytest.mark.parametrize(
    ("values", "words"),
    [((0.0, 1.0, 0.0), "areal_density=0.0"), ((0.1, -1.0, 0.0), "stretch=-1.0"), ((0.1, 1.0, -1.0), "bending=-1.0")],
)
def test_values_out_of_range_are_refused(values, words):
    with pytest.raises(ValueError, match=words):
        Fabric(*values)


def test_an_unknown_fabric_is_refused_with_those_that_there_are():
    with pytest.raises(ValueError, match="unknown fabric 'tin'; use one of cotton, denim"):
        fabric_of("tin")
