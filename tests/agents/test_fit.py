"""Studies: parameters as settings, trials in shared builds, the file that outlasts a kill, and what is reported."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml

pytest.importorskip("torch", reason="needs the extra fit")
pytest.importorskip("optuna", reason="needs the extra fit")

from agents.fit import __main__ as fit
from agents.fit.config import load_fit
from agents.fit.rollout import Player
from agents.fit.scorers import scorer_class
from agents.fit.space import Space
from agents.fit.study import FILE, Study
from piavatar_envs.config import ConfigError

ROOT = Path(__file__).resolve().parents[2]
BALL = {"name": "ball", "size": [0.15], "mass": 4.0, "position": [0.0, -0.33, 1.0], "velocity": [0.0, 6.0, 0.0]}
STUDY = {
    "env_id": "PIAvatar/Stand-v0",
    "env": {"control": "pose", "fidelity": "tiny", "episode_seconds": 0.1, "scene": {"props": [BALL]}},
    "parameters": {"scene.props.0.mass": {"low": 1.0, "high": 8.0, "scale": "log"}},
    "scorers": {"measured": {"quantity": "indentation_depth"}},
    "trials": 7,
    "startup": 4,
}
#: Study that :mod:`tests.agents.killed_study` kills.
KILLED = {"direction": "minimize", "sampler": "tpe", "trials": 12, "startup": 4, "batch": 2}


def study(**changed):
    return load_fit({**STUDY, **changed})


def space_of(parameters, env=None):
    return Space(study(parameters=parameters, env={**STUDY["env"], **(env or {})}))


# Parameters.


def test_names_reach_lists_ranges_and_whole_numbers():
    regions = [{"joints": ["spine1"], "young_modulus": 2e4}]
    env = {"scene": {"props": [BALL], "avatars": [{"regions": regions, "physics": {"density": 900.0}}]}}
    space = space_of(
        {
            "scene.props.0.velocity.1": {"low": 1.0, "high": 5.0},
            "scene.avatars.0.regions.0.young_modulus": {"low": 1e2, "high": 1e7, "scale": "log"},
            "scene.avatars.0.physics.density": {"low": 500.0, "high": 2000.0},
            "physics.num_substeps": {"low": 4, "high": 40},
            "randomize.mass_factor": {"low": 0.5, "high": 2.0},
            "shape.parameters.weight": {},
        },
        env,
    )
    values = space.values([0.5] * 6)
    settings = space.settings(values)
    assert settings.scene.props[0].velocity == (0.0, 3.0, 0.0)
    assert settings.scene.avatars[0].regions[0].young_modulus == pytest.approx(10**4.5)
    assert settings.scene.avatars[0].physics["density"] == 1250.0
    assert settings.physics.num_substeps == 22 and isinstance(values["physics.num_substeps"], int)
    assert settings.randomize.mass_factor == (1.25, 1.25)
    assert settings.shape.parameters == {"weight": 0.0}  # bounds of the schema: -1 to 1
    assert space.shares([values]) == pytest.approx(np.full((1, 6), 0.5))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"physics.yung_modulus": {"low": 1, "high": 2}}, r"did you mean physics\.young_modulus"),
        (
            {"scene.props.1.mass": {"low": 1, "high": 2}},
            r"parameters\.scene\.props\.1\.mass is not a setting.*there are 0",
        ),
        ({"physics.material": {"low": 1, "high": 2}}, "is not a number"),
        ({"physics": {"low": 1, "high": 2}}, "is a section"),
        ({"scene.ground": {"low": 0, "high": 1}}, "is not a number"),
        ({"physics.friction": {"low": 2, "high": 1}}, r"low=2 must be below high=1"),
        ({"physics.friction": {"low": 0, "high": 1, "scale": "log"}}, r"low=0 must be > 0"),
        ({"physics.poisson_ratio": {"low": 0.1, "high": 0.5}}, r"poisson_ratio=0\.5 must be < 0\.5"),
        ({"scene.props.0.velocity.0": {"low": 0.0, "high": 101.0}}, r"velocity\.0=101\.0 must be <= 100"),
        ({"scene.avatars.0.yaw": {"low": 0, "high": 1}}, r"scene\.avatars has no parts|scene\.avatars.*no setting"),
        ({}, "parameters is empty"),
    ],
)
def test_what_is_no_parameter_is_refused(parameters, message):
    with pytest.raises(ConfigError, match=message):
        space_of(parameters)


def test_overrides_reach_environment_scorers_and_bounds():
    config = load_fit(
        STUDY,
        {"env.tone": 0.5, "scorers.measured.target": 0.1, "parameters.scene.props.0.mass.high": 5.0, "trials": 3},
    )
    assert config.env["control"]["tone"] == 0.5 and config.trials == 3
    assert config.scorers["measured"]["target"] == 0.1
    assert config.parameters["scene.props.0.mass"].high == 5.0
    for wrong in ({"scorers.measured.tarjet": 1.0}, {"scorer": "opinion"}, {"actor": {"kind": "run"}}):
        with pytest.raises(ConfigError, match=r"target|no scorer|kind='run'"):
            load_fit(STUDY, wrong)


@pytest.mark.parametrize("path", sorted((ROOT / "configs" / "fit").glob("*.yaml")), ids=lambda path: path.stem)
def test_published_studies_load(path):
    config = load_fit(path)
    assert len(Space(config).axes) == len(config.parameters) >= 1
    if "vlm" in config.scorers:
        assert load_fit(path, {"scorer": "vlm"}).best_is == config.best_is


# Trials.


def test_a_shared_build_gives_every_trial_what_a_build_of_its_own_does(device):
    # Factors, and the mass of a prop without a modulus, differ between the environments of one batch.
    parameters = {
        "scene.props.0.mass": {"low": 1.0, "high": 8.0, "scale": "log"},
        "randomize.stiffness_factor": {"low": 0.25, "high": 1.0, "scale": "log"},
        "randomize.ground_friction_factor": {"low": 0.5, "high": 2.0},
    }
    config = study(parameters=parameters, repeats=2)
    space = Space(config)
    assert space.shared == space.axes
    trials = [space.values(share) for share in ([0.1, 0.9, 0.5], [0.9, 0.1, 0.2], [0.5, 0.5, 1.0])]
    player = Player(config, space, ("particle_position", "prop_velocity"), device=device)
    together = dict(player.play(trials, [0, 1, 2]))
    assert player.builds == 1
    for index, values in enumerate(trials):
        alone = dict(player.play([values], [0]))[0]
        for own, shared in zip(alone, together[index], strict=True):
            assert all(np.array_equal(own.readings[name], shared.readings[name]) for name in own.readings)
    # and so does a build with the settings themselves, but for rounding
    settings = space.settings(trials[1])
    assert settings.randomize.stiffness_factor == (trials[1]["randomize.stiffness_factor"],) * 2
    env = gym.make(config.env_id, config=settings, device=device, **player.time_step(trials[1]))
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(env.action_space.shape, np.float32))
    velocity = env.unwrapped.read("prop_velocity")
    env.close()
    player.close()
    assert velocity == pytest.approx(together[1][0].readings["prop_velocity"][3], abs=1e-4)
    assert velocity != pytest.approx(together[0][0].readings["prop_velocity"][3], abs=1e-2)


def test_other_settings_need_a_build_each(device):
    config = study(parameters={"physics.young_modulus": {"low": 1e4, "high": 1e5}, **STUDY["parameters"]})
    space = Space(config)
    assert [axis.name for axis in space.shared] == ["scene.props.0.mass"]
    player = Player(config, space, ("prop_velocity",), device=device)
    list(player.play([space.values(share) for share in ([0.0, 0.0], [0.0, 1.0], [1.0, 0.0])], [0, 1, 2]))
    player.close()
    assert player.builds == 2
    stiff = {**STUDY["env"], "scene": {"props": [{**BALL, "young_modulus": 2e4}]}}
    assert Space(study(env=stiff)).shared == ()  # mass at a given modulus changes the waves


def test_scripts_act_from_their_times_on(device):
    frames = [{"time": 0.04, "actions": {"left_elbow.x": 1.0}}]
    config = study(actor={"kind": "keyframes", "keyframes": frames})
    turned = []
    for one in (config, study()):
        player = Player(one, space := Space(one), ("bone_local_rotation",), device=device)
        ((_, (episode,)),) = player.play([space.values([0.5])], [0])
        turned.append(episode.readings["bone_local_rotation"])
        player.close()
    assert np.array_equal(turned[0][:3], turned[1][:3]) and not np.array_equal(turned[0][3], turned[1][3])
    wrong = study(actor={"kind": "keyframes", "keyframes": [{"actions": {"left_elbw.x": 1.0}}]})
    with pytest.raises(ConfigError, match=r"left_elbw\.x is not a component"):
        list(Player(wrong, Space(wrong), (), device=device).play([space.values([0.5])], [0]))


def test_a_trained_policy_acts_in_the_environment_that_it_was_trained_for(device):
    pytest.importorskip("rsl_rl", reason="needs the extra rsl")
    folder = ROOT / "benchmarks" / "results" / "ppo" / "stand_0"
    run = yaml.safe_load((folder / "config.yaml").read_text())
    env = {**run["env"], "episode_seconds": 0.1, "physics": {**run["env"]["physics"], "fidelity": "tiny"}}
    other = {"env_id": run["env_id"], "parameters": {"physics.friction": {"low": 0.5, "high": 1.0}}}
    turned = []
    for actor in ({"kind": "run", "run": str(folder)}, {"kind": "zero"}):
        config = study(**other, env=env, actor=actor)
        space = Space(config)
        player = Player(config, space, ("bone_local_rotation",), device=device)
        ((_, (episode,)),) = player.play([space.values([0.5])], [0])
        turned.append(episode.readings["bone_local_rotation"][-1])
        player.close()
    assert not np.array_equal(*turned)
    wrong = study(actor={"kind": "run", "run": str(folder)})
    with pytest.raises(ConfigError, match="trained for other"):
        list(Player(wrong, space := Space(wrong), (), device=device).play([space.values([0.5])], [0]))


# The file.


class Toy:
    """Stands in for a player: no simulation, and a kill before a trial if asked for."""

    def __init__(self, kill_at: int | None = None) -> None:
        self.kill_at, self.played = kill_at, 0

    def play(self, trials, wanted):
        """Return the trials' values as their episodes."""
        for index in wanted:
            if self.kill_at is not None and self.played >= self.kill_at:
                raise KeyboardInterrupt
            self.played += 1
            yield index, [trials[index]]


class ToyScorer:
    """Scores values by their distance from a place, without a score in a part of the range."""

    def score(self, values):
        """Return the score."""
        from agents.fit.scorers import Unscored

        mass = values["scene.props.0.mass"]
        if mass > 4.0:
            raise Unscored("too heavy")
        return -((np.log(mass) - 1.0) ** 2)


class ToyMatch(ToyScorer):
    """Scores values by their distance from a place, and has the differences."""

    def score(self, values):
        """Return the score."""
        return float(np.linalg.norm(self.residuals(values)))

    def residuals(self, values):
        """Return the differences."""
        share = np.log(values["scene.props.0.mass"]) - 1.0
        return np.array([np.sin(share), share**2, np.expm1(share)], np.float32)


class _Episode(dict):
    failure = ""


def play_toy(config, folder, kill_at=None, scorer=ToyScorer):
    folder.mkdir(exist_ok=True)
    toy = Toy(kill_at)
    original = toy.play
    toy.play = lambda trials, wanted: ((i, [_Episode(e[0])]) for i, e in original(trials, wanted))
    own = Study(config, Space(config), folder)
    with suppress(KeyboardInterrupt):
        list(own.run(toy, scorer()))
    return own.trials()


@pytest.mark.parametrize(("sampler", "batch"), [("gp", 2), ("tpe", 3)])
def test_a_killed_study_goes_on_with_the_same_trials(sampler, batch, tmp_path):
    config = study(sampler=sampler, batch=batch, trials=9, seed=3)
    whole = play_toy(config, tmp_path / "whole")
    assert len(whole) == 9 and any(trial.score is None for trial in whole)
    for part in range(40):
        killed = play_toy(config, tmp_path / "killed", kill_at=3 + part % 2)
        assert killed == whole[: len(killed)]
        if len(killed) == 9:
            break
    assert killed == whole
    longer = play_toy(config.model_copy(update={"trials": 11}), tmp_path / "killed")
    assert longer[:9] == whole and len(longer) == 11
    assert play_toy(config.model_copy(update={"seed": 4, "trials": 3}), tmp_path / "other") != whole[:3]


def test_a_killed_identification_goes_on_with_the_same_trials_and_closes_in(tmp_path):
    config = study(direction="minimize", trials=14, startup=9, batch=2)
    whole = play_toy(config, tmp_path / "whole", scorer=ToyMatch)
    for kill_at in (9, 3, None):
        killed = play_toy(config, tmp_path / "killed", kill_at, ToyMatch)
        assert killed == whole[: len(killed)]
    assert killed == whole
    # trial 9 is where the model of the residuals matches best
    assert whole[9].values["scene.props.0.mass"] == pytest.approx(np.e, rel=2e-3)
    assert whole[9].score < 0.1 * min(trial.score for trial in whole[:9])


def test_a_study_killed_at_random_moments_has_the_trials_of_one_that_was_not(tmp_path):
    command = [sys.executable, "-m", "tests.agents.killed_study", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    config = study(**KILLED)
    whole, *others = (
        Study(config, Space(config), folder).trials(True)
        for folder in (tmp_path / "whole", *sorted(tmp_path.glob("killed_*")))
    )
    assert others and len(whole) == KILLED["trials"]
    for killed in others:
        assert killed == whole
        assert all(np.array_equal(one.residuals, other.residuals) for one, other in zip(whole, killed, strict=True))


def test_a_file_of_other_settings_or_of_something_else_is_refused(tmp_path):
    config = study(trials=2)
    play_toy(config, tmp_path)
    with pytest.raises(ConfigError, match=r"other settings \(seed\)"):
        Study(config.model_copy(update={"seed": 1}), Space(config), tmp_path)
    (tmp_path / FILE).write_bytes(b"no database")
    with pytest.raises(ConfigError, match="not a file of a study"):
        Study(config, Space(config), tmp_path)


# The command line.


def test_a_study_leaves_figures_and_a_configuration_that_gym_takes(tmp_path, device, capsys):
    file, folder = tmp_path / "mass.yaml", tmp_path / "run"
    file.write_text(yaml.safe_dump({**STUDY, "direction": "maximize"}))
    fit.main([str(file), "trials=6", "--out", str(folder), "--device", device])
    fit.main([str(file), "--out", str(folder), "--device", device])  # prolongs it
    found = json.loads((folder / "results.json").read_text())
    assert found["benchmark"] == "fit" and {"commit", "versions", "device"} <= set(found)
    assert [trial["case"] for trial in found["results"]] == [f"trial {number}" for number in range(7)]
    best, (low, high) = found["best"], found["best"]["intervals"]["scene.props.0.mass"]
    assert best["values"]["scene.props.0.mass"] > 6.0 and low <= best["values"]["scene.props.0.mass"] <= high
    assert "scene.props.0.mass" in capsys.readouterr().out and (folder / "study.png").stat().st_size > 10_000
    env = gym.make(STUDY["env_id"], config=folder / "best.yaml", device=device)
    assert env.unwrapped.host.config.scene.props[0].mass == best["values"]["scene.props.0.mass"]
    env.close()
    with sqlite3.connect(folder / FILE) as database:  # a database of Optuna, for its dashboard
        assert database.execute("select count(*) from trials").fetchone() == (7,)
    with pytest.raises(SystemExit, match=r"error: .*other settings"):
        fit.main([str(file), "env.tone=0.1", "--out", str(folder), "--device", device])


def test_scorers_are_found_by_their_modules():
    assert {scorer_class(name).__name__ for name in ("measured", "recorded")} == {"MeasuredScorer", "RecordedScorer"}
    with pytest.raises(ValueError, match="there is no scorer 'opinion'; use one of measured, recorded, vlm"):
        scorer_class("opinion")
