"""What a task writes that is not finite, or beyond its columns: noted before it is replaced, or in the next row.

Values that are not finite are replaced by zeros, which nobody would notice; a third term where two are declared would
be the next environment's first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.tasks.base import Task

if TYPE_CHECKING:
    from piavatar_envs.envs.batch_env import BatchEnv
    from piavatar_envs.mpm.program import Program

wp.set_module_options({"enable_backward": False})


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

        def outcome(env: BatchEnv, program: Program) -> None:
            record_outcome(env, program)
            for name, declared in NAMED.items():
                self._note(env, program, getattr(env, name), getattr(task, declared), 0, range(env.num_agents))

        def observe(env: BatchEnv, program: Program, agent: int, start: int) -> None:
            record_observe(env, program, agent, start)
            names = [f"{term.name}[{index}]" for term in task.terms() for index in range(term.size)]
            self._note(env, program, env.observation, names, start, range(agent, agent + 1))

        task.allocate, task.record_outcome, task.record_observe = lengthen, outcome, observe

    def _with_spare(self, name: str, array: wp.array) -> wp.array:
        """An array such as ``array``, whose rows follow each other as they do there: it can be reshaped."""
        long = np.full(array.size + SPARE, UNTOUCHED, np.float32)
        long[: array.size] = 0.0
        self._long[name] = wp.array(long, dtype=float, device=array.device)
        return self._long[name][: array.size].reshape(array.shape)

    def _note(
        self, env: BatchEnv, program: Program, values: wp.array, names: Sequence[str], start: int, agents: range
    ) -> None:
        """Append: note which columns of ``values``, called ``names`` from ``start`` on, some agent has not finite."""
        if names:
            found = self._found.setdefault(tuple(names), wp.zeros(len(names), dtype=int, device=env.device))
            shape = env.num_envs, len(agents), len(names)
            program.launch(note_columns, shape, [env.failure, values, agents.start, start], [found])

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
