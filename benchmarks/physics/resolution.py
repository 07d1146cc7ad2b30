"""Impacts at every resolution: how far dents, restitution and force are from those of the finest grid.

``python -m benchmarks.physics.resolution --device cuda --out benchmarks/results/resolution.json`` throws balls at a
body whose pelvis is held, at each fidelity, and draws ``resolution.png`` beside the file. ``--gates`` repeats it with
other gaps at which bodies are in contact: in grid spacings, or as a length that is the same at each resolution.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import runner
from benchmarks.physics.checks import Options as CheckOptions
from benchmarks.physics.probe import CHEST, HEAD, Probe, ball, empty

#: Balls by name: mass [kg], speed [m/s], target (x, z) [m], Young's modulus [Pa].
BALLS: dict[str, tuple[float, float, tuple[float, float], float]] = {
    "chest": (1.5, 4.0, CHEST, 1.0e5),
    "chest_soft": (0.45, 10.0, CHEST, 2.0e4),
    "head": (4.0, 6.0, HEAD, 1.0e5),
}
FREE_WAY = 0.5  # from the ball's centre to the middle of the body at first [m]
AFTER = 0.25  # time after the ball would reach the middle of the body [s]
#: Share of the peak force above which the ball counts as in contact.
TOUCHING = 0.02


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the resolution study."""

    #: resolutions
    fidelities: tuple[str, ...] = ("tiny", "coarse", "medium")
    #: balls, of BALLS
    balls: tuple[str, ...] = ("chest", "chest_soft", "head")
    #: gaps of contact: shares of the grid spacing, as "0.15 dx", or lengths, as "8 mm"; the default's if none is given
    gates: tuple[str, ...] = ()
    #: results of other resolutions or machines, whose rows are written and drawn before the new ones
    also: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Strike:
    """One impact.

    Attributes:
        restitution: speed of the ball after it over that before [-].
        dent: largest distance of flesh from its skinned place [m].
        ball_dent: largest root-mean-square distance of the ball's matter from its rest shape [m].
        force: peak of the contact force over a control step [N].
        contact: duration of contact [s].
        impulse: of the contact [N s].
        dx: grid spacing [m].
        substeps: per control step.
        particles: in the world.
    """

    restitution: float
    dent: float
    ball_dent: float
    force: float
    contact: float
    impulse: float
    dx: float
    substeps: int
    particles: int


def strike(options: CheckOptions, name: str = "chest", *props: dict, control: str = "pd", **settings: Any) -> Strike:
    """Throw a ball of :data:`BALLS` at a held, weightless body; ``props`` are further ones, which nothing touches."""
    mass, speed, at, modulus = BALLS[name]
    thrown = ball(mass, speed, at, FREE_WAY, young_modulus=modulus)
    scene = empty(thrown, *props, **settings.pop("scene", {}))
    probe = Probe.under(options, control, control_dt=1.0 / 120.0, **scene, **settings)
    matter, state = probe.prop(), probe.simulation.props.state
    forces, dents, ball_dents = [], [], []
    for _ in range(round((FREE_WAY / speed + AFTER) / probe.dt)):
        probe.step()
        subjects = len(probe.sensor("boundary_impulse"))
        pair = probe.sensor("pair_impulse").reshape(subjects, subjects, 3)[0, 1]
        forces.append(np.linalg.norm(pair) / probe.dt)
        dents.append(probe.displacement().max())
        ball_dents.append(state.deformation.numpy()[0, 0])
    back = -probe.momentum(matter)[1] / probe.mass[matter].sum()
    force = np.array(forces)
    return Strike(
        restitution=float(back / speed),
        dent=float(max(dents)),
        ball_dent=float(max(ball_dents)),
        force=float(force.max()),
        contact=float((force > TOUCHING * force.max()).sum() * probe.dt),
        impulse=float(force.sum() * probe.dt),
        dx=float(probe.simulation.dx),
        substeps=int(probe.simulation.model.num_substeps),
        particles=len(probe.mass),
    )


def gate_in_spacings(gate: str, dx: float) -> float:
    """Return a gap given as ``"0.15 dx"`` or ``"8 mm"`` in grid spacings.

    Raises:
        SystemExit: it is neither.
    """
    value, _, unit = gate.partition(" ")
    if unit not in ("dx", "mm"):
        raise SystemExit(f"--gates {gate!r}: must be as '0.15 dx' or '8 mm'")
    return float(value) if unit == "dx" else 1e-3 * float(value) / dx


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row per ball, resolution and gap of contact; then draw the picture."""
    from benchmarks.physics.collisions import grid_spacing

    jobs = [(g, n, f) for g in options.gates or ("",) for n in options.balls for f in options.fidelities]
    rows = [row for path in options.also for row in read_rows(path)]
    yield from rows
    for gate, name, fidelity in runner.progress(jobs, "impacts"):
        scene = {"contact_gate": gate_in_spacings(gate, grid_spacing(fidelity))} if gate else {}
        begun = time.perf_counter()
        found = strike(CheckOptions(device=options.device, fidelity=fidelity), name, scene=scene)
        rows.append(
            {
                "case": f"{name}, {fidelity}{f', gate {gate}' if gate else ''}",
                "ball": name,
                "fidelity": fidelity,
                "gate": gate or "default",
                "dx_mm": 1e3 * found.dx,
                "dent_mm": 1e3 * found.dent,
                "restitution": found.restitution,
                "peak_force_n": found.force,
                "contact_ms": 1e3 * found.contact,
                "impulse_n_s": found.impulse,
                "ball_dent_mm": 1e3 * found.ball_dent,
                "substeps": found.substeps,
                "particles": found.particles,
                "seconds": time.perf_counter() - begun,
            }
        )
        yield rows[-1]
    if options.out is not None:
        draw(rows, options.out.with_suffix(".png"))


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of an earlier run; each names the device on which and the commit at which it was measured."""
    report = json.loads(path.read_text(encoding="utf-8"))
    origin = {"device": report["device"]["name"], "commit": report["commit"]}
    return [origin | row for row in report["results"]]


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw dent, restitution and peak force over the grid spacing, a line per ball and gap of contact."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(9.6, 2.9), layout="constrained")
    quantities = {"dent_mm": "largest dent [mm]", "restitution": "restitution [-]", "peak_force_n": "peak force [N]"}
    kinds = dict.fromkeys((row["ball"], row["gate"]) for row in rows)
    for axis, (quantity, label) in zip(axes, quantities.items(), strict=True):
        for ball_name, gate in kinds:
            chosen = [row for row in rows if (row["ball"], row["gate"]) == (ball_name, gate)]
            chosen.sort(key=lambda row: row["dx_mm"])
            mass, speed, _, _ = BALLS[ball_name]
            title = f"{ball_name.replace('_', ', ')}: {mass:g} kg, {speed:g} m/s"
            title += f", gate {gate}" if gate != "default" else ""
            axis.plot([row["dx_mm"] for row in chosen], [row[quantity] for row in chosen], "o-", ms=4, label=title)
        axis.set(xscale="log", xlabel="grid spacing [mm]", ylabel=label)
        ticks = sorted({round(row["dx_mm"]) for row in rows})
        axis.set_xticks(ticks, [str(tick) for tick in ticks])
        axis.minorticks_off()
        axis.set_ylim(bottom=min(0.0, 1.2 * min(row[quantity] for row in rows)))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def finer(options: CheckOptions) -> CheckOptions:
    """Return the options with the next finer resolution.

    Raises:
        ValueError: there is none.
    """
    names = ("tiny", "coarse", "medium", "fine")
    if options.fidelity == names[-1]:
        raise ValueError(f"fidelity={options.fidelity!r} is the finest")
    return replace(options, fidelity=names[names.index(options.fidelity) + 1])


if __name__ == "__main__":
    runner.main("resolution", cases, Options)
