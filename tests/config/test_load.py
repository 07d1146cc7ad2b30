"""Configurations: sources merge in order, control modes choose their settings, round trips lose nothing."""

from __future__ import annotations

import copy
import pickle
from typing import Literal

import numpy as np
import pytest
import yaml
from pydantic import BaseModel, Field, ValidationError

from piavatar_envs.config import (
    ConfigError,
    ControlConfig,
    EnvConfig,
    PixelsConfig,
    PlacedCamera,
    PoseControlConfig,
    TorqueControlConfig,
    dump_yaml,
    load_config,
    parse_assignments,
    replace,
)
from piavatar_envs.config.errors import models_of, setting_keys


class Task(EnvConfig):
    """A task's configuration."""

    target_radius: float = Field(0.1, gt=0.0, le=1.0, description="radius of the target [m]")
    span: tuple[float, float] = Field((0.3, 0.9), description="nearest and farthest target [m]")


def test_file_then_keywords(tmp_path):
    path = tmp_path / "some.yaml"
    path.write_text("physics:\n  young_modulus: 1e6\n  fidelity: tiny\ncontrol:\nshape.parameters.age: 0.5\n")
    config = load_config(Task, path, {"fidelity": "medium", "shape": {"parameters": {"weight": -0.5}}})
    assert config.physics.young_modulus == 1e6  # YAML 1.1 would call this a string
    assert config.physics.fidelity == "medium"
    assert config.shape.parameters == {"age": 0.5, "weight": -0.5}
    assert config.control == Task().control  # an empty section is one with defaults


def test_merge_keys_of_yaml_are_followed(tmp_path):
    """Use YAML's merge keys: the mapping's own values win, and do not count as given twice."""
    path = tmp_path / "merged.yaml"
    path.write_text("shape:\n  parameters:\n    <<: {age: 0.5, weight: 0.1}\n    weight: 0.2\n")
    assert load_config(Task, path).shape.parameters == {"age": 0.5, "weight": 0.2}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("017", 17), ("-08", -8), ("1_000", 1000), ("0x1F", 31), ("0", 0), ("1:30", "1:30"), ("1:30.5", "1:30.5"),
        ("0b11", "0b11"), ("1e5", 1e5), ("-2.5E-3", -2.5e-3), (".5", 0.5), ("3.", 3.0), (".inf", float("inf")),
    ],
)  # fmt: skip
def test_numbers_are_those_of_yaml_1_2(text, value):
    read = parse_assignments([f"key={text}"])["key"]
    assert read == value and type(read) is type(value)


def test_numpy_and_tuples_are_accepted():
    config = load_config(
        Task, None, {"tone": np.float32(0.5), "span": np.array([0.1, 0.2]), "num_substeps": np.int64(9)}
    )
    assert config.control.tone == 0.5 and config.span == (0.1, 0.2) and config.physics.num_substeps == 9


def test_printed_and_read_back_is_the_same(tmp_path):
    overrides = {"tone": 0.2, "shape.parameters": {"age": 0.25}, "span": [0.5, 0.6], "density": 985.123456789}
    config = load_config(Task, None, overrides)
    path = tmp_path / "resolved.yaml"
    path.write_text(dump_yaml(config))
    assert load_config(Task, path) == config
    assert set(yaml.safe_load(path.read_text())) == set(Task.model_fields)


def test_configurations_are_frozen_hashable_and_copied():
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
    twice = {name for name in bare if bare.count(name) > 1}
    assert twice <= set(EnvConfig.bare_names), "a bare name would be ambiguous as a keyword of gym.make"


def test_bare_names_of_several_sections_are_those_of_pictures():
    config = load_config(EnvConfig, None, {"width": 32, "camera": "head", "obs_mode": "pixels"})
    assert config.render.width == 32 and config.pixels.width == 64 and config.pixels.camera.kind == "head"


class Above(EnvConfig):
    """A task that is seen from above by default."""

    obs_mode: Literal["flat", "pixels"] = Field("pixels", description="what is observed")
    pixels: PixelsConfig = Field(
        default_factory=lambda: PixelsConfig(camera=PlacedCamera(position=(0.0, -0.1, 5.0))), description="pictures"
    )


def test_another_camera_replaces_all_of_the_one_before():
    assert load_config(Above, None, {"pixels.width": 32}).pixels.camera.position == (0.0, -0.1, 5.0)
    placed = {"kind": "placed", "position": [0, 0, 3]}
    for config in (load_config(Above, None, {"camera": "head"}), replace(load_config(Above), camera="head")):
        assert config.pixels.camera.kind == "head"
    above = {"obs_mode": "pixels", "pixels": {"camera": placed}}
    assert replace(load_config(EnvConfig, above), camera="task").pixels == PixelsConfig()


class Held(EnvConfig):
    """A task with torque control by default, and a default of its own in that mode."""

    control: ControlConfig = Field(
        default_factory=lambda: TorqueControlConfig(root_assist=0.4), description="how actions move the body"
    )


class Quick(EnvConfig):
    """A task with pose control by default, and a default of its own in that mode."""

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
    held = load_config(Held, None, {"strength": 0.5})
    assert held.control == TorqueControlConfig(root_assist=0.4, strength=0.5)
    assert replace(held, {"control.strength": 0.25}).control == held.control.model_copy(update={"strength": 0.25})
    assert load_config(Held, None, {"control": "torque"}).control.root_assist == 0.4
    assert load_config(Quick, None, {"tone": 0.5}).control == PoseControlConfig(joint_speed_limit=7.0, tone=0.5)


def test_another_mode_begins_with_its_defaults():
    quick = load_config(Quick, None, {"tone": 0.5})
    under_torques = replace(quick, control="pd", strength=2.0)
    assert under_torques.control == TorqueControlConfig(strength=2.0)
    assert replace(under_torques, control="torque").control == TorqueControlConfig(mode="torque", strength=2.0)
    assert replace(under_torques, control="pose").control == PoseControlConfig(joint_speed_limit=7.0)
    assert load_config(Held, None, {"control": "pose"}).control == PoseControlConfig()


@pytest.mark.parametrize(
    ("mode", "joints"),
    [("pose", {"tone": 0.1}), ("pd", {"joint_stiffness": 0.3}), ("torque", {"joint_stiffness": 0.3})],
)
def test_a_preset_softens_body_and_joints_in_any_mode(mode, joints):
    """Set what the mode of control has, whichever of preset and mode comes from a file and which from a keyword."""
    for source, overrides in (({"preset": "soft"}, {"control": mode}), ({"control": mode}, {"preset": "soft"})):
        config = load_config(Task, source, overrides)
        assert config.physics.young_modulus == 2.0e4
        assert joints.items() <= config.control.model_dump().items()


def test_settings_win_over_a_preset_and_a_later_preset_over_settings():
    soft = load_config(Task, {"preset": "soft", "tone": 0.5})
    assert (soft.physics.young_modulus, soft.control.tone) == (2.0e4, 0.5)
    assert load_config(Task, yaml.safe_load(dump_yaml(soft))) == soft
    stiffer = replace(soft, young_modulus=5.0e4)
    assert (stiffer.physics.young_modulus, stiffer.control.tone) == (5.0e4, 0.5)
    firm = replace(stiffer, preset="firm")
    assert (firm.physics, firm.control) == (Task().physics, Task().control)
