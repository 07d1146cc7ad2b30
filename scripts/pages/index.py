"""The list of all pages."""

from __future__ import annotations

from collections.abc import Sequence

from scripts.pages.entries import Entry, Facts
from scripts.pages.markdown import code, page, table
from scripts.pages.text import NOTE


def index_page(found: Sequence[tuple[Entry, Facts]]) -> str:
    """Return the list of all pages."""
    head = ("environment", "task", "actions", "observations")
    single = [_index_row(entry, facts) for entry, facts in found if not entry.multi]
    multi = [(*_index_row(entry, facts), str(len(facts.agents))) for entry, facts in found if entry.multi]
    return page(
        [
            NOTE.format(source="the tasks"),
            "# Environments",
            "Each page lists the actions, observations, reward, settings and `info` of one environment, from its "
            "code. Units are metres, kilograms, seconds and radians; z is up.",
            "## One agent: Gymnasium" if multi else "",
            table(head, single),
            "## Several agents: PettingZoo" if multi else "",
            table((*head, "agents"), multi) if multi else "",
        ]
    )


def _index_row(entry: Entry, facts: Facts) -> tuple[str, str, str, str]:
    link = f"[{code(entry.title)}]({entry.name}.md)"
    return link, entry.task.description, str(facts.actions.size), str(facts.layout.size)
