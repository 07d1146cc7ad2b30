"""Bones that stop at surfaces: Coulomb's law, answers to impulses in double precision, skipped points, falls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from benchmarks.physics.rig import joint_gaps
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.torque_control.bone_contact import (
    LAYER,
    TOLERANCE,
    Ground,
    find_fastest,
    least_speed,
    may_violate,
    measure_bones,
    nth_touch,
)
from piavatar_envs.avatar.torque_control.joint_motion import spread_motion
from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF
from piavatar_envs.avatar.torque_control.workspace import TorqueWorkspace
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import Collider
from tests.avatar.articulated import Joints

UP = np.array([0.0, 0.0, 1.0])
FACING = Collider.plane((0.0, 0.0, -1.0), -1.9, 0.8)  # a ceiling
SLOPE = Collider.plane((0.6, 0.0, 0.8), -9.0, 0.8)  # far below


@dataclass
class Lying:
    """A body in a wild pose whose lowest point of a bone is a little above the floor, before a substep.

    Attributes:
        joints: the body.
        place: of the points of its bones, shape ``(B, 3)`` [m].
        J: their Jacobian, shape ``(B, 3, 69)``.
        lowest: which is the lowest.
    """

    joints: Joints
    place: np.ndarray
    J: np.ndarray
    lowest: int

    @property
    def before(self) -> np.ndarray:
        """Return the velocity of the joints, shape ``(69,)``."""
        return self.joints.body.state.velocity.numpy()[0].astype(float)

    @property
    def M(self) -> np.ndarray:
        """Return the mass matrix, shape ``(69, 69)``; there are no springs."""
        return self.joints.mass.astype(float)

    def least(self) -> np.ndarray:
        """Return speeds that take points to the layer of flesh above the floor in a substep, shape ``(B,)`` [m/s]."""
        return (LAYER - self.place[:, 2]) / self.joints.model.step.dt

    def set(self, name: str, value: float | np.ndarray, boundary: int = 0) -> None:
        """Set the ``friction``, ``velocity`` [m/s] or ``spin`` [rad/s] of a boundary."""
        array = getattr(self.joints.model.boundaries, name)
        values = array.numpy()
        values[0, boundary] = value
        array.assign(values)

    def leave_one_point(self) -> None:
        """Leave nothing but the lowest point of a bone that can be stopped."""
        body, bones = self.joints.body.body, self.joints.rig.points.bone
        point = np.flatnonzero(bones >= 0)[self.lowest]
        body.tracker_start.assign((np.arange(NUM_JOINTS + 1) > bones[point]).astype(np.int32))
        body.tracker.assign(np.full(body.tracker.shape, point, np.int32))

    def stop(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Let the body follow its joints for a substep; return their velocity without contact and with it."""
        made = self.joints
        made.body.state.velocity.assign(velocity[None].astype(np.float32))
        before = self.before
        free = before + 0.5 * made.model.step.dt * made.bias_change(before)
        made.state.vk.assign(made.skinning(before)[None].astype(np.float32))
        made.substep(1).run()
        return free, self.before


@pytest.fixture
def lying(make_rig, wild_pose):
    def build(seed: int, height: float, solid: bool = True, highest: bool = False, colliders=()) -> Lying:
        rig = make_rig(cells=16, floor=True, colliders=colliders, half_width=2.0)
        bones = np.flatnonzero(rig.points.bone >= 0)
        made = Joints(rig, solid=solid)
        pose = wild_pose(np.random.default_rng(seed))
        made.pose(pose)
        root = rig.points.joints[0, 0].astype(float)
        heights = made.rig.read("x")[bones, 2]
        root[2] += height - (heights.max() if highest else heights.min())
        made.pose(pose, root)
        place = made.rig.read("x")[bones]
        return Lying(made, place, made.jacobian[bones], int(place[:, 2].argmin()))

    return build


def moving(velocity) -> np.ndarray:
    """Return a body that moves as a whole."""
    return np.r_[velocity, np.zeros(66)]


@pytest.mark.parametrize("friction", [0.0, 0.3, 10.0])
@pytest.mark.parametrize("along", [0.02, 3.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_one_point_is_stopped_by_coulombs_law(lying, seed, along, friction):
    # It is stopped along the normal, by an impulse in the cone of friction, against the slip that is left. A point that
    # has got less than the cone allows does not slip against it any more.
    body = lying(seed, height=0.004)
    body.leave_one_point()
    body.set("friction", friction)
    least, J = body.least()[body.lowest], body.J[body.lowest]
    before, after = body.stop(moving([0.6 * along, 0.8 * along, least - 0.5]))
    p = (body.M @ (after - before))[:3]
    np.testing.assert_allclose(body.M @ (after - before), J.T @ p, atol=2e-3 * np.abs(J.T @ p).max())
    v = J @ after
    assert v[2] == pytest.approx(least, abs=1e-3)
    tangential = np.linalg.norm(p[:2])
    assert p[2] > 0.0 and tangential <= (1.001 * friction + 1e-3) * p[2]
    if friction > 0.0:
        against = p[:2] @ v[:2] / tangential
        assert against < 1e-3
        if tangential < 0.999 * friction * p[2]:
            assert against > -1e-3
    K = J @ np.linalg.inv(body.M) @ J.T
    assert p @ (J @ before) + 0.5 * p @ K @ p < 0.0  # kinetic energy


@pytest.mark.parametrize("friction", [0.0, 10.0])
@pytest.mark.parametrize("seed", range(3))
def test_many_points_are_stopped_and_no_energy_is_made(lying, seed, friction):
    # A body in any motion onto the floor: no point too fast, momentum in the cone of friction, energy no greater.
    body, rng = lying(seed, height=0.003), np.random.default_rng(10 + seed)
    body.set("friction", friction)
    velocity = rng.normal(0.0, 1.0, 69)
    velocity[:3] = [1.0, -0.5, -2.0]
    before, after = body.stop(velocity)
    lacking = (body.least() - (body.J @ before)[:, 2]).max()
    assert lacking > 0.1
    assert (body.least() - (body.J @ after)[:, 2]).max() < 0.05 * lacking
    gained = (body.M @ (after - before))[:3]
    assert gained[2] > 0.0 and np.linalg.norm(gained[:2]) <= 1.001 * friction * gained[2] + 1e-3
    assert after @ body.M @ after < before @ body.M @ before


def test_a_surface_that_moves_is_met_with_its_own_velocity(lying):
    # At the point: it comes up and turns, and drags along what sticks to it.
    body = lying(1, height=0.002)
    body.leave_one_point()
    body.set("friction", 3.0)
    body.set("velocity", [0.3, -0.2, 1.0])
    body.set("spin", [0.0, 0.0, 0.5])
    place = body.place[body.lowest]
    surface = np.array([0.3, -0.2, 1.0]) + np.cross([0.0, 0.0, 0.5], place)
    _, after = body.stop(np.zeros(69))
    v = body.J[body.lowest] @ after
    np.testing.assert_allclose(v[:2], surface[:2], atol=5e-3)
    assert v[2] == pytest.approx(1.0 + body.least()[body.lowest], abs=2e-3)


def test_every_boundary_stops_bones(lying):
    # A ceiling, which is the last of three.
    body = lying(0, height=1.9 - 0.002, highest=True, colliders=(SLOPE, FACING))
    top = int(body.place[:, 2].argmax())
    _, after = body.stop(moving([0.0, 0.0, 1.0]))
    assert (body.J[top] @ after)[2] == pytest.approx((0.002 - LAYER) / body.joints.model.step.dt, abs=2e-3)


def test_a_bone_that_has_come_too_low_goes_back_slowly(lying):
    body = lying(0, height=-0.02)
    _, after = body.stop(np.zeros(69))
    speed = (body.J @ after)[body.lowest, 2]
    assert 0.2 < speed < 0.7 and LAYER - body.place[body.lowest, 2] > 0.02


def test_nothing_happens_above_the_floor_or_to_bones_that_do_not_stop(lying):
    velocity = moving([0.0, 0.0, -0.5])  # a millimetre in a substep
    for body in (lying(0, height=0.05), lying(0, height=0.0, solid=False)):
        before, after = body.stop(velocity)
        np.testing.assert_allclose(after, before, atol=1e-5)


@pytest.fixture(scope="module")
def fall(make_rig):
    """Drop a limp body on the floor head first; return a log of every control step."""
    rig = make_rig(cells=16, gravity=9.81, floor=True)
    bones = np.flatnonzero(rig.points.bone >= 0)
    made = Joints(rig, damping=2.0, attachment=300.0, firm=rig.points.bone >= 0, solid=True)
    pose = np.zeros((NUM_JOINTS, 3))
    pose[0, 0] = 1.9  # from upright to beyond level
    made.pose(pose, rig.points.joints[0, 0] + np.array([0.0, 0.0, 0.3]))
    graph = made.control_step()
    made.body.record_end(graph, rig.state)
    rig.avatar.record_tracking(graph, rig.state)
    seen = {name: [] for name in ("momentum", "turn", "center", "impulse", "moment", "gap", "lowest")}

    def look() -> None:
        totals = rig.totals()
        seen["momentum"].append(totals.momentum)
        seen["turn"].append(totals.angular_momentum)
        seen["center"].append(rig.mass @ rig.read("x") / rig.mass.sum())

    look()
    for _ in range(30):
        graph.run()
        look()
        sensors = rig.scratch.sensors
        seen["impulse"].append(sensors.boundary_impulse.numpy()[0, 0].astype(float))
        seen["moment"].append(sensors.boundary_moment.numpy()[0, 0].astype(float))
        seen["gap"].append(joint_gaps(rig.avatar.tracked, rig.points.joints)[0].max())
        world = Rotation.from_quat(made.body.state.rotation.numpy()[0].astype(float)).as_matrix()
        bone, at = rig.points.bone[bones], made.body.state.position.numpy()[0].astype(float)
        arm = (rig.points.rest[0, bones] - rig.points.joints[0, bone]).astype(float)
        seen["lowest"].append((at[bone] + np.einsum("pij,pj->pi", world[bone], arm))[:, 2].min())
    assert rig.state.failure.numpy().sum() == 0
    weight = -rig.mass.sum() * 9.81 * rig.model.control_dt * UP
    return {name: np.array(values) for name, values in seen.items()} | {"weight": weight}


def test_bones_of_a_falling_body_stay_above_the_floor_and_together(fall):
    assert 0.0 < fall["lowest"].min() < 2.0 * LAYER  # some do come down to it
    assert fall["gap"].max() < 1e-5


def test_sensors_report_all_that_the_floor_gives(fall):
    # Weight and sensed impulses are the change of momentum, and their moments that of angular momentum.
    scale = np.abs(fall["impulse"]).max()
    assert scale > 3.0 * np.abs(fall["weight"]).max()
    np.testing.assert_allclose(np.diff(fall["momentum"], axis=0), fall["impulse"] + fall["weight"], atol=2e-4 * scale)
    middle = 0.5 * (fall["center"][1:] + fall["center"][:-1])
    moment = fall["moment"] + np.cross(middle, fall["weight"])
    scale = np.abs(fall["moment"]).max()
    np.testing.assert_allclose(np.diff(fall["turn"], axis=0), moment, atol=1e-2 * scale)


@wp.kernel(enable_backward=False)
def move_bones(body: Body, q: wp.array2d(dtype=float), w: TorqueWorkspace):
    """Store the motion of bones under velocities ``q`` of joints, and boxes around their hulls."""
    e = wp.tid()
    measure_bones(body, 1, e, 0, 1, w)
    spread_motion(body, w.pose.position, q, e, e, 0, 1, w.moving)


@wp.kernel(enable_backward=False)
def look(
    body: Body,
    ground: Ground,
    dt: float,
    w: TorqueWorkspace,
    may: wp.array3d(dtype=int),
    most: wp.array3d(dtype=float),
    fastest: wp.array(dtype=wp.vec2),
):
    """Store which bones are examined, and by how much any of their points is too fast; over ``(num_envs, bones)``."""
    e, b = wp.tid()
    for k in range(ground.boundaries.count):
        may[e, b, k] = int(may_violate(ground.boundaries, dt, w, e, b, k))
        lacking = float(-1.0e9)
        points = body.tracker_start[b + 1] - body.tracker_start[b]
        for n in range(points + 1):  # its deepest point, too
            touch = nth_touch(body, ground, w, e, b, n, k)
            lacking = wp.max(lacking, least_speed(touch.distance, dt) - wp.dot(touch.velocity, touch.normal))
        most[e, b, k] = lacking
    if b == 0:
        fastest[e] = find_fastest(body, ground, dt, e, 0, 1, w)


@pytest.mark.parametrize("seed", range(2))
def test_no_bone_is_skipped_of_which_a_point_is_too_fast(make_rig, wild_pose, device, seed):
    # Bodies in any motion among planes, balls, boxes and capsules that move and turn, in short and long substeps.
    rng, n = np.random.default_rng(seed), 2
    sizes = {"plane": 0, "sphere": 1, "box": 3, "capsule": 2}
    solids = [
        Collider(kind, tuple(0.02 + 0.4 * rng.random(size)), (0.0, 0.0, 0.0), friction=0.5, kinematic=True)
        for kind, size in sizes.items()
        for _ in range(2)
    ]
    rig = make_rig(cells=16, floor=True, colliders=solids, half_width=2.0, num_envs=n)
    made = Joints(rig, solid=True).pose(wild_pose(rng))
    body, workspace, boundaries = made.body, made.body._workspace, rig.model.boundaries
    ground = body._ground(rig.scratch)
    rows, count = boundaries.position.shape
    needed = looked_at = 0
    for _ in range(25):
        turns, still = Rotation.random(count, rng).as_quat(), rng.choice([0.0, 0.1, 3.0])
        drawn = {
            "rotation": turns,
            "position": rng.normal(0.0, 0.5, (count, 3)) + [0.0, 0.0, 1.0],
            "velocity": still * rng.normal(size=(count, 3)),
            "spin": 3.0 * still * rng.normal(size=(count, 3)),
        }
        for name, values in drawn.items():
            getattr(boundaries, name).assign(np.tile(values.astype(np.float32), (rows, 1, 1)))
        q = rng.choice([0.0, 0.1, 2.0]) * rng.normal(size=(n, NUM_DOF))
        dt = float(rng.choice([1e-4, 6e-4, 2e-3, 3e-2, 0.5]))
        velocity = wp.array(q.astype(np.float32), dtype=float, device=device)
        wp.launch(move_bones, n, [body.body, velocity, workspace], device=device)
        may = wp.zeros((n, NUM_JOINTS, count), dtype=int, device=device)
        most, fastest = wp.zeros(may.shape, dtype=float, device=device), wp.zeros(n, dtype=wp.vec2, device=device)
        hulls = LaunchGraph(device)
        body._hulls.record(hulls, body.pose, rig.state.failure)
        hulls.run()
        inputs = [body.body, ground, dt, workspace]
        wp.launch(look, (n, NUM_JOINTS), inputs, [may, most, fastest], device=device)
        lacking, seen = most.numpy(), may.numpy() != 0
        assert seen[lacking > TOLERANCE].all()
        needed, looked_at = needed + (lacking > TOLERANCE).sum(), looked_at + seen.sum()
        for (speed, which), own in zip(fastest.numpy(), lacking, strict=True):
            if own.max() > 2.0 * TOLERANCE:
                assert speed == pytest.approx(own.max(), rel=1e-3)
                assert own[int(which) // count % NUM_JOINTS, int(which) % count] == pytest.approx(own.max(), rel=1e-6)
    assert 100 < needed <= looked_at < 2 * needed
