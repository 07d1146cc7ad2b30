"""All published trainings by one command, which goes on where it was stopped."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("stable_baselines3", reason="needs the extra train")

from scripts import train_all

SMALL = (
    "env.fidelity=tiny", "env.episode_seconds=0.3", "total_steps=64", "num_workers=4", "evaluation.episodes=2",
    "ppo.rollout_steps=8", "ppo.batch_size=16", "ppo.epochs=1",
)  # fmt: skip


@pytest.mark.parametrize("minutes, over", [(0.0, 0), (None, 2)])
def test_seeds_train_and_what_is_over_is_left_alone(minutes, over, tmp_path, capsys, device):
    gpus = () if device == "cpu" else ("0",)
    for _ in range(2):
        assert train_all.main(("stand_sb3",), SMALL, seeds=2, gpus=gpus, each=2, minutes=minutes, runs=tmp_path) == 0
        found = sorted(tmp_path.glob("*/results.json"))
        assert [path.parent.name for path in found] == [f"stand_sb3_{seed}" for seed in range(over)]
        dates = [json.loads(path.read_text())["date"] for path in found]
        assert [json.loads(path.read_text())["seed"] for path in found] == list(range(over))
    assert dates == [json.loads(path.read_text())["date"] for path in found]
    assert capsys.readouterr().err.count("the same command goes on") == 2 * (2 - over)


def test_a_training_that_is_stopped_goes_on(tmp_path, monkeypatch, capsys):
    """Its time is up when it has a checkpoint; then it has all that it needs."""
    long = (*SMALL[:2], "total_steps=640", *SMALL[3:], "checkpoint_every=32")
    monkeypatch.setattr(train_all.time, "monotonic", lambda: float((tmp_path / "stand_sb3_0/checkpoint.pt").exists()))
    assert train_all.main(("stand_sb3",), long, seeds=1, minutes=1.0 / 60.0, runs=tmp_path) == 0
    assert "stopped" in capsys.readouterr().err and not list(tmp_path.glob("*/results.json"))
    monkeypatch.undo()
    assert train_all.main(("stand_sb3",), long, seeds=1, runs=tmp_path) == 0
    curve = (tmp_path / "stand_sb3_0" / "curve.csv").read_text().split()[1:]
    steps = [int(row.split(",")[0]) for row in curve]
    assert steps == sorted(steps) and 600 < steps[-1] <= 640
    assert (tmp_path / "stand_sb3_0" / "log.txt").read_text().count("| 0/640 [") == 1, "it began twice"


@pytest.mark.parametrize("stem", ["reach_sb3", "stand_rsl"])
def test_scores_of_less_are_not_the_end_and_of_other_settings_refused(stem, tmp_path):
    if stem.endswith("rsl"):
        pytest.importorskip("rsl_rl", reason="needs the extra rsl")
    (path,) = train_all.find((stem,))
    length = "iterations" if stem.endswith("rsl") else "total_steps"
    job = train_all.Job(path, 0, tmp_path / f"{stem}_0")
    job.folder.mkdir()
    results = job.folder / "results.json"
    had = train_all.LOADERS[path.parent.name](path, {"seed": 0, length: 200}).model_dump(mode="json")
    results.write_text(json.dumps({"config": had}))
    assert job.is_over((f"{length}=200",)) and job.is_over((f"{length}=100", "checkpoint_every=7"))
    assert not job.is_over((f"{length}=201",)) and not job.is_over((f"{length}=200", "evaluation.episodes=3"))
    del had["env"]["physics"]["friction"]  # it knows nothing of it, and had the default
    results.write_text(json.dumps({"config": had}))
    assert job.is_over((f"{length}=200",))
    with pytest.raises(ValueError, match=r"is of a training with ppo\.epochs=\d+, now it is 77; .* --runs"):
        train_all.main((f"walk_{stem[-3:]}", stem), ("ppo.epochs=77", f"{length}=200"), seeds=1, runs=tmp_path)
    assert [folder.name for folder in tmp_path.iterdir()] == [f"{stem}_0"], "nothing was begun"
    results.write_text("{}")
    with pytest.raises(ValueError, match=rf"results\.json is of no training of {stem}"):
        job.is_over(())


def test_every_published_training_has_a_job_and_others_are_refused():
    files = {path for folder in train_all.SCRIPTS for path in (train_all.CONFIGS / folder).glob("*.yaml")}
    assert set(train_all.find(())) == files and len(files) > 10
    assert [path.stem for path in train_all.find(("walk_sb3", "stand_rsl", "walk_sb3"))] == ["walk_sb3", "stand_rsl"]
    with pytest.raises(ValueError, match=r"no configuration 'fly'.*stand_rsl"):
        train_all.main(("fly",))
    with pytest.raises(ValueError, match=r"seeds=0, each=3: both must be >= 1"):
        train_all.main((), seeds=0)
