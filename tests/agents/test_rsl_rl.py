"""Training by rsl_rl: the published configurations, and a run of seconds from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extras train and rsl")
for needed in ("rsl_rl", "tensordict", "git"):
    pytest.importorskip(needed, reason="needs the extra rsl")

from agents.batch_training import load_batched, new_task  # noqa: E402
from agents.checkpoint import Checkpoint  # noqa: E402
from agents.rsl_rl import ppo as rsl_algorithm  # noqa: E402
from agents.rsl_rl import train as rsl_ppo  # noqa: E402
from agents.rsl_rl.policy import RslTraining  # noqa: E402
from piavatar_envs.api.host import EpisodeHost  # noqa: E402
from piavatar_envs.avatar.motion import deepmimic  # noqa: E402
from piavatar_envs.tasks import load_task  # noqa: E402
from tests.agents.killing import flat, killed_in_step  # noqa: E402

CONFIGS = sorted((Path(__file__).resolve().parents[2] / "configs" / "rsl_rl").glob("*.yaml"))
TINY = (
    "env.fidelity=tiny", "env.episode_seconds=0.3", "num_envs=2", "iterations=3", "ppo.rollout_steps=8",
    "ppo.minibatches=2", "ppo.epochs=2", "evaluation.episodes=2", 'curriculum={"episode_seconds": 0.3}',
)  # fmt: skip
SHORTEST = (
    "env.fidelity=tiny", "env.episode_seconds=0.3", "num_envs=2", "iterations=1", "ppo.rollout_steps=8",
    "ppo.minibatches=1", "ppo.epochs=1", "evaluation.episodes=2", 'curriculum={"episode_seconds": 0.3}',
)  # fmt: skip


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_published_configurations_train_and_leave_their_results(path, device, tmp_path, capsys):
    if "deepmimic:" in path.read_text() and deepmimic.clip_folder() is None:
        pytest.skip("no pybullet here (its wheels are for Python 3.10 and 3.11): its clip cannot be learned from")
    rsl_ppo.main([str(path), *SHORTEST, "--out", str(tmp_path), "--device", device])
    assert "trained" in capsys.readouterr().out
    left = {entry.name for entry in tmp_path.iterdir()}
    assert {"policy.pt", "curve.png", "curve.csv", "config.yaml", "results.json"} <= left
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["benchmark"] == "rsl_rl.train" and results["num_envs"] == 2 and results["training_s"] > 0.0
    assert [row["case"] for row in results["results"]] == ["zero", "random", "trained"]
    assert np.isfinite([row["return_mean"] for row in results["results"]]).all()
    steps = [line.split(",")[0] for line in (tmp_path / "curve.csv").read_text().split()[1:]]
    assert steps == ["16"]
    again = load_batched(RslTraining, load_task, tmp_path / "config.yaml")
    assert again.iterations == 1 and again.env["physics"]["fidelity"] == "tiny"


def test_training_changes_the_policy_repeats_and_depends_on_its_seed(device, tmp_path, capsys):
    overrides = {"observe": ["target_position"]}
    for assignment in TINY:
        name, _, value = assignment.partition("=")
        overrides[name] = value if name == "env.fidelity" else json.loads(value)
    actors, agents = {}, {}
    for name, extra in (("a", {}), ("b", {}), ("c", {"seed": 1}), ("short", {"iterations": 1})):
        config = load_batched(RslTraining, load_task, None, overrides | extra)
        folder = tmp_path / name
        folder.mkdir()
        checkpoint = Checkpoint(folder, "rsl_rl.train", config, device, resume=False)
        agents[name] = rsl_ppo.learn(config, new_task(config, load_task), folder, device, checkpoint).agent
        saved = torch.load(folder / "policy.pt", weights_only=True, map_location="cpu")
        actors[name] = {key: value for key, value in saved.items() if "weight" in key}

    def apart(one: str, other: str) -> float:
        return max((actors[one][key] - actors[other][key]).abs().max().item() for key in actors[one])

    assert apart("a", "b") == 0.0
    assert apart("a", "c") > 1e-2 and apart("a", "short") > 1e-5
    rng = np.random.default_rng(0)
    layout = EpisodeHost(new_task(config, load_task), 1, device).layout
    seen, changed = rng.normal(size=(2, 4, 1, layout.size)).astype(np.float32)
    chosen = layout["target_position"].slice
    changed[..., chosen] = seen[..., chosen]
    actions = agents["a"](seen)
    assert actions.shape[:2] == (4, 1) and np.array_equal(agents["a"](changed), actions), "it sees what was chosen"
    changed[..., chosen] += 1.0
    assert not np.allclose(agents["a"](changed), actions, atol=1e-3)


def test_updates_aim_at_smaller_and_smaller_divergences(tmp_path, monkeypatch, capsys):
    aims, update = [], rsl_algorithm.PPO.update
    monkeypatch.setattr(rsl_algorithm.PPO, "update", lambda self: aims.append(self.desired_kl) or update(self))
    run = [str(CONFIGS[0]), *TINY, "assist=null", "ppo.final_kl=0.01"]
    rsl_ppo.main([*run, "ppo.desired_kl=0.02", "--out", str(tmp_path / "falls")])
    assert aims == pytest.approx([0.02, 0.015, 0.01])
    with pytest.raises(SystemExit, match="falls to, and there is none; give both"):
        rsl_ppo.main([*run, "ppo.desired_kl=null", "--out", str(tmp_path / "none")])


def test_an_interrupted_training_resumes_bit_for_bit(device, tmp_path):
    """With an adaptive rate, normalised observations and an assist schedule, whose states resume as well."""
    path = next(path for path in CONFIGS if path.stem == "stand_rsl")
    longer = [setting for setting in TINY if not setting.startswith("iterations")]
    longer += ["checkpoint_every=2", "ppo.normalize_observation=true", "ppo.desired_kl=0.01", "ppo.final_kl=0.002"]
    longer += ["assist={first: 0.5, step: 0.2}"]
    command, more = ([str(path), *longer, f"iterations={n}", "--device", device, "--out"] for n in (5, 8))
    rsl_ppo.main([*command, str(tmp_path / "whole")])
    parts = tmp_path / "parts"
    with killed_in_step(rsl_ppo.AvatarRslEnv, 26):  # in the fourth iteration
        rsl_ppo.main([*command, str(parts)])
    assert torch.load(parts / "checkpoint.pt", weights_only=True)["state"]["iterations"] < 4
    rsl_ppo.main([*command, str(parts), "--resume"])
    assert (parts / "curve.csv").read_text() == (tmp_path / "whole" / "curve.csv").read_text()
    whole, resumed = (
        torch.load(tmp_path / run / "checkpoint.pt", weights_only=True)["state"] for run in ("whole", "parts")
    )
    assert whole["algorithm"]["optimizer_state_dict"]["param_groups"][0]["lr"] != 1e-3  # it has adapted
    bits, others = flat(whole), flat(resumed)
    timed = {".curve.seconds", ".logged.1"}
    assert [name for name in bits if others[name] != bits[name] and name not in timed] == [] and len(bits) > 800
    with pytest.raises(SystemExit, match=r"iterations=5.* 8"):  # its updates have become as small as they were to be
        rsl_ppo.main([*more, str(parts), "--resume"])
