"""Random full-scale actions: a few hundred steps; benchmarks/physics/robustness.py takes ten thousand."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from benchmarks.physics import robustness
from piavatar_envs.tasks import task_modules

SEEDS, STEPS = 20, 10
#: Tasks on the ground: hands of tiny bodies are too thin to be struck on it with all their strength.
ON_THE_GROUND = {"PIAvatar/GetUp-v0"}


@pytest.mark.parametrize("settings", [{}, {"shape.randomize": True}], ids=str)
@pytest.mark.parametrize("kind", ["uniform", "corners", "held corners"])
def test_no_failure_and_nothing_that_is_not_finite(make_batch, env_id, kind, settings):
    """Many seeds at once: environment ``i`` is the single environment of seed ``i`` (see test_batch_env)."""
    seeds, more = (2, {"fidelity": "coarse"}) if env_id in ON_THE_GROUND else (SEEDS, {})
    batch = make_batch(env_id, seeds, **settings, **more)
    batch.reset(seeds=range(seeds))
    rng = np.random.default_rng(0)
    steps = STEPS if kind == "uniform" else STEPS // 2
    action = rng.choice([-1.0, 1.0], batch.action.shape)
    for step in range(steps):
        if kind == "uniform":
            action = rng.uniform(-1.0, 1.0, batch.action.shape)
        elif kind == "corners":
            action = rng.choice([-1.0, 1.0], batch.action.shape)
        batch.action.assign(action.astype(np.float32))
        batch.step()
        assert not batch.failure.numpy().any(), f"step {step}: {batch.failure.numpy()}"
        for name in ("observation", "reward", "terms", "metrics"):
            assert np.isfinite(getattr(batch, name).numpy()).all(), f"step {step}: {name}"
        state = batch.simulation.state.numpy()
        assert all(np.isfinite(value).all() for value in state.values())
        assert np.linalg.det(state["F"].astype(float)).min() > 0.0, "flesh has been turned inside out"
    batch.action.zero_()


class Spoiled(gymnasium.Wrapper):
    """Every fifth step reports a failure, and every third a number that is not one."""

    count = 0

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.count += 1
        if self.count % 5 == 0:
            terminated, info["failure"] = True, "nonfinite"
        if self.count % 3 == 0:
            info["reward_terms"]["control"] = np.nan
        return observation, reward, terminated, truncated, info

    @property
    def batch(self):
        return self.env.batch


def test_the_benchmark_counts_what_goes_wrong(make_env, env_id):
    env = make_env(env_id)
    clean, spoiled = robustness.run_seed(env, 0, 15), robustness.run_seed(Spoiled(env), 0, 15)
    assert clean["failures"] == {} and clean["nonfinite"] == 0 and clean["steps"] == 15
    assert spoiled["failures"] == {"nonfinite": 3} == {"nonfinite": spoiled["ends"]["failure"]}
    assert spoiled["nonfinite"] == 5 and spoiled["episodes"] >= 4


def test_the_benchmark_takes_all_its_steps(tmp_path, device):
    args = [
        "--steps",
        "13",
        "--seeds",
        "2",
        "--fidelity",
        "tiny",
        "--device",
        device,
        "--out",
        str(tmp_path / "r.json"),
    ]
    report = robustness.runner.main("robustness", robustness.cases, robustness.Options, args)
    *rows, total = report["results"]
    assert [(row["env_id"], row["seed"]) for row in rows] == [(env_id, s) for env_id in task_modules() for s in (0, 1)]
    assert sum(row["steps"] for row in rows) == total["steps"] == 13
    assert total["case"] == "all" and total["failures"] == total["nonfinite"] == 0
