"""Holes of textured surfaces: where geometry has them, from near and afar, and what shows through them."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.textures import Texture, Textures
from piavatar_envs.render.texels import OPAQUE, alpha_levels
from piavatar_envs.render.views import Shot
from tests.render.test_painter import AHEAD, NIGHT, paint, quad, rays

FACES = quad()[1]


def card(corners: np.ndarray, alpha: np.ndarray, cutoff: float = 0.5, subject: int = 1) -> tuple:
    """Return a white square, of which the corners are given from the lower left on, with an opacity."""
    image = Texture(np.full((*alpha.shape, 3), 255, np.uint8), alpha=alpha, cutoff=cutoff)
    textures = Textures((image,), np.zeros(2, int), quad()[2], np.full((4, 3), 255, np.uint8))
    return corners, FACES, {"textures": textures, "subject": subject}


def disc(side: int = 256) -> np.ndarray:
    """Return an opacity that falls from the middle, to 0.4 at a distance of a quarter of the side."""
    at = (np.arange(side) + 0.5) / side - 0.5
    distance = np.hypot(*np.meshgrid(at, at))
    return np.clip(np.rint(255.0 * (0.4 + 2.0 * (0.25 - distance))), 0, 255).astype(np.uint8)


def turned(angle: float, shift: tuple[float, float, float]) -> np.ndarray:
    """Return the corners of the square, turned about the vertical."""
    corners = quad()[0] - [0.0, 0.0, 1.0]
    cos, sin = np.cos(angle), np.sin(angle)
    return corners @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) + [0.0, 0.0, 1.0] + shift


@pytest.mark.parametrize(
    ("angle", "shift"), [(0.0, (0.0, 0.0, 0.0)), (1.1, (0.1, 0.0, 0.1)), (-1.4, (0.06, -3.7, 0.0))],
    ids=["ahead", "slanting", "beside the eye"],
)  # fmt: skip
def test_a_disc_is_left_of_a_card(device, angle, shift):
    """Samples of a card show it within a circle of its plane, in perspective, and the wall behind it elsewhere."""
    size, corners = 128, turned(angle, shift)
    wall = (quad(9.0)[0] + [0.0, 8.0, 0.0], FACES, {"subject": 2})
    painter = paint(device, [card(corners, disc(), 0.4), wall], size=size, samples=1, ground=NIGHT, segmentation=True)
    labels, ray = painter.labels.numpy()[0], rays(AHEAD, size)
    across, up = corners[1] - corners[0], corners[3] - corners[0]
    normal = np.cross(across, up)
    at = AHEAD.eye + ray * (((corners[0] - AHEAD.eye) @ normal) / (ray @ normal))[..., None] - corners[0]
    before = (at + corners[0] - AHEAD.eye) @ (0.0, 1.0, 0.0) > 0.05
    distance = np.hypot(at @ across - 0.5, at @ up - 0.5)
    inside, rim = before & (distance < 0.25), before & (np.abs(distance - 0.25) < 0.004)
    assert inside.sum() > 100 and (~inside).sum() > 1000
    assert ((labels == 1) == inside)[~rim].all() and (labels[~rim & ~inside] == 2).all()
    color = painter.color.numpy()[0]
    assert (color[inside & ~rim] > 0.2).all()


def test_fine_holes_leave_as_much_from_afar(device):
    """A quarter of a card is opaque in dots below a pixel; plain averages would be holes everywhere."""
    alpha = np.zeros((512, 512), np.uint8)
    rng = np.random.default_rng(0)
    alpha[rng.random((512, 512)) < 0.25] = 255
    for away in (0.0, 6.0):
        corners = quad()[0] + [0.0, away, 0.0]
        whole, holed = (
            paint(device, [card(corners, opacity)], ground=NIGHT, samples=4).color.numpy()[0].mean(-1)
            for opacity in (np.full_like(alpha, 255), alpha)
        )
        shown = whole > 0.5 * whole.max()
        assert 0.15 < holed[shown].mean() / whole[shown].mean() < 0.3


def test_levels_keep_the_opaque_share():
    rng = np.random.default_rng(1)
    alpha = (255 * rng.random((64, 64)) ** 3).astype(np.uint8)
    for cutoff in (0.1, 0.5, 0.9, 1.5):
        levels = alpha_levels(alpha, cutoff, 64)
        share, first = (alpha >= 255 * cutoff).mean(), 0
        for side in (64, 32, 16, 8, 4, 2, 1):
            level = levels[first : first + side * side]
            assert (
                abs((level >= OPAQUE).mean() - share) <= 0.5 / side**2 + 0.005
            )  # equal values of a level are all above or all below
            first += side * side
        assert first == len(levels)


def test_pictures_of_a_batch_have_the_same_holes(device):
    corners, aside = (
        turned(0.3, (0.0, 0.0, 0.0)),
        Shot(np.array([1.0, -3.0, 1.2]), np.array([0.0, 0.0, 1.0]), 30.0, AHEAD.center),
    )
    both = paint(device, [card(corners, disc())], (AHEAD, aside), ground=NIGHT).picture.numpy()
    for shot, picture in zip((AHEAD, aside), both, strict=True):
        assert np.array_equal(paint(device, [card(corners, disc())], (shot,), ground=NIGHT).picture.numpy()[0], picture)


def test_an_opacity_of_another_size_is_refused():
    with pytest.raises(ValueError, match="one value per pixel"):
        Texture(np.zeros((4, 4, 3), np.uint8), alpha=np.zeros((4, 5), np.uint8))
