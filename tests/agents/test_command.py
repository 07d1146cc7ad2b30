"""Command lines and configurations: settings anywhere among the options, and errors of one line."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from agents import batch_training as batches
from agents import demo, play
from agents.command import read_options, script_hint
from agents.pid import score as score_pid
from agents.sb3 import train
from agents.sb3.config import env_config, load_training
from agents.sb3.workers import components, factory
from piavatar_envs.config import ConfigError, dump_yaml

#: Scripts that take settings, and what they want first.
SCRIPTS = {play: ["run"], train: ["run.yaml"], batches: ["run.yaml"], score_pid: ["PIAvatar/Stand-v0"], demo: []}
scripts = pytest.mark.parametrize(
    ("script", "first"), [pytest.param(*pair, id=pair[0].__name__.partition(".")[2]) for pair in SCRIPTS.items()]
)


@scripts
@pytest.mark.parametrize(
    "settings",
    [
        ["a=1", "b=-2", "c=x", "--device", "cuda", "--out", "x=y"],
        ["--device", "cuda", "--out", "x=y", "a=1", "b=-2", "c=x"],
        ["a=1", "--device", "cuda", "b=-2", "--out=x=y", "c=x"],
        ["--device", "cuda", "a=1", "b=-2", "--out", "x=y", "c=x"],
    ],
    ids=["before", "after", "around", "between"],
)
def test_settings_may_stand_anywhere(script, first, settings):
    options = read_options(script.Options, "x", [*first, *settings])
    assert options.settings == ("a=1", "b=-2", "c=x")
    assert options.device == "cuda" and options.out == Path("x=y")


@scripts
@pytest.mark.parametrize(
    "line", [["--nowhere", "a=1"], ["a=1", "--device", "cpu", "-x"], ["a=1", "--out", "b", "--no=1"]]
)
def test_options_that_there_are_not_are_refused(script, first, line, capsys):
    with pytest.raises(SystemExit) as ended:
        read_options(script.Options, "x", [*first, *line])
    said = capsys.readouterr()
    assert ended.value.code == 2 and "Unrecognized options" in said.out + said.err


CONFIGS = Path(__file__).resolve().parents[2] / "configs"
#: The script that a folder of configurations belongs to; RL Zoo's own has none of ours.
OWNERS = {
    "fit": "fit",
    "rl_zoo3": None,
    "rllib": "rllib.train",
    "rsl_rl": "rsl_rl.train",
    "skrl": "skrl.train",
    "sb3": "sb3.train",
}


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*/*.y*ml")), ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_files_of_other_scripts_are_known_wherever_they_lie(path, tmp_path):
    owner = OWNERS[path.parent.name]
    copy = tmp_path / "config.yaml"
    copy.write_bytes(path.read_bytes())
    module = f"agents.{owner}" if owner else "rl_zoo3.train"
    for script in filter(None, OWNERS.values()):
        hint = "" if script == owner else f" (this is a file for python -m {module})"
        assert script_hint(path, script) == script_hint(copy, script) == hint


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
    # and a change of it is not a setting given twice
    assert env_config(load_training(path, {"env.fidelity": "coarse"})).physics.fidelity == "coarse"
