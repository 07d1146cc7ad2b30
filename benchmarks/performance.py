"""The tables of ``PERFORMANCE.md``, from the JSON files in ``results/``.

``python -m benchmarks.performance`` writes what stands between ``<!-- table: NAME -->`` and ``<!-- end -->`` anew, and
refuses if a file that a table needs is missing or was not finished. ``--only`` names the tables that are written, the
others stay as they are. ``--check`` changes nothing: it ends with an error if something would change.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks import profile
from benchmarks.runner import ROOT

DOCUMENT = ROOT / "benchmarks" / "PERFORMANCE.md"
RESULTS = ROOT / "benchmarks" / "results"
MARKED = re.compile(r"(<!-- table: (?P<name>\w+) -->\n)(?P<body>.*?)(<!-- end -->)", re.DOTALL)
MOST_ROWS = 14  # of a table of kernels
PROFILE, PICTURE = "profile_reach.json", "profile_reach.png"
#: Kernels of the joints of bodies under torques, which project and stop bones, and of the Material Point Method.
JOINTS = frozenset({"attach_flesh", "sum_pairs", "build_mass", "act", "take_over", "begin_substep"})
MATTER = frozenset(
    {"substep_in_small_room", "substep_in_large_room", "nodes_in_small_room", "nodes_in_large_room", "forget_speeds"}
    | {"particles_to_grid", "runs_to_grid", "singles_to_grid", "update_grid", "find_facing", "solve_contact"}
    | {"grid_to_particles", "mark_particles", "forget_blocks", "free_slots", "freeze"}
    | {"carry_on", "begin_turns", "sweep_sums", "grid_to_momenta", "momenta_to_grid"}
)
Report = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """A table of the document.

    Attributes:
        file: what it is made from, in the folder of results.
        command: that makes the file.
        write: from the report to lines of Markdown.
    """

    file: str
    command: str
    write: Callable[[Report], list[str]]


def grid(header: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Lines of a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(str(cell) for cell in line) + " |" for line in lines]


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits and without an exponent; a dash for what there is not."""
    if value is None:
        return "-"
    if value == 0.0:
        return "0"
    text = f"{float(f'{value:.{digits}g}'):,.10f}".rstrip("0").rstrip(".")
    return text if abs(value) >= 1e-4 else f"{value:.{digits}g}"


def origin(report: Report) -> list[str]:
    """One line: device, commit, date."""
    device, dirty = report["device"], ", with changes" if report["dirty"] else ""
    name = device["name"] if device.get("kind") != "cpu" else f"{device['name']}, {device['cpu_cores']} cores"
    return ["", f"{name}; commit `{report['commit'][:12]}`{dirty}; {report['date'][:10]}.", ""]


def substep_table(report: Report) -> list[str]:
    """Milliseconds a substep beside bound, expectation and others, and memory."""
    rows = []
    for row in report["results"]:
        time, roof, rebuilt = row["ms_per_substep"], row["roofline"], row["rebuilt_ms"]
        rows.append(
            [
                row["case"] if not row["failed"] else f"{row['case']} failed: {row['failed']}",
                number(time),
                number(row["ms_per_substep_float"]),
                number(row["ms_per_substep_full_drive"]),
                f"{number(roof['bound_ms'])} ({roof['bound_by']})",
                number(row["expected_ms"]),
                number(rebuilt),
                number(row["paper_ms"]),
                number(rebuilt / time, 2) if rebuilt and time else "-",
                f"{number(row['memory_gb'])} / {number(row['paper_memory_gb'])}",
            ]
        )
    header = [
        "case",
        "ms a substep",
        "floating-point sums",
        "drive every substep",
        "bound (by)",
        "expected",
        "paper's loop, same card",
        "paper, RTX 4090",
        "times faster than its loop",
        "memory / paper's [GB]",
    ]
    return origin(report) + grid(header, rows)


def roofline_table(report: Report) -> list[str]:
    """What a substep must do, and the least time of it."""
    header = ["case", "cells", "nodes (shared)", "4^3 blocks", "MB", "MFLOP", "node additions", "launches"]
    header += [f"{kind} [us]" for kind in ("memory", "arithmetic", "additions", "launch")]
    rows = []
    for row in report["results"]:
        roof = row["roofline"]
        counts = [f"{roof[key]:,}" for key in ("cells", "nodes", "blocks")]
        counts[1] += f" ({roof['shared_nodes']:,})"
        work = [number(roof["bytes"] / 1e6), number(roof["flop"] / 1e6), f"{roof['additions']:,}"]
        times = [number(roof[f"{kind}_us"]) for kind in ("memory", "arithmetic", "additions", "launch")]
        rows.append([row["case"], *counts, *work, number(roof["launches"]), *times])
    return origin(report) + grid(header, rows)


def stages_table(report: Report) -> list[str]:
    """Microseconds a substep of the kernels that take longest, a column a case."""
    cases = [row["case"] for row in report["results"]]
    most: dict[str, float] = {}
    for row in report["results"]:
        for kernel, time in row["stages_ms"].items():
            most[kernel] = max(most.get(kernel, 0.0), time / max(1e-12, row["stages_sum_ms"]))
    kernels = sorted(most, key=lambda kernel: -most[kernel])
    shown, rest = kernels[:MOST_ROWS], kernels[MOST_ROWS:]
    rows: list[list[str]] = []
    for kernel in shown:
        times = [row["stages_ms"].get(kernel) for row in report["results"]]
        rows.append([f"`{kernel}`", *(number(None if t is None else 1e3 * t) for t in times)])
    others = [sum(row["stages_ms"].get(kernel, 0.0) for kernel in rest) for row in report["results"]]
    rows.append([f"{len(rest)} others", *(number(1e3 * time) for time in others)])
    rows.append(["sum of the kernels", *(number(1e3 * row["stages_sum_ms"]) for row in report["results"])])
    whole = [row["ms_per_substep"] for row in report["results"]]
    rows.append(["captured program", *(number(None if t is None else 1e3 * t) for t in whole)])
    return origin(report) + grid(["kernel [us a substep]", *cases], rows)


def vector_table(report: Report) -> list[str]:
    """Speeds and memory of batches."""
    header = [
        "world",
        "environments",
        "env-steps/s",
        "step only",
        "with copies",
        "particle-substeps/s",
        "MB an env",
        "ms a step",
        "failed",
    ]
    rows = []
    for row in report["results"]:
        if row["case"] == "cpu_scaling":
            continue
        if row["refused"]:
            rows.append([row["case"], row["num_envs"], f"refused: {row['refused']}", *[""] * (len(header) - 3)])
            continue
        speeds = [number(row[key]) for key in ("env_steps_per_s", "step_only", "with_autoreset")]
        rest = [f"{row['particle_substeps_per_s']:.3g}", number(row["mb_per_env"]), number(row["ms_per_step"])]
        rows.append([row["case"], row["num_envs"], *speeds, *rest, row["failed_envs"]])
    lines = origin(report) + grid(header, rows)
    for row in report["results"]:
        if row["case"] == "cpu_scaling":
            low, high = row["speed_up_range"]
            lines += [
                "",
                f"Two threads against one, {row['num_envs']} environments of {row['world']}: "
                f"{number(row['speed_up'])} times as fast ({number(low)} to {number(high)}).",
            ]
    return lines


def soak_table(report: Report) -> list[str]:
    """Verdict of the long run."""
    (verdict,) = (row for row in report["results"] if row["case"] == "verdict")
    rows = []
    names = {
        "device_mb": "memory of the device [MB]",
        "host_mb": "memory of the process [MB]",
        "ms_per_step": "time of a step [ms; growth as a share]",
    }
    for key, name in names.items():
        if key not in verdict:
            continue
        growth = verdict[f"{key}_growth"]
        told = "-" if growth is None else f"{number(growth[0])} ({number(growth[1])} to {number(growth[2])})"
        rows.append([name, number(verdict[key], 4), told, number(verdict[f"{key}_limit"]), verdict[f"{key}_verdict"]])
    options = report["options"]
    header = ["", "median", "growth over the run (95 %)", "counts as flat below", "verdict"]
    told = (
        f"{options['world']}, {options['num_envs']} environments, {verdict['steps']:,} steps: **{verdict['verdict']}**"
    )
    return [*origin(report), f"{told}; {verdict['failed_envs']} episodes ended in a failure.", "", *grid(header, rows)]


def profile_table(report: Report) -> list[str]:
    """Kernels of a step and what they reach."""
    (step,) = (row for row in report["results"] if row["case"] == profile.STEP)
    kernels = [row for row in report["results"] if row["case"] != profile.STEP]
    rows = []
    for row in kernels[:MOST_ROWS]:
        share = row["share_of_h200_bandwidth"]
        rows.append(
            [
                f"`{row['case']}`",
                number(row["ms_per_step"]),
                f"{100 * row['share']:.1f} %",
                "-" if row["launches_per_step"] is None else row["launches_per_step"],
                number(row["gb_per_s"]),
                "-" if share is None else f"{100 * share:.2g} %",
                "-" if row["additions_per_s"] is None else f"{row['additions_per_s']:.3g}",
            ]
        )
    header = ["kernel", "ms a step", "share", "launches", "GB/s", "of an H200's bandwidth", "node additions/s"]
    told = (
        f"{step['world']}, {step['num_envs']} environments: captured step {number(step['ms_per_step'])} ms, "
        f"{step['launches_per_step']} launches, kernels one by one {number(step['kernels_sum_ms'])} ms."
    )
    return [*origin(report), told, "", *grid(header, rows)]


def pictured_profile_table(report: Report) -> list[str]:
    """:func:`profile_table` with its picture."""
    return [*profile_table(report), "", f"![Time of the kernels](results/{PICTURE})"]


def joints_and_matter(report: Report) -> tuple[float, float]:
    """Time of the joints and of the Material Point Method in a profiled step [ms]."""
    ms = {row["case"]: row["ms_per_step"] for row in report["results"]}
    joints, matter = (sum(ms[name] for name in ms if name in names) for names in (JOINTS, MATTER))
    return joints, matter


def torque_profile_table(report: Report) -> list[str]:
    """:func:`profile_table`, and what the joints take beside the Material Point Method."""
    (firm,) = (row["ms_per_step"] for row in report["results"] if row["case"] == "put_in_place")
    told = f"{share_of_joints(report)}; putting firm particles in their places, once a step, {number(firm)} ms."
    return [*profile_table(report), "", told]


def share_of_joints(report: Report) -> str:
    """What the joints take beside the Material Point Method, in words."""
    joints, matter = joints_and_matter(report)
    share = f"{joints / matter:.3f} of the {number(matter)} ms of the Material Point Method"
    return f"The joints take {number(joints)} ms, {share}"


def projection_table(report: Report) -> list[str]:
    """The projection alone, of a profile with bones that do not stop at surfaces."""
    (act,) = (row["ms_per_step"] for row in report["results"] if row["case"] == "act")
    return ["", f"{share_of_joints(report)}: that is the projection alone, `act` {number(act)} ms."]


_SUBSTEP = ("substep.json", "python -m benchmarks.substep --device cuda")
TABLES: dict[str, Table] = {
    "roofline": Table(*_SUBSTEP, roofline_table),
    "substep": Table(*_SUBSTEP, substep_table),
    "stages": Table(*_SUBSTEP, stages_table),
    "vector": Table("vector.json", "python -m benchmarks.vector --device cuda", vector_table),
    "vector_cpu": Table("vector_cpu.json", "python -m benchmarks.vector --device cpu", vector_table),
    "profile_reach": Table(PROFILE, "python -m benchmarks.profile --device cuda", pictured_profile_table),
    "profile_stand": Table(
        "profile_stand.json",
        "python -m benchmarks.profile --device cuda --case PIAvatar/Stand-v0 --num-envs 2048",
        torque_profile_table,
    ),
    "profile_projection": Table(
        "profile_projection.json",
        "python -m benchmarks.profile --device cuda --case PIAvatar/Stand-v0 --num-envs 2048 "
        "--settings drive.bone_contact=false",
        projection_table,
    ),
    "soak": Table("soak.json", "python -m benchmarks.soak --device cuda", soak_table),
}


def fill(text: str, results: Path = RESULTS, only: Sequence[str] = ()) -> str:
    """``text`` with its marked tables written anew, or those of the names ``only``.

    Raises:
        FileNotFoundError: files that tables need, all at once, and the commands that make them.
        ValueError: a mark or a name without a table, or a file whose run was not finished.
    """
    names = [match["name"] for match in MARKED.finditer(text)]
    unknown = sorted({*names, *only} - set(TABLES))
    if unknown or not names:
        raise ValueError(f"marks {unknown or 'of tables'} are not known or not there; use {', '.join(TABLES)}")
    names = [name for name in names if not only or name in only]
    missing = sorted({TABLES[name].file for name in names if not (results / TABLES[name].file).exists()})
    if missing:
        commands = {TABLES[name].file: TABLES[name].command for name in names}
        folder = results.relative_to(ROOT) if results.is_relative_to(ROOT) else results
        how = "; ".join(f"{commands[file]} --out {folder / file}" for file in missing)
        raise FileNotFoundError(f"no {', '.join(missing)} in {folder}; make them: {how}")

    def table(match: re.Match[str]) -> str:
        if match["name"] not in names:
            return match[0]
        report = json.loads((results / TABLES[match["name"]].file).read_text(encoding="utf-8"))
        if not report["complete"]:
            raise ValueError(f"{TABLES[match['name']].file} is of a run that was stopped; run it again to the end")
        return match[1] + "\n".join(TABLES[match["name"]].write(report)) + "\n\n" + match[4]

    return MARKED.sub(table, text)


def main(only: tuple[str, ...] = (), check: bool = False) -> None:
    """Fill the tables of PERFORMANCE.md, and draw the profile.

    Args:
        only: names of the tables to fill; all if not given.
        check: change nothing; end with an error if something would change.
    """
    before = DOCUMENT.read_text(encoding="utf-8")
    try:
        after = fill(before, only=only)
    except (FileNotFoundError, ValueError) as error:
        sys.exit(f"error: {error}")
    if check and after != before:
        sys.exit(f"error: tables of {DOCUMENT.name} are not those of the results; run python -m benchmarks.performance")
    if check:
        return
    DOCUMENT.write_text(after, encoding="utf-8")
    if not only or "profile_reach" in only:
        profile.draw(json.loads((RESULTS / PROFILE).read_text(encoding="utf-8"))["results"], RESULTS / PICTURE)


if __name__ == "__main__":
    tyro.cli(main, prog="python -m benchmarks.performance")
