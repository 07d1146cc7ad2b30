"""Files with the layouts of real SMPL models, of random numbers, and the packages that their pickles mention."""

from __future__ import annotations

import io
import pickle
import sys
import types
import zipfile
from pathlib import Path

import numpy as np
from scipy import sparse

from piavatar_envs.avatar.body.skeleton import PARENTS

BODY_MODELS_REASON = "needs body-models: make test-avatars"


def random_members(joints: int, columns: int, vertices: int = 120, seed: int = 0) -> dict[str, np.ndarray]:
    """Return members of a model file with random values of the size that real ones have."""
    rng = np.random.default_rng(seed)
    template = rng.uniform(-1.0, 1.0, (vertices, 3)) * [0.8, 0.9, 0.15]
    weights = rng.uniform(0.0, 1.0, (vertices, joints)) * (rng.uniform(size=(vertices, joints)) < 4.0 / joints)
    weights[np.arange(vertices), rng.integers(0, joints, vertices)] += 0.1
    regressor = np.where(rng.uniform(size=(joints, vertices)) < 0.1, rng.uniform(size=(joints, vertices)), 0.0)
    regressor[np.arange(joints), rng.integers(0, vertices, joints)] += 0.1
    members = {
        "v_template": template,
        "f": rng.permuted(np.tile(np.arange(vertices), (2 * vertices, 1)), axis=1)[:, :3].astype(np.uint32),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "shapedirs": rng.normal(0.0, 0.01, (vertices, 3, columns)),
        "posedirs": rng.normal(0.0, 0.01, (vertices, 3, 9 * (joints - 1))),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "kintree_table": np.stack([_parents(joints), np.arange(joints)]).astype(np.uint32),
    }
    if joints > 24:
        members |= {f"hands_mean{side}": rng.normal(0.0, 0.3, 45) for side in "lr"}
        members |= {f"hands_components{side}": rng.normal(0.0, 0.3, (45, 45)) for side in "lr"}
    return members


def _parents(joints: int) -> np.ndarray:
    """Return the trees of the three models, by their papers; the root's parent is written as -1."""
    if joints == 24:
        return np.array([*PARENTS, 20, 21])
    first = joints - 30
    fingers = [
        (wrist if bone == 0 else first + 15 * side + 3 * finger + bone - 1)
        for side, wrist in enumerate((20, 21))
        for finger in range(5)
        for bone in range(3)
    ]
    return np.array([*PARENTS, *[15] * (first - 22), *fingers])


class Ch:
    """An array of chumpy: what its state has in real files."""

    def __init__(self, x):
        self.x, self._dirty_vars, self._itr = x, set(), None


class Select:
    """A selection of chumpy from another array."""

    def __init__(self, a, idxs, shape):
        self.a, self.idxs, self.preferred_shape, self._dirty_vars = a, idxs, shape, set()


def with_chumpy(monkeypatch) -> None:
    """Let objects of this module be pickled as chumpy's."""
    for name, kind in (("chumpy.ch", Ch), ("chumpy.reordering", Select)):
        module = types.ModuleType(name)
        setattr(module, kind.__name__, kind)
        monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setattr(kind, "__module__", name)
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))


def write_npz(path: Path, members: dict, pickled: tuple[str, ...] = ("joint2num",)) -> Path:
    """Write an ``.npz``; ``pickled`` members as arrays of one object, a sparse regressor among them."""
    boxed = dict(members, joint2num={f"joint_{index}": index for index in range(members["weights"].shape[1])})
    for key in pickled:
        box = np.empty((), object)
        box[()] = sparse.csc_matrix(boxed[key]) if key == "J_regressor" else boxed[key]
        boxed[key] = box
    np.savez(path, **boxed)
    return path


def write_pkl(path: Path, members: dict, protocol: int = 2) -> Path:
    """Write a ``.pkl`` with chumpy's arrays and a sparse regressor, as the SMPL files of 2015."""
    count = members["posedirs"].size
    chumpy = dict(
        members,
        J_regressor=sparse.csc_matrix(members["J_regressor"]),
        shapedirs=Ch(members["shapedirs"]),
        posedirs=Select(Ch(members["posedirs"].ravel()[::-1]), np.arange(count)[::-1], members["posedirs"].shape),
        bs_type="lrotmin",
    )
    path.write_bytes(pickle.dumps(chumpy, protocol))
    return path


def npy_of_pickle(payload: bytes) -> bytes:
    """Return an ``.npy`` of objects whose pickle is ``payload``."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
    return stream.getvalue() + payload


def zip_of(path: Path, members: dict[str, bytes]) -> Path:
    """Write raw members into an archive."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path
