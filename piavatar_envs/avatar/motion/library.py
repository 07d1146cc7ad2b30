"""The registry of motions: embedded clips, registered ones, installed DeepMimic clips, AMASS files by path.

A new embedded clip is one new file in ``clips/`` with a ``build(rest_joints) -> Motion``; :func:`register_motion` adds
one from elsewhere.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import amass, clips, deepmimic
from piavatar_envs.avatar.motion.deepmimic import lay_hands_on_ground
from piavatar_envs.avatar.motion.motion import Motion

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.asset import AvatarAsset, ShapedBody

DEEPMIMIC_PREFIX = "deepmimic:"
GROUND_WINDOW = 0.8  # [s] longer than any flight in DeepMimic's clips, whose skeleton stands otherwise than ours


#: Builds a motion for a body from its joint positions in the rest pose ``(22, 3)`` [m].
Builder = Callable[[np.ndarray], Motion]

_registered: dict[str, Builder] = {}


def list_embedded() -> tuple[str, ...]:
    """Return the names of the clips of this package."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(clips.__path__)))


def list_motions() -> tuple[str, ...]:
    """Return every name that :func:`load_motion` takes: embedded clips, registered and installed ones."""
    installed = (DEEPMIMIC_PREFIX + name for name in deepmimic.list_clips())
    return (*list_embedded(), *sorted(_registered), *installed)


def register_motion(name: str, build: Builder) -> None:
    """Make a motion of your own available by name, in this process.

    Args:
        name: the name, without a slash, colon or dot. Registering it again replaces it.
        build: returns the motion for joint positions in the rest pose ``(22, 3)`` [m].

    Raises:
        TypeError: the builder is not callable.
        ValueError: an embedded clip has the name, or it reads like a path or an installed clip.
    """
    if not callable(build):
        raise TypeError(f"build of {name!r} is a {type(build).__name__}; pass a function that returns a Motion")
    if name in list_embedded() or set(name) & set("/:."):
        raise ValueError(f"motion {name!r} is an embedded clip, or has a slash, colon or dot; use another name")
    _registered[name] = build


def load_motion(name_or_path: str | Path, asset: AvatarAsset | None = None, body: ShapedBody | None = None) -> Motion:
    """Return a motion by name or path, for a body, standing on the ground.

    Args:
        name_or_path: an embedded clip (``"squat"``), a registered one, a DeepMimic clip
            (``"deepmimic:walk"``) or the path of an AMASS ``.npz`` file.
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
    elif name in _registered:
        motion = _registered[name](joints)
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
