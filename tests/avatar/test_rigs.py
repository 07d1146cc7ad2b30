"""Rigs of every naming scheme give the 22 joints, and a rig that lacks some is completed."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body import rigs
from piavatar_envs.avatar.body.asset import dense_weights
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset

#: Names of the pelvis, spine1-3, neck, head, then collar, shoulder, elbow, wrist, hip, knee, ankle, foot of a side.
SCHEMES: dict[str, tuple[str, str]] = {
    "mixamo": (
        "mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck mixamorig:Head",
        "mixamorig:{Left}Shoulder mixamorig:{Left}Arm mixamorig:{Left}ForeArm mixamorig:{Left}Hand "
        "mixamorig:{Left}UpLeg mixamorig:{Left}Leg mixamorig:{Left}Foot mixamorig:{Left}ToeBase",
    ),
    "unreal": (
        "pelvis spine_01 spine_02 spine_03 neck_01 head",
        "clavicle_{l} upperarm_{l} lowerarm_{l} hand_{l} thigh_{l} calf_{l} foot_{l} ball_{l}",
    ),
    "rigify": (
        "DEF-spine DEF-spine.001 DEF-spine.002 DEF-spine.003 DEF-spine.004 DEF-spine.006",
        "DEF-shoulder.{L} DEF-upper_arm.{L} DEF-forearm.{L} DEF-hand.{L} DEF-thigh.{L} DEF-shin.{L} DEF-foot.{L} "
        "DEF-toe.{L}",
    ),
    "makehuman": (
        "root spine05 spine03 spine01 neck01 head",
        "clavicle.{L} upperarm01.{L} lowerarm01.{L} wrist.{L} upperleg01.{L} lowerleg01.{L} foot.{L} toe3-1.{L}",
    ),
    "cmu": (
        "Hips LowerBack Spine Spine1 Neck Head",
        "{Left}Shoulder {Left}Arm {Left}ForeArm {Left}Hand {Left}UpLeg {Left}Leg {Left}Foot {Left}ToeBase",
    ),
    "asf": (
        "root lowerback upperback thorax lowerneck head",
        "{l}clavicle {l}humerus {l}radius {l}wrist {l}femur {l}tibia {l}foot {l}toes",
    ),
    "daz": (
        "hip abdomenLower abdomenUpper chestLower neckLower head",
        "{l}Collar {l}ShldrBend {l}ForearmBend {l}Hand {l}ThighBend {l}Shin {l}Foot {l}Toe",
    ),
    "biped": (
        "Bip01_Pelvis Bip01_Spine Bip01_Spine1 Bip01_Spine2 Bip01_Neck Bip01_Head",
        "Bip01_{L}_Clavicle Bip01_{L}_UpperArm Bip01_{L}_Forearm Bip01_{L}_Hand Bip01_{L}_Thigh Bip01_{L}_Calf "
        "Bip01_{L}_Foot Bip01_{L}_Toe0",
    ),
    "kaykit": (
        "hips spine chest upperchest neck head",
        "shoulder.{l} upperarm.{l} lowerarm.{l} wrist.{l} upperleg.{l} lowerleg.{l} foot.{l} toes.{l}",
    ),
    "vroid": (
        "J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head",
        "J_Bip_{L}_Shoulder J_Bip_{L}_UpperArm J_Bip_{L}_LowerArm J_Bip_{L}_Hand J_Bip_{L}_UpperLeg "
        "J_Bip_{L}_LowerLeg J_Bip_{L}_Foot J_Bip_{L}_ToeBase",
    ),
    "smpl": (
        "Pelvis Spine1 Spine2 Spine3 Neck Head",
        "{L}_Collar {L}_Shoulder {L}_Elbow {L}_Wrist {L}_Hip {L}_Knee {L}_Ankle {L}_Foot",
    ),
    "poser": (
        "Hips Chest Chest2 Chest3 Neck Head",
        "{Left}Collar {Left}Shoulder {Left}Elbow {Left}Wrist {Left}Hip {Left}Knee {Left}Ankle {Left}Toe",
    ),
}
_MIDDLE = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_SIDE = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")


@pytest.fixture(scope="module")
def asset():
    return load_asset()


def named(scheme: str) -> list[str]:
    """Return a scheme's names of our joints."""
    middle, side = SCHEMES[scheme]
    by_joint = dict(zip(_MIDDLE, middle.split(), strict=True))
    for ours, long, short in (("left", "Left", "L"), ("right", "Right", "R")):
        words = {"Left": long, "L": short, "l": short.lower()}
        by_joint |= {f"{ours}_{j}": n.format(**words) for j, n in zip(_SIDE, side.split(), strict=True)}
    return [by_joint[joint] for joint in JOINT_NAMES]


def without(joints: set[str], names, parents, positions):
    """Return a rig without some of its nodes, whose children hang on the next node above."""
    kept = [index for index, joint in enumerate(JOINT_NAMES) if joint not in joints]

    def above(index: int) -> int:
        index = parents[index]
        while index >= 0 and index not in kept:
            index = parents[index]
        return kept.index(index) if index >= 0 else -1

    return [names[i] for i in kept], [above(i) for i in kept], np.asarray(positions)[kept]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_is_read(scheme, asset):
    found = rigs.map_joints(named(scheme), PARENTS, asset.joints)
    assert [found.nodes[joint] for joint in JOINT_NAMES] == list(range(22))
    assert found.missing == () and found.notes == () and found.aliases == {}
    assert np.array_equal(rigs.joints_of(found, asset.joints), asset.joints)
    assert np.array_equal(rigs.owner_of_nodes(found, PARENTS), np.arange(22))


def test_helpers_twists_and_fingers_follow_their_joint(asset):
    names, parents, places = named("unreal"), list(PARENTS), list(asset.joints)
    root, extra = len(names), {}
    for name, above in (
        ("upperarm_twist_01_l", "left_shoulder"), ("index_01_l", "left_wrist"), ("index_02_l", None),
        ("ik_foot_l", root), ("jaw", "head"), ("neck_02", "neck"), ("thigh_twist_01_r", "right_hip"),
    ):  # fmt: skip
        parent = len(names) - 1 if above is None else above if above == root else joint_index(above)
        if above == root:
            parent = -1
        extra[len(names)] = 0 if above == root else joint_index(above or "left_wrist")
        names.append(name)
        parents.append(parent)
        places.append(places[max(parent, 0)] + [0.0, 0.0, 0.01])
    found = rigs.map_joints(names, parents, np.array(places))
    assert [found.nodes[joint] for joint in JOINT_NAMES] == list(range(22))
    owners = rigs.owner_of_nodes(found, parents)
    assert {node: owners[node] for node in extra} == extra


@pytest.mark.parametrize(
    ("lacks", "far"),
    [
        ({"spine2"}, 0.02),
        ({"spine1", "spine3"}, 0.03),
        ({"left_foot", "right_foot"}, 0.02),
        ({"left_collar", "right_collar"}, 0.02),
        ({"neck"}, 0.03),
        ({"spine2", "neck", "left_collar", "right_collar", "left_foot", "right_foot"}, 0.03),
    ],
    ids=lambda value: "+".join(sorted(value)) if isinstance(value, set) else "",
)
def test_missing_joints_are_made_where_the_embedded_body_has_them(lacks, far, asset):
    names, parents, places = without(lacks, named("kaykit"), PARENTS, asset.joints)
    found = rigs.map_joints(names, parents, places)
    assert set(found.missing) == lacks and "made by interpolation" in found.notes[-1]
    joints = rigs.joints_of(found, places)
    assert np.linalg.norm(joints - asset.joints, axis=1).max() < far
    # Weights of the joints that are made move the flesh that they move in the embedded body.
    dense = dense_weights(asset.skin_joints, asset.skin_weights)
    poor = dense.copy()
    for joint in sorted(lacks, key=joint_index, reverse=True):
        poor[:, PARENTS[joint_index(joint)]] += poor[:, joint_index(joint)]
        poor[:, joint_index(joint)] = 0.0
    spread = rigs.spread_weights(poor, asset.vertices, joints)
    assert np.allclose(spread.sum(axis=1), 1.0) and spread.min() >= 0.0
    for joint in lacks - {"left_collar", "right_collar"}:
        index = joint_index(joint)
        assert np.abs(spread[:, index] - dense[:, index]).mean() < 0.6 * np.abs(poor[:, index] - dense[:, index]).mean()
    for joint in lacks & {"left_collar", "right_collar"}:
        assert spread[:, joint_index(joint)].sum() > 10.0


def test_limbs_whose_bones_are_only_numbered(asset):
    side = (
        "{l}_shoulder_0",
        "arm_joint_{l}_1",
        "arm_joint_{l}_2",
        "arm_joint_{l}_3",
        *(f"leg_joint_{{l}}_{i}" for i in range(4)),
    )
    middle = ("torso_joint_1", "torso_joint_2", "torso_joint_3", "torso_joint_4", "neck_joint_1", "neck_joint_2")
    by_joint = dict(zip(_MIDDLE, middle, strict=True))
    for ours, letter in (("left", "l"), ("right", "r")):
        by_joint |= {f"{ours}_{j}": n.format(l=letter) for j, n in zip(_SIDE, side, strict=True)}
    found = rigs.map_joints([by_joint[joint] for joint in JOINT_NAMES], PARENTS, asset.joints)
    assert [found.nodes[joint] for joint in JOINT_NAMES] == list(range(22))


def test_a_copy_of_the_skeleton_moves_with_the_first(asset):
    """Clothes may be bound to bones of their own, which have the same names."""
    names, parents = named("mixamo") * 2, [*PARENTS, *(p + 22 if p >= 0 else -1 for p in PARENTS)]
    found = rigs.map_joints(names, parents, np.tile(asset.joints, (2, 1)))
    assert np.array_equal(rigs.owner_of_nodes(found, parents), np.tile(np.arange(22), 2))


def test_the_mapping_by_hand_has_the_last_word(asset, tmp_path):
    names = [f"Bone.{index:03d}" for index in range(22)]
    with pytest.raises(
        ValueError, match=r"no node for head, left_hip.*found none; other nodes are Bone\.000.*mapping="
    ):
        rigs.map_joints(names, PARENTS, asset.joints)
    by_hand = dict(zip(JOINT_NAMES, names, strict=True))
    assert rigs.map_joints(names, PARENTS, asset.joints, mapping=by_hand).missing == ()
    made = rigs.map_joints(names, PARENTS, asset.joints, mapping=by_hand | {"left_foot": ""})
    assert made.missing == ("left_foot",)
    file = tmp_path / "map.json"
    file.write_text('{"left_elbow": "LowerArm.L"}')
    assert rigs.read_mapping(file) == {"left_elbow": "LowerArm.L"}
    with pytest.raises(ValueError, match=r"'lowerarm'.*near are"):
        rigs.map_joints(named("unreal"), PARENTS, asset.joints, mapping={"left_elbow": "lowerarm"})
    with pytest.raises(ValueError, match="'elbow'; the joints are pelvis"):
        rigs.map_joints(named("unreal"), PARENTS, asset.joints, mapping={"elbow": "lowerarm_l"})
    with pytest.raises(ValueError, match="'hand_l' is taken for left_elbow and left_wrist"):
        rigs.map_joints(named("unreal"), PARENTS, asset.joints, mapping={"left_elbow": "hand_l"})
    file.write_text("[1, 2]")
    with pytest.raises(ValueError, match="is not a mapping of joints"):
        rigs.read_mapping(file)


def test_a_humanoid_map_goes_before_names(asset):
    names = named("unreal")
    names[joint_index("left_elbow")], names[joint_index("left_wrist")] = "hand_l", "lowerarm_l"
    bones = {rigs.VRM_JOINTS[joint]: joint_index(joint) for joint in rigs.VRM_JOINTS}
    found = rigs.map_joints(names, PARENTS, asset.joints, humanoid=bones | {"spine": 3, "chest": 6, "upperChest": 9})
    assert [found.nodes[joint] for joint in JOINT_NAMES] == list(range(22))


@pytest.mark.parametrize("toes", [True, False], ids=["toes", "no_toes"])
@pytest.mark.parametrize("mirrored", [False, True], ids=["right_handed", "left_handed"])
def test_axes_are_found(toes, mirrored, asset):
    names, parents, places = named("mixamo"), PARENTS, np.asarray(asset.joints, dtype=float)
    tips = places[[joint_index("left_foot"), joint_index("right_foot")]]
    if not toes:
        names, parents, places = without({"left_foot", "right_foot"}, names, parents, places)
    lean = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(0.2), -np.sin(0.2)], [0.0, np.sin(0.2), np.cos(0.2)]])
    for turn in (
        np.eye(3),
        np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
        np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]),
    ):
        turn = turn @ np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0])
        theirs = 100.0 * places @ (turn @ lean).T
        found = rigs.map_joints(names, parents, theirs)
        axes, mirrors = rigs.axes_of(found, theirs, 100.0 * tips @ (turn @ lean).T)
        assert mirrors is mirrored and np.array_equal(axes, turn.T)


def test_broken_rigs_end_in_one_line(asset):
    with pytest.raises(ValueError, match="pass as many of each"):
        rigs.map_joints(["a"], [-1, 0], np.zeros((2, 3)))
    with pytest.raises(ValueError, match="span 0 upwards"):
        rigs.joints_of(rigs.map_joints(named("mixamo"), PARENTS, np.zeros((22, 3))), np.zeros((22, 3)))
    around = np.roll(np.arange(22), 1)  # every node hangs on another
    rigs.owner_of_nodes(rigs.map_joints(named("mixamo"), around, asset.joints), around)
