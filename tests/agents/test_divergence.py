"""Training runs that diverge end with a line, and leave the checkpoint of before."""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="needs the extra train")


CONFIGS = Path(__file__).resolve().parents[2] / "configs"
ALL = ("env.fidelity=tiny", "env.episode_seconds=0.3", "evaluation.episodes=2")
BATCH = ("num_envs=2", "iterations=5", "checkpoint_every=1")
WORKER = ("num_workers=1", "total_steps=80", "checkpoint_every=16")
PPO = ("ppo.rollout_steps=16", "ppo.batch_size=8", "ppo.epochs=2")
RSL = ("ppo.rollout_steps=8", "ppo.minibatches=2", "ppo.epochs=2")
MAPPO = ("mappo.rollout_steps=8", "mappo.minibatches=2", "mappo.epochs=2")
#: Name -> what it needs, script, configuration, its settings, the learning rate's, steps of a rollout.
TRAININGS = {
    "rsl": ("rsl_rl", "rsl_rl.train", "rsl_rl/reach_rsl", (*BATCH, *RSL), "ppo", 16),
    "ppo": ("stable_baselines3", "sb3.train", "sb3/reach_ppo", (*WORKER, *PPO), "ppo", 16),
    "sac": (
        "stable_baselines3",
        "sb3.train",
        "sb3/reach_sac",
        (*WORKER, "sac.batch_size=8", "sac.first_random=20"),
        "sac",
        1,
    ),
    "mappo": ("skrl", "skrl.train", "skrl/high_five_mappo", (*BATCH, *MAPPO), "mappo", 16),
}


def ended_with(name: str, folder: Path, device: str, *settings: str) -> str:
    """Run a training run that must fail, and return its message."""
    needed, script, config, own, *_ = TRAININGS[name]
    pytest.importorskip(needed, reason="needs its extra")
    main = importlib.import_module(f"agents.{script}").main
    with pytest.raises(SystemExit) as ended:
        main([str(CONFIGS / f"{config}.yaml"), *ALL, *own, *settings, "--out", str(folder), "--device", device])
    message = ended.value.code
    assert isinstance(message, str) and "\n" not in message  # which is printed, with the exit status 1
    return message


@pytest.mark.parametrize("name", TRAININGS)
def test_an_absurd_learning_rate_ends_in_a_line(name, device, tmp_path):
    *_, algorithm, rollout = TRAININGS[name]
    message = ended_with(name, tmp_path / "run", device, f"{algorithm}.learning_rate=1e30")
    matched = re.fullmatch(
        r"error: the training has diverged: .+ is (nan|-?inf), not finite, after (\d+) steps; begin anew in another "
        rf"folder \(--out\) with a smaller {algorithm}.learning_rate, now 1e\+30(; .+checkpoint.pt is left .+)?",
        message,
    )
    assert matched and int(matched[2]) % rollout == 0 < int(matched[2]), message
    assert not {"policy.pt", "policy.zip", "results.json"} & {entry.name for entry in (tmp_path / "run").iterdir()}


def tensors_in(tree) -> Iterator[torch.Tensor]:
    """All tensors in nested containers."""
    if isinstance(tree, torch.Tensor):
        yield tree
    elif isinstance(tree, (dict, list, tuple)):
        for part in tree.values() if isinstance(tree, dict) else tree:
            yield from tensors_in(part)


def spoil_after(monkeypatch, algorithm: type, update: str, updates: int, networks) -> None:
    """Let a library's update leave a weight that is not a number, once there have been so many before."""
    original, count = getattr(algorithm, update), 0

    def spoilt(self, *args, **kwargs):
        nonlocal count
        count += 1
        result = original(self, *args, **kwargs)
        if count > updates:
            next(networks(self).parameters()).data.view(-1)[-1] = math.nan
        return result

    monkeypatch.setattr(algorithm, update, spoilt)


@pytest.mark.parametrize("name", ["rsl", "ppo", "mappo"])
def test_the_checkpoint_of_before_is_kept(name, device, tmp_path, monkeypatch):
    pytest.importorskip(TRAININGS[name][0], reason="needs its extra")
    if name == "rsl":
        from rsl_rl.algorithms import PPO as Algorithm

        spoil_after(monkeypatch, Algorithm, "update", 3, lambda alg: alg.critic)
    elif name == "ppo":
        from stable_baselines3 import PPO as Algorithm

        spoil_after(monkeypatch, Algorithm, "train", 3, lambda model: model.policy.mlp_extractor.value_net)
    else:
        from skrl.multi_agents.torch.mappo import MAPPO as Algorithm

        # one per agent
        spoil_after(monkeypatch, Algorithm, "update", 6, lambda mappo: mappo.values["agent_1"])
    message = ended_with(name, tmp_path / "run", device)
    assert re.search(r"is nan, not finite, after 64 steps; .*; \S+/run/checkpoint.pt is left as it was", message), (
        message
    )
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["state"]
    assert state.get("steps", 16 * state.get("iterations", 0)) == 48
    kept = list(tensors_in([state.get(part) for part in ("algorithm", "modules", "agents")]))
    assert len(kept) > 10 and all(tensor.isfinite().all() for tensor in kept)
