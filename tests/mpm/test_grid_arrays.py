"""Grid arrays: what is taken from an accumulator is cleared, and records lie in halves."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.core.arrays import vec4l, vec8
from piavatar_envs.core.structs import make_struct
from piavatar_envs.mpm.grid_arrays import (
    clear_offset,
    finish_take,
    load_accumulator,
    mass_of,
    offset_at,
    quanta_of,
    read_record,
    write_physical,
    write_record,
)
from piavatar_envs.mpm.types import Accumulators, Grid

RECORDS = 64
SLOTS = 3


@wp.kernel
def take_all(
    grid: Grid,
    sums: Accumulators,
    driven: wp.array(dtype=bool),
    taken: wp.array(dtype=vec8),
    offset: wp.array(dtype=wp.vec4),
):
    """Records of field 1 in environment 1."""
    r = wp.tid()
    taken[r] = finish_take(sums, 1, quanta_of(sums, 1, 1), r, load_accumulator(sums, 1, r), driven[r])
    offset[r] = offset_at(grid, sums, 1, 1, r)
    if r % 2 == 0:
        clear_offset(sums, 1, r)


@pytest.mark.parametrize("driven", ["all", "none", "slabs", "some"])
def test_fixed_sums(device, driven):
    """A record with mass is cleared when it is taken, one without is not touched.

    Without contact candidates kinematic momentum is not touched, also next to a node of the same warp with some.
    """
    rng, shape = np.random.default_rng(1), (2, SLOTS, 2, 64, 4)  # environments, slots, halves, nodes
    numbers = rng.integers(-(2**50), 2**50, shape)
    numbers[:, :, 0, :, 0] = np.abs(numbers[:, :, 0, :, 0]) + 1
    numbers[:, :, 1, :, 3] = 0
    numbers[:, :, 0, ::3, 0] = 0
    records = np.arange(64 * SLOTS)
    asks = {"all": records >= 0, "none": records < 0, "slabs": records // 16 % 2 == 0, "some": records % 5 == 0}[driven]
    offsets = rng.integers(-(2**50), 2**50, (2, 64 * SLOTS, 4))
    unit = np.array([[1.0, 2.0**-30]], np.float32), np.array([[1.0, 2.0**-28]], np.float32)
    sums = make_struct(
        Accumulators,
        is_fixed=1,
        value=wp.zeros((1, 1), dtype=wp.vec4, device=device),
        fixed=wp.array(numbers.reshape(2, -1, 4), dtype=vec4l, device=device),
        offset=wp.zeros((1, 1), dtype=wp.vec4, device=device),
        offset_fixed=wp.array(offsets, dtype=vec4l, device=device),
        mass_quantum=wp.array(unit[0], dtype=float, device=device),
        momentum_quantum=wp.array(unit[1], dtype=float, device=device),
    )
    grid = Grid()
    grid.dx = 0.25
    taken = wp.zeros(64 * SLOTS, dtype=vec8, device=device)
    found = wp.zeros(64 * SLOTS, dtype=wp.vec4, device=device)
    inputs = [grid, sums, wp.array(asks, dtype=bool, device=device)]
    wp.launch(take_all, 64 * SLOTS, inputs=inputs, outputs=[taken, found], device=device)
    expected, left = numbers[1].astype(float), sums.fixed.numpy().reshape(shape)
    needed, massive = asks.reshape(SLOTS, 64), numbers[1, :, 0, :, 0] > 0
    expected[:, 0][~massive] = 0.0
    expected[:, 1][~(massive & needed)] = 0.0
    kept = numbers.copy()
    kept[1, :, 0][massive] = 0
    kept[1, :, 1][massive & needed] = 0
    np.testing.assert_array_equal(left, kept)
    scale = np.array([2.0**-30] + 7 * [2.0**-28])
    halves = np.concatenate([expected[:, 0], expected[:, 1]], axis=2).reshape(-1, 8)
    np.testing.assert_allclose(taken.numpy(), scale * halves, rtol=1e-6)
    scale = np.array(3 * [0.25 * 2.0**-30] + [2.0**-30])
    np.testing.assert_allclose(found.numpy(), scale * offsets[1], rtol=1e-6)
    offsets[1, ::2] = 0
    np.testing.assert_array_equal(sums.offset_fixed.numpy(), offsets)


@wp.kernel
def count_up(stride: int, records: wp.array2d(dtype=wp.vec4), mass: wp.array(dtype=float)):
    """Record ``stride t`` is read and written; every second in its first half only."""
    r = stride * wp.tid()
    mass[wp.tid()] = mass_of(records, 0, r)
    summand = vec8(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, float(r))
    if wp.tid() % 2 == 0:
        write_record(records, 0, r, read_record(records, 0, r) + summand)
    else:
        write_physical(records, 0, r, read_record(records, 0, r) + summand)


@pytest.mark.parametrize("stride", [1, 3])
def test_records_have_two_halves(device, stride):
    """The physical halves of a block's 64 nodes come first, then the kinematic ones."""
    start = np.random.default_rng(2).integers(0, 99, (stride, 2, 64, 4)).astype(np.float32)
    records = wp.array(start.reshape(1, -1, 4), dtype=wp.vec4, device=device)
    mass = wp.zeros(RECORDS, dtype=float, device=device)
    wp.launch(count_up, RECORDS, inputs=[stride], outputs=[records, mass], device=device)
    at = stride * np.arange(RECORDS)
    expected = start.copy()
    active, node = at // 64, at % 64
    np.testing.assert_array_equal(mass.numpy(), start[active, 0, node, 0])
    expected[active, 0, node] += np.arange(1, 5)
    active, node, last = active[::2], node[::2], at[::2, None]
    expected[active, 1, node] += np.hstack([np.tile(np.arange(5, 8), (len(last), 1)), last])
    np.testing.assert_array_equal(records.numpy().reshape(start.shape), expected)
