"""Files of other skeletons, written from clips of ours: other names, units, axes, zero poses and orders of rotation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, forward_kinematics
from piavatar_envs.avatar.motion import Motion
from piavatar_envs.avatar.motion.retarget import align_limbs
from scripts.gltf_files import Writer

SIDES = ("left", "right")
ARMS_OUT = {
    f"{side}_{joint}": [x, 0.0, 0.0] for side, x in zip(SIDES, (1, -1), strict=True) for joint in ("shoulder", "elbow")
}
LEGS_DOWN = {f"{side}_{joint}": [0.0, 0.0, -1.0] for side in SIDES for joint in ("hip", "knee")}
FEET = dict.fromkeys(("left_ankle", "right_ankle"))
T_POSE = {**ARMS_OUT, **LEGS_DOWN, **FEET}
#: Rotations from our axes (left +x, back +y, up +z) to those of a file.
Y_UP = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # facing +z
Y_UP_BACK = Rotation.from_euler("y", 180, degrees=True) * Y_UP  # facing -z
Z_UP = Rotation.identity()
X_UP = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])


def mixamo(joint: str) -> str:
    side, _, part = joint.rpartition("_")
    own = {"pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head"}
    limb = {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder"}
    limb |= {"shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand"}
    return "mixamorig:" + (own[joint] if joint in own else side.capitalize() + limb[part])


def unreal(joint: str) -> str:
    side, _, part = joint.rpartition("_")
    own = {"spine1": "spine_01", "spine2": "spine_02", "spine3": "spine_03", "neck": "neck_01"}
    limb = {"hip": "thigh", "knee": "calf", "ankle": "foot", "foot": "ball", "collar": "clavicle"}
    limb |= {"shoulder": "upperarm", "elbow": "lowerarm", "wrist": "hand"}
    return f"{limb[part]}_{side[0]}" if side else own.get(joint, joint)


@dataclass
class Skeleton:
    """A skeleton of a file.

    Attributes:
        name: of a node, by joint.
        unit: metres in a unit of length.
        axes: from our axes to those of the zero pose.
        world: from our world to that of the file; as ``axes`` without it.
        zero: directions of limbs in the zero pose.
        frames: rotation of every node's axes in the zero pose, 22 of them; BVH has none but these.
    """

    name: object = mixamo
    unit: float = 0.01
    axes: Rotation = Y_UP
    world: Rotation | None = None
    zero: dict | None = None
    frames: Rotation | None = None

    def pose(self, motion: Motion, rest: np.ndarray) -> tuple[np.ndarray, list[Rotation], list[Rotation]]:
        """Return offsets in the parents' axes, ``(22, 3)``, local rotations by joint, and those of the zero pose."""
        aligned = align_limbs(rest, T_POSE if self.zero is None else self.zero)
        world = self.axes if self.world is None else self.world
        turns, _ = motion.joint_frames(rest)
        own = Rotation.identity(NUM_JOINTS) if self.frames is None else self.frames
        source = [
            world * Rotation.from_matrix(turns[:, j]) * aligned[j].inv() * self.axes.inv() * own[j]
            for j in range(NUM_JOINTS)
        ]
        local = [source[0]] + [source[PARENTS[j]].inv() * source[j] for j in range(1, NUM_JOINTS)]
        still = [own[0]] + [own[PARENTS[j]].inv() * own[j] for j in range(1, NUM_JOINTS)]
        hanging = [aligned[0]] + [aligned[PARENTS[j]].inv() * aligned[j] for j in range(1, NUM_JOINTS)]
        zero = forward_kinematics(np.stack([turn.as_matrix() for turn in hanging]), np.zeros(3), rest)[1]
        offsets = np.zeros((NUM_JOINTS, 3))
        for j in range(1, NUM_JOINTS):
            offsets[j] = own[PARENTS[j]].inv().apply(self.axes.apply(zero[j] - zero[PARENTS[j]])) / self.unit
        return offsets, local, still

    def root(self, motion: Motion) -> np.ndarray:
        """Return the path of the root node, ``(num_frames, 3)``."""
        return (self.axes if self.world is None else self.world).apply(motion.root_position.copy()) / self.unit


def write_bvh(
    path: Path,
    motion: Motion,
    rest: np.ndarray,
    skeleton: Skeleton,
    order: str = "ZXY",
    newline: str = "\n",
    rest_first: bool = False,
    announced: int | None = None,
) -> Path:
    """Write a BVH file; ``rest_first`` puts the zero pose before the frames."""
    offsets, local, _ = skeleton.pose(motion, rest)
    lines: list[str] = ["HIERARCHY"]

    def write(j: int, depth: int) -> None:
        tab = "\t" * depth
        name = skeleton.name(JOINT_NAMES[j])
        places = "Xposition Yposition Zposition " if j == 0 else ""
        channels = places + " ".join(f"{axis}rotation" for axis in order)
        lines.extend([f"{tab}{'JOINT' if j else 'ROOT'} {name}", tab + "{"])
        lines.append(f"{tab}\tOFFSET\t" + " ".join(f"{value:.9f}" for value in offsets[j]))
        lines.append(f"{tab}\tCHANNELS {6 if j == 0 else 3} {channels}")
        children = [child for child in range(NUM_JOINTS) if PARENTS[child] == j]
        for child in children:
            write(child, depth + 1)
        if not children:
            lines.extend([f"{tab}\tEnd Site", tab + "\t{", f"{tab}\t\tOFFSET 0 1 0", tab + "\t}"])
        lines.append(tab + "}")

    written: list[int] = []

    def depth_first(j: int) -> None:
        written.append(j)
        for child in range(NUM_JOINTS):
            if PARENTS[child] == j:
                depth_first(child)

    write(0, 0)
    depth_first(0)
    columns = [skeleton.root(motion), *(local[j].as_euler(order, degrees=True) for j in written)]
    rows = np.concatenate(columns, axis=1)
    if rest_first:
        rows = np.concatenate([np.zeros((1, rows.shape[1])), rows])
    lines += [
        "MOTION",
        f"Frames:\t{len(rows) if announced is None else announced}",
        f"Frame Time: {1 / motion.fps:.7f}",
    ]
    lines += [" ".join(f"{value:.9f}" for value in row) for row in rows]
    path.write_bytes(newline.join([*lines, ""]).encode())
    return path


def write_glb(
    path: Path,
    clips: dict[str, Motion],
    rest: np.ndarray,
    skeleton: Skeleton,
    mode: str = "LINEAR",
    shown: int | None = None,
    armature: Rotation | None = None,
) -> Path:
    """Write a GLB file with an animation for each clip, and a skin; the file shows frame ``shown``, or the zero pose.

    The nodes hang on an armature that is turned and scales them by ten.
    """
    out = Writer()
    turn = Rotation.identity() if armature is None else armature
    named = {name: skeleton.pose(motion, rest) for name, motion in clips.items()}
    offsets, first_local, still = next(iter(named.values()))
    first = next(iter(clips.values()))
    offsets, hips = offsets / 10.0, skeleton.axes.apply(rest[0]) / skeleton.unit / 10.0
    if shown is not None:
        hips = skeleton.root(first)[shown] / 10.0
    hips = turn.inv().apply(hips)
    out.add("nodes", {"name": "Armature", "rotation": turn.as_quat().tolist(), "scale": [10.0] * 3, "children": [1]})
    for j in range(NUM_JOINTS):
        pose = still[j] if shown is None else first_local[j][shown]
        pose = turn.inv() * pose if j == 0 else pose
        node = {"name": skeleton.name(JOINT_NAMES[j]), "rotation": pose.as_quat().tolist()}
        node["translation"] = (hips if j == 0 else offsets[j]).tolist()
        node["children"] = [1 + child for child in range(NUM_JOINTS) if PARENTS[child] == j]
        out.add("nodes", {key: value for key, value in node.items() if value != []})
    world, places = [still[0]], [skeleton.axes.apply(rest[0]) / skeleton.unit]
    for j in range(1, NUM_JOINTS):
        places.append(places[PARENTS[j]] + world[PARENTS[j]].apply(10.0 * offsets[j]))
        world.append(world[PARENTS[j]] * still[j])
    binds = np.tile(np.eye(4), (NUM_JOINTS, 1, 1))
    binds[:, :3, :3] = [10.0 * turn.as_matrix() for turn in world]
    binds[:, :3, 3] = places
    inverse = np.linalg.inv(binds).transpose(0, 2, 1).reshape(-1, 16).astype(np.float32)
    joints = [1 + j for j in range(NUM_JOINTS)]
    out.add("skins", {"joints": joints, "inverseBindMatrices": out.accessor(inverse, "MAT4")})
    for name, motion in clips.items():
        _, local, _ = named[name]
        animation: dict = {"name": name, "channels": [], "samplers": []}
        times = (np.arange(motion.num_frames) / motion.fps + 0.5).astype(np.float32)
        clock = out.accessor(times[:, None], "SCALAR", min=[float(times[0])], max=[float(times[-1])])
        local = [turn.inv() * local[0], *local[1:]]
        tracks = [("rotation", 1 + j, local[j].as_quat(), "VEC4") for j in range(NUM_JOINTS)]
        tracks.append(("translation", 1, turn.inv().apply(skeleton.root(motion)) / 10.0, "VEC3"))
        for target, node, values, kind in tracks:
            values = np.array(values, np.float32)
            if mode == "CUBICSPLINE":
                values = np.stack([0 * values, values, 0 * values], axis=1).reshape(-1, values.shape[1])
            sampler = {"input": clock, "output": out.accessor(values, kind), "interpolation": mode}
            animation["samplers"].append(sampler)
            channel = {"sampler": len(animation["samplers"]) - 1, "target": {"node": node, "path": target}}
            animation["channels"].append(channel)
        out.add("animations", animation)
    return out.save(path)
