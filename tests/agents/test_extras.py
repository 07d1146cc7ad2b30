"""Every script runs with what its extra installs: the one that its guide and the hint of a missing module name."""

from __future__ import annotations

import ast
import importlib.metadata
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from agents import _EXTRAS
from piavatar_envs.core.extras import EXTRAS

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OWN = ("agents", "piavatar_envs")
#: Scripts by their folder in ``agents``; those beside the folders need the extra ``train``.
FOLDERS = sorted(path.parent.name for path in (ROOT / "agents").glob("*/__init__.py"))

#: Ray's script says how it is installed; torchrl and rsl-rl-lib bring tensordict.
FOUND = ("ray", "tensordict")


@cache
def required_by(name: str) -> list[str]:
    """Return the requirements of a distribution; none where it is not installed."""
    try:
        return importlib.metadata.requires(name) or []
    except importlib.metadata.PackageNotFoundError:
        return []


def installed_by(requirements: list[str]) -> set[str]:
    """Return the canonical names of distributions that requirements install, with all that these require."""
    found: set[str] = set()
    left = [Requirement(text) for text in requirements]
    while left:
        requirement = left.pop()
        name = canonicalize_name(requirement.name)
        if name not in found and (requirement.marker is None or requirement.marker.evaluate({"extra": ""})):
            found.add(name)
            left += [Requirement(text) for text in required_by(name)]
    return found


@cache
def providers() -> dict[str, set[str]]:
    """Return the distributions that provide each top-level module."""
    found = importlib.metadata.packages_distributions()
    return {module: {canonicalize_name(owner) for owner in owners} for module, owners in found.items()}


@cache
def imports(path: Path) -> frozenset[str]:
    """Return the modules that a file imports when it is imported, or draws its figures with."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    skipped = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test))
        for inner in ast.walk(node)
    }
    found = {"matplotlib"} if "from matplotlib" in path.read_text(encoding="utf-8") else set()
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def files_of(module: str) -> Iterator[Path]:
    """Yield the files of a module of ours and of the packages around it; none of what is not a module."""
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        path = ROOT.joinpath(*parts[:count])
        yield from (file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file())


def needed(files: list[Path]) -> dict[str, Path]:
    """Return modules of others that files import, with all of ours that these import, and where."""
    found: dict[str, Path] = {}
    left, seen = list(files), set()
    while left:
        path = left.pop()
        if path in seen:
            continue
        seen.add(path)
        for module in imports(path):
            if module.partition(".")[0] in OWN:
                left += files_of(module)
            elif module.partition(".")[0] not in sys.stdlib_module_names:
                found[module.partition(".")[0]] = path
    return found


@pytest.mark.parametrize("folder", ["", *FOLDERS])
def test_an_extra_is_all_that_its_scripts_need(folder):
    extras = _EXTRAS.get(folder, "train")
    wanted = [text for extra in extras.split(",") for text in PROJECT["optional-dependencies"][extra]]
    have = installed_by([*PROJECT["dependencies"], *wanted])
    scripts = sorted((ROOT / "agents" / folder).glob("*.py"))
    lacking = {
        module: str(path.relative_to(ROOT))
        for module, path in needed(scripts).items()
        if module not in FOUND and not providers().get(module, {canonicalize_name(module)}) & have
    }
    assert scripts and not lacking, f"[{extras}] does not install them"


def test_hints_and_the_doctor_name_extras_that_there_are():
    optional = PROJECT["optional-dependencies"]
    assert {*EXTRAS, *(extra for own in _EXTRAS.values() for extra in own.split(","))} <= set(optional)
    for extra, modules in EXTRAS.items():
        have = installed_by(optional[extra])
        lacking = [module for module in modules if not providers().get(module, have) & have]
        assert not lacking, f"{extra} does not install them"
