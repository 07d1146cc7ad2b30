"""Write the skeleton of MyoFullBody as meshes that fit the embedded body, for the study of bone particles.

The package ``musclemimic-models`` (Apache-2.0) has the meshes; MuJoCo poses them. Each bone is turned, scaled and put
so that its joint and the next one are the embedded body's::

    pip install musclemimic-models mujoco trimesh
    python -m benchmarks.paper.myo_skeleton skeleton
    python -m benchmarks.paper.tracking --no-tables --no-disturbances --no-pictures --skeleton skeleton
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tyro

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.skeleton_mesh import bone_of_name
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion.retarget import shortest_rotation

#: Our bone -> bodies of the model at its joint and at its end, and the joint at its end; ``@`` stands for the side.
FRAMES: dict[str, tuple[str, str, str]] = {
    "pelvis": ("pelvis", "lumbar5", "spine1"),
    "spine1": ("lumbar5", "lumbar2", "spine2"),
    "spine2": ("lumbar2", "lumbar1", "spine3"),
    "spine3": ("torso", "neck", "neck"),
    "neck": ("neck", "head", "head"),
    "@_hip": ("femur_@", "tibia_@", "@_knee"),
    "@_knee": ("tibia_@", "talus_@", "@_ankle"),
    "@_ankle": ("talus_@", "toes_@", "@_foot"),
    "@_collar": ("clavicle_@", "humerus_@", "@_shoulder"),
    "@_shoulder": ("humerus_@", "ulna_@", "@_elbow"),
    "@_elbow": ("ulna_@", "lunate_@", "@_wrist"),
}
#: Bones without an end: the body at their joint, and the bone whose turn they share.
ENDS = {"head": ("head", "neck"), "@_wrist": ("lunate_@", "@_elbow"), "@_foot": ("toes_@", "@_ankle")}
SHORTEST = 0.03  # [m] shorter bones keep their direction


def main(folder: tyro.conf.Positional[Path]) -> None:
    """Write a mesh for every body of the model.

    Args:
        folder: created if it does not exist.
    """
    import mujoco
    import musclemimic_models
    import trimesh

    model, data = musclemimic_models.load("myofullbody")
    mujoco.mj_forward(model, data)
    parts = _parts(model, data, mujoco)
    joints = load_asset().joints.astype(np.float64)
    maps = _maps({name: data.body(name).xpos.copy() for name in parts}, joints)
    folder.mkdir(parents=True, exist_ok=True)
    for name, (vertices, faces) in parts.items():
        side = {"l": "left", "r": "right"}.get(name[-1] if name[-2] == "_" else "", "")
        known = bone_of_name(name, np.array([[-1.0 if side == "right" else 1.0, 0.0, 0.0]]))
        start, matrix, place = maps[known or f"{side}_wrist"]
        placed = trimesh.Trimesh((vertices - start) @ matrix.T + place, faces, process=False)
        placed.export(folder / f"{name}.ply")
    print(f"{folder}: {len(parts)} parts")


def _parts(model, data, mujoco) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return vertices in the world and triangles of every body that has meshes."""
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH):
        mesh = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
        faces = model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
        placed = vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        found.setdefault(model.body(model.geom_bodyid[geom]).name, []).append((placed, faces))
    parts = {}
    for name, pieces in found.items():
        first = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
        faces = np.concatenate([piece[1] + offset for piece, offset in zip(pieces, first, strict=False)])
        parts[name] = np.concatenate([vertices for vertices, _ in pieces]), faces
    return parts


def _maps(places: dict[str, np.ndarray], joints: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return for each bone the model's joint, the matrix from there to ours, and our joint."""
    up, left = places["head"] - places["pelvis"], places["femur_l"] - places["femur_r"]
    tall = (joints[joint_index("head")] - joints[0])[2] / np.linalg.norm(up)
    up /= np.linalg.norm(up)
    left -= (left @ up) * up
    left /= np.linalg.norm(left)
    axes = np.stack([left, np.cross(up, left), up])
    maps = {}
    for sign, side in (("l", "left"), ("r", "right")):
        for bone, frame in FRAMES.items():
            start, end = (places[body.replace("@", sign)] for body in frame[:2])
            bone, far = bone.replace("@", side), frame[2].replace("@", side)
            own, wanted = axes @ (end - start), joints[joint_index(far)] - joints[joint_index(bone)]
            matrix, length = tall * axes, np.linalg.norm(own)
            if length > SHORTEST:
                matrix = np.linalg.norm(wanted) / length * shortest_rotation(own, wanted).as_matrix() @ axes
            maps[bone] = start, matrix, joints[joint_index(bone)]
        for bone, (body, like) in ENDS.items():
            turn = maps[like.replace("@", side)][1]
            turn = turn / np.cbrt(np.linalg.det(turn)) * tall
            bone = bone.replace("@", side)
            maps[bone] = places[body.replace("@", sign)], turn, joints[joint_index(bone)]
    return maps


if __name__ == "__main__":
    tyro.cli(main)
