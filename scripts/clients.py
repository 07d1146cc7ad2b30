"""Run third-party clients on the environments: ``python -m scripts.clients``, or of some: ``... clients sbx minari``.

Every folder of ``tests/clients`` is a client with a test and its pins, and so is ``tests/rllib``. Pins are installed
without dependencies into a folder of the client's own, where they take precedence over the environment for its test
alone: clients whose pins contradict each other, or those of this project, run side by side. The first pins of a file,
up to an empty line, are those of the client; others are what it imports.

Leaves ``clients.json`` and a table, ``clients.md``. The exit status is 1 if a client fails.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import tyro

from agents.files import git_commit, write_json

ROOT = Path(__file__).resolve().parents[1]
TESTS = ROOT / "tests" / "clients"
#: A client with a target of its own in the Makefile.
RLLIB = ROOT / "tests" / "rllib"
#: Interfaces whose versions a row names, because pins of clients replace them.
INTERFACES = ("gymnasium", "pettingzoo", "torch")
#: Name of the file of pins, and of the mark that a folder holds them.
PINS, MARK = "requirements.txt", ".pins"


@dataclass(frozen=True)
class Row:
    """Result of a client.

    Attributes:
        client: name of its folder.
        pins: of the client itself, as ``sbx-rl 0.28.0``.
        interfaces: versions that it ran with, by name.
        passed, failed, skipped: tests.
        seconds: time of the tests.
        date: day of the run, UTC.
        about: first line of the test's documentation.
        note: end of the output if something failed.
    """

    client: str
    pins: tuple[str, ...]
    interfaces: Mapping[str, str]
    passed: int
    failed: int
    skipped: int
    seconds: float
    date: str
    about: str
    note: str = ""

    @property
    def ok(self) -> bool:
        """Return whether tests ran and none failed."""
        return self.passed > 0 and not self.failed


def find_clients() -> dict[str, Path]:
    """Return the folders of the tests of all clients, by name."""
    folders = [*TESTS.iterdir(), RLLIB]
    return {
        folder.name: folder for folder in sorted(folders, key=lambda folder: folder.name) if (folder / PINS).is_file()
    }


def own_pins(text: str) -> tuple[str, ...]:
    """Return the pins of the client itself: the first block of a file of pins."""
    lines = [line.partition("#")[0].strip() for line in text.splitlines()]
    block: list[str] = []
    for line in lines:
        if line:
            block.append(line.replace("==", " "))
        elif block:
            break
    return tuple(block)


def install(tests: Path, folder: Path) -> None:
    """Install the pins of a client into a folder; does nothing where they are unchanged.

    Args:
        tests: folder of its tests.
        folder: for its packages.

    Raises:
        subprocess.CalledProcessError: pip has failed.
    """
    pins = tests / PINS
    state = f"{hashlib.sha256(pins.read_bytes()).hexdigest()} {sys.version_info[:2]}"
    mark = folder / MARK
    if mark.exists() and mark.read_text() == state:
        return
    pip = [sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--quiet", "--no-deps", "--upgrade"]
    # CleanRL's package names Python < 3.11, which its scripts do not need
    pip += ["--ignore-requires-python", "--target", str(folder), "--requirement", str(pins)]
    subprocess.run(pip, check=True)
    mark.write_text(state)


def environment(folder: Path) -> dict[str, str]:
    """Return variables of a process in which the packages of a folder take precedence."""
    path = os.pathsep.join([str(folder), str(ROOT)])
    # without a JIT, as compilation takes longer than the tests
    return os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "NUMBA_DISABLE_JIT": "1"}


def versions(folder: Path) -> dict[str, str]:
    """Return the versions of :data:`INTERFACES` that a client sees."""
    code = "import json, sys; from importlib.metadata import version; "
    code += "print(json.dumps({name: version(name) for name in sys.argv[1:]}))"
    command = [sys.executable, "-c", code, *INTERFACES]
    done = subprocess.run(command, env=environment(folder), capture_output=True, text=True)
    return json.loads(done.stdout) if done.returncode == 0 else {}


def run(tests: Path, folder: Path, report: Path) -> Row:
    """Run the tests of a client.

    Args:
        tests: folder of its tests.
        folder: with its pins.
        report: JUnit file to write.
    """
    files = sorted(str(path) for path in tests.glob("test_*.py"))
    report.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", *files]
    began = time.perf_counter()
    done = subprocess.run(command, env=environment(folder), cwd=ROOT, capture_output=True, text=True)
    seconds = time.perf_counter() - began
    passed, failed, skipped = counts(report) if report.exists() else (0, 0, 0)
    first = re.search(r'"""(.*)', Path(files[0]).read_text(encoding="utf-8"))
    return Row(
        tests.name,
        own_pins((tests / PINS).read_text(encoding="utf-8")),
        versions(folder),
        passed,
        failed or int(done.returncode != 0),
        skipped,
        seconds,
        f"{datetime.now(timezone.utc):%Y-%m-%d}",
        first.group(1) if first else "",
        "" if done.returncode == 0 else (done.stdout + done.stderr)[-4000:],
    )


def counts(report: Path) -> tuple[int, int, int]:
    """Return how many tests of a JUnit file passed, failed and were skipped."""
    suites = ElementTree.parse(report).getroot().iter("testsuite")
    total = failed = skipped = 0
    for suite in suites:
        total += int(suite.get("tests", 0))
        failed += int(suite.get("failures", 0)) + int(suite.get("errors", 0))
        skipped += int(suite.get("skipped", 0))
    return total - failed - skipped, failed, skipped


def table(rows: Sequence[Row]) -> str:
    """Return the rows as Markdown."""
    head = ["client", "versions", "gymnasium", "pettingzoo", "tests", "seconds", "date"]
    lines = [f"| {' | '.join(head)} |", "| --- " * len(head) + "|"]
    for row in rows:
        result = f"{row.passed} passed" + (f", {row.failed} failed" if row.failed else "")
        result += f", {row.skipped} skipped" if row.skipped else ""
        seen = [row.interfaces.get(name, "") for name in INTERFACES[:2]]
        cells = [row.client, ", ".join(row.pins), *seen, result, f"{row.seconds:.0f}", row.date]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(
    clients: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    folder: Annotated[Path, tyro.conf.arg(help="where every client has its packages")] = ROOT / ".venv" / "clients",
    out: Annotated[Path, tyro.conf.arg(help="folder of the table")] = ROOT / "build" / "clients",
) -> None:
    """Run third-party clients, each with its own pins, and write a table of them.

    Args:
        clients: names of folders in ``tests/clients``, or ``rllib``; by default all.
        folder: where every client has its packages.
        out: folder of the table.
    """
    known = find_clients()
    if unknown := set(clients) - known.keys():
        sys.exit(f"error: there is no client {', '.join(sorted(unknown))}; use some of {', '.join(known)}")
    rows = []
    for client in clients or known:
        print(f"{client}: ", end="", flush=True)
        try:
            install(known[client], folder / client)
        except subprocess.CalledProcessError as error:
            sys.exit(f"error: the pins of {client} cannot be installed (exit {error.returncode})")
        rows.append(run(known[client], folder / client, out / f"{client}.xml"))
        print(f"{rows[-1].passed} passed, {rows[-1].failed} failed, {rows[-1].seconds:.0f} s", flush=True)
        if rows[-1].note:
            print(rows[-1].note)
        commit, _ = git_commit()
        about = {"benchmark": "clients", "commit": commit, "python": platform.python_version()}
        write_json(out / "clients.json", about | {"results": [asdict(row) for row in rows]})
    text = table(rows)
    (out / "clients.md").write_text(text, encoding="utf-8")
    print(text)
    sys.exit(0 if all(row.ok for row in rows) else 1)


if __name__ == "__main__":
    tyro.cli(main)
