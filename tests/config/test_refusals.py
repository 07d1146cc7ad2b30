"""What is no setting is refused by its place, in lists and files too; what is one has limits."""

from __future__ import annotations

import importlib.util
import re
from typing import Annotated, Literal, get_args, get_origin

import pytest

from piavatar_envs.config import ConfigError, EnvConfig, load_config
from piavatar_envs.config.errors import entry_of, models_of
from piavatar_envs.multi import listed_games, load_game
from piavatar_envs.tasks import load_task, task_modules


def refusal(source=None, overrides=None) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(EnvConfig, source, overrides)
    return str(caught.value)


def configs() -> list[type[EnvConfig]]:
    """Of all tasks and games."""
    found = [load_task(env_id).Config for env_id in task_modules()]
    if importlib.util.find_spec("pettingzoo"):
        found += [load_game(name).TASK.Config for name in listed_games()]
    return found


@pytest.mark.parametrize("given", [[1], 0, False, (), 5.0, b"a.yaml", EnvConfig])
def test_what_is_no_settings_is_not_taken_for_none(given):
    for message in (refusal(given), refusal(None, given)):
        assert f"={given!r} is of type {type(given).__name__}; settings are a mapping of names to values" in message


@pytest.mark.parametrize(
    ("scene", "told"),
    [
        ({"avatars": [{"positon": [0, 0]}]}, "avatars.0.positon is no setting of AvatarConfig; did you mean X.positi"),
        ({"avatars": [{}, {"qqq": 0}]}, "avatars.1.qqq is no setting of AvatarConfig; there are position, yaw, "),
        ({"avatars": [{"yaw": "left"}]}, "avatars.0.yaw='left' must be a number [rad]"),
        ({"avatars": [{"control": {"tone": 2, "alpha": 3}}]}, "avatars.0.control.tone=2 must be <= 1; X.control.alp"),
        ({"avatars": [{"control.tone": 2}]}, "avatars.0.control.tone=2 must be <= 1"),
        ({"avatars": [{"physics": {"fidelity": "fine"}}]}, "avatars.0.physics.fidelity cannot differ between avatars"),
        ({"avatars": [{"shape": {"scal": 1}}]}, "avatars.0.shape.scal is no setting of ShapeConfig; did you mean sca"),
        ({"avatars": [{"regions": [{"joints": ["tail"]}]}]}, "avatars.0.regions.0.joints.0='tail' is refused: unknown"),
        ({"colliders": [{"name": "a", "sise": 1}]}, "colliders.0.sise is no setting of ColliderConfig; did you mean X"),
        ({"colliders": [None]}, "colliders.0=None must be a section"),
        ({"props": [{"name": "a", "position": [0, 0, 0, 0]}]}, "props.0.position=[0, 0, 0, 0] must be a list of at mo"),
        ({"props": [{"name": ""}]}, "props.0.name='' must be a string of at least 1 character"),
        ({"props": [{"name": "a", "size": [-1]}]}, "props.0.size.0=-1 must be > 0 [m]"),
        ({"props": [{"name": "a", "rotation": [1e-9, 0, 0, 0]}]}, "must be a quaternion wxyz, not zero"),
        ({"props": [{"name": "a", None: 1}]}, "props.0.None is of type NoneType; the name of a setting is a string"),
        ({"pair_friction": [{"a": "x", "b": "y", "friction": -1}]}, "pair_friction.0.friction=-1 must be >= 0"),
    ],
)  # fmt: skip
def test_refusals_within_lists_say_which_entry(scene, told):
    place = re.match(r"\w+\.\d+", told)
    assert told.replace("X", f"scene.{place[0]}" if place else "") in refusal(None, {"scene": scene})


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"num_envs": 4}, "num_envs is no setting of EnvConfig; use gym.make_vec(..., num_envs=...)"),
        ({"seed": 3}, "seed is no setting of EnvConfig; use reset(seed=...)"),
        ({"scene": {"seed": 3}}, "scene.seed is no setting of EnvConfig; there are scene."),
    ],
)
def test_what_belongs_elsewhere_is_sent_there(given, told):
    assert told in refusal(None, given)


def test_an_entry_of_a_file_is_the_files_fault_and_one_of_a_keyword_is_not(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text("scene:\n  avatars:\n  - yaw: left\n")
    assert refusal(path) == f"{path}: scene.avatars.0.yaw='left' must be a number [rad]"
    assert refusal(path, {"scene": {"avatars": [{"yaw": "right"}]}}).startswith("scene.avatars.0.yaw='right' must")


def test_what_yaml_makes_of_values_is_refused_by_name(tmp_path):
    path = tmp_path / "odd.yaml"
    for text, told in {
        "control:\n  tone: 2020-01-01\n": "control.tone=datetime.date(2020, 1, 1) is of type date; a setting is",
        "shape:\n  parameters: {1: 0.5}\n": "shape.parameters.1 is of type int; the name of a setting is a string",
        "control.: 1\n": "'control.' is no name of a setting",
        f"density: 1{'0' * 400}\n": "0000... must be a finite number [kg/m^3]",
    }.items():
        path.write_text(text)
        assert told in refusal(path)


def test_every_number_has_an_upper_limit():
    """Beyond them are overflows, not physics; lengths of lists and counts are limited where they are used."""

    def numbers(annotation, limits):
        if get_origin(annotation) is Annotated:
            found = [limit for one in get_args(annotation)[1:] for limit in getattr(one, "metadata", [one])]
            return numbers(get_args(annotation)[0], [*limits, *found])
        inner = [one for one in get_args(annotation) if one not in (..., type(None))]
        if get_origin(annotation) is Literal or not inner:
            return [limits] if annotation in (int, float) else []
        return [found for one in inner for found in numbers(one, limits)]

    def walk(cls):
        for name, field in cls.model_fields.items():
            below = entry_of(field.annotation)
            for model in (below,) if below else models_of(field):
                yield from walk(model)
            for limits in numbers(field.annotation, list(field.metadata)):
                bounds = {bound for limit in limits for bound in ("gt", "ge", "lt", "le") if hasattr(limit, bound)}
                if not bounds & {"lt", "le"}:
                    yield f"{cls.__name__}.{name}"

    assert sorted({name for config in (EnvConfig, *configs()) for name in walk(config)}) == []
