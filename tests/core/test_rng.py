"""Random numbers: a draw depends on its four coordinates only, and none of them may fold into another."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

from piavatar_envs.core.rng import generator


@wp.kernel
def draw(coordinates: wp.array2d(dtype=int), out: wp.array2d(dtype=float)):
    n = wp.tid()
    random = generator(coordinates[n, 0], coordinates[n, 1], coordinates[n, 2], coordinates[n, 3])
    for i in range(out.shape[1]):
        out[n, i] = wp.randf(random)


def drawn(device, coordinates, count: int = 2) -> np.ndarray:
    coordinates = np.asarray(coordinates, np.int32)
    out = wp.zeros((len(coordinates), count), dtype=float, device=device)
    wp.launch(draw, len(coordinates), [wp.array(coordinates, dtype=int, device=device)], [out], device=device)
    return out.numpy()


def test_no_two_coordinates_draw_the_same(device):
    # Also far out: an offset packed into 32 bits repeats after some thousand episodes.
    seeds, episodes, indices = (0, 1, 2**31 - 1, -1), (0, 1, 4096, 8192, 16384, 10**6), (0, 1, 65535, 65536, 131072)
    values = drawn(device, list(itertools.product(seeds, episodes, range(3), indices)))
    assert len(np.unique(values, axis=0)) == len(values) == 360


def test_a_draw_does_not_depend_on_the_others(device):
    alone = drawn(device, [(5, 7, 1, 3)])
    together = drawn(device, [(5, 7, 1, n) for n in range(8)])
    assert np.array_equal(alone[0], together[3])


@pytest.mark.parametrize("varied", range(4))
def test_neighbouring_coordinates_are_uncorrelated_and_uniform(device, varied):
    # Kolmogorov-Smirnov and lag-one correlation of 20,000 draws, at three and a half standard errors or so.
    n = 20_000
    coordinates = np.tile(np.array([3, 1, 1, 2], np.int32), (n, 1))
    coordinates[:, varied] = np.arange(n)
    u = drawn(device, coordinates)
    for column in u.T:
        distance = np.abs(np.sort(column) - (np.arange(n) + 0.5) / n).max()
        assert distance < 2.0 / np.sqrt(n)
        assert abs(np.corrcoef(column[1:], column[:-1])[0, 1]) < 3.5 / np.sqrt(n)
    assert abs(np.corrcoef(u.T)[0, 1]) < 3.5 / np.sqrt(n)
