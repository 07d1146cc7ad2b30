"""Colliders that are thinner than a cell stop matter, and their sensors report what they take from it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.physics.matter import ball
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.thin_colliders import thin_colliders
from piavatar_envs.sim.prop_geometry import primitive_distance

DX, RADIUS, SPACING = 0.05, 0.11, 0.03
#: A rotation with which no face is parallel to the grid; matter is thrown along its x axis.
TURN = Rotation.from_rotvec([0.3, -0.2, 0.5])
#: Half a millimetre, three, and a quarter of a cell.
PLATES = {f"plate {1e3 * half:g} mm": ("box", (half, 0.5, 0.5)) for half in (0.0005, 0.003, 0.0125)}
#: What is thin along two or three axes, at 0.6 of a cell, and the edge of a plate at 0.3.
POLES = {
    "pole": ("capsule", (0.03, 0.9)),
    "rod": ("box", (0.03, 0.03, 0.9)),
    "edge": ("box", (0.3, 0.015, 0.9)),
}
THIN = PLATES | POLES


def pose(collider):
    """Return the pose of a collider as a rotation from its frame and a position."""
    return Rotation.from_quat(np.roll(collider.rotation, -1)), np.array(collider.position)


def distances(collider, x):
    """Return the signed distances of points from a collider in its initial pose [m]."""
    turn, position = pose(collider)
    local = turn.inv().apply(x - position)
    return primitive_distance(collider.kind, (*collider.size, 0.0, 0.0)[:3])(local)


def place(kind, size, **kwargs):
    """Build a collider that is turned against the grid."""
    return Collider(kind, size, (0.01, -0.013, 0.007), tuple(np.roll(TURN.as_quat(), 1)), **kwargs)


def throw(simulate, collider, speed, ahead=0.05, aside=0.0, **kwargs):
    """Build a ball of 1.5 kg that flies at a collider along the x axis of its frame, from negative x."""
    turn, position = pose(collider)
    center = position + turn.apply([-(collider.size[0] + RADIUS + ahead), aside, 0.0])
    matter = {"density": 270.0, "young_modulus": 2.7e4, "spacing": SPACING, "dx": DX, "margin": 0.0}
    box = {"lower": [-0.8] * 3, "upper": [0.8] * 3}
    sim = simulate(**box, **matter, rest=ball(center, RADIUS, SPACING), colliders=[collider], **kwargs)
    return sim.set(u=turn.apply([speed, 0.0, 0.0]))


def along(collider, x):
    """Return the x coordinate of points in the frame of a collider [m]."""
    turn, position = pose(collider)
    return turn.inv().apply(x - position)[:, 0]


@pytest.mark.parametrize("speed", [3.0, 9.0])
@pytest.mark.parametrize(("kind", "size"), PLATES.values(), ids=PLATES)
def test_a_ball_comes_back_from_a_face(simulate, kind, size, speed):
    plate = place(kind, size)
    sim = throw(simulate, plate, speed)
    for _ in range(5):
        assert along(plate, sim.run().get("x")).max() < -size[0]
    assert sim.failures == [0]
    back = -TURN.inv().apply(sim.get("u")).mean(axis=0)[0]
    assert 0.35 * speed < back < speed


@pytest.mark.parametrize("speed", [3.0, 6.0, 9.0])
@pytest.mark.parametrize(("kind", "size"), POLES.values(), ids=POLES)
def test_a_ball_does_not_hang_on_a_pole(simulate, kind, size, speed):
    pole = place(kind, size)
    sim = throw(simulate, pole, speed)
    for _ in range(8):
        assert distances(pole, sim.run().get("x")).min() > 0.0
    assert sim.failures == [0]
    velocity = TURN.inv().apply(sim.get("u")).mean(axis=0)
    assert abs(velocity[0]) > 0.1 * speed
    x = sim.get("x")
    assert np.linalg.norm(x - x.mean(axis=0), axis=1).max() < 1.3 * RADIUS  # in one piece


@pytest.mark.parametrize("decoupling", ["split", "paper"])
@pytest.mark.parametrize(("kind", "size"), THIN.values(), ids=THIN)
def test_sensors_report_what_colliders_take(simulate, kind, size, decoupling):
    collider = place(kind, size, friction=0.4)
    sim = throw(simulate, collider, 9.0, ahead=0.03, aside=0.02, decoupling=decoupling)
    start = sim.totals()
    for _ in range(3):
        now = sim.run().totals()
        sensors = sim.scratch.sensors  # not cleared in between
        impulse, moment = sensors.boundary_impulse.numpy()[0, 0], sensors.boundary_moment.numpy()[0, 0]
        assert np.abs(impulse - now.momentum + start.momentum).max() < 1e-5 * start.momentum_scale
        assert np.abs(moment - now.angular_momentum + start.angular_momentum).max() < 1e-5 * start.momentum_scale
    assert np.linalg.norm(impulse) > 0.7 * start.momentum_scale


def test_a_moving_plate_drives_a_ball(simulate):
    plate = place("box", (0.002, 0.5, 0.5), velocity=tuple(TURN.apply([-6.0, 0.0, 0.0])))
    sim = throw(simulate, plate, 0.0).run(3)
    surface = along(plate, sim.model.boundaries.position.numpy()[0])
    assert along(plate, sim.get("x")).max() < surface - 0.002
    assert -TURN.inv().apply(sim.get("u")).mean(axis=0)[0] > 6.0


def test_a_turning_plate_drives_a_ball(simulate):
    plate = place("box", (0.5, 0.002, 0.5), spin=tuple(TURN.apply([0.0, 0.0, 8.0])))
    turn, position = pose(plate)
    points = ball(position + turn.apply([0.3, 0.2, 0.0]), RADIUS, SPACING)
    matter = {"rest": points, "spacing": SPACING, "dx": DX, "margin": 0.0}
    sim = simulate([-0.8] * 3, [0.8] * 3, **matter, colliders=[plate])
    for _ in range(4):
        sim.run()
        now = Rotation.from_quat(sim.model.boundaries.rotation.numpy()[0, 0])
        assert now.inv().apply(sim.get("x") - position)[:, 1].min() > 0.002
    assert sim.failures == [0]
    assert np.linalg.norm(sim.get("u").mean(axis=0)) > 2.0


def test_a_thin_plate_bears_what_a_thick_one_does(simulate):
    heights, weights = [], []
    for half in (0.2, 0.002):
        plate = Collider("box", (0.3, 0.3, half), (0.0, 0.0, -half), friction=0.5)
        sim = simulate((-0.1, -0.1, 0.0), (0.1, 0.1, 0.1), colliders=[plate], gravity=(0.0, 0.0, -9.81), margin=0.3)
        sim.run(30).scratch.sensors.accumulators.zero_()
        impulse = sim.run(15).scratch.sensors.boundary_impulse.numpy()[0, 0]
        weights.append(impulse[2] / (9.81 * sim.totals().mass * 15 * sim.model.control_dt))
        heights.append(sim.get("x")[:, 2].mean())
    assert weights == pytest.approx([1.0, 1.0], abs=0.01)
    assert heights[1] == pytest.approx(heights[0], abs=0.1 * DX)


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule"])
def test_no_way_crosses_a_solid(simulate, kind):
    # a particle per environment, at up to a cell a substep, from all around, at all angles, at the edges too
    size = {"sphere": (0.02,), "box": (0.1, 0.001, 0.1), "capsule": (0.01, 0.1)}[kind]
    solid, rng, count = place(kind, size, friction=0.3), np.random.default_rng(0), 300
    way = rng.normal(size=(count, 1, 3))
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    reach = np.max(size)
    start = pose(solid)[1] + rng.uniform(-reach, reach, (count, 1, 3)) - 0.25 * way
    speed = rng.uniform(15.0, 24.0, (count, 1, 1))
    matter = {"rest": np.zeros((1, 3)), "young_modulus": 1.0, "spacing": 0.01, "dx": DX, "margin": 0.0}
    step = {"control_dt": 1.0 / 500.0, "num_substeps": 1, "num_envs": count}
    sim = simulate([-0.6] * 3, [0.6] * 3, **matter, **step, colliders=[solid]).set(x=start, u=speed * way)
    shares = np.linspace(0.0, 1.0, 60)[:, None, None]
    enters = (
        distances(solid, (start[:, 0] + 12 * shares * 0.04 * way[:, 0]).reshape(-1, 3)).reshape(60, -1).min(axis=0) < 0
    )
    assert enters.sum() > 20
    after, depth = start[:, 0], np.inf
    for _ in range(12):
        before, after = after, sim.run().state.numpy()["x"][:, 0].astype(float)
        depth = min(depth, distances(solid, (before + shares * (after - before)).reshape(-1, 3)).min())
    assert depth > -1e-6
    assert set(sim.failures) == {0}


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule"])
def test_matter_that_begins_inside_comes_out(simulate, kind):
    solid = place(kind, {"sphere": (0.05,), "box": (0.1, 0.02, 0.1), "capsule": (0.04, 0.1)}[kind])
    turn, position = pose(solid)
    grain = position + turn.apply([[0.002, -0.01, 0.003]])
    box = {"lower": [-0.5] * 3, "upper": [0.5] * 3, "margin": 0.0, "dx": DX, "spacing": 0.01}
    sim = simulate(**box, rest=grain, colliders=[solid]).run()
    assert distances(solid, sim.get("x"))[0] > 0.0
    assert turn.inv().apply(sim.get("x") - position)[0, 1] < 0.0


def test_only_thin_colliders_need_it(simulate):
    thick = [Collider("box", (0.1, 0.1, 0.1)), Collider("sphere", (0.1,)), Collider("capsule", (0.1, 0.01))]
    assert thin_colliders([Collider.plane((0.0, 0.0, 1.0), 0.0), *thick], DX) == []
    sim = simulate(planes=[((0.0, 0.0, 1.0), 0.0, 0.0)], colliders=thick)
    assert sim.model.thin_colliders is None
    names = [launch.kernel.key for launch in sim.graph._launches]
    assert not [name for name in names if "thin" in name or "positions" in name]
