"""Scores of every environment: zero, random and briefly trained agents."""

from __future__ import annotations

import pytest

pytest.importorskip("stable_baselines3", reason="the scores need the extra train")
pytest.importorskip("pettingzoo", reason="the scores need the extra multi")

from benchmarks.learning import scores
from piavatar_envs.tasks import task_modules


def test_every_environment_is_scored():
    found = scores.every_environment()
    assert set(task_modules()) < set(found) and "sumo_v0" in found and len(found) == len(set(found))
    for env_id in found:
        config = scores.training_config(env_id, scores.Options(train_steps=5000, workers=3, fidelity="tiny"))
        assert (config.env_id, config.total_steps, config.num_workers) == (env_id, 5000, 3)
        assert config.env["physics"]["fidelity"] == "tiny"


@pytest.mark.parametrize("case", ["PIAvatar/Reach-v0", "sumo_v0"])
def test_rows_of_one_environment(case):
    options = scores.Options(ids=(case,), episodes=2, train_steps=600, workers=1, fidelity="tiny")
    rows = list(scores.cases(options))
    assert [row["agent"] for row in rows] == ["zero", "random", "trained"]
    assert {row["case"] for row in rows} == {case} and all(row["episodes"] == 2 for row in rows)
    assert rows[2]["trained_for_steps"] == 600 and rows[2]["training_s"] > 0.0
    assert rows[0]["return_mean"] != rows[1]["return_mean"] and all(row["failures"] == 0 for row in rows)
