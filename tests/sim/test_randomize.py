"""Random mass, stiffness and friction: every constant follows its factor, the physics follows the constants.

Factors depend on seed and episode alone, the time step on the ranges alone.
"""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.mpm.model import CFL_STABLE
from piavatar_envs.sim.randomize import draw_factors
from piavatar_envs.tasks import load_task
from tests.sim.randomized import RANGES, VARIED, constants_of, factors_of

REACH = "PIAvatar/Reach-v0"
#: Nothing but the flesh itself moves the body.
FREE = {"root": "free", "gravity": 0.0, "pose_noise": 0.0}


FOLLOWS = {"mass": "mass_factor", "bone_mass": "mass_factor", "body_mass": "mass_factor", "density": "mass_factor"}
FOLLOWS |= {"mu": "stiffness_factor", "lam": "stiffness_factor"}
FOLLOWS |= {"ground": "ground_friction_factor", "pairs": "body_friction_factor"}


@pytest.mark.parametrize("one", ["mass_factor", "stiffness_factor", "all"])
def test_every_constant_follows_its_factor_and_nothing_else(make_batch, one):
    # In a world with a prop and limb fields.
    settings = {"self_contact": True, "scene.props": [{"name": "ball", "position": (0.0, -1.0, 0.2)}]}
    varied = VARIED if one == "all" else {f"randomize.{one}": RANGES[one]}
    plain, batch = make_batch(REACH, 3, **settings), make_batch(REACH, 3, **settings, **varied)
    plain.reset(seeds=[0, 1, 2])
    nominal = constants_of(plain)
    for seeds in ([0, 1, 2], None):
        batch.reset(seeds=seeds)
        factors, now = factors_of(batch), constants_of(batch)
        for name, bounds in RANGES.items():
            drawn = factors[name]
            if name == one or one == "all":
                assert (drawn >= bounds[0]).all() and (drawn <= bounds[1]).all() and len(np.unique(drawn)) == 3
        for name, follows in FOLLOWS.items():
            factor = factors[follows].reshape(3, 1) if one in (follows, "all") else 1.0
            assert now[name] == pytest.approx(nominal[name] * factor, rel=1e-6), name
        assert np.array_equal(now["volume"], nominal["volume"])
        ball = slice(batch.simulation.avatar.num_points, None)  # comes after the avatar
        for name in ("mass", "mu", "lam"):
            arrays = [getattr(b.simulation.model.particles, name).numpy()[:, ball] for b in (batch, plain)]
            assert np.array_equal(*arrays), f"{name} of the ball"


# The draws.


def drawn_factors(device, seeds, episodes, bounds) -> np.ndarray:
    n = len(seeds)
    out = wp.zeros((n, len(bounds)), dtype=float, device=device)
    inputs = [wp.array(np.ones(n, bool), dtype=wp.bool, device=device)]
    inputs += [wp.array(np.asarray(a, np.int32), dtype=int, device=device) for a in (seeds, episodes)]
    inputs += [wp.array(np.repeat([bounds], n, 0).astype(np.float32), dtype=wp.vec2, device=device)]
    wp.launch(draw_factors, out.shape, inputs, [out], device=device)
    return out.numpy()


def test_factors_are_uniform_in_their_logarithm(device):
    # Kolmogorov-Smirnov at 20,000 draws, over seeds and over episodes; bounds are kept, a point stays one.
    n, count = 20_000, np.arange(20_000)
    bounds = [(0.25, 4.0), (0.9, 1.0), (2.0, 2.0)]
    for seeds, episodes in ((count, 0 * count), (7 + 0 * count, count)):
        drawn = drawn_factors(device, seeds, episodes, bounds)
        for column, (low, high) in zip(drawn.T[:2].astype(float), bounds, strict=False):
            assert low <= column.min() and column.max() <= np.float32(high)
            share = np.sort(np.log(column / low) / np.log(high / low))
            assert np.abs(share - (np.arange(n) + 0.5) / n).max() < 2.0 / np.sqrt(n)
        assert (drawn[:, 2] == 2.0).all()
        assert abs(np.corrcoef(np.log(drawn[:, 0]), np.log(drawn[:, 1]))[0, 1]) < 3.5 / np.sqrt(n)


def test_fixed_factors_are_those_of_each_environment(make_batch):
    # The same factors as episodes that draw each from a range of one value; other factors are drawn as before.
    plain, batch = make_batch(REACH, 3, **VARIED), make_batch(REACH, 3, **VARIED)
    values = np.array([0.5, 0.8, 1.6])
    batch.simulation.randomization.fix("mass_factor", values)
    for seeds in ([4, 5, 6], None):
        plain.reset(seeds=seeds)
        batch.reset(seeds=seeds)
        drawn, factors = factors_of(plain), factors_of(batch)
        assert np.array_equal(factors.pop("mass_factor")[:, 0], values.astype(np.float32))
        assert all(np.array_equal(factor, drawn[name]) for name, factor in factors.items())
    alone = make_batch(REACH, 1, **VARIED | {"randomize.mass_factor": (0.8, 0.8)})
    alone.reset(seeds=[5])
    alone.reset()
    assert np.array_equal(constants_of(alone)["mass"][0], constants_of(batch)["mass"][1])
    with pytest.raises(ValueError, match=r"mass_factor=.* must lie in the range"):
        batch.simulation.randomization.fix("mass_factor", np.full(3, 1.7))
    with pytest.raises(ValueError, match=r"stiffness_factor=.* must lie in the range"):
        make_batch(REACH, 1).simulation.randomization.fix("stiffness_factor", np.ones(1))


# The time step.


def test_the_time_step_is_that_of_the_worst_body(make_batch):
    # Substeps go with the wave speed ``sqrt(stiffness / density)`` of the ranges, whatever has been drawn.
    plain = make_batch(REACH, 1).simulation.model
    for stiffness, mass in (((1.0, 4.0), (1.0, 1.0)), ((1.0, 1.0), (0.25, 1.0)), ((0.5, 2.0), (0.5, 3.0))):
        settings = {"randomize.stiffness_factor": stiffness, "randomize.mass_factor": mass}
        model = make_batch(REACH, 2, **settings).simulation.model
        assert model.sound_speed == pytest.approx(2.0 * plain.sound_speed, rel=1e-6)
        assert model.step.dt * model.sound_speed <= 0.5 * model.grid.dx * (1.0 + 1e-6)
        assert model.num_substeps == np.ceil(2.0 * model.control_dt * plain.sound_speed / (0.5 * model.grid.dx) - 1e-6)
    # a body that can only be slower has the nominal one's
    slower = make_batch(REACH, 2, **{"randomize.mass_factor": (4.0, 9.0)}).simulation.model
    assert slower.num_substeps == plain.num_substeps


def test_a_time_step_that_a_draw_could_break_is_refused(make_batch, device):
    plain = make_batch(REACH, 1).simulation.model
    least = int(np.ceil(plain.control_dt * plain.sound_speed / (CFL_STABLE * plain.grid.dx)))
    task, fidelity = load_task(REACH), {"fidelity": "tiny", "num_substeps": least}
    BatchEnv(task(load_config(task.Config, None, fidelity)), 1, device)
    stiff = load_config(task.Config, None, {**fidelity, "randomize.stiffness_factor": (0.1, 4.0)})
    with pytest.raises(ValueError, match=rf"CFL limit .*use num_substeps >= {2 * least - 1}|{2 * least}"):
        BatchEnv(task(stiff), 1, device)


@pytest.mark.parametrize(("bounds", "value"), [((0.0, 1.0), "0=0.0"), ((2.0, 1.0), "="), (2.0, "=2.0")])
def test_ranges_that_are_none_are_refused(bounds, value):
    with pytest.raises(ConfigError, match=rf"randomize\.mass_factor\.?{value}"):
        load_config(load_task(REACH).Config, None, {"mass_factor": bounds})


# The physics.


def compressed(batch) -> np.ndarray:
    """Return the physical velocity of every particle after one short step from the same compressed, resting body."""
    state = batch.get_state()
    state["particles.F"][:] = np.diag([0.95, 1.0, 1.02]).reshape(9, 1)
    batch.set_state(state)
    batch.step()
    return batch.get_state()["particles.u"].astype(float)


def test_flesh_answers_by_stiffness_over_mass(make_batch):
    # One substep from the same strain: du = dt f / m with f of the moduli; nothing else acts on the body.
    settings = {**FREE, "control_dt": 1e-3, "num_substeps": 1, "tone": 0.0, "alpha": 0.0, "scene.ground": False}
    plain, batch = make_batch(REACH, 3, **settings), make_batch(REACH, 3, **settings, **VARIED)
    for b in (plain, batch):
        b.action.zero_()
        b.reset(seeds=[1, 2, 3])
    factors, nominal, varied = factors_of(batch), compressed(plain), compressed(batch)
    ratio = (factors["stiffness_factor"] / factors["mass_factor"])[:, 0]
    assert np.ptp(ratio) > 0.3
    for e in range(3):
        scale = np.abs(nominal[e]).max()
        assert varied[e] / scale == pytest.approx(ratio[e] * nominal[e] / scale, abs=2e-4)


def momenta(batch) -> np.ndarray:
    """Return the momentum and angular momentum about the origin of every environment, shape ``(num_envs, 6)``."""
    s, mass = batch.get_state(), constants_of(batch)["mass"].astype(float)[..., None]
    x, v = s["particles.x"].astype(float), s["particles.u"].astype(float) + s["particles.vk"]
    return np.concatenate([(mass * v).sum(1), (mass * np.cross(x, v)).sum(1)], axis=1)


def test_a_floating_body_keeps_its_momentum(make_batch):
    # Shape, tone and commanded motion give back what they take: by bone masses that are those of the particles.
    batch = make_batch(REACH, 3, **FREE, **VARIED, **{"shape.randomize": True, "scene.ground": False})
    batch.reset(seeds=[1, 2, 3])
    state = batch.get_state()
    state["particles.u"] += np.float32([0.3, -0.2, 0.1])
    batch.set_state(state)
    before, mass = momenta(batch), constants_of(batch)["mass"].sum(1, keepdims=True)
    rng = np.random.default_rng(0)
    for _ in range(8):
        batch.action.assign(rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
    batch.action.zero_()
    assert not batch.failure.numpy().any()
    assert np.abs(momenta(batch) - before).max() < 2e-4 * mass.min() and np.ptp(mass) > 5.0


def test_the_root_carries_the_drawn_weight(make_batch):
    batch = make_batch(REACH, 3, pose_noise=0.0, **VARIED)
    batch.reset(seeds=[5, 6, 7])
    batch.action.zero_()
    for _ in range(20):
        batch.step()
    force = batch.simulation.avatar.state.wrench_force.numpy()[:, 2]
    weight = 9.81 * constants_of(batch)["mass"].sum(1)
    assert force == pytest.approx(weight, rel=0.02) and np.ptp(weight) > 50.0


def test_things_slide_by_the_drawn_friction(make_batch):
    # A box on the floor loses ``factor mu g`` of its speed per second.
    box = {"name": "box", "shape": "box", "size": (0.3, 0.3, 0.3), "friction": 0.4, "mass": 100.0}
    box |= {"position": (0.0, -1.2, 0.3), "velocity": (1.5, 0.0, 0.0)}
    batch = make_batch(REACH, 3, **VARIED, **{"scene.props": [box]})
    batch.reset(seeds=[1, 2, 4])
    batch.action.zero_()
    speeds = []
    for _ in range(12):
        batch.step()
        speeds.append(batch.simulation.props.state.velocity.numpy()[:, 0, 0].copy())
    lost = (speeds[2] - speeds[-1]) / (9 / 30)
    friction = 0.4 * factors_of(batch)["ground_friction_factor"]
    assert np.ptp(friction) > 0.1 and (speeds[-1] > 0.05).all()
    assert lost == pytest.approx(9.81 * friction, rel=0.08)


def test_bodies_rub_by_the_drawn_friction(make_batch):
    # A box on a slab that stays loses speed as the drawn coefficient says, as well as soft bodies at tiny can.
    slab = {"name": "slab", "shape": "box", "size": (0.55, 0.45, 0.25), "friction": 5.0, "mass": 400.0}
    box = {"name": "box", "shape": "box", "size": (0.28, 0.28, 0.2), "mass": 30.0, "velocity": (1.2, 0.0, 0.0)}
    props = [slab | {"position": (0.2, -1.2, 0.25)}, box | {"position": (0.0, -1.2, 0.71)}]
    settings = {"physics.friction": 5.0, "body_friction": 0.25, "body_friction_factor": (0.4, 2.0)}
    batch = make_batch(REACH, 4, **settings, **{"scene.props": props})
    batch.reset(seeds=[1, 2, 3, 4])
    batch.action.zero_()
    for _ in range(5):
        batch.step()
    lost = 1.2 - batch.simulation.props.state.velocity.numpy()[:, 1, 0]
    factor = factors_of(batch)["body_friction_factor"]
    assert factor.max() > 3.0 * factor.min()
    assert lost / lost.mean() == pytest.approx(factor / factor.mean(), rel=0.2)


# Checkpoints; tests/envs/test_batch_env.py runs with random factors as well.


def everything(batch, steps: int) -> list[np.ndarray]:
    rng, log = np.random.default_rng(0), [batch.observation.numpy().copy()]
    for _ in range(steps):
        batch.action.assign(rng.uniform(-0.5, 0.5, batch.action.shape).astype(np.float32))
        batch.step()
        log += [batch.observation.numpy().copy(), batch.reward.numpy().copy()]
    batch.action.zero_()
    return log


@pytest.mark.parametrize("task", [REACH, "PIAvatar/KickBall-v0"])
def test_a_restored_state_brings_what_was_drawn(make_batch, task, equal):
    settings = {"observe_parameters": True, "shape.randomize": True, **VARIED}
    batch = make_batch(task, 2, **settings)
    batch.reset(seeds=[3, 4])
    state, constants = batch.get_state(), constants_of(batch)
    expected = everything(batch, 4)
    batch.reset(seeds=[8, 9])
    assert not np.allclose(constants_of(batch)["mass"], constants["mass"])
    batch.set_state(state)
    assert all(np.array_equal(value, constants[name]) for name, value in constants_of(batch).items())
    nominal = constants["mass"] / factors_of(batch)["mass_factor"]
    assert batch.simulation.flesh[0].points.mass == pytest.approx(nominal, rel=1e-6)
    assert all(equal(a, b) for a, b in zip(everything(batch, 4), expected, strict=True))
