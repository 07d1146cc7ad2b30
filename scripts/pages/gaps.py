"""What a task has left unsaid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from scripts.pages.entries import Entry, Facts
from scripts.pages.settings import sections_of
from scripts.pages.text import info_docs


def gaps(entry: Entry, facts: Facts) -> list[str]:
    """One line for everything that a page needs and the code does not give, or gives for a name that there is not."""
    task = entry.task
    name = task.__name__
    found = [
        f"{name}.{text} is empty"
        for text in ("description", "summary", "success_doc", "history")
        if not getattr(task, text)
    ]
    for docs, names in (
        ("reward_docs", task.reward_terms),
        ("metric_docs", task.metrics),
        ("cost_docs", task.cost_terms),
    ):
        found += _compare(f"{name}.{docs}", getattr(task, docs), names)
    found += [
        f"observation term {t.name} has no description" for t in facts.layout.values() if not t.description.strip()
    ]
    found += [f"info[{key!r}] is not explained" for key in facts.info if not info_docs(entry).get(key, "").strip()]
    settings = [setting for section in sections_of(facts.config) for setting in section.settings]
    return found + [f"setting {setting.key} has no description" for setting in settings if not setting.description]


def _compare(where: str, docs: Mapping[str, str], names: Sequence[str]) -> list[str]:
    missing = [f"{where} lacks {name!r}" for name in names if not docs.get(name, "").strip()]
    return missing + [f"{where} explains {name!r}, which there is not" for name in docs if name not in names]
