"""Gathers that find what is scattered next, and parts of a world that go from one to the other by themselves."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from piavatar_envs.mpm.build import MaterialPoints
from piavatar_envs.mpm.memory import MARKS_OF_GROUPS
from piavatar_envs.mpm.parts import first_groups, parts_of_world
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.solver import record_begin, record_end, record_substeps
from piavatar_envs.mpm.types import FAILURE_BLOCKS, FAILURE_CFL

ARRAYS = ("x", "u", "C", "F")
SCATTERS = ("runs_to_grid", "momenta_to_grid")
SENSED = ("boundary_impulse", "pair_impulse", "part_impulse", "penetration")


def groups_of(*fields_and_sizes: tuple[int, int]) -> np.ndarray:
    """Groups of these fields and sizes, as ``begin_groups`` makes them."""
    field, size = np.array(fields_and_sizes).T
    return np.column_stack([np.concatenate([[0], size.cumsum()]), np.append(field, 0)]).astype(np.int32)


@pytest.mark.parametrize(
    ("groups", "expected"),
    [
        ([(0, 128), (0, 60)], [0, 2]),  # one field
        ([(0, 128), (0, 60), (1, 128), (1, 60)], [0, 2, 4]),
        ([(0, 100), (1, 100), (2, 100), (3, 100)], [0, 2, 4]),
        ([(0, 10), (1, 100), (2, 100)], [0, 2, 3]),  # 110 and 100, not 10 and 200
        ([(0, 100), (1, 100), (0, 100)], [0, 3]),  # a field on both sides
        ([(0, 100), (1, 20), (0, 100), (2, 90)], [0, 3, 4]),  # limbs among their trunk
    ],
)
def test_parts_share_no_field_and_are_alike(groups, expected):
    assert first_groups(groups_of(*groups)) == expected


@pytest.fixture
def groups_clash(clash):
    """Three boxes that come together on a floor in two worlds, added up by groups, in steps with new marks."""
    return partial(clash, **{"num_substeps": MARKS_OF_GROUPS + 4, "control_dt": 0.015, "scatter": "runs"})


def same(first, second, arrays=ARRAYS):
    """Whether the particles of two worlds have become the same, bit for bit, and what sensors say of them."""
    for array in arrays:
        np.testing.assert_array_equal(first.get(array, 1), second.get(array, 1), err_msg=array)
        np.testing.assert_array_equal(first.get(array), second.get(array), err_msg=array)
    for name in SENSED:
        found, expected = (getattr(sim.scratch.sensors, name).numpy() for sim in (first, second))
        np.testing.assert_array_equal(found, expected, err_msg=name)


@pytest.mark.parametrize("num_substeps", [1, 2, MARKS_OF_GROUPS, MARKS_OF_GROUPS + 4])
def test_parts_are_the_same_substeps_bit_for_bit(groups_clash, one_by_one, num_substeps):
    """Of three bodies in two parts, which collide; what sensors say, too."""
    settings = {"num_substeps": num_substeps, "control_dt": 75e-5 * num_substeps}
    parts, apart = groups_clash(**settings), one_by_one(groups_clash(**settings))
    both = parts_of_world(parts.model)
    assert len(both) == 2 and sum(part.particles[1] for part in both) == parts.model.num_particles
    scatters = [launch.branch for launch in parts.program._launches if launch.kernel.key in SCATTERS]
    marked = (num_substeps - 1) // MARKS_OF_GROUPS
    assert len(scatters) == 2 * num_substeps - 1 - marked and set(scatters) == ({0, 1} if num_substeps > 1 else {0})
    assert parts.program.names.count("mark_particles") == 1 + marked
    for _ in range(2 if num_substeps > 2 else 20 // num_substeps):
        parts.run(), apart.run()
        assert parts.failures == apart.failures == [0, 0]
        same(parts, apart)
    assert all(np.abs(getattr(apart.scratch.sensors, name).numpy()).max() > 0.0 for name in SENSED)


@pytest.mark.parametrize(("max_slots", "failures"), [(44, [FAILURE_BLOCKS] * 2), (50, [FAILURE_BLOCKS, 0])])
def test_parts_where_slots_run_out(groups_clash, one_by_one, max_slots, failures):
    """Particles of one part find no room, while others are scattered: nobody moves, and sensors say what they did."""
    parts, apart = groups_clash(max_slots=max_slots).run(2), one_by_one(groups_clash(max_slots=max_slots)).run(2)
    assert parts.failures == apart.failures == failures
    same(parts, apart, ("x", "u", "F"))  # only a gather that is the last of a step leaves affine velocities
    assert parts.sums_are_clear and apart.sums_are_clear


def same_everywhere(ahead, apart):
    """Whether all particles of two worlds are the same, bit for bit, and have gone on."""
    start = ahead.get("F")
    ahead.run(2), apart.run(2)
    assert ahead.failures == apart.failures == [0] * ahead.model.num_envs
    assert np.abs(ahead.get("F") - start).max() > 1e-3 and ahead.sums_are_clear
    for array in ARRAYS:
        np.testing.assert_array_equal(ahead.state.numpy()[array], apart.state.numpy()[array], err_msg=array)


@pytest.mark.parametrize("decoupling", ["split", "paper", "none", "no_stress"])
@pytest.mark.parametrize("material", ["neo_hookean", "fixed_corotated"])
def test_what_gathers_find_ahead_is_what_scatters_find(drop, one_by_one, decoupling, material):
    """Of one body, which goes in one part."""
    settings = {"scatter": "runs", "decoupling": decoupling, "material": material, "num_substeps": 18}
    ahead, apart = drop(**settings), one_by_one(drop(**settings))
    assert [ahead.program.names.count(name) for name in SCATTERS] == [1, 17]
    assert "momenta_to_grid" not in apart.program.names
    same_everywhere(ahead, apart)


def test_constants_of_each_environment_ahead(drop, one_by_one):
    """Environments whose particles are made of different matter."""
    density = np.random.default_rng(3).uniform(900.0, 1100.0, (3, 512))
    points = replace(MaterialPoints.uniform(np.full(512, 0.025**3)), density=density)
    same_everywhere(*(record(drop(points=points, scatter="runs")) for record in (lambda sim: sim, one_by_one)))


@pytest.mark.parametrize("decoupling", ["split", "paper"])
def test_particles_far_apart_go_in_turns_ahead(drop, one_by_one, decoupling):
    """Groups of theirs have no room for all of their nodes at once."""
    far = np.random.default_rng(5).uniform(-0.5, 0.5, (300, 3))
    settings = {"rest": far, "planes": [((0.0, 0.0, 1.0), -0.3, 0.5)], "num_substeps": 6, "control_dt": 0.006}
    settings |= {"scatter": "runs", "decoupling": decoupling}
    same_everywhere(drop(**settings), one_by_one(drop(**settings)))


def test_who_fails_ahead_fails_alone(drop):
    """A particle that goes too fast fails in the first gather; other environments do as without it."""
    sound, broken = drop(scatter="runs"), drop(scatter="runs")
    vk = broken.state.vk.numpy()
    vk[1, 7] = [60.0, 0.0, 0.0]
    broken.set(vk=vk)
    sound.run(), broken.run()
    assert broken.failures == [0, FAILURE_CFL, 0] and broken.sums_are_clear
    assert all(np.isfinite(broken.state.numpy()[array]).all() for array in ARRAYS)
    for array in ARRAYS:
        np.testing.assert_array_equal(broken.get(array), sound.get(array), err_msg=array)
        np.testing.assert_array_equal(broken.get(array, 2), sound.get(array, 2), err_msg=array)


def test_what_who_fails_ahead_has_felt_does_not_depend_on_the_past(drop):
    """A particle at the floor that fails in the first gather is scattered once more, in new worlds as in old ones."""
    old, new = drop(scatter="runs").run(3), drop(scatter="runs")
    old.scratch.sensors.sums.zero_()
    new.set(**{array: old.state.numpy()[array] for array in (*ARRAYS, "vk", "spin")})
    for sim in (old, new):
        vk = sim.state.vk.numpy()
        vk[1, sim.get("x", 1)[:, 2].argmin()] = [60.0, 0.0, 0.0]
        sim.set(vk=vk).run()
    assert old.failures == new.failures == [0, FAILURE_CFL, 0]
    found, expected = (sim.scratch.sensors.boundary_impulse.numpy() for sim in (old, new))
    assert np.abs(expected[1]).max() > 0.0
    np.testing.assert_array_equal(found, expected)


def test_worlds_whose_boundaries_move_do_not_go_ahead(groups_clash, one_by_one):
    """Their gather does not know which particles will be near a boundary; these move in every substep."""
    sims = [groups_clash(), groups_clash()]
    for sim in sims:
        sim.model = replace(sim.model, moving_boundaries=True)
        velocity = sim.model.boundaries.velocity
        velocity.assign(np.broadcast_to(np.array([0.2, 0.0, 0.5], np.float32), (*velocity.shape, 3)).copy())
    ahead, apart = sims[0], one_by_one(sims[1])
    ahead.program, world = Program(ahead.model.device), (ahead.model, ahead.state, ahead.scratch)
    record_begin(ahead.program, *world)
    record_substeps(ahead.program, *world)
    record_end(ahead.program, *world)
    known = {*SCATTERS, "grid_to_particles", "grid_to_momenta", "move_colliders"}
    order = [name for name in ahead.program.names if name in known]
    assert order == ["runs_to_grid", "grid_to_particles", "move_colliders"] * ahead.model.num_substeps
    same(ahead.run(), apart.run())


def test_what_goes_in_parts(clash, meet):
    """Only what groups scatter, of several fields."""
    boxes = [{"box": ((-0.2, -0.1, -0.1), (0.0, 0.1, 0.1))}, {"box": ((0.1, -0.1, -0.1), (0.3, 0.1, 0.1))}]
    assert len(parts_of_world(meet(boxes, scatter="runs").model)) == 2
    assert len(parts_of_world(meet(boxes, scatter="runs_float").model)) == 2
    assert len(parts_of_world(meet(boxes[:1], scatter="runs").model)) == 1
    assert len(parts_of_world(meet(boxes, scatter="singles").model)) == 1
