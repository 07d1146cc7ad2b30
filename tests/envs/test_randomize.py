"""Random mass, stiffness and friction: every constant follows its factor, the physics follows the constants.

What is drawn depends on seed and episode alone, the time step on the ranges alone. What agents may observe of it, and
of what tasks draw, is tested over all of them.
"""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.parameters import ASSIST, PARAMETERS
from piavatar_envs.mpm.model import CFL_STABLE
from piavatar_envs.sim.randomize import OF_AVATAR, OF_WORLD, Parameter, draw_factors
from piavatar_envs.tasks import load_task

RANGES = {"mass_factor": (0.5, 1.6), "stiffness_factor": (0.4, 1.5)}
RANGES |= {"ground_friction_factor": (0.25, 1.25), "body_friction_factor": (0.5, 2.0)}
VARIED = {f"randomize.{name}": bounds for name, bounds in RANGES.items()}
REACH = "PIAvatar/Reach-v0"
#: Nothing but the flesh itself moves the body.
FREE = {"root": "free", "gravity": 0.0, "pose_noise": 0.0}


def factors_of(batch) -> dict[str, np.ndarray]:
    """Drawn factors by setting, of the world ``(num_envs,)`` and of avatars ``(num_envs, avatars)``."""
    random, avatars = batch.simulation.randomization, range(batch.num_agents)
    found = {name: random.column(name).numpy() for name in OF_WORLD}
    return found | {name: np.stack([random.column(name, a).numpy() for a in avatars], 1) for name in OF_AVATAR}


def constants_of(batch, avatar: int = 0) -> dict[str, np.ndarray]:
    """What follows from the factors, a row an environment."""
    sim, n = batch.simulation, batch.num_envs
    model, drive = sim.model, sim.avatars[avatar]
    own = slice(drive.body.first, drive.body.first + drive.body.count)
    subject = model.contact.subject.numpy()
    found = {name: getattr(model.particles, name).numpy()[:, own] for name in ("mass", "mu", "lam", "volume")}
    found |= {"bone_mass": drive.body.bone_mass.numpy(), "body_mass": drive.body_mass.numpy()[:, None]}
    found |= {"density": model.contact.density.numpy()[:, subject == avatar]}
    found |= {"ground": model.boundaries.friction.numpy(), "pairs": model.contact.friction.numpy()}
    return {name: np.broadcast_to(array, (n, array.shape[1])).copy() for name, array in found.items()}


FOLLOWS = {"mass": "mass_factor", "bone_mass": "mass_factor", "body_mass": "mass_factor", "density": "mass_factor"}
FOLLOWS |= {"mu": "stiffness_factor", "lam": "stiffness_factor"}
FOLLOWS |= {"ground": "ground_friction_factor", "pairs": "body_friction_factor"}


@pytest.mark.parametrize("one", [*RANGES, "all"])
def test_every_constant_follows_its_factor_and_nothing_else(make_batch, one):
    """In a world with a prop and limb fields; only what varies has rows of its own."""
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


def test_only_what_varies_has_rows_of_its_own(make_batch):
    rows = {}
    for name in ("none", *RANGES):
        batch = make_batch(REACH, 3, **({f"randomize.{name}": RANGES[name]} if name in RANGES else {}))
        model = batch.simulation.model
        particles = {key: getattr(model.particles, key).shape[0] for key in ("mass", "volume", "mu", "lam", "material")}
        rows[name] = {key for key, count in particles.items() if count > 1}
        rows[name] |= {"ground"} if model.boundaries.friction.shape[0] > 1 else set()
        rows[name] |= {"bones"} if batch.simulation.avatar.body.bone_mass.shape[0] > 1 else set()
        drawn = [key for key in batch.get_state() if key.startswith("randomize")]
        assert drawn == ([] if name == "none" else ["randomize.factors"])
    assert rows["none"] == rows["body_friction_factor"] == set()
    assert rows["mass_factor"] == {"mass", "bones"} and rows["stiffness_factor"] == {"mu", "lam"}
    assert rows["ground_friction_factor"] == {"ground"}


def test_random_shapes_have_random_density_too(make_batch):
    """Mass is factor times density times volume of the shape drawn, in the particles, the bones and all of it."""
    batch = make_batch(REACH, 3, **{"shape.randomize": True, **VARIED})
    for seeds in ([4, 5, 6], None):
        batch.reset(seeds=seeds)
        now, factor = constants_of(batch), factors_of(batch)["mass_factor"]
        mass = factor * batch.config.physics.density * now["volume"].astype(float).sum(1, keepdims=True)
        assert now["mass"].astype(float).sum(1, keepdims=True) == pytest.approx(mass, rel=1e-6)
        assert now["bone_mass"].sum(1, keepdims=True) == pytest.approx(mass, rel=1e-5)
        assert now["body_mass"] == pytest.approx(mass, rel=1e-5)
        assert now["density"] == pytest.approx(factor * batch.config.physics.density, rel=1e-6)
        # the shapes are those of the same seeds without random mass
        plain = make_batch(REACH, 3, **{"shape.randomize": True})
        plain.reset(seeds=seeds)
        assert np.array_equal(now["volume"], constants_of(plain)["volume"])
        nominal = batch.simulation.flesh[0].points.mass
        assert nominal == pytest.approx(now["mass"] / factor, rel=1e-6)


# The draws.


def drawn_factors(device, seeds, episodes, bounds) -> np.ndarray:
    n = len(seeds)
    out = wp.zeros((n, len(bounds)), dtype=float, device=device)
    inputs = [wp.array(np.ones(n, bool), dtype=wp.bool, device=device)]
    inputs += [wp.array(np.asarray(a, np.int32), dtype=int, device=device) for a in (seeds, episodes)]
    inputs += [wp.array(np.asarray(bounds, np.float32), dtype=wp.vec2, device=device)]
    wp.launch(draw_factors, out.shape, inputs, [out], device=device)
    return out.numpy()


def test_factors_are_uniform_in_their_logarithm(device):
    """Kolmogorov-Smirnov at 20,000 draws, over seeds and over episodes; bounds are kept, a point stays one."""
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


def test_a_factor_does_not_depend_on_the_other_ranges(device):
    seeds, episodes = np.arange(5), np.full(5, 3)
    one = drawn_factors(device, seeds, episodes, [(1.0, 1.0), (0.5, 2.0)])
    both = drawn_factors(device, seeds, episodes, [(0.5, 3.0), (0.5, 2.0)])
    assert np.array_equal(one[:, 1], both[:, 1])


# The time step.


def test_the_time_step_is_that_of_the_worst_body(make_batch):
    """Substeps go with the wave speed ``sqrt(stiffness / density)`` of the ranges, whatever has been drawn."""
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


@pytest.mark.parametrize(
    ("bounds", "told"),
    [
        ((0.0, 1.0), r"randomize.mass_factor.0=0.0 must be >= 0.001"),
        ((2.0, 1.0), r"randomize.mass_factor=.*lower one first"),
        ((-1.0, 1.0), r"randomize.mass_factor.0=-1.0 must be >= 0.001"),
        (2.0, "randomize.mass_factor=2.0 must be a list"),
    ],
)
def test_ranges_that_are_none_are_refused(bounds, told):
    with pytest.raises(ConfigError, match=told):
        load_config(load_task(REACH).Config, None, {"mass_factor": bounds})


# The physics.


def compressed(batch) -> np.ndarray:
    """Physical velocity of every particle after one short step from the same compressed, resting body."""
    state = batch.get_state()
    state["particles.F"][:] = np.diag([0.95, 1.0, 1.02]).reshape(9, 1)
    batch.set_state(state)
    batch.step()
    return batch.get_state()["particles.u"].astype(float)


def test_flesh_answers_by_stiffness_over_mass(make_batch):
    """One substep from the same strain: du = dt f / m with f of the moduli; nothing else acts on the body."""
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


def test_stress_goes_with_the_modulus(make_batch):
    """The same strain is observed as a stress that many times higher, in units of the nominal modulus."""
    plain, batch = make_batch(REACH, 3), make_batch(REACH, 3, **VARIED)
    seen = []
    for b in (plain, batch):
        b.reset(seeds=[1, 2, 3])
        state = b.get_state()
        state["particles.F"][:] = np.diag([0.95, 1.0, 1.02]).reshape(9, 1)
        b.set_state(state)
        seen.append(b.observation.numpy()[:, 0, b.layout["stress"].slice].copy())
    assert (seen[0] > 0.01).all()
    assert seen[1] / seen[0] == pytest.approx(
        np.repeat(factors_of(batch)["stiffness_factor"], seen[0].shape[1], 1), rel=1e-4
    )


def momenta(batch) -> np.ndarray:
    """Momentum and angular momentum about the origin of every environment, shape ``(num_envs, 6)``."""
    s, mass = batch.get_state(), constants_of(batch)["mass"].astype(float)[..., None]
    x, v = s["particles.x"].astype(float), s["particles.u"].astype(float) + s["particles.vk"]
    return np.concatenate([(mass * v).sum(1), (mass * np.cross(x, v)).sum(1)], axis=1)


def test_a_floating_body_keeps_its_momentum(make_batch):
    """Shape, tone and commanded motion give back what they take: by bone masses that are those of the particles."""
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


@pytest.mark.parametrize("limit", ["force", "torque"])
def test_limits_of_the_root_are_in_drawn_weights(make_batch, limit):
    """A command too far away: the wrench is as large as it may be, over the body's own weight."""
    settings = {"pose_noise": 0.0, "gravity": 0.0, "max_root_force": 0.5, "max_root_torque": 0.05, **VARIED}
    batch = make_batch(REACH, 3, **settings)
    batch.reset(seeds=[5, 6, 7])
    batch.action.zero_()
    state = batch.get_state()
    if limit == "force":
        state["avatar_0.state.command_root"][:, 0] += 0.4
    else:
        state["avatar_0.state.command_rotation"][:, 0] = np.float32([np.sin(0.3), 0.0, 0.0, np.cos(0.3)])
    batch.set_state(state)
    batch.step()
    drive = batch.simulation.avatar.state
    wrench = np.linalg.norm(getattr(drive, f"wrench_{limit}").numpy(), axis=1)
    share = {"force": 0.5, "torque": 0.05}[limit]
    assert wrench == pytest.approx(share * 9.81 * constants_of(batch)["mass"].sum(1), rel=5e-3)


def test_things_slide_by_the_drawn_friction(make_batch):
    """A box on the floor loses ``factor mu g`` of its speed a second."""
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
    """A box on a slab that stays loses speed as the drawn coefficient says, as well as soft bodies at tiny can."""
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


# Batches and checkpoints; tests/envs/test_batch_env.py runs with random factors, too.


def everything(batch, steps: int) -> list[np.ndarray]:
    rng, log = np.random.default_rng(0), [batch.observation.numpy().copy()]
    for _ in range(steps):
        batch.action.assign(rng.uniform(-0.5, 0.5, batch.action.shape).astype(np.float32))
        batch.step()
        log += [batch.observation.numpy().copy(), batch.reward.numpy().copy()]
    batch.action.zero_()
    return log


def test_a_restored_state_brings_what_was_drawn(make_batch, env_id, equal):
    settings = {"observe_parameters": True, "shape.randomize": True, **VARIED}
    batch = make_batch(env_id, 2, **settings)
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


# What is observed.


def seen(batch) -> np.ndarray:
    """The term of every environment and agent."""
    return batch.observation.numpy()[:, :, batch.layout[PARAMETERS].slice].copy()


def by_name(batch, agent: int = 0) -> dict[str, np.ndarray]:
    """Parameters in their units, by name, from what an agent observes."""
    parameters = batch.layout[PARAMETERS].parameters
    return {p.name: p.value(column) for p, column in zip(parameters, seen(batch)[:, agent].T, strict=True)}


@pytest.fixture
def observed(make_batch, env_id):
    settings = {"observe_parameters": True, "shape.randomize": True, **VARIED}
    if env_id.endswith("TrackMotion-v0"):
        settings["impulse_interval"] = 0.3
    batch = make_batch(env_id, 3, **settings)
    batch.reset(seeds=[11, 12, 13])
    return batch


def test_parameters_are_not_observed_unless_asked_for(make_batch, env_id):
    batch = make_batch(env_id, 3)
    assert PARAMETERS not in batch.layout and "env.parameters" not in batch.get_state()
    assert not any(term.parameters for term in batch.layout.values())


def is_setting(parameter: Parameter) -> bool:
    """Whether it is not drawn, but set for all episodes."""
    return parameter.name.endswith(ASSIST.name)


def check_term(batch, mask: np.ndarray) -> None:
    """What holds for every task: last in the layout, in range, differs between seeds, as the arrays say, constant."""
    term = batch.layout[PARAMETERS]
    assert list(batch.layout)[-1] == PARAMETERS and term.slice.stop == batch.layout.size
    assert term.size == len(term.parameters) and len({p.name for p in term.parameters}) == term.size
    for p in term.parameters:
        assert p.name in term.description and p.description and p.low < p.high
    first = seen(batch)
    assert (np.abs(first) <= 1.0).all() and (first[..., -1] == -1.0).all() and term.parameters[-1].name == "clock"
    for agent in range(batch.num_agents):
        spread = np.ptp(first[:, agent, :-1], axis=0)
        constant = {p.name for p, s in zip(term.parameters, spread, strict=False) if s == 0.0 and not is_setting(p)}
        assert not constant, f"{constant} do not differ between seeds"
    factors = factors_of(batch)
    for agent in range(batch.num_agents):
        told = by_name(batch, agent)
        for name in OF_WORLD:
            assert told[name] == pytest.approx(factors[name], rel=1e-5)
        for index in range(batch.num_agents):
            other = (agent + index) % batch.num_agents
            prefix = f"other_{index - 1}_" if index else ""
            for name in OF_AVATAR:
                assert told[prefix + name] == pytest.approx(factors[name][:, other], rel=1e-5)
            flesh = batch.simulation.flesh[other]
            for name, value in zip(flesh.asset.shape_names, flesh.shape_parameters.T, strict=True):
                assert told[f"{prefix}shape_{name}"] == pytest.approx(value, abs=1e-6)
        for p, drawn in zip(batch.task.drawn(), batch.task.drawn_values(batch), strict=True):
            values = drawn.scale * drawn.values.numpy()
            assert (values >= p.low - 1e-5).all() and (values <= p.high * (1 + 1e-5) + 1e-5).all(), p.name
            if p.low < p.high:
                assert told[p.name] == pytest.approx(values, rel=1e-4, abs=1e-5 * (p.high - p.low)), p.name
    batch.action.zero_()
    for step in range(3):
        batch.step()
        now = seen(batch)
        assert np.array_equal(now[..., :-1], first[..., :-1])
        assert now[..., -1] == pytest.approx(2.0 * (step + 1) / batch.max_steps - 1.0, abs=1e-6)
    batch.reset(env_mask=mask)
    after = seen(batch)
    assert np.array_equal(after[~mask], now[~mask]) and (after[mask][..., -1] == -1.0).all()
    drawn = [not is_setting(p) for p in term.parameters]
    assert (after[mask] != now[mask])[..., drawn].mean() > 0.9, "an environment that was reset must draw anew"


def test_parameters_are_what_was_drawn(observed):
    check_term(observed, np.array([False, True, False]))


def test_without_ranges_only_the_task_and_the_clock_are_told(make_batch, env_id):
    batch = make_batch(env_id, 3, observe_parameters=True)
    drawn = [p.name for p in batch.task.drawn() if p.low < p.high]
    settings = [] if batch.control == "pose" else [ASSIST.name]
    assert [p.name for p in batch.layout[PARAMETERS].parameters] == [*settings, *drawn, "clock"]


@pytest.mark.parametrize("control", ["pd", "torque"])
def test_help_for_the_pelvis_is_told_as_it_is_now(make_batch, control):
    """From the first observation after it has changed, in every environment its own, through resets and restoring."""
    batch = make_batch(REACH, 3, observe_parameters=True, control=control, root_assist=0.25, **VARIED)
    batch.assist_root(0.25)  # the batch may have been used before
    batch.reset(seeds=[1, 2, 3])
    name = ASSIST.name
    assert by_name(batch)[name] == pytest.approx(0.25)
    shares = np.array([0.0, 0.6, 1.0])
    batch.assist_root(shares)
    before = by_name(batch)
    batch.step()
    told = by_name(batch)
    assert told[name] == pytest.approx(shares, abs=1e-6)
    assert all(np.array_equal(told[other], before[other]) for other in told if other not in (name, "clock"))
    state = batch.get_state()
    batch.reset(env_mask=np.array([True, True, False]))
    assert by_name(batch)[name] == pytest.approx(shares, abs=1e-6)
    batch.assist_root(1.0)
    batch.reset()
    assert by_name(batch)[name] == pytest.approx(1.0)
    batch.set_state(state)
    assert by_name(batch)[name] == pytest.approx(shares, abs=1e-6)
    assert name not in by_name_of_poses(make_batch)


def by_name_of_poses(make_batch) -> dict[str, np.ndarray]:
    """What is told where a wrench holds the root."""
    batch = make_batch(REACH, 3, observe_parameters=True, **VARIED)
    batch.reset(seeds=[1, 2, 3])
    return by_name(batch)


def test_masses_of_props_are_told(observed):
    """From the particles: every prop whose mass a task draws has a parameter that is its mass."""
    sim, told = observed.simulation, by_name(observed)
    masses = sim.model.particles.mass.numpy().astype(float)
    for prop, name in zip(sim.props.props, sim.props.names, strict=True):
        mass = masses[:, prop.first : prop.first + prop.count].sum(1)
        assert told[f"{name}_mass"] == pytest.approx(mass, rel=1e-4), name


def test_the_way_of_the_target_is_known_from_what_is_told(make_batch):
    """Reach: where the target will be follows from its parameters and the clock."""
    batch = make_batch(REACH, 3, observe_parameters=True, **VARIED)
    batch.reset(seeds=[1, 2, 3])
    config, body = batch.config, batch.simulation.avatar.body
    center = np.broadcast_to(body.rest_joint.numpy()[:, batch.task.target.center], (3, 3))
    for _ in range(3):
        batch.step()
        told = by_name(batch)
        time = told["clock"] * batch.max_steps * config.physics.control_dt
        rate = config.target_speed * told["target_pace"] / (0.35 * config.radius * 1.4143)
        azimuth, elevation = (
            told[f"target_{angle}"] + 0.35 * part * np.sin(rate * time + told[f"target_phase_{angle}"])
            for angle, part in (("azimuth", np.cos(told["target_tilt"])), ("elevation", np.sin(told["target_tilt"])))
        )
        out = [np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
        goal = center + config.radius * np.stack(out, axis=1)
        assert batch.task.goal.numpy() == pytest.approx(goal, abs=1e-4)


@pytest.mark.parametrize("task", ["KickBall", "Header"])
def test_the_gate_stands_where_it_is_told(make_batch, task):
    batch = make_batch(f"PIAvatar/{task}-v0", 3, observe_parameters=True)
    batch.reset(seeds=[1, 2, 3])
    told, course = by_name(batch), batch.task.course
    start = batch.simulation.props.spawn.position.numpy()[:, 0]
    side = told["target_side"]
    way = told["target_distance"][:, None] * np.stack([side, -np.sqrt(1.0 - side**2)], axis=1)
    assert course.center.numpy()[:, :2] == pytest.approx(start[:, :2] + way, abs=1e-4)


def test_impulses_come_when_they_are_told(make_batch):
    """TrackMotion: the first ends the interval that was under way at the start; the clip begins where it is told."""
    batch = make_batch("PIAvatar/TrackMotion-v0", 4, observe_parameters=True, impulse_interval=0.3)
    batch.reset(seeds=[1, 2, 3, 4])
    told, interval, dt = by_name(batch), 9, batch.config.physics.control_dt
    start = np.round(told["motion_start"] / dt).astype(int)
    first = batch.task.rotations[start][:, :, [1, 2, 3, 0]]  # before a step is done
    commanded = batch.simulation.avatar.state.command_rotation.numpy()
    assert len(set(start.tolist())) > 1 and np.abs((first * commanded).sum(-1)) == pytest.approx(
        np.ones((4, 22)), abs=1e-5
    )
    struck = []
    for _ in range(interval):
        batch.step()
        struck.append(np.linalg.norm(batch.task.impulse.numpy(), axis=1) > 0.0)
    expected = interval - 1 - np.round(told["impulse_offset"] / dt).astype(int)
    assert np.array_equal(np.argmax(struck, axis=0), expected) and (np.sum(struck, axis=0) == 1).all()


def test_named_shape_parameters_and_points_are_no_parameters(make_batch):
    settings = {"shape.randomize": True, "shape.parameters": {"height": 0.4}, "shape.scale": 0.5}
    batch = make_batch(REACH, 3, observe_parameters=True, **settings, **{"randomize.mass_factor": (1.3, 1.3)})
    batch.reset(seeds=[1, 2, 3])
    parameters = batch.layout[PARAMETERS].parameters
    names = [p.name for p in parameters]
    assert "shape_height" not in names and "shape_weight" in names and "mass_factor" not in names
    assert (factors_of(batch)["mass_factor"] == np.float32(1.3)).all()
    assert by_name(batch)["shape_weight"] == pytest.approx(
        batch.simulation.flesh[0].shape_parameters[:, batch.simulation.asset.shape_names.index("weight")], abs=1e-6
    )
    assert {(p.low, p.high) for p in batch.layout[PARAMETERS].parameters if p.name.startswith("shape_")} == {
        (-0.5, 0.5)
    }


def test_a_parameter_knows_its_value():
    linear, log = Parameter("a", "m", 1.0, 3.0, "a"), Parameter("b", "kg", 0.1, 10.0, "b", log=True)
    assert linear.value(np.array([-1.0, 0.0, 0.5, 1.0])) == pytest.approx([1.0, 2.0, 2.5, 3.0])
    assert log.value(np.array([-1.0, 0.0, 0.5, 1.0])) == pytest.approx([0.1, 1.0, 10.0**0.5, 10.0])
