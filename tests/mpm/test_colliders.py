"""Analytic solids: distances against sampled surfaces, normals against finite differences, Coulomb's law, motion."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from piavatar_envs.mpm.colliders import (
    COLLIDER_KINDS,
    boundary_contact,
    move_colliders,
    nearest_boundary,
    remove_approach,
    signed_distance,
    surface_velocity,
)
from piavatar_envs.mpm.types import Boundaries

SIZES = {
    "plane": (0.0, 0.0, 0.0),
    "sphere": (0.3, 0.0, 0.0),
    "box": (0.2, 0.35, 0.1),
    "capsule": (0.15, 0.25, 0.0),
}
KINDS = list(SIZES)
POSITION, TURN = np.array([0.4, -0.2, 0.7]), Rotation.from_rotvec([0.8, -0.5, 1.1])


@wp.kernel
def query(
    boundaries: Boundaries,
    env: wp.array(dtype=int),
    collider: wp.array(dtype=int),
    x: wp.array(dtype=wp.vec3),
    # out
    distance: wp.array(dtype=wp.vec4),
    velocity: wp.array(dtype=wp.vec3),
    nearest: wp.array(dtype=float),
):
    i = wp.tid()
    distance[i] = signed_distance(boundaries, env[i], collider[i], x[i])
    velocity[i] = surface_velocity(boundaries, env[i], collider[i], x[i])
    nearest[i] = nearest_boundary(boundaries, env[i], x[i])


@wp.kernel
def collide_pair(
    boundaries: Boundaries,
    env: wp.array(dtype=int),
    field: wp.array(dtype=int),
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    gate: float,
    # out
    after: wp.array(dtype=wp.vec3),
    unseen: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    after[i] = boundary_contact(boundaries, env[i], field[i], x[i], v[i], gate)
    unseen[i] = remove_approach(boundaries, env[i], x[i], v[i], gate)


class Solids:
    """Colliders on a device; poses are ``(rows, B, ...)`` or broadcast to it, rotations SciPy's."""

    def __init__(self, device, kinds, position=POSITION, rotation=TURN, velocity=0.0, spin=0.0, friction=0.0, rows=1):
        self.device, count = device, len(kinds)
        b = self.boundaries = Boundaries()
        b.count = count
        b.kind = wp.array([COLLIDER_KINDS[kind] for kind in kinds], dtype=int, device=device)
        b.size = self.upload([SIZES[kind] for kind in kinds], wp.vec3, (count, 3))
        b.rotation = self.upload(rotation.as_quat(), wp.quat, (rows, count, 4))
        for name, value in (("position", position), ("velocity", velocity), ("spin", spin)):
            setattr(b, name, self.upload(value, wp.vec3, (rows, count, 3)))
        friction = np.atleast_2d(friction)
        fields = max(1, friction.shape[-1] // count)
        b.friction = self.upload(friction, float, (len(friction), fields * count))

    def upload(self, values, dtype, shape):
        values = np.ascontiguousarray(np.broadcast_to(np.asarray(values, np.float32), shape))
        return wp.array(values, dtype=dtype, device=self.device)

    def indices(self, values, count):
        return wp.array(np.broadcast_to(np.asarray(values, np.int32), count).copy(), dtype=int, device=self.device)

    def query(self, x, collider=0, env=0):
        """Return normals ``(N, 3)``, distances ``(N,)``, surface velocities ``(N, 3)`` and distances to the nearest."""
        n = len(x)
        out = [wp.full(n, np.nan, dtype=dtype, device=self.device) for dtype in (wp.vec4, wp.vec3, float)]
        where = self.upload(x, wp.vec3, (n, 3))
        inputs = [self.boundaries, self.indices(env, n), self.indices(collider, n), where]
        wp.launch(query, n, inputs, out, device=self.device)
        distance, velocity, nearest = (array.numpy().astype(float) for array in out)
        return distance[:, :3], distance[:, 3], velocity, nearest

    def collide_pair(self, x, v, gate=np.inf, field=0, env=0):
        """Return the velocity after contact and velocity without approach, both ``(N, 3)``."""
        n = len(x)
        out = [wp.full(n, wp.vec3(np.nan), dtype=wp.vec3, device=self.device) for _ in range(2)]
        moving = [self.upload(value, wp.vec3, (n, 3)) for value in (x, v)]
        inputs = [self.boundaries, self.indices(env, n), self.indices(field, n), *moving, float(gate)]
        wp.launch(collide_pair, n, inputs, out, device=self.device)
        return tuple(array.numpy().astype(float) for array in out)

    def move(self, dt, steps=1):
        for _ in range(steps):
            wp.launch(move_colliders, self.boundaries.position.shape, [dt, self.boundaries], device=self.device)


def world(local):
    return TURN.apply(local) + POSITION


def surface_samples(kind, step=0.01):
    """Return points of the surface in the solid's own frame, none farther than ``step`` from its neighbours."""
    size = SIZES[kind]
    if kind == "plane":
        ticks = np.arange(-2.0, 2.0, step)
        return np.stack([*(m.ravel() for m in np.meshgrid(ticks, ticks)), np.zeros(len(ticks) ** 2)], axis=1)
    if kind == "box":
        ticks = [np.linspace(-h, h, int(2 * h / step) + 2) for h in size]
        grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        return grid[np.any(np.abs(grid) >= np.array(size) - 1e-9, axis=1)]
    radius, half = size[0], size[1]
    angles = np.linspace(0.0, 2.0 * np.pi, int(2 * np.pi * radius / step) + 2)
    polar = np.linspace(0.0, np.pi, int(np.pi * radius / step) + 2)
    profile = [(radius * np.sin(p), radius * np.cos(p) + half * s) for p in polar for s in (-1.0, 1.0)]
    profile = [(rho, z) for rho, z in profile if abs(z) >= half - 1e-9]
    profile += [(radius, z) for z in np.linspace(-half, half, int(2 * half / step) + 2)]
    return np.array([[rho * np.cos(a), rho * np.sin(a), z] for rho, z in profile for a in angles])


def is_inside(kind, p):
    size = np.array(SIZES[kind])
    if kind == "plane":
        return p[:, 2] < 0.0
    if kind == "box":
        return np.all(np.abs(p) < size, axis=1)
    in_tube = (np.hypot(p[:, 0], p[:, 1]) < size[0]) & (np.abs(p[:, 2]) < size[1])
    return in_tube | np.any([np.linalg.norm(p - [0, 0, end], axis=1) < size[0] for end in (-size[1], size[1])], axis=0)


def random_points(count=3000, reach=0.6, seed=0):
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 3))


@pytest.mark.parametrize("kind", KINDS)
def test_distance_is_that_of_the_sampled_surface(device, kind):
    # A sample at most ``gap`` beside the nearest point of the surface is at most ``hypot(distance, gap)`` away.
    local, gap = random_points(500), 0.01
    _, distance, _, nearest = Solids(device, [kind]).query(world(local))
    sampled = cKDTree(surface_samples(kind, 0.5 * gap)).query(local)[0]  # half, because round surfaces fall away
    assert np.all(np.abs(distance) <= sampled + 1e-6)
    assert np.all(sampled <= np.hypot(distance, gap) + 1e-6)
    clear = np.abs(distance) > 1e-6
    assert np.array_equal(distance[clear] < 0.0, is_inside(kind, local)[clear])
    assert 0.01 < np.mean(distance < 0.0) < 0.7
    assert np.array_equal(nearest, distance)


@pytest.mark.parametrize("kind", KINDS)
def test_normal_is_the_gradient_of_the_distance(device, kind):
    solid, local, step = Solids(device, [kind]), random_points(seed=1), 2e-3
    normal = solid.query(world(local))[0]
    assert np.abs(np.linalg.norm(normal, axis=1) - 1.0).max() < 1e-5
    gradient = np.stack(
        [(solid.query(world(local) + d)[1] - solid.query(world(local) - d)[1]) / (2 * step) for d in step * np.eye(3)],
        axis=1,
    )
    smooth = np.ones(len(local), bool)  # within the solid, two of its nearest points may be equally near
    size = np.array(SIZES[kind])
    if kind == "box":
        depth = np.sort(size - np.abs(local), axis=1)
        middle = (np.abs(local) < 2 * step).any(axis=1)  # both faces of an axis are as near
        deep = (depth[:, 0] > 2 * step) & (depth[:, 1] - depth[:, 0] > 4 * step) & ~middle
        smooth = np.where(is_inside("box", local), deep, depth[:, 0] < -20 * step)
    elif kind != "plane":
        axis = local - np.clip(local[:, 2], -size[1], size[1])[:, None] * [0, 0, 1]
        smooth = np.linalg.norm(axis, axis=1) > 20 * step
    assert smooth.mean() > 0.8
    assert np.abs(gradient - normal)[smooth].max() < 5e-3


#: Places in the solids' own frames where several points of the surface are equally near, and their distances.
DEGENERATE = {
    "plane": [((0, 0, 0), 0.0), ((1, 2, 0), 0.0)],
    "sphere": [((0, 0, 0), -0.3), ((0, 0, 1e-20), -0.3), ((0.3, 0, 0), 0.0)],
    "box": [
        ((0, 0, 0), -0.1),
        ((0.2, 0.35, 0.1), 0.0),
        ((-0.2, -0.35, -0.1), 0.0),
        ((0.2, 0.35, 0), 0.0),
        ((0.2, 0, 0), 0.0),
        ((0.15, 0.3, 0.05), -0.05),
        ((0, 0, 1e-30), -0.1),
    ],
    "capsule": [((0, 0, 0), -0.15), ((0, 0, 0.25), -0.15), ((0, 0, -0.25), -0.15), ((0, 0, 0.3), -0.1)],
}


@pytest.mark.parametrize("kind", KINDS)
def test_normals_lead_out_where_the_nearest_point_is_not_unique(device, kind):
    local = np.array([place for place, _ in DEGENERATE[kind]], float)
    expected = np.array([distance for _, distance in DEGENERATE[kind]])
    solid = Solids(device, [kind], position=(0, 0, 0), rotation=Rotation.identity())
    normal, distance, _, _ = solid.query(local)
    assert np.abs(distance - expected).max() < 1e-7
    assert np.abs(np.linalg.norm(normal, axis=1) - 1.0).max() < 1e-6
    for step in (0.02, 0.05):
        ahead = solid.query(local + step * normal)[1]
        assert np.abs(ahead - expected - step).max() < 1e-6


# ---- contact
def coulomb(normal, surface, friction, v):
    """Return the velocity after an inelastic contact with friction."""
    relative = v - surface
    vn = np.einsum("ni,ni->n", relative, normal)
    vt = relative - vn[:, None] * normal
    speed = np.linalg.norm(vt, axis=1)
    pressed = np.maximum(-vn, 0.0)
    kept = np.maximum(speed - friction * pressed, 0.0) / np.maximum(speed, 1e-12)
    return surface + np.where(vn < 0.0, kept, 1.0)[:, None] * vt + (np.maximum(vn, 0.0))[:, None] * normal


@pytest.mark.parametrize("kind", KINDS)
def test_contact_with_a_moving_surface_follows_coulomb(device, kind):
    rng = np.random.default_rng(5)
    velocity, spin = np.array([0.6, -0.3, 0.2]), np.array([2.0, -1.0, 3.0])
    coefficients = np.array([0.0, 0.3, 0.8, 50.0])
    solid = Solids(device, [kind], velocity=velocity, spin=spin, friction=coefficients)
    x, v = world(random_points(seed=6)), 2.0 * rng.normal(size=(3000, 3))
    field = rng.integers(0, 4, 3000)
    normal, _, surface, _ = solid.query(x)
    assert np.abs(surface - (velocity + np.cross(spin, x - POSITION))).max() < 1e-5
    after, _ = solid.collide_pair(x, v, field=field)
    assert np.abs(after - coulomb(normal, surface, coefficients[field], v)).max() < 2e-5

    # what the law means, apart from its formula
    change, before_n = after - v, np.einsum("ni,ni->n", v - surface, normal)
    change_n = np.einsum("ni,ni->n", change, normal)
    friction = np.linalg.norm(change - change_n[:, None] * normal, axis=1)
    hit = before_n < -1e-4
    assert 0.3 < hit.mean() < 0.7
    assert np.abs(np.einsum("ni,ni->n", after - surface, normal)[hit]).max() < 1e-5
    assert np.all(friction[hit] <= coefficients[field][hit] * (change_n[hit] + 1e-5) + 1e-5)
    stuck = np.linalg.norm(after - surface, axis=1) < 1e-5
    for index, expected in enumerate([(0.0, 0.0), (0.01, 0.2), (0.1, 0.5), (0.95, 1.0)]):
        assert expected[0] <= stuck[hit & (field == index)].mean() <= expected[1], index
    # friction adds no energy in the surface's frame: the sliding does not turn round
    assert np.all(np.einsum("ni,ni->n", after - surface, v - surface)[hit] > -1e-5)
    separating = before_n > 1e-4
    assert np.array_equal(after[separating], v[separating].astype(np.float32).astype(float))


def test_fields_and_colliders_have_friction_of_their_own(device):
    # Two level floors, one far below: the entry of field f on collider b is f * B + b.
    table = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])  # three fields, two colliders
    for b, heights in enumerate([((0, 0, 0), (0, 0, -5.0)), ((0, 0, -5.0), (0, 0, 0))]):
        floors = Solids(device, ["plane", "plane"], [heights], Rotation.identity(2), friction=table)
        after, _ = floors.collide_pair(np.zeros((3, 3)), np.array([[1.0, 0, -1.0]] * 3), gate=0.1, field=np.arange(3))
        assert after[:, 0] == pytest.approx(1.0 - table.reshape(3, 2)[:, b], abs=1e-6)


def test_environments_and_solids_have_rows_of_their_own(device):
    # Distances of each solid in each environment, the nearest of them, and the friction of an environment.
    position = np.random.default_rng(3).normal(0.0, 0.5, (3, 4, 3))
    own = Solids(device, KINDS, position, Rotation.identity(), friction=np.arange(12.0).reshape(3, 4), rows=3)
    x = random_points(50, seed=3)
    for env in range(3):
        each = np.stack([own.query(x, collider=b, env=env)[1] for b in range(4)])
        assert np.array_equal(own.query(x, env=env)[3], each.min(axis=0))
        for b, kind in enumerate(KINDS):
            alone = Solids(device, [kind], position[env, b], Rotation.identity())
            assert np.array_equal(alone.query(x)[1], each[b])
    floor = Solids(device, ["plane"], (0, 0, 0), Rotation.identity(), friction=[[0.0], [0.5], [2.0]])
    after, _ = floor.collide_pair(np.zeros((3, 3)), np.array([[1.0, 0, -1.0]] * 3), env=np.arange(3))
    assert after[:, 0] == pytest.approx([1.0, 0.5, 0.0], abs=1e-6)


def test_the_gate_is_a_distance(device):
    floor = Solids(device, ["plane"], (0, 0, 0.1), Rotation.identity(), friction=0.2)
    x = np.array([[0, 0, 0.1 + d] for d in (-5.0, 0.0, 0.029, 0.031, 1.0)])
    v = np.array([[0.3, 0, -1.0]] * 5)
    for after, slid in zip(floor.collide_pair(x, v, gate=0.03), (0.1, 0.3), strict=True):
        assert after == pytest.approx(np.array([[slid, 0, 0]] * 3 + [[0.3, 0, -1.0]] * 2), abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_what_the_grid_did_not_see_only_stops_approaching(device, kind):
    # No friction, and no velocity of the surface: the grid has met that already.
    solid = Solids(device, [kind], velocity=(5.0, 4.0, -3.0), spin=(1.0, 2.0, 3.0), friction=10.0)
    x, v = world(random_points(seed=8)), np.random.default_rng(9).normal(size=(3000, 3))
    normal = solid.query(x)[0]
    _, unseen = solid.collide_pair(x, v)
    vn = np.einsum("ni,ni->n", v, normal)
    assert unseen == pytest.approx(v - np.minimum(vn, 0.0)[:, None] * normal, abs=1e-5)


# ---- motion
def test_a_solid_turns_as_the_closed_form_says(device):
    # 1 rad/s about a slanted axis, in 150 steps, while it flies; a solid at rest keeps its bits.
    axis, velocity = np.array([1.0, -2.0, 2.0]) / 3.0, np.array([0.3, 0.2, -0.1])
    solids = Solids(
        device, ["box"] * 2, POSITION, Rotation.concatenate([TURN] * 2), [velocity, 0 * axis], [axis, 0 * axis]
    )
    before = solids.boundaries.rotation.numpy()[0, 1].copy()
    duration, steps = 0.5 * np.pi, 150
    solids.move(duration / steps, steps)
    now = Rotation.from_quat(solids.boundaries.rotation.numpy()[0, 0].astype(float))
    assert (now.inv() * Rotation.from_rotvec(duration * axis) * TURN).magnitude() < 1e-5
    assert np.linalg.norm(solids.boundaries.rotation.numpy()[0, 0]) == pytest.approx(1.0, abs=1e-6)
    place = solids.boundaries.position.numpy()[0]
    assert np.abs(place - [POSITION + duration * velocity, POSITION]).max() < 1e-5
    assert np.array_equal(solids.boundaries.rotation.numpy()[0, 1], before)
