"""Python of the documentation's pages, as users would save and run it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: README and guides, without those that are written from the code.
PAGES = {
    page.relative_to(ROOT).as_posix(): page
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs/training").glob("*")))
}
_BLOCK = re.compile(r"^```python\n(.*?)^```", re.M | re.S)
_FILE = re.compile(r"[Ss]ave this as\s`([\w.]+)`")


@dataclass(frozen=True)
class Block:
    """A block of Python.

    Attributes:
        code: its text.
        file: name under which the text before it says to save it; None for one to be run.
    """

    code: str
    file: str | None = None

    @property
    def session(self) -> bool:
        """Whether it is a session of an interpreter, with prompts."""
        return self.code.startswith(">>>")


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page in their order."""
    text, end, found = page.read_text(encoding="utf-8"), 0, []
    for match in _BLOCK.finditer(text):
        files = _FILE.findall(text[end : match.start()])
        found.append(Block(match[1], files[-1] if files else None))
        end = match.end()
    return found


def page_modules(page: Path) -> dict[str, str]:
    """Return modules by name: those that a page says to save, and one of all of its other blocks."""
    modules = {block.file.removesuffix(".py"): block.code for block in blocks(page) if block.file}
    code = "\n".join(block.code for block in blocks(page) if not block.file and not block.session)
    name = "_".join(page.relative_to(ROOT).with_suffix("").parts)
    return modules | ({name: code} if code else {})
