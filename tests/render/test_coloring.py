"""Strain of a deformation gradient, and its colours."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.core.srgb import srgb_to_linear
from piavatar_envs.render import strain_magnitude
from piavatar_envs.render.coloring import color_by, strain_table


@pytest.mark.parametrize(
    ("stretches", "strain"),
    [((1, 1, 1), 0.0), ((1.3, 1, 1), 0.3), ((0.6, 1.1, 1.2), 0.4), ((1.5, 0.7, 0.9), 0.5), ((0.9, 0.9, 0.9), 0.1)],
)
def test_strain_of_known_stretches(stretches, strain):
    assert strain_magnitude(np.diag(stretches)[None]) == pytest.approx([strain], abs=1e-7)


def test_strain_of_simple_shear():
    """Compare with the stretches of a shear g: sqrt(1 + g^2/4) +- g/2 and 1."""
    shear = 0.8
    gradient = np.eye(3)
    gradient[0, 1] = shear
    stretch = np.sqrt(1.0 + shear**2 / 4.0) + shear / 2.0
    assert strain_magnitude(gradient[None]) == pytest.approx([stretch - 1.0], abs=1e-9)


def test_strain_does_not_depend_on_rotations():
    rng = np.random.default_rng(1)
    gradient = np.eye(3) + 0.3 * rng.normal(size=(200, 3, 3))
    before, after = (Rotation.random(200, rng=rng).as_matrix() for _ in range(2))
    np.testing.assert_allclose(strain_magnitude(before @ gradient @ after), strain_magnitude(gradient), atol=1e-7)
    np.testing.assert_allclose(strain_magnitude(before), 0.0, atol=1e-7)


def test_inverted_and_broken_elements():
    assert strain_magnitude(np.diag([1.0, 1.0, -0.5])[None]) == pytest.approx([1.5])
    assert np.isinf(strain_magnitude(np.full((1, 3, 3), np.nan))).all()


def test_the_color_range_is_fixed():
    alone, among = color_by([0.1], 0.3), color_by([0.1, 5.0, -1.0], 0.3)
    np.testing.assert_array_equal(alone[0], among[0])
    np.testing.assert_array_equal(among[1], color_by([0.3], 0.3)[0])
    np.testing.assert_array_equal(among[2], color_by([0.0], 0.3)[0])
    np.testing.assert_array_equal(color_by([np.nan, np.inf], 0.3), color_by([0.3, 0.3], 0.3))
    with pytest.raises(ValueError, match=r"maximum=0\.0"):
        color_by([0.1], 0.0)


def test_the_color_map_is_perceptually_uniform():
    """Expect CIE lightness to fall all the way, in steps that differ by little."""
    luminance = srgb_to_linear(strain_table()) @ [0.2126, 0.7152, 0.0722]
    lightness = 116.0 * np.cbrt(luminance) - 16.0
    steps = -np.diff(lightness[::8])
    assert steps.min() > 0.0
    assert steps.std() / steps.mean() < 0.35
    assert lightness[0] - lightness[-1] > 55.0
