"""What a task declares of its reward, costs and metrics: names that can be told apart, and as many as it writes."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.api.conformance import FiniteWatch, TaskError, check_task
from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.task import NAMES_OF_INFO, Task
from piavatar_envs.tasks.common.spawn import record_standing

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
    """Writes as many columns of each as it is told."""

    reward_terms = ("near", "control")
    cost_terms = ("hits",)
    metrics = ("off",)
    columns = (2, 1, 1)

    def record_reset(self, env, graph):
        record_standing(env, graph, noise=0.1)

    def record_outcome(self, env, graph):
        graph.launch(write, env.num_envs, [wp.vec3i(*self.columns)], [env.terms, env.cost_terms, env.metrics])


def made(**declared) -> Task:
    cls = type("Own", (Plain,), declared)
    return cls(load_config(cls.Config, None, {"fidelity": "tiny"}))


@pytest.mark.parametrize(
    ("declared", "told"),
    [
        ({"reward_terms": ("near", "far", "near")}, r"Own\.reward_terms has 'near' twice, .* call one otherwise"),
        ({"cost_terms": ("hits", "hits")}, r"Own\.cost_terms has 'hits' twice"),
        ({"metrics": ("off", "off")}, r"Own\.metrics has 'off' twice"),
        ({"metrics": ("off", "success")}, r"Own\.metrics has 'success', which info has anyway, .* call it otherwise"),
        ({"metrics": ("_off",)}, r"Own\.metrics has '_off'; a name is a string that does not begin with an underscore"),
        ({"reward_terms": ("near", 1)}, r"Own\.reward_terms has 1; a name is a string"),
        ({"reward_terms": "near"}, r"Own\.reward_terms='near' is one string; give a tuple of names: \('near',\)"),
    ],
)
def test_names_that_info_would_lose_are_refused(declared, told):
    with pytest.raises(ValueError, match=told):
        made(**declared)


def test_a_name_may_be_a_reward_and_a_metric():
    made(reward_terms=("near", "success"), metrics=("near",))


def test_no_metric_can_take_a_name_of_info(make_env, env_id):
    env = make_env(env_id)
    env.reset(seed=0)
    info = env.step(np.zeros(env.action_space.shape))[4]
    assert set(info) - set(env.batch.task.metrics) <= set(NAMES_OF_INFO)


@pytest.mark.parametrize(
    ("declared", "found"),
    [
        ({}, {}),
        ({"columns": (3, 1, 1)}, {"reward_terms": (2, 3)}),
        ({"columns": (1, 4, 2)}, {"cost_terms": (1, 4), "metrics": (1, 2)}),
        ({"columns": (2, 1, 1), "cost_terms": ()}, {"cost_terms": (0, 1)}),
        ({"columns": (2, 0, 1), "cost_terms": ()}, {}),
    ],
)
def test_columns_beyond_those_declared_are_seen(device, declared, found):
    task = made(**declared)
    watch = FiniteWatch(task)
    batch = BatchEnv(task, 3, device)
    batch.reset(seeds=[0, 1, 2])
    batch.step()
    assert watch.beyond() == found and watch.names() == []
    columns = min(2, task.columns[0])
    assert batch.terms.shape == (3, 1, 2) and (batch.terms.numpy()[:, 0, :columns] == 1.0).all()
    assert batch.reward.numpy().tolist() == [[float(columns)]] * 3


def test_check_task_tells_what_is_written_beyond_the_names(device):
    told = "reward_terms declares 2 names, and 3 columns are written: .* name them, or write fewer"
    with pytest.raises(TaskError, match=told):
        check_task(type("Wide", (Plain,), {"columns": (3, 1, 1)}), steps=4, device=device)
    check_task(Plain, steps=4, device=device)


class Flat(Plain):
    """Has arrays of its own shape, of which nobody but itself knows where a row ends."""

    def allocate(self, env):
        self.flat = env.terms.flatten(), env.cost_terms.reshape(env.num_envs), env.metrics.reshape((env.num_envs, 1))

    def record_outcome(self, env, graph):
        graph.launch(write_flat, env.num_envs, [self.columns[0]], list(self.flat))


def test_a_task_may_reshape_its_arrays(device):
    check_task(Flat, steps=4, device=device)
    with pytest.raises(TaskError, match="reward_terms declares 2 names, and 4 columns are written"):
        check_task(type("Wide", (Flat,), {"columns": (4, 1, 1)}), steps=4, device=device)
