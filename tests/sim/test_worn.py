"""Garments that avatars wear in a world: resets, batches, checkpoints, random bodies and fabrics, games, failures."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.api.conformance import check_task
from piavatar_envs.config import ConfigError
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.mpm.types import FAILURE_CLOTH, failure_name
from piavatar_envs.sim.garments import bytes_of_garments
from tests.sim.dressed import BALL, moved

REACH, STAND = "PIAvatar/Reach-v0", "PIAvatar/Stand-v0"
#: A mesh of few vertices.
SKIRT = {"kind": "skirt", "length": 0.4, "edge": 0.07}
WORN = {"garments": [SKIRT]}
RANDOM = {
    **WORN,
    "shape": {"randomize": True, "pool": 3},
    "randomize": {"cloth_mass_factor": [0.5, 2.0], "cloth_stiffness_factor": [0.8, 1.2]},
}


def without_air(cloth) -> None:
    """Take away the air, which takes momentum."""
    for name in ("drag", "skin_drag"):
        getattr(cloth.fabric, name).zero_()


def momentum_of(simulation) -> tuple[np.ndarray, np.ndarray]:
    """Return momentum and angular momentum of bodies, props and cloth together."""
    body, cloth = totals(simulation.model, simulation.state), simulation.garments.cloth
    p = cloth.mass[0][:, None] * cloth.state.v.numpy()[0]
    return body.momentum + p.sum(axis=0), body.angular_momentum + np.cross(cloth.state.x.numpy()[0], p).sum(axis=0)


def test_without_garments_nothing_is_added(make_batch):
    batch = make_batch(REACH)
    assert batch.simulation.garments is None
    assert not [name for name in batch.get_state() if "cloth" in name]
    assert not {"advance_cloth", "find_normals", "receive_impulses"} & {
        *batch.step_graph.names,
        *batch.reset_graph.names,
    }


def test_a_reset_drapes_the_garment_on_the_wearer(make_batch):
    batch = make_batch(REACH, 2, **WORN, pose_noise=0.0)
    batch.reset(seeds=[0, 1])
    (garment,), state = batch.simulation.garments.garments, batch.simulation.garments.cloth.state
    pelvis = batch.simulation.avatar.tracked.position.numpy()[:, 0]
    shift = pelvis - batch.simulation.flesh[0].points.joints[0, 0]
    np.testing.assert_allclose(state.x.numpy()[0], garment.draped + shift[0], atol=2e-3)
    before = moved(batch, 3, envs=slice(0, 2))
    assert np.abs(before["cloth.v"]).max() > 0.0
    batch.reset(np.array([False, True]))
    after = batch.get_state()
    np.testing.assert_array_equal(after["cloth.x"][0], before["cloth.x"][0])
    assert not after["cloth.v"][1].any() and (after["cloth.near"][1] == -1).all()


def test_a_garment_at_rest_stays_and_its_weight_is_carried(make_env):
    env = make_env(REACH, **WORN, pose_noise=0.0)
    env.reset(seed=0)
    simulation, carried = env.batch.simulation, []
    cloth, dt = simulation.garments.cloth, env.config.physics.control_dt
    start = cloth.state.x.numpy().copy()
    for _ in range(90):
        info = env.step(np.zeros(env.action_space.shape, np.float32))[4]
        carried.append(info["root_force"][2] + simulation.sensors.boundary_impulse.numpy()[0, 0, 2] / dt)
    body = 9.81 * simulation.model.particles.mass.numpy()[0].sum()
    weight = 9.81 * cloth.mass.sum()
    assert weight > 0.3
    assert np.mean(carried[-30:]) == pytest.approx(body + weight, abs=0.1 * weight)
    assert np.abs(cloth.state.x.numpy() - start).max() < 0.01
    assert np.abs(cloth.state.v.numpy()).max() < 0.05


def test_stiff_cloth_of_short_edges_rests_too(make_env):
    env = make_env(REACH, garments=[{"kind": "scarf", "fabric": "fleece"}], pose_noise=0.0)
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.zeros(env.action_space.shape, np.float32))
    assert np.abs(env.batch.simulation.garments.cloth.state.v.numpy()).max() < 0.05


def test_bending_that_the_substeps_do_not_resolve_is_refused(make_batch):
    factors = {"cloth_stiffness_factor": [0.1, 10.0], "cloth_mass_factor": [0.1, 1.0]}
    with pytest.raises(ConfigError, match=r"cloth.substeps=20 .* skirt \(bending 0.03 N m, .*at least \d\d;"):
        make_batch(REACH, garments=[SKIRT | {"bending": 0.03}])
    with pytest.raises(ConfigError, match="times up to 100 by `randomize`"):
        make_batch(REACH, garments=[SKIRT | {"bending": 1e-3}], randomize=factors)
    with pytest.raises(ConfigError, match=r"bending=1 N m of the skirt needs \d+ substeps .* at most 1000"):
        make_batch(REACH, garments=[SKIRT | {"length": 0.2, "edge": 0.03, "bending": 1.0, "areal_density": 0.01}])


def test_environments_of_a_batch_equal_single_ones(make_batch, equal):
    several, single = make_batch(REACH, 3, **RANDOM), make_batch(REACH, 1, **RANDOM)
    several.reset(seeds=[4, 5, 6])
    found = moved(several, 6)
    density = found["cloth.areal_density"][:, 0]
    assert len(np.unique(density)) == 3 and (density >= 0.075).all() and (density <= 0.3).all()
    for env in range(3):
        single.reset(seeds=[4 + env])
        alone = moved(single, 6, envs=slice(env, env + 1))
        for name, value in alone.items():
            if name.startswith(("cloth", "particles", "randomize")):
                assert equal(found[name][env], value[0]), (name, env)


def test_a_saved_state_goes_on_bit_for_bit(make_batch, equal):
    batch = make_batch(REACH, 3, **RANDOM)
    batch.reset(seeds=[1, 2, 3])
    saved = {name: value.copy() for name, value in moved(batch, 4).items()}
    there = {name: value.copy() for name, value in moved(batch, 4, seed=7).items()}
    batch.reset(seeds=[7, 8, 9])
    batch.set_state(saved)
    again = moved(batch, 4, seed=7)
    for name, value in again.items():
        assert equal(value, there[name]), name


def test_garments_of_random_bodies_are_graded(make_batch):
    batch = make_batch(REACH, 3, **RANDOM, pose_noise=0.0)
    batch.reset(seeds=[1, 2, 3])
    garments = batch.simulation.garments
    edges, x = garments.cloth.mesh.edges, garments.cloth.state.x.numpy()
    length = garments.cloth.length.numpy()
    span = np.linalg.norm(x[:, edges[:, 0]] - x[:, edges[:, 1]], axis=2)
    assert np.std(length.sum(axis=1)) > 1e-3 * length.sum(axis=1).mean()  # the bodies differ
    assert np.abs(span / length - 1.0).mean() < 0.02
    (garment,) = garments.garments
    mean = garment.mesh.length.sum()
    assert (np.abs(length.sum(axis=1) / mean - 1.0) < 0.4).all()
    state = moved(batch, 5)
    assert not state["particles.failure"].any()
    span = np.linalg.norm(state["cloth.x"][:, edges[:, 0]] - state["cloth.x"][:, edges[:, 1]], axis=2)
    assert np.sqrt(((span / length - 1.0) ** 2).mean()) < 0.03


def test_factors_on_fabrics_are_observed(make_env):
    env = make_env(REACH, **RANDOM, observe_parameters=True)
    env.reset(seed=3)
    simulation = env.batch.simulation
    names = [p.name for p in env.batch.observer.parameters.term.parameters]
    factor = simulation.randomization.column("cloth_mass_factor").numpy()[0]
    nominal = simulation.garments.garments[0].fabric
    fabric = simulation.garments.cloth.fabric
    assert fabric.areal_density.numpy()[0, 0] == pytest.approx(factor * nominal.areal_density, rel=1e-6)
    stiffness = simulation.randomization.column("cloth_stiffness_factor").numpy()[0]
    assert fabric.stretch.numpy()[0, 0] == pytest.approx(stiffness * nominal.stretch, rel=1e-6)
    assert fabric.bending.numpy()[0, 0] == pytest.approx(stiffness * nominal.bending, rel=1e-6)
    assert fabric.friction.numpy()[0, 0] == pytest.approx(nominal.friction)
    assert "cloth_mass_factor" in names and "cloth_friction_factor" not in names


def test_the_contract_of_environments_is_kept(device):
    # a reset of one environment tracks all of them: what cloth has changed must have been tracked before
    check_task(REACH, 8, device, **RANDOM, observe_parameters=True)


def test_a_state_with_any_nearest_points_goes_on(make_batch):
    batch = make_batch(REACH, 2, **WORN)
    batch.reset(seeds=[0, 1])
    state = batch.get_state()
    state["cloth.near"][:] = np.random.default_rng(0).integers(-(2**31), 2**31, state["cloth.near"].shape)
    batch.set_state(state)
    batch.step()
    points = batch.simulation.garments.surfaces.obstacles.part.shape[0]
    free = batch.simulation.garments.cloth.mass[0] > 0.0  # held vertices have none
    near = batch.get_state()["cloth.near"][:, free, 0]
    assert (near >= -1).all() and (near < points).all() and not batch.failure.numpy().any()


def test_cloth_that_is_not_finite_fails_its_environment_alone(make_batch):
    batch = make_batch(REACH, 2, **WORN)
    batch.reset(seeds=[0, 1])
    state = batch.get_state()
    state["cloth.x"][1, 5, 0] = np.nan
    batch.set_state(state)
    batch.step()
    assert batch.failure.numpy().tolist() == [0, FAILURE_CLOTH] and failure_name(FAILURE_CLOTH) == "cloth"
    assert np.isfinite(batch.get_state()["particles.u"]).all()
    batch.reset(np.array([False, True]))
    batch.step()
    assert not batch.failure.numpy().any() and np.isfinite(batch.get_state()["cloth.x"]).all()


def test_memory_is_counted(make_batch):
    simulation = make_batch(REACH, 2, scene={"props": [BALL]}, **WORN).simulation
    garments = simulation.garments
    held = sum(array.capacity for array in arrays_of(garments.cloth, garments.surfaces, *garments._worn, garments))
    meshes = [own.mesh for own in garments.garments]
    counted = 2 * bytes_of_garments(meshes, simulation.flesh, simulation.props.points, num_envs=2)
    assert counted == pytest.approx(held, rel=0.2)


def arrays_of(*owners) -> list:
    """Return the arrays of a row per environment that objects and their structs hold."""
    found = {}
    for owner in owners:
        for value in vars(owner).values():
            for array in [
                value,
                *(getattr(value, name, None) for name in getattr(getattr(value, "_cls", None), "vars", ())),
            ]:
                if (
                    getattr(array, "ndim", 0) >= 1
                    and hasattr(array, "capacity")
                    and array.shape[0] == 2
                    and array.ndim > 1
                ):
                    found[array.ptr] = array
    return list(found.values())


@pytest.mark.parametrize("mode", ["pd", "torque"])
def test_cloth_and_body_keep_their_momentum(make_batch, mode):
    # nothing outside acts: what the cloth loses the body gets
    batch = make_batch(
        STAND, 1, control=mode, gravity=0.0, scene={"ground": False, "walls": False}, pose_noise=0.0, **WORN
    )
    batch.reset(seeds=[0])
    simulation, rng = batch.simulation, np.random.default_rng(0)
    cloth = simulation.garments.cloth
    without_air(cloth)
    v = rng.normal(0.0, 0.5, cloth.state.v.numpy().shape).astype(np.float32)
    cloth.state.v.assign(v)

    before, scale = momentum_of(simulation), (cloth.mass[0][:, None] * np.abs(v[0])).sum()
    for _ in range(5):
        batch.step()
    after = momentum_of(simulation)
    assert after[0] == pytest.approx(before[0], abs=1e-5 * scale)
    assert after[1] == pytest.approx(before[1], abs=2e-3 * scale)


def test_a_body_that_falls_lies_on_its_garment_in_peace(make_batch):
    # cloth between floor and body must neither lift the body nor shake
    batch = make_batch(STAND, 1, control="pd", root_assist=0.0, episode_seconds=100.0, garments=[{"kind": "skirt"}])
    batch.reset(seeds=[0])
    garments, dt, forces, speeds = batch.simulation.garments, batch.task.config.physics.control_dt, [], []
    for _ in range(120):
        batch.step()
        forces.append(np.linalg.norm(garments.surfaces._receivers.force.numpy()[0].sum(axis=0)) / dt)
        # but for one vertex, which may be pinched where it can neither stay nor leave
        speeds.append(np.sort(np.linalg.norm(garments.cloth.state.v.numpy()[0], axis=1))[-2])
    assert batch.simulation.avatar.tracked.position.numpy()[0, 0, 2] < 0.2 and not batch.failure.numpy().any()
    assert max(forces[-30:]) < 3.0 * 9.81 * garments.cloth.mass.sum()
    assert max(speeds[-30:]) < 0.3
    edges, x = garments.cloth.mesh.edges, garments.cloth.state.x.numpy()[0]
    span = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    strain = span / garments.cloth.length.numpy()[0] - 1.0
    assert np.sqrt((strain**2).mean()) < 0.05 and strain.max() < 0.4


def test_a_thrown_ball_pushes_a_skirt_and_is_slowed_by_it(make_batch):
    # Without gravity, air and ground; the ball flies at the front of the skirt, below the trunk.
    ball = BALL | {"velocity": [0.0, 1.0, 0.0], "position": [0.0, -0.5, 0.72]}
    empty = {"ground": False, "walls": False, "props": [ball]}
    batch = make_batch(STAND, 1, control="pd", gravity=0.0, scene=empty, pose_noise=0.0, garments=[SKIRT])
    batch.reset(seeds=[0])
    simulation = batch.simulation
    cloth, props = simulation.garments.cloth, simulation.props.state
    without_air(cloth)
    before, slowed = momentum_of(simulation)[0], 0.0
    for _ in range(12):
        batch.step()
        if not simulation.sensors.pair_impulse.numpy().any():  # the ball has not touched the body
            slowed = 1.0 - props.velocity.numpy()[0, 0, 1]
        away = np.linalg.norm(cloth.state.x.numpy()[0] - props.position.numpy()[0, 0], axis=1)
        assert away.min() > 0.12 - 0.015
    assert slowed > 0.01
    np.testing.assert_allclose(momentum_of(simulation)[0], before, atol=1e-5 * 0.5)


def test_avatars_may_wear_different_garments(make_batch):
    avatars = [{"position": [-0.5, 0.0]}, {"position": [0.5, 0.0], "garments": []}]
    batch = make_batch(REACH, 1, garments=[SKIRT], scene={"avatars": avatars[:1]})
    assert len(batch.simulation.garments.garments) == 1
    bare = make_batch(REACH, 1, garments=[SKIRT], scene={"avatars": [avatars[1] | {"position": [0.0, 0.0]}]})
    assert bare.simulation.garments is None
