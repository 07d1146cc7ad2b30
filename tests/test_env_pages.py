"""The pages of docs/envs say what the code does, say all of it, and lead nowhere that does not exist."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest
from pydantic import BaseModel, Field

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.config import FROZEN, ControlConfig, EnvConfig, PoseControlConfig
from piavatar_envs.config.load import setting_keys
from piavatar_envs.config.schema import AvatarConfig, ColliderConfig, PropConfig, SceneConfig
from piavatar_envs.envs.observations import ObservationLayout, ObservationTerm
from piavatar_envs.envs.task import Metric, Task, Term
from piavatar_envs.mpm.types import FAILURE_NAMES
from scripts.pages import markdown, pictures
from scripts.pages.entries import ROOT, Entry, Facts, entries, gather
from scripts.pages.gaps import gaps
from scripts.pages.index import index_page
from scripts.pages.scene import scene_section
from scripts.pages.settings import sections_of
from scripts.pages.text import FAILURE_DOCS, FOLDER, PICTURES, entry_page

ENTRIES = {entry.name: entry for entry in entries()}
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="session")
def made(device):
    """A maker of environments by the names of their pages, each with its facts; the same name gives the same object."""
    known = {}

    def make(name: str):
        if name not in known:
            env = ENTRIES[name].make(fidelity="tiny", device=device)
            known[name] = env, gather(ENTRIES[name], env)
        return known[name]

    yield make
    for env, _ in known.values():
        env.close()


def committed(path) -> str:
    assert path.is_file(), f"{path.relative_to(ROOT)} is missing; run `make docs` and commit it"
    return path.read_text(encoding="utf-8")


def rows(text: str, heading: str) -> list[list[str]]:
    """Cells of all table rows below a heading of a page, without heads and rules."""
    section = text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    lines = [re.split(r" (?<!\\)\| ", line[2:-2]) for line in section.split("\n") if line.startswith("| ")]
    heads = [n - 1 for n, line in enumerate(lines) if set(line) == {"---"}]
    return [line for n, line in enumerate(lines) if n not in heads and set(line) != {"---"}]


@pytest.mark.parametrize("name", ENTRIES)
def test_every_environment_has_a_page_that_is_up_to_date(made, name):
    text = entry_page(ENTRIES[name], made(name)[1])
    assert committed(FOLDER / f"{name}.md") == text, f"docs/envs/{name}.md is out of date; run `make docs`"


def test_the_index_is_up_to_date(made):
    text = index_page([(entry, made(name)[1]) for name, entry in ENTRIES.items()])
    assert committed(FOLDER / "README.md") == text, "docs/envs/README.md is out of date; run `make docs`"


@pytest.mark.parametrize("name", ENTRIES)
def test_nothing_is_left_unsaid(made, name):
    assert gaps(ENTRIES[name], made(name)[1]) == []


def test_no_page_or_picture_is_left_over():
    assert {path.stem for path in FOLDER.glob("*")} == {*ENTRIES, "README"}
    assert {path.stem for path in PICTURES.glob("*")} == set(ENTRIES)


@pytest.mark.parametrize("name", ENTRIES)
def test_a_page_has_its_picture(name):
    path = PICTURES / f"{name}.png"
    command = f"python -m scripts.env_pages --pictures --only {name}"
    assert path.is_file(), f"{path.relative_to(ROOT)} is missing; run `{command}`"
    data = path.read_bytes()
    # a frame without anything in it packs into a fraction of this
    assert data.startswith(PNG) and 20_000 < len(data) < 400_000


def test_links_lead_somewhere():
    targets = [
        (path, target)
        for path in FOLDER.glob("*.md")
        for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8"))
        if not target.startswith(("http:", "https:", "#"))
    ]
    assert len(targets) >= 3 * len(ENTRIES)
    for path, target in targets:
        assert (path.parent / target.partition("#")[0]).exists(), f"{path.relative_to(ROOT)} links to {target}"


@pytest.mark.parametrize("name", ENTRIES)
def test_steps_of_actions_are_what_the_kernels_take(made, name):
    """The action table against the arrays that kernels scale and clamp with."""
    env, facts = made(name)
    table, action_map = rows(entry_page(ENTRIES[name], facts), "Actions"), env.batch.action_map
    offset, scale = action_map.offset.numpy(), action_map.scale.numpy()
    lower, upper = np.degrees(action_map.lower.numpy()), np.degrees(action_map.upper.numpy())
    posed = facts.config.control.mode == "pose"
    acting = [b for b in np.argsort(offset) if offset[b] >= 0]
    assert [row[1].split(".")[0].strip("`") for row in table[: len(acting)]] == [JOINT_NAMES[b] for b in acting]
    for row, b in zip(table, acting, strict=False):
        assert row[0] == f"`{offset[b]}:{offset[b] + 3}`" and len(row) == (6 if posed else 5)
        if posed:
            assert float(row[2].split()[0]) == pytest.approx(scale[b], rel=1e-3) and row[2].endswith(" rad")
        ranges = [[float(bound) for bound in cell.split(" to ")] for cell in row[-3:]]
        assert ranges == pytest.approx(np.stack([lower[b], upper[b]], -1), rel=1e-3)
    root = table[len(acting) :]
    assert len(root) == (3 if action_map.root_offset >= 0 else 0) and facts.actions.size == 3 * len(acting) + len(root)
    for n, (row, step) in enumerate(zip(root, (action_map.root_step,) * 2 + (action_map.root_turn,), strict=False)):
        assert row[0] == f"`{action_map.root_offset + n}:{action_map.root_offset + n + 1}`"
        assert float(row[2].split()[0]) == pytest.approx(step, rel=1e-3)


@pytest.mark.parametrize("name", ENTRIES)
def test_tables_tell_what_the_environment_returns(made, name):
    env, facts = made(name)
    text = entry_page(ENTRIES[name], facts)
    spans = [[int(n) for n in row[0].strip("`").split(":")] for row in rows(text, "Observations")]
    assert [start for start, _ in spans] == [0, *(stop for _, stop in spans[:-1])]
    space = env.observation_space(env.possible_agents[0]) if ENTRIES[name].multi else env.observation_space
    assert spans[-1][1] == space.shape[0] and f"`Box(-inf, inf, {space.shape}, float32)`" in text
    assert {row[0].strip("`") for row in rows(text, "Info")} == set(facts.info)
    told = [row[0].strip("`") for row in rows(text, "Arguments")]
    assert set(setting_keys(type(facts.config))) <= set(told)
    assert all(told.count(key) == 1 for key in told if "." in key)
    assert any(row[:2] == ["`physics.fidelity`", '`"coarse"`'] for row in rows(text, "Arguments"))


@pytest.mark.parametrize("name", ENTRIES)
def test_what_a_task_draws_is_told_with_its_range(made, name):
    _, facts = made(name)
    told = {row[0].strip("`"): row[2] for row in rows(entry_page(ENTRIES[name], facts), "Parameters")}
    drawn = {p.name: p for p in facts.task.drawn() if p.low < p.high}
    assert told.keys() == drawn.keys()
    for parameter, text in told.items():
        low, high = text.removesuffix(", logarithmic").split(" to ")
        assert [float(low), float(high)] == pytest.approx([drawn[parameter].low, drawn[parameter].high], rel=1e-3)
        assert text.endswith(", logarithmic") == drawn[parameter].log


@pytest.mark.parametrize("name", ENTRIES)
def test_the_lines_of_usage_work(made, name, device):
    text = entry_page(ENTRIES[name], made(name)[1])
    block = re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]
    tiny = block.replace(', render_mode="rgb_array")', f', fidelity="tiny", device="{device}")')
    tiny = tiny.replace('(render_mode="rgb_array")', f'(fidelity="tiny", device="{device}")')
    assert tiny != block
    names: dict = {}
    exec(tiny, names)
    names["env"].close()
    assert "info" in names or "infos" in names


# What the generator itself does: on tasks and settings that are made up.


class Tuned(BaseModel):
    model_config = FROZEN
    gain: float = Field(2.0, gt=0.0, lt=9.0, description="a gain [1/s]")


class Item(BaseModel):
    model_config = FROZEN
    name: str = Field(..., description="its name")
    at: tuple[float, float, float] = Field((0.0, 1.0, 0.5), description="where [m]")


class MadeUpConfig(EnvConfig):
    control: ControlConfig = Field(PoseControlConfig(root="free"), description="how poses move the body")
    tuned: Tuned = Field(Tuned(gain=3.0), description="a section of the task")
    items: tuple[Item, ...] = Field((Item(name="ball"), Item(name="box", at=(0, 0, 2))), description="things")
    count: int | None = Field(None, ge=1, description="how many")
    kind: Literal["a", "b"] | None = Field("a", description="of what kind")
    shares: dict[str, Annotated[float, Field(ge=0.0, le=1.0)]] = Field({}, description="share of each [-]")


class MadeUp(Task):
    Config = MadeUpConfig
    description = "made up"
    summary = "A task that is made up."
    rewards = (Term("near", "of being near"),)
    metrics = (Metric("distance", "m", "a distance"),)
    costs = (Term("force", "of pressing"),)
    success_doc = "it is near"


@pytest.fixture
def facts() -> Facts:
    task = MadeUp(MadeUpConfig())
    layout = ObservationLayout([ObservationTerm("height", 1, "m", "world", "of the pelvis")])
    info = {"success": False, "distance": 1.0, "cost": 0.0}
    return Facts(task, layout, (), {"success": False}, info)


def test_settings_are_told_with_default_range_and_unit():
    # entries of lists are named without their section, and come late
    told = {row.key: row for section in reversed(sections_of(MadeUpConfig())) for row in section.settings}
    expected = {
        "tuned.gain": ("`3`", "1/s", "(0, 9)", True),
        "control.root": ('`"free"`', "", '`"wrench"`, `"free"`', True),
        "control.tone": ("`1`", "-", "[0, 1]", False),
        "physics.young_modulus": ("`100000`", "Pa", "[1, 1e+09]", False),
        "physics.num_substeps": ("`None`", "", "integer [1, 10000] or `None`", False),
        "shape.randomize": ("`False`", "", "`True`, `False`", False),
        "items": ('`[{name: "ball"}, {name: "box", at: [0, 0, 2]}]`', "", "list of entries, see below", True),
        "at": ("`[0, 1, 0.5]`", "m", "3 numbers", False),
        "name": ("required", "", "text", False),
        "count": ("`None`", "", "integer ≥ 1 or `None`", True),
        "kind": ('`"a"`', "", '`"a"`, `"b"` or `None`', True),
        "shares": ("`{}`", "-", "mapping to numbers [0, 1]", True),
    }
    for key, row in expected.items():
        assert (told[key].default, told[key].unit, told[key].allowed, told[key].own) == row, key
    assert told["tuned.gain"].description == "a gain"
    assert [s.name for s in sections_of(MadeUpConfig()) if not s.settings[0].own][-1] == "items[]"


def test_every_gap_is_found(facts):
    assert gaps(Entry("made_up", "MadeUp-v0", MadeUp), facts) == []

    def found(said=facts, **attributes):
        return gaps(Entry("made_up", "MadeUp-v0", type("MadeUp", (MadeUp,), attributes)), said)

    assert found(summary="") == ["MadeUp.summary is empty"]
    assert found(success_doc="") == ["MadeUp.success_doc is empty"]
    assert found(rewards=(Term("far"),)) == ["MadeUp.rewards: far has no description"]
    assert found(costs=(Term("force", " "),)) == ["MadeUp.costs: force has no description"]
    assert found(metrics=(Metric("distance"),)) == ["MadeUp.metrics: distance has no description"]
    assert found(metrics=()) == ["info['distance'] is not explained"]
    mute = ObservationLayout([ObservationTerm("height", 1, "m", "world", "")])
    assert found(replace(facts, layout=mute)) == ["observation term height has no description"]
    assert found(replace(facts, info={"novel": 1})) == ["info['novel'] is not explained"]

    class Mute(EnvConfig):
        knob: int = 3

    assert found(replace(facts, task=MadeUp(Mute()))) == ["setting knob has no description"]


def test_a_page_says_what_the_task_says(facts, monkeypatch):
    monkeypatch.setattr(Entry, "source", Path("made_up.py"))
    several = replace(facts, agents=("red", "blue"))
    text = entry_page(Entry("made_up_v0", "piavatar_envs.multi.made_up_v0", MadeUp, True), several)
    assert "from piavatar_envs.multi import made_up_v0" in text and "`red`, `blue`" in text
    assert rows(text, "Reward") == [["`near`", "of being near"]]
    assert rows(text, "Costs") == [["`force`", "of pressing"]]
    assert (
        "True when it is near." in text and "- the root wrench is released" not in text
    )  # nothing holds the root here
    assert [row[0] for row in rows(text, "Info")] == ["`success`", "`distance`", "`cost`"]
    assert "after a step" not in rows(text, "Info")[0] and "after a step" in rows(text, "Info")[1]
    assert "- v0: first version" in text


def test_a_scene_is_told_without_what_goes_without_saying():
    assert scene_section(SceneConfig(avatars=(AvatarConfig(),)), ("agent_0",)) == ""
    scene = SceneConfig(
        avatars=(AvatarConfig(), AvatarConfig(position=(0.0, -1.0), yaw=3.0)),
        props=(PropConfig(name="ball", mass=0.45),),
        colliders=(ColliderConfig(name="wall", size=(1.0, 0.1, 1.0)),),
    )
    assert rows("\n" + scene_section(scene, ("red", "blue")), "Scene") == [
        ["avatar", "`red`", "position `[0, 0]`, yaw `0`"],
        ["avatar", "`blue`", "position `[0, -1]`, yaw `3`"],
        ["soft prop", "`ball`", 'shape `"sphere"`, size `[0.11]`, position `[0, -1, 1]`, mass `0.45`'],
        ["collider", "`wall`", 'kind `"box"`, size `[1, 0.1, 1]`, position `[0, 0, 0]`'],
    ]


def test_every_failure_is_explained():
    assert set(FAILURE_DOCS) == set(FAILURE_NAMES.values())


def test_actions_of_a_picture():
    names = ["a.x", "a.y", "root.x"]
    assert not pictures.actions("zero", names, 1.0, 0.1, 0).any()
    assert (pictures.actions({"a.y": -0.5}, names, 1.0, 0.1, 0) == [[0.0, -0.5, 0.0]] * 10).all()
    swings = pictures.actions("random", names, pictures.PERIOD, 0.01, 0)
    assert swings.shape == (200, 3) and 0.05 < np.abs(swings).max() <= pictures.SWING
    assert np.abs(swings.mean(0)).max() < 1e-6  # they come back to where they began
    for wrong in ("rondom", {"b.x": 1.0}):
        with pytest.raises(ValueError, match="picture_actions"):
            pictures.actions(wrong, names, 1.0, 0.1, 0)


def test_a_table_refuses_ragged_rows_and_keeps_bars_in_their_cells():
    assert markdown.table(("a", "b"), [("x|y", "two\nlines")]).split("\n")[2] == "| x\\|y | two lines |"
    with pytest.raises(ValueError, match="row of 1"):
        markdown.table(("a", "b"), [("x",)])
