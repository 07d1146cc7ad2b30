"""Markdown: tables, code and numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; cells may hold Markdown, but neither lines nor bars of their own.

    Raises:
        ValueError: a row that is not as wide as the head.
    """
    lines = [head, ["---"] * len(head)]
    for row in rows:
        if len(row) != len(head):
            raise ValueError(f"a row of {len(row)} cells under a head of {len(head)}: {list(row)}")
        lines.append([" ".join(cell.split()).replace("|", "\\|") for cell in row])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def code(text: object) -> str:
    """Return text as code."""
    return f"`{text}`"


def listed(names: Iterable[object]) -> str:
    """Return names as code, with commas."""
    return ", ".join(code(name) for name in names)


def number(value: float) -> str:
    """Return a number to four digits, never in a form that depends on its type: 5, 0.1333, 1e+06."""
    return f"{value:.4g}"


def sentence(text: str) -> str:
    """Return a clause with a capital, unless it begins with code, and a full stop."""
    text = " ".join(text.split())
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith(('.', '!', '?')) else '.'}"


def page(blocks: Iterable[str]) -> str:
    """Join blocks with blank lines between them; empty ones are left out."""
    return "\n\n".join(block.strip("\n") for block in blocks if block) + "\n"
