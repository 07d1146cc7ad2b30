"""Help for the pelvis that wanes while an agent learns."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extras train and rsl")
for needed in ("rsl_rl", "tensordict", "git"):
    pytest.importorskip(needed, reason="needs the extra rsl")

from agents import rsl_ppo  # noqa: E402
from agents.help import HelpedEnv, HelpSettings  # noqa: E402

FEW = (
    "configs/rsl_rl/stand_rsl.yaml", "env.fidelity=tiny", "num_envs=3", "ppo.rollout_steps=4", "ppo.minibatches=1",
    "ppo.epochs=1", "evaluation.episodes=2", "env.episode_seconds=0.2", "checkpoint_every=1",
)  # fmt: skip


def test_it_falls_in_equal_steps_and_some_have_none(device):
    settings = HelpSettings(first=0.8, rollouts=2)
    env = HelpedEnv(settings, 3, "Stand-v0", 3, device, {"fidelity": "tiny"})
    still = torch.zeros(3, env.num_actions, device=env.device)
    had = []
    for _ in range(9):
        env.step(still)
        had.append(np.concatenate([group.simulation.avatars[0].joints.assist.numpy() for group in env.episodes.groups]))
    expected = [0.8] * 3 + [0.4] * 3 + [0.0] * 3
    np.testing.assert_allclose(had, np.outer(expected, [0.0, 0.5, 1.0]), atol=1e-7)
    env.close()
    alone = HelpedEnv(settings, 3, "Stand-v0", 1, device, {"fidelity": "tiny"})
    alone.step(still[:1])
    assert alone.episodes.groups[0].simulation.avatars[0].joints.assist.numpy().tolist() == pytest.approx([0.8])
    alone.close()


def test_a_resumed_training_has_the_help_that_it_would_have_had(device, tmp_path, capsys):
    command = [*FEW, "help={first: 0.5, rollouts: 3}", "--device", device, "--out"]
    rsl_ppo.main([*command[:-3], "iterations=4", *command[-3:], str(tmp_path / "whole")])
    parts = str(tmp_path / "parts")
    rsl_ppo.main([*command[:-3], "iterations=2", *command[-3:], parts])
    rsl_ppo.main([*command[:-3], "iterations=4", *command[-3:], parts, "--resume"])
    rsl_ppo.main([*FEW, "iterations=4", *command[-3:], str(tmp_path / "alone")])
    whole, resumed, alone = (
        torch.load(tmp_path / run / "policy.pt", weights_only=True) for run in ("whole", "parts", "alone")
    )
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
    assert not all(torch.equal(whole[name], alone[name]) for name in whole)


def test_what_cannot_be_helped_is_refused(device, tmp_path, capsys):
    posed = ("env.drive.control=pose", "help={first: 0.5, rollouts: 3}", "iterations=1")
    with pytest.raises(SystemExit, match=r"help is for bodies under torques"):
        rsl_ppo.main([*FEW, *posed, "--device", device, "--out", str(tmp_path)])
    both = ("env.drive.root_assist=0.1", "help={first: 0.5, rollouts: 3}", "iterations=1")
    with pytest.raises(SystemExit, match=r"root_assist=0.1 stays; give one of them"):
        rsl_ppo.main([*FEW, *both, "--device", device, "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"error: .*'tail' is not a joint"):
        rsl_ppo.main([*FEW, "env.joints=[tail]", "--device", device, "--out", str(tmp_path)])
