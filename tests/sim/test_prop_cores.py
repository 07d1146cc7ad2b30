"""Thin colliders stop the cores of props, whose sensors report the impulse; what is wide or far has no effect."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.physics.matter import build_matter
from benchmarks.physics.thin import Options, Throw
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.model import MaterialPoints
from piavatar_envs.sim.prop_geometry import CORE, CORE_ERROR, box, capsule, primitive_distance, sphere

#: Solids by their kind and size: a ball, a brick, a rod of one layer and a board of two.
SOLIDS = {
    "ball": (sphere, "sphere", (0.11,)),
    "brick": (box, "box", (0.1, 0.08, 0.12)),
    "rod": (capsule, "capsule", (0.02, 0.2)),
    "board": (box, "box", (0.15, 0.1, 0.03)),
}


@pytest.mark.parametrize(("make", "kind", "size"), SOLIDS.values(), ids=SOLIDS)
def test_balls_fill_the_core_and_no_more(make, kind, size):
    balls = make(*([size] if make is box else size), 0.03).core
    distance = primitive_distance(kind, (*size, 0.0, 0.0)[:3])
    deepest = min(size) if kind == "box" else size[0]
    assert np.all(-distance(balls[:, :3]) - balls[:, 3] > (1.0 - CORE - 0.05) * deepest)
    half = np.array(size) if kind == "box" else np.array([size[0], size[0], sum(size)])
    points = np.random.default_rng(0).uniform(-half, half, (4000, 3))
    depth = -distance(points)
    gap = (np.linalg.norm(points[:, None] - balls[:, :3], axis=2) - balls[:, 3]).min(axis=1)
    # what is deepest lies in a ball, or between two that are a spacing of the lattice apart
    assert gap[depth > (1.0 - 0.5 * CORE) * deepest].max() < CORE_ERROR * deepest + 0.5 * 0.03


@pytest.mark.parametrize(("kind", "thickness"), [("pole", 0.04), ("edge", 0.01)])
def test_a_fast_soft_ball_is_neither_impaled_nor_pierced(device, kind, thickness):
    options = Options(device=device, places=6)
    throw = Throw(options, kind, thickness, 2.7e4, 9.0).run(0.8)
    # Without cores some of these balls hang, and the others are pierced or nearly so.
    assert throw.distances.min() > 0.9 * CORE * 0.11
    assert not throw.hangs.any() and not throw.pierced.any()


@pytest.mark.parametrize("moves", [False, True])
def test_sensors_report_what_cores_take(device, moves):
    speed, brick = 9.0, box((0.1, 0.08, 0.12), 0.03)
    velocity = {"velocity": (-speed, 0.0, 0.0), "spin": (0.0, 0.0, 2.0)} if moves else {}
    pole = Collider("capsule", (0.015, 0.4), friction=0.4, **velocity)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5])
    sim = build_matter(
        [-0.8] * 3,
        [0.8] * 3,
        dx=0.05,
        margin=0.0,
        rest=turn.apply(brick.rest) + (-0.16, 0.03, 0.05),
        points=MaterialPoints.uniform(brick.volume, 270.0, 1.0e4),
        colliders=[pole],
        prop=brick,
        sound_speed=2.0 * speed,
        device=device,
    )
    sim.set(u=np.broadcast_to([0.0 if moves else speed, 0.0, 0.0], brick.rest.shape))
    start, names = sim.totals(), [launch.kernel.key for launch in sim.graph._launches]
    assert {"stop_core", "apply_change"} <= set(names)
    scale = speed * start.mass
    for _ in range(2):
        now = sim.run().totals()
        sensors = sim.scratch.sensors  # not cleared in between
        impulse, moment = sensors.boundary_impulse.numpy()[0, 0], sensors.boundary_moment.numpy()[0, 0]
        assert np.abs(impulse - now.momentum + start.momentum).max() < 1e-5 * scale
        assert np.abs(moment - now.angular_momentum + start.angular_momentum).max() < 1e-5 * scale
    assert np.linalg.norm(impulse) > 0.5 * scale


def test_only_props_at_thin_colliders_have_cores(make_batch):
    ball = {"name": "ball", "position": [0.9, -0.9, 1.0]}
    pole = {"name": "pole", "kind": "capsule", "position": [-1.0, 0.0, 0.9]}
    found = []
    for size, props in ([0.2, 0.4], [ball]), ([0.1, 0.4], [ball]), ([0.1, 0.4], []):
        scene = {"props": props, "colliders": [{**pole, "size": size}]}
        batch = make_batch("PIAvatar/Reach-v0", scene=scene)
        found.append("stop_core" in {launch.kernel.key for launch in batch.step_graph._launches})
    assert found == [False, True, False]
