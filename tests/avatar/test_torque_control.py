"""Joints under torques against the Jacobian written out in double precision."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body import device as body_device
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, forward_kinematics, joint_index
from piavatar_envs.avatar.torque_control.articulated_body import ArticulatedBody
from piavatar_envs.avatar.torque_control.joint_tissue import JointTissue
from piavatar_envs.avatar.torque_control.joint_torques import UNBOUNDED
from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF
from piavatar_envs.avatar.torque_control.stages import FIT_SHARE
from piavatar_envs.core import cuda_intrinsics as lanes
from tests.avatar.articulated import GAINS, Joints, carried_by, momentum_of

TOES = [joint_index("left_foot"), joint_index("right_foot")]


@pytest.fixture
def joints(make_rig, wild_pose):
    """Return joints in a wild pose, particles shaken about it, in random motion."""

    def build(seed=0, **gains) -> Joints:
        rng = np.random.default_rng(seed)
        made = Joints(make_rig(cells=16), **gains).pose(wild_pose(rng))
        shape = made.state.x.numpy().shape
        made.state.x.assign(made.state.x.numpy() + rng.normal(0.0, 2e-3, shape).astype(np.float32))
        made.state.u.assign(rng.normal(0.0, 1.0, shape).astype(np.float32))
        made.build_mass()
        return made

    return build


@pytest.mark.parametrize("seed", range(2))
def test_mass_matrix_is_that_of_the_jacobian(joints, seed):
    made = joints(seed)
    J, m = made.jacobian, made.rig.mass
    expected = np.einsum("p,pia,pib->ab", m, J, J)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(made.mass - expected) / scale).max() < 1e-5
    assert np.linalg.eigvalsh(made.mass).min() > 0.0


def test_joints_take_over_what_they_can_and_change_no_velocity(joints):
    # ``(M + I) dq = J^T m v``; particles turn with their bones about skinned places, and what is left is physical.
    made = joints()
    made.state.u.assign(0.5 * made.state.u.numpy())  # half a step turns joints by 0.09 rad at most
    before, J, m = made.total, made.jacobian, made.rig.mass
    expected = np.linalg.solve(np.einsum("p,pia,pib->ab", m, J, J) + np.diag(made.besides), momentum_of(J, m, before))
    places, dt = made.skinned_now(), made.model.step.dt
    made.body.state.outside.assign(-expected[None].astype(np.float32))  # so that none is expected next
    made.substep(1).run()
    np.testing.assert_allclose(made.total, before, atol=2e-5)
    got = made.body.state.velocity.numpy()[0]
    assert np.linalg.norm(got - expected) < 2e-3 * np.linalg.norm(expected)
    left = momentum_of(J, m, before - J @ got) - made.besides * got
    size = np.sqrt(np.einsum("p,pia,pia->a", m, J, J))
    assert np.abs(left / size).max() < 2e-3 * np.abs(momentum_of(J, m, before) / size).max()
    bones = carried_by().T @ got[3:].reshape(NUM_JOINTS, 3)  # a bone spins with all joints that carry it
    weights = made.rig.weights / made.rig.weights.sum(1, keepdims=True)
    spin = made.rig.read("spin")
    np.testing.assert_allclose(spin, weights @ bones, atol=1e-4)
    turn = np.cross(spin, made.rig.read("x") - places)
    vk = (made.skinned_now() - places) / dt + turn + 0.5 * dt * np.cross(spin, turn)
    assert np.abs(vk - J @ expected).max() > 0.05
    np.testing.assert_allclose(made.rig.read("vk"), vk, atol=3e-4)


@pytest.mark.parametrize("attachment", [None, 200.0])
def test_particles_go_from_skinned_places_to_skinned_places(make_rig, wild_pose, attachment):
    # Also where a wild pose bends joints: there ``J qdot`` alone, at a particle, is another velocity.
    rng = np.random.default_rng(2)
    made = Joints(make_rig(cells=16), attachment=attachment).pose(wild_pose(rng))
    velocity = rng.normal(0.0, 3.0, NUM_DOF)
    made.body.state.velocity.assign(velocity[None].astype(np.float32))
    made.state.u.zero_()
    made.state.vk.assign(made.skinning(velocity)[None].astype(np.float32))
    home, dt = made.rig.read("x"), made.model.step.dt
    alone, bias = made.halfway(velocity) @ velocity, made.bias_change(velocity)
    made.substep(1).run()
    got = made.body.state.velocity.numpy()[0].astype(float)
    predicted = 0.5 * dt * bias  # of the bias forces, half is predicted
    assert np.linalg.norm(got - velocity - predicted) < 0.1 * np.linalg.norm(predicted)
    way = made.skinned_now() - home
    assert np.linalg.norm(dt * made.rig.read("vk") - way, axis=1).max() < 1e-6
    assert np.linalg.norm(dt * alone - way, axis=1).max() > 1e-3 * np.linalg.norm(way, axis=1).max()


@pytest.mark.parametrize("stale", [False, True], ids=["fresh", "stale"])
def test_torques_change_neither_momentum(joints, wild_pose, stale):
    # Springs, dampers, torques of 1000 N m, flesh on bones; also with a mass matrix of another place.
    made = joints(1, stiffness=300.0, damping=10.0, attachment=200.0)
    rng = np.random.default_rng(3)
    if stale:
        made.state.x.assign(made.state.x.numpy() + rng.normal(0.0, 2e-2, made.state.x.numpy().shape).astype(np.float32))
    made.body.target.rotation.assign(Rotation.from_rotvec(wild_pose(rng)).as_quat()[None].astype(np.float32))
    made.body.state.torque.assign(rng.normal(0.0, 1e3, (1, NUM_JOINTS, 3)).astype(np.float32))
    p, L, _ = made.momenta()
    made.substep(1).run()
    p_after, L_after, size = made.momenta()
    assert size > 2.0 * made.rig.mass.sum() * 0.5
    assert np.linalg.norm(p_after - p) < 3e-6 * size
    assert np.linalg.norm(L_after - L) < 3e-6 * size


def test_torque_turns_a_joint_as_the_inertia_says(joints):
    # Without springs ``M d = dt tau``, in the frame of the upper arm; compared in double precision.
    made = joints(2)
    made.state.u.zero_()
    elbow = joint_index("left_elbow")
    torque = np.zeros((1, NUM_JOINTS, 3), np.float32)
    torque[0, elbow] = (3.0, -2.0, 5.0)
    made.body.state.torque.assign(torque)
    J, m, dt = made.jacobian, made.rig.mass, made.model.step.dt
    right = np.zeros(NUM_DOF)
    locked = np.r_[np.zeros(3), np.repeat(made.body.tissue.lock.numpy().astype(float), 3)]
    upper_arm = Rotation.from_quat(made.body.state.rotation.numpy()[0, PARENTS[elbow]])
    right[3 + 3 * elbow : 6 + 3 * elbow] = dt * upper_arm.apply(torque[0, elbow])
    expected = np.linalg.solve(np.einsum("p,pia,pib->ab", m, J, J) + np.diag(locked), right)
    made.substep(1).run()
    got = made.body.state.velocity.numpy()[0]
    assert np.linalg.norm(got - expected) < 1e-3 * np.linalg.norm(expected)


def off_their_places(made, rotvec, rng) -> tuple[np.ndarray, np.ndarray]:
    """Put particles where a pose near by has them; return its rotations, ``(22, 3, 3)``, and its place [m]."""
    turned = Rotation.from_rotvec(rotvec) * Rotation.from_rotvec(rng.normal(0.0, 0.02, rotvec.shape))
    root = made.body.state.position.numpy()[0, 0] + (0.01, -0.02, 0.015)
    made.state.x.assign(made.rig.skinned(turned.as_matrix(), root)[None].astype(np.float32))
    return turned.as_matrix(), root


def test_the_pose_is_fitted_to_particles_that_rest(joints, wild_pose):
    # In many substeps, for each takes a share, and a smaller one where the grid's inertia is the larger one.
    rng = np.random.default_rng(5)
    rotvec = wild_pose(rng)
    made = Joints(joints(0).rig).pose(rotvec)
    made.state.u.zero_()
    turned, root = off_their_places(made, rotvec, rng)
    graph = made.substep(0)
    for _ in range(800):
        graph.run()
    world, positions = forward_kinematics(turned, root, made.rig.points.joints[0].astype(float))
    np.testing.assert_allclose(made.body.state.position.numpy()[0], positions, atol=2e-4)
    off = Rotation.from_quat(made.body.state.rotation.numpy()[0].astype(float)) * Rotation.from_matrix(world).inv()
    assert off.magnitude().max() < 2e-3
    for velocity in (made.state.u, made.state.vk, made.body.state.velocity):
        assert not velocity.numpy().any()


@pytest.mark.parametrize("speed", [0.0, 10.0], ids=["resting", "flying"])
def test_a_fit_takes_a_share_of_the_displacement(joints, wild_pose, speed):
    # ``(M + I) dq = J^T m (x - LBS)``, wherever the body flies; the next substep has no matrix, and no fit.
    rng = np.random.default_rng(6)
    rotvec, flight = wild_pose(rng), speed * np.array([0.6, 0.0, 0.8])
    made = Joints(joints(0).rig).pose(rotvec)
    home, dt = made.rig.read("x"), made.model.step.dt
    off_their_places(made, rotvec, rng)
    made.state.u.zero_()
    made.state.vk.assign(np.broadcast_to(flight, made.state.vk.numpy().shape).astype(np.float32))
    made.body.state.velocity.assign(np.r_[flight, np.zeros(NUM_DOF - 3)][None].astype(np.float32))
    J, m, rest = made.jacobian, made.rig.mass, made.rig.points.joints[0].astype(float)
    M = np.einsum("p,pia,pib->ab", m, J, J) + np.diag(made.besides)
    dq = np.linalg.solve(M, momentum_of(J, m, made.rig.read("x") - home))
    local, root = made.moved(dq, FIT_SHARE)
    for step in range(2):
        made.substep(step).run()
        world, positions = forward_kinematics(local, root + (step + 1) * dt * flight, rest)
        np.testing.assert_allclose(made.body.state.position.numpy()[0], positions, atol=3e-5)
        off = Rotation.from_quat(made.body.state.rotation.numpy()[0].astype(float)) * Rotation.from_matrix(world).inv()
        assert off.magnitude().max() < 1e-4
    turns = np.linalg.norm(FIT_SHARE * carried_by().T @ dq[3:].reshape(NUM_JOINTS, 3), axis=1)
    assert turns.max() > 4e-3


def test_a_mode_swings_at_its_frequency(make_rig):
    # Small swings of the softest springs: ``K x = omega^2 M x``, in a body that nothing holds.
    made = Joints(make_rig(cells=16), stiffness=60.0).pose(np.zeros((NUM_JOINTS, 3)))
    M = made.mass
    K = np.diag(np.r_[np.zeros(6), np.full(NUM_DOF - 6, 60.0)])
    values, modes = eigh(K, M)
    omega, mode = np.sqrt(values[6]), modes[:, 6]  # six rigid motions come first
    mode *= 0.1 / np.abs(mode[6:]).max()
    dt = made.model.step.dt
    made.body.state.velocity.assign(mode[None].astype(np.float32))
    made.state.vk.assign((made.jacobian @ mode)[None].astype(np.float32))
    graph = made.substep(0)
    swing, steps = [], round(np.pi / omega / dt)
    for _ in range(steps):
        graph.run()
        made.state.x.assign(made.state.x.numpy() + np.float32(dt) * (made.state.u.numpy() + made.state.vk.numpy()))
        swing.append(mode @ M @ made.body.state.velocity.numpy()[0] / (mode @ M @ mode))
    damped = np.exp(-0.5 * omega**2 * dt * dt * np.arange(1, steps + 1))  # of the implicit step
    expected = damped * np.cos(omega * dt * np.arange(1, steps + 1))
    assert steps > 20
    np.testing.assert_allclose(swing, expected, atol=0.03)


def test_flesh_comes_back_to_the_bones(make_rig):
    # Displaced flesh in empty space: at a rate of 100/s nothing is left of it after 0.4 s.
    made = Joints(make_rig(cells=16), stiffness=300.0, damping=10.0, attachment=100.0)
    nothing, everywhere = np.zeros(NUM_JOINTS), np.full((NUM_JOINTS, 3), UNBOUNDED)
    made.body.set_tissue(JointTissue(nothing, -everywhere, everywhere, TOES))  # too light for so large cells
    made.pose(np.zeros((NUM_JOINTS, 3)))
    rng, dt = np.random.default_rng(0), made.model.step.dt
    rest = made.rig.read("x")
    bump = 0.02 * np.sin(12.0 * rest) * rng.normal(size=3)
    made.state.x.assign((rest + bump)[None].astype(np.float32))
    graph = made.substep(0)
    for _ in range(round(0.4 / dt)):
        graph.run()
        made.state.x.assign(made.state.x.numpy() + np.float32(dt) * (made.state.u.numpy() + made.state.vk.numpy()))
    turned = Rotation.from_quat(made.body.state.rotation.numpy()[0].astype(float)).as_matrix()
    local = np.stack([turned[0], *(turned[PARENTS[b]].T @ turned[b] for b in range(1, NUM_JOINTS))])
    off = made.rig.read("x") - made.rig.skinned(local, made.body.state.position.numpy()[0, 0].astype(float))
    assert np.abs(bump).max() > 0.01
    assert np.abs(off).max() < 0.02 * np.abs(bump).max()


@pytest.mark.parametrize("attachment", [None, 100.0])
def test_threads_and_partitions_change_nothing(joints, monkeypatch, attachment):
    # Threads that have several particles each give the same bits; bodies in many partitions sum in another order.

    def moved():
        made = joints(stiffness=300.0, damping=10.0, attachment=attachment)
        graph = made.substep(0)
        graph.run()
        return made

    whole = moved()
    if wp.get_device(whole.model.device).is_cuda:  # on a CPU one thread has all particles
        with monkeypatch.context() as patch:
            patch.setattr(lanes, "RESIDENT", 1)
            assert lanes.particle_rounds(whole.model.device, whole.rig.points.num_points) > 1
            several = moved()
        for name, value in whole.state.numpy().items():
            np.testing.assert_array_equal(several.state.numpy()[name], value, err_msg=name)
    monkeypatch.setattr(body_device, "partition_size", lambda device, count: 100)
    divided = moved()
    assert divided.body.body.chunk_bone.shape[0] > whole.body.body.chunk_bone.shape[0]
    assert divided.rig.points.num_points > 200
    for name in ("u", "vk"):
        expected = whole.rig.read(name)
        np.testing.assert_allclose(divided.rig.read(name), expected, atol=4e-5 * np.abs(expected).max(), err_msg=name)
    speed = whole.body.state.velocity.numpy()
    np.testing.assert_allclose(divided.body.state.velocity.numpy(), speed, atol=2e-5 * np.abs(speed).max())


def test_bad_gains_are_refused(make_rig):
    rig = make_rig(cells=16)
    good, negative, missing = {"stiffness": GAINS, "damping": GAINS}, GAINS.copy(), GAINS.copy()
    negative[0, 3], missing[0, 3] = -1.0, np.nan
    for name, bad in (
        ("stiffness", negative),
        ("damping", missing),
        ("damping", np.ones(3)),
        ("firm", np.ones(3, bool)),
    ):
        with pytest.raises(ValueError, match=name):
            ArticulatedBody(rig.points, rig.avatar.body, rig.model, **{**good, name: bad})


def test_a_held_pelvis_bears_the_weight(make_rig):
    # Springs of the pelvis carry a body at rest: with stiff joints it sinks by ``m g / K``, and stays.
    rig = make_rig(cells=16, gravity=9.81)
    stiffness, damping = 3000.0 * GAINS, 100.0 * GAINS
    stiffness[0, :2], damping[0, :2] = (2e4, 1e4), (2e3, 1e3)
    body = ArticulatedBody(
        rig.points, rig.avatar.body, rig.model, stiffness, damping, np.full((1, len(rig.mass)), 300.0)
    )
    made = Joints(rig)
    made.body = body
    made.pose(np.zeros((NUM_JOINTS, 3)))
    root = body.state.position.numpy()[0, 0].copy()
    body.target.root.assign(root[None])
    graph = made.control_step()
    for _ in range(30):
        graph.run()
    assert rig.state.failure.numpy().sum() == 0
    sunk = root - body.state.position.numpy()[0, 0]
    weight = 9.81 * rig.mass.sum()
    assert sunk[2] == pytest.approx(weight / 2e4, rel=0.01)
    assert np.abs(sunk[:2]).max() < 2e-3
    assert np.abs(made.total).max() < 0.1
