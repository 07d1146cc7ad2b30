"""Gaps in the documentation of a task."""

from __future__ import annotations

from scripts.pages.entries import Entry, Facts
from scripts.pages.settings import sections_of
from scripts.pages.text import info_docs


def gaps(entry: Entry, facts: Facts) -> list[str]:
    """Return a line for everything that a page needs and the code does not give."""
    task = entry.task
    name = task.__name__
    found = [
        f"{name}.{text} is empty"
        for text in ("description", "summary", "success_doc", "history")
        if not getattr(task, text)
    ]
    found += [
        f"{name}.{what}: {one.name} has no description"
        for what in ("rewards", "costs", "metrics")
        for one in getattr(task, what)
        if not one.description.strip()
    ]
    found += [
        f"observation term {t.name} has no description" for t in facts.layout.values() if not t.description.strip()
    ]
    known = info_docs(entry)
    found += [f"info[{key!r}] is not explained" for key in facts.info if key not in known]
    settings = [setting for section in sections_of(facts.config) for setting in section.settings]
    return found + [f"setting {setting.key} has no description" for setting in settings if not setting.description]
