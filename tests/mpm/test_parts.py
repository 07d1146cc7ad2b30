"""Parts of a world that go from gather to scatter by themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from piavatar_envs.mpm.parts import first_groups, parts_of_world
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.solver import MARKS_OF_GROUPS, record_begin, record_end, record_substep, record_substeps
from piavatar_envs.mpm.types import FAILURE_BLOCKS

ARRAYS = ("x", "u", "C", "F")
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
def clash(meet, three_boxes, device):
    """Three boxes that come together on a floor in two worlds, added up by groups, in steps with new marks."""
    if device == "cpu":
        pytest.skip("groups are a GPU's")

    def build(**kwargs):
        world = {"num_substeps": MARKS_OF_GROUPS + 4, "num_envs": 2, "control_dt": 0.015, "scatter": "runs"}
        sim = meet(three_boxes, friction=0.4, planes=[((0.0, 0.0, 1.0), -0.11, 0.5)], **(world | kwargs))
        rng = np.random.default_rng(8)
        shape = (2, len(sim.rest), 3)
        return sim.set(u=sim.state.u.numpy() + rng.normal(0.0, 0.1, shape), vk=rng.normal(0.0, 0.1, shape))

    return build


def recorded(sim, in_parts: bool):
    """A world whose substeps are recorded ``in_parts``, or begin when those before have ended; sensors forget."""
    sim.program, world = Program(sim.model.device), (sim.model, sim.state, sim.scratch)
    record_begin(sim.program, *world)
    if in_parts:
        record_substeps(sim.program, *world)
    else:
        for index in range(sim.model.num_substeps):
            record_substep(sim.program, *world, index)
    record_end(sim.program, *world)
    return sim


@pytest.mark.parametrize("num_substeps", [1, 2, MARKS_OF_GROUPS, MARKS_OF_GROUPS + 4])
def test_parts_are_the_same_substeps_bit_for_bit(clash, num_substeps):
    """Of three bodies in two parts, which collide; what sensors say, too."""
    settings = {"num_substeps": num_substeps, "control_dt": 75e-5 * num_substeps}
    parts, apart = recorded(clash(**settings), True), recorded(clash(**settings), False)
    both = parts_of_world(parts.model)
    assert len(both) == 2 and sum(part.particles[1] for part in both) == parts.model.num_particles
    scatters = [launch.branch for launch in parts.program._launches if launch.kernel.key == "runs_to_grid"]
    marked = (num_substeps - 1) // MARKS_OF_GROUPS
    assert len(scatters) == 2 * num_substeps - 1 - marked and set(scatters) == ({0, 1} if num_substeps > 1 else {0})
    assert parts.program.names.count("mark_particles") == 1 + marked
    for _ in range(2 if num_substeps > 2 else 20 // num_substeps):
        parts.run(), apart.run()
        assert parts.failures == apart.failures == [0, 0]
        for array in ARRAYS:
            np.testing.assert_array_equal(parts.get(array, 1), apart.get(array, 1), err_msg=array)
            np.testing.assert_array_equal(parts.get(array), apart.get(array), err_msg=array)
        for name in SENSED:
            found, expected = (getattr(sim.scratch.sensors, name).numpy() for sim in (parts, apart))
            np.testing.assert_array_equal(found, expected, err_msg=name)
    assert all(np.abs(getattr(apart.scratch.sensors, name).numpy()).max() > 0.0 for name in SENSED)


def test_parts_where_slots_run_out(clash):
    """Particles of one part find no room, while others are scattered: nobody moves, and sensors say what they did."""
    parts, apart = (recorded(clash(max_slots=50), in_parts).run(2) for in_parts in (True, False))
    assert parts.failures == apart.failures == [FAILURE_BLOCKS] * 2
    for array in ARRAYS:
        np.testing.assert_array_equal(parts.get(array, 1), apart.get(array, 1), err_msg=array)
    for name in SENSED:
        found, expected = (getattr(sim.scratch.sensors, name).numpy() for sim in (parts, apart))
        np.testing.assert_array_equal(found, expected, err_msg=name)
    assert parts.sums_are_clear and apart.sums_are_clear


def test_boundaries_that_move_do_so_in_every_substep(clash):
    """Such worlds do not go in parts."""
    sim = clash()
    sim.model = replace(sim.model, moving_boundaries=True)
    names = recorded(sim, True).program.names
    assert names.count("move_colliders") == names.count("runs_to_grid") == sim.model.num_substeps


def test_what_goes_in_parts(clash, meet):
    """Only what groups scatter, of several fields."""
    boxes = [{"box": ((-0.2, -0.1, -0.1), (0.0, 0.1, 0.1))}, {"box": ((0.1, -0.1, -0.1), (0.3, 0.1, 0.1))}]
    assert len(parts_of_world(meet(boxes, scatter="runs").model)) == 2
    assert len(parts_of_world(meet(boxes, scatter="runs_float").model)) == 2
    assert len(parts_of_world(meet(boxes[:1], scatter="runs").model)) == 1
    assert len(parts_of_world(meet(boxes, scatter="singles").model)) == 1
