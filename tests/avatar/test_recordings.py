"""Motions of other skeletons: clips of ours written with other names, units, axes and zero poses come back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.rigs import VRM_JOINTS
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import Motion, load_motion
from piavatar_envs.avatar.motion.bvh import read_bvh
from piavatar_envs.avatar.motion.gltf_animations import read_animation
from piavatar_envs.avatar.motion.library import clips_of
from piavatar_envs.avatar.motion.recording import to_motion
from scripts.gltf_files import glb
from tests.avatar.skeletons import X_UP, Y_UP, Y_UP_BACK, Z_UP, Skeleton, mixamo, unreal, write_bvh, write_glb

REST = load_asset().joints.astype(np.float64)


@pytest.fixture(scope="module")
def squat() -> Motion:
    return load_motion("squat").resample(30.0)


@pytest.fixture(scope="module")
def kick() -> Motion:
    return load_motion("kick").resample(30.0)


def differences(got: Motion, expected: Motion) -> tuple[float, float]:
    """Return the greatest distance of a joint [m] and the greatest angle between local rotations [rad]."""
    places = [motion.joint_frames(REST)[1] for motion in (got, expected)]
    turns = [Rotation.from_quat(motion.local_rotations.reshape(-1, 4), scalar_first=True) for motion in (got, expected)]
    distance = np.linalg.norm(places[0] - places[1], axis=-1).max()
    return float(distance), float((turns[0].inv() * turns[1]).magnitude().max())


# Reading


def test_channels_in_any_order_turn_as_they_are_written(tmp_path: Path) -> None:
    path = tmp_path / "arm.bvh"
    path.write_bytes(
        b"HIERARCHY\r\nROOT  upper arm {\r\nOFFSET 9 9 9\r\n"
        b"CHANNELS 6 Yrotation Zposition xrotation Xposition Yposition Zrotation\r\n"
        b"\tJOINT lower {\r\n\t\tOFFSET 1\t2 3\r\n\t\tCHANNELS 2 Zrotation Yposition\r\n"
        b"\t\tEnd Site\r\n{\r\nOFFSET 0 0 1\r\n}\r\n}\r\n}\r\n"
        b"MOTION\r\nFrames: 2\r\nFrame Time: 0.0083333\r\n0 0 0 0 0 0 0 0\r\n90 5 90 4 7 -90  30 -8\r\n"
    )
    recording = read_bvh(path)
    assert recording.names == ("upper arm", "lower") and recording.fps == 120.0 and list(recording.parents) == [-1, 0]
    np.testing.assert_allclose(recording.zero, [[9, 9, 9], [10, 11, 12]])
    y, x, z = (Rotation.from_euler(axis, angle, degrees=True) for axis, angle in (("y", 90), ("x", 90), ("z", -90)))
    np.testing.assert_allclose(recording.positions[1, 0], [4, 7, 5])
    np.testing.assert_allclose(recording.positions[1, 1], [4, 7, 5] + (y * x * z).apply([1, -8, 3]), atol=1e-14)
    turn = y * x * z * Rotation.from_euler("z", 30, degrees=True)
    assert (recording.turns[1][1].inv() * turn).magnitude() < 1e-14


def test_positions_are_those_of_pybvh(tmp_path: Path, kick: Motion) -> None:
    pybvh = pytest.importorskip("pybvh", reason="needs pybvh, beside rotations by hand: make test-avatars")
    path = write_bvh(tmp_path / "kick.bvh", kick, REST, Skeleton(), order="YXZ")
    recording, other = read_bvh(path), pybvh.read_bvh_file(str(path))
    places = other.node_positions() if callable(other.node_positions) else other.node_positions
    names = [node.name for node in other.nodes]
    theirs = np.asarray(places)[:, [names.index(name) for name in recording.names]]
    assert np.abs(theirs - recording.positions).max() <= 1e-14 * max(1.0, np.abs(theirs).max())


GOOD = (
    b"HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\nEnd Site\n{\nOFFSET 0 1 0\n}\n}\n"
)
FRAMES = b"MOTION\nFrames: 3\nFrame Time: 0.1\n1 2 3\n4 5 6\n7 8 9\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no MOTION"),
        (b"\x00\xff" * 500, "no MOTION"),
        (GOOD, "no MOTION"),
        (GOOD + FRAMES.replace(b"9", b""), "8 numbers, no multiple of its 3 channels"),
        (GOOD + FRAMES.replace(b"5", b"nan"), "'a' is nan in frame 1"),
        (GOOD + FRAMES.replace(b"5", b"five"), "five"),
        (GOOD + FRAMES.replace(b"Frames: 3", b"Frames: 4000000000"), "3 frames, and its header says 4000000000"),
        (GOOD + FRAMES.replace(b"Frames: 3", b"Frames: -3"), "header says -3"),
        (GOOD + FRAMES.replace(b"0.1", b"0"), "frame time is 0 s"),
        (GOOD + FRAMES.replace(b"0.1", b"inf"), "frame time is inf s"),
        (GOOD + b"MOTION\nFrames: 1\nFrame Time: 0.1\n1 2 3\n", "1 frames"),
        (GOOD + b"MOTION\n", "not followed by"),
        (GOOD.replace(b"}\n}", b"}") + FRAMES, "ends within 1 braces"),
        (GOOD + GOOD[10:] + FRAMES, "second root"),
        (b"HIERARCHY\n" + b"JOINT a\n{\n" * 200_000 + FRAMES, "more than 2000 joints"),
        (GOOD.replace(b"a\n", b"{" * 200_000) + FRAMES, "ends within 200000 braces"),
        (GOOD.replace(b"3 X", b"4000000000 X") + FRAMES, "4000000000 X"),
        (GOOD.replace(b"Yrot", b"Xrot") + FRAMES, "as many different names"),
        (GOOD.replace(b"Yrotation", b"Wrotation") + FRAMES, "as many different names"),
        (GOOD.replace(b"0 1 0", b"0 1e999 0") + FRAMES, "three numbers"),
        (GOOD.replace(b"OFFSET 0 0 0", b"OFFSET 0 0") + FRAMES, "three numbers"),
        (GOOD.replace(b"OFFSET", b"MATRIX") + FRAMES, "MATRIX"),
    ],
)
def test_files_that_are_no_motion_are_refused_in_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.bvh"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as error:
        read_bvh(path)
    assert str(error.value).startswith(f"{path} is not a BVH motion: ") and "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError):
        load_motion(tmp_path / "none.bvh")


def test_what_is_no_file_of_a_motion_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"is a folder.*\.bvh"):
        load_motion(tmp_path)
    (tmp_path / "walk.fbx").write_bytes(b"Kaydara FBX Binary")
    with pytest.raises(ValueError, match=r"walk\.fbx is not a motion: it is FBX.*glTF"):
        load_motion(tmp_path / "walk.fbx")
    with pytest.raises(FileNotFoundError, match="no motion file or folder"):
        load_motion(str(tmp_path / "walks"))


def test_a_header_with_another_count_is_warned_of(tmp_path: Path, squat: Motion) -> None:
    path = write_bvh(tmp_path / "squat.bvh", squat, REST, Skeleton(), announced=squat.num_frames - 1)
    with pytest.warns(UserWarning, match=f"says {squat.num_frames - 1} frames, there are {squat.num_frames}"):
        assert len(read_bvh(path).positions) == squat.num_frames


# Retargeting


@pytest.mark.parametrize("clip", ["squat", "kick"])
@pytest.mark.parametrize(
    ("skeleton", "how"),
    [
        (Skeleton(mixamo, 0.01, Y_UP), {}),
        (Skeleton(unreal, 1.0, Y_UP_BACK), {"order": "XYZ", "newline": "\r\n"}),
        (Skeleton(mixamo, 0.0254, Z_UP), {"order": "YXZ"}),
        (Skeleton(unreal, 0.001, X_UP), {"order": "ZYX"}),
        (Skeleton(mixamo, 0.056, Y_UP, zero={}), {"order": "YZX"}),  # our own rest pose, of an unknown unit
        (Skeleton(mixamo, 0.01, Y_UP, frames=Rotation.random(NUM_JOINTS, random_state=1)), {}),  # no zero pose at all
    ],
    ids=["centimetres", "metres", "inches", "x_up", "rest_pose", "no_zero_pose"],
)
def test_a_clip_comes_back_from_another_skeleton(tmp_path: Path, request, clip: str, skeleton, how: dict) -> None:
    motion = request.getfixturevalue(clip)
    read = to_motion(read_bvh(write_bvh(tmp_path / "clip.bvh", motion, REST, skeleton, **how)), REST)
    distance, angle = differences(read, motion)
    assert distance < 1e-3 and angle < 1e-3 and read.fps == motion.fps
    unit = {0.01: "centimetres", 1.0: "metres", 0.0254: "inches", 0.001: "millimetres", 0.056: "unknown"}[skeleton.unit]
    assert unit in read.notes[-1]


def test_a_larger_skeleton_takes_larger_steps(tmp_path: Path, squat: Motion) -> None:
    giant = Motion("giant", squat.fps, squat.local_rotations, 1.3 * squat.root_position)
    path = write_bvh(tmp_path / "giant.bvh", giant, 1.3 * REST, Skeleton())
    distance, angle = differences(to_motion(read_bvh(path), REST), squat)
    assert distance < 1e-3 and angle < 1e-3


def test_the_zero_pose_before_the_motion_is_dropped(tmp_path: Path, squat: Motion, kick: Motion) -> None:
    posed = Motion("posed", kick.fps, kick.local_rotations[20:], kick.root_position[20:])
    path = write_bvh(tmp_path / "first.bvh", posed, REST, Skeleton(), rest_first=True)
    read = to_motion(read_bvh(path), REST)
    assert read.num_frames == posed.num_frames and any("dropped" in note for note in read.notes)
    assert differences(read, posed)[0] < 1e-3
    # a clip that begins in its zero pose and moves on from it keeps it
    path = write_bvh(tmp_path / "own.bvh", squat, REST, Skeleton(zero={}))
    assert to_motion(read_bvh(path), REST).num_frames == squat.num_frames


def test_a_world_of_another_up_is_found(tmp_path: Path, squat: Motion) -> None:
    # The zero pose is y-up, the root's rotation stands the figure up in a z-up world.
    skeleton = Skeleton(axes=Y_UP, world=Z_UP)
    path = write_bvh(tmp_path / "stood_up.bvh", squat, REST, skeleton, order="XZY")
    with pytest.warns(UserWarning, match="another axis"):
        read = to_motion(read_bvh(path), REST)
    distance, angle = differences(read, squat)
    assert distance < 1e-3 and angle < 1e-3


def test_a_left_handed_file_is_mirrored(tmp_path: Path, kick: Motion) -> None:
    path = write_bvh(tmp_path / "kick.bvh", kick, REST, Skeleton())
    left_handed = read_bvh(path).mirrored()
    distance, angle = differences(to_motion(left_handed, REST), kick)
    assert distance < 1e-3 and angle < 1e-3


def test_a_skeleton_of_fewer_joints_shares_the_turns_of_its_trunk(tmp_path: Path, squat: Motion) -> None:
    # Joints that are renamed to what is none are lacking; the others still turn in the world as they did.
    lacking = ("spine2", "neck", "left_collar", "right_collar", "left_foot", "right_foot")
    skeleton = Skeleton(name=lambda joint: f"aux_{JOINT_NAMES.index(joint)}" if joint in lacking else mixamo(joint))
    path = write_bvh(tmp_path / "few.bvh", squat, REST, skeleton)
    mapping = {joint: "" for joint in lacking} | {j: mixamo(j) for j in ("spine1", "spine3")}
    read = to_motion(read_bvh(path), REST, mapping)
    got, expected = (motion.joint_frames(REST)[0] for motion in (read, squat))
    for joint in ("pelvis", "spine1", "spine3", "head", "left_wrist", "right_ankle"):
        np.testing.assert_allclose(got[:, joint_index(joint)], expected[:, joint_index(joint)], atol=1e-3)
    between = Rotation.from_matrix(got[:, joint_index("spine1")]).inv() * Rotation.from_matrix(
        got[:, joint_index("spine3")]
    )
    own = Rotation.from_quat(read.local_rotations[:, joint_index("spine2")], scalar_first=True)
    np.testing.assert_allclose(own.magnitude(), 0.5 * between.magnitude(), atol=1e-6)


def test_a_file_stands_on_the_ground_and_its_glitches_are_warned_of(tmp_path: Path, squat: Motion) -> None:
    path = write_bvh(tmp_path / "squat.bvh", squat.translated(np.array([0.0, 0.0, 3.0])), REST, Skeleton())
    assert differences(load_motion(path), squat)[0] < 0.012  # the level of the ground is found in every window
    rotations = squat.local_rotations.copy()
    rotations[10, joint_index("head")] = Rotation.from_euler("z", 60, degrees=True).as_quat(scalar_first=True)
    path = write_bvh(tmp_path / "glitch.bvh", Motion("g", 30.0, rotations, squat.root_position), REST, Skeleton())
    with pytest.warns(UserWarning, match=r"head turns at .* rad/s in frame (9|10)"):
        load_motion(path)


def test_clips_that_nearly_meet_themselves_are_closed_when_asked(tmp_path: Path, kick: Motion) -> None:
    path = write_bvh(tmp_path / "kick.bvh", kick, REST, Skeleton())
    assert not load_motion(path).loop and load_motion(path, loop=True).loop
    cut = Motion("cut", kick.fps, kick.local_rotations[:45], kick.root_position[:45])
    path = write_bvh(tmp_path / "cut.bvh", cut, REST, Skeleton())
    assert not load_motion(path, loop=True).loop  # a leg in the air does not meet the stance
    time = np.linspace(0.0, 1.0, 31)
    for angle, meets in ((0.5 * (1.0 - np.cos(2 * np.pi * time)), True), (np.sin(np.pi * time), False)):
        swing = np.tile([1.0, 0.0, 0.0, 0.0], (31, NUM_JOINTS, 1))  # to and fro, or half of that: then speeds differ
        swing[:, joint_index("left_elbow")] = Rotation.from_rotvec(-angle[:, None] * [1, 0, 0]).as_quat(
            scalar_first=True
        )
        assert Motion("swing", 30.0, swing, np.zeros((31, 3))).meets_itself() == meets


# glTF animations


@pytest.mark.parametrize(
    ("skeleton", "how"),
    [
        (Skeleton(mixamo, 0.01, Y_UP), {}),
        (Skeleton(unreal, 1.0, Y_UP_BACK, frames=Rotation.random(NUM_JOINTS, random_state=2)), {"mode": "CUBICSPLINE"}),
        (Skeleton(mixamo, 1.0, Y_UP), {"shown": 30}),
        (Skeleton(unreal, 0.01, Y_UP), {"armature": Rotation.from_euler("x", -90, degrees=True), "shown": 0}),
    ],
    ids=["centimetres", "own_axes", "shown_in_motion", "armature"],
)
def test_animations_come_back(tmp_path: Path, squat: Motion, kick: Motion, skeleton, how: dict) -> None:
    path = write_glb(tmp_path / "hero.glb", {"Squat down": squat, "Kick.001": kick}, REST, skeleton, **how)
    assert clips_of(path) == ["#Squat down", "#Kick.001"]
    for name, motion in (("Squat down", squat), ("Kick.001", kick)):
        read = to_motion(read_animation(path, name), REST)
        distance, angle = differences(read, motion)
        assert distance < 1e-3 and angle < 1e-3 and read.fps == motion.fps
    assert differences(load_motion(f"{path}#Kick.001"), kick)[0] < 0.03
    with pytest.raises(ValueError, match=r"the animations Squat down, Kick\.001; name one of them: hero\.glb#Sq"):
        load_motion(path)
    with pytest.raises(ValueError, match="no animation 'Run'"):
        load_motion(f"{path}#Run")


def test_bones_of_a_vrm_animation_need_no_names(tmp_path: Path, kick: Motion) -> None:
    skeleton = Skeleton(lambda joint: f"n{JOINT_NAMES.index(joint)}", 1.0, Y_UP)
    content = write_glb(tmp_path / "kick.glb", {"": kick}, REST, skeleton).read_bytes()
    length = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + length])
    del document["skins"]
    spine = {"spine1": "spine", "spine2": "chest", "spine3": "upperChest"}
    bones = {bone: {"node": 1 + joint_index(joint)} for joint, bone in (VRM_JOINTS | spine).items()}
    document["extensions"] = {"VRMC_vrm_animation": {"specVersion": "1.0", "humanoid": {"humanBones": bones}}}
    path = tmp_path / "kick.vrma"
    path.write_bytes(glb(json.dumps(document).encode(), content[28 + length :]))
    distance, angle = differences(to_motion(read_animation(path), REST), kick)
    assert distance < 1e-3 and angle < 1e-3 and load_motion(path).num_frames == kick.num_frames


def test_files_without_a_motion_of_a_body_are_refused(tmp_path: Path, squat: Motion) -> None:
    path = write_glb(tmp_path / "hero.glb", {"a": squat}, REST, Skeleton())
    content = path.read_bytes()
    assert load_motion(path).num_frames == squat.num_frames  # the only one needs no name
    for old, new, message in (
        (b'"animations"', b'"aminations"', "no animation"),
        (b"glTF", b"gltf", "not a glTF file"),
        (b'"path": "rotation"', b'"path": "rotatiom"', None),  # of no use, and passed over
        (content[-4000:], b"", "not a glTF file"),
    ):
        (tmp_path / "bad.glb").write_bytes(content.replace(old, new))
        if message is None:
            still = load_motion(tmp_path / "bad.glb")
            assert still.joint_speeds()[:, 1:].max() < 1e-6
            continue
        with pytest.raises(ValueError, match=message) as error:
            load_motion(tmp_path / "bad.glb")
        assert "\n" not in str(error.value)
