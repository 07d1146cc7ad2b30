"""Pictures of the tracking benchmark: distances beside the paper's, strain of the variants, recovery after a strike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper import metrics as paper
from benchmarks.paper.poses import random_poses, random_shapes
from benchmarks.physics.rig import Rig, World
from piavatar_envs.config import PoseControlConfig
from piavatar_envs.core.arrays import matrices_of

COLORS = {"split": "#1b7f79", "paper": "#d1495b", "none": "#8d6a9f"}
TITLES = {"split": "split (ours)", "paper": "F (F^k)^-1 (paper)", "none": "no decoupling"}
STYLES = {("increment", "coarse"): "-", ("reference", "coarse"): "--", ("increment", "medium"): ":"}
SIZE = 520  # of one body's picture [px]


def draw_all(rows: Sequence[dict[str, Any]], folder: Path, world: World) -> None:
    """Write ``tracking_distance.png``, ``tracking_recovery.png`` and ``tracking_strain.png`` into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    draw_distance(rows, folder / "tracking_distance.png")
    draw_recovery(rows, folder / "tracking_recovery.png")
    draw_strain(
        folder / "tracking_strain.png", replace(world, fidelity="coarse" if world.fidelity == "tiny" else "medium")
    )


def draw_distance(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the mean distance over the four poses of Table 1, with the standard deviation over seeds."""
    figure, axes = _figure(5.2)
    for decoupling, color in COLORS.items():
        for (drive, fidelity), style in STYLES.items():
            found = [
                row
                for row in rows
                if row["table"] == 1 and row["decoupling"] == decoupling and row["drive"] == drive
                if row["fidelity"] == fidelity and not row["disturbed"] and row["mean_distance_m"]
            ]
            if found:
                at = [row["substeps"] for row in found]
                mean = [row["mean_distance_m"] for row in found]
                error = [row["mean_distance_m_std"] or 0.0 for row in found]
                name = f"{TITLES[decoupling]}, {drive}, {fidelity}"
                axes.errorbar(at, mean, error, color=color, linestyle=style, marker="o", capsize=3, label=name)
    published = paper.TABLE_1_MEAN_DISTANCE
    axes.plot(list(published), list(published.values()), "k*", markersize=11, label="published (SMPL-X)")
    axes.set(
        yscale="log", xlabel="substeps (a random pose every 100)", ylabel="mean distance to the commanded shape [m]"
    )
    axes.set_xticks(list(published))
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    _save(figure, path)


def draw_recovery(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the error of the worst joint after a strike, by tone."""
    found = [row for row in rows if row.get("study") == "recovery" and row["alpha"] == 0.3]
    names = list(dict.fromkeys(row["case"].split(", tone")[0] for row in found))
    if not names:
        return
    import matplotlib.pyplot as plt

    columns = min(3, len(names))
    count = -(-len(names) // columns)
    figure, grid = plt.subplots(
        count, columns, figsize=(4.0 * columns, 3.0 * count), squeeze=False, layout="constrained"
    )
    shades = {0.0: "#f2a65a", 0.3: "#d1495b", 1.0: "#472b62"}
    for axes, name in zip(grid.flat, names, strict=False):
        for row in found:
            if row["case"].startswith(name + ","):
                error = row["joint_error_deg"]
                time = (np.arange(len(error)) + 1) / 30.0
                axes.plot(time, error, color=shades[row["tone"]], label=f"tone {row['tone']:g}")
        axes.set(title=name, yscale="log", ylim=(0.05, 200.0), xlabel="time after the strike [s]")
        axes.title.set_fontsize(9)
        axes.grid(alpha=0.3)
    for axes in grid[:, 0]:
        axes.set_ylabel("worst joint [deg]")
    for axes in grid.flat[len(names) :]:
        axes.set_visible(False)
    grid[0, 0].legend(fontsize=8)
    _save(figure, path)


def draw_strain(path: Path, world: World) -> None:
    """Draw the three variants after the same four poses, coloured by strain, as in the paper's figure."""
    from PIL import Image
    from scipy.spatial.transform import Rotation

    from piavatar_envs.render import Body, Camera, Renderer, Skin, strain_magnitude
    from piavatar_envs.render.overlay import label

    rng = np.random.default_rng(12)
    rotations, shifts = random_poses(rng, 4)
    shapes, panels = random_shapes(world.asset, rng, 1), []
    with Renderer(SIZE, SIZE, Camera(position=(1.1, -3.7, 1.25), target=(0.0, 0.0, 0.98))) as renderer:
        for decoupling, title in TITLES.items():
            control = PoseControlConfig(tone=0.0, alpha=0.0, root="free", free_motion=False)
            where = replace(world, decoupling=decoupling)
            rig = Rig(where, control, shapes)
            for rotation, shift in zip(rotations, shifts, strict=True):
                rig.step(rotation[None], shift[None])
            points = rig.points
            skin = Skin(rig.asset, rig.shaped[0], points.rest[0], points.skin_joints, points.skin_weights)
            tracked = rig.avatar.tracked
            turned = Rotation.from_quat(tracked.rotation.numpy()[0]).as_matrix()
            vertices = skin.deform(turned, tracked.position.numpy()[0], rig.state.x.numpy()[0])
            strain = skin.interpolate(strain_magnitude(matrices_of(rig.state.F)[0]))
            frame = renderer.render([Body(vertices, rig.asset.faces, scalars=strain)])
            mean = 1e3 * float(rig.distances().mean())
            panels.append(label(frame, f"{title}: {mean:.3g} mm off"))
            renderer.reset_camera()
    Image.fromarray(np.concatenate(panels, axis=1)).save(path, optimize=True)


def _figure(width: float) -> tuple[Any, Any]:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(width + 3.0, 4.2))
    axes.grid(alpha=0.3)
    return figure, axes


def _save(figure: Any, path: Path) -> None:
    import matplotlib.pyplot as plt

    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)
