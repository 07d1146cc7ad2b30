"""Garments in games: each avatar wears its own and touches those of the others; runs repeat."""

from __future__ import annotations

import numpy as np

SKIRT = {"kind": "skirt", "length": 0.4, "edge": 0.07}


def still(game) -> dict[str, np.ndarray]:
    """Return zero actions."""
    return {agent: np.zeros(game.action_space(agent).shape, np.float32) for agent in game.agents}


def test_each_agent_wears_its_own_and_touches_the_others(make_game):
    game = make_game("sumo_v0", num_agents=2, garments=[SKIRT])
    first = [game.reset(seed=3)[0], *(game.step(still(game))[0] for _ in range(4))]
    garments = game.batch.simulation.garments
    assert [garment.wearer for garment in garments.garments] == [0, 1]
    start = garments.surfaces.obstacles.piece_start.numpy()
    near, first_vertex = garments.cloth.state.near.numpy()[0], garments.cloth.first
    for wearer in range(2):
        own, other = near[first_vertex[wearer] : first_vertex[wearer + 1]].T
        own, other = own[own >= 0], other[other >= 0]
        assert len(own) and ((own >= start[wearer]) & (own < start[wearer + 1])).all()
        assert len(other) and ((other >= start[1 - wearer]) & (other < start[2 - wearer])).all()
    again = [game.reset(seed=3)[0], *(game.step(still(game))[0] for _ in range(4))]
    for one, two in zip(first, again, strict=True):
        assert all(one[agent].tobytes() == two[agent].tobytes() for agent in one)


def test_garments_in_mpm_are_fields_of_their_wearers(make_game):
    soft = {"stretch": 40.0}
    outfit = [SKIRT | soft, {"kind": "shirt", "edge": 0.08, "friction": 0.7, **soft}]
    game = make_game("sumo_v0", num_agents=2, garments=outfit, cloth={"solver": "mpm"})
    simulation = game.batch.simulation
    fields, garments = simulation.subjects.fields, simulation.garments
    assert [garment.wearer for garment in garments.garments] == [0, 0, 1, 1]
    per = len(fields.subject) // 2
    assert list(fields.subject) == [0] * per + [1] * per
    own = simulation.subjects.matter.field[simulation.subjects.first[-1] :]
    assert (
        own.tolist() == np.array([per - 2, per - 1, 2 * per - 2, 2 * per - 1])[garments.cloth.matter.garment].tolist()
    )
    assert list(fields.apart) == sorted(set(own.tolist()))
    thin = np.array([garment.fabric.areal_density for garment in garments.garments]) / (0.5 * simulation.dx)
    np.testing.assert_allclose(fields.density[list(fields.apart)], thin)
    np.testing.assert_array_equal(fields.friction[: per - 2, per - 1], 0.7)
    np.testing.assert_array_equal(fields.friction[per - 1, : per - 2], 0.7)
    assert simulation.subjects.colliders[0].friction[per - 1] == 0.7
    observations = [game.reset(seed=3)[0]]
    for _ in range(3):
        observations.append(game.step(still(game))[0])
    assert all(np.isfinite(one[agent]).all() for one in observations for agent in one)
    assert not simulation.state.failure.numpy().any()
