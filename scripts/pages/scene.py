"""What is in the world of an environment besides the ground: avatars, props and colliders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pydantic import BaseModel

from piavatar_envs.config.schema import SceneConfig
from scripts.pages.markdown import code, page, table
from scripts.pages.settings import literal


def scene_section(scene: SceneConfig, avatars: Sequence[str]) -> str:
    """A table of the scene, its avatars by name; nothing where one avatar stands at the origin, alone."""
    rows = list(_rows(scene, avatars))
    if not rows:
        return ""
    text = (
        "Of the settings that `scene` has for each kind (see below), those that are not the default, or say what it is."
    )
    return page(["## Scene", text, table(("kind", "name", "settings"), rows)])


def _rows(scene: SceneConfig, avatars: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    if len(avatars) > 1 or any(avatar.model_dump(exclude_defaults=True) for avatar in scene.avatars):
        for name, avatar in zip(avatars, scene.avatars, strict=True):
            yield "avatar", code(name), _told(avatar, ("position", "yaw"))
    for prop in scene.props:
        yield "soft prop", code(prop.name), _told(prop, ("shape", "size", "position"))
    for collider in scene.colliders:
        yield "collider", code(collider.name), _told(collider, ("kind", "size", "position"))


def _told(thing: BaseModel, always: Sequence[str]) -> str:
    settings = {name: getattr(thing, name) for name in always}
    settings |= {name: value for name, value in thing.model_dump(exclude_defaults=True).items() if name != "name"}
    return ", ".join(f"{name} {code(literal(value))}" for name, value in settings.items())
