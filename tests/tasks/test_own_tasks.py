"""Tasks from outside the package: registered, found by every view, and refused with the reason."""

from __future__ import annotations

import importlib
import os
import sys

import gymnasium as gym
import numpy as np
import pytest

import piavatar_envs
from piavatar_envs import cli
from piavatar_envs.api.gym_env import AvatarEnv
from piavatar_envs.api.vector_env import AvatarVectorEnv
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task, reach

MODULE = """
import piavatar_envs
from piavatar_envs.tasks.reach import ReachConfig, ReachTask


class NearConfig(ReachConfig):
    radius: float = 0.2


class NearTask(ReachTask):
    Config = NearConfig


piavatar_envs.register_task("{namespace}/Near-v0", "{module}:NearTask")
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module of another author with a task; nothing of it is left afterwards."""
    monkeypatch.syspath_prepend(tmp_path)
    name = "somebodys_tasks"
    (tmp_path / f"{name}.py").write_text(MODULE.format(module=name, namespace="Somebody"))
    yield name
    sys.modules.pop(name, None)
    gym.registry.pop("Somebody/Near-v0", None)
    piavatar_envs.tasks._added.pop("Somebody/Near-v0", None)


def test_it_is_an_environment_like_all_others(module, device):
    env = gym.make(f"{module}:Somebody/Near-v0", fidelity="tiny", device=device)  # Gymnasium imports the module
    assert env.unwrapped.config.radius == 0.2 and env.spec.max_episode_steps is None
    one, _ = env.reset(seed=3)
    many = gym.make_vec("Somebody/Near-v0", num_envs=2, fidelity="tiny", device=device)
    observations, _ = many.reset(seed=3)
    assert np.array_equal(observations[0], one) and not np.array_equal(observations[1], one)
    same = AvatarEnv(load_task("Somebody/Near-v0"), fidelity="tiny", device=device)
    assert np.array_equal(same.reset(seed=3)[0], one)
    for made in (env, many, same):
        made.close()


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
@pytest.mark.parametrize(
    "made, task, told",
    [
        ("PIAvatar/Reach-v0", "KickBall-v0", "task='KickBall-v0' is not that of PIAvatar/Reach-v0; make 'PIA"),
        ("PIAvatar/Reach-v0", "Somebody/Near-v0", "not that of PIAvatar/Reach-v0; make 'Somebody/Near-v0'"),
        ("PIAvatar/KickBall-v0", reach.ReachTask, "task='ReachTask' is not .*make the id that .*register_task"),
        ("Somebody/Near-v0", "PIAvatar/Reach-v0", "is not that of Somebody/Near-v0; make 'PIAvatar/Reach-v0'"),
    ],
)
def test_an_id_makes_no_other_task(module, monkeypatch, make, made, task, told):
    load_task(f"{module}:Somebody/Near-v0")
    monkeypatch.setattr(BatchEnv, "__init__", None)  # refused before anything is built
    with pytest.raises(ValueError, match=told) as caught:
        make(made, task=task, fidelity="tiny")
    assert "\n" not in str(caught.value)


def test_an_id_makes_its_own_task_by_any_name(module, device):
    found = load_task(f"{module}:Somebody/Near-v0")
    specs = [gym.spec("Somebody/Near-v0")]
    for name in ("Somebody/Near-v0", f"{module}:NearTask", found):
        env = gym.make(specs[-1], task=name, fidelity="tiny", device=device)
        assert type(env.unwrapped.batch.task) is found
        specs.append(env.spec)  # what has been made can be made again


def test_its_module_is_imported_when_its_id_names_it(module):
    assert module not in sys.modules
    task = load_task(f"{module}:Somebody/Near-v0")
    assert task is sys.modules[module].NearTask and load_task("Somebody/Near-v0") is task
    assert load_task(task) is task and load_task("Reach-v0") is reach.ReachTask


def test_processes_that_have_not_imported_it_find_it(module, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    context = {"context": "spawn", "shared_memory": False}
    make = dict(fidelity="tiny", vectorization_mode="async", vector_kwargs=context)
    envs = gym.make_vec(f"{module}:Somebody/Near-v0", num_envs=2, **make)
    observations, _ = envs.reset(seed=3)
    envs.close()
    one = AvatarEnv(f"{module}:NearTask", fidelity="tiny").reset(seed=3)[0]
    assert np.array_equal(observations[0], one)


def test_several_agents_are_for_the_view_of_several():
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    duel = importlib.import_module("piavatar_envs.multi.sumo_v0").TASK
    for view in (AvatarEnv, AvatarVectorEnv):
        with pytest.raises(ValueError, match=r"SumoTask has 2 agents, .*AvatarParallelEnv\(SumoTask\)"):
            view(duel, fidelity="tiny")


def test_a_task_without_hooks_says_which():
    class Empty(Task):
        """Nothing is defined."""

    with pytest.raises(NotImplementedError, match=r"Empty must define record_reset\(env, graph\)"):
        AvatarEnv(Empty, fidelity="tiny")


def test_the_command_line_knows_it(module, capsys):
    cli.main(["play", f"{module}:Somebody/Near-v0", "--steps", "1", "-c", "fidelity=tiny"])
    assert "reward_terms.reach" in capsys.readouterr().out and "Somebody/Near-v0" in cli.registered_ids()
    assert cli.describe("Somebody/Reach-v0") == "" != cli.describe("PIAvatar/Reach-v0")
    with pytest.raises(SystemExit):
        cli.main(["play", "no_such_module:Somebody/Near-v0"])
    assert capsys.readouterr().err == "error: No module named 'no_such_module'\n"


def test_registering_again_replaces_without_a_warning(module, recwarn):
    load_task(f"{module}:Somebody/Near-v0")
    piavatar_envs.register_task("Somebody/Near-v0", reach.ReachTask)
    assert load_task("Somebody/Near-v0") is reach.ReachTask and not recwarn.list


@pytest.mark.parametrize(
    "own_id, task, error, reason",
    [
        ("Near-v0", reach.ReachTask, ValueError, "must be a namespace, a name and a version"),
        ("Somebody/Near", reach.ReachTask, ValueError, "must be a namespace, a name and a version"),
        ("some.body/Near-v0", reach.ReachTask, ValueError, "must be a namespace, a name and a version"),
        ("PIAvatar/Reach-v0", reach.ReachTask, ValueError, "namespace of this package; use one of your own"),
        ("Somebody/Near-v0", reach.ReachConfig, TypeError, "neither a subclass of Task nor 'module:Class'"),
        ("Somebody/Near-v0", "NearTask", TypeError, "neither a subclass of Task nor 'module:Class'"),
    ],
)
def test_what_is_refused_is_not_registered(own_id, task, error, reason):
    before = dict(gym.registry)
    with pytest.raises(error, match=reason):
        piavatar_envs.register_task(own_id, task)
    assert dict(gym.registry) == before
    if own_id != "PIAvatar/Reach-v0":
        with pytest.raises(ValueError, match="unknown task"):
            load_task(own_id)


def test_tasks_that_are_not_there(module):
    with pytest.raises(ValueError, match=r"unknown task 'Hop-v0'; there are PIAvatar/Dodge-v0"):
        load_task("Hop-v0")
    with pytest.raises(ValueError, match=r"the module that registers it, such as my_tasks:Somebody/Hop-v0"):
        load_task("Somebody/Hop-v0")
    for name in ("Nothing", "NearConfig"):
        with pytest.raises(ValueError, match=f"{module} has no task '{name}': it must be a subclass of"):
            load_task(f"{module}:{name}")
    with pytest.raises(ImportError):
        load_task("no_such_module:Somebody/Near-v0")
