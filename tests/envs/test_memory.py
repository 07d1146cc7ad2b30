"""Steps allocate nothing that stays: neither Warp's arrays, nor Python objects, nor pages of the process."""

from __future__ import annotations

import gc
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import warp as wp


def resident_bytes() -> int:
    """Return the memory of this process that is in RAM."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def steps(env, count: int, actions: np.ndarray) -> None:
    for n in range(count):
        env.step(actions[n % len(actions)])


@pytest.fixture
def warmed_up(make_env, sample_id):
    env = make_env(sample_id, episode_seconds=3600.0)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (8, *env.action_space.shape))
    env.reset(seed=0)
    steps(env, 10, actions)
    return env, actions


def test_a_step_makes_no_array_on_the_device(warmed_up, monkeypatch):
    env, actions = warmed_up
    device = wp.get_device(env.batch.device)
    allocator, made = device.get_allocator(), []

    class Counting:
        def __getattr__(self, name):
            return getattr(allocator, name)

        def allocate(self, size):
            made.append(size)
            return allocator.allocate(size)

    monkeypatch.setattr(device, "get_allocator", lambda *args, **kwargs: Counting())
    wp.zeros(7, dtype=float, device=device)
    assert made == [28], "the count must include every allocation"
    made.clear()
    env.batch.step()
    env.batch.step()
    assert not made
    steps(env, 5, actions)
    # an action on its way to a GPU may be staged
    assert len(made) <= (0 if device.is_cpu else 5)


def test_python_objects_do_not_pile_up(warmed_up):
    env, actions = warmed_up
    tracemalloc.start()
    try:
        held = []
        for _ in range(3):
            steps(env, 20, actions)  # five times as slow as without tracemalloc
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    # a leak of one observation a step would be 20 x 1 kB each time; a cache that fills grows once
    grown = np.diff(held).min()
    assert grown < 5_000, f"{grown} bytes in 20 steps"


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc to read the memory of the process from")
def test_the_process_does_not_grow(warmed_up):
    env, actions = warmed_up
    steps(env, 50, actions)
    before = resident_bytes()
    for _ in range(4):
        env.reset()
        steps(env, 50, actions)
    assert resident_bytes() - before < 4 * 2**20
