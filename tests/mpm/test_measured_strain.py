"""Strain measured against the rest shape: exact for uniform deformation; hourglass modes fade, the centre stays."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree

from piavatar_envs.core.arrays import components_of, matrices_of
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.measured_strain import RATE, MeasuredStrain
from piavatar_envs.mpm.memory import allocate
from piavatar_envs.mpm.model import MaterialPoints, build_model, make_grid

SPACING, FIRST = 0.1, 4  # other matter comes first


@pytest.fixture
def matter(device):
    """Return model, state, the measured strain of its last particles, and these at rest ``(1, count)``."""
    line = SPACING * np.arange(4)
    rest = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    rest += np.random.default_rng(0).uniform(-0.01, 0.01, rest.shape)
    volume = np.random.default_rng(1).uniform(0.5, 1.5, FIRST + len(rest)) * SPACING**3
    model = build_model(
        MaterialPoints.uniform(volume), make_grid((-2.0,) * 3, (2.0,) * 3, SPACING), num_envs=2, device=device
    )
    links = cKDTree(rest).query_pairs(1.8 * SPACING, output_type="ndarray").astype(np.int32)
    at_rest = wp.array(rest[None].astype(np.float32), dtype=wp.vec3, device=device)
    return model, allocate(model)[0], MeasuredStrain(model, links, FIRST, len(rest)), at_rest


def deform(state, at_rest, gradient, noise, F):
    """Put the matter of both environments where ``gradient`` leads, plus ``noise``, with the same ``F`` everywhere."""
    x = np.zeros((*state.x.shape, 3), np.float32)
    x[:, FIRST:] = at_rest.numpy() @ gradient.T + noise
    state.x.assign(x)
    state.F.assign(components_of(np.broadcast_to(F.astype(np.float32), (*state.x.shape, 3, 3))))


def run(matter, steps):
    """Return positions and deformation gradients after the ends of control steps."""
    model, state, measured, at_rest = matter
    graph = LaunchGraph(model.device)
    measured.record(graph, state, at_rest, at_rest)
    for _ in range(steps):
        graph.run()
    return state.x.numpy()[:, FIRST:].copy(), matrices_of(state.F.numpy())[:, FIRST:]


GRADIENT = np.array([[1.003, 0.002, 0.0], [0.0, 0.998, 0.001], [-0.001, 0.0, 1.001]])


def test_uniform_deformation_is_found(matter):
    model, state, _, at_rest = matter
    deform(state, at_rest, GRADIENT, 0.0, np.eye(3))
    _, F = run(matter, 1)
    strain = 0.5 * (GRADIENT.T @ GRADIENT - np.eye(3))
    share = -np.expm1(-RATE * model.control_dt) * (1.0 - np.linalg.norm(strain) / 0.1)
    assert np.abs(F - np.eye(3) - share * (GRADIENT - np.eye(3))).max() < 1e-6


def test_uniform_deformation_moves_nothing(matter):
    _, state, _, at_rest = matter
    deform(state, at_rest, GRADIENT, 0.0, GRADIENT)
    before = state.x.numpy()[:, FIRST:].copy()
    x, F = run(matter, 30)
    assert np.abs(x - before).max() < 1e-6
    assert np.abs(F - GRADIENT).max() < 1e-5


def test_hourglass_modes_fade_and_the_centre_stays(matter):
    model, state, _, at_rest = matter
    rng = np.random.default_rng(2)
    noise = 1e-3 * rng.standard_normal((2, at_rest.shape[1], 3)).astype(np.float32)
    deform(state, at_rest, np.eye(3), noise, np.eye(3))
    mass = model.particles.mass.numpy()[0, FIRST:].astype(float)
    before = state.x.numpy()[:, FIRST:].copy()
    x, _ = run(matter, round(4.0 / RATE / model.control_dt))
    assert np.abs(np.tensordot(x.astype(float) - before, mass, (1, 0)) / mass.sum()).max() < 1e-7

    def rough(positions):
        """Return the root mean square of what no neighbours share [m]."""
        away = positions - at_rest.numpy()
        tree = cKDTree(at_rest.numpy()[0])
        around = tree.query_ball_point(at_rest.numpy()[0], 1.8 * SPACING)
        return np.sqrt(np.mean([(away[:, p] - away[:, a].mean(axis=1)) ** 2 for p, a in enumerate(around)]))

    assert rough(x) < 0.4 * rough(before)
