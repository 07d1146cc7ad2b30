"""The paper's figures, played by this suite: ``python -m benchmarks.paper.figures NAME ...`` draws them.

Each is a picture of one or more acts and, as JSON beside it, what was measured in them over time.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from benchmarks.paper import acts, curves
from benchmarks.paper.stage import Act, Course, perform
from benchmarks.paper.supplement import write_meshes

FOLDER = Path(__file__).resolve().parents[1] / "results" / "figures"
PANEL = 300  # [px]
FILM, FILM_RATE = 300, 15  # [px] and pictures a second
STEP = 4  # between the brightnesses of a PNG, of 256: half the size, without a visible difference


@dataclass(frozen=True)
class Options:
    """Options of the figures."""

    #: figures by name; all if none is given
    only: tyro.conf.Positional[tuple[str, ...]] = ()
    #: where to write
    folder: Path = FOLDER
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
        shows: the figure of the paper, and what is to be seen.
        measure: what is measured over time, by name with its unit.
        film: seconds of a film, 0 for none; filmed: which of the acts are in it.
    """

    acts: Sequence[Act]
    titles: Sequence[str]
    shows: str
    measure: Callable[[Course], dict[str, np.ndarray]]
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
        "belly_mass": Figure(
            acts.belly_balls(),
            ("0.5 kg", "2 kg", "8 kg"),
            "Fig. 1 and 12: balls of several masses against the belly; the heavier dents it more and folds the body",
            curves.belly,
            0.8,
            (0, 2),
        ),
        "propagation": Figure(
            [acts.blow()],
            ("",),
            "Fig. 7: the deformation gradient spreads from where a ball hits",
            curves.spread,
        ),
        "kick_mass": Figure(
            kicks[1:],
            ("0.5 kg", "1.5 kg", "8 kg"),
            "Supplement: the same kick at balls of several masses; the heavier bends the leg more",
            curves.kick,
            1.1,
            (0, 2),
        ),
        "ball_stiffness": Figure(
            throws[:3] + throws[4:],
            ("1 kPa", "10 kPa", "100 kPa", "10 MPa"),
            "Supplement: soft and stiff objects; the softer is dented more",
            curves.ball,
        ),
        "resistance": Figure(
            [hits[0], hits[2]],
            ("tone 1", "tone 0"),
            "Supplement: resistance of the struck avatar; a limp one recoils farther and stays bent",
            curves.recoil,
            1.2,
            (0, 1),
        ),
        "several_objects": Figure(
            [acts.crowd(torus)], ("",), "Supplement: several objects hit one avatar at once", curves.objects, 1.0
        ),
        "shape_preservation": Figure(
            [dents[0], dents[2]],
            ("alpha 0", "alpha 1"),
            "Supplement: a dent in a limp belly, without and with shape preservation",
            curves.belly,
        ),
        "limb_fields": Figure(
            legs[:2],
            ("limb fields", "one field"),
            "Supplement: legs crossed and opened; without fields of their own they stick together",
            curves.legs,
        ),
        "pillow": Figure(
            [pillows[0], pillows[2], pillows[3]],
            ("1 kPa", "5 kPa", "100 kPa"),
            "Fig. 5: pillows of several stiffnesses at the head",
            curves.ball,
        ),
        "regions": Figure(
            cans,
            ("head", "head, hair", "belly", "belly, garment", "ankle", "ankle, stiff"),
            "Fig. 8: a can against flesh, and against hair, a garment and a boot of materials of their own",
            curves.ball,
        ),
        "jiggle": Figure(
            [drops[0], drops[2]],
            ("firm", "soft"),
            "Fig. 6: a belly on landing, of firm and of soft flesh that lags behind the bones",
            curves.jiggle,
        ),
    }


def draw(figure: Figure, path: Path, fidelity: str, device: str) -> None:
    """Write a PNG: acts in rows, moments in columns, more than four acts in two columns; and a JSON of the curves."""
    from PIL import Image

    from piavatar_envs.render import label

    rows, measured = [], []
    for act, title in zip(figure.acts, figure.titles, strict=True):
        course = perform(act, fidelity, device, size=PANEL)
        frames = course.frames
        found = {"time_s": course.time} | figure.measure(course)
        measured.append({"act": act.name, **act.tags, **{name: _digits(values) for name, values in found.items()}})
        times = [f"{title}{', ' if title else ''}{moment:.2f} s" for moment in act.view.moments]
        rows.append(np.concatenate([label(f, t) for f, t in zip(frames, times, strict=True)], axis=1))
    if len(rows) > 4:
        rows = [np.concatenate(rows[index : index + 2], axis=1) for index in range(0, len(rows), 2)]
    pixels = np.concatenate(rows) // STEP * STEP + STEP // 2
    Image.fromarray(pixels.astype(np.uint8)).save(path, optimize=True)
    text = json.dumps({"shows": figure.shows, "resolution": fidelity, "acts": measured}, indent=1)
    # a curve a line
    path.with_suffix(".json").write_text(re.sub(r"\[[^\[\]{}]*\]", lambda m: " ".join(m[0].split()), text) + "\n")


def _digits(values: np.ndarray) -> list[float]:
    return [float(f"{value:.4g}") for value in np.asarray(values, float).ravel()]


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
            print(f"{found[name].shows}\n{written[-1]}: {written[-1].stat().st_size / 1e3:.0f} kB", flush=True)
    return written


if __name__ == "__main__":
    main(tyro.cli(Options, prog="python -m benchmarks.paper.figures"))
