"""Joints that push: what a blocked limb transmits, what limits do, how flesh is held."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.flesh import attachment_rates, bone_distance, firmness
from piavatar_envs.avatar.body.sampling import sample_particles, spacing_for
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.torque_control.articulated_body import ArticulatedBody
from piavatar_envs.avatar.torque_control.joint_tissue import JointTissue
from piavatar_envs.avatar.torque_control.joint_torques import UNBOUNDED
from tests.avatar.articulated import Joints

ANKLES = [joint_index("left_ankle"), joint_index("right_ankle")]
TOES = [joint_index("left_foot"), joint_index("right_foot")]
EVERYWHERE = np.full((NUM_JOINTS, 3), UNBOUNDED)


class Held(Joints):
    """A body whose pelvis is held and whose joints are stiff, but for one pair that a test is about.

    Attributes:
        graph: a control step.
    """

    def __init__(self, rig, joints, stiffness: float, damping: float):
        self.rig, self.model, self.state, self.joints = rig, rig.model, rig.state, list(joints)
        springs, dampers = np.full((1, 1 + NUM_JOINTS), 3000.0), np.full((1, 1 + NUM_JOINTS), 100.0)
        springs[0, :2], dampers[0, :2] = 1e5, 1e4
        springs[0, 1 + np.array(self.joints)], dampers[0, 1 + np.array(self.joints)] = stiffness, damping
        self.body = ArticulatedBody(
            rig.points, rig.avatar.body, rig.model, springs, dampers, np.full((1, len(rig.mass)), 300.0)
        )
        self.body.set_tissue(JointTissue(np.zeros(NUM_JOINTS), -EVERYWHERE, EVERYWHERE, TOES))

    def start(self):
        """Start in the rest pose, where the pelvis is held."""
        self.pose(np.zeros((NUM_JOINTS, 3)))
        self.body.target.root.assign(self.body.state.position.numpy()[:, 0])
        self.graph = self.control_step()
        return self

    def aim(self, rotvec) -> None:
        """Let the springs of the pair pull to a rotation vector."""
        target = np.zeros((NUM_JOINTS, 3))
        target[self.joints] = rotvec
        self.body.target.rotation.assign(Rotation.from_rotvec(target).as_quat()[None].astype(np.float32))

    def local(self) -> np.ndarray:
        """Return the rotation vectors of the pair, ``(2, 3)`` [rad]."""
        world = Rotation.from_quat(self.body.state.rotation.numpy()[0].astype(float))
        return np.stack([(world[PARENTS[b]].inv() * world[b]).as_rotvec() for b in self.joints])

    def torque(self) -> np.ndarray:
        """Return torques that the pair got in the last substep, in the frame of the parents, ``(2, 3)`` [N m]."""
        impulse = self.body.impulse.numpy()[0].astype(float).reshape(-1, 3)[1:] / self.model.step.dt
        world = Rotation.from_quat(self.body.state.rotation.numpy()[0].astype(float))
        return np.stack([world[PARENTS[b]].inv().apply(impulse[b]) for b in self.joints])


@pytest.fixture(scope="module")
def pressed(make_rig) -> dict[float, dict[str, np.ndarray]]:
    """Press toes on the floor without gravity; return what is measured, by the damping of the ankles."""
    found = {}
    for damping in (20.0, 200.0):
        held = Held(make_rig(cells=24, floor=True), ANKLES, 300.0, damping).start()
        held.aim([0.3, 0.0, 0.0])
        for _ in range(60 if damping < 100.0 else 200):  # it creeps to its rest in D / K = 0.67 s
            held.graph.run()
        assert held.state.failure.numpy().sum() == 0
        found[damping] = {
            "error": 0.3 - held.local()[:, 0],
            "torque": held.torque()[:, 0],
            "speed": np.abs(held.total).max(),
            "floor": held.rig.scratch.sensors.boundary_impulse.numpy()[0, 0, 2] / held.model.control_dt,
            "held": held.body.impulse.numpy()[0, 2] / held.model.step.dt,
        }
    return found


def test_a_blocked_foot_transmits_its_spring_whatever_its_damper(pressed):
    # ``tau = K e``, and the floor pushes back at the lever of the foot.
    for seen in pressed.values():
        assert seen["speed"] < 0.02
        assert seen["error"].min() > 0.05  # it is blocked
        np.testing.assert_allclose(seen["torque"], 300.0 * seen["error"], rtol=0.03)
        assert seen["floor"] == pytest.approx(-seen["held"], rel=0.03)  # what the pelvis is held down with
        assert 0.08 < seen["torque"].sum() / seen["floor"] < 0.22  # from the ankle to where toes press [m]
    forces = [seen["floor"] for seen in pressed.values()]
    assert max(forces) < 1.05 * min(forces)


@pytest.mark.parametrize("limit", [2.0, 15.0])
def test_muscles_give_no_more_than_they_have(make_rig, limit):
    # An arm is asked to rise by a spring that its weight and the limit do not let it follow.
    shoulders = [joint_index("left_shoulder"), joint_index("right_shoulder")]
    held = Held(make_rig(cells=16, gravity=9.81), shoulders, 1000.0, 30.0)
    lower, upper = -EVERYWHERE.copy(), EVERYWHERE.copy()
    lower[shoulders], upper[shoulders] = -limit, limit
    held.body.set_strength(lower, upper, 1)
    held.start().aim([-1.0, 0.0, 0.0])
    most = 0.0
    for _ in range(30 if limit > 10.0 else 10):  # arms that nothing damps would swing through the body at last
        held.graph.run()
        most = max(most, np.abs(held.torque()).max())
    assert held.state.failure.numpy().sum() == 0
    assert most == pytest.approx(limit, rel=0.02)  # read in the frame of a moment later
    # 15 N m hold an arm of 3 kg out in front; 2 N m do not
    assert (held.local()[0, 0] < -0.8) == (limit > 10.0)


def test_no_muscle_gives_more_where_others_have_been_cut(make_rig):
    # All joints are pulled beyond their reach: what a muscle at its limit lacks, its neighbours would have to give.
    rng = np.random.default_rng(2)
    moving = [b for b in range(1, NUM_JOINTS) if b not in TOES]
    held = Held(make_rig(cells=16), moving, 300.0, 3.0)
    limit = rng.uniform(2.0, 40.0, (NUM_JOINTS, 1)) * np.ones(3)
    held.body.set_strength(-limit, limit, 1)
    graph, excess, cut = held.start().substep(0), [], []
    for _ in range(60):
        held.pose(np.zeros((NUM_JOINTS, 3))).aim(rng.uniform(-0.3, 0.3, (len(moving), 3)))
        held.state.u.zero_(), held.state.vk.zero_()
        graph.run()
        # where a substep begins all frames are the world's
        torque = held.body.impulse.numpy()[0].reshape(-1, 3)[1:] / held.model.step.dt
        share = np.abs(torque[moving]) / limit[moving]
        excess.append(share.max())
        cut.append((share > 0.97).any(1).sum())
    assert held.state.failure.numpy().sum() == 0
    assert 4 <= np.median(cut) <= len(moving) - 4  # some are, and some are not
    assert max(excess) < 1.001


def test_flesh_is_held_the_faster_the_deeper_it_lies():
    particles = sample_particles(load_asset(), spacing_for(0.07))
    distance = bone_distance(particles.rest_positions, particles.bone)
    firm = firmness(particles.skin_joints, particles.skin_weights)
    assert attachment_rates(particles.depth, distance, firm, 30.0, 500.0)[firm > 0.999] == pytest.approx(
        500.0, rel=0.01
    )
    nowhere = np.zeros(len(distance))
    rates = attachment_rates(particles.depth, distance, nowhere, 30.0, 500.0)
    assert rates[particles.bone >= 0] == pytest.approx(500.0)
    assert rates.min() >= 30.0 and rates[particles.depth == 0.0] == pytest.approx(30.0)
    for fixed in (0.02, 0.05):  # deeper at the same distance from the bone, nearer to it at the same depth
        steps = np.linspace(0.001, 0.1, 20)
        assert (np.diff(attachment_rates(steps, np.full(20, fixed), nowhere[:20], 30.0, 500.0)) > 0.0).all()
        assert (np.diff(attachment_rates(np.full(20, fixed), steps, nowhere[:20], 30.0, 500.0)) < 0.0).all()
    assert not attachment_rates(particles.depth, distance, nowhere, 0.0, 500.0).any()
    # depth is what sampling has measured: bone particles of the thigh lie deeper than its skin's
    assert particles.depth[particles.shell].max() < particles.depth[particles.bone == joint_index("left_hip")].mean()
