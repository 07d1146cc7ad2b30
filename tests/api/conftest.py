"""Vectors of environments for the tests of this folder, and the comparison of two answers."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest


@pytest.fixture(scope="session")
def make_vec(device: str):
    """A maker of vectors, ``make_vec(env_id, num_envs, **settings)``, tiny by default.

    The same settings give the same object, because building takes longer than a test: begin with a seeded reset.
    """
    import piavatar_envs  # noqa: F401

    made: dict[tuple, gymnasium.vector.VectorEnv] = {}

    def make(env_id: str, num_envs: int = 3, **settings):
        key = (env_id, num_envs, repr(sorted(settings.items())))
        if key not in made:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                made[key] = gymnasium.make_vec(
                    env_id, num_envs=num_envs, device=device, **{"fidelity": "tiny", "num_threads": 2, **settings}
                )
        return made[key]

    yield make
    for vector in made.values():
        vector.close()


@pytest.fixture(scope="session")
def same(equal):
    """Assert that two answers are alike: names, types, shapes, and numbers by ``equal``."""

    def compare(a, b, where: str = "") -> None:
        assert type(a) is type(b), f"{where}: {type(a)} is not {type(b)}"
        if isinstance(a, dict):
            assert set(a) == set(b), f"{where}: {set(a) ^ set(b)}"
            for name in a:
                compare(a[name], b[name], f"{where}.{name}")
        elif isinstance(a, (tuple, list)) or (isinstance(a, np.ndarray) and a.dtype == object):
            assert len(a) == len(b), where
            for i, (x, y) in enumerate(zip(a, b, strict=True)):
                compare(x, y, f"{where}[{i}]")
        elif isinstance(a, np.ndarray):
            assert a.dtype == b.dtype, f"{where}: {a.dtype} is not {b.dtype}"
            assert equal(a, b), f"{where}: {a} is not {b}"
        else:
            assert a == b or (isinstance(a, float) and equal(a, b)), f"{where}: {a} is not {b}"

    return compare
