"""Contact sensors; batches, failures and the scratch of worlds with several bodies."""

from __future__ import annotations

import numpy as np
import pytest

DX = 0.05
ARRAYS = ("x", "u", "C", "F")
BLOCK = {"box": ((-0.15, -0.1, -0.1), (0.05, 0.1, 0.1))}
BALL = {"ball": ((0.16, 0.04, 0.03), 0.1), "velocity": (-4.0, 0.5, 0.0)}
CUBE = {"box": ((-0.2, -0.1, -0.1), (0.0, 0.1, 0.1))}


@pytest.mark.parametrize("normals", ["shared", "own"])
def test_impulses_are_the_changes_of_momentum(meet, normals):
    # On the pair, on the parts by subject, and on each body: Newton's third law at every moment.
    sim = meet([BLOCK, BALL], normals=normals, friction=0.3, control_dt=1.0 / 240.0)
    sensors, scale = sim.scratch.sensors, sim.totals().momentum_scale
    before, most = [sim.totals(select=sim.of(body)).momentum for body in range(2)], 0.0
    for _ in range(12):
        sim.run()
        after = [sim.totals(select=sim.of(body)).momentum for body in range(2)]
        change = np.subtract(after, before)
        parts = sensors.part_impulse.numpy()[0]
        assert np.abs(parts[0, 1] - change[0]).max() < 1e-5 * scale
        assert np.abs(parts[1, 0] - change[1]).max() < 1e-5 * scale
        assert not parts[0, 0].any() and not parts[1, 1].any()
        if normals == "shared":
            pairs = sensors.pair_impulse.numpy()[0].reshape(2, 2, 3)
            assert np.abs(pairs[0, 1] - change[0]).max() < 1e-5 * scale
            assert not pairs[1, 0].any()  # only a < b is kept
        before, most = after, max(most, np.abs(change).max())
    assert most > 0.05 * scale


@pytest.mark.parametrize(("overlap", "density"), [(-0.5, 500.0), (0.1, 2000.0), (0.4, 2000.0), (0.8, 500.0)])
def test_penetration_of_a_known_overlap(meet, overlap, density):
    # The centre of the deepest particle, a quarter of a spacing inside its body; the bodies are at rest.
    into = {"box": ((-overlap * DX, -0.1, -0.1), (0.2 - overlap * DX, 0.1, 0.1)), "density": density}
    sim = meet([CUBE, into], num_substeps=1, control_dt=1e-4).run()
    expected = max(0.0, overlap - 0.25) * DX
    found = sim.scratch.sensors.penetration.numpy()[0]
    np.testing.assert_allclose(found, expected, atol=0.15 * DX)
    assert overlap > 0.0 or not found.any()
    assert overlap < 0.2 or found.all()


@pytest.mark.parametrize("depth", [1.0, 1.6, 2.2])
@pytest.mark.parametrize("turn", [False, True])
def test_penetration_of_matter_deep_in_other_matter(meet, depth, turn):
    # A speck in a large cube or ball, at rest: its own particles are a quarter of a spacing apart from its middle.
    middle = np.array([0.2 - depth * DX, 0.013, 0.007])
    host = {"ball": ((0.0, 0.0, 0.0), 0.2)} if turn else {"box": ((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2))}
    if turn:  # half way between an axis and two diagonals of the ways that are tried
        middle = (0.2 - depth * DX) * np.array([0.88, 0.42, 0.22]) / np.linalg.norm([0.88, 0.42, 0.22])
    speck = {"box": (tuple(middle - 0.0124), tuple(middle + 0.0124))}
    sim = meet([host, speck], num_substeps=1, control_dt=1e-4).run()
    found = sim.scratch.sensors.penetration.numpy()[0, 1]
    x = sim.rest[sim.of(1)]
    expected = (0.2 - np.linalg.norm(x, axis=1) if turn else (0.2 - np.abs(x)).min(1)).max()
    assert found == pytest.approx(expected, abs=0.15 * depth * DX + 0.1 * DX)


def test_penetration_of_bodies_that_go_on(meet, device):
    # On tiles: they enter blocks that the last G2P has activated, which hold no velocities yet.
    if device == "cpu":
        pytest.skip("a CPU has only the plain path")
    for substeps in (2, 9):
        settings = {"num_substeps": substeps, "control_dt": 1e-3 * substeps}
        sims = [meet([BLOCK, BALL], path=way, **settings) for way in ("plain", "tiled")]
        for _ in range(18 // substeps):
            plain, found = (sim.run().scratch.sensors.penetration.numpy() for sim in sims)
            np.testing.assert_allclose(found, plain, atol=1e-4)
        assert plain.max() > 0.002


def test_sensors_forget(meet):
    # They cover one control step.
    sim = meet([BLOCK, BALL], control_dt=1.0 / 60.0).run(2)
    sensors = sim.scratch.sensors
    assert sensors.pair_impulse.numpy().any() and sensors.part_impulse.numpy().any()
    sim.set(x=sim.rest, u=0.0, C=0.0, F=np.eye(3)).run()
    for name in ("pair_impulse", "part_impulse", "penetration", "boundary_impulse", "boundary_moment"):
        assert not getattr(sensors, name).numpy().any(), name


def sensed(sim, env=0):
    names = ("pair_impulse", "part_impulse", "penetration")
    return {name: getattr(sim.scratch.sensors, name).numpy()[env] for name in names}


def test_a_failure_in_contact_leaves_the_grid_clear(meet):
    # A particle that is lost in the middle of a collision takes nothing with it.
    sim = meet([BLOCK, BALL], num_envs=2).run()
    u = sim.state.u.numpy()
    u[0, 3] = np.inf
    sim.state.u.assign(u)
    sim.run(2)
    assert sim.failures[0] != 0 and sim.failures[1] == 0
    assert sim.accumulators_are_clear


def test_the_grid_is_clear_between_steps(meet):
    plane = [((0.0, 0.0, 1.0), -0.11, 0.5)]
    sim = meet([BLOCK, BALL], num_substeps=15, planes=plane, gravity=(0.0, 0.0, -9.81))
    for _ in range(3):
        sim.run()
        assert sim.failures == [0]
        assert sim.accumulators_are_clear


def test_contacts_leave_nothing_behind(meet, equal):
    # A world whose bodies have met all over the grid goes on like a new one. The cubes' last common nodes end a block
    # of the grid: what the next block once held is not to be looked at.
    cubes = [
        {"box": ((-0.2, -0.2, -0.2), (0.0, 0.0, 0.0)), "velocity": (1.0, 0.2, 0.0)},
        {"box": ((0.0, -0.2, -0.2), (0.2, 0.0, 0.0)), "velocity": (-1.0, 0.0, 0.0)},
    ]
    used, fresh = meet(cubes, friction=0.3), meet(cubes, friction=0.3)
    start, rng = used.state.numpy(), np.random.default_rng(0)
    used.set(x=rng.uniform(-0.35, 0.4, used.rest.shape), u=0.0).run()
    used.set(**{name: start[name] for name in ARRAYS})
    used.state.failure.zero_()
    for sim in (used, fresh):
        sim.run(3)
    for array in ARRAYS:
        assert equal(used.get(array), fresh.get(array)), array
    found, expected = sensed(used), sensed(fresh)
    assert all(equal(found[name], expected[name]) for name in expected)
