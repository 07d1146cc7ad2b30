"""Sums over the threads that share a piece of work, and records blended by particles."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.avatar.segment_sums import own_share, share_chunks, store_both, store_moments, store_one
from piavatar_envs.avatar.skinning import (
    blend_changes,
    blend_places,
    blend_records,
    blend_steps,
    in_order,
    pack,
    store_record,
)
from piavatar_envs.avatar.types import vec24, vec44
from piavatar_envs.core.arrays import vec8, vec12, vec16
from piavatar_envs.core.cuda_intrinsics import (
    chunk_threads,
    sum_threads12,
    sum_threads16,
    warp_threads,
)

wp.set_module_options({"enable_backward": False})

ROWS, POINTS, BONES = 5, 70, 22


@wp.kernel
def add_up(
    values: wp.array3d(dtype=float), threads: int, out12: wp.array3d(dtype=vec12), out16: wp.array3d(dtype=vec16)
):
    e, c, thread = wp.tid()
    if e == 1:
        return  # the threads of a failed environment leave before the sum
    v12 = vec12()
    v16 = vec16()
    for n in range(16):
        v16[n] = values[e, c, 16 * thread + n]
        if n < 12:
            v12[n] = v16[n]
    out12[e, c, thread] = sum_threads12(v12, threads)
    out16[e, c, thread] = sum_threads16(v16, threads)


@wp.kernel
def store_chunks(
    quarters: wp.array(dtype=wp.vec4i),
    values: wp.array3d(dtype=float),
    threads: int,
    out12: wp.array2d(dtype=vec12),
    out16: wp.array2d(dtype=vec16),
    both16: wp.array2d(dtype=vec16),
    both12: wp.array2d(dtype=vec12),
):
    i, j, k = wp.tid()
    e, share = own_share(quarters, i, j, k, threads)
    first = vec16()
    other = vec12()
    for n in range(share[2], share[3], share[1] >> 8):
        for word in range(16):
            first[word] += values[e, n, word]
        for word in range(12):
            other[word] += values[e, n, 16 + word]
    store_one(out12, e, share, other)
    store_moments(out16, e, share, first)
    store_both(both16, both12, e, share, first, other)


@wp.kernel
def copy_records(source: wp.array2d(dtype=vec44), out: wp.array2d(dtype=vec44)):
    e, b = wp.tid()
    store_record(out, e, b, source[e, b])


@wp.kernel
def blend(
    record: wp.array2d(dtype=vec44),
    change: wp.array2d(dtype=vec8),
    step: wp.array2d(dtype=vec12),
    place: wp.array2d(dtype=wp.mat44),
    skin: wp.array(dtype=wp.vec4),
    rest: wp.array(dtype=wp.vec3),
    out: wp.array2d(dtype=vec24),
    out_change: wp.array2d(dtype=vec8),
    out_step: wp.array2d(dtype=vec12),
    out_place: wp.array2d(dtype=wp.vec3),
):
    e, p = wp.tid()
    out[e, p] = blend_records(record, e, skin, p, rest[p])
    out_change[e, p] = blend_changes(change, e, skin, p)
    out_step[e, p] = blend_steps(step, e, skin, p)
    out_place[e, p] = blend_places(place, e, skin, p, rest[p])


@pytest.mark.parametrize("threads", [1, 2, 8, 32])
def test_threads_add_up_what_each_of_them_has(device, threads):
    """Groups of any size, some of them gone; every thread is told the sum of its own group, in every run the same."""
    threads = min(threads, warp_threads(device))
    values = np.random.default_rng(0).normal(size=(ROWS, 3, 16 * threads)).astype(np.float32)
    expected = values.reshape(ROWS, 3, threads, 16).astype(float).sum(2)
    expected[1] = 0.0
    runs = []
    for _ in range(2):
        out12 = wp.zeros((ROWS, 3, threads), dtype=vec12, device=device)
        out16 = wp.zeros((ROWS, 3, threads), dtype=vec16, device=device)
        given = wp.array(values, dtype=float, device=device)
        wp.launch(add_up, (ROWS, 3, threads), [given, threads], [out12, out16], device=device)
        for n in range(threads):
            np.testing.assert_allclose(out16.numpy()[:, :, n], expected, atol=1e-5)
            np.testing.assert_allclose(out12.numpy()[:, :, n], expected[..., :12], atol=1e-5)
        runs.append(out16.numpy())
    assert np.array_equal(*runs)


def test_quarters_of_a_warp_share_chunks(device):
    """Of any length: one quarter has a short one, two or all four a long one, and each sum is that of its entries."""
    rng, threads = np.random.default_rng(2), warp_threads(device)
    lengths = np.r_[1, 7, 8, 9, 47, 48, 49, 96, 97, 192, 193, 300, rng.integers(1, 300, 9)]
    borders = np.cumsum([0, *lengths])
    bones = rng.integers(0, BONES, len(lengths))
    shares = share_chunks(np.arange(len(lengths)), borders[:-1], borders[1:], bones, device)
    stored = shares[:, 0] >= 0
    assert sorted(shares[stored, 0]) == list(range(len(lengths)))
    assert np.array_equal(shares[stored, 1] % 256, bones[shares[stored, 0]])
    if threads > 1:
        lanes = shares[stored, 1] // 256
        assert len(shares) % 4 == 0 and set(lanes) == {8, 16, 32}
        assert (lengths[shares[stored, 0]] <= 6 * lanes)[lanes < 32].all()
        begin = np.flatnonzero(stored)
        assert not (begin * 8 % lanes).any()  # lanes that share a chunk are those that add up
    values = rng.normal(size=(ROWS, borders[-1], 28)).astype(np.float32)
    expected = np.add.reduceat(values.astype(float), borders[:-1], axis=1)
    shape, warps = (ROWS, len(lengths)), len(shares) // max(1, threads // 8)
    out = [wp.zeros(shape, dtype=dtype, device=device) for dtype in (vec12, vec16, vec16, vec12)]
    given = [wp.array(shares, dtype=wp.vec4i, device=device), wp.array(values, device=device)]
    wp.launch(store_chunks, (ROWS, warps, threads), [*given, threads], out, device=device)
    for array, words in zip(out, (slice(16, 28), slice(16), slice(16), slice(16, 28)), strict=True):
        np.testing.assert_allclose(array.numpy(), expected[..., words], atol=1e-4)


@pytest.mark.parametrize(("chunks", "threads"), [(0, 1), (1, 1), (2, 1), (3, 2), (5, 4), (8, 4), (9, 0), (5000, 0)])
def test_a_thread_adds_about_two_chunks(device, chunks, threads):
    """Where a bone has many, it has a warp of its own; on a CPU one thread adds them up."""
    assert chunk_threads(device, chunks) == (threads if warp_threads(device) > 1 else 1)


def test_particles_blend_the_records_of_their_bones(device):
    """Of the rest position: its places on the bones and the velocities there. The other numbers as they are."""
    rng = np.random.default_rng(2)
    record = rng.normal(size=(ROWS, BONES, 44)).astype(np.float32)
    change = rng.normal(size=(ROWS, BONES, 8)).astype(np.float32)
    steps = rng.normal(size=(ROWS, BONES, 12)).astype(np.float32)
    place = rng.normal(size=(ROWS, BONES, 4, 4)).astype(np.float32)
    joint = rng.integers(0, BONES, size=(POINTS, 4)).astype(np.int32)
    joint, weight = in_order(joint, rng.random((POINTS, 4)) * (np.arange(4) <= rng.integers(0, 4, (POINTS, 1))))
    rest = rng.normal(size=(POINTS, 3)).astype(np.float32)

    def upload(value, dtype):
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device=device)

    out = wp.zeros((ROWS, POINTS), dtype=vec24, device=device)
    out_change = wp.zeros((ROWS, POINTS), dtype=vec8, device=device)
    out_step = wp.zeros((ROWS, POINTS), dtype=vec12, device=device)
    out_place = wp.zeros((ROWS, POINTS), dtype=wp.vec3, device=device)
    stored = wp.zeros((ROWS, BONES), dtype=vec44, device=device)
    wp.launch(copy_records, (ROWS, BONES), [upload(record, vec44)], [stored], device=device)
    skin = [upload(pack(joint, weight), wp.vec4), upload(rest, wp.vec3)]
    inputs = [stored, upload(change, vec8), upload(steps, vec12), upload(place, wp.mat44), *skin]
    wp.launch(blend, (ROWS, POINTS), inputs, [out, out_change, out_step, out_place], device=device)
    of = record[:, joint].astype(float)  # (ROWS, POINTS, 4, 44)
    rows = of[..., :24].reshape(ROWS, POINTS, 4, 6, 4)
    ends = np.einsum("epnqi,pi->epnq", rows[..., :3], rest.astype(float)) + rows[..., 3]
    turn = of[..., 24:33].reshape(ROWS, POINTS, 4, 3, 3)
    step = np.einsum("epnij,epnj->epni", turn, ends[..., :3]) + of[..., 33:36]
    parts = np.concatenate([ends, step, of[..., 24:33], of[..., 36:42]], axis=-1)
    np.testing.assert_allclose(out.numpy(), np.einsum("pn,epnc->epc", weight.astype(float), parts), atol=3e-5)
    expected = np.einsum("pn,epnc->epc", weight.astype(float), change[:, joint].astype(float))
    np.testing.assert_allclose(out_change.numpy()[..., :6], expected[..., :6], atol=1e-5)
    expected = np.einsum("pn,epnc->epc", weight.astype(float), steps[:, joint].astype(float))
    np.testing.assert_allclose(out_step.numpy(), expected, atol=1e-5)
    of = place[:, joint].astype(float)
    ends = np.einsum("epnij,pj->epni", of[..., :3, :3], rest) + of[..., :3, 3]
    np.testing.assert_allclose(out_place.numpy(), np.einsum("pn,epni->epi", weight.astype(float), ends), atol=1e-5)
