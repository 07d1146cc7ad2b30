"""Refused settings: the error names key, value and limit, within lists and files too."""

from __future__ import annotations

import importlib.util
from itertools import pairwise
from typing import Annotated, Literal, get_args, get_origin

import pytest
from pydantic import BaseModel, Field

from piavatar_envs.config import ConfigError, ControlConfig, EnvConfig, TorqueControlConfig, load_config
from piavatar_envs.config.errors import entry_of, models_of
from piavatar_envs.multi import listed_games, load_game
from piavatar_envs.tasks import load_task, task_modules


class Task(EnvConfig):
    """A task's configuration."""

    target_radius: float = Field(0.1, gt=0.0, le=1.0, description="radius of the target [m]")


class Held(EnvConfig):
    """A task with torque control by default."""

    control: ControlConfig = Field(default_factory=TorqueControlConfig, description="how actions move the body")


def refusal(source=None, overrides=None, cls=Task) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(cls, source, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def avatar(**settings) -> dict:
    return {"scene": {"avatars": [settings]}}


def prop(**settings) -> dict:
    return {"scene": {"props": [{"name": "a", **settings}]}}


@pytest.mark.parametrize(
    ("overrides", "key", "words"),
    [
        ({"control.tone": 1.5}, "control.tone=1.5", "<= 1"),
        ({"physics.control_dt": 0}, "physics.control_dt=0", ">= 0.0001 [s]"),
        ({"physics.poisson_ratio": 0.5}, "physics.poisson_ratio=0.5", "< 0.5"),
        ({"fidelity": "ultra"}, "physics.fidelity='ultra'", "'tiny', 'coarse', 'medium' or 'fine'"),
        ({"young_modulus": "100000"}, "physics.young_modulus='100000'", "a number [Pa]"),
        ({"tone": True}, "control.tone=True", "a number"),
        ({"tone": object()}, "control.tone=", "a number"),
        ({"num_substeps": 1.5}, "physics.num_substeps=1.5", "a whole number"),
        ({"free_motion": 1}, "control.free_motion=1", "true or false"),
        ({"tone": float("nan")}, "control.tone=nan", "a finite number"),
        ({"density": float("inf")}, "physics.density=inf", "a finite number [kg/m^3]"),
        ({"shape.parameters.age": 2}, "shape.parameters.age=2", "<= 1"),
        ({"physics": 3}, "physics=3", "a section"),
        ({"target_radius": 2.0}, "target_radius=2.0", "<= 1 [m]"),
        ({"width": 8}, "render.width=8", ">= 16 [pixel]"),
        ({"pixels": {"width": 4}}, "pixels.width=4", ">= 8 [pixel]"),
        ({"camera": "nose"}, "pixels.camera.kind='nose'", "'task', 'head', 'left_hand', 'right_hand', 'placed'"),
        ({"pixels.camera.target": [0, 0, 1]}, "pixels.camera.target=[0, 0, 1]", "pixels.camera.kind='placed'"),
        ({"camera": {"kind": "placed", "position": [0, 0, 1], "target": [0, 0, 1]}}, "pixels.camera.", "move it"),
        ({"farthest": 0}, "pixels.farthest=0", "> 0 [m]"),
        ({"depth": True}, "pixels.depth has no effect under obs_mode='flat'", "'pixels+state', or leave it out"),
        ({"camera": "head", "pixels.width": 32, "obs_mode": "dict"}, "pixels.width, pixels.camera have", "'dict'"),
        ({"control.ton": 1}, "control.ton ", "control.tone?"),
        ({"control.young_modulus": 1}, "control.young_modulus ", "physics.young_modulus?"),
        ({"physcs": {"fidelity": "tiny"}}, "physcs ", "physics?"),
        ({"physics.qqqq": 1}, "physics.qqqq ", "physics.fidelity, "),
        ({"target_radius.x": 1}, "target_radius={'x': 1}", "a number [m]"),
        ({"control": {"tone": 0.1}, "tone": 0.2}, "control.tone", "given twice"),
        ({"control": "push"}, "control.mode='push'", "'pose', 'pd', 'torque'"),
        ({"control": ["pd"]}, "control.mode=['pd']", "'pose', 'pd', 'torque'"),
        ({"garments": [{}]}, "garments.0.kind ", "is missing"),
        ({"garments": [{"kind": "kilt"}]}, "garments.0.kind='kilt'", "use one of cape, dress"),
        ({"garments": [{"kind": "skirt", "fabric": "tin"}]}, "garments.0.fabric='tin'", "use one of cotton"),
        ({"garments": [{"kind": "skirt", "flare": 3.0}]}, "garments.0.flare=3.0", "less than or equal to 1 [-]"),
        ({"garments": [{"kind": "skirt", "sleeve": 1}]}, "garments.0.sleeve=1 ", "it has length, flare"),
        ({"garments": [{"kind": "skirt", "color": [2, 0, 0]}]}, "garments.0.color.0=2", "<= 1"),
        ({"garments": [{"kind": "skirt", "stretch": 0}]}, "garments.0.stretch=0", ">= 1 [N/m]"),
        ({"garments": {"kind": "skirt"}}, "garments={'kind': 'skirt'}", "a list"),
        (avatar(garments=[{"kind": "mesh"}]), "scene.avatars.0.garments.0.path ", "is missing"),
        ({"cloth": {"sweeps": 0}}, "cloth.sweeps=0", ">= 1"),
        ({"num_envs": 4}, "num_envs ", "gym.make_vec"),
        ({"seed": 3}, "seed ", "reset(seed=...)"),
        ({"scene": {"seed": 3}}, "scene.seed ", "scene."),
        (avatar(positon=[0, 0]), "scene.avatars.0.positon ", "position"),
        (avatar(qqq=0), "scene.avatars.0.qqq ", "position, yaw, "),
        (avatar(yaw="left"), "scene.avatars.0.yaw='left'", "a number [rad]"),
        (avatar(control={"tone": 2, "alpha": 3}), "scene.avatars.0.control.tone=2", "scene.avatars.0.control.alpha=3"),
        (avatar(**{"control.tone": 2}), "scene.avatars.0.control.tone=2", "<= 1"),
        (avatar(physics={"fidelity": "fine"}), "scene.avatars.0.physics.fidelity ", "cannot differ"),
        (avatar(shape={"scal": 1}), "scene.avatars.0.shape.scal ", "scale"),
        (avatar(regions=[{"joints": ["tail"]}]), "scene.avatars.0.regions.0.joints.0='tail'", "unknown"),
        ({"scene": {"colliders": [{"name": "a", "sise": 1}]}}, "scene.colliders.0.sise ", "size"),
        ({"scene": {"colliders": [None]}}, "scene.colliders.0=None", "a section"),
        (prop(position=[0, 0, 0, 0]), "scene.props.0.position=[0, 0, 0, 0]", "at most 3"),
        (prop(name=""), "scene.props.0.name=''", "at least 1 character"),
        (prop(size=[-1]), "scene.props.0.size.0=-1", "> 0 [m]"),
        (prop(damping_ratio=-0.1), "scene.props.0.damping_ratio=-0.1", ">= 0"),
        ({"physics": {"viscosity": -1.0}}, "physics.viscosity=-1.0", ">= 0 [Pa s]"),
        (prop(rotation=[1e-9, 0, 0, 0]), "scene.props.0.rotation", "not zero"),
    ],
)
def test_a_refusal_names_key_value_and_limit(overrides, key, words):
    message = refusal(None, overrides)
    assert message.startswith(key) and words in message, message


@pytest.mark.parametrize(
    ("cls", "overrides", "key", "mode"),
    [
        (Task, {"root_assist": 0.5}, "control.root_assist=0.5", "'pd' or 'torque'"),
        (Task, {"control": "pd", "tone": 0.5}, "control.tone=0.5", "'pose'"),
        (Task, {"control": {"mode": "torque", "alpha": 0.1}}, "control.alpha=0.1", "'pose'"),
        (Held, {"tone": 1.0}, "control.tone=1.0", "'pose'"),
        (Held, {"scene": {"avatars": [{}, {"control": {"tone": 0}}]}}, "scene.avatars.1.control.tone=0", "'pose'"),
        (Task, avatar(**{"control.strength": 2}), "scene.avatars.0.control.strength=2", "'pd' or"),
    ],
)
def test_a_setting_of_another_mode_is_refused_with_its_mode(cls, overrides, key, mode):
    assert refusal(None, overrides, cls).startswith(f"{key} belongs to control.mode={mode}")


@pytest.mark.parametrize("given", [[1], 0, False, (), b"a.yaml", EnvConfig])
def test_a_source_of_another_type_is_refused(given):
    for message in (refusal(given), refusal(None, given)):
        assert f"={given!r} is of type {type(given).__name__}" in message


def test_an_ambiguous_name_is_refused():
    class Left(BaseModel):
        same: int = 0

    class Two(BaseModel):
        left: Left = Left()
        right: Left = Left()

    message = refusal(None, {"same": 1}, Two)
    assert message.startswith("same ") and "left.same or right.same" in message


def aliases(first: str, more: str) -> str:
    """Return YAML of a few lines, each of which has the one before nine times."""
    names = "abcdefghi"
    lines = [f"{new}: &{new} {more.format(9 * f'*{old}, ')}" for old, new in pairwise(names)]
    return "\n".join([f"a: &a {first}", *lines])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("control: &d {tone: 0.3, more: *d}", "holds itself"),
        ("physics: [1,\n", "bad.yaml is not YAML"),
        ("physics: " + 3000 * "[", "bad.yaml is not YAML: "),
        ("physics: \udcff", "bad.yaml is not YAML"),
        ("physics: \0", "bad.yaml is not YAML"),
        (aliases("[1]", "[{}]"), "once aliases are expanded"),
        (aliases("{x: 1}", "{{<<: [{}]}}"), "once aliases are expanded"),
        ("control: !!python/object/apply:os.getcwd []\n", "bad.yaml is not YAML"),
        ("- a\n- b\n", "a list"),
        ("control:\n  tone: 0.1\n  tone: 0.2\n", "'tone' is given twice"),
        ("control:\n  tone: 2020-01-01\n", "control.tone=datetime.date(2020, 1, 1)"),
        ("shape:\n  parameters: {1: 0.5}\n", "shape.parameters.1"),
        ("control.: 1\n", "'control.'"),
        (f"density: 1{'0' * 400}\n", "a finite number [kg/m^3]"),
        ("scene:\n  avatars:\n  - yaw: left\n", "bad.yaml: scene.avatars.0.yaw='left'"),
    ],
)
def test_bad_files_are_refused_with_the_place_of_the_fault(tmp_path, text, words):
    path = tmp_path / "bad.yaml"
    path.write_text(text, errors="surrogateescape")
    assert words in refusal(path)


def test_all_errors_come_in_one_line_with_their_source(tmp_path):
    assert "none.yaml" in refusal(tmp_path / "none.yaml")
    path = tmp_path / "bad.yaml"
    path.write_text("physics:\n  density: -1\nobs_mode: both\n")
    faults = refusal(path, {"tone": 7}).split("; ")
    assert any(fault.startswith(f"{path}: physics.density=-1 ") for fault in faults)
    assert any(fault.startswith(f"{path}: obs_mode='both' ") for fault in faults)
    assert any(fault.startswith("control.tone=7 ") for fault in faults)  # of a keyword


def configs() -> list[type[EnvConfig]]:
    """Return the configurations of all tasks and games."""
    found = [load_task(env_id).Config for env_id in task_modules()]
    if importlib.util.find_spec("pettingzoo"):
        found += [load_game(name).TASK.Config for name in listed_games()]
    return found


def test_every_number_has_an_upper_limit():
    """Values beyond are overflows, not physics; lengths of lists and counts are limited by the code that uses them."""

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
