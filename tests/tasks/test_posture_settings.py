"""What counts as standing, as keeping still, as a fall: each task has the settings that act in it, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.config.load import setting_keys
from piavatar_envs.tasks import load_task
from piavatar_envs.tasks.get_up import GetUpConfig
from piavatar_envs.tasks.push_recovery import PushRecoveryConfig
from piavatar_envs.tasks.stand import StandConfig
from piavatar_envs.tasks.walk import WalkConfig

#: Values of the settings that a body which tips over can tell from the defaults.
OTHERS = {
    "upright.stand_head": 0.05, "upright.height_margin": 0.05, "upright.tilt_margin": 0.05,
    "still.speed_margin": 0.05, "still.pose_margin": 0.02, "fall.fall_head": 0.97, "fall.fall_pelvis": 0.97,
}  # fmt: skip


@pytest.mark.parametrize(
    ("config", "name", "line"),
    [
        (WalkConfig, "still.speed_margin", "still is no setting of WalkConfig"),
        (WalkConfig, "upright.pose_margin", "upright.pose_margin is no setting of WalkConfig"),
        (GetUpConfig, "fall.fall_head", "fall is no setting of GetUpConfig"),
        (GetUpConfig, "upright.fall_pelvis", "upright.fall_pelvis is no setting of GetUpConfig"),
        (StandConfig, "upright.fall_head", "did you mean fall.fall_head"),
        (PushRecoveryConfig, "upright.speed_margin", "did you mean still.speed_margin"),
    ],
)
def test_settings_that_would_do_nothing_are_refused(config, name, line):
    """Walk has no margins of stillness, and GetUp no fall."""
    with pytest.raises(ConfigError, match=line):
        load_config(config, None, {name: 0.5})


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        ("Stand-v0", {}),
        ("PushRecovery-v0", {"throw_interval": 0.2, "hit_impulse": 0.0}),
        ("GetUp-v0", {"hold_seconds": 0.01, "root_assist": 1.0}),
        ("Walk-v0", {"target_speed": 0.01}),
    ],
)
def test_every_setting_of_the_posture_acts(make_env, task, settings):
    """Each changes a reward, a success or a fall of a body that tips over, or that is lifted."""

    def play(**posture: float) -> list[tuple]:
        env = make_env(f"PIAvatar/{task}", pose_noise=0.3, **settings, **posture)
        env.reset(seed=3)  # tips over forwards
        outcomes = [env.step(np.zeros(env.action_space.shape, np.float32)) for _ in range(45)]
        return [(reward, bool(terminated), bool(info["success"])) for _, reward, terminated, _, info in outcomes]

    names = setting_keys(load_task(f"PIAvatar/{task}").Config)
    posture = [name for name in names if name.startswith(("upright.", "still.", "fall."))]
    default = play()
    assert len(posture) >= 5 and [name for name in posture if play(**{name: OTHERS[name]}) == default] == []
