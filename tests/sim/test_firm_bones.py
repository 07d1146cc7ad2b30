"""Particles of bones that are put into their places: tracked bones stay together, and all else holds."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.physics.rig import joint_gaps
from piavatar_envs.config import load_config
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.tasks.games.sumo import SumoTask

REACH = "PIAvatar/Reach-v0"
PD = {"control": "pd", "pose_noise": 0.0, "firm_bones": True}
EMPTY = {"gravity": 0.0, "scene": {"ground": False, "walls": False}}


def swing(batch, steps: int, seed: int = 0) -> np.ndarray:
    """Random joint targets; the largest gap between tracked bones after each step [m], shape ``(steps, num_envs)``."""
    rng, avatar, gaps = np.random.default_rng(seed), batch.simulation.avatar, []
    rest = avatar.body.rest_joint.numpy().astype(float)
    for _ in range(steps):
        batch.action.assign(0.5 * rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
        gaps.append(joint_gaps(avatar.tracked, rest).max(axis=1))
    return np.array(gaps)


def put_in_place(batch) -> None:
    """What ends a control step of the joints, alone, wherever they have been put."""
    simulation = batch.simulation
    graph, controller = LaunchGraph(simulation.model.device), simulation.controllers[0]
    controller.joints.record_pose(graph, simulation.state)
    controller.record_end(graph, simulation.state)
    graph.run()


def of_bones(batch) -> np.ndarray:
    """Which particles are a bone's, shape ``(P,)`` bool."""
    return batch.simulation.flesh[0].sampled.bone >= 0


def test_bones_stay_together(make_batch):
    """Under random targets; where they slip they are millimetres apart."""
    worst = {}
    for firm in (True, False):
        batch = make_batch(REACH, 2, **PD | {"firm_bones": firm}, **EMPTY)
        batch.reset(seeds=[1, 2])
        worst[firm] = swing(batch, 30).max()
        assert not batch.failure.numpy().any()
    assert worst[True] < 1e-5
    assert worst[False] > 1e-3


def test_bones_on_the_floor_are_apart_only_where_they_press_on_it(make_batch):
    batch = make_batch(REACH, 2, root_assist=0.0, **PD)
    batch.reset(seeds=[1, 2])
    gaps, lowest = swing(batch, 40), batch.simulation.state.x.numpy()[:, of_bones(batch), 2].min()
    assert not batch.failure.numpy().any()
    assert np.median(gaps) < 1e-5
    assert lowest > -1e-6  # [m]


def test_momentum_is_kept(make_batch):
    """In empty space, though particles are moved."""
    batch = make_batch(REACH, 1, **PD, **EMPTY)
    batch.reset(seeds=[0])
    model, state = batch.simulation.model, batch.simulation.state
    start, scale, drift = totals(model, state), 0.0, np.zeros(2)
    for step in range(20):
        swing(batch, 1, step)
        now = totals(model, state)
        scale = max(scale, now.momentum_scale)
        changes = now.momentum - start.momentum, now.angular_momentum - start.angular_momentum
        drift = np.maximum(drift, [np.linalg.norm(change) for change in changes])
    assert scale > 5.0
    assert (drift < 1e-5 * scale).all(), drift / scale


def test_the_affine_velocity_takes_back_what_moves_give(make_batch):
    """Of particles that are millimetres from their places: none changes its velocity, all its angular momentum."""
    batch = make_batch(REACH, 1, **PD, **EMPTY)
    batch.reset(seeds=[0])
    swing(batch, 5)
    model, state, chosen = batch.simulation.model, batch.simulation.state, of_bones(batch)
    home, rng = state.x.numpy()[0].astype(float), np.random.default_rng(5)
    state.x.assign(state.x.numpy() + rng.normal(0.0, 5e-3, state.x.numpy().shape).astype(np.float32))
    moved, before = state.x.numpy()[0].astype(float), totals(model, state)
    put_in_place(batch)
    place, after = state.x.numpy()[0].astype(float), totals(model, state)
    np.testing.assert_allclose(place[chosen], home[chosen], atol=2e-6)
    np.testing.assert_array_equal(place[~chosen], moved[~chosen])
    velocity = (state.u.numpy() + state.vk.numpy())[0].astype(float)
    given = np.cross(place - moved, model.particles.mass.numpy()[0, :, None] * velocity).sum(0)
    assert np.linalg.norm(given) > 1e-4 * before.momentum_scale
    np.testing.assert_array_equal(after.momentum, before.momentum)
    assert np.linalg.norm(after.angular_momentum - before.angular_momentum) < 1e-6 * before.momentum_scale


def test_the_pull_goes_on_as_if_particles_had_not_been_put_in_place(make_batch):
    """Once shaken particles have been put in place, the next substep does to velocities what it does to shaken ones."""
    changes = {}
    for firm in (True, False):
        batch = make_batch(REACH, 1, **PD | {"firm_bones": firm}, **EMPTY)
        batch.reset(seeds=[0])
        state, rng = batch.simulation.state, np.random.default_rng(5)
        shaken = rng.normal(0.0, 5e-3, state.x.numpy().shape) * of_bones(batch)[None, :, None]
        state.x.assign(state.x.numpy() + shaken.astype(np.float32))
        put_in_place(batch)
        controller = batch.simulation.controllers[0]
        graph = LaunchGraph(batch.simulation.model.device)
        controller.record_before_substep(graph, state, batch.simulation.scratch, 0)
        before = state.u.numpy() + state.vk.numpy()
        graph.run()
        changes[firm] = (state.u.numpy() + state.vk.numpy() - before)[0]
    assert np.abs(changes[False][of_bones(batch)]).max() > 0.5  # [m/s]
    assert np.linalg.norm(changes[True] - changes[False]) < 0.1 * np.linalg.norm(changes[False])  # levers differ


def test_no_particle_is_put_into_the_floor(make_batch):
    """The pose alone goes down by 5 cm: particles go with it as far as the floor lets them."""
    batch = make_batch(REACH, 1, **PD)
    batch.reset(seeds=[0])
    simulation, chosen, down = batch.simulation, of_bones(batch), np.float32([0.0, 0.0, 0.05])
    put_in_place(batch)
    before, position = simulation.state.x.numpy()[0, chosen], simulation.controllers[0].state.position
    position.assign(position.numpy() - down)
    put_in_place(batch)
    expected = before - down
    assert (expected[:, 2] < 0.0).sum() > 3
    expected[:, 2] = np.maximum(expected[:, 2], 0.0)
    np.testing.assert_allclose(simulation.state.x.numpy()[0, chosen], expected, atol=2e-6)


def test_flesh_and_commanded_poses_are_left_alone(make_batch):
    """Only particles of bones under torques are put anywhere, and none where they may slip."""
    batch = make_batch(REACH, 1, **PD)
    np.testing.assert_array_equal(batch.simulation.controllers[0].joints.firm.numpy(), np.flatnonzero(of_bones(batch)))
    assert 0 < of_bones(batch).sum() < 0.9 * len(of_bones(batch))
    assert make_batch(REACH, 1, control="pd", firm_bones=False).simulation.controllers[0].joints.firm.size == 0
    assert make_batch(REACH, 1).simulation.controllers[0].moves_particles is False


def test_two_bodies_that_collide_keep_their_momentum(device):
    """The particles of the second body's bones are put in place as the first one's are."""
    settings = {"fidelity": "tiny", "joints": None, "start_distance": 0.6, "control": "pd", "firm_bones": True, **EMPTY}
    batch = BatchEnv(SumoTask(load_config(SumoTask.Config, None, settings)), 1, device)
    batch.reset(seeds=[0])
    simulation = batch.simulation
    model, state, first = simulation.model, simulation.state, simulation.subjects.first
    bodies = [slice(*first[i : i + 2]) for i in range(2)]
    x, u = state.x.numpy()[0], state.u.numpy()
    way = x[bodies[1]].mean(0) - x[bodies[0]].mean(0)
    for body, speed in zip(bodies, (0.7, -0.7), strict=True):
        u[0, body] += speed * way / np.linalg.norm(way)
    state.u.assign(u)
    start, pushed, rng = totals(model, state), 0.0, np.random.default_rng(0)
    for _ in range(15):
        batch.action.assign(0.5 * rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
        pushed += np.linalg.norm(simulation.sensors.pair_impulse.numpy()[0], axis=-1).max()
        for avatar in simulation.avatars:
            assert joint_gaps(avatar.tracked, avatar.body.rest_joint.numpy().astype(float)).max() < 1e-5
    now = totals(model, state)
    assert pushed > 5.0
    for change in (now.momentum - start.momentum, now.angular_momentum - start.angular_momentum):
        assert np.linalg.norm(change) < 1e-5 * now.momentum_scale


@pytest.mark.parametrize("control", ["pd", "torque"])
def test_a_run_is_taken_up_again(make_batch, equal, control):
    batch = make_batch(REACH, 2, **PD | {"control": control})
    batch.reset(seeds=[3, 4])
    swing(batch, 3)
    state = batch.get_state()
    first = swing(batch, 3, 1)
    batch.set_state(state)
    assert equal(first, swing(batch, 3, 1))
