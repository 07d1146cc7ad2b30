"""Cloth as a thin shell in MPM: its stress, sheets against theory, momentum, energy and batches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from benchmarks.garments import theory
from benchmarks.garments.sheets import LINEN, flat_sheet, garment, hanging_sheet
from benchmarks.garments.shells import ShellRun
from piavatar_envs.cloth.shell import hold_weights
from piavatar_envs.cloth.shell_energy import energy, frame_of, map_director, stress_of, wave_speed
from piavatar_envs.mpm.diagnostics import totals
from tests.gpu_on_cpu import gpu_on_cpu

STRETCH, FRICTION = 200.0, 0.4
WEIGHTLESS = (0.0, 0.0, 0.0)


@wp.kernel
def stresses(
    f1: wp.array(dtype=wp.vec3),
    f2: wp.array(dtype=wp.vec3),
    d: wp.array(dtype=wp.vec3),
    mapped: wp.array(dtype=wp.vec3),
    p: wp.array2d(dtype=wp.vec3),
):
    n = wp.tid()
    s = frame_of(f1[n], f2[n])
    mapped[n] = map_director(s, d[n], 0.4)
    stress = stress_of(s, wp.vec3(wp.dot(s.q1, d[n]), wp.dot(s.q2, d[n]), wp.dot(s.q3, d[n])), 200.0)
    p[n, 0] = stress.p1
    p[n, 1] = stress.p2
    p[n, 2] = stress.p3


def evaluated(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mapped directors in their frames, and the stresses ``(N, 3 columns, 3)`` of ``(N, 3 columns, 3)``."""
    given = [wp.array(columns[:, k].astype(np.float32), dtype=wp.vec3) for k in range(3)]
    mapped, p = wp.zeros(len(columns), dtype=wp.vec3), wp.zeros((len(columns), 3), dtype=wp.vec3)
    wp.launch(stresses, len(columns), inputs=[*given, mapped, p])
    return mapped.numpy(), p.numpy().astype(float)


def strained(count: int = 40) -> np.ndarray:
    """Return random columns of deformation gradients, turned at will, with pressed and sheared directors."""
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))[:, None, None]
    F = np.eye(3) + rng.uniform(-0.2, 0.2, (count, 3, 3))
    F[:, 2, :2], F[:, 2, 2] = 0.0, rng.uniform(0.4, 0.95, count)
    return np.swapaxes(turn @ F, 1, 2)


def test_the_stress_is_the_derivative_of_the_energy_and_makes_no_couple():
    columns = strained()
    stress = evaluated(columns)[1]
    h = 1e-6
    for k in range(3):
        for axis in range(3):
            more, less = columns.copy(), columns.copy()
            more[:, k, axis] += h
            less[:, k, axis] -= h
            slope = (energy(*np.moveaxis(more, 1, 0), STRETCH) - energy(*np.moveaxis(less, 1, 0), STRETCH)) / (2 * h)
            np.testing.assert_allclose(stress[:, k, axis], slope, atol=1e-3 * np.abs(stress).max())
    tau = np.einsum("nki,nkj->nij", stress, columns)
    np.testing.assert_allclose(tau, np.swapaxes(tau, 1, 2), atol=1e-5 * np.abs(tau).max())


def test_the_director_pulls_at_nothing_and_its_shear_obeys_coulomb():
    columns = strained()
    columns[::2, 2] *= -1.5 * np.sign(np.linalg.det(columns[::2]))[:, None] * -1.0
    mapped = evaluated(columns)[0]
    normal = np.cross(columns[:, 0], columns[:, 1])
    apart = (columns[:, 2] * normal).sum(axis=1) >= np.linalg.norm(normal, axis=1)
    assert 3 < apart.sum() < len(columns) - 3
    np.testing.assert_array_equal(mapped[apart], np.broadcast_to([0.0, 0.0, 1.0], (apart.sum(), 3)))
    shear, pressed = np.linalg.norm(mapped[~apart, :2], axis=1), 1.0 - mapped[~apart, 2]
    assert (0.1 * shear <= FRICTION * 0.5 * pressed**2 * (1.0 + 1e-5)).all() and (pressed <= 1.0).all()


@pytest.mark.parametrize("stretch", [50.0, 200.0])
def test_a_hanging_sheet_stretches_as_theory_has_it(stretch):
    points, faces, top = hanging_sheet(0.15, 0.4, 0.04)
    hem = points[:, 2] < -0.4 + 1e-6
    sheet = garment(points, faces, replace(LINEN, stretch=stretch), held=top)
    run, longer = ShellRun(sheet, dx=0.06, margin=0.2), []
    for _ in range(60):  # it bounces about its rest
        run.steps(1)
        longer.append((points[hem, 2] - run.get()[hem, 2]).mean() / 0.4)
    assert np.mean(longer) == pytest.approx(theory.hanging_stretch(LINEN.areal_density, stretch, 0.4), rel=0.04)
    assert np.abs(run.get()[:, 1]).max() < 1e-6


def test_free_fall_is_exact_and_a_flying_sheet_keeps_momentum_and_energy():
    points, faces = flat_sheet(0.3, 0.3, 0.04)
    falls = ShellRun(garment(points, faces), dx=0.06).steps(3)
    assert falls.get("v")[:, 2] == pytest.approx(-9.81 * 0.1, rel=1e-5)
    assert np.abs(falls.cloth.mesh.strain(falls.get())).max() < 1e-5
    run = ShellRun(garment(points, faces), dx=0.06, gravity=WEIGHTLESS)
    wave = 0.3 * np.sin(9 * points[:, 0])[:, None] * [0.0, 0.0, 1.0]
    run.put(v=np.cross([0.0, 1.0, 4.0], points) + [0.3, 0.1, 0.0] + wave).steps(1)
    before = totals(run.model, run.state)
    after = totals(run.model, run.steps(8).state)
    assert np.abs(after.momentum - before.momentum).max() < 1e-6 * before.momentum_scale
    # triangles move with their corners, which the grid moves by the same field up to its curvature
    assert after.angular_momentum == pytest.approx(before.angular_momentum, rel=1e-4, abs=1e-6)
    assert 0.98 * before.kinetic < after.kinetic < 1.0001 * before.kinetic


def test_a_sheet_that_turns_as_a_whole_keeps_its_energy():
    points, faces = flat_sheet(0.3, 0.3, 0.04)
    run = ShellRun(garment(points, faces), dx=0.06, gravity=WEIGHTLESS)
    run.put(v=np.cross([0.0, 0.0, 3.0], points)).steps(1)
    start = totals(run.model, run.state).kinetic
    run.steps(15)  # by 1.5 rad
    assert totals(run.model, run.state).kinetic == pytest.approx(start, rel=2e-3)
    assert np.abs(run.cloth.mesh.strain(run.get())).max() < 1e-3


def test_a_batch_is_its_singles_and_runs_repeat(device):
    points, faces, top = hanging_sheet(0.15, 0.15, 0.05)

    def flutter(starts, steps=4):
        run = ShellRun(
            garment(points, faces, replace(LINEN, bending=2e-5, drag=0.6), held=top), dx=0.06, margin=0.2,
            num_envs=len(starts), device=device, wind=(0.0, 2.0, 0.0), substeps=44,
        )  # fmt: skip
        u = run.state.u.numpy()
        u[..., 1] += np.array(starts)[:, None]
        run.state.u.assign(u)
        return run.steps(steps)

    def results(run, e):
        arrays = [*run.cloth.arrays().values(), run.state.x, run.state.u, run.state.C]
        return [array.numpy()[e].tobytes() for array in arrays]

    starts = (0.0, 0.4, 0.8)
    batch, again = flutter(starts), flutter(starts)
    assert not batch.state.failure.numpy().any() and results(batch, 0) != results(batch, 1)
    for e, start in enumerate(starts):
        assert results(batch, e) == results(flutter([start]), 0) == results(again, e)


def test_a_gpu_does_the_same_up_to_rounding():
    points, faces, top = hanging_sheet(0.15, 0.15, 0.05)
    sheet = garment(points, faces, replace(LINEN, drag=0.6), held=top)
    with gpu_on_cpu() as device:
        emulated = ShellRun(sheet, dx=0.06, margin=0.2, device=device).steps(2)
        found = emulated.get()
    plain = ShellRun(sheet, dx=0.06, margin=0.2).steps(2)
    assert np.abs(found - plain.get()).max() < 1e-5 and np.abs(plain.get() - points).max() > 1e-4


def test_too_stiff_cloth_and_too_long_edges_are_refused_with_a_remedy():
    points, faces, top = hanging_sheet(0.15, 0.15, 0.05)
    stiff = replace(LINEN, stretch=2e4)
    assert wave_speed(stiff.areal_density, stiff.stretch) == pytest.approx(335.4, rel=1e-3)
    with pytest.raises(ValueError, match=r"c=335 m/s.*num_substeps >= "):
        ShellRun(garment(points, faces, stiff, held=top), dx=0.06, margin=0.2, substeps=20)
    with pytest.raises(ValueError, match=r"edges of a sheet are \d+ mm.*`edge`"):
        ShellRun(garment(points, faces, held=top), dx=0.02, margin=0.2, substeps=100)


def test_held_vertices_follow_any_affine_motion_of_their_wearer():
    rng = np.random.default_rng(0)
    particles, places = rng.uniform(0.0, 0.3, (200, 3)), rng.uniform(0.0, 0.35, (10, 3))
    weights = hold_weights(places, particles)
    A, b = rng.normal(size=(3, 3)), rng.normal(size=3)
    np.testing.assert_allclose(weights @ (particles @ A.T + b), places @ A.T + b, atol=1e-9)
    assert np.abs(weights).max() < 1.0
