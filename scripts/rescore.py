"""Score all kept agents anew, in the engine as it is: ``python -m scripts.rescore --device cuda --jobs 8``.

Policies play the episodes of their evaluations (``ppo/*/evaluation.json``), the PID agent and streams of random actions
those that are recorded (``pid/*``, ``random/*``), each with the settings that it was recorded with; then comes the
table of all (``torque_baselines.json``, ``.md``). On an H200 that is some nine minutes, on a CPU many hours.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.progress import track

from agents.design import Design
from agents.folders import read_json
from piavatar_envs.envs.config import load_config
from piavatar_envs.tasks import load_task

TABLE = "torque_baselines.json"


@dataclass(frozen=True)
class Job:
    """What scores one agent: a module and its arguments."""

    folder: Path
    command: tuple[str, ...]

    def run(self) -> str:
        """Score it; returns the end of what it said if it failed, else nothing."""
        done = subprocess.run([sys.executable, "-m", *self.command], capture_output=True, text=True)
        return "" if done.returncode == 0 else (done.stderr or done.stdout)[-2000:] or f"exit {done.returncode}"


def main(
    results: Annotated[Path, tyro.conf.arg(help="folder with ppo, pid and random")] = Path("benchmarks/results"),
    device: Annotated[str, tyro.conf.arg(help="where to simulate")] = "cpu",
    jobs: Annotated[int, tyro.conf.arg(help="agents that play at a time")] = 1,
    bone_contact: Annotated[
        bool | None, tyro.conf.arg(help="score policies on bones that stop, or do not; else as each was scored last")
    ] = None,
) -> int:
    """Score what is kept, and draw up the table.

    Raises:
        ValueError: there is nothing, or ``jobs`` is no number of jobs.
    """
    todo = find_jobs(results, device, bone_contact)
    if not todo or jobs < 1:
        raise ValueError(f"{results} has {len(todo)} agents and jobs={jobs}; both must be >= 1")
    with ThreadPoolExecutor(jobs) as pool:
        said = list(track(pool.map(Job.run, todo), "scoring", len(todo)))
    failed = [(job.folder, words) for job, words in zip(todo, said, strict=True) if words]
    for folder, words in failed:
        print(f"{folder}:\n{words}", file=sys.stderr)
    if failed:
        print(f"{len(failed)} of {len(todo)} failed; the table is as it was", file=sys.stderr)
        return 1
    folders = map(str, sorted({job.folder for job in todo}))
    return subprocess.run([sys.executable, "-m", "agents.scores", *folders, "--out", str(results / TABLE)]).returncode


def find_jobs(results: Path, device: str, bone_contact: bool | None = None) -> list[Job]:
    """A job for every agent that is kept, the longest first; policies on bones that stop or do not, if that is said."""
    jobs = []
    for folder in sorted(path.parent for path in results.glob("pid/*/results.json")):
        jobs.append(Job(folder, ("agents.score_pid", *pid_arguments(folder), *written(folder, device))))
    for folder in sorted(path.parent for path in results.glob("random/*/results.json")):
        count = read_json(folder / "results.json")["results"][0]["seeds"]
        command = ("agents.score_random", str(folder), "--seeds", str(count), *written(folder, device))
        jobs.append(Job(folder, command))
    for folder in sorted(path.parent for path in results.glob("ppo/*/config.yaml")):
        out = ("--device", device, "--out", str(folder / "evaluation.json"))
        bones = scored_on(folder) if bone_contact is None else bone_contact
        said = () if bones is None else (f"drive.bone_contact={str(bones).lower()}",)
        command = ("agents.play", str(folder), *said, *out)
        jobs.append(Job(folder, command))
    return jobs


def scored_on(folder: Path) -> bool | None:
    """Whether bones stopped where a policy was scored last; None if nothing says so."""
    path = folder / "evaluation.json"
    env = read_json(path).get("env", {}) if path.is_file() else {}
    return env.get("drive", {}).get("bone_contact")


def written(folder: Path, device: str) -> tuple[str, ...]:
    """Arguments for the same episodes in the same place."""
    row = read_json(folder / "results.json")["results"][0]
    episodes = ("--evaluation.episodes", str(row["episodes"]), "--evaluation.first-seed", str(row["first_seed"]))
    return (*episodes, "--device", device, "--out", str(folder))


def pid_arguments(folder: Path) -> list[str]:
    """The task, its settings and the controller's numbers, as far as they are not the defaults."""
    config = read_json(folder / "results.json")["config"]
    default = load_config(load_task(config["env_id"]).Config, {"control": "torque"}).model_dump(mode="json")
    settings = [f"{name}={json.dumps(value)}" for name, value in differences(config["env"], default)]
    arguments = [config["env_id"], *settings]
    for name, value in differences(config["design"], json.loads(json.dumps(asdict(Design())))):
        arguments += [f"--design.{name.replace('_', '-')}", *map(str, value if isinstance(value, list) else [value])]
    return arguments


def differences(recorded: Mapping[str, Any], default: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Dotted names and values of what is not the default's."""
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
