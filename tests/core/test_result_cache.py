"""Kept results: read back, never stale, rebuilt where damaged, and announced where they take long."""

from __future__ import annotations

import dataclasses
import json
import os

import numpy as np
import pytest

from piavatar_envs.core import result_cache
from piavatar_envs.core.result_cache import digest_of, kept


@pytest.fixture(autouse=True)
def folder(empty_kernel_cache, monkeypatch):
    monkeypatch.setattr(result_cache, "LEAST_SECONDS", 0.0)
    return empty_kernel_cache / result_cache.FOLDER


@dataclasses.dataclass
class Pair:
    first: np.ndarray
    second: tuple


class Work:
    """Counts how often it is done."""

    def __init__(self) -> None:
        self.done = 0

    def __call__(self):
        self.done += 1
        return {"a": np.arange(3.0), "b": np.array([["x", "yy"]])}


def test_results_are_computed_once_and_read_back(folder):
    work = Work()
    for _ in range(2):
        arrays = kept("thing", "0123", work, "working")
        np.testing.assert_array_equal(arrays["a"], np.arange(3.0))
        assert arrays["b"].tolist() == [["x", "yy"]]
    assert work.done == 1
    assert [path.name for path in folder.iterdir()] == ["thing_0123.npz"]
    kept("thing", "4567", work, "working")
    assert work.done == 2


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 no archive", b"\x93NUMPY"])
def test_a_damaged_file_is_computed_anew(folder, damage):
    work = Work()
    kept("thing", "0123", work, "working")
    path = folder / "thing_0123.npz"
    path.write_bytes(damage or path.read_bytes()[:100])
    np.testing.assert_array_equal(kept("thing", "0123", work, "working")["a"], np.arange(3.0))
    assert work.done == 2
    kept("thing", "0123", work, "working")
    assert work.done == 2


def test_objects_of_a_file_are_not_loaded(folder):
    folder.mkdir(parents=True)
    np.savez(folder / "thing_0123.npz", a=np.array([json], dtype=object).astype(str).astype(object))
    work = Work()
    kept("thing", "0123", work, "working")
    assert work.done == 1


def test_quick_results_and_folders_that_cannot_be_written_leave_no_file(folder, monkeypatch):
    work = Work()
    folder.parent.mkdir(exist_ok=True)
    folder.write_text("a file in the way")
    for _ in range(2):
        kept("thing", "0123", work, "working")
    assert work.done == 2
    folder.unlink()
    monkeypatch.setattr(result_cache, "LEAST_SECONDS", 60.0)
    kept("thing", "0123", work, "working")
    assert not folder.exists()


def test_files_that_were_not_used_for_longest_go_when_the_folder_is_full(folder, monkeypatch):
    work = Work()
    for number, digest in enumerate(("first", "second", "third")):
        kept("thing", digest, work, "working")
        os.utime(folder / f"thing_{digest}.npz", (number, number))
    size = (folder / "thing_first.npz").stat().st_size
    kept("thing", "first", work, "working")  # used again
    monkeypatch.setattr(result_cache, "MOST_BYTES", 2 * size)
    kept("thing", "fourth", work, "working")
    assert {path.name for path in folder.iterdir()} == {"thing_first.npz", "thing_fourth.npz"}


def test_a_digest_tells_values_types_and_code_apart():
    values = [[1], [1.0], ["1"], [np.array(1)], [np.array([1])], [np.array([1.0])], [1, 1], [None]]
    digests = [digest_of(value, []) for value in values]
    assert len(set(digests)) == len(values)
    assert digest_of([1], [json]) != digest_of([1], [])
    assert digest_of([np.arange(4)[::2]], []) == digest_of([np.array([0, 2])], [])
    nested = [Pair(np.zeros(2000), ("a", 1)), Pair(np.zeros(2000), ("b", 1)), Pair(np.arange(2000.0) == 999, ("a", 1))]
    assert len({digest_of(value, []) for value in nested}) == 3
    with pytest.raises(TypeError, match="no digest of a set"):
        digest_of([{1, 2}], [])


def test_long_work_is_announced(capsys, monkeypatch):
    import time

    monkeypatch.setattr(result_cache, "PATIENCE", 0.05)
    kept("thing", "0123", lambda: time.sleep(0.3) or {"a": np.zeros(1)}, "closing the skin of knight.glb")
    assert "closing the skin of knight.glb" in capsys.readouterr().err
    kept("thing", "0123", dict, "closing the skin of knight.glb")
    assert capsys.readouterr().err == ""
