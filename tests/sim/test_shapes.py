"""Bodies of many shapes: drawn from seed and episode, from a pool or anew, with all constants of their shape."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.device import bone_masses
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.sim.shapes import draw_body
from piavatar_envs.tasks import load_task

#: The mean body is 1.65 m or so; the asset's own tests hold the range of its shapes.
SHORTEST, TALLEST, LIGHTEST, HEAVIEST = 1.2, 2.1, 25.0, 160.0


def body_of(env, index: int = 0) -> dict[str, float | np.ndarray]:
    """Return height along its own axis [m], mass [kg] and parameters of a body at rest."""
    simulation = env.batch.simulation
    own = slice(0, simulation.avatar.num_points)  # props come after the avatar
    x = simulation.state.x.numpy()[index, own]
    up = Rotation.from_quat(simulation.avatar.tracked.rotation.numpy()[index, 0].astype(float)).apply([0.0, 0.0, 1.0])
    return {
        "height": float(np.ptp(x @ up)),
        "mass": float(simulation.model.particles.mass.numpy()[index, own].sum()),
        "parameters": simulation.flesh[0].shape_parameters[index].copy(),
    }


@pytest.mark.parametrize("task", ["PIAvatar/Reach-v0", "PIAvatar/KickBall-v0"])
def test_seeds_and_episodes_draw_other_bodies_and_the_same_ones_again(make_env, task):
    env = make_env(task, **{"shape.randomize": True})
    count = env.batch.simulation.model.num_particles

    def draw():
        bodies = []
        for seed in (0, 1, 2):
            for seed_or_none in (seed, None):
                env.reset(seed=seed_or_none)
                bodies.append(body_of(env))
                assert env.batch.simulation.state.x.shape == (1, count)
        return bodies

    first, again = draw(), draw()
    masses, heights = ([body[name] for body in first] for name in ("mass", "height"))
    assert len(np.unique(np.round(masses, 3))) == len(masses) and np.ptp(masses) > 5.0
    assert all(LIGHTEST < mass < HEAVIEST for mass in masses) and all(SHORTEST < h < TALLEST for h in heights)
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a["parameters"], b["parameters"]) and a["mass"] == b["mass"]
        assert a["height"] == pytest.approx(b["height"], abs=1e-6)


def test_the_body_is_the_one_of_its_parameters(make_env):
    # Mass is density times the volume of that shape's mesh, by the divergence theorem; feet stand on the ground.
    env = make_env("PIAvatar/Reach-v0", pose_noise=0.0, **{"shape.randomize": True})
    simulation = env.batch.simulation
    for seed in (3, 4):
        env.reset(seed=seed)
        shaped = simulation.asset.shape(simulation.flesh[0].shape_parameters[0])
        a, b, c = (shaped.vertices[simulation.asset.faces[:, n]].astype(float) for n in range(3))
        volume = np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0
        assert body_of(env)["mass"] == pytest.approx(env.config.physics.density * volume, rel=0.01)
        x, dx = simulation.state.x.numpy()[0], simulation.dx
        assert 0.0 <= x[:, 2].min() < 0.5 * dx
        assert x[:, 2].max() == pytest.approx(shaped.vertices[:, 2].max(), abs=0.5 * dx)
        tracked = simulation.avatar.tracked.position.numpy()[0]
        assert tracked == pytest.approx(shaped.joints, abs=1e-4)


@pytest.mark.parametrize("pool", [None, 3])
def test_named_parameters_are_kept_and_scale_bounds_the_others(make_env, pool):
    shape = {"randomize": True, "pool": pool, "parameters": {"height": -0.75, "sex": 1.0}, "scale": 0.3}
    env = make_env("PIAvatar/Reach-v0", shape=shape)
    names = env.batch.simulation.asset.shape_names
    drawn = []
    for seed in range(6):
        env.reset(seed=seed)
        drawn.append(body_of(env)["parameters"])
    drawn = np.array(drawn)
    assert (drawn[:, names.index("height")] == np.float32(-0.75)).all() and (drawn[:, names.index("sex")] == 1.0).all()
    others = [index for index, name in enumerate(names) if name not in ("height", "sex")]
    assert (np.ptp(drawn[:, others], axis=0) > 1e-3).all() and np.abs(drawn[:, others]).max() <= 0.3


def test_a_fixed_shape_is_the_same_in_every_episode(make_env):
    env = make_env("PIAvatar/Reach-v0", pose_noise=0.0, **{"shape.parameters": {"height": 0.9, "weight": 0.5}})
    mean = make_env("PIAvatar/Reach-v0", pose_noise=0.0)
    env.reset(seed=0)
    mean.reset(seed=0)
    first = body_of(env)
    env.reset(seed=1)
    assert body_of(env)["height"] == pytest.approx(first["height"], abs=1e-6)
    assert first["height"] > body_of(mean)["height"] + 0.05 and first["mass"] > body_of(mean)["mass"] + 3.0


REACH = "PIAvatar/Reach-v0"
POOL = {"shape.randomize": True, "shape.pool": 3}
TWO = {"scene.avatars": [{"position": (-0.6, 0.0)}, {"position": (0.6, 0.0)}]}


def constants_of(simulation, env: int, avatar: int = 0) -> dict[str, np.ndarray]:
    """Return all that depends on an avatar's shape in an environment."""
    own_avatar, particles = simulation.avatars[avatar], simulation.model.particles
    body = own_avatar.body
    own = slice(body.first, body.first + body.count)
    found = {
        "rest": body.rest,
        "joints": body.rest_joint,
        "center": body.rest_center,
        "velocity_lag": body.velocity_lag,
    }
    found |= {"bone_mass": body.bone_mass, "mass": particles.mass[:, own], "volume": particles.volume[:, own]}
    return {name: array.numpy()[env] for name, array in found.items()} | {"total": own_avatar.body_mass.numpy()[env]}


def expected_of(flesh, parameters: np.ndarray) -> dict[str, np.ndarray]:
    """Return these, shaped anew on the host."""
    points, volume = flesh.shaped(parameters)
    mass, center = bone_masses(points)
    found = {"rest": points.rest, "joints": points.joints, "center": center, "velocity_lag": points.velocity_lag}
    found |= {"bone_mass": mass, "mass": points.mass, "volume": volume}
    return {name: array[0].astype(np.float32) for name, array in found.items()} | {"total": points.mass.sum()}


def test_all_that_depends_on_the_shape_is_of_the_body_drawn(make_batch):
    batch = make_batch(REACH, 3, **POOL, soft_tissue=0.3, pose_noise=0.0, mass_factor=(0.5, 2.0))
    sim, seen = batch.simulation, set()
    for seeds in ([1, 2, 3], None):
        batch.reset(seeds=seeds)
        flesh = sim.flesh[0]
        scale = sim.randomization.column("mass_factor").numpy()
        for env in range(3):
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
    assert len(seen) == 3, "six episodes have not drawn all three bodies"


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


def test_the_host_takes_no_part_until_its_copy_is_read(make_batch, monkeypatch):
    # No body is shaped in a reset, and the host's copy follows when it is read.
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
    assert np.array_equal(flesh.shape_parameters, pool.bodies.parameters[pool.index.numpy()])
    assert not np.array_equal(flesh.shape_parameters, before)


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


def test_bodies_are_given_only_where_shapes_are_random_and_drawn_from_no_pool(make_batch):
    plain = make_batch(REACH, 2).simulation
    with pytest.raises(ValueError, match=r"shape\.randomize=False"):
        plain.shapes.give(0, plain.flesh[0].base_parameters)
    batch = make_batch(REACH, 2, **POOL)
    flesh = batch.simulation.flesh[0]
    with pytest.raises(ValueError, match=r"shape\.pool=3"):
        batch.simulation.shapes.give(0, flesh.base_parameters)
    with pytest.raises(ConfigError, match=r"shape.pool=0 must be >= 1"):
        load_config(load_task(REACH).Config, None, {"shape.pool": 0})
