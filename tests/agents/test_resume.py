"""Checkpoints: killed training runs resume bit for bit, folders are not overwritten, and damage is detected."""

from __future__ import annotations

import errno
import io
import re
import subprocess
import sys
import time
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from agents.checkpoint import FORMAT, Checkpoint, load_weights
from agents.files import hold, write_atomically
from agents.sb3 import train
from agents.sb3.config import load_training
from agents.sb3.learning import begin, learn
from agents.sb3.workers import factory, prepare, start_vector, start_workers
from piavatar_envs.config import ConfigError, dump_yaml
from piavatar_envs.core.reading import UNREADABLE
from tests.agents.conftest import TINY
from tests.agents.killing import KillAt, Killed, flat, run_killed

SAC = {"sac": {"memory_size": 48, "batch_size": 8, "first_random": 8, "hidden": [8]}}


def networks(policy: Path) -> dict[str, str]:
    """Weights and the optimizer's moments in a saved policy, by name."""
    found = {}
    with ZipFile(policy) as archive:
        for name in ("policy.pth", "policy.optimizer.pth"):
            with archive.open(name) as file:
                found |= flat(torch.load(file, weights_only=True), name)
    return found


def checkpoint_of(config, folder: Path, resume: bool = True, script: str = "sb3.train") -> Checkpoint:
    folder.mkdir(exist_ok=True)
    return Checkpoint(folder, script, config, "cpu", resume)


def test_a_training_killed_while_it_writes_resumes_bit_for_bit(device, tmp_path):
    path = tmp_path / "short.yaml"
    ppo = TINY["ppo"] | {"learning_rate": 1e-3, "final_learning_rate": 1e-4}
    path.write_text(
        dump_yaml(load_training(TINY | {"total_steps": 128, "checkpoint_every": 32, "seed": 5, "ppo": ppo}))
    )
    command = [str(path), "--device", device, "--out"]
    train.main([*command, str(tmp_path / "whole")])
    parts = tmp_path / "parts"
    run_killed(5, *command, str(parts))
    assert torch.load(parts / "checkpoint.pt", weights_only=True)["state"]["steps"] == 32
    half = parts / "checkpoint.pt.partial"
    assert 0 < half.stat().st_size < (parts / "checkpoint.pt").stat().st_size and not (parts / "policy.zip").exists()
    with pytest.raises(SystemExit, match=r"error: .*--resume.*--out"):
        train.main([*command, str(parts)])
    time.sleep(1.0)  # TensorBoard orders a run's files by the second in which they were begun
    train.main([*command, str(parts), "--resume"])
    assert not half.exists()
    curve = (parts / "curve.csv").read_text()
    assert curve == (tmp_path / "whole" / "curve.csv").read_text() and len(curve.splitlines()) == 9
    # TensorBoard forgets what was logged after the checkpoint and lost
    events = EventAccumulator(str(parts / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("time/fps")] == [32, 64, 96, 128]
    events = EventAccumulator(str(tmp_path / "whole" / "tensorboard")).Reload()
    rates = [event.value for event in events.Scalars("train/learning_rate")]  # the last update is not logged
    np.testing.assert_allclose(rates, np.linspace(1e-3, 1e-4, 5)[1:-1], rtol=1e-5)
    whole, resumed = (networks(tmp_path / run / "policy.zip") for run in ("whole", "parts"))
    assert len(whole) > 20 and resumed == whole


@pytest.mark.parametrize(
    "settings",
    [{"num_workers": 2}, {"num_workers": 3, "vector": True}, SAC],
    ids=["processes", "vector", "sac"],
)
def test_every_way_of_training_goes_on_bit_for_bit(settings, device, tmp_path):
    config = load_training(TINY | {"total_steps": 128, "checkpoint_every": 40} | settings)
    facts, make = prepare(factory(config)), factory(config)
    states, curves = [], []
    for name, kills in (("whole", ()), ("parts", (110,))):
        if config.vector:
            venv = start_vector(config)
        elif kills:
            venv = start_workers(make, config.num_workers)
            if config.num_workers > 1:  # a single environment stays in this process
                check_where_they_come_from(venv.processes)
        else:  # one process does what several do
            venv = DummyVecEnv([make] * config.num_workers)
        for steps in kills:
            with pytest.raises(Killed):
                learn_on(config, venv, facts, tmp_path / name, watchers=[KillAt(steps)])
            assert checkpoint_of(config, tmp_path / name).state["steps"] > 0
        curves.append(learn_on(config, venv, facts, tmp_path / name))
        venv.close()
        states.append(checkpoint_of(config, tmp_path / name).state)
    assert curves[0].returns and curves[0].returns == curves[1].returns and curves[0].steps == curves[1].steps
    # the last checkpoints hold all there is: networks, moments, random numbers, environments, replayed steps
    seconds = re.compile(r"\.seconds$|\.latest\.\d+\.2$")
    whole, parts = (flat(state) for state in states)
    assert whole.keys() == parts.keys() and len(whole) > 800
    assert [name for name in whole if parts[name] != whole[name] and not seconds.search(name)] == []


def check_where_they_come_from(workers):
    """Check that processes are forked from one that has imported torch, which takes longer than they do to start."""
    if Path("/proc/self/maps").is_file():
        (parent,) = {Path(f"/proc/{own.pid}/stat").read_text().rpartition(")")[2].split()[1] for own in workers}
        assert "torch_python" in Path(f"/proc/{parent}/maps").read_text()


def learn_on(config, venv, facts, folder: Path, watchers=()):
    """Begin, or go on where the folder's checkpoint is; the environments may stand anywhere."""
    return learn(config, begin(config, venv, facts), folder, checkpoint_of(config, folder), watchers=watchers)


def test_a_finished_training_has_nothing_to_do_and_can_be_made_longer(tiny, device, tmp_path):
    config = tiny.model_copy(update={"checkpoint_every": 32})
    facts, make = prepare(factory(config)), factory(config)
    longer = config.model_copy(update={"total_steps": 128})

    def go_on(config, name):
        venv = start_workers(make, 1)
        model, curve = train.train(config, venv, facts, tmp_path / name, checkpoint_of(config, tmp_path / name))
        venv.close()
        return torch.cat([p.detach().ravel() for p in model.policy.parameters()]).numpy(), curve.returns

    done = go_on(config, "run")
    np.testing.assert_array_equal(go_on(config, "run")[0], done[0])
    whole, longer_run = go_on(longer, "whole"), go_on(longer, "run")
    np.testing.assert_array_equal(longer_run[0], whole[0])
    assert longer_run[1] == whole[1] and len(whole[1]) > len(done[1])
    with pytest.raises(ConfigError, match=r"has had 128 steps, total_steps=64; ask for as many or more"):
        go_on(config, "run")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 1}, ["seed=0", "1", "--out"]),
        ({"ppo": {"learning_rate": 0.5}}, ["ppo.learning_rate=0.0007", "0.5"]),
        ({"env": {"fidelity": "tiny", "episode_seconds": 0.4}}, ["env.episode_seconds=0.5", "0.4"]),
    ],
)
def test_another_configuration_is_refused(tiny, change, words, tmp_path):
    checkpoint_of(tiny, tmp_path).save({})
    free = {"total_steps": 999, "checkpoint_every": 7, "evaluation": {"episodes": 5}}
    assert checkpoint_of(load_training(TINY | free), tmp_path).state == {}
    with pytest.raises(ConfigError) as refused:
        checkpoint_of(load_training(TINY | {"ppo": TINY["ppo"] | change.pop("ppo", {})} | change), tmp_path)
    assert "\n" not in str(refused.value)
    assert all(word in str(refused.value) for word in words), refused.value


def test_other_versions_devices_and_scripts_are_refused(tiny, tmp_path, monkeypatch):
    checkpoint_of(tiny, tmp_path).save({})
    with pytest.raises(ConfigError, match=r"script 'sb3.train', now it is 'rsl_rl.train'"):
        checkpoint_of(tiny, tmp_path, script="rsl_rl.train")
    with pytest.raises(ConfigError, match=r"device 'cpu', now it is 'cuda:0'"):
        Checkpoint(tmp_path, "sb3.train", tiny, "cuda:0", resume=True)
    with monkeypatch.context() as patch:
        patch.setattr("agents.checkpoint.package_version", lambda name: "0.0.1" if name == "torch" else "1")
        with pytest.raises(ConfigError, match=r"now it is .*; install that version, or begin anew"):
            checkpoint_of(tiny, tmp_path)
    monkeypatch.setattr("agents.checkpoint.git_commit", lambda: ("abc", False))
    with pytest.warns(UserWarning, match="this is abc: the curve may go on otherwise"):
        checkpoint_of(tiny, tmp_path)


def test_a_training_whose_updates_fall_keeps_its_length(tmp_path):
    """A longer one would have begun with others, and would go on with greater ones than its last."""
    config = load_training(TINY | {"total_steps": 64, "ppo": TINY["ppo"] | {"final_learning_rate": 1e-5}})
    checkpoint_of(config, tmp_path).save({"steps": 64})
    assert checkpoint_of(config.model_copy(update={"checkpoint_every": 7}), tmp_path).state == {"steps": 64}
    with pytest.raises(ConfigError, match="was written with total_steps=64, now it is 128; give the same settings"):
        checkpoint_of(config.model_copy(update={"total_steps": 128}), tmp_path)


def test_a_file_that_is_no_checkpoint_is_refused_and_never_run(tiny, tmp_path):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(b"not one")
    with pytest.raises(ConfigError, match=r"cannot be read \(.*\); delete it to begin anew"):
        checkpoint_of(tiny, tmp_path)
    torch.save({"format": 0}, path)
    with pytest.raises(ConfigError, match=r"has format=0, this reads \d+; delete it"):
        checkpoint_of(tiny, tmp_path)
    for content in ({}, {"about": {}}, {"about": {"script": "sb3.train"}, "state": {}}, {"about": None, "state": []}):
        torch.save({"format": FORMAT, **content}, path)
        with pytest.raises(ConfigError, match="lacks the state or the description of a training run; delete it"):
            checkpoint_of(tiny, tmp_path)

    class Trap:
        def __reduce__(self):
            return (tmp_path / "sprung").touch, ()

    torch.save({"format": Trap()}, path)
    with pytest.raises(ConfigError, match="cannot be read"):
        checkpoint_of(tiny, tmp_path)
    assert not (tmp_path / "sprung").exists()


def test_a_write_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "file"
    write_atomically(path, lambda file: file.write(b"old"))

    def fail(file):
        file.write(b"ne")
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space"):
        write_atomically(path, fail)
    assert path.read_bytes() == b"old" and [entry.name for entry in tmp_path.iterdir()] == ["file"]

    class Full(io.BytesIO):
        """A disk that takes no more; torch hides its words behind its own."""

        def write(self, content):
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match=r"file cannot be written \(No space left on device\)"):
        write_atomically(path, lambda _: torch.save({"weight": torch.zeros(9)}, Full()))
    assert path.read_bytes() == b"old" and [entry.name for entry in tmp_path.iterdir()] == ["file"]
    write_atomically(path, lambda file: file.write(b"new"))
    assert path.read_bytes() == b"new" and [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_no_other_process_trains_where_one_does(tmp_path):
    pytest.importorskip("fcntl", reason="Windows has no such locks")
    hold(tmp_path)
    hold(tmp_path)  # one process may go on where it was
    code = f"from pathlib import Path; from agents.files import hold; hold(Path({str(tmp_path)!r}))"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert "another training run writes to" in other.stderr and "--out" in other.stderr


@pytest.mark.parametrize("name", ["policy.pt", "policy.zip", "results.json"])
@pytest.mark.parametrize("resume", [False, True])
def test_a_run_that_was_kept_is_not_written_over(name, resume, tmp_path):
    (tmp_path / name).write_text("kept")
    config = load_training({"env_id": "PIAvatar/Reach-v0", "env": {"fidelity": "tiny"}})
    with pytest.raises(ConfigError, match=rf"{name} is of a training run that has ended"):
        Checkpoint(tmp_path, "sb3.train", config, "cpu", resume)
    assert (tmp_path / name).read_text() == "kept"


def test_damage_anywhere_is_found(tmp_path):
    whole, damaged = tmp_path / "whole.pt", tmp_path / "damaged.pt"
    torch.save({"weight": torch.arange(3000.0)}, whole)
    torch.testing.assert_close(load_weights(whole, "cpu")["weight"], torch.arange(3000.0))
    content = whole.read_bytes()
    rng = np.random.default_rng(3)
    for at in [*rng.integers(0, len(content) - 64, 40), content.index(torch.arange(1000.0, 1004.0).numpy().tobytes())]:
        # four bytes of the numbers themselves, or of what describes them
        damaged.write_bytes(content[:at] + bytes(b ^ 0xFF for b in content[at : at + 4]) + content[at + 4 :])
        try:
            read = load_weights(damaged, "cpu")
        except UNREADABLE:
            continue
        torch.testing.assert_close(read["weight"], torch.arange(3000.0))  # bytes that are not read, such as a date
    for broken in (content[: len(content) // 2], b"", b"no archive"):
        damaged.write_bytes(broken)
        with pytest.raises(UNREADABLE):
            load_weights(damaged, "cpu")
    with pytest.raises(UNREADABLE):
        load_weights(tmp_path, "cpu")
