"""Lint of the prose in docstrings and comments: ``python -m scripts.prose [FOLDER ...]``.

A docstring begins with an imperative verb or a noun, never with What, Who, How or Where; and particles, nodes, threads
and environments are things: they store and read, and do not tell, ask, know or feel. Prints every breach and the counts
by folder; the exit status is 1 if there is any.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("piavatar_envs", "agents", "benchmarks", "scripts")

#: First words that a docstring must not have.
FIRST = re.compile(r"\s*(What|Who|Whoever|Whose|Whom|How|Where)\b")
#: Words that make a thing a person.
PERSON = re.compile(
    r"\b(who|whoever|whom|nobody|somebody|anybody|everybody|tells|told|knows|asks for|feels)\b", re.IGNORECASE
)
#: Contexts in which such a word is right: people, and names in code or quotes.
ALLOWED = re.compile(
    r"\b(users?|people|callers?|readers?|authors?|those of you|anyone|someone) who\b|``[^`]*``|\"[^\"]*\""
)


def texts(source: str) -> Iterator[tuple[int, str, bool]]:
    """Yield line, text and whether it is a docstring, of every docstring and every block of comments."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            docstring = ast.get_docstring(node, clean=False)
            if docstring:
                yield node.body[0].lineno, docstring, True
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string, False


def breaches(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and description of every breach in a file."""
    for line, text, is_docstring in texts(source):
        first = FIRST.match(text) if is_docstring else None
        if first:
            yield line, f"a docstring begins with {first[1]}"
        blank = ALLOWED.sub(lambda match: re.sub(r"\S", "x", match[0]), text)
        for match in PERSON.finditer(blank):
            row = line + blank.count("\n", 0, match.start())
            context = " ".join(text[max(0, match.start() - 30) : match.end() + 30].split())
            yield row, f"{match[0]!r} in: {context}"


def main(arguments: list[str] | None = None) -> int:
    """Check folders and print the breaches; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "folders", nargs="*", default=FOLDERS, help="folders or files; all of the project's if not given"
    )
    parser.add_argument("--counts", action="store_true", help="print the counts by folder only")
    options = parser.parse_args(arguments)
    counts: Counter[str] = Counter()
    for name in options.folders:
        path = ROOT / name
        for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
            shown = file.relative_to(ROOT)
            if shown == Path(__file__).relative_to(ROOT):
                continue  # names the words
            for line, description in breaches(file.read_text(encoding="utf-8")):
                counts[str(shown.parent)] += 1
                if not options.counts:
                    print(f"{shown}:{line}: {description}")
    for folder, count in sorted(counts.items()):
        print(f"{folder}: {count}")
    return int(bool(counts))


if __name__ == "__main__":
    sys.exit(main())
