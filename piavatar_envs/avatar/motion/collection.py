"""Several motions as one curriculum: their files in folders, a split by name, and their frames one after the other."""

from __future__ import annotations

import hashlib
import importlib
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from piavatar_envs.avatar.motion.library import SUFFIXES, clips_of, load_motion
from piavatar_envs.avatar.motion.motion import Motion
from piavatar_envs.core.result_cache import digest_of, kept

if TYPE_CHECKING:
    from types import ModuleType

    from piavatar_envs.avatar.body.asset import AvatarAsset

Split = Literal["all", "train", "held_out"]
_READERS = "amass bvh collection deepmimic gltf_animations ground library motion recording retarget".split()
_SHOWN = 3  # files that a warning names


@dataclass(frozen=True)
class Entry:
    """A motion by its place.

    Attributes:
        name: by which a split chooses: the path below its folder, which is the same on every machine.
        place: what :func:`~piavatar_envs.avatar.motion.load_motion` takes.
        required: whether it was named by itself, and not found in a folder, where files of other kinds may lie.
    """

    name: str
    place: str
    required: bool = True


def find_motions(names: str | Iterable[str]) -> list[Entry]:
    """Return the motions of names, files and folders; every animation of a glTF file in a folder is one.

    Raises:
        ValueError: a folder has no file with the suffix of a motion.
    """
    entries: list[Entry] = []
    for name in [names] if isinstance(names, str) else names:
        folder = Path(name)
        if not ("/" in name and folder.is_dir()):
            entries.append(Entry(folder.name if "/" in name else name, name))
            continue
        found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
        if not found:
            raise ValueError(f"{name} has no motions: none of its files ends in {', '.join(SUFFIXES)}")
        for path in found:
            below = path.relative_to(folder).as_posix()
            entries += [Entry(f"{below}{clip}", f"{path}{clip}", required=False) for clip in clips_of(path)]
    return entries


def chosen(entries: Sequence[Entry], split: Split, share: float) -> list[Entry]:
    """Return the motions of a part of a split, which depends on their names only.

    Args:
        entries: all motions.
        split: ``"all"``, ``"train"`` or ``"held_out"``.
        share: of motions that are held out, by the hash of their names.

    Raises:
        ValueError: the part is empty.
    """
    if split == "all":
        return list(entries)
    kept = [entry for entry in entries if (place_in_split(entry.name) < share) == (split == "held_out")]
    if not kept:
        raise ValueError(
            f"split={split!r} has none of the {len(entries)} motions with held_out_share={share:g}; change the share, "
            "or give more motions"
        )
    return kept


def place_in_split(name: str) -> float:
    """Return a number in [0, 1) that depends on the name only."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big") / 2.0**64


@dataclass(frozen=True, eq=False)
class Frames:
    """Motions at one rate, one after the other.

    Attributes:
        names: of the motions.
        rotations: local, wxyz, shape ``(F, 22, 4)``.
        roots: pelvis joints [m], shape ``(F, 3)``.
        first: first frame of each motion, and the end, shape ``(M + 1,)``.
        starts: an episode begins in the first so many frames of its motion, shape ``(M,)``.
    """

    names: tuple[str, ...]
    rotations: np.ndarray
    roots: np.ndarray
    first: np.ndarray
    starts: np.ndarray

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how far a root moves on the ground within an episode at most, ``(least, greatest)`` x and y [m]."""
        least, most = [], []
        for begin, end, starts in zip(self.first[:-1], self.first[1:], self.starts, strict=True):
            roots = self.roots[begin:end, :2]
            window = sliding_window_view(roots, len(roots) - starts + 1, axis=0)
            least.append((window.min(axis=-1) - roots[:starts]).min(axis=0))
            most.append((window.max(axis=-1) - roots[:starts]).max(axis=0))
        return np.min(least, axis=0), np.max(most, axis=0)


@dataclass(frozen=True)
class Sampling:
    """Episodes for which motions are sampled.

    Attributes:
        dt: time between frames [s].
        steps: length of an episode.
        random_start: whether it may begin anywhere in a loop, and in a clip that is longer than it.
    """

    dt: float
    steps: int
    random_start: bool


def sample_frames(names: Sequence[str], motions: Sequence[Motion], sampling: Sampling) -> Frames:
    """Sample motions at one rate.

    A loop is sampled for as many rounds as an episode lasts; a clip that does not loop holds its last pose.

    Args:
        names: of the motions.
        motions: at least one.
        sampling: rate, and length and beginning of the episodes.
    """
    dt, steps, random_start = sampling.dt, sampling.steps, sampling.random_start
    parts, starts = [], []
    for motion in motions:
        period = max(1, round(motion.duration / dt))
        if motion.loop:
            starts.append(period if random_start else 1)
            frames = starts[-1] + steps + 2
        else:
            starts.append(max(1, period - steps + 1) if random_start else 1)
            frames = starts[-1] - 1 + min(period, steps) + 2
        parts.append(motion.sample(np.arange(frames) * dt))
    rotations, roots = (np.concatenate([part[place] for part in parts]) for place in (0, 1))
    first = np.cumsum([0, *(len(part[1]) for part in parts)])
    return Frames(tuple(names), rotations, roots, first, np.array(starts))


def load_all(entries: Sequence[Entry], load: Callable[[str], Motion]) -> tuple[list[str], list[Motion]]:
    """Load motions; files of a folder that are none are left out, with a warning.

    Returns:
        Names and motions.

    Raises:
        ValueError: one that was named by itself cannot be read, or none of a folder can.
        FileNotFoundError: a file is gone.
    """
    names: list[str] = []
    motions: list[Motion] = []
    refused: list[str] = []
    for entry in entries:
        try:
            motion = load(entry.place)
        except ValueError as error:
            if entry.required:
                raise
            refused.append(str(error))
            continue
        names.append(entry.name)
        motions.append(motion)
    if refused:
        listed = "; ".join(refused[:_SHOWN]) + ("; ..." if len(refused) > _SHOWN else "")
        if not motions:
            raise ValueError(f"none of {len(refused)} files can be read: {listed}")
        warnings.warn(f"{len(refused)} of {len(entries)} files are left out: {listed}", stacklevel=3)
    return names, motions


def load_frames(
    entries: Sequence[Entry],
    asset: AvatarAsset,
    parameters: np.ndarray,
    mapping: Mapping[str, str] | None,
    loop: bool,
    sampling: Sampling,
) -> Frames:
    """Load motions for a body and sample them; what takes long is kept until a file changes.

    Args:
        entries: places of the motions.
        asset: the avatar that shall move.
        parameters: of its shape.
        mapping: as for :func:`~piavatar_envs.avatar.motion.load_motion`.
        loop: likewise.
        sampling: rate, and length and beginning of the episodes.

    Raises:
        ValueError, FileNotFoundError: see :func:`load_all`.
    """
    body = asset.shape(parameters)

    def compute() -> dict[str, np.ndarray]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            loaded = load_all(entries, lambda place: load_motion(place, asset, body, mapping=mapping, loop=loop))
        texts = [str(warning.message) for warning in caught]
        return {**vars(sample_frames(*loaded, sampling)), "warned": np.array(texts, dtype=str)}

    files = [_file_of(entry.place) for entry in entries]
    if None in files:
        arrays = compute()  # a clip by name may be registered anew, a .gltf has files beside it
    else:
        contents = [hashlib.blake2b(file.read_bytes()).hexdigest() for file in files]
        skin = [body.vertices, body.joints, asset.skin_joints, asset.skin_weights]
        names = sorted((mapping or {}).items())
        digest = digest_of([list(entries), contents, skin, names, loop, sampling], _code())
        arrays = kept("motions", digest, compute, f"reading {len(entries)} motions")
    for text in arrays.pop("warned").tolist():
        warnings.warn(text, stacklevel=3)
    return Frames(**{**arrays, "names": tuple(np.asarray(arrays["names"]).tolist())})


def _file_of(place: str) -> Path | None:
    """Return the file that a motion, or the animation of a file, is in; None if it is in none, or in several."""
    paths = (Path(text) for text in (place, place.rpartition("#")[0]) if text)
    return next((path for path in paths if path.is_file() and path.suffix.lower() != ".gltf"), None)


def _code() -> list[ModuleType]:
    """Return the modules that read and retarget motions."""
    names = ("gltf", "gltf_surfaces", "body.rigs", "body.skeleton", *(f"motion.{name}" for name in _READERS))
    return [importlib.import_module(f"piavatar_envs.avatar.{name}") for name in names]
