"""Ctrl-C in training runs: one line with the step and the remedy, a checkpoint, and a run that plays and resumes."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

torch = pytest.importorskip("torch", reason="needs the extra train")
pytest.importorskip("stable_baselines3", reason="needs the extra train")

from stable_baselines3.common.vec_env import DummyVecEnv  # noqa: E402

from agents import demo  # noqa: E402
from agents.interrupt import StopRequest  # noqa: E402
from agents.play import open_run  # noqa: E402
from agents.sb3 import parallel  # noqa: E402
from piavatar_envs.api.host import EpisodeHost  # noqa: E402
from piavatar_envs.config import load_config  # noqa: E402
from piavatar_envs.tasks import load_task  # noqa: E402
from tests.agents.test_selfplay import AUCTION  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("env.fidelity=tiny", "env.episode_seconds=0.2", "evaluation.episodes=2")
#: Library, arguments, and the method whose calls count.
TRAININGS = {
    "ppo": ("sb3", ("configs/sb3/reach_ppo.yaml", *QUICK, "total_steps=64", "num_workers=1", "ppo.rollout_steps=8",
                    "ppo.batch_size=8"), (EpisodeHost, "advance")),
    "sac": ("sb3", ("configs/sb3/reach_sac.yaml", *QUICK, "total_steps=64", "num_workers=2", "sac.first_random=4",
                    "sac.batch_size=4"), (EpisodeHost, "advance")),
    "selfplay": ("sb3", ("auction.yaml", "num_workers=1", "evaluation.episodes=2", "total_steps=512",
                         "ppo.batch_size=32"), (parallel.World, "step")),
    "rsl": ("rsl_rl", ("configs/rsl_rl/reach_rsl.yaml", *QUICK, "num_envs=2", "iterations=5", "ppo.rollout_steps=4",
                       "ppo.minibatches=1", "ppo.epochs=1"), (EpisodeHost, "advance")),
    "skrl": ("skrl", ("configs/skrl/high_five_mappo.yaml", *QUICK, "num_envs=2", "iterations=5",
                      "mappo.rollout_steps=4", "mappo.minibatches=1", "mappo.epochs=1"), (EpisodeHost, "advance")),
}  # fmt: skip


def script_of(name: str):
    for needed in {"rsl_rl": ("rsl_rl", "tensordict"), "skrl": ("skrl", "pettingzoo")}.get(name, ()):
        pytest.importorskip(needed, reason="needs the extras rsl, skrl and multi")
    module = f"agents.{name}.train"
    return pytest.importorskip(module), module


@pytest.mark.parametrize("kind", TRAININGS)
def test_an_interrupted_training_says_in_one_line_how_to_go_on(kind, games, device, tmp_path, capfd, monkeypatch):
    name, args, (stepped, method) = TRAININGS[kind]
    script, module = script_of(name)
    if kind == "selfplay":
        (tmp_path / "auction.yaml").write_text(yaml.safe_dump(AUCTION))
        args = (str(tmp_path / args[0]), *args[1:])
    args = [*args, "--out", str(tmp_path / "run"), "--device", device]
    listening, step, left, handler = (
        StopRequest.listening,
        getattr(stepped, method),
        [10**9],
        signal.getsignal(signal.SIGINT),
    )

    def listened(self):
        left[0] = 9
        return listening(self)

    def counted(self, *actions):
        left[0] -= 1
        if left[0] == 0:
            signal.raise_signal(signal.SIGINT)
        return step(self, *actions)

    with monkeypatch.context() as patch:
        patch.setattr(StopRequest, "listening", listened)
        patch.setattr(stepped, method, counted)
        with pytest.raises(SystemExit) as ended:
            script.main(args)
    assert ended.value.code == 130 and signal.getsignal(signal.SIGINT) is handler
    line = capfd.readouterr().err.strip().splitlines()[-1]
    reached = re.match(rf"interrupted after (\d+) of \d+ (steps|iterations); go on with python -m {module} ", line)
    assert reached and int(reached[1]) > 0, line
    assert shlex.split(line.partition(module)[2]) == [*args, "--resume"]
    folder = tmp_path / "run"
    assert (folder / "checkpoint.pt").is_file() and not (folder / "results.json").exists()
    if kind in ("ppo", "sac", "rsl"):
        check_that_it_plays(folder)
        if kind != "ppo":
            return  # resuming is the same for all, and tested in test_resume
        script.main([*args, "--resume"])
        assert (folder / "results.json").is_file()


def check_that_it_plays(folder: Path) -> None:
    run = open_run(folder)
    task = load_task(run.env_id)
    batch = EpisodeHost(task(load_config(task.Config, run.env)), 2)
    batch.reset(0)
    actions = run.make_agent(batch.layout, batch.action_size)(batch.observation())
    assert actions.shape == (2, 1, batch.action_size) and np.abs(actions).max() > 0.0


def test_the_second_interrupt_ends_at_once(capfd):
    stop, handler = StopRequest(), signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), stop.listening():
        signal.raise_signal(signal.SIGINT)
        assert stop.made
        signal.raise_signal(signal.SIGINT)
    assert "Ctrl-C again" in capfd.readouterr().err
    assert signal.getsignal(signal.SIGINT) is handler


def test_workers_leave_the_interrupt_to_their_parent(tmp_path):
    """In a terminal it reaches all processes of a training run: none of them prints a traceback."""
    args = ["configs/sb3/reach_ppo.yaml", *QUICK, "total_steps=100000", "num_workers=2", "ppo.rollout_steps=8"]
    command = [sys.executable, "-m", "agents.sb3.train", *args, "ppo.batch_size=8", "--out", str(tmp_path / "run")]
    with (tmp_path / "log").open("wb") as log:
        training = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log, start_new_session=True)
        while training.poll() is None and b"train:" not in (tmp_path / "log").read_bytes():
            time.sleep(0.1)
        os.killpg(training.pid, signal.SIGINT)
        assert training.wait(300) == 130
    text = (tmp_path / "log").read_text()
    assert "Traceback" not in text and "interrupted after" in text.splitlines()[-1]


@pytest.mark.parametrize("script", ["demo", "play", "rsl_rl.train", "skrl.train"])
def test_a_script_without_torch_names_the_extra_in_one_line(script, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] in ('torch', 'stable_baselines3'):\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Blocked())\n"
    )
    paths = [str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in paths if path)}
    command = [sys.executable, "-m", f"agents.{script}", "x"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    extras = {"rsl_rl.train": "[rsl]", "skrl.train": "[skrl]"}.get(script, "[train]")
    assert line.startswith("error: this script needs ") and extras in line
    assert [path.name for path in tmp_path.iterdir() if path.name not in ("sitecustomize.py", "__pycache__")] == []


def test_an_interrupted_demo_leaves_a_policy_to_play(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(demo, "start_workers", lambda make, count: DummyVecEnv([make] * count))
    train = demo.train

    def interrupted(*args, **kwargs):
        signal.raise_signal(signal.SIGINT)
        return train(*args, **kwargs)

    monkeypatch.setattr(demo, "train", interrupted)
    settings = ["env.fidelity=tiny", "env.episode_seconds=0.2", "num_workers=1", "ppo.rollout_steps=16"]
    with pytest.raises(SystemExit) as ended:
        demo.main([*settings, "ppo.batch_size=16", "--out", str(tmp_path / "demo")])
    assert ended.value.code == 130
    line = capfd.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("interrupted after 1 of 30720 steps; play what it has learned with python -m agents.play")
    check_that_it_plays(tmp_path / "demo")
