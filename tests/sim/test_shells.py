"""Garments as thin shells in MPM in a world: their weight is carried, momentum is kept, batches equal singles."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.config import ClothConfig, ConfigError
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.sim.shells import bytes_of_shells, shell_matter
from tests.sim.dressed import BALL, moved

REACH, STAND = "PIAvatar/Reach-v0", "PIAvatar/Stand-v0"
#: Meshes of few vertices, soft enough for few substeps.
SOFT = {"stretch": 40.0}
SKIRT = {"kind": "skirt", "length": 0.4, "edge": 0.07, **SOFT}
WORN = {"garments": [SKIRT], "cloth": {"solver": "mpm"}}
EMPTY = {"gravity": 0.0, "scene": {"ground": False, "walls": False}}


def test_a_reset_places_the_particles_where_the_drape_is(make_batch):
    batch = make_batch(REACH, 2, **WORN, pose_noise=0.0)
    batch.reset(seeds=[0, 1])
    simulation = batch.simulation
    cloth, first = simulation.garments.cloth, simulation.subjects.first[-1]
    x, matter = cloth.state.x.numpy(), cloth.matter
    particles = simulation.state.x.numpy()[:, first:]
    free = matter.vertex >= 0
    np.testing.assert_array_equal(particles[:, matter.vertex[free]], x[:, free])
    np.testing.assert_allclose(particles[:, matter.triangle], x[:, cloth.mesh.faces].mean(axis=2), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(cloth.director.numpy(), axis=2), 1.0, atol=1e-5)
    graph = LaunchGraph(batch.device)
    cloth.record_places(graph)
    graph.run()  # the skin's bones placed held vertices, now the particles of the waist do
    assert np.abs(cloth.state.x.numpy() - x)[:, ~free].max() < 0.01
    before = moved(batch, 3, of=2)
    batch.reset(np.array([False, True]))
    after = batch.get_state()
    np.testing.assert_array_equal(after["cloth.x"][0], before["cloth.x"][0])
    np.testing.assert_array_equal(after["particles.u"][0], before["particles.u"][0])
    assert not after["particles.u"][1, first:].any()


@pytest.mark.parametrize("mode", ["pose", "pd"])
def test_a_skirt_is_worn_and_its_weight_is_carried(make_env, mode):
    settings = {"pose_noise": 0.0} | ({} if mode == "pose" else {"control": "pd", "root_assist": 1.0})
    env = make_env(REACH if mode == "pose" else STAND, **WORN, **settings)
    env.reset(seed=0)
    simulation, carried = env.batch.simulation, []
    cloth, dt = simulation.garments.cloth, env.config.physics.control_dt
    mass, first = simulation.model.particles.mass.numpy()[0].astype(float), simulation.subjects.first[-1]
    for _ in range(100):
        info = env.step(np.zeros(env.action_space.shape, np.float32))[4]
        carried.append(info["root_force"][2] + simulation.sensors.boundary_impulse.numpy()[0, 0, 2] / dt)
    body, weight = 9.81 * mass[:first].sum(), 9.81 * mass[first:].sum()
    assert weight > 0.3
    assert np.mean(carried[-30:]) == pytest.approx(body + weight, abs=0.1 * weight)
    assert np.sqrt((cloth.state.v.numpy() ** 2).sum(axis=2).mean()) < 0.1
    assert np.abs(cloth.mesh.strain(cloth.state.x.numpy()[0].astype(float))).mean() < 0.05


@pytest.mark.parametrize("mode", ["pose", "torque"])
def test_a_body_and_its_garment_keep_momentum_together(make_env, mode):
    settings = {"pose": {"control": "pose", "root": "free"}, "torque": {"control": "torque"}}[mode]
    env = make_env(REACH if mode == "pose" else STAND, **WORN, **settings, **EMPTY)
    env.reset(seed=0)
    simulation = env.batch.simulation
    for name in ("drag", "skin_drag"):
        getattr(simulation.garments.cloth.fabric, name).zero_()
    u = simulation.state.u.numpy()
    u[:, simulation.subjects.first[-1] :, 0] = 0.5  # the skirt swings, and pulls at the waist
    simulation.state.u.assign(u)
    start = totals(simulation.model, simulation.state)
    for _ in range(4):
        env.step(np.zeros(env.action_space.shape, np.float32))
    end = totals(simulation.model, simulation.state)
    scale = max(start.momentum_scale, end.momentum_scale)
    assert end.momentum == pytest.approx(start.momentum, abs=2e-5 * scale)


def test_environments_of_a_batch_equal_single_ones(make_batch, equal):
    settings = {
        **WORN,
        "scene": {"props": [BALL]},
        "shape": {"randomize": True, "pool": 3},
        "randomize": {"cloth_stiffness_factor": [0.8, 1.2]},
    }
    several, single = make_batch(REACH, 2, **settings), make_batch(REACH, 1, **settings)
    several.reset(seeds=[4, 5])
    found = moved(several, 5, of=2)
    assert len(np.unique(found["cloth.stretch"][:, 0])) == 2 and not found["particles.failure"].any()
    for env in range(2):
        single.reset(seeds=[4 + env])
        for name, value in moved(single, 5, envs=slice(env, env + 1), of=2).items():
            if name.startswith(("cloth", "particles", "randomize", "props")):
                assert equal(found[name][env], value[0]), (name, env)


def test_a_saved_state_goes_on_bit_for_bit(make_batch, equal):
    batch = make_batch(REACH, 2, **WORN)
    batch.reset(seeds=[1, 2])
    saved = {name: value.copy() for name, value in moved(batch, 3, of=2).items()}
    there = {name: value.copy() for name, value in moved(batch, 3, seed=7, of=2).items()}
    batch.reset(seeds=[7, 8])
    batch.set_state(saved)
    for name, value in moved(batch, 3, seed=7, of=2).items():
        assert equal(value, there[name]), name


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (
            {"cloth": {"solver": "mpm", "self_collision": True}},
            r"cloth.self_collision=true has no effect.*leave it out",
        ),
        ({"decoupling": "no_stress"}, r"decoupling='no_stress'.*'split'"),
        ({"randomize": {"cloth_mass_factor": [0.5, 1.0]}}, r"cloth_mass_factor.*xpbd"),
        ({"num_substeps": 3}, r"num_substeps=3.*skirt.*17\.3 m/s.*at least 5.*`stretch`"),
    ],
)
def test_what_the_solver_does_not_support_is_refused_with_a_remedy(make_batch, settings, text):
    with pytest.raises((ConfigError, ValueError), match=text):
        make_batch(REACH, 1, **(WORN | settings))


def test_edges_that_are_too_long_for_a_fine_grid_are_refused(make_batch):
    simulation = make_batch(REACH, 1, **WORN).simulation
    garments = simulation.garments.garments
    with pytest.raises(ConfigError, match=r"edges of a skirt are \d+ mm.*`edge`"):
        shell_matter(simulation.config, garments, 0.01)
    assert 0 < bytes_of_shells([garment.mesh for garment in garments]) < 100_000
    assert shell_matter(simulation.config.model_copy(update={"cloth": ClothConfig()}), garments, 0.01) is None
