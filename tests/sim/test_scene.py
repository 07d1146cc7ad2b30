"""Worlds: avatars with settings of their own, props, colliders, friction by name, and impossible scenes."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, JOINT_NAMES
from piavatar_envs.config import ConfigError, EnvConfig, load_config
from piavatar_envs.mpm.materials import DAMPING_FREQUENCY, material_index
from piavatar_envs.sim.scene import Domain
from piavatar_envs.sim.world import Simulation

BALL = {"name": "ball", "mass": 0.5, "position": [0.0, -1.0, 1.0]}


def world(device, num_envs=1, settings=None, **scene) -> Simulation:
    """Return a world of tiny bodies."""
    overrides = {"fidelity": "tiny", "scene": scene, **(settings or {})}
    return Simulation(load_config(EnvConfig, None, overrides), num_envs, device)


def test_as_many_avatars_as_the_scene_says(device):
    count = 3
    avatars = [{"position": [0.8 * index, 0.0], "yaw": 0.5 * index} for index in range(count)]
    simulation = world(device, avatars=avatars)
    single = world(device)
    assert len(simulation.avatars) == len(simulation.flesh) == count
    assert simulation.model.num_particles == count * single.model.num_particles
    assert simulation.subjects.names == tuple(f"agent_{index}" for index in range(count))
    assert simulation.model.contact.num_fields == count
    field, first = simulation.model.particles.field.numpy(), simulation.subjects.first
    for index in range(count):
        assert (field[first[index] : first[index + 1]] == index).all()
    upper = np.asarray(simulation.model.grid.origin) + simulation.dx * (np.asarray(simulation.model.grid.nodes) - 2)
    assert upper[0] >= Domain().upper[0] + 0.8 * (count - 1) - 1e-3


def test_the_domain_grows_with_bodies_taller_than_it_is_made_for():
    usual, ring = Domain(), Domain(fenced=True)
    assert usual.for_height(1.7) == usual.for_height(2.0) == usual
    assert usual.for_height(3.0).upper == pytest.approx((2.4, 2.4, 3.9))
    assert usual.for_height(3.0).lower == pytest.approx((-2.4, -2.4, -0.3))
    assert ring.for_height(3.0).upper == pytest.approx((1.6, 1.6, 3.9)) and ring.for_height(3.0).fenced


def test_avatars_have_settings_of_their_own(device):
    avatars = [
        {},
        {
            "position": [1.0, 0.0],
            "control": {"tone": 0.25, "alpha": 0.1, "max_root_force": 0.5},
            "physics": {"young_modulus": 5.0e4, "density": 900.0, "material": "fixed_corotated"},
            "shape": {"parameters": {"height": 0.8}},
        },
    ]
    simulation = world(device, avatars=avatars)
    a, b = (controller.parameters for controller in simulation.controllers)
    assert b.tone_rate / a.tone_rate == pytest.approx(0.25)
    assert b.max_root_force / a.max_root_force == pytest.approx(0.5 / 2.0)
    assert b.shape_rate / a.shape_rate == pytest.approx(0.1 / 0.3)
    own = slice(simulation.subjects.first[1], simulation.subjects.first[2])
    particles = simulation.model.particles
    assert np.unique(particles.material.numpy()[0, own]).tolist() == [material_index("fixed_corotated")]
    assert (particles.mu.numpy()[0, own] == np.float32(5.0e4 / 2.6)).all()
    assert particles.mass.numpy()[0, own].sum() == pytest.approx(900.0 * simulation.flesh[1]._volume.sum(), rel=1e-4)
    heights = [np.ptp(flesh.points.rest[0][:, 2]) for flesh in simulation.flesh]
    assert heights[1] > heights[0] + 0.05


def test_the_softest_avatar_does_not_set_the_time_step(device):
    stiff = world(device, avatars=[{"physics": {"young_modulus": 4.0e5}}, {"position": [1.0, 0.0]}])
    assert stiff.model.num_substeps == pytest.approx(2.0 * world(device).model.num_substeps, abs=1)


def test_regions_are_of_another_material(device):
    regions = [
        {"joints": ["head"], "material": "fixed_corotated", "young_modulus": 5.0e3},
        {"joints": ["left_ankle", "right_ankle"], "young_modulus": 2.0e5, "density": 1200.0},
    ]
    simulation = world(device, avatars=[{"regions": regions}])
    owner = np.array([JOINT_NAMES[j] for j in simulation.flesh[0].sampled.skin_joints[:, 0]])
    particles = simulation.model.particles
    young = particles.mu.numpy()[0] * 2.6
    head, ankle = owner == "head", np.isin(owner, ("left_ankle", "right_ankle"))
    assert head.any() and ankle.any()
    assert young[head] == pytest.approx(5.0e3, rel=1e-5) and young[ankle] == pytest.approx(2.0e5, rel=1e-5)
    assert young[~head & ~ankle] == pytest.approx(1.0e5, rel=1e-5)
    material = np.where(head, material_index("fixed_corotated"), material_index("neo_hookean"))
    assert (particles.material.numpy()[0] == material).all()
    density = particles.mass.numpy()[0] / particles.volume.numpy()[0]
    assert density[ankle] == pytest.approx(1200.0, rel=1e-4) and density[~ankle] == pytest.approx(1000.0, rel=1e-4)


def test_flesh_of_a_region_misses_a_share_of_commanded_motion_of_its_own(device):
    avatars = [{"regions": [{"joints": ["head"], "soft_tissue": 0.6}]}]
    simulation = world(device, avatars=avatars)
    sampled, lag = simulation.flesh[0].sampled, simulation.avatars[0].body.velocity_lag.numpy()[0]
    head = (sampled.skin_joints[:, 0] == JOINT_NAMES.index("head")) & (sampled.bone < 0)
    assert head.any() and lag[head] == pytest.approx(0.6)
    usual = world(device).avatars[0].body.velocity_lag.numpy()[0]
    assert np.array_equal(lag[~head], usual[~head])
    with pytest.raises(ConfigError, match=r"soft_tissue belongs to control.mode='pose', and has no effect under 'tor"):
        load_config(EnvConfig, None, {"control": "torque", "scene.avatars": avatars})


def test_matter_has_viscosity_of_its_own(device):
    # As a viscosity or as a damping ratio, of the flesh, of a region of it, and of a prop, which has none unless given.
    avatars = [{"physics": {"damping_ratio": 0.1}, "regions": [{"joints": ["head"], "viscosity": 50.0}]}]
    props = [{**BALL, "viscosity": 20.0}, {**BALL, "name": "other", "position": (0.5, -1.0, 1.0)}]
    simulation = world(device, avatars=avatars, props=props)
    first, particles = simulation.subjects.first, simulation.model.particles
    viscosity = particles.retardation.numpy()[0] * particles.mu.numpy()[0]
    owner = np.array([JOINT_NAMES[j] for j in simulation.flesh[0].sampled.skin_joints[:, 0]])
    of_ratio = 0.1 / (np.pi * DAMPING_FREQUENCY) * 1.0e5 / 2.6
    assert viscosity[: first[1]] == pytest.approx(np.where(owner == "head", of_ratio + 50.0, of_ratio), rel=1e-5)
    assert viscosity[first[1] : first[2]] == pytest.approx(20.0, rel=1e-5)
    assert (viscosity[first[2] :] == 0.0).all()


def test_viscous_matter_sets_the_time_step(device):
    # Of the most viscous flesh that can be drawn: stiffness scales viscosity.
    plain, viscous = (world(device, settings={"damping_ratio": ratio}) for ratio in (0.0, 0.5))
    drawn = world(device, settings={"damping_ratio": 0.5, "randomize": {"stiffness_factor": (1.0, 1.5)}})
    assert plain.model.num_substeps < viscous.model.num_substeps < drawn.model.num_substeps
    with pytest.raises(ValueError, match=f"num_substeps >= {viscous.model.num_substeps}, or less viscosity"):
        world(device, settings={"damping_ratio": 0.5, "num_substeps": viscous.model.num_substeps - 1})


def test_props_begin_inside_the_domain(device):
    # One that reaches less than half a grid spacing out is pushed back; the message says where it is inside.
    for place, message in {
        (3.0, -1.0, 1.0): r"'ball' .*x=-1.6 and 1.6 m.* x in \[-1.52, 1.52\] m",
        (0.0, -1.65, 1.0): "y=-1.6 and 1.6 m",
        (0.0, -1.0, 2.65): "z=-0.3 and 2.6 m",
    }.items():
        with pytest.raises(ConfigError, match=message):
            world(device, props=[{**BALL, "position": place}])
    edge = Domain().upper[1] - 0.08 + 0.4 * world(device).dx
    world(device, props=[{**BALL, "position": (0.0, edge, 1.0)}])
    plank = {"name": "plank", "shape": "box", "size": [0.9, 0.1, 0.1], "position": [0.9, -1.0, 1.0]}
    with pytest.raises(ConfigError, match=r"'plank' .* x=-1.6 and 1.6"):
        world(device, props=[plank])
    world(device, props=[{**plank, "rotation": [1.0, 0.0, 1.0, 0.0]}])
    with pytest.raises(ConfigError, match="make it smaller"):
        world(device, props=[{**plank, "size": [2.0, 0.1, 0.1]}])
    # what is around moves with the avatars, and is wider under torques
    world(device, props=[{**BALL, "position": [3.0, -1.0, 1.0]}], avatars=[{"position": [3.0, 0.0]}])
    torques = {"fidelity": "tiny", "control": "torque", "scene": {"props": [{**BALL, "position": [2.5, -1.0, 1.0]}]}}
    Simulation(load_config(EnvConfig, None, torques), 1, device)


@pytest.mark.parametrize(
    ("task", "settings", "axis"),
    [
        ("PIAvatar/KickBall-v0", {"ball_place": (0.0, 1.1), "ball_jitter": 0.2}, "y"),
        ("PIAvatar/Header-v0", {"ball_height": (6.0, 6.5), "ball_speed": 2.0}, "x"),
    ],
)
def test_places_that_episodes_draw_are_inside_the_domain(make_batch, task, settings, axis):
    with pytest.raises(ConfigError, match=f"out of the domain, which ends at {axis}="):
        make_batch(task, **settings)


@pytest.mark.parametrize("task", ["PIAvatar/KickBall-v0", "PIAvatar/Header-v0", "PIAvatar/PushBox-v0"])
def test_episodes_draw_the_places_that_are_looked_at(make_batch, task):
    batch = make_batch(task, 32)
    ((name, places),) = batch.task.prop_places().items()
    drawn = []
    for episode in range(8):
        batch.reset(seeds=range(32) if episode == 0 else None)
        drawn.append(batch.simulation.props.initial.position.numpy()[:, batch.simulation.props.index(name)])
    drawn, places = np.concatenate(drawn), np.array(places)
    low, high = places.min(0), places.max(0)
    assert (drawn >= low - 1e-6).all() and (drawn <= high + 1e-6).all()
    # no wider than they need be: what is drawn comes near the limits, but where several draws would have to agree
    assert (np.ptp(drawn, axis=0) >= 0.6 * (high - low)).all()


def test_a_place_of_no_prop_is_refused(device):
    from piavatar_envs.envs.batch_env import BatchEnv
    from piavatar_envs.tasks.kick_ball import KickBallTask

    class Lost(KickBallTask):
        def prop_places(self):
            return {"bal": [(0.0, 0.0, 0.2)]}

    with pytest.raises(ConfigError, match=r"no prop 'bal' .*; use one of ball"):
        BatchEnv(Lost(load_config(Lost.Config, None, {"fidelity": "tiny"})), 1, device)


def test_props_have_their_mass_and_the_fleshs_wave_speed(device):
    brick = {"name": "brick", "shape": "box", "size": [0.2, 0.2, 0.2], "density": 300.0, "young_modulus": 2e4}
    props = [BALL, brick | {"position": [0.0, 1.0, 1.0]}]
    simulation = world(device, num_envs=2, props=props)
    assert simulation.props.mass[0] == pytest.approx(0.5, rel=1e-6)
    particles, first = simulation.model.particles, simulation.subjects.first
    ball, brick = slice(first[1], first[2]), slice(first[2], first[3])
    assert particles.mass.numpy().shape[0] == 2
    assert particles.mass.numpy()[0, ball].sum() == pytest.approx(0.5, rel=1e-5)
    assert particles.mass.numpy()[0, brick].sum() == pytest.approx(300.0 * 0.4**3, rel=1e-4)
    density = particles.mass.numpy()[0, ball] / particles.volume.numpy()[0, ball]
    waves = (particles.lam.numpy()[0, ball] + 2.0 * particles.mu.numpy()[0, ball]) / density
    flesh = (particles.lam.numpy()[0, 0] + 2.0 * particles.mu.numpy()[0, 0]) / 1000.0
    assert waves == pytest.approx(flesh, rel=1e-4)
    assert simulation.model.num_substeps == world(device).model.num_substeps


def test_friction_of_pairs(device):
    simulation = world(
        device,
        avatars=[{}, {"position": [1.0, 0.0]}],
        props=[BALL | {"friction": 0.1}],
        colliders=[{"name": "wall", "size": [0.1, 1.0, 1.0], "position": [-1.2, 0.0, 1.0], "friction": 0.4}],
        body_friction=0.6,
        pair_friction=[
            {"a": "ball", "b": "agent_1", "friction": 0.0},
            {"a": "ground", "b": "agent_0", "friction": 1.5},
        ],
    )
    table = simulation.model.contact.friction.numpy()[0].reshape(3, 3)
    assert table[0, 1] == table[1, 0] == np.float32(0.6)
    assert table[0, 2] == np.float32(0.6) and table[1, 2] == table[2, 1] == 0.0
    count = simulation.model.boundaries.count
    on_solids = simulation.model.boundaries.friction.numpy()[0].reshape(3, count)
    assert on_solids[:, :2] == pytest.approx(np.array([[1.5, 0.4], [0.8, 0.4], [0.1, 0.1]]))
    assert not on_solids[:, 2:].any()  # the walls around the domain are smooth


POST = {"name": "post", "kind": "capsule", "size": [0.1, 0.4], "position": [0.0, 1.0, 0.5]}
RUBS = {"a": "ball", "b": "agent_0", "friction": 0.1}


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ({"props": [BALL, BALL]}, "'ball' is given twice"),
        ({"props": [BALL | {"size": [0.1, 0.2]}]}, "ball: size"),
        ({"props": [BALL | {"shape": "mesh", "size": [1.0]}]}, "ball: .*file"),
        ({"props": [BALL | {"mass": -1.0}]}, "mass=-1.0"),
        ({"props": [{"shape": "sphere"}]}, "name is missing"),
        ({"props": [BALL], "pair_friction": [RUBS, RUBS | {"a": "agent_0", "b": "ball"}]}, "'ball' are given twice"),
        ({"props": [BALL], "pair_friction": [RUBS | {"b": "ball"}]}, "'ball' .*itself"),
        ({"pair_friction": [RUBS | {"a": "agent_0"}]}, "'agent_0' .*itself; .*self_contact=true"),
        ({"colliders": [POST], "pair_friction": [RUBS | {"a": "ground", "b": "post"}]}, "'ground' and 'post' .*solids"),
        ({"props": [BALL, BALL | {"name": "twin"}]}, "'ball' would begin at .* inside 'twin'"),
        ({"props": [BALL | {"rotation": [0, 0, 0, 0]}]}, "quaternion wxyz"),
        ({"pair_friction": [RUBS]}, "no 'ball'"),
        ({"avatars": [{"control": {"tone": 2.0}}]}, "tone=2.0"),
        ({"avatars": [{"control": {"tune": 0.2}}]}, "control.tune"),
        ({"avatars": [{"physics": {"fidelity": "fine"}}]}, "fidelity"),
        ({"avatars": [{"regions": [{"joints": ["tail"]}]}]}, "'tail'"),
        ({"avatars": [{"regions": [{"joints": ["head"], "beyond": 3.0}]}]}, "'head'.*beyond=3.0 m"),
        ({"avatars": [{"position": [float(k), 0.0]} for k in range(7)], "self_contact": True}, "35 velocity fields"),
        ({"colliders": [{"name": "post", "kind": "capsule", "size": [0.1]}]}, "capsule must be 2"),
    ],
)
def test_what_cannot_be_is_refused(device, scene, message):
    with pytest.raises((ConfigError, ValueError), match=message):
        world(device, **scene)


def test_a_task_with_one_avatar_takes_no_second(make_env):
    with pytest.raises(ConfigError, match=r"scene\.avatars has 2 entries"):
        make_env("PIAvatar/Reach-v0", scene={"avatars": [{}, {"position": [1.0, 0.0]}]})


def test_any_task_takes_more_props_and_colliders(make_env):
    # A ball dropped beside the avatar falls freely, then rests on the floor; a kinematic box goes its way.
    scene = {
        "props": [BALL | {"position": [0.9, 0.0, 1.0], "size": [0.2]}],
        "colliders": [{"name": "lift", "size": [0.1, 0.1, 0.1], "position": [-1.2, 0.0, 0.5], "velocity": [0, 0, 0.3]}],
    }
    env = make_env("PIAvatar/Reach-v0", scene=scene)
    env.reset(seed=0)
    state, boundaries = env.batch.simulation.props.state, env.batch.simulation.model.boundaries
    for _ in range(6):
        env.step(np.zeros(env.action_space.shape))
    assert 1.0 - state.position.numpy()[0, 0, 2] == pytest.approx(0.5 * 9.81 * 0.2**2, rel=0.05)
    assert boundaries.position.numpy()[0, 1, 2] == pytest.approx(0.5 + 0.3 * 0.2, abs=1e-5)
    for _ in range(54):
        info = env.step(np.zeros(env.action_space.shape))[4]
    assert info["failure"] == 0
    assert state.position.numpy()[0, 0, 2] == pytest.approx(0.2, abs=0.05)
    assert np.abs(state.velocity.numpy()[0, 0]).max() < 0.3
    env.reset(seed=0)
    assert boundaries.position.numpy()[0, 1, 2] == pytest.approx(0.5)
    assert state.position.numpy()[0, 0] == pytest.approx([0.9, 0.0, 1.0], abs=1e-5)


def test_a_ball_that_hits_is_sensed_where_it_hits(make_env):
    # Thrown at the chest: the torso senses the momentum that the ball loses.
    ball = {"name": "ball", "mass": 2.0, "size": [0.2], "position": [0.0, -0.8, 1.2], "velocity": [0.0, 6.0, 0.0]}
    env = make_env("PIAvatar/Reach-v0", pose_noise=0.0, scene={"props": [ball]}, gravity=0.0)
    env.reset(seed=0)
    simulation = env.batch.simulation
    sensed, before = np.zeros((len(BODY_PARTS), 3)), simulation.props.state.velocity.numpy()[0, 0].copy()
    for _ in range(12):
        env.step(np.zeros(env.action_space.shape))
        sensed += simulation.sensors.part_impulse.numpy()[0, :, 1]
    lost = 2.0 * (before - simulation.props.state.velocity.numpy()[0, 0])
    assert lost[1] > 6.0  # it has hit
    assert sensed.sum(0) == pytest.approx(lost, abs=0.02 * float(np.abs(lost).max()))
    parts = dict(zip(BODY_PARTS, np.linalg.norm(sensed, axis=1), strict=True))
    assert parts["torso"] > 0.8 * sum(parts.values())
