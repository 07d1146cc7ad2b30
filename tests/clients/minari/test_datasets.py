"""The datasets of agents.datasets in Minari's own hands, and the baselines that learn from them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import minari
import numpy as np
import pytest

from agents.datasets import __main__ as datasets
from agents.datasets import baselines

PAGE = Path(__file__).resolve().parents[3] / "docs" / "datasets.md"
SETTINGS = ["fidelity=tiny", "episode_seconds=0.4"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Record datasets of Reach of two levels."""
    folder = tmp_path_factory.mktemp("datasets")
    for level in ("expert", "medium"):
        datasets.main(["PIAvatar/Reach-v0", *SETTINGS, "--level", level, "--episodes", "4", "--out", str(folder)])
    return folder


def test_dataset_is_loaded_and_its_environment_rebuilt(folder, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    assert {"piavatar/reach/expert-v0", "piavatar/reach/medium-v0"} <= set(minari.list_local_datasets())
    dataset = minari.load_dataset("piavatar/reach/medium-v0")
    assert dataset.total_episodes == 4 and dataset.total_steps == 48
    assert "noise" in dataset.storage.metadata["algorithm_name"]
    env = dataset.recover_environment()
    assert env.unwrapped.config.physics.fidelity == "tiny"
    episode = dataset[0]
    assert episode.truncations.tolist() == [False] * 11 + [True] and not episode.terminations.any()
    observation, _ = env.reset(seed=int(next(dataset.storage.get_episode_metadata([0]))["seed"]))
    np.testing.assert_array_equal(observation, episode.observations[0])
    for action, seen in zip(episode.actions, episode.observations[1:], strict=True):
        assert env.action_space.contains(action)
        np.testing.assert_array_equal(env.step(action)[0], seen)
    env.close()


def test_python_of_the_page_runs(folder, monkeypatch, capsys):
    monkeypatch.setenv("MINARI_DATASETS_PATH", "replaced by the page")
    (block,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    exec(compile(block.replace("runs/datasets", str(folder)).replace("/walk/", "/reach/"), "datasets.md", "exec"), {})
    assert capsys.readouterr().out.count("(13, 280)") == 4


def test_baselines_are_scored_in_the_same_episodes(folder, tmp_path, capsys):
    out = tmp_path / "scores.json"
    options = ["--updates", "20", "--evaluation.episodes", "2", "--learn-device", "cpu", "--out", str(out)]
    baselines.main([str(folder), "piavatar/reach/medium-v0", *options])
    said = capsys.readouterr().out
    written = json.loads(out.read_text())
    assert [row["case"] for row in written["results"]] == ["random", "medium", "expert", "bc", "iql"]
    assert {row["episodes"] for row in written["results"]} == {2} and "normalized" in said
    assert written["normalized"]["random"] == 0.0 and written["normalized"]["expert"] == pytest.approx(100.0)
    assert written["dataset_steps"] == 48 and "noise" in written["behaviour"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["piavatar/reach/best-v0"], "piavatar/reach/expert-v0"),
        (["piavatar/reach/expert-v0", "--updates", "0"], "updates"),
        (["piavatar/reach/expert-v0", "--learners", "dqn"], "bc, iql"),
    ],
)
def test_what_there_is_not_is_refused(folder, arguments, named):
    with pytest.raises(SystemExit, match=named):
        baselines.main([str(folder), *arguments])
