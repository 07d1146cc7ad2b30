"""Help for the pelvis that wanes while an agent learns."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extras train and rsl")
for needed in ("rsl_rl", "tensordict", "git"):
    pytest.importorskip(needed, reason="needs the extra rsl")

from agents.batch_training import load_batched  # noqa: E402
from agents.rsl_rl import train as rsl_ppo  # noqa: E402
from agents.rsl_rl.curriculum import AssistSchedule, CurriculumEnv  # noqa: E402
from agents.rsl_rl.policy import RslTraining  # noqa: E402
from piavatar_envs.config import load_config, parse_assignments  # noqa: E402
from piavatar_envs.tasks import load_task  # noqa: E402

FEW = (
    "configs/rsl_rl/stand_rsl.yaml", "env.fidelity=tiny", "num_envs=3", "ppo.rollout_steps=4", "ppo.minibatches=1",
    "ppo.epochs=1", "evaluation.episodes=2", "env.episode_seconds=0.2", "checkpoint_every=1",
)  # fmt: skip


def test_it_falls_in_equal_steps_and_some_have_none(device):
    settings = AssistSchedule(first=0.8, rollouts=2)
    env = CurriculumEnv({"assist": settings}, 3, "Stand-v0", 3, device, {"fidelity": "tiny"})
    still = torch.zeros(3, env.num_actions, device=env.device)
    had = []
    for _ in range(9):
        env.step(still)
        had.append(np.concatenate([group.simulation.controllers[0].assist.numpy() for group in env.host.groups]))
    expected = [0.8] * 3 + [0.4] * 3 + [0.0] * 3
    np.testing.assert_allclose(had, np.outer(expected, [0.0, 0.5, 1.0]), atol=1e-7)
    env.close()
    alone = CurriculumEnv({"assist": settings}, 3, "Stand-v0", 1, device, {"fidelity": "tiny"})
    alone.step(still[:1])
    assert alone.host.groups[0].simulation.controllers[0].assist.numpy().tolist() == pytest.approx([0.8])
    alone.close()


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        ("Stand-v0", [[0.0, 0.4, 0.8], [0.0, 0.1, 0.5], [0.0, 0.0, 0.2]]),
        ("GetUp-v0", [[0.0, 0.4, 0.8], [0.3, 0.7, 0.8], [0.6, 0.8, 0.8]]),
    ],
)
def test_it_falls_after_success_and_rises_after_failure(device, task, expected):
    """In a tenth of a second no body falls, and none gets up."""
    settings = AssistSchedule(first=0.8, step=0.3)
    env = CurriculumEnv({"assist": settings}, 4, task, 3, device, {"fidelity": "tiny", "episode_seconds": 0.1})
    still = torch.zeros(3, env.num_actions, device=env.device)
    for shares in np.repeat(expected, 3, axis=0):
        _, _, _, extras = env.step(still)
        groups = env.host.groups
        had = np.concatenate([group.simulation.controllers[0].assist.numpy() for group in groups])
        np.testing.assert_allclose(had, shares, atol=1e-6)
        assert float(extras["log"]["Task/root_assist"]) == pytest.approx(shares.mean(), abs=1e-6)
    env.close()


def test_curricula_are_for_training_only(device, tmp_path, capsys):
    setting = "curriculum={pose_noise: 0.3, control.root_assist: 0.1}"
    config = load_batched(RslTraining, load_task, FEW[0], parse_assignments([*FEW[1:], setting]))
    task = load_task(config.env_id)
    env = rsl_ppo.make_env(config, task(load_config(task.Config, config.env)), device)
    assert env.config.pose_noise == 0.3 and env.config.control.root_assist == 0.1
    assert config.env["pose_noise"] == 0.05 and config.env["control"]["root_assist"] == 0.0
    env.close()
    with pytest.raises(SystemExit, match=r"tail is not a setting of StandConfig"):
        rsl_ppo.main([*FEW, "curriculum={tail: 1}", "iterations=1", "--device", device, "--out", str(tmp_path)])


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ("control.mode: pd", "control.mode"),
        ("joints: [left_hip]", "its actions"),
        ("observe_parameters: true", "observe_parameters"),
    ],
)
def test_curricula_for_another_body_are_refused(device, tmp_path, setting, named):
    """A policy that sees or does something else would fail, or be evaluated at what it has not learned."""
    with pytest.raises(SystemExit, match=rf"curriculum=.* changes .*{named}"):
        rsl_ppo.main([*FEW, f"curriculum={{{setting}}}", "iterations=1", "--device", device, "--out", str(tmp_path)])
