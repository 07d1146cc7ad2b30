"""Folders of trainings: no other training overwrites them, and damage is detected."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from agents.checkpoint import UNREADABLE, Checkpoint, load_weights
from agents.files import hold
from agents.sb3.config import load_training
from piavatar_envs.config import ConfigError


def test_no_other_process_trains_where_one_does(tmp_path):
    pytest.importorskip("fcntl", reason="Windows knows no such locks")
    hold(tmp_path)
    hold(tmp_path)  # one process may go on where it was
    code = f"from pathlib import Path; from agents.files import hold; hold(Path({str(tmp_path)!r}))"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert "another training writes to" in other.stderr and "--out" in other.stderr


@pytest.mark.parametrize("name", ["policy.pt", "policy.zip", "results.json"])
@pytest.mark.parametrize("resume", [False, True])
def test_a_run_that_was_kept_is_not_written_over(name, resume, tmp_path):
    (tmp_path / name).write_text("kept")
    config = load_training({"env_id": "PIAvatar/Reach-v0", "env": {"fidelity": "tiny"}})
    with pytest.raises(ConfigError, match=rf"{name} is of a training that has ended"):
        Checkpoint(tmp_path, "sb3.train", config, "cpu", resume)
    assert (tmp_path / name).read_text() == "kept"


def test_damage_anywhere_is_found(tmp_path):
    whole, damaged = tmp_path / "whole.pt", tmp_path / "damaged.pt"
    torch.save({"weight": torch.arange(3000.0)}, whole)
    torch.testing.assert_close(load_weights(whole, "cpu")["weight"], torch.arange(3000.0))
    content = whole.read_bytes()
    rng = np.random.default_rng(3)
    for at in [*rng.integers(0, len(content) - 64, 40), content.index(torch.arange(1000.0, 1004.0).numpy().tobytes())]:
        # four bytes of the numbers themselves, or of what describes them
        damaged.write_bytes(content[:at] + bytes(b ^ 0xFF for b in content[at : at + 4]) + content[at + 4 :])
        try:
            read = load_weights(damaged, "cpu")
        except UNREADABLE:
            continue
        torch.testing.assert_close(read["weight"], torch.arange(3000.0))  # what nobody reads, such as a date
    for broken in (content[: len(content) // 2], b"", b"no archive"):
        damaged.write_bytes(broken)
        with pytest.raises(UNREADABLE):
            load_weights(damaged, "cpu")
    with pytest.raises(UNREADABLE):
        load_weights(tmp_path, "cpu")
