"""The text of a page, section by section."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, JOINT_NAMES
from piavatar_envs.envs.task import COST, REWARD, Term
from piavatar_envs.mpm.types import FAILURE_NAMES
from scripts.pages.actions import actions_section
from scripts.pages.entries import ROOT, Entry, Facts
from scripts.pages.markdown import code, listed, number, page, sentence, table
from scripts.pages.scene import scene_section
from scripts.pages.scores import scores_section
from scripts.pages.settings import Section, Setting, sections_of

FOLDER = ROOT / "docs" / "envs"
PICTURES = ROOT / "docs" / "images" / "envs"
NOTE = "<!-- Written from the code by `make docs`: edit {source}, not this page. -->"

#: Meaning of ``ObservationTerm.frame``.
FRAMES = {
    "world": "the axes of the world, z up",
    "root": "the axes of the pelvis, positions relative to it",
    "parent": "the axes of the parent bone",
    "bone": "the axes of the bone itself",
    "-": "",
}
#: Keys that the views put into ``info`` beside the task's metrics.
INFO_DOCS = {
    "success": "whether the state is a success, see above",
    "failure": "code of the cause for which the simulation has failed; 0 while it has not",
    "limited_share": "share of all mass whose speed or stretch was limited to what the time step allows",
    "root_force": "force of the root wrench on the body, its mean over the step, in the world [N]",
    "root_torque": "its torque about the body's centre of mass [N m]",
    "root_released": "whether the root wrench has been released, which lasts until the end of the episode",
    "cost": "sum of the cost terms",
}
FAILURE_DOCS = {
    "nonfinite": "a velocity or a deformation is not finite",
    "out_of_grid": "more than a twentieth of the matter is at the edge of the domain, or a body has left it",
    "cfl": "more than a twentieth of the matter is too fast or too stretched for the time step",
    "action": "an action was not finite",
    "blocks": "the flesh is spread over more blocks of the grid than have memory",
    "force": "an external force was not finite, or one too many",
    "cloth": "a position or velocity of cloth is not finite",
}
USAGE = """```python
import gymnasium as gym
import piavatar_envs

env = gym.make("{title}", render_mode="rgb_array")
observation, info = env.reset(seed=0)
```"""
MULTI_USAGE = """```python
from {package} import {name}

env = {name}.parallel_env(render_mode="rgb_array")
observations, infos = env.reset(seed=0)
```"""


def entry_page(entry: Entry, facts: Facts) -> str:
    """Return the page of an environment."""
    task = entry.task
    return page(
        [
            NOTE.format(source=entry.source.as_posix()),
            f"# {entry.title}",
            sentence(task.description),
            f"![{entry.title}]({_relative(PICTURES / f'{entry.name}.png')})",
            _caption(entry),
            task.summary,
            _usage(entry),
            _overview(entry, facts),
            _agents(facts),
            scene_section(facts.task.scene, facts.task.agent_names),
            actions_section(facts),
            _observations(facts),
            _parameters(facts),
            _reward(entry),
            _costs(entry),
            _episode(entry, facts),
            _info(entry, facts),
            scores_section(entry, FOLDER),
            _arguments(entry, facts),
            "## Versions\n\n" + "\n".join(f"- {version}: {text}" for version, text in task.history),
        ]
    )


def _relative(path: os.PathLike[str]) -> str:
    return os.path.relpath(path, FOLDER).replace(os.sep, "/")


def _caption(entry: Entry) -> str:
    """Return the settings of the picture, if it has any."""
    settings = entry.task.picture_settings
    return f"*In the picture: {listed(f'{key}={value!r}' for key, value in settings.items())}.*" if settings else ""


def _usage(entry: Entry) -> str:
    package, _, name = entry.title.rpartition(".")
    return MULTI_USAGE.format(package=package, name=name) if entry.multi else USAGE.format(title=entry.title)


def _duration(seconds: float) -> str:
    """Return a time step, as a fraction where it is one."""
    rate = round(1.0 / seconds)
    return f"1/{rate} s" if rate > 1 and abs(rate * seconds - 1.0) < 1e-9 else f"{number(seconds)} s"


def _overview(entry: Entry, facts: Facts) -> str:
    dt, seconds = facts.config.physics.control_dt, facts.config.episode_seconds
    rows = [
        ("action", code(f"Box(-1, 1, ({facts.actions.size},), float32)")),
        (
            "observation",
            f'{code(f"Box(-inf, inf, ({facts.layout.size},), float32)")}, a `Dict` with `obs_mode="dict"`, or '
            '[pictures](../pixels.md) with `obs_mode="pixels"`',
        ),
        ("control step", f"{_duration(dt)}, {round(seconds / dt)} of them in an episode of {number(seconds)} s"),
        ("source", f"[{entry.source.as_posix()}]({_relative(ROOT / entry.source)})"),
    ]
    return table(("", "by default" + (", for each agent" if facts.agents else "")), rows)


def _agents(facts: Facts) -> str:
    if not facts.agents:
        return ""
    text = (
        f"{listed(facts.agents)}: each is one avatar, and their spaces are the same. An agent that terminates leaves "
        "`env.agents`; its avatar stays in the scene, no longer held up by its root wrench, and the others go on."
    )
    return page(["## Agents", text])


def _observations(facts: Facts) -> str:
    terms = list(facts.layout.values())
    rows = [
        (code(f"{t.slice.start}:{t.slice.stop}"), code(t.name), str(t.size), t.unit, t.frame, t.description)
        for t in terms
    ]
    frames = dict.fromkeys(t.frame for t in terms if FRAMES[t.frame])
    return page(
        [
            "## Observations",
            table(("slice", "term", "size", "unit", "frame", "meaning"), rows),
            "Frames: " + "; ".join(f"*{frame}*, {FRAMES[frame]}" for frame in frames) + ".",
            f"The order of joints is {listed(JOINT_NAMES[1:])}, with `pelvis` before them where all bones are meant; "
            f"that of body parts is {listed(BODY_PARTS)}.",
        ]
    )


def _parameters(facts: Facts) -> str:
    others = " (the agent's own, then those of the others, counted on from it)" if facts.agents else ""
    text = (
        "With `observe_parameters=True` the observation ends with the term `parameters`: all that the episode has "
        "drawn, each mapped from its range to [-1, 1]. It has the factors of `randomize` and the parameters of random "
        f"shapes{others}, then what the task draws, and last `clock`, the share of the episode that is over. With "
        '`control="pd"` or `"torque"` the parameters of each avatar end with its present `root_assist`.'
    )
    parameters = [p for p in facts.task.drawn() if p.low < p.high]
    rows = [
        (code(p.name), p.unit, f"{number(p.low)} to {number(p.high)}{', logarithmic' if p.log else ''}", p.description)
        for p in parameters
    ]
    drawn = table(("drawn by the task", "unit", "range", "meaning"), rows) if rows else ""
    return page(["## Parameters", text, drawn])


def _described(terms: Sequence[Term]) -> list[tuple[str, str]]:
    return [(code(term.name), term.description) for term in terms]


def _reward(entry: Entry) -> str:
    rows = _described(entry.task.rewards)
    return page(["## Reward", "The sum of", table(("term", "value"), rows)])


def _costs(entry: Entry) -> str:
    task = entry.task
    if not task.costs:
        return ""
    text = '`info["cost"]`, for constrained learning and not part of the reward, is the sum of'
    return page(["## Costs", text, table(("term", "value"), _described(task.costs))])


def _episode(entry: Entry, facts: Facts) -> str:
    task, config = entry.task, facts.config
    control = config.control
    ends = [task.termination_doc] if task.termination_doc else []
    if control.mode == "pose" and control.root == "wrench":
        ends.append(
            "the root wrench is released: the pelvis is off its commanded pose by "
            f"{number(np.degrees(control.release_tilt))} degrees of tilt (`release_tilt`), "
            f"{number(control.release_distance)} m horizontally (`release_distance`) or "
            f"{number(control.release_height)} m in height (`release_height`)"
        )
    failures = ", ".join(f"{bit} {code(name)} ({FAILURE_DOCS[name]})" for bit, name in FAILURE_NAMES.items())
    ends.append(
        f'the simulation fails; `info["failure"]` is the sum of its causes: {failures}; '
        "`piavatar_envs.failure_name` decodes it"
    )
    return page(
        [
            "## Episode",
            f'**Success**: `info["success"]` is True when {task.success_doc}.',
            "**Terminated** when\n\n" + ";\n".join(f"- {end}" for end in ends) + ".",
            f"**Truncated** after `episode_seconds`, {number(config.episode_seconds)} s.",
        ]
    )


def info_docs(entry: Entry) -> dict[str, str]:
    """Return the meaning of every known key of ``info``."""
    task = entry.task
    terms = {f"{REWARD}{name}": f"term {code(name)} of the reward" for name in task.reward_names}
    terms |= {f"{COST}{name}": f"term {code(name)} of the cost" for name in task.cost_names}
    return INFO_DOCS | terms | {one.name: f"{one.description} [{one.unit}]" for one in task.metrics}


def _info(entry: Entry, facts: Facts) -> str:
    docs = info_docs(entry)
    rows = [(code(key), _type_name(value), docs.get(key, "")) for key, value in facts.info.items()]
    text = "The same keys after a reset, when metrics and the terms of reward and cost are zero, and after a step."
    return page(["## Info", text, table(("key", "type", "meaning"), rows)])


def _type_name(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    return type(value).__name__


def _arguments(entry: Entry, facts: Facts) -> str:
    sections = sections_of(facts.config)
    own = [setting for section in sections for setting in section.settings if setting.own]
    shared = [replace(s, settings=tuple(row for row in s.settings if not row.own)) for s in sections]
    maker, more = ("parallel_env", "`max_cycles` (steps until truncation), ") if entry.multi else ("gym.make", "")
    text = (
        f'{code(maker)} takes `render_mode` (`None`, `"rgb_array"`, or `"human"`: live in a web browser), `device` (of '
        'Warp: `"cpu"` or `"cuda:0"`), '
        f"{more}`config` (a mapping or a YAML file, where `None` is `null`) and, by keyword, every setting below. Its "
        'last part is enough, as in `tone=0.3`; the whole name is given as `**{"control.tone": 0.3}`. The unit `-` is '
        "that of a pure number."
    )
    return page(
        [
            "## Arguments",
            text,
            "Settings of this task, and those of all environments that it gives another default:" if own else "",
            _settings_table(own) if own else "",
            "Settings of all environments:",
            *[_folded(section) for section in shared if section.settings],
        ]
    )


def _settings_table(settings: Sequence[Setting]) -> str:
    rows = [(code(s.key), s.default, s.unit, s.allowed, s.description) for s in settings]
    return table(("setting", "default", "unit", "allowed", "meaning"), rows)


def _folded(section: Section) -> str:
    """Return a table that opens on a click: most readers look for the task's own settings."""
    name = f"<code>{section.name}</code>: {section.description}" if section.name else "top level"
    return f"<details>\n<summary>{name}</summary>\n\n{_settings_table(section.settings)}\n\n</details>"
