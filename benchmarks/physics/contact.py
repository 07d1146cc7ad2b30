"""Contact: momentum, energy, release, gaps and friction, with shared normals and with the paper's own.

``python -m benchmarks.physics.contact --out FILE.json``. Rows hold ``case``, ``normals`` (``shared`` or ``own``),
``resolution`` (the default, ``coarse``, and twice as fine, ``medium``) and metrics. No drive acts: bodies are plain
soft matter, so that all that is measured is contact and elasticity. The experiments of the paper's supplement, in
which avatars act, follow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import runner
from benchmarks.physics.collisions import BLOCK, Collision, ball, block, body, collide, grid_spacing
from piavatar_envs.mpm.colliders import Collider

GRAVITY = 9.81
#: Slope of the inclines: a block stays on it from a coefficient of 0.364 on.
INCLINE = np.radians(20.0)
AFTER = 0.2  # how long after contact a release is looked at [s]


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the contact benchmark."""

    #: resolutions, as the environments' fidelity
    resolutions: tuple[str, ...] = ("coarse", "medium")
    #: a smoke run; its figures mean nothing
    quick: bool = False
    #: leave the supplement's experiments out
    only_contact: bool = False


def conservation(world: Collision, steps: int) -> dict[str, Any]:
    """Run a collision and return its errors of momentum and energy."""
    about = np.average([t.x.mean(0) for t in world.things], axis=0)
    start = world.totals(about=about)
    scale = sum(
        thing.density * (thing.volume * np.linalg.norm(np.cross(thing.x - about, thing.velocity), axis=1)).sum()
        for thing in world.things
    )
    linear = angular = 0.0
    most, touching = 1.0, 0
    for _ in range(steps):
        world.run(1)
        now = world.totals(about=about)
        linear = max(linear, float(np.abs(now.momentum - start.momentum).max()) / start.momentum_scale)
        angular = max(angular, float(np.abs(now.angular_momentum - start.angular_momentum).max()) / float(scale))
        most = max(most, (now.kinetic + now.elastic) / (start.kinetic + start.elastic))
        touching += world.touched()
    return {
        "linear_momentum_rel": linear,
        "angular_momentum_rel": angular,
        "energy_ratio_max": most,
        "energy_ratio_end": (now.kinetic + now.elastic) / (start.kinetic + start.elastic),
        "contact_steps": touching,
        "substeps_per_s": world.model.num_substeps / world.model.control_dt,
        "failed": world.failed,
    }


def free_hits(resolution: str, normals: str, options: Options) -> Iterator[dict[str, Any]]:
    """Yield rows of free, off-centre hits: a ball on a body, and a body on a body."""
    steps = 3 if options.quick else 24
    thrown = ball((0.05, -0.5, 1.25), resolution, mass=1.5, velocity=(0.3, 6.0, 0.5))
    hits = {
        "ball on body": [body(resolution), thrown],
        "body on body": [
            body(resolution, velocity=(0.0, -1.5, 0.0)),
            body(resolution, (0.12, -0.55, 0.05), yaw=np.pi, velocity=(0.0, 1.5, 0.2)),
        ],
    }
    for name, things in hits.items():
        world = collide(things, resolution, normals, fastest=6.0, device=options.device)
        yield {"case": name, **conservation(world, steps)}


def rapid(resolution: str, normals: str, options: Options) -> Iterator[dict[str, Any]]:
    """Yield rows of a ball of 0.45 kg at 5 to 20 m/s on a body: release, rebound and lost momentum."""
    speeds = (20.0,) if options.quick else (5.0, 10.0, 15.0, 20.0)
    for speed in speeds:
        thrown = ball((0.0, -0.35, 1.25), resolution, mass=0.45, velocity=(0.0, speed, 0.0))
        world = collide([body(resolution), thrown], resolution, normals, fastest=speed, room=1.6, device=options.device)
        kept = conservation(world, 3 if options.quick else 4 + round((0.2 / speed + AFTER) / world.model.control_dt))
        yield {"case": f"ball at {speed:g} m/s", "speed_m_per_s": speed, **kept, **release(world)}


def release(world: Collision) -> dict[str, Any]:
    """Return whether the second thing has left the first."""
    relative = world.velocity(1) - world.velocity(0)
    return {
        "release_speed_m_per_s": float(np.linalg.norm(relative)),
        "leaving_speed_m_per_s": float(-relative[1]),
        "nearest_particle_dx": world.nearest() / world.dx,
        "released": bool(relative[1] < 0.0 and world.nearest() > world.dx),
    }


def gaps(resolution: str, normals: str, options: Options) -> Iterator[dict[str, Any]]:
    """Yield rows of a ball of 1.5 kg at 3 m/s on a body (gap and depth), and of a block at rest on another."""
    thrown = ball((0.0, -0.4, 1.25), resolution, mass=1.5, velocity=(0.0, 3.0, 0.0))
    world = collide([body(resolution), thrown], resolution, normals, fastest=3.0, device=options.device)
    closest, depth, contact_ends = np.inf, 0.0, 0
    for step in range(4 if options.quick else 30):
        world.run(1)
        closest, depth = min(closest, world.gap()), max(depth, world.penetration())
        contact_ends = step if world.touched() else contact_ends
        if step - contact_ends >= round(AFTER / world.model.control_dt) and contact_ends:
            break
    yield {"case": "gap of a hit", **_gap_row("closest", closest, world), **_depth_row(depth, world), **release(world)}
    stack = [block((0.0, 0.0, BLOCK[2]), resolution), block((0.0, 0.0, 3.02 * BLOCK[2]), resolution)]
    floor = [Collider.plane((0.0, 0.0, 1.0), 0.0, 0.8)]
    world = collide(stack, resolution, normals, 0.5, (0.0, 0.0, -GRAVITY), floor, room=0.5, device=options.device)
    world.run(2 if options.quick else 30, damped=True)
    world.run(1 if options.quick else 12)
    yield {"case": "gap at rest", **_gap_row("rest", world.gap(), world), **_depth_row(world.penetration(), world)}


def _gap_row(name: str, gap: float, world: Collision) -> dict[str, float]:
    return {f"{name}_gap_dx": gap / world.dx, f"{name}_gap_mm": 1e3 * gap}


def _depth_row(depth: float, world: Collision) -> dict[str, float]:
    return {"penetration_dx": depth / world.dx, "penetration_mm": 1e3 * depth}


def inclines(resolution: str, normals: str, options: Options) -> Iterator[dict[str, Any]]:
    """Yield rows of a block on an incline, analytic or of soft matter: gravity tilts, the ground stays level."""
    tilted = GRAVITY * np.array([np.sin(INCLINE), 0.0, -np.cos(INCLINE)])
    for friction in (0.2,) if options.quick else (0.0, 0.2, 0.5):
        expected = GRAVITY * max(0.0, np.sin(INCLINE) - friction * np.cos(INCLINE))
        for ground in ("analytic", "soft"):
            world, mover = _on_incline(resolution, normals, friction, ground == "analytic", tilted, options)
            world.run(1 if options.quick else 24, damped=True)
            world.run(1 if options.quick else 6)
            start, steps = world.velocity(mover)[0], 2 if options.quick else 18
            before = world.positions(mover).mean(0)[0]
            world.run(steps)
            time = steps * world.model.control_dt
            measured = float(world.velocity(mover)[0] - start) / time
            yield {
                "case": f"block on {ground} incline, mu {friction:g}",
                "friction": friction,
                "acceleration_m_per_s2": measured,
                "expected_m_per_s2": expected,
                "acceleration_rel_error": abs(measured - expected) / (expected or GRAVITY * np.sin(INCLINE)),
                "slid_mm": 1e3 * float(world.positions(mover).mean(0)[0] - before),
                "stays": None if expected else bool(abs(measured) < 0.01 * GRAVITY * np.sin(INCLINE)),
                "failed": world.failed,
            }


def _on_incline(resolution: str, normals: str, friction: float, analytic: bool, tilted: np.ndarray, options: Options):
    """Build the world, and return which thing slides."""
    if analytic:
        floor, things = [Collider.plane((0.0, 0.0, 1.0), 0.0, friction)], [block((0.0, 0.0, BLOCK[2]), resolution)]
    else:
        # the slab is held by a floor that nothing slips on, and a wall before it
        floor = [Collider.plane((0.0, 0.0, 1.0), 0.0, 100.0), Collider.plane((-1.0, 0.0, 0.0), -0.9, 100.0)]
        slab = block((0.3, 0.0, BLOCK[2]), resolution, (0.6, 0.3, BLOCK[2]))
        things = [slab, block((0.0, 0.0, 3.02 * BLOCK[2]), resolution)]
    world = collide(things, resolution, normals, friction, tilted, floor, room=0.9, device=options.device)
    return world, len(things) - 1


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield all rows."""
    resolutions = ("tiny",) if options.quick else options.resolutions
    for resolution in runner.progress(resolutions, "resolutions"):
        for experiment in (free_hits, rapid, gaps, inclines):
            for normals in ("shared", "own"):
                for row in experiment(resolution, normals, options):
                    about = {"normals": normals, "resolution": resolution, "dx_mm": 1e3 * grid_spacing(resolution)}
                    yield {"case": row.pop("case"), **about, **row}
    if not options.only_contact:
        from benchmarks.paper import supplement

        yield from supplement.cases(supplement.Options(device=options.device, quick=options.quick))


if __name__ == "__main__":
    runner.main("contact", cases, Options)
