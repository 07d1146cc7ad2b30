"""Failures: flagged, frozen, and contained in their environment."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.mpm.contact_sensors import LIMITED_SHARE
from piavatar_envs.mpm.model import Fields
from piavatar_envs.mpm.types import (
    FAILURE_CFL,
    FAILURE_NONFINITE,
    FAILURE_OUT_OF_GRID,
)

VICTIM, PARTICLE = 1, 37
ARRAYS = ("x", "u", "C", "F")

#: What is broken -> (state array, value, failure)
FAULTS = {
    "position is not a number": ("x", np.nan, FAILURE_NONFINITE),
    "position is infinite": ("x", np.inf, FAILURE_NONFINITE),
    "velocity is not a number": ("u", np.nan, FAILURE_NONFINITE),
    "prescribed velocity is infinite": ("vk", -np.inf, FAILURE_NONFINITE),
    "affine matrix is not a number": ("C", np.nan, FAILURE_NONFINITE),
    "deformation is not a number": ("F", np.nan, FAILURE_NONFINITE),
    "left below": ("x", -1.5, FAILURE_OUT_OF_GRID),
    "left above": ("x", 1.5, FAILURE_OUT_OF_GRID),
    "left for good": ("x", 1e12, FAILURE_OUT_OF_GRID),
    "absurd speed": ("u", 1e6, FAILURE_CFL),
    "absurd prescribed speed": ("vk", 1e6, FAILURE_CFL),
}


@pytest.fixture(scope="module", params=[None, "tiled"])
def three(simulate, device, request):
    """Return a function that starts three environments in free fall, each with another velocity.

    On a GPU also on the tiled path.
    """
    if request.param is not None and device == "cpu":
        pytest.skip("only the plain path is for a CPU")
    falling = {"num_envs": 3, "gravity": (0.0, 0.0, -9.81), "pushed": True, "path": request.param}
    sim = simulate(**falling, planes=[((0.0, 0.0, 1.0), -0.11, 0.5)])

    def start():
        for name in ("vk", "C", "failure"):
            getattr(sim.state, name).zero_()
        velocities = np.random.default_rng(0).normal(size=(3, 1, 3))
        return sim.set(x=sim.rest, F=np.eye(3), u=np.broadcast_to(velocities, (3, *sim.rest.shape)))

    return start


def break_particle(sim, name, value):
    array = getattr(sim.state, name)
    host = array.numpy()
    host[(VICTIM, slice(None), PARTICLE) if name in ("C", "F") else (VICTIM, PARTICLE)] = value
    array.assign(host)


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_flagged_and_contained(three, fault):
    name, value, failure = FAULTS[fault]
    expected = three().run(3).state.numpy()
    sim = three()
    break_particle(sim, name, value)
    got = sim.run(3).state.numpy()
    assert sim.failures == [0, failure, 0] and sim.accumulators_are_clear
    for array in ARRAYS:
        for env in (0, 2):
            assert np.array_equal(got[array][env], expected[array][env]), array


@pytest.mark.parametrize("fault", ["left above", "absurd speed"])
def test_failed_environment_is_frozen(three, fault):
    name, value, failure = FAULTS[fault]
    sim = three()
    break_particle(sim, name, value)
    frozen = sim.run().state.numpy()
    after = sim.run(3).state.numpy()
    assert sim.failures == [0, failure, 0]
    assert np.array_equal(after["x"][VICTIM], frozen["x"][VICTIM], equal_nan=True)
    assert np.array_equal(after["F"][VICTIM], frozen["F"][VICTIM], equal_nan=True)
    moved = np.abs(after["x"] - frozen["x"]).max(axis=(1, 2))
    assert moved[0] > 0.01 and moved[2] > 0.01
    expected, again = (three().run().state.numpy() for _ in range(2))  # the first begins where the failure was
    np.testing.assert_array_equal(again["x"], expected["x"])


@pytest.mark.parametrize("axis", range(3))
def test_a_stencil_must_lie_inside_the_grid(simulate, axis):
    # The outermost cell and a half hold none; nor do places whose cell is no 32-bit integer.
    sim = simulate(num_envs=10, num_substeps=1, control_dt=1e-4)
    grid, dx = sim.model.grid, float(sim.model.grid.dx)
    low = float(grid.origin[axis]) + 0.5 * dx
    high = float(grid.origin[axis]) + (int(grid.nodes[axis]) - 1.5) * dx
    x = np.broadcast_to(sim.rest, (10, *sim.rest.shape)).copy()
    outward = (-1e-3, 1e-3, 10.0, 1e10, 1e15)
    x[:, PARTICLE, axis] = [edge + sign * way for edge, sign in ((low, -1.0), (high, 1.0)) for way in outward]
    assert sim.set(x=x).run().failures == 2 * [0, *4 * [FAILURE_OUT_OF_GRID]]


def test_what_a_failure_leaves_does_not_depend_on_the_order_of_the_particles(simulate):
    # All others make the substep in which one fails, whether they come before it or after it in memory.
    rest = simulate().rest
    broken = np.argmin(np.linalg.norm(rest - rest.min(axis=0), axis=1))
    moved = []
    for order in (np.arange(len(rest)), np.arange(len(rest))[::-1]):
        sim = simulate(rest=rest[order], num_substeps=20).set(u=(0.3, 0.0, 0.0))
        u = sim.state.u.numpy().copy()
        u[0, np.flatnonzero(order == broken)[0]] = (1e6, 0.0, 0.0)
        sim.state.u.assign(u)
        sim.run()
        assert sim.failures == [FAILURE_CFL]
        moved.append((sim.get("x") - rest[order])[np.argsort(order)])
    far = np.linalg.norm(rest - rest[broken], axis=1) > 0.2
    assert far.sum() > 50
    step = 0.3 * float(sim.model.step.dt)
    for motion in moved:
        np.testing.assert_allclose(motion[far], np.tile([step, 0.0, 0.0], (far.sum(), 1)), atol=1e-6)


def limited_bar(simulate, speeds):
    """Build 100 particles in line, four grid spacings apart, with ``speeds`` across it.

    Speeds are in grid spacings a substep.
    """
    rest = np.zeros((100, 3))
    rest[:, 0] = 0.2 * np.arange(100)
    kwargs = {"fields": Fields(), "num_substeps": 2, "control_dt": 2e-3}  # fields: sensors cover a control step
    sim = simulate((0.0, 0.0, 0.0), (20.0, 0.0, 0.0), rest=rest, **kwargs)
    u = np.zeros((100, 3))
    u[:, 1] = np.asarray(speeds) * float(sim.model.grid.dx) / float(sim.model.step.dt)
    return sim.set(u=u)


def test_a_fast_particle_moves_a_grid_spacing_and_keeps_all_momentum(simulate):
    speeds = np.zeros(100)
    speeds[10] = 3.0
    sim = limited_bar(simulate, speeds)
    before = sim.totals()
    sim.run()
    after = sim.totals()
    assert sim.failures == [0]
    way = np.linalg.norm(sim.get("x") - sim.rest, axis=1) / float(sim.model.grid.dx)
    assert way[10] == pytest.approx(2.0, rel=1e-5)  # in two substeps
    np.testing.assert_allclose(after.momentum, before.momentum, atol=1e-6 * before.momentum_scale)
    np.testing.assert_allclose(after.angular_momentum, before.angular_momentum, atol=1e-5 * before.momentum_scale)
    assert sim.scratch.sensors.limited.numpy()[0] == pytest.approx(1 / 100)


@pytest.mark.parametrize("count", [4, 6])
def test_limited_motion_of_more_than_a_share_of_the_mass_is_a_failure(simulate, count):
    speeds = np.zeros(100)
    speeds[: 10 * count : 10] = 2.0
    sim = limited_bar(simulate, speeds).run()
    share = sim.scratch.sensors.limited.numpy()[0]
    assert share == pytest.approx(count / 100)
    assert sim.failures == [FAILURE_CFL if share > LIMITED_SHARE else 0]


def test_stretch_is_limited_and_keeps_momentum(simulate):
    # One particle of 512 lies alone and is stretched. Its stress would turn it inside out in a substep.
    sim = simulate(num_substeps=1, control_dt=1e-3, poisson_ratio=0.45)
    rest = sim.rest.copy()
    rest[PARTICLE] = (0.4, 0.4, 0.4)
    F = np.tile(np.eye(3), (len(rest), 1, 1))
    F[PARTICLE] = np.diag([5.0, 0.8, 0.4])
    sim.set(x=rest, F=F)
    before, first = sim.totals(), sim.run().get("F")[PARTICLE]
    assert 3.0 < (first**2).sum() < 9.5 and 0.5 < np.linalg.det(first) < 2.0
    for _ in range(40):
        after = sim.run().totals()
        assert after.elastic + after.kinetic < before.elastic
    assert sim.failures == [0]
    np.testing.assert_allclose(after.momentum, before.momentum, atol=1e-6)
    np.testing.assert_allclose(after.angular_momentum, before.angular_momentum, atol=1e-6)


def test_matter_at_the_edge_of_the_grid_is_held_and_keeps_its_momentum(simulate):
    speeds = np.zeros(100)
    speeds[10] = 0.9  # the grid ends 0.5 m aside, which is ten spacings
    sim = limited_bar(simulate, speeds).run(10)
    before = sim.totals()
    sim.run(5)
    assert sim.failures == [0]
    np.testing.assert_allclose(sim.totals().momentum, before.momentum, atol=1e-6 * before.momentum_scale)
    assert sim.scratch.sensors.limited.numpy()[0] == pytest.approx(1 / 100)
    everything = limited_bar(simulate, np.full(100, 0.9)).run(10)
    assert everything.failures == [FAILURE_OUT_OF_GRID]
