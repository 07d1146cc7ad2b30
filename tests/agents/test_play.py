"""Letting what trainings have left play again."""

from __future__ import annotations

import json
import pickle
import zipfile

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra train")
pytest.importorskip("stable_baselines3", reason="needs the extra train")

from agents import play, scores  # noqa: E402
from agents.play import open_run  # noqa: E402
from agents.sb3 import train  # noqa: E402
from piavatar_envs.api.host import EpisodeHost  # noqa: E402
from piavatar_envs.config import load_config  # noqa: E402
from piavatar_envs.tasks import load_task  # noqa: E402

QUICK = ("env.fidelity=tiny", "env.episode_seconds=0.2", "evaluation.episodes=3")
SB3 = {
    "ppo": ("configs/sb3/reach_sb3.yaml", "total_steps=16", "num_workers=2", "ppo.rollout_steps=8", "ppo.batch_size=8"),
    "sac": ("configs/sb3/reach_sac.yaml", "total_steps=16", "num_workers=2", "sac.first_random=4", "sac.batch_size=4"),
}


def run_of(kind: str, folder, device: str) -> None:
    """A short training."""
    if kind == "rsl":
        for needed in ("rsl_rl", "tensordict", "git"):
            pytest.importorskip(needed, reason="needs the extra rsl")
        from agents.rsl_rl import train as rsl_ppo

        few = ("num_envs=2", "iterations=2", "ppo.rollout_steps=4", "ppo.minibatches=1", "ppo.epochs=1")
        rsl_ppo.main(["configs/rsl_rl/reach_rsl.yaml", *QUICK, *few, "--out", str(folder), "--device", device])
    else:
        train.main([*SB3[kind], *QUICK, "--out", str(folder), "--device", device])


@pytest.mark.parametrize("kind", ["rsl", *SB3])
def test_what_was_trained_plays_as_it_did(kind, device, tmp_path, capsys):
    run_of(kind, tmp_path / "run", device)
    play.main([str(tmp_path / "run"), "--device", device, "--out", str(tmp_path / "run" / "evaluation.json")])
    then, now = (json.loads((tmp_path / "run" / name).read_text()) for name in ("results.json", "evaluation.json"))
    (trained,) = (row for row in then["results"] if row["case"] == "trained")
    assert now["results"] == [trained], "the same episodes, the same actions"
    untrained = next(row for row in then["results"] if row["case"] == "zero")
    assert trained["return_mean"] != untrained["return_mean"]
    scores.main([str(tmp_path / "run")])  # takes it for an evaluation of this run


def test_settings_win_and_a_film_is_written(device, tmp_path, capsys):
    pytest.importorskip("pyvista", reason="needs the extra render")
    run_of("ppo", tmp_path / "run", device)
    film = tmp_path / "film.gif"
    small = ("env.render.width=64", "render.height=64")
    line = [str(tmp_path / "run"), "episode_seconds=0.1", *small, "--film", str(film)]
    capsys.readouterr()
    play.main([*line, "--device", device])
    assert "trained" not in capsys.readouterr().out, "a film alone plays no other episodes"
    from PIL import Image

    with Image.open(film) as pictures:
        assert pictures.n_frames == 3 and pictures.size == (64, 64)
    play.main([*line, "--episodes", "2", "--device", device])
    assert "trained" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["rsl", "ppo"])
def test_it_plays_live_as_it_does_in_an_evaluation(kind, device, tmp_path, capsys, monkeypatch):
    pytest.importorskip("viser", reason="needs the extra live")
    run_of(kind, tmp_path / "run", device)
    totals = []

    def watch_env(env, act, seed, port, begin):
        begin()
        observation, _ = env.reset(seed=seed)
        over, total = False, 0.0
        while not over:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, over = total + reward, terminated or truncated
        totals.append((seed, port, total))
        raise KeyboardInterrupt  # ends it as Ctrl-C does: quietly

    monkeypatch.setattr("piavatar_envs.watch.watch_env", watch_env)
    play.main([str(tmp_path / "run"), "--live", "--port", "8500", "--first-seed", "7", "--device", device])
    run = open_run(tmp_path / "run")
    task = load_task(run.env_id)
    batch = EpisodeHost(task(load_config(task.Config, run.env)), 1, device)
    (episode,) = play.play("trained", run.make_agent(batch.layout, batch.action_size), batch, 7).episodes
    assert totals == [(7, 8500, pytest.approx(episode.total, rel=1e-4))]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--episodes", "1"), r"episodes=1 must be >= 2: .*a film alone needs no --episodes"),
        (("--episodes", "0"), r"episodes=0 must be >= 2"),
        (("--film-every", "0"), r"film_every=0 must be >= 1"),
        (("--film-episodes", "0"), r"film_episodes=0 must be >= 1"),
        (("--first-seed", "-1"), r"first_seed=-1 must be >= 0 and <= 4294967295"),
        (("--live", "--port", "0"), r"port=0 is outside \[1, 64536\]"),
        (("--first-seed", "4294967295", "--episodes", "2"), r"first_seed=4294967295 must be >= 0 and <= 4294967294"),
        (("--film", "x.avi"), r"video x\.avi ends in '\.avi'; use \.mp4 or \.gif"),
        (("joints=[tail]",), r"'tail' is not a joint"),
    ],
)
def test_what_cannot_be_played_is_refused(options, words, device, tmp_path, capsys, monkeypatch):
    run_of("ppo", tmp_path / "run", device)
    for builder in ("EpisodeHost", "EnvFactory"):
        monkeypatch.setattr(play, builder, None)  # nothing is built
    with pytest.raises(SystemExit, match=f"error: .*{words}"):
        play.main([str(tmp_path / "run"), *options, "--device", device])


def test_nothing_is_unpickled(device, tmp_path, capsys):
    """A file that would run code when it is unpickled is refused, and does not."""

    class Trap:
        def __reduce__(self):
            return (np.save, (str(tmp_path / "sprung"), np.zeros(1)))

    run_of("ppo", tmp_path / "run", device)
    policy = tmp_path / "run" / "policy.zip"
    with zipfile.ZipFile(policy) as whole:
        members = {name: whole.read(name) for name in whole.namelist()}
    members["policy.pth"] = pickle.dumps(Trap())
    members["data"] = b"no JSON at all, and never read"
    with zipfile.ZipFile(policy, "w") as changed:
        for name, content in members.items():
            changed.writestr(name, content)
    with pytest.raises(SystemExit, match=r"holds no policy of its config\.yaml"):
        play.main([str(tmp_path / "run"), "--device", device])
    assert not (tmp_path / "sprung.npy").exists()
