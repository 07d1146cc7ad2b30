"""The registry of motions: embedded clips, installed DeepMimic clips, AMASS files by path.

A new embedded clip is one new file in ``clips/`` with a ``build(rest_joints) -> Motion``; nothing lists it.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import TYPE_CHECKING

from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import amass, clips, deepmimic
from piavatar_envs.avatar.motion.hands import lay_hands_on_ground
from piavatar_envs.avatar.motion.motion import Motion

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.asset import AvatarAsset, ShapedBody

DEEPMIMIC_PREFIX = "deepmimic:"
GROUND_WINDOW = 0.8  # [s] longer than any flight in DeepMimic's clips, whose skeleton stands otherwise than ours


def list_embedded() -> tuple[str, ...]:
    """Names of the clips that are always there."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(clips.__path__)))


def list_motions() -> tuple[str, ...]:
    """Every name :func:`load_motion` takes: the embedded clips and, if installed, ``"deepmimic:..."``."""
    return list_embedded() + tuple(DEEPMIMIC_PREFIX + name for name in deepmimic.list_clips())


def load_motion(name_or_path: str | Path, asset: AvatarAsset | None = None, body: ShapedBody | None = None) -> Motion:
    """A motion by name or path, for a body, standing on the ground.

    Args:
        name_or_path: an embedded clip (``"squat"``), a DeepMimic clip (``"deepmimic:walk"``) or the path of an AMASS
            ``.npz`` file.
        asset: the avatar that shall move; without it the embedded body.
        body: one of its shapes; without it the mean shape. Legs of another length scale the root's path.

    Raises:
        ImportError: a DeepMimic clip without the extra ``motions``.
        ValueError: the name is unknown, or a file is not a motion.
        FileNotFoundError: there is no such file.
    """
    asset = load_asset() if asset is None else asset
    joints = (asset if body is None else body).joints
    name = str(name_or_path)
    if name in list_embedded():
        motion = importlib.import_module(f"{clips.__name__}.{name}").build(joints)
    elif name.startswith(DEEPMIMIC_PREFIX):
        motion = deepmimic.load_installed(name.removeprefix(DEEPMIMIC_PREFIX), joints)
        return lay_hands_on_ground(motion, asset, body, GROUND_WINDOW).on_ground(asset, body, window=GROUND_WINDOW)
    elif isinstance(name_or_path, Path) or Path(name).suffix or "/" in name:
        motion = amass.load_file(name, joints)
    else:
        raise ValueError(
            f"unknown motion {name!r}; known are {', '.join(list_motions())}, or the path of an AMASS .npz file"
        )
    return motion.on_ground(asset, body)
