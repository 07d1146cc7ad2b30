"""Passive resistance of joints: published moments, and the energy of flesh that skinning strains."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body import flesh_stiffness as stiffness_module
from piavatar_envs.avatar.body.flesh_stiffness import flesh_stiffness
from piavatar_envs.avatar.body.interpolation import rest_gradient
from piavatar_envs.avatar.body.passive import passive_moments
from piavatar_envs.avatar.body.sampling import sample_particles, spacing_for
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, forward_kinematics, joint_index, joint_limits, skin
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.torque_control.joint_tissue import JointTissue, Tissue, make_tissue, tissue_pull
from piavatar_envs.mpm.model import lame_parameters

SPINE = [joint_index(f"spine{n}") for n in (1, 2, 3)]
HIP, KNEE, ANKLE = (joint_index(f"left_{name}") for name in ("hip", "knee", "ankle"))
MU, LAM = lame_parameters(np.float64(1e5), np.float64(0.3))


@pytest.fixture(scope="module")
def body():
    """Return the asset and its particles, as many as a tiny body has."""
    asset = load_asset()
    return asset, sample_particles(asset, spacing_for(float(np.ptp(asset.vertices[:, 2])) / 24))


@pytest.fixture(scope="module")
def flesh(body) -> np.ndarray:
    """Return the stiffness of its joints by flesh of 100 kPa, held at its skinned places."""
    asset, p = body
    whole = np.ones(len(p.rest_positions))
    skinning = p.skin_joints, p.skin_weights
    return flesh_stiffness(p.rest_positions, p.volumes, asset.joints, p.links, *skinning, MU * whole, LAM * whole)


@wp.kernel
def pull_joints(tissue: Tissue, bend: wp.array2d(dtype=wp.vec3), pull: wp.array2d(dtype=wp.vec3)):
    e, b = wp.tid()
    pull[e, b] = tissue_pull(tissue, bend, 1.0, e, b)


def pulls(bend: np.ndarray, device: str, flesh: np.ndarray | None = None) -> np.ndarray:
    """Return the pulls of passive moments and flesh on joints, ``(n, 22, 3)``, that are bent by rotation vectors."""
    tissue = make_tissue(JointTissue(np.zeros(NUM_JOINTS), *joint_limits(), [], passive_moments(), flesh), device)
    at = wp.array(bend.astype(np.float32), dtype=wp.vec3, device=device)
    found = wp.zeros_like(at)
    wp.launch(pull_joints, at.shape, [tissue, at], [found], device=device)
    return found.numpy().astype(float)


def bent(joint: int, axis: int, angles) -> np.ndarray:
    """Return poses with one joint bent by ``angles`` [rad]."""
    bend = np.zeros((len(angles), NUM_JOINTS, 3))
    bend[:, joint, axis] = angles
    return bend


def potential(s, end, moment, rate):
    """Return the integral of a passive moment from 0 to ``s``."""
    s, least = np.maximum(s, 0.0), np.exp(-rate * end)
    return moment * ((np.exp(rate * (s - end)) - least) / rate - least * s)


def energy(bend: np.ndarray, flesh: np.ndarray) -> np.ndarray:
    """Return the energy of passive moments and flesh."""
    m, (lower, upper) = passive_moments(), joint_limits()
    total = potential(-bend, -lower, m.lower, m.lower_rate)[:, 1:].sum((1, 2))
    total += potential(bend, upper, m.upper, m.upper_rate)[:, 1:].sum((1, 2))
    total += potential((bend[:, m.joints, 0] * m.shares).sum(-1), m.ends, m.moments, m.rates).sum(1)
    total += 0.5 * np.einsum("nai,aibj,nbj->n", bend, flesh, bend)
    t = (bend**2).sum(-1)
    return total + 0.5 * np.einsum("nai,aiaj,naj,na->n", bend, flesh, bend, t / (2.0 + t))


def test_tissue_gives_back_what_it_takes(flesh, device):
    rng, turn = np.random.default_rng(0), 1e-5
    lower, upper = joint_limits()
    bend = rng.uniform(lower, upper, (3, NUM_JOINTS, 3))
    bend[:, 0] = 0.0
    moves = turn * np.eye(3 * NUM_JOINTS).reshape(-1, NUM_JOINTS, 3)
    expected = np.array([(energy(v - moves, flesh) - energy(v + moves, flesh)) / (2.0 * turn) for v in bend])
    got = pulls(bend, device, flesh).reshape(3, -1)
    assert np.abs(expected[:, 3:]).max() > 100.0
    # couplings below a hundredth are left out
    np.testing.assert_allclose(got[:, 3:], expected[:, 3:], atol=0.02 * np.abs(expected).max())


def test_nothing_pulls_at_rest(flesh, device):
    assert not pulls(np.zeros((1, NUM_JOINTS, 3)), device, flesh).any()


@pytest.mark.parametrize("knee", [0.0, 60.0])
def test_a_hip_resists_as_measured(device, knee):
    # Riener & Edrich: hamstrings stretched by a bent hip, less where the knee is bent, too.
    bend = bent(HIP, 0, -np.radians([60.0, 75.0, 90.0]))
    bend[:, KNEE, 0] = np.radians(knee)
    found = pulls(bend, device)
    measured = np.exp(1.3403 + 0.0305 * np.array([60.0, 75.0, 90.0]) - 0.0226 * knee)
    np.testing.assert_allclose(found[:, HIP, 0], measured, rtol=0.1, atol=4.0)  # less what it is at rest
    np.testing.assert_allclose(found[:, KNEE, 0] - pulls(bent(KNEE, 0, [np.radians(knee)]), device)[0, KNEE, 0],
                               0.741 * found[:, HIP, 0], rtol=0.15, atol=1.0)  # fmt: skip


def test_an_ankle_resists_as_measured(device):
    angles = np.array([10.0, 15.0, 20.0])
    found = pulls(bent(ANKLE, 0, -np.radians(angles)), device)[:, ANKLE, 0]
    np.testing.assert_allclose(found, np.exp(2.1016 + 0.0843 * angles) - np.exp(2.1016), rtol=0.05)


def test_a_trunk_resists_as_measured(device):
    # Lateral bending of 20 degrees in equal moments: quarters of 0.25, 0.6, 1.7 and 5.1 N m per degree.
    moments = np.array(
        [pulls(bent(b, 1, -np.linspace(0.0, joint_limits()[1][b, 1], 5)), device)[:, b, 1] for b in SPINE]
    )
    np.testing.assert_allclose(moments, moments[:1].repeat(3, 0), rtol=1e-4)
    stiffness = np.diff(moments[0]) / 5.0
    np.testing.assert_allclose(stiffness, [0.25, 0.62, 1.72, 5.1], rtol=0.25)


def strained_energy(body, rotvec: np.ndarray) -> float:
    """Return the Neo-Hookean energy of flesh at its skinned places."""
    asset, p = body
    rest, joints = p.rest_positions.astype(float), asset.joints.astype(float)
    pose = forward_kinematics(Rotation.from_rotvec(rotvec).as_matrix(), joints[0], joints)
    x = skin(rest, p.skin_joints, p.skin_weights.astype(float), *pose, joints)
    F = np.stack([along @ x for along in rest_gradient(rest, p.links)[0]], axis=-1)
    known = (
        np.abs(np.stack([along @ rest for along in rest_gradient(rest, p.links)[0]], -1) - np.eye(3)).max((1, 2)) < 1e-6
    )
    J = np.linalg.det(F[known])
    density = 0.5 * MU * ((F[known] ** 2).sum((1, 2)) - 3.0) - MU * np.log(J) + 0.5 * LAM * np.log(J) ** 2
    return float(density @ p.volumes[known])


def test_flesh_stiffness_takes_only_joints_that_bend_their_flesh(body, monkeypatch):
    # Counted instead of timed: strains of particles by joints, a few together, as large bodies have thousands.
    asset, p = body
    whole, counts, strains = np.ones(len(p)), [], stiffness_module._strains
    skinning = p.skin_joints, p.skin_weights
    given = p.rest_positions, p.volumes, asset.joints, p.links, *skinning, MU * whole, LAM * whole

    def counted(rest, joints, share, along):
        counts.append(len(joints) * along[0].shape[0])
        return strains(rest, joints, share, along)

    monkeypatch.setattr(stiffness_module, "_strains", counted)
    together = flesh_stiffness(*given)
    assert counts == [(NUM_JOINTS - 1) * len(p)]
    counts.clear()
    monkeypatch.setattr(stiffness_module, "AT_ONCE", 64)
    np.testing.assert_allclose(flesh_stiffness(*given), together, rtol=1e-6, atol=1e-6 * np.abs(together).max())
    assert sum(counts) < 0.5 * NUM_JOINTS * len(p)


@pytest.mark.parametrize(("joint", "axis", "degrees", "error"), [
    ("spine1", 0, 10.0, 0.1), ("spine2", 0, 20.0, 0.2), ("spine3", 1, 10.0, 0.1), ("spine1", 2, 5.0, 0.1),
    ("left_hip", 0, -45.0, 0.2), ("left_knee", 0, 60.0, 0.25), ("left_shoulder", 1, 60.0, 0.25), ("neck", 0, 10.0, 0.1),
])  # fmt: skip
def test_flesh_stiffness_is_that_of_the_skinned_shape(body, flesh, joint, axis, degrees, error):
    bend = bent(joint_index(joint), axis, [np.radians(degrees)])
    quadratic = 0.5 * np.einsum("nai,aibj,nbj->n", bend, flesh, bend)[0]
    t = np.radians(degrees) ** 2
    assert (1.0 + t / (2.0 + t)) * quadratic == pytest.approx(strained_energy(body, bend[0]), rel=error)


def test_flesh_couples_the_joints_of_a_trunk(body, flesh):
    # Bent in one sense they strain the same flesh, so that the whole is stiffer than its joints one by one.
    bend = np.zeros((1, NUM_JOINTS, 3))
    bend[0, SPINE, 0] = np.radians([10.0, 10.0, 6.0])
    alone = sum(0.5 * flesh[b, 0, b, 0] * bend[0, b, 0] ** 2 for b in SPINE)
    together = strained_energy(body, bend[0])
    assert together > 1.3 * alone
    assert 0.5 * np.einsum("nai,aibj,nbj->n", bend, flesh, bend)[0] == pytest.approx(together, rel=0.15)
