"""Surveys of people: videos, page, key, and the count of votes."""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
import yaml

pytest.importorskip("optuna", reason="needs the extra fit")
pytest.importorskip("imageio_ffmpeg", reason="needs the extra render")

from agents.fit import survey
from tests.agents.test_fit import STUDY

QUIET = {"render": {"width": 64, "height": 64}, "episode_seconds": 0.07}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, device):
    """A survey of one question with three variants."""
    root = tmp_path_factory.mktemp("survey")
    file = root / "mass.yaml"
    file.write_text(yaml.safe_dump({**STUDY, "env": STUDY["env"] | QUIET, "question": "Which is <heavy>?"}))
    survey.main([str(file), "--variants", "3", "--out", str(root / "out"), "--device", device])
    return root / "out"


def test_every_variant_has_a_video_whose_name_hides_its_value(folder):
    import imageio.v3 as iio

    with (folder / "key.csv").open(encoding="utf-8", newline="") as file:
        key = list(csv.DictReader(file))
    assert [float(row["value"]) for row in key] == pytest.approx([1.0, 8.0**0.5, 8.0])
    assert {row["parameter"] for row in key} == {"scene.props.0.mass"}
    assert sorted(row["video"] for row in key) == ["mass_0.mp4", "mass_1.mp4", "mass_2.mp4"]
    frames = [iio.imread(folder / row["video"]) for row in key]
    assert all(len(video) == 3 and video.std() > 5.0 for video in frames)
    assert not np.array_equal(frames[0], frames[2])


def test_the_page_has_the_questions_and_no_values(folder):
    page = (folder / "index.html").read_text(encoding="utf-8")
    (question,) = json.loads(re.search(r"const questions = (.*);", page)[1])
    assert question == {
        "name": "mass",
        "text": "Which is <heavy>?",
        "videos": ["mass_0.mp4", "mass_1.mp4", "mass_2.mp4"],
    }
    assert "<heavy>" not in page and "2.82" not in page and "$" not in page.replace("${", "")


def test_votes_are_counted_by_the_key(folder, tmp_path):
    files = []
    for participant, chosen in (("a", "mass_0.mp4"), ("b", "mass_2.mp4"), ("c", "mass_0.mp4")):
        files.append(tmp_path / f"votes_{participant}.csv")
        text = f'"participant","question","video","shown","seconds"\n"{participant}","mass","{chosen}","x","3.0"\n'
        files[-1].write_text(text)
    survey.main(["--out", str(folder), "--votes", *map(str, files)])
    with (folder / "counts.csv").open(encoding="utf-8", newline="") as file:
        votes = {row["video"]: int(row["votes"]) for row in csv.DictReader(file)}
    assert votes == {"mass_0.mp4": 2, "mass_1.mp4": 0, "mass_2.mp4": 1}
    files[0].write_text(files[0].read_text().replace("mass_0", "other_0"))
    with pytest.raises(SystemExit, match=r"there is no video 'other_0\.mp4'"):
        survey.main(["--out", str(folder), "--votes", str(files[0])])


def test_a_question_has_one_parameter(tmp_path):
    file = tmp_path / "two.yaml"
    more = {"physics.friction": {"low": 0.1, "high": 1.0}}
    file.write_text(yaml.safe_dump({**STUDY, "parameters": STUDY["parameters"] | more}))
    with pytest.raises(SystemExit, match="two has 2 parameters"):
        survey.main([str(file), "--out", str(tmp_path / "out")])
