"""Declarations of a task: names that are unique and match the columns it writes, and arrays."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.api.conformance import TaskError, WriteMonitor, check_task
from piavatar_envs.config import EnvConfig, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.task import NAMES_OF_INFO, Metric, Task, TaskArray, Term
from piavatar_envs.tasks.common.spawn import record_standing
from piavatar_envs.tasks.common.upright import POSTURE_METRICS, StandingTask
from piavatar_envs.tasks.get_up import GetUpTask
from piavatar_envs.tasks.push_recovery import PushRecoveryTask
from piavatar_envs.tasks.walk import WalkTask

wp.set_module_options({"enable_backward": False})


@wp.kernel
def write(
    columns: wp.vec3i, terms: wp.array3d(dtype=float), costs: wp.array3d(dtype=float), out: wp.array3d(dtype=float)
):
    e = wp.tid()
    for k in range(columns[0]):
        terms[e, 0, k] = 1.0
    for k in range(columns[1]):
        costs[e, 0, k] = 2.0
    for k in range(columns[2]):
        out[e, 0, k] = 3.0


@wp.kernel
def write_flat(columns: int, terms: wp.array(dtype=float), costs: wp.array(dtype=float), out: wp.array2d(dtype=float)):
    e = wp.tid()
    for k in range(columns):
        terms[2 * e + k] = 1.0
    costs[e] = 1.0
    out[e, 0] = 1.0


class Plain(Task):
    """Writes as many columns of each as ``columns`` says."""

    rewards = (Term("near"), Term("control"))
    costs = (Term("hits"),)
    metrics = (Metric("off", "m"),)
    columns = (2, 1, 1)

    def record_reset(self, env, graph):
        record_standing(env, graph, noise=0.1)

    def record_outcome(self, env, graph):
        graph.launch(write, env.num_envs, [wp.vec3i(*self.columns)], [env.terms, env.cost_terms, env.metrics])


def made(**declared) -> Task:
    cls = type("Own", (Plain,), declared)
    return cls(load_config(cls.Config, None, {"fidelity": "tiny"}))


@pytest.mark.parametrize(
    ("field", "declared", "name"),
    [
        ("rewards", (Term("near"), Term("far"), Term("near")), "'near'"),
        ("costs", (Term("hits"), Term("hits")), "'hits'"),
        ("metrics", (Metric("off"), Metric("off")), "'off'"),
        ("metrics", (Metric("off"), Metric("success")), "'success'"),
        ("metrics", (Metric("off"), Metric("reward_near")), "'reward_near'"),
        ("metrics", (Metric("_off"),), "'_off'"),
        ("rewards", (Term("left hand"),), "'left hand'"),
        ("rewards", (Term("pass"),), "'pass'"),
        ("rewards", (Term(1),), "1"),
        ("rewards", ("near",), "'near'.* Term"),
        ("rewards", "near", "'near'.* Term"),
        ("state_arrays", (TaskArray("goal"), TaskArray("goal")), "'goal'"),
        ("state_arrays", (TaskArray("config"),), "'config'"),
    ],
)
def test_declarations_that_info_or_the_task_would_lose_are_refused(field, declared, name):
    with pytest.raises(ValueError, match=rf"Own\.{field}.*{name}"):
        made(**{field: declared})


def test_a_name_is_declared_once_but_may_be_a_reward_and_a_metric():
    with pytest.raises(ValueError, match=r"'goal'"):
        made(state_arrays=(TaskArray("goal"),), scratch_arrays=(TaskArray("goal"),))
    task = made(rewards=(Term("near"), Term("success")), metrics=(Metric("near"),))
    assert task.reward_names == ("near", "success") and task.metric_names == ("near",) and task.cost_names == ("hits",)


@wp.kernel
def write_named(terms: wp.array3d(dtype=float), costs: wp.array3d(dtype=float), out: wp.array3d(dtype=float)):
    e = wp.tid()
    terms[e, 0, Named.rewards.near] = 1.0
    terms[e, 0, Named.rewards.count] = 2.0
    costs[e, 0, Named.costs.hits] = 3.0
    out[e, 0, Named.metrics.near] = 4.0


class Named(Plain):
    """Writes columns by the names that it declares; one of them is a method of tuples."""

    rewards = (Term("control"), Term("count"), Term("near"))
    metrics = (Metric("off"), Metric("near"))

    def record_outcome(self, env, graph):
        graph.launch(write_named, env.num_envs, [env.terms, env.cost_terms, env.metrics])


def test_a_kernel_writes_the_columns_that_it_names(device):
    batch = BatchEnv(Named(load_config(Named.Config, None, {"fidelity": "tiny"})), 1, device)
    batch.reset(seeds=[0])
    batch.step()
    assert batch.terms.numpy()[0, 0].tolist() == [0.0, 2.0, 1.0]
    assert batch.cost_terms.numpy()[0, 0].tolist() == [3.0] and batch.metrics.numpy()[0, 0].tolist() == [0.0, 4.0]


@pytest.mark.parametrize("task", [WalkTask, GetUpTask, PushRecoveryTask])
def test_shared_metrics_have_the_columns_of_a_standing_task(task):
    shared = StandingTask.metrics if task is not WalkTask else POSTURE_METRICS
    assert task.metrics[: len(shared)] == shared == StandingTask.metrics[: len(shared)]


@wp.kernel
def count_steps(steps: wp.array(dtype=int), peaks: wp.array2d(dtype=wp.vec2), seen: wp.array(dtype=float)):
    e = wp.tid()
    steps[e] = steps[e] + 1
    peaks[e, 1] = peaks[e, 1] + wp.vec2(1.0, 2.0)
    seen[e] = seen[e] + 1.0


class Counting(Plain):
    """Counts its steps in declared arrays."""

    Config = type("CountingConfig", (EnvConfig,), {"__annotations__": {"lanes": int}, "lanes": 3})
    state_arrays = (TaskArray("steps", int, cleared=True), TaskArray("peaks", wp.vec2, ("lanes",), cleared=True))
    scratch_arrays = (TaskArray("seen"),)

    def record_outcome(self, env, graph):
        super().record_outcome(env, graph)
        graph.launch(count_steps, env.num_envs, [self.steps, self.peaks, self.seen])


def test_declared_arrays_are_allocated_saved_and_cleared_where_episodes_begin(device):
    task = Counting(load_config(Counting.Config, None, {"fidelity": "tiny"}))
    batch = BatchEnv(task, 2, device)
    batch.reset(seeds=[0, 1])
    batch.step()
    batch.step()
    state = batch.get_state()
    assert {name for name in state if name.startswith("task.")} == {"task.steps", "task.peaks"}
    assert task.peaks.shape == (2, 3) and task.peaks.numpy()[:, 1].tolist() == [[2.0, 4.0]] * 2
    batch.reset(env_mask=np.array([True, False]))
    assert task.steps.numpy().tolist() == [0, 2] and task.peaks.numpy()[:, 1].tolist() == [[0.0, 0.0], [2.0, 4.0]]
    assert task.seen.numpy().tolist() == [2.0, 2.0], "not declared cleared"
    batch.set_state(state)
    assert task.steps.numpy().tolist() == [2, 2]


def test_no_metric_can_take_a_name_of_info(make_env, env_id):
    env = make_env(env_id)
    env.reset(seed=0)
    info = env.step(np.zeros(env.action_space.shape))[4]
    others = {name for name in info if not name.startswith(("reward_", "cost_"))}
    assert others - set(env.batch.task.metric_names) <= set(NAMES_OF_INFO)


@pytest.mark.parametrize(
    ("declared", "found"),
    [
        ({}, {}),
        ({"columns": (3, 1, 1)}, {"rewards": (2, 3)}),
        ({"columns": (1, 4, 2)}, {"costs": (1, 4), "metrics": (1, 2)}),
        ({"columns": (2, 1, 1), "costs": ()}, {"costs": (0, 1)}),
    ],
)
def test_columns_beyond_those_declared_are_seen(device, declared, found):
    task = made(**declared)
    watch = WriteMonitor(task)
    batch = BatchEnv(task, 3, device)
    batch.reset(seeds=[0, 1, 2])
    batch.step()
    assert watch.undeclared() == found and watch.not_finite() == []
    columns = min(2, task.columns[0])
    assert batch.terms.shape == (3, 1, 2) and (batch.terms.numpy()[:, 0, :columns] == 1.0).all()
    assert batch.reward.numpy().tolist() == [[float(columns)]] * 3


class Flat(Plain):
    """Has arrays of its own shape, whose rows only the task can tell apart."""

    def allocate(self, env):
        self.flat = env.terms.flatten(), env.cost_terms.reshape(env.num_envs), env.metrics.reshape((env.num_envs, 1))

    def record_outcome(self, env, graph):
        graph.launch(write_flat, env.num_envs, [self.columns[0]], list(self.flat))


@pytest.mark.parametrize(("base", "columns"), [(Plain, 3), (Flat, 4)])
def test_check_task_reports_columns_beyond_the_names(device, base, columns):
    check_task(base, steps=2, device=device)
    with pytest.raises(TaskError, match=rf"rewards.* 2 .* {columns} columns"):
        check_task(type("Wide", (base,), {"columns": (columns, 1, 1)}), steps=2, device=device)
