"""Contact between bodies: Newton's third law, Coulomb's law, and nothing where nothing touches."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.optimize import brentq

from piavatar_envs.mpm.contact import coulomb
from piavatar_envs.mpm.materials import MATERIALS, lame_parameters

DX = 0.05
ARRAYS = ("x", "u", "C", "F")
BLOCK = {"box": ((-0.15, -0.1, -0.1), (0.05, 0.1, 0.1))}
#: Off every centre, so that the block is turned as well, and begins to touch within a control step.
BALL = {"ball": ((0.16, 0.04, 0.03), 0.1), "velocity": (-4.0, 0.5, 0.0)}
#: Two cubes whose matter meets at x = 0; the rest of the scene is up to a test.
LEFT, RIGHT = {"box": ((-0.2, -0.1, -0.1), (0.0, 0.1, 0.1))}, {"box": ((0.0, -0.1, -0.1), (0.2, 0.1, 0.1))}


def ball_on_block(meet, speed=4.0, density=1000.0, **kwargs):
    velocity = tuple(speed / 4.0 * np.array(BALL["velocity"]))
    kwargs = {"friction": 0.3, "control_dt": 1.0 / 240.0} | kwargs
    return meet([BLOCK, BALL | {"velocity": velocity, "density": density}], **kwargs)


def moved(body, way):
    """Return a body elsewhere along x [m]."""
    shift = np.array([way, 0.0, 0.0])
    if "box" in body:
        return body | {"box": tuple(tuple(shift + corner) for corner in body["box"])}
    return body | {"ball": (tuple(shift + body["ball"][0]), body["ball"][1])}


def velocity_of(sim, field):
    return sim.get("u")[sim.of(field)].mean(0)


def energy(totals):
    return totals.kinetic + totals.elastic


# --- conservation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("density", [200.0, 1000.0, 5000.0])
@pytest.mark.parametrize("speed", [2.0, 10.0])
def test_contact_keeps_momentum_and_makes_no_energy(meet, speed, density):
    sim = ball_on_block(meet, speed, density, num_substeps=4)
    start, most = sim.totals(), 0.0
    for _ in range(24):
        most = max(most, energy(sim.run().totals()))
    end = sim.totals()
    before = -speed * sim.totals(select=sim.of(1)).mass
    assert sim.failures == [0]
    assert sim.totals(select=sim.of(1)).momentum[0] - before > 0.3 * start.momentum_scale  # they did collide
    assert np.abs(end.momentum - start.momentum).max() < 1e-5 * start.momentum_scale
    arm = 0.2  # [m], half the size of the scene
    assert np.abs(end.angular_momentum - start.angular_momentum).max() < 1e-5 * arm * start.momentum_scale
    assert most < 1.01 * energy(start)


def test_normals_of_their_own_lose_momentum(meet):
    # The paper's rule, kept for comparison.
    sim = ball_on_block(meet, normals="own")
    start = sim.totals()
    end = sim.run(24).totals()
    assert np.abs(end.momentum - start.momentum).max() > 1e-2 * start.momentum_scale
    assert not sim.scratch.sensors.pair_impulse.numpy().any()


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_prescribed_motion_meets_bodies_like_momentum(meet, share):
    # Contact acts on the total velocity: what share of it is prescribed makes no difference.
    all_physical = ball_on_block(meet).run(12)
    sim = ball_on_block(meet)
    velocity = sim.get("u")
    sim.set(u=(1.0 - share) * velocity, vk=share * velocity).run(12)
    assert np.abs(all_physical.get("x") - sim.get("x")).max() < 1e-4


def test_three_bodies_at_a_node(meet):
    # Two blocks side by side and a third that falls on the joint of both.
    third = {"box": ((-0.1, -0.1, 0.1), (0.1, 0.1, 0.2)), "velocity": (0.6, 0.0, -3.0), "density": 2000.0}
    closing = [LEFT | {"velocity": (0.5, 0.0, 0.0)}, RIGHT | {"velocity": (-0.5, 0.2, 0.0)}, third]
    sim = meet(closing, friction=0.4)
    start, before = sim.totals(), [sim.totals(select=sim.of(body)).momentum for body in range(3)]
    sim.run()
    change = [sim.totals(select=sim.of(body)).momentum - before[body] for body in range(3)]
    sensors = sim.scratch.sensors
    pairs = sensors.pair_impulse.numpy()[0].reshape(3, 3, 3)
    assert all(np.linalg.norm(pairs[a, b]) > 0.01 * start.momentum_scale for a, b in ((0, 1), (0, 2), (1, 2)))
    both_ways = pairs - pairs.swapaxes(0, 1)
    np.testing.assert_allclose(both_ways.sum(1), change, atol=1e-5 * start.momentum_scale)
    np.testing.assert_allclose(sensors.part_impulse.numpy()[0].sum(1), change, atol=1e-5 * start.momentum_scale)
    assert np.abs(np.sum(change, axis=0)).max() < 1e-5 * start.momentum_scale


# --- collisions ------------------------------------------------------------------------------------------------------


def test_equal_bodies_exchange_their_velocities(meet):
    # Head on they mirror each other; seen from one of them the other takes over more than half of the velocity.
    speed = 4.0
    balls = [{"ball": ((side * 0.13, 0.0, 0.0), 0.1), "velocity": (-side * speed, 0.0, 0.0)} for side in (-1, 1)]
    sim = meet(balls, control_dt=1.0 / 240.0).run(16)
    left, right = (velocity_of(sim, field) for field in range(2))
    np.testing.assert_allclose(right, -left, atol=1e-4 * speed)
    assert np.abs(left[1:]).max() < 1e-4 * speed
    assert left[0] < -0.3 * speed  # the block thrown at the resting one keeps less than 0.35 of its velocity
    moving = meet([balls[0] | {"velocity": (2.0 * speed, 0.0, 0.0)}, balls[1] | {"velocity": (0.0, 0.0, 0.0)}],
                  control_dt=1.0 / 240.0).run(16)  # fmt: skip
    np.testing.assert_allclose(velocity_of(moving, 1)[0], right[0] + speed, rtol=0.05)


@pytest.mark.parametrize("speed", [0.05, 2.0])
def test_bodies_that_separate_are_not_held(meet, equal, speed, device):
    # No tension, and no friction on what leaves: each does what it would do with the other afar, to the bit. On the
    # same path and in the same tiles: a GPU uses another path for a single body.
    path = "plain" if device == "cpu" else "tiled"
    bodies = [LEFT | {"velocity": (-speed, 0.3, 0.0)}, RIGHT | {"velocity": (speed, 0.3, 0.0)}]
    both = meet(bodies, friction=1.0, path=path)
    alone = [meet([bodies[0], moved(bodies[1], 0.4)], path=path)]
    alone.append(meet([moved(bodies[0], -0.4), bodies[1]], path=path))
    for _ in range(3):
        both.run()
        for field, single in enumerate(alone):
            single.run()
            for array in ARRAYS:
                assert equal(both.get(array)[both.of(field)], single.get(array)[single.of(field)]), array
        assert not both.scratch.sensors.pair_impulse.numpy().any()
    assert np.abs(both.get("u")).max() >= speed


def test_far_bodies_do_not_know_each_other(meet, device):
    # A node with one field is untouched, though the two do share blocks of nodes: 3.5 spacings lie between them. To the
    # bit; on a GPU to round-off, because contact blocks are updated by another kernel.
    far = {"ball": ((0.29, 0.02, 0.01), 0.06), "velocity": (0.0, 1.0, 0.0)}
    plane = [((0.0, 0.0, 1.0), -0.11, 0.5)]
    near = BLOCK | {"velocity": (-0.5, 0.0, -2.0)}
    gravity = {"gravity": (0.0, 0.0, -9.81), "planes": plane, "num_substeps": 15}
    gravity["path"] = "plain" if device == "cpu" else "tiled"
    both = meet([near, far], friction=0.5, **gravity).run(3)
    assert (both.scratch.blocks.fields.numpy() == 3).any()
    for field, bodies in enumerate(([near, moved(far, 0.4)], [moved(near, -0.4), far])):
        single = meet(bodies, friction=0.5, **gravity).run(3)
        assert not (single.scratch.blocks.fields.numpy() == 3).any()
        # of 45 substeps with round-off; contact where there is none would be a thousand times as much
        for array, atol in zip(ARRAYS, (2e-7, 2e-5, 1e-3, 5e-6), strict=True):
            of_both, alone = both.get(array)[both.of(field)], single.get(array)[single.of(field)]
            np.testing.assert_allclose(of_both, alone, rtol=0.0, atol=0.0 if device == "cpu" else atol, err_msg=array)


@pytest.mark.parametrize(("gate", "gap", "touches"), [(3.0, 1.0, True), (0.15, 0.6, False), (0.15, 0.0, True)])
def test_gate_is_the_gap_at_which_bodies_touch(meet, gate, gap, touches):
    # Cubes that close slowly over a gap [grid spacings]: without a gate they feel each other across the grid.
    away = {"box": ((gap * DX, -0.1, -0.1), (0.2 + gap * DX, 0.1, 0.1)), "velocity": (-0.01, 0.0, 0.0)}
    sim = meet([LEFT, away], gate=gate).run()
    impulse = -sim.scratch.sensors.pair_impulse.numpy()[0, 1, 0]
    at_rest = 0.5 * 8.0 * 0.01  # that of two rigid cubes of 8 kg without rebound [N s]
    assert impulse > 0.05 * at_rest if touches else impulse < 0.005 * at_rest


# --- friction --------------------------------------------------------------------------------------------------------


@wp.kernel
def slow_down(
    masses: wp.array(dtype=wp.vec2),
    velocity: wp.array2d(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    friction: wp.array(dtype=float),
    # out
    impulse: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    impulse[i] = coulomb(masses[i][0], masses[i][1], velocity[i, 0] - velocity[i, 1], normal[i], friction[i])


def test_coulombs_law_of_two_masses(device):
    rng = np.random.default_rng(0)
    count = 2000
    masses = 10.0 ** rng.uniform(-2.0, 2.0, (count, 2))
    v = rng.normal(size=(count, 2, 3))
    n = rng.normal(size=(count, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    mu = rng.uniform(0.0, 2.0, count)
    types = {"dtype": float, "device": device}
    vectors = {"dtype": wp.vec3, "device": device}
    out = wp.empty(count, **vectors)
    arrays = [wp.array(masses, dtype=wp.vec2, device=device), wp.array(v, **vectors), wp.array(n, **vectors)]
    wp.launch(slow_down, count, [*arrays, wp.array(mu, **types)], [out], device=device)
    J = out.numpy().astype(float)
    before = v[:, 0] - v[:, 1]
    after = before - J * (1.0 / masses).sum(1)[:, None]  # equal and opposite
    approach, jn = (before * n).sum(1), (J * n).sum(1)
    sliding, left = before - approach[:, None] * n, after - (after * n).sum(1)[:, None] * n
    jt = J - jn[:, None] * n
    touching = approach > 0.0
    assert not J[~touching].any() and 0.3 < touching.mean() < 0.7
    assert np.abs((after * n).sum(1)[touching]).max() < 1e-5  # a perfectly inelastic blow
    assert (np.linalg.norm(jt, axis=1) <= mu * jn * (1.0 + 1e-5) + 1e-5).all()
    assert ((jt * sliding).sum(1) >= -1e-5).all()  # against the sliding, and never beyond rest
    assert ((left * sliding).sum(1) >= -1e-4).all()
    sticks = touching & (np.linalg.norm(sliding, axis=1) < 0.999 * mu * approach)
    slips = touching & (np.linalg.norm(sliding, axis=1) > 1.001 * mu * approach)
    assert np.linalg.norm(left, axis=1)[sticks].max() < 1e-5 and sticks.sum() > 100
    np.testing.assert_allclose(np.linalg.norm(jt, axis=1)[slips], (mu * jn)[slips], rtol=1e-4, atol=1e-6)


# --- fast and heavy hits ---------------------------------------------------------------------------------------------


def behind_shock(material, speed, density=1000.0):
    """Return the volume ratio behind a shock that stops matter of this speed [m/s], by its jump conditions.

    Momentum gives ``P(J) (1 - J) = density speed^2`` with the stress ``P`` of matter that is squeezed along one axis.
    """
    law, (mu, lam) = MATERIALS[material], lame_parameters(100.0 * density, 0.3)

    def energy_at(J):
        return law.energy(np.diag([J, 1.0, 1.0]), mu, lam)

    def excess(J):
        return (energy_at(J - 1e-5) - energy_at(J + 1e-5)) / 2e-5 * (1.0 - J) - density * speed**2

    return brentq(excess, 0.06, 0.99)


@pytest.mark.parametrize("material", ["neo_hookean", "fixed_corotated"])
@pytest.mark.parametrize("speed", [10.0, 20.0])
def test_shocks_squeeze_matter_as_their_jump_conditions_say(meet, material, speed):
    # Blocks that meet at up to four times the speed of their waves; without viscosity, matter swings far beyond.
    left = {"box": ((-0.4, -0.2, -0.2), (0.0, 0.2, 0.2)), "velocity": (speed, 0.0, 0.0)}
    right = {"box": ((0.0, -0.2, -0.2), (0.4, 0.2, 0.2)), "velocity": (-speed, 0.0, 0.0)}
    sim = meet([left, right], material=material, num_substeps=3, control_dt=0.018 / speed)
    start = sim.totals()
    history = [start]
    least, overlap = 1.0, 0.0
    for _ in range(6):
        history.append(sim.run().totals())
        x = sim.get("x")[:, 0]
        least = min(least, np.linalg.det(sim.get("F")).min())
        overlap = max(overlap, x[sim.of(0)].max() - x[sim.of(1)].min())
    assert least > 0.9 * behind_shock(material, speed)
    assert np.diff([energy(t) for t in history]).max() < 1e-3 * energy(start)
    assert np.abs(history[-1].momentum - start.momentum).max() < 1e-5 * start.momentum_scale
    assert overlap < 0.2 * DX


@pytest.mark.parametrize("material", ["neo_hookean", "fixed_corotated"])
def test_viscosity_in_shocks_is_stable_at_the_usual_step(meet, material):
    # At a Courant number of 0.5, quadratic viscosity alone stops more than the compression and makes energy.
    mu, lam = lame_parameters(100.0, 0.3)
    left = {"box": ((-0.4, -0.2, -0.2), (0.0, 0.2, 0.2)), "velocity": (10.0, 0.0, 0.0)}
    right = {"box": ((0.0, -0.2, -0.2), (0.4, 0.2, 0.2)), "velocity": (-10.0, 0.0, 0.0)}
    sim = meet([left, right], material=material, num_substeps=1, control_dt=0.5 * DX / np.sqrt(lam + 2.0 * mu))
    history = [energy(sim.totals())]
    for _ in range(14):
        history.append(energy(sim.run().totals()))
    assert sim.failures == [0]
    assert np.diff(history).max() < 1e-3 * history[0]


def test_bodies_that_would_cross_in_a_substep_stop_at_the_gate(meet):
    # They are just beyond the gate and close by 0.8 grid spacings.
    away = {"box": ((0.3 * DX, -0.1, -0.1), (0.2 + 0.3 * DX, 0.1, 0.1)), "velocity": (-0.8 * DX / 1e-3, 0.0, 0.0)}
    sim = meet([LEFT, away], num_substeps=1, control_dt=1e-3)
    start = sim.totals()
    x = sim.run().get("x")[:, 0]
    assert x[sim.of(1)].min() - x[sim.of(0)].max() - 0.5 * DX > -0.35 * DX  # a quarter of a spacing to each surface
    assert np.abs(sim.totals().momentum - start.momentum).max() < 1e-5 * start.momentum_scale


def test_bodies_deep_in_each_other_part(meet):
    # At rest and without stress, only contact parts them; slowly, to less than half a grid spacing.
    into = {"box": ((-0.8 * DX, -0.1, -0.1), (0.2 - 0.8 * DX, 0.1, 0.1))}
    sim = meet([LEFT, into], num_substeps=10, control_dt=1e-2)
    fastest = 0.0
    for _ in range(6):
        fastest = max(fastest, np.abs(sim.run().get("u")).max())
    x = sim.get("x")[:, 0]
    assert x[sim.of(0)].max() - x[sim.of(1)].min() + 0.5 * DX < 0.5 * DX
    assert fastest < 0.1 * DX / sim.model.step.dt
    assert np.abs(sim.totals().momentum).max() < 1e-5 * sim.totals().momentum_scale
