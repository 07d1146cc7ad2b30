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
    """Smooth random velocities, physical and prescribed, from one seed an environment."""
    draws = [np.random.default_rng(seed).normal(size=(4, 3)) for seed in seeds]
    u = np.stack([d[0] + np.sin(20.0 * sim.rest) * d[1] for d in draws])
    vk = np.stack([0.3 * np.cos(15.0 * sim.rest) * d[2] for d in draws])
    return sim.set(u=u, vk=vk)


def assert_same(got, expected):
    for array in ARRAYS:
        assert np.array_equal(got[array], expected[array]), array


def test_three_environments_equal_three_single_ones(simulate):
    batch = start(simulate(num_envs=3, **SCENE), (5, 6, 7)).run(3)
    assert batch.failures == [0, 0, 0]
    impulses = batch.scratch.sensors.boundary_impulse.numpy()[:, 0]
    assert np.all(impulses[:, 2] > 0.1)  # each has hit the ground
    for env, seed in enumerate((5, 6, 7)):
        single = start(simulate(num_envs=1, **SCENE), (seed,)).run(3)
        got = {name: batch.state.numpy()[name][env : env + 1] for name in ARRAYS}
        assert_same(got, single.state.numpy())
        assert impulses[env] == pytest.approx(single.scratch.sensors.boundary_impulse.numpy()[0, 0], rel=1e-5, abs=1e-5)


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


def test_each_environment_has_its_own_constants(simulate):
    """Arrays with a row an environment: environment i is the single one with row i."""
    points = random_points(3, 1)
    batch = start(simulate(num_envs=3, points=points, **SCENE), (5, 5, 5)).run(3)
    finals = []
    for env in range(3):
        given = {name: value for name, value in vars(points).items() if value is not None}
        row = MaterialPoints(**{name: value[env : env + 1] for name, value in given.items()})
        single = start(simulate(points=row, **SCENE), (5,)).run(3)
        finals.append(single.state.numpy())
        got = {name: batch.state.numpy()[name][env : env + 1] for name in ARRAYS}
        assert_same(got, finals[-1])
    assert np.abs(finals[0]["x"] - finals[1]["x"]).max() > 1e-3  # the constants do matter


@pytest.mark.parametrize("name", ["volume", "density", "young_modulus", "poisson_ratio", "material"])
def test_constants_with_one_row_are_shared(simulate, name):
    """One row serves all environments, whichever the array, next to arrays with a row an environment."""
    points = vars(random_points(3, 2))
    mixed = MaterialPoints(**(points | {name: points[name][:1]}))
    spread = MaterialPoints(**(points | {name: np.repeat(points[name][:1], 3, axis=0)}))
    runs = [start(simulate(num_envs=3, points=p, **SCENE), (5, 6, 7)).run().state.numpy() for p in (mixed, spread)]
    assert_same(*runs)


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
    """25 substeps in one graph equal 25 graphs of one, which activate their blocks each time."""
    whole = start(simulate(**SCENE), (1,)).run(2)
    split = start(simulate(**{**SCENE, "num_substeps": 1}, control_dt=whole.model.step.dt), (1,)).run(50)
    for array in ARRAYS:
        assert np.allclose(split.state.numpy()[array], whole.state.numpy()[array], atol=1e-3)


def test_timed_reports_every_kernel(simulate):
    sim = simulate(**SCENE)
    seconds = sim.graph.timed(1)
    once = {"deactivate_blocks", "reset_active_blocks", "activate_particle_blocks", "freeze", "read_impulses"}
    tiled = sim.model.path == "tiled"
    each = {"tiled_p2g" if tiled else "p2g", "update_grid", "tiled_g2p" if tiled else "g2p"}
    if sim.model.path == "block":
        once |= {"reset_speeds"}
        each = {"substep_in_large_arena"}
    assert set(seconds) == once | each
    assert all(value > 0.0 for value in seconds.values())
    activation = {"deactivate_blocks", "reset_active_blocks", "activate_particle_blocks"}
    activations = 4  # before substeps 0, 8, 16 and 24
    assert len(sim.graph) == len(once - activation) + activations * len(activation) + len(each) * 25
