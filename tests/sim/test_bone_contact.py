"""Bones that stop at the floor, in environments: drawn bodies, batches and states in the middle of contact."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.torque_control.bone_contact import LAYER
from piavatar_envs.envs.batch_env import BatchEnv

THRASHING = {"fidelity": "coarse", "control": "torque"}
GET_UP = "PIAvatar/GetUp-v0"


def boxes_of(points) -> np.ndarray:
    """Lowest and highest of the particles that track a bone, from its joint [m], shape ``(2, rows, 22, 3)``."""
    arms = [points.rest[:, points.bone == b] - points.joints[:, b, None] for b in range(NUM_JOINTS)]
    return np.stack([np.stack([end(arm, axis=1) for arm in arms], axis=1) for end in (np.min, np.max)])


@pytest.mark.parametrize("pool", [None, 3])
def test_boxes_hold_the_bones_of_the_body_that_was_drawn(make_batch, pool):
    batch = make_batch("PIAvatar/Stand-v0", 3, control="torque", **{"shape.randomize": True, "shape.pool": pool})
    found = []
    for seeds in ([0, 1, 2], [31, 32, 33]):
        batch.reset(seeds=seeds)
        batch.step()
        batch.simulation.shapes.mark_stale()
        workspace = batch.simulation.controllers[0].joints._workspace
        middle, half = workspace.middle.numpy().copy(), workspace.half.numpy().copy()
        boxes = np.stack([middle - half, middle + half])
        np.testing.assert_allclose(boxes, boxes_of(batch.simulation.flesh[0].points), atol=1e-5)
        found.append(boxes)
    assert np.abs(found[1] - found[0]).max() > 1e-3


def thrash(batch: BatchEnv, steps: range) -> dict[str, np.ndarray]:
    """Torques that depend on the step and the environment's seed alone; the state after them."""
    seeds = batch.seed.numpy()
    for step in steps:
        draw = [np.random.default_rng([int(seed), step]).uniform(-1.0, 1.0, batch.action.shape[1:]) for seed in seeds]
        batch.action.assign(np.array(draw, np.float32))
        batch.step()
    return batch.get_state()


def lowest(batch: BatchEnv) -> float:
    """Of the points of bones of all bodies that have come to the layer of flesh, how low they are [m]."""
    tracked = batch.simulation.flesh[0].sampled.bone >= 0
    return float(batch.simulation.state.x.numpy()[:, : len(tracked)][:, tracked, 2].min())


def test_bodies_on_their_bones_are_alike_in_a_batch_and_go_on_from_a_state(make_batch, device):
    batch = make_batch(GET_UP, 2, **THRASHING)
    batch.reset(seeds=[3, 4])
    low = 1.0
    for step in range(14):
        middle = thrash(batch, range(step, step + 1))
        low = min(low, lowest(batch))
    assert 0.0 < low < 1.5 * LAYER  # they have been stopped
    end = thrash(batch, range(14, 20))
    single = make_batch(GET_UP, 1, **THRASHING)
    single.reset(seeds=[4])
    alone = thrash(single, range(20))
    batch.set_state(middle)
    again = thrash(batch, range(14, 20))
    for name, value in end.items():
        np.testing.assert_array_equal(again[name], value, err_msg=name)
        np.testing.assert_array_equal(alone[name][0], value[1], err_msg=name)
