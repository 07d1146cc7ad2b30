"""What a task writes that is not finite: noted before it is replaced by zeros, which nobody would notice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import warp as wp

from piavatar_envs.tasks.base import Task

if TYPE_CHECKING:
    from piavatar_envs.envs.batch_env import BatchEnv
    from piavatar_envs.mpm.program import Program

wp.set_module_options({"enable_backward": False})


class FiniteWatch:
    """Looks at all that a task writes, in every step of the one batch that is built of it afterwards."""

    def __init__(self, task: Task) -> None:
        """Stand between the task and its batch."""
        self._found: dict[tuple[str, ...], wp.array] = {}
        record_outcome, record_observe = task.record_outcome, task.record_observe

        def outcome(env: BatchEnv, program: Program) -> None:
            record_outcome(env, program)
            self._note(env, program, env.terms, task.reward_terms, 0, range(env.num_agents))
            self._note(env, program, env.cost_terms, task.cost_terms, 0, range(env.num_agents))
            self._note(env, program, env.metrics, task.metrics, 0, range(env.num_agents))

        def observe(env: BatchEnv, program: Program, agent: int, start: int) -> None:
            record_observe(env, program, agent, start)
            names = [f"{term.name}[{index}]" for term in task.terms() for index in range(term.size)]
            self._note(env, program, env.observation, names, start, range(agent, agent + 1))

        task.record_outcome, task.record_observe = outcome, observe

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
