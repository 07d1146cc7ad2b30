"""What every environment of the suite promises, and what to do about a task that does not keep it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from piavatar_envs.api.trial import NUM_ENVS, TOLD, Trial, array_of, go_on, play

State = dict[str, np.ndarray]


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
        group.observe_program.run()
    changed = _changed(before, many.get_state())
    if changed or many.observation().tobytes() != seen.tobytes():
        what = ", ".join(changed) or "what is seen"
        yield f"observing a second time changes {what}; record_observe must write into env.observation alone"


#: In this order; each looks at environments that it resets itself.
PROMISES = (repeats, singles, observations, numbers, memory, actions, masks, states, looks)
