"""Random mass, stiffness and friction in every game: avatars draw apart, and each agent observes all draws."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.parameters import PARAMETERS
from piavatar_envs.sim.randomize import OF_AVATAR, Parameter
from tests.sim.randomized import VARIED, by_name, check_term, constants_of, factors_of

#: Draws that tasks leave out by default.
DRAWN = {"high_five_v0": {"hand": "random", "impulse": (1.0, 2.0)}}


@pytest.fixture(scope="session")
def make_crowd(games, device):
    """A maker of batches of a game, ``make_crowd(game_name, num_envs)``, with everything random and observed."""
    made = {}

    def make(game_name: str, num_envs: int, **settings) -> BatchEnv:
        key = (game_name, num_envs, repr(sorted(settings.items())))
        if key not in made:
            task = games[game_name].TASK
            given = {"fidelity": "tiny", "observe_parameters": True, "shape.randomize": True, **VARIED, **settings}
            made[key] = BatchEnv(task(load_config(task.Config, None, given)), num_envs, device)
        return made[key]

    return make


def test_parameters_are_what_was_drawn(make_crowd, game_name):
    settings = DRAWN.get(game_name.rpartition(".")[2], {})
    batch = make_crowd(game_name, 4, **settings)
    batch.reset(seeds=[11, 12, 13, 14])
    assert len(batch.task.drawn()) == len(batch.task.drawn_values(batch))
    assert all(isinstance(parameter, Parameter) for parameter in batch.task.drawn())
    check_term(batch, np.array([False, True, False, True]))


def test_avatars_draw_apart_and_each_has_its_own(make_crowd, game_name):
    batch = make_crowd(game_name, 4)
    batch.reset(seeds=[1, 2, 3, 4])
    factors, physics = factors_of(batch), batch.config.physics
    for name in OF_AVATAR:
        drawn = factors[name]
        assert len(np.unique(drawn)) == drawn.size > 4
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


def test_agents_are_told_of_the_others_in_order(make_crowd, game_name):
    batch = make_crowd(game_name, 4)
    batch.reset(seeds=[1, 2, 3, 4])
    told = [by_name(batch, agent) for agent in range(batch.num_agents)]
    for agent, mine in enumerate(told):
        for index in range(batch.num_agents - 1):
            theirs = told[(agent + 1 + index) % batch.num_agents]
            for name in ("mass_factor", "shape_height"):
                assert np.array_equal(mine[f"other_{index}_{name}"], theirs[name])


def test_world_i_is_the_single_world_of_seed_plus_i(make_crowd, game_name, equal):
    crowd, single, seed = make_crowd(game_name, 4), make_crowd(game_name, 1), 21
    rng, steps = np.random.default_rng(0), 8
    actions = rng.uniform(-1.0, 1.0, (2, steps, *crowd.action.shape)).astype(np.float32)
    rows = []
    for episode in range(2):
        crowd.reset(seeds=seed + np.arange(4) if episode == 0 else None)
        rows.append([crowd.observation.numpy().copy()])
        for action in actions[episode]:
            crowd.action.assign(action)
            crowd.step()
            rows[-1].append(crowd.observation.numpy().copy())
    for i in (0, 3):
        for episode, expected in enumerate(rows):
            single.reset(seeds=[seed + i] if episode == 0 else None)
            assert equal(single.observation.numpy()[0], expected[0][i]), f"world {i}, episode {episode}"
            for step, action in enumerate(actions[episode]):
                single.action.assign(action[i : i + 1])
                single.step()
                assert equal(single.observation.numpy()[0], expected[step + 1][i]), f"world {i}, step {step}"
    for batch in (crowd, single):
        batch.action.zero_()


def test_the_term_is_told_by_name(make_game, game_name):
    world = make_game(game_name, observe_parameters=True, obs_mode="dict", mass_factor=(0.5, 2.0))
    observations, _ = world.reset(seed=3)
    names = [parameter.name for parameter in world.observation_layout[PARAMETERS].parameters]
    assert names[:2] == ["mass_factor", "other_0_mass_factor"] and names[-1] == "clock"
    first, second, *_ = (observation[PARAMETERS] for observation in observations.values())
    assert len(first) == len(names) and first[0] != second[0] and first[1] == second[0]
