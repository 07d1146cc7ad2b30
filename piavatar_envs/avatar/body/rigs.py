"""Any human rig to the 22 joints: by a VRM humanoid map, by the names of its nodes, by its hierarchy, or by hand.

A rig is a tree of named nodes with rest positions. Names are read as words without side, number and the prefixes of
exporters (Mixamo, Unreal, Rigify, MakeHuman, CMU, Daz, Biped, KayKit and their like), so that
``mixamorig:LeftForeArm``, ``lowerarm_l`` and ``DEF-forearm.L`` are one joint. The spine is the chain of nodes from the
pelvis to the neck, of which those are taken that lie closest to the embedded body's joints. What a rig lacks (a third
spine joint, a neck, collars, toes) is put where the embedded body has it, and takes its share of the weights from the
joint below.
"""

from __future__ import annotations

import difflib
import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.core.reading import reading

SIDES = ("left", "right")
#: Joints that no rig may lack: the others are made from them.
REQUIRED: tuple[str, ...] = (
    "head",
    *(f"{side}_{joint}" for joint in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist") for side in SIDES),
)
#: Words of joints of one side, the better ones first.
_SIDED: dict[str, tuple[tuple[str, ...], ...]] = {
    "hip": (("thigh", "upleg", "upperleg", "legupper", "femur"), ("hip",)),
    "knee": (("calf", "shin", "lowerleg", "lowleg", "leglower", "tibia", "knee"),),
    "ankle": (("ankle",),),
    "foot": (("toe", "toes", "ball", "football"),),
    "collar": (("clavicle", "collar", "collarbone"),),
    "shoulder": (("upperarm", "uparm", "armupper", "shldr", "humerus", "arm"),),
    "elbow": (("forearm", "lowerarm", "lowarm", "armlower", "elbow", "radius"),),
    "wrist": (("wrist",), ("hand", "palm")),
}
_PELVIS = ("pelvis", "hips", "hip")
_NECK = ("neck", "necktwist", "necklower", "lowerneck")
_SPINE = (
    "spine", "chest", "upperchest", "torso", "abdomen", "waist", "lowerback", "upperback", "thorax", "ribcage",
    "abdomenlower", "abdomenupper", "chestlower", "chestupper", "back", "body",
)  # fmt: skip
#: Parts of names that say nothing: prefixes of exporters and words for a bone.
_NOISE = frozenset(
    "mixamorig def org mch cc base bip j c b m f bind jnt joint bone sk rig bend genesis armature skeleton character "
    "avatar valve biped x stretch".split()
)
_LEFT, _RIGHT = ("left", "l"), ("right", "r")
_KNOWN = frozenset(
    itertools.chain(*(tier for tiers in _SIDED.values() for tier in tiers), ("leg", "shoulder", "foot", "hand"))
)
#: Joints of VRM's humanoid (https://github.com/vrm-c/vrm-specification), which 0.x and 1.0 share.
VRM_JOINTS: dict[str, str] = {
    "pelvis": "hips",
    "neck": "neck",
    "head": "head",
    **{
        f"{side}_{ours}": f"{side}{theirs}"
        for side in SIDES
        for ours, theirs in (
            ("hip", "UpperLeg"), ("knee", "LowerLeg"), ("ankle", "Foot"), ("foot", "Toes"), ("collar", "Shoulder"),
            ("shoulder", "UpperArm"), ("elbow", "LowerArm"), ("wrist", "Hand"),
        )
    },
}  # fmt: skip
_VRM_SPINE = ("spine", "chest", "upperChest")
_SPINE_JOINTS = ("spine1", "spine2", "spine3")
#: A node farther than this from the joint that it is a copy of, over the way from the pelvis to the head, is another's.
_OWN_REACH = 0.5
#: Places of the embedded body's joints, as shares of the way from the pelvis over the spine to the head.
TRUNK_SHARES = {"pelvis": 0.0, "spine1": 0.19, "spine2": 0.37, "spine3": 0.59, "neck": 0.91, "head": 1.0}
COLLAR_SHARE = 0.35  # of the way from the neck to the shoulder
PELVIS_ABOVE = 0.057  # the middle of the hips, in lengths of the leg
FOOT_AHEAD, FOOT_BELOW = 0.166, 0.053  # of the toe joint from the ankle, in lengths of the leg
LEAST_NECK = 0.7  # of the way from the hips to the head, for a nameless node
NEAR_HIPS = 0.5  # lengths of the leg that a pelvis node may be away from the middle of the hips
#: The joint at the far end of those that have several.
_ABOVE = {"pelvis": joint_index("spine1"), "spine3": joint_index("neck")}
_FEW_DEFORMERS = 12  # names with DEF- that make the others controls


@dataclass(frozen=True)
class JointMap:
    """Nodes of a rig that are our joints.

    Attributes:
        nodes: node of each joint that was found.
        missing: joints that the rig lacks, in our order; :func:`joints_of` makes them.
        notes: what was guessed or made, for the user, one sentence each.
        aliases: further nodes that move with a joint, though they do not hang on its node.
    """

    nodes: dict[str, int]
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    aliases: dict[int, str] = field(default_factory=dict)


def read_name(name: str) -> tuple[str, str]:
    """Return side (or an empty string) and word of a node's name: ``"DEF-upper_arm.L.001"`` is a left upperarm."""
    own = re.split(r"[:|]", name)[-1]
    split = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", own)
    tokens = [token.lower() for token in re.findall(r"[A-Za-z]+", split)]
    side = next((token for token in tokens if token in _LEFT + _RIGHT), "")
    if side:
        tokens.remove(side)
    word = "".join(token for token in tokens if token not in _NOISE)
    if not side and word not in _KNOWN:
        for mark in ("left", "right", "l", "r"):
            for rest, fits in ((word[len(mark) :], word.startswith(mark)), (word[: -len(mark)], word.endswith(mark))):
                if fits and rest in _KNOWN:
                    return ("left" if mark in _LEFT else "right"), rest
    return ("left" if side in _LEFT else "right" if side in _RIGHT else ""), word


def read_mapping(path: str | Path) -> dict[str, str]:
    """Return a mapping file: one JSON object from our joints to names of nodes; an empty name means a joint to be made.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not such an object.
    """
    with reading(path, 'a mapping of joints (JSON such as {"left_elbow": "LowerArm.L"})'):
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(content, dict) or not all(isinstance(name, str) for name in content.values()):
            raise ValueError("it is not an object of names")
    return content


def map_joints(
    names: Sequence[str],
    parents: Sequence[int],
    positions: np.ndarray,
    humanoid: Mapping[str, int] | None = None,
    mapping: Mapping[str, str] | None = None,
) -> JointMap:
    """Find our joints among the nodes of a rig.

    Args:
        names: of the ``N`` nodes; an empty one is not a candidate.
        parents: node that each hangs on, -1 for a root; without cycles, in any order.
        positions: of the nodes at rest, in any axes and unit, shape ``(N, 3)``.
        humanoid: VRM's map from its bones to nodes, which names go after.
        mapping: by hand, from our joints to names of nodes, which everything goes after.

    Raises:
        ValueError: a joint of :data:`REQUIRED` is not found, or the mapping has a joint or a node that there is not.
    """
    rig = _Rig(names, parents, positions)
    fixed = _by_hand(mapping or {}, list(names))
    nodes = {joint: node for joint, node in fixed.items() if node is not None}
    if humanoid:
        nodes = {joint: humanoid[bone] for joint, bone in VRM_JOINTS.items() if bone in humanoid} | nodes
    for side in SIDES:
        found = rig.limbs(side)
        nodes = {joint: node for joint, node in found.items() if joint not in fixed} | nodes
    notes: list[str] = []
    for joint, node in rig.middle(nodes).items():
        if joint not in fixed:
            nodes.setdefault(joint, node)
    lacking = [joint for joint in REQUIRED if joint not in nodes]
    if lacking:
        raise ValueError(_lacking(lacking, nodes, list(names)))
    if "pelvis" in nodes and "pelvis" not in fixed and rig.hip_distance(nodes) > NEAR_HIPS:
        far = nodes.pop("pelvis")
        notes.append(f"node {names[far]!r} is too far from the hips for a pelvis: it is put above their middle")
    allowed = None if not humanoid else {humanoid[bone] for bone in _VRM_SPINE if bone in humanoid}
    spine = rig.spine(nodes, allowed)
    nodes.update({joint: node for joint, node in spine.items() if joint not in fixed})
    doubled = [node for node in set(nodes.values()) if list(nodes.values()).count(node) > 1]
    if doubled:
        joints = [joint for joint in JOINT_NAMES if nodes.get(joint) == doubled[0]]
        raise ValueError(f"node {names[doubled[0]]!r} is taken for {' and '.join(joints)}: {_REMEDY}")
    nodes = {joint: nodes[joint] for joint in JOINT_NAMES if joint in nodes}
    missing = tuple(joint for joint in JOINT_NAMES if joint not in nodes)
    if missing:
        notes.append(f"the rig has no {', '.join(missing)}: made by interpolation")
    return JointMap(nodes, missing, tuple(notes), rig.aliases(nodes))


def joints_of(joint_map: JointMap, positions: np.ndarray) -> np.ndarray:
    """Return the positions of our joints, with those that the rig lacks made from their neighbours.

    Args:
        joint_map: of the rig.
        positions: of its nodes, in axes of any orientation (a toe is made ahead by the left and the up of the hips and
            the head, so a mirrored rig must have been unmirrored), shape ``(N, 3)``.

    Returns:
        Joints, shape ``(22, 3)`` float64.
    """
    rest = np.asarray(positions, dtype=np.float64)
    made = {joint: rest[node] for joint, node in joint_map.nodes.items()}
    up, left = _up_and_left(made)
    leg = _leg(made)
    if "pelvis" not in made:
        made["pelvis"] = 0.5 * (made["left_hip"] + made["right_hip"]) + PELVIS_ABOVE * leg * up
    known = [joint for joint in TRUNK_SHARES if joint in made]
    shares = [TRUNK_SHARES[joint] for joint in known]
    trunk = np.stack([made[joint] for joint in known])
    for joint, share in TRUNK_SHARES.items():
        if joint not in made:
            made[joint] = np.array([np.interp(share, shares, trunk[:, axis]) for axis in range(3)])
    for side in SIDES:
        if f"{side}_collar" not in made:
            made[f"{side}_collar"] = made["neck"] + COLLAR_SHARE * (made[f"{side}_shoulder"] - made["neck"])
        if f"{side}_foot" not in made:
            ahead = np.cross(left, up)
            made[f"{side}_foot"] = made[f"{side}_ankle"] + leg * (FOOT_AHEAD * ahead - FOOT_BELOW * up)
    return np.stack([made[joint] for joint in JOINT_NAMES])


def owner_of_nodes(joint_map: JointMap, parents: Sequence[int]) -> np.ndarray:
    """Return the joint that each node moves with: its own, or that of the next node above it that has one.

    Returns:
        Indices of joints, shape ``(N,)`` int64; the pelvis where no node above is a joint.
    """
    own = {node: joint_index(joint) for node, joint in joint_map.aliases.items()}
    own |= {node: joint_index(joint) for joint, node in joint_map.nodes.items()}
    owners = np.zeros(len(parents), dtype=np.int64)
    for node in range(len(parents)):
        owners[node] = next((own[above] for above in _upwards(node, parents) if above in own), 0)
    return owners


def of_rig(joint_map: JointMap, parents: Sequence[int], positions: np.ndarray) -> np.ndarray:
    """Return which nodes belong to the rig of a character, and not to another one with the same names.

    Args:
        joint_map: of the rig.
        parents: of the nodes.
        positions: of the nodes, shape ``(N, 3)``.

    Returns:
        Whether each node is below or above a joint, or another node for a joint that is near it, shape ``(N,)`` bool.
    """
    rest, nodes = np.asarray(positions, dtype=np.float64), joint_map.nodes
    near = _OWN_REACH * np.linalg.norm(rest[nodes["head"]] - rest[nodes["pelvis"]])
    also = {
        node
        for node, joint in joint_map.aliases.items()
        if joint not in nodes or np.linalg.norm(rest[node] - rest[nodes[joint]]) <= near
    }
    own = {*nodes.values(), *also}
    above = {node for joint in own for node in _upwards(joint, parents)}
    chains = (_upwards(node, parents) for node in range(len(parents)))
    return np.array([node in above or any(each in own for each in chain) for node, chain in enumerate(chains)], bool)


def axes_of(joint_map: JointMap, positions: np.ndarray, tips: np.ndarray | None = None) -> tuple[np.ndarray, bool]:
    """Return the orthogonal matrix from a rig's axes to ours (left +x, forward -y, up +z), and whether it mirrors.

    Up is from the ankles to the head, left by the names of the sides. A matrix that permutes axes is returned for a rig
    within 30 degrees of one, so that a lean or an uneven pelvis turns nothing. It is a reflection where the toes point
    backwards for these, as in a file of a left-handed program.

    Args:
        joint_map: of the rig.
        positions: of its nodes, shape ``(N, 3)``.
        tips: points of the left and the right foot ahead of the ankles, for a rig without toes, shape ``(2, 3)``.
    """
    rest = np.asarray(positions, dtype=np.float64)
    found = {joint: rest[node] for joint, node in joint_map.nodes.items()}
    up, left = _up_and_left(found)
    ahead = np.zeros(3)
    for index, side in enumerate(SIDES):
        ankle, toe = found[f"{side}_ankle"], found.get(f"{side}_foot")
        if toe is None and tips is not None:
            toe = np.asarray(tips[index], dtype=np.float64)
        if toe is not None:
            ahead += toe - ankle
    forward = np.cross(left, up)
    mirrors = bool(ahead @ forward < -1e-3 * _leg(found))
    axes = np.stack([left, forward if mirrors else -forward, up])
    near = np.zeros((3, 3))
    for row in (2, 0, 1):
        free = np.where(near.any(axis=0), 0.0, np.abs(axes[row]))
        near[row, free.argmax()] = np.sign(axes[row, free.argmax()])
    snaps = (near * axes).sum(axis=1).min() > np.cos(np.radians(30.0))
    return (near if snaps else axes), mirrors


def spread_weights(weights: np.ndarray, points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Give flesh to joints that none follows, as those that a rig lacks: each takes some from the joint it hangs on.

    Beyond the plane through the joint the weight is its own, and it changes over within a quarter of the way to its
    neighbours.

    Args:
        weights: by joint, rows sum to one, shape ``(V, 22)``.
        points: of the skin [m], shape ``(V, 3)``.
        joints: where the joints are [m], shape ``(22, 3)``.

    Returns:
        Weights whose rows sum to one, shape ``(V, 22)``.
    """
    spread = np.array(weights, dtype=np.float64)
    for joint in range(1, NUM_JOINTS):
        if spread[:, joint].max(initial=0.0) > 0.0:
            continue
        name, parent = JOINT_NAMES[joint], PARENTS[joint]
        below, at = joints[parent], np.array(joints[joint])
        child = _ABOVE.get(name, next((c for c in range(NUM_JOINTS) if PARENTS[c] == joint), None))
        if name.endswith("foot"):
            at[2] = below[2]  # the sole is level
        above = 2.0 * at - below if child is None else joints[child]
        share = np.ones(len(points))
        if name.endswith("collar"):
            # Beside the shoulder only: the flank hangs on the chest.
            away = _distance_to_segment(points, at, above)
            share = np.clip(2.0 - away / max(float(np.linalg.norm(above - at)), 1e-9), 0.0, 1.0)
        lower, upper = float(np.linalg.norm(at - below)), float(np.linalg.norm(above - at))
        along = (above - below) / max(float(np.linalg.norm(above - below)), 1e-9)
        beyond = (points - at) @ along
        ramp = np.clip(0.5 + 2.0 * beyond / np.maximum(np.where(beyond < 0.0, lower, upper), 1e-9), 0.0, 1.0)
        moved = ramp * share * spread[:, parent]
        spread[:, joint] += moved
        spread[:, parent] -= moved
    return spread


_REMEDY = 'name the right nodes by mapping=FILE.json, such as {"left_elbow": "LowerArm.L"}'


class _Rig:
    """Names, hierarchy and rest positions of a rig, and the nodes that could be a joint by their name."""

    def __init__(self, names: Sequence[str], parents: Sequence[int], positions: np.ndarray):
        self.names = list(names)
        self.parents = [int(parent) for parent in parents]
        self.rest = np.asarray(positions, dtype=np.float64)
        if not len(self.names) == len(self.parents) == len(self.rest):
            raise ValueError(
                f"a rig of {len(self.names)} names, {len(self.parents)} parents and {len(self.rest)} positions; "
                "pass as many of each"
            )
        deforming = [bool(re.match(r"DEF[-_.]", name)) for name in self.names]
        controls = sum(deforming) >= _FEW_DEFORMERS
        self.words: list[tuple[str, str]] = [
            read_name(name) if deforms or not controls else ("", "")
            for name, deforms in zip(self.names, deforming, strict=True)
        ]
        self.found: dict[tuple[str, str], list[int]] = {}
        for node, key in enumerate(self.words):
            self.found.setdefault(key, []).append(node)
        self.toes: dict[str, list[int]] = {}

    def depth(self, node: int) -> int:
        """Return the number of nodes above a node."""
        return sum(1 for _ in _upwards(node, self.parents)) - 1

    def pick(self, side: str, tiers: Iterable[Sequence[str]]) -> list[int]:
        """Return the nodes nearest to the root that have a word of the first tier that any has; empty if none."""
        for words in tiers:
            nodes = [node for word in words for node in self.found.get((side, word), [])]
            if nodes:
                depths = [self.depth(node) for node in nodes]
                return [node for node, depth in zip(nodes, depths, strict=True) if depth == min(depths)]
        return []

    def limbs(self, side: str) -> dict[str, int]:
        """Return the joints of one side that are found by name."""
        tiers = {joint: list(words) for joint, words in _SIDED.items()}
        # Some words mean the joint above or below it, by which others the rig has.
        tiers["hip" if self.pick(side, tiers["knee"]) else "knee"].append(("leg",))
        tiers["foot" if self.pick(side, tiers["ankle"]) else "ankle"].append(("foot",))
        arm = bool(self.pick(side, tiers["shoulder"]))
        tiers["collar" if arm else "shoulder"].append(("shoulder",))
        found: dict[str, int] = {}
        for joint, words in tiers.items():
            nodes = self.pick(side, words)
            if nodes:
                middle = self.rest[nodes].mean(axis=0)
                found[f"{side}_{joint}"] = nodes[int(np.linalg.norm(self.rest[nodes] - middle, axis=1).argmin())]
                if joint == "foot":
                    self.toes[side] = nodes
        for joints, word in ((("hip", "knee", "ankle", "foot"), "leg"), (("shoulder", "elbow", "wrist"), "arm")):
            links = self.links(self.found.get((side, word), []))
            if len(links) >= 3 and not all(f"{side}_{joint}" in found for joint in joints[:3]):
                found |= {f"{side}_{joint}": node for joint, node in zip(joints, links, strict=False)}
        return found

    def links(self, nodes: Sequence[int]) -> list[int]:
        """Return those of some nodes that hang on each other, the uppermost first: a leg whose bones are numbered."""
        chain: list[int] = []
        for node in sorted(nodes, key=self.depth):
            if not chain or chain[-1] in _upwards(node, self.parents):
                chain.append(node)
        return chain

    def middle(self, limbs: Mapping[str, int]) -> dict[str, int]:
        """Return pelvis, neck and head as far as names and the hierarchy above the limbs give them."""
        found: dict[str, int] = {}
        hips = self.common([limbs.get("left_hip", -1), limbs.get("right_hip", -1)])
        named = [node for word in _PELVIS for node in self.found.get(("", word), [])]
        over_both = [node for node in named if node in hips] or named
        if over_both:
            found["pelvis"] = min(over_both, key=self.depth)
        elif hips:
            found["pelvis"] = hips[0]
        chest = self.common([limbs.get("left_shoulder", -1), limbs.get("right_shoulder", -1)])
        head = limbs.get("head")
        heads, necks = self.pick("", [("head",)]), self.pick("", [_NECK])
        if head is None and heads:
            head = heads[0]
        if head is None and chest:
            above = self.above_chest(chest[0], limbs)
            head = above[-1] if len(above) > 1 - bool(necks) else None
            necks = necks or above[:1]
        if head is not None:
            found["head"] = head
            between = list(itertools.takewhile(lambda node: node not in chest, _upwards(head, self.parents)))[1:]
            if not necks and chest and len(between) < self.depth(head):
                hips_to_head = np.linalg.norm(self.rest[head] - self.rest[limbs["left_hip"]])
                high = [n for n in between if self.rises(n, limbs) > LEAST_NECK * hips_to_head]
                necks = high[-1:]
        if necks and necks[0] != head:
            found["neck"] = necks[0]
        return found

    def above_chest(self, chest: int, limbs: Mapping[str, int]) -> list[int]:
        """Return the chain of nodes named as a spine or neck from the one that the arms hang on to its end."""
        arms = {node for side in SIDES for node in _upwards(limbs[f"{side}_shoulder"], self.parents)}
        chain, here = [], chest
        while True:
            following = [
                node
                for node, parent in enumerate(self.parents)
                if parent == here and node not in arms and self.words[node][1] in (*_SPINE, *_NECK)
            ]
            if len(following) != 1 or len(chain) > len(self.parents):
                return chain
            here = following[0]
            chain.append(here)

    def common(self, nodes: Sequence[int]) -> list[int]:
        """Return the nodes that all of some hang on, the nearest first; empty if one of them is -1."""
        if min(nodes) < 0:
            return []
        ways = [list(_upwards(node, self.parents))[1:] for node in nodes]
        return [node for node in ways[0] if all(node in way for way in ways[1:])]

    def rises(self, node: int, limbs: Mapping[str, int]) -> float:
        """Return how far a node is from the left hip."""
        return float(np.linalg.norm(self.rest[node] - self.rest[limbs["left_hip"]]))

    def hip_distance(self, nodes: Mapping[str, int]) -> float:
        """Return how far the pelvis is from the middle of the hips, in lengths of the leg."""
        made = {joint: self.rest[node] for joint, node in nodes.items()}
        middle = 0.5 * (made["left_hip"] + made["right_hip"])
        return float(np.linalg.norm(made["pelvis"] - middle)) / _leg(made)

    def spine(self, nodes: Mapping[str, int], allowed: set[int] | None) -> dict[str, int]:
        """Return the nodes of the spine: of the chain between pelvis and neck those nearest to the usual places."""
        top = nodes.get("neck", nodes["head"])
        chain = self.chain(nodes, top)
        if allowed is not None:
            chain = [node for node in chain if node in allowed]
        if not chain:
            return {}
        made = {joint: self.rest[node] for joint, node in nodes.items()}
        foot = made.get("pelvis", 0.5 * (made["left_hip"] + made["right_hip"]))
        way = np.stack([foot, *self.rest[chain], *([made["neck"]] if "neck" in made else []), made["head"]])
        lengths = np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))
        shares = lengths[: len(chain)] / max(float(lengths[-1]), 1e-12)
        count = min(len(chain), len(_SPINE_JOINTS))
        best, choice = np.inf, None
        for slots in itertools.combinations(range(len(_SPINE_JOINTS)), count):
            for links in itertools.combinations(range(len(chain)), count):
                pairs = [(_SPINE_JOINTS[slot], link) for slot, link in zip(slots, links, strict=True)]
                cost = sum(abs(shares[link] - TRUNK_SHARES[joint]) for joint, link in pairs)
                if cost < best:
                    best, choice = cost, {joint: chain[link] for joint, link in pairs}
        return choice or {}

    def chain(self, nodes: Mapping[str, int], top: int) -> list[int]:
        """Return the nodes between the pelvis and the neck, the lowest first."""
        ends = set(nodes.values())
        above = list(_upwards(top, self.parents))[1:]
        foot = nodes.get("pelvis")
        hips = self.common([nodes["left_hip"], nodes["right_hip"]])
        if foot in above:
            between = above[: above.index(foot)]
        else:
            between = list(itertools.takewhile(lambda node: node not in hips, above))
        distinct: list[int] = []
        for node in reversed(between):
            if node not in ends and (not distinct or not np.allclose(self.rest[node], self.rest[distinct[-1]])):
                distinct.append(node)
        return distinct

    def aliases(self, nodes: Mapping[str, int]) -> dict[int, str]:
        """Return the toes beside the one that was taken, and the nodes of further copies of the skeleton."""
        further = {
            toe: f"{side}_foot"
            for side in SIDES
            for toe in self.toes.get(side, [])
            if f"{side}_foot" in nodes and toe != nodes[f"{side}_foot"]
        }
        own = {node: joint for joint, node in nodes.items()}
        by_name: dict[str, str] = {}
        strays: list[int] = []
        for node, name in enumerate(self.names):
            joint = next((own[above] for above in _upwards(node, self.parents) if above in own), None)
            if joint is None:
                strays.append(node)
            elif name:
                by_name.setdefault(name, joint)
        return further | {node: by_name[self.names[node]] for node in strays if self.names[node] in by_name}


def _upwards(node: int, parents: Sequence[int]) -> Iterator[int]:
    """Yield a node and those above it; at most as many as there are, should the parents form a cycle."""
    for _ in range(len(parents)):
        if node < 0:
            return
        yield int(node)
        node = parents[node]


def _up_and_left(made: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit directions from the ankles to the head and from right to left, at right angles.

    Raises:
        ValueError: the joints of a rig coincide.
    """
    up = made["head"] - 0.5 * (made["left_ankle"] + made["right_ankle"])
    left = sum(made[f"left_{joint}"] - made[f"right_{joint}"] for joint in ("hip", "shoulder"))
    height = float(np.linalg.norm(up))
    if height > 0.0:
        up = up / height
        left = left - (left @ up) * up
    width = float(np.linalg.norm(left))
    if not (np.isfinite(height) and width > 1e-3 * height > 0.0):
        raise ValueError(
            f"head, hips and ankles of the rig span {height:.3g} upwards and {width:.3g} sideways; give it rest "
            "positions, or exchange joints by mapping=FILE.json"
        )
    return up, left / width


def _leg(made: Mapping[str, np.ndarray]) -> float:
    """Return the length from hip over knee to ankle, the mean of both legs."""
    bones = [(f"{side}_{a}", f"{side}_{b}") for side in SIDES for a, b in (("hip", "knee"), ("knee", "ankle"))]
    return 0.5 * float(sum(np.linalg.norm(made[b] - made[a]) for a, b in bones)) or 1e-12


def _distance_to_segment(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return how far points are from a line segment, shape ``(N,)``."""
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)


def _by_hand(mapping: Mapping[str, str], names: list[str]) -> dict[str, int | None]:
    """Return the nodes of a mapping by hand, None for a joint that shall be made.

    Raises:
        ValueError: there is no such joint or node, or the joint cannot be made.
    """
    fixed: dict[str, int | None] = {}
    for joint, name in mapping.items():
        if joint not in JOINT_NAMES:
            raise ValueError(f"mapping has a joint {joint!r}; the joints are {', '.join(JOINT_NAMES)}")
        if not name and joint in REQUIRED:
            raise ValueError(f"mapping leaves {joint} out, which cannot be made from others; name its node")
        if name and name not in names:
            named = [n for n in names if n]
            near = difflib.get_close_matches(name, named, n=3, cutoff=0.4)
            hint = f"; near are {', '.join(near)}" if near else f"; the first are {', '.join(named[:9])}"
            raise ValueError(f"mapping takes {joint} from {name!r}, and there is no such node{hint}")
        fixed[joint] = names.index(name) if name else None
    return fixed


def _lacking(lacking: Sequence[str], nodes: Mapping[str, int], names: list[str]) -> str:
    """Return the message for a rig without some of the joints that it must have."""
    found = ", ".join(f"{joint}={names[nodes[joint]]}" for joint in JOINT_NAMES if joint in nodes) or "none"
    others = [name for node, name in enumerate(names) if name and node not in nodes.values()]
    shown = ", ".join(others[:40]) + (f" and {len(others) - 40} more" if len(others) > 40 else "")
    return f"no node for {', '.join(lacking)}; found {found}; other nodes are {shown or 'none'}; {_REMEDY}"
