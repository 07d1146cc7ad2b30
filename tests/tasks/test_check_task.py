"""check_task: passes honest tasks, and names each breach of the contract and its remedy."""

from __future__ import annotations

import re

import numpy as np
import pytest
import warp as wp

import piavatar_envs
from piavatar_envs.api.conformance import TaskError
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.core.rng import STREAM_TASK, generator
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.task import Metric, Task, Term
from piavatar_envs.tasks.common.spawn import record_standing

wp.set_module_options({"enable_backward": False})

BY_PLACE = wp.constant(1)
UNMASKED = wp.constant(2)
NEVER_RESET = wp.constant(3)
NOT_A_NUMBER = wp.constant(4)
LOOKS_COUNT = wp.constant(5)
NOTHING_SEEN = wp.constant(6)
FORGOTTEN = wp.constant(7)
NOT_A_METRIC = wp.constant(8)
NOT_SEEN = wp.constant(9)


@wp.kernel
def draw(
    fault: int,
    mask: wp.array(dtype=wp.bool),
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    # out
    goal: wp.array(dtype=float),
    passed: wp.array(dtype=float),
):
    e = wp.tid()
    if mask[e] or fault == UNMASKED:
        random = generator(seed[e], episode[e], STREAM_TASK, 0)
        if fault == BY_PLACE:
            random = wp.rand_init(e)
        goal[e] = wp.randf(random)
        if fault != NEVER_RESET:
            passed[e] = 0.0


@wp.kernel
def judge(
    fault: int,
    goal: wp.array(dtype=float),
    passed: wp.array(dtype=float),
    # out
    terms: wp.array3d(dtype=float),
    metrics: wp.array3d(dtype=float),
):
    e = wp.tid()
    passed[e] = passed[e] + 0.01
    terms[e, 0, 0] = wp.abs(goal[e] - passed[e])
    metrics[e, 0, 0] = passed[e]
    if fault == NOT_A_NUMBER:
        terms[e, 0, 0] = wp.sqrt(-1.0 - goal[e])
    if fault == NOT_A_METRIC:
        metrics[e, 0, 0] = 1.0 / (goal[e] - goal[e])


@wp.kernel
def see(
    fault: int,
    agent: int,
    start: int,
    goal: wp.array(dtype=float),
    passed: wp.array(dtype=float),
    # out
    observation: wp.array3d(dtype=float),
):
    e = wp.tid()
    observation[e, agent, start] = goal[e]
    if fault == LOOKS_COUNT:
        passed[e] = passed[e] + 0.01
    if fault != NOTHING_SEEN:
        observation[e, agent, start + 1] = passed[e]
    if fault == NOT_SEEN:
        observation[e, agent, start + 1] = wp.log(-1.0 - passed[e])


class Honest(Task):
    """A goal that is drawn, and a count that goes on."""

    observation_terms = (ObservationTerm("goal", 1, "m", "world", "-"), ObservationTerm("passed", 1, "s", "-", "-"))
    rewards = (Term("off"),)
    metrics = (Metric("passed", "s"),)
    fault = 0

    def allocate(self, env):
        self.goal, self.passed = (wp.zeros(env.num_envs, dtype=float, device=env.device) for _ in range(2))

    def arrays(self):
        return {"goal": self.goal} | ({} if self.fault == FORGOTTEN else {"passed": self.passed})

    def record_reset(self, env, graph):
        record_standing(env, graph, noise=0.1)
        inputs = [self.fault, env.mask, env.seed, env.episode]
        graph.launch(draw, env.num_envs, inputs, [self.goal, self.passed])

    def record_outcome(self, env, graph):
        graph.launch(judge, env.num_envs, [self.fault, self.goal, self.passed], [env.terms, env.metrics])

    def record_observe(self, env, graph, agent, start):
        inputs = [self.fault, agent, start, self.goal, self.passed]
        graph.launch(see, env.num_envs, inputs, [env.observation])


def problems_of(fault: int, device: str, steps: int = 6, **options) -> tuple[str, ...]:
    task = type("Broken", (Honest,), {"fault": int(fault)})
    with pytest.raises(TaskError, match=r"^Broken .*:\n- ") as caught:
        piavatar_envs.check_task(task, steps, device, **options)
    return caught.value.problems


def test_an_honest_task_passes(device):
    piavatar_envs.check_task(Honest, 4, device, reward_range=(0.0, 1.0))
    piavatar_envs.check_task(Honest, 4, device, obs_mode="dict", episode_seconds=0.1, seed=7)


@pytest.mark.parametrize(
    ("fault", "count", "words"),
    [
        (BY_PLACE, 1, r"environment 1 of 3 .* goal\[0\]"),
        (UNMASKED, 1, r"reset of environment 2 alone .*task.passed"),
        (NEVER_RESET, 4, r"second time: .* passed\[0\]"),
        (NOT_A_NUMBER, 1, "off is not finite"),
        (NOT_A_METRIC, 1, "passed is not finite"),
        (NOT_SEEN, 2, r"passed\[0\] is not finite"),
        (NOTHING_SEEN, 1, r"passed\[0\] is \[0.0\] in all steps .*constant=\['passed'\]"),
        (FORGOTTEN, 1, r"restored state .* arrays\(\)"),
        (LOOKS_COUNT, 3, r"observing a second time changes task.passed"),
    ],
)
def test_breaches_are_named(device, fault, count, words):
    found = problems_of(fault, device)
    assert len(found) <= count and any(re.search(words, problem) for problem in found), found


def test_ranges_and_constants_are_as_declared(device):
    (problem,) = problems_of(0, device, reward_range=(0.2, 0.9))
    assert "rewards" in problem and "reward_range=[0.2, 0.9]" in problem
    still = type("Still", (Honest,), {"fault": int(NOTHING_SEEN)})
    piavatar_envs.check_task(still, 6, device, constant=["passed"])
    for options, words in (
        ({"steps": 1}, r"steps=1 "),
        ({"reward_range": (1.0, 0.0)}, r"reward_range=\[1.0, 0.0\]"),
        ({"constant": ["gaol"]}, "'gaol'.* goal"),
        ({"bogus": 1}, "bogus"),
    ):
        with pytest.raises(ValueError, match=words):
            piavatar_envs.check_task(Honest, device=device, **options)


def test_views_that_share_memory_or_take_any_action_are_reported(device, monkeypatch):
    with monkeypatch.context() as patched:
        taken = lambda self, action: self.advance(np.nan_to_num(action)[..., : self.action_size])  # noqa: E731
        patched.setattr(EpisodeHost, "step", taken)
        found = problems_of(0, device)
        assert ["is not refused" in problem for problem in found] == [True, True], found
    if device == "cpu":
        monkeypatch.setattr(EpisodeHost, "read", lambda self, array_of: array_of(self.groups[0]).numpy())
        assert any("shares memory with" in problem for problem in problems_of(0, device))


def test_tasks_of_the_suite_keep_their_promises(env_id, device):
    """Check every task with bodies and worlds that differ; single views of a few have tests of their own."""
    factors = {f"{name}_factor": (0.6, 1.5) for name in ("mass", "stiffness", "ground_friction", "body_friction")}
    steps = 20 if env_id.endswith("Header-v0") else 12  # until the ball has come down
    piavatar_envs.check_task(env_id, steps=steps, device=device, **{"shape.randomize": True}, **factors)


def test_tasks_of_several_agents_are_checked(device):
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    piavatar_envs.check_task("piavatar_envs.tasks.games.high_five:HighFiveTask", 4, device)
