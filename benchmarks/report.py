"""One page of all committed results: curves and tables, each with its commit, device and date.

python -m benchmarks.report --out build/report   # index.md and its pictures, readable as it is
make docs                                        # the same page as a part of the site

Everything is read from ``benchmarks/results``; nothing is simulated. A result that is not there is left out by name.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from benchmarks.paper import metrics as paper
from scripts.pages import markdown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RESULTS = Path(__file__).resolve().parent / "results"


@dataclass(frozen=True)
class Result:
    """A committed JSON file.

    Attributes:
        path: of the file.
        commit: of the code that was measured, shortened.
        device: in words.
        date: of the run.
        rows: as its benchmark wrote them.
        caption: one sentence, of figures.
    """

    path: Path
    commit: str
    device: str
    date: str
    rows: Sequence[dict[str, Any]]
    caption: str = ""

    @classmethod
    def read(cls, path: Path) -> Result:
        """Read a file of :mod:`benchmarks.runner`.

        Raises:
            OSError: there is no such file.
            ValueError: it is not JSON.
        """
        found = json.loads(path.read_text(encoding="utf-8"))
        device = found.get("device") or {}
        name = device if isinstance(device, str) else device.get("name", "?")
        rows = found.get("results")
        return cls(
            path,
            str(found.get("commit", "?"))[:7],
            name,
            str(found.get("date", "?"))[:10],
            rows if isinstance(rows, list) else [],
            found.get("caption", ""),
        )

    def source(self, folder: Path) -> str:
        """Return a line that says where the numbers come from, for a page in ``folder``."""
        link = f"[{self.path.name}]({os.path.relpath(self.path, folder)})"
        return f"*{link}: {self.device}, commit {self.commit}, {self.date}*"


class Page:
    """The page as it grows: paragraphs of Markdown in a folder with its pictures."""

    def __init__(self, folder: Path) -> None:
        """Begin a page in a folder, which is made."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.text, self.missing = folder, ["# Report"], list[str]()

    def add(self, *paragraphs: str) -> None:
        """Append paragraphs."""
        self.text += paragraphs

    def result(self, name: str) -> Result | None:
        """Return a result of ``benchmarks/results``; None, and noted as missing, if it is not there."""
        if (RESULTS / name).is_file():
            return Result.read(RESULTS / name)
        self.missing.append(name)
        return None

    def picture(self, path: Path, text: str) -> None:
        """Append a picture of the results or of :attr:`folder`."""
        if path.is_file():
            self.add(f"![{text}]({os.path.relpath(path, self.folder)})")
        else:
            self.missing.append(path.name)

    def table(self, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Append a table."""
        self.add(markdown.table(head, ([_cell(value) for value in row] for row in rows)))

    def write(self) -> Path:
        """Write ``index.md`` and return its path."""
        path = self.folder / "index.md"
        path.write_text("\n\n".join(self.text) + "\n", encoding="utf-8")
        return path


def _cell(value: Any) -> str:
    """Return a value as text: numbers with three digits."""
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _axes(height: float = 4.2) -> tuple[Figure, Axes]:
    """Return a figure and its axes; the height is in inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, height))
    axes = figure.add_subplot()
    axes.grid(alpha=0.3)
    return figure, axes


def speed(page: Page) -> None:
    """Append steps per second of batches."""
    found = page.result("vector.json")
    if found is None:
        return
    page.add("## Speed of batches", "Control steps of 1/30 s, all environments together, random actions at full scale.")
    rows = [row for row in found.rows if not row["refused"]]
    figure, axes = _axes()
    for case in dict.fromkeys(row["case"] for row in rows):
        own = [row for row in rows if row["case"] == case]
        axes.plot([row["num_envs"] for row in own], [row["env_steps_per_s"] for row in own], marker="o", label=case)
    axes.set(xscale="log", yscale="log", xlabel="environments", ylabel="environment steps per second")
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(page.folder / "speed.png", dpi=110, bbox_inches="tight")
    page.picture(page.folder / "speed.png", "Environment steps per second over the number of environments")
    columns = (
        "case",
        "num_envs",
        "env_steps_per_s",
        "ms_per_step",
        "mb_per_env",
        "particles",
        "substeps",
        "failed_envs",
    )
    page.table(columns, ([row[name] for name in columns] for row in rows))
    page.add(found.source(page.folder))


def large_bodies(page: Page) -> None:
    """Append the time of a substep over the number of particles, beside a plain MLS-MPM."""
    found = [page.result(name) for name in ("steps.json", "steps_fine.json", "steps_fine_four.json", "plain_mpm.json")]
    results = [one for one in found if one is not None]
    if not results:
        return
    page.add(
        "## Large bodies",
        "A substep of one environment, with contact, sensors and the controller, and of a plain MLS-MPM.",
    )
    figure, axes = _axes()
    for mine, label in ((True, "this suite"), (False, "plain MLS-MPM")):
        rows = [row for one in results if (one.path.name != "plain_mpm.json") == mine for row in one.rows]
        points = sorted((row["particles"], row["ms_per_substep"]) for row in rows)
        axes.plot(*zip(*points, strict=True), marker="o", linestyle="-" if mine else "--", label=label)
    axes.set(xscale="log", yscale="log", xlabel="particles", ylabel="ms per substep")
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(page.folder / "substep.png", dpi=110, bbox_inches="tight")
    page.picture(page.folder / "substep.png", "Time of a substep over the number of particles")
    page.table(
        ("case", "particles", "ms per substep"),
        ((row["case"], row["particles"], row["ms_per_substep"]) for one in results for row in one.rows),
    )
    page.add(*(one.source(page.folder) for one in results))


def pixels(page: Page) -> None:
    """Append pictures per second."""
    found = page.result("pixels.json")
    if found is None:
        return
    page.add("## Pictures as observations", "Steps with a picture of every environment, and the pictures alone.")
    columns = ("case", "num_envs", "size", "frames_per_s", "drawing_only", "without_pixels", "mb_per_env")
    page.table(columns, ([row[name] for name in columns] for row in found.rows))
    page.add(found.source(page.folder))


def tracking(page: Page) -> None:
    """Append the paper's Table 1, measured beside published."""
    found = page.result("tracking.json")
    if found is None:
        return
    page.add(
        "## The paper's Table 1",
        "Mean distance of the flesh from the commanded, skinned pose [mm] after random poses of 100 substeps each. The "
        "published bodies are SMPL-X, ours the embedded one.",
    )
    page.picture(RESULTS / "tracking_distance.png", "Distance from the commanded pose, ours and published")
    wanted = {"table": 1, "drive": "increment", "fidelity": "coarse", "disturbed": False}
    table = [row for row in found.rows if all(row[name] == value for name, value in wanted.items())]
    steps = sorted({row["substeps"] for row in table})
    published = {"published, with decoupling": paper.TABLE_1_MEAN_DISTANCE, "without": paper.TABLE_1_UNDECOUPLED}
    rows = [[name, *(1e3 * distance[step] for step in steps)] for name, distance in published.items()]
    for decoupling in ("split", "paper", "none"):
        own = {row["substeps"]: row["mean_distance_m"] for row in table if row["decoupling"] == decoupling}
        rows.append([f"`{decoupling}`", *(1e3 * own[step] for step in steps)])
    page.table(("", *(f"{step} substeps" for step in steps)), rows)
    page.add(found.source(page.folder))
    page.picture(RESULTS / "tracking_strain.png", "Strain after four poses with split, paper and none")


def physics(page: Page) -> None:
    """Append every quantity against theory."""
    _checked(page, "physics.json", "Physics against theory")
    for name, text in (
        ("elastodynamics", "Bars, a cantilever and impacts beside textbooks"),
        ("resolution", "Impacts at every fidelity"),
    ):
        other = page.result(f"{name}.json")
        if other is not None:
            page.picture(RESULTS / f"{name}.png", text)
            page.add(other.source(page.folder))


def garments(page: Page) -> None:
    """Append every quantity of garments, and its picture."""
    if _checked(page, "garments.json", "Garments"):
        page.picture(RESULTS / "garments.png", "Deviations over their tolerances")
    _checked(page, "garments_mpm.json", "Garments as shells in MPM")


def _checked(page: Page, name: str, heading: str) -> bool:
    """Append the table of a result whose rows have verdicts, and return whether it is there."""
    found = page.result(name)
    if found is None:
        return False
    held = sum(row["verdict"] == "holds" for row in found.rows)
    page.add(
        f"## {heading}",
        f"{held} of {len(found.rows)} quantities are within their tolerance; the others are listed as they are.",
    )
    columns = ("experiment", "quantity", "theory", "tolerance", "measured", "")
    names = ("title", "quantity", "theory", "limit", "value")
    verdicts = ("" if row["verdict"] == "holds" else "**fails**" for row in found.rows)
    rows = ((*(row[key] for key in names), verdict) for row, verdict in zip(found.rows, verdicts, strict=True))
    page.table(columns, rows)
    page.add(found.source(page.folder))
    return True


def robustness(page: Page) -> None:
    """Append failures under full-scale actions."""
    found = page.result("failures.json")
    if found is None:
        return
    page.add("## Failures", "Actions of -1 and 1 at random, each held for four steps.")
    columns = ("case", "env_steps", "failures_per_million", "limited_share_max")
    page.table(columns, ([row[name] for name in columns] for row in found.rows))
    page.add(found.source(page.folder))


def baselines(page: Page) -> None:
    """Append the scores of agents, with their intervals."""
    found = page.result("torque_baselines.json")
    if found is None:
        return
    page.add(
        "## Baselines",
        "Share of episodes that succeed at their end, with 95 % intervals. Walk's success is its distance.",
    )
    rows = sorted(found.rows, key=lambda row: (row["env_id"], row["success_at_end"]))
    figure, axes = _axes(0.22 * len(rows) + 1.0)
    names = [f"{row['env_id'].split('/')[1]}: {row['agent']}, {row['control']}" for row in rows]
    for index, row in enumerate(rows):
        low, high = row["success_at_end_interval"]
        axes.plot([100 * low, 100 * high], [index, index], color="#7fa8a5", linewidth=3)
        axes.plot(100 * row["success_at_end"], index, "o", color="#1b7f79", markersize=5)
    axes.set_yticks(range(len(rows)), names, fontsize=7)
    axes.set(xlabel="episodes that succeed at their end [%]", xlim=(-2, 102))
    figure.savefig(page.folder / "baselines.png", dpi=110, bbox_inches="tight")
    page.picture(page.folder / "baselines.png", "Scores of all agents")
    page.add(found.source(page.folder))


def figures(page: Page) -> None:
    """Append the figures after the paper's."""
    page.add(
        "## Figures after the paper's",
        "Drawn by `python -m benchmarks.paper.figures NAME`; the scenes repeat its experiments with other bodies.",
    )
    for path in sorted((RESULTS / "figures").glob("*.json")):
        found = Result.read(path)
        page.add(f"### {path.stem.replace('_', ' ')}")
        page.picture(path.with_suffix(".png"), path.stem)
        page.add(*([found.caption] if found.caption else []), found.source(page.folder))


def everything(page: Page) -> None:
    """Append a list of all files."""
    page.add("## All files")
    found = [
        Result.read(path) for path in sorted(RESULTS.rglob("*.json")) if path.parent in (RESULTS, RESULTS / "figures")
    ]
    page.table(
        ("file", "commit", "device", "date", "rows"),
        (
            (f"[{r.path.name}]({os.path.relpath(r.path, page.folder)})", r.commit, r.device, r.date, len(r.rows))
            for r in found
        ),
    )
    if page.missing:
        page.add(f"Not there: {', '.join(page.missing)}.")


SECTIONS: tuple[Callable[[Page], None], ...] = (
    speed,
    large_bodies,
    pixels,
    tracking,
    physics,
    garments,
    robustness,
    baselines,
    figures,
    everything,
)


def build(folder: Path) -> Path:
    """Write the page and its pictures into a folder, and return the path of ``index.md``.

    Raises:
        OSError: the folder cannot be written.
        ValueError: a result is not JSON.
    """
    page = Page(folder)
    page.add(
        "All results that are committed, as measured, also where they are bad. Each names the commit and the device; "
        "the commands are in `benchmarks/README.md`."
    )
    for section in SECTIONS:
        section(page)
    return page.write()


def main(out: Path = Path("build/report")) -> None:
    """Write the report.

    Args:
        out: folder to write to.
    """
    print(build(out))


if __name__ == "__main__":
    tyro.cli(main)
