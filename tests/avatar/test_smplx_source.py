"""Bodies of SMPL files: the model's own surface in the reference pose and while it moves, shapes, hands and a run."""

from __future__ import annotations

import json

import gymnasium as gym
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.asset import AvatarAsset, mesh_volume
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion.retarget import LIMB_ENDS, align_limbs
from scripts.synthetic_smplx import TO_SMPL, synthetic_model
from tests.avatar.smpl_files import BODY_MODELS_REASON
from tests.avatar.test_smpl_file import by_equations


@pytest.fixture(scope="module")
def members() -> dict[str, np.ndarray]:
    """Members of an SMPL-H file whose surface is closed."""
    return synthetic_model(joints=52, columns=16)


@pytest.fixture(scope="module")
def path(members, tmp_path_factory):
    file = tmp_path_factory.mktemp("model") / "synthetic_smplh.npz"
    np.savez(file, **members)
    return file


@pytest.fixture(scope="module")
def asset(path) -> AvatarAsset:
    return load_asset("smplx", path=path)


def reference_pose(members: dict, joints: np.ndarray) -> np.ndarray:
    """Return the pose vectors of the file that turn its limbs as those of the embedded body rest, hands in their mean.

    Args:
        members: of the file.
        joints: the person's, in the file's zero pose and axes, shape ``(J, 3)``.
    """
    embedded = load_asset().joints.astype(float)
    ends = {name: embedded[joint_index(end)] - embedded[joint_index(name)] for name, end in LIMB_ENDS.items()}
    world = align_limbs(joints[:NUM_JOINTS] @ TO_SMPL, {**ends, "left_ankle": None, "right_ankle": None})
    pose = np.zeros((len(joints), 3))
    for joint in range(1, NUM_JOINTS):
        pose[joint] = (world[PARENTS[joint]].inv() * world[joint]).as_rotvec() @ TO_SMPL.T
    if "hands_meanl" in members:
        first = len(joints) - 30
        pose[first:] = np.concatenate([members["hands_meanl"], members["hands_meanr"]]).reshape(30, 3)
    return pose


def in_our_axes(vertices: np.ndarray) -> np.ndarray:
    return vertices @ TO_SMPL


def shaped_joints(members: dict, betas: np.ndarray) -> np.ndarray:
    return members["J_regressor"] @ (members["v_template"] + members["shapedirs"][..., : len(betas)] @ betas)


def test_the_look_in_the_reference_pose_is_the_model_s_surface(members, asset):
    pose = reference_pose(members, shaped_joints(members, np.zeros(1)))
    expected = in_our_axes(by_equations(members, np.zeros(1), pose))
    assert np.abs(asset.look.vertices - expected).max() < 1e-6
    flat = by_equations(members, np.zeros(1), np.where(np.arange(52)[:, None] < 22, pose, 0.0))
    assert np.abs(in_our_axes(flat) - expected).max() > 0.01  # the hands are in their mean pose


def test_it_agrees_with_another_reader(members, path, asset):
    pytest.importorskip("body_models", reason=BODY_MODELS_REASON)
    from body_models.smplh.numpy import SMPLH

    pose = reference_pose(members, shaped_joints(members, np.zeros(1)))
    other = SMPLH(model_path=path, flat_hand_mean=False)  # adds the mean to the hands' pose
    hands, shape = np.zeros((1, 30, 3)), np.zeros((1, 16))
    vertices = other.forward_vertices(body_pose=pose[None, 1:22], hand_pose=hands, shape=shape)
    assert np.abs(in_our_axes(np.asarray(vertices)[0]) - asset.look.vertices).max() < 1e-6


def test_shape_parameters_count_in_standard_deviations(members, path, asset):
    assert asset.shape_names == tuple(f"beta_{index}" for index in range(10))
    betas = np.array([1.0, 0.0, -2.0])
    parameters = asset.parameters(beta_0=1.0 / 2.5, beta_2=-2.0 / 2.5)
    pose = reference_pose(members, shaped_joints(members, np.zeros(1)))
    expected = in_our_axes(by_equations(members, betas, pose))
    drawn = asset.shape_drawn(parameters)
    assert np.abs((drawn.vertices - drawn.joints[0]) - (expected - expected_root(members, betas))).max() < 2e-6
    fixed = load_asset("smplx", path=path, betas=[1.0, 0.0, -2.0], num_betas=0)
    assert fixed.shape_names == ()
    assert abs(fixed.height([]) - asset.height(parameters)) < 2e-3  # limbs of other lengths are turned a little else
    mean, tall = asset.mean_body(), asset.shape(parameters)
    assert np.abs(tall.joints - mean.joints).max() > 0.01


def expected_root(members: dict, betas: np.ndarray) -> np.ndarray:
    return in_our_axes(shaped_joints(members, betas)[0])


def test_displacements_by_the_pose_are_the_model_s(members, asset):
    """In the reference pose's frame they are the model's change, turned as the skin of the zero pose was."""
    rng = np.random.default_rng(1)
    rest = reference_pose(members, shaped_joints(members, np.zeros(1)))
    local = Rotation.from_rotvec(rest[:NUM_JOINTS] @ TO_SMPL).as_matrix()
    reference = local.copy()
    for joint in range(1, NUM_JOINTS):
        reference[joint] = reference[PARENTS[joint]] @ local[joint]
    turned = Rotation.from_rotvec(rng.normal(0.0, 0.4, (NUM_JOINTS, 3))).as_matrix()
    found = asset.look.pose.displacement(turned)
    change = np.zeros((51, 3, 3))
    for joint in range(1, NUM_JOINTS):
        now, parent = turned[joint] @ reference[joint], turned[PARENTS[joint]] @ reference[PARENTS[joint]]
        change[joint - 1] = TO_SMPL @ (parent.T @ now - local[joint]) @ TO_SMPL.T
    zero = in_our_axes(members["posedirs"] @ change.ravel())
    fingers = Rotation.from_rotvec(rest @ TO_SMPL).as_matrix()
    world = fingers.copy()
    for joint in range(1, 52):
        world[joint] = world[members["kintree_table"][0, joint]] @ fingers[joint]
    expected = np.einsum("vj,jab,vb->va", members["weights"], world, zero)
    assert np.linalg.norm(expected, axis=1).max() > 0.003
    assert np.abs(found - expected).max() < 1e-6
    assert np.abs(asset.look.pose.displacement(np.tile(np.eye(3), (22, 1, 1)))).max() == 0.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"betas": [0.0] * 17}, "leave the last ones out"),
        ({"betas": [float("nan")]}, "standard deviations"),
        ({"expression": [1.0]}, "expression has 1"),
        ({"num_betas": 17}, "outside 0 to 16"),
        ({"skeleton": "no_such_folder"}, "no such"),
        ({"gender": "female"}, "no setting gender"),
    ],
)
def test_settings_that_the_file_does_not_carry_are_refused(path, settings, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_asset("smplx", path=path, **settings)


def test_groups_of_vertices_come_to_the_skin(members, path, tmp_path):
    most = members["weights"].argmax(axis=1)
    listed = {"left_hip": np.flatnonzero(most == 1).tolist(), "nothing": []}
    file = tmp_path / "groups.json"
    file.write_text(json.dumps(listed))
    body = load_asset("smplx", path=path, groups=str(file))
    assert set(body.groups) == {"skin", "left_hip"}
    inside = body.groups["left_hip"] > 0.5
    assert inside.sum() > 50 and (body.skin_joints[inside, 0] == joint_index("left_hip")).mean() > 0.95


def test_open_eyes_are_closed_and_the_face_moves(tmp_path):
    """The layout of SMPL-X, 10,475 vertices with holes behind the eyes, is a body of the embedded one's volume."""
    members = synthetic_model(joints=55, columns=20)
    np.savez(tmp_path / "synthetic_smplx.npz", **members)
    assert members["v_template"].shape == (10_475, 3)
    body = load_asset("smplx", path=tmp_path / "synthetic_smplx.npz", num_betas=1, num_expressions=1)
    embedded = load_asset().mean_body()
    volume = mesh_volume(embedded.vertices, load_asset().faces)
    mean = body.mean_body()
    assert abs(mesh_volume(mean.vertices, body.faces) / volume - 1.0) < 0.02
    assert np.abs(mean.joints - embedded.joints).max() < 0.005
    edges = np.sort(np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert body.shape_names == ("beta_0", "expression_0")
    open_mouth = body.shape_drawn([0.0, 1.0]).vertices - body.shape_drawn([0.0, 0.0]).vertices
    assert 0.005 < np.linalg.norm(open_mouth, axis=1).max() < 0.02
    off = np.abs(ClosedSurface(body.vertices, body.faces).distance(body.look.vertices[:9383]))
    assert np.quantile(off, 0.8) < 0.003
    assert off.max() < 0.03  # inside of the mouth


def test_an_environment_runs_with_it(path, device):
    env = gym.make("PIAvatar/Reach-v0", device=device, fidelity="tiny", avatar={"source": "smplx", "path": str(path)},
                   shape={"randomize": True}, disable_env_checker=True)  # fmt: skip
    env.reset(seed=0)
    for _ in range(3):
        observation, _, terminated, _, _ = env.step(env.action_space.sample())
    assert not terminated
    assert all(
        np.isfinite(value).all() for value in (observation.values() if isinstance(observation, dict) else [observation])
    )
    env.close()
