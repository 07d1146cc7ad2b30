"""Bodies of SMPL, SMPL-H and SMPL-X model files, which users own; see :mod:`piavatar_envs.avatar.body.smpl_file`.

The model is posed by its own equations, pose displacements included, as the embedded body rests, and closed there. Its
hands keep one pose, its jaw and eyes follow the head. Shape and expression coefficients are shape parameters, of which
the ends are :data:`SIGMAS` standard deviations from the given person, so that a sampled one has the model's deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from piavatar_envs.avatar.body.asset import SAMPLE_DEVIATION, AvatarAsset, PoseDisplacements
from piavatar_envs.avatar.body.character import Character, Surface, body_of, reference_rotations
from piavatar_envs.avatar.body.groups import read_groups
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, forward_kinematics
from piavatar_envs.avatar.body.skeleton_mesh import moved, read_skeleton
from piavatar_envs.avatar.body.smpl_file import SmplModel, read_smpl

SUFFIXES = (".npz", ".pkl")
#: Standard deviations of a coefficient at the ends of its shape parameter.
SIGMAS = 1.0 / SAMPLE_DEVIATION
#: Shape parameters of each kind where the settings do not say how many.
USUAL_PARAMETERS = 10
#: Our axes (z up, facing -y) from the file's (y up, facing +z).
TO_OURS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def build(
    path: str,
    betas: Sequence[float] = (),
    expression: Sequence[float] = (),
    num_betas: int | None = None,
    num_expressions: int | None = None,
    flat_hand: bool = False,
    skeleton: str | None = None,
    groups: str | None = None,
) -> AvatarAsset:
    """Return the body of a model file.

    Args:
        path: the file, ``.npz`` or ``.pkl``.
        betas: shape coefficients of the person in standard deviations; those left out are zero.
        expression: likewise of the face, for SMPL-X.
        num_betas: shape parameters ``beta_0`` and so on; by default 10, or as many as the file has.
        num_expressions: shape parameters ``expression_0`` and so on, likewise.
        flat_hand: hold the hands flat, as the template has them, and not in the file's mean pose.
        skeleton: mesh of a skeleton, or a folder of its parts, in the file's axes and zero pose; for bone particles.
        groups: JSON file of an object from names to lists of vertices, as segmentations of these models are.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no such model, or has fewer coefficients than the settings name.
    """
    model, shaped, counts = _person(path, betas, expression, num_betas, num_expressions)
    rotations, reference = _reference(model, shaped, flat_hand)
    character = _character(path, model, shaped, counts, rotations, reference)
    if groups is not None:
        character = replace(character, groups=read_groups(groups, len(character.vertices)))
    bones = None
    if skeleton is not None:
        rest = model.joints(shaped)[:NUM_JOINTS] @ TO_OURS.T
        bones = moved(read_skeleton(skeleton, rest, TO_OURS), rest, reference, character.joints)
    return replace(body_of(character), skeleton=bones)


def read_character(
    path: str,
    betas: Sequence[float] = (),
    expression: Sequence[float] = (),
    num_betas: int | None = None,
    num_expressions: int | None = None,
    flat_hand: bool = False,
) -> Character:
    """Return the person of a model file in the reference pose; arguments and errors as for :func:`build`."""
    model, shaped, counts = _person(path, betas, expression, num_betas, num_expressions)
    return _character(path, model, shaped, counts, *_reference(model, shaped, flat_hand))


def _person(
    path: str, betas: Sequence[float], expression: Sequence[float], num_betas: int | None, num_expressions: int | None
) -> tuple[SmplModel, np.ndarray, tuple[int, int]]:
    """Return the model, the person's vertices in the zero pose, and the numbers of shape parameters of either kind."""
    model = read_smpl(path)
    columns, faces = model.shape_dirs.shape[2], model.expression_dirs.shape[2]
    shape, face = _coefficients("betas", betas, columns), _coefficients("expression", expression, faces)
    counts = _count("num_betas", num_betas, columns), _count("num_expressions", num_expressions, faces)
    return model, model.shaped(shape, face), counts


def _character(
    path: str,
    model: SmplModel,
    shaped: np.ndarray,
    counts: tuple[int, int],
    rotations: np.ndarray,
    reference: np.ndarray,
) -> Character:
    """Return the character of a person, from :func:`_person`, in the pose of :func:`_reference`."""
    names = *(f"beta_{index}" for index in range(counts[0])), *(f"expression_{index}" for index in range(counts[1]))
    displaced = shaped + model.pose_displacement(rotations)
    vertices, joints = _turned(model, displaced, model.joints(shaped), rotations)
    deltas, joint_deltas = np.zeros((len(names), 2, *vertices.shape)), np.zeros((len(names), 2, NUM_JOINTS, 3))
    directions = np.concatenate([model.shape_dirs[..., : counts[0]], model.expression_dirs[..., : counts[1]]], axis=2)
    for index in range(len(names)):
        step = SIGMAS * directions[..., index].astype(np.float64)
        own = _turned(model, step, model.joints(step), rotations)  # which is linear
        deltas[index], joint_deltas[index] = (np.stack([-each, each]) for each in own)
    columns = [f"{dirs.shape[2]} {kind}" for kind, dirs in
               (("shape", model.shape_dirs), ("expression", model.expression_dirs)) if dirs.shape[2]]  # fmt: skip
    return Character(
        name=f"{model.kind} ({Path(path).name})",
        vertices=vertices,
        faces=model.faces,
        weights=model.body_weights(),
        joints=joints,
        colors=None,
        surfaces=(Surface("skin", 0, len(model.faces)),),
        shape_names=names,
        shape_deltas=deltas,
        shape_joints=joint_deltas,
        notes=(f"{model.kind} of {len(model.parents)} joints with {' and '.join(columns)} coefficients",),
        pose=_pose_displacements(model, rotations, reference),
    )


def _coefficients(name: str, values: Sequence[float], most: int) -> np.ndarray:
    coefficients = np.asarray(values, dtype=np.float64).reshape(-1)
    if len(coefficients) > most:
        raise ValueError(f"{name} has {len(coefficients)} coefficients, the file {most}; leave the last ones out")
    if not (np.abs(coefficients) <= 10.0).all():
        raise ValueError(f"{name} has a value that is not within 10 standard deviations: {coefficients.tolist()}")
    return coefficients


def _count(name: str, value: int | None, most: int) -> int:
    if value is None:
        return min(USUAL_PARAMETERS, most)
    if isinstance(value, bool) or int(value) != value or not 0 <= value <= most:
        raise ValueError(f"{name}={value} is outside 0 to {most}, the coefficients of the file")
    return int(value)


def _reference(model: SmplModel, shaped: np.ndarray, flat_hand: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the reference pose of a person: local rotations of all joints in the file's axes, and ours of the bones.

    The latter are world rotations from the file's zero pose in our axes, shape ``(22, 3, 3)``.
    """
    world = reference_rotations(model.joints(shaped)[:NUM_JOINTS] @ TO_OURS.T)
    rotations = model.rest_rotations(flat_hand)
    for joint in range(NUM_JOINTS):
        parent = np.eye(3) if joint == 0 else world[PARENTS[joint]]
        rotations[joint] = TO_OURS.T @ parent.T @ world[joint] @ TO_OURS
    return rotations, world


def _turned(
    model: SmplModel, vertices: np.ndarray, joints: np.ndarray, rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and the 22 body joints after linear blend skinning, in our axes."""
    _, places = forward_kinematics(rotations[:NUM_JOINTS], joints[0], joints[:NUM_JOINTS])
    return model.skinned(vertices, joints, rotations) @ TO_OURS.T, places @ TO_OURS.T


def _pose_displacements(model: SmplModel, rotations: np.ndarray, reference: np.ndarray) -> PoseDisplacements:
    """Return the model's displacements by the body joints, turned from the zero to the reference pose and our axes."""
    count, body = len(model.template), NUM_JOINTS - 1
    directions = model.pose_dirs[..., : 9 * body].reshape(-1, 9) @ np.kron(TO_OURS, TO_OURS).T.astype(np.float32)
    turn = TO_OURS @ model.turns(rotations)
    directions = np.matmul(turn.astype(np.float32), directions.reshape(count, 3, 9 * body))
    return PoseDisplacements(directions.reshape(count, 3, body, 9), reference)
