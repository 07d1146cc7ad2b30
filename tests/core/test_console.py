"""Quiet console: no lines of Warp, and a bar only where kernels take time to compile."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

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
