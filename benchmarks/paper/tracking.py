"""Distance of a soft body from commanded poses: the paper's Tables 1 and 2, struck and unstruck.

``python -m benchmarks.paper.tracking --out benchmarks/results/tracking.json``; ``benchmarks/README.md`` has the
protocol.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks import runner
from benchmarks.paper import disturbance
from benchmarks.paper import metrics as paper
from benchmarks.paper.metrics import distance_metrics, pose_metrics, spread
from benchmarks.paper.poses import passing_through, random_directions, random_poses, random_shapes
from benchmarks.physics.rig import Rig, World
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import PoseControlConfig
from piavatar_envs.config import replace as changed
from piavatar_envs.core.launch_graph import LaunchGraph

VARIANTS = ("split", "paper", "none")
FRAMES = 4  # poses of a sequence of Table 1
SUBSTEPS = 100  # a pose
STEPS_PER_POSE = 20  # of the smooth sequence: joints turn at 1 to 5 rad/s
STRUCK_BONE, STRIKE = "left_elbow", 3.0  # [N s]: a forearm at 2 to 3 m/s
#: Nothing but the kinematic velocity moves the body: no pull of any kind, no wrench.
BARE = PoseControlConfig(tone=0.0, alpha=0.0, root="free", free_motion=False)
#: What the environments use, without the root wrench, which would take up the momentum of a strike.
TENSED = PoseControlConfig(root="free", free_motion=False)


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the tracking benchmark."""

    #: independent repetitions: other bodies, other poses
    seeds: int = 3
    #: sequences of four poses in each repetition of Table 1
    sequences: int = 5
    #: poses of the sequence of Table 2
    poses: int = 200
    #: poses of the disturbed sequence of Table 2, a strike every tenth
    struck_poses: int = 30
    #: repetitions of Table 1 with twice as fine a grid; 0 leaves it out
    medium_seeds: int = 2
    #: a model file of SMPL, SMPL-H or SMPL-X, tracked in place of the embedded body
    model: str | None = None
    #: mesh of a skeleton, or a folder of its parts, for bone particles
    skeleton: str | None = None
    #: Tables 1 and 2
    tables: bool = True
    #: strikes and balls as well
    disturbances: bool = True
    #: a minute's smoke run: few poses of a tiny body; the figures mean nothing
    quick: bool = False
    #: draw the pictures beside the JSON file
    pictures: bool = True


def shortened(options: Options) -> Options:
    """Return the options, shortened to a smoke run if asked for."""
    if not options.quick:
        return options
    return replace(options, seeds=2, sequences=1, poses=3, struck_poses=3, medium_seeds=0)


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield all rows of the benchmark."""
    chosen = shortened(options)
    settings = {"source": "embedded" if options.model is None else "smplx"}
    settings |= {"path": options.model} if options.model else {}
    settings |= {"skeleton": options.skeleton} if options.skeleton else {}
    world = World(fidelity="tiny" if options.quick else "coarse", avatar=tuple(settings.items()), device=options.device)
    bar = runner.progress(list(plan(chosen, world)), "tracking")
    rows: list[dict[str, Any]] = []
    for run in bar:
        for row in run():
            rows.append(row)
            yield row
    if chosen.pictures and chosen.out is not None:
        from benchmarks.paper import tracking_figures as pictures

        pictures.draw_all(rows, chosen.out.parent, world)


def plan(options: Options, world: World) -> Iterator[Any]:
    """Yield every measurement, as a function that yields its rows."""
    if options.tables:
        yield from tables(options, world)
    few = replace(options, sequences=min(2, options.sequences))
    ten_times = [{"bone_rings": rings} for rings in (4, 8 if options.quick else 40)]
    if options.skeleton:  # points of a surface
        ten_times = [{"bone_voxel": voxel} for voxel in (1.0, 0.7 if options.quick else 10.0**-0.5)]
    for number in ten_times:
        for variant in ("split", "paper"):
            where = replace(world, decoupling=variant, **number)
            yield lambda where=where: bone_particles(few, where)
    if options.disturbances:
        yield from disturbance.plan(options.seeds, options.quick, world)


def tables(options: Options, world: World) -> Iterator[Any]:
    """Yield the measurements of Tables 1 and 2, struck and unstruck."""
    medium = replace(world, fidelity="medium")
    runs = [(replace(world, decoupling=v), BARE, options.seeds) for v in VARIANTS]
    runs += [
        (replace(world, decoupling=v), changed(BARE, {"command": "reference"}), options.seeds)
        for v in ("paper", "none")
    ]
    if options.medium_seeds:
        runs += [(replace(medium, decoupling=v), BARE, options.medium_seeds) for v in VARIANTS]
    for where, control, seeds in runs:
        yield lambda where=where, control=control, seeds=seeds: table_1(options, where, control, seeds)
    for variant in VARIANTS:
        where = replace(world, decoupling=variant)
        yield lambda where=where: table_1(options, where, TENSED, options.seeds, strike=STRIKE)
    target = changed(BARE, {"command": "target"})
    for variant in VARIANTS:
        where = replace(world, decoupling=variant)
        yield lambda where=where: table_2(options, where, target, options.poses)
    smooth = max(1, options.poses // (2 * STEPS_PER_POSE))
    for variant in VARIANTS:
        where = replace(world, decoupling=variant)
        yield lambda where=where: table_2(options, where, target, smooth, STEPS_PER_POSE)
    # the environments' own time step and pulls; jumps are too fast for that step
    usual = changed(TENSED, {"command": "target"})
    yield lambda: table_2(options, replace(world, num_substeps=None), usual, smooth, STEPS_PER_POSE)
    for variant in VARIANTS:
        where = replace(world, decoupling=variant)
        yield lambda where=where: table_2(options, where, usual, options.struck_poses, strike=STRIKE)


def table_1(
    options: Options, world: World, control: PoseControlConfig, seeds: int, strike: float = 0.0
) -> Iterator[dict[str, Any]]:
    """Yield rows of Table 1: distance to the commanded shape after one, two, three and four poses.

    With ``strike`` [N s], a forearm is struck before the second pose, in a random direction.
    """
    samples = [run_sequences(world, control, options.sequences, seed, strike) for seed in range(seeds)]
    for frame in range(FRAMES):
        substeps = SUBSTEPS * (frame + 1)
        yield {
            "case": label("table 1", world, control, strike) + f", {substeps} substeps",
            "table": 1,
            "decoupling": world.decoupling,
            "drive": control.command,
            "fidelity": world.fidelity,
            "disturbed": strike > 0.0,
            "substeps": substeps,
            **spread([sample[frame] for sample in samples]),
            "seeds": seeds,
            "poses_per_seed": FRAMES * options.sequences,
            "failed_bodies": sum(sample[frame]["failed"] for sample in samples),
            "tone": control.tone,
            "alpha": control.alpha,
            "strike_n_s": strike,
            "paper": paper.table_1(world.decoupling, substeps) if not strike else None,
        }


def run_sequences(
    world: World, control: PoseControlConfig, sequences: int, seed: int, strike: float = 0.0
) -> list[dict[str, float]]:
    """Run one repetition of Table 1 and return metrics after each of the four poses, over all bodies."""
    rng = np.random.default_rng([seed, 1])
    shapes = random_shapes(world.asset, rng, sequences)
    rotations, shifts = random_poses(rng, sequences * FRAMES)
    rotations = rotations.reshape(sequences, FRAMES, -1, 3)
    shifts = shifts.reshape(sequences, FRAMES, 3)
    directions = random_directions(rng, sequences)
    # a fine grid is large: one body at a time there
    groups = np.array_split(np.arange(sequences), sequences if world.fidelity in ("medium", "fine") else 1)
    found: list[list[np.ndarray]] = [[] for _ in range(FRAMES)]
    poses: list[list[dict[str, np.ndarray]]] = [[] for _ in range(FRAMES)]
    failed = np.zeros(FRAMES, int)
    seconds = np.zeros(FRAMES)
    for group in groups:
        rig = Rig(world, control, shapes[group])
        for frame in range(FRAMES):
            if strike and frame == 1:
                rig.strike(np.full(len(group), joint_index(STRUCK_BONE)), strike * directions[group])
            start = time.perf_counter()
            rig.step(rotations[group, frame], shifts[group, frame])
            alive = rig.alive
            seconds[frame] += time.perf_counter() - start
            failed[frame] += int((~alive).sum())
            found[frame] += list(rig.distances()[alive])
            poses[frame].append({name: value[alive] for name, value in rig.pose_errors().items()})
    return [
        distance_metrics(found[frame])
        | pose_metrics(poses[frame])
        | {"seconds_per_pose": seconds[frame] / sequences, "failed": int(failed[frame])}
        for frame in range(FRAMES)
    ]


def table_2(
    options: Options,
    world: World,
    control: PoseControlConfig,
    poses: int,
    steps_per_pose: int = 1,
    strike: float = 0.0,
) -> Iterator[dict[str, Any]]:
    """Yield a row of Table 2: mean Kabsch errors over a long sequence of random poses, a body per seed.

    Poses are reached in one control step, or along arcs in ``steps_per_pose``. A body that fails is put, unstrained,
    into the pose it should have, and counted. With ``strike`` [N s], a forearm is struck before every tenth step.
    """
    rngs = [np.random.default_rng([seed, 2]) for seed in range(options.seeds)]
    shapes = np.concatenate([random_shapes(world.asset, rng, 2)[seed % 2][None] for seed, rng in enumerate(rngs)])
    courses = [passing_through(*random_poses(rng, poses), steps_per_pose) for rng in rngs]
    rotations, shifts = (np.stack(parts, axis=1) for parts in zip(*courses, strict=True))
    rig = Rig(world, control, shapes)
    frames: list[list[dict[str, float]]] = [[] for _ in rngs]
    failures = 0
    for step in range(len(rotations)):
        if strike and step % 10 == 1:
            directions = np.array([random_directions(rng, 1)[0] for rng in rngs])
            rig.strike(np.full(len(rngs), joint_index(STRUCK_BONE)), strike * directions)
        rig.step(rotations[step], shifts[step])
        distances, errors, alive = rig.distances(), rig.pose_errors(), rig.alive
        for seed in np.flatnonzero(alive):
            one = {name: value[seed : seed + 1] for name, value in errors.items()}
            frames[seed].append(distance_metrics([distances[seed]]) | pose_metrics([one]))
        if not alive.all():
            failures += int((~alive).sum())
            rig.reset(rotations[step], shifts[step], ~alive)
    samples = [{name: float(np.mean([f[name] for f in seen])) for name in seen[0]} for seen in frames if seen]
    for sample in samples:
        sample["distance_m"] = sample.pop("mean_distance_m")
    how = "a jump a pose" if steps_per_pose == 1 else f"{steps_per_pose} steps a pose"
    yield {
        "case": label("table 2", world, control, strike) + f", {how}, {rig.model.num_substeps} substeps a step",
        "table": 2,
        "decoupling": world.decoupling,
        "drive": control.command,
        "fidelity": world.fidelity,
        "disturbed": strike > 0.0,
        "substeps": rig.model.num_substeps,
        "steps_per_pose": steps_per_pose,
        **spread(samples),
        "worst_distance_m": max((f["mean_distance_m"] for seen in frames for f in seen), default=None),
        "seeds": options.seeds,
        "steps_per_seed": len(rotations),
        "failed_bodies": failures,
        "tone": control.tone,
        "alpha": control.alpha,
        "strike_n_s": strike,
        "paper": paper.table_2() if not strike else None,
    }


def bone_particles(options: Options, world: World) -> Iterator[dict[str, Any]]:
    """Yield error and cost with ten times as many bone particles, in the last frame of Table 1's protocol."""
    samples = [run_sequences(world, BARE, options.sequences, seed)[-1] for seed in range(options.seeds)]
    rig = Rig(world, BARE, np.zeros((1, len(world.asset.shape_names))))
    trackers = np.bincount(rig.points.bone[~rig.flesh])
    yield {
        "case": label("bone particles", world, BARE, 0.0) + f", {trackers.mean():.0f} a joint",
        "table": None,
        "study": "bone particles",
        "decoupling": world.decoupling,
        "fidelity": world.fidelity,
        "disturbed": False,
        "substeps": SUBSTEPS * FRAMES,
        "bone_particles_per_joint": float(trackers.mean()),
        "particles": rig.points.num_points,
        **spread(samples),
        "tracking_ms": 1e3 * time_tracking(rig),
        "seeds": options.seeds,
    }


def time_tracking(rig: Rig, repeats: int = 20) -> float:
    """Return the median time of one Kabsch tracking of all bones of one body [s]."""
    graph = LaunchGraph(rig.model.device)
    rig.avatar.record_tracking(graph, rig.state)
    runs = []
    for _ in range(repeats):
        start = time.perf_counter()
        graph.run()
        rig.avatar.tracked.position.numpy()  # waits for a GPU
        runs.append(time.perf_counter() - start)
    return float(np.median(runs))


def label(what: str, world: World, control: PoseControlConfig, strike: float) -> str:
    """Return the name of a row."""
    return f"{what}: {world.decoupling}, {control.command}, {world.fidelity}" + (", struck" if strike else "")


if __name__ == "__main__":
    runner.main("tracking", cases, Options)
