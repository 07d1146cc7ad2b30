"""Training runs on several ranks: two processes on CPUs, as torchrun starts them, and what each of them has."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extras train, rsl and skrl")
for needed in ("rsl_rl", "tensordict", "git", "skrl", "pettingzoo"):
    pytest.importorskip(needed, reason="needs the extras rsl, skrl and multi")

from agents import ranks as ranks_module  # noqa: E402
from agents.batch_training import load_batched, new_task  # noqa: E402
from agents.play import open_run  # noqa: E402
from agents.ranks import ALONE, Ranks  # noqa: E402
from agents.rsl_rl import train as rsl_train  # noqa: E402
from agents.rsl_rl.policy import load_rsl  # noqa: E402
from agents.skrl import train as skrl_train  # noqa: E402
from agents.skrl.networks import ActedMemory  # noqa: E402
from piavatar_envs.config import ConfigError  # noqa: E402
from tests.agents.killing import flat  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
RSL = (
    "configs/rsl_rl/stand_rsl.yaml", "env.fidelity=tiny", "env.episode_seconds=0.2", "num_envs=2", "iterations=3",
    "checkpoint_every=2", "ppo.rollout_steps=4", "ppo.minibatches=2", "ppo.epochs=1", "ppo.hidden=[16]",
    "ppo.normalize_observation=true", "assist={first: 0.5, step: 0.2}", "evaluation.episodes=2",
)  # fmt: skip
SKRL = (
    "configs/skrl/high_five_mappo.yaml", "env.fidelity=tiny", "env.episode_seconds=0.3", "num_envs=2",
    "iterations=1000", "mappo.rollout_steps=4", "mappo.minibatches=1", "mappo.epochs=1", "mappo.hidden=[8]",
)  # fmt: skip
BOTH = [Ranks(0, 2, 0, 2), Ranks(1, 2, 1, 2)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Runs on two machines, here two torchruns of a rank each: one that fails and is restarted, the same without that,
    and one that is interrupted."""
    if not hasattr(os, "fork"):
        pytest.skip("Windows cannot fork ranks")
    folder = tmp_path_factory.mktemp("ranks")
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    machine = ("--nnodes=2", "--nproc-per-node=1", "--max-restarts=1", "--rdzv-backend=c10d")
    args = ("rsl_rl", "fails", *RSL, "--", "rsl_rl", "whole", *RSL, "--", "skrl", "interrupts", *SKRL)
    command = [sys.executable, "-m", "tests.agents.rank_launch", *machine, f"--rdzv-endpoint=localhost:{port}"]
    command += ["tests/agents/rank_probe.py", str(folder), *args]
    with (folder / "log").open("ab") as log:
        env = os.environ | {"OMP_NUM_THREADS": "1"}
        started = subprocess.Popen(command, cwd=ROOT, env=env, stdout=log, stderr=log, start_new_session=True)
    try:
        assert started.wait(500), "the interrupted one is the last"
    finally:
        with contextlib.suppress(ProcessLookupError):  # all have ended
            os.killpg(started.pid, signal.SIGTERM)
    return folder


def facts(folder: Path, fate: str) -> list[dict]:
    """Return what the ranks of a training run have left."""
    return [json.loads((folder / f"{fate}_{rank}.json").read_text()) for rank in range(2)]


def saved(folder: Path) -> dict:
    """Return the checkpoint of a training."""
    return torch.load(folder / "checkpoint.pt", weights_only=True)


def test_ranks_have_the_same_networks_and_normalisers_and_draw_differently(trained):
    first, second = facts(trained, "whole")
    assert first["ranks"] == second["ranks"] == 2
    assert first["networks"] == second["networks"]
    content = saved(trained / "whole")
    state, (other,) = content["state"], content["others"]
    actor = state["algorithm"]["actor_state_dict"]
    assert int(actor["obs_normalizer.count"]) == 3 * 4 * 2 * 2, "of the observations of both ranks"
    seeds = [seed for part in (state, other) for seed in part["envs"]["env.seed"].tolist()]
    assert seeds == list(range(seeds[0], seeds[0] + 4))
    assert not torch.equal(state["random"]["torch"], other["random"]["torch"])


def test_rank_0_writes_results_of_all(trained):
    run = trained / "whole"
    results = json.loads((run / "results.json").read_text())
    assert results["ranks"] == 2 and results["num_envs"] == 2 and results["train_steps"] == 2 * 3 * 2 * 4
    assert [line.split(",")[0] for line in (run / "curve.csv").read_text().split()[1:]] == ["16", "32", "48"]
    assert open_run(run).env_id == "PIAvatar/Stand-v0"


def test_a_training_whose_rank_has_failed_goes_on_from_its_checkpoint_bit_for_bit(trained):
    log = (trained / "log").read_text()
    own, others = (len(re.findall(f"error: {where}the cable of rank 1", log)) for where in ("", r"rank 1 on \S+: "))
    assert own == 1 and others == 1, log[-4000:]
    assert [own["resumed"] for own in facts(trained, "fails")] == [1, 1]
    whole, resumed = (saved(trained / fate) for fate in ("whole", "fails"))
    bits, others = (flat([content["state"], content["others"]]) for content in (whole, resumed))
    timed = {".0.curve.seconds", ".0.logged.1"}
    assert [name for name in bits if others[name] != bits[name] and name not in timed] == [] and len(bits) > 800
    curves = [(trained / fate / "curve.csv").read_text() for fate in ("whole", "fails")]
    assert curves[0] == curves[1]


def test_a_checkpoint_is_for_as_many_ranks(trained):
    with pytest.raises(SystemExit, match="written by 2 ranks, now there are 1; start as many"):
        rsl_train.main([*RSL, "--out", str(trained / "whole"), "--resume"])


def test_an_interrupt_of_torchrun_ends_all_ranks_at_a_checkpoint(trained):
    log = (trained / "log").read_text()
    found = re.search(r"interrupted after (\d+) of 1000 iterations; go on with (.*)", log)
    assert found and log.count("interrupted after") == 1, log[-4000:]
    again = "torchrun --nnodes=2 --nproc-per-node=1 -m agents.skrl.train "
    assert found[2].startswith(again) and found[2].endswith("--resume")
    content = saved(trained / "interrupts")
    assert content["state"]["iterations"] == int(found[1]) and len(content["others"]) == 1
    assert content["state"]["playing"][0] == content["others"][0]["playing"][0] == int(found[1]) * 2 * 2 * 4


def rows(env, step) -> np.ndarray:
    """Return what environments observe in some steps of equal actions."""
    return np.stack([np.asarray(step(env)) for _ in range(8)], axis=1)


@pytest.mark.parametrize("library", ["rsl_rl", "skrl"])
def test_two_ranks_of_n_are_one_batch_of_2n_bit_for_bit(library):
    if library == "rsl_rl":
        config = load_rsl(ROOT / RSL[0], {"env.fidelity": "tiny", "env.episode_seconds": 0.1, "num_envs": 2})
        make, task = rsl_train.make_env, lambda: new_task(config, rsl_train.load_task)

        def step(env):
            return env.step(torch.full((env.num_envs, env.num_actions), 0.5))[0]["policy"]

    else:
        overrides = {"env.fidelity": "tiny", "env.episode_seconds": 0.1, "num_envs": 2}
        config = load_batched(skrl_train.MAPPOTraining, skrl_train.find_world, ROOT / SKRL[0], overrides)
        task = lambda: new_task(config, skrl_train.find_world)  # noqa: E731

        def make(config, task, device, ranks):
            env = skrl_train.Worlds(type(task), config.num_envs, device, task.config, ranks.threads)
            env.reset(config.first_seed_on(ranks))
            return env

        def step(env):
            actions = {name: torch.full((env.num_envs, env.host.action_size), 0.5) for name in env.agents}
            env.step(actions)
            return env.state()

    seen = [rows(make(config, task(), "cpu", ranks), step) for ranks in BOTH]
    whole = rows(make(config.model_copy(update={"num_envs": 4}), task(), "cpu", ALONE), step)
    assert np.array_equal(np.concatenate(seen), whole) and not np.array_equal(*seen)
    assert np.abs(np.diff(whole, axis=1)).max() > 0.0


def test_the_assist_of_all_ranks_spreads_as_over_one_batch():
    overrides = {"env.fidelity": "tiny", "num_envs": 2, "assist": {"first": 0.6, "rollouts": 4}}
    config = load_rsl(ROOT / RSL[0], overrides)
    envs = [rsl_train.make_env(config, new_task(config, rsl_train.load_task), "cpu", ranks) for ranks in BOTH]
    assists = torch.cat([env.curricula["assist"].assist for env in envs])
    assert assists.tolist() == pytest.approx([0.0, 0.2, 0.4, 0.6])


def test_the_first_rank_of_a_machine_builds_before_the_others(monkeypatch):
    done: list[str] = []
    monkeypatch.setattr(Ranks, "any", lambda self, flag: done.append("all are here"))
    for place in (Ranks(2, 4, 0, 2), Ranks(3, 4, 1, 2)):
        with place.leaders_first():
            done.append(f"rank {place.rank} builds")
    assert done == ["rank 2 builds", "all are here", "all are here", "rank 3 builds"]


def test_ranks_make_as_many_minibatches_as_the_one_with_the_fewest(monkeypatch):
    monkeypatch.setattr(Ranks, "least", lambda self, number: min(number, self.size))
    memory = ActedMemory(memory_size=4, num_envs=2, device="cpu", ranks=Ranks(0, 2))
    memory.create_tensor(name="x", size=1)
    assert len(memory.sample(["x"], batch_size=4, mini_batches=4)) == 2


def test_places_and_devices_come_from_torchrun(monkeypatch):
    names = {"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2"}
    place = Ranks.here(names)
    assert place == Ranks(3, 4, 1, 2) and not place.first and Ranks.here({}) == ALONE and ALONE.first
    assert Ranks.here(names | {"WORLD_SIZE": "1"}) == ALONE
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert [place.device(asked) for asked in ("cpu", "cuda", "cuda:0")] == ["cpu", "cuda:1", "cuda:0"]
    assert ALONE.device("cuda") == "cuda"
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ConfigError, match="2 ranks on a machine with 1 GPUs; start --nproc-per-node=1"):
        place.device("cuda")


def test_what_ranks_cannot_do_is_refused(monkeypatch, tmp_path):
    config = load_rsl(ROOT / RSL[0], {"num_envs": 2**15})
    assert config.first_seed_on(BOTH[1]) == config.first_seed + 2**15
    with pytest.raises(ConfigError, match="num_envs=32768 on each of 3 ranks are 98304 environments"):
        config.first_seed_on(Ranks(0, 3))
    monkeypatch.setenv("TORCHELASTIC_MAX_RESTARTS", "2")
    with pytest.raises(SystemExit, match=r"--max-restarts=2 .* add --resume"):
        rsl_train.main([*RSL, "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("how", ["silent", "failed", "here", "lost"])
def test_a_rank_ends_with_the_message_of_another(how, monkeypatch, capfd):
    """Without a message where torchrun ends it, and with that of a store which does not answer."""
    monkeypatch.setattr(ranks_module, "_POLL", 0.01)
    monkeypatch.setattr(ranks_module, "_MISSED", 3)
    monkeypatch.setattr(ranks_module, "_GRACE", 0.01)
    exits, over = [], threading.Event()
    monkeypatch.setattr(os, "_exit", lambda status: (exits.append(status), over.set()))
    store = torch.distributed.HashStore()
    monkeypatch.setenv("GROUP_RANK", "0")
    watch = ranks_module._Watch(store, Ranks(0, 2))

    def lost():
        raise RuntimeError("Connection reset by peer")

    store.set("beats_1", "1")
    if how in ("failed", "here"):
        store.set("failed", f"{'7' if how == 'failed' else '0'}\nrank 1 on there: it has run dry")
    if how == "lost":
        monkeypatch.setattr(watch, "_beat", lost)
    watch.start()
    assert over.wait(10.0) and exits == [1]
    printed = {
        "silent": "error: rank 1 has had no heartbeat for 0 s\n",
        "failed": "error: rank 1 on there: it has run dry\n",
        "here": "",
        "lost": "error: rank 0 has lost torchrun's store: RuntimeError: Connection reset by peer\n",
    }
    assert capfd.readouterr().err == printed[how]


def test_a_group_has_a_name_that_no_earlier_one_has_had():
    """Although the store holds numbers and replies of the one before, and ranks start at different times."""
    store, places = torch.distributed.HashStore(), [Ranks(rank, 3) for rank in range(3)]
    names = []
    for _ in range(3):
        found: dict[int, str] = {}

        def agree(own: Ranks, found: dict[int, str] = found) -> None:
            found[own.rank] = ranks_module._fresh_name(store, own)

        threads = [threading.Thread(target=agree, args=(own,)) for own in places]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30.0)
        assert len(set(found.values())) == 1 and len(found) == 3
        names.append(found[0])
        places.reverse()
    assert len(set(names)) == 3
