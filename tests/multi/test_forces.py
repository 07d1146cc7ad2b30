"""External forces in games: of bones by agent, and of props."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index

UP = [0.0, 0.0, 9.0]


def test_a_bone_needs_its_agent_and_a_prop_none(make_game):
    game = make_game("pass_ball_v0", episode_seconds=7.0)
    game.reset(seed=0)
    with pytest.raises(ValueError, match=r"'head' is a bone of 3 agents; give the name of one as agent"):
        game.apply_force("head", UP)
    with pytest.raises(ValueError, match=r"agent='agent_9' is not one of agent_0, agent_1, agent_2"):
        game.apply_force("head", UP, agent="agent_9")
    game.apply_force("head", UP, agent="agent_1")
    game.apply_force("ball", UP)
    state = game.get_state()
    assert state["forces.target"][0, :2].tolist() == [NUM_JOINTS + joint_index("head"), 3 * NUM_JOINTS]


@pytest.mark.parametrize("control", ["pose", "pd"])
def test_the_agent_that_is_pushed_moves(make_game, play, control):
    """Compare games with and without a push on one agent's head."""
    game, heads = make_game("sumo_v0", control=control, episode_seconds=7.0), []
    for push in (False, True):
        game.reset(seed=0)
        if push:
            game.apply_force("head", [0.0, 0.0, 60.0], steps=3, agent="agent_1")
        play(game, 3)
        avatars = game.batch.simulation.avatars
        heads.append(np.stack([a.tracked.velocity.numpy()[0, joint_index("head")] for a in avatars]))
    change = np.linalg.norm(heads[1] - heads[0], axis=1)
    assert change[0] < 1e-3 and change[1] > 0.01
