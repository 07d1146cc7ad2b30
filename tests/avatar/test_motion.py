"""The motion type against analytic rotations and paths; the ground; the embedded clips, for bodies of any size."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import Motion, list_motions, load_motion
from piavatar_envs.avatar.motion.deepmimic import lay_hands_on_ground
from piavatar_envs.avatar.motion.ground import lowest_heights
from piavatar_envs.avatar.motion.library import list_embedded
from piavatar_envs.avatar.motion.retarget import align_limbs, retarget

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def still(num_frames: int) -> np.ndarray:
    return np.tile(IDENTITY, (num_frames, NUM_JOINTS, 1))


def clip(rotations: np.ndarray, root: np.ndarray | None = None, fps: float = 10.0, loop: bool = False) -> Motion:
    root = np.zeros((len(rotations), 3)) if root is None else root
    return Motion("test", fps, rotations, root, loop=loop)


def spinning(joint: str, rotvec: np.ndarray, num_frames: int) -> np.ndarray:
    """Return rotations of one joint that turns at constant speed from 0 to ``rotvec``."""
    rotations = still(num_frames)
    turn = Rotation.from_rotvec(np.linspace(0.0, 1.0, num_frames)[:, None] * rotvec)
    rotations[:, joint_index(joint)] = turn.as_quat(scalar_first=True)
    return rotations


def circling(num_frames: int = 7, heading: float = 0.5, loop: bool = True) -> Motion:
    """Return a walk on a circle of 2 m about (1, -1), by ``heading`` a round."""
    angle = np.linspace(0.0, heading, num_frames)
    rotations = still(num_frames)
    rotations[:, 0] = Rotation.from_rotvec(angle[:, None] * [0, 0, 1]).as_quat(scalar_first=True)
    root = np.stack([1.0 + 2.0 * np.cos(angle), -1.0 + 2.0 * np.sin(angle), np.full(num_frames, 0.9)], axis=1)
    return clip(rotations, root, loop=loop)


# The type


def test_sampling_a_constant_turn_is_the_exponential_map() -> None:
    rotvec = 2.5 * np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    motion = clip(spinning("left_knee", rotvec, 4))
    for time in (0.0, 0.04, 0.1, 0.17, 0.299, 0.3):
        rotations, _ = motion.sample(time)
        got = Rotation.from_quat(rotations[joint_index("left_knee")], scalar_first=True)
        expected = Rotation.from_rotvec(time / motion.duration * rotvec)
        assert (got * expected.inv()).magnitude() < 1e-12
        np.testing.assert_allclose(np.delete(rotations, joint_index("left_knee"), 0), still(1)[0, 1:], atol=1e-15)


def test_a_motion_cannot_be_changed() -> None:
    source = still(3)
    motion = clip(source)
    source[:] = 7.0
    np.testing.assert_array_equal(motion.local_rotations, still(3))
    with pytest.raises(ValueError, match="read-only"):
        motion.root_position[0] = 1.0


@pytest.mark.parametrize("time", [-5.0, 0.0, 0.25, 0.6, 100.0])
def test_a_clip_that_does_not_loop_holds_its_ends(time: float) -> None:
    motion = circling(loop=False)
    rotations, root = motion.sample(time)
    expected_rotations, expected_root = motion.sample(float(np.clip(time, 0.0, 0.6)))
    np.testing.assert_array_equal(rotations, expected_rotations)
    np.testing.assert_array_equal(root, expected_root)


@pytest.mark.parametrize("heading", [0.5, -0.9, 1e-3, 1e-11])
def test_a_loop_goes_on_along_its_circle(heading: float) -> None:
    # Frames of any round lie on the same circle, forwards and backwards in time.
    motion = circling(heading=heading)
    for step in (-20, -6, -1, 0, 5, 6, 7, 13, 61, 600):
        rotations, root = motion.sample(step / motion.fps)
        angle = step / 6.0 * heading
        np.testing.assert_allclose(root, [1 + 2 * np.cos(angle), -1 + 2 * np.sin(angle), 0.9], atol=1e-6)
        got = Rotation.from_quat(rotations[0], scalar_first=True)
        assert (got * Rotation.from_rotvec([0.0, 0.0, -angle])).magnitude() < 1e-8


def test_resampling_keeps_the_motion() -> None:
    motion = clip(spinning("neck", np.array([0.4, 1.0, -2.0]), 7), np.linspace([0, 0, 1], [3, -2, 1.5], 7))
    finer = motion.resample(40.0)
    assert finer.num_frames == 25 and finer.duration == pytest.approx(motion.duration)
    for time in (0.0, 0.013, 0.31, 0.6):
        for got, expected in zip(finer.sample(time), motion.sample(time), strict=True):
            np.testing.assert_allclose(got, expected, atol=1e-12)
    back = finer.resample(10.0)
    np.testing.assert_allclose(back.local_rotations, motion.local_rotations, atol=1e-12)
    np.testing.assert_allclose(back.root_position, motion.root_position, atol=1e-12)


def test_resampling_a_loop_keeps_whole_rounds() -> None:
    motion = circling()
    odd = motion.resample(24.0)  # 0.6 s are 14.4 frames: 14 of them
    assert odd.num_frames == 15 and odd.loop
    np.testing.assert_allclose(odd.root_position[[0, -1]], motion.root_position[[0, -1]], atol=1e-12)
    assert odd.loop_heading == pytest.approx(motion.loop_heading, abs=1e-12)


def test_a_clip_that_does_not_close_is_refused_as_a_loop_until_it_is_closed() -> None:
    rotations = spinning("left_elbow", np.array([0.0, 0.0, 0.3]), 31)
    root = np.linspace([0.0, 0.0, 1.0], [1.0, 0.0, 1.1], 31)
    with pytest.raises(ValueError, match=r"left_elbow differs by 0\.3000 rad .*closed\(\)"):
        clip(rotations, root, loop=True)
    closed = clip(rotations, root).closed(blend_time=0.5)
    np.testing.assert_allclose(closed.local_rotations[5:26], rotations[5:26], atol=1e-12)  # the middle is untouched
    np.testing.assert_allclose(closed.root_position[:, 0], root[:, 0], atol=1e-12)  # so is the way on the ground
    np.testing.assert_allclose(closed.root_position[-1, 2], closed.root_position[0, 2], atol=1e-12)
    half = Rotation.from_quat(closed.local_rotations[0, joint_index("left_elbow")], scalar_first=True)
    np.testing.assert_allclose(half.as_rotvec(), [0.0, 0.0, 0.15], atol=1e-12)  # both ends come half the way


def test_a_mirrored_clip_moves_as_the_mirror_image() -> None:
    rng = np.random.default_rng(3)
    rest = load_asset().joints.astype(np.float64)
    other = {"left": "right", "right": "left"}
    swapped = [joint_index("_".join(other.get(part, part) for part in name.split("_"))) for name in JOINT_NAMES]
    rest = 0.5 * (rest + rest[swapped] * [-1, 1, 1])  # exactly symmetric, the embedded body is so to a millimetre
    vectors = np.cumsum(0.2 * rng.standard_normal((5, NUM_JOINTS, 3)), axis=0)
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_quat(scalar_first=True).reshape(5, NUM_JOINTS, 4)
    motion = clip(rotations, rng.standard_normal((5, 3)))
    positions = motion.joint_frames(rest)[1]
    mirrored = motion.mirrored().joint_frames(rest)[1]
    np.testing.assert_allclose(mirrored, positions[:, swapped] * [-1, 1, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fps": 0.0}, r"fps=0\.0"),
        ({"local_rotations": still(3)[:, :21]}, r"\(3, 21, 4\)"),
        ({"local_rotations": still(1), "root_position": np.zeros((1, 3))}, "at least 2 frames"),
        ({"root_position": np.zeros((4, 3))}, r"3 frames .*\(4, 3\)"),
        ({"root_position": np.array([[0, 0, 0], [0, np.inf, 0], [0, 0, 0]])}, r"root_position\[1, 1\] is inf"),
        ({"local_rotations": still(3) * 1.1}, r"pelvis in frame 0 has norm 1\.1000.*normalise"),
        ({"local_rotations": still(3) * np.nan}, r"local_rotations\[0, 0, 0\] is nan"),
    ],
)
def test_malformed_clips_are_refused(change: dict, message: str) -> None:
    good = {"name": "bad", "fps": 30.0, "local_rotations": still(3), "root_position": np.zeros((3, 3))}
    with pytest.raises(ValueError, match=message):
        Motion(**{**good, **change})
    with pytest.raises(ValueError, match="time=nan"):
        circling().sample(float("nan"))
    with pytest.raises(ValueError, match="fps=-1"):
        circling().resample(-1.0)


# The ground


def test_the_ground_offset_puts_the_lowest_skin_on_the_ground() -> None:
    # A turning body, skinned by brute force with every vertex.
    body = load_asset()
    motion = clip(spinning("pelvis", np.array([2.0, 0.3, 0.0]), 5), np.linspace([0, 0, 3.0], [0, 1, 2.0], 5))
    grounded = motion.on_ground(body)
    rest = body.joints.astype(np.float64)
    turns, positions = grounded.joint_frames(rest)
    lowest = []
    for rotation, position in zip(turns, positions, strict=True):
        per_joint = np.einsum("bij,vbj->vbi", rotation, body.vertices[:, None] - rest) + position
        chosen = np.take_along_axis(per_joint, body.skin_joints[..., None], axis=1)
        lowest.append((body.skin_weights[..., None] * chosen).sum(1)[:, 2].min())
    np.testing.assert_allclose(lowest_heights(grounded, body), lowest, atol=1e-6)
    assert min(lowest) == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_array_equal(grounded.root_position[:, :2], motion.root_position[:, :2])


def test_hands_lie_down_where_the_arms_stand_on_the_ground() -> None:
    # Face down on straight vertical arms: the hand is bent to the level of the forearm's end, backwards.
    body = load_asset()
    rest = body.joints.astype(np.float64)
    wrists = (joint_index("left_wrist"), joint_index("right_wrist"))
    ahead = {f"{side}_{joint}": [0.0, -1.0, 0.0] for side in ("left", "right") for joint in ("shoulder", "elbow")}
    upright = [Rotation.identity(3)] * NUM_JOINTS
    prone = Rotation.from_euler("x", 90.0, degrees=True)
    motion = clip(retarget(upright, align_limbs(rest, ahead), prone, Rotation.identity()), fps=30.0)
    level = lowest_heights(motion, body, ignored=wrists)
    assert (lowest_heights(motion, body) < level - 0.12).all()  # the hands bore into the ground
    laid = lay_hands_on_ground(motion, body, None, window=0.5)
    assert (lowest_heights(laid, body) > level - 0.06).all()
    for wrist in wrists:
        bend_angle = Rotation.from_quat(laid.local_rotations[:, wrist], scalar_first=True).magnitude()
        assert np.degrees(bend_angle).min() > 45.0 and np.degrees(bend_angle).max() <= 85.0 + 1e-6
        # At rest the palms look down and inwards: what points up then is the back of the hand, and does so here.
        assert laid.joint_frames(rest)[0][0, wrist, 2, 2] > 0.5
    others = np.delete(np.arange(NUM_JOINTS), wrists)
    np.testing.assert_allclose(laid.local_rotations[:, others], motion.local_rotations[:, others])


REST_POSE = np.tile([1.0, 0.0, 0.0, 0.0], (NUM_JOINTS, 1))


def world_joints(motion: Motion) -> dict[str, np.ndarray]:
    positions = motion.joint_frames(load_asset().joints)[1]
    return {name: positions[:, joint] for joint, name in enumerate(JOINT_NAMES)}


def bend(joints: dict[str, np.ndarray], start: str, middle: str, end: str) -> np.ndarray:
    """Return the angle between two bones [deg], 0 when straight."""
    a, b = joints[middle] - joints[start], joints[end] - joints[middle]
    cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


@pytest.fixture(scope="module", params=list_embedded())
def embedded(request: pytest.FixtureRequest) -> Motion:
    return load_motion(request.param)


def test_embedded_clips_start_and_end_at_rest(embedded: Motion) -> None:
    assert embedded.name in list_motions()
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
@pytest.mark.parametrize("sizes", [{}, {"height": -1.0}])
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


def test_unknown_motions_are_refused(tmp_path) -> None:
    with pytest.raises(ValueError, match="waltz"):
        load_motion("waltz")
    with pytest.raises((ValueError, ImportError), match="DeepMimic"):
        load_motion("deepmimic:")
    with pytest.raises(FileNotFoundError, match=r"walk\.npz"):
        load_motion(tmp_path / "walk.npz")
