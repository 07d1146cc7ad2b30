"""What cannot run is refused with the value, the limit and the remedy; what can is sized by rule."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.mpm import memory
from piavatar_envs.mpm.colliders import Collider, make_boundaries
from piavatar_envs.mpm.materials import MATERIALS, material_index
from piavatar_envs.mpm.memory import allocate, estimate_bytes
from piavatar_envs.mpm.model import (
    CFL_STABLE,
    Fields,
    MaterialPoints,
    build_model,
    check_num_substeps,
    choose_num_substeps,
    make_grid,
)


def wave_speed(young_modulus, poisson_ratio, density=1000.0):
    """P-wave modulus from any table of elastic constants."""
    modulus = young_modulus * (1.0 - poisson_ratio) / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    return np.sqrt(modulus / density)


@pytest.mark.parametrize(("poisson_ratio", "expected"), [(0.3, 15), (0.45, 25)])
def test_substeps_of_the_default_body(poisson_ratio, expected):
    """E = 1e5 Pa at dx = 5.3 cm: 15 substeps per 1/30 s, 25 near incompressibility."""
    points = MaterialPoints.uniform(np.ones(3), young_modulus=1e5, poisson_ratio=poisson_ratio)
    assert points.sound_speed() == pytest.approx(wave_speed(1e5, poisson_ratio), rel=1e-6)
    assert choose_num_substeps(1.0 / 30.0, 0.053, points.sound_speed()) == expected


def test_fastest_particle_rules():
    points = MaterialPoints.uniform(np.ones(4))
    points.young_modulus[0, 2], points.density[0, 2] = 4e5, 100.0
    assert points.sound_speed() == pytest.approx(wave_speed(4e5, 0.3, 100.0), rel=1e-6)


@pytest.mark.parametrize("control_dt", [1e-3, 1 / 30, 0.1])
@pytest.mark.parametrize("speed", [0.1, 11.6, 300.0])
@pytest.mark.parametrize("cfl", [0.3, 0.5, 0.8])
def test_chosen_substeps_are_the_fewest(control_dt, speed, cfl):
    n = choose_num_substeps(control_dt, 0.05, speed, cfl)
    assert speed * control_dt / n <= cfl * 0.05 * (1.0 + 1e-6)
    assert n == 1 or speed * control_dt / (n - 1) > cfl * 0.05
    check_num_substeps(n, control_dt, 0.05, speed)


def test_exact_multiples_need_no_extra_substep():
    assert choose_num_substeps(0.1, 0.05, 10.0, 0.5) == 40


def test_unstable_time_step_is_refused():
    """The remedy in the message is the fewest substeps that are accepted."""
    speed, dx, control_dt = 11.6, 0.05, 1 / 30
    fewest = int(np.ceil(control_dt * speed / (CFL_STABLE * dx)))
    with pytest.raises(ValueError, match=rf"sim_dt=0.0333 s.*CFL limit 0.00362 s.*c=11.6.*num_substeps >= {fewest}"):
        check_num_substeps(1, control_dt, dx, speed)
    with pytest.raises(ValueError, match="CFL"):
        check_num_substeps(fewest - 1, control_dt, dx, speed)
    check_num_substeps(fewest, control_dt, dx, speed)


def test_dust_without_stiffness_has_no_limit():
    assert choose_num_substeps(1.0, 0.05, 0.0) == 1
    check_num_substeps(1, 1.0, 0.05, 0.0)


@pytest.fixture(scope="module")
def model_of(device):
    """``build_model`` of 8 particles in a box of 1 m, with some arguments changed."""

    def build_with(points=None, **kwargs):
        points = points or MaterialPoints.uniform(np.full(8, 1e-3))
        return build_model(points, make_grid((0, 0, 0), (1, 1, 1), 0.1), device=device, **kwargs)

    return build_with


@pytest.mark.parametrize("num_substeps", [0, -3])
def test_no_substeps_are_refused(model_of, num_substeps):
    with pytest.raises(ValueError, match=rf"num_substeps={num_substeps}.*at least 1"):
        model_of(num_substeps=num_substeps)


def test_model_is_what_was_asked_for(model_of):
    model = model_of(control_dt=0.02, gravity=(0.0, 1.0, -2.0), num_envs=2)
    assert model.num_substeps == choose_num_substeps(0.02, 0.1, model.sound_speed)
    assert model.step.dt * model.num_substeps == pytest.approx(0.02)
    assert list(model.step.gravity) == [0.0, 1.0, -2.0]
    assert model.particles.mass.numpy() == pytest.approx(np.ones((1, 8)))
    state, scratch = allocate(model)
    assert state.x.shape == (2, 8) and scratch.velocity.shape == (2, 2 * 64 * model.max_active_blocks)
    assert np.array_equal(state.numpy()["F"], np.broadcast_to(np.eye(3), (2, 8, 3, 3)))


def test_default_step_is_refused_when_too_long(model_of):
    with pytest.raises(ValueError, match=r"num_substeps >= \d+"):
        model_of(num_substeps=1, control_dt=0.1)


def test_unknown_decoupling(model_of):
    with pytest.raises(ValueError, match=r"'magic'.*split, paper, none, no_stress"):
        model_of(decoupling="magic")


@pytest.mark.parametrize("poisson_ratio", [0.5, -0.2, np.nan])
def test_bad_poisson_ratio(model_of, poisson_ratio):
    with pytest.raises(ValueError, match=rf"poisson_ratio={poisson_ratio}"):
        model_of(MaterialPoints.uniform(np.full(8, 1e-3), poisson_ratio=poisson_ratio))


@pytest.mark.parametrize("name", ["volume", "density"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_matter_has_mass(model_of, name, value):
    points = MaterialPoints.uniform(np.full(8, 1e-3))
    getattr(points, name)[0, 3] = value
    with pytest.raises(ValueError, match=rf"{name}={value:g}.*positive"):
        model_of(points)


def test_unknown_material():
    with pytest.raises(ValueError, match=r"'jelly'"):
        MaterialPoints.uniform(np.ones(1), material="jelly")
    assert [material_index(name) for name in MATERIALS] == list(range(len(MATERIALS)))


@pytest.mark.parametrize(
    ("lower", "upper", "dx"),
    [
        ((0, 0, 0), (1, 1, 0), 0.1),
        ((0, 0, 0), (1, -1, 1), 0.1),
        ((0, 0, 0), (1, 1, 1), 0.0),
        ((0, 0, 0), (1, 1, 1), np.nan),
        ((0, 0, np.nan), (1, 1, 1), 0.1),
        ((0, 0, 0), (1, np.inf, 1), 0.1),
    ],
)
def test_empty_domain(lower, upper, dx):
    with pytest.raises(ValueError, match="empty domain"):
        make_grid(lower, upper, dx)


def test_too_fine_grid():
    with pytest.raises(ValueError, match=r"nodes exceed 2\^30.*dx larger than 0.0009 m"):
        make_grid((0, 0, 0), (1, 1, 1), 9e-4)


def test_active_blocks_are_bounded(model_of):
    """As many as all particles can touch at once, fewer if asked for; a record's stride is 32-bit."""
    blocks = model_of().num_blocks
    assert model_of().max_active_blocks == min(8 * 8, blocks) and model_of(max_active_blocks=5).max_active_blocks == 5
    for active_blocks in (0, -1):
        with pytest.raises(ValueError, match=rf"{active_blocks} active blocks.*at least 1"):
            model_of(max_active_blocks=active_blocks)
    fine = make_grid((0, 0, 0), (4, 4, 4), 0.005)
    field = np.zeros(10**6, int)
    assert memory.bound_active_blocks(memory.MAX_ACTIVE_BLOCKS - 1, field, fine, 1) * 64 * 64 < 2**31
    with pytest.raises(
        ValueError, match=rf"{memory.MAX_ACTIVE_BLOCKS} active blocks.*less than {memory.MAX_ACTIVE_BLOCKS}"
    ):
        memory.bound_active_blocks(memory.MAX_ACTIVE_BLOCKS, field, fine, 1)


def test_unknown_path_is_refused(model_of, device):
    with pytest.raises(ValueError, match=r"'heap'.*plain, tiled, block"):
        model_of(path="heap")
    if device == "cpu":
        with pytest.raises(ValueError, match=r"path='tiled' needs a GPU.*cpu takes 'plain'"):
            model_of(path="tiled")


def test_domain_lies_inside_its_grid():
    grid = make_grid((-0.33, 0.1, 2.0), (0.41, 0.75, 2.3), 0.05)
    top = np.asarray(grid.origin) + 0.05 * (np.asarray(grid.nodes) - 1)
    assert np.all(np.asarray(grid.origin) <= np.array([-0.33, 0.1, 2.0]) - 1.5 * 0.05)
    assert np.all(top >= np.array([0.41, 0.75, 2.3]) + 0.99 * 0.05)
    assert np.all(np.asarray(grid.blocks) * 4 >= np.asarray(grid.nodes))


@pytest.mark.parametrize("plane", [((0, 0, 0), 0.0, 0.5), ((0, 0, 1), 0.0, -0.1), ((0, 0, 1), 0.0, np.nan)])
def test_bad_planes(device, plane):
    with pytest.raises(ValueError, match=r"friction|normal"):
        make_boundaries([Collider.plane(*plane)], 1, 1, device)


@pytest.mark.parametrize("fields", [1, 2])
def test_memory_estimate(model_of, fields):
    """Close to what the arrays take."""
    model = model_of(num_envs=3, fields=Fields(tuple(range(fields))))
    state, scratch = allocate(model)
    sums, blocks = scratch.accumulators, scratch.blocks
    grid = [
        sums.value,
        sums.offset,
        sums.fixed,
        sums.offset_fixed,
        scratch.velocity,
        scratch.volume_gradient,
        scratch.sensors.node,
        scratch.sensors.touched,
    ]
    grid += [blocks.fields, blocks.active, blocks.owner, blocks.contact_blocks]
    arrays = {array.ptr: array.capacity for array in [*vars(state).values(), *grid]}  # two may be one
    taken = sum(arrays.values())
    layout = model.max_active_blocks, fields, model.num_blocks, model.path
    estimate = estimate_bytes(3, model.num_particles, *layout)
    assert taken <= estimate <= 1.25 * taken


def test_batch_that_does_not_fit_is_refused(monkeypatch):
    class Small:
        is_cuda, free_memory = True, 2**30

    monkeypatch.setattr(memory.wp, "get_device", lambda name: Small())
    need = estimate_bytes(1, 3000, 300)
    fits = 2**30 // need
    memory.check_memory(fits, 3000, 300, "cuda:0")
    with pytest.raises(ValueError, match=rf"{10 * fits} environments need .* GiB.*num_envs <= {fits}"):
        memory.check_memory(10 * fits, 3000, 300, "cuda:0")
