"""The benchmark of elastic bodies: its rows and its picture, at a resolution where that takes seconds."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.physics import elastodynamics


@pytest.fixture(scope="module")
def rows(device):
    if device != "cpu":
        pytest.skip("a smoke run; the benchmark itself runs on a GPU with --device")
    return list(elastodynamics.cases(elastodynamics.Options(quick=True)))


def test_rows_are_complete(rows):
    names = {row["case"] for row in rows}
    assert {"bar", "cantilever", "bar on wall", "bar on bar", "ball on plane", "ball on ball"} <= names
    assert all(np.isfinite(value) for row in rows for value in row.values() if isinstance(value, float))
    for row in rows:
        if "force_of_theory" in row:
            assert row["force_of_theory"].shape == row["time_of_duration"].shape
            # it turns in the middle; before and after they do not touch
            assert row["force_of_theory"].argmax() == pytest.approx(len(row["time_of_duration"]) // 2, abs=20)
            assert abs(row["force_of_theory"][[0, -1]]).max() < 0.05


def test_the_picture_is_drawn(rows, tmp_path):
    pytest.importorskip("matplotlib", reason="needs the extra train")
    elastodynamics.draw(rows, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 20_000
