"""Bones that stop at the floor: the impulse against Coulomb's law and the Jacobian in double precision; falls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.rig import joint_gaps
from piavatar_envs.avatar.bone_contact import LAYER
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep
from tests.avatar.jointed import Joints

FRICTION = 0.8  # of the rig's floor
UP = np.array([0.0, 0.0, 1.0])


@dataclass
class Lying:
    """A body in a wild pose whose lowest point of a bone is a little above the floor, before a substep.

    Attributes:
        joints: the body.
        points: of its bones, by index of the particle, shape ``(B,)``.
        place: where they are, shape ``(B, 3)`` [m].
        J: their Jacobian, shape ``(B, 3, 69)``.
        lowest: which is the lowest.
    """

    joints: Joints
    points: np.ndarray
    place: np.ndarray
    J: np.ndarray
    lowest: int

    @property
    def dt(self) -> float:
        return self.joints.model.step.dt

    @property
    def before(self) -> np.ndarray:
        """Velocity of the joints, shape ``(69,)``."""
        return self.joints.body.state.velocity.numpy()[0].astype(float)

    def least(self) -> np.ndarray:
        """Speeds along the normal at which points come to the layer of flesh in a substep, shape ``(B,)`` [m/s]."""
        return (LAYER - self.place[:, 2]) / self.dt

    def stop(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Let the body, which moves with its joints, do a substep: their velocity before and after."""
        made = self.joints
        made.body.state.velocity.assign(velocity[None].astype(np.float32))
        before = self.before
        made.state.vk.assign(made.skinning(before)[None].astype(np.float32))
        made.substep(1).run()
        return before, self.before


@pytest.fixture
def lying(make_rig, wild_pose):
    def build(seed: int, height: float, solid: bool = True, **springs: float) -> Lying:
        rig = make_rig(cells=16, floor=True)
        bones = rig.points.bone >= 0
        made = Joints(rig, solid=solid, **springs)
        pose = wild_pose(np.random.default_rng(seed))
        made.pose(pose)
        points = np.flatnonzero(bones)
        root = rig.points.joints[0, 0].astype(float)
        root[2] += height - made.rig.read("x")[points, 2].min()
        made.pose(pose, root)
        place = made.rig.read("x")[points]
        return Lying(made, points, place, made.jacobian[points], int(place[:, 2].argmin()))

    return build


def response(body: Lying) -> np.ndarray:
    """``M^-1`` with which joints answer, shape ``(69, 69)``, of joints without springs."""
    return np.linalg.inv(body.joints.mass.astype(float))


def coulomb(K: np.ndarray, v: np.ndarray, least: float) -> np.ndarray:
    """The impulse that stops a point: it sticks, or it slides on, against the slip that there would be without."""
    stick = np.linalg.solve(K, least * UP - v)
    if np.linalg.norm(stick[:2]) <= FRICTION * stick[2]:
        return stick
    slip = v + (least - v[2]) / K[2, 2] * K[:, 2]
    direction = UP - FRICTION * np.r_[slip[:2], 0.0] / np.linalg.norm(slip[:2])
    return (least - v[2]) / (UP @ K @ direction) * direction


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("along", [0.0, 3.0])
def test_one_point_is_stopped_by_coulombs_law(lying, seed, along):
    """It goes just too fast for the layer; standing on the spot it sticks, fast along the floor it slides."""
    body = lying(seed, height=0.004)
    target = np.array([along, 0.0, body.least()[body.lowest] - 0.05])
    velocity = np.zeros(69)
    velocity[:3] = target
    before, after = body.stop(velocity)
    J, inverse = body.J[body.lowest], response(body)
    K = J @ inverse @ J.T
    p = coulomb(K, J @ before, body.least()[body.lowest])
    assert p[2] > 0.0
    assert along == 0.0 or np.linalg.norm(p[:2]) == pytest.approx(FRICTION * p[2])
    expected = inverse @ J.T @ p
    np.testing.assert_allclose(after - before, expected, atol=2e-3 * np.abs(expected).max())
    assert (J @ after)[2] == pytest.approx(body.least()[body.lowest], abs=1e-3)
    assert ((body.J @ after)[:, 2] > body.least() - 2e-3).all()


@pytest.mark.parametrize("seed", range(3))
def test_many_points_are_stopped_and_no_energy_is_made(lying, seed):
    """A body in any motion onto the floor: no point too fast, momentum in the cone of friction, energy no greater."""
    body, rng = lying(seed, height=0.003), np.random.default_rng(10 + seed)
    velocity = rng.normal(0.0, 1.0, 69)
    velocity[:3] = [1.0, -0.5, -2.0]
    before, after = body.stop(velocity)
    too_fast = (body.least() - (body.J @ before)[:, 2]) > 1e-3
    left = (body.least() - (body.J @ after)[:, 2]).max()
    assert too_fast.sum() > 1
    assert left < 0.05 * (body.least() - (body.J @ before)[:, 2]).max()
    M = body.joints.mass.astype(float)
    gained = (M @ (after - before))[:3]
    assert gained[2] > 0.0 and np.linalg.norm(gained[:2]) <= 1.001 * FRICTION * gained[2]
    assert after @ M @ after < before @ M @ before


def test_a_bone_that_has_come_too_low_goes_back_slowly(lying):
    body = lying(0, height=-0.02)
    _, after = body.stop(np.zeros(69))
    speed = (body.J @ after)[body.lowest, 2]
    assert 0.2 < speed < 0.7 and LAYER - body.place[body.lowest, 2] > 0.02


def test_nothing_happens_above_the_floor_or_to_bones_that_slip(lying):
    away = lying(0, height=0.05)
    velocity = np.zeros(69)
    velocity[2] = -0.5  # a millimetre in a substep
    before, after = away.stop(velocity)
    np.testing.assert_allclose(after, before, atol=1e-5)
    slipping = lying(0, height=0.0, solid=False)
    before, after = slipping.stop(velocity)
    np.testing.assert_allclose(after, before, atol=1e-5)


@pytest.fixture(scope="module")
def fall(make_rig):
    """A limp body that falls on the floor head first: what happens in every control step."""
    rig = make_rig(cells=16, gravity=9.81, floor=True)
    bones = rig.points.bone >= 0
    made = Joints(rig, damping=2.0, attachment=300.0, firm=bones, solid=True)
    root = rig.points.joints[0, 0] + np.array([0.0, 0.0, 0.3])
    pose = np.zeros((NUM_JOINTS, 3))
    pose[0, 0] = 1.9  # from upright to beyond level
    made.pose(pose, root)
    program, model = Program(rig.model.device), rig.model
    record_begin(program, model, rig.state, rig.scratch)
    for step in range(model.num_substeps):
        made.body.record_substep(program, rig.state, rig.scratch, step)
        record_substep(program, model, rig.state, rig.scratch, step)
    record_end(program, model, rig.state, rig.scratch)
    made.body.record_end(program, rig.state)
    rig.drive.record_tracking(program, rig.state)
    seen = {"momentum": [rig.totals().momentum], "impulse": [], "moment": [], "gap": [], "lowest": []}
    seen["turn"] = [rig.totals().angular_momentum]
    first = np.flatnonzero(bones)
    for _ in range(30):
        program.run()
        seen["momentum"].append(rig.totals().momentum)
        seen["turn"].append(rig.totals().angular_momentum)
        seen["impulse"].append(rig.scratch.sensors.boundary_impulse.numpy()[0, 0].astype(float))
        seen["moment"].append(rig.scratch.sensors.boundary_moment.numpy()[0, 0].astype(float))
        seen["gap"].append(joint_gaps(rig.drive.tracked, rig.points.joints)[0].max())
        world = Rotation.from_quat(made.body.state.rotation.numpy()[0].astype(float)).as_matrix()
        bone, at = rig.points.bone[first], made.body.state.position.numpy()[0].astype(float)
        arm = (rig.points.rest[0, first] - rig.points.joints[0, bone]).astype(float)
        seen["lowest"].append((at[bone] + np.einsum("pij,pj->pi", world[bone], arm))[:, 2].min())
    assert rig.state.failure.numpy().sum() == 0
    return {name: np.array(values) for name, values in seen.items()} | {"mass": rig.mass.sum(), "model": model}


def test_bones_of_a_falling_body_stay_above_the_floor_and_together(fall):
    assert fall["lowest"].min() < 2.0 * LAYER  # some do come down to it
    assert fall["lowest"].min() > 0.0
    assert fall["gap"].max() < 1e-5


def test_sensors_tell_all_that_the_floor_gave(fall):
    """Weight and what the sensors tell are the change of momentum."""
    weight = fall["mass"] * 9.81 * fall["model"].control_dt * UP
    changes = np.diff(fall["momentum"], axis=0)
    scale = np.abs(fall["impulse"]).max()
    assert scale > 3.0 * weight[2]
    np.testing.assert_allclose(changes, fall["impulse"] - weight, atol=2e-4 * scale)
