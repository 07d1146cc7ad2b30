"""From configurations to committed agents: ``train_all`` trains them, ``keep_run`` copies, ``rescore`` scores again."""

from __future__ import annotations

import importlib
import io
import json
import shutil
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

torch = pytest.importorskip("torch", reason="needs the extra train")
pytest.importorskip("stable_baselines3", reason="needs the extra train")

from agents import score_random  # noqa: E402
from agents.pid import score as score_pid  # noqa: E402
from scripts import keep_run, rescore, train_all  # noqa: E402

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
CONFIG = {"env_id": "Walk-v0", "total_steps": 200, "env": {"physics": {"friction": 0.8}}, "observe": None}


def test_train_all_stops_in_time_goes_on_and_leaves_finished_trainings(tmp_path, monkeypatch, capsys):
    settings = (
        "env.fidelity=tiny", "env.episode_seconds=0.3", "total_steps=64", "num_workers=4", "evaluation.episodes=2",
        "ppo.rollout_steps=8", "ppo.batch_size=16", "ppo.epochs=1",
    )  # fmt: skip
    folder = tmp_path / "stand_sb3_0"

    def train(**options):
        assert train_all.main(("stand_sb3",), settings, seeds=1, runs=tmp_path, **options) == 0
        return capsys.readouterr().err.count("the same command goes on")

    assert train(minutes=0.0) == 1 and not folder.exists()
    with monkeypatch.context() as patch:  # a training run that does not end by itself, stopped once it has begun
        endless = [sys.executable, "-c", f"open({str(folder / 'begun')!r}, 'w'), __import__('time').sleep(600)"]
        patch.setattr(train_all.Job, "command", lambda *_: endless)
        patch.setattr(train_all.time, "monotonic", lambda: float((folder / "begun").exists()))
        assert train(minutes=1.0 / 60.0) == 1
    job = train_all.Job(train_all.find(("stand_sb3",))[0], 0, folder)
    assert "--resume" in job.command("cpu", settings) and not job.is_over(settings)
    assert train() == 0 and job.is_over(settings)
    date = json.loads((folder / "results.json").read_text())["date"]
    assert train() == 0 and json.loads((folder / "results.json").read_text())["date"] == date


@pytest.mark.parametrize(("stem", "length"), [("reach_sb3", "total_steps"), ("stand_rsl", "iterations")])
def test_train_all_continues_shorter_trainings_and_refuses_other_settings(stem, length, tmp_path):
    if stem.endswith("rsl"):
        pytest.importorskip("rsl_rl", reason="needs the extra rsl")
    (path,) = train_all.find((stem,))
    job = train_all.Job(path, 0, tmp_path / f"{stem}_0")
    job.folder.mkdir()
    results = job.folder / "results.json"
    had = train_all.LOADERS[path.parent.name](path, {"seed": 0, length: 200}).model_dump(mode="json")
    del had["env"]["physics"]["friction"]  # a setting that is not recorded had its default
    results.write_text(json.dumps({"config": had}))
    assert job.is_over((f"{length}=200",)) and job.is_over((f"{length}=100", "checkpoint_every=7"))
    assert not job.is_over((f"{length}=201",)) and not job.is_over((f"{length}=200", "evaluation.episodes=3"))
    with pytest.raises(ValueError, match=r"ppo\.epochs=\d+.*77.*--runs"):
        train_all.main((f"walk_{stem[-3:]}", stem), ("ppo.epochs=77", f"{length}=200"), seeds=1, runs=tmp_path)
    assert [folder.name for folder in tmp_path.iterdir()] == [job.folder.name]  # no training was started
    results.write_text("{}")
    with pytest.raises(ValueError, match=r"results\.json"):
        job.is_over(())


def test_train_all_knows_every_configuration():
    files = {path for folder in train_all.SCRIPTS for path in (train_all.CONFIGS / folder).glob("*.yaml")}
    assert set(train_all.find(())) == files and len(files) > 10
    assert [path.stem for path in train_all.find(("walk_sb3", "stand_rsl", "walk_sb3"))] == ["walk_sb3", "stand_rsl"]
    with pytest.raises(ValueError, match=r"'fly'.*stand_rsl"):
        train_all.main(("fly",))
    with pytest.raises(ValueError, match="seeds=0"):
        train_all.main((), seeds=0)


def make_run(folder: Path, value: float) -> Path:
    """Write a finished training run whose policy returns ``value``."""
    folder.mkdir(parents=True)
    rows = [{"case": "zero", "return_mean": 1000.0}, {"case": "trained", "return_mean": value}]
    (folder / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    (folder / "results.json").write_text(json.dumps({"benchmark": "sb3.train", "config": CONFIG, "results": rows}))
    held = io.BytesIO()
    torch.save({"action_net.weight": torch.arange(600.0), "value_net.weight": torch.arange(3.0)}, held)
    with zipfile.ZipFile(folder / "policy.zip", "w") as content:
        content.writestr("policy.pth", held.getvalue())
        content.writestr("policy.optimizer.pth", bytes(10000))
    return folder


def test_keep_run_keeps_all_scores_and_the_actor_of_the_median_seed(tmp_path):
    runs = tuple(make_run(tmp_path / "runs" / f"walk_{n}", value) for n, value in enumerate((9.0, 1.0, 5.0)))
    rows = [{"case": "trained", "return_mean": 2.0}]
    (runs[0] / "evaluation.json").write_text(json.dumps({"results": rows}))  # returns 2, 1, 5: the first is the median
    assert keep_run.main(runs, tmp_path / "results") == 0
    kept = {folder.name: {path.name for path in folder.iterdir()} for folder in (tmp_path / "results").iterdir()}
    assert kept == {
        "walk_0": {"config.yaml", "results.json", "evaluation.json", "policy.zip"},
        "walk_1": {"results.json"},
        "walk_2": {"results.json"},
    }
    assert (tmp_path / "results/walk_0/results.json").read_bytes() == (runs[0] / "results.json").read_bytes()
    with zipfile.ZipFile(tmp_path / "results/walk_0/policy.zip") as content:
        assert content.namelist() == ["policy.pth"]
        parameters = torch.load(io.BytesIO(content.read("policy.pth")), weights_only=True)
    assert list(parameters) == ["action_net.weight"] and torch.equal(*parameters.values(), torch.arange(600.0))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("results.json", None, r"walk_2 has no results\.json"),
        ("results.json", b"{}", "walk_2"),
        ("config.yaml", yaml.safe_dump(CONFIG | {"total_steps": 400}).encode(), "total_steps=200.*400"),
        ("policy.zip", b"no archive", r"walk_2/policy\.zip"),
    ],
)
def test_keep_run_writes_nothing_where_a_run_is_damaged_or_unfinished(tmp_path, name, content, message):
    runs = make_run(tmp_path / "runs" / "walk_1", 5.0), make_run(tmp_path / "runs" / "walk_2", 5.0)
    (runs[1] / name).unlink() if content is None else (runs[1] / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        keep_run.main(runs, tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_rescore_has_a_job_for_every_committed_agent():
    jobs = rescore.find_jobs(RESULTS, Path("out"), "cuda")
    policies = {path.parent for path in RESULTS.glob("ppo/*/policy.*")}
    committed = {*policies, *RESULTS.glob("pid/*"), *RESULTS.glob("random/*")}
    assert {job.source for job in jobs} == committed and len(jobs) == len(committed)
    assert len(policies) == len({path.name.rpartition("_")[0] for path in RESULTS.glob("ppo/*")})  # one a training run
    assert all("cuda" in job.command for job in jobs)


@pytest.fixture
def in_this_process(monkeypatch):
    """Let ``rescore`` call the scripts instead of starting them."""

    def run(command, **_):
        assert command[:2] == [sys.executable, "-m"]
        try:
            importlib.import_module(command[2]).main([*command[3:]])
        except SystemExit as end:
            return SimpleNamespace(returncode=1, stderr=str(end), stdout="")
        return SimpleNamespace(returncode=0, stderr="", stdout="")

    monkeypatch.setattr(rescore, "subprocess", SimpleNamespace(run=run))


def test_rescore_repeats_scores_and_leaves_the_record(tmp_path, device, capsys, in_this_process):
    pid, stream, out = tmp_path / "pid" / "pid_Stand", tmp_path / "random" / "Stand", tmp_path / "out"
    settings = ("PIAvatar/Stand-v0", "fidelity=tiny", "episode_seconds=0.2", "control.firm_bones=false")
    episodes = ("--evaluation.episodes", "3", "--evaluation.first-seed", "7", "--device", device)
    score_pid.main([*settings, *episodes, "--design.hip-share", "0.25", "--out", str(pid)])
    score_random.main([str(pid), "--seeds", "2", *episodes, "--out", str(stream)])
    before = [(folder / "results.json").read_bytes() for folder in (pid, stream)]
    assert rescore.main(tmp_path, out, device) == 0
    assert [(folder / "results.json").read_bytes() for folder in (pid, stream)] == before
    for old, folder in zip(map(json.loads, before), ("pid/pid_Stand", "random/Stand"), strict=True):
        new = json.loads((out / folder / "results.json").read_text())
        assert new["results"] == old["results"] and new["config"] == old["config"] and new["date"] > old["date"]
    table = json.loads((out / rescore.TABLE).read_text())
    assert {row["agent"] for row in table["results"]} >= {"PID", "random"}
    # an agent that cannot be scored leaves no table
    shutil.rmtree(out)
    (tmp_path / "ppo" / "stand_0").mkdir(parents=True)
    (tmp_path / "ppo" / "stand_0" / "config.yaml").write_text("env_id: PIAvatar/Stand-v0\n")
    (tmp_path / "ppo" / "stand_0" / "policy.pt").write_bytes(b"no policy")
    assert rescore.main(tmp_path, out, device) == 1
    words = capsys.readouterr().err
    assert "policy.pt" in words and "1 of 3 failed" in words and not (out / rescore.TABLE).exists()
