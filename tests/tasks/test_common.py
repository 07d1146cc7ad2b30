"""Parts that several tasks share: shaping against the formulas it cites, and the clamp of the root command."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.envs.episodes import Bones
from piavatar_envs.tasks.common.rewards import mean_square_action, tolerance
from piavatar_envs.tasks.common.root_command import clamp_root

LEAD, TURN = 0.2, 0.4


@wp.kernel
def shape(value: wp.array(dtype=float), bound: float, margin: float, out: wp.array(dtype=float)):
    n = wp.tid()
    out[n] = tolerance(value[n], bound, margin)


@wp.kernel
def cost(action: wp.array3d(dtype=float), out: wp.array(dtype=float)):
    e = wp.tid()
    out[e] = mean_square_action(action, e, 0)


@pytest.mark.parametrize(("bound", "margin"), [(0.0, 1.0), (0.1, 0.5), (2.0, 0.01)])
def test_tolerance_is_dm_controls(device, bound, margin):
    """One within the bound, beyond it ``exp(-(x sqrt(-2 ln 0.1))^2 / 2)`` of the excess over the margin."""
    values = np.array([-5.0, 0.0, bound, bound + 0.3 * margin, bound + margin, bound + 3 * margin], np.float32)
    out = wp.zeros(len(values), dtype=float, device=device)
    wp.launch(shape, len(values), [wp.array(values, device=device), bound, margin, out], device=device)
    excess = np.maximum(values.astype(float) - bound, 0.0) / margin
    expected = np.exp(-0.5 * (excess * np.sqrt(-2.0 * np.log(0.1))) ** 2)
    assert out.numpy() == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert out.numpy()[4] == pytest.approx(0.1, rel=1e-3)


def test_actions_cost_their_clipped_mean_square(device):
    actions = np.array([[0.0, 0.0, 0.0], [1.0, -1.0, 1.0], [0.5, 9.0, 0.0], [np.nan, 1.0, -np.inf]], np.float32)
    out = wp.zeros(4, dtype=float, device=device)
    wp.launch(cost, 4, [wp.array(actions[:, None], dtype=float, device=device), out], device=device)
    assert out.numpy()[:3] == pytest.approx([0.0, 1.0, 1.25 / 3.0])
    assert np.isfinite(out.numpy()[3]) and 0.0 <= out.numpy()[3] <= 1.0


def clamped(device, rotation, position, command_rotation, command_root, released=None):
    """The commands after the kernel, quaternions ``xyzw``."""
    n = len(position)
    bones = [np.asarray(a, np.float32)[:, None] for a in (rotation, position, command_rotation)]
    rotations, positions, commands = (
        wp.array(a, dtype=t, device=device) for a, t in zip(bones, (wp.quat, wp.vec3, wp.quat), strict=True)
    )
    root = wp.array(np.asarray(command_root, np.float32), dtype=wp.vec3, device=device)
    down = wp.array(np.zeros(n) if released is None else released, dtype=int, device=device)
    body = Bones()
    body.rotation, body.position = rotations, positions
    wp.launch(clamp_root, n, [LEAD, TURN, body, down, commands, root], device=device)
    return commands.numpy()[:, 0].astype(float), root.numpy().astype(float)


def heading(rotation: Rotation) -> np.ndarray:
    """Turn about the vertical: the twist of the rotation [rad]."""
    q = rotation.as_quat()
    return 2.0 * np.arctan2(q[..., 2], q[..., 3])


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(0)
    n = 200
    tilts = Rotation.from_rotvec(np.c_[rng.uniform(-0.4, 0.4, (n, 2)), np.zeros(n)])
    body = Rotation.from_rotvec(np.c_[np.zeros((n, 2)), rng.uniform(-9.0, 9.0, n)]) * tilts
    ahead = rng.uniform(-1.2, 1.2, n)
    command = Rotation.from_rotvec(np.c_[np.zeros((n, 2)), heading(body) + ahead])
    position = rng.uniform(-2.0, 2.0, (n, 3))
    root = position + rng.uniform(-0.4, 0.4, (n, 3))
    return body, position, command, root, ahead


def test_no_command_leads_by_more_than_the_limits(device, case):
    body, position, command, root, ahead = case
    turned, moved = clamped(device, body.as_quat(), position, command.as_quat(), root)
    way, before = (moved - position)[:, :2], (root - position)[:, :2]
    length, far = np.linalg.norm(before, axis=1), np.linalg.norm(before, axis=1) > LEAD
    assert 20 < far.sum() < len(far) - 20, "the case must have both"
    assert np.linalg.norm(way, axis=1) == pytest.approx(np.minimum(length, LEAD), abs=1e-5)
    # along the line to the body, and no further than needed
    assert way == pytest.approx(before * np.minimum(1.0, LEAD / length)[:, None], abs=1e-5)
    assert moved[:, 2] == pytest.approx(root[:, 2], abs=1e-6)
    lead = heading(Rotation.from_quat(turned) * command.inv()) + ahead
    assert lead == pytest.approx(np.clip(ahead, -TURN, TURN), abs=1e-4)


def test_a_tilted_command_keeps_its_tilt(device):
    lean = Rotation.from_rotvec([0.3, 0.0, 0.0])
    command = Rotation.from_rotvec([0.0, 0.0, 1.5]) * lean
    turned, _ = clamped(device, [[0, 0, 0, 1]], np.zeros((1, 3)), [command.as_quat()], np.zeros((1, 3)))
    expected = Rotation.from_rotvec([0.0, 0.0, TURN]) * lean
    assert (Rotation.from_quat(turned[0]) * expected.inv()).magnitude() < 1e-5


def test_a_root_that_has_let_go_is_not_clamped(device, case):
    body, position, command, root, _ = case
    turned, moved = clamped(device, body.as_quat(), position, command.as_quat(), root, np.ones(len(root)))
    assert np.array_equal(turned, command.as_quat().astype(np.float32).astype(float))
    assert moved == pytest.approx(root, abs=1e-6)
