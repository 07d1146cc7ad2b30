"""Garments on bodies that move: depth in the skin, stretch, flutter, falls, momentum, batches and cost."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from benchmarks.garments.dressed import RAMP, RATE, REST, SPEED, SPUN, STOP, Dressed, Garments, spinning
from benchmarks.garments.rows import Options, check
from benchmarks.physics.checks import Quantity, at_least, at_most
from piavatar_envs.cloth.fabric import Fabric, register_fabric
from piavatar_envs.cloth.obstacles import QUANTUM
from piavatar_envs.cloth.remesh import boundary_loops
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.diagnostics import totals

#: Cloth of all rows, as in the table of tolerances.
CLOTH = {"areal_density": 0.2, "stretch": 500.0, "bending": 2e-5, "friction": 0.3}
SKIRT = {"kind": "skirt", "length": 0.5, "flare": 0.5, **CLOTH}
SHIRT = {"kind": "shirt", **CLOTH}
#: Name of that cloth without air.
AIRLESS = "benchmark cloth without air"
#: Clips of the motion library with the longest share of each that is measured [s].
EVERYDAY = {"walk": 2.5, "run": 1.6, "jump": 1.7, "kick": 1.5, "dance_a": 1.6}
WILD = {"cartwheel": 2.6, "spinkick": 1.2, "backflip": 1.7}
LOOPS = ("walk", "run")
#: Time in which the edges of cloth that a reset placed find their lengths [s], and control steps between looks at it.
SETTLED, EVERY = 0.5, 2


def looks(dressed: Dressed, seconds: float, envs: Sequence[int] = (0,)) -> np.ndarray:
    """Return the shares of cloth deeper than 1 mm in the skin in the first seconds, shape ``(looks, envs)``."""
    found = []
    for number in range(round(seconds * RATE)):
        dressed.step()
        if number % EVERY == 0:
            found.append([dressed.deep(e) for e in envs])
    return np.array(found)


def depths(
    garments: Garments, clips: dict[str, float], mean: float, worst: float, options: Options
) -> Iterator[Quantity]:
    """Yield, of each clip, the mean and the greatest share of cloth deeper than 1 mm in the skin."""
    for clip, seconds in clips.items():
        dressed = Dressed(garments, options, motion=f"deepmimic:{clip}", loop=clip in LOOPS)
        found = 100.0 * looks(dressed, seconds)
        yield at_most(f"{clip}, mean", found.mean(), mean, "%", theory=0.0)
        yield at_most(f"{clip}, worst frame", found.max(), worst, "%", theory=0.0)


@check("skirt_depth", "skirt deeper than 1 mm in the skin")
def skirt_depth(options: Options) -> Iterator[Quantity]:
    """Yield shares of the cloth, by clip, and in a spin."""
    yield from depths([SKIRT], EVERYDAY, 0.3, 2.5, options)
    yield from depths([SKIRT], WILD, 2.0, 10.0, options)
    found = 100.0 * looks(spinning([SKIRT], options), REST + SPUN)
    yield at_most("spin at 2 rev/s, worst frame", found.max(), 0.0, "%", theory=0.0)


@check("shirt_depth", "T-shirt deeper than 1 mm in the skin")
def shirt_depth(options: Options) -> Iterator[Quantity]:
    """Yield shares of the cloth, by clip."""
    yield from depths([SHIRT], {clip: EVERYDAY[clip] for clip in ("walk", "jump", "dance_a")}, 2.0, 6.0, options)


@check("bodies_depth", "skirts of six random bodies that walk, deeper than 1 mm in the skin")
def bodies_depth(options: Options) -> Iterator[Quantity]:
    """Yield the greatest share of the cloth of any body in any frame."""
    settings = {"motion": "deepmimic:walk", "loop": True, "shape": {"randomize": True}}
    dressed = Dressed([SKIRT], options, num_envs=6, **settings)
    found = 100.0 * looks(dressed, 1.8, range(6))
    yield at_most("worst frame", found.max(), 2.5, "%", theory=0.0)


@check("stretch", "edges of a skirt, root mean square by area")
def stretch(options: Options) -> Iterator[Quantity]:
    """Yield strains in a spin and in a walk."""
    walk = Dressed([SKIRT], options, motion="deepmimic:walk", loop=True)
    for name, dressed, begin, end, mean, most in (
        ("walk", walk, SETTLED, 3.0, 1.0, 1.5),
        ("spin at 2 rev/s", spinning([SKIRT], options), REST, REST + SPUN, 2.0, 3.0),
    ):
        found = []
        while dressed.time < end:
            dressed.step()
            if dressed.time > begin:
                found.append(100.0 * dressed.strain())
        yield at_most(f"{name}, mean", np.mean(found), mean, "%", theory=0.0)
        yield at_most(f"{name}, any time", np.max(found), most, "%", theory=0.0)


def flutter_of(flare: float, options: Options, **settings: Any) -> dict[str, float]:
    """Return lag behind the waist [deg], lift of the hem [m] and its speed after the stop [m/s] of a skirt spun."""
    dressed = spinning([SKIRT | {"flare": flare}], options, **settings)
    loops = boundary_loops(dressed.mesh.faces)
    waist = dressed.held
    (hem,) = (loop for loop in loops if not np.isin(loop, waist).any())
    seen, speeds = [(dressed.get()[waist], dressed.get()[hem])], [0.0]
    while dressed.time < REST + SPUN + STOP + 0.8:
        dressed.step()
        seen.append((dressed.get()[waist], dressed.get()[hem]))
        speeds.append(float(np.sqrt((dressed.get("v")[hem] ** 2).sum(axis=1).mean())))

    def turned(points: np.ndarray) -> np.ndarray:
        place = points[..., :2] - np.array([own.mean(axis=0)[:2] for own, _ in seen])[:, None]
        angle = np.unwrap(np.arctan2(place[..., 1], place[..., 0]), axis=0)
        return np.degrees(angle - angle[round(REST * RATE)]).mean(axis=1)

    def during(begin: float, end: float) -> slice:
        return slice(round((REST + begin) * RATE), round((REST + end) * RATE))

    lag = turned(np.array([own for own, _ in seen])) - turned(np.array([own for _, own in seen]))
    height = np.array([own[:, 2].mean() for _, own in seen])
    return {
        "lag": float(lag[during(0.0, RAMP + 0.3)].max()),
        "lift": float(height[during(1.2, 1.9)].mean() - height[round(REST * RATE)]),
        "speed": float(np.sqrt(np.mean(np.square(speeds[during(SPUN + 0.3, SPUN + 0.8)])))),
    }


@check("flutter", f"skirt in a spin at {SPEED:g} rev/s and after the stop")
def flutter(options: Options) -> Iterator[Quantity]:
    """Yield what the hem of a half and of a full circle does of its own."""
    half, full = flutter_of(0.5, options), flutter_of(1.0, options)
    yield at_least("half circle, lag", half["lag"], 20.0, "deg")
    yield at_least("half circle, lift", 1e3 * half["lift"], 50.0, "mm")
    yield at_least("half circle, hem 0.1 to 0.6 s after the stop", half["speed"], 0.8, "m/s")
    yield at_least("full circle, lift", 1e3 * full["lift"], 300.0, "mm")


@check("fall", "body in a skirt that falls under pd, and lies")
def fall(options: Options) -> Iterator[Quantity]:
    """Yield the force of the cloth on the body over its weight, and the speed of the cloth of the lying body."""
    dressed = Dressed([SKIRT], options, motion="idle", control={"mode": "pd"}, root_action=False)
    forces = np.array([RATE * np.linalg.norm(dressed.step().impulse()) for _ in range(4 * RATE)])
    weight = 9.81 * dressed.mass.sum()
    landing = at_most("greatest force over the weight of the cloth, landing", forces.max() / weight, 3.0)
    yield replace(landing, note="the cloth stops with the body, within one control step")
    lying = forces[-RATE:].max() / weight
    yield at_most("greatest force over the weight of the cloth, lying", lying, 3.0, theory=1.0)
    speed = max(np.linalg.norm(dressed.step().get("v"), axis=1).max() for _ in range(RATE // 2))
    yield at_most("fastest vertex, lying", speed, 0.3, "m/s", theory=0.0)


@check("momentum", "skirt and body without gravity, floor and air")
def momentum(options: Options) -> Iterator[Quantity]:
    """Yield the drift of momentum, and how much of what the cloth gives the body does not receive, in 30 control steps.

    Both are of the sums of |m v| or |r x J|. The body does not move meanwhile: its own drift is not the cloth's.
    """
    register_fabric(AIRLESS, Fabric(drag=0.0, skin_drag=0.0, **CLOTH))
    garment = {"kind": "skirt", "length": 0.5, "flare": 0.5, "fabric": AIRLESS}
    free = {"physics": {"gravity": 0.0}, "scene": {"ground": False, "walls": False}}
    dressed = Dressed([garment], options, "PIAvatar/Reach-v0", control={"mode": "pose", "root": "free"}, **free)
    dressed.step(2)
    simulation, garments = dressed.simulation, dressed.garments
    cloth, surfaces = garments.cloth, garments.surfaces
    v = np.random.default_rng(0).normal(0.0, 0.3, dressed.get().shape) + [0.0, 1.5, 0.0]
    cloth.state.v.assign(np.where(dressed.mass[:, None] > 0.0, v, 0.0)[None].astype(np.float32))
    act, react = LaunchGraph(simulation.device), LaunchGraph(simulation.device)
    garments.record_begin(act)
    surfaces.record_end(act)
    cloth.record_step(act, simulation.state.failure)
    surfaces.record_reaction(react, simulation.state)

    def moving() -> np.ndarray:
        return dressed.mass[:, None] * dressed.get("v")

    size, start = np.linalg.norm(moving(), axis=1).sum(), moving().sum(axis=0)
    begun, drift, lost = totals(simulation.model, simulation.state).momentum, 0.0, 0.0
    for _ in range(RATE):
        act.run()
        books = surfaces.obstacles.impulse.numpy()[0] * QUANTUM
        arms = np.cross(surfaces.obstacles.end.numpy()[0].astype(float), books[:, :3])
        before = totals(simulation.model, simulation.state)
        react.run()
        after = totals(simulation.model, simulation.state)
        drift = max(drift, np.abs(after.momentum - begun + moving().sum(axis=0) - start).max() / size)
        missing = after.angular_momentum - before.angular_momentum - (arms + books[:, 3:]).sum(axis=0)
        lost = max(lost, np.abs(missing).max() / np.linalg.norm(arms, axis=1).sum())
    yield at_most("linear", drift, 1e-6, theory=0.0)
    yield at_most("angular", lost, 1e-5, theory=0.0)


@check("batch", "skirts in a batch")
def batch(options: Options) -> Iterator[Quantity]:
    """Yield the greatest difference between a batch, single environments and a second run, and the memory."""
    settings = {"motion": "deepmimic:walk", "loop": True, "random_start": True}

    def run(num_envs: int, seed: int) -> np.ndarray:
        dressed = Dressed([SKIRT], options, num_envs=num_envs, seed=seed, **settings).step(20)
        return dressed.garments.cloth.state.x.numpy()

    both, again = run(3, 0), run(3, 0)
    singles = np.concatenate([run(1, seed) for seed in range(3)])
    where = "a GPU" if wp.get_device(options.device).is_cuda else "a CPU"
    yield at_most(f"batch against singles on {where}", np.abs(both - singles).max(), 0.0, "m", theory=0.0)
    yield at_most(f"second run on {where}", np.abs(both - again).max(), 0.0, "m", theory=0.0)
    few, many = 2, 2048 if wp.get_device(options.device).is_cuda else 4
    dressed = Dressed([SKIRT], options, motion="deepmimic:walk", num_envs=few)
    more = Dressed([SKIRT], options, motion="deepmimic:walk", num_envs=many)
    each = (bytes_of(more) - bytes_of(dressed)) / (many - few)
    name = f"memory of cloth of {dressed.mesh.num_vertices} vertices in an environment, batch of {many:,}"
    yield at_most(name, each / 1e3, 200.0, "KB")


def bytes_of(dressed: Dressed) -> int:
    """Return the size of all arrays of the cloth and of the surfaces that it touches [bytes]."""
    cloth, surfaces = dressed.garments.cloth, dressed.garments.surfaces
    found: dict[int, int] = {}

    def add(value: object, depth: int = 0) -> None:
        if isinstance(value, wp.array):
            found[value.ptr or id(value)] = value.capacity
        elif depth < 2 and hasattr(value, "_cls") and hasattr(value._cls, "vars"):
            for name in value._cls.vars:
                add(getattr(value, name), depth + 1)

    for owner in (cloth, surfaces):
        for value in vars(owner).values():
            add(value)
    return sum(found.values())


@check("cost", "time of a skirt that walks")
def cost(options: Options) -> Iterator[Quantity]:
    """Yield the time of the cloth on one core; on a GPU that of 2,048 skirts over the rest of a Reach step."""
    if wp.get_device(options.device).is_cuda:
        garment, num_envs = SKIRT | {"edge": 0.041}, 2048
        more, vertices = extra_time(garment, options, num_envs)
        yield at_most(f"{num_envs:,} skirts of {vertices} vertices, on top of Reach", more, 60.0, "%")
        return
    dressed = Dressed([SKIRT], options, motion="deepmimic:walk", loop=True)
    garments, failure = dressed.garments, dressed.simulation.state.failure
    graph = LaunchGraph(dressed.simulation.device)
    garments.cloth.record_step(graph, failure)
    state, took = garments.cloth.state, []
    for number in range(RATE):
        dressed.step()
        if number < 5:
            continue
        kept = {name: getattr(state, name).numpy() for name in ("x", "v", "near")}
        start = time.process_time()
        graph.run()
        took.append(time.process_time() - start)
        for name, values in kept.items():
            getattr(state, name).assign(values)
        garments.surfaces.obstacles.impulse.zero_()
    each = 1e6 * float(np.sort(took)[2]) / dressed.mesh.num_vertices
    yield at_most("one core, a vertex and control step", each, 8.0, "us")
    yield Quantity("2,048 skirts of 600 vertices on an H200, on top of Reach", np.nan, "%", None, 60.0, "<=", "no GPU")


def extra_time(
    garment: Mapping[str, Any], options: Options, num_envs: int, steps: int = 40, **settings: Any
) -> tuple[float, int]:
    """Return how much longer a step of Reach takes with a garment [%], and the vertices of the garment.

    Args:
        garment: what every avatar wears.
        options: resolution and device.
        num_envs: environments of the batch.
        steps: control steps that are timed.
        settings: of the dressed environments.
    """
    seconds = []
    for garments, given in (([], {}), ([garment], settings)):
        dressed = Dressed(garments, options, "PIAvatar/Reach-v0", num_envs=num_envs, **given)
        dressed.step(5)
        start = time.perf_counter()
        dressed.step(steps)
        wp.synchronize_device(options.device)
        seconds.append(time.perf_counter() - start)
    return 100.0 * (seconds[1] / seconds[0] - 1.0), dressed.mesh.num_vertices
