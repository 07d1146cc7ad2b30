"""Files of SMPL, SMPL-H and SMPL-X models: their layouts and the surface that they describe.

A model is a template mesh, displacements by shape, expression and pose, a regressor of the joints, and skinning
weights (Loper et al., "SMPL: A skinned multi-person linear model", 2015; Romero et al., "Embodied Hands", 2017;
Pavlakos et al., "Expressive Body Capture", 2019). With the parameters ``beta`` (shape and expression) and the local
rotations ``R_j``, the vertices are

    v = skin(template + S beta + P vec(R_j - I), J (template + S beta), R),

where the joints come from the shaped surface before the pose displaces it. Axes of the files: metres, y up, facing +z,
the left is +x. A user owns such files; none is part of this package. What is pickled in one is read by
:mod:`piavatar_envs.core.array_pickle`, which runs nothing.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS
from piavatar_envs.core.array_pickle import array_of, plain, read_pickle
from piavatar_envs.core.reading import reading

#: Joints of a file -> its model.
MODELS: dict[int, str] = {24: "SMPL", 52: "SMPL-H", 55: "SMPL-X"}
#: First joint of each model's hands, which have 15 joints a side; SMPL has one a side.
FIRST_HAND_JOINT: dict[int, int] = {52: 22, 55: 25}
#: SMPL-X files with so many columns have the expression from :data:`LONG_EXPRESSION` on; shorter ones from 10 on.
LONG_COLUMNS, LONG_EXPRESSION, SHORT_EXPRESSION = 400, 300, 10
MAX_BYTES = 2**31
MAX_VERTICES = 1_000_000
_NEEDED = ("v_template", "f", "weights", "shapedirs", "posedirs", "J_regressor", "kintree_table")
_HANDS = ("hands_meanl", "hands_meanr")


@dataclass(frozen=True, eq=False)
class SmplModel:
    """A model of ``J`` joints (24, 52 or 55) and ``V`` vertices, in the axes of the file.

    Attributes:
        kind: SMPL, SMPL-H or SMPL-X.
        template: vertices in the zero pose [m], shape ``(V, 3)`` float64.
        faces: triangles, shape ``(T, 3)`` int32.
        weights: skinning weights, rows sum to one, shape ``(V, J)`` float64.
        parents: parent of each joint, -1 for the root, shape ``(J,)``.
        regressor: joints from vertices, shape ``(J, V)``.
        shape_dirs: displacement by a standard deviation of each shape coefficient [m], shape ``(V, 3, S)`` float32.
        expression_dirs: of each expression coefficient [m], shape ``(V, 3, E)`` float32.
        pose_dirs: displacement by each element of ``R_j - I`` of the joints but the root [m], shape
            ``(V, 3, 9 (J - 1))`` float32.
        hand_mean: rotation vectors of the joints of both hands in their mean pose [rad], shape ``(2, 15, 3)``; zero
            where the file has none.
    """

    kind: str
    template: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    parents: np.ndarray
    regressor: sparse.csr_matrix
    shape_dirs: np.ndarray
    expression_dirs: np.ndarray
    pose_dirs: np.ndarray
    hand_mean: np.ndarray

    def shaped(self, betas: np.ndarray, expression: np.ndarray) -> np.ndarray:
        """Return the vertices of a person in the zero pose [m], ``(V, 3)``, from at most all coefficients."""
        shape = np.einsum("vik,k->vi", self.shape_dirs[..., : len(betas)], betas)
        face = np.einsum("vik,k->vi", self.expression_dirs[..., : len(expression)], expression)
        return self.template + shape + face

    def joints(self, vertices: np.ndarray) -> np.ndarray:
        """Return the joints of a shaped surface, or their displacements for the surface's [m], shape ``(J, 3)``."""
        return self.regressor @ vertices

    def pose_displacement(self, rotations: np.ndarray) -> np.ndarray:
        """Return the displacement of the zero pose's vertices [m], ``(V, 3)``, by local rotations ``(J, 3, 3)``."""
        return self.pose_dirs @ (rotations[1:] - np.eye(3)).ravel()

    def posed(self, shaped: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Return the vertices of a shaped surface in a pose [m], shape ``(V, 3)``; the root joint stays in place.

        Args:
            shaped: from :meth:`shaped`, shape ``(V, 3)``.
            rotations: of every joint relative to its parent, shape ``(J, 3, 3)``.
        """
        return self.skinned(shaped + self.pose_displacement(rotations), self.joints(shaped), rotations)

    def skinned(self, vertices: np.ndarray, joints: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Return vertices ``(V, 3)`` moved by linear blend skinning, without pose displacements."""
        place, world = np.array(joints, dtype=np.float64), self._world(rotations)
        for joint in range(1, len(self.parents)):
            parent = self.parents[joint]
            place[joint] = place[parent] + world[parent] @ (joints[joint] - joints[parent])
        offset = place - np.einsum("jab,jb->ja", world, joints)
        return np.einsum("vab,vb->va", self.turns(rotations), vertices) + self.weights @ offset

    def turns(self, rotations: np.ndarray) -> np.ndarray:
        """Return the matrices by which skinning turns displacements of the vertices, shape ``(V, 3, 3)``."""
        return (self.weights @ self._world(rotations).reshape(-1, 9)).reshape(-1, 3, 3)

    def _world(self, rotations: np.ndarray) -> np.ndarray:
        world = np.array(rotations, dtype=np.float64)
        for joint in range(1, len(world)):
            world[joint] = world[self.parents[joint]] @ world[joint]
        return world

    def body_weights(self) -> np.ndarray:
        """Return the weights of the 22 joints of the body, ``(V, 22)``: hands, jaw and eyes move with their parents."""
        owner = np.arange(len(self.parents))
        for joint in range(NUM_JOINTS, len(owner)):
            owner[joint] = owner[self.parents[joint]]
        return self.weights @ np.eye(len(owner))[owner][:, :NUM_JOINTS]

    def rest_rotations(self, flat_hand: bool) -> np.ndarray:
        """Return the local rotations of the rest pose, ``(J, 3, 3)``: all zero, or with the hands in their mean."""
        vectors = np.zeros((len(self.parents), 3))
        first = FIRST_HAND_JOINT.get(len(vectors))
        if first is not None and not flat_hand:
            vectors[first : first + 30] = self.hand_mean.reshape(30, 3)
        return Rotation.from_rotvec(vectors).as_matrix()


def read_smpl(path: str | Path) -> SmplModel:
    """Read a model from a ``.npz`` or ``.pkl`` file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no such model, is damaged, or pickles something else than arrays.
    """
    path = Path(path)
    if path.suffix.lower() not in (".npz", ".pkl"):
        raise ValueError(f"{path} has the suffix {path.suffix!r}; SMPL models are .npz or .pkl files")
    with reading(path, "an SMPL, SMPL-H or SMPL-X model"):
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes; at most {MAX_BYTES} are read")
        values = _npz_values(path) if path.suffix.lower() == ".npz" else _pkl_values(path)
        missing = [key for key in _NEEDED if key not in values]
        if missing:
            raise ValueError(f"it lacks {', '.join(missing)}")
        return _model(values)


def _pkl_values(path: Path) -> dict[str, Any]:
    content = read_pickle(path.read_bytes())
    if not isinstance(content, dict):
        raise ValueError(f"it pickles a {type(content).__name__}; a model is a dictionary of arrays")
    named = {key.decode("latin-1") if isinstance(key, bytes) else key: value for key, value in content.items()}
    return {key: plain(named[key]) for key in (*_NEEDED, *_HANDS) if key in named}


def _npz_values(path: Path) -> dict[str, Any]:
    values = {}
    with zipfile.ZipFile(path) as archive:
        present = {info.filename: info for info in archive.infolist()}
        wanted = {key: present[f"{key}.npy"] for key in (*_NEEDED, *_HANDS) if f"{key}.npy" in present}
        size = sum(info.file_size for info in wanted.values())
        if size > MAX_BYTES:
            raise ValueError(f"its arrays have {size} bytes; at most {MAX_BYTES} are read")
        for key, info in wanted.items():
            values[key] = _npy_value(archive.read(info))
    return values


def _npy_value(data: bytes) -> Any:
    """Return an array in NumPy's format; one of objects is a pickle of arrays."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(stream)
    rest = data[stream.tell() :]
    return plain(read_pickle(rest)) if dtype.kind == "O" else array_of(rest, dtype, shape, fortran)


def _model(values: dict[str, Any]) -> SmplModel:
    """Return the model of a file's arrays; check that they belong together."""
    template = _numbers(values, "v_template", ("V", 3), {})
    sizes = {"V": len(template)}
    if not 0 < len(template) <= MAX_VERTICES:
        raise ValueError(f"it has {len(template)} vertices; 1 to {MAX_VERTICES} are read")
    tree = _numbers(values, "kintree_table", (2, "J"), sizes).astype(np.int64)
    if sizes["J"] not in MODELS:
        raise ValueError(f"it has {sizes['J']} joints; SMPL has 24, SMPL-H 52, SMPL-X 55")
    parents = tree[0].copy()
    parents[0] = -1  # in the files the largest unsigned integer
    if (
        tuple(parents[:NUM_JOINTS]) != PARENTS
        or not (parents[1:] < np.arange(1, sizes["J"])).all()
        or parents[1:].min() < 0
    ):
        raise ValueError(f"its kintree_table has the parents {parents.tolist()}; the first 22 are SMPL's")
    faces = _numbers(values, "f", ("T", 3), sizes).astype(np.int64)
    if faces.size == 0 or faces.min() < 0 or faces.max() >= sizes["V"]:
        raise ValueError(f"f refers to vertices outside 0 to {sizes['V'] - 1}")
    weights = _numbers(values, "weights", ("V", "J"), sizes)
    if weights.min() < -1e-6 or np.abs(weights.sum(axis=1) - 1.0).max() > 1e-3:
        raise ValueError("weights has rows that are negative or do not sum to one")
    weights = np.maximum(weights, 0.0)
    directions = _numbers(values, "shapedirs", ("V", 3, "S"), sizes, np.float32)
    shape, expression = _split(directions, sizes["J"])
    sizes["P"] = 9 * (sizes["J"] - 1)
    means = [_numbers(values, key, (45,), {}) if key in values else np.zeros(45) for key in _HANDS]
    return SmplModel(
        kind=MODELS[sizes["J"]],
        template=template,
        faces=faces.astype(np.int32),
        weights=weights / weights.sum(axis=1, keepdims=True),
        parents=parents,
        regressor=_regressor(values["J_regressor"], (sizes["J"], sizes["V"])),
        shape_dirs=shape,
        expression_dirs=expression,
        pose_dirs=_numbers(values, "posedirs", ("V", 3, "P"), sizes, np.float32),
        hand_mean=np.stack(means).reshape(2, 15, 3),
    )


def _split(directions: np.ndarray, joints: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns of shape and of expression; only SMPL-X has any of the latter."""
    columns = directions.shape[2]
    first = columns
    if MODELS[joints] == "SMPL-X":
        first = LONG_EXPRESSION if columns >= LONG_COLUMNS else min(SHORT_EXPRESSION, columns)
    return directions[..., :first], directions[..., first:]


def _numbers(
    values: dict[str, Any], key: str, shape: tuple[int | str, ...], sizes: dict[str, int], dtype: type = np.float64
) -> np.ndarray:
    """Return a member as an array of finite numbers; named sizes are set where new and else compared."""
    value = values[key]
    array = np.asarray(value)
    if array.dtype.kind not in "biuf" or array.ndim != len(shape):
        raise ValueError(
            f"{key} has {array.ndim} dimensions of type {array.dtype}; it should have {len(shape)} of numbers"
        )
    for found, size in zip(array.shape, shape, strict=True):
        if found != (sizes.setdefault(size, found) if isinstance(size, str) else size):
            raise ValueError(f"{key} has the shape {array.shape}; it should be {shape} with {sizes}")
    array = array.astype(dtype)
    if not np.isfinite(array).all():
        raise ValueError(f"{key} has values that are not finite")
    return array


def _regressor(value: Any, shape: tuple[int, int]) -> sparse.csr_matrix:
    """Return the matrix ``(J, V)`` of joints from vertices, which files store dense, sparse or pickled."""
    if not sparse.issparse(value):
        value = _numbers({"J_regressor": value}, "J_regressor", shape, {})
    matrix = sparse.csr_matrix(value, dtype=np.float64)
    if matrix.shape != shape:
        raise ValueError(f"J_regressor has the shape {matrix.shape}; it should be {shape}")
    if not np.isfinite(matrix.data).all():
        raise ValueError("J_regressor has values that are not finite")
    return matrix
