"""A training's configuration: what is wrong is said in one line, what is right survives its file."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from agents.sb3.config import env_config, load_training
from agents.sb3.workers import components, factory
from piavatar_envs.config import ConfigError, dump_yaml

CONFIGS = sorted((Path(__file__).resolve().parents[2] / "configs" / "sb3").glob("*.yaml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_published_configurations_load_and_observe_what_there_is(path, device):
    config = load_training(path, {"env.fidelity": "tiny"})
    env = factory(config, device)()
    seen = components(env.unwrapped.observation_layout, config.observe)
    assert 0 < len(seen) == len(set(seen)) <= env.observation_space.shape[-1]
    env.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"total_step": 10}, ["total_step", "did you mean total_steps"]),
        ({"ppo": {"discount": 1.5}}, ["ppo.discount=1.5", "<= 1"]),
        ({"ppo.hidden": "large"}, ["ppo.hidden='large'", "list"]),
        ({"env": {"fidelty": "tiny"}}, ["env:", "fidelty", "did you mean physics.fidelity"]),
        ({"env": {"tone": 7.0}}, ["env:", "control.tone=7.0", "<= 1"]),
        ({"env_id": "PIAvatar/Fly-v0"}, ["env_id", "Fly-v0", "PIAvatar/Reach-v0"]),
        ({"env": {"obs_mode": "dict"}}, ["obs_mode='dict'", "flat", "observe"]),
        ({"num_workers": 1, "ppo": {"rollout_steps": 8, "batch_size": 9}}, ["batch_size=9", "<= 8"]),
    ],
)
def test_errors_are_one_line_with_key_value_and_limit(settings, words):
    with pytest.raises(ConfigError) as caught:
        load_training(settings)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_environment_settings_of_the_command_line_win_over_the_file():
    config = load_training({"env": {"fidelity": "tiny", "tone": 0.5}}, {"env.tone": 0.25, "seed": 3})
    assert env_config(config).control.tone == 0.25
    assert env_config(config).physics.fidelity == "tiny"
    assert config.seed == 3


def test_a_resolved_configuration_is_whole_and_reads_back_equal(tiny, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(dump_yaml(tiny))
    assert yaml.safe_load(path.read_text())["env"]["physics"]["density"] == 1000.0  # a default, said nevertheless
    again = load_training(path)
    assert again == tiny
    # and a change of it is no setting given twice
    assert env_config(load_training(path, {"env.fidelity": "coarse"})).physics.fidelity == "coarse"
