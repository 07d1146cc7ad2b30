"""The loop of the live view: every control of the panel changes the simulation or what is shown of it."""

from __future__ import annotations

import io
import urllib.error
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest

from piavatar_envs.render.live import Drag
from piavatar_envs.sim.tuning import ALPHA, FRICTION, GRAVITY, STIFFNESS, TONE
from tests.live.shows import change, click, steps_done, table, values_of

pytest.importorskip("viser", reason='needs pip install "piavatar-envs[live]"')


def test_it_plays_one_episode_after_the_other(open_show):
    show, shown = open_show(episode_seconds=0.2), []
    for _ in range(15):
        show.turn()
        shown.append(table(show))
    # the last step of an episode is shown, however short it was
    assert all("| step | 6 |" in text and "| time | 0.20 s |" in text for text in (shown[5], shown[11]))
    assert steps_done(show) == 3 and show.played == 15
    assert show.time.now - 100.0 == pytest.approx(0.5)


def test_pause_single_step_and_new_episode(open_show):
    show = open_show()
    show.turn()
    change(show, "play")
    for _ in range(3):
        show.turn()
    assert steps_done(show) == 1 and show.panel.handles["play"].label == "Play"
    change(show, "step")
    for _ in range(3):
        show.turn()
    assert steps_done(show) == 2 and "| step | 2 |" in table(show)
    change(show, "episode")
    assert steps_done(show) == 0 and "| step | 0 |" in table(show)
    change(show, "play")
    assert steps_done(show) == 1 and show.panel.handles["play"].label == "Pause"


def test_speed_and_a_pause_that_shows_the_last_step(open_show):
    """At high speed not every step is shown; the last one is, as soon as it is paused."""
    show = open_show()
    change(show, "speed", 0.5)
    assert show.time.now - 100.0 == pytest.approx(2.0 / 30.0)
    change(show, "speed", 4.0)
    show.turn()
    assert show.time.now - 100.0 == pytest.approx(2.5 / 30.0)
    assert show.live._behind
    change(show, "play")
    assert not show.live._behind and show.live._progress.since_last() == 0.0


def test_colour_while_paused(open_show):
    show = open_show()
    change(show, "play")
    change(show, "color", "strain")
    nodes = show.live.view._nodes
    assert any("band" in name for name in nodes) and "/world/body_0" not in nodes
    assert steps_done(show) == 0


def test_the_table_shows_the_reward_and_the_plots_follow(open_show):
    show = open_show()
    change(show, "step")
    terms = {name: values[0] for name, values in show.host.outcome(0).items() if name.startswith("reward_")}
    assert "PIAvatar/Reach-v0" in table(show) and f"| return | {show.total:.2f} |" in table(show)
    assert terms and all(f"| {name[7:]} | {value:+.3f} |" in table(show) for name, value in terms.items())
    for _ in range(4):
        change(show, "step")
    time, reward = show.panel.reward._handle.data
    np.testing.assert_allclose(time, np.arange(1, 6) / 30.0)
    assert reward.sum() == pytest.approx(show.total, rel=1e-5)
    ground = np.linalg.norm(values_of(show, "sensors.boundary_impulse")[0], axis=-1).sum()
    assert show.panel.impulse._handle.data[1][-1] == pytest.approx(ground)
    change(show, "episode")
    change(show, "step")
    assert len(show.panel.reward._handle.data[0]) == 1


def test_an_environment_of_a_batch(open_show):
    """Each environment has its own episode, and what is thrown or dragged in one leaves the others."""
    show = open_show(num_envs=3)
    for _ in range(3):
        show.turn()
    first = show.live.view._nodes["/world/sphere_0"].vertices.copy()
    change(show, "play")
    change(show, "env", "2")
    batch, own = show.host.group_of(2)
    assert show.env == 2 and steps_done(show, 2) == 3 and "| step | 3 |" in table(show)
    assert not np.allclose(show.live.view._nodes["/world/sphere_0"].vertices, first)
    receivers = batch.simulation.receivers.find("left_wrist", 0)
    start = receivers.frame.position.numpy()[own, receivers.column].astype(float)
    show.live.view.drags[7] = Drag(0, start, start + [0.3, 0.0, 0.3])
    change(show, "step")
    assert (values_of(show, "forces.force") != 0.0).any(axis=(1, 2)).tolist() == [False, False, True]


def test_agents(open_show):
    show = open_show()
    show.turn()
    assert not show._agent.act(0).any()
    change(show, "agent", "random")
    drawn = show._agent.act(5)
    assert drawn.any() and np.array_equal(drawn, show._agent.act(5)) and not np.array_equal(drawn, show._agent.act(6))
    change(show, "agent", "clip:squat")
    knee = show.host.groups[0].simulation.avatars[0].state.command_rotation
    before = np.abs(knee.numpy()[0, 4, 0])
    for _ in range(15):
        show.turn()
    assert np.abs(knee.numpy()[0, 4, 0]) > before + 0.1  # the knees are bent, and the feet stay on the ground
    height = show.host.groups[0].simulation.avatars[0].tracked.position.numpy()[0]
    assert height[0, 2] < 0.85 and abs(height[[7, 8], 2].mean() - 0.08) < 0.06


def test_an_unknown_agent_is_refused(open_show):
    with pytest.raises(ValueError, match=r"no agent 'nobody'; there are random, zero, clip:"):
        open_show(agent="nobody")


def test_the_pid_agent_begins_anew_under_torque_control(open_show):
    show = open_show(**{"control.tone": 0.5})
    change(show, "agent", "pid")
    assert "needs control='torque'" in show.words
    assert show.host.config.control.mode == "torque" and show.setup.agent == "pid"
    for _ in range(5):
        show.turn()
    assert show._agent.act(0).any() and not values_of(show, "particles.failure").any()


def test_an_agent_that_begins_under_another_control(open_show):
    show = open_show(agent="clip:bow", control="torque")
    assert show.host.config.control.mode == "pose" and "needs control='pose'" in show.words


def test_settings_that_act_at_once(open_show):
    show = open_show()
    host, simulation = show.host, show.host.groups[0].simulation
    mu = simulation.model.particles.mu.numpy().copy()
    change(show, STIFFNESS, 50.0)  # kPa
    np.testing.assert_allclose(simulation.model.particles.mu.numpy(), 0.5 * mu, rtol=1e-6)
    change(show, FRICTION, 0.25)
    assert simulation.model.boundaries.friction.numpy()[0, 0] == pytest.approx(0.25)
    for name, value in ((GRAVITY, 2.0), (TONE, 0.1), (ALPHA, 0.9)):
        change(show, name, value)
    assert show.host is host and show.tuned == {
        STIFFNESS: 50_000.0, FRICTION: 0.25, GRAVITY: 2.0, TONE: 0.1, ALPHA: 0.9
    }  # fmt: skip
    control = simulation.controllers[0].parameters
    assert control.gravity[2] == -2.0 and control.shape_rate == pytest.approx(27.0)
    assert steps_done(show) == 5


def test_settings_that_need_a_new_environment(open_show):
    show = open_show()
    host = show.host
    change(show, TONE, 0.5)
    change(show, STIFFNESS, 150.0)
    assert show.host is not host and host.closed and "shorter time step" in show.words
    physics, control = show.host.config.physics, show.host.config.control
    # what was changed before stays
    assert (physics.young_modulus, control.tone, steps_done(show)) == (150_000.0, 0.5, 1)
    show.turn()
    assert steps_done(show) == 2


def test_a_click_throws_a_ball_at_the_body(open_show):
    show = open_show()
    change(show, "pointer", "throw")
    assert show.setup.ball and "ball to throw" in show.words
    size = show.host.layout.size
    change(show, "ball_mass", 1.5)
    change(show, "ball_speed", 8.0)
    click(show, (0.0, -3.0, 1.3), (0.0, 1.0, 0.0))
    props = show.host.groups[0].simulation.props
    ball = props.index("thrown_ball")
    assert props.state.velocity.numpy()[0, ball, 1] == pytest.approx(8.0, rel=0.05)
    assert props.density.numpy()[0, ball] * props.volume[ball] == pytest.approx(1.5)
    for _ in range(8):
        show.turn()
    bodies = show.panel.impulse.data[2]
    assert bodies.max() > 2.0  # it has hit
    change(show, "pointer", "camera")
    place = props.state.position.numpy()[0, ball].copy()
    click(show, (0.0, -3.0, 1.3), (0.0, 1.0, 0.0))
    assert np.linalg.norm(props.state.position.numpy()[0, ball] - place) < 0.3
    assert show.host.layout.size == size == open_show().host.layout.size  # no agent observes it


def test_two_mice_drag(open_show):
    show = open_show("PIAvatar/KickBall-v0")
    simulation = show.host.groups[0].simulation
    drags = show.live.view.drags
    for mouse, name in enumerate(("left_wrist", "pelvis")):
        target = simulation.receivers.find(name, 0)
        start = target.frame.position.numpy()[0, target.column].astype(float)
        drags[mouse] = Drag(0, start, start + [0.2 - 0.4 * mouse, 0.0, 0.1])
    show.turn()
    slots = show.host.get_state()
    assert np.count_nonzero(np.linalg.norm(slots["forces.force"][0], axis=1)) == 2
    show.turn()
    assert sum("arrow" in name for name in show.live.view._nodes) >= 2
    assert show.panel.impulse.data[3][-1] == pytest.approx(show.live.pull) and show.live.pull > 1.0
    drags.clear()
    show.turn()
    assert show.live.pull == 0.0


@pytest.mark.parametrize(("kind", "begins"), [("mp4", b"ftyp"), ("gif", b"GIF8")])
def test_a_clip_is_recorded(open_show, kind, begins):
    pytest.importorskip("imageio_ffmpeg" if kind == "mp4" else "PIL", reason="needs the extra render")
    show, sent = open_show(), []
    show.live.view.server.send_file_download = lambda name, content, **_more: sent.append((name, content))
    change(show, "format", kind)
    change(show, "record")
    assert "Stop" in show.panel.handles["record"].label
    for _ in range(3):
        show.turn()
    assert len({frame.tobytes() for frame in show.recording.frames}) > 1
    change(show, "record")
    ((name, content),) = sent
    assert name == f"Reach-v0.{kind}" and begins in content[:12] and show.recording is None
    if kind == "gif":
        from PIL import Image

        picture = Image.open(io.BytesIO(content))
        assert picture.n_frames == 4 and len(np.unique(np.asarray(picture.convert("L")))) > 20


class NoRedirect(urllib.request.HTTPRedirectHandler):
    """Reports a redirection as an error."""

    def redirect_request(self, *_arguments):
        return None


def test_a_scene_is_saved_and_opened(open_show, tmp_path):
    """Open it by its link, in another show and from a browser: all go on as the one that was saved did."""
    show = open_show(agent="random", num_envs=2)
    change(show, TONE, 0.3)
    change(show, "color", "strain")
    change(show, "env", "1")
    change(show, "play")
    change(show, "save")
    (path,) = (tmp_path / "scenes").glob("*.npz")
    link = show.panel._link.content.partition("](")[2].partition(")")[0]
    assert str(path) in show.panel._link.content
    saved, played = show.host.get_state(), show.played

    def go_on(other) -> np.ndarray:
        for _ in range(3):
            change(other, "step")
        return values_of(other, "particles.x")

    future = go_on(show)

    opener = urllib.request.build_opener(NoRedirect)
    with pytest.raises(urllib.error.HTTPError) as answer:
        opener.open(link, timeout=10.0)
    assert answer.value.code == 303 and answer.value.headers["Location"] == show.live.view.url
    show.turn()
    assert show.played == played
    for name, values in show.host.get_state().items():
        np.testing.assert_array_equal(values, saved[name], err_msg=name)
    np.testing.assert_array_equal(go_on(show), future)
    for address, code in ((link + "x", 404), (link.replace("/open", "/"), 404)):
        with pytest.raises(urllib.error.HTTPError) as answer:
            opener.open(address, timeout=10.0)
        assert answer.value.code == code
    request = urllib.request.Request(link, headers={"Sec-Fetch-Site": "cross-site"})
    with pytest.raises(urllib.error.HTTPError) as answer:
        opener.open(request, timeout=10.0)
    assert answer.value.code == 403

    other = open_show("PIAvatar/KickBall-v0")
    change(other, "play")
    change(other, "open", SimpleNamespace(name="scene.npz", content=path.read_bytes()))
    assert (other.setup.env_id, other.env, other.live.color, other.tuned) == (
        "PIAvatar/Reach-v0",
        1,
        "strain",
        {TONE: 0.3},
    )
    np.testing.assert_array_equal(go_on(other), future)


def test_a_file_that_is_no_scene_is_named(open_show):
    show = open_show()
    host = show.host
    change(show, "open", SimpleNamespace(name="scene.npz", content=b"nothing"))
    assert "not a scene" in show.words and show.host is host and steps_done(show) == 1


def test_games_are_watched(open_show):
    pytest.importorskip("pettingzoo")
    show = open_show("sumo_v0")
    change(show, "step")
    assert "| agent_0.control |" in table(show) and "| agent_1.control |" in table(show)
    shown = {name.split("_band")[0] for name in show.live.view._nodes}  # clothes are bands of their colours
    assert {"/world/body_0", "/world/body_1"} <= shown
