"""``watch``: endless play, the controls of the panel, and the end by Ctrl-C."""

from __future__ import annotations

import re
import signal
import subprocess
import sys

import numpy as np
import pytest

from piavatar_envs import cli, watch
from piavatar_envs.api.pictures import Live, Pace
from piavatar_envs.play import make
from tests.api.test_live import FakeTime
from tests.conftest import reward_terms

pytest.importorskip("viser", reason='needs pip install "piavatar-envs[live]"')


@pytest.fixture
def open_show(device):
    """A maker of shows with a clock that only they move: ``show, env, time, begun = open_show(env_id)``."""
    opened = []

    def start(env_id: str, **settings):
        env, time = make(env_id, {"device": device, "fidelity": "tiny", **settings}), FakeTime()
        live = Live(env.unwrapped.batch, env.unwrapped.apply_force, port=8300, pace=Pace(time.clock, time.sleep))
        begun = []
        still = np.zeros(env.action_space.shape, np.float32)
        show = watch.Show(env, lambda _observation: still, lambda: begun.append(1), live)
        opened.append((live, env))
        show.begin(seed=4)
        return show, env, time, begun

    yield start
    for live, env in opened:
        live.close()
        env.close()


def table(show) -> str:
    return show.panel._text.content


def steps_done(env) -> int:
    return int(env.unwrapped.batch.step_count.numpy()[0])


def test_it_plays_one_episode_after_the_other(open_show):
    show, env, time, begun = open_show("PIAvatar/Reach-v0", episode_seconds=0.2)
    for turn in range(1, 16):
        show.turn()
        if turn in (6, 12):  # the last step of an episode is shown, however short it was
            assert "| step | 6 |" in table(show) and "| time | 0.20 s |" in table(show)
    assert len(begun) == 3 and steps_done(env) == 3
    assert time.now - 100.0 == pytest.approx(0.5)


def test_the_panel_pauses_steps_and_resets(open_show):
    show, env, _, begun = open_show("PIAvatar/Reach-v0")
    show.turn()
    show.panel.play(False)
    for _ in range(3):
        show.turn()
    assert steps_done(env) == 1 and show.panel._play.label == "Play"
    show.panel.request_step()
    for _ in range(3):
        show.turn()
    assert steps_done(env) == 2 and "| step | 2 |" in table(show)
    show.panel.request_episode()
    show.turn()
    assert steps_done(env) == 0 and len(begun) == 2 and "| step | 0 |" in table(show)
    show.panel.play(True)
    show.turn()
    assert steps_done(env) == 1 and show.panel._play.label == "Pause"


def test_the_panel_sets_the_speed_and_a_pause_shows_the_last_step(open_show):
    """At high speed not every step is shown; the last one is, as soon as it is paused."""
    show, _, time, _ = open_show("PIAvatar/Reach-v0")
    show.panel.speed = 0.5
    show.turn()
    assert time.now - 100.0 == pytest.approx(2.0 / 30.0)
    show.panel.speed = 4.0
    for _ in range(2):
        show.turn()
    assert time.now - 100.0 == pytest.approx(2.5 / 30.0)
    assert show._live._behind
    show.panel.play(False)
    show.turn()
    assert not show._live._behind and show._live._progress.since_last() == 0.0


def test_the_panel_changes_the_colour_while_paused(open_show):
    show, env, _, _ = open_show("PIAvatar/Reach-v0")
    show.panel.play(False)
    show.panel.color = "strain"
    show.turn()
    view = show._live.view
    assert any("band" in name for name in view._nodes) and "/world/body_0" not in view._nodes
    assert steps_done(env) == 0


def test_the_panel_shows_the_reward(open_show):
    show, *_ = open_show("PIAvatar/Reach-v0")
    show.panel.request_step()
    show.turn()
    content = table(show)
    assert "PIAvatar/Reach-v0" in content and f"| return | {show._return:.2f} |" in content
    for name, value in reward_terms(show._info).items():
        assert f"| {name} | {value:+.3f} |" in content


def test_games_are_watched(open_show):
    pytest.importorskip("pettingzoo")
    show, *_ = open_show("sumo_v0")
    show.panel.request_step()
    show.turn()
    assert "| agent_0.control |" in table(show) and "| agent_1.control |" in table(show)
    shown = {name.split("_band")[0] for name in show._live.view._nodes}  # clothes are bands of their colours
    assert {"/world/body_0", "/world/body_1"} <= shown


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["watch", "PIAvatar/Nothing-v9"], "no environment 'PIAvatar/Nothing-v9'"),
        (["watch", "PIAvatar/Reach-v0", "--seed", "-1"], "seed=-1 must be >= 0"),
        (["watch", "Reach-v0", "--port", "0", "-c", "fidelity=tiny"], "port=0 "),
        (["watch", "PIAvatar/Reach-v0", "-c", "render_mode=human"], "render_mode is no setting here"),
    ],
)
def test_mistakes_end_in_one_line(capsys, device, args, words):
    with pytest.raises(SystemExit) as stop:
        cli.main([*args, "--device", device] if "Reach" in args[1] else args)
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
