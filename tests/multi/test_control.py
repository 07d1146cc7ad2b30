"""Worlds of several agents whose joints move under torques."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.mark.parametrize("control", ["pd", "torque"])
def test_a_run_repeats_and_agents_that_fall_stay_in(make_game, play, game_name, control):
    """Nothing lets go of a root that nothing holds; agents leave by their task's rules only."""
    world = make_game(game_name, control=control)
    runs = []
    for _ in range(2):
        world.reset(seed=3)
        runs.append(play(world, 15, np.random.default_rng(0)))
    for first, second in zip(*runs, strict=True):
        for a, b in zip(first[:2], second[:2], strict=True):
            assert all(np.array_equal(a[name], b[name]) for name in a)
    infos = [info for row in runs[0] for info in row[4].values()]
    assert all(info["failure"] is None and not info["root_released"] for info in infos)
    assert not any(np.any(info["root_force"]) for info in infos)
    assert all("root" not in name for name in world.action_names)
