"""Clients are complete: exact pins, a documented test each, and the table that the script writes of them."""

from __future__ import annotations

import ast

import pytest

from scripts import clients

FOLDERS = clients.find_clients()


@pytest.mark.parametrize("name", FOLDERS)
def test_client_has_exact_pins_and_a_documented_test(name):
    text = (FOLDERS[name] / clients.PINS).read_text(encoding="utf-8")
    pins = [line for line in (line.partition("#")[0].strip() for line in text.splitlines()) if line]
    assert all(pin.count("==") == 1 for pin in pins)
    names = [pin.partition("==")[0].lower().replace("_", "-") for pin in pins]
    assert len(names) == len(set(names)) and not {"torch", "warp-lang", "numpy"} & set(names)
    assert clients.own_pins(text)
    tests = list(FOLDERS[name].glob("test_*.py"))
    assert tests and all(ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) for path in tests)


def test_own_pins_are_the_first_block():
    assert clients.own_pins("# why\n\na==1\nb==2  # both\n\nc==3\n") == ("a 1", "b 2")


def test_table_names_failures_and_clients_without_tests_do_not_count_as_run():
    about = {"interfaces": {"gymnasium": "1.4.0"}, "seconds": 3.2, "date": "2026-11-29", "about": "x"}
    good = clients.Row("a", ("a 1",), passed=2, failed=0, skipped=0, **about)
    bad = clients.Row("b", ("b 1",), passed=1, failed=1, skipped=1, **about)
    none = clients.Row("c", ("c 1",), passed=0, failed=0, skipped=1, **about)
    assert good.ok and not bad.ok and not none.ok
    lines = clients.table([good, bad, none]).splitlines()
    assert lines[2] == "| a | a 1 | 1.4.0 |  | 2 passed | 3 | 2026-11-29 |"
    assert "1 passed, 1 failed, 1 skipped" in lines[3] and len(lines) == 5


def test_junit_reports_are_counted(tmp_path):
    report = tmp_path / "report.xml"
    report.write_text('<testsuites><testsuite tests="5" failures="1" errors="1" skipped="1"/></testsuites>')
    assert clients.counts(report) == (2, 2, 1)


def test_unknown_clients_are_refused():
    with pytest.raises(SystemExit, match="no client gym"):
        clients.main(("gym",))
