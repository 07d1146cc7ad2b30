"""The benchmarks' runner: statistics against theory, files that are whole, and an honest account of the run."""

from __future__ import annotations

import json
import math
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from agents import files
from agents.intervals import mean_and_interval
from benchmarks import runner


def test_interval_of_a_known_sample():
    # mean 3, s^2 = 2.5, n = 5: half width t(0.975, 4) s / sqrt(5) with t = 2.776445 from any table
    estimate = mean_and_interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert estimate.mean == pytest.approx(3.0)
    assert estimate.half_width == pytest.approx(2.776445 * math.sqrt(2.5 / 5), rel=1e-6)
    assert estimate.high - estimate.low == pytest.approx(2 * estimate.half_width)
    assert mean_and_interval([2.0]) == (2.0, math.inf)
    for wrong, words in (([], "shape"), ([[1.0]], "shape"), ([1.0, math.nan], r"values\[1\]=nan")):
        with pytest.raises(ValueError, match=words):
            mean_and_interval(wrong)


@dataclass(frozen=True)
class Options(runner.Options):
    count: int = 2
    fail_at: int | None = None


def cases(options: Options):
    for index in range(options.count):
        if index == options.fail_at:
            raise RuntimeError("stopped")
        yield {"case": f"case {index}", "value_m": np.float32(0.5), "count": np.int64(index), "spread": (1.0, None)}


def test_the_file_holds_the_promised_schema(tmp_path):
    out = tmp_path / "deep" / "result.json"
    report = runner.main("example", cases, Options, ["--out", str(out), "--count", "3"])
    read = json.loads(out.read_text())
    assert read == report
    assert {"benchmark", "commit", "device", "versions", "date", "results"} <= set(read)
    assert read["benchmark"] == "example" and read["complete"] is True
    assert read["options"] == {"count": 3, "fail_at": None}
    assert read["results"][1] == {"case": "case 1", "value_m": 0.5, "count": 1, "spread": [1.0, None]}
    assert read["device"]["alias"] == "cpu" and read["device"]["name"] and read["device"]["cpu_cores"] >= 1
    assert read["versions"]["numpy"] == np.__version__ and read["versions"]["warp-lang"]
    assert [path.name for path in out.parent.iterdir()] == ["result.json"]  # no temporary file stays


def test_a_stopped_run_keeps_what_it_finished(tmp_path):
    out = tmp_path / "result.json"
    with pytest.raises(RuntimeError, match="stopped"):
        runner.main("example", cases, Options, ["--out", str(out), "--fail-at", "1"])
    read = json.loads(out.read_text())
    assert read["complete"] is False and [row["case"] for row in read["results"]] == ["case 0"]


def test_without_a_file_rows_go_to_the_terminal(capsys):
    runner.main("example", cases, Options, [])
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    assert [json.loads(line)["case"] for line in lines] == ["case 0", "case 1"]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ({"value": 1}, "no 'case'"),
        ({"case": "a", "value": math.nan}, "a: value is nan"),
        ({"case": "a", "deep": {"list": [1.0, math.inf]}}, r"a: deep: list\[1\] is inf"),
        ({"case": "a", "value": object()}, "a: value is of type object"),
    ],
)
def test_a_bad_row_is_refused(row, words):
    with pytest.raises(ValueError, match=words):
        runner.main("example", lambda options: [row], runner.Options, [])


def test_an_unknown_device_is_refused():
    with pytest.raises(ValueError, match="no device 'cuda:99'"):
        files.describe_run("example", "cuda:99")


def test_writing_is_atomic(tmp_path, monkeypatch):
    path = tmp_path / "result.json"
    files.write_json(path, {"old": 1})
    monkeypatch.setattr(files.os, "replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        files.write_json(path, {"new": 2})
    assert json.loads(path.read_text()) == {"old": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_commit_and_whether_the_checkout_differs(tmp_path, monkeypatch):
    def git(*command: str) -> None:
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", *identity, *command], cwd=tmp_path, check=True, capture_output=True)

    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    monkeypatch.delenv("PIAVATAR_COMMIT", raising=False)
    assert files.git_commit(tmp_path) == ("unknown", None)
    monkeypatch.setenv("PIAVATAR_COMMIT", "abc")
    assert files.git_commit(tmp_path) == ("abc", None)
    assert files.git_commit() == ("abc", None)  # also where another history came along with the copy
    monkeypatch.delenv("PIAVATAR_COMMIT")
    git("init", "--quiet")
    (tmp_path / "code.py").write_text("a = 1\n")
    git("add", "code.py")
    git("commit", "--quiet", "--message", "first", "--no-verify")
    commit, dirty = files.git_commit(tmp_path)
    assert len(commit) == 40 and dirty is False
    results = Path(tmp_path, "benchmarks", "results")
    results.mkdir(parents=True)
    (results / "new.json").write_text("{}")
    assert files.git_commit(tmp_path) == (commit, False)
    (tmp_path / "code.py").write_text("a = 2\n")
    assert files.git_commit(tmp_path) == (commit, True)
