"""The benchmark of Cholesky factors: systems that are a body's, errors that are found, failures that are told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import cholesky
from benchmarks.cholesky import CUSOLVER, PLAIN, Options, make_systems
from piavatar_envs.avatar.cholesky import find_pattern
from piavatar_envs.avatar.lanes import warp_threads
from piavatar_envs.avatar.mass_matrix import NUM_DOF

TIMES = ("factorise_us", "solve_us", "together_us")


@pytest.fixture(scope="module")
def systems():
    return make_systems(5)


@pytest.fixture
def options(device: str) -> Options:
    return Options(device=device, num_envs=5, repeats=2, block_dims=(32,), rows=(72,))


def test_all_solve_the_same_systems_to_round_off(options):
    ours, *tiles = cholesky.cases(options)
    assert ours["case"] == "ours" and {row["case"] for row in tiles} == {"warp_tile"}
    assert [(row["solver"], row["rows"]) for row in tiles] == [(CUSOLVER, 72), (PLAIN, 72)]
    for row in (ours, *tiles):
        if row.get("solver") == CUSOLVER and options.device == "cpu":
            assert row["failed"] == "cuSolverDx is for GPUs" and not set(TIMES) & set(row)
            continue
        assert "failed" not in row and min(row[name] for name in TIMES) > 0.0
        assert 0.0 < row["largest_error"] < 1e-4 and 0.0 < row["largest_residual"] < 1e-4


def test_matrices_are_a_body_s(systems):
    whole = systems.matrix.astype(float)
    assert np.linalg.eigvalsh(whole).min() > 0.0
    np.testing.assert_allclose(whole[:, :3, :3], np.tile(60.0 * np.eye(3), (5, 1, 1)), atol=30.0)  # its mass [kg]
    empty = ~systems.filled
    assert 0.2 < empty.mean() < 0.6 and not whole[:, empty].any()
    assert whole.shape == (5, NUM_DOF, NUM_DOF) and (np.ptp(whole, axis=0).max(0) > 0.0).sum() > 60  # poses differ


def test_our_factors_take_a_fifth_of_the_updates_of_dense_ones(systems):
    steps = find_pattern(systems.filled.copy(), "cpu").step.numpy()
    before = steps[steps[:, 3] == 0, 2]
    ours = (before[:, None] + np.arange(3)).ravel()
    updates = [int((count * (count + 1) // 2).sum()) for count in (ours, np.arange(NUM_DOF))]
    assert updates[0] == pytest.approx(0.2 * updates[1], rel=0.05)


def test_wrong_solutions_are_found(systems):
    exact = systems.errors(systems.solution)
    assert max(exact.values()) < 1e-9
    wrong = systems.solution.copy()
    wrong[3, 40] += 0.01 * np.abs(wrong[3]).max()
    assert systems.errors(wrong)["largest_error"] == pytest.approx(0.01)
    without = replace(systems, diagonal=np.zeros_like(systems.diagonal))
    assert without.errors(systems.solution)["largest_residual"] > 0.1


def test_what_cannot_be_built_says_why(systems, options, monkeypatch):
    def refuse(rows: int, cusolver: bool):
        raise RuntimeError("Failed to compile LTO 'potrf_72'")

    monkeypatch.setattr(cholesky, "tile_kernels", refuse)
    row = cholesky.measure_tiles(systems, options, 72, warp_threads(options.device), cusolver=False)
    assert row["failed"] == "RuntimeError: Failed to compile LTO 'potrf_72'" and not set(TIMES) & set(row)
    with pytest.raises(ValueError, match="rows=66 must be >= 69"):
        cholesky.measure_tiles(systems, options, 66, 32, cusolver=False)


def test_solutions_that_are_none_have_no_times(systems, options):
    broken = replace(systems, matrix=-systems.matrix)
    row = cholesky.measure_tiles(broken, options, 72, warp_threads(options.device), cusolver=False)
    assert row["failed"].startswith("ArithmeticError: ") and not set(TIMES) & set(row)
