"""Score all committed agents with the present engine: ``python -m scripts.rescore --device cuda --jobs 8``.

Policies (``ppo/*/policy.*``) play the episodes of their last evaluation, the PID agent and streams of random actions
those of their record (``pid/*``, ``random/*``), each with its recorded settings. The new scores go to a folder of their
own (``--out``, by default ``runs/rescored``), with one table of all: compare it with the committed
``torque_baselines.md``. This takes minutes on an H200 and many hours on a CPU.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.progress import track

from agents.files import read_json
from agents.pid.agent import Design
from piavatar_envs.config import load_config
from piavatar_envs.tasks import load_task

TABLE = "torque_baselines.json"


@dataclass(frozen=True)
class Job:
    """Command that scores one agent.

    Attributes:
        source: folder of the agent among the results.
        folder: of its new scores.
        command: a module and its arguments.
    """

    source: Path
    folder: Path
    command: tuple[str, ...]

    def run(self) -> str:
        """Score the agent; return the end of the output if that failed, else nothing."""
        shutil.copytree(self.source, self.folder, dirs_exist_ok=True)
        done = subprocess.run([sys.executable, "-m", *self.command], capture_output=True, text=True)
        return "" if done.returncode == 0 else (done.stderr or done.stdout)[-2000:] or f"exit {done.returncode}"


def main(
    results: Annotated[Path, tyro.conf.arg(help="folder with ppo, pid and random")] = Path("benchmarks/results"),
    out: Annotated[Path, tyro.conf.arg(help="folder of the new scores")] = Path("runs/rescored"),
    device: Annotated[str, tyro.conf.arg(help="where to simulate")] = "cpu",
    jobs: Annotated[int, tyro.conf.arg(help="agents that play at a time")] = 1,
    bone_contact: Annotated[
        bool | None,
        tyro.conf.arg(help="override control.bone_contact of the policies; else as in their last evaluation"),
    ] = None,
) -> int:
    """Score the committed agents, and write the table.

    Raises:
        ValueError: there is no agent, or ``jobs`` is less than 1.
    """
    todo = find_jobs(results, out, device, bone_contact)
    if not todo or jobs < 1:
        raise ValueError(f"{results} has {len(todo)} agents and jobs={jobs}; both must be >= 1")
    with ThreadPoolExecutor(jobs) as pool:
        said = list(track(pool.map(Job.run, todo), "scoring", len(todo)))
    failed = [(job.folder, words) for job, words in zip(todo, said, strict=True) if words]
    for folder, words in failed:
        print(f"{folder}:\n{words}", file=sys.stderr)
    if failed:
        print(f"{len(failed)} of {len(todo)} failed; there is no new table", file=sys.stderr)
        return 1
    folders = map(str, sorted({job.folder for job in todo}))
    return subprocess.run([sys.executable, "-m", "agents.scores", *folders, "--out", str(out / TABLE)]).returncode


def find_jobs(results: Path, out: Path, device: str, bone_contact: bool | None = None) -> list[Job]:
    """Return a job for every committed agent, the longest first; arguments as for :func:`main`."""
    jobs = []
    for folder in sorted(path.parent for path in results.glob("pid/*/results.json")):
        new = out / folder.relative_to(results)
        jobs.append(Job(folder, new, ("agents.pid.score", *pid_arguments(folder), *written(folder, new, device))))
    for folder in sorted(path.parent for path in results.glob("random/*/results.json")):
        new, count = out / folder.relative_to(results), read_json(folder / "results.json")["results"][0]["seeds"]
        command = ("agents.score_random", str(folder), "--seeds", str(count), *written(folder, new, device))
        jobs.append(Job(folder, new, command))
    for folder in sorted(path.parent for path in results.glob("ppo/*/policy.*")):
        new, bones = out / folder.relative_to(results), scored_on(folder) if bone_contact is None else bone_contact
        settings = () if bones is None else (f"control.bone_contact={str(bones).lower()}",)
        where = ("--device", device, "--out", str(new / "evaluation.json"))
        jobs.append(Job(folder, new, ("agents.play", str(folder), *settings, *where)))
    return jobs


def scored_on(folder: Path) -> bool | None:
    """Return ``control.bone_contact`` of a policy's last evaluation; None if it has none."""
    path = folder / "evaluation.json"
    env = read_json(path).get("env", {}) if path.is_file() else {}
    return env.get("control", {}).get("bone_contact")


def written(folder: Path, new: Path, device: str) -> tuple[str, ...]:
    """Return arguments for the episodes that ``folder`` records, with results in ``new``."""
    row = read_json(folder / "results.json")["results"][0]
    episodes = ("--evaluation.episodes", str(row["episodes"]), "--evaluation.first-seed", str(row["first_seed"]))
    return (*episodes, "--device", device, "--out", str(new))


def pid_arguments(folder: Path) -> list[str]:
    """Return the task, and the settings and numbers of the controller that differ from the defaults."""
    config = read_json(folder / "results.json")["config"]
    default = load_config(load_task(config["env_id"]).Config, {"control": "torque"}).model_dump(mode="json")
    settings = [f"{name}={json.dumps(value)}" for name, value in differences(config["env"], default)]
    arguments = [config["env_id"], *settings]
    for name, value in differences(config["design"], json.loads(json.dumps(asdict(Design())))):
        arguments += [f"--design.{name.replace('_', '-')}", *map(str, value if isinstance(value, list) else [value])]
    return arguments


def differences(recorded: Mapping[str, Any], default: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of the settings that differ from the defaults."""
    for name, value in recorded.items():
        other = default.get(name)
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            yield from ((f"{name}.{inner}", own) for inner, own in differences(value, other))
        elif value != other:
            yield name, value


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main, description=__doc__))
    except ValueError as error:
        sys.exit(f"error: {error}")
