"""Training end to end on the tiny body: files, resuming, deadlines, the demo."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from agents import demo, play
from agents.demo import ReachIK
from agents.evaluate import evaluate, zero_agent
from agents.sb3 import train
from agents.sb3.config import load_training
from agents.sb3.policy import policy_agent
from agents.sb3.workers import factory, prepare, start_vector, start_workers
from piavatar_envs.config import dump_yaml
from tests.agents.conftest import TINY

SB3 = Path(__file__).resolve().parents[2] / "configs" / "sb3"
PUBLISHED = sorted(path for path in SB3.glob("*.yaml") if "vector: true" in path.read_text(encoding="utf-8"))


@pytest.fixture
def workers(tiny, device):
    """One environment of the tiny configuration, in this process."""
    venv = start_workers(factory(tiny), 1)
    yield venv
    venv.close()


@pytest.fixture
def facts(tiny, device):
    return prepare(factory(tiny))


def test_training_repeats_in_workers_and_batches_and_depends_on_its_seed(tiny, workers, facts, tmp_path, device):
    """The same steps, hence the same networks: bit for bit where torch repeats itself, which it does on a CPU."""
    venv = start_vector(tiny.model_copy(update={"vector": True}), device)
    weights, returns = [], []
    for own, seed in ((workers, 1), (workers, 0), (venv, 0)):
        model, curve = train.train(tiny.model_copy(update={"seed": seed}), own, facts, tmp_path)
        assert model.num_timesteps == tiny.total_steps and curve.steps == [15, 30, 45, 60]
        weights.append(np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()]))
        returns.append(evaluate("x", policy_agent(model), own, 3, 7, progress=False).returns)
    venv.close()
    assert not np.allclose(weights[0], weights[1])
    np.testing.assert_allclose(*returns[1:], rtol=0.0, atol=0.0 if device == "cpu" else 1e-4)
    # Adam makes steps of one size of gradients that differ in their last place, however small they are
    np.testing.assert_allclose(*weights[1:], rtol=0.0, atol=0.0 if device == "cpu" else 1e-3)
    observation = np.random.default_rng(0).normal(size=facts.layout.size).astype(np.float32)
    loaded = PPO.load(tmp_path / "policy.zip", device="cpu")  # needs no wrapper
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )


def test_networks_see_only_the_chosen_terms(workers, facts, tmp_path):
    config = load_training(
        {
            "env": {"fidelity": "tiny", "episode_seconds": 0.5},
            "observe": ["target_position"],
            "total_steps": 32,
            "num_workers": 1,
            "ppo": {"rollout_steps": 32, "batch_size": 16, "epochs": 1, "hidden": [8]},
        }
    )
    model, _ = train.train(config, workers, facts, tmp_path)
    rng = np.random.default_rng(0)
    observation = rng.normal(size=facts.layout.size).astype(np.float32)
    changed = rng.normal(size=facts.layout.size).astype(np.float32)
    seen = facts.layout["target_position"].slice
    changed[seen] = observation[seen]
    act = policy_agent(model)
    np.testing.assert_array_equal(act(observation[None]), act(changed[None]))
    changed[seen] += 0.5
    assert not np.array_equal(act(observation[None]), act(changed[None]))


@pytest.mark.parametrize("path", PUBLISHED, ids=lambda path: path.stem)
def test_published_vectors_train_and_leave_their_results(path, device, tmp_path):
    small = [
        "env.fidelity=tiny", "env.episode_seconds=0.5", "total_steps=128", "num_workers=4", "evaluation.episodes=2",
        "checkpoint_every=64",
    ]  # fmt: skip
    if load_training(path).sac:
        small += ["sac.first_random=32", "sac.batch_size=16", "sac.minibatches=2"]
    else:
        small += ["ppo.rollout_steps=16", "ppo.batch_size=16", "ppo.epochs=1"]
    train.main([str(path), *small, "--out", str(tmp_path), "--device", device])
    assert load_training(tmp_path / "config.yaml").vector and (tmp_path / "policy.zip").is_file()
    results = json.loads((tmp_path / "results.json").read_text())["results"]
    assert [row["case"] for row in results] == ["zero", "random", "trained"]
    assert np.isfinite([row["return_mean"] for row in results]).all()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    shown = {"rollout/ep_rew_mean", "rollout/success_rate", "train/learning_rate"}
    shown |= {"train/ent_coef", "train/actor_loss"} if load_training(path).sac else {"train/value_loss"}
    assert shown <= set(events.Tags()["scalars"])
    curve = [line.split(",") for line in (tmp_path / "curve.csv").read_text().split()[1:]]
    assert events.Scalars("rollout/ep_rew_mean")[-1].step <= 128 and len(curve) == 8


def test_a_deadline_ends_the_training_with_a_policy(tiny, workers, facts, tmp_path):
    endless = tiny.model_copy(update={"total_steps": 10_000_000})
    begun = time.monotonic()
    model, _ = train.train(endless, workers, facts, tmp_path, deadline=lambda steps, _: begun + 1.0)
    assert model.num_timesteps < 10_000_000
    assert (tmp_path / "policy.zip").is_file()
    assert np.isfinite(evaluate("x", policy_agent(model), workers, 2, 0, progress=False).returns).all()


def test_the_command_line_trains_and_refuses(tiny, device, tmp_path, capsys):
    path = tmp_path / "short.yaml"
    path.write_text(dump_yaml(tiny))
    train.main([str(path), "total_steps=32", "--out", str(tmp_path / "run")])
    left = {entry.name for entry in (tmp_path / "run").iterdir()}
    assert {
        "tensorboard",
        "checkpoint.pt",
        "policy.zip",
        "curve.png",
        "curve.csv",
        "config.yaml",
        "results.json",
    } <= left
    assert load_training(tmp_path / "run" / "config.yaml").total_steps == 32
    with pytest.raises(SystemExit) as refused:
        train.main([str(path), "ppo.epoch=3", "--out", str(tmp_path / "run")])
    assert str(refused.value) == "error: ppo.epoch is not a setting of TrainingConfig; did you mean ppo.epochs?"


def test_the_demo_replaces_a_stopped_one_and_leaves_policy_film_and_scores(tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra render")
    for module in (demo, play):
        monkeypatch.setattr(module, "start_workers", lambda make, count: DummyVecEnv([make] * count))
    settings = (
        "env.fidelity=tiny", "env.episode_seconds=0.2", "total_steps=64", "num_workers=2", "ppo.rollout_steps=16",
        "ppo.batch_size=16", "evaluation.episodes=2", "env.render.width=64", "env.render.height=64",
    )  # fmt: skip
    options = demo.Options(settings=settings, out=tmp_path, seed=4)

    def stopped(*args, **kwargs):
        (tmp_path / "policy.zip").write_bytes(b"learned")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(demo, "train", stopped)
        demo.run(options, Console(quiet=True))
    (tmp_path / "before_after.mp4").write_bytes(b"of an earlier one")
    trained = demo.train

    def watched(*args, **kwargs):
        assert not any((tmp_path / name).exists() for name in demo.LATER)
        return trained(*args, **kwargs)

    played = demo.play_references

    def compared(*args):
        assert (tmp_path / "policy.zip").is_file(), "it trains first"
        return played(*args)

    monkeypatch.setattr(demo, "train", watched)
    monkeypatch.setattr(demo, "play_references", compared)
    outcome = demo.run(options, Console(quiet=True))
    assert len({tuple(e.seed for e in evaluation.episodes) for evaluation in outcome.evaluations}) == 1
    for name in ("policy.zip", "curve.png", "before_after.mp4", "config.yaml"):
        assert (tmp_path / name).stat().st_size > 100, name
    results = json.loads((tmp_path / "results.json").read_text())
    assert [row["case"] for row in results["results"]] == ["zero", "random", "scripted IK", "trained"]
    assert load_training(tmp_path / "config.yaml").seed == 4


def test_a_demo_on_a_slow_machine_trains_for_half_of_the_time_and_fails_if_nothing_was_learned(
    tmp_path, monkeypatch, capsys
):
    class Trained(Exception):
        pass

    def train(*args, deadline):
        left = deadline(4, 100.0) - time.monotonic()  # at 25 s per step nothing else would fit
        assert 0.3 * seconds < left <= 0.5 * seconds
        raise Trained

    prepared = demo.prepare

    def prepare(make):
        time.sleep(0.5)  # to compile
        return prepared(make)

    options = ["env.fidelity=tiny", "num_workers=1", "--out", str(tmp_path)]
    for seconds in (570.0, 0.5):
        with monkeypatch.context() as patch, pytest.raises(Trained):
            patch.setattr(demo, "prepare", prepare)
            patch.setattr(demo, "train", train)
            demo.main([*options, "--seconds", str(seconds)])
    workers = start_workers(factory(load_training(TINY)), 1)
    size = workers.action_space.shape[0]
    rows = evaluate("zero", zero_agent(size), workers, 2, 0, progress=False)
    outcome = demo.Outcome((rows,) * 4, 4, 1.0, 4.0, 4.0, separated=False)
    monkeypatch.setattr(demo, "run", lambda *_: outcome)
    with pytest.raises(SystemExit, match="error: nothing was learned in 4 steps"):
        demo.main(options)
    monkeypatch.setattr(demo, "run", lambda *_: replace(outcome, separated=True))
    demo.main(options)


def test_inverse_kinematics_reaches_every_target(device):
    config = load_training({"env": {"fidelity": "tiny", "episode_seconds": 2.0}, "num_workers": 1})
    make = factory(config)
    facts = prepare(make)
    agent = ReachIK(facts.layout, facts.action_names, facts.action_step, facts.control_dt)
    venv = start_workers(make, 1)
    try:
        scripted = evaluate("scripted", agent, venv, episodes=4, first_seed=0, progress=False)
        still = evaluate("zero", zero_agent(len(facts.action_names)), venv, episodes=4, first_seed=0, progress=False)
    finally:
        venv.close()
    assert scripted.row()["success_at_end"] == 1.0
    assert scripted.row()["failures"] == 0
    assert (scripted.returns > still.returns).all()
    # 60 steps, each worth 1 at most: what is lost is the way there and the cost of control
    assert (scripted.returns > 50.0).all() and (scripted.returns <= 60.0).all()
