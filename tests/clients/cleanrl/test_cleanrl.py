"""CleanRL: the single-file scripts of its package, as they are, under the Gymnasium that they were written for."""

from __future__ import annotations

import re
import subprocess
import sys

import gymnasium
import pytest

#: The scripts take an id and no settings, so a module registers one with short episodes, as CleanRL's guide has it.
MODULE = """
import gymnasium

SETTINGS = {"fidelity": "tiny", "device": "cpu", "episode_seconds": 0.4}
gymnasium.register("ShortReach-v0", lambda: gymnasium.make("piavatar_envs:PIAvatar/Reach-v0", **SETTINGS))
"""
OPTIONS = {
    "ppo_continuous_action": "--total-timesteps 64 --num-envs 1 --num-steps 32 --num-minibatches 4 --update-epochs 2",
    "rpo_continuous_action": "--total-timesteps 64 --num-envs 1 --num-steps 32 --num-minibatches 4 --update-epochs 2",
    "ddpg_continuous_action": "--total-timesteps 64 --learning-starts 16 --batch-size 16 --buffer-size 100",
}


def test_gymnasium_is_the_one_of_the_scripts():
    assert gymnasium.__version__ == "0.29.1"


@pytest.mark.parametrize("script", OPTIONS)
def test_script_runs_over_the_end_of_episodes(script, tmp_path):
    (tmp_path / "short_reach.py").write_text(MODULE)
    command = [sys.executable, "-m", f"cleanrl.{script}", "--env-id", "short_reach:ShortReach-v0", "--cuda", "False"]
    done = subprocess.run(
        [*command, *OPTIONS[script].split()], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    returns = [float(found) for found in re.findall(r"episodic_return=\[?\s*([-\d.e]+)", done.stdout)]
    assert len(returns) == 64 // 12 and all(abs(value) < 100.0 for value in returns), done.stdout
    assert list(tmp_path.glob("runs/*/events.*"))
