"""Conformance check of a task: whether it keeps the contract of every environment of the suite; see docs/tasks.md.

The task is run under random actions in a batch, and in the single environments that the batch must equal. Each function
``check_*`` looks at one part of the contract and yields a sentence with a remedy for every breach.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.api.host import EpisodeHost, Settings
from piavatar_envs.config import load_config
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.episodes import EpisodeArrays
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task

wp.set_module_options({"enable_backward": False})

#: Environments of the batch; each is compared with a single one.
NUM_ENVS = 3
#: Arrays of the batch that are compared between runs.
COMPARED = (
    "observation", "reward", "cost", "terms", "cost_terms", "metrics", "success", "terminated", "truncated", "failure"
)  # fmt: skip
#: Spare numbers behind the last row of an array, which catch writes beyond its columns, and their initial value.
SPARE, UNTOUCHED = 8, -1.2345678e30
#: Arrays of the batch by name, and the attributes of a task that declare their columns.
NAMED = {"terms": "rewards", "cost_terms": "costs", "metrics": "metrics"}

State = dict[str, np.ndarray]
#: A run: arrays ``(steps, num_envs, ...)`` by name, and under ``"start"`` the observation before the first step.
Run = dict[str, np.ndarray]


class TaskError(ValueError):
    """A task that breaks the contract of environments.

    Attributes:
        problems: the breaches, a sentence each.
    """

    def __init__(self, task: str, problems: Sequence[str]) -> None:
        super().__init__("\n- ".join([f"{task} breaks the contract of environments:", *problems]))
        self.problems = tuple(problems)


def check_task(
    task: str | type[Task],
    steps: int = 30,
    device: str = "cpu",
    config: Settings = None,
    reward_range: tuple[float, float] | None = None,
    constant: Sequence[str] = (),
    fidelity: str = "tiny",
    seed: int = 0,
    **overrides: Any,
) -> None:
    """Check under random actions whether a task keeps the contract of environments.

    The same seed and actions give the same run; environment ``i`` of a batch is the single environment of seed + ``i``;
    the task's observations are in their space and change, and all its numbers are finite and have names; returned
    arrays are copies; bad actions are refused; a masked reset and an observation leave everything else alone; a
    restored state goes on as the saved one did.

    Args:
        task: its id, its class, or ``"module:id"``; of one agent or several.
        steps: control steps of a run.
        device: Warp device, ``"cpu"`` or ``"cuda:0"``.
        config: settings as a mapping, a YAML file or a configuration.
        reward_range: lower and upper bound of the reward, of every agent; not checked if not given.
        constant: names of the task's observation terms that may be constant.
        fidelity: of the bodies; overrides ``config``.
        seed: of the first environment.
        **overrides: settings that override ``config``.

    Raises:
        TaskError: the task breaks the contract; lists all breaches.
        ValueError: fewer than two steps, an unknown term, a decreasing range, or whatever building environments raises.
    """
    if steps < 2:
        raise ValueError(f"steps={steps} must be >= 2")
    if reward_range is not None and not reward_range[0] <= reward_range[1]:
        raise ValueError(f"reward_range={list(reward_range)} falls; give the lower bound first")
    task_class = load_task(task)
    settings = load_config(task_class.Config, config, {**overrides, "physics.fidelity": fidelity})
    monitored = task_class(settings)
    terms = [term.name for term in monitored.terms()]
    for name in constant:
        if name not in terms:
            raise ValueError(f"constant={name!r} is not a term that the task observes; there are {', '.join(terms)}")
    monitor = WriteMonitor(monitored)
    many = EpisodeHost(monitored, NUM_ENVS, device, num_threads=1)
    one = EpisodeHost(task_class(settings), 1, device)
    shape = steps, NUM_ENVS, many.num_agents, many.action_size
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, shape).astype(np.float32)
    subject = Subject(many, one, monitor, actions, seed, reward_range, constant)
    try:
        problems = [problem for check in CHECKS for problem in check(subject)]
    finally:
        many.close()
        one.close()
    if problems:
        raise TaskError(task if isinstance(task, str) else task.__name__, problems)


@dataclass(frozen=True)
class Subject:
    """A task under check.

    Attributes:
        many: a batch of :data:`NUM_ENVS`.
        one: a single environment of the same settings.
        monitor: of all that the task writes in ``many``.
        actions: random, ``(steps, num_envs, num_agents, action_size)``.
        seed: of the first environment.
        reward_range: bounds of every reward, or None.
        constant: terms of the observation that may be constant.
    """

    many: EpisodeHost
    one: EpisodeHost
    monitor: WriteMonitor
    actions: np.ndarray
    seed: int
    reward_range: tuple[float, float] | None
    constant: Sequence[str]

    @cached_property
    def run(self) -> Run:
        """The first run of the batch under all actions."""
        return self.play()

    def play(self) -> Run:
        """Run the batch under all actions."""
        return play(self.many, self.actions, self.seed)

    def difference(self, now: Run, then: Run, env: int | None = None) -> str | None:
        """Describe the first difference between runs: of the batch, or of its environment ``env`` and a single one."""
        for name, value in now.items():
            a, b = (value if env is None else value[:, env : env + 1]), then[name]
            unlike = (a != b) & ~(np.isnan(a) & np.isnan(b)) if a.dtype.kind == "f" else a != b
            if unlike.any():
                index = tuple(int(i) for i in np.argwhere(unlike)[0])
                return f"{self._place(name, index, env)} is {a[index]}, not {b[index]}"
        return None

    def _place(self, name: str, index: tuple[int, ...], env: int | None) -> str:
        """Describe an element of a run."""
        task, place = self.many.task, name
        names = declared_names(task, name) if name in NAMED else ()
        if name in ("start", "observation"):
            place = f"observation {component(self.many, index[3])}"
        elif names:  # an array without names has one column without meaning
            place = f"{name} {names[index[3]]!r}"
        when = "before the first step" if name.startswith(("start", "first ")) else f"in step {index[0] + 1}"
        agent = f" of {task.agent_names[index[2]]}" if len(index) > 2 and self.many.num_agents > 1 else ""
        return f"{when} {place}{agent} in environment {index[1] if env is None else env}"


def component(host: EpisodeHost, index: int) -> str:
    """Return the name of a component of the flat observation: its term, and its index in the term."""
    for name, term in host.layout.items():
        if term.slice.start <= index < term.slice.stop:
            return f"{name}[{index - term.slice.start}]"
    raise IndexError(f"the observation has no component {index}; it has {host.layout.size}")


def declared_names(task: Task, array: str) -> list[str]:
    """Return the names of the columns of an array of :data:`NAMED`."""
    return [column.name for column in getattr(task, NAMED[array])]


def play(host: EpisodeHost, actions: np.ndarray, seed: int) -> Run:
    """Reset to ``seed`` and step under ``actions``, with the next episode wherever one ends."""
    host.reset(seed)
    start = host.observation()[None]
    return {
        "start": start,
        **{f"first {name}": values[None] for name, values in pictures(host).items()},
        **go_on(host, actions),
    }


def go_on(host: EpisodeHost, actions: np.ndarray) -> Run:
    """Step under ``actions`` from the present state."""
    rows = []
    for action in actions:
        host.step(action)
        rows.append({name: host.read(array_of(name)) for name in COMPARED} | pictures(host))
        if host.find_ended().any():
            host.reset_ended()
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def pictures(host: EpisodeHost) -> State:
    """Return the pictures that agents observe, ``(num_envs, num_agents, height, width, channels)`` by name."""
    seen = [host.observed_pictures(agent) for agent in range(host.num_agents)]
    return {name: np.stack([own[name] for own in seen], axis=1) for name in seen[0]}


def array_of(name: str) -> Callable[[BatchEnv], Any]:
    """Return a function that returns the array ``name`` of a batch."""
    return lambda batch: getattr(batch, name)


def changed_arrays(before: State, after: State, envs: slice = slice(None)) -> list[str]:
    """Return the names of arrays that differ in some environments."""
    return [name for name, value in before.items() if value[envs].tobytes() != after[name][envs].tobytes()]


# the checks


def check_repeats(subject: Subject) -> Iterator[str]:
    """Check that the same seed and actions give the same run, whatever was played before."""
    difference = subject.difference(subject.run, subject.play())
    if difference:
        yield (
            f"the same seed and actions give another run the second time: {difference}; draw by generator(seed, "
            "episode, stream, index) alone, and let record_reset write all that an episode begins with"
        )


def check_singles(subject: Subject) -> Iterator[str]:
    """Check that environment ``i`` is the single environment of seed + ``i``."""
    for env in range(NUM_ENVS):
        alone = play(subject.one, subject.actions[:, env : env + 1], subject.seed + env)
        difference = subject.difference(subject.run, alone, env)
        if difference:
            yield (
                f"environment {env} of {NUM_ENVS} is not the single one of its seed: {difference}; draw by its seed, "
                "not by its place e, read and write row e alone, and no more columns than the task declares"
            )
            return


def check_observations(subject: Subject) -> Iterator[str]:
    """Check that observations are in their space, and that the task's own terms change."""
    run, many = subject.run, subject.many
    seen = np.concatenate([run["start"], run["observation"]])
    space = many.observation_space()
    rows = seen.reshape(-1, seen.shape[-1])
    drawn = {
        name: np.concatenate([run[f"first {name}"], run[name]]).reshape(-1, *run[name].shape[3:])
        for name in pictures(many)
    }
    outside = sum(
        not space.contains(many.named(row, {name: values[index] for name, values in drawn.items()}))
        for index, row in enumerate(rows)
    )
    if outside:
        yield f"{outside} of {len(rows)} observations are not in the observation space {space}"
    for term in many.task.terms():
        if term.name in subject.constant:
            continue
        columns = rows[:, many.layout[term.name].slice]
        still = np.flatnonzero(np.ptp(columns, axis=0) == 0.0)
        if len(still):
            yield (
                f"observation {term.name}{still.tolist()} is {columns[0, still].tolist()} in all steps of all "
                f"{NUM_ENVS} environments; write it in record_observe, take more steps, or declare it: "
                f"constant=[{term.name!r}]"
            )


def check_numbers(subject: Subject) -> Iterator[str]:
    """Check that all numbers of the task are finite and have names, and that rewards are in their range."""
    run = subject.run
    for name in subject.monitor.not_finite():
        yield f"{name} is not finite in some step, and counts as 0; look for a division by zero, or a negative root"
    for name, (declared, written) in subject.monitor.undeclared().items():
        yield (
            f"{name} declares {declared} names, and {written} columns are written: those beyond are the next "
            "environment's, or outside the array; name them, or write fewer"
        )
    failed = int((run["failure"] != 0).any(0).sum())
    if failed:
        yield (
            f"the simulation fails in {failed} of {NUM_ENVS} environments under random actions; info['failure'] has "
            "the cause, docs/envs its meaning"
        )
    if subject.reward_range:
        low, high = subject.reward_range
        found = float(run["reward"].min()), float(run["reward"].max())
        if not low <= found[0] <= found[1] <= high:
            yield f"rewards are in {list(found)}, and should be in reward_range={[low, high]}"


def check_memory(subject: Subject) -> Iterator[str]:
    """Check that returned arrays share no memory."""
    many = subject.many
    many.reset(subject.seed)
    given = []
    for action in subject.actions[:2]:
        many.step(action)
        given += [(name, many.read(array_of(name))) for name in COMPARED]
        given += many.observed_pictures(0).items()
    own = [(name, array.numpy()) for group in many.groups for name, array in group.arrays().items()]
    own += [(name, array_of(name)(group).numpy()) for group in many.groups for name in COMPARED]
    own += [
        (name, arrays[0].numpy())
        for group in many.groups
        if group.pixels
        for name, arrays in group.pixels.arrays.items()
    ]
    for place, (name, value) in enumerate(given):
        for other, array in [*given[:place], *own]:
            if np.shares_memory(value, array):
                yield f"the returned {name} shares memory with {other}; return copies"
                return


def check_actions(subject: Subject) -> Iterator[str]:
    """Check that actions of a wrong shape, or that are not finite, are refused and change nothing."""
    many, good = subject.many, subject.actions[0]
    many.reset(subject.seed)
    before = many.get_state()
    broken = good.copy()
    broken[-1, -1, -1] = np.nan
    cases = {"too many components": np.concatenate([good, good], -1), "a component NaN": broken}
    for fault, bad in cases.items():
        try:
            many.step(bad)
        except ValueError:
            changed = changed_arrays(before, many.get_state())
            if changed:
                yield f"an action with {fault} is refused and still changes {', '.join(changed)}"
        else:
            yield f"an action with {fault} is not refused; leave step() of the environments as it is"


def check_masks(subject: Subject) -> Iterator[str]:
    """Check that a reset of some environments leaves the others alone, in later steps too."""
    many, half = subject.many, len(subject.actions) // 2
    undisturbed = subject.run
    play(many, subject.actions[:half], subject.seed)
    before, last = many.get_state(), np.arange(NUM_ENVS) == NUM_ENVS - 1
    many.reset(mask=last)
    remedy = "in record_reset write only where mask[e] is set"
    changed = changed_arrays(before, many.get_state(), slice(NUM_ENVS - 1))
    if changed:
        yield f"a reset of environment {NUM_ENVS - 1} alone changes {', '.join(changed)} of the others; {remedy}"
        return
    later = {name: value[:, :-1] for name, value in go_on(many, subject.actions[half:]).items()}
    difference = subject.difference(later, {name: undisturbed[name][half:, :-1] for name in later})
    if difference:
        yield f"a reset of environment {NUM_ENVS - 1} alone changes later steps of the others: {difference}; {remedy}"


def check_states(subject: Subject) -> Iterator[str]:
    """Check that a state that is restored in another episode goes on as before."""
    many, half = subject.many, len(subject.actions) // 2
    play(many, subject.actions[:half], subject.seed)
    state = many.get_state()
    expected = go_on(many, subject.actions[half:])
    many.reset(subject.seed + NUM_ENVS)
    many.step(subject.actions[0])
    many.set_state(state)
    difference = subject.difference(go_on(many, subject.actions[half:]), expected)
    if difference:
        yield f"a restored state goes on otherwise: {difference}; let arrays() name all arrays that the task keeps"


def check_observing(subject: Subject) -> Iterator[str]:
    """Check that observing changes nothing."""
    many = subject.many
    play(many, subject.actions[:2], subject.seed)
    before, seen = many.get_state(), {"observation": many.observation(), **pictures(many)}
    for group in many.groups:
        group.observe_graph.run()
    changed = changed_arrays(before, many.get_state())
    if changed or changed_arrays(seen, {"observation": many.observation(), **pictures(many)}):
        what = ", ".join(changed) or "the observation"
        yield f"observing a second time changes {what}; record_observe must write into env.observation alone"


#: In this order; each check resets the environments itself.
CHECKS = (
    check_repeats, check_singles, check_observations, check_numbers, check_memory, check_actions, check_masks,
    check_states, check_observing,
)  # fmt: skip


class WriteMonitor:
    """Monitors all that a task writes, in every step of the one batch that is built of it afterwards.

    Numbers that are not finite are noted before the batch replaces them by zeros. A column beyond those declared is the
    first of the next row, where it looks like that row's own; only behind the last row it shows.
    """

    def __init__(self, task: Task) -> None:
        """Wrap the methods of ``task`` that record its writes."""
        self._found: dict[tuple[str, ...], wp.array] = {}
        self._long: dict[str, wp.array] = {}
        self._task = task
        allocate, record_outcome, record_observe = task.allocate, task.record_outcome, task.record_observe

        def lengthen(env: EpisodeArrays) -> None:
            for name in NAMED:
                long = self._with_spare(name, getattr(env, name))
                setattr(env, name, long)
                setattr(env.outcome, name, long)
            allocate(env)

        def outcome(env: EpisodeArrays, graph: LaunchGraph) -> None:
            record_outcome(env, graph)
            for name in NAMED:
                self._note(env, graph, getattr(env, name), declared_names(task, name), 0, range(env.num_agents))

        def observe(env: EpisodeArrays, graph: LaunchGraph, agent: int, start: int) -> None:
            record_observe(env, graph, agent, start)
            names = [f"{term.name}[{index}]" for term in task.terms() for index in range(term.size)]
            self._note(env, graph, env.observation, names, start, range(agent, agent + 1))

        vars(task).update(allocate=lengthen, record_outcome=outcome, record_observe=observe)

    def _with_spare(self, name: str, array: wp.array) -> wp.array:
        """Return an array like ``array`` with spare numbers behind it; contiguous, so that tasks can reshape it."""
        long = np.full(array.size + SPARE, UNTOUCHED, np.float32)
        long[: array.size] = 0.0
        self._long[name] = wp.array(long, dtype=float, device=array.device)
        return self._long[name][: array.size].reshape(array.shape)

    def _note(
        self, env: EpisodeArrays, graph: LaunchGraph, values: wp.array, names: Sequence[str], start: int, agents: range
    ) -> None:
        """Append a launch that notes the columns of ``values`` from ``start`` on that are not finite for some agent."""
        if names:
            found = self._found.setdefault(tuple(names), wp.zeros(len(names), dtype=int, device=env.device))
            shape = env.num_envs, len(agents), len(names)
            graph.launch(note_columns, shape, [env.failure, values, agents.start, start], [found])

    def not_finite(self) -> list[str]:
        """Return the names of numbers that were not finite in an environment that had not failed."""
        return [name for names, found in self._found.items() for name, n in zip(names, found.numpy(), strict=True) if n]

    def undeclared(self) -> dict[str, tuple[int, int]]:
        """Return those of ``rewards``, ``costs`` and ``metrics`` of which more are written than declared.

        Returns:
            The number of names, and of columns written, up to :data:`SPARE` more.
        """
        found = {}
        for name, long in self._long.items():
            declared, values = len(getattr(self._task, NAMED[name])), long.numpy()
            behind = np.flatnonzero(values[-SPARE:] != np.float32(UNTOUCHED))
            if len(behind):
                found[NAMED[name]] = declared, max(1, declared) + int(behind[-1]) + 1
            elif not declared and values[:-SPARE].any():  # an array without names has one column without meaning
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
    e, a, n = wp.tid()  # type: ignore[misc]
    if failure[e] == 0 and not wp.isfinite(values[e, agent + a, start + n]):
        wp.atomic_max(found, n, 1)
