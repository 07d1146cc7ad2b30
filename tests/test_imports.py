"""Imports: one way, in no circles, and light."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: Folders from the ground up; a module may import its own folder and those before it.
ORDER = ("data", "core", "mpm", "avatar", "cloth", "config", "sim", "render", "envs", "tasks", "api", "multi")
TOP = len(ORDER)
#: Folders outside the package, and those outside of it that each may import.
OUTSIDE = {
    "agents": {"agents"},
    "benchmarks": {"benchmarks", "agents"},
    "scripts": {"scripts", "agents", "benchmarks"},
}


def floor(module: str) -> int:
    """Return the place in ``ORDER``, by the name without the package's; the package itself is the ground."""
    folder = module.partition(".")[0]
    return -1 if not folder else ORDER.index(folder) if folder in ORDER else TOP


def modules(root: Path = ROOT, package: str = "piavatar_envs") -> dict[str, Path]:
    """Return the modules of a package by their names within it: ``mpm.solver``; a package is named as its folder."""
    found = {}
    for path in sorted((root / package).rglob("*.py")):
        parts = path.relative_to(root / package).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports_of(path: Path, root: Path = ROOT) -> Iterator[tuple[int, str]]:
    """Yield the line and absolute name of every import in a file, also within functions and under TYPE_CHECKING."""
    parts = path.relative_to(root).with_suffix("").parts
    package = parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            source = ".".join([*base, *([node.module] if node.module else [])])
            # "from package import name" may import a module of this name
            yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)


def edges(root: Path = ROOT) -> dict[str, dict[str, int]]:
    """Return the modules that each module of the package imports, with the line."""
    known = modules(root)
    found: dict[str, dict[str, int]] = {}
    for module, path in known.items():
        found[module] = {}
        for line, name in imports_of(path, root):
            parts = name.split(".")
            if parts[0] != "piavatar_envs":
                continue
            longest = next(
                (".".join(parts[1:n]) for n in range(len(parts), 0, -1) if ".".join(parts[1:n]) in known), ""
            )
            if longest != module:
                found[module].setdefault(longest, line)
    return found


def circle(graph: dict[str, dict[str, int]]) -> list[str]:
    """Return modules that import each other, directly or by way of others; none if there is no circle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def upward(graph: dict[str, dict[str, int]]) -> list[str]:
    """Return the imports that break the order."""
    return [
        f"{module}:{line} imports {other}"
        for module, others in graph.items()
        for other, line in others.items()
        if 0 <= floor(module) < floor(other)
    ]


def outward(root: Path = ROOT) -> list[str]:
    """Return the imports of packages that the wheel lacks."""
    return [
        f"{module}:{line} imports {name}"
        for module, path in modules(root).items()
        for line, name in imports_of(path, root)
        if name.partition(".")[0] in ("agents", "benchmarks", "tests", "scripts")
    ]


def test_imports_go_one_way_and_in_no_circles():
    graph = edges()
    assert not upward(graph) and not outward() and not circle(graph)


@pytest.mark.parametrize("package", list(OUTSIDE))
def test_folders_outside_import_in_one_direction(package):
    wrong = [
        f"{module}:{line} imports {name}"
        for module, path in modules(ROOT, package).items()
        for line, name in imports_of(path)
        if name.partition(".")[0] in ("agents", "benchmarks", "tests")
        and name.partition(".")[0] not in OUTSIDE[package]
    ]
    assert not wrong


def write(root: Path, files: dict[str, str]) -> dict[str, dict[str, int]]:
    """Write modules of a package, by path, and return the imports of all that are there."""
    for name, text in {"__init__": "", **files}.items():
        path = root / "piavatar_envs" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return edges(root)


@pytest.mark.parametrize(
    "line",
    [
        "from piavatar_envs.avatar import skeleton",
        "from ..envs import task",
        "from piavatar_envs import tasks",
        "def f():\n    import piavatar_envs.api",
        "import benchmarks.runner",
    ],
)
def test_a_wrong_import_is_found(tmp_path, line):
    good = "import numpy\nfrom piavatar_envs.core import launch_graph\nfrom . import grid\n"
    folders = {f"{name}/__init__": "" for name in ("avatar", "envs", "tasks", "api", "core", "mpm")}
    graph = write(tmp_path, {**folders, "mpm/a": good, "core/launch_graph": "", "mpm/grid": ""})
    assert not upward(graph) and not outward(tmp_path) and not circle(graph)
    graph = write(tmp_path, {"mpm/a": f"{line}\n"})
    assert len(upward(graph) + outward(tmp_path)) == 1


def test_a_circle_is_found(tmp_path):
    hidden = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from piavatar_envs.mpm.a import A\n"
    files = {"mpm/a": "from piavatar_envs.mpm.b import B\n", "mpm/b": "from piavatar_envs.mpm import c\n", "mpm/c": ""}
    assert not circle(write(tmp_path, files))
    assert set(circle(write(tmp_path, {"mpm/c": hidden}))) == {"mpm.a", "mpm.b", "mpm.c"}


def test_importing_is_light_and_an_environment_imports_no_renderer():
    """Check that an import leaves Warp uninitialized: a forked worker inherits a CUDA context that it cannot use."""
    unused = ("torch", "PIL", "matplotlib", "imageio", "viser")
    heavy = (*unused, "stable_baselines3", "pettingzoo", "pybullet_data")
    code = f"""
import sys
import piavatar_envs, gymnasium
assert [i for i in gymnasium.registry if i.startswith("PIAvatar/")], "no id was registered"
assert not [name for name in {heavy!r} if name in sys.modules]
context = sys.modules.get("warp._src.context")
assert context is None or context.runtime is None
env = gymnasium.make("piavatar_envs:PIAvatar/Reach-v0", device="cpu", fidelity="tiny")
env.reset(seed=0)
env.step(env.action_space.sample())
assert not [name for name in {unused!r} if name in sys.modules]
"""
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stderr
