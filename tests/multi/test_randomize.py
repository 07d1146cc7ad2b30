"""Random mass, stiffness and friction in every game: avatars draw apart, and each agent observes all draws."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.sim.randomize import OF_AVATAR, Parameter
from tests.sim.randomized import VARIED, check_term, constants_of, factors_of

#: Draws that tasks leave out by default.
DRAWN = {"high_five_v0": {"hand": "random", "impulse": (1.0, 2.0)}}


@pytest.fixture(scope="module")
def make_crowd(games, device):
    """A maker of batches of a game, ``make_crowd(game_name, num_envs)``, with everything random and observed."""
    made = {}

    def make(game_name: str, num_envs: int) -> BatchEnv:
        if (game_name, num_envs) not in made:
            task, given = games[game_name].TASK, {**VARIED, **DRAWN.get(game_name, {})}
            given |= {"fidelity": "tiny", "observe_parameters": True, "shape.randomize": True}
            made[game_name, num_envs] = BatchEnv(task(load_config(task.Config, None, given)), num_envs, device)
        return made[game_name, num_envs]

    return make


def test_avatars_draw_apart_and_every_agent_observes_all_draws(make_crowd, game_name):
    batch = make_crowd(game_name, 3)
    batch.reset(seeds=[11, 12, 13])
    factors, physics = factors_of(batch), batch.config.physics
    assert all(len(np.unique(factors[name])) == factors[name].size > 4 for name in OF_AVATAR)
    for avatar in range(batch.num_agents):
        own = constants_of(batch, avatar)
        density = factors["mass_factor"][:, avatar] * physics.density
        mass = own["mass"].astype(float).sum(1)
        assert mass == pytest.approx(density * own["volume"].astype(float).sum(1), rel=1e-5)
        assert own["body_mass"][:, 0] == pytest.approx(mass, rel=1e-5)
        assert own["density"] == pytest.approx(np.broadcast_to(density[:, None], own["density"].shape), rel=1e-6)
        modulus = physics.young_modulus / (2.0 + 2.0 * physics.poisson_ratio)
        expected = np.broadcast_to(modulus * factors["stiffness_factor"][:, avatar, None], own["mu"].shape)
        assert own["mu"] == pytest.approx(expected, rel=1e-5)
    assert len(batch.task.drawn()) == len(batch.task.drawn_values(batch))
    assert all(isinstance(parameter, Parameter) for parameter in batch.task.drawn())
    check_term(batch, np.array([False, True, False]))


def test_an_environment_of_a_batch_is_the_single_one_of_its_seed(make_crowd, game_name, equal):
    """Observations and rewards, over two episodes."""
    crowd, single, seed = make_crowd(game_name, 3), make_crowd(game_name, 1), 21
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 4, *crowd.action.shape)).astype(np.float32)

    def run(batch: BatchEnv, seeds: list[int], rows: slice) -> list[tuple[np.ndarray, np.ndarray]]:
        log = []
        for episode in actions:
            batch.reset(seeds=None if log else seeds)
            log.append((batch.observation.numpy()[-1].copy(), np.zeros(0)))
            for action in episode:
                batch.action.assign(action[rows])
                batch.step()
                log.append((batch.observation.numpy()[-1].copy(), batch.reward.numpy()[-1].copy()))
        batch.action.zero_()
        return log

    together, alone = run(crowd, [seed, seed + 1, seed + 2], slice(3)), run(single, [seed + 2], slice(2, 3))
    for step, (a, b) in enumerate(zip(together, alone, strict=True)):
        assert equal(a[0], b[0]) and equal(a[1], b[1]), f"answer {step}"
