"""Setups: the environments that gym.make builds, and scenes as files hold them."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from piavatar_envs.live.scenes import SavedScene
from piavatar_envs.live.setup import Setup


def test_a_setup_builds_what_gymnasium_makes(device, sample_id):
    settings = {"fidelity": "tiny", "physics.friction": 0.5}
    env = gymnasium.make(sample_id, device=device, **settings)
    env.reset(seed=3)
    host = Setup(sample_id, settings, num_envs=2, seed=3, device=device).make()
    host.reset(3)
    assert host.config == env.unwrapped.config
    action = np.full(env.action_space.shape, 0.4, np.float32)
    for _ in range(3):
        observation, *_ = env.step(action)
        host.step(np.broadcast_to(action, (2, 1, *action.shape)))
    np.testing.assert_array_equal(host.observation()[0, 0], observation)
    host.close()
    env.close()


def test_a_setup_of_what_is_not_registered_is_refused():
    with pytest.raises(ValueError, match="no environment 'PIAvatar/Nothing-v0'"):
        Setup("PIAvatar/Nothing-v0").task()


def test_files_of_scenes_are_checked():
    state = {"particles.x": np.arange(6.0).reshape(1, 2, 3)}
    scene = SavedScene(
        Setup("PIAvatar/Reach-v0", {"fidelity": "tiny"}), {"control.tone": 0.5}, 0, "skin", 7, 1.5, state
    )
    read = SavedScene.from_bytes(scene.to_bytes())
    assert (read.setup, read.tuned, read.played, read.total) == (scene.setup, scene.tuned, 7, 1.5)
    np.testing.assert_array_equal(read.state["particles.x"], state["particles.x"])
    wrong = SavedScene(Setup("PIAvatar/Reach-v0", agent=3), {}, 0, "skin", 7, 1.5, state)
    for content in (b"", scene.to_bytes()[:-30], wrong.to_bytes()):
        with pytest.raises(ValueError, match="not a scene of the live view"):
            SavedScene.from_bytes(content)
