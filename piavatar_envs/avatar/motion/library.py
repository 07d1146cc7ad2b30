"""The registry of motions: embedded clips, registered ones, installed DeepMimic clips, files and folders by path.

A new embedded clip is one new file in ``clips/`` with a ``build(rest_joints) -> Motion``; :func:`register_motion` adds
one from elsewhere.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import amass, clips, deepmimic
from piavatar_envs.avatar.motion.bvh import read_bvh
from piavatar_envs.avatar.motion.deepmimic import lay_hands_on_ground
from piavatar_envs.avatar.motion.motion import Motion
from piavatar_envs.avatar.motion.recording import to_motion
from piavatar_envs.core.reading import naming, reading

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.asset import AvatarAsset, ShapedBody

DEEPMIMIC_PREFIX = "deepmimic:"
RATES = 5.0, 1000.0  # [1/s] of motion capture
ROOT_SPEED = 20.0  # [m/s] of a pelvis, beyond sprinters and falls
JOINT_SPEED = 25.0  # [rad/s] of a joint, about that of a punch
GROUND_WINDOW = 0.8  # [s] longer than most flights; other skeletons stand otherwise than ours, so contact drifts
GLTF_SUFFIXES = (".glb", ".gltf", ".vrm", ".vrma")
#: Endings of files that may be motions.
SUFFIXES = (".bvh", ".npz", ".txt", *GLTF_SUFFIXES)
_ANIMATION = re.compile(r"(.+?\.(?:glb|gltf|vrma?))#(.+)", re.IGNORECASE)
FILES = "an AMASS .npz, a .bvh, a .glb, .gltf, .vrm or .vrma with animations, or a DeepMimic .txt file"


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


def load_motion(
    name_or_path: str | Path,
    asset: AvatarAsset | None = None,
    body: ShapedBody | None = None,
    *,
    mapping: Mapping[str, str] | None = None,
    loop: bool = False,
) -> Motion:
    """Return a motion by name or path, for a body, standing on the ground.

    A joint that turns faster than 25 rad/s is warned of: the capture has glitches, or a wrong frame rate.

    Args:
        name_or_path: an embedded clip (``"squat"``), a registered one, a DeepMimic clip (``"deepmimic:walk"``), or the
            path of a file: AMASS ``.npz``, ``.bvh``, ``.glb``, ``.gltf``, ``.vrm`` or ``.vrma`` (one of several
            animations by ``"hero.glb#Run"``), DeepMimic ``.txt``.
        asset: the avatar that shall move; without it the embedded body.
        body: one of its shapes; without it the mean shape. Legs of another length scale the root's path.
        mapping: names of a skeleton's nodes by joint, for BVH and glTF files whose names say too little.
        loop: close a clip whose end nearly meets its start (:meth:`Motion.meets_itself`); others are left as they are.

    Raises:
        ImportError: a DeepMimic clip without the extra ``motions``.
        ValueError: the name is unknown, or a file is not a motion, or one that no human makes.
        FileNotFoundError: there is no such file.
    """
    asset = load_asset() if asset is None else asset
    joints = (asset if body is None else body).joints
    name = str(name_or_path)
    window = None
    if name in list_embedded():
        motion = importlib.import_module(f"{clips.__name__}.{name}").build(joints)
    elif name in _registered:
        motion = _registered[name](joints)
    elif name.startswith(DEEPMIMIC_PREFIX):
        motion, window = deepmimic.load_installed(name.removeprefix(DEEPMIMIC_PREFIX), joints), GROUND_WINDOW
    elif isinstance(name_or_path, Path) or Path(name).suffix or "/" in name:
        with naming(name):
            motion, window = _load_file(Path(name), joints, mapping)
    elif Path(name).is_dir():
        raise ValueError(f"unknown motion {name!r}; for the folder of that name write './{name}'")
    else:
        raise ValueError(f"unknown motion {name!r}; known are {', '.join(list_motions())}, or the path of {FILES}")
    if name not in list_embedded():
        _warn_of_speed(name, motion)
    if window is not None and motion.source.startswith("DeepMimic"):
        motion = lay_hands_on_ground(motion, asset, body, GROUND_WINDOW)
    motion = motion.on_ground(asset, body, window=window)
    return motion.closed() if loop and not motion.loop and motion.meets_itself() else motion


def clips_of(path: Path) -> list[str]:
    """Return what is added to the path of a file to name each of its clips: nothing where it has one, or has none."""
    if path.suffix.lower() not in GLTF_SUFFIXES:
        return [""]
    # the reader of characters imports this package
    from piavatar_envs.avatar.motion.gltf_animations import names_of_animations

    try:
        names = names_of_animations(path)
    except ValueError:
        return [""]  # refused when it is loaded
    return [f"#{name}" for name in names] if len(names) > 1 else [""]


def _load_file(path: Path, joints: np.ndarray, mapping: Mapping[str, str] | None) -> tuple[Motion, float | None]:
    """Return the motion of a file by its suffix, and the window of its ground level [s]."""
    file, clip = path, None
    found = _ANIMATION.fullmatch(str(path))
    if found and not path.is_file():
        file, clip = Path(found[1]), found[2]
    suffix = file.suffix.lower()
    if suffix == ".txt":
        motion = deepmimic.load_file(path, joints)
    elif suffix == ".bvh":
        motion = to_motion(read_bvh(path), joints, mapping)
    elif suffix in GLTF_SUFFIXES:
        from piavatar_envs.avatar.motion.gltf_animations import read_animation  # which imports this package

        motion = to_motion(read_animation(file, clip, mapping), joints)
    elif suffix not in SUFFIXES and path.exists():
        from piavatar_envs.avatar.gltf import check_format  # which imports this package

        with reading(path, "a motion"):
            check_format(path)
        kind = "a folder, of which TrackMotion draws motions" if path.is_dir() else "no motion by its suffix"
        raise ValueError(f"{path} is {kind}; give the path of {FILES}")
    elif suffix not in SUFFIXES:
        raise FileNotFoundError(f"no motion file or folder {path}")
    else:
        return _checked(str(path), amass.load_file(path, joints)), None
    return _checked(str(path), motion), GROUND_WINDOW


def _checked(path: str, motion: Motion) -> Motion:
    """Return the motion of a file, if a human could make it.

    Raises:
        ValueError: its rate or the speed of its root is out of range; names the likely cause.
    """
    if not RATES[0] <= motion.fps <= RATES[1]:
        cause = f"it may be the time between frames [s], of {1.0 / motion.fps:g} frames per second"
        raise ValueError(f"{path}: {motion.fps:g} frames per second must be in [{RATES[0]:g}, {RATES[1]:g}]; {cause}")
    steps = motion.fps * np.linalg.norm(np.diff(motion.root_position, axis=0), axis=1)
    if steps.max() > ROOT_SPEED:
        cause = "its lengths may be in millimetres or centimetres and not in metres, or its frame rate too high"
        raise ValueError(
            f"{path}: the root moves at {steps.max():.3g} m/s in frame {steps.argmax()}, it must be <= {ROOT_SPEED:g}; "
            f"{cause}"
        )
    return motion


def _warn_of_speed(name: str, motion: Motion) -> None:
    """Warn of joints that turn faster than people's."""
    turns = motion.joint_speeds()
    if turns.max() > JOINT_SPEED:
        frame, joint = np.unravel_index(turns.argmax(), turns.shape)
        warnings.warn(
            f"{name}: {JOINT_NAMES[joint]} turns at {turns.max():.3g} rad/s in frame {frame}, and "
            f"{np.count_nonzero(turns.max(axis=1) > JOINT_SPEED)} of {motion.num_frames} frames are faster than "
            f"{JOINT_SPEED:g}; its capture may have glitches, or its frame rate be wrong",
            stacklevel=3,
        )
