"""Quiet console: no lines of Warp, and a bar only where kernels take time to compile."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from piavatar_envs.core.kernel_cache import _without_driver_warning
from piavatar_envs.core.launch_graph import _shown


def test_playing_an_environment_prints_nothing(device):
    """Neither Warp's banner, nor a line a module, nor that there is no CUDA driver, in any process."""
    code = (
        "import gymnasium, piavatar_envs\n"
        f"env = gymnasium.make('PIAvatar/Reach-v0', fidelity='tiny', device={device!r})\n"
        "env.reset(seed=0), env.step(env.action_space.sample())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True)
    bar = [line for line in done.stderr.replace("\r", "\n").splitlines() if line and "kernels" not in line]
    assert (done.stdout, bar) == ("", [])


def test_other_messages_of_native_code_are_kept(capfd):
    with _without_driver_warning():
        os.write(2, b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU ...\nanother\n")
    assert capfd.readouterr().err == "another\n"


def test_a_bar_shows_only_where_compiling_takes_time(capfd):
    for seconds, shown in ((0.0, False), (0.6, True)):
        with ThreadPoolExecutor(1) as pool:
            loads = [pool.submit(time.sleep, seconds) for _ in range(3)]
            assert len(list(_shown(loads))) == 3
        text = capfd.readouterr().err
        assert ("kernels, compiled once" in text) == shown and text.count("\n") == int(shown)


def test_without_a_folder_for_temporary_files_warnings_pass(monkeypatch, capfd):
    """A container that can only be read has none, though its kernel cache may be a volume."""

    def refuse(**_):
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    with _without_driver_warning():
        os.write(2, b"something\n")
    assert capfd.readouterr().err == "something\n"


@pytest.mark.parametrize("name", ["WARP_CACHE_PATH", "XDG_CACHE_HOME"])
def test_an_empty_variable_of_the_cache_is_none(name, tmp_path):
    """Warp takes it for the working directory."""
    code = "from piavatar_envs.core.kernel_cache import init_warp\ninit_warp()\n"
    env = {key: value for key, value in os.environ.items() if key not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")}
    env |= {"HOME": str(tmp_path / "home"), name: "", "PYTHONPATH": str(Path(__file__).parents[2])}
    (tmp_path / "here").mkdir()
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path / "here", env=env, timeout=300, check=True)
    assert not list((tmp_path / "here").iterdir())
