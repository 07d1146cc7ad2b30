"""The motion type against analytic rotations and paths, and clips against the ground."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import Motion, load_motion
from piavatar_envs.avatar.motion.deepmimic import lay_hands_on_ground
from piavatar_envs.avatar.motion.ground import ground_level, lowest_heights
from piavatar_envs.avatar.motion.motion import hemisphere_consistent, slerp
from piavatar_envs.avatar.motion.retarget import align_limbs, retarget

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def still(num_frames: int) -> np.ndarray:
    return np.tile(IDENTITY, (num_frames, NUM_JOINTS, 1))


def clip(rotations: np.ndarray, root: np.ndarray | None = None, fps: float = 10.0, loop: bool = False) -> Motion:
    root = np.zeros((len(rotations), 3)) if root is None else root
    return Motion("test", fps, rotations, root, loop=loop)


def spinning(joint: str, rotvec: np.ndarray, num_frames: int) -> np.ndarray:
    """One joint turning at constant speed from 0 to ``rotvec``."""
    rotations = still(num_frames)
    turn = Rotation.from_rotvec(np.linspace(0.0, 1.0, num_frames)[:, None] * rotvec)
    rotations[:, joint_index(joint)] = turn.as_quat(scalar_first=True)
    return rotations


def circling(num_frames: int = 7, heading: float = 0.5, loop: bool = True) -> Motion:
    """Walking a circle of 2 m about (1, -1) by ``heading`` a round."""
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


def test_slerp_takes_the_shorter_arc_whatever_the_signs() -> None:
    start = np.array([1.0, 0.0, 0.0, 0.0])
    end = -Rotation.from_euler("z", 90.0, degrees=True).as_quat(scalar_first=True)
    middle = slerp(start, end, np.array(0.5))
    np.testing.assert_allclose(middle, [np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8)], atol=1e-15)


def test_quaternions_lie_in_one_hemisphere_after_construction() -> None:
    rotations = spinning("head", np.array([0.0, 3.0, 0.0]), 20)
    flipped = rotations * np.where(np.arange(20) % 3 == 0, -1.0, 1.0)[:, None, None]
    np.testing.assert_array_equal(hemisphere_consistent(flipped), rotations)
    np.testing.assert_allclose(clip(flipped).local_rotations, rotations, atol=1e-15)


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
    """Frames of any round lie on the same circle, forwards and backwards in time."""
    motion = circling(heading=heading)
    for step in (-20, -6, -1, 0, 5, 6, 7, 13, 61, 600):
        rotations, root = motion.sample(step / motion.fps)
        angle = step / 6.0 * heading
        np.testing.assert_allclose(root, [1 + 2 * np.cos(angle), -1 + 2 * np.sin(angle), 0.9], atol=1e-6)
        got = Rotation.from_quat(rotations[0], scalar_first=True)
        assert (got * Rotation.from_rotvec([0.0, 0.0, -angle])).magnitude() < 1e-8


def test_a_loop_is_continuous_across_its_seam() -> None:
    motion = circling()
    before, after = (motion.sample(2 * motion.duration + dt) for dt in (-1e-7, 1e-7))
    np.testing.assert_allclose(before[0], after[0], atol=1e-6)
    np.testing.assert_allclose(before[1], after[1], atol=1e-6)


def test_sampling_many_times_is_sampling_each() -> None:
    motion = circling()
    times = np.array([[-1.3, 0.0, 0.2], [0.6, 0.61, 9.0]])
    rotations, root = motion.sample(times)
    assert rotations.shape == (2, 3, NUM_JOINTS, 4) and root.shape == (2, 3, 3)
    for index in np.ndindex(times.shape):
        one = motion.sample(float(times[index]))
        np.testing.assert_allclose(rotations[index], one[0], atol=1e-15)
        np.testing.assert_allclose(root[index], one[1], atol=1e-15)


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


def test_resampling_a_single_pass_holds_the_last_pose() -> None:
    motion = clip(still(4), np.linspace([0, 0, 0], [3.0, 0, 0], 4))
    slower = motion.resample(4.0)  # 0.3 s are 1.2 frames: frames at 0, 0.25 and 0.5 s
    np.testing.assert_allclose(slower.root_position[:, 0], [0.0, 2.5, 3.0], atol=1e-12)


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


def test_closing_can_take_the_turn_out_of_a_loop() -> None:
    assert circling(loop=False, num_frames=31).closed(heading=0.0).loop_heading == pytest.approx(0.0, abs=1e-12)


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
        ({"fps": 0.0}, r"fps=0\.0 is outside \(0, 1000\]"),
        ({"fps": float("nan")}, "fps=nan"),
        ({"local_rotations": still(3)[:, :21]}, r"shape \(3, 21, 4\), expected"),
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


def test_times_and_rates_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="time=nan s is not finite"):
        circling().sample(float("nan"))
    with pytest.raises(ValueError, match=r"fps=-1.* \(0, 1000\]"):
        circling().resample(-1.0)


# The ground


def test_the_ground_offset_puts_the_lowest_skin_on_the_ground() -> None:
    """A turning body, skinned by brute force with every vertex."""
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


@pytest.mark.parametrize("loop", [False, True])
def test_the_level_is_smooth_below_the_heights_and_ignores_short_flights(loop: bool) -> None:
    time = np.arange(0, 121) / 60.0
    drift = 0.05 * np.sin(2 * np.pi * time / 2.0) ** 2
    flight = 0.6 * np.clip(1 - ((time - 1.0) / 0.2) ** 2, 0, None)  # 0.4 s off the ground
    level = ground_level(drift + flight, 60.0, window=0.8, loop=loop)
    assert (level <= drift + flight + 1e-12).all()
    assert level.max() < 0.06
    assert np.abs(np.diff(level)).max() * 60.0 < 0.2  # [m/s]


def test_hands_lie_down_where_the_arms_stand_on_the_ground() -> None:
    """Face down on straight vertical arms: the hand is bent to the level of the forearm's end, backwards."""
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


def test_hands_in_the_air_are_left_alone() -> None:
    motion = load_motion("arm_wave")
    laid = lay_hands_on_ground(motion, load_asset(), None, window=0.5)
    np.testing.assert_allclose(laid.local_rotations, motion.local_rotations, atol=1e-12)
