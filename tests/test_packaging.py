"""The wheel works where the checkout is not: everything it needs is inside it, and nothing else is."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import types
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: Copied to build from, so that building leaves nothing in the checkout, and the checkout's leftovers do not get in.
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "piavatar_envs")

PROBE = """
import importlib.resources, json, sys
import gymnasium, piavatar_envs
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import list_motions, load_motion

env = gymnasium.make("PIAvatar/Reach-v0", device="cpu", fidelity="tiny")
env.reset(seed=0)
_, reward, *_ = env.step(env.action_space.sample())
mine = [module for name, module in sys.modules.items() if name.split(".")[0] == "piavatar_envs"]
print(json.dumps({
    "files": sorted({module.__file__ for module in mine}),
    "path": sys.path,
    "reward": float(reward),
    "vertices": len(load_asset().vertices),
    "motions": {name: len(load_motion(name).root_position) for name in list_motions() if ":" not in name},
    "data": sorted(entry.name for entry in importlib.resources.files("piavatar_envs.data").iterdir()),
    "typed": importlib.resources.files("piavatar_envs").joinpath("py.typed").is_file(),
}))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy of the sources with the backend that is installed here."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, source / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run(
        [*pip, "--wheel-dir", str(folder), str(source)], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of a new environment outside the checkout that holds the wheel.

    The dependencies come from this environment by a .pth file. Python does not follow the .pth files of a folder that
    is itself named in one, so the editable install of the checkout stays out of sight.
    """
    folder = tmp_path_factory.mktemp("elsewhere") / "env"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True, timeout=120)
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = subprocess.run([python, "-c", code], check=True, capture_output=True, text=True, timeout=60).stdout.strip()
    paths = dict.fromkeys([sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    Path(site, "dependencies.pth").write_text("\n".join(paths) + "\n", encoding="utf-8")
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    done = subprocess.run([*pip, "--ignore-installed", str(wheel)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return python


def test_hints_install_extras_from_where_the_package_is(monkeypatch, tmp_path):
    """The package is on no index, so that its name alone installs nothing."""
    from piavatar_envs.core import extras

    assert extras.install_command("live") == f'pip install -e "{ROOT}[live]"'
    origin = {"url": "https://host/name.git", "vcs_info": {"vcs": "git", "commit_id": "0"}}
    found = types.SimpleNamespace(read_text=lambda name: json.dumps(origin))
    monkeypatch.setattr(extras.importlib.metadata, "distribution", lambda name: found)
    assert extras.install_command("live") == 'pip install "piavatar-envs[live] @ git+https://host/name.git"'
    origin["vcs_info"]["requested_revision"] = "v0.1"  # as it was asked for, or pip would install another commit
    assert extras.install_command("live") == 'pip install "piavatar-envs[live] @ git+https://host/name.git@v0.1"'
    own = Path(extras.__file__)
    texts = {path: path.read_text(encoding="utf-8") for path in (ROOT / "piavatar_envs").rglob("*.py") if path != own}
    assert not [path for path, text in texts.items() if "pip install" in text]


def test_the_wheel_holds_the_package_and_its_data(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    top = {name.partition("/")[0] for name in names}
    assert {name for name in top if not name.endswith(".dist-info")} == {"piavatar_envs"}
    for name in ("py.typed", "data/body.npz", "data/BODY_LICENSE.txt", "cli.py", "config/schema.py"):
        assert f"piavatar_envs/{name}" in names, name
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "piavatar_envs").rglob("*.py")}
    assert modules <= set(names), "a module was left out"
    metadata = zipfile.ZipFile(wheel).read(next(name for name in names if name.endswith("METADATA"))).decode()
    assert "License-Expression: Apache-2.0 AND CC0-1.0" in metadata and "Requires-Python: >=3.10" in metadata
    assert any(name.endswith("licenses/LICENSE") for name in names), "the licence goes with the code"
    assert wheel.stat().st_size < 3 * 2**20


def test_the_wheel_makes_an_env_outside_the_checkout(installed, tmp_path):
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        [installed, "-c", PROBE], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    home = installed.parents[1].resolve()
    assert found["files"] and all(Path(file).resolve().is_relative_to(home) for file in found["files"])
    assert str(ROOT) not in found["path"]
    assert found["typed"] and {"body.npz", "BODY_LICENSE.txt"} <= set(found["data"])
    assert found["vertices"] > 10_000
    assert len(found["motions"]) >= 4 and all(frames > 1 for frames in found["motions"].values())


def test_the_command_works_from_the_wheel(installed, tmp_path):
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    command = installed.with_name("piavatar-envs")
    done = subprocess.run([command, "list"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "PIAvatar/Reach-v0" in done.stdout
