"""Section of a page on the scene: avatars, props and colliders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pydantic import BaseModel

from piavatar_envs.config.schema import SceneConfig
from scripts.pages.markdown import code, page, table
from scripts.pages.settings import literal


def scene_section(scene: SceneConfig, avatars: Sequence[str]) -> str:
    """Return a table of the scene, its avatars by name; nothing for a single avatar at the origin."""
    rows = list(_rows(scene, avatars))
    if not rows:
        return ""
    text = "Settings of `scene` (listed below) that differ from their defaults, or that identify the object."
    return page(["## Scene", text, table(("kind", "name", "settings"), rows)])


def _rows(scene: SceneConfig, avatars: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    if len(avatars) > 1 or any(avatar.model_dump(exclude_defaults=True) for avatar in scene.avatars):
        for name, avatar in zip(avatars, scene.avatars, strict=True):
            yield "avatar", code(name), _settings(avatar, ("position", "yaw"))
    for prop in scene.props:
        yield "soft prop", code(prop.name), _settings(prop, ("shape", "size", "position"))
    for collider in scene.colliders:
        yield "collider", code(collider.name), _settings(collider, ("kind", "size", "position"))


def _settings(thing: BaseModel, always: Sequence[str]) -> str:
    settings = {name: getattr(thing, name) for name in always}
    settings |= {name: value for name, value in thing.model_dump(exclude_defaults=True).items() if name != "name"}
    return ", ".join(f"{name} {code(literal(value))}" for name, value in settings.items())
