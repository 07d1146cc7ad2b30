"""check_task: content with honest tasks, and of every way to break a promise it says which and what to do about it."""

from __future__ import annotations

import re

import numpy as np
import pytest
import warp as wp

import piavatar_envs
from piavatar_envs.api.conformance import TaskError
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import ConfigError
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
    with pytest.raises(TaskError, match=r"^Broken .*:\n- ") as told:
        piavatar_envs.check_task(task, steps, device, **options)
    return told.value.problems


def test_an_honest_task_passes(device):
    piavatar_envs.check_task(Honest, 6, device, reward_range=(0.0, 1.0))
    piavatar_envs.check_task(Honest, 6, device, obs_mode="dict", episode_seconds=0.1, seed=7)


@pytest.mark.parametrize(
    ("fault", "count", "words"),
    [
        (BY_PLACE, 1, r"environment 1 of 3 is not the single one of its seed: before the first step .* goal\[0\]"),
        (UNMASKED, 1, r"a reset of environment 2 alone changes .*task.passed.* of the others; .* mask\[e\] is set"),
        (NEVER_RESET, 4, r"another run the second time: before the first step observation passed\[0\] in "),
        (NOT_A_NUMBER, 1, "off is not finite in some step, and counts as 0"),
        (NOT_A_METRIC, 1, "passed is not finite in some step"),
        (NOT_SEEN, 2, r"passed\[0\] is not finite in some step"),
        (NOTHING_SEEN, 1, r"observation passed\[0\] is \[0.0\] in all steps of all 3 .* constant=\['passed'\]"),
        (FORGOTTEN, 1, r"a restored state goes on otherwise: in step 1 .*; let arrays\(\) name"),
        (LOOKS_COUNT, 3, r"observing a second time changes task.passed; record_observe must write"),
    ],
)  # fmt: skip
def test_what_is_broken_is_named(device, fault, count, words):
    found = problems_of(fault, device)
    assert len(found) <= count and any(re.search(words, problem) for problem in found), found


def test_ranges_and_constants_are_as_declared(device):
    (told,) = problems_of(0, device, reward_range=(0.2, 0.9))
    assert told.startswith("rewards are in [0.") and told.endswith("and should be in reward_range=[0.2, 0.9]")
    still = type("Still", (Honest,), {"fault": int(NOTHING_SEEN)})
    piavatar_envs.check_task(still, 6, device, constant=["passed"])
    for options, words in {
        "steps": ({"steps": 1}, r"steps=1 must be >= 2"),
        "range": ({"reward_range": (1.0, 0.0)}, r"reward_range=\[1.0, 0.0\] falls"),
        "constant": (
            {"constant": ["gaol"]},
            "constant='gaol' is no term that the task observes; there are goal",
        ),
    }.values():
        with pytest.raises(ValueError, match=words):
            piavatar_envs.check_task(Honest, device=device, **options)
    with pytest.raises(ConfigError, match="no setting"):
        piavatar_envs.check_task(Honest, bogus=1)


def test_views_that_share_or_take_everything_are_noticed(device, monkeypatch):
    with monkeypatch.context() as patched:
        taken = lambda self, action: self.advance(np.nan_to_num(action)[..., : self.action_size])  # noqa: E731
        patched.setattr(EpisodeHost, "step", taken)
        found = problems_of(0, device)
        assert ["is not refused" in problem for problem in found] == [True, True], found
    if device == "cpu":
        monkeypatch.setattr(EpisodeHost, "read", lambda self, array_of: array_of(self.groups[0]).numpy())
        assert any("shares memory with" in problem for problem in problems_of(0, device))


def test_tasks_of_the_suite_keep_their_promises(env_id, device):
    piavatar_envs.check_task(env_id, device=device)


def test_several_agents_are_looked_at_too(device):
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    piavatar_envs.check_task("piavatar_envs.multi.high_five_v0:HighFiveTask", 8, device)
