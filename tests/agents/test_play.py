"""Letting what training runs have left play again."""

from __future__ import annotations

import json
import pickle
import shutil
import zipfile

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra train")
pytest.importorskip("stable_baselines3", reason="needs the extra train")

from agents import play, scores  # noqa: E402
from agents.files import write_config  # noqa: E402
from agents.play import open_run  # noqa: E402
from agents.rllib.policy import actors, load_rllib  # noqa: E402
from piavatar_envs.api.host import EpisodeHost  # noqa: E402
from piavatar_envs.config import ConfigError, load_config  # noqa: E402
from piavatar_envs.tasks import load_task  # noqa: E402


def test_settings_win_and_a_film_is_written(run_of, device, tmp_path, capsys):
    pytest.importorskip("PIL", reason="needs the extra render")
    film = tmp_path / "film.gif"
    small = ("env.render.width=64", "render.height=64")
    line = [str(run_of("ppo")), "episode_seconds=0.1", *small, "--film", str(film)]
    capsys.readouterr()
    play.main([*line, "--device", device])
    assert "trained" not in capsys.readouterr().out, "a film alone plays no other episodes"
    from PIL import Image

    with Image.open(film) as pictures:
        assert pictures.n_frames == 3 and pictures.size == (64, 64)
    play.main([*line, "--episodes", "2", "--device", device])
    assert "trained" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["ppo", "pixels"])
def test_an_episode_is_exported(kind, run_of, device, tmp_path, capsys):
    line = [str(run_of(kind)), "episode_seconds=0.1", "--export", str(tmp_path / "film"), "--format", "ply"]
    capsys.readouterr()
    play.main([*line, "--device", device])
    assert "trained" not in capsys.readouterr().out, "an export alone plays no other episodes"
    files = sorted(file.name for file in (tmp_path / "film" / "body_0").iterdir())
    assert files == [f"{frame:04d}.ply" for frame in range(4)]
    with pytest.raises(SystemExit, match="not empty"):
        play.main(line)  # the folder holds a film


QUICK = ("env.fidelity=tiny", "env.episode_seconds=0.2", "evaluation.episodes=3")
TRAININGS = {
    "rsl": (
        "configs/rsl_rl/reach_rsl.yaml", "num_envs=2", "iterations=2", "ppo.rollout_steps=4", "ppo.minibatches=1",
        "ppo.epochs=1",
    ),
    "pixels": (
        "configs/rsl_rl/reach_pixels_rsl.yaml", "num_envs=2", "iterations=2", "ppo.rollout_steps=4",
        "ppo.minibatches=1", "ppo.epochs=1", "env.pixels.width=36", "env.pixels.height=36",
    ),
    "ppo": ("configs/sb3/reach_sb3.yaml", "total_steps=16", "num_workers=2", "ppo.rollout_steps=8", "ppo.batch_size=8"),
    "sac": ("configs/sb3/reach_sac.yaml", "total_steps=16", "num_workers=2", "sac.first_random=4", "sac.batch_size=4"),
}  # fmt: skip


@pytest.fixture(scope="module")
def run_of(device, tmp_path_factory):
    """Folders of short training runs, one per kind."""
    root = tmp_path_factory.mktemp("runs")

    def run(kind: str):
        if kind in ("rsl", "pixels"):
            for needed in ("rsl_rl", "tensordict", "git"):
                pytest.importorskip(needed, reason="needs the extra rsl")
            from agents.rsl_rl import train as script
        else:
            from agents.sb3 import train as script
        if not (root / kind).exists():
            script.main([*TRAININGS[kind], *QUICK, "--out", str(root / kind), "--device", device])
        return root / kind

    return run


@pytest.mark.parametrize("kind", TRAININGS)
def test_policies_play_as_in_training_in_figures_and_live(kind, run_of, device, tmp_path, capsys, monkeypatch):
    folder = shutil.copytree(run_of(kind), tmp_path / "run")
    play.main([str(folder), "--device", device, "--out", str(folder / "evaluation.json")])
    then, now = (json.loads((folder / name).read_text()) for name in ("results.json", "evaluation.json"))
    zero, _, trained = then["results"]
    assert now["results"] == [trained] and trained["return_mean"] != zero["return_mean"]
    scores.main([str(folder)])  # takes it for an evaluation of this run
    pytest.importorskip("viser", reason="needs the extra live")
    totals = []

    def watch_setup(setup, kinds, port):
        host = setup.make()
        host.reset(setup.seed)
        agent, over, total = kinds[setup.agent].make(host, setup.seed), False, 0.0
        agent.begin(np.ones(1, bool))
        while not over:
            host.step(agent.act(0))
            total, over = total + float(host.reward()[0, 0]), bool(host.find_ended()[0])
        totals.append((setup.seed, port, total))

    monkeypatch.setattr("piavatar_envs.watch.watch_setup", watch_setup)
    play.main([str(folder), "--live", "--port", "8500", "--first-seed", "7", "--device", device])
    run = open_run(folder)
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
def test_what_cannot_be_played_is_refused(options, words, run_of, device, monkeypatch):
    folder = run_of("ppo")
    for builder in ("EpisodeHost", "EnvFactory"):
        monkeypatch.setattr(play, builder, None)  # nothing is built
    with pytest.raises(SystemExit, match=f"error: .*{words}"):
        play.main([str(folder), *options, "--device", device])


def test_a_policy_of_rllib_plays_without_it(tmp_path, device):
    """Compare the actions with those of the weights as RLlib names them; a file of other sizes is refused."""
    config = load_rllib({"env": {"fidelity": "tiny"}, "observe": ["target_position"], "ppo": {"hidden": [4]}})
    batch = EpisodeHost(load_task(config.env_id)(load_config(load_task(config.env_id).Config, config.env)), 2, device)
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(4, 3)), rng.normal(size=(batch.action_size, 4))
    weights = {
        "encoder.actor_encoder.net.mlp.0.weight": first,
        "encoder.actor_encoder.net.mlp.0.bias": np.ones(4),
        "pi.net.mlp.0.weight": second,
        "pi.net.mlp.0.bias": np.zeros(batch.action_size),
        "pi.log_std": np.zeros(batch.action_size),
    }
    networks = actors({"default_policy": {name: value.astype(np.float32) for name, value in weights.items()}})
    write_config(tmp_path, config)
    torch.save({name: network.state_dict() for name, network in networks.items()}, tmp_path / "policy.pt")
    batch.reset([0, 1])
    seen = batch.observation()
    run = open_run(tmp_path)
    action = run.make_agent(batch.layout, batch.action_size)(seen)
    hidden = np.tanh(seen[:, 0, batch.layout["target_position"].slice] @ first.T + 1.0)
    np.testing.assert_allclose(action[:, 0], np.clip(hidden @ second.T, -1.0, 1.0), atol=1e-5)
    with pytest.raises(ConfigError, match=r"policy\.pt holds no policy of its config\.yaml that sees 3 numbers"):
        run.make_agent(batch.layout, batch.action_size + 1)


def test_nothing_is_unpickled(run_of, device, tmp_path):
    """A file that would run code when it is unpickled is refused, and does not."""

    class Trap:
        def __reduce__(self):
            return (np.save, (str(tmp_path / "sprung"), np.zeros(1)))

    policy = shutil.copytree(run_of("ppo"), tmp_path / "run") / "policy.zip"
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
