"""What the embedded clips must look like, whatever the size of the body."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import Motion, list_motions, load_motion
from piavatar_envs.avatar.motion.ground import lowest_heights
from piavatar_envs.avatar.motion.library import list_embedded

REST_POSE = np.tile([1.0, 0.0, 0.0, 0.0], (NUM_JOINTS, 1))


def world_joints(motion: Motion) -> dict[str, np.ndarray]:
    positions = motion.joint_frames(load_asset().joints)[1]
    return {name: positions[:, joint] for joint, name in enumerate(JOINT_NAMES)}


def bend(joints: dict[str, np.ndarray], start: str, middle: str, end: str) -> np.ndarray:
    """Angle between two bones [deg], 0 when straight."""
    a, b = joints[middle] - joints[start], joints[end] - joints[middle]
    cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


@pytest.fixture(scope="module", params=list_embedded())
def embedded(request: pytest.FixtureRequest) -> Motion:
    return load_motion(request.param)


def test_the_embedded_clips_are_there() -> None:
    assert {"arm_wave", "squat", "step", "kick"} <= set(list_embedded()) <= set(list_motions())


def test_embedded_clips_start_and_end_at_rest(embedded: Motion) -> None:
    assert embedded.loop and embedded.source == "procedural"
    for frame in (0, -1):
        np.testing.assert_allclose(embedded.local_rotations[frame], REST_POSE, atol=2e-3)
        np.testing.assert_allclose(embedded.root_position[frame], load_asset().joints[0], atol=2e-3)


def test_embedded_clips_are_smooth_and_human(embedded: Motion) -> None:
    speed = embedded.joint_speeds()
    assert speed.max() < 10.0  # [rad/s]
    assert speed[[0, -1]].max() < 0.35  # at rest where the loop closes
    assert np.abs(np.diff(speed, axis=0)).max() * embedded.fps < 120.0  # [rad/s^2] no kinks
    joints = world_joints(embedded)
    for side in ("left", "right"):
        assert bend(joints, f"{side}_hip", f"{side}_knee", f"{side}_ankle").max() < 150.0
        assert bend(joints, f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist").max() < 150.0
    for trunk in ("spine1", "spine2", "spine3", "neck", "head", "left_collar", "right_collar"):
        turn = Rotation.from_quat(embedded.local_rotations[:, joint_index(trunk)], scalar_first=True)
        assert turn.magnitude().max() < np.radians(30.0)


def test_embedded_clips_stand_on_the_ground(embedded: Motion) -> None:
    heights = lowest_heights(embedded, load_asset())
    assert heights.min() == pytest.approx(0.0, abs=1e-6)
    assert heights.max() < 0.01


@pytest.mark.parametrize(
    ("name", "planted"),
    [
        *[(name, ("left_ankle", "right_ankle")) for name in ("arm_wave", "bow", "idle", "squat", "t_pose")],
        ("kick", ("left_ankle",)),
    ],
)
@pytest.mark.parametrize("sizes", [{}, {"height": 1.0}, {"height": -1.0}])
def test_standing_feet_do_not_slide_whatever_the_size(name: str, planted: tuple[str, ...], sizes: dict) -> None:
    asset = load_asset()
    body = asset.shape(asset.parameters(**sizes))
    motion = load_motion(name, asset, body)
    positions = motion.joint_frames(body.joints)[1]
    for ankle in planted:
        path = positions[:, joint_index(ankle)]
        np.testing.assert_allclose(path, np.tile(path[0], (len(path), 1)), atol=5e-3)


def test_arm_wave_lifts_the_left_hand_on_the_side_of_positive_x() -> None:
    joints = world_joints(load_motion("arm_wave"))
    top = joints["left_wrist"][:, 2].argmax()
    assert joints["left_wrist"][top, 2] > joints["head"][top, 2]
    assert joints["left_wrist"][top, 0] > 0.2 > joints["right_wrist"][top, 0]
    assert joints["right_wrist"][:, 2].max() < joints["right_shoulder"][:, 2].min()
    across = joints["left_wrist"][:, 0][joints["left_wrist"][:, 2] > joints["head"][:, 2]]
    turning_points = np.sum(np.diff(np.sign(np.diff(across))) != 0)
    assert turning_points >= 3  # to and fro, more than once


def test_squat_lowers_the_pelvis_with_the_knees_in_front() -> None:
    motion = load_motion("squat")
    joints = world_joints(motion)
    low = motion.root_position[:, 2].argmin()
    assert motion.root_position[0, 2] - motion.root_position[low, 2] > 0.3
    for side in ("left", "right"):
        assert joints[f"{side}_knee"][low, 1] < joints[f"{side}_hip"][low, 1] - 0.3  # forward is -y
        assert joints[f"{side}_knee"][low, 1] < joints[f"{side}_ankle"][low, 1]


def test_step_lifts_each_foot_while_the_other_stands() -> None:
    joints = world_joints(load_motion("step"))
    rise = {side: joints[f"{side}_ankle"][:, 2] - joints[f"{side}_ankle"][0, 2] for side in ("left", "right")}
    for side, other in (("left", "right"), ("right", "left")):
        top = rise[side].argmax()
        assert rise[side][top] > 0.15 and abs(rise[other][top]) < 5e-3
        standing = 1 if other == "left" else -1
        assert standing * joints["pelvis"][top, 0] > 0.07  # the weight is over the foot that stands


def test_kick_throws_the_right_foot_forward() -> None:
    joints = world_joints(load_motion("kick"))
    foot = joints["right_ankle"]
    strike = foot[:, 1].argmin()
    assert foot[strike, 1] < -0.6 and foot[strike, 2] > 0.45
    assert foot[:strike, 1].max() > 0.25  # wound up behind before
    assert bend(joints, "right_hip", "right_knee", "right_ankle")[strike] < 30.0


@pytest.mark.parametrize("name", ["waltz", "deepmimic:"])
def test_unknown_names_are_refused(name: str) -> None:
    with pytest.raises((ValueError, ImportError), match=r"unknown motion|DeepMimic"):
        load_motion(name)


def test_missing_files_are_refused(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match=r"walk\.npz"):
        load_motion(tmp_path / "walk.npz")
