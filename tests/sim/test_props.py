"""Props among the particles: placed as rigid bodies, tracked as such, made heavier at the same wave speed."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.core.arrays import matrices_of
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.types import Kinematic, Particles
from piavatar_envs.sim import prop_geometry as geometry
from piavatar_envs.sim.props import Prop, PropMatter, PropState, place_prop, scale_density, track_prop

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
        """Vectors ``(E, P, 3)``, matrices ``(E, P, 3, 3)``."""
        array = getattr(self, name)
        return matrices_of(array) if name in ("C", "F") else array.numpy()

    def array(self, values, dtype):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def place(self, rng, mask=(True,) * NUM_ENVS):
        """A random motion in every environment: rotations, positions, velocities, spins of this prop."""
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
    """Angle between rotations [rad]."""
    return (Rotation.from_quat(quaternions).inv() * Rotation.from_matrix(matrices)).magnitude().max()


def test_placed_particles_move_rigidly(device):
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


def test_placing_touches_only_the_prop_and_the_masked_environments(device):
    scene = Scene(device)
    scene.place(np.random.default_rng(1), mask=(True, False, True, False))
    for name in ("x", "u", "C", "F", "vk", "turning"):
        values = scene.read(name)
        foreign = np.concatenate([values[:, :BEFORE], values[:, scene.own.stop :]], axis=1)
        assert np.all(foreign == np.float32(POISON)), name
        assert np.all(values[[1, 3]] == np.float32(POISON)), name
        assert not np.any(values[[0, 2], scene.own] == np.float32(POISON)), name


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


def test_tracking_sees_the_total_velocity(device):
    """The prescribed part counts as well."""
    scene = Scene(device)
    _, _, velocity, spin = scene.place(np.random.default_rng(3))
    half = 0.5 * scene.u.numpy()[:, scene.own]
    scene.write("u", half)
    scene.write("vk", half)
    tracked = scene.track()
    assert np.abs(tracked["velocity"] - velocity).max() < 2e-6
    assert np.abs(tracked["spin"] - spin).max() < 1e-4


@pytest.mark.parametrize("rows", ["shared", "own"])
def test_fit_of_a_deformed_prop_against_numpy(device, rows):
    """Kabsch, momentum and angular momentum of a prop whose particles are shaken, in double precision."""
    scene, rng = Scene(device, uneven=rows == "own"), np.random.default_rng(4)
    scene.place(rng)
    mass = scene.mass.copy()
    m = rng.uniform(0.5, 2.0, (len(mass), scene.count))
    m -= (scene.rest @ np.linalg.lstsq(scene.rest, m.T, rcond=None)[0]).T  # the centre stays the rest frame's origin
    assert m.min() > 0.0
    mass[:, scene.own] *= m
    scene.particles.mass.assign(mass)
    scene.write("x", scene.x.numpy()[:, scene.own] + 0.01 * rng.normal(size=(NUM_ENVS, scene.count, 3)))
    scene.write("u", rng.normal(size=(NUM_ENVS, scene.count, 3)))
    tracked = scene.track()
    x, u = (getattr(scene, name).numpy()[:, scene.own].astype(float) for name in ("x", "u"))
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


def test_deformation_of_a_stretch(device):
    """Longer by a tenth along one axis of the body: the turn is seen through it, and a tenth of that axis's spread."""
    scene = Scene(device)
    R, position, _, _ = scene.place(np.random.default_rng(5))
    stretched = scene.rest * [1.1, 1.0, 1.0]
    scene.write("x", position[:, None] + np.einsum("eij,pj->epi", R, stretched))
    tracked = scene.track()
    assert turn_error(tracked["rotation"], R) < 1e-5
    assert tracked["deformation"] == pytest.approx(0.1 * 0.1 / np.sqrt(3.0), rel=1e-3)


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


def test_state_starts_upright(device):
    state = PropState.allocate(2, 3, device).numpy()
    assert np.array_equal(state["rotation"], np.broadcast_to(np.float32([0, 0, 0, 1]), (2, 3, 4)))
    assert state["position"].shape == (2, 3, 3) and state["deformation"].shape == (2, 3)
