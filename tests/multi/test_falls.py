"""Falls under torques: limits of head and pelvis, the postures below them, and the consequences."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.sources import load_asset

SUMO, BOXING = "sumo_v0", "boxing_v0"
HIGH_FIVE, PASS_BALL = "high_five_v0", "pass_ball_v0"
#: Rings too wide to be left by falling.
WIDE = {SUMO: {"ring_radius": 4.0}, BOXING: {"ring_size": 8.0}}
STILL = {"pose_noise": 0.0, "place_noise": 0.0}
HEAD = joint_index("head")


def shares(game, agent: int) -> tuple[float, float]:
    """Heights of head and pelvis over those in the rest pose of the agent's own body."""
    avatar = game.batch.simulation.avatars[agent]
    z = avatar.tracked.position.numpy()[0, :, 2].astype(float)
    rest = avatar.body.rest_joint.numpy()[0, :, 2].astype(float)
    return z[HEAD] / rest[HEAD], z[0] / rest[0]


def is_down(game, agent: int) -> bool:
    head, pelvis = shares(game, agent)
    return head < game.config.fall.fall_head or pelvis < game.config.fall.fall_pelvis


def help_only(game, *agents: int) -> None:
    """Hold the pelvises of these agents up, as ``root_assist`` does for all."""
    state = game.get_state()
    for agent in range(len(game.possible_agents)):
        state[f"controller_{agent}.assist"][:] = float(agent in agents)
    game.set_state(state)


def still(game) -> dict[str, np.ndarray]:
    return {name: np.zeros(game.action_space(name).shape) for name in game.agents}


@pytest.mark.parametrize("shape", [{}, {"shape.randomize": True}], ids=["mean", "random"])
@pytest.mark.parametrize("module", [SUMO, BOXING])
def test_the_agent_that_falls_loses_and_the_one_that_stands_wins(make_game, module, shape):
    """In the very step in which the heights say so, without a root that lets go."""
    game = make_game(module, control="pd", joint_stiffness=0.2, **WIDE[module], **STILL, **shape)
    game.reset(seed=4)
    assert not any("root" in name for name in game.action_names)
    help_only(game, 1)
    for _ in range(90):
        _, rewards, terminations, truncations, infos = game.step(still(game))
        assert infos["agent_0"]["failure"] == 0 and not any(truncations.values())
        assert terminations["agent_0"] == is_down(game, 0) and not is_down(game, 1)
        if terminations["agent_0"]:
            break
        assert not any(terminations.values())
    assert terminations == {"agent_0": True, "agent_1": True} and not game.agents
    assert [infos[name]["success"] for name in ("agent_0", "agent_1")] == [False, True]
    lost = {SUMO: "out", BOXING: "down"}[module]
    assert infos["agent_0"][f"reward_{lost}"] < -4.0 and infos["agent_1"]["reward_win"] > 4.0
    assert rewards["agent_0"] < -4.0 and rewards["agent_1"] > 4.0
    assert not any(info["root_released"] for info in infos.values()) and not infos["agent_0"]["root_force"].any()


@pytest.mark.parametrize("module", [SUMO, BOXING])
def test_limp_bodies_go_down_and_stay_out(make_game, same, module):
    """Three without torques: each is out for good from the step in which it is down, and the first two win nothing."""
    game = make_game(module, control="torque", num_agents=3, **WIDE[module])
    game.reset(seed=1)
    help_only(game, 2)
    out, log = [], []
    while game.agents and len(log) < 90:
        down = [is_down(game, agent) for agent in range(3)]
        assert not any(down[game.possible_agents.index(name)] for name in game.agents)
        log.append(game.step(still(game)))
        _, _, terminations, _, infos = log[-1]
        out += [name for name, ended in terminations.items() if ended]
        winners = [name for name, info in infos.items() if info["success"]]
        assert winners == (["agent_2"] if {"agent_0", "agent_1"} <= set(out) and not is_down(game, 2) else [])
    assert {"agent_0", "agent_1"} <= set(out) and not game.agents
    game.reset(seed=1)
    help_only(game, 2)
    assert same([game.step(still(game)) for _ in range(6)], log[:6])


@pytest.mark.parametrize("module", [HIGH_FIVE, PASS_BALL])
def test_where_all_have_one_aim_a_fall_is_the_end_for_all(make_game, module):
    slow = {"serve_speed": (0.2, 0.25), "dead_speed": 1e-6} if module == PASS_BALL else {}  # a ball that stays in play
    game = make_game(module, control="pd", episode_seconds=5.0, **slow)
    game.reset(seed=2)
    help_only(game, 0)
    count = len(game.agents)
    for _ in range(90):
        _, _, terminations, truncations, infos = game.step(still(game))
        down = [is_down(game, agent) for agent in range(count)]
        assert not down[0] and list(terminations.values()) == [any(down)] * count and not any(truncations.values())
        if any(down):
            break
    assert any(down) and not game.agents
    assert not any(info["success"] or info["root_released"] or info["failure"] for info in infos.values())
    game = make_game(module)  # also where a root that is held up lets go
    game.reset(seed=0)
    state = game.get_state()
    state["avatar_1.state.released"][:] = 1
    game.set_state(state)
    _, rewards, terminations, _, infos = game.step(still(game))
    assert all(terminations.values()) and not game.agents and max(rewards.values()) < 1.0
    assert [info["root_released"] for info in infos.values()] == [index == 1 for index in range(count)]
    assert not any(info["success"] for info in infos.values())


def test_where_a_wrench_holds_the_root_no_posture_is_a_fall(make_game, play, game_name):
    game = make_game(game_name, **{"fall.fall_head": 0.9999, "fall.fall_pelvis": 0.9999})
    game.reset(seed=0)
    rows = play(game, 5)
    assert any(is_down(game, agent) for agent in range(2)), "a body sags by a little"
    assert len(rows) == 5 and not any(any(row[2].values()) for row in rows)


@pytest.mark.parametrize("module", [SUMO, BOXING])
def test_kneeling_is_down_and_ducking_is_not(make_game, module):
    """Of the mean body, with a straight trunk; a shin is about as thick as an ankle is high."""
    fall, at = make_game(module).config.fall, load_asset().mean_body().joints[:, 2]
    head, pelvis = at[HEAD], at[0]
    kneeling = pelvis - at[joint_index("left_knee")] + at[joint_index("left_ankle")]
    assert kneeling / pelvis < fall.fall_pelvis and max(fall.fall_pelvis, fall.fall_head) < 0.75
    assert (head - pelvis + kneeling) / head > fall.fall_head, "by the pelvis only"
