"""The house's rules that a parser can hold: imports go one way, and importing the package costs and touches nothing."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "piavatar_envs"
FILES = sorted(PACKAGE.rglob("*.py"))

#: A module may import its own floor and those below: mpm <- avatar <- props, render <- tasks, envs <- api.
FLOORS = {"mpm": 0, "data": 0, "avatar": 1, "props": 2, "render": 2, "tasks": 3, "envs": 3, "api": 4, "multi": 5}
TOP = 6


def floor(module: str) -> int:
    """Floor of a dotted module of the package; the package itself only registers ids and is the ground."""
    parts = module.split(".")
    return -1 if len(parts) == 1 else FLOORS.get(parts[1], TOP)


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path) -> list[tuple[int, str]]:
    """Line and absolute name of every import in a file, also those inside functions."""
    package = module_name(path) if path.name == "__init__.py" else module_name(path).rpartition(".")[0]
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            # `from piavatar_envs import envs` imports the module envs, not only the package.
            names = [f"{source}.{alias.name}" for alias in node.names] if source == "piavatar_envs" else [source]
            found += [(node.lineno, name) for name in names]
    return found


def upward(path: Path) -> list[str]:
    """Imports of a file that break the direction."""
    mine = floor(module_name(path))
    wrong = []
    for line, name in imports_of(path):
        if name.partition(".")[0] in ("agents", "benchmarks", "tests", "scripts"):
            wrong.append(f"{path.name}:{line} imports {name}, which is not part of the wheel")
        elif name.partition(".")[0] == "piavatar_envs" and 0 <= mine < floor(name):
            wrong.append(f"{path.name}:{line} ({module_name(path)}) imports {name}, which stands above it")
    return wrong


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    assert not upward(path)


def test_the_direction_test_can_fail(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    folder = tmp_path / "piavatar_envs" / "mpm"
    folder.mkdir(parents=True)
    wrong = ("from piavatar_envs.avatar import skeleton", "from ..envs import config", "import benchmarks.runner")
    for line in (*wrong, "from piavatar_envs import tasks", "def f():\n    import piavatar_envs.api"):
        (folder / "bad.py").write_text(f"{line}\n")
        assert len(upward(folder / "bad.py")) == 1, line
    (folder / "good.py").write_text("import numpy\nfrom piavatar_envs.mpm import stencil\nfrom . import grid\n")
    assert not upward(folder / "good.py")


def run_python(code: str) -> str:
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_importing_the_package_is_light_and_touches_no_device():
    """A forked worker inherits a CUDA context it cannot use, so an import must make none: Warp stays asleep."""
    heavy = (
        "torch",
        "pyvista",
        "vtk",
        "matplotlib",
        "stable_baselines3",
        "pettingzoo",
        "imageio",
        "pybullet_data",
        "viser",
    )
    code = f"""
import sys
import piavatar_envs, gymnasium
assert [i for i in gymnasium.registry if i.startswith("PIAvatar/")], "no id was registered"
print([name for name in {heavy!r} if name in sys.modules])
context = sys.modules.get("warp._src.context")
print(context is not None and context.runtime is not None)
"""
    assert run_python(code).split("\n")[:2] == ["[]", "False"]


def test_an_env_without_rendering_imports_no_renderer():
    code = """
import sys
import gymnasium, piavatar_envs
env = gymnasium.make("PIAvatar/Reach-v0", device="cpu", fidelity="tiny")
env.reset(seed=0)
env.step(env.action_space.sample())
print([name for name in ("pyvista", "vtk", "matplotlib", "torch", "imageio", "viser") if name in sys.modules])
"""
    assert run_python(code).strip().endswith("[]")
