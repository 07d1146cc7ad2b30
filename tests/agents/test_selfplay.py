"""Self-play: the pool, the snapshots drawn from it, and training runs of seconds that beat where they began."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from agents.checkpoint import Checkpoint
from agents.evaluate import Episode
from agents.sb3 import matches, ppo, selfplay, train
from agents.sb3.config import TrainingConfig, load_training
from agents.sb3.learning import begin, learn
from agents.sb3.parallel import AgentVecEnv, WorldFactory
from agents.sb3.selfplay import Opponents, Pool
from agents.sb3.workers import factory, prepare
from piavatar_envs.config import ConfigError, dump_yaml
from tests.agents.killing import KillAt, Killed

AUCTION = {
    "env_id": "auction_v0",
    "total_steps": 4 * 192,
    "num_workers": 2,
    "checkpoint_every": 192,
    "seed": 3,
    "selfplay": {"duel_share": 0.5, "snapshot_every": 192, "evaluate_against": ["random", "first"]},
    "ppo": {"rollout_steps": 64, "batch_size": 48, "epochs": 5, "hidden": [16], "learning_rate": 5e-3},
    "evaluation": {"episodes": 20},
}


@pytest.fixture
def auction(games) -> TrainingConfig:
    """A training run of a second or two."""
    return load_training(AUCTION)


def keep(config: TrainingConfig, folder) -> Checkpoint:
    folder.mkdir(exist_ok=True)
    return Checkpoint(folder, "sb3.train", config, "cpu", resume=True)


def play(config: TrainingConfig, folder, checkpoint: Checkpoint | None = None, watcher: BaseCallback | None = None):
    """Train as ``train.train_selfplay`` does, with all worlds in this process."""
    make = factory(config)
    folder.mkdir(parents=True, exist_ok=True)
    venv = AgentVecEnv(DummyVecEnv([make] * config.num_workers), config.selfplay.num_duels(config.num_workers))
    model = begin(config, venv, prepare(make), checkpoint)
    snapshots = selfplay.enter(config.selfplay, venv, model, folder, train.pool_of(checkpoint))
    curve = learn(config, model, folder, checkpoint, watchers=[snapshots, *([watcher] if watcher else [])])
    return model, snapshots.pool, curve


def weights(model) -> np.ndarray:
    return np.concatenate([value.detach().numpy().ravel() for value in model.policy.parameters()])


@pytest.fixture
def policy():
    """Of an untrained agent of the auction."""
    venv = AgentVecEnv(DummyVecEnv([WorldFactory("tests.agents.games.auction_v0", {})]))
    return ppo.build(ppo.PPOSettings(hidden=(4,)), venv, range(2), seed=0).policy


def always(policy, action: float):
    """Let it take this action, whatever it sees."""
    with torch.no_grad():
        for value in policy.parameters():
            value.fill_(0.0)
        policy.action_net.bias.fill_(action)
        policy.log_std.fill_(-10.0)
    return policy


def test_a_pool_goes_on_as_it_was_and_begins_empty(policy, tmp_path):
    pool = Pool(tmp_path / "pool")
    for steps in (0, 100, 1000):
        pool.add(policy, steps)
    # it forgets what came after the checkpoint
    assert Pool(pool.folder, [0, 100]).steps == [0, 100]
    assert sorted(path.name for path in pool.folder.iterdir()) == ["snapshot_0_steps.pt", "snapshot_100_steps.pt"]
    with pytest.raises(ConfigError, match=r"has no snapshot_1000_steps\.pt; resume in the folder of the run"):
        Pool(pool.folder, [0, 100, 1000])
    with pytest.raises(ConfigError, match="has no snapshot_7_steps"):
        Pool(tmp_path / "elsewhere", [7])
    assert not (tmp_path / "elsewhere").exists() and len(list(pool.folder.iterdir())) == 2, "nothing has changed"
    assert Pool(pool.folder).steps == []
    assert not list(pool.folder.iterdir())


def test_opponents_act_as_the_drawn_snapshot_and_all_are_drawn(policy, tmp_path):
    pool = Pool(tmp_path)
    for steps in (0, 10, 20):
        pool.add(always(policy, steps / 50.0), steps)
    opponents = Opponents(pool, always(policy, 0.9), worlds=(4, 5))
    rng = np.random.default_rng(0)
    observation = np.array([[0.5, 0.5]], np.float32)
    drawn = []
    for _ in range(40):
        for world in (4, 5):
            opponents.draw(world, rng)
        for world in (4, 5):
            action = opponents.act(world, observation)
            assert action.shape == (1, 1)
            assert action[0, 0] == pytest.approx(opponents.drawn[world] / 50.0, abs=1e-3)
            drawn.append((world, opponents.drawn[world]))
    assert set(drawn) == {(world, steps) for world in (4, 5) for steps in pool.steps}


class Watch(BaseCallback):
    """Which snapshots have played, and in the episodes of which seeds."""

    def __init__(self) -> None:
        super().__init__()
        self.drawn: list[tuple[int, int]] = []
        self.seeds: set[int] = set()

    def _on_step(self) -> bool:
        venv = self.training_env.unwrapped
        self.drawn.append((self.num_timesteps, venv.opponents.drawn[venv.duels[0]]))
        self.seeds |= {world.env.seed for world in venv.worlds.envs}
        return True


def test_what_is_interrupted_goes_on_with_its_pool_as_if_it_had_not_been(auction, tmp_path):
    """Killed in the third rollout; the checkpoint is of its start, when a third snapshot had just joined the pool."""
    runs = {}
    for name, stops in (("whole", []), ("parts", [500])):
        folder = tmp_path / name
        for at in stops:
            with pytest.raises(Killed):
                play(auction, folder, checkpoint=keep(auction, folder), watcher=KillAt(at))
            (folder / "pool" / "snapshot_9999_steps.pt").touch()  # of a future that will not come
        watch = Watch()
        model, pool, curve = play(auction, folder, checkpoint=keep(auction, folder), watcher=watch)
        assert model.num_timesteps == auction.total_steps and pool.steps == [0, 192, 384, 576]
        runs[name] = weights(model), curve, watch.drawn
    np.testing.assert_array_equal(runs["whole"][0], runs["parts"][0])
    assert runs["whole"][1].steps == runs["parts"][1].steps
    assert runs["whole"][1].returns == runs["parts"][1].returns
    drawn = runs["parts"][2]
    assert drawn == [(step, snapshot) for step, snapshot in runs["whole"][2] if step > 384]
    assert {0, 192} & {snapshot for _, snapshot in drawn}  # the old ones play on


def test_self_play_beats_where_it_began(games, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("agents.sb3.workers.start_workers", lambda make, count: DummyVecEnv([make] * count))
    path = tmp_path / "auction.yaml"
    path.write_text(dump_yaml(load_training(AUCTION)))
    settings = ["total_steps=2304", "selfplay.snapshot_every=576", "checkpoint_every=1000"]
    train.main([str(path), *settings, "--out", str(tmp_path / "run")])
    left = {entry.name for entry in (tmp_path / "run").iterdir()}
    assert {"policy.zip", "curve.csv", "results.json", "pool", "checkpoint.pt"} <= left
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert results["agents"] == ["left", "right"]
    rows = {row["case"]: row for row in results["results"]}
    assert list(rows) == [
        "zero against random", "trained against random", "zero against first", "random against first",
        "trained against first",
    ]  # fmt: skip
    for opponent in ("random", "first"):
        trained, zero = rows[f"trained against {opponent}"], rows[f"zero against {opponent}"]
        assert trained["win_interval"][0] > 0.5
        assert trained["win_interval"][0] > zero["win_interval"][1]
        assert trained["return_interval"][0] > trained["opponent_return_interval"][1]
        assert trained["episodes"] == 20
    assert load_training(tmp_path / "run" / "config.yaml").selfplay.snapshot_every == 576
    assert "trained against first" in capsys.readouterr().out


def test_cooperation_learns_to_meet(games, tmp_path):
    config = load_training(
        {
            "env_id": "rendezvous_v0",
            "total_steps": 8192,
            "num_workers": 4,
            "ppo": {"rollout_steps": 128, "batch_size": 128, "epochs": 8, "hidden": [32], "learning_rate": 3e-3},
            "evaluation": {"episodes": 20},
        }
    )
    make = factory(config)
    workers = DummyVecEnv([make] * 4)
    curve, results = train.train_cooperative(config, workers, prepare(make), tmp_path, None)
    assert len(curve.returns) > 100
    rows = {result.agent: result.row() for result in results}
    assert list(rows) == ["zero", "random", "trained"]
    for other in ("zero", "random"):
        assert rows["trained"]["return_interval"][0] > rows[other]["return_interval"][1]
        assert rows["trained"]["success_at_end_interval"][0] > rows[other]["success_at_end_interval"][1]
    # both are paid the same, and an episode's return is their mean
    assert rows["zero"]["agent_return_mean"][0] == rows["zero"]["agent_return_mean"][1]
    assert rows["zero"]["return_mean"] == pytest.approx(rows["zero"]["agent_return_mean"][0])


def game(totals, success, steps=3):
    return Episode(5, steps=steps, agent_totals=np.array(totals, float), agent_success=np.array(success))


def test_a_match_counts_from_the_players_seat():
    games = (
        game([3.0, 1.0], [True, False]), game([2.0, 0.0], [True, False]), game([0.0, 4.0], [False, True]),
        game([1.0, 1.0], [True, True]),
    )  # fmt: skip
    row = matches.Match("a", "b", (0, 1, 1, 0), games).row()
    assert row["case"] == "a against b"
    assert (row["win_rate"], row["loss_rate"], row["draw_rate"]) == (0.5, 0.25, 0.25)
    assert row["return_mean"] == (3.0 + 0.0 + 4.0 + 1.0) / 4
    assert row["opponent_return_mean"] == (1.0 + 2.0 + 0.0 + 1.0) / 4
    # Wilson (1927): (p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4 n^2)) / (1 + z^2 / n)
    z, n, p = 1.959964, 4, 0.5
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    np.testing.assert_allclose(
        row["win_interval"], [(p + z**2 / (2 * n) + s * half) / (1 + z**2 / n) for s in (-1, 1)], rtol=1e-5
    )
