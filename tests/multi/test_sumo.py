"""Sumo: agents that are out, the winner, their rewards, and fairness."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.mpm.types import FAILURE_CFL, FAILURE_OUT_OF_GRID
from tests.conftest import reward_terms

SUMO = "sumo_v0"
STILL = {"pose_noise": 0.0, "place_noise": 0.0}


def pelvises(game) -> np.ndarray:
    """Tracked pelvis joints ``(agents, 3)`` [m]."""
    return np.array([avatar.tracked.position.numpy()[0, 0] for avatar in game.batch.simulation.avatars], float)


def particles_of(game, agent: int) -> slice:
    body = game.batch.simulation.avatars[agent].body
    return slice(body.first, body.first + body.count)


def knock_down(game, *agents: int) -> None:
    """The roots of these agents let go."""
    state = game.get_state()
    for agent in agents:
        state[f"avatar_{agent}.state.released"][:] = 1
    game.set_state(state)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_they_stand_on_a_circle_and_face_its_middle(make_game, play, count):
    game = make_game(SUMO, num_agents=count, **STILL)
    observations, _ = game.reset(seed=0)
    assert list(observations) == game.possible_agents == [f"agent_{index}" for index in range(count)]
    at = pelvises(game)[:, :2]
    radius = np.linalg.norm(at, axis=1)
    assert radius == pytest.approx(radius[0], abs=1e-3)
    if count > 1:
        gaps = np.linalg.norm(at - np.roll(at, 1, axis=0), axis=1)
        assert gaps == pytest.approx(game.config.start_distance, abs=2e-3)
        assert at.mean(0) == pytest.approx(0.0, abs=1e-3)
    for index, avatar in enumerate(game.batch.simulation.avatars):
        facing = Rotation.from_quat(avatar.tracked.rotation.numpy()[0, 0]).apply([0.0, -1.0, 0.0])
        assert facing[:2] == pytest.approx(-at[index] / radius[index], abs=0.05)
    rows = play(game, 5, np.random.default_rng(0))
    assert len(rows) == 5 and all(np.isfinite(row).all() for row in rows[-1][0].values())
    assert ("others_in" in game.observation_layout) == (count > 2)


def test_feet_are_on_the_ground_whatever_the_body(make_game):
    """In the crouch no particle of a body lies deeper than in its rest pose, and some lies as deep."""
    game = make_game(SUMO, **STILL, **{"shape.randomize": True})
    for seed in range(3):
        game.reset(seed=seed)
        x = game.batch.simulation.state.x.numpy()[0]
        for agent, flesh in enumerate(game.batch.simulation.flesh):
            soles = flesh.points.rest[0, :, 2].min()
            assert x[particles_of(game, agent), 2].min() == pytest.approx(soles, abs=0.02)
            assert pelvises(game)[agent, 2] < flesh.points.joints[0, 0, 2] - 0.05, "it crouches"


def test_walking_out_of_the_ring_loses_and_the_last_one_in_wins(make_game, play):
    game = make_game(SUMO, ring_radius=0.8, **STILL)
    game.reset(seed=0)
    rim = []
    while game.agents and len(rim) < 40:
        actions = {name: np.zeros(game.action_space(name).shape) for name in game.agents}
        actions["agent_0"][game.action_names.index("root.y")] = 1.0  # backwards
        _, _, terminations, truncations, infos = game.step(actions)
        rim.append(infos["agent_0"]["rim_distance"])
        assert rim[-1] == pytest.approx(0.8 - np.linalg.norm(pelvises(game)[0, :2]), abs=1e-5)
    assert rim[-1] < 0.0 and min(rim[:-1]) >= 0.0
    assert terminations == {"agent_0": True, "agent_1": True} and not any(truncations.values())
    assert [infos[name]["success"] for name in ("agent_0", "agent_1")] == [False, True]
    assert infos["agent_0"]["reward_out"] == -game.config.out_cost
    assert infos["agent_1"]["reward_win"] == game.config.win_reward
    assert infos["agent_0"]["reward_win"] == infos["agent_1"]["reward_out"] == 0.0
    assert not infos["agent_0"]["root_released"]


@pytest.mark.parametrize("down", [(1,), (0, 1)])
def test_agents_that_are_down_are_out(make_game, play, down):
    """The one that stands wins; if all go down at once, none does."""
    game = make_game(SUMO, **STILL)
    game.reset(seed=0)
    knock_down(game, *down)
    [(_, rewards, terminations, _, infos)] = play(game, 1)
    assert all(terminations.values())
    for agent, name in enumerate(game.possible_agents):
        info = infos[name]
        assert info["root_released"] == (agent in down) != info["success"]
        assert (rewards[name] < -9.0) if agent in down else (rewards[name] > 9.0)


def test_a_failure_makes_no_winner(make_game, play):
    game = make_game(SUMO, **STILL)
    game.reset(seed=0)
    state = game.get_state()
    state["avatar_1.state.released"][:] = 1
    state["particles.u"][0, 0] = 1e6
    game.set_state(state)
    [(_, rewards, terminations, _, infos)] = play(game, 1)
    assert all(terminations.values()) and infos["agent_0"]["failure"] == FAILURE_CFL
    assert not any(info["success"] for info in infos.values()) and max(np.abs(list(rewards.values()))) < 0.1


@pytest.mark.parametrize("count", [1, 2])
def test_the_clock_makes_it_a_draw(make_game, play, count):
    game = make_game(SUMO, max_cycles=4, num_agents=count)
    game.reset(seed=0)
    rows = play(game, 9)
    _, rewards, terminations, truncations, infos = rows[-1]
    assert len(rows) == 4 and all(truncations.values()) and not any(terminations.values())
    assert not any(info["success"] for info in infos.values()) and max(np.abs(list(rewards.values()))) < 0.1


def test_the_game_goes_on_without_agents_that_are_out(make_game, play, same):
    game = make_game(SUMO, num_agents=4)
    game.reset(seed=0)
    play(game, 2)
    knock_down(game, 1)
    [(observations, rewards, terminations, _, infos)] = play(game, 1)
    assert terminations == {"agent_0": False, "agent_1": True, "agent_2": False, "agent_3": False}
    assert set(observations) == set(rewards) == set(infos) == set(game.possible_agents), "its last observation comes"
    assert game.agents == ["agent_0", "agent_2", "agent_3"] and infos["agent_0"]["standing"] == 3
    # its actions are not wanted any more
    idle = {name: np.zeros(game.action_space(name).shape) for name in game.possible_agents}
    with pytest.raises(ValueError, match=r"agent_1; .* agent_0, agent_2, agent_3"):
        game.step(idle)
    height = pelvises(game)[1, 2]
    rows = play(game, 10)
    assert all(set(row[0]) == {"agent_0", "agent_2", "agent_3"} for row in rows)
    assert game.batch.reward.numpy()[0, 1] == 0.0 and not game.batch.terms.numpy()[0, 1].any()
    assert pelvises(game)[1, 2] < height - 0.05, "nothing holds it"
    assert rows[-1][4]["agent_0"]["failure"] == 0
    # the others see that it is out, counted on from themselves
    for name, expected in (("agent_0", [0, 1, 1]), ("agent_2", [1, 1, 0]), ("agent_3", [1, 0, 1])):
        assert game.observation_layout.split(rows[-1][0][name])["others_in"].tolist() == expected
    # a state restores the agents that are out
    state = game.get_state()
    expected = play(game, 3)
    game.reset(seed=1)
    assert game.agents == game.possible_agents
    game.set_state(state)
    assert game.agents == ["agent_0", "agent_2", "agent_3"]
    assert same(play(game, 3), expected)
    knock_down(game, 0, 3)
    [(_, rewards, _, _, infos)] = play(game, 1)
    assert infos["agent_2"]["success"] and not game.agents


def test_rewards_and_the_observed_ring_are_those_of_numpy(make_game):
    game = make_game(SUMO, num_agents=4, push_weight=0.5)
    game.reset(seed=3)
    radius, rng = game.config.ring_radius, np.random.default_rng(0)
    for _ in range(8):
        actions = {name: rng.uniform(-1.5, 1.5, game.action_space(name).shape) for name in game.agents}
        observations, _, _, _, infos = game.step(actions)
        away = np.minimum(np.linalg.norm(pelvises(game)[:, :2], axis=1), radius)
        for index, name in enumerate(game.possible_agents):
            terms, seen = reward_terms(infos[name]), game.observation_layout.split(observations[name])
            lead = (np.delete(away, index).mean() - away[index]) / radius
            assert terms["push"] == pytest.approx(0.5 * lead, abs=1e-5)
            control = -game.config.control_cost * np.mean(np.clip(actions[name], -1.0, 1.0) ** 2)
            assert terms["control"] == pytest.approx(control, abs=1e-6)
            assert terms["win"] == terms["out"] == 0.0
            at = pelvises(game)[index]
            turn = Rotation.from_quat(game.batch.simulation.avatars[index].tracked.rotation.numpy()[0, 0])
            assert turn.apply(seen["ring_centre"]) == pytest.approx(-at, abs=1e-5)
            assert seen["rim_distance"][0] == pytest.approx(radius - np.hypot(*at[:2]), abs=1e-5)


def test_a_push_moves_an_agent_that_does_not_push_back(make_game):
    """One walks forward, the other does nothing: it is pushed out of the ring and stands all the while."""
    game = make_game(SUMO, ring_radius=0.9, **STILL)
    game.reset(seed=0)
    pushed, lead = [], []
    while game.agents and len(pushed) < 60:
        actions = {name: np.zeros(game.action_space(name).shape) for name in game.agents}
        actions["agent_0"][game.action_names.index("root.y")] = -1.0
        observations, _, _, _, infos = game.step(actions)
        pushed.append(infos["agent_1"]["push_impulse"])
        sensed = game.observation_layout.split(observations["agent_1"])["contact_impulse"].reshape(-1, 3)
        turn = Rotation.from_quat(game.batch.simulation.avatars[1].tracked.rotation.numpy()[0, 0])
        assert np.hypot(*turn.apply(sensed).sum(0)[:2]) == pytest.approx(pushed[-1], rel=1e-3, abs=1e-3)
        assert infos["agent_0"]["push_impulse"] == pytest.approx(pushed[-1], rel=0.02, abs=0.05), "equal and opposite"
        drive = game.batch.simulation.avatars[0].state
        lead.append(np.linalg.norm((drive.command_root.numpy()[0] - pelvises(game)[0])[:2]))
    assert infos["agent_0"]["success"] and not infos["agent_1"]["root_released"]
    assert max(pushed) > 10.0
    # a step of the root beyond the limit of its lead, and what contact took back in this step
    step = game.config.root_speed * game.config.physics.control_dt
    assert game.config.root_lead_limit < max(lead) < game.config.root_lead_limit + 2.5 * step


def test_a_body_that_is_pushed_is_not_carried_further_by_its_command(make_game, play):
    """A push of 1 m/s, no action: what moves the body must not come back as a motion of its own."""
    game = make_game(SUMO, num_agents=1, **STILL)
    game.reset(seed=0)
    start = pelvises(game)[0]
    state = game.get_state()
    state["particles.u"][0] += np.array([1.0, 0.0, 0.0], np.float32)
    game.set_state(state)
    way = []
    for _ in range(30):
        play(game, 1)
        way.append(pelvises(game)[0, 0] - start[0])
    assert 0.02 < max(way) < 0.3
    assert abs(way[-1] - way[-8]) < 0.02, "it has come to rest"
    assert game.agents == ["agent_0"]


def run(game, actions: dict[str, np.ndarray], steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Observations and rewards ``(steps, agents, ...)`` under actions ``(steps, size)``."""
    seen, paid = [], []
    game.reset(seed=0)
    for k in range(steps):
        observations, rewards, *_ = game.step({name: actions[name][k] for name in game.agents})
        seen.append([observations[name] for name in game.possible_agents])
        paid.append([rewards[name] for name in game.possible_agents])
    return np.array(seen), np.array(paid)


def test_it_is_fair(make_game):
    """Swap places and actions, and results are swapped: up to round-off, for contact is added up in another order."""
    places = [{"position": (0.1, 0.5), "yaw": 0.2}, {"position": (-0.05, -0.45), "yaw": 3.0}]
    games = [make_game(SUMO, scene={"avatars": order}, **STILL) for order in (places, places[::-1])]
    rng, steps = np.random.default_rng(0), 15
    size = games[0].action_space("agent_0").shape
    one, two = (rng.uniform(-1.0, 1.0, (steps, *size)) for _ in range(2))
    for actions in (one, two):
        actions[:, games[0].action_names.index("root.y")] = -1.0  # into each other
    seen, paid = run(games[0], {"agent_0": one, "agent_1": two}, steps)
    swapped_seen, swapped_paid = run(games[1], {"agent_0": two, "agent_1": one}, steps)
    contact = games[0].observation_layout["contact_impulse"].slice
    assert np.abs(seen[..., contact]).max() > 5.0, "they must have met"
    assert np.abs(seen[:, 0] - seen[:, 1]).max() > 0.1, "the two must differ"
    assert swapped_paid[:, ::-1] == pytest.approx(paid, abs=1e-3)
    assert np.abs(swapped_seen[:, ::-1] - seen)[..., : contact.start].max() < 0.05
    assert np.abs(swapped_seen[:, ::-1] - seen)[..., contact].max() < 0.5


@pytest.mark.parametrize("walls", [True, False])
def test_the_walls_keep_an_agent_that_is_thrown_out(make_game, play, walls):
    game = make_game(SUMO, num_agents=4, scene={"walls": walls})
    game.reset(seed=0)
    state = game.get_state()
    state["avatar_1.state.released"][:] = 1
    state["particles.u"][0, particles_of(game, 1)] = (-6.0, 0.0, 1.0)
    game.set_state(state)
    reached = []
    for _ in range(30):
        rows = play(game, 1)
        reached.append(-game.batch.simulation.state.x.numpy()[0, particles_of(game, 1), 0].min())
        if not game.agents:
            break
    side, dx = game.config.ring_radius + 1.2, game.batch.simulation.dx
    assert side - dx < max(reached), "it must come to the wall"
    if walls:
        assert max(reached) < side + 0.5 * dx and len(game.agents) == 3
        assert np.linalg.norm(pelvises(game)[1, :2]) > game.config.ring_radius
    else:
        assert rows[-1][4]["agent_0"]["failure"] == FAILURE_OUT_OF_GRID
