"""Random full-scale actions: a few steps of many seeds; benchmarks/physics/robustness.py takes ten thousand."""

from __future__ import annotations

import gymnasium
import numpy as np

from benchmarks.physics import robustness
from piavatar_envs.mpm.types import FAILURE_NONFINITE
from piavatar_envs.tasks import task_modules

#: Tasks on the ground: hands of tiny bodies are too thin to be struck on it with all their strength.
ON_THE_GROUND = {"PIAvatar/GetUp-v0"}


def test_nothing_fails_or_is_not_finite(make_batch, env_id):
    """Of random bodies: some act uniformly, some in corners of the action space, some hold a corner."""
    on_ground = env_id in ON_THE_GROUND
    seeds, settings = (3, {"fidelity": "coarse"}) if on_ground else (15, {})
    batch = make_batch(env_id, seeds, **{"shape.randomize": True}, **settings)
    batch.reset(seeds=range(seeds))
    rng, kind = np.random.default_rng(0), (np.arange(seeds) % 3)[:, None, None]
    held = rng.choice([-1.0, 1.0], batch.action.shape)
    for step in range(8):
        corners, uniform = rng.choice([-1.0, 1.0], held.shape), rng.uniform(-1.0, 1.0, held.shape)
        batch.action.assign(np.where(kind == 0, uniform, np.where(kind == 1, corners, held)).astype(np.float32))
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
            terminated, info["failure"] = True, FAILURE_NONFINITE
        if self.count % 3 == 0:
            info["reward_control"] = np.nan
        return observation, reward, terminated, truncated, info

    @property
    def batch(self):
        return self.env.batch


def test_the_benchmark_counts_what_goes_wrong(make_env, tmp_path, device):
    env = make_env("PIAvatar/Reach-v0")
    clean, spoiled = robustness.run_seed(env, 0, 15), robustness.run_seed(Spoiled(env), 0, 15)
    assert clean["failures"] == {} and clean["nonfinite"] == 0 and clean["steps"] == 15
    assert spoiled["failures"] == {"nonfinite": 3} == {"nonfinite": spoiled["ends"]["failure"]}
    assert spoiled["nonfinite"] == 5 and spoiled["episodes"] >= 4
    args = ["--steps", "11", "--seeds", "1", "--fidelity", "tiny", "--device", device, "--out", str(tmp_path / "r")]
    *rows, total = robustness.runner.main("robustness", robustness.cases, robustness.Options, args)["results"]
    assert [row["env_id"] for row in rows] == list(task_modules())
    assert sum(row["steps"] for row in rows) == total["steps"] == 11 and total["failures"] == total["nonfinite"] == 0
