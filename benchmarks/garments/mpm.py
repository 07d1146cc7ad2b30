"""The solver ``"mpm"`` of garments: sheets without a body against theory, and what the grid makes of a worn one."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import warp as wp

from benchmarks.garments import theory
from benchmarks.garments.dressed import RATE, SPEED, Dressed
from benchmarks.garments.free import CONTROL_DT, DRAG, GRAVITY, swing
from benchmarks.garments.rows import Options, check
from benchmarks.garments.sheets import LINEN, flat_sheet, garment, hanging_sheet
from benchmarks.garments.shells import ShellRun
from benchmarks.garments.worn import SKIRT, extra_time, flutter_of
from benchmarks.physics.checks import Quantity, at_least, at_most, equal
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.diagnostics import totals

#: Grid spacings of the fidelities "coarse", "medium" and "fine" [m].
COARSE, MEDIUM, FINE = 0.052, 0.026, 0.01
SOLVER = {"solver": "mpm"}
#: A T-shirt that is worn by friction; its softness spares substeps.
SHIRT = {"kind": "shirt", "fabric": "jersey"}


@check("mpm_hanging", "in MPM: a sheet hangs by its upper border")
def hanging(options: Options) -> Iterator[Quantity]:
    """Yield the mean stretch of a sheet that bounces about its rest, for nothing damps it."""
    points, faces, top = hanging_sheet(0.3, 0.5, 0.03)
    hem = points[:, 2] < -0.5 + 1e-6
    for stretch, dx in ((50.0, COARSE), (200.0, COARSE), (200.0, MEDIUM)):
        sheet = garment(points, faces, replace(LINEN, stretch=stretch, drag=DRAG), held=top)
        run, longer = ShellRun(sheet, dx=dx, device=options.device), []
        for _ in range(120):
            run.steps(1)
            longer.append((points[hem, 2] - run.get()[hem, 2]).mean() / 0.5)
        expected = theory.hanging_stretch(LINEN.areal_density, stretch, 0.5, GRAVITY)
        name = f"stretch, E h {stretch:g} N/m, grid of {1e3 * dx:.0f} mm"
        yield equal(name, np.mean(longer), expected, 0.04 * expected)


@check("mpm_swings", "in MPM: small swings of a hanging sheet")
def swings(options: Options) -> Iterator[Quantity]:
    """Yield frequency and damping ratio of the modes that a grid carries: two at 52 mm, three at 26 mm."""
    for dx, modes in ((COARSE, ((0.02, 0.01), (0.05, 0.1))), (MEDIUM, ((0.02, 0.01), (0.03, 0.03), (0.05, 0.15)))):
        for mode, (frequency, damping) in enumerate(modes, start=1):
            omega, ratio = swing(
                mode, lambda sheet, dx=dx: ShellRun(sheet, dx=dx, margin=0.2, device=options.device), settle=0
            )
            expected, on = theory.swing_frequency(mode, 0.5, GRAVITY), f"mode {mode}, grid of {1e3 * dx:.0f} mm"
            yield equal(f"frequency, {on}", omega, expected, frequency * expected, "rad/s")
            yield at_most(f"damping ratio, {on}", ratio, damping, theory=0.0)


@check("mpm_free", "in MPM: a sheet flies and spins at 4 rad/s for 1 s")
def free(options: Options) -> Iterator[Quantity]:
    """Yield drifts of momentum and angular momentum, and the share of the kinetic energy that is left."""
    points, faces = flat_sheet(0.4, 0.4, 0.03)
    run = ShellRun(garment(points, faces), dx=COARSE, gravity=(0.0, 0.0, 0.0), device=options.device)
    run.put(v=np.cross([0.0, 0.0, 4.0], points) + [0.3, 0.1, 0.0]).steps(1)
    before = totals(run.model, run.state)
    after = totals(run.model, run.steps(30).state)
    drift = np.abs(after.momentum - before.momentum).max() / before.momentum_scale
    yield at_most("drift of momentum, of the sum of m |v|", drift, 5e-6, theory=0.0)
    turning = after.angular_momentum[2] / before.angular_momentum[2] - 1.0
    yield at_most("drift of angular momentum", abs(turning), 1e-4, theory=0.0)
    yield equal("kinetic energy, of that of the start", after.kinetic / before.kinetic, 1.0, 2e-3)
    fall = ShellRun(garment(points, faces), dx=COARSE, device=options.device).steps(9)
    expected = GRAVITY * 9 * CONTROL_DT
    yield equal("speed of a free fall after 0.3 s", -fall.get("v")[:, 2].mean(), expected, 1e-5 * expected, "m/s")


@check("mpm_gap", "in MPM: a sheet falls on a soft block")
def gap(options: Options) -> Iterator[Quantity]:
    """Yield the distance at which contact on the grid stops cloth; the solver "xpbd" keeps 4 mm."""
    for dx in (COARSE, MEDIUM):
        side = (np.arange(16) - 7.5) * dx / 2
        flesh = np.stack(np.meshgrid(side, side, (np.arange(8) - 7.5) * dx / 2, indexing="ij"), axis=-1).reshape(-1, 3)
        points, faces = flat_sheet(4.0 * dx, 4.0 * dx, 0.6 * dx, z=1.5 * dx)
        run = ShellRun(
            garment(points, faces), dx=dx, margin=2.0 * dx, flesh=flesh, device=options.device,
            colliders=[Collider.plane((0.0, 0.0, 1.0), -4.0 * dx, 0.9)],
        ).steps(30)  # fmt: skip
        x = run.state.x.numpy()[0, : len(flesh)]
        top = x[flesh[:, 2] > -0.3 * dx, 2].mean() + 0.25 * dx
        middle = np.linalg.norm(points[:, :2], axis=1) < dx
        off = 1e3 * (run.get()[middle, 2].mean() - top)
        yield at_most(f"distance from the surface, grid of {1e3 * dx:.0f} mm", off, 1e3 * dx, "mm", theory=0.0)


@check("mpm_worn", "in MPM: garments on a body")
def worn(options: Options) -> Iterator[Quantity]:
    """Yield the carried weight, the distance of a shirt's shoulders, the flutter of a skirt, and the cost.

    The flutter is judged as that of the solver "xpbd", which reaches it.
    """
    dressed = Dressed([SKIRT], options, "PIAvatar/Reach-v0", pose_noise=0.0, cloth=SOLVER)
    simulation, carried, took = dressed.simulation, [], []
    mass = simulation.model.particles.mass.numpy()[0].astype(float)
    first = simulation.subjects.first[-1]
    for _ in range(60):
        start = time.process_time()
        info = dressed.env.step(np.zeros(dressed.env.action_space.shape, np.float32))[4]
        took.append(time.process_time() - start)
        carried.append(info["root_force"][2] + RATE * simulation.sensors.boundary_impulse.numpy()[0, 0, 2])
    weight = GRAVITY * mass[first:].sum()
    force = np.mean(carried[-30:]) - GRAVITY * mass[:first].sum()
    yield equal("weight of a skirt that the body bears", force, weight, 0.05 * weight, "N")
    bare = Dressed([], options, "PIAvatar/Reach-v0", pose_noise=0.0)
    alone = []
    for _ in range(30):
        start = time.process_time()
        bare.step()
        alone.append(time.process_time() - start)
    each = 1e6 * (np.median(took) - np.median(alone)) / dressed.mesh.num_vertices
    name = f"one core, a vertex and control step, with {simulation.model.num_substeps} substeps of the body"
    yield Quantity(name, each, "us", None, 1000.0, "<=")
    for solver in ("mpm", "xpbd"):
        walks = Dressed([SHIRT], options, motion="deepmimic:walk", loop=True, cloth={"solver": solver}).step(45)
        yield at_most(f"distance of a shirt's upper part from the skin, {solver}", upper_gap(walks), 40.0, "mm")
    half = flutter_of(0.5, options, cloth=SOLVER)
    yield at_least(f"half circle at {SPEED:g} rev/s, lag", half["lag"], 20.0, "deg")
    yield at_least("half circle, hem 0.1 to 0.6 s after the stop", half["speed"], 0.8, "m/s")


def upper_gap(dressed: Dressed) -> float:
    """Return the median distance of the highest 15 % of the cloth from the deformed skin [mm]."""
    x = dressed.get()
    distance = ClosedSurface(dressed.skin(), dressed.simulation.flesh[0].asset.faces).distance(x)
    return 1e3 * float(np.median(distance[x[:, 2] > np.quantile(x[:, 2], 0.85)]))


@check("mpm_gpu", "in MPM: garments on a GPU")
def on_gpu(options: Options) -> Iterator[Quantity]:
    """Yield the cost of skirts in a batch by either solver, and what a `fine` grid makes of a shirt."""
    shoulders = "distance of a shirt's upper part from the skin, fine"
    if not wp.get_device(options.device).is_cuda:
        yield Quantity("256 skirts, on top of Reach, mpm", np.nan, "%", None, 1000.0, "<=", "no GPU")
        yield Quantity(shoulders, np.nan, "mm", None, 1e3 * FINE, "<=", "no GPU")
        return
    for solver in ("mpm", "xpbd"):
        more, vertices = extra_time(SKIRT, options, 256, cloth={"solver": solver})
        yield Quantity(f"256 skirts of {vertices} vertices, on top of Reach, {solver}", more, "%", None, 1000.0, "<=")
    options = replace(options, fidelity="fine")
    steps = Dressed([SHIRT | {"edge": 1.8 * FINE}], options, motion="step", cloth=SOLVER).step(5)
    start = time.perf_counter()
    steps.step(25)
    took = (time.perf_counter() - start) / 25
    yield at_most(shoulders, upper_gap(steps), 1e3 * FINE, "mm")
    name = f"a control step at fine, {steps.mesh.num_vertices} vertices, {steps.simulation.model.num_substeps} substeps"
    yield Quantity(name, 1e3 * took, "ms", None, 1000.0, "<=")
