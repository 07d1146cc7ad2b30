"""The solver of cloth against theory: stretch, swings, bending, friction, air, momentum and energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares
from scipy.special import j0, jn_zeros

from piavatar_envs.mpm.colliders import Collider, make_boundaries
from tests.cloth.sheets import LINEN, Run, flat_sheet, garment, hanging_sheet, plane, surfaces

G = 9.81


@pytest.mark.parametrize(("stretch", "settings"), [(50.0, {}), (200.0, {"substeps": 30, "sweeps": 8})])
def test_a_hanging_sheet_stretches_by_its_weight_and_rests(stretch, settings):
    """Check the mean strain ``sigma g L / (2 E h)``; stiffer cloth needs more sweeps to converge."""
    points, faces, top = hanging_sheet(0.3, 0.5, 0.03)
    sheet = garment(points, faces, replace(LINEN, stretch=stretch, drag=0.6), held=top)
    run = Run(sheet, **settings).steps(120)
    hem = points[:, 2] < -0.5 + 1e-6
    longer = (points[hem, 2] - run.get()[hem, 2]).mean() / 0.5
    assert longer == pytest.approx(0.2 * G * 0.5 / (2.0 * stretch), rel=0.04)
    assert run.speed() < 1e-3


@pytest.mark.parametrize(("mode", "frequency", "damping"), [(1, 0.01, 0.01), (2, 0.01, 0.025), (3, 0.03, 0.03)])
def test_a_hanging_sheet_swings_as_a_chain(mode, frequency, damping):
    """Check against the modes of a hanging chain, ``J0(j_n sqrt(s / L))`` with ``omega = j_n / 2 sqrt(g / L)``."""
    height, amplitude = 0.5, 0.015
    points, faces, top = hanging_sheet(0.2, height, 0.025)
    run = Run(garment(points, faces, held=top)).steps(60)
    zero = jn_zeros(0, mode)[-1]
    omega = zero / 2 * np.sqrt(G / height)
    shape = j0(zero * np.sqrt(np.clip(1.0 + points[:, 2] / height, 0.0, 1.0)))
    rest = run.get()
    run.put(x=rest + amplitude * shape[:, None] * [0.0, 1.0, 0.0], v=np.zeros(3))
    weight = run.cloth.mesh.area * shape
    time = np.arange(int(np.ceil(6 * 2 * np.pi / omega * 30))) / 30
    swing = np.zeros(len(time))
    for n in range(len(time)):
        swing[n] = weight @ (run.get() - rest)[:, 1] / (weight @ shape)
        run.steps(1)

    def error(p):
        return p[0] * np.exp(-p[1] * time) * np.cos(p[2] * time + p[3]) - swing

    starts = ([amplitude, decay * omega, part * omega, 0.0] for decay in (0.01, 0.1) for part in (0.8, 1.0, 1.2))
    found = min((least_squares(error, start) for start in starts), key=lambda result: result.cost).x
    assert abs(found[2]) == pytest.approx(omega, rel=frequency)
    assert 0.0 <= found[1] / abs(found[2]) < damping


def test_an_overhang_bends_as_peirce_measured():
    """Check the chord of an overhang of length L: ``c = L (cos(a / 2) / (8 tan a))^(1/3)`` (Peirce 1930)."""
    c, spacing = 0.05, 0.03
    row = spacing * np.sqrt(0.75)
    sheet, faces = flat_sheet(0.3, 6 * row, spacing)
    points = np.c_[sheet[:, 1] - sheet[:, 1].min(), sheet[:, 0], np.zeros(len(sheet))]
    held = np.flatnonzero(points[:, 0] < 2.5 * row)
    stiff = replace(LINEN, bending=0.2 * G * c**3, drag=0.6, skin_drag=0.02)
    settings = {"substeps": 30, "sweeps": 8, "forces_every": 1, "damping": 2e-3}
    run = Run(garment(points, faces, stiff, held=held), **settings).steps(200)
    tip = run.get()[points[:, 0] > points[:, 0].max() - 1e-6].mean(axis=0) - [2 * row, 0.0, 0.0]
    length = 4.5 * row  # it is clamped half a row in
    angle = brentq(lambda a: (np.cos(a / 2) / (8 * np.tan(a))) ** (1 / 3) - c / length, 1e-3, 1.5)
    assert np.degrees(np.arctan2(-tip[2], tip[0])) == pytest.approx(np.degrees(angle), abs=4.0)
    assert run.speed() < 1e-3


@pytest.mark.parametrize("on", ["skin", "floor"])
@pytest.mark.parametrize(("friction", "degrees"), [(0.3, 20.0), (0.3, 15.0), (0.5, 35.0), (0.5, 25.0)])
def test_a_sheet_slides_down_an_incline_by_coulombs_law(on, friction, degrees):
    angle = np.radians(degrees)
    points, faces = flat_sheet(0.2, 0.2, 0.05, z=0.004)
    worn = {"wearer": 0} if on == "skin" else {}
    sheet = garment(points, faces, replace(LINEN, friction=friction), **worn)
    run = Run(
        sheet,
        obstacles=surfaces(plane(1.5)) if on == "skin" else None,
        boundaries=make_boundaries([Collider.plane((0, 0, 1), 0.0)], 1, 1, "cpu") if on == "floor" else None,
        gravity=(G * np.sin(angle), 0.0, -G * np.cos(angle)),
    ).steps(6)
    before = run.get("v").mean(axis=0)[0]
    gained = (run.steps(9).get("v").mean(axis=0)[0] - before) / 0.3
    slides = G * (np.sin(angle) - friction * np.cos(angle))
    if slides > 0.0:
        assert gained == pytest.approx(slides, rel=1e-3)
    else:
        assert np.abs(run.get() - points).max() < 1e-6


def test_air_slows_a_sheet_as_quadratic_drag_does():
    points, faces = flat_sheet(0.2, 0.2, 0.05)
    airy = garment(points, faces, replace(LINEN, drag=0.6, bending=2e-5))
    run = Run(airy, gravity=(0.0, 0.0, 0.0)).put(v=[0.0, 0.0, -3.0]).steps(1)
    assert -run.get("v")[:, 2].mean() == pytest.approx(3.0 / (1.0 + 0.6 / 0.2 * 3.0 / 30.0), rel=1e-3)
    falls = Run(airy).steps(60)
    assert -falls.get("v")[:, 2].mean() == pytest.approx(np.sqrt(G * 0.2 / 0.6), rel=1e-3)
    blown = Run(airy, gravity=(0.0, 0.0, 0.0), wind=(0.0, 0.0, 3.0)).steps(1)
    assert blown.get("v")[:, 2].mean() == pytest.approx(3.0 - 3.0 / (1.0 + 0.6 / 0.2 * 3.0 / 30.0), rel=1e-3)


def test_free_cloth_keeps_its_momentum_and_gains_no_energy():
    points, faces = flat_sheet(0.4, 0.4, 0.03)
    run = Run(garment(points, faces), gravity=(0.0, 0.0, 0.0))
    mesh, rng = run.cloth.mesh, np.random.default_rng(0)
    wave = 0.3 * (np.sin(9 * points[:, 0]) + np.cos(7 * points[:, 1]))[:, None] * [0, 0, 1]
    v = np.cross([0.0, 0.0, 4.0], points) + [0.3, 0.1, 0.0] + wave + rng.normal(0.0, 0.05, points.shape)
    run.put(v=v)
    stiffness = LINEN.stretch * mesh.edge_area / mesh.length**2

    def energy() -> float:
        stretched = mesh.strain(run.get()) * mesh.length
        return 0.5 * (run.mass @ (run.get("v") ** 2).sum(axis=1)) + 0.5 * (stiffness @ stretched**2)

    momentum, start = run.momentum()[0], energy()
    most = max(energy() for _ in range(60) if run.steps(1))
    size = run.mass @ np.linalg.norm(v, axis=1)
    assert np.abs(run.momentum()[0] - momentum).max() < 1e-6 * size
    assert most <= start
