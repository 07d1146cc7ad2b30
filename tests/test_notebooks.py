"""Notebooks: every cell runs, from top to bottom, in a fresh folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))
#: In place of the cell that is tagged ``parameters``.
SMALLER = {"FIDELITY": "tiny", "STEPS": 3, "NUM_ENVS": 2, "TRAINING_STEPS": 256}


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_runs(notebook, monkeypatch, tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    pytest.importorskip("PIL", reason="needs the extra render")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code), "clear its outputs"
    space: dict = {"__name__": notebook.stem}
    for cell in code:
        text = "".join(cell["source"])
        if text.startswith("%%writefile "):
            name, _, module = text.removeprefix("%%writefile ").partition("\n")
            (tmp_path / name).write_text(module, encoding="utf-8")
        elif "parameters" in cell["metadata"].get("tags", ()):
            exec(compile(text, notebook.stem, "exec"), space)
            assert set(space) - {"__name__", "__builtins__"} <= set(SMALLER)
            space |= SMALLER
        else:
            exec(compile(text, notebook.stem, "exec"), space)


def test_there_are_notebooks():
    assert [path.stem for path in NOTEBOOKS] == ["first_steps", "gpu_batch", "own_task"]
