"""Training runs by agents.rllib: the published configurations, policies without RLlib, going on, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ray", reason="needs RLlib: make test-rllib")
torch = pytest.importorskip("torch", reason="needs the extra train")
pytest.importorskip("stable_baselines3", reason="needs the extra train")

from agents import play  # noqa: E402
from agents.batch_training import load_batched, new_task  # noqa: E402
from agents.checkpoint import Checkpoint, read_checkpoint  # noqa: E402
from agents.rllib import train  # noqa: E402
from agents.rllib.policy import RLlibTraining, actors, find_task, mean_agent  # noqa: E402
from piavatar_envs.config import ConfigError  # noqa: E402

CONFIGS = sorted((Path(__file__).resolve().parents[2] / "configs" / "rllib").glob("*.yaml"))
TINY = (
    "env.fidelity=tiny", "env.episode_seconds=0.4", "num_envs=2", "env_runners=0", "checkpoint_every=1",
    "ppo.rollout_steps=12", "ppo.minibatches=2", "ppo.epochs=2", "evaluation.episodes=2",
)  # fmt: skip
pytestmark = pytest.mark.usefixtures("local_ray")


def progress(folder: Path) -> np.ndarray:
    """Return the numbers of progress.csv, a row per iteration."""
    return np.loadtxt(folder / "progress.csv", delimiter=",", skiprows=1, ndmin=2)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_published_configurations_train_go_on_and_leave_their_results(path, tmp_path):
    train.main([str(path), *TINY, "iterations=2", "--out", str(tmp_path)])
    left = {entry.name for entry in tmp_path.iterdir()}
    assert {"policy.pt", "checkpoint.pt", "curve.png", "config.yaml", "results.json", "progress.csv"} <= left
    results = json.loads((tmp_path / "results.json").read_text())
    assert [row["case"] for row in results["results"]] == ["zero", "random", "trained"]
    assert results["train_steps"] == 2 * 24
    rows = progress(tmp_path)
    # four episodes of 12 steps; no env runner but the training's own process
    assert rows[:, :2].tolist() == [[1, 24], [2, 48]] and np.isfinite(rows).all() and not rows[:, 4:].any()
    before = read_checkpoint(tmp_path / "checkpoint.pt")["state"]
    train.main([str(path), *TINY, "iterations=3", "--out", str(tmp_path), "--resume"])
    assert progress(tmp_path)[:, 1].tolist() == [24, 48, 72]
    after = read_checkpoint(tmp_path / "checkpoint.pt")["state"]
    counts = [
        [float(one["step"]) for optimizer in state["learner"]["optimizer"].values()
         for one in optimizer["state"]["state"].values()]
        for state in (before, after)
    ]  # fmt: skip
    # Adam's steps go on where they were
    (two,), (three,) = map(set, counts)
    assert two > 0 and three == 1.5 * two


def test_a_trained_policy_plays_as_in_training(tmp_path):
    """Play what is left of a finished training run, and of the same one as if it had been interrupted."""
    reach, game = (next(path for path in CONFIGS if path.stem == name) for name in ("reach_rllib", "high_five_rllib"))
    train.main([str(reach), *TINY, "iterations=1", "--out", str(tmp_path)])
    then, out = json.loads((tmp_path / "results.json").read_text()), tmp_path / "evaluation.json"
    for left in ("policy.pt", "checkpoint.pt"):
        play.main([str(tmp_path), "--out", str(out)])
        assert json.loads(out.read_text())["results"] == then["results"][2:]
        (tmp_path / left).unlink()
    train.main([str(game), *TINY, "iterations=1", "--out", str(tmp_path / "game")])
    for left in ("policy.pt", "checkpoint.pt"):
        with pytest.raises(SystemExit, match=r"high_five_v0.* is a world of several agents"):
            play.main([str(tmp_path / "game")])
        (tmp_path / "game" / left).unlink()


def test_policies_are_those_of_rllib(tmp_path):
    """Compare the mean actions of the networks in policy.pt with those of RLlib's module."""
    settings = {"env": {"fidelity": "tiny"}, "observe": ["target_position"], "num_envs": 2, "iterations": 1}
    config = load_batched(RLlibTraining, find_task, {**settings, "ppo": {"hidden": [8, 6]}})
    task = new_task(config, find_task)
    trainer = train.Trainer(config, task, tmp_path, "cpu", Checkpoint(tmp_path, "rllib.train", config, "cpu", False))
    weights = trainer.weights()
    assert (weights["default_policy"]["pi.log_std"] == config.ppo.log_std).all()
    networks = actors(weights)
    observation = torch.randn(5, 3)
    module = trainer.algorithm.get_module("default_policy")
    with torch.no_grad():
        found = module.forward_inference({"obs": observation})["action_dist_inputs"]
        mean = networks["default_policy"](observation)
    size = mean.shape[1]
    torch.testing.assert_close(found[:, :size], mean)
    assert (found[:, size:] == config.ppo.log_std).all() and 0 < mean.abs().max() < 0.05
    trainer.algorithm.stop()


def test_an_untrained_policy_of_several_agents_acts_for_each():
    config = load_batched(RLlibTraining, find_task, {"env_id": "sumo_v0", "policies": "independent"})
    task = new_task(config, find_task)
    networks = {name: torch.nn.Linear(2, 3) for name in task.agent_names}
    observation = np.random.default_rng(0).normal(size=(4, 2, 6)).astype(np.float32)
    action = mean_agent(networks, task.agent_names, [1, 4])(observation)
    for index, name in enumerate(task.agent_names):
        own = networks[name](torch.as_tensor(observation[:, index][:, [1, 4]])).clamp(-1.0, 1.0)
        np.testing.assert_allclose(action[:, index], own.detach().numpy(), rtol=1e-6)


def test_more_environments_than_seeds_are_refused():
    with pytest.raises(ConfigError, match="env_runners=1024 with num_envs=128"):
        load_batched(RLlibTraining, find_task, {"env_runners": 1024, "num_envs": 128})
