"""Correctives of the rest pose: bent joints keep their volume, and velocities lead exactly from place to place."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.pose_correctives import pose_correctives
from piavatar_envs.avatar.body.sampling import sample_particles, spacing_for
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, forward_kinematics, joint_index, skin
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.correctives import predict_joints
from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF
from piavatar_envs.core.launch_graph import LaunchGraph
from tests.avatar.articulated import Joints

CELLS = 32  # the default resolution


def spine(flexion: float) -> dict[str, tuple[float, float, float]]:
    """Return a flexion of the trunk [deg], shared by the joints of the spine like their ranges."""
    return {"spine1": (0.375 * flexion, 0, 0), "spine2": (0.375 * flexion, 0, 0), "spine3": (0.25 * flexion, 0, 0)}


#: Poses [deg], the region whose volume is compared (joint and radius [m], None for the waist), the largest change of
#: volume, and that of linear blend skinning.
BENT = {
    "waist 20": (spine(20.0), None, 0.01, -0.05),
    "waist 40": (spine(40.0), None, 0.02, -0.1),
    "waist 60": (spine(60.0), None, 0.05, -0.15),
    "waist -30": (spine(-30.0), None, 0.02, 0.06),
    "hip": ({"left_hip": (-45, 0, 0)}, ("left_hip", 0.17), 0.03, -0.06),
    "knee": ({"left_knee": (60, 0, 0)}, ("left_knee", 0.12), 0.03, -0.06),
    "elbow": ({"left_elbow": (-30, 0, -30)}, ("left_elbow", 0.1), 0.03, -0.08),
    "shoulder": ({"left_shoulder": (-60, 0, 0)}, ("left_shoulder", 0.14), 0.03, -0.06),
    "collar": ({"left_collar": (0, -25, 0)}, ("left_collar", 0.14), 0.03, 0.06),
    "neck": ({"neck": (25, 0, 0), "head": (20, 0, 0)}, ("neck", 0.12), 0.03, -0.035),
}


def rotation_vectors(degrees: dict[str, tuple[float, float, float]]) -> np.ndarray:
    """Return rotation vectors of all joints, shape ``(22, 3)`` [rad]."""
    rotvec = np.zeros((NUM_JOINTS, 3))
    for name, value in degrees.items():
        rotvec[joint_index(name)] = np.radians(value)
    return rotvec


def quaternions(rotvec: np.ndarray) -> np.ndarray:
    """Return the quaternions of rotation vectors."""
    return Rotation.from_rotvec(rotvec).as_quat()


def volumes(x: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the signed volumes of tetrahedra [m^3]."""
    a, b, c, d = (x[corners[:, index]] for index in range(4))
    return np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a) / 6.0


class Shape:
    """A body in NumPy, with tetrahedra between its particles."""

    def __init__(self, cells: float) -> None:
        asset = load_asset()
        self.joints = asset.joints.astype(float)
        self.particles = sample_particles(asset, spacing_for(float(np.ptp(asset.vertices[:, 2])) / cells))
        self.correctives = pose_correctives(asset, self.particles)
        self.rest = self.particles.rest_positions.astype(float)
        corners = Delaunay(self.rest).simplices
        edges = self.rest[corners][:, :, None] - self.rest[corners][:, None]
        short = np.linalg.norm(edges, axis=3).max((1, 2)) < 2.2 * self.particles.spacing
        solid = np.abs(volumes(self.rest, corners)) > 2e-3 * self.particles.spacing**3
        self.corners = corners[short & solid]
        self.before = volumes(self.rest, self.corners)

    def place(self, rotvec: np.ndarray, corrected: bool) -> np.ndarray:
        """Return the skinned places [m]."""
        p, rest = self.particles, self.rest
        if corrected:
            rest = rest + self.correctives.displacement(quaternions(rotvec))
        world, position = forward_kinematics(Rotation.from_rotvec(rotvec).as_matrix(), self.joints[0], self.joints)
        return skin(rest, p.skin_joints, p.skin_weights.astype(float), world, position, self.joints)

    def change(self, rotvec: np.ndarray, region: tuple[str, float] | None, corrected: bool) -> float:
        """Return the change of the volume of a region over that at rest."""
        middle = self.rest[self.corners].mean(1)
        if region is None:
            inside = (middle[:, 2] > 1.0) & (middle[:, 2] < 1.14) & (np.abs(middle[:, 0]) < 0.2)
        else:
            inside = np.linalg.norm(middle - self.joints[joint_index(region[0])], axis=1) < region[1]
        ratio = np.sign(self.before) * volumes(self.place(rotvec, corrected), self.corners)
        return float(ratio[inside].sum() / np.abs(self.before[inside]).sum() - 1.0)


@pytest.fixture(scope="module")
def shape() -> Shape:
    """Return the body at the default resolution."""
    return Shape(CELLS)


@pytest.mark.parametrize("bent", BENT)
def test_bent_joints_keep_their_volume(shape, bent):
    degrees, region, limit, linear = BENT[bent]
    rotvec = rotation_vectors(degrees)
    assert abs(shape.change(rotvec, region, True)) < limit
    change = shape.change(rotvec, region, False)
    assert change < linear if linear < 0.0 else change > linear


def test_correctives_are_interpolated_at_other_resolutions():
    # A coarser body than the one that they are fitted to.
    other = Shape(26.0)
    assert abs(other.change(rotation_vectors(spine(40.0)), None, True)) < 0.03
    assert other.change(rotation_vectors(spine(40.0)), None, False) < -0.1


def test_correctives_vanish_at_rest_and_for_rigid_motions(shape):
    rotvec = np.zeros((NUM_JOINTS, 3))
    rotvec[0] = (0.4, -1.0, 2.0)  # the pelvis, with which the whole body turns
    assert not shape.correctives.displacement(quaternions(rotvec)).any()


def test_correctives_are_smooth_through_half_a_turn_and_local(shape):
    rotvec = np.zeros((NUM_JOINTS, 3))
    elbow = joint_index("left_elbow")
    near = []
    for angle in (np.pi - 1e-4, np.pi + 1e-4):  # where the rotation vector jumps
        rotvec[elbow] = angle * np.array([0.6, 0.0, 0.8])
        near.append(shape.correctives.displacement(quaternions(rotvec)))
    assert np.abs(near[0] - near[1]).max() < 1e-4
    moved = np.linalg.norm(near[0], axis=1) > 0.0
    assert moved.any()
    assert np.linalg.norm(shape.rest[moved] - shape.joints[elbow], axis=1).max() < 0.2
    q = quaternions(rotvec)
    np.testing.assert_allclose(shape.correctives.displacement(-q), shape.correctives.displacement(q), atol=1e-12)


@pytest.fixture(scope="module")
def rig(make_rig):
    """Return a rig whose rest pose is corrected."""
    return make_rig(cells=CELLS, keeps_volume=True)


def uncorrected(rig, rotvec: np.ndarray) -> np.ndarray:
    """Return the places by linear blend skinning alone [m]."""
    p, joints = rig.points, rig.points.joints[0].astype(float)
    world, position = forward_kinematics(Rotation.from_rotvec(rotvec).as_matrix(), joints[0], joints)
    return skin(p.rest[0].astype(float), p.skin_joints, p.skin_weights.astype(float), world, position, joints)


def test_a_reset_and_commanded_motion_lead_to_corrected_places(rig):
    begin, end = rotation_vectors(spine(10.0)), rotation_vectors(spine(25.0))
    rig.reset(begin)
    places = rig.skinned(Rotation.from_rotvec(begin).as_matrix(), rig.points.joints[0, 0])
    np.testing.assert_allclose(rig.read("x"), places, atol=2e-6)
    rig.command(end)
    rig.step()
    assert rig.pose_error().max() < 2e-5
    assert np.linalg.norm(rig.read("x") - uncorrected(rig, end), axis=1).max() > 5e-3
    assert np.abs(rig.read("u")).max() < 1e-3  # nothing is left to the physical velocity


def test_the_commanded_velocity_is_the_chord_between_corrected_places(rig):
    begin, end = rotation_vectors(spine(10.0)), rotation_vectors(spine(25.0))
    rig.reset(begin)
    rig.command(end)
    home, steps = rig.read("x"), rig.model.num_substeps
    rig.run_controller()
    # The displacement of the rest pose moves evenly in time, from that of the begin to that of the end.
    rotvec = begin + (end - begin) / steps  # about one axis
    displacement = [rig.points.correctives.displacement(quaternions(pose)) for pose in (begin, end)]
    rest = rig.points.rest[0] + displacement[0] + (displacement[1] - displacement[0]) / steps
    p, joints = rig.points, rig.points.joints[0].astype(float)
    world, position = forward_kinematics(Rotation.from_rotvec(rotvec).as_matrix(), joints[0], joints)
    after = skin(rest, p.skin_joints, p.skin_weights.astype(float), world, position, joints)
    np.testing.assert_allclose(rig.model.step.dt * rig.read("vk"), after - home, atol=1e-6)


@pytest.fixture
def joints(rig, wild_pose):
    """Return joints in a wild pose and motion, with the correctives of the first control step set."""
    rng = np.random.default_rng(5)
    made, pose = Joints(rig, attachment=200.0), wild_pose(rng)
    rig.reset(pose)
    made.pose(pose)
    velocity = rng.normal(0.0, 2.0, NUM_DOF)
    made.body.state.velocity.assign(velocity[None].astype(np.float32))
    graph = LaunchGraph(rig.model.device)
    inputs = [rig.avatar.body, rig.model.control_dt, made.body.pose, made.body.state.velocity]
    rig.avatar.record_corrections(graph, predict_joints, inputs)
    graph.run()
    return made, pose, velocity


def test_predicted_joints_are_those_after_the_control_step(joints):
    made, pose, velocity = joints
    local, _ = made.moved(velocity, made.model.control_dt)
    got = made.rig.avatar.state.corrected_rotation.numpy()[0].astype(float)
    apart = (Rotation.from_quat(got).inv() * Rotation.from_matrix(local)).magnitude()
    # a bone spins with those that carry it; the prediction turns each joint about its own axis
    assert np.median(apart) < 0.02
    correctives, after = made.rig.avatar.body.correctives, made.rig.points.correctives.displacement(got)
    before = made.rig.points.correctives.displacement(quaternions(pose))
    alone = made.rig.avatar.body.alone
    np.testing.assert_allclose(correctives.displacement.numpy()[0], before[alone:], atol=1e-6)
    np.testing.assert_allclose(correctives.change.numpy()[0], (after - before)[alone:], atol=1e-6)


def test_joints_lead_particles_from_corrected_place_to_corrected_place(joints):
    made, pose, _ = joints
    rig = made.rig
    made.state.u.zero_()
    home = rig.read("x")
    made.substep(0).run()
    state = made.body.state
    world = Rotation.from_quat(state.rotation.numpy()[0].astype(float)).as_matrix()
    change = np.zeros_like(home)
    change[rig.avatar.body.alone :] = rig.avatar.body.correctives.change.numpy()[0]
    displacement = rig.points.correctives.displacement(quaternions(pose)) + change / rig.model.num_substeps
    p = rig.points
    args = p.skin_joints, p.skin_weights.astype(float), world, state.position.numpy()[0].astype(float)
    after = skin(p.rest[0] + displacement, *args, p.joints[0].astype(float))
    np.testing.assert_allclose(rig.model.step.dt * rig.read("vk"), after - home, atol=2e-6)
    assert np.linalg.norm(change, axis=1).max() > 1e-3


def test_correctives_change_neither_momentum(joints):
    made, _, _ = joints
    rng = np.random.default_rng(6)
    made.state.u.assign(rng.normal(0.0, 1.0, made.state.u.shape + (3,)).astype(np.float32))
    p, L, _ = made.momenta()
    made.substep(0).run()
    p_after, L_after, size = made.momenta()
    assert np.linalg.norm(p_after - p) < 3e-6 * size
    assert np.linalg.norm(L_after - L) < 3e-6 * size
