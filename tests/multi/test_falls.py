"""Falls under torques: limits of head and pelvis, the postures below them, and the consequences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.sources import load_asset

SUMO, BOXING = "sumo_v0", "boxing_v0"
HIGH_FIVE, PASS_BALL = "high_five_v0", "pass_ball_v0"
#: Rings too wide to be left by falling.
WIDE = {SUMO: {"ring_radius": 4.0}, BOXING: {"ring_size": 8.0}}
STILL = {"pose_noise": 0.0, "place_noise": 0.0}
HEAD = joint_index("head")


def shares(world, agent: int) -> tuple[float, float]:
    """Heights of head and pelvis over those in the rest pose of the agent's own body."""
    avatar = world.batch.simulation.avatars[agent]
    z = avatar.tracked.position.numpy()[0, :, 2].astype(float)
    rest = avatar.body.rest_joint.numpy()[0, :, 2].astype(float)
    return z[HEAD] / rest[HEAD], z[0] / rest[0]


def is_down(world, agent: int) -> bool:
    head, pelvis = shares(world, agent)
    return head < world.config.fall.fall_head or pelvis < world.config.fall.fall_pelvis


def help_only(world, *agents: int) -> None:
    """Hold the pelvises of these agents up, as ``root_assist`` does for all."""
    state = world.get_state()
    for agent in range(len(world.possible_agents)):
        state[f"controller_{agent}.assist"][:] = float(agent in agents)
    world.set_state(state)


def still(world) -> dict[str, np.ndarray]:
    return {name: np.zeros(world.action_space(name).shape) for name in world.agents}


@pytest.mark.parametrize("shape", [{}, {"shape.randomize": True}], ids=["mean", "random"])
@pytest.mark.parametrize("module", [SUMO, BOXING])
def test_who_falls_loses_and_who_stands_wins(make_game, module, shape):
    """In the very step in which the heights say so, without a root that lets go."""
    world = make_game(module, control="pd", **WIDE[module], **STILL, **shape)
    world.reset(seed=4)
    help_only(world, 1)
    for _ in range(90):
        _, rewards, terminations, truncations, infos = world.step(still(world))
        assert infos["agent_0"]["failure"] is None and not any(truncations.values())
        assert terminations["agent_0"] == is_down(world, 0) and not is_down(world, 1)
        if terminations["agent_0"]:
            break
        assert not any(terminations.values())
    assert terminations == {"agent_0": True, "agent_1": True} and not world.agents
    assert [infos[name]["success"] for name in ("agent_0", "agent_1")] == [False, True]
    lost = {SUMO: "out", BOXING: "down"}[module]
    assert infos["agent_0"]["reward_terms"][lost] < -4.0 and infos["agent_1"]["reward_terms"]["win"] > 4.0
    assert rewards["agent_0"] < -4.0 and rewards["agent_1"] > 4.0
    assert not any(info["root_released"] for info in infos.values())


@pytest.mark.parametrize("module", [SUMO, BOXING])
def test_limp_bodies_go_down_and_stay_out(make_game, module):
    """Three without torques: each is out for good from the step in which it is down, and the first two win nothing."""
    world = make_game(module, control="torque", num_agents=3, **WIDE[module])
    world.reset(seed=1)
    help_only(world, 2)
    out = []
    while world.agents and len(out) < 90:
        down = [is_down(world, agent) for agent in range(3)]
        assert not any(down[world.possible_agents.index(name)] for name in world.agents)
        _, _, terminations, _, infos = world.step(still(world))
        out += [name for name, ended in terminations.items() if ended]
        winners = [name for name, info in infos.items() if info["success"]]
        assert winners == (["agent_2"] if {"agent_0", "agent_1"} <= set(out) and not is_down(world, 2) else [])
    assert {"agent_0", "agent_1"} <= set(out) and not world.agents


@pytest.mark.parametrize("module", [HIGH_FIVE, PASS_BALL])
def test_where_all_have_one_aim_a_fall_is_the_end_for_all(make_game, module):
    slow = {"serve_speed": (0.2, 0.25), "dead_speed": 1e-6} if module == PASS_BALL else {}  # a ball that stays in play
    world = make_game(module, control="pd", episode_seconds=5.0, **slow)
    world.reset(seed=2)
    help_only(world, 0)
    count = len(world.agents)
    for _ in range(90):
        _, _, terminations, truncations, infos = world.step(still(world))
        down = [is_down(world, agent) for agent in range(count)]
        assert not down[0] and list(terminations.values()) == [any(down)] * count and not any(truncations.values())
        if any(down):
            break
    assert any(down) and not world.agents
    assert not any(info["success"] or info["root_released"] or info["failure"] for info in infos.values())


@pytest.mark.parametrize("module", [SUMO, BOXING, HIGH_FIVE, PASS_BALL])
def test_where_a_wrench_holds_the_root_no_posture_is_a_fall(make_game, play, module):
    world = make_game(module, **{"fall.fall_head": 0.9999, "fall.fall_pelvis": 0.9999})
    world.reset(seed=0)
    rows = play(world, 5)
    assert any(is_down(world, agent) for agent in range(2)), "a body sags by a little"
    assert len(rows) == 5 and not any(any(row[2].values()) for row in rows)


@pytest.mark.parametrize("module", [SUMO, BOXING])
def test_to_kneel_and_to_reach_the_ground_is_to_be_down_and_to_duck_is_not(make_game, module):
    """Of the mean body, as geometry has it: legs and a straight trunk that leans forwards by any angle."""
    world = make_game(module)
    fall, body = world.config.fall, load_asset().mean_body()
    joint = {name: body.joints[joint_index(name)].astype(float) for name in ("head", "pelvis", "left_knee", "left_hip")}
    arm = [body.joints[joint_index(f"left_{name}")].astype(float) for name in ("shoulder", "elbow", "wrist")]
    tip = body.vertices[body.vertices[:, 0].argmax()]  # of the left hand
    reach = sum(np.linalg.norm(b - a) for a, b in zip(arm, [*arm[1:], tip], strict=True))

    def down(head: float, pelvis: float) -> bool:
        return head / joint["head"][2] < fall.fall_head or pelvis / joint["pelvis"][2] < fall.fall_pelvis

    shin = body.joints[joint_index("left_ankle")][2]  # about as thick as an ankle is high
    assert down(joint["head"][2], joint["pelvis"][2] - joint["left_knee"][2] + shin)
    for lean in np.radians(np.arange(0.0, 120.0, 5.0)):
        turned = Rotation.from_rotvec([lean, 0.0, 0.0])  # the avatar faces -y
        head, shoulder = (turned.apply(at - joint["left_hip"])[2] for at in (joint["head"], arm[0]))
        pelvis = turned.apply(joint["pelvis"] - joint["left_hip"])[2]
        hip = reach - shoulder  # the fingers touch the ground
        if hip <= joint["left_hip"][2]:
            assert down(hip + head, hip + pelvis), f"{np.degrees(lean)} degrees"
        if lean <= np.radians(75.0):  # on legs hardly bent
            assert not down(0.95 * joint["left_hip"][2] + head, 0.95 * joint["left_hip"][2] + pelvis)
    assert not down(0.75 * joint["head"][2], 0.75 * joint["pelvis"][2])
