"""Models: refusals with value, limit and remedy; sizes and time steps by rule."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.mpm import memory
from piavatar_envs.mpm.colliders import Collider
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


def test_the_fastest_particle_sets_the_speed_of_sound():
    # The P-wave modulus is from a table of elastic constants.
    points = MaterialPoints.uniform(np.ones(4))
    points.young_modulus[0, 2], points.density[0, 2] = 4e5, 100.0
    modulus = 4e5 * (1.0 - 0.3) / ((1.0 + 0.3) * (1.0 - 2.0 * 0.3))
    assert points.sound_speed() == pytest.approx(np.sqrt(modulus / 100.0), rel=1e-6)


@pytest.mark.parametrize("speed", [0.0, 0.1, 10.0, 11.6, 300.0])
def test_chosen_substeps_are_the_fewest(speed):
    for control_dt, cfl in ((1e-3, 0.3), (1 / 30, 0.5), (0.1, 0.5), (0.1, 0.8)):
        n = choose_num_substeps(control_dt, 0.05, speed, cfl)
        assert speed * control_dt / n <= cfl * 0.05 * (1.0 + 1e-6)
        assert n == 1 or speed * control_dt / (n - 1) > cfl * 0.05
        check_num_substeps(n, control_dt, 0.05, speed)


def test_unstable_time_step_is_refused():
    # The remedy in the message is the fewest substeps that are accepted.
    speed, dx, control_dt = 11.6, 0.05, 1 / 30
    fewest = int(np.ceil(control_dt * speed / (CFL_STABLE * dx)))
    for too_few in (1, fewest - 1):
        with pytest.raises(ValueError, match=f"num_substeps >= {fewest}"):
            check_num_substeps(too_few, control_dt, dx, speed)
    check_num_substeps(fewest, control_dt, dx, speed)


@pytest.fixture(scope="module")
def model_of(device):
    """Return ``build_model`` of 8 particles in a box of 1 m, with some arguments changed."""

    def build_with(points=None, **kwargs):
        points = points or MaterialPoints.uniform(np.full(8, 1e-3))
        return build_model(points, make_grid((0, 0, 0), (1, 1, 1), 0.1), device=device, **kwargs)

    return build_with


def test_active_blocks_are_bounded(model_of):
    # As many as all particles can touch at once, fewer if asked for; a record's stride is 32-bit.
    blocks = model_of().num_blocks
    assert model_of().max_active_blocks == min(8 * 8, blocks) and model_of(max_active_blocks=5).max_active_blocks == 5
    fine = make_grid((0, 0, 0), (4, 4, 4), 0.005)
    field = np.zeros(10**6, int)
    assert memory.bound_active_blocks(memory.MAX_ACTIVE_BLOCKS - 1, field, fine, 1) * 64 * 64 < 2**31
    with pytest.raises(ValueError, match=f"{memory.MAX_ACTIVE_BLOCKS} active blocks"):
        memory.bound_active_blocks(memory.MAX_ACTIVE_BLOCKS, field, fine, 1)


def matter(**constants):
    """Return eight particles, of which one has constants of its own."""
    points = MaterialPoints.uniform(np.full(8, 1e-3))
    for name, value in constants.items():
        getattr(points, name)[0, 3] = value
    return points


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"points": {"volume": 0.0}}, "volume=0"),
        ({"points": {"volume": np.nan}}, "volume=nan"),
        ({"points": {"density": -1.0}}, "density=-1"),
        ({"points": {"poisson_ratio": 0.5}}, "poisson_ratio=0.5"),
        ({"points": {"poisson_ratio": np.nan}}, "poisson_ratio=nan"),
        ({"num_substeps": 0}, "num_substeps=0"),
        ({"num_substeps": 1, "control_dt": 0.1}, r"num_substeps >= \d+"),
        ({"decoupling": "magic"}, "'magic'.*split"),
        ({"path": "heap"}, "'heap'.*plain"),
        ({"max_active_blocks": 0}, "0 active blocks.*at least 1"),
        ({"colliders": [Collider.plane((0, 0, 1), 0.0, -0.1)]}, "friction"),
        ({"fields": Fields(subject=(0, 2))}, "in order"),
        ({"fields": Fields(subject=tuple(range(32)))}, "32 velocity fields exceed 31"),
        ({"fields": Fields(friction=-0.1)}, "-0.1"),
        ({"fields": Fields(normals="mine")}, "'mine'"),
        ({"fields": Fields(gate=np.nan)}, "gate=nan"),
        ({"fields": Fields(subject=(0, 0), density=np.array([1000.0, 8.0]))}, "share one reference density"),
    ],
)
def test_what_cannot_run_is_refused(model_of, settings, message):
    points = matter(**settings.pop("points", {}))
    with pytest.raises(ValueError, match=message):
        model_of(points, **settings)


def test_a_gpus_path_is_refused_on_a_cpu(model_of, device):
    if device != "cpu":
        pytest.skip("of a CPU")
    with pytest.raises(ValueError, match=r"path='tiled'.*cpu takes 'plain'"):
        model_of(path="tiled")


@pytest.mark.parametrize(
    ("upper", "dx", "message"),
    [
        ((1, 1, 0), 0.1, "empty domain"),
        ((1, np.inf, 1), 0.1, "empty domain"),
        ((1, 1, 1), 0.0, "empty domain"),
        ((1, 1, 1), np.nan, "empty domain"),
        ((1, 1, 1), 9e-4, r"2\^30.*dx larger than 0.0009"),
    ],
)
def test_grids_that_cannot_be_are_refused(upper, dx, message):
    with pytest.raises(ValueError, match=message):
        make_grid((0, 0, 0), upper, dx)


@pytest.mark.parametrize("fields", [1, 2])
def test_memory_estimate(model_of, fields):
    # Close to what the arrays take.
    model = model_of(num_envs=3, fields=Fields(tuple(range(fields))))
    state, scratch = allocate(model)
    sums, blocks = scratch.accumulators, scratch.blocks
    grid = [sums.value, sums.offset, sums.fixed, sums.offset_fixed, scratch.velocity, scratch.volume_gradient]
    grid += [scratch.sensors.node, scratch.sensors.touched]
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


def test_a_field_that_never_merges_has_a_density_of_its_own():
    fields = Fields(subject=(0, 0), density=np.array([1000.0, 8.0]), apart=(1,))
    fields.check()
    assert fields.upload(0.1, 1, "cpu").density.numpy().tolist() == [[1000.0, 8.0]]
