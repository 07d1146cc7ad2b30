"""Batches of cloth: bit for bit their singles, in any order of threads; failed environments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from benchmarks.garments.sheets import LINEN, Run, flat_sheet, garment, hanging_sheet, move, sphere, surfaces
from piavatar_envs.cloth import kernels
from piavatar_envs.cloth.solver import bytes_of_cloth
from piavatar_envs.mpm.colliders import Collider, make_boundaries
from piavatar_envs.mpm.types import FAILURE_CLOTH
from tests.gpu_on_cpu import gpu_on_cpu

#: Places of the balls that sheets fall on, one per environment [m].
STARTS = (0.0, 0.03, 0.06)


def fall(starts, device: str = "cpu", steps: int = 12) -> Run:
    """Let two sheets fall on two balls, the second piece another's, and a floor; every ball moves its own way."""
    ball = sphere(0.08, rings=5)
    o = surfaces(ball, ball, num_envs=len(starts), device=device)
    points, faces = flat_sheet(0.2, 0.2, 0.04, z=0.09)
    fabric = replace(LINEN, bending=2e-5, drag=0.6, skin_drag=0.02)
    sheets = [
        garment(points + [0.02, 0.01, 0.01 * wearer], faces, fabric, wearer=wearer, thickness=0.004 + 0.002 * wearer)
        for wearer in range(2)
    ]
    floor = make_boundaries([Collider.plane((0, 0, 1), -0.02)], 1, 1, device)
    run = Run(*sheets, obstacles=o, boundaries=floor, num_envs=len(starts), device=device)
    middle = np.concatenate([ball[0], ball[0] + [0.1, 0.0, 0.0]])
    for n in range(steps):
        move(o, np.stack([middle + [start, 0.0, 0.002 * n * start / 0.03] for start in starts]))
        run.steps(1)
    return run


def results(run: Run, e: int) -> list[bytes]:
    """Return all that a control step has changed in an environment."""
    return [array.numpy()[e].tobytes() for array in (*run.cloth.arrays().values(), run.obstacles.impulse)]


def test_a_batch_is_its_singles_and_runs_repeat(device):
    batch = fall(STARTS, device)
    assert results(batch, 0) != results(batch, 1) and not batch.failure.numpy().any()
    again = fall(STARTS, device)
    for e, start in enumerate(STARTS):
        alone = fall([start], device)  # emulated, each launch begins in another order of threads
        assert results(batch, e) == results(alone, 0) == results(again, e)


def test_a_gpu_does_the_same_up_to_rounding():
    with gpu_on_cpu() as device:
        emulated = fall(STARTS[:2], device, steps=6)
        assert emulated.cloth.threads > 1
    plain = fall(STARTS[:2], steps=6)
    for e in range(2):
        for name, size in (("x", 1e-5), ("v", 1e-3)):
            assert np.abs(emulated.get(name, e) - plain.get(name, e)).max() < size
        books = [run.obstacles.impulse.numpy()[e].sum(axis=0)[:3] for run in (emulated, plain)]
        assert books[0] == pytest.approx(books[1], rel=1e-3, abs=1e-4 * np.abs(books[1]).max())


def test_a_failed_environment_is_frozen_and_one_that_is_not_finite_fails(device):
    points, faces, top = hanging_sheet(0.2, 0.2, 0.05)
    run = Run(garment(points, faces, held=top), num_envs=3, device=device)
    v = np.zeros((3, len(points), 3), np.float32)
    v[1, -1, 2] = np.nan
    run.put(v=v)
    run.failure.assign(np.array([0, 0, 4], np.int32))
    run.steps(2)
    assert run.failure.numpy().tolist() == [0, FAILURE_CLOTH, 4]
    assert np.array_equal(run.get("x", 2), points.astype(np.float32)) and np.isfinite(run.get("x", 0)).all()
    alone = Run(garment(points, faces, held=top), device=device).steps(2)
    assert run.get("x", 0).tobytes() == alone.get("x").tobytes()


def test_environments_may_have_their_own_fabric_and_lengths(device):
    points, faces, top = hanging_sheet(0.1, 0.2, 0.05)
    run = Run(garment(points, faces, replace(LINEN, stretch=20.0), held=top), num_envs=2, rows=2, device=device)
    fabric, cloth = run.cloth.fabric, run.cloth
    fabric.stretch.assign(np.array([[20.0], [40.0]], np.float32))
    fabric.areal_density.assign(np.array([[0.2], [0.4]], np.float32))
    cloth.length.assign(np.stack([cloth.mesh.length, 1.1 * cloth.mesh.length]).astype(np.float32))
    run.steps(60 if device == "cpu" else 2)
    assert cloth.mass[1] == pytest.approx(2.0 * cloth.mass[0])
    if device == "cpu":
        long = [-run.get("x", e)[:, 2].min() / 0.2 for e in range(2)]
        assert long[0] == pytest.approx(1.0 + 0.2 * 9.81 * 0.2 / 40.0, rel=5e-3)
        assert long[1] / long[0] == pytest.approx(1.1, rel=2e-3)  # twice the weight on twice the stiffness


@pytest.mark.parametrize("self_collision", [False, True])
def test_memory_of_an_environment_is_as_estimated(self_collision):
    points, faces = flat_sheet(0.3, 0.3, 0.03)
    o = surfaces(sphere(), num_envs=2)
    cloth = Run(garment(points, faces, wearer=0), obstacles=o, num_envs=2, self_collision=self_collision).cloth
    structs = cloth.state, cloth._workspace, cloth._touches, cloth._self_contacts
    arrays = [value for struct in structs for value in (getattr(struct, name) for name in struct._cls.vars)]
    used = sum(each.capacity for each in arrays if isinstance(each, wp.array))
    per_env = bytes_of_cloth(cloth.mesh, 1, self_collision, 2) - 4 * cloth.mesh.num_edges  # lengths are shared here
    assert used == pytest.approx(2 * per_env, rel=0.01)


def test_what_a_step_works_in_exists_once_for_environments_that_take_turns(monkeypatch):
    """A GPU takes as many environments at once as it has room for, a CPU takes one; results are the same."""
    with gpu_on_cpu() as device:
        at_once = fall(STARTS, device, steps=6)
        monkeypatch.setattr(kernels, "ROOM", 2.0 / 132)
        in_turns = fall(STARTS, device, steps=6)
        assert [len(run.cloth._touches.impulse) for run in (at_once, in_turns)] == [3, 2]
        for e in range(3):
            assert results(at_once, e) == results(in_turns, e)
    plain = fall(STARTS, steps=1).cloth
    assert len(plain._touches.impulse) == len(plain._workspace.correction) == 1
    sizes = [bytes_of_cloth(plain.mesh, 1, num_envs=count) for count in (1, 1000)]
    assert sizes[1] < 0.4 * sizes[0]


def test_a_step_reads_nothing_that_another_environment_has_left():
    def touching(left: float | None) -> Run:
        ball = sphere(0.08, rings=5)
        points, faces = flat_sheet(0.2, 0.2, 0.04, z=0.083)
        run = Run(garment(points, faces, wearer=0, thickness=0.004), obstacles=surfaces(ball)).steps(2)
        if left is not None:
            for struct in (run.cloth._workspace, run.cloth._touches):
                for value in (getattr(struct, name) for name in struct._cls.vars):
                    if isinstance(value, wp.array):
                        value.fill_(0 if value.dtype is wp.int32 else left)
        return run.steps(2)

    expected = results(touching(None), 0)
    assert touching(None).obstacles.impulse.numpy().any()
    assert results(touching(1.0), 0) == results(touching(np.nan), 0) == expected
