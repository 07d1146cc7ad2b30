"""Shows for tests of the live view."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from piavatar_envs.api.pictures import Pace
from piavatar_envs.live.agents import agent_kinds
from piavatar_envs.live.setup import Setup
from piavatar_envs.live.show import Show
from tests.api.test_live import FakeTime


@pytest.fixture
def open_show(device, tmp_path) -> Iterator[Callable[..., Show]]:
    """A maker of shows with a clock that only they move: ``show = open_show(env_id)``; its time is ``show.time``."""
    pytest.importorskip("viser", reason='needs pip install "piavatar-envs[live]"')
    opened = []

    def start(
        env_id: str = "PIAvatar/Reach-v0",
        agent: str = "zero",
        num_envs: int = 1,
        folder: Path | None = None,
        **settings,
    ):
        time = FakeTime()
        setup = Setup(env_id, {"fidelity": "tiny", **settings}, agent, num_envs, 4, device)
        show = Show(setup, agent_kinds(env_id), 8300, Pace(time.clock, time.sleep), folder or tmp_path / "scenes")
        show.time = time
        opened.append(show)
        show.begin(4)
        return show

    yield start
    for show in opened:
        show.close()
