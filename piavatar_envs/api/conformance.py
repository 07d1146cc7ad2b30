"""What every environment of the suite promises, and what to do about a task that does not keep it.

Runs of a task that is looked at: in a batch, and in the single environments that the batch must equal.

Whether a task keeps what every environment of the suite promises; for tasks of one's own, see docs/tasks.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.api.batched import BatchedEpisodes
from piavatar_envs.api.episode import Settings
from piavatar_envs.config import load_config
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.episodes import EpisodeArrays
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task

wp.set_module_options({"enable_backward": False})

State = dict[str, np.ndarray]

#: Numbers behind the last row in which is seen what a task writes beyond its columns, and what stands there until then.
SPARE, UNTOUCHED = 8, -1.2345678e30
#: Arrays of the batch by name, and the attributes of a task that declare their columns.
NAMED = {"terms": "rewards", "cost_terms": "costs", "metrics": "metrics"}


class FiniteWatch:
    """Looks at all that a task writes, in every step of the one batch that is built of it afterwards."""

    def __init__(self, task: Task) -> None:
        """Stand between the task and its batch."""
        self._found: dict[tuple[str, ...], wp.array] = {}
        self._long: dict[str, wp.array] = {}
        self._task = task
        allocate, record_outcome, record_observe = task.allocate, task.record_outcome, task.record_observe

        def lengthen(env: EpisodeArrays) -> None:
            for name in NAMED:
                setattr(env, name, self._with_spare(name, getattr(env, name)))
            allocate(env)

        def outcome(env: EpisodeArrays, graph: LaunchGraph) -> None:
            record_outcome(env, graph)
            for name, declared in NAMED.items():
                names = [one.name for one in getattr(task, declared)]
                self._note(env, graph, getattr(env, name), names, 0, range(env.num_agents))

        def observe(env: EpisodeArrays, graph: LaunchGraph, agent: int, start: int) -> None:
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
        self, env: EpisodeArrays, graph: LaunchGraph, values: wp.array, names: Sequence[str], start: int, agents: range
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
        """Of ``rewards``, ``costs`` and ``metrics``, those of which the task writes more than it declares.

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


def _changed(before: State, after: State, envs: slice = slice(None)) -> list[str]:
    """Names of arrays that differ in some environments."""
    return [name for name, value in before.items() if value[envs].tobytes() != after[name][envs].tobytes()]


def repeats(trial: Trial) -> Iterator[str]:
    """The same seed and actions give the same run, whatever was played before."""
    told = trial.difference(trial.run, trial.play())
    if told:
        yield (
            f"the same seed and actions give another run the second time: {told}; draw by generator(seed, episode, "
            "stream, index) alone, and let record_reset write all that an episode begins with"
        )


def singles(trial: Trial) -> Iterator[str]:
    """Environment ``i`` is the single environment of seed + ``i``."""
    for env in range(NUM_ENVS):
        alone = play(trial.one, trial.actions[:, env : env + 1], trial.seed + env)
        told = trial.difference(trial.run, alone, env)
        if told:
            yield (
                f"environment {env} of {NUM_ENVS} is not the single one of its seed: {told}; draw by its seed, not by "
                "its place e, read and write row e alone, and no more columns than the task declares"
            )
            return


def observations(trial: Trial) -> Iterator[str]:
    """Observations are in their space, and all that the task adds to them changes."""
    run, many = trial.run, trial.many
    seen = np.concatenate([run["start"], run["observation"]])
    space = many.observation_space()
    rows = seen.reshape(-1, seen.shape[-1])
    outside = sum(not space.contains(many.named(row)) for row in rows)
    if outside:
        yield f"{outside} of {len(rows)} observations are not in the observation space {space}"
    for term in many.task.terms():
        if term.name in trial.constant:
            continue
        columns = rows[:, many.layout[term.name].slice]
        still = np.flatnonzero(np.ptp(columns, axis=0) == 0.0)
        if len(still):
            yield (
                f"observation {term.name}{still.tolist()} is {columns[0, still].tolist()} in all steps of all "
                f"{NUM_ENVS} environments; write it in record_observe, take longer (steps), or say that it may: "
                f"constant=[{term.name!r}]"
            )


def numbers(trial: Trial) -> Iterator[str]:
    """All that the task writes is finite and has a name, and rewards are in their range."""
    run = trial.run
    for name in trial.watch.names():
        yield f"{name} is not finite in some step, and counts as 0; look for a division by zero, or a negative root"
    for name, (declared, written) in trial.watch.beyond().items():
        yield (
            f"{name} declares {declared} names, and {written} columns are written: those beyond are the next "
            "environment's, or nobody's; name them, or write fewer"
        )
    failed = int((run["failure"] != 0).any(0).sum())
    if failed:
        yield (
            f"the simulation fails in {failed} of {NUM_ENVS} environments under random actions; info['failure'] says "
            "why, docs/envs what that means"
        )
    if trial.reward_range:
        low, high = trial.reward_range
        found = float(run["reward"].min()), float(run["reward"].max())
        if not low <= found[0] <= found[1] <= high:
            yield f"rewards are in {list(found)}, and should be in reward_range={[low, high]}"


def memory(trial: Trial) -> Iterator[str]:
    """What is returned is the caller's own."""
    many = trial.many
    many.reset(trial.seed)
    given = []
    for action in trial.actions[:2]:
        many.step(action)
        given += [(name, many.read(array_of(name))) for name in TOLD]
    own = [(name, array.numpy()) for group in many.groups for name, array in group.arrays().items()]
    own += [(name, array_of(name)(group).numpy()) for group in many.groups for name in TOLD]
    for place, (name, value) in enumerate(given):
        for other, array in [*given[:place], *own]:
            if np.shares_memory(value, array):
                yield f"the returned {name} shares memory with {other}; return copies"
                return


def actions(trial: Trial) -> Iterator[str]:
    """Actions of a wrong shape, or that are not finite, are refused and change nothing."""
    many, good = trial.many, trial.actions[0]
    many.reset(trial.seed)
    before = many.get_state()
    broken = good.copy()
    broken[-1, -1, -1] = np.nan
    for what, bad in {"too many components": np.concatenate([good, good], -1), "a component NaN": broken}.items():
        try:
            many.step(bad)
        except ValueError:
            changed = _changed(before, many.get_state())
            if changed:
                yield f"an action with {what} is refused and still changes {', '.join(changed)}"
        else:
            yield f"an action with {what} is not refused; leave step() of the environments as it is"


def masks(trial: Trial) -> Iterator[str]:
    """A reset of some environments leaves the others alone, also in what is to come."""
    many, half = trial.many, len(trial.actions) // 2
    undisturbed = trial.run
    play(many, trial.actions[:half], trial.seed)
    before, last = many.get_state(), np.arange(NUM_ENVS) == NUM_ENVS - 1
    many.reset(mask=last)
    remedy = "in record_reset write only where mask[e] is set"
    changed = _changed(before, many.get_state(), slice(NUM_ENVS - 1))
    if changed:
        yield f"a reset of environment {NUM_ENVS - 1} alone changes {', '.join(changed)} of the others; {remedy}"
        return
    later = {name: value[:, :-1] for name, value in go_on(many, trial.actions[half:]).items()}
    told = trial.difference(later, {name: undisturbed[name][half:, :-1] for name in later})
    if told:
        yield f"a reset of environment {NUM_ENVS - 1} alone changes what the others do later: {told}; {remedy}"


def states(trial: Trial) -> Iterator[str]:
    """A state that is restored in another episode goes on as it did."""
    many, half = trial.many, len(trial.actions) // 2
    play(many, trial.actions[:half], trial.seed)
    state = many.get_state()
    expected = go_on(many, trial.actions[half:])
    many.reset(trial.seed + NUM_ENVS)
    many.step(trial.actions[0])
    many.set_state(state)
    told = trial.difference(go_on(many, trial.actions[half:]), expected)
    if told:
        yield f"a restored state goes on otherwise: {told}; let arrays() name all that the task remembers"


def looks(trial: Trial) -> Iterator[str]:
    """To observe changes nothing."""
    many = trial.many
    play(many, trial.actions[:2], trial.seed)
    before, seen = many.get_state(), many.observation()
    for group in many.groups:
        group.observe_graph.run()
    changed = _changed(before, many.get_state())
    if changed or many.observation().tobytes() != seen.tobytes():
        what = ", ".join(changed) or "what is seen"
        yield f"observing a second time changes {what}; record_observe must write into env.observation alone"


#: In this order; each looks at environments that it resets itself.
PROMISES = (repeats, singles, observations, numbers, memory, actions, masks, states, looks)


#: Environments of the batch; each is compared with a single one.
NUM_ENVS = 3
#: What is compared of a run, arrays of the batch.
TOLD = (
    "observation", "reward", "cost", "terms", "cost_terms", "metrics", "success", "terminated", "truncated", "failure"
)  # fmt: skip

#: A run: arrays ``(steps, num_envs, ...)`` by name, and under ``"start"`` what was seen before the first step.
Run = dict[str, np.ndarray]


@dataclass(frozen=True)
class Trial:
    """What is looked at.

    Attributes:
        many: a batch of :data:`NUM_ENVS`.
        one: a single environment of the same settings.
        watch: what ``many`` wrote that was not finite.
        actions: random ones, ``(steps, num_envs, num_agents, action_size)``.
        seed: of the first environment.
        reward_range: that every reward must be in, or None.
        constant: terms of the observation that may stay as they are.
    """

    many: BatchedEpisodes
    one: BatchedEpisodes
    watch: FiniteWatch
    actions: np.ndarray
    seed: int
    reward_range: tuple[float, float] | None
    constant: Sequence[str]

    @cached_property
    def run(self) -> Run:
        """All actions in the batch, the first time."""
        return self.play()

    def play(self) -> Run:
        """All actions in the batch."""
        return play(self.many, self.actions, self.seed)

    def difference(self, now: Run, then: Run, env: int | None = None) -> str | None:
        """The first of what differs between two runs of the batch, or of its environment ``env`` and a single one."""
        for name, value in now.items():
            a, b = (value if env is None else value[:, env : env + 1]), then[name]
            unlike = (a != b) & ~(np.isnan(a) & np.isnan(b)) if a.dtype.kind == "f" else a != b
            if unlike.any():
                at = tuple(int(i) for i in np.argwhere(unlike)[0])
                return f"{self._place(name, at, env)} is {a[at]}, not {b[at]}"
        return None

    def _place(self, name: str, at: tuple[int, ...], env: int | None) -> str:
        """What an element of a run is called."""
        task, what = self.many.task, name
        names = {"terms": task.reward_names, "cost_terms": task.cost_names, "metrics": task.metric_names}.get(name, ())
        if name in ("start", "observation"):
            what = f"observation {component(self.many, at[3])}"
        elif names:  # without there is a column that means nothing
            what = f"{name} {names[at[3]]!r}"
        when = "before the first step" if name == "start" else f"in step {at[0] + 1}"
        agent = f" of {task.agent_names[at[2]]}" if len(at) > 2 and self.many.num_agents > 1 else ""
        return f"{when} {what}{agent} in environment {at[1] if env is None else env}"


def component(episodes: BatchedEpisodes, index: int) -> str:
    """Name of a component of the flat observation: its term, and where it is in it."""
    for name, term in episodes.layout.items():
        if term.slice.start <= index < term.slice.stop:
            return f"{name}[{index - term.slice.start}]"
    raise IndexError(f"the observation has no component {index}; it has {episodes.layout.size}")


def play(episodes: BatchedEpisodes, actions: np.ndarray, seed: int) -> Run:
    """Begin with ``seed``, act, and go on with the next episode wherever one ends."""
    episodes.reset(seed)
    start = episodes.observation()[None]
    return {"start": start, **go_on(episodes, actions)}


def go_on(episodes: BatchedEpisodes, actions: np.ndarray) -> Run:
    """Act from where the environments are."""
    rows = []
    for action in actions:
        episodes.step(action)
        rows.append({name: episodes.read(array_of(name)) for name in TOLD})
        if episodes.find_ended().any():
            episodes.reset_ended()
    return {name: np.stack([row[name] for row in rows]) for name in TOLD}


def array_of(name: str) -> Callable[[BatchEnv], Any]:
    """Says which array of a batch is called ``name``."""
    return lambda batch: getattr(batch, name)


class TaskError(ValueError):
    """A task that does not keep what it should.

    Attributes:
        problems: what is wrong, a sentence each.
    """

    def __init__(self, task: str, problems: Sequence[str]) -> None:
        super().__init__("\n- ".join([f"{task} does not keep what environments promise:", *problems]))
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
    """See whether a task keeps what all environments promise, under random actions.

    That the same seed and actions give the same run; that environment ``i`` of a batch is the single environment of
    seed + ``i``; that what the task observes is in its space and changes, and all its numbers are finite and have
    names; that returned arrays are the caller's own; that bad actions are refused; that a masked reset and an
    observation leave everything else alone; and that a restored state goes on as it did.

    Args:
        task: its id, its class, or ``"module:id"``; of one agent or several.
        steps: control steps of a run.
        device: Warp device, ``"cpu"`` or ``"cuda:0"``.
        config: settings as a mapping, a YAML file or a configuration.
        reward_range: lower and upper bound of the reward, of every agent; not looked at if not given.
        constant: names of the task's observation terms that may stay as they are.
        fidelity: of the bodies; wins over ``config``.
        seed: of the first environment.
        **overrides: settings that win over ``config``.

    Raises:
        TaskError: the task does not; says all that is wrong.
        ValueError: fewer than two steps, an unknown term or a range that falls, or what building environments refuses.
    """
    if steps < 2:
        raise ValueError(f"steps={steps} must be >= 2")
    if reward_range is not None and not reward_range[0] <= reward_range[1]:
        raise ValueError(f"reward_range={list(reward_range)} falls; give the lower bound first")
    task_class = load_task(task)
    settings = load_config(task_class.Config, config, {**overrides, "physics.fidelity": fidelity})
    watched = task_class(settings)
    terms = [term.name for term in watched.terms()]
    for name in constant:
        if name not in terms:
            raise ValueError(f"constant={name!r} is no term that the task observes; there are {', '.join(terms)}")
    watch = FiniteWatch(watched)
    many = BatchedEpisodes(watched, NUM_ENVS, device, num_threads=1)
    one = BatchedEpisodes(task_class(settings), 1, device)
    shape = steps, NUM_ENVS, many.num_agents, many.action_size
    drawn = np.random.default_rng(seed).uniform(-1.0, 1.0, shape).astype(np.float32)
    trial = Trial(many, one, watch, drawn, seed, reward_range, constant)
    try:
        problems = [problem for check in PROMISES for problem in check(trial)]
    finally:
        many.close()
        one.close()
    if problems:
        raise TaskError(task if isinstance(task, str) else task.__name__, problems)
