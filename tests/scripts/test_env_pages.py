"""Generator of docs/envs: its tables agree with the environments, it finds gaps, and its check finds differences.

``make docs CHECK=1`` compares the committed pages with the generator.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.config import EnvConfig
from piavatar_envs.config.load import setting_keys
from piavatar_envs.envs.observations import ObservationLayout, ObservationTerm
from piavatar_envs.envs.task import Metric, Task, Term
from piavatar_envs.mpm.types import FAILURE_NAMES
from scripts import env_pages
from scripts.pages.entries import Entry, Facts, entries, gather
from scripts.pages.gaps import gaps
from scripts.pages.text import FAILURE_DOCS, FOLDER, entry_page

ENTRIES = {entry.name: entry for entry in entries()}


@pytest.fixture(scope="module", params=ENTRIES)
def page(request, device):
    """An environment, its facts and the text of its page."""
    entry = ENTRIES[request.param]
    env = entry.make(fidelity="tiny", device=device)
    facts = gather(entry, env)
    yield env, facts, entry_page(entry, facts)
    env.close()


def rows(text: str, heading: str) -> list[list[str]]:
    """Return the cells of all table rows below a heading of a page, without heads and rules."""
    section = text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    lines = [re.split(r" (?<!\\)\| ", line[2:-2]) for line in section.split("\n") if line.startswith("| ")]
    heads = [n - 1 for n, line in enumerate(lines) if set(line) == {"---"}]
    return [line for n, line in enumerate(lines) if n not in heads and set(line) != {"---"}]


def test_steps_of_actions_are_those_of_the_kernels(page):
    """Compare the action table with the arrays that kernels scale and clamp with."""
    env, facts, text = page
    table, action_map = rows(text, "Actions"), env.batch.action_map
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


def test_tables_list_the_returned_values_and_all_settings(page):
    env, facts, text = page
    spans = [[int(n) for n in row[0].strip("`").split(":")] for row in rows(text, "Observations")]
    assert [start for start, _ in spans] == [0, *(stop for _, stop in spans[:-1])]
    several = bool(facts.agents)
    space = env.observation_space(env.possible_agents[0]) if several else env.observation_space
    assert spans[-1][1] == space.shape[0]
    assert {row[0].strip("`") for row in rows(text, "Info")} == set(facts.info)
    keys = [row[0].strip("`") for row in rows(text, "Arguments")]
    assert set(setting_keys(type(facts.config))) <= set(keys)
    assert all(keys.count(key) == 1 for key in keys if "." in key)
    drawn = {p.name: p for p in facts.task.drawn() if p.low < p.high}
    parameters = {row[0].strip("`"): row[2] for row in rows(text, "Parameters")}
    assert parameters.keys() == drawn.keys()
    for name, cell in parameters.items():
        low, high = cell.removesuffix(", logarithmic").split(" to ")
        assert [float(low), float(high)] == pytest.approx([drawn[name].low, drawn[name].high], rel=1e-3)
        assert cell.endswith(", logarithmic") == drawn[name].log


def test_blocks_of_a_page_are_one_blank_line_apart(page):
    """Two of them, as a list without its first item leaves, would end a list for readers of Markdown."""
    assert "\n\n\n" not in page[2]


def test_usage_runs(page, device):
    block = re.search(r"```python\n(.*?)```", page[2], re.DOTALL)[1]
    tiny = block.replace(', render_mode="rgb_array")', f', fidelity="tiny", device="{device}")')
    tiny = tiny.replace('(render_mode="rgb_array")', f'(fidelity="tiny", device="{device}")')
    assert tiny != block
    names: dict = {}
    exec(tiny, names)
    names["env"].close()
    assert "info" in names or "infos" in names


class MadeUp(Task):
    description = "made up"
    summary = "A task that is made up."
    rewards = (Term("near", "of being near"),)
    metrics = (Metric("distance", "m", "a distance"),)
    costs = (Term("force", "of pressing"),)
    success_doc = "it is near"


def test_gaps_in_the_documentation_are_found():
    layout = ObservationLayout([ObservationTerm("height", 1, "m", "world", "of the pelvis")])
    facts = Facts(MadeUp(EnvConfig()), layout, (), {"distance": 1.0, "cost": 0.0})

    def found(facts=facts, **attributes):
        return "\n".join(gaps(Entry("made_up", "MadeUp-v0", type("MadeUp", (MadeUp,), attributes)), facts))

    assert not found()
    for key, attributes in {
        "summary": {"summary": ""},
        "success_doc": {"success_doc": ""},
        "far": {"rewards": (Term("far"),)},
        "force": {"costs": (Term("force", " "),)},
        "distance": {"metrics": (Metric("distance"),)},
        "info['distance']": {"metrics": ()},
    }.items():
        assert key in found(**attributes)
    mute = ObservationLayout([ObservationTerm("height", 1, "m", "world", "")])
    assert "height" in found(replace(facts, layout=mute))
    assert "info['novel']" in found(replace(facts, info={"novel": 1}))

    class Mute(EnvConfig):
        knob: int = 3

    assert "knob" in found(replace(facts, task=MadeUp(Mute())))
    assert set(FAILURE_DOCS) == set(FAILURE_NAMES.values())


def test_the_check_finds_stale_missing_and_surplus_files(tmp_path):
    for name, text in {"same.md": "a", "stale.md": "b", "surplus.md": "c"}.items():
        (tmp_path / name).write_text(text)
    lines = env_pages.differences(tmp_path, {"same": "a", "stale": "new", "missing": "d"})
    assert [re.search(r"(\w+)\.md", line)[1] for line in lines] == ["missing", "stale", "surplus"]
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for name, size in {"right": 30_000, "blank": 900, "surplus": 30_000}.items():
        (pictures / f"{name}.png").write_bytes(bytes(size))
    lines = env_pages.picture_faults(pictures, ["right", "blank", "missing"])
    assert [re.search(r"(\w+)\.png", line)[1] for line in lines] == ["blank", "missing", "surplus"]


def test_scores_are_those_of_the_committed_results(page):
    """Compare every mean return on a page with the files that its rows link to."""
    _, _, text = page
    table = rows(text, "Baseline scores")
    assert {row[0].split(" against ")[0] for row in table} >= {"zero", "random"} and len(table) >= 3
    for agent, _, shown, _, episodes, result in table:
        file = (FOLDER / re.search(r"\((.*?)\)", result)[1]).resolve()
        found = json.loads(file.read_text())["results"]
        mean = float(shown.split(" (")[0])
        same = [row for row in found if row["return_mean"] == pytest.approx(mean, abs=0.06)]
        assert same, f"{agent}: no row of {file} has a return of {mean}"
        assert int(episodes) in {row["episodes"] for row in same}
