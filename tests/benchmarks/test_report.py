"""The page of all results: every committed result is on it, as measured, with its commit and device."""

from __future__ import annotations

import json
import re

import pytest

from benchmarks import report

pytest.importorskip("matplotlib", reason="needs the extra train")


def test_every_result_is_on_the_page_with_commit_and_device(tmp_path):
    text = report.build(tmp_path).read_text(encoding="utf-8")
    assert "Not there" not in text
    for path in report.RESULTS.glob("*.json"):
        found = json.loads(path.read_text(encoding="utf-8"))
        assert f"| {found['commit'][:7]} |" in text and path.name in text
    for link in re.findall(r"\]\(([^)]+)\)", text):
        assert (tmp_path / link).is_file(), link


def test_numbers_are_those_of_the_files(tmp_path, monkeypatch):
    row = {"case": "Reach", "num_envs": 8, "refused": None, "env_steps_per_s": 1234.4, "ms_per_step": 6.48}
    row |= {"mb_per_env": 1.5, "particles": 300, "substeps": 15, "failed_envs": 2}
    about = {"commit": "0123456789", "device": {"name": "a | device"}, "date": "2026-01-02T03:04:05", "results": [row]}
    (tmp_path / "vector.json").write_text(json.dumps(about), encoding="utf-8")
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    text = report.build(tmp_path / "out").read_text(encoding="utf-8")
    assert "| Reach | 8 | 1,234 | 6.48 | 1.5 | 300 | 15 | 2 |" in text
    assert "(../vector.json): a | device, commit 0123456, 2026-01-02*" in text
    # the other results are named, not left out in silence
    assert "Not there: steps.json" in text and "physics.json" in text
