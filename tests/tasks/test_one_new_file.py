"""A new task and a new game are one file each: registered from outside, or dropped into the package's folders."""

from __future__ import annotations

import importlib
import sys

import gymnasium as gym
import numpy as np
import pytest

import piavatar_envs
from piavatar_envs import cli, play, tasks
from piavatar_envs.multi import listed_games, load_game, parallel_env
from piavatar_envs.tasks import games

TASK = '''
"""Balance: keep the pelvis high."""

import warp as wp

import piavatar_envs
from piavatar_envs.envs.task import Metric, Task, TaskArray, Term
from piavatar_envs.tasks.common.spawn import record_standing


@wp.kernel
def judge(
    position: wp.array2d(dtype=wp.vec3),
    best: wp.array(dtype=float),
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
):
    e = wp.tid()
    best[e] = wp.max(best[e], position[e, 0][2])
    terms[e, 0, 0] = position[e, 0][2]
    metrics[e, 0, 0] = best[e]


class BalanceTask(Task):
    rewards = (Term("height", "height of the pelvis [m]"),)
    metrics = (Metric("best", "m", "greatest height of the episode"),)
    state_arrays = (TaskArray("best", cleared=True),)

    def record_reset(self, env, graph):
        record_standing(env, graph, noise=0.1)

    def record_outcome(self, env, graph):
        inputs = [env.simulation.avatar.tracked.position]
        graph.launch(judge, env.num_envs, inputs, [self.best, env.terms, env.metrics])


TASK = BalanceTask
'''
GAME = '''
"""Apart: two avatars move away from each other."""

import warp as wp
from pydantic import Field

import piavatar_envs
from piavatar_envs.config import EnvConfig
from piavatar_envs.envs.task import Task, Term
from piavatar_envs.tasks.common.multi_agent import on_circle
from piavatar_envs.tasks.common.spawn import record_standing


class ApartConfig(EnvConfig):
    start_distance: float = Field(1.2, ge=0.6, le=5.0, description="between the two at the start [m]")


@wp.kernel
def judge(one: wp.array2d(dtype=wp.vec3), two: wp.array2d(dtype=wp.vec3), terms: wp.array3d(dtype=float)):
    e = wp.tid()
    for agent in range(2):
        terms[e, agent, 0] = wp.length(one[e, 0] - two[e, 0])


class ApartTask(Task):
    Config = ApartConfig
    rewards = (Term("distance", "distance of the pelvises [m]"),)
    observes_others = True

    def build_scene(self):
        return on_circle(self.config.scene, 2, self.config.start_distance)

    def record_reset(self, env, graph):
        record_standing(env, graph, noise=0.1)

    def record_outcome(self, env, graph):
        one, two = (avatar.tracked.position for avatar in env.simulation.avatars)
        graph.launch(judge, env.num_envs, [one, two], [env.terms])


TASK = ApartTask
'''
REGISTER = {
    "task": '\npiavatar_envs.register_task("Elsewhere/Balance-v0", BalanceTask)\n',
    "game": '\npiavatar_envs.register_game("apart_v0", ApartTask)\n',
}


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Modules of another author on the path, which register a task and a game; nothing is left afterwards."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "other_tasks.py").write_text(TASK + REGISTER["task"])
    (tmp_path / "other_games.py").write_text(GAME + REGISTER["game"])
    yield
    for name in ("other_tasks", "other_games"):
        sys.modules.pop(name, None)
    gym.registry.pop("Elsewhere/Balance-v0", None)
    tasks._added.pop("Elsewhere/Balance-v0", None)
    games._added.pop("apart_v0", None)


@pytest.fixture
def dropped_in(tmp_path, monkeypatch):
    """One file more in each of the package's folders."""
    for package, name, text in ((tasks, "balance", TASK), (games, "apart", GAME)):
        folder = tmp_path / package.__name__
        folder.mkdir()
        (folder / f"{name}.py").write_text(text)
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(folder)])
    importlib.invalidate_caches()
    yield
    for name in ("piavatar_envs.tasks.balance", "piavatar_envs.tasks.games.apart"):
        sys.modules.pop(name, None)


def acted(env, steps: int = 2) -> float:
    """Sum of the rewards of a few random steps."""
    env.reset(seed=0)
    random, total = np.random.default_rng(0), 0.0
    for _ in range(steps):
        actions = {name: random.uniform(-1.0, 1.0, env.action_space(name).shape) for name in env.agents}
        total += sum(env.step(actions)[1].values())
    env.close()
    return total


def test_a_registered_task_runs_and_passes_the_conformance_check(elsewhere, device):
    env = gym.make("other_tasks:Elsewhere/Balance-v0", fidelity="tiny", device=device)
    env.reset(seed=0)
    *_, info = env.step(np.zeros(env.action_space.shape))
    assert info["reward_terms"]["height"] == pytest.approx(info["best"], abs=0.05) and info["best"] > 0.7
    env.close()
    assert "Elsewhere/Balance-v0" in cli.registered_ids()
    piavatar_envs.check_task("Elsewhere/Balance-v0", 6, device)


def test_a_registered_game_is_listed_loaded_played_and_built(elsewhere, device):
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    game = load_game("other_games:apart_v0")
    assert game.TASK is sys.modules["other_games"].ApartTask and "apart_v0" in listed_games()
    assert "apart_v0" in cli.registered_ids()
    settings = {"fidelity": "tiny", "device": device}
    total = acted(parallel_env("apart_v0", **settings))
    assert total > 2.0 and acted(game.parallel_env(**settings)) == total
    cli.check_id("other_games:apart_v0")
    rollout = play.play("other_games:apart_v0", steps=2, device=device, overrides={"fidelity": "tiny"})
    assert rollout.steps == 2 and "agent_1.reward_terms.distance" in rollout.metrics


def test_a_file_in_the_folders_of_the_package_is_found(dropped_in, device):
    assert tasks.task_modules()["PIAvatar/Balance-v0"] == "balance"
    env = piavatar_envs.api.gym_env.AvatarEnv("PIAvatar/Balance-v0", fidelity="tiny", device=device)
    env.reset(seed=0)
    assert env.step(np.zeros(env.action_space.shape))[1] > 0.7
    env.close()
    assert "apart_v0" in listed_games()
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    assert acted(parallel_env("apart_v0", fidelity="tiny", device=device)) > 2.0


@pytest.mark.parametrize(
    ("name", "task", "error", "reason"),
    [
        ("apart", "other_games:ApartTask", ValueError, "'apart'.* version"),
        ("sumo_v0", "other_games:ApartTask", ValueError, "'sumo_v0' is a game of this package"),
        ("apart_v0", "ApartTask", TypeError, "apart_v0: 'ApartTask'"),
    ],
)
def test_games_that_cannot_be_named_are_refused(name, task, error, reason):
    before = listed_games()
    with pytest.raises(error, match=reason):
        piavatar_envs.register_game(name, task)
    assert listed_games() == before
