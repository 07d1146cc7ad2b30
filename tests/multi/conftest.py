"""Fixtures for games of several agents: tests run over every game of the package; none is listed."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from piavatar_envs.multi import load_game
from piavatar_envs.tasks.games import game_modules
from tests.conftest import only_one_process

if importlib.util.find_spec("pettingzoo") is None:
    collect_ignore_glob = ["test_*.py"]  # the extra `multi` is not installed


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run tests with ``game_name`` on every game, but for those that name the games themselves."""
    named = any("game_name" in marker.args[0] for marker in metafunc.definition.iter_markers("parametrize"))
    if "game_name" in metafunc.fixturenames and not named:
        metafunc.parametrize("game_name", game_modules())


@pytest.fixture(scope="session")
def games(device):
    """The games, by name, their kernels compiled; parallel workers would race each other's files."""
    import warp as wp

    with only_one_process("kernels"):
        found = {name: load_game(name) for name in game_modules()}
        wp.force_load(device)
    return found


@pytest.fixture(scope="session")
def make_game(device, games):
    """A maker of parallel environments of games, ``make_game(game_name, **settings)``, tiny by default.

    The same settings give the same object, because building takes longer than a test: begin with a reset. ``twin=1``
    gives another one of the same settings.
    """
    made = {}

    def make(game_name: str, twin: int = 0, **settings):
        key = (game_name, twin, repr(sorted(settings.items())))
        if key not in made:
            made[key] = games[game_name].parallel_env(device=device, **{"fidelity": "tiny", **settings})
        return made[key]

    yield make
    for game in made.values():
        game.close()


@pytest.fixture(scope="session")
def play():
    """``play(game, steps, rng, **constant)``: what the game returned at every step.

    Actions are random in [-1, 1] (zero without ``rng``); ``constant`` holds components, for all agents:
    ``**{"root.y": -1.0}``. Ends with the last agent.
    """

    def run(game, steps: int, rng: np.random.Generator | None = None, **constant: float) -> list[tuple]:
        log = []
        for _ in range(steps):
            if not game.agents:
                break
            actions = {}
            for name in game.agents:
                size = game.action_space(name).shape
                actions[name] = np.zeros(size) if rng is None else rng.uniform(-1.0, 1.0, size)
                for component, value in constant.items():
                    actions[name][game.action_names.index(component)] = value
            log.append(game.step(actions))
        return log

    return run


@pytest.fixture(scope="session")
def same(equal):
    """Whether two results of ``reset`` or ``step`` are the same: bit for bit."""

    def compare(a, b) -> bool:
        if isinstance(a, dict):
            return a.keys() == b.keys() and all(compare(value, b[name]) for name, value in a.items())
        if isinstance(a, (tuple, list)):
            return len(a) == len(b) and all(compare(x, y) for x, y in zip(a, b, strict=True))
        if isinstance(a, str) or a is None:
            return a == b
        return type(a) is type(b) and equal(a, b)

    return compare
