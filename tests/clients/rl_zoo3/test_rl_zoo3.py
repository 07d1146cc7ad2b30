"""RL Zoo: its command lines for training and enjoying, with the hyper-parameters in ``configs/rl_zoo3``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "rl_zoo3"
ENV_ID = "PIAvatar/Reach-v0"
SETTINGS = ["--env", ENV_ID, "--gym-packages", "piavatar_envs"]
QUICK = ["--env-kwargs", "fidelity:'tiny'", "device:'cpu'", "episode_seconds:0.4"]
#: Settings of the file that a run of 64 steps needs smaller.
SMALLER = {"ppo": ["n_steps:16", "batch_size:16"], "sac": ["learning_starts:16", "batch_size:16"]}


def run(module: str, *options: str) -> str:
    """Run a module of the zoo as its documentation has it, and return its output."""
    command = [sys.executable, "-m", f"rl_zoo3.{module}", *SETTINGS, *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yml")), ids=lambda path: path.stem)
def test_train_and_enjoy(path, tmp_path):
    algorithm = path.stem
    logs = ["--algo", algorithm, "-f", str(tmp_path)]
    common = ["--conf-file", str(path), "--device", "cpu", "--seed", "1", "-n", "64", "--eval-freq", "32"]
    run("train", *logs, *common, *QUICK, "--eval-episodes", "1", "-params", *SMALLER[algorithm], "n_envs:2")
    (trained,) = tmp_path.glob(f"{algorithm}/*_1")
    assert list(trained.glob("*.zip"))
    said = run("enjoy", *logs, "--no-render", "-n", "30", "--device", "cpu", *QUICK)
    assert "Episode Reward" in said and "Episode Length 12" in said


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yml")), ids=lambda path: path.stem)
def test_every_environment_of_a_file_exists(path):
    import gymnasium

    import piavatar_envs  # noqa: F401 - registers the ids

    for env_id in yaml.safe_load(path.read_text()):
        assert gymnasium.spec(env_id).id == env_id
