"""Garments in a world: surfaces follow bodies and props; what cloth does to them keeps momentum and is borne."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.cloth.obstacles import QUANTUM, ObstacleSurfaces
from piavatar_envs.cloth.proxy import LEFT_ARM
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.render.stage import Stage
from piavatar_envs.sim.garments import avatar_piece, prop_piece

STAND = "PIAvatar/Stand-v0"
EMPTY = {"gravity": 0.0, "scene": {"ground": False, "walls": False}}
BALL = {"name": "ball", "mass": 1.5, "position": [0.0, -1.2, 1.3]}
MODES = {
    "pose": {"control": "pose", "root": "free"},
    "one velocity": {"control": "pose", "root": "free", "decoupling": "paper"},
    "pd": {"control": "pd"},
    "torque": {"control": "torque"},
}


def surfaces_of(simulation) -> ObstacleSurfaces:
    """Return the surfaces of all avatars and props of a world."""
    bodies = zip(simulation.flesh, simulation.avatars, strict=True)
    pieces = [avatar_piece(i, *body, simulation.shapes, simulation.state) for i, body in enumerate(bodies)]
    pieces += [prop_piece(i, simulation.props, simulation.state) for i in range(len(simulation.props))]
    return ObstacleSurfaces(pieces, simulation.model)


def recorded(device: str, *records) -> LaunchGraph:
    """Return a graph of what some functions append."""
    graph = LaunchGraph(device)
    for record in records:
        record(graph)
    return graph


def hold(env, steps: int) -> None:
    """Step with zero actions."""
    for _ in range(steps):
        env.step(np.zeros(env.action_space.shape, np.float32))


def test_surfaces_lie_on_the_drawn_skin_and_prop(make_env):
    env = make_env("PIAvatar/Reach-v0", scene={"props": [BALL]})
    env.reset(seed=3)
    for _ in range(3):
        env.step(env.action_space.sample())
    simulation, surfaces = env.batch.simulation, surfaces_of(env.batch.simulation)
    recorded(env.batch.device, surfaces.record_start).run()
    stage = Stage(simulation)
    recorded(env.batch.device, stage.record).run()
    found, drawn = surfaces.obstacles.start.numpy()[0], stage.vertices.numpy()[0]
    first = surfaces.obstacles.piece_start.numpy()
    ball = drawn[stage.parts[1].vertices]
    np.testing.assert_allclose(found[first[1] :], ball, atol=1e-6)
    # the skin's own vertices: the drawn surface is another one, of clothes, at most some centimetres away
    from scipy.spatial import cKDTree

    far = cKDTree(drawn[stage.parts[0].vertices]).query(found[: first[1]])[0]
    assert np.median(far) < 0.02
    normal = surfaces.obstacles.start_normal.numpy()[0]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-5)
    outward = (normal[first[1] :] * (ball - ball.mean(axis=0))).sum(axis=1)
    assert (outward > 0.0).all()


def give(surfaces: ObstacleSurfaces, impulses: np.ndarray, moments: np.ndarray, env: int = 0) -> None:
    """Book impulses [N s] and moments [N m s] about the end of each point, ``(N, 3)``."""
    books = surfaces.obstacles.impulse.numpy().copy()
    books[env] = np.rint(np.concatenate([impulses, moments], axis=1) / QUANTUM).astype(np.int64)
    surfaces.obstacles.impulse.assign(books)


@pytest.mark.parametrize("mode", MODES)
def test_the_reaction_keeps_momentum_and_angular_momentum(make_env, mode):
    env = make_env("PIAvatar/Reach-v0", **MODES[mode], gravity=0.0, scene={"ground": False, "props": [BALL]})
    env.reset(seed=0)
    hold(env, 2)
    simulation, device = env.batch.simulation, env.batch.device
    surfaces, rng = surfaces_of(simulation), np.random.default_rng(0)
    recorded(device, surfaces.record_end).run()
    points = surfaces.obstacles.end.numpy()[0].astype(float)
    impulses, moments = rng.normal(0.0, 0.01, (2, *points.shape))
    impulses[:, 2] -= 0.01
    give(surfaces, impulses, moments)
    before = totals(simulation.model, simulation.state)
    recorded(device, lambda graph: surfaces.record_reaction(graph, simulation.state)).run()
    after = totals(simulation.model, simulation.state)
    scale = np.linalg.norm(impulses, axis=1).sum()
    assert after.momentum - before.momentum == pytest.approx(impulses.sum(axis=0), abs=1e-6 * scale)
    turning = np.cross(points, impulses) + moments
    assert after.angular_momentum - before.angular_momentum == pytest.approx(
        turning.sum(axis=0), abs=1e-5 * np.linalg.norm(turning, axis=1).sum()
    )
    assert not surfaces.obstacles.impulse.numpy().any()


def test_a_failed_environment_receives_nothing(make_env):
    env = make_env("PIAvatar/Reach-v0")
    env.reset(seed=0)
    simulation, device = env.batch.simulation, env.batch.device
    surfaces = surfaces_of(simulation)
    recorded(device, surfaces.record_end).run()
    give(surfaces, np.ones(surfaces.obstacles.end.numpy()[0].shape), np.zeros(surfaces.obstacles.end.numpy()[0].shape))
    simulation.state.failure.assign([1])
    before = simulation.state.u.numpy().copy()
    recorded(device, lambda graph: surfaces.record_reaction(graph, simulation.state)).run()
    np.testing.assert_array_equal(simulation.state.u.numpy(), before)
    assert not surfaces.obstacles.impulse.numpy().any()
    simulation.state.failure.assign([0])


@pytest.mark.parametrize("mode", ["pose", "pd", "pd on the ground"])
def test_the_body_carries_a_steady_load_of_its_surface(make_env, mode):
    # 20 N down on an arm, given after every control step, reach what holds the root, and the ground
    settings = {"pose": EMPTY, "pd": {"control": "pd", "root_assist": 1.0, "pose_noise": 0.0, **EMPTY}}
    settings["pd on the ground"] = {"control": "pd", "root_assist": 1.0, "pose_noise": 0.0, "episode_seconds": 100.0}
    env = make_env("PIAvatar/Reach-v0" if mode == "pose" else STAND, **settings[mode])
    simulation, dt = env.batch.simulation, env.config.physics.control_dt
    surfaces = surfaces_of(simulation)
    end = recorded(env.batch.device, surfaces.record_end)
    react = recorded(env.batch.device, lambda graph: surfaces.record_reaction(graph, simulation.state))
    arm = surfaces.obstacles.part.numpy() == LEFT_ARM
    load = np.zeros((len(arm), 3))
    load[arm, 2] = -20.0 * dt / arm.sum()
    weight = 9.81 * simulation.model.particles.mass.numpy()[0].sum() if "ground" in mode else 0.0
    env.reset(seed=0)
    held = []
    for _ in range(80):
        end.run()
        give(surfaces, load, 0.0 * load)
        react.run()
        info = env.step(np.zeros(env.action_space.shape, np.float32))[4]
        held.append(info["root_force"][2] + simulation.sensors.boundary_impulse.numpy()[0, 0, 2] / dt)
    assert np.mean(held[-10:]) == pytest.approx(weight + 20.0, abs=0.2)
