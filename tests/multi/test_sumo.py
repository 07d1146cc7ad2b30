"""Sumo: agents that are out, the winner, their rewards, and fairness."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index

SUMO = "sumo_v0"
STILL = {"pose_noise": 0.0, "place_noise": 0.0}


def pelvises(world) -> np.ndarray:
    """Tracked pelvis joints ``(agents, 3)`` [m]."""
    return np.array([avatar.tracked.position.numpy()[0, 0] for avatar in world.batch.simulation.avatars], float)


def particles_of(world, agent: int) -> slice:
    body = world.batch.simulation.avatars[agent].body
    return slice(body.first, body.first + body.count)


def knock_down(world, *agents: int) -> None:
    """The roots of these agents let go."""
    state = world.get_state()
    for agent in agents:
        state[f"avatar_{agent}.state.released"][:] = 1
    world.set_state(state)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_they_stand_on_a_circle_and_face_its_middle(make_game, play, count):
    world = make_game(SUMO, num_agents=count, **STILL)
    observations, _ = world.reset(seed=0)
    assert list(observations) == world.possible_agents == [f"agent_{index}" for index in range(count)]
    at = pelvises(world)[:, :2]
    radius = np.linalg.norm(at, axis=1)
    assert radius == pytest.approx(radius[0], abs=1e-3)
    if count > 1:
        gaps = np.linalg.norm(at - np.roll(at, 1, axis=0), axis=1)
        assert gaps == pytest.approx(world.config.start_distance, abs=2e-3)
        assert at.mean(0) == pytest.approx(0.0, abs=1e-3)
    for index, avatar in enumerate(world.batch.simulation.avatars):
        facing = Rotation.from_quat(avatar.tracked.rotation.numpy()[0, 0]).apply([0.0, -1.0, 0.0])
        assert facing[:2] == pytest.approx(-at[index] / radius[index], abs=0.05)
    rows = play(world, 5, np.random.default_rng(0))
    assert len(rows) == 5 and all(np.isfinite(row).all() for row in rows[-1][0].values())
    assert ("others_in" in world.observation_layout) == (count > 2)


@pytest.mark.parametrize("settings", [{}, {"shape.randomize": True}], ids=str)
def test_feet_are_on_the_ground_whatever_the_body(make_game, settings):
    """In the crouch no particle of a body lies deeper than in its rest pose, and some lies as deep."""
    world = make_game(SUMO, **STILL, **settings)
    for seed in range(3):
        world.reset(seed=seed)
        x = world.batch.simulation.state.x.numpy()[0]
        for agent, flesh in enumerate(world.batch.simulation.flesh):
            soles = flesh.points.rest[0, :, 2].min()
            assert x[particles_of(world, agent), 2].min() == pytest.approx(soles, abs=0.02)
            assert pelvises(world)[agent, 2] < flesh.points.joints[0, 0, 2] - 0.05, "it crouches"


def test_walking_out_of_the_ring_loses_and_the_last_one_in_wins(make_game, play):
    world = make_game(SUMO, ring_radius=0.8, **STILL)
    world.reset(seed=0)
    rim = []
    while world.agents and len(rim) < 40:
        actions = {name: np.zeros(world.action_space(name).shape) for name in world.agents}
        actions["agent_0"][world.action_names.index("root.y")] = 1.0  # backwards
        _, _, terminations, truncations, infos = world.step(actions)
        rim.append(infos["agent_0"]["rim_distance"])
        assert rim[-1] == pytest.approx(0.8 - np.linalg.norm(pelvises(world)[0, :2]), abs=1e-5)
    assert rim[-1] < 0.0 and min(rim[:-1]) >= 0.0
    assert terminations == {"agent_0": True, "agent_1": True} and not any(truncations.values())
    assert [infos[name]["success"] for name in ("agent_0", "agent_1")] == [False, True]
    assert infos["agent_0"]["reward_terms"]["out"] == -world.config.out_cost
    assert infos["agent_1"]["reward_terms"]["win"] == world.config.win_reward
    assert infos["agent_0"]["reward_terms"]["win"] == infos["agent_1"]["reward_terms"]["out"] == 0.0
    assert not infos["agent_0"]["root_released"]


def test_who_is_down_is_out(make_game, play):
    world = make_game(SUMO, **STILL)
    world.reset(seed=0)
    knock_down(world, 1)
    [(_, rewards, terminations, _, infos)] = play(world, 1)
    assert infos["agent_1"]["root_released"] and infos["agent_0"]["success"] and not infos["agent_1"]["success"]
    assert rewards["agent_0"] > 9.0 and rewards["agent_1"] < -9.0 and all(terminations.values())


def test_when_all_go_out_at_once_nobody_wins(make_game, play):
    world = make_game(SUMO, **STILL)
    world.reset(seed=0)
    knock_down(world, 0, 1)
    [(_, rewards, terminations, _, infos)] = play(world, 1)
    assert all(terminations.values()) and not any(info["success"] for info in infos.values())
    assert all(reward < -9.0 for reward in rewards.values())


def test_nobody_wins_by_a_failure(make_game, play):
    world = make_game(SUMO, **STILL)
    world.reset(seed=0)
    state = world.get_state()
    state["avatar_1.state.released"][:] = 1
    state["particles.u"][0, 0] = 1e6
    world.set_state(state)
    [(_, rewards, terminations, _, infos)] = play(world, 1)
    assert all(terminations.values()) and infos["agent_0"]["failure"] == "cfl"
    assert not any(info["success"] for info in infos.values())
    assert max(np.abs(list(rewards.values()))) < 0.1, "no agent is at fault"


def test_the_clock_makes_it_a_draw(make_game, play):
    world = make_game(SUMO, max_cycles=4)
    world.reset(seed=0)
    *_, (_, rewards, terminations, truncations, infos) = play(world, 9)
    assert all(truncations.values()) and not any(terminations.values())
    assert not any(info["success"] for info in infos.values()) and max(np.abs(list(rewards.values()))) < 0.1


def test_one_alone_cannot_win(make_game, play):
    world = make_game(SUMO, num_agents=1, max_cycles=5)
    world.reset(seed=0)
    rows = play(world, 9)
    assert len(rows) == 5 and rows[-1][3] == {"agent_0": True} and not rows[-1][4]["agent_0"]["success"]


def test_the_world_goes_on_without_those_who_are_out(make_game, play, same):
    world = make_game(SUMO, num_agents=4)
    world.reset(seed=0)
    play(world, 2)
    knock_down(world, 1)
    [(observations, rewards, terminations, _, infos)] = play(world, 1)
    assert terminations == {"agent_0": False, "agent_1": True, "agent_2": False, "agent_3": False}
    assert set(observations) == set(rewards) == set(infos) == set(world.possible_agents), "its last observation comes"
    assert world.agents == ["agent_0", "agent_2", "agent_3"] and infos["agent_0"]["standing"] == 3
    # its actions are not wanted any more
    idle = {name: np.zeros(world.action_space(name).shape) for name in world.possible_agents}
    with pytest.raises(ValueError, match="an action for agent_1; the agents that act are agent_0, agent_2, agent_3"):
        world.step(idle)
    height = pelvises(world)[1, 2]
    rows = play(world, 10)
    assert all(set(row[0]) == {"agent_0", "agent_2", "agent_3"} for row in rows)
    assert world.batch.reward.numpy()[0, 1] == 0.0 and not world.batch.terms.numpy()[0, 1].any()
    assert pelvises(world)[1, 2] < height - 0.05, "nothing holds it"
    assert rows[-1][4]["agent_0"]["failure"] is None
    # the others see that it is out, counted on from themselves
    for name, expected in (("agent_0", [0, 1, 1]), ("agent_2", [1, 1, 0]), ("agent_3", [1, 0, 1])):
        assert world.observation_layout.split(rows[-1][0][name])["others_in"].tolist() == expected
    # a state restores the agents that are out
    state = world.get_state()
    expected = play(world, 3)
    world.reset(seed=1)
    assert world.agents == world.possible_agents
    world.set_state(state)
    assert world.agents == ["agent_0", "agent_2", "agent_3"]
    assert same(play(world, 3), expected)
    knock_down(world, 0, 3)
    [(_, rewards, _, _, infos)] = play(world, 1)
    assert infos["agent_2"]["success"] and not world.agents


def test_rewards_are_those_of_numpy(make_game, play):
    world = make_game(SUMO, num_agents=4, push_weight=0.5)
    world.reset(seed=3)
    radius = world.config.ring_radius
    rng = np.random.default_rng(0)
    for _ in range(10):
        actions = {name: rng.uniform(-1.5, 1.5, world.action_space(name).shape) for name in world.agents}
        infos = world.step(actions)[4]
        away = np.minimum(np.linalg.norm(pelvises(world)[:, :2], axis=1), radius)
        for index, name in enumerate(world.possible_agents):
            terms = infos[name]["reward_terms"]
            lead = (np.delete(away, index).mean() - away[index]) / radius
            assert terms["push"] == pytest.approx(0.5 * lead, abs=1e-5)
            control = -world.config.control_cost * np.mean(np.clip(actions[name], -1.0, 1.0) ** 2)
            assert terms["control"] == pytest.approx(control, abs=1e-6)
            assert terms["win"] == terms["out"] == 0.0


def test_the_ring_is_seen(make_game, play):
    world = make_game(SUMO)
    observations, _ = world.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(6):
        for index, name in enumerate(world.possible_agents):
            seen = world.observation_layout.split(observations[name])
            at = pelvises(world)[index]
            turn = Rotation.from_quat(world.batch.simulation.avatars[index].tracked.rotation.numpy()[0, 0])
            assert turn.apply(seen["ring_centre"]) == pytest.approx(-at, abs=1e-5)
            assert seen["rim_distance"][0] == pytest.approx(world.config.ring_radius - np.hypot(*at[:2]), abs=1e-5)
        [(observations, *_)] = play(world, 1, rng)


def test_a_push_moves_who_does_not_push_back(make_game, device):
    """One walks forward, the other does nothing: it is pushed out of the ring and stands all the while."""
    world = make_game(SUMO, ring_radius=0.9, **STILL)
    world.reset(seed=0)
    pushed, lead = [], []
    while world.agents and len(pushed) < 60:
        actions = {name: np.zeros(world.action_space(name).shape) for name in world.agents}
        actions["agent_0"][world.action_names.index("root.y")] = -1.0
        observations, _, _, _, infos = world.step(actions)
        pushed.append(infos["agent_1"]["push_impulse"])
        sensed = world.observation_layout.split(observations["agent_1"])["contact_impulse"].reshape(-1, 3)
        turn = Rotation.from_quat(world.batch.simulation.avatars[1].tracked.rotation.numpy()[0, 0])
        assert np.hypot(*turn.apply(sensed).sum(0)[:2]) == pytest.approx(pushed[-1], rel=1e-3, abs=1e-3)
        assert infos["agent_0"]["push_impulse"] == pytest.approx(pushed[-1], rel=0.02, abs=0.05), "equal and opposite"
        drive = world.batch.simulation.avatars[0].state
        lead.append(np.linalg.norm((drive.command_root.numpy()[0] - pelvises(world)[0])[:2]))
    assert infos["agent_0"]["success"] and not infos["agent_1"]["root_released"]
    assert max(pushed) > 10.0
    # a step of the root beyond the limit of its lead, and what contact took back in this step
    step = world.config.root_speed * world.config.physics.control_dt
    assert world.config.root_lead_limit < max(lead) < world.config.root_lead_limit + 2.5 * step


def test_a_body_that_is_pushed_is_not_carried_further_by_its_command(make_game, play):
    """A push of 1 m/s, no action: what moves the body must not come back as a motion of its own."""
    world = make_game(SUMO, num_agents=1, **STILL)
    world.reset(seed=0)
    start = pelvises(world)[0]
    state = world.get_state()
    state["particles.u"][0] += np.array([1.0, 0.0, 0.0], np.float32)
    world.set_state(state)
    way = []
    for _ in range(30):
        play(world, 1)
        way.append(pelvises(world)[0, 0] - start[0])
    assert 0.02 < max(way) < 0.3
    assert abs(way[-1] - way[-8]) < 0.02, "it has come to rest"
    assert world.agents == ["agent_0"]


def run(world, actions: dict[str, np.ndarray], steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Observations and rewards ``(steps, agents, ...)`` under actions ``(steps, size)``."""
    seen, paid = [], []
    world.reset(seed=0)
    for k in range(steps):
        observations, rewards, *_ = world.step({name: actions[name][k] for name in world.agents})
        seen.append([observations[name] for name in world.possible_agents])
        paid.append([rewards[name] for name in world.possible_agents])
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


def test_a_bout_is_taken_up_again_in_the_clinch(make_game, play, same):
    world, other = make_game(SUMO), make_game(SUMO, twin=1)
    world.reset(seed=2)
    rows = play(world, 12, np.random.default_rng(0), **{"root.y": -1.0})
    assert rows[-1][4]["agent_0"]["push_impulse"] > 1.0
    state = world.get_state()
    expected = play(world, 15, np.random.default_rng(1), **{"root.y": -1.0})
    other.reset(seed=9)
    for target in (other, world):
        target.set_state(state)
        assert same(play(target, 15, np.random.default_rng(1), **{"root.y": -1.0}), expected)


@pytest.mark.parametrize("walls", [True, False])
def test_the_walls_keep_who_is_thrown_out(make_game, play, walls):
    world = make_game(SUMO, num_agents=4, scene={"walls": walls})
    world.reset(seed=0)
    state = world.get_state()
    state["avatar_1.state.released"][:] = 1
    state["particles.u"][0, particles_of(world, 1)] = (-6.0, 0.0, 1.0)
    world.set_state(state)
    reached = []
    for _ in range(30):
        rows = play(world, 1)
        reached.append(-world.batch.simulation.state.x.numpy()[0, particles_of(world, 1), 0].min())
        if not world.agents:
            break
    side, dx = world.config.ring_radius + 1.2, world.batch.simulation.dx
    assert side - dx < max(reached), "it must come to the wall"
    if walls:
        assert max(reached) < side + 0.5 * dx and len(world.agents) == 3
        assert np.linalg.norm(pelvises(world)[1, :2]) > world.config.ring_radius
    else:
        assert rows[-1][4]["agent_0"]["failure"] == "out_of_grid"


def test_a_batch_is_as_many_worlds(make_game, same, device):
    from piavatar_envs.envs.batch_env import BatchEnv

    single, seed, steps = make_game(SUMO), 3, 8
    batch = BatchEnv(type(single.batch.task)(single.config), 2, device)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (steps, *batch.action.shape)).astype(np.float32)
    actions[..., single.action_names.index("root.y")] = -1.0
    batch.reset(seeds=[seed, seed + 1])
    rows = []
    for action in actions:
        batch.action.assign(action)
        batch.step()
        rows.append((batch.observation.numpy().copy(), batch.reward.numpy().copy()))
    for i in range(2):
        single.reset(seed=seed + i)
        for action, (observation, reward) in zip(actions, rows, strict=True):
            step = single.step(dict(zip(single.possible_agents, action[i], strict=True)))
            for index, name in enumerate(single.possible_agents):
                assert same(step[0][name], observation[i, index])
                assert same(np.float32(step[1][name]), reward[i, index])


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"num_agents": 8}, r"num_agents=8 at start_distance=1.1 m .* use ring_radius >= 1.7"),
        ({"num_agents": 0}, "num_agents=0 must be >= 1"),
        ({"joints": ["tail"]}, "'tail' is not a joint"),
        ({"num_agents": 3, "scene": {"avatars": [{}, {}]}}, "2 entries and num_agents=3"),
    ],
)
def test_impossible_rings_are_refused(make_game, settings, told):
    with pytest.raises(ValueError, match=told):
        make_game(SUMO, **settings)


def test_upper_body_acts_and_the_legs_do_not(make_game):
    joints = {name.partition(".")[0] for name in make_game(SUMO).action_names}
    assert "root" in joints and joint_index("spine1") and not any("hip" in name or "knee" in name for name in joints)
    assert len(make_game(SUMO, joints=None).action_names) == 66
