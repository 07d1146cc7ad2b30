"""Analytic boundaries: Coulomb's law on an incline, the weight of a body at rest, and nothing left on the grid."""

from __future__ import annotations

import numpy as np
import pytest

GROUND = (0.0, 0.0, 1.0)
DX = 0.05
#: A block whose lowest particles are half their spacing above the ground: it touches, and does not fall first.
BLOCK = {"lower": (-0.1, -0.1, 0.0), "upper": (0.1, 0.1, 0.1), "dx": DX, "spacing": 0.025, "margin": 0.8}


def block_on_incline(simulate, slope, friction, plane=(GROUND, 0.0)):
    """Build a block on a level plane under tilted gravity: ``tan(angle) = slope`` along +x.

    The block is loaded slowly, under damping: put down at once it rocks, and rocking bodies creep below the friction
    angle, as they do in reality.
    """
    angle = np.arctan(slope)
    gravity = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    sim = simulate(**{**BLOCK, "lower": (-0.2, -0.1, 0.0)}, gravity=gravity, planes=[(*plane, friction)], pushed=True)
    sim.push(damping=50.0).run(10)
    return sim.push(damping=0.0).run(4)


def mean_velocity(sim):
    """Return the velocity along the slope [m/s]."""
    return sim.get("u")[:, 0].mean()


@pytest.mark.parametrize(("slope", "friction"), [(0.3, 0.29), (0.6, 0.0), (1.2, 0.5)])
def test_block_slips_with_the_acceleration_of_coulomb(simulate, slope, friction):
    # ``a = g (sin - mu cos)``.
    angle = np.arctan(slope)
    sim = block_on_incline(simulate, slope, friction)
    start, steps = mean_velocity(sim), 8
    acceleration = (mean_velocity(sim.run(steps)) - start) / (steps * sim.model.control_dt)
    assert sim.failures == [0]
    assert acceleration == pytest.approx(9.81 * (np.sin(angle) - friction * np.cos(angle)), abs=0.002 * 9.81)


@pytest.mark.parametrize(("slope", "friction"), [(0.3, 0.31), (0.8, 0.85)])
def test_block_stays_below_the_friction_angle(simulate, slope, friction):
    sim = block_on_incline(simulate, slope, friction)
    before = sim.get("x")[:, 0].mean()
    sim.run(15)
    assert abs(sim.get("x")[:, 0].mean() - before) < 1e-3 * DX  # a slide without friction would have gone 0.35 m
    assert abs(mean_velocity(sim)) < 1e-4


@pytest.mark.parametrize("decoupling", ["split", "paper"])
def test_impulse_is_the_change_of_momentum(simulate, decoupling):
    # Newton's third law at every moment of a fall, an oblique impact and the rest after it.
    gravity = np.array([0.5, 0.0, -9.81])
    sim = simulate(**BLOCK, gravity=gravity, planes=[(GROUND, -0.02, 0.4)], decoupling=decoupling)
    sim.set(u=[1.0, 0.5, -1.0])
    start, dt = sim.totals(), sim.model.control_dt
    for n in range(1, 16):
        now = sim.run().totals()
        impulse = sim.scratch.sensors.boundary_impulse.numpy()[0, 0]  # not cleared in between
        expected = now.momentum - start.momentum - n * dt * now.mass * gravity
        assert np.abs(impulse - expected).max() < 1e-5 * start.momentum_scale
    assert impulse[2] > 0.5 * n * dt * now.mass * 9.81


def test_ground_bears_the_weight_below_the_middle(simulate):
    # At rest its impulse and the moment of that are those of the weight.
    at, steps = np.array([0.13, -0.08]), 30
    block = {**BLOCK, "lower": (*(at - 0.1), 0.0), "upper": (*(at + 0.1), 0.1)}
    sim = simulate(**block, gravity=(0.0, 0.0, -9.81), planes=[(GROUND, 0.0, 0.5)]).run(30)
    sim.scratch.sensors.accumulators.zero_()
    sensors = sim.run(steps).scratch.sensors
    impulse, moment = sensors.boundary_impulse.numpy()[0, 0], sensors.boundary_moment.numpy()[0, 0]
    weight = sim.totals().mass * 9.81
    assert impulse[2] == pytest.approx(weight * steps * sim.model.control_dt, rel=2e-3)
    assert np.abs(impulse[:2]).max() < 2e-3 * impulse[2]
    assert np.abs(sim.get("u")).max() < 5e-3
    middle = sim.get("x").mean(0)[:2]
    assert np.abs(middle - at).max() < 1e-3
    assert np.array([-moment[1], moment[0]]) / impulse[2] == pytest.approx(middle, abs=1e-3)


@pytest.mark.parametrize("speed", [1.0, 4.0])
@pytest.mark.parametrize("how", ["u", "vk"])
def test_nothing_passes_a_plane(simulate, how, speed):
    # A soft block thrown at the ground, or carried at it by its prescribed velocity, stays above it and bounces.
    sim = simulate(**BLOCK, planes=[(GROUND, 0.0, 0.5)], young_modulus=2.0e4, num_substeps=15)
    sim.set(**{how: [0.0, 0.0, -speed]})
    for _ in range(5):
        assert sim.run().get("x")[:, 2].min() > -0.6 * DX
    total = (sim.get("u") + sim.get("vk"))[:, 2].mean()
    assert sim.failures == [0]
    assert 0.0 < total < speed  # restitution


def test_contact_candidates_without_contact_move_like_others(simulate):
    # Kinematic momentum is for contact: a body just above the ground does what it does where there is none.
    spin = np.array([0.5, -1.0, 2.0])
    free, candidates = (simulate(**BLOCK, planes=planes, num_substeps=15) for planes in ([], [(GROUND, -0.02, 0.5)]))
    vk = np.cross(spin, free.rest) + [0.3, 0.0, 2.0]
    stretch = np.diag([1.02, 0.99, 1.0])
    for sim in (free, candidates):
        sim.set(vk=vk, spin=spin, u=[0.0, 0.1, 0.5], F=stretch).run()
        assert sim.failures == [0]
    assert candidates.get("x")[:, 2].min() > 0.05  # it is on its way
    for name, atol in (("x", 1e-6), ("u", 2e-5), ("F", 1e-5)):
        np.testing.assert_allclose(candidates.get(name), free.get(name), atol=atol, err_msg=name)
    assert candidates.scratch.sensors.boundary_impulse.numpy()[0, 0].tolist() == [0.0, 0.0, 0.0]


def test_leaving_the_ground_is_free(simulate):
    # A plane pushes; it does not pull, and has no friction on what leaves.
    sim = simulate(**BLOCK, planes=[(GROUND, 0.0, 0.5)])
    velocity = np.array([0.7, -0.4, 1.0])
    sim.set(u=velocity).run(2)
    assert np.abs(sim.get("u") - velocity).max() < 1e-5
    assert sim.scratch.sensors.boundary_impulse.numpy()[0, 0].tolist() == [0.0, 0.0, 0.0]


def test_prescribed_motion_meets_the_ground_like_momentum(simulate):
    # Contact acts on the total velocity: what share of it is prescribed makes no difference.
    runs = []
    for share in (0.0, 0.3, 1.0):
        sim = simulate(**BLOCK, planes=[(GROUND, 0.0, 0.5)], gravity=(0.0, 0.0, -9.81))
        velocity = np.array([0.5, 0.0, -1.0])
        runs.append(sim.set(u=(1.0 - share) * velocity, vk=share * velocity).run(5).get("x"))
    assert np.abs(runs[1] - runs[0]).max() < 1e-4
    assert np.abs(runs[2] - runs[0]).max() < 1e-4


def test_corner_of_two_planes(simulate):
    # Pulled into a corner, a block rests on both planes.
    gravity = (-5.0, 0.0, -9.81)
    sim = simulate(**BLOCK, gravity=gravity, planes=[(GROUND, 0.0, 0.0), ((1.0, 0.0, 0.0), -0.1, 0.0)]).run(30)
    sim.scratch.sensors.accumulators.zero_()
    impulse = sim.run(15).scratch.sensors.boundary_impulse.numpy()[0, 0]
    expected = -np.array(gravity) * sim.totals().mass * 15 * sim.model.control_dt
    assert impulse == pytest.approx(expected, abs=0.02 * expected[2])


@pytest.mark.parametrize("planes", [[], [((1.0, 0.2, 1.0), -0.05, 0.5)]])
def test_the_grid_is_clear_between_steps(simulate, planes):
    # The next substep adds to what it finds.
    sim = simulate(**BLOCK, gravity=(0.0, 0.0, -9.81), planes=planes, num_substeps=15)
    sim.set(u=[2.0, 1.0, 0.5])
    for _ in range(4):
        sim.run()
        assert sim.failures == [0]
        assert sim.accumulators_are_clear
