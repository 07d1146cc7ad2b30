"""``watch``: mistakes on the command line, and the end by Ctrl-C."""

from __future__ import annotations

import re
import signal
import subprocess
import sys

import pytest

from piavatar_envs import cli

pytest.importorskip("viser", reason='needs pip install "piavatar-envs[live]"')


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["watch", "PIAvatar/Nothing-v9"], "no environment 'PIAvatar/Nothing-v9'"),
        (["watch", "PIAvatar/Reach-v0", "--seed", "-1"], "seed=-1 must be >= 0"),
        (["watch", "Reach-v0", "--port", "0", "-c", "fidelity=tiny"], "port=0 "),
        (["watch", "PIAvatar/Reach-v0", "-c", "render_mode=human"], "render_mode is not a setting here"),
        (["watch", "PIAvatar/Reach-v0", "--agent", "nobody"], "no agent 'nobody'; there are random, zero, clip:"),
        (["watch", "PIAvatar/Reach-v0", "--num-envs", "0"], "num_envs=0"),
        (["watch"], "give the ID of an environment"),
        (["watch", "--scene", "nowhere.npz"], "nowhere.npz"),
        (["watch", "PIAvatar/Reach-v0", "--scene", "x.npz"], "a scene has its own environment"),
    ],
)
def test_mistakes_end_in_one_line(capsys, device, args, words):
    with pytest.raises(SystemExit) as stop:
        cli.main([*args, "--device", device] if "PIAvatar/Reach-v0" in args else args)
    error = capsys.readouterr().err
    assert stop.value.code == 2 and words in error and "Traceback" not in error


def test_a_missing_viser_is_named_in_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SystemExit) as stop:
        cli.main(["watch", "PIAvatar/Reach-v0"])
    assert stop.value.code == 2 and '[live]"' in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="sends SIGINT")
def test_ctrl_c_ends_it_without_a_traceback(device):
    line = [sys.executable, "-m", "piavatar_envs", "watch", "PIAvatar/Reach-v0", "--device", device, "--port", "8400"]
    run = subprocess.Popen(
        [*line, "-c", "fidelity=tiny"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    try:
        assert "live view: http://127.0.0.1:" in run.stdout.readline()
        run.send_signal(signal.SIGINT)
        said, error = run.communicate(timeout=60)
    finally:
        run.kill()
    assert run.returncode == 0 and "Traceback" not in error, error
    assert re.search(r"ended after \d+ steps; the same command begins again", said)
