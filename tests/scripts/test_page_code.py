"""Code of the pages: its blocks, and the modules that they are type-checked as."""

from __future__ import annotations

from scripts.page_code import PAGES, Block, blocks, page_modules


def test_blocks_know_their_files(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "Run this:\n\n```python\na = 1\n```\n\nSave this as `b.py`:\n\n```python\nb = 2\n```\n\n"
        "```sh\nmake\n```\n\n```python\n>>> a\n1\n```\n"
    )
    found = blocks(page)
    assert found == [Block("a = 1\n"), Block("b = 2\n", "b.py"), Block(">>> a\n1\n")]
    assert [block.session for block in found] == [False, False, True]


def test_modules_of_pages():
    modules = page_modules(PAGES["docs/tasks.md"])
    assert {"hands_up", "tall", "docs_tasks"} == set(modules) and "import hands_up" in modules["docs_tasks"]
    assert "class Tall" not in modules["docs_tasks"]
