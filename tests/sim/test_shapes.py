"""Bodies of many shapes: drawn from seed and episode, other in mass and height, alike in everything that is counted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

#: The mean body is 1.65 m or so; the asset's own tests hold the range of its shapes.
SHORTEST, TALLEST, LIGHTEST, HEAVIEST = 1.2, 2.1, 25.0, 160.0


def body_of(env, index: int = 0) -> dict[str, float | np.ndarray]:
    """What one sees of a body at rest: height along its own axis [m], mass [kg], parameters."""
    simulation = env.batch.simulation
    own = slice(0, simulation.avatar.num_points)  # props come after the avatar
    x = simulation.state.x.numpy()[index, own]
    up = Rotation.from_quat(simulation.avatar.tracked.rotation.numpy()[index, 0].astype(float)).apply([0.0, 0.0, 1.0])
    return {
        "height": float(np.ptp(x @ up)),
        "mass": float(simulation.model.particles.mass.numpy()[index, own].sum()),
        "parameters": simulation.flesh[0].shape_parameters[index].copy(),
    }


def test_seeds_and_episodes_draw_other_bodies_and_the_same_ones_again(make_env, env_id):
    env = make_env(env_id, **{"shape.randomize": True})
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
    """Mass is density times the volume of that shape's mesh, by the divergence theorem; feet stand on the ground."""
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


def test_the_weight_that_the_root_carries_is_the_bodys_own(make_env):
    env = make_env("PIAvatar/Reach-v0", pose_noise=0.0, **{"shape.randomize": True})
    for seed in (5, 6, 7):
        env.reset(seed=seed)
        forces = [env.step(np.zeros(env.action_space.shape))[4]["root_force"][2] for _ in range(20)]
        assert forces[-1] == pytest.approx(9.81 * body_of(env)["mass"], rel=0.02)


def test_named_parameters_are_kept(make_env):
    env = make_env("PIAvatar/Reach-v0", **{"shape.randomize": True, "shape.parameters": {"height": -0.75, "sex": 1.0}})
    names = env.batch.simulation.asset.shape_names
    drawn = []
    for seed in range(3):
        env.reset(seed=seed)
        drawn.append(body_of(env)["parameters"])
    drawn = np.array(drawn)
    assert (drawn[:, names.index("height")] == np.float32(-0.75)).all() and (drawn[:, names.index("sex")] == 1.0).all()
    others = [index for index, name in enumerate(names) if name not in ("height", "sex")]
    assert (np.ptp(drawn[:, others], axis=0) > 1e-3).all()


@pytest.mark.parametrize("scale", [0.0, 0.3])
def test_scale_bounds_the_shapes(make_env, scale):
    env = make_env("PIAvatar/Reach-v0", **{"shape.randomize": True, "shape.scale": scale})
    drawn = []
    for seed in range(4):
        env.reset(seed=seed)
        drawn.append(body_of(env)["parameters"])
    assert np.abs(drawn).max() <= scale and (scale == 0.0 or np.ptp(drawn, axis=0).max() > 0.1 * scale)


def test_a_fixed_shape_is_the_same_in_every_episode(make_env):
    env = make_env("PIAvatar/Reach-v0", pose_noise=0.0, **{"shape.parameters": {"height": 0.9, "weight": 0.5}})
    mean = make_env("PIAvatar/Reach-v0", pose_noise=0.0)
    env.reset(seed=0)
    mean.reset(seed=0)
    first = body_of(env)
    env.reset(seed=1)
    assert body_of(env)["height"] == pytest.approx(first["height"], abs=1e-6)
    assert first["height"] > body_of(mean)["height"] + 0.05 and first["mass"] > body_of(mean)["mass"] + 3.0


def test_without_randomize_no_other_body_is_taken(make_env):
    env = make_env("PIAvatar/Reach-v0")
    with pytest.raises(ValueError, match=r"shape\.randomize=False"):
        env.batch.simulation.shapes.give(0, env.batch.simulation.flesh[0].base_parameters)


def test_a_restored_state_brings_its_body_back(make_env, env_id):
    """Also to what lives on the host: pictures are drawn from it."""
    env, other = (make_env(env_id, twin=twin, **{"shape.randomize": True}) for twin in (0, 1))
    env.reset(seed=1)
    state, expected = env.get_state(), env.batch.simulation.flesh[0]
    other.reset(seed=2)
    got = other.batch.simulation.flesh[0]
    assert not np.allclose(got.shape_parameters, expected.shape_parameters)
    other.set_state(state)
    assert np.array_equal(got.shape_parameters, expected.shape_parameters)
    for name in ("rest", "joints", "mass"):
        assert np.array_equal(getattr(got.points, name), getattr(expected.points, name)), name


def test_bodies_of_a_batch_differ(make_batch):
    batch = make_batch("PIAvatar/Reach-v0", 3, **{"shape.randomize": True})
    batch.reset(seeds=[1, 2, 3])
    masses = batch.simulation.model.particles.mass.numpy().sum(1)
    assert len(np.unique(np.round(masses, 2))) == 3
