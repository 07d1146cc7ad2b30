"""The mannequin of viverse (MIT): refused, because meshopt compresses it, with a remedy that helps."""

from __future__ import annotations

import base64
import importlib.util
import re
import shutil
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest

from piavatar_envs.avatar.body.sources import load_asset

PACKAGE = "@pmndrs/viverse@0.2.20"
NPM = shutil.which("npm")
# what takes the network runs where the other references are installed
pytestmark = pytest.mark.skipif(
    NPM is None or importlib.util.find_spec("anny") is None, reason="needs npm, in make test-avatars"
)


@pytest.fixture(scope="module")
def mannequin(tmp_path_factory) -> Path:
    """The file, out of the package's module that has it as text."""
    folder = tmp_path_factory.mktemp("viverse")
    packed = subprocess.run([NPM, "pack", "--silent", PACKAGE], cwd=folder, capture_output=True, text=True, timeout=120)
    if packed.returncode:
        pytest.skip(f"npm cannot fetch {PACKAGE}: {packed.stderr[-200:]}")
    with tarfile.open(folder / packed.stdout.split()[-1]) as archive:
        module = archive.extractfile("package/dist/assets/mannequin.js").read().decode()
    path = folder / "mannequin.glb"
    path.write_bytes(base64.b64decode(re.search(r"base64,([A-Za-z0-9+/=]+)", module)[1]))
    return path


def test_a_compressed_character_is_refused_with_a_remedy_that_works(mannequin):
    with pytest.raises(ValueError, match=r"meshopt.*npx @gltf-transform/cli copy"):
        load_asset("glb", str(mannequin))
    plain = mannequin.with_name("plain.glb")
    command = [shutil.which("npx"), "--yes", "@gltf-transform/cli@4", "copy", str(mannequin), str(plain)]
    copied = subprocess.run(command, capture_output=True, text=True, timeout=240)
    if copied.returncode:
        pytest.skip(f"npx cannot fetch gltf-transform: {copied.stderr[-200:]}")
    asset = load_asset("glb", str(plain), height=1.75)
    edges = np.sort(asset.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 2).all()
    assert asset.volume([]) == pytest.approx(0.0666, rel=0.02)
