"""Pictures of the supplement's acts, in ``results/figures``: ``python -m benchmarks.paper.supplement_figures``."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from benchmarks.paper import acts
from benchmarks.paper.stage import Act, perform
from benchmarks.paper.supplement import write_meshes

FOLDER = Path(__file__).resolve().parent / "results" / "figures"
PANEL = 300  # [px]
FILM, FILM_RATE = 300, 15  # [px] and pictures a second
STEP = 4  # between the brightnesses of a PNG, of 256: half the size, without a visible difference


@dataclass(frozen=True)
class Options:
    """Options of the figures."""

    #: where to write
    folder: Path = FOLDER
    #: figures by name; all if none is given
    only: tuple[str, ...] = ()
    #: resolution of bodies and grid
    fidelity: Literal["tiny", "coarse", "medium", "fine"] = "coarse"
    device: str = "cpu"
    #: without the films
    still: bool = False


@dataclass(frozen=True)
class Figure:
    """Figure with a row of pictures for each act; the acts of a film are placed side by side.

    Attributes:
        acts: what is played.
        titles: of the acts.
        film: seconds of a film, 0 for none; filmed: which of the acts are in it.
    """

    acts: Sequence[Act]
    titles: Sequence[str]
    film: float = 0.0
    filmed: Sequence[int] = (0,)


def figures(folder: Path) -> dict[str, Figure]:
    """Return all figures by file name; mesh files are written into ``folder``."""
    torus, can = write_meshes(folder)
    kicks, throws, hits = acts.kicks(), acts.throws(), acts.head_hits()
    dents, legs, pillows, cans, drops = (
        acts.belly_dents(),
        acts.crossed_legs(),
        acts.pillows(),
        acts.cans(can),
        acts.drops(),
    )
    return {
        "kick_mass": Figure(kicks[1:], ("0.5 kg", "1.5 kg", "8 kg"), 1.1, (0, 2)),
        "ball_stiffness": Figure(throws[:3] + throws[4:], ("1 kPa", "10 kPa", "100 kPa", "10 MPa")),
        "resistance": Figure([hits[0], hits[2]], ("tone 1", "tone 0"), 1.2, (0, 1)),
        "several_objects": Figure([acts.crowd(torus)], ("",), 1.0),
        "shape_preservation": Figure([dents[0], dents[2]], ("alpha 0", "alpha 1")),
        "limb_fields": Figure(legs[:2], ("limb fields", "one field")),
        "pillow": Figure([pillows[0], pillows[2], pillows[3]], ("1 kPa", "5 kPa", "100 kPa")),
        "regions": Figure(cans, ("head", "head, hair", "belly", "belly, garment", "ankle", "ankle, stiff")),
        "jiggle": Figure([drops[0], drops[2]], ("firm", "soft_tissue 0.8, 5 kPa")),
    }


def draw(figure: Figure, path: Path, fidelity: str, device: str) -> None:
    """Draw a PNG: acts in rows, moments in columns; more than four acts in two columns."""
    from PIL import Image

    from piavatar_envs.render import label

    rows = []
    for act, title in zip(figure.acts, figure.titles, strict=True):
        frames = perform(act, fidelity, device, steps=_steps(act, max(act.view.moments)), size=PANEL).frames
        times = [f"{title}{', ' if title else ''}{moment:.2f} s" for moment in act.view.moments]
        rows.append(np.concatenate([label(f, t) for f, t in zip(frames, times, strict=True)], axis=1))
    if len(rows) > 4:
        rows = [np.concatenate(rows[index : index + 2], axis=1) for index in range(0, len(rows), 2)]
    pixels = np.concatenate(rows) // STEP * STEP + STEP // 2
    Image.fromarray(pixels.astype(np.uint8)).save(path, optimize=True)


def film(figure: Figure, path: Path, fidelity: str, device: str) -> None:
    """Write a GIF: acts side by side."""
    from piavatar_envs.render import label, write_video

    moments = tuple(np.arange(0.0, figure.film, 1.0 / FILM_RATE))
    strips = []
    for index in figure.filmed:
        act = figure.acts[index]
        act = replace(act, view=replace(act.view, moments=moments))
        frames = perform(act, fidelity, device, steps=_steps(act, figure.film), size=FILM).frames
        title = figure.titles[index]
        strips.append([label(frame, title) if title else frame for frame in frames])
    write_video(path, (np.concatenate(frames, axis=1) for frames in zip(*strips, strict=True)), FILM_RATE)


def _steps(act: Act, seconds: float) -> int:
    """Return the control steps until a moment."""
    return max(1, round(30.0 * min(seconds, act.seconds)))


def main(options: Options) -> list[Path]:
    """Draw the figures and return their files.

    Raises:
        ValueError: there is no figure of such a name.
    """
    options.folder.mkdir(parents=True, exist_ok=True)
    written = []
    with tempfile.TemporaryDirectory() as folder:
        found = figures(Path(folder))
        unknown = [name for name in options.only if name not in found]
        if unknown:
            raise ValueError(f"there is no figure {unknown[0]!r}; there are {', '.join(found)}")
        for name in options.only or found:
            written.append(options.folder / f"{name}.png")
            draw(found[name], written[-1], options.fidelity, options.device)
            if found[name].film and not options.still:
                written.append(options.folder / f"{name}.gif")
                film(found[name], written[-1], options.fidelity, options.device)
            print(f"{written[-1]}: {written[-1].stat().st_size / 1e3:.0f} kB", flush=True)
    return written


if __name__ == "__main__":
    main(tyro.cli(Options, prog="python -m benchmarks.paper.supplement_figures"))
