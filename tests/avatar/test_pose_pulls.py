"""The two pulls: shape preservation and tone. Conservation laws, and what each pull is for."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.skeleton import joint_index
from tests.avatar.conftest import blended_rigid_part

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
    assert lost["physical"] < 1e-5  # what single precision leaves in vk
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
    # x -= alpha (x - LBS) / num_substeps, num_substeps times per control step, toward bones that do not move
    rig = make_rig(root="free", decoupling="no_stress", num_substeps=12, alpha=0.3, shape_preservation="kinematic")
    bulge(rig)
    before = rig.shape_error().max()
    rig.step(3)
    assert rig.shape_error().max() == pytest.approx(before * (1.0 - 0.3 / 12) ** 36, rel=0.03)


@pytest.mark.parametrize("decoupling", ["no_stress", "paper"])
def test_flesh_with_a_rate_of_its_own_heals_by_it(make_rig, decoupling):
    # In the kinematic velocity, each side of the belly as it is in a body that has its rate all over.
    given = {"root": "free", "decoupling": decoupling, "num_substeps": 12, "shape_preservation": "kinematic"}
    sides = make_rig(alpha=0.2, alpha_of=lambda rest: np.where(rest[:, 0] > 0.0, 0.5, 0.1), **given)
    alike = {alpha: make_rig(alpha=alpha, **given) for alpha in (0.5, 0.1)}
    left = sides.points.rest[0][:, 0] > 0.0
    for rig in (sides, *alike.values()):
        bulge(rig)
        if decoupling == "paper":
            rig.run_part_of_step("inject_velocity", 1)
        else:
            rig.run_controller()
    change = {alpha: alike[alpha].read("vk") for alpha in alike}
    assert np.abs(change[0.5] - change[0.1]).max() > 0.05
    expected = np.where(left[:, None], change[0.5], change[0.1])
    np.testing.assert_allclose(sides.read("vk"), expected, atol=1e-6)


@pytest.mark.parametrize("own", [False, True])
def test_the_pull_is_given_back_bone_by_bone(make_rig, wild_pose, own):
    # The velocity after the pull, against the formula in double precision. ``u += dl - fit_b(dl)`` with the implicit
    # critically damped change ``dl`` of ``u - u_b``, the decay of motion between bones, and the rigid part of it all
    # returned to the whole body.
    rng = np.random.default_rng(1)
    given = {"alpha": 0.0, "alpha_of": lambda rest: 0.2 + 0.5 * (rest[:, 0] > 0.05)} if own else {"alpha": 0.6}
    rig = make_rig(root="free", tone=0.0, **given).reset(wild_pose(rng), root=(0.0, 0.0, 0.9))
    x, (count, dt) = rig.read("x"), (rig.points.num_points, rig.model.step.dt)
    place = x.copy()  # as tracked: only flesh is moved
    x = x + 0.02 * rng.normal(size=(count, 3)) * (rig.points.bone < 0)[:, None]
    u = rng.normal(size=(count, 3)) + np.cross((3.0, -2.0, 1.0), x)
    rig.state.x.assign(x[None].astype(np.float32))
    rig.state.u.assign(u[None].astype(np.float32))
    rig.run_controller()
    mass, weights = rig.mass, rig.weights
    rate = 30.0 * (given["alpha_of"](rig.points.rest[0]) if own else np.full(count, 0.6))[:, None]
    u_bone = blended_rigid_part(weights, mass, x, u)
    relative = u - u_bone
    pull = (relative + dt * rate**2 * (place - x)) / (1.0 + 2.0 * rate * dt + (rate * dt) ** 2) - relative
    u_body = blended_rigid_part(np.ones((count, 1)), mass, x, u)
    change = pull - blended_rigid_part(weights, mass, x, pull) + (np.exp(-3.0 * dt) - 1.0) * (u_bone - u_body)
    change -= blended_rigid_part(np.ones((count, 1)), mass, x, change)
    assert np.abs(change).max() > 0.1
    np.testing.assert_allclose(rig.read("u") - u, change, atol=2e-5)


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
    assert settled[0.0] > 8.0
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


@pytest.mark.parametrize("tone", [0.5, 1.0])
def test_tone_pulls_at_its_natural_frequency(make_rig, tone):
    # A pose error without velocity closes like an oscillator of frequency ``w = 30 tone`` with damping ``2 w + 3``. In
    # closed form ``(b exp(-a t) - a exp(-b t)) / (b - a)`` with ``a + b = 2 w + 3`` and ``a b = w^2``. Without stress,
    # so that elasticity does not help, and at the hip, whose bones are many grid cells wide.
    rig = make_rig(root="free", decoupling="no_stress", num_substeps=30, tone=tone)
    hip = joint_index("left_hip")
    command = np.zeros((22, 3))
    command[hip, 0] = 0.1
    rig.avatar.state.command_rotation.assign(rig.quaternions(command))
    rig.command(command)
    errors = [rig.joint_errors()[hip - 1]]
    for _ in range(4):
        rig.step()
        errors.append(rig.joint_errors()[hip - 1])
    t, w = np.arange(5) / 30.0, 30.0 * tone
    middle = w + 1.5
    spread = np.sqrt(middle**2 - w**2)
    a, b = middle - spread, middle + spread
    expected = (b * np.exp(-a * t) - a * np.exp(-b * t)) / (b - a)
    np.testing.assert_allclose(np.array(errors) / 0.1, expected, atol=0.04)
    assert expected[-1] < 0.5
