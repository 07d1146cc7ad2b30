"""The pose controller in a batch: masked resets, failures, determinism; environments are independent."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.pose_control import kernels
from piavatar_envs.avatar.pose_control.controller import PoseController
from piavatar_envs.core import cuda_intrinsics as lanes
from piavatar_envs.mpm.types import FAILURE_NONFINITE


def assert_same(rig, one: dict, other: dict, rows=slice(None), other_rows=None) -> None:
    """Compare bit for bit on a CPU; a GPU sums in any order."""
    for name, value in one.items():
        mine, theirs = value[rows], other[name][rows if other_rows is None else other_rows]
        if wp.get_device(rig.model.device).is_cuda:
            np.testing.assert_allclose(mine, theirs, atol=1e-2, err_msg=name)
        else:
            np.testing.assert_array_equal(mine, theirs, err_msg=name)


def disturbed(make_rig, wild_pose, num_envs: int = 3, **options):
    """Return several bodies in different poses, moving differently."""
    rng = np.random.default_rng(5)
    rig = make_rig(cells=16, num_envs=num_envs, gravity=9.81, floor=True, **options)
    rig.reset(np.stack([wild_pose(rng, 0.1) for _ in range(num_envs)]), rig.points.joints[:, 0] + [0.0, 0.0, 0.1])
    for env in range(num_envs):
        kick = np.zeros((rig.points.num_points, 3))
        kick[:] = rng.normal(size=3) * 0.3
        rig.add_velocity(kick, env)
    rig.command(np.stack([wild_pose(rng, 0.1) for _ in range(num_envs)]))
    rig.step(2)
    return rig


def test_a_masked_reset_touches_its_environments_only(make_rig, wild_pose):
    rig, untouched = (disturbed(make_rig, wild_pose) for _ in range(2))
    before = rig.everything()
    rig.reset(mask=[False, True, False])
    after = rig.everything()
    assert_same(rig, after, before, rows=[0, 2])
    fresh = make_rig(cells=16, num_envs=3, gravity=9.81, floor=True).everything()
    assert_same(rig, after, fresh, rows=[1])
    assert not np.array_equal(after["x"][1], before["x"][1])
    for one in (rig, untouched):
        one.step(2)
    assert_same(rig, rig.everything(), untouched.everything(), rows=[0, 2])


def test_a_failed_environment_is_frozen_until_its_reset(make_rig, wild_pose):
    rig, healthy = (disturbed(make_rig, wild_pose) for _ in range(2))
    broken = np.zeros((rig.points.num_points, 3))
    broken[7] = np.nan
    rig.add_velocity(broken, env=1)
    rig.step()
    healthy.step()
    assert rig.state.failure.numpy().tolist() == [0, FAILURE_NONFINITE, 0]
    frozen = rig.everything()
    assert_same(rig, frozen, healthy.everything(), rows=[0, 2])
    rig.step(2)
    later = rig.everything()
    for name in ("x", "F", "C", "command_rotation", "command_root", "rotation", "position"):
        np.testing.assert_array_equal(later[name][1], frozen[name][1], err_msg=name)
    assert not np.array_equal(later["x"][0], frozen["x"][0])
    rig.reset(mask=[False, True, False])
    rig.step(5)
    assert rig.state.failure.numpy().tolist() == [0, 0, 0]
    assert rig.pose_error(1).max() < 1e-3 and np.isfinite(rig.read("u", 1)).all()


def test_a_reset_body_stands_at_rest_and_unstrained(make_rig, wild_pose):
    rng = np.random.default_rng(6)
    rig = disturbed(make_rig, wild_pose, num_envs=2)
    pose = np.stack([wild_pose(rng, 0.9) for _ in range(2)])
    rig.reset(pose, root=(0.1, 0.2, 1.0))
    state = rig.state.numpy()
    for env in range(2):
        rotations = Rotation.from_rotvec(pose[env]).as_matrix()
        np.testing.assert_allclose(state["x"][env], rig.skinned(rotations, (0.1, 0.2, 1.0)), atol=2e-6)
    np.testing.assert_array_equal(state["F"], np.broadcast_to(np.eye(3, dtype=np.float32), state["F"].shape))
    assert not any(state[name].any() for name in ("u", "vk", "C", "failure"))
    np.testing.assert_array_equal(rig.avatar.state.goal_rotation.numpy(), rig.avatar.state.command_rotation.numpy())
    np.testing.assert_array_equal(rig.avatar.state.goal_root.numpy(), rig.avatar.state.command_root.numpy())


def test_every_environment_equals_a_single_one(make_rig, wild_pose):
    rng = np.random.default_rng(7)
    poses = np.stack([wild_pose(rng, 0.12) for _ in range(2)])
    batch = make_rig(cells=16, num_envs=2, gravity=9.81, floor=True)
    batch.command(poses)
    batch.step(2)
    for env in range(2):
        single = make_rig(cells=16, gravity=9.81, floor=True)
        single.command(poses[env])
        single.step(2)
        assert_same(batch, batch.everything(), single.everything(), rows=[env], other_rows=[0])


def test_running_twice_gives_the_same_bits_and_eager_equals_recorded(make_rig, wild_pose):
    runs = [disturbed(make_rig, wild_pose) for _ in range(3)]
    runs[0].step()
    runs[1].step()
    runs[2].step_graph.run_eager()
    first = runs[0].everything()
    assert_same(runs[0], first, runs[1].everything())
    assert_same(runs[0], first, runs[2].everything())


@pytest.mark.parametrize("rounds", [2, 6])
def test_threads_that_have_several_particles_move_them_as_one_each_does(
    device, make_rig, wild_pose, monkeypatch, rounds
):
    # On a GPU, in batches that leave no thread idle.
    gpu = wp.get_device(device)
    if not gpu.is_cuda:
        pytest.skip("on a CPU one thread has all particles")

    def moved():
        rng = np.random.default_rng(8)
        rig = make_rig(cells=16, num_envs=3, gravity=9.81, floor=True, others=37)
        u, x = rig.state.u.numpy(), rig.state.x.numpy()
        u[:, 37:] = 0.3 * np.sin(7.0 * x[:, 37:])
        u[1, 50] = np.nan  # an environment that fails
        rig.state.u.assign(u)
        rig.command(np.stack([wild_pose(rng, 0.1) for _ in range(3)]))
        rig.step(2)
        return rig

    one = moved()
    particles = 3 * one.points.num_points
    monkeypatch.setattr(lanes, "RESIDENT", particles // (gpu.sm_count * rounds))
    assert lanes.particle_rounds(device, particles) == rounds
    several = moved()
    assert several.state.failure.numpy().tolist() == [0, FAILURE_NONFINITE, 0]
    found = several.everything()
    for name, value in one.everything().items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)


def stepped(make_rig, wild_pose) -> dict:
    """Return two bodies after two control steps."""
    rng = np.random.default_rng(9)
    rig = make_rig(cells=16, num_envs=2, gravity=9.81, floor=True)
    rig.command(np.stack([wild_pose(rng, 0.1) for _ in range(2)]))
    rig.step(2)
    return rig.everything()


def test_warps_of_a_body_change_nothing(device, make_rig, wild_pose, monkeypatch):
    # One warp prepares a body as three do; bones that have a warp each have the same sums but for round-off.
    if not wp.get_device(device).is_cuda:
        pytest.skip("on a CPU one thread has a body")
    usual = stepped(make_rig, wild_pose)
    with monkeypatch.context() as patch:
        patch.setattr(kernels, "BODIES_PREPARED", 0)
        assert kernels.warps_of_body(device, 2) == 1
        for name, value in stepped(make_rig, wild_pose).items():
            np.testing.assert_array_equal(usual[name], value, err_msg=name)
    monkeypatch.setattr(lanes, "MANY_THREADS", 0)
    assert lanes.chunk_threads(device, 1) == 0
    for name, value in stepped(make_rig, wild_pose).items():
        np.testing.assert_allclose(value, usual[name], rtol=1e-4, atol=1e-4, err_msg=name)


@pytest.mark.parametrize("root", ["wrench", "free"])
def test_one_launch_moves_a_body_as_many_do(make_rig, wild_pose, monkeypatch, root):
    # On a CPU the whole pose controller is one launch, on a GPU every pass over particles is one.
    options = {"root": root, "free_motion": root == "free"}
    one = disturbed(make_rig, wild_pose, **options)
    if wp.get_device(one.model.device).is_cuda:
        pytest.skip("a GPU has passes only")
    before_substep = PoseController.record_before_substep

    def by_passes(controller, *args):
        controller.in_one_launch = False
        before_substep(controller, *args)

    monkeypatch.setattr(PoseController, "record_before_substep", by_passes)
    many = disturbed(make_rig, wild_pose, **options)
    assert "command_body" in one.step_graph.names and "command_particles" in many.step_graph.names
    for name, value in one.everything().items():
        np.testing.assert_array_equal(value, many.everything()[name], err_msg=name)
