"""Animations of glTF, GLB, VRM and VRMA files as recordings: tracks at an even rate, nodes posed in the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.rigs import map_joints
from piavatar_envs.avatar.gltf import Animation, Gltf, read_gltf, whole
from piavatar_envs.avatar.gltf_surfaces import bind_pose
from piavatar_envs.avatar.motion.recording import Recording, whole_rate
from piavatar_envs.core.reading import reading

RATES = 20.0, 240.0  # [1/s] of keys that are frames of a capture; others are sampled at USUAL_RATE
USUAL_RATE = 30.0
MAX_SECONDS = 3600.0
MAX_POSES = 2 * 10**7  # frames times nodes of the file
_TO_WORLD = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # y up, facing +z
_CHUNK = 64  # frames posed at once, bounds the memory of files with many nodes


def names_of_animations(path: str | Path) -> tuple[str, ...]:
    """Return the names by which :func:`read_animation` finds the animations of a file: their own, or their places.

    Raises:
        ValueError: it is not a glTF file.
        FileNotFoundError: there is no such file.
    """
    names = [animation.name for animation in read_gltf(path).animations]
    return tuple(name if name and names.count(name) == 1 else str(place) for place, name in enumerate(names))


def read_animation(path: str | Path, name: str | None = None, mapping: Mapping[str, str] | None = None) -> Recording:
    """Read an animation of a file.

    Args:
        path: of the file.
        name: of the animation, or its place; may be left out where there is one.
        mapping: names of nodes by joint, where the names say too little.

    Raises:
        ValueError: there is no such animation, or it moves no joint.
        FileNotFoundError: there is no such file.
    """
    gltf = read_gltf(path)
    names = names_of_animations(path)
    if name is None and len(names) > 1:
        raise ValueError(
            f"{path} has the animations {', '.join(names)}; name one of them: {Path(path).name}#{names[0]}"
        )
    if not names or (name is not None and name not in names):
        has = f"; it has {', '.join(names)}" if names else "; export it with one"
        raise ValueError(f"{path} has no animation{'' if name is None else f' {name!r}'}{has}")
    animation = gltf.animations[0 if name is None else names.index(name)]
    with reading(path, "a glTF motion"):
        rest, lead = _rest(gltf)
        joint_map = map_joints(_joint_names(gltf), gltf.parents, rest[:, :3, 3], _humanoid(gltf), mapping)
        kept = _with_ancestors(gltf, joint_map.nodes.values())
        moved = {track.node for track in animation.tracks}
        if not moved & set(kept):
            raise ValueError(f"animation {animation.name!r} moves none of its joints")
        rate, times = _frame_times(animation)
        if len(times) * len(gltf.parents) > MAX_POSES:
            raise ValueError(f"it has {len(times)} frames of {len(gltf.parents)} nodes; cut it into shorter animations")
        places = {node: place for place, node in enumerate(kept)}
        turns, positions = _posed(gltf, animation, times, kept, rest[kept])
        turns = [turn * lead for turn in turns]
        return Recording(
            name=Path(path).stem if name is None else f"{Path(path).stem}#{name}",
            fps=rate,
            names=tuple(gltf.names[node] for node in kept),
            parents=np.array([places.get(int(gltf.parents[node]), -1) for node in kept]),
            zero=lead.inv().apply(rest[kept, :3, 3]),
            turns=turns,
            positions=positions,
            source=f"glTF {path}",
            joint_map=replace(joint_map, nodes={j: places[node] for j, node in joint_map.nodes.items()}, aliases={}),
            world=_TO_WORLD,
        )


def _joint_names(gltf: Gltf) -> list[str]:
    """Return the names of the nodes, empty for meshes that hang on a skeleton."""
    joints = {int(joint) for skin in gltf.skins for joint in skin.joints}
    meshes = [bool(joints) and "mesh" in node for node in gltf.items("nodes")]
    return ["" if mesh and node not in joints else gltf.names[node] for node, mesh in enumerate(meshes)]


def _humanoid(gltf: Gltf) -> dict[str, int] | None:
    """Return the nodes of VRM's bones, of a character or of an animation without one (VRMA)."""
    animated = (gltf.json.get("extensions") or {}).get("VRMC_vrm_animation")
    if animated is None:
        return gltf.humanoid
    bones = animated["humanoid"]["humanBones"].items()
    return {bone: whole(entry["node"], f"node of the bone {bone}", len(gltf.names) - 1) for bone, entry in bones}


def _rest(gltf: Gltf) -> tuple[np.ndarray, Rotation]:
    """Return transforms of the nodes to the scene at rest, and the rotation to it from axes in which they are upright.

    The bind pose hangs on the root as the file shows it, which may lean or lie. Its meshes were modelled upright.
    """
    bound = bind_pose(gltf)
    if bound is None or not gltf.skins:
        return gltf.world, Rotation.identity()
    world, leads = bound
    lead = leads[int(np.argmax([len(skin.joints) for skin in gltf.skins]))][:3, :3]
    mirrors = np.linalg.det(lead) <= 0.0
    return world, Rotation.identity() if mirrors else Rotation.from_matrix(_directions(lead))


def _with_ancestors(gltf: Gltf, nodes: object) -> list[int]:
    """Return nodes and all that they hang on, parents before children."""
    needed = np.zeros(len(gltf.parents), bool)
    needed[list(nodes)] = True
    for node in gltf.order[::-1]:
        if needed[node] and gltf.parents[node] >= 0:
            needed[gltf.parents[node]] = True
    return [int(node) for node in gltf.order if needed[node]]


def _frame_times(animation: Animation) -> tuple[float, np.ndarray]:
    """Return the rate [1/s] and the times of the frames [s]."""
    seconds = animation.end - animation.start
    if not 0.0 < seconds <= MAX_SECONDS:
        raise ValueError(f"animation {animation.name!r} lasts {seconds:g} s, it must be > 0 and <= {MAX_SECONDS:g}")
    rate = animation.rate if RATES[0] <= animation.rate <= RATES[1] else USUAL_RATE
    count = max(1, round(seconds * rate))
    # the last key is a frame, so that a loop closes where its file closes it
    return whole_rate(count / seconds), animation.start + np.arange(count + 1) * (seconds / count)


def _posed(
    gltf: Gltf, animation: Animation, times: np.ndarray, kept: list[int], rest: np.ndarray
) -> tuple[list[Rotation], np.ndarray]:
    """Return world rotations of nodes since the rest pose, and positions ``(num_frames, nodes, 3)``."""
    frames = np.concatenate(
        [gltf.world_at(animation, times[first : first + _CHUNK])[:, kept, :3] for first in range(0, len(times), _CHUNK)]
    )
    axes, still = (_directions(part[..., :3]) for part in (frames, rest[:, :3]))
    turns = axes @ still.transpose(0, 2, 1)
    return [Rotation.from_matrix(turns[:, node]) for node in range(len(kept))], frames[..., 3].copy()


def _directions(matrices: np.ndarray) -> np.ndarray:
    """Return matrices without the scales of their columns."""
    return matrices / np.maximum(np.linalg.norm(matrices, axis=-2, keepdims=True), 1e-12)
