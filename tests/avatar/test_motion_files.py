"""Motion files written here, AMASS in both layouts and DeepMimic: axes, retargeting, refusals; installed clips."""

from __future__ import annotations

import json
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import Motion, amass, deepmimic, list_motions, load_motion
from piavatar_envs.avatar.motion.amass import HIP_DROP, LEG_LENGTH, load_file
from piavatar_envs.avatar.motion.ground import lowest_heights
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
    """Write a file whose named joints have axis-angle vectors (3,) or (num_frames, 3), the root upright."""
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


def world_joints(motion: Motion) -> dict[str, np.ndarray]:
    positions = motion.joint_frames(REST)[1]
    return {name: positions[:, joint] for joint, name in enumerate(JOINT_NAMES)}


def joints_of(motion: Motion) -> dict[str, np.ndarray]:
    """Return the joint positions of the first frame."""
    return {name: positions[0] for name, positions in world_joints(motion).items()}


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
    # Facing +x in the z-up world is a quarter turn to the left from facing -y.
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
    # A forward bend is about +x in SMPL's axes and in ours; a turn to the left about +y there is about +z here.
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
    # With our own rest pose as the subject's, in SMPL's axes, zero rotations must be our rest pose, to scale 1.
    zero = Rotation.from_euler("x", -90, degrees=True).apply(REST)
    motion = load_file(write(tmp_path / "clip.npz"), REST, zero_joints=zero)
    np.testing.assert_allclose(np.abs(motion.local_rotations[0, :, 0]), np.ones(NUM_JOINTS), atol=1e-12)
    np.testing.assert_allclose(motion.root_position, 0.0, atol=1e-9)
    with pytest.raises(ValueError, match=r"zero_joints has shape \(52, 3\)"):
        load_file(write(tmp_path / "clip.npz"), REST, zero_joints=np.zeros((52, 3)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": None}, "'poses'"),
        ({"trans": None}, "'trans'"),
        ({"mocap_framerate": None}, "rate is missing"),
        ({"poses": np.zeros((4, 72))}, r"\(4, 72\)"),
        ({"trans": np.zeros((5, 3))}, r"trans .*\(5, 3\) for 4 poses"),
        ({"trans": np.full((4, 3), np.nan)}, "trans .*not finite"),
        ({"poses": np.full((4, 156), "x")}, "poses holds <U1"),
        ({"poses": np.full((4, 156), Opened(), dtype=object)}, "not an AMASS motion"),
        ({"mocap_framerate": np.array([30.0, 60.0])}, "frame rate has shape"),
    ],
)
def test_malformed_files_are_refused(tmp_path: Path, changes: dict, message: str) -> None:
    Opened.count = 0
    with pytest.raises(ValueError, match=message):
        load_file(write(tmp_path / "bad.npz", **changes), REST)
    assert Opened.count == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trans": np.outer(np.arange(4), [12.0, 0.0, 0.0])}, r"root moves at .* m/s .*millimetres"),  # 1.4 m/s
        ({"turned": {"left_knee": (90.0, 0.0, 0.0)}}, r"joint turns by 90 rad .*degrees"),
        ({"mocap_framerate": np.array(1.0 / 120.0)}, r"0\.00833.* frames per second .*of 120 frames"),
        ({"mocap_framerate": np.array(1e6)}, r"clip\.npz: .*fps=1000000.0 is outside .*correct the rate"),
    ],
)
def test_units_of_another_kind_are_refused_with_the_likely_cause(tmp_path: Path, changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_motion(write(tmp_path / "clip.npz", **changes))
    assert load_motion(write(tmp_path / "clip.npz")).fps == 120.0


def test_arrays_that_unpack_to_more_than_the_limit_are_refused_unread(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(amass, "MAX_BYTES", 100_000)
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, poses=np.zeros((1000, 156)), trans=np.zeros((1000, 3)), mocap_framerate=np.array(30.0))
    assert path.stat().st_size < 100_000
    with pytest.raises(ValueError, match=r"its arrays have .* bytes, the limit is 100000"):
        load_file(path, REST)


def test_pickles_and_other_files_are_refused_unopened(tmp_path: Path) -> None:
    Opened.count = 0
    for name in ("clip.pkl", "clip.npz", "clip"):
        (tmp_path / name).write_bytes(pickle.dumps(Opened()))
        with pytest.raises(ValueError, match=r"\.npz files|not an AMASS motion"):
            load_file(tmp_path / name, REST)
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "cut.npz").write_bytes(write(tmp_path / "whole.npz").read_bytes()[:500])
    np.save(tmp_path / "single.npy", np.zeros((4, 156)))
    (tmp_path / "single.npy").rename(tmp_path / "single.npz")
    packed = tmp_path / "packed.npz"
    with np.load(tmp_path / "whole.npz") as whole:
        np.savez_compressed(packed, **{key: whole[key] for key in ("poses", "trans", "mocap_framerate")})
    for place in range(40, 240, 8):  # in headers of the archive, of its arrays, and in what is compressed
        content = bytearray(packed.read_bytes())
        content[place : place + 8] = bytes(255 - byte for byte in content[place : place + 8])
        (tmp_path / f"spoiled{place}.npz").write_bytes(content)
    refused = 0
    for path in tmp_path.glob("spoiled*"):
        try:
            load_file(path, REST)  # what is not read, such as a date, may be spoiled
        except ValueError:
            refused += 1
    assert refused > 5
    for name in ("text.npz", "cut.npz", "single.npz"):
        with pytest.raises(ValueError, match="not an AMASS motion"):
            load_file(tmp_path / name, REST)
    assert Opened.count == 0


CHANNELS = {"root": 4, "chest": 8, "neck": 12, "right_hip": 16, "right_knee": 20, "right_ankle": 21}
CHANNELS |= {"right_shoulder": 25, "right_elbow": 29, "left_hip": 30, "left_knee": 34, "left_ankle": 35}
CHANNELS |= {"left_shoulder": 39, "left_elbow": 43}
HINGES = {name for name in CHANNELS if name.endswith(("knee", "elbow"))}

installed = pytest.mark.skipif(
    deepmimic.clip_folder() is None,
    reason="no pybullet here (its wheels are for Python 3.10 and 3.11): the DeepMimic clips are not tested",
)


def frame(duration: float = 0.1, position: tuple = (0.0, 0.8, 0.0), **joints: object) -> list[float]:
    """Return a frame of the zero pose but for named joints: a rotation vector in DeepMimic's axes, or a hinge angle."""
    values = np.zeros(deepmimic.NUM_CHANNELS)
    values[0], values[1:4] = duration, position
    for name, start in CHANNELS.items():
        if name in HINGES:
            values[start] = joints.get(name, 0.0)
        else:
            turn = Rotation.from_rotvec(joints.get(name, (0.0, 0.0, 0.0)))
            values[start : start + 4] = turn.as_quat(scalar_first=True)
    return values.tolist()


def write_clip(folder: Path, frames: list, loop: object = "none") -> Path:
    path = folder / "humanoid3d_test.txt"
    path.write_text(json.dumps({"Loop": loop, "Frames": frames}))
    return path


def posed(folder: Path, **joints: object) -> dict[str, np.ndarray]:
    return joints_of(deepmimic.load_file(write_clip(folder, [frame(**joints), frame(**joints)]), REST))


def test_in_the_zero_pose_the_limbs_hang_straight_down(tmp_path: Path) -> None:
    joints = posed(tmp_path)
    for side in ("left", "right"):
        for start, end in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")):
            np.testing.assert_allclose(direction(joints, f"{side}_{start}", f"{side}_{end}"), [0, 0, -1], atol=1e-9)
        assert direction(joints, f"{side}_ankle", f"{side}_foot")[1] < -0.9  # toes forward
    assert joints["left_hip"][0] > 0 > joints["right_hip"][0]
    assert joints["head"][2] > joints["pelvis"][2]


@pytest.mark.parametrize(
    ("joint", "value", "start", "end", "expected"),
    [
        # DeepMimic's axes: forward +x, up +y, right +z; ours: forward -y, up +z, left +x.
        ("left_knee", -1.5, "left_knee", "left_ankle", [0, np.sin(1.5), -np.cos(1.5)]),  # knees bend backwards
        ("right_knee", -1.5, "right_knee", "right_ankle", [0, np.sin(1.5), -np.cos(1.5)]),
        ("left_elbow", 1.2, "left_elbow", "left_wrist", [0, -np.sin(1.2), -np.cos(1.2)]),  # elbows bend forwards
        ("right_elbow", 1.2, "right_elbow", "right_wrist", [0, -np.sin(1.2), -np.cos(1.2)]),
        ("right_hip", (0, 0, 1.0), "right_hip", "right_knee", [0, -np.sin(1.0), -np.cos(1.0)]),  # the thigh forward
        ("left_shoulder", (np.pi / 2, 0, 0), "left_shoulder", "left_elbow", [1, 0, 0]),  # the left arm out to the left
        ("right_shoulder", (-np.pi / 2, 0, 0), "right_shoulder", "right_elbow", [-1, 0, 0]),
    ],
)
def test_each_limb_turns_the_way_deepmimic_turns_it(tmp_path: Path, joint, value, start, end, expected) -> None:
    np.testing.assert_allclose(direction(posed(tmp_path, **{joint: value}), start, end), expected, atol=1e-9)


def test_the_chest_turn_is_shared_by_the_spine_and_adds_up(tmp_path: Path) -> None:
    frames = [frame(chest=(0, 0, -0.6))] * 2  # bent forward
    motion = deepmimic.load_file(write_clip(tmp_path, frames), REST)
    rotvec = Rotation.from_quat(motion.local_rotations[0], scalar_first=True).as_rotvec()
    for name in ("spine1", "spine2", "spine3"):
        np.testing.assert_allclose(rotvec[joint_index(name)], [0.2, 0, 0], atol=1e-9)


def test_the_root_walks_and_turns_in_our_axes(tmp_path: Path) -> None:
    # One metre forward is to -y; a quarter turn about the vertical to the left faces +x; both legs' length scales.
    frames = [frame(), frame(position=(1.0, 0.8, 0.5), root=(0, np.pi / 2, 0))]
    motion = deepmimic.load_file(write_clip(tmp_path, frames), REST)
    joints = world_joints(motion)
    hips = 0.5 * (joints["left_hip"] + joints["right_hip"])
    scale = leg_length(REST) / deepmimic.LEG_LENGTH
    np.testing.assert_allclose(hips, scale * np.array([[0, 0, 0.8], [-0.5, -1.0, 0.8]]), atol=1e-9)
    turned = Rotation.from_quat(motion.local_rotations[1, 0], scalar_first=True)
    np.testing.assert_allclose(turned.apply([0, -1, 0]), [1, 0, 0], atol=1e-9)


def test_uneven_frame_times_become_an_even_rate(tmp_path: Path) -> None:
    # A turn and a path at constant speed stay so, whatever the frames' durations.
    durations = [0.1, 0.3, 0.2, 0.2]
    times = np.concatenate([[0.0], np.cumsum(durations)])
    frames = [
        frame(d, (t, 0.8, 0.0), left_hip=(0, 0, t), left_knee=-t) for t, d in zip(times, [*durations, 0.0], strict=True)
    ]
    motion = deepmimic.load_file(write_clip(tmp_path, frames), REST)
    assert motion.fps == pytest.approx(5.0) and motion.duration == pytest.approx(0.8)
    np.testing.assert_allclose(np.diff(motion.root_position[:, 1], n=2), 0.0, atol=1e-12)
    knee = Rotation.from_quat(motion.local_rotations[:, joint_index("left_knee")], scalar_first=True)
    np.testing.assert_allclose((knee[:-1].inv() * knee[1:]).magnitude(), 0.2, atol=1e-9)


def test_wrapping_clips_become_closed_loops_that_go_straight_on(tmp_path: Path) -> None:
    turns = np.linspace(0.0, 0.2, 31)
    frames = [frame(1 / 30, (t, 0.8, 0.0), root=(0, t, 0), left_shoulder=(0, 0, 2 * t)) for t in turns]
    motion = deepmimic.load_file(write_clip(tmp_path, frames, "wrap"), REST)
    assert motion.loop and motion.loop_heading == pytest.approx(0.0, abs=1e-9)
    _, root = motion.sample(3 * motion.duration)
    np.testing.assert_allclose(root - motion.root_position[0], 3 * (motion.root_position[-1] - motion.root_position[0]))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("not json", "not a DeepMimic clip"),
        ("[" * 100_000, "not a DeepMimic clip.*RecursionError"),
        (b"\xff\xfe\x00", "not a DeepMimic clip"),
        ("[]", "not a DeepMimic clip"),
        ({"Frames": [frame(), frame()]}, "not a DeepMimic clip"),
        ({"Loop": "often", "Frames": [frame(), frame()]}, "not a DeepMimic clip"),
        ({"Loop": "none", "Frames": [frame(), frame()[:-1]]}, "not a DeepMimic clip"),
        ({"Loop": "none", "Frames": [frame()]}, r"\(1, 44\)"),
        ({"Loop": "none", "Frames": [frame(0.0), frame()]}, r"frame 0 lasts 0\.0"),
        ({"Loop": "none", "Frames": [frame(), [float("nan")] * 44]}, "frame 1 .*not finite"),
        ({"Loop": "none", "Frames": [frame(), [0.1] + [0.0] * 43]}, "frame 1 has norm 0"),
        ({"Loop": "none", "Frames": [frame(left_knee=-60.0)] * 2}, "turns by 60 rad in frame 0.*degrees"),
        ({"Loop": "none", "Frames": [frame(), frame(right_elbow=90.0)]}, "turns by 90 rad in frame 1.*degrees"),
    ],
)
def test_malformed_clips_are_refused(tmp_path: Path, content: object, message: str) -> None:
    path = tmp_path / "humanoid3d_bad.txt"
    text = content if isinstance(content, (str, bytes)) else json.dumps(content)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message):
        deepmimic.load_file(path, REST)


def test_clips_are_loaded_by_path(tmp_path: Path) -> None:
    motion = load_motion(write_clip(tmp_path, [frame(1 / 30), frame(1 / 30), frame(1 / 30)]))
    assert motion.fps == pytest.approx(30.0) and motion.root_position[0, 2] > 0.7
    with pytest.raises(FileNotFoundError, match=r"none\.txt"):
        load_motion(tmp_path / "none.txt")
    with pytest.raises(ValueError, match="millimetres"):
        load_motion(write_clip(tmp_path, [frame(1 / 30, (0.0, 800.0 + 20.0 * n, 0.0)) for n in range(3)]))


def test_without_pybullet_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deepmimic.importlib.util, "find_spec", lambda name: None)
    assert not any(name.startswith("deepmimic:") for name in list_motions())
    with pytest.raises(ImportError, match=r"pip install .*\[motions\]"):
        load_motion("deepmimic:walk")


# The installed clips


@installed
@pytest.mark.parametrize("name", deepmimic.list_clips() or ["none installed"])
def test_installed_clips_are_human_and_come_down_to_the_ground(name: str) -> None:
    clip = load_motion(f"deepmimic:{name}")
    assert "pybullet" not in sys.modules
    assert clip.name in list_motions() and clip.source.startswith("DeepMimic humanoid3d_")
    assert 0.5 < clip.duration < 10.0
    assert clip.joint_speeds().max() < 35.0  # [rad/s], a punch is about 27
    assert np.linalg.norm(np.diff(clip.root_position, axis=0), axis=1).max() * clip.fps < 6.0  # [m/s]
    for side in ("left", "right"):
        # Knees never bend the wrong way: the shin in the thigh's rest frame does not go forward of straight.
        knee = Rotation.from_quat(clip.local_rotations[:, joint_index(f"{side}_knee")], scalar_first=True)
        assert knee.as_rotvec()[:, 0].min() > np.radians(-20.0)
        assert knee.magnitude().max() < np.radians(160.0)
    heights = lowest_heights(clip, load_asset())
    assert heights.min() > -2e-3
    assert np.sort(heights)[: max(2, len(heights) // 20)].max() < 0.03


@installed
def test_walk_goes_forward_with_a_foot_on_the_ground() -> None:
    walk = load_motion("deepmimic:walk")
    assert lowest_heights(walk, load_asset()).max() < 0.012
    assert walk.joint_speeds().max() < 8.0  # [rad/s]; the file jumps at 15 where two halves were spliced
    velocity = (walk.root_position[-1] - walk.root_position[0]) / walk.duration
    assert -1.3 < velocity[1] < -0.7 and abs(velocity[0]) < 0.1
    joints = world_joints(walk)
    legs = joints["left_ankle"][:, 1] - joints["right_ankle"][:, 1]
    arms = joints["left_wrist"][:, 1] - joints["right_wrist"][:, 1]
    assert np.corrcoef(legs, arms)[0, 1] < -0.5  # arms swing against the legs


@installed
def test_getting_up_goes_from_lying_to_standing() -> None:
    for name, faces_up in (("getup_facedown", False), ("getup_faceup", True)):
        motion = load_motion(f"deepmimic:{name}")
        joints = world_joints(motion)
        assert joints["head"][0, 2] < 0.5 and joints["head"][-1, 2] > 1.3
        forward = Rotation.from_quat(motion.local_rotations[0, 0], scalar_first=True).apply([0.0, -1.0, 0.0])
        assert (forward[2] > 0.5) == faces_up and abs(forward[2]) > 0.5
