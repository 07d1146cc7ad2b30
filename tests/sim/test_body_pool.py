"""A pool of bodies: drawn on the device, each with every constant of its shape; the host takes part when it asks."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.avatar.body.device import bone_masses
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.sim.shapes import draw_body
from piavatar_envs.tasks import load_task

REACH = "PIAvatar/Reach-v0"
POOL = {"shape.randomize": True, "shape.pool": 3}
TWO = {"scene.avatars": [{"position": (-0.6, 0.0)}, {"position": (0.6, 0.0)}]}


def constants_of(simulation, env: int, avatar: int = 0) -> dict[str, np.ndarray]:
    """What depends on an avatar's shape in an environment."""
    drive, particles = simulation.avatars[avatar], simulation.model.particles
    body = drive.body
    own = slice(body.first, body.first + body.count)
    found = {
        "rest": body.rest,
        "joints": body.rest_joint,
        "center": body.rest_center,
        "velocity_lag": body.velocity_lag,
    }
    found |= {"bone_mass": body.bone_mass, "mass": particles.mass[:, own], "volume": particles.volume[:, own]}
    return {name: array.numpy()[env] for name, array in found.items()} | {"total": drive.body_mass.numpy()[env]}


def expected_of(flesh, parameters: np.ndarray) -> dict[str, np.ndarray]:
    """The same, shaped anew on the host."""
    points, volume = flesh.shaped(parameters)
    mass, center = bone_masses(points)
    found = {"rest": points.rest, "joints": points.joints, "center": center, "velocity_lag": points.velocity_lag}
    found |= {"bone_mass": mass, "mass": points.mass, "volume": volume}
    return {name: array[0].astype(np.float32) for name, array in found.items()} | {"total": points.mass.sum()}


@pytest.mark.parametrize("factor", [None, (0.5, 2.0)])
def test_all_that_depends_on_the_shape_is_of_the_body_drawn(make_batch, factor):
    settings = {**POOL, "soft_tissue": 0.3, "pose_noise": 0.0}
    batch = make_batch(REACH, 4, **settings, **({"mass_factor": factor} if factor else {}))
    sim, seen = batch.simulation, set()
    for seeds in ([1, 2, 3, 4], None, None):
        batch.reset(seeds=seeds)
        flesh = sim.flesh[0]
        scale = sim.randomization.column("mass_factor").numpy()
        for env in range(4):
            expected, found = expected_of(flesh, flesh.shape_parameters[env]), constants_of(sim, env)
            for name, value in expected.items():
                factor_of = scale[env] if name in ("mass", "bone_mass", "total") else 1.0
                assert found[name] == pytest.approx(factor_of * value, rel=2e-6, abs=1e-9), name
            assert np.array_equal(flesh.points.rest[env], expected["rest"])
            assert np.array_equal(flesh.points.joints[env], expected["joints"])
            assert flesh.points.mass[env] == pytest.approx(expected["mass"], rel=1e-6)
            seen.add(flesh.shape_parameters[env].tobytes())
            tracked = sim.avatar.tracked.position.numpy()[env]
            assert tracked == pytest.approx(expected["joints"], abs=1e-4)
    assert len(seen) == 3, "twelve episodes have not drawn all three bodies"


def test_bodies_are_drawn_alike_and_each_by_its_seed_and_episode(device):
    n, count = 30_000, 7
    inputs = [wp.array(np.ones(n, bool), dtype=wp.bool, device=device)]
    seeds, zeros = np.arange(n, dtype=np.int32), np.zeros(n, np.int32)
    found = []
    for seed, episode, avatar in ((seeds, zeros, 0), (zeros, seeds, 0), (seeds, zeros, 1)):
        index = wp.zeros(n, dtype=int, device=device)
        arrays = [wp.array(a, dtype=int, device=device) for a in (seed, episode)]
        wp.launch(draw_body, n, [*inputs, *arrays, avatar, count], [index], device=device)
        found.append(index.numpy())
        share = np.bincount(found[-1], minlength=count) / n
        assert len(share) == count and np.abs(share - 1 / count).max() < 5 * np.sqrt(1 / count / n)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(np.mean(found[a] == found[b]) - 1 / count) < 5 * np.sqrt(1 / count / n)


def test_the_host_takes_no_part_until_it_asks(make_batch, monkeypatch):
    """What shapes a body is not called, and the host's copy follows when it is looked at."""
    batch = make_batch(REACH, 3, **POOL)
    flesh = batch.simulation.flesh[0]
    batch.reset(seeds=[1, 2, 3])
    before = flesh.shape_parameters.copy()

    def refuse(*args, **kwargs):
        raise AssertionError("a body is shaped in a reset")

    monkeypatch.setattr(type(flesh), "shaped", refuse)
    monkeypatch.setattr(batch.simulation.shapes, "give", refuse)
    for _ in range(4):
        batch.reset()
        assert np.array_equal(flesh._shape_parameters, before), "the host has looked"
    pool = batch.simulation.shapes.pools[0]
    index = pool.index.numpy()
    assert np.array_equal(flesh.shape_parameters, pool.bodies.parameters[index])
    assert not np.array_equal(flesh.shape_parameters, before)


def test_a_restored_state_brings_its_body_back(make_batch):
    batch = make_batch(REACH, 3, **POOL)
    batch.reset(seeds=[1, 2, 3])
    state, flesh = batch.get_state(), batch.simulation.flesh[0]
    parameters, rest = flesh.shape_parameters.copy(), flesh.points.rest.copy()
    batch.reset(seeds=[7, 8, 12])
    assert not np.array_equal(flesh.shape_parameters, parameters)
    batch.set_state(state)
    assert np.array_equal(flesh.shape_parameters, parameters) and np.array_equal(flesh.points.rest, rest)
    assert np.array_equal(batch.simulation.avatar.body.rest.numpy(), rest)


def test_the_body_drawn_is_told(make_batch):
    batch = make_batch(REACH, 3, observe_parameters=True, **POOL)
    for seeds in ([1, 2, 3], None):
        batch.reset(seeds=seeds)
        term = batch.layout["parameters"]
        told = batch.observation.numpy()[:, 0, term.slice]
        flesh = batch.simulation.flesh[0]
        assert [p.name for p in term.parameters] == [
            *(f"shape_{name}" for name in flesh.asset.shape_names),
            *(p.name for p in batch.task.drawn()),
            "clock",
        ]
        assert told[:, : len(flesh.asset.shape_names)] == pytest.approx(flesh.shape_parameters, abs=1e-6)


def test_avatars_draw_apart_from_bodies_that_are_shaped_once(device):
    from piavatar_envs.config import EnvConfig
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.sim.world import Simulation

    n = 6
    config = load_config(EnvConfig, None, {"fidelity": "tiny", **POOL, **TWO})
    simulation, graph = Simulation(config, n, device), LaunchGraph(device)
    mask = wp.array(np.ones(n, bool), dtype=wp.bool, device=device)
    seed, episode = (
        wp.array(np.arange(n, dtype=np.int32), dtype=int, device=device),
        wp.zeros(n, dtype=int, device=device),
    )
    simulation.record_randomization(graph, mask, seed, episode)
    graph.run()
    pools = simulation.shapes.pools
    assert pools[0].bodies is pools[1].bodies
    assert not np.array_equal(pools[0].index.numpy(), pools[1].index.numpy())
    for avatar, flesh in enumerate(simulation.flesh):
        flesh.mark_stale()
        for env in range(n):
            assert constants_of(simulation, env, avatar)["mass"].sum() == pytest.approx(flesh.points.mass[env].sum())


def test_settings_of_the_shapes_hold_for_the_pool(make_batch):
    batch = make_batch(REACH, 2, **POOL, **{"shape.parameters": {"height": 0.5}, "shape.scale": 0.3})
    names, drawn = batch.simulation.asset.shape_names, batch.simulation.shapes.pools[0].bodies.parameters
    others = [index for index, name in enumerate(names) if name != "height"]
    assert (drawn[:, names.index("height")] == 0.5).all()
    assert np.abs(drawn[:, others]).max() <= 0.3 and (np.ptp(drawn[:, others], axis=0) > 0.0).all()


def test_a_pool_is_not_written_into(make_batch):
    batch = make_batch(REACH, 2, **POOL)
    flesh = batch.simulation.flesh[0]
    with pytest.raises(ValueError, match=r"shape\.pool=3"):
        batch.simulation.shapes.give(0, flesh.base_parameters)
    with pytest.raises(ConfigError, match=r"shape.pool=0 must be >= 1"):
        load_config(load_task(REACH).Config, None, {"shape.pool": 0})


def test_without_random_shapes_there_is_no_pool(make_batch):
    batch = make_batch(REACH, 2, **{"shape.pool": 3})
    assert not batch.simulation.shapes.pools and batch.simulation.avatar.body.rest.shape[0] == 1
