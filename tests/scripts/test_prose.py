"""The lint of docstrings and comments finds what it forbids, and nothing else."""

from __future__ import annotations

import pytest

from scripts import prose


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ('"""What a node stores."""\n', 1),
        ('def f():\n    """How fast it is."""\n', 1),
        ('class A:\n    """A node that knows its mass."""\n', 1),
        ("x = 1  # the particle that feels it\n", 1),
        ('def f():\n    """Return the mass.\n\n    Nobody tells it.\n    """\n', 2),
        ('def f():\n    """Return the mass of a node that was told."""\n', 1),
        ('def f():\n    """Return what a user who has a GPU sees."""\n', 0),
        ('def f():\n    """Set ``told``, an argument of a library."""\n', 0),
        ('x = "who knows"\n', 0),
        ('def f():\n    """Wait for the whole answer."""\n', 0),
    ],
)
def test_breaches_are_found(source, count):
    assert len(list(prose.breaches(source))) == count


def test_a_breach_is_found_on_its_line():
    ((line, text),) = prose.breaches('def f():\n    """Return x.\n\n    A thread tells it.\n    """\n')
    assert line == 4 and "tells" in text
