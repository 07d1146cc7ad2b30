"""Props: particles with volume, centre and inertia of the solid; placed and tracked as rigid bodies."""

from __future__ import annotations

import pickle
import sys

import numpy as np
import pytest
import warp as wp
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.asset import mesh_volume
from piavatar_envs.config import ConfigError, EnvConfig, PropConfig, load_config
from piavatar_envs.core.arrays import matrices_of
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import Kinematic, Particles
from piavatar_envs.sim import prop_geometry as geometry
from piavatar_envs.sim.props import Prop, PropMatter, PropState, place_prop, prop_points, scale_density, track_prop

#: Foreign particles before and after the prop, which nothing here may touch.
BEFORE, AFTER = 5, 3
NUM_ENVS, NUM_PROPS, INDEX = 4, 3, 1
DENSITY = 300.0
POISON = 7.0e7


class Scene:
    """A box among foreign particles in several environments, all outputs poisoned."""

    def __init__(self, device, uneven=False):
        self.device = device
        points = geometry.box((0.1, 0.06, 0.15), 0.05)
        self.rest, self.count = points.rest.astype(float), len(points)
        self.total = BEFORE + self.count + AFTER
        self.own = slice(BEFORE, BEFORE + self.count)
        self.prop = Prop()
        self.prop.first, self.prop.count = BEFORE, self.count
        self.prop.rest = wp.array(points.rest, dtype=wp.vec3, device=device)
        mass = np.full((1, self.total), 1e6, np.float32)
        mass[:, self.own] = DENSITY * points.volume
        if uneven:
            mass = np.repeat(mass, NUM_ENVS, axis=0)
        self.mass = mass
        self.particles = make_struct(Particles, mass=wp.array(mass, dtype=float, device=device))
        shape = (NUM_ENVS, self.total)
        self.x, self.u, self.vk, self.turning = (self.poisoned(shape, wp.vec3) for _ in range(4))
        self.C, self.F = (self.poisoned((NUM_ENVS, 9, self.total), float) for _ in range(2))
        self.failure = wp.zeros(NUM_ENVS, dtype=int, device=device)
        self.spawn, self.state = (PropState.allocate(NUM_ENVS, NUM_PROPS, device) for _ in range(2))
        for array in vars(self.state).values():
            array.assign(np.full_like(array.numpy(), POISON))

    def poisoned(self, shape, dtype):
        array = wp.zeros(shape, dtype=dtype, device=self.device)
        array.assign(np.full_like(array.numpy(), POISON))
        return array

    def read(self, name):
        """Return vectors ``(E, P, 3)``, matrices ``(E, P, 3, 3)``."""
        array = getattr(self, name)
        return matrices_of(array) if name in ("C", "F") else array.numpy()

    def array(self, values, dtype):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def place(self, rng, mask=(True,) * NUM_ENVS):
        """Place the prop in a random motion in every environment; return rotations, positions, velocities, spins."""
        rotation = Rotation.random(NUM_ENVS * NUM_PROPS, random_state=rng)
        position, velocity, spin = rng.normal(size=(3, NUM_ENVS, NUM_PROPS, 3)) * [[[[3.0]]], [[[2.0]]], [[[5.0]]]]
        self.spawn.rotation.assign(rotation.as_quat().reshape(NUM_ENVS, NUM_PROPS, 4).astype(np.float32))
        for name, value in (("position", position), ("velocity", velocity), ("spin", spin)):
            getattr(self.spawn, name).assign(value.astype(np.float32))
        spawn = self.spawn
        wp.launch(
            place_prop,
            (NUM_ENVS, self.count),
            [self.array(mask, wp.bool), self.prop, INDEX, spawn.position, spawn.rotation, spawn.velocity, spawn.spin],
            [self.x, self.u, self.C, self.F, make_struct(Kinematic, vk=self.vk, spin=self.turning)],
            device=self.device,
        )
        turns = rotation.as_matrix().reshape(NUM_ENVS, NUM_PROPS, 3, 3)
        return turns[:, INDEX], position[:, INDEX], velocity[:, INDEX], spin[:, INDEX]

    def track(self):
        state = self.state
        wp.launch(
            track_prop,
            NUM_ENVS,
            [self.prop, INDEX, self.particles, self.x, self.u, self.vk, self.failure],
            [state.position, state.rotation, state.velocity, state.spin, state.deformation],
            device=self.device,
        )
        return {name: value[:, INDEX].astype(float) for name, value in state.numpy().items()}

    def write(self, name, own):
        """Give the prop's particles new values."""
        values = getattr(self, name).numpy()
        values[:, self.own] = own
        getattr(self, name).assign(values)


def turn_error(quaternions, matrices):
    """Return the angle between rotations [rad]."""
    return (Rotation.from_quat(quaternions).inv() * Rotation.from_matrix(matrices)).magnitude().max()


def test_placed_particles_move_rigidly_and_no_others(device):
    scene = Scene(device)
    R, position, velocity, spin = scene.place(np.random.default_rng(0))
    arm = np.einsum("eij,pj->epi", R, scene.rest)
    names = ("x", "u", "C", "F", "vk", "turning")
    x, u, C, F, vk, turning = (scene.read(name)[:, scene.own].astype(float) for name in names)
    assert np.abs(x - (position[:, None] + arm)).max() < 2e-6
    assert np.abs(u - (velocity[:, None] + np.cross(spin[:, None], arm))).max() < 1e-5
    # the affine matrix carries the same motion on to the next point
    step = np.array([0.01, -0.02, 0.03])
    assert np.abs(C @ step - np.cross(spin, step)[:, None]).max() < 1e-6
    assert np.array_equal(F, np.broadcast_to(np.eye(3), F.shape))
    assert not vk.any() and not turning.any()
    # nothing else is touched
    before = scene.x.numpy().copy()
    scene.place(np.random.default_rng(1), mask=(True, False, True, False))
    changed = (scene.x.numpy() != before).any(axis=2)
    assert changed[[0, 2], scene.own].all() and not changed[[1, 3]].any()
    for name in names:
        foreign = np.delete(scene.read(name), np.r_[scene.own], axis=1)
        assert np.all(foreign == np.float32(POISON)), name


def test_tracking_reads_back_what_was_placed(device):
    scene = Scene(device)
    R, position, velocity, spin = scene.place(np.random.default_rng(2))
    tracked = scene.track()
    assert np.abs(tracked["position"] - position).max() < 2e-6
    assert turn_error(tracked["rotation"], R) < 1e-5
    assert np.abs(tracked["velocity"] - velocity).max() < 2e-6
    assert np.abs(tracked["spin"] - spin).max() < 1e-4
    assert tracked["deformation"].max() < 1e-6
    others = np.delete(scene.state.position.numpy(), INDEX, axis=1)
    assert np.all(others == np.float32(POISON))


def test_a_prop_that_only_flies_has_the_velocity_of_its_particles_and_no_spin(device):
    # to the bit: sums of the velocities themselves lose as many digits as the prop is fast and has particles
    scene, rng = Scene(device), np.random.default_rng(3)
    scene.place(rng)
    velocity = (30.0 * rng.normal(size=(NUM_ENVS, 1, 3))).astype(np.float32)
    scene.write("u", velocity)
    scene.write("vk", 0.0)
    tracked = scene.track()
    assert np.array_equal(tracked["velocity"], velocity[:, 0]) and not tracked["spin"].any()


@pytest.mark.parametrize("rows", ["shared", "own"])
def test_fit_of_a_deformed_prop_against_numpy(device, rows):
    # Kabsch, momentum and angular momentum of a prop whose particles are shaken, in double precision.
    scene, rng = Scene(device, uneven=rows == "own"), np.random.default_rng(4)
    scene.place(rng)
    mass = scene.mass.copy()
    m = rng.uniform(0.5, 2.0, (len(mass), scene.count))
    m -= (scene.rest @ np.linalg.lstsq(scene.rest, m.T, rcond=None)[0]).T  # the centre stays the rest frame's origin
    assert m.min() > 0.0
    mass[:, scene.own] *= m
    scene.particles.mass.assign(mass)
    scene.write("x", scene.x.numpy()[:, scene.own] + 0.01 * rng.normal(size=(NUM_ENVS, scene.count, 3)))
    for name in ("u", "vk"):
        scene.write(name, rng.normal(size=(NUM_ENVS, scene.count, 3)))
    tracked = scene.track()
    x, u, vk = (getattr(scene, name).numpy()[:, scene.own].astype(float) for name in ("x", "u", "vk"))
    u += vk  # the prescribed part of the velocity counts as well
    for e in range(NUM_ENVS):
        w = mass[min(e, len(mass) - 1), scene.own].astype(float)
        centre, V = w @ x[e] / w.sum(), w @ u[e] / w.sum()
        d = x[e] - centre
        turn, distance = Rotation.align_vectors(d, scene.rest, weights=w)
        second = np.einsum("p,pi,pj->ij", w, d, d)
        spin = np.linalg.solve(np.trace(second) * np.eye(3) - second, w @ np.cross(d, u[e] - V))
        assert np.abs(tracked["position"][e] - centre).max() < 1e-6
        assert turn_error(tracked["rotation"][e], turn.as_matrix()) < 1e-5
        assert np.abs(tracked["velocity"][e] - V).max() < 1e-6
        assert np.abs(tracked["spin"][e] - spin).max() < 1e-4
        assert tracked["deformation"][e] == pytest.approx(distance / np.sqrt(w.sum()), rel=1e-4)
        assert tracked["deformation"][e] > 0.01


def test_a_failed_environment_keeps_its_last(device):
    scene, rng = Scene(device), np.random.default_rng(6)
    scene.place(rng)
    first = scene.track()
    scene.place(rng)
    scene.failure.assign(np.array([0, 2, 0, 1], np.int32))
    second = scene.track()
    for name in first:
        if name != "deformation":
            assert np.array_equal(second[name][[1, 3]], first[name][[1, 3]])
            assert not np.array_equal(second[name][[0, 2]], first[name][[0, 2]])


def test_density_scales_at_the_same_wave_speed(device):
    scene = Scene(device)
    matter = PropMatter()
    matter.density, matter.mu, matter.lam = DENSITY, 2.0e3, 5.0e3
    shape = (NUM_ENVS, scene.total)
    mass, mu, lam = (scene.poisoned(shape, float) for _ in range(3))
    volume = scene.array((scene.mass / DENSITY).astype(np.float32), float)
    density = np.array([30.0, 300.0, 900.0, 55.0], np.float32)
    mask = np.array([True, True, True, False])
    inputs = [scene.array(mask, wp.bool), scene.prop, scene.array(density, float), matter, volume]
    wp.launch(scale_density, (NUM_ENVS, scene.count), inputs, [mass, mu, lam], device=device)
    mass, mu, lam = (array.numpy().astype(float) for array in (mass, mu, lam))
    own = np.s_[mask, scene.own]
    rho = mass[own] / volume.numpy()[:, scene.own]
    assert rho == pytest.approx(np.broadcast_to(density[mask, None], rho.shape), rel=1e-6)
    speed = np.sqrt((lam[own] + 2.0 * mu[own]) / rho)
    assert speed == pytest.approx(np.full_like(speed, np.sqrt(9.0e3 / DENSITY)), rel=1e-6)
    assert lam[own] / mu[own] == pytest.approx(np.full_like(rho, 2.5), rel=1e-6)  # nor does Poisson's ratio change
    for array in (mass, mu, lam):
        assert np.all(array[3] == np.float32(POISON))
        assert np.all(np.delete(array, np.r_[scene.own], axis=1) == np.float32(POISON))


RADIUS, HALF_SIZE, TUBE = 0.11, (0.1, 0.2, 0.05), (0.06, 0.15)
SPACINGS = (10.0, 0.06, 0.012)


def capsule_integrals(radius, half_length):
    """Return the volume, and mean squares across and along the axis, from discs stacked along it."""

    def integral(of_disc):
        def disc(z):
            return of_disc(radius**2 - max(abs(z) - half_length, 0.0) ** 2, z)

        end = radius + half_length
        return quad(disc, -end, end, points=[-half_length, half_length], epsabs=1e-12)[0]

    volume = integral(lambda square, z: np.pi * square)
    across = integral(lambda square, z: np.pi * square**2 / 4)
    along = integral(lambda square, z: np.pi * square * z**2)
    return volume, across / volume, along / volume


def solids():
    """Return maker of particles, volume, mean of x^2, y^2 and z^2, and whether points are outside, by solid."""
    a = np.array(HALF_SIZE)
    volume, across, along = capsule_integrals(*TUBE)

    def beyond_capsule(p):
        axis = p - np.clip(p[:, 2], -TUBE[1], TUBE[1])[:, None] * [0, 0, 1]
        return np.linalg.norm(axis, axis=1) - TUBE[0]

    return [
        pytest.param(
            lambda spacing: geometry.sphere(RADIUS, spacing),
            4 / 3 * np.pi * RADIUS**3,
            np.full(3, RADIUS**2 / 5),
            lambda p: np.linalg.norm(p, axis=1) - RADIUS,
            id="sphere",
        ),
        pytest.param(
            lambda spacing: geometry.box(HALF_SIZE, spacing),
            8 * a.prod(),
            a**2 / 3,
            lambda p: (np.abs(p) - a).max(axis=1),
            id="box",
        ),
        pytest.param(
            lambda spacing: geometry.capsule(*TUBE, spacing),
            volume,
            np.array([across, across, along]),
            beyond_capsule,
            id="capsule",
        ),
    ]


def moments(points):
    """Return the volume, centre and mean of ``x x^T`` of point masses, in double precision."""
    rest, volume = points.rest.astype(float), points.volume.sum()
    share = points.volume / volume
    return volume, share @ rest, np.einsum("p,pi,pj->ij", share, rest, rest)


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize(("make", "volume", "squares", "beyond"), solids())
def test_mass_centre_and_inertia_are_the_solids(make, volume, squares, beyond, spacing):
    points = make(spacing)
    assert len(points) >= geometry.MIN_PARTICLES and np.linalg.matrix_rank(points.rest) == 3  # it can be seen to roll
    total, centre, spread = moments(points)
    assert points.volume.dtype == np.float64 and np.all(points.volume > 0.0)
    assert total == pytest.approx(volume, rel=1e-14 if volume != pytest.approx(capsule_integrals(*TUBE)[0]) else 1e-9)
    assert np.abs(centre).max() < 1e-8
    assert spread == pytest.approx(np.diag(squares), abs=1e-5 * squares.max())
    assert beyond(points.rest.astype(float)).max() < 0.0


@pytest.mark.parametrize(("make", "volume", "squares", "beyond"), solids())
def test_particles_are_even_and_as_dense_as_asked(make, volume, squares, beyond):
    spacing = 0.015
    points = make(spacing)
    assert len(points) == pytest.approx(volume / spacing**3, rel=0.2)
    assert points.volume.min() > 0.25 * points.volume.max()
    gap = np.linalg.norm(points.rest[:, None] - points.rest[None], axis=-1) + np.eye(len(points))
    assert 0.5 * spacing < gap.min(axis=1).min() and gap.min(axis=1).max() < 1.3 * spacing


@pytest.mark.parametrize(("make", "volume", "squares", "beyond"), solids())
def test_surface_is_closed_outward_and_where_the_solid_is(make, volume, squares, beyond):
    points = make(0.03)
    vertices, faces = points.vertices.astype(float), points.faces
    assert np.abs(beyond(vertices)).max() < 1e-7
    assert mesh_volume(vertices, faces) == pytest.approx(volume, rel=0.02)
    # closed: every edge has its opposite, vertices of equal place taken for one
    place = np.unique(vertices.round(6), axis=0, return_inverse=True)[1].ravel()[faces]
    edges = np.concatenate([place[:, [k, (k + 1) % 3]] for k in range(3)])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert np.array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: geometry.sphere(np.nan, 0.03), "radius=nan"),
        (lambda: geometry.sphere(0.1, 0.0), "spacing=0.0"),
        (lambda: geometry.box((0.1, 0.0, 0.1), 0.03), r"half_size\[1\]=0.0"),
        (lambda: geometry.box((0.1, 0.2), 0.03), "three lengths"),
        (lambda: geometry.capsule(0.1, np.inf, 0.03), "half_length=inf"),
        (lambda: geometry.sphere(0.1, 1e-3), r"8e\+06 cells.* spacing above 0\.0034 m"),
        (lambda: geometry.mesh("solid.obj", 0.05, -1.0), r"scale=-1\.0"),
    ],
)
def test_bad_lengths_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# ---- meshes
def write_obj(path, vertices, faces, texture=False):
    """Write a mesh as text; ``texture`` gives each corner of each triangle a texture coordinate of its own."""
    lines = ["mtllib no_such_file.mtl", "usemtl skin"] + [f"v {x} {y} {z}" for x, y, z in vertices]
    if texture:
        lines += [f"vt {n / (3 * len(faces))} 0.5" for n in range(3 * len(faces))]
    for f, corners in enumerate(faces):
        words = [f"{v + 1}/{3 * f + k + 1}" if texture else f"{v + 1}" for k, v in enumerate(corners)]
        lines.append(" ".join(["f", *words]))
    path.write_text("\n".join(lines) + "\n")
    return path


#: A simplex of unit legs, and the mean of x x^T about its centre: 3/80 on the diagonal, -1/80 off it.
TETRAHEDRON = (
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)
TETRAHEDRON_SPREAD = (4 * np.eye(3) - 1) / 80


@pytest.fixture
def trimesh():
    return pytest.importorskip("trimesh", reason="an optional extra")


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("spacing", [0.2, 0.07])
def test_mesh_against_the_integrals_of_a_tetrahedron(trimesh, tmp_path, spacing, inverted):
    vertices, faces = TETRAHEDRON
    shift, scale = np.array([3.0, -2.0, 7.0]), 0.5
    path = write_obj(tmp_path / "solid.obj", vertices + shift, faces[:, ::-1] if inverted else faces)
    points = geometry.mesh(path, spacing * scale, scale)
    total, centre, spread = moments(points)
    assert total == pytest.approx(scale**3 / 6, rel=1e-12)
    assert np.abs(centre).max() < 1e-7
    assert spread == pytest.approx(scale**2 * TETRAHEDRON_SPREAD, abs=1e-4 * scale**2)
    assert mesh_volume(points.vertices, points.faces) == pytest.approx(total, rel=1e-5)  # and outward
    assert np.sort(points.vertices, axis=0) == pytest.approx(np.sort(scale * (vertices - 0.25), axis=0), abs=1e-6)
    at = points.rest / scale + 0.25
    assert at.min() > 0.0 and at.sum(axis=1).max() < 1.0


#: Three bars along the axes, apart from each other: most of the bounding box, and its middle, are empty.
BARS = np.array([[[0, 0, 0], [1, 0.2, 0.2]], [[0, 0.25, 0], [0.2, 1, 0.2]], [[0, 0, 0.25], [0.2, 0.2, 1]]])


@pytest.mark.parametrize("suffix", geometry.MESH_FORMATS)
def test_every_format_gives_the_same_prop(trimesh, tmp_path, suffix):
    shape = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in BARS])
    path = tmp_path / f"bars{suffix}"
    shape.export(path)
    points = geometry.mesh(path, 0.06)
    total, centre, spread = moments(points)
    edges = BARS[:, 1] - BARS[:, 0]
    share = edges.prod(axis=1) / edges.prod(axis=1).sum()
    middles = BARS.mean(axis=1)
    of_bars = np.einsum("b,bi,bj->ij", share, middles, middles) + np.diag(share @ edges**2) / 12.0
    middle = share @ middles
    assert total == pytest.approx(edges.prod(axis=1).sum(), rel=1e-6)
    assert np.abs(centre).max() < 1e-7
    assert spread == pytest.approx(of_bars - np.outer(middle, middle), abs=0.02 * np.trace(spread))
    at = points.rest + middle
    assert np.any([np.all((at > low) & (at < high), axis=1) for low, high in BARS], axis=0).all()


def test_between_the_teeth_of_a_comb_there_is_nothing(trimesh, tmp_path):
    # Four plates, two to a cell: the middle of what a cell holds is in the gap, and no particle may stay there.
    low = np.array([[0.06 * k, 0.0, 0.0] for k in range(4)])
    plates = [trimesh.creation.box(bounds=[corner, corner + [0.03, 0.4, 0.4]]) for corner in low]
    trimesh.util.concatenate(plates).export(tmp_path / "comb.stl")
    points = geometry.mesh(tmp_path / "comb.stl", 0.1)
    assert np.abs(moments(points)[1]).max() < 1e-7
    at = points.rest - points.vertices.min(axis=0)
    assert np.any([np.all((at > c) & (at < c + [0.03, 0.4, 0.4]), axis=1) for c in low], axis=0).all()


@pytest.mark.parametrize("outward", [True, False])
def test_a_hollow_body_is_hollow(trimesh, tmp_path, outward):
    # Also where the file has it inside out.
    outer, inner = (trimesh.creation.box(extents=[edge] * 3) for edge in (0.4, 0.2))
    inner.invert()
    shape = trimesh.util.concatenate([outer, inner])
    if not outward:
        shape.invert()
    shape.export(tmp_path / "hollow.stl")
    points = geometry.mesh(tmp_path / "hollow.stl", 0.04)
    assert points.volume.sum() == pytest.approx(0.4**3 - 0.2**3, rel=1e-6)
    assert np.abs(points.rest).max(axis=1).min() > 0.1 and np.abs(points.rest).max() < 0.2
    assert mesh_volume(points.vertices, points.faces) == pytest.approx(points.volume.sum(), rel=1e-5)


#: Bounds of boxes, which of them face inward, and the union's bounds of boxes that do not overlap, less a cavity.
PARTS = {
    "overlapping": ([[0, 0.4], [0.2, 0.6]], (), 2 * 0.4**3 - 0.2**3, 0.3),
    "overlapping inside out": ([[0, 0.4], [0.2, 0.6]], (1,), 2 * 0.4**3 - 0.2**3, 0.3),
    "apart inside out": ([[0, 0.4], [0.5, 0.9]], (0,), 2 * 0.4**3, 0.45),
    "all inside out": ([[0, 0.4], [0.2, 0.6]], (0, 1), 2 * 0.4**3 - 0.2**3, 0.3),
    "one in another": ([[0, 0.4], [0.1, 0.2]], (), 0.4**3, 0.2),
    "a cavity": ([[0, 0.4], [0.1, 0.3]], (1,), 0.4**3 - 0.2**3, 0.2),
}


@pytest.mark.parametrize("name", list(PARTS))
def test_parts_of_a_mesh_are_united(trimesh, tmp_path, name):
    """Matter of overlapping parts counts once; a part left inside out is solid unless it lies in another."""
    cubes, inward, volume, centre = PARTS[name]
    shapes = [trimesh.creation.box(bounds=[[low] * 3, [high] * 3]) for low, high in cubes]
    for index in inward:
        shapes[index].invert()
    path = tmp_path / "parts.stl"
    trimesh.util.concatenate(shapes).export(path)
    points = geometry.mesh(path, 0.05)
    total, middle, spread = moments(points)
    assert total == pytest.approx(volume, rel=2e-3)
    assert np.abs(middle).max() < 1e-7
    # particles at their places in the file: the surface moves with them
    at = points.rest - points.vertices.min(axis=0)
    inside = np.any([np.all((at > low - 1e-4) & (at < high + 1e-4), axis=1) for low, high in cubes], axis=0)
    assert inside.all() and at.mean() == pytest.approx(centre, abs=5e-3)
    # second moments of the union by inclusion and exclusion of cubes, about its centre
    edges = np.array([high - low for low, high in cubes])
    middles = np.array([0.5 * (low + high) for low, high in cubes]) - centre
    weights = edges**3 * np.where([name == "a cavity" and k == 1 for k in range(2)], -1.0, 1.0)
    along, across = weights @ (middles**2 + edges**2 / 12.0), weights @ middles**2
    if volume < 2 * 0.4**3 and "cavity" not in name:
        both = max(low for low, _ in cubes), min(high for _, high in cubes)
        edge, offset = both[1] - both[0], 0.5 * sum(both) - centre
        along, across = along - edge**3 * (offset**2 + edge**2 / 12.0), across - edge**3 * offset**2
    expected = (across + (along - across) * np.eye(3)) / volume
    assert spread == pytest.approx(expected, abs=0.01 * along / volume)


def test_slivers_and_texture_seams_do_not_open_a_mesh(trimesh, tmp_path):
    # Exporters leave triangles that collapse when vertices are merged.
    vertices, faces = TETRAHEDRON
    extra = np.concatenate([vertices, vertices[1:2]]), np.concatenate([faces, [[1, 4, 2]]])
    plain, sliver, seamed = (
        geometry.mesh(write_obj(tmp_path / f"{name}.obj", *solid, texture=name == "seamed"), 0.1)
        for name, solid in (("plain", TETRAHEDRON), ("sliver", extra), ("seamed", TETRAHEDRON))
    )
    assert np.array_equal(plain.rest, seamed.rest) and np.array_equal(plain.volume, seamed.volume)
    assert sliver.volume.sum() == pytest.approx(1.0 / 6.0, rel=1e-12)


def hollow_ball(trimesh):
    """Return two balls, one inside the other and turned outside in: a skin of 2 mm."""
    inner = trimesh.creation.icosphere(subdivisions=3, radius=0.198)
    inner.invert()
    return trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=3, radius=0.2), inner])


#: Name, contents (bytes, or what makes a shape to export), and the message that refuses it.
BAD_FILES = {
    "model.pkl": (pickle.dumps({"vertices": []}), r"'\.pkl'.* \.glb, \.obj"),
    "model": (b"", "unknown mesh format ''"),
    "pickle.obj": (pickle.dumps({"vertices": []}), r"no triangles"),
    "nothing.obj": (b"", r"no triangles"),
    "noise.glb": (bytes(range(256)), r"readable \.glb mesh"),
    "cloud.ply": (lambda trimesh: trimesh.PointCloud(TETRAHEDRON[0]), r"no triangles"),
    "open.off": (lambda trimesh: trimesh.Trimesh(TETRAHEDRON[0], TETRAHEDRON[1][1:]), r"not watertight \(3 edges"),
    "mixed.off": (
        lambda trimesh: trimesh.Trimesh(TETRAHEDRON[0], [*TETRAHEDRON[1][:2], *TETRAHEDRON[1][2:, ::-1]]),
        r"normals consistent",
    ),
    "sheet.off": (
        lambda trimesh: trimesh.Trimesh(TETRAHEDRON[0][:3], [[0, 1, 2], [0, 2, 1]], process=False),
        r"no volume",
    ),
    "far.off": (lambda trimesh: trimesh.Trimesh(1e39 * TETRAHEDRON[0], TETRAHEDRON[1]), r"a vertex .*e\+39 m"),
    "wide.off": (lambda trimesh: trimesh.Trimesh(1e30 * TETRAHEDRON[0], TETRAHEDRON[1]), r"has .* cells"),
    "shell.stl": (hollow_ball, r"spacing=0\.05 m.* spacing under 0\.025 m"),
}


@pytest.mark.parametrize("name", list(BAD_FILES))
def test_bad_meshes_are_refused(trimesh, tmp_path, name):
    content, message = BAD_FILES[name]
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        content(trimesh).export(path)
    with pytest.raises(ValueError, match=message) as error:
        geometry.mesh(path, 0.05)
    assert name in str(error.value)
    with pytest.raises(FileNotFoundError, match=r"none\.obj"):
        geometry.mesh(tmp_path / "none.obj", 0.05)


def test_defaults_of_a_ball_are_not_those_of_a_mesh(trimesh, tmp_path):
    path = str(tmp_path / "cube.stl")
    trimesh.creation.box(extents=[0.4] * 3).export(path)
    for given in (PropConfig(name="a", shape="mesh", file=path), made(shape="mesh", file=path)):
        assert prop_points(given, 0.05).volume.sum() == pytest.approx(0.4**3, rel=1e-5)
    assert prop_points(made(shape="mesh", file=path, size=[0.5]), 0.05).volume.sum() == pytest.approx(0.2**3, rel=1e-5)
    assert made().size == (0.11,)
    with pytest.raises(ConfigError, match=r"file=.*cube.stl' is for shape='mesh', not 'sphere'"):
        prop_points(made(file=path), 0.05)
    with pytest.raises(ConfigError, match=r"smaller size.* 0\.001, or a coarser physics\.fidelity"):
        prop_points(made(shape="mesh", file=path, size=[100.0]), 0.01)


def made(**settings) -> PropConfig:
    """Return a prop as settings of an environment make it."""
    return load_config(EnvConfig, None, {"scene": {"props": [{"name": "a", **settings}]}}).scene.props[0]


def test_without_trimesh_the_error_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"\[props\]"):
        geometry.mesh(tmp_path / "solid.obj", 0.05)
    assert len(geometry.sphere(RADIUS, 0.05)) >= 8  # needs no extra
