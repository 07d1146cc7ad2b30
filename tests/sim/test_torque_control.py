"""Torque control in environments: bones in place and on the ground, flesh on limbs that turn, loads on joints."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.physics.flesh import set_spinning, swing_legs
from benchmarks.physics.probe import Measurements
from benchmarks.physics.rig import joint_gaps
from piavatar_envs.avatar.body.asset import dense_weights
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.avatar.torque_control.bone_contact import LAYER
from piavatar_envs.config import load_config
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.tasks.games.sumo import SumoTask
from tests.sim.tissue import tissue_torques

REACH = "PIAvatar/Reach-v0"
PD = {"control": "pd", "pose_noise": 0.0, "firm_bones": True}
EMPTY = {"gravity": 0.0, "scene": {"ground": False, "walls": False}}


def swing(batch, steps: int, seed: int = 0) -> np.ndarray:
    """Follow random joint targets; return the largest gap between bones after each step [m], ``(steps, num_envs)``."""
    rng, avatar, gaps = np.random.default_rng(seed), batch.simulation.avatar, []
    rest = avatar.body.rest_joint.numpy().astype(float)
    for _ in range(steps):
        batch.action.assign(0.5 * rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
        gaps.append(joint_gaps(avatar.tracked, rest).max(axis=1))
    return np.array(gaps)


def widths(env) -> np.ndarray:
    """Return the root-mean-square width of every bone's particles across the bone [m], shape ``(22,)``."""
    x, bone = env.simulation.state.x.numpy()[0].astype(float), env.simulation.flesh[0].sampled.bone
    spread = [np.linalg.svd(x[bone == b] - x[bone == b].mean(0), compute_uv=False) for b in range(NUM_JOINTS)]
    return np.array([np.hypot(*values[1:]) for values in spread])


def test_flesh_does_not_wear_out_in_limbs_that_swing(make_batch):
    # Inertia strains it by 4e-4; integration errors once added 2.6e-3 per second, and stayed when limbs came to rest.
    settings = {"fidelity": "coarse", "root_assist": 1.0, "control": "pd", "pose_noise": 0.0, **EMPTY}
    batch = make_batch("PIAvatar/Stand-v0", 1, **settings)
    batch.reset(seeds=[0])
    swing_legs(batch, 3.0)
    assert not batch.failure.numpy().any()
    assert 1e-4 < Measurements(batch).strain().mean() < 8e-4
    batch.action.zero_()
    for _ in range(30):
        batch.step()
    assert Measurements(batch).strain().mean() < 3e-4
    measured = Measurements(batch)
    assert measured.elastic_energy(measured.body) < 0.002  # [J]; 0.3 once


def test_a_spinning_body_keeps_its_kinetic_energy(make_batch):
    # 8 rad/s about the vertical, free: after it has given way to its inertia, nothing is lost to the flesh.
    settings = {"fidelity": "coarse", "control": "pd", "pose_noise": 0.0, **EMPTY}
    batch = make_batch("PIAvatar/Stand-v0", 1, **settings)
    batch.reset(seeds=[0])
    set_spinning(batch, 8.0)
    mass, energy = batch.simulation.model.particles.mass.numpy()[0].astype(float), []
    for step in range(75):
        batch.step()
        if step in (29, 74):
            state = batch.simulation.state.numpy()
            energy.append(0.5 * mass @ ((state["u"] + state["vk"])[0].astype(float) ** 2).sum(1))
    assert energy[1] == pytest.approx(energy[0], rel=2e-3)
    assert Measurements(batch).strain().mean() < 2e-3


def put_in_place(batch) -> None:
    """Run the end of a control step alone, wherever joints have been put."""
    simulation = batch.simulation
    graph, controller = LaunchGraph(simulation.model.device), simulation.controllers[0]
    controller.joints.record_pose(graph, simulation.state)
    controller.record_end(graph, simulation.state)
    graph.run()


def of_bones(batch) -> np.ndarray:
    """Return the mask of bone particles, shape ``(P,)``."""
    return batch.simulation.flesh[0].sampled.bone >= 0


def test_bones_stay_together(make_batch):
    # Under random targets; where they may slip they are a third of a millimetre apart.
    worst = {}
    for firm in (True, False):
        batch = make_batch(REACH, 2, **PD | {"firm_bones": firm}, **EMPTY)
        batch.reset(seeds=[1, 2])
        worst[firm] = swing(batch, 30).max()
        assert not batch.failure.numpy().any()
    assert worst[True] < 1e-5
    assert worst[False] > 1e-4


def test_bones_on_the_floor_are_apart_only_where_they_press_on_it(make_batch):
    batch = make_batch(REACH, 2, root_assist=0.0, **PD)
    batch.reset(seeds=[1, 2])
    gaps, lowest = swing(batch, 40), batch.simulation.state.x.numpy()[:, of_bones(batch), 2].min()
    assert not batch.failure.numpy().any()
    assert np.median(gaps) < 1e-5
    assert lowest > -1e-6  # [m]


def test_momentum_is_kept(make_batch):
    # In empty space, though particles are moved.
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
    # Of particles that are millimetres from their places: none changes its velocity, all its angular momentum.
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
    assert np.abs(place - moved)[~chosen].max() < 1e-3  # hourglass modes, slowly
    velocity = (state.u.numpy() + state.vk.numpy())[0].astype(float)
    given = np.cross(place - moved, model.particles.mass.numpy()[0, :, None] * velocity).sum(0)
    assert np.linalg.norm(given) > 1e-4 * before.momentum_scale
    np.testing.assert_array_equal(after.momentum, before.momentum)
    assert np.linalg.norm(after.angular_momentum - before.angular_momentum) < 1e-6 * before.momentum_scale


def test_the_pull_goes_on_as_if_particles_had_not_been_put_in_place(make_batch):
    # Once shaken particles have been put in place, the next substep does to velocities what it does to shaken ones.
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
    # The pose alone goes down by 5 cm: particles go with it as far as the floor lets them.
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


def test_two_bodies_that_collide_keep_their_momentum(device):
    # The particles of the second body's bones are put in place as the first one's are.
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


HELD_BY_NOTHING = {"control": "pd", "pose_noise": 0.0, "root_assist": 0.0}


def test_limbs_that_turn_do_not_swell(make_batch):
    # In ``T`` seconds of straight ways they would grow by ``exp(omega^2 dt T / 2)``, which no stress counters. Nor do
    # those that no control step puts back.
    rate, steps = 8.0, 45
    batch = make_batch(REACH, 1, firm_bones=False, **HELD_BY_NOTHING, **EMPTY)
    batch.reset(seeds=[0])
    model, state = batch.simulation.model, batch.simulation.state
    before = widths(batch)
    set_spinning(batch, rate)
    start = totals(model, state)
    for _ in range(steps):
        batch.step()
    now = totals(model, state)
    assert not batch.failure.numpy().any()
    assert np.linalg.norm(now.angular_momentum - start.angular_momentum) < 1e-5 * start.momentum_scale
    physics = batch.simulation.model
    swelling = np.expm1(0.5 * rate**2 * physics.step.dt * steps * physics.control_dt)  # if particles moved straight on
    assert swelling > 0.15
    assert np.abs(widths(batch) / before - 1.0).max() < 0.1 * swelling


def weight_about_joints(batch) -> np.ndarray:
    """Return the moment of the weight that hangs on each joint about it, in the world's axes, ``(22, 3)`` [N m]."""
    simulation = batch.simulation
    sampled, at = simulation.flesh[0].sampled, simulation.controllers[0].state.position.numpy()[0].astype(float)
    mass, x = simulation.model.particles.mass.numpy()[0].astype(float), simulation.state.x.numpy()[0].astype(float)
    share = dense_weights(sampled.skin_joints, sampled.skin_weights)
    for bone in reversed(range(1, len(PARENTS))):
        share[:, PARENTS[bone]] += share[:, bone]
    force = np.array([0.0, 0.0, -9.81]) * mass[:, None]
    return np.stack([share[:, b] @ np.cross(x - at[b], force) for b in range(len(PARENTS))])


def spring_torques(batch) -> np.ndarray:
    """Return the torques of the springs towards the rest pose, in the world's axes, ``(22, 3)`` [N m]."""
    controller = batch.simulation.controllers[0]
    world = Rotation.from_quat(controller.state.rotation.numpy()[0].astype(float))
    stiffness = controller.joints.springs.stiffness.numpy()[0, 1:]
    above = [world[max(PARENTS[b], 0)] for b in range(len(PARENTS))]
    return np.stack([-k * a.apply((a.inv() * w).as_rotvec()) for k, a, w in zip(stiffness, above, world, strict=True)])


def test_a_joint_at_rest_bears_the_weight_that_hangs_on_it(make_batch):
    # Springs and tissue give exactly its moment: the grid's inertia in light joints resists no load that stays.
    batch = make_batch(REACH, 1, control="pd", pose_noise=0.0, root_assist=1.0, joints=None, scene=EMPTY["scene"])
    batch.reset(seeds=[0])
    for _ in range(150):
        batch.step()
    held, weight = spring_torques(batch) + tissue_torques(batch), weight_about_joints(batch)
    moving = [b for b in range(1, len(PARENTS)) if batch.simulation.controllers[0].joints.tissue.lock.numpy()[b] == 0.0]
    assert len(moving) == len(PARENTS) - 3  # toes are locked
    assert np.linalg.norm(weight[moving], axis=1).min() > 0.05
    np.testing.assert_allclose(held[moving], -weight[moving], rtol=0.003, atol=0.01)


@pytest.mark.parametrize("name", ["ankle", "knee"])
def test_legs_bear_what_stands_on_them(make_batch, name):
    # Feet press the ground; springs and tissue give the moment of all above a joint: weight and what holds the pelvis.
    batch = make_batch(REACH, 1, control="pd", pose_noise=0.0, root_assist=1.0, joints=None, episode_seconds=20.0)
    batch.reset(seeds=[0])
    for _ in range(100):
        batch.step()
    simulation, joints = batch.simulation, [joint_index(f"{side}_{name}") for side in ("left", "right")]
    pelvis, at = (
        simulation.controllers[0].joints.support,
        simulation.controllers[0].state.position.numpy()[0].astype(float),
    )
    axis = at[joints].mean(0)
    mass, x = simulation.model.particles.mass.numpy()[0].astype(float), simulation.state.x.numpy()[0].astype(float)
    weight = np.cross(x - axis, np.array([0.0, 0.0, -9.81]) * mass[:, None]).sum(0)
    held = pelvis.torque.numpy()[0] + np.cross(at[0] - axis, pelvis.force.numpy()[0])
    above = weight - weight_about_joints(batch)[joints].sum(0) + held
    assert above[0] > 10.0  # [N m]
    assert (spring_torques(batch) + tissue_torques(batch))[joints, 0].sum() == pytest.approx(above[0], rel=0.04)


@pytest.mark.parametrize("firm", [False, True])
def test_bodies_that_thrash_on_the_ground_do_not_fail(make_batch, firm):
    # Random torques of all that muscles have, where a hand is half as large as a cell.
    batch = make_batch("PIAvatar/GetUp-v0", 4, firm_bones=firm)
    batch.reset(seeds=list(range(4)))
    rng, fastest = np.random.default_rng(0), 0.0
    for _ in range(100):
        batch.action.assign(rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
        fastest = max(fastest, np.abs(batch.simulation.controllers[0].state.velocity.numpy()).max())
    assert not batch.failure.numpy().any()
    assert fastest > 10.0  # [rad/s]


THRASHING = {"fidelity": "coarse", "control": "torque"}
GET_UP = "PIAvatar/GetUp-v0"


def thrash(batch: BatchEnv, steps: range) -> dict[str, np.ndarray]:
    """Apply torques that depend on the step and the environment's seed alone; return the state after them."""
    seeds = batch.seed.numpy()
    for step in steps:
        draw = [np.random.default_rng([int(seed), step]).uniform(-1.0, 1.0, batch.action.shape[1:]) for seed in seeds]
        batch.action.assign(np.array(draw, np.float32))
        batch.step()
    return batch.get_state()


def lowest(batch: BatchEnv) -> float:
    """Return the height of the lowest point of a bone [m]."""
    tracked = batch.simulation.flesh[0].sampled.bone >= 0
    return float(batch.simulation.state.x.numpy()[:, : len(tracked)][:, tracked, 2].min())


def test_bodies_on_their_bones_are_alike_in_a_batch_and_go_on_from_a_state(make_batch, device):
    batch = make_batch(GET_UP, 2, **THRASHING)
    batch.reset(seeds=[3, 4])
    low = 1.0
    for step in range(14):
        middle = thrash(batch, range(step, step + 1))
        low = min(low, lowest(batch))
    assert 0.0 < low < 1.5 * LAYER  # they have been stopped
    end = thrash(batch, range(14, 20))
    single = make_batch(GET_UP, 1, **THRASHING)
    single.reset(seeds=[4])
    alone = thrash(single, range(20))
    batch.set_state(middle)
    again = thrash(batch, range(14, 20))
    for name, value in end.items():
        np.testing.assert_array_equal(again[name], value, err_msg=name)
        np.testing.assert_array_equal(alone[name][0], value[1], err_msg=name)
