"""Survey of people: ``python -m agents.fit.survey CONFIG.yaml ... --out FOLDER`` renders variants and a page to choose.

Each configuration is a question with one parameter. Its variants are values evenly spaced on the parameter's scale; a
participant opens ``index.html``, sees them in an order of their own, and saves a CSV file of what was chosen. Names of
videos say nothing of values, which are in ``key.csv``. ``--votes FILE ...`` counts such files with that key.
"""

from __future__ import annotations

import csv
import html
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from agents.command import one_line_errors, read_options
from agents.config import check_imports
from agents.files import write_atomically
from agents.fit.config import FitConfig, load_fit
from agents.fit.rollout import Player
from agents.fit.space import Space
from piavatar_envs.config import ConfigError, parse_assignments, read_yaml
from piavatar_envs.core.writing import check_writable
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.render import write_video

PAGE, KEY, COUNTS = "index.html", "key.csv", "counts.csv"
_KEY_COLUMNS = ("question", "text", "video", "parameter", "value")
_TEMPLATE = Template("""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>Survey</title>
<style>
body { font-family: sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
#videos { display: grid; grid-template-columns: repeat(3, 1fr); gap: 1rem; }
#videos label { border: 3px solid #ddd; padding: .5rem; cursor: pointer; text-align: center; }
#videos label:has(input:checked) { border-color: #06c; }
video { width: 100%; }
button { font-size: 1.1rem; margin: 1rem 0; padding: .5rem 1rem; }
</style>
<h1 id="text">Survey</h1>
<p id="start">Each question shows $count videos. Choose the one that answers it best. There is no time limit.
<br><br>Your name or number: <input id="participant"></p>
<div id="videos"></div>
<button id="next">Begin</button>
<p><small id="place"></small></p>
<script>
const questions = $questions;
const rows = [["participant", "question", "video", "shown", "seconds"]];
let index = -1, shown = [], begun = 0;
const find = (id) => document.getElementById(id);
function shuffled(list) {
  const copy = list.slice();
  for (let i = copy.length - 1; i > 0; i--) {
    const j = Math.floor(Math.random() * (i + 1));
    [copy[i], copy[j]] = [copy[j], copy[i]];
  }
  return copy;
}
function show() {
  const question = questions[index];
  shown = shuffled(question.videos);
  find("text").textContent = question.text;
  find("place").textContent = `question $${index + 1} of $${questions.length}`;
  find("videos").innerHTML = shown.map((video, i) =>
    `<label><video src="$${video}" autoplay loop muted playsinline></video><br>` +
    `<input type="radio" name="choice" value="$${video}"> $${String.fromCharCode(65 + i)}</label>`).join("");
  find("next").textContent = "Next";
  begun = performance.now();
}
function save() {
  const cell = (value) => '"' + String(value).replaceAll('"', '""') + '"';
  const text = rows.map((row) => row.map(cell).join(",")).join("\\n") + "\\n";
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = `votes_$${find("participant").value.trim().replace(/\\W+/g, "_")}.csv`;
  link.click();
}
find("next").onclick = () => {
  const name = find("participant").value.trim();
  if (index >= questions.length) { save(); return; }
  if (index < 0 && !name) { alert("Please enter a name or a number."); return; }
  if (index >= 0) {
    const chosen = document.querySelector("input[name=choice]:checked");
    if (!chosen) { alert("Please choose a video."); return; }
    const seconds = ((performance.now() - begun) / 1000).toFixed(1);
    rows.push([name, questions[index].name, chosen.value, shown.join(" "), seconds]);
  }
  find("start").style.display = "none";
  index++;
  if (index < questions.length) { show(); return; }
  find("text").textContent = "Thank you";
  find("videos").innerHTML = "";
  find("place").textContent = "Please send the saved file to the person that asked you.";
  find("next").textContent = "Save again";
  save();
};
</script>
</html>
""")


@dataclass(frozen=True)
class Options:
    """Render the variants of questions and a page to choose from them, or count the votes."""

    #: YAML files of studies with one parameter each, a question each
    configs: tyro.conf.Positional[tuple[Path, ...]] = ()
    #: settings that override those of all files: --settings env.fidelity=coarse
    settings: tuple[str, ...] = ()
    #: folder of the survey
    out: Path = Path("runs") / "survey"
    #: variants of a question
    variants: int = 6
    #: times that a video is slower than life
    slow: float = 3.0
    #: CSV files of participants to count, with the key in the folder of the survey; nothing is rendered then
    votes: tuple[Path, ...] = ()
    #: where to simulate
    device: str = "cpu"
    #: module of a task of your own, which the studies may import
    imports: tuple[str, ...] = ()


def render(name: str, config: FitConfig, folder: Path, options: Options) -> list[dict[str, Any]]:
    """Render the variants of a question; returns the rows of the key.

    Args:
        name: of the question.
        config: of its study.
        folder: to write the videos to.
        options: of the command line.

    Raises:
        ConfigError: the study has several parameters.
    """
    space = Space(config)
    if len(space.axes) != 1:
        raise ConfigError(f"{name} has {len(space.axes)} parameters; a question of a survey varies one")
    control_dt, seconds = space.base.physics.control_dt, space.base.episode_seconds
    alone = config.model_copy(update={"repeats": 1})
    player = Player(alone, space, (), round(seconds / control_dt) + 1, options.device)
    variants = [space.values([share]) for share in np.linspace(0.0, 1.0, options.variants)]
    labels = np.random.default_rng(config.seed).permutation(options.variants)
    rows = []
    for index, values in enumerate(tqdm(variants, desc=name, unit="video")):
        ((_, episodes),) = player.play([values], [0])
        video = f"{name}_{labels[index]}.mp4"
        write_video(folder / video, episodes[0].pictures, 1.0 / (control_dt * options.slow))
        ((parameter, value),) = values.items()
        text = config.question or name
        rows.append({"question": name, "text": text, "video": video, "parameter": parameter, "value": value})
    player.close()
    return rows


def page(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the page of a survey from the rows of its key."""
    questions: dict[str, dict[str, Any]] = {}
    for row in rows:
        question = questions.setdefault(row["question"], {"name": row["question"], "text": row["text"], "videos": []})
        question["videos"].append(row["video"])
    for question in questions.values():
        question["videos"].sort()
    text = json.dumps(list(questions.values())).replace("<", "\\u003c")
    return _TEMPLATE.substitute(questions=text, count=html.escape(str(len(next(iter(questions.values()))["videos"]))))


def write_table(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV file."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


def read_table(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Read a CSV file.

    Raises:
        ConfigError: it cannot be read, or lacks columns.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, ValueError, csv.Error) as error:
        raise ConfigError(f"cannot read {path}: {error}") from None
    if not rows or not set(columns) <= set(rows[0]):
        raise ConfigError(f"{path} must be a CSV file with the columns {', '.join(columns)}")
    return rows


def count_votes(folder: Path, files: Sequence[Path]) -> list[dict[str, Any]]:
    """Count the votes of participants by the key of a survey; returns the rows of the key with their votes.

    Raises:
        ConfigError: a file cannot be read, or names a video that the key does not have.
    """
    key = read_table(folder / KEY, _KEY_COLUMNS)
    votes = {row["video"]: 0 for row in key}
    for path in files:
        for row in read_table(path, ("participant", "question", "video")):
            if row["video"] not in votes:
                raise ConfigError(f"{path}: there is no video {row['video']!r} in {folder / KEY}")
            votes[row["video"]] += 1
    return [{**row, "votes": votes[row["video"]]} for row in key]


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    options = read_options(Options, "fit.survey", args)
    quiet_warp()
    with one_line_errors(ValueError, ImportError, OSError):
        if options.votes:
            rows = count_votes(options.out, options.votes)
            write_table(options.out / COUNTS, (*_KEY_COLUMNS, "votes"), rows)
            print(f"wrote {options.out / COUNTS}: {sum(row['votes'] for row in rows)} votes")
            return
        if not options.configs or options.variants < 2 or options.slow <= 0.0:
            raise ConfigError("give at least one configuration, variants >= 2, and slow > 0")
        check_writable(options.out / PAGE)
        overrides = parse_assignments(options.settings)
        rows = []
        for path in options.configs:
            check_imports(read_yaml(path).get("env_id", ""), path, options.imports)
            # the videos need no judge
            config = load_fit(path, {"scorer": "measured", **overrides})
            options.out.mkdir(parents=True, exist_ok=True)
            rows += render(path.stem, config, options.out, options)
        write_table(options.out / KEY, _KEY_COLUMNS, rows)
        write_atomically(options.out / PAGE, lambda file: file.write(page(rows).encode()))
    print(f"in {options.out}: {PAGE}, {KEY}, {len(rows)} videos")


if __name__ == "__main__":
    main()
