"""``render_mode="human"``: the live view shows the scene of the pictures, in real time, of one environment."""

from __future__ import annotations

import sys

import gymnasium
import numpy as np
import pytest

from piavatar_envs.api.gym_env import AvatarEnv
from piavatar_envs.api.pictures import Pace
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.render.live import Drag


class FakeTime:
    """A clock that only sleep and :meth:`work` move."""

    def __init__(self):
        self.now, self.slept = 100.0, []

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds

    def work(self, seconds: float) -> None:
        self.now += seconds

    def pace(self) -> Pace:
        return Pace(self.clock, self.sleep)


@pytest.fixture
def make_human(device):
    """A maker of watched environments with a clock that tests move: ``env, time = make_human(env_id)``."""
    pytest.importorskip("viser", reason='needs pip install "piavatar-envs[live]"')
    made = []

    def make(env_id: str, **settings):
        settings = {"device": device, "fidelity": "tiny", **settings}
        env = gymnasium.make(env_id, render_mode="human", disable_env_checker=True, **settings)
        time = FakeTime()
        env.unwrapped.host.live.pace = time.pace()
        made.append(env)
        return env, time

    yield make
    for env in made:
        env.close()


def shown(env) -> dict[str, np.ndarray]:
    """Return the vertices in the view, by name."""
    return {name: node.vertices for name, node in env.unwrapped.host.live.view._nodes.items()}


def body_in(env) -> np.ndarray:
    """Return the vertices of the first body in the view, band by band."""
    return np.concatenate([v for name, v in sorted(shown(env).items()) if name.startswith("/world/body_0")])


@pytest.mark.parametrize("color", ["skin", "strain"])
def test_the_view_shows_the_scene_of_the_picture(make_human, device, monkeypatch, color):
    seen = []

    def keep(_renderer, bodies, markers=(), **_more):
        seen.append((bodies, markers))

    monkeypatch.setattr("piavatar_envs.render.renderer.Renderer.render", keep)
    settings = {"device": device, "fidelity": "tiny", "color": color}
    pictured = gymnasium.make("PIAvatar/KickBall-v0", render_mode="rgb_array", **settings)
    watched, _ = make_human("PIAvatar/KickBall-v0", color=color)
    action = np.full(watched.action_space.shape, 0.7, np.float32)
    for env in (pictured, watched):
        env.reset(seed=3)
        for _ in range(4):
            env.step(action)
    pictured.unwrapped.render()
    pictured.close()
    (bodies, markers), view = seen[-1], shown(watched)
    assert (bodies[0].scalars is not None) == (color == "strain") and markers
    for index, marker in enumerate(markers):
        (name,) = [name for name in view if name.endswith(f"_{index}") and "body" not in name]
        np.testing.assert_allclose(view[name], marker.mesh()[0], atol=1e-6)
    for index, body in enumerate(bodies):
        if body.scalars is None and body.colors is None:
            np.testing.assert_array_equal(view[f"/world/body_{index}"], np.asarray(body.vertices, np.float32))
            continue
        banded = np.concatenate([v for name, v in view.items() if name.startswith(f"/world/body_{index}_band")])
        assert {v.tobytes() for v in banded} == {v.tobytes() for v in np.asarray(body.vertices, np.float32)}


def test_resets_steps_and_states_update_the_view(make_human, sample_id):
    env, _ = make_human(sample_id)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.unwrapped.render()
    assert env.unwrapped.host.live._view is None
    env.reset(seed=0)
    assert env.render() is None
    before = body_in(env)
    for _ in range(3):
        env.step(env.action_space.sample())
    assert not np.array_equal(body_in(env), before)
    state = env.unwrapped.get_state()
    env.reset(seed=0)
    np.testing.assert_array_equal(body_in(env), before)
    env.unwrapped.set_state(state)
    assert not np.array_equal(body_in(env), before)
    assert env.unwrapped.metadata["render_modes"] == ["rgb_array", "human"]


@pytest.mark.parametrize(("work", "slept"), [(0.02, 1.0 / 30.0 - 0.02), (0.05, 0.0)])
def test_steps_take_at_least_their_time(make_human, monkeypatch, work, slept):
    """Sleep the rest of a control step of 1/30 s, and nothing where it took longer."""
    env, time = make_human("PIAvatar/Reach-v0")
    step = BatchEnv.step
    monkeypatch.setattr(BatchEnv, "step", lambda batch: (step(batch), time.work(work)))
    env.reset(seed=0)
    time.work(-time.now)
    env.unwrapped.host.live.pace.begin()
    for _ in range(6):
        env.step(np.zeros(env.action_space.shape, np.float32))
    assert time.slept == pytest.approx([slept] * 6 if slept else [])
    assert time.now == pytest.approx(6 * max(work, 1.0 / 30.0))


def test_oversleeping_does_not_add_up():
    time = FakeTime()
    pace = Pace(time.clock, lambda seconds: time.sleep(seconds + 0.004))
    for _ in range(50):
        time.work(0.01)
        pace.wait(0.1)
    assert time.now - 100.0 == pytest.approx(5.0, abs=0.005)


def test_not_every_step_faster_than_a_screen_is_sent(make_human, monkeypatch):
    env, _ = make_human("PIAvatar/Reach-v0", control_dt=0.005)
    env.reset(seed=0)
    live, sent = env.unwrapped.host.live, []
    monkeypatch.setattr(live.view, "show", lambda scene, elapsed: sent.append(elapsed))
    for _ in range(40):
        env.step(np.zeros(env.action_space.shape, np.float32))
    assert 8 <= len(sent) <= 12 and sum(sent) == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("body", [0, 1])
def test_the_mouse_pulls_at_what_it_drags(make_human, body):
    """Pull a hand, and a ball, half a metre up and to the side: the force grows with the distance, and ends."""
    env, _ = make_human("PIAvatar/KickBall-v0", episode_seconds=2.3)
    env.reset(seed=0)
    live, batch, still = env.unwrapped.host.live, env.unwrapped.batch, np.zeros(env.action_space.shape, np.float32)
    name = "left_wrist" if body == 0 else "ball"
    target = batch.simulation.receivers.find(name)
    start = target.frame.position.numpy()[0, target.column] + (np.array([0.05, 0.0, -0.05]) if body == 0 else 0.0)
    end, distances = start + np.array([0.1, 0.0, 0.1 if body == 0 else 0.5]), []
    live.view.drags[0] = Drag(body, start, end)
    for _ in range(8):
        env.step(still)
        distances.append(np.linalg.norm(live._mice[0]._grip.point(0) - end))
    assert not batch.failure.numpy().any()
    slots = {key: value[0, 0] for key, value in env.unwrapped.get_state().items() if key.startswith("forces.")}
    assert slots["forces.target"] == target.index and slots["forces.remaining"] == 0
    assert distances[-1] < distances[0]
    assert any("arrow" in node for node in shown(env))
    live.view.drags.clear()
    env.step(still)
    assert not any("arrow" in node for node in shown(env))


def test_closing_stops_the_server(make_human):
    env, _ = make_human("PIAvatar/Reach-v0")
    env.reset(seed=0)
    view = env.unwrapped.host.live.view
    env.close()
    env.close()
    assert view.closed
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        env.step(np.zeros(env.action_space.shape, np.float32))


def test_a_missing_viser_shows_at_once(monkeypatch, device):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"\[live\]"):
        AvatarEnv("Reach-v0", render_mode="human", device=device, fidelity="tiny")


def test_many_environments_have_no_live_view(device):
    for make in (gymnasium.make_vec, sb3_vector):
        with pytest.raises(ValueError, match=r"live view of one environment.*rgb_array.*watch ID"):
            make("PIAvatar/Reach-v0", num_envs=2, render_mode="human", device=device, fidelity="tiny")


def sb3_vector(env_id: str, **settings):
    pytest.importorskip("stable_baselines3")
    from piavatar_envs.api.sb3 import SB3VecEnv

    return SB3VecEnv(env_id, **settings)
