"""Many environments equal one, each with its own constants; a replayed graph equals launches one by one."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.mpm.materials import MATERIALS
from piavatar_envs.mpm.model import MaterialPoints

ARRAYS = ("x", "u", "C", "F")
SCENE = {"gravity": (0.0, 0.0, -9.81), "planes": [((0.1, 0.0, 1.0), -0.11, 0.5)], "num_substeps": 25, "margin": 0.3}
COUNT = 512


def start(sim, seeds):
    """Set smooth random velocities, physical and prescribed, from one seed per environment."""
    draws = [np.random.default_rng(seed).normal(size=(4, 3)) for seed in seeds]
    u = np.stack([d[0] + np.sin(20.0 * sim.rest) * d[1] for d in draws])
    vk = np.stack([0.3 * np.cos(15.0 * sim.rest) * d[2] for d in draws])
    return sim.set(u=u, vk=vk)


def assert_same(got, expected):
    for array in ARRAYS:
        assert np.array_equal(got[array], expected[array]), array


def random_points(rows, seed):
    rng = np.random.default_rng(seed)
    shape = (rows, COUNT)
    return MaterialPoints(
        volume=0.025**3 * rng.uniform(0.8, 1.2, shape),
        density=rng.uniform(800.0, 1200.0, shape),
        young_modulus=rng.uniform(1e4, 1e5, shape),
        poisson_ratio=rng.uniform(0.1, 0.35, shape),
        material=rng.integers(0, len(MATERIALS), shape),
    )


@pytest.mark.parametrize("shared", [(), ("volume", "density"), ("young_modulus", "poisson_ratio", "material")])
def test_environments_equal_single_ones_of_their_constants(simulate, shared):
    # Environment i is the single one with row i of the constants, or with the one row that all share.
    points = {name: value for name, value in vars(random_points(3, 1)).items() if value is not None}
    points |= {name: points[name][:1] for name in shared}
    batch = start(simulate(num_envs=3, points=MaterialPoints(**points), **SCENE), (5, 6, 7)).run(3)
    assert batch.failures == [0, 0, 0]
    impulses = batch.scratch.sensors.boundary_impulse.numpy()[:, 0]
    assert np.all(impulses[:, 2] > 0.1)  # each has hit the ground
    for env, seed in enumerate((5, 6, 7)):
        rows = {name: value[min(env, len(value) - 1)][None] for name, value in points.items()}
        single = start(simulate(points=MaterialPoints(**rows), **SCENE), (seed,)).run(3)
        got = {name: batch.state.numpy()[name][env : env + 1] for name in ARRAYS}
        assert_same(got, single.state.numpy())
        assert impulses[env] == pytest.approx(single.scratch.sensors.boundary_impulse.numpy()[0, 0], rel=1e-5, abs=1e-5)


def test_constants_matter(simulate):
    runs = [start(simulate(points=random_points(1, seed), **SCENE), (5,)).run(3).get("x") for seed in (1, 2)]
    assert np.abs(runs[0] - runs[1]).max() > 1e-3


def test_wrong_number_of_rows_is_refused(simulate):
    with pytest.raises(ValueError, match=r"young_modulus.*2.*1 or 3"):
        points = vars(random_points(1, 3)) | {"young_modulus": np.full((2, COUNT), 1e5)}
        simulate(num_envs=3, points=MaterialPoints(**points), **SCENE)


def test_captured_graph_equals_eager_launches(simulate):
    replayed = start(simulate(num_envs=2, **SCENE), (1, 2)).run(2)
    eager = start(simulate(num_envs=2, **SCENE), (1, 2))
    for _ in range(2):
        eager.graph.run_eager()
    assert_same(replayed.state.numpy(), eager.state.numpy())


def test_substeps_equal_control_steps(simulate):
    # 25 substeps in one graph equal 25 graphs of one, which activate their blocks each time.
    whole = start(simulate(**SCENE), (1,)).run(2)
    split = start(simulate(**{**SCENE, "num_substeps": 1}, control_dt=whole.model.step.dt), (1,)).run(50)
    for array in ARRAYS:
        assert np.allclose(split.state.numpy()[array], whole.state.numpy()[array], atol=1e-3)
