"""Closed environments refuse to go on; pictures that cannot be drawn are refused before anything is built."""

from __future__ import annotations

import sys

import gymnasium
import pytest

import piavatar_envs  # noqa: F401 - registers the ids
from tests.api.test_readings import VIEWS


@pytest.mark.parametrize("build", VIEWS)
def test_a_closed_view_refuses_to_go_on(build, device):
    view, reset, step = build(device)
    reset()
    view.close()
    for name, call in (("reset", reset), ("step", step), ("read", lambda: view.read("particle_position"))):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match=rf"{name}\(\) after close\(\)"):
            call()
    view.close()


def test_a_scale_without_the_library_of_text_is_refused_when_an_environment_is_made(monkeypatch):
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    from piavatar_envs.multi import sumo_v0

    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.setattr("piavatar_envs.api.host.BatchEnv", None)  # nothing is built
    settings = {"render_mode": "rgb_array", "fidelity": "tiny", "color": "strain"}
    for make in (
        lambda: gymnasium.make("PIAvatar/Reach-v0", **settings),
        lambda: gymnasium.make_vec("PIAvatar/Reach-v0", num_envs=2, **settings),
        lambda: sumo_v0.parallel_env(**settings),
    ):
        with pytest.raises(ImportError, match=r"color='strain' needs PIL, .*\[render\]"):
            make()
