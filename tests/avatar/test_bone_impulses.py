"""Which points of bones are too fast, and how bones answer to impulses: against all points, and double precision."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.torque_control.bone_contact import (
    TOLERANCE,
    Ground,
    apply_impulse,
    find_fastest,
    least_speed,
    may_violate,
    measure_bones,
    mobility_at,
    touch_of,
)
from piavatar_envs.avatar.torque_control.joint_motion import spread_motion
from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF
from piavatar_envs.avatar.torque_control.tree_cholesky import load_factor
from piavatar_envs.avatar.torque_control.workspace import TorqueWorkspace, warp_arena
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.cuda_intrinsics import warp_threads
from piavatar_envs.mpm.colliders import Collider
from tests.avatar.articulated import Joints, carried_by


@wp.kernel(enable_backward=False)
def push_bone(
    body: Body,
    b: int,
    first: int,
    x: wp.array(dtype=wp.vec3),
    p: wp.vec3,
    threads: int,
    w: TorqueWorkspace,
    K: wp.array(dtype=wp.mat33),
):
    """``K`` of a bone, and an impulse on it, by factor ``first + e``; over ``(num_envs, threads)``."""
    e, thread = wp.tid()
    room = warp_arena()
    load_factor(w.factors, first + e, room)
    found = mobility_at(body, first + e, e, b, x[e], thread, threads, room, w)
    if thread == 0:
        K[e] = found
    apply_impulse(p, b, e, first + e, e, thread, threads, room, w)


@wp.kernel(enable_backward=False)
def move_bones(body: Body, q: wp.array2d(dtype=float), w: TorqueWorkspace):
    """Motion of the bones under velocities ``q`` of the joints, and boxes around their points; over ``num_envs``."""
    e = wp.tid()
    measure_bones(body, e, 0, 1, w)
    spread_motion(body, w.pose.position, q, e, e, 0, 1, w.moving)


@wp.kernel(enable_backward=False)
def look(
    body: Body,
    ground: Ground,
    dt: float,
    w: TorqueWorkspace,
    may: wp.array3d(dtype=int),
    most: wp.array3d(dtype=float),
    fastest: wp.array(dtype=wp.vec2),
):
    """What bones are looked at, and by how much any of their points is too fast; over ``(num_envs, bones)``."""
    e, b = wp.tid()
    for k in range(ground.boundaries.count):
        may[e, b, k] = int(may_violate(ground.boundaries, dt, w, e, b, k))
        lacking = float(-1.0e9)
        for tracker in range(body.tracker_start[b], body.tracker_start[b + 1]):
            touch = touch_of(body, ground.boundaries, w, e, b, tracker, k)
            lacking = wp.max(lacking, least_speed(touch.distance, dt) - wp.dot(touch.velocity, touch.normal))
        most[e, b, k] = lacking
    if b == 0:
        fastest[e] = find_fastest(body, ground, dt, e, 0, 1, w)


@pytest.mark.parametrize("driven", [False, True])
@pytest.mark.parametrize(("stiffness", "damping"), [(0.0, 0.0), (300.0, 5.0)])
@pytest.mark.parametrize("seed", [0, 1])
def test_every_bone_answers_as_the_whole_matrix_says(make_rig, wild_pose, device, seed, stiffness, damping, driven):
    """``K = J (M + D)^-1 J^T`` and ``(M + D)^-1 J^T p``, by the factor with all that is implicit or the other."""
    rng, n, threads = np.random.default_rng(seed), 2, warp_threads(device)
    rig = make_rig(cells=16, floor=True, room=2.0, num_envs=n)
    made = Joints(rig, stiffness, damping, solid=True).pose(wild_pose(rng))
    body, workspace, first = made.body, made.body._workspace, n * driven
    M, D = (array.astype(float) for array in (body.mass.read(), workspace.diagonals.numpy()))
    assert (np.abs(D[n:, 6:]).max() > 1e-3) == (stiffness > 0.0)
    joints = body.state.position.numpy().astype(float)
    for b, carried in enumerate(carried_by().T):
        x, p = joints[:, b] + rng.normal(0.0, 0.1, (n, 3)), rng.normal(size=3)
        whole, shares = (rng.normal(size=(rows, NUM_DOF)).astype(np.float32) for rows in (n, 3 * n))
        workspace.whole.assign(whole)
        workspace.shares.assign(shares)
        workspace.touch.fill_(np.nan)  # nothing of last time is read
        K = wp.zeros(n, dtype=wp.mat33, device=device)
        points = wp.array(x.astype(np.float32), dtype=wp.vec3, device=device)
        inputs = [body.body, b, first, points, wp.vec3(*p), threads, workspace]
        wp.launch(push_bone, (n, threads), inputs, [K], block_dim=threads, device=device)
        for e in range(n):
            arms = carried[:, None] * (x[e] - joints[e])
            turned = np.cross(np.eye(3)[None], arms[:, None]).reshape(-1, 3)  # by a turn of a joint about each axis
            J = np.concatenate([np.eye(3), turned]).T
            answer = np.linalg.inv(M[e] + np.diag(D[first + e])) @ J.T
            np.testing.assert_allclose(K.numpy()[e], J @ answer, atol=1e-3 * np.abs(J @ answer).max())
            change, atol = answer @ p, 1e-3 * np.abs(answer @ p).max()
            np.testing.assert_allclose(workspace.whole.numpy()[e] - whole[e], change, atol=atol)
            np.testing.assert_allclose(workspace.shares.numpy()[e] - shares[e], change, atol=atol)
        np.testing.assert_array_equal(workspace.shares.numpy()[n:], shares[n:])


@pytest.mark.parametrize("seed", range(4))
def test_no_bone_is_passed_by_of_which_a_point_is_too_fast(make_rig, wild_pose, device, seed):
    """Bodies in any motion among planes, balls, boxes and capsules that move and turn, in short and long substeps."""
    rng, n = np.random.default_rng(seed), 2
    sizes = {"plane": 0, "sphere": 1, "box": 3, "capsule": 2}
    solids = [
        Collider(kind, tuple(0.02 + 0.4 * rng.random(size)), (0.0, 0.0, 0.0), friction=0.5, kinematic=True)
        for kind, size in sizes.items()
        for _ in range(2)
    ]
    rig = make_rig(cells=16, floor=True, colliders=solids, room=2.0, num_envs=n)
    made = Joints(rig, solid=True).pose(wild_pose(rng))
    body, workspace, boundaries = made.body, made.body._workspace, rig.model.boundaries
    ground = body._ground(rig.scratch)
    rows, count = boundaries.position.shape
    needed = looked_at = 0
    for _ in range(25):
        turns, still = Rotation.random(count, rng).as_quat(), rng.choice([0.0, 0.1, 3.0])
        drawn = {
            "rotation": turns,
            "position": rng.normal(0.0, 0.5, (count, 3)) + [0.0, 0.0, 1.0],
            "velocity": still * rng.normal(size=(count, 3)),
            "spin": 3.0 * still * rng.normal(size=(count, 3)),
        }
        for name, values in drawn.items():
            getattr(boundaries, name).assign(np.tile(values.astype(np.float32), (rows, 1, 1)))
        q = rng.choice([0.0, 0.1, 2.0]) * rng.normal(size=(n, NUM_DOF))
        dt = float(rng.choice([1e-4, 6e-4, 2e-3, 3e-2, 0.5]))
        velocity = wp.array(q.astype(np.float32), dtype=float, device=device)
        wp.launch(move_bones, n, [body.body, velocity, workspace], device=device)
        may = wp.zeros((n, NUM_JOINTS, count), dtype=int, device=device)
        most, fastest = wp.zeros(may.shape, dtype=float, device=device), wp.zeros(n, dtype=wp.vec2, device=device)
        inputs = [body.body, ground, dt, workspace]
        wp.launch(look, (n, NUM_JOINTS), inputs, [may, most, fastest], device=device)
        lacking, seen = most.numpy(), may.numpy() != 0
        assert seen[lacking > TOLERANCE].all()
        needed, looked_at = needed + (lacking > TOLERANCE).sum(), looked_at + seen.sum()
        for (speed, which), own in zip(fastest.numpy(), lacking, strict=True):
            if own.max() > 2.0 * TOLERANCE:
                assert speed == pytest.approx(own.max(), rel=1e-3)
                assert own[int(which) // count % NUM_JOINTS, int(which) % count] == pytest.approx(own.max(), rel=1e-6)
    assert 100 < needed <= looked_at < 2 * needed
