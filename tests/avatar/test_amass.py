"""AMASS files written here in both layouts: handedness, axes, retargeting, and what is refused."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import load_motion
from piavatar_envs.avatar.motion.amass import HIP_DROP, LEG_LENGTH, load_file
from piavatar_envs.avatar.motion.ground import lowest_heights
from piavatar_envs.avatar.motion.motion import Motion
from piavatar_envs.avatar.motion.retarget import leg_length

UPRIGHT = np.array([np.pi / 2, 0.0, 0.0])  # stands SMPL's y-up body up in a z-up world; it then faces -y
REST = load_asset().joints.astype(np.float64)


class Opened:
    """Unpickling it is noticed."""

    count = 0

    def __reduce__(self):
        return (_open, ())


def _open() -> str:
    Opened.count += 1
    return "opened"


def write(path: Path, width: int = 156, turned: dict | None = None, num_frames: int = 4, **changes: object) -> Path:
    """A file whose named joints have axis-angle vectors (3,) or (num_frames, 3), the root upright."""
    values = np.zeros((num_frames, width))
    for name, vector in {"pelvis": UPRIGHT, **(turned or {})}.items():
        values[:, 3 * joint_index(name) : 3 * joint_index(name) + 3] = vector
    content = {
        "poses": values,
        "trans": np.zeros((num_frames, 3)),
        "mocap_framerate" if width == 156 else "mocap_frame_rate": np.array(120.0),
        "gender": np.array("neutral"),
        "betas": np.zeros(16),
        "markers_latent_vids": np.array(Opened(), dtype=object),
        **changes,
    }
    np.savez(path, **{key: value for key, value in content.items() if value is not None})
    return path


def joints_of(motion: Motion) -> dict[str, np.ndarray]:
    """Joint positions of the first frame."""
    positions = motion.joint_frames(REST)[1][0]
    return dict(zip(JOINT_NAMES, positions, strict=True))


def direction(joints: dict[str, np.ndarray], start: str, end: str) -> np.ndarray:
    return (joints[end] - joints[start]) / np.linalg.norm(joints[end] - joints[start])


@pytest.mark.parametrize("width", [156, 165])
def test_both_layouts_are_read_without_unpickling(tmp_path: Path, width: int) -> None:
    Opened.count = 0
    motion = load_motion(write(tmp_path / "clip.npz", width))
    assert motion.fps == 120.0 and motion.num_frames == 4 and not motion.loop and motion.name == "clip"
    assert Opened.count == 0
    assert lowest_heights(motion, load_asset()).min() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("width", "key"), [(156, "mocap_frame_rate"), (165, "mocap_framerate")])
def test_the_rate_is_found_under_the_other_layouts_name(tmp_path: Path, width: int, key: str) -> None:
    own = {"mocap_framerate": None, "mocap_frame_rate": None, key: np.array(59.94)}
    assert load_file(write(tmp_path / "clip.npz", width, **own), REST).fps == 59.94


def test_upright_is_the_identity_and_the_limbs_form_a_t(tmp_path: Path) -> None:
    motion = load_file(write(tmp_path / "t.npz"), REST)
    np.testing.assert_allclose(motion.local_rotations[:, 0], [[1.0, 0.0, 0.0, 0.0]] * 4, atol=1e-12)
    joints = joints_of(motion)
    for side, outward in (("left", 1.0), ("right", -1.0)):
        np.testing.assert_allclose(direction(joints, f"{side}_shoulder", f"{side}_elbow"), [outward, 0, 0], atol=1e-9)
        np.testing.assert_allclose(direction(joints, f"{side}_elbow", f"{side}_wrist"), [outward, 0, 0], atol=1e-9)
        np.testing.assert_allclose(direction(joints, f"{side}_hip", f"{side}_knee"), [0, 0, -1], atol=1e-9)
        np.testing.assert_allclose(direction(joints, f"{side}_knee", f"{side}_ankle"), [0, 0, -1], atol=1e-9)
        rest_foot = REST[joint_index(f"{side}_foot")] - REST[joint_index(f"{side}_ankle")]
        np.testing.assert_allclose(joints[f"{side}_foot"] - joints[f"{side}_ankle"], rest_foot, atol=1e-9)


def test_turns_about_the_vertical_are_headings(tmp_path: Path) -> None:
    """Facing +x in the z-up world is a quarter turn to the left from facing -y."""
    root = (Rotation.from_euler("z", 90, degrees=True) * Rotation.from_rotvec(UPRIGHT)).as_rotvec()
    motion = load_file(write(tmp_path / "left.npz", turned={"pelvis": root}), REST)
    turned = Rotation.from_quat(motion.local_rotations[0, 0], scalar_first=True)
    np.testing.assert_allclose(turned.as_rotvec(), [0.0, 0.0, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(turned.apply([0.0, -1.0, 0.0]), [1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("joint", "end", "vector", "expected"),
    [
        # Vectors in SMPL's axes (left +x, up +y, forward +z), directions in ours (left +x, forward -y, up +z).
        ("left_shoulder", "left_elbow", [0, 0, np.pi / 2], [0, 0, 1]),  # the left arm up
        ("right_shoulder", "right_elbow", [0, 0, -np.pi / 2], [0, 0, 1]),  # the right arm up
        ("left_shoulder", "left_elbow", [0, -np.pi / 2, 0], [0, -1, 0]),  # the left arm forward
        ("left_elbow", "left_wrist", [0, -np.pi / 2, 0], [0, -1, 0]),  # the left elbow bends forward
        ("right_elbow", "right_wrist", [0, np.pi / 2, 0], [0, -1, 0]),
        ("left_hip", "left_knee", [-np.pi / 2, 0, 0], [0, -1, 0]),  # the left thigh forward
        ("right_knee", "right_ankle", [np.pi / 2, 0, 0], [0, 1, 0]),  # the right shin back
    ],
)
def test_each_limb_turns_the_way_smpl_turns_it(tmp_path: Path, joint, end, vector, expected) -> None:
    joints = joints_of(load_file(write(tmp_path / "clip.npz", turned={joint: vector}), REST))
    np.testing.assert_allclose(direction(joints, joint, end), expected, atol=1e-9)


def test_trunk_rotations_are_taken_over_in_our_axes(tmp_path: Path) -> None:
    """A forward bend is about +x in SMPL's axes and in ours; a turn to the left about +y there is about +z here."""
    motion = load_file(write(tmp_path / "clip.npz", turned={"spine2": [0.3, 0, 0], "neck": [0, 0.4, 0]}), REST)
    rotvec = Rotation.from_quat(motion.local_rotations[0], scalar_first=True).as_rotvec()
    np.testing.assert_allclose(rotvec[joint_index("spine2")], [0.3, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rotvec[joint_index("neck")], [0, 0, 0.4], atol=1e-12)


def test_the_root_path_is_scaled_by_the_legs(tmp_path: Path) -> None:
    trans = np.linspace([0.0, 0.0, 0.9], [1.0, -2.0, 1.1], 4)
    motion = load_file(write(tmp_path / "clip.npz", trans=trans), REST)
    np.testing.assert_allclose(
        np.diff(motion.root_position, axis=0) * LEG_LENGTH, np.diff(trans, axis=0) * leg_length(REST)
    )
    hips = 0.5 * (joints_of(motion)["left_hip"] + joints_of(motion)["right_hip"])
    np.testing.assert_allclose(hips, (trans[0] - [0, 0, HIP_DROP]) * leg_length(REST) / LEG_LENGTH, atol=1e-9)


def test_the_subjects_own_zero_pose_is_used_when_given(tmp_path: Path) -> None:
    """With our own rest pose as the subject's, in SMPL's axes, zero rotations must be our rest pose, to scale 1."""
    zero = Rotation.from_euler("x", -90, degrees=True).apply(REST)
    motion = load_file(write(tmp_path / "clip.npz"), REST, zero_joints=zero)
    np.testing.assert_allclose(np.abs(motion.local_rotations[0, :, 0]), np.ones(NUM_JOINTS), atol=1e-12)
    np.testing.assert_allclose(motion.root_position, 0.0, atol=1e-9)
    with pytest.raises(ValueError, match=r"zero_joints has shape \(52, 3\)"):
        load_file(write(tmp_path / "clip.npz"), REST, zero_joints=np.zeros((52, 3)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": None}, r"keys \['poses'\] are missing"),
        ({"trans": None}, r"keys \['trans'\] are missing"),
        ({"mocap_framerate": None}, "the rate is missing"),
        ({"poses": np.zeros((4, 72))}, r"\(4, 72\), expected \(N, 156\) for SMPL-H or \(N, 165\) for SMPL-X"),
        ({"poses": np.zeros(156)}, r"shape \(156,\)"),
        ({"trans": np.zeros((5, 3))}, r"trans has shape \(5, 3\) for 4 poses"),
        ({"trans": np.full((4, 3), np.nan)}, "trans .* not finite"),
        ({"poses": np.full((4, 156), np.inf)}, "poses .* not finite"),
        ({"poses": np.full((4, 156), "x")}, "poses .* not finite numbers"),
        ({"poses": np.full((4, 156), Opened(), dtype=object)}, "not an AMASS motion.*allow_pickle"),
        ({"mocap_framerate": np.array([30.0, 60.0])}, "frame rate has shape"),
        ({"mocap_framerate": np.array(0.0)}, r"fps=0\.0"),
    ],
)
def test_malformed_files_are_refused(tmp_path: Path, changes: dict, message: str) -> None:
    Opened.count = 0
    with pytest.raises(ValueError, match=message):
        load_file(write(tmp_path / "bad.npz", **changes), REST)
    assert Opened.count == 0


def test_pickles_and_other_files_are_refused_unopened(tmp_path: Path) -> None:
    Opened.count = 0
    for name in ("clip.pkl", "clip.npz", "clip"):
        (tmp_path / name).write_bytes(pickle.dumps(Opened()))
        with pytest.raises(ValueError, match=r"\.npz files|not an AMASS motion"):
            load_file(tmp_path / name, REST)
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "cut.npz").write_bytes(write(tmp_path / "whole.npz").read_bytes()[:500])
    for name in ("text.npz", "cut.npz"):
        with pytest.raises(ValueError, match="not an AMASS motion"):
            load_file(tmp_path / name, REST)
    assert Opened.count == 0
