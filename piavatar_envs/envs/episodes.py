"""What a task writes that is not finite, or beyond its columns: noted before it is replaced, or in the next row.

Values that are not finite are replaced by zeros, which nobody would notice; a third term where two are declared would
be the next environment's first.

Kernels by which episodes begin, are counted, and end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.envs.task import Task

wp.set_module_options({"enable_backward": False})


if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.batch_env import BatchEnv


#: Numbers behind the last row in which is seen what a task writes beyond its columns, and what stands there until then.
SPARE, UNTOUCHED = 8, -1.2345678e30
#: Arrays of the batch whose last dimension are a task's names, and how these are called.
NAMED = {"terms": "reward_terms", "cost_terms": "cost_terms", "metrics": "metrics"}


class FiniteWatch:
    """Looks at all that a task writes, in every step of the one batch that is built of it afterwards."""

    def __init__(self, task: Task) -> None:
        """Stand between the task and its batch."""
        self._found: dict[tuple[str, ...], wp.array] = {}
        self._long: dict[str, wp.array] = {}
        self._task = task
        allocate, record_outcome, record_observe = task.allocate, task.record_outcome, task.record_observe

        def lengthen(env: BatchEnv) -> None:
            for name in NAMED:
                setattr(env, name, self._with_spare(name, getattr(env, name)))
            allocate(env)

        def outcome(env: BatchEnv, graph: LaunchGraph) -> None:
            record_outcome(env, graph)
            for name, declared in NAMED.items():
                self._note(env, graph, getattr(env, name), getattr(task, declared), 0, range(env.num_agents))

        def observe(env: BatchEnv, graph: LaunchGraph, agent: int, start: int) -> None:
            record_observe(env, graph, agent, start)
            names = [f"{term.name}[{index}]" for term in task.terms() for index in range(term.size)]
            self._note(env, graph, env.observation, names, start, range(agent, agent + 1))

        task.allocate, task.record_outcome, task.record_observe = lengthen, outcome, observe

    def _with_spare(self, name: str, array: wp.array) -> wp.array:
        """An array such as ``array``, whose rows follow each other as they do there: it can be reshaped."""
        long = np.full(array.size + SPARE, UNTOUCHED, np.float32)
        long[: array.size] = 0.0
        self._long[name] = wp.array(long, dtype=float, device=array.device)
        return self._long[name][: array.size].reshape(array.shape)

    def _note(
        self, env: BatchEnv, graph: LaunchGraph, values: wp.array, names: Sequence[str], start: int, agents: range
    ) -> None:
        """Append: note which columns of ``values``, called ``names`` from ``start`` on, some agent has not finite."""
        if names:
            found = self._found.setdefault(tuple(names), wp.zeros(len(names), dtype=int, device=env.device))
            shape = env.num_envs, len(agents), len(names)
            graph.launch(note_columns, shape, [env.failure, values, agents.start, start], [found])

    def names(self) -> list[str]:
        """Of all that was not finite in an environment that had not failed."""
        return [name for names, found in self._found.items() for name, n in zip(names, found.numpy(), strict=True) if n]

    def beyond(self) -> dict[str, tuple[int, int]]:
        """Of ``reward_terms``, ``cost_terms`` and ``metrics``, those of which the task writes more than it declares.

        What is written beyond a row is the next one's, where nobody can tell it from what that row's agent has written;
        it is seen behind the last agent of the last environment.

        Returns:
            How many names there are, and how many columns are written, as far as :data:`SPARE` more can tell.
        """
        found = {}
        for name, long in self._long.items():
            declared, values = len(getattr(self._task, NAMED[name])), long.numpy()
            behind = np.flatnonzero(values[-SPARE:] != np.float32(UNTOUCHED))
            if len(behind):
                found[NAMED[name]] = declared, max(1, declared) + int(behind[-1]) + 1
            elif not declared and values[:-SPARE].any():  # without names there is a column that means nothing
                found[NAMED[name]] = declared, 1
        return found


@wp.kernel
def note_columns(
    failure: wp.array(dtype=int),
    values: wp.array3d(dtype=float),
    agent: int,
    start: int,
    # out
    found: wp.array(dtype=int),
):
    """Note columns from ``start`` on that are not finite, of agents from ``agent`` on, where nothing has failed."""
    e, a, n = wp.tid()
    if failure[e] == 0 and not wp.isfinite(values[e, agent + a, start + n]):
        wp.atomic_max(found, n, 1)


@wp.kernel
def count_episodes(
    mask: wp.array(dtype=wp.bool),
    new_seed: wp.array(dtype=int),
    # in and out
    seeded: wp.array(dtype=wp.bool),
    # out
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    begins: wp.array(dtype=int),
):
    """The next episode of the masked environments, or the first one of a new seed; whether any ``begins``."""
    e = wp.tid()
    if not mask[e]:
        return
    begins[0] = 1
    episode[e] = episode[e] + 1
    if seeded[e]:
        seeded[e] = False
        seed[e] = new_seed[e]
        episode[e] = 0


@wp.kernel
def find_ended(
    terminated: wp.array2d(dtype=wp.bool),
    truncated: wp.array(dtype=wp.bool),
    # out
    mask: wp.array(dtype=wp.bool),
):
    """Where every agent has terminated or the clock has run out."""
    e = wp.tid()
    ended = bool(True)
    for agent in range(terminated.shape[1]):
        if not terminated[e, agent]:
            ended = False
    mask[e] = ended or truncated[e]


@wp.kernel
def begin_episode(
    mask: wp.array(dtype=wp.bool),
    # out
    step_count: wp.array(dtype=int),
    head_start: wp.array(dtype=int),
    terminated: wp.array2d(dtype=wp.bool),
    truncated: wp.array(dtype=wp.bool),
    success: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
    begins: wp.array(dtype=int),
):
    """Clocks and flags of the masked environments back to the start; that any ``begins`` is known by now."""
    e, agent = wp.tid()
    begins[0] = 0
    if mask[e]:
        step_count[e] = 0
        head_start[e] = 0
        truncated[e] = False
        terminated[e, agent] = False
        success[e, agent] = False
        alive[e, agent] = True


@wp.kernel
def retire(agent: int, alive: wp.array2d(dtype=wp.bool), let_go: wp.array(dtype=int)):
    """Nothing holds the root of an agent that is out."""
    e = wp.tid()
    if not alive[e, agent]:
        let_go[e] = 1


@wp.kernel
def end_agent(
    agent: int,
    num_agents: int,
    failure: wp.array(dtype=int),
    let_go: wp.array(dtype=int),
    terms: wp.array3d(dtype=float),
    cost_terms: wp.array3d(dtype=float),
    # out
    reward: wp.array2d(dtype=float),
    cost: wp.array2d(dtype=float),
    # in and out
    terminated: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
):
    """Sum the terms of an agent; a fall and a failure terminate it. What is out among several earns nothing."""
    e = wp.tid()
    out = num_agents > 1 and not alive[e, agent]
    total = float(0.0)
    for n in range(terms.shape[2]):
        if out or not wp.isfinite(terms[e, agent, n]):
            terms[e, agent, n] = 0.0
        total += terms[e, agent, n]
    reward[e, agent] = total
    total = float(0.0)
    for n in range(cost_terms.shape[2]):
        if out or not wp.isfinite(cost_terms[e, agent, n]):
            cost_terms[e, agent, n] = 0.0
        total += cost_terms[e, agent, n]
    cost[e, agent] = total
    terminated[e, agent] = failure[e] != 0 or let_go[e] != 0 or terminated[e, agent] or out
    alive[e, agent] = not terminated[e, agent]


@wp.kernel
def end_step(
    max_steps: int,
    terminated: wp.array2d(dtype=wp.bool),
    head_start: wp.array(dtype=int),
    # in and out
    step_count: wp.array(dtype=int),
    # out
    truncated: wp.array(dtype=wp.bool),
):
    """Count the step; the clock truncates where an agent is still in."""
    e = wp.tid()
    step_count[e] = step_count[e] + 1
    left = int(0)
    for agent in range(terminated.shape[1]):
        if not terminated[e, agent]:
            left += 1
    truncated[e] = step_count[e] + head_start[e] >= max_steps and left > 0
