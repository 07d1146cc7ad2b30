"""Shape preservation and joints of posed bodies: conservation laws, and what each is for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.muscles import (
    DAMPING_TIME,
    REFERENCE_HEIGHT,
    REFERENCE_MASS,
    held_joints,
    make_muscles,
)
from piavatar_envs.avatar.body.skeleton import PARENTS, joint_index
from piavatar_envs.mpm.colliders import Collider
from tests.avatar.conftest import blended_rigid_part, mean_rigid_motion

# ---- rigid fits


# ---- conservation


@pytest.mark.parametrize(("tone", "alpha"), [(0.0, 0.0), (0.0, 0.3), (1.0, 0.0), (1.0, 0.3)])
def test_a_blow_keeps_its_momentum_and_only_loses_energy(make_rig, tone, alpha, device):
    rig = make_rig(root="free", tone=tone, alpha=alpha)
    rig.strike((5.0, 20.0, -3.0), at=(0.1, -0.1, 1.3))
    about, before = rig.rigid_motion()[0], rig.totals()
    scale, turn = before.momentum_scale, rig.totals(about=about).angular_momentum
    energy = [rig.energy()]
    for _ in range(15):
        rig.step()
        energy.append(rig.energy())
    after, center = rig.totals(), rig.rigid_motion()[0]
    assert scale > 20.0 and energy[-1] < 0.5 * energy[0]
    tolerance = 1e-6 if device == "cpu" else 4e-6  # atomic sums in any order
    np.testing.assert_allclose(after.momentum, before.momentum, atol=tolerance * scale)
    # scale [kg m/s] times the half height [m]
    np.testing.assert_allclose(rig.totals(about=center).angular_momentum, turn, atol=tolerance * scale * 0.85)
    assert np.diff(energy).max() < 1e-5 * energy[0]


def test_the_papers_shape_preservation_breaks_momentum(make_rig):
    # A pull inside ``vk`` has no reaction: selectable, but this is why it is not the default.
    lost = {}
    for kind in ("physical", "kinematic"):
        rig = make_rig(root="free", tone=0.0, shape_preservation=kind)
        rig.strike((0.0, 30.0, 0.0), internal=True)
        scale, worst = rig.totals().momentum_scale, 0.0
        for _ in range(10):
            rig.step()
            worst = max(worst, np.linalg.norm(rig.totals().momentum))
        lost[kind] = worst / scale
    assert lost["physical"] < 5e-6  # what single precision leaves in vk
    assert lost["kinematic"] > 1e-3


# ---- what shape preservation does


def bulge(rig, height: float = 0.03):
    """Push the flesh of the belly out without straining it: elasticity does nothing, only the shape pull does."""
    x = rig.read("x")
    flesh = (rig.points.bone < 0) * np.exp(-((x - [0.0, -0.12, 1.1]) ** 2).sum(1) / 0.1**2)
    rig.state.x.assign((x - height * flesh[:, None] * [0.0, 1.0, 0.0])[None].astype(np.float32))


def healed(make_rig, **options) -> float:
    """Return the share of the largest shape error that half a second heals."""
    rig = make_rig(root="free", decoupling="no_stress", num_substeps=12, **options)
    bulge(rig)
    before = rig.shape_error().max()
    assert before > 0.025
    rig.step(15)
    return 1.0 - rig.shape_error().max() / before


def test_shape_preservation_heals_the_shape_and_nothing_else_does(make_rig):
    assert abs(healed(make_rig, alpha=0.0)) < 0.01
    little, usual, all_of_it = (healed(make_rig, alpha=alpha) for alpha in (0.1, 0.3, 1.0))
    assert 0.05 < little < usual < all_of_it
    assert usual > 0.4 and all_of_it > 0.7


def test_kinematic_shape_preservation_undoes_alpha_of_the_error_a_step(make_rig):
    # x -= alpha (x - LBS) / num_substeps, num_substeps times a control step, toward bones that do not move
    rig = make_rig(root="free", decoupling="no_stress", num_substeps=12, alpha=0.3, shape_preservation="kinematic")
    bulge(rig)
    before = rig.shape_error().max()
    rig.step(3)
    assert rig.shape_error().max() == pytest.approx(before * (1.0 - 0.3 / 12) ** 36, rel=0.03)


def joint_motion(rig, x, u, command, tone):
    """Return the change of velocity by the joints, in double precision: one linear system for bones and impulses.

    It is that of the first substep, in which all of the motion counts as a change by contact and flesh.
    """
    dt, bones = rig.model.step.dt, range(1, 22)
    rotation, place = rig.tracked_world()
    fits = [mean_rigid_motion(rig.mass * rig.weights[:, b], x, u) for b in range(22)]
    mass = rig.mass @ rig.weights
    system, right = np.zeros((132 + 126, 132 + 126)), np.zeros(132 + 126)
    size = rig.mass.sum() * np.ptp(rig.points.rest[0, :, 2]) / (REFERENCE_MASS * REFERENCE_HEIGHT)
    stiffness = tone * size * held_joints(make_muscles().stiffness)
    for b in range(22):
        d = x - fits[b][0]
        second = np.einsum("p,pi,pj->ij", rig.mass * rig.weights[:, b], d, d)
        system[6 * b : 6 * b + 3, 6 * b : 6 * b + 3] = mass[b] * np.eye(3)
        system[6 * b + 3 : 6 * b + 6, 6 * b + 3 : 6 * b + 6] = np.trace(second) * np.eye(3) - second
    for b in bones:
        a, rows = PARENTS[b], slice(132 + 6 * (b - 1), 132 + 6 * b)
        relative = np.zeros((6, 132))  # velocity at the joint and spin, relative to the parent
        for bone, sign in ((b, 1.0), (a, -1.0)):
            arm = place[b] - fits[bone][0]
            relative[:3, 6 * bone : 6 * bone + 3] = relative[3:, 6 * bone + 3 : 6 * bone + 6] = sign * np.eye(3)
            relative[:3, 6 * bone + 3 : 6 * bone + 6] = sign * np.cross(np.eye(3), arm).T
        motion = relative @ np.concatenate([np.concatenate(fit[1:]) for fit in fits])
        local = Rotation.from_matrix(rotation[a].T @ rotation[b])
        error = rotation[a] @ (Rotation.from_rotvec(command[b]) * local.inv()).as_rotvec()
        resistance = (dt * DAMPING_TIME + dt**2) * stiffness[b]
        system[:132, rows], system[rows, :132] = -relative.T, relative
        system[rows.start + 3 : rows.stop, :132] *= resistance
        system[rows.start + 3 : rows.stop, rows.start + 3 : rows.stop] = np.eye(3)
        right[rows] = [*(-1.97 * motion[:3]), *(dt * stiffness[b] * error - 2.0 * resistance * motion[3:])]
    change = np.linalg.solve(system, right)[:132].reshape(22, 2, 3)
    return sum(
        w[:, None] * (v + np.cross(s, x - fit[0])) for w, (v, s), fit in zip(rig.weights.T, change, fits, strict=True)
    )


@pytest.mark.parametrize("tone", [0.0, 0.5])
def test_pulls_and_joints_give_back_bone_by_bone(make_rig, wild_pose, tone):
    # The velocity after pull and joints, against the formulas in double precision. ``u += dl - fit_b(dl)`` with the
    # implicit critically damped change ``dl`` of ``u - u_b``, the decay of motion between bones, and the rigid part of
    # it all returned to the whole body.
    rng = np.random.default_rng(1)
    pose, command = wild_pose(rng), wild_pose(rng, 0.2)
    rig = make_rig(root="free", tone=tone, alpha=0.6).reset(pose, root=(0.0, 0.0, 0.9))
    command = (Rotation.from_rotvec(pose) * Rotation.from_rotvec(command)).as_rotvec()
    rig.avatar.state.command_rotation.assign(rig.quaternions(command))
    rig.command(command)
    x, (count, dt) = rig.read("x"), (rig.points.num_points, rig.model.step.dt)
    place = x.copy()  # as tracked: only flesh is moved
    x = x + 0.02 * rng.normal(size=(count, 3)) * (rig.points.bone < 0)[:, None]
    u = rng.normal(size=(count, 3)) + np.cross((3.0, -2.0, 1.0), x)
    rig.state.x.assign(x[None].astype(np.float32))
    rig.state.u.assign(u[None].astype(np.float32))
    rig.run_controller()
    mass, weights, rate = rig.mass, rig.weights, 0.6 * 30.0
    u_bone = blended_rigid_part(weights, mass, x, u)
    relative = u - u_bone
    pull = (relative + dt * rate**2 * (place - x)) / (1.0 + 2.0 * rate * dt + (rate * dt) ** 2) - relative
    u_body = blended_rigid_part(np.ones((count, 1)), mass, x, u)
    change = pull - blended_rigid_part(weights, mass, x, pull) + (np.exp(-3.0 * dt) - 1.0) * (u_bone - u_body)
    joints = joint_motion(rig, x, u, command, tone)
    change += joints
    change -= blended_rigid_part(np.ones((count, 1)), mass, x, change)
    assert np.abs(change - joints).max() > 0.1 and np.abs(joints).max() > 0.5
    np.testing.assert_allclose(rig.read("u") - u, change, atol=3e-5 * np.abs(change).max())


def test_a_dent_turns_with_the_body(make_rig):
    # A displacement by contact turns with the bones.
    rig = make_rig(root="free", alpha=0.0, decoupling="no_stress", num_substeps=12)
    bulge(rig)
    dent = rig.read("x") - rig.target()
    turn = np.zeros((22, 3))
    for k in range(1, 16):
        turn[0, 2] = k * np.pi / 30.0
        rig.command(turn)
        rig.step()
    np.testing.assert_allclose(rig.tracked_world()[0][0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-3)
    turned = rig.read("x") - rig.target()
    np.testing.assert_allclose(turned, dent @ rig.tracked_world()[0][0].T, atol=1e-3)


# ---- what tone does


@pytest.fixture(scope="module")
def recoils(make_rig):
    """Return largest joint errors [deg] in the control steps after a blow, and shape errors, by tone."""
    errors, shapes = {}, {}
    for tone in (0.0, 0.3, 1.0):
        rig = make_rig(root="free", tone=tone)
        rig.strike((0.0, 30.0, 0.0), internal=True)
        errors[tone] = []
        for _ in range(30):
            rig.step()
            errors[tone].append(np.degrees(rig.joint_errors().max()))
        shapes[tone] = rig.shape_error()
    return {tone: np.array(e) for tone, e in errors.items()}, shapes


def test_a_firm_body_recoils_less(recoils):
    peak = {tone: e.max() for tone, e in recoils[0].items()}
    assert peak[0.0] > 2.0 * peak[0.3] > 3.0 * peak[1.0] > 6.0


def test_a_body_with_tone_returns_to_the_commanded_pose(recoils):
    for tone in (0.3, 1.0):
        error = recoils[0][tone]
        assert error.max() > 2.0  # the joints give way before they return
        assert error[-1] < 0.12 * error.max()
        shape = recoils[1][tone]
        assert shape.mean() < 0.5e-3 and shape.max() < 3e-3


def test_a_body_without_tone_stays_bent(recoils):
    errors = recoils[0]
    settled = {tone: e[-8:].mean() for tone, e in errors.items()}
    assert settled[0.0] > 4.0
    assert settled[0.0] > 5.0 * settled[0.3] > 5.0 * settled[1.0]


def test_tone_brings_a_torn_bone_back(make_rig):
    # A hand moved off its forearm without strain, which elasticity and rotations do not show.
    rig = make_rig(root="free", decoupling="no_stress", tone=1.0)
    hand, elbow = joint_index("left_wrist"), joint_index("left_elbow")

    def gap() -> float:
        rotations, positions = rig.tracked_world()
        arm = rig.points.joints[0, hand] - rig.points.joints[0, elbow]
        return float(np.linalg.norm(positions[hand] - positions[elbow] - rotations[elbow] @ arm))

    rig.state.x.assign((rig.read("x") + 0.2 * rig.weights[:, hand, None] * [1.0, 0.0, 0.0])[None].astype(np.float32))
    rig.track()
    assert gap() > 0.15
    rig.step(15)
    assert gap() < 0.02
    # it was an internal matter
    still = rig.totals()
    np.testing.assert_allclose(still.momentum, 0.0, atol=1e-5 * rig.mass.sum())


@pytest.mark.parametrize(
    ("half", "at", "steps", "expected"),
    [
        ((0.08, 0.05, 0.08), (0.17, -0.16, -0.083), 12, {"left_ankle": 0.1, "left_knee": 0.03}),
        ((0.06, 0.06, 0.08), (0.47, -0.22, 0.93), 30, {"left_elbow": 0.03}),
    ],
    ids=["foot", "hand"],
)
def test_a_joint_resists_contact_with_the_stiffness_of_its_muscles(make_rig, half, at, steps, expected):
    # A smooth box rises under forefoot or hand and stops: the moment about a joint, of contact and of the root's
    # acceleration of the flesh beyond, over the joint's angle. A foot is so light that a damper would hide its spring.
    rig = make_rig(colliders=[Collider("box", half, at, velocity=(0.0, 0.0, 0.05))])
    rig.step(steps)
    rig.model.boundaries.velocity.zero_()
    rig.step(20)
    sensors, wrench, x = rig.scratch.sensors, rig.controller.workspace.wrench, rig.read("x")
    force, moment = (
        a.numpy()[0, 0].astype(float) / rig.model.control_dt
        for a in (sensors.boundary_impulse, sensors.boundary_moment)
    )
    field = wrench.linear.numpy()[0] + np.cross(wrench.angular.numpy()[0], x - rig.rigid_motion()[0])
    size = rig.mass.sum() * np.ptp(rig.points.rest[0, :, 2]) / (REFERENCE_MASS * REFERENCE_HEIGHT)
    assert force[2] > 10.0
    for name, tolerance in expected.items():
        joint = joint_index(name)
        place = rig.tracked_world()[1][joint]
        beyond = rig.mass * rig.weights[:, [b for b in range(22) if hangs_on(b, joint)]].sum(1)
        total = moment - np.cross(place, force) + np.cross(x - place, beyond[:, None] * field).sum(0)
        stiffness = np.linalg.norm(total) / rig.joint_errors()[joint - 1]
        assert stiffness == pytest.approx(size * make_muscles().stiffness[joint], rel=tolerance), name


def hangs_on(bone: int, joint: int) -> bool:
    """Return whether a bone is moved by a joint."""
    return bone == joint or (bone > joint and hangs_on(PARENTS[bone], joint))
