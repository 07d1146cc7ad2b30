"""Rules that a parser can hold: imports go one way and in no circles, and importing the package is cheap."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: Folders from the ground up; a module may import its own folder and those before it.
ORDER = ("data", "core", "mpm", "avatar", "config", "sim", "envs", "tasks", "render", "api", "multi")
TOP = len(ORDER)
#: Imports that break the order, as (importing folder or module, imported module): the reason.
EXCEPTIONS = {
    ("tasks", "render.scene"): "a task describes its markers; the scene description imports nothing of the package",
    ("envs.task", "render.scene"): "the base class of tasks names the type of markers",
}
#: Folders outside the package, and those outside of it that each may import.
OUTSIDE = {
    "agents": {"agents"},
    "benchmarks": {"benchmarks", "agents"},
    "scripts": {"scripts", "agents", "benchmarks"},
}


def floor(module: str) -> int:
    """Floor of a module, by its name without the package's; the package itself only registers ids and is the ground."""
    folder = module.partition(".")[0]
    return -1 if not folder else ORDER.index(folder) if folder in ORDER else TOP


def modules(root: Path = ROOT, package: str = "piavatar_envs") -> dict[str, Path]:
    """Modules of a package by name, without the package's own: ``mpm.solver``; a package is named as its folder."""
    found = {}
    for path in sorted((root / package).rglob("*.py")):
        parts = path.relative_to(root / package).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports_of(path: Path, root: Path = ROOT) -> Iterator[tuple[int, str]]:
    """Line and absolute name of every import in a file, also within functions and under TYPE_CHECKING."""
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
    """Modules that each module of the package imports, with the line."""
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


def circles(graph: dict[str, dict[str, int]]) -> list[frozenset[str]]:
    """Sets of modules that import each other, directly or by way of others (Tarjan's strong components)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[frozenset[str]] = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for other in graph[module]:
            if other not in index:
                visit(other)
                low[module] = min(low[module], low[other])
            elif other in stack:
                low[module] = min(low[module], index[other])
        if low[module] == index[module]:
            component = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(component) > 1:
                found.append(frozenset(component))

    for module in graph:
        if module not in index:
            visit(module)
    return found


def upward(graph: dict[str, dict[str, int]]) -> list[str]:
    """Imports that break the order."""
    return [
        f"{module}:{line} imports {other}"
        for module, others in graph.items()
        for other, line in others.items()
        if 0 <= floor(module) < floor(other)
        and not any(other == name and module.startswith(start) for start, name in EXCEPTIONS)
    ]


def outward(root: Path = ROOT) -> list[str]:
    """Imports of the package that the wheel does not hold."""
    return [
        f"{module}:{line} imports {name}"
        for module, path in modules(root).items()
        for line, name in imports_of(path, root)
        if name.partition(".")[0] in ("agents", "benchmarks", "tests", "scripts")
    ]


def test_imports_go_one_way():
    assert not upward(edges())


def test_imports_form_no_circles():
    assert not circles(edges())


def test_the_package_imports_nothing_outside_the_wheel():
    assert not outward()


def test_the_renderer_is_imported_by_views_only():
    """Also by the tools on top of them; the scene description has a test of its own."""
    wrong = [
        f"{module} imports {other}"
        for module, others in edges().items()
        for other in others
        if other.startswith("render") and other != "render.scene" and floor(module) < ORDER.index("render")
    ]
    assert not wrong


def test_the_scene_description_imports_nothing_of_the_package():
    assert not edges()["render.scene"]


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


def test_the_tests_of_direction_can_fail(tmp_path):
    wrong = (
        "from piavatar_envs.avatar import skeleton",
        "from ..envs import task",
        "from piavatar_envs import tasks",
        "def f():\n    import piavatar_envs.api",
    )
    write(tmp_path, {f"{name}/__init__": "" for name in ("avatar", "envs", "tasks", "api", "core", "mpm")})
    for line in wrong:
        assert len(upward(write(tmp_path, {"mpm/bad": f"{line}\n"}))) == 1, line
    write(tmp_path, {"mpm/bad": "import benchmarks.runner\n"})
    assert len(outward(tmp_path)) == 1
    good = "import numpy\nfrom piavatar_envs.core import launch_graph\nfrom . import grid\n"
    assert not upward(write(tmp_path, {"mpm/bad": good, "core/launch_graph": "", "mpm/grid": ""}))
    assert not outward(tmp_path)


def test_the_test_of_circles_can_fail(tmp_path):
    hidden = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from piavatar_envs.mpm.a import A\n"
    files = {"mpm/a": "from piavatar_envs.mpm.b import B\n", "mpm/b": "from piavatar_envs.mpm import c\n", "mpm/c": ""}
    assert not circles(write(tmp_path, files))
    assert circles(write(tmp_path, {"mpm/c": hidden})) == [frozenset({"mpm.a", "mpm.b", "mpm.c"})]


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
