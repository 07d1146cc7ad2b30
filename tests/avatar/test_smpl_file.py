"""SMPL models: every layout gives one surface, by the equations and by another reader; hostile files are refused."""

from __future__ import annotations

import io
import os
import pickle
import struct

import numpy as np
import pytest
from scipy.linalg import expm

from piavatar_envs.avatar.body.smpl_file import SmplModel, read_smpl
from piavatar_envs.core.array_pickle import read_pickle
from tests.avatar.smpl_files import (
    BODY_MODELS_REASON,
    npy_of_pickle,
    random_members,
    with_chumpy,
    write_npz,
    write_pkl,
    zip_of,
)
from tests.conftest import in_core_seconds

LAYOUTS = [(24, 10), (24, 300), (52, 16), (55, 20), (55, 400)]


def cross_matrix(vector):
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def by_equations(members: dict, coefficients: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the vertices by equations 2 to 9 of Loper et al. (2015), vertex by vertex in homogeneous coordinates."""
    template, dirs = members["v_template"], members["shapedirs"]
    shaped = template + sum(value * dirs[:, :, index] for index, value in enumerate(coefficients))
    joints = members["J_regressor"] @ shaped
    turns = [expm(cross_matrix(vector)) for vector in pose]
    differences = np.concatenate([(turn - np.eye(3)).reshape(9) for turn in turns[1:]])
    displaced = shaped + members["posedirs"] @ differences
    chain = []
    for joint, turn in enumerate(turns):
        parent = None if joint == 0 else int(members["kintree_table"][0, joint])
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = turn, joints[joint] - (0.0 if parent is None else joints[parent])
        chain.append(own if parent is None else chain[parent] @ own)
    for joint, matrix in enumerate(chain):
        back = np.eye(4)
        back[:3, 3] = -joints[joint]
        chain[joint] = matrix @ back
    points = np.append(displaced, np.ones((len(displaced), 1)), axis=1)
    return np.array([(np.tensordot(w, chain, 1) @ x)[:3] for w, x in zip(members["weights"], points, strict=True)])


def case(joints: int, columns: int):
    """Return a model's members, coefficients for all of its columns, and a pose."""
    rng = np.random.default_rng(columns)
    return random_members(joints, columns), rng.normal(size=columns), rng.normal(0.0, 0.4, (joints, 3))


def posed(model: SmplModel, coefficients: np.ndarray, pose: np.ndarray) -> np.ndarray:
    first = model.shape_dirs.shape[2]
    shaped = model.shaped(coefficients[:first], coefficients[first:])
    return model.posed(shaped, np.array([expm(cross_matrix(vector)) for vector in pose]))


@pytest.mark.parametrize(("joints", "columns"), LAYOUTS)
@pytest.mark.parametrize("layout", ["npz", "npz with a pickled regressor", "pkl 2", "pkl 0", "pkl 5"])
def test_every_layout_gives_the_paper_s_surface(joints, columns, layout, tmp_path, monkeypatch):
    members, coefficients, pose = case(joints, columns)
    if layout.startswith("npz"):
        pickled = ("joint2num", "J_regressor") if "pickled" in layout else ("joint2num",)
        model = read_smpl(write_npz(tmp_path / "model.npz", members, pickled))
    else:
        with_chumpy(monkeypatch)
        model = read_smpl(write_pkl(tmp_path / "model.pkl", members, int(layout[-1])))
    assert model.kind == {24: "SMPL", 52: "SMPL-H", 55: "SMPL-X"}[joints]
    assert np.array_equal(model.faces, members["f"])
    assert model.expression_dirs.shape[2] == {(55, 20): 10, (55, 400): 100}.get((joints, columns), 0)
    expected = by_equations(members, coefficients, pose)
    assert np.abs(posed(model, coefficients, pose) - expected).max() < 3e-6  # directions are float32


@pytest.mark.parametrize(("joints", "columns"), [(24, 10), (52, 16), (55, 400)])
def test_vertices_agree_with_another_reader(joints, columns, tmp_path):
    pytest.importorskip("body_models", reason=BODY_MODELS_REASON)
    members, coefficients, pose = case(joints, columns)
    path = write_npz(tmp_path / "model.npz", members)
    if joints == 24:
        from body_models.smpl.numpy import SMPL

        other, split = SMPL(model_path=path), {"body_pose": pose[None, 1:]}
    elif joints == 52:
        from body_models.smplh.numpy import SMPLH

        other = SMPLH(model_path=path, flat_hand_mean=True)
        split = {"body_pose": pose[None, 1:22], "hand_pose": pose[None, 22:]}
    else:
        from body_models.smplx.numpy import SMPLX

        other = SMPLX(model_path=path, flat_hand_mean=True)
        coefficients[310:] = 0.0  # of the expressions the other reader takes ten
        split = {"body_pose": pose[None, 1:22], "head_pose": pose[None, 22:25], "hand_pose": pose[None, 25:]}
        split["expression"] = coefficients[None, 300:310]
    shape = coefficients[None, :300]
    found = np.asarray(other.forward_vertices(**split, pelvis_rotation=pose[None, 0], shape=shape))[0]
    ours = posed(read_smpl(path), coefficients, pose)
    # it turns about the origin where we turn about the pelvis joint, or the same: shifts do not count
    difference = (found - found.mean(axis=0)) - (ours - ours.mean(axis=0))
    assert np.abs(difference).max() < 1e-6 * max(1.0, np.abs(ours).max())


def test_hands_rest_flat_or_in_their_mean_and_follow_the_wrists(tmp_path):
    members = random_members(55, 20)
    model = read_smpl(write_npz(tmp_path / "model.npz", members))
    assert np.array_equal(model.rest_rotations(flat_hand=True), np.tile(np.eye(3), (55, 1, 1)))
    mean = np.concatenate(
        [np.zeros((25, 3)), members["hands_meanl"].reshape(15, 3), members["hands_meanr"].reshape(15, 3)]
    )
    expected = np.array([expm(cross_matrix(vector)) for vector in mean])
    assert np.abs(model.rest_rotations(flat_hand=False) - expected).max() < 1e-12
    weights = model.body_weights()
    assert np.abs(weights.sum(axis=1) - 1.0).max() < 1e-12
    assert np.allclose(weights[:, 20], members["weights"][:, [20, *range(25, 40)]].sum(axis=1))  # left hand
    assert np.allclose(weights[:, 21], members["weights"][:, [21, *range(40, 55)]].sum(axis=1))
    assert np.allclose(weights[:, 15], members["weights"][:, [15, 22, 23, 24]].sum(axis=1))  # jaw and eyes


class Evil:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


def array_pickle(shape: tuple, raw: bytes, dtype: bytes = b"f8") -> bytes:
    """Return the pickle of an array with any shape, whatever its bytes are."""
    good = pickle.dumps({"v_template": np.zeros(3)}, 2)
    assert b"f8" in good
    start = pickle.dumps(np.zeros(3), 2)
    head, tail = start[2:].split(b"K\x03\x85", 1)  # the shape (3,)
    sizes = b"".join(b"\x8a\x08" + struct.pack("<q", size) for size in shape)
    return b"\x80\x02" + head + b"(" + sizes + b"t" + tail.replace(b"f8", dtype)


HOSTILE = {
    "a call": lambda evil: pickle.dumps({"v_template": Evil(evil)}, 2),
    "a call in protocol 0": lambda evil: pickle.dumps({"v_template": Evil(evil)}, 0),
    "a call in protocol 5": lambda evil: pickle.dumps({"v_template": Evil(evil)}, 5),
    "eval": lambda evil: b"c__builtin__\neval\n(V__import__('os').system('touch %s')\ntR." % str(evil).encode(),
    "an instance": lambda evil: b"(S'touch %s'\nios\nsystem\n." % str(evil).encode(),
    "an attribute of numpy": lambda evil: b"cnumpy\nsave\n(V%s\nI1\ntR." % str(evil).encode(),
    "a dotted name": lambda evil: b"\x80\x04\x8c\x05numpy\x8c\x0fndarray.tofile.x\x93.",
    "a persistent object": lambda evil: b"P1\n.",
    "a list of itself": lambda evil: b"]q\x00h\x00a.",
    "a dictionary of itself": lambda evil: b"}q\x00U\x0av_templateh\x00s.",
    "an array of itself": lambda evil: (
        b"}U\x0av_templatecnumpy.core.multiarray\n_reconstruct\n(tRq\x01(K\x01K\x01\x85NK\x00]h\x01atbs."
    ),
    "deep lists": lambda evil: b"]" * 400_000 + b"a" * 399_999 + b".",
    "deep tuples as a key": lambda evil: b"}" + b")" + b"\x85" * 200_000 + b"K\x01s.",
    "doubled tuples as a key": lambda evil: b"}" + b")q\x00" + b"h\x00h\x00\x86q\x00" * 200 + b"K\x01s.",
    "a memo of terabytes": lambda evil: b"K\x01r\xff\xff\xff\xff.",
    "bytes of terabytes": lambda evil: b"\x80\x05\x96" + struct.pack("<Q", 2**45) + b"x.",
    "an array of terabytes": lambda evil: array_pickle((2**20, 2**25), b""),
    "a negative array": lambda evil: array_pickle((-3,), b""),
    "an array of objects": lambda evil: array_pickle((3,), b"", b"O8"),
    "a number of a million digits": lambda evil: b"I" + b"9" * 1_000_000 + b"\n.",
    "an empty file": lambda evil: b"",
    "text": lambda evil: b"solid cube\n",
    "a foreign pickle": lambda evil: pickle.dumps([1, 2, 3]),
    "half a model": lambda evil: pickle.dumps(random_members(24, 10), 2)[:50_000],
    "a pop of nothing": lambda evil: b"0000.",
    "a mark as a value": lambda evil: b"}(K\x01s.",
}


@pytest.mark.parametrize("kind", HOSTILE)
@pytest.mark.parametrize("suffix", [".pkl", ".npz"])
def test_hostile_pickles_are_refused_in_one_line_and_run_nothing(kind, suffix, tmp_path):
    evil = tmp_path / "pwned"
    payload, path = HOSTILE[kind](evil), tmp_path / f"model{suffix}"
    if suffix == ".pkl":
        path.write_bytes(payload)
    else:
        zip_of(path, {"v_template": npy_of_pickle(payload)})
    with in_core_seconds(2.0), pytest.raises(ValueError, match="is not an SMPL") as caught:
        read_smpl(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
    assert not evil.exists()


def npy(header: bytes, rest: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + rest


@pytest.mark.parametrize(
    "member",
    [
        npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776, 3)}"),
        npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3)}"),
        npy(b"{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,)}", bytes(8)),
        npy(b"{'descr': '<U4', 'fortran_order': False, 'shape': (1,)}", bytes(16)),
        npy(b"(" * 5000),
        b"\x93NUMPY\x09\x00",
        b"",
    ],
)
def test_damaged_arrays_are_refused(member, tmp_path):
    with pytest.raises(ValueError, match="is not an SMPL"):
        read_smpl(zip_of(tmp_path / "model.npz", {"v_template": member}))


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("f", lambda a: a + 10_000, "f refers"),
        ("weights", lambda a: 2.0 * a, "sum to one"),
        ("v_template", lambda a: np.where(a > 0.7, np.nan, a), "finite"),
        ("kintree_table", lambda a: a[:, :23], "joints"),
        ("kintree_table", lambda a: a[:, ::-1], "parents"),
        ("posedirs", lambda a: a[..., :-1], "posedirs"),
        ("J_regressor", lambda a: a.T, "J_regressor"),
        ("shapedirs", None, "lacks shapedirs"),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(key, change, message, tmp_path):
    members = random_members(24, 10)
    if change is None:
        del members[key]
    else:
        members[key] = change(members[key])
    np.savez(tmp_path / "model.npz", **members)
    with pytest.raises(ValueError, match=message):
        read_smpl(tmp_path / "model.npz")


def test_a_zip_bomb_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("piavatar_envs.avatar.body.smpl_file.MAX_BYTES", 10_000_000)
    path = zip_of(tmp_path / "model.npz", {"v_template": bytes(20_000_000)})
    assert path.stat().st_size < 1_000_000
    with pytest.raises(ValueError, match="at most 10000000"):
        read_smpl(path)


def test_pickles_of_arrays_are_read_without_their_packages():
    stream = io.BytesIO()
    pickle.dump({"a": np.arange(3)}, stream, 2)
    assert list(read_pickle(stream.getvalue())) == ["a"]
    with pytest.raises(FileNotFoundError):
        read_smpl("no_such_model.npz")
    with pytest.raises(ValueError, match="suffix"):
        read_smpl("model.fbx")
