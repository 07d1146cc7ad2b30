"""The paper's figures, each from one command: ``python -m benchmarks.paper.figures NAME``, or ``list``, or ``all``.

A figure is a PNG, with pictures of acts and a curve beside them, and a JSON file with what was measured.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from agents.files import describe_run, plain, write_json
from benchmarks import runner
from benchmarks.paper import acts, curves, measures
from benchmarks.paper.stage import Act, Course, perform
from benchmarks.paper.supplement import write_meshes

FOLDER = Path(__file__).resolve().parents[1] / "results" / "figures"
PANEL = 400  # width of the curve [px]
FILM, FILM_RATE = 300, 15  # size of a film [px], and pictures per second
TITLE = 27  # height of a title [px]
PALETTE = 256  # of a PNG: a quarter of the size, without a visible difference
COLORS = ("#1b7f79", "#d1495b", "#8d6a9f", "#e0a030", "#3b6fb6", "#555555")

Row = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """Options of the figures."""

    #: name of a figure; list prints all names, and all draws them
    name: Annotated[str, tyro.conf.Positional]
    #: folder to write to
    out: Path = FOLDER
    #: resolution of bodies and grid
    fidelity: Literal["tiny", "coarse", "medium", "fine"] = "coarse"
    #: where to simulate: cpu, cuda, cuda:1, ...
    device: str = "cpu"
    #: control steps of every act; the whole acts if not given
    steps: int | None = None
    #: a film as well, NAME.gif, of figures that have one
    film: bool = False


@dataclass(frozen=True)
class Figure:
    """Acts of a figure, with what is measured of them.

    Attributes:
        caption: what the pictures show, and what the curve is.
        plan: from a folder for mesh files to the acts.
        titles: of the acts.
        measure: numbers of an act.
        curve: draws rows on axes of matplotlib.
        series: curves over time of an act, by name; kept in the rows.
        columns: pictures of an act stand below each other, instead of side by side.
        size: of a picture [px].
        film: seconds of a film, 0 for none; filmed: which of the acts are in it, side by side.
    """

    caption: str
    plan: Callable[[Path], Sequence[Act]]
    titles: Sequence[str]
    measure: Callable[[Course], Row]
    curve: Callable[[Any, Sequence[Row]], None]
    series: Callable[[Course], Mapping[str, np.ndarray]] = lambda _course: {}
    columns: bool = False
    size: int = 200
    film: float = 0.0
    filmed: Sequence[int] = (0,)


def over_time(axes: Any, rows: Sequence[Row], label: str) -> None:
    """Draw every series of every row over time."""
    count = 0
    for row in rows:
        for name, values in row["series"].items():
            color = COLORS[count % len(COLORS)]
            axes.plot(row["time_s"], values, color=color, label=" ".join(filter(None, (row["title"], name))))
            count += 1
    axes.set(xlabel="time [s]", ylabel=label)
    axes.legend(fontsize=8, frameon=False)


def against(
    axes: Any, rows: Sequence[Row], x: str, y: str, labels: tuple[str, str], power: float | None = None
) -> None:
    """Draw a number of each row against another on logarithmic axes, beside a power law through the middle one."""
    at, values = ([row.get(name) or np.nan for row in rows] for name in (x, y))
    axes.loglog(at, values, "o-", color=COLORS[0], label="measured")
    if power is not None:
        middle = len(at) // 2
        law = values[middle] * (np.array(at) / at[middle]) ** power
        axes.loglog(at, law, "--", color="#888888", label=f"power {power:g} (Hertz)")
        axes.legend(fontsize=8, frameon=False)
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.set_xticks(at, [f"{value:g}" for value in at])
    axes.minorticks_off()
    ticks = [10.0**power * digit for power in range(-3, 4) for digit in (1, 2, 5)]
    low, high = axes.get_ylim()
    axes.set_yticks(shown := [tick for tick in ticks if low <= tick <= high], [f"{tick:g}" for tick in shown])


def front(axes: Any, rows: Sequence[Row]) -> None:
    """Draw the strain by height and time as an image, with the two waves of an elastic solid from the blow on."""
    (row,) = rows
    time, heights = np.array(row["time_s"]), np.array(row["height_m"])
    levels = np.array([row["series"][f"{height:g} m"] for height in heights])
    image = axes.pcolormesh(1e3 * time, heights, levels, cmap="inferno", vmin=0.0, vmax=0.3, shading="nearest")
    axes.figure.colorbar(image, ax=axes, label="mean |F - R|")
    for name, style in (("pressure_wave_m_s", "--"), ("shear_wave_m_s", ":")):
        title = f"{name.split('_')[0]} wave, {row[name]:.1f} m/s"
        axes.plot(1e3 * time, acts.BELLY[2] - row[name] * time, style, color="w", label=title)
    axes.set(xlabel="time [ms]", ylabel="height [m]", ylim=(heights[0], heights[-1]))
    axes.legend(fontsize=8, loc="upper left", labelcolor="w", facecolor="none", edgecolor="none")


def figures() -> dict[str, Figure]:
    """Return all figures by name."""
    return {
        "belly_mass": Figure(
            "Balls of one size and speed (3 m/s), light to heavy, against a soft belly: a heavier ball dents it more "
            "(Figures 1 and 12).",
            lambda _: acts.belly_balls(),
            ("0.5 kg", "1 kg", "2 kg", "4 kg", "8 kg"),
            measures.belly,
            partial(
                against, x="ball_kg", y="peak_dent_mm", labels=("mass of the ball [kg]", "deepest dent [mm]"), power=0.4
            ),
            columns=True,
        ),
        "limb_fields": Figure(
            "Legs that are crossed and opened: with velocity fields for the limbs they push each other aside, in one "
            "field they pass through each other (supplement).",
            lambda _: acts.crossed_legs()[:2],
            ("limb fields", "one field"),
            measures.legs,
            partial(over_time, label="overlap of the legs [cm³]"),
            curves.leg_overlap,
        ),
        "shape_preservation": Figure(
            "A ball of 5 kg pushed into the belly of a limp body: the more shape preservation, the sooner the dent "
            "heals (supplement).",
            lambda _: acts.belly_dents()[:3],
            ("alpha 0", "alpha 0.3", "alpha 1"),
            measures.belly,
            partial(over_time, label="mean dent of the belly [mm]"),
            curves.belly_dent,
            columns=True,
        ),
        "stickiness": Figure(
            "A ball of 2 kg at a soft belly. As usual it dents it and leaves; by the normals of each body, or a wide "
            "gate of contact, it is stopped in the air before; without stress it sinks in and sticks (supplement).",
            lambda _: acts.remedies(),
            ("as usual", "own normals", "gate 1.5 dx", "no stress"),
            measures.stickiness,
            partial(over_time, label="ball ahead of the skin at rest [mm]"),
            curves.ball_depth,
            columns=True,
        ),
        "jiggle": Figure(
            "A heavy belly after a drop of 0.3 m, coloured by strain: softer flesh that lags jiggles more (Figure 6).",
            lambda _: acts.drops(),
            ("firm", "20 kPa", "5 kPa"),
            measures.jump,
            partial(over_time, label="RMS displacement of the belly [mm]"),
            curves.jiggle,
            columns=True,
        ),
        "propagation": Figure(
            "A ball of 8 kg strikes the belly of a floating, limp body at 8 m/s: strain travels through the body as "
            "fast as elastic waves (Figure 7).",
            lambda _: [acts.blow()],
            ("",),
            measures.waves,
            front,
            curves.slices,
        ),
        "ball_stiffness": Figure(
            "Balls of 1.5 kg, soft to stiff, at the chest at 4 m/s: a soft ball flattens, a stiff one does not "
            "(supplement).",
            lambda _: acts.throws(),
            ("1 kPa", "10 kPa", "100 kPa", "1 MPa", "10 MPa"),
            measures.throw,
            partial(
                against,
                x="young_modulus_pa",
                y="peak_ball_dent_mm",
                labels=("Young's modulus of the ball [Pa]", "deformation of the ball [mm]"),
            ),
            columns=True,
        ),
        "several_objects": Figure(
            "A ball, a box, a capsule and a torus hit one avatar at once (supplement).",
            lambda folder: [acts.crowd(write_meshes(folder)[0])],
            ("",),
            measures.crowd,
            partial(over_time, label="impulse per step [N s]"),
            curves.impulses,
            film=1.0,
        ),
        "resistance": Figure(
            "A ball of 4 kg at the face at 6 m/s: a tensed body recoils with its head, a limp one bends far backwards "
            "(supplement).",
            lambda _: acts.head_hits(),
            ("tone 1", "tone 0.3", "tone 0"),
            measures.head_hit,
            partial(over_time, label="bend of neck and head [deg]"),
            curves.head_angle,
            film=1.2,
            filmed=(0, 2),
        ),
        "kick_mass": Figure(
            "The same kick at balls light to heavy: a heavier ball bends the leg more and leaves more slowly "
            "(supplement).",
            lambda _: acts.kicks()[1:],
            ("0.5 kg", "1.5 kg", "8 kg"),
            measures.kick,
            partial(over_time, label="bend of the leg [deg]"),
            curves.leg_angle,
            film=1.1,
            filmed=(0, 2),
        ),
        "pillow": Figure(
            "A pillow of 0.6 kg, soft and stiff, at 5 m/s at the head, the body and a head of soft hair: a soft one "
            "wraps around what it hits (Figure 5).",
            lambda _: [*acts.pillows((1e3, 1e5)), *acts.pillows_on_body_and_hair((1e3, 1e5))],
            tuple(f"{site}, {young}" for site in ("head", "body", "hair") for young in ("1 kPa", "100 kPa")),
            measures.pillow,
            partial(over_time, label="impulse per step [N s]"),
            lambda course: {"": curves.impulses(course)["pillow"]},
            columns=True,
            size=176,
        ),
        "loose_garment": Figure(
            "A dress in a spin that stops, and in a jump: it lags behind the body, flares out unevenly, floats, and "
            "swings on (Figure 10).",
            lambda _: acts.dresses(),
            ("spin", "jump"),
            measures.loose_garment,
            partial(over_time, label="rise of the hem against the pelvis [mm]"),
            curves.hem_lift,
            film=2.8,
            filmed=(0, 1),
        ),
        "regions": Figure(
            "A can of 0.35 kg at head, belly and ankle at 3 m/s, on flesh and on hair, cloth and a stiff boot of other "
            "materials (Figure 8).",
            lambda folder: acts.cans(write_meshes(folder)[1]),
            ("head", "hair", "belly", "cloth", "ankle", "stiff boot"),
            measures.can,
            partial(over_time, label="deepest dent [mm]"),
            curves.can_dent,
            columns=True,
            size=176,
        ),
    }


def draw(figure: Figure, options: Options) -> tuple[np.ndarray, list[Row]]:
    """Return the pixels ``(H, W, 3)`` of a figure, and a row of each act."""
    rows, strips = [], []
    with tempfile.TemporaryDirectory() as folder:
        plan = figure.plan(Path(folder))
        for act, title in runner.progress(list(zip(plan, figure.titles, strict=True)), "acts"):
            course = perform(act, options.fidelity, options.device, steps=options.steps, size=figure.size)
            row = {"case": act.name, "title": title, "particles": course.x.shape[1], **act.tags}
            row |= {"failed": course.failed, **figure.measure(course), "time_s": course.time}
            rows.append(_rounded(row | {"series": dict(figure.series(course))}))
            moments = [round(moment / course.stage.dt) * course.stage.dt for moment in act.view.moments]
            texts = [
                (f"{title}{', ' if title else ''}{1e3 * moment:.0f} ms" if color == act.view.colors[0] else color)
                for moment in moments
                for color in act.view.colors
            ]
            strips.append([_titled(frame, text) for frame, text in zip(course.frames, texts, strict=False)])
    whole, across = (1, 0) if figure.columns else (0, 1)
    pictures = np.concatenate([np.concatenate(strip, axis=across) for strip in strips], axis=whole)
    return np.concatenate((pictures, _panel(figure, rows, len(pictures))), axis=1), rows


def film(figure: Figure, path: Path, options: Options) -> None:
    """Write a GIF: acts side by side."""
    from piavatar_envs.render import label, write_video

    moments, strips = tuple(np.arange(0.0, figure.film, 1.0 / FILM_RATE)), []
    with tempfile.TemporaryDirectory() as folder:
        plan = figure.plan(Path(folder))
        for act, title in ((plan[index], figure.titles[index]) for index in figure.filmed):
            act = replace(act, seconds=figure.film, view=replace(act.view, moments=moments))
            frames = perform(act, options.fidelity, options.device, steps=options.steps, size=FILM).frames
            strips.append([label(frame, title) if title else frame for frame in frames])
    write_video(path, (np.concatenate(frames, axis=1) for frames in zip(*strips, strict=True)), FILM_RATE)


def _titled(frame: np.ndarray, text: str) -> np.ndarray:
    """Return a picture below a strip with a text."""
    from piavatar_envs.render import label

    strip = label(np.full((TITLE, frame.shape[1], 3), 255, np.uint8), text)
    return np.concatenate((strip, frame))


def _panel(figure: Figure, rows: Sequence[Row], height: int) -> np.ndarray:
    """Return the curve's pixels ``(height, PANEL, 3)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Page

    page = Page(figsize=(PANEL / 100, height / 100), dpi=100, layout="constrained")
    canvas, axes = FigureCanvasAgg(page), page.subplots()
    axes.grid(alpha=0.3)
    figure.curve(axes, rows)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:height, :PANEL, :3]


def _rounded(value: Any) -> Any:
    """Round every number within to four digits."""
    if isinstance(value, Mapping):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, list)):
        return [_rounded(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, (float, np.floating)) else value


def write(name: str, options: Options) -> list[Path]:
    """Draw a figure and return its files: ``NAME.png``, ``NAME.json`` and, if it is filmed, ``NAME.gif``."""
    from PIL import Image

    figure = figures()[name]
    pixels, rows = draw(figure, options)
    picture, measured = options.out / f"{name}.png", options.out / f"{name}.json"
    options.out.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).quantize(PALETTE, kmeans=4, dither=Image.Dither.NONE).save(picture, optimize=True)
    chosen = {"fidelity": options.fidelity, "steps": options.steps}
    report = describe_run(f"paper.figures.{name}", options.device)
    write_json(measured, plain(report | {"caption": figure.caption, "options": chosen, "results": rows}, name))
    written = [picture, measured]
    if figure.film and options.film:
        written.append(options.out / f"{name}.gif")
        film(figure, written[-1], options)
    return written


def main(options: Options) -> list[Path]:
    """Draw a figure, or all of them, and return their files.

    Raises:
        ValueError: there is no figure of such a name.
    """
    known = figures()
    if options.name == "list":
        print("\n".join(f"{name}: {figure.caption}" for name, figure in known.items()))
        return []
    if options.name != "all" and options.name not in known:
        raise ValueError(f"there is no figure {options.name!r}; there are {', '.join(known)}, and all")
    written: list[Path] = []
    for name in known if options.name == "all" else [options.name]:
        for path in write(name, options):
            written.append(path)
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", flush=True)
    return written


if __name__ == "__main__":
    main(tyro.cli(Options, prog="python -m benchmarks.paper.figures"))
