"""Command lines: settings may stand anywhere among the options, and what is neither is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from agents import batch_training as batches
from agents import demo, play
from agents.command import read_options, script_hint
from agents.pid import score as score_pid
from agents.sb3 import train

#: Scripts that take settings, and what they want first.
SCRIPTS = {play: ["run"], train: ["run.yaml"], batches: ["run.yaml"], score_pid: ["PIAvatar/Stand-v0"], demo: []}
scripts = pytest.mark.parametrize(
    ("script", "first"), [pytest.param(*pair, id=pair[0].__name__.partition(".")[2]) for pair in SCRIPTS.items()]
)


@scripts
@pytest.mark.parametrize(
    "settings",
    [
        ["a=1", "b=-2", "c=x", "--device", "cuda", "--out", "x=y"],
        ["--device", "cuda", "--out", "x=y", "a=1", "b=-2", "c=x"],
        ["a=1", "--device", "cuda", "b=-2", "--out=x=y", "c=x"],
        ["--device", "cuda", "a=1", "b=-2", "--out", "x=y", "c=x"],
    ],
    ids=["before", "after", "around", "between"],
)
def test_settings_may_stand_anywhere(script, first, settings):
    options = read_options(script.Options, "x", [*first, *settings])
    assert options.settings == ("a=1", "b=-2", "c=x")
    assert options.device == "cuda" and options.out == Path("x=y")


@scripts
@pytest.mark.parametrize(
    "line", [["--nowhere", "a=1"], ["a=1", "--device", "cpu", "-x"], ["a=1", "--out", "b", "--no=1"]]
)
def test_options_that_there_are_not_are_refused(script, first, line, capsys):
    with pytest.raises(SystemExit) as ended:
        read_options(script.Options, "x", [*first, *line])
    said = capsys.readouterr()
    assert ended.value.code == 2 and "Unrecognized options" in said.out + said.err


CONFIGS = Path(__file__).resolve().parents[2] / "configs"
#: The script that a folder of configurations belongs to.
OWNERS = {"rsl_rl": "rsl_rl.train", "skrl": "skrl.train", "sb3": "sb3.train"}


@pytest.mark.parametrize("path", sorted(CONFIGS.rglob("*.yaml")), ids=lambda path: path.stem)
def test_files_of_other_scripts_are_known_wherever_they_lie(path, tmp_path):
    owner = OWNERS[path.parent.name]
    copy = tmp_path / "config.yaml"
    copy.write_bytes(path.read_bytes())
    for script in ("rsl_rl.train", "skrl.train", "sb3.train"):
        told = "" if script == owner else f" (this is a file for python -m agents.{owner})"
        assert script_hint(path, script) == script_hint(copy, script) == told
