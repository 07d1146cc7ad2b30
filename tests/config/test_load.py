"""Configurations: errors name key, value and limit; sources merge in order; round trips lose nothing."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import yaml
from pydantic import BaseModel, Field, ValidationError

from piavatar_envs.config import (
    ConfigError,
    ControlConfig,
    EnvConfig,
    PoseControlConfig,
    TorqueControlConfig,
    dump_yaml,
    load_config,
    parse_assignments,
    replace,
)
from piavatar_envs.config.errors import models_of, setting_keys


class Task(EnvConfig):
    """A task's configuration, as tasks/ writes them: one level below EnvConfig."""

    target_radius: float = Field(0.1, gt=0.0, le=1.0, description="radius of the target [m]")
    span: tuple[float, float] = Field((0.3, 0.9), description="nearest and farthest target [m]")


def refusal(source=None, overrides=None, cls=Task) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(cls, source, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("overrides", "key", "limit"),
    [
        ({"control.tone": 1.5}, "control.tone=1.5", "<= 1"),
        ({"control": {"tone": -0.1}}, "control.tone=-0.1", ">= 0"),
        ({"physics.control_dt": 0}, "physics.control_dt=0", ">= 0.0001 [s]"),
        ({"physics.poisson_ratio": 0.5}, "physics.poisson_ratio=0.5", "< 0.5"),
        ({"fidelity": "ultra"}, "physics.fidelity='ultra'", "one of 'tiny', 'coarse', 'medium' or 'fine'"),
        ({"young_modulus": "soft"}, "physics.young_modulus='soft'", "a number [Pa]"),
        ({"young_modulus": "100000"}, "physics.young_modulus='100000'", "a number [Pa]"),
        ({"tone": True}, "control.tone=True", "a number"),
        ({"num_substeps": 1.5}, "physics.num_substeps=1.5", "a whole number"),
        ({"free_motion": 1}, "control.free_motion=1", "true or false"),
        ({"tone": float("nan")}, "control.tone=nan", "a finite number"),
        ({"density": float("inf")}, "physics.density=inf", "a finite number [kg/m^3]"),
        ({"shape.parameters.age": 2}, "shape.parameters.age=2", "<= 1"),
        ({"physics": 3}, "physics=3", "a section, with its settings below it"),
        ({"target_radius": 2.0}, "target_radius=2.0", "<= 1 [m]"),
        ({"width": 8}, "render.width=8", ">= 16 [pixel]"),
        ({"control.ton": 1}, "control.ton ", "control.tone?"),
        ({"control.young_modulus": 1}, "control.young_modulus ", "physics.young_modulus?"),
        ({"physcs": {"fidelity": "tiny"}}, "physcs ", "physics?"),
        ({"target_radius.x": 1}, "target_radius={'x': 1}", "a number [m]"),
        ({"control": {"tone": 0.1}, "tone": 0.2}, "control.tone", "given twice"),
    ],
)
def test_a_refusal_names_key_value_and_limit(overrides, key, limit):
    message = refusal(None, overrides)
    assert message.startswith(key) and limit in message


def test_an_unlike_key_is_answered_with_what_there_is():
    message = refusal(None, {"physics.qqqq": 1})
    assert message.startswith("physics.qqqq is no setting of Task; there are physics.fidelity, ")


def test_all_errors_come_in_one_line_with_their_file(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text("physics:\n  density: -1\nobs_mode: both\n")
    message = refusal(path, {"tone": 7})
    assert f"{path}: physics.density=-1 must be >= 0.1 [kg/m^3]" in message
    assert f"{path}: obs_mode='both' must be one of 'flat' or 'dict'" in message
    assert "; control.tone=7 must be <= 1; " in message  # not the file's fault


def test_files_that_cannot_be_read(tmp_path):
    assert "cannot read the configuration" in refusal(tmp_path / "none.yaml")
    endless = tmp_path / "endless.yaml"
    endless.write_text("control: &d {tone: 0.3, more: *d}")
    assert "has a value that holds itself; write it out" in refusal(endless)
    broken = tmp_path / "broken.yaml"
    broken.write_text("physics: [1,\n")
    assert f"{broken} is not YAML" in refusal(broken)
    broken.write_text("- a\n- b\n")
    assert "holds a list, not settings" in refusal(broken)
    broken.write_text("control:\n  tone: 0.1\n  tone: 0.2\n")
    assert "'tone' is given twice" in refusal(broken)
    broken.write_text("control: !!python/object/apply:os.getcwd []\n")
    assert "is not YAML" in refusal(broken)


def test_file_then_keywords(tmp_path):
    path = tmp_path / "some.yaml"
    path.write_text("physics:\n  young_modulus: 1e6\n  fidelity: tiny\ncontrol:\nshape.parameters.age: 0.5\n")
    config = load_config(Task, path, {"fidelity": "medium", "shape": {"parameters": {"weight": -0.5}}})
    assert config.physics.young_modulus == 1e6  # YAML 1.1 would call this a string
    assert config.physics.fidelity == "medium"
    assert config.shape.parameters == {"age": 0.5, "weight": -0.5}
    assert config.control == Task().control  # an empty section is one with defaults


def test_a_mapping_may_begin_as_another_one(tmp_path):
    """By YAML's merge keys; what it says itself wins, and is not given twice by that."""
    path = tmp_path / "merged.yaml"
    path.write_text("shape:\n  parameters:\n    <<: {age: 0.5, weight: 0.1}\n    weight: 0.2\n")
    assert load_config(Task, path).shape.parameters == {"age": 0.5, "weight": 0.2}


def test_an_ambiguous_name_is_refused():
    class Left(BaseModel):
        same: int = 0

    class Two(BaseModel):
        left: Left = Left()
        right: Left = Left()

    assert refusal(None, {"same": 1}, Two) == "same is ambiguous in Two; say which: left.same or right.same"


def test_numpy_and_tuples_are_welcome():
    config = load_config(
        Task, None, {"tone": np.float32(0.5), "span": np.array([0.1, 0.2]), "num_substeps": np.int64(9)}
    )
    assert config.control.tone == 0.5 and config.span == (0.1, 0.2) and config.physics.num_substeps == 9
    assert "a setting is a number" in refusal(None, {"tone": object()})


def test_printed_and_read_back_is_the_same(tmp_path):
    overrides = {"tone": 0.2, "shape.parameters": {"age": 0.25}, "span": [0.5, 0.6], "density": 985.123456789}
    config = load_config(Task, None, overrides)
    path = tmp_path / "resolved.yaml"
    path.write_text(dump_yaml(config))
    assert load_config(Task, path) == config
    assert set(yaml.safe_load(path.read_text())) == set(Task.model_fields)


def test_frozen_all_through_hashable_and_copied():
    config = load_config(Task, None, {"shape.parameters.age": 0.3})
    with pytest.raises(ValidationError):
        config.obs_mode = "dict"
    with pytest.raises(ValidationError):
        config.control.tone = 0.0
    for change in (lambda d: d.update(age=1), lambda d: d.pop("age"), lambda d: d.__setitem__("age", 1)):
        with pytest.raises(TypeError, match="frozen"):
            change(config.shape.parameters)
    assert hash(config) == hash(load_config(Task, None, {"shape.parameters.age": 0.3}))
    assert pickle.loads(pickle.dumps(config)) == config == copy.deepcopy(config)


def test_replace_changes_a_copy_and_validates():
    config = Task()
    changed = replace(config, {"control.alpha": 0}, tone=0.7)
    assert (changed.control.alpha, changed.control.tone) == (0.0, 0.7)
    assert config == Task() and type(changed) is Task
    with pytest.raises(ConfigError, match=r"control\.tone=2 must be <= 1"):
        replace(config, tone=2)


def test_assignments_of_a_command_line():
    parsed = parse_assignments(
        ["control.tone=0.3", "young_modulus=1e5", "fidelity=tiny", "span=[1, 2]", "num_substeps="]
    )
    assert parsed == {
        "control.tone": 0.3,
        "young_modulus": 1e5,
        "fidelity": "tiny",
        "span": [1, 2],
        "num_substeps": None,
    }
    for wrong in (["tone"], ["=1"], ["a=[1"], ["a=1", "a=2"]):
        with pytest.raises(ConfigError):
            parse_assignments(wrong)


def test_every_setting_is_described_with_its_unit():
    def fields(cls, prefix=""):
        for name, field in cls.model_fields.items():
            yield f"{prefix}{name}", field
            for model in models_of(field):
                yield from fields(model, f"{prefix}{name}.")

    undescribed = [name for name, field in fields(EnvConfig) if not field.description]
    unitless = [name for name, field in fields(EnvConfig) if field.annotation is float and "[" not in field.description]
    assert not undescribed and not unitless
    bare = [name.rpartition(".")[2] for name in setting_keys(EnvConfig)]
    assert len(bare) == len(set(bare)), "a bare name would be ambiguous as a keyword of gym.make"


class Held(EnvConfig):
    """A task that has another mode, and a setting of its own in that mode."""

    control: ControlConfig = Field(
        default_factory=lambda: TorqueControlConfig(root_assist=0.4), description="how actions move the body"
    )


class Quick(EnvConfig):
    """A task that has the usual mode, and a setting of its own in that mode."""

    control: ControlConfig = Field(
        default_factory=lambda: PoseControlConfig(joint_speed_limit=7.0), description="how actions move the body"
    )


@pytest.mark.parametrize(
    "overrides",
    [
        {"control": "pd", "strength": 0.5},
        {"control": {"mode": "pd", "strength": 0.5}},
        {"control": "pd", "control.strength": 0.5},
        {"control.mode": "pd", "control": {"strength": 0.5}},
        {"mode": "pd", "strength": 0.5},
        {"control": TorqueControlConfig(strength=0.5)},
    ],
)
def test_a_mode_is_chosen_by_any_name(overrides, tmp_path):
    expected = TorqueControlConfig(mode="pd", strength=0.5)
    assert load_config(Task, None, overrides).control == expected
    if "control" not in overrides or not isinstance(overrides["control"], BaseModel):
        path = tmp_path / "mode.yaml"
        path.write_text(yaml.safe_dump(overrides))
        assert load_config(Task, path).control == expected


def test_settings_of_the_tasks_mode_need_no_mode():
    assert load_config(Held, None, {"strength": 0.5}).control == TorqueControlConfig(root_assist=0.4, strength=0.5)
    assert load_config(Held, None, {"control": "torque"}).control.root_assist == 0.4
    assert load_config(Quick, None, {"tone": 0.5}).control == PoseControlConfig(joint_speed_limit=7.0, tone=0.5)


@pytest.mark.parametrize(
    ("cls", "overrides", "key", "mode"),
    [
        (Task, {"root_assist": 0.5}, "control.root_assist=0.5", "'pd' or 'torque'"),
        (Task, {"control": "pd", "tone": 0.5}, "control.tone=0.5", "'pose'"),
        (Task, {"control": {"mode": "torque", "alpha": 0.1}}, "control.alpha=0.1", "'pose'"),
        (Held, {"tone": 1.0}, "control.tone=1.0", "'pose'"),
        (Held, {"scene": {"avatars": [{}, {"control": {"tone": 0}}]}}, "scene.avatars.1.control.tone=0", "'pose'"),
        (Task, {"scene": {"avatars": [{"control.strength": 2}]}}, "scene.avatars.0.control.strength=2", "'pd' or"),
    ],
)
def test_a_setting_of_another_mode_is_refused_with_its_mode(cls, overrides, key, mode):
    message = refusal(None, overrides, cls)
    assert message.startswith(f"{key} belongs to control.mode={mode}")


def test_another_mode_begins_with_its_defaults():
    quick = load_config(Quick, None, {"tone": 0.5})
    under_torques = replace(quick, control="pd", strength=2.0)
    assert under_torques.control == TorqueControlConfig(strength=2.0)
    assert replace(under_torques, control="torque").control == TorqueControlConfig(mode="torque", strength=2.0)
    assert replace(under_torques, control="pose").control == PoseControlConfig(joint_speed_limit=7.0)
    assert load_config(Held, None, {"control": "pose"}).control == PoseControlConfig()


def test_a_mode_that_there_is_not_is_refused():
    for mode in ("push", 3, ["pd"]):
        assert refusal(None, {"control": mode}).startswith(
            f"control.mode={mode!r} must be one of 'pose', 'pd', 'torque'"
        )


def test_a_part_of_a_section_leaves_the_tasks_own_defaults_of_the_rest():
    config = load_config(Held, None, {"strength": 0.5, "control.joint_damping": 0.7})
    assert config.control == TorqueControlConfig(root_assist=0.4, strength=0.5, joint_damping=0.7)
    assert replace(config, {"control.strength": 0.25}).control == config.control.model_copy(update={"strength": 0.25})
