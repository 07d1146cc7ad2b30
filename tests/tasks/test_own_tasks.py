"""Tasks and games of other authors: one file each, registered from outside or dropped into the package's folders."""

from __future__ import annotations

import importlib
import os
import sys

import gymnasium as gym
import numpy as np
import pytest

import piavatar_envs
from piavatar_envs import cli, play, tasks
from piavatar_envs.api.gym_env import AvatarEnv
from piavatar_envs.api.vector_env import AvatarVectorEnv
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.task import Task
from piavatar_envs.multi import listed_games, load_game, parallel_env
from piavatar_envs.tasks import games, load_task, reach

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
REGISTER_TASK = '\npiavatar_envs.register_task("Elsewhere/Balance-v0", BalanceTask)\n'
REGISTER_GAME = '\npiavatar_envs.register_game("apart_v0", ApartTask)\n'
BALANCE = "other_tasks:Elsewhere/Balance-v0"


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Put modules that register a task and a game on the path; nothing of them is left afterwards."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "other_tasks.py").write_text(TASK + REGISTER_TASK)
    (tmp_path / "other_games.py").write_text(GAME + REGISTER_GAME)
    yield
    for name in ("other_tasks", "other_games"):
        sys.modules.pop(name, None)
    gym.registry.pop("Elsewhere/Balance-v0", None)
    tasks._added.pop("Elsewhere/Balance-v0", None)
    games._added.pop("apart_v0", None)


@pytest.fixture
def dropped_in(tmp_path, monkeypatch):
    """Put one file more into each of the package's folders."""
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
    """Return the sum of the rewards of a few random steps of all agents."""
    env.reset(seed=0)
    random, total = np.random.default_rng(0), 0.0
    for _ in range(steps):
        actions = {name: random.uniform(-1.0, 1.0, env.action_space(name).shape) for name in env.agents}
        total += sum(env.step(actions)[1].values())
    env.close()
    return total


def test_a_registered_task_is_an_environment_like_all_others(elsewhere, device):
    """Gymnasium imports its module; one environment, many, and its class begin alike; the contract holds."""
    assert "other_tasks" not in sys.modules
    env = gym.make(BALANCE, fidelity="tiny", device=device)
    found = load_task("Elsewhere/Balance-v0")
    assert found is sys.modules["other_tasks"].BalanceTask is load_task(BALANCE) is load_task(found)
    one, _ = env.reset(seed=3)
    many = gym.make_vec("Elsewhere/Balance-v0", num_envs=2, fidelity="tiny", device=device)
    observations, _ = many.reset(seed=3)
    assert np.array_equal(observations[0], one) and not np.array_equal(observations[1], one)
    same = AvatarEnv(found, fidelity="tiny", device=device)
    assert np.array_equal(same.reset(seed=3)[0], one)
    *_, info = env.step(np.zeros(env.action_space.shape))
    assert info["reward_height"] == pytest.approx(info["best"], abs=0.05) and info["best"] > 0.7
    spec = env.spec
    assert spec.max_episode_steps == 150
    for name in ("Elsewhere/Balance-v0", "other_tasks:BalanceTask", found):
        made = gym.make(spec, task=name, fidelity="tiny", device=device)
        assert type(made.unwrapped.batch.task) is found
        spec = made.spec  # a spec of an environment makes it again
        made.close()
    for made in (env, many, same):
        made.close()
    piavatar_envs.check_task("Elsewhere/Balance-v0", 4, device)


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
@pytest.mark.parametrize(
    ("made", "task", "remedy"),
    [
        ("PIAvatar/Reach-v0", "KickBall-v0", "make 'PIAvatar/KickBall-v0'"),
        ("PIAvatar/Reach-v0", "Elsewhere/Balance-v0", "make 'Elsewhere/Balance-v0'"),
        ("PIAvatar/KickBall-v0", reach.ReachTask, "task='ReachTask' .*register_task"),
        ("Elsewhere/Balance-v0", "PIAvatar/Reach-v0", "make 'PIAvatar/Reach-v0'"),
    ],
)
def test_an_id_makes_no_other_task(elsewhere, monkeypatch, make, made, task, remedy):
    load_task(BALANCE)
    monkeypatch.setattr(BatchEnv, "__init__", None)  # refused before anything is built
    with pytest.raises(ValueError, match=remedy):
        make(made, task=task, fidelity="tiny")


def test_processes_that_have_not_imported_it_find_it(elsewhere, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    context = {"context": "spawn", "shared_memory": False}
    make = dict(fidelity="tiny", vectorization_mode="async", vector_kwargs=context)
    envs = gym.make_vec(BALANCE, num_envs=1, **make)
    observations, _ = envs.reset(seed=3)
    envs.close()
    one = AvatarEnv("other_tasks:BalanceTask", fidelity="tiny").reset(seed=3)[0]
    assert np.array_equal(observations[0], one)


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
    assert rollout.steps == 2 and "agent_1.reward_distance" in rollout.metrics


def test_a_file_in_the_folders_of_the_package_is_found(dropped_in, device):
    assert tasks.task_modules()["PIAvatar/Balance-v0"] == "balance" and "apart_v0" in listed_games()
    env = AvatarEnv("PIAvatar/Balance-v0", fidelity="tiny", device=device)
    env.reset(seed=0)
    assert env.step(np.zeros(env.action_space.shape))[1] > 0.7
    env.close()
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    assert acted(parallel_env("apart_v0", fidelity="tiny", device=device)) > 2.0


def test_the_command_line_plays_it(elsewhere, capsys):
    cli.main(["play", BALANCE, "--steps", "1", "-c", "fidelity=tiny"])
    assert "reward_height" in capsys.readouterr().out and "Elsewhere/Balance-v0" in cli.registered_ids()
    with pytest.raises(SystemExit):
        cli.main(["play", "no_such_module:Elsewhere/Balance-v0"])
    assert "no_such_module" in capsys.readouterr().err


def test_registering_again_replaces_without_a_warning(elsewhere, recwarn):
    load_task(BALANCE)
    piavatar_envs.register_task("Elsewhere/Balance-v0", reach.ReachTask)
    assert load_task("Elsewhere/Balance-v0") is reach.ReachTask and not recwarn.list


@pytest.mark.parametrize(
    ("own_id", "task", "error", "reason"),
    [
        ("Balance-v0", reach.ReachTask, ValueError, "namespace"),
        ("Elsewhere/Balance", reach.ReachTask, ValueError, "version"),
        ("else.where/Balance-v0", reach.ReachTask, ValueError, "namespace"),
        ("PIAvatar/Reach-v0", reach.ReachTask, ValueError, "one of your own"),
        ("Elsewhere/Balance-v0", reach.ReachConfig, TypeError, "subclass of Task"),
        ("Elsewhere/Balance-v0", "BalanceTask", TypeError, "module:Class"),
    ],
)
def test_tasks_that_cannot_be_registered_are_refused(own_id, task, error, reason):
    before = dict(gym.registry)
    with pytest.raises(error, match=reason):
        piavatar_envs.register_task(own_id, task)
    assert dict(gym.registry) == before
    if own_id != "PIAvatar/Reach-v0":
        with pytest.raises(ValueError, match="unknown task"):
            load_task(own_id)


@pytest.mark.parametrize(
    ("name", "task", "error", "reason"),
    [
        ("apart", "other_games:ApartTask", ValueError, "'apart'.* version"),
        ("sumo_v0", "other_games:ApartTask", ValueError, "'sumo_v0' .*this package"),
        ("apart_v0", "ApartTask", TypeError, "apart_v0: 'ApartTask'"),
    ],
)
def test_games_that_cannot_be_registered_are_refused(name, task, error, reason):
    before = listed_games()
    with pytest.raises(error, match=reason):
        piavatar_envs.register_game(name, task)
    assert listed_games() == before


def test_names_without_a_task_are_refused(elsewhere):
    for name, reason in (
        ("Hop-v0", r"'Hop-v0'; .* PIAvatar/Dodge-v0"),
        ("Elsewhere/Hop-v0", r"module .*:Elsewhere/Hop-v0"),
        ("other_tasks:Nothing", "other_tasks .*'Nothing'"),
        ("other_tasks:Metric", "other_tasks .*'Metric'"),
    ):
        with pytest.raises(ValueError, match=reason):
            load_task(name)
    with pytest.raises(ImportError):
        load_task("no_such_module:Elsewhere/Balance-v0")


def test_a_task_without_hooks_or_of_several_agents_is_no_single_environment():
    class Empty(Task):
        """A task that defines nothing."""

    with pytest.raises(NotImplementedError, match=r"Empty .*record_reset\(env, graph\)"):
        AvatarEnv(Empty, fidelity="tiny")
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    sumo = importlib.import_module("piavatar_envs.multi.sumo_v0").TASK
    for view in (AvatarEnv, AvatarVectorEnv):
        with pytest.raises(ValueError, match=r"2 agents.*AvatarParallelEnv\(SumoTask\)"):
            view(sumo, fidelity="tiny")
