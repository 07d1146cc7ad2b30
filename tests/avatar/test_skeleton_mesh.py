"""Skeleton meshes: every part finds its bone; bone particles lie on it, thinned, inside the skin, eighteen at least."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import SkeletonPoints
from piavatar_envs.avatar.body.sampling import MIN_BONE_PARTICLES, ClosedSurface, sample_particles
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.avatar.body.skeleton_mesh import STEP, bone_of_name, nearest_bones, read_skeleton, thinned
from piavatar_envs.avatar.body.sources import load_asset
from scripts.gltf_files import Y_UP, rig_of
from scripts.synthetic_smplx import TO_SMPL, synthetic_model
from tests.avatar.test_rigs import named

trimesh = pytest.importorskip("trimesh", reason="trimesh, of the extra props, is not installed")

RADIUS, SPACING = 0.009, 0.03
#: Bones with one axis, from their joint to the next one.
LIMBS = {
    f"{side}_{bone}": f"{side}_{end}"
    for side in ("left", "right")
    for bone, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
}


def tube(joints: np.ndarray, bone: str, radius: float = RADIUS):
    """Return a tube around the middle of a bone's axis."""
    start, end = joints[joint_index(bone)], joints[joint_index(LIMBS[bone])]
    return trimesh.creation.cylinder(radius, segment=[start + 0.15 * (end - start), end - 0.15 * (end - start)])


def write_tubes(folder, joints: np.ndarray, radius: float = RADIUS):
    folder.mkdir()
    for bone in LIMBS:
        tube(joints, bone, radius).export(folder / f"{bone}.ply")
    return folder


def axis_distance(points: np.ndarray, joints: np.ndarray, bone: str) -> np.ndarray:
    start, end = joints[joint_index(bone)], joints[joint_index(LIMBS[bone])]
    axis = (end - start) / np.linalg.norm(end - start)
    return np.linalg.norm(np.cross(points - start, axis), axis=1)


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    return load_asset().joints.astype(np.float64)


@pytest.fixture(scope="module")
def folder(joints, tmp_path_factory):
    return write_tubes(tmp_path_factory.mktemp("skeleton") / "parts", joints)


def test_parts_are_points_of_their_bones(folder, joints):
    skeleton = read_skeleton(folder, joints)
    assert {JOINT_NAMES[bone] for bone in np.unique(skeleton.bone)} == set(LIMBS)
    for bone in LIMBS:
        own = skeleton.points[skeleton.bone == joint_index(bone)]
        # the caps lie inside of the tube, the sides of its polygon a little
        off = axis_distance(own, joints, bone)
        assert off.max() < RADIUS + 1e-6
        assert np.quantile(off, 0.2) > 0.95 * RADIUS
        length = np.linalg.norm(joints[joint_index(LIMBS[bone])] - joints[joint_index(bone)])
        assert len(own) > 0.5 * length / STEP * 2.0 * np.pi * RADIUS / STEP  # long triangles have points inside
    cells = np.concatenate([skeleton.bone[:, None], np.floor(skeleton.points / STEP)], axis=1)
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_one_mesh_goes_to_the_nearest_bones(folder, joints, tmp_path):
    whole = trimesh.util.concatenate([tube(joints, bone) for bone in LIMBS])
    whole.export(tmp_path / "skeleton.obj")
    skeleton, parts = read_skeleton(tmp_path / "skeleton.obj", joints), read_skeleton(folder, joints)
    counts = (np.bincount(one.bone, minlength=NUM_JOINTS) for one in (skeleton, parts))
    assert np.allclose(*counts, rtol=0.01)  # the format rounds


@pytest.mark.parametrize(
    ("name", "bone"),
    [
        ("femur_l", "left_hip"), ("RightTibia", "left_knee"), ("fibula", "left_knee"), ("l_pelvis", "pelvis"),
        ("L5", "spine1"), ("lumbar_1", "spine2"), ("t12", "spine2"), ("thoracic8_s", "spine3"), ("ribs", "spine3"),
        ("sternum", "spine3"), ("C3", "neck"), ("skull", "head"), ("mandible", "head"), ("scapula", "left_collar"),
        ("humerus.r", "left_shoulder"), ("ulna", "left_elbow"), ("metacarpal-2", "left_wrist"),
        ("hamate", "left_wrist"),
        ("metatarsals", "left_ankle"), ("calcn", "left_ankle"), ("tarsals", "left_ankle"), ("toes", "left_foot"),
        ("right_knee", "right_knee"), ("part_17", None),
    ],
)  # fmt: skip
def test_names_of_anatomy_mean_bones_and_their_place_the_side(name, bone):
    assert bone_of_name(name, np.array([[0.2, 0.0, 1.0]])) == bone


def test_particles_lie_on_the_skeleton_inside_the_skin_eighteen_at_least(folder, joints):
    asset = load_asset("embedded", skeleton=str(folder))
    particles = sample_particles(asset, SPACING)
    skin = ClosedSurface(asset.vertices, asset.faces)
    bones = particles.bone >= 0
    assert skin.distance(particles.rest_positions[bones]).max() < 0.0
    counts = np.bincount(particles.bone[bones], minlength=NUM_JOINTS)
    assert counts.min() >= MIN_BONE_PARTICLES
    lattice = sample_particles(load_asset(), SPACING)
    for joint in set(range(NUM_JOINTS)) - {joint_index(bone) for bone in LIMBS}:
        own = lattice.rest_positions[lattice.bone == joint]
        for point in particles.rest_positions[particles.bone == joint]:
            assert np.linalg.norm(own - point, axis=1).min() < 1e-6
    thick = joint_index("left_hip")
    own = particles.rest_positions[particles.bone == thick]
    assert len(own) > MIN_BONE_PARTICLES
    assert axis_distance(own, joints, "left_hip").max() < 1.01 * RADIUS
    finer = sample_particles(asset, SPACING, bone_voxel=0.5)
    assert (finer.bone == thick).sum() > 1.8 * len(own)
    assert np.isclose(particles.volumes.sum(), lattice.volumes.sum())


def test_points_outside_the_skin_are_left_out(joints, tmp_path):
    asset = load_asset("embedded", skeleton=str(write_tubes(tmp_path / "thick", joints, radius=0.06)))
    assert ClosedSurface(asset.vertices, asset.faces).distance(asset.skeleton.points).max() > 0.0
    particles = sample_particles(asset, SPACING)
    bones = particles.bone >= 0
    assert ClosedSurface(asset.vertices, asset.faces).distance(particles.rest_positions[bones]).max() < 0.0


def test_a_skeleton_of_the_zero_pose_is_moved_with_its_bones(tmp_path):
    members = synthetic_model(joints=24, columns=10)
    np.savez(tmp_path / "model.npz", **members)
    zero = members["J_regressor"] @ members["v_template"]
    write_tubes(tmp_path / "parts", zero[:NUM_JOINTS])
    asset = load_asset("smplx", path=tmp_path / "model.npz", skeleton=str(tmp_path / "parts"), num_betas=0)
    assert np.abs(TO_SMPL @ (asset.joints[18] - asset.joints[16]) - (zero[18] - zero[16])).max() > 0.05
    for bone in LIMBS:
        own = asset.skeleton.points[asset.skeleton.bone == joint_index(bone)]
        assert axis_distance(own, asset.joints.astype(float), bone).max() < RADIUS + 1e-4


def test_a_skeleton_beside_a_character_in_centimetres(joints, tmp_path):
    """It is in the file's unit and axes, y up; the bodies of both are the embedded one."""
    rig_of(load_asset(), named("mixamo"), unit=100.0).write().save(tmp_path / "character.glb")
    standing = load_asset().mean_body().joints.astype(np.float64)
    (tmp_path / "parts").mkdir()
    for bone in LIMBS:
        tube(100.0 * standing @ Y_UP.T, bone, 100.0 * RADIUS).export(tmp_path / "parts" / f"{bone}.stl")
    asset = load_asset("glb", path=tmp_path / "character.glb", skeleton=str(tmp_path / "parts"))
    for bone in LIMBS:
        own = asset.skeleton.points[asset.skeleton.bone == joint_index(bone)]
        assert axis_distance(own, asset.joints.astype(float), bone).max() < RADIUS + 1e-4
        assert len(own) > 100


def test_every_axis_is_nearest_to_its_own_bone(joints):
    for joint in range(1, NUM_JOINTS):
        parent = PARENTS[joint]
        middle = joints[parent] + 0.5 * (joints[joint] - joints[parent])
        assert nearest_bones(middle[None], joints)[0] == parent


def test_thinning_keeps_the_point_nearest_to_the_middle_of_a_cube():
    points = np.array([[0.001, 0.001, 0.001], [0.004, 0.004, 0.004], [0.005, 0.005, 0.005], [0.02, 0.0, 0.0]])
    found = thinned(SkeletonPoints(points, np.array([1, 1, 1, 1], np.int32)), 0.01)
    assert np.array_equal(found.points, points[[1, 3]])
    both = thinned(SkeletonPoints(points, np.array([1, 2, 1, 2], np.int32)), 0.01)
    assert len(both.points) == 3  # bones do not share cubes


def test_bad_skeletons_are_refused(joints, tmp_path):
    with pytest.raises(FileNotFoundError):
        read_skeleton(tmp_path / "nothing", joints)
    with pytest.raises(ValueError, match="no mesh"):
        read_skeleton(tmp_path, joints)
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nend_header\n")
    with pytest.raises(ValueError, match="is not a mesh"):
        read_skeleton(tmp_path / "bad.ply", joints)
    large = tube(joints, "left_hip")
    large.apply_scale(100.0)
    large.export(tmp_path / "centimetres.stl")
    with pytest.raises(ValueError, match="in metres"):
        read_skeleton(tmp_path / "centimetres.stl", joints)


@pytest.mark.parametrize("control", ["pose", "torque"])
def test_an_environment_runs_with_a_skeleton(folder, device, control):
    env = gym.make("PIAvatar/Reach-v0", device=device, fidelity="tiny", avatar={"skeleton": str(folder)},
                   control={"mode": control}, disable_env_checker=True)  # fmt: skip
    env.reset(seed=0)
    for _ in range(3):
        observation, _, terminated, _, _ = env.step(env.action_space.sample())
    assert not terminated
    assert np.isfinite(observation).all()
    env.close()
