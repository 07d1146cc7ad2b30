"""Constitutive models: the stress in the kernels is the derivative of the energy in NumPy, for every material."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import piavatar_envs
from piavatar_envs.config.schema import PhysicsConfig
from piavatar_envs.mpm.compression import J_MIN
from piavatar_envs.mpm.materials import (
    MATERIALS,
    kirchhoff_stress,
    lame_parameters,
    material_index,
    von_mises_stress,
)
from piavatar_envs.mpm.model import CFL_STABLE

wp.set_module_options({"enable_backward": False})

MU, LAM = (float(value) for value in lame_parameters(1.0e5, 0.3))
COUNT = 60
VOLUME_RATIOS = {"squashed": 1.2 * J_MIN, "below J_MIN": 0.6 * J_MIN, "nearly flat": 1e-3, "inverted": -0.3}

pytestmark = pytest.mark.filterwarnings("error")
each_material = pytest.mark.parametrize("material", MATERIALS)


@wp.kernel
def probe_stress(material: int, mu: float, lam: float, F: wp.array(dtype=wp.mat33), tau: wp.array(dtype=wp.mat33)):
    p = wp.tid()
    tau[p] = kirchhoff_stress(material, F[p], mu, lam)


@wp.kernel
def probe_von_mises(tau: wp.array(dtype=wp.mat33), J: wp.array(dtype=float), out: wp.array(dtype=float)):
    p = wp.tid()
    out[p] = von_mises_stress(tau[p], J[p])


@pytest.fixture(scope="module")
def stress(device):
    """Return Kirchhoff stress from the kernel, in double precision, shape (P, 3, 3) [Pa]."""

    def evaluate(material, F, mu=MU, lam=LAM):
        F = wp.array(np.ascontiguousarray(F, np.float32), dtype=wp.mat33, device=device)
        tau = wp.zeros_like(F)
        wp.launch(probe_stress, len(F), inputs=[material_index(material), mu, lam, F, tau], device=device)
        return tau.numpy().astype(float)

    return evaluate


def rotations(count, seed):
    return Rotation.random(count, random_state=seed).as_matrix()


def deformations(kind):
    """Return the float32-exact deformation gradients ``U diag(stretches) V^T`` of one kind, shape (COUNT, 3, 3)."""
    rng = np.random.default_rng(len(kind))
    if kind == "small":
        stretches = 1.0 + rng.uniform(-1e-2, 1e-2, (COUNT, 3))
    elif kind == "moderate":
        stretches = rng.uniform(0.6, 1.6, (COUNT, 3))
    elif kind == "large":
        stretches = np.exp(rng.uniform(-1.5, 1.5, (COUNT, 3)))
    else:
        stretches = rng.uniform(0.7, 1.4, (COUNT, 3))
        stretches[:, 0] = VOLUME_RATIOS[kind] / (stretches[:, 1] * stretches[:, 2])
    F = rotations(COUNT, 1) @ (stretches[:, :, None] * rotations(COUNT, 2))
    return F.astype(np.float32).astype(float)


def energy_gradient(material, F, step=1e-6):
    """Return the central differences of the energy density with respect to F, shape (P, 3, 3) [Pa]."""
    gradient = np.empty_like(F)
    for i in range(3):
        for j in range(3):
            delta = np.zeros((3, 3))
            delta[i, j] = step
            gradient[:, i, j] = (material.energy(F + delta, MU, LAM) - material.energy(F - delta, MU, LAM)) / (
                2.0 * step
            )
    return gradient


@each_material
@pytest.mark.parametrize("kind", ["small", "moderate", "large", *VOLUME_RATIOS])
def test_stress_is_the_energy_gradient(stress, material, kind):
    F = deformations(kind)
    expected = energy_gradient(MATERIALS[material], F) @ np.swapaxes(F, 1, 2)
    error = np.linalg.norm(stress(material, F) - expected, axis=(1, 2))
    # what float32 can resolve: terms of size mu |F|^2 cancel in the stress
    resolution = MU * np.linalg.norm(F, axis=(1, 2)) ** 2 + np.linalg.norm(expected, axis=(1, 2))
    assert (error / resolution).max() < 1e-5


@each_material
@pytest.mark.parametrize("kind", ["moderate", "large"])
def test_stress_is_objective_and_isotropic(stress, material, kind):
    # Turning the body turns the stress with it; turning the matter before it is deformed changes nothing.
    F, Q = deformations(kind), rotations(COUNT, 7)
    tau = stress(material, F)
    scale = MU * np.linalg.norm(F, axis=(1, 2)) ** 2 + np.linalg.norm(tau, axis=(1, 2))
    turned = np.abs(stress(material, Q @ F) - Q @ tau @ np.swapaxes(Q, 1, 2)).max(axis=(1, 2))
    assert (turned / scale).max() < 3e-6
    assert (np.abs(stress(material, F @ Q) - tau).max(axis=(1, 2)) / scale).max() < 3e-6
    assert (np.abs(tau - np.swapaxes(tau, 1, 2)).max(axis=(1, 2)) / scale).max() < 1e-6


@each_material
def test_no_stress_in_rotations(stress, material):
    assert np.abs(stress(material, rotations(COUNT, 3))).max() < 2e-6 * (2.0 * MU + 3.0 * LAM)
    assert MATERIALS[material].energy(rotations(COUNT, 3), MU, LAM) == pytest.approx(0.0, abs=1e-8)


@each_material
@pytest.mark.parametrize("poisson_ratio", [0.0, 0.3, 0.45])
def test_small_strains_obey_hooke(stress, material, poisson_ratio):
    # A bar pulled by ``e`` and thinned by ``nu e`` has the axial stress ``E e`` and no other.
    young_modulus, strain = 2.0e5, 1e-3
    F = np.diag([1.0 + strain, 1.0 - poisson_ratio * strain, 1.0 - poisson_ratio * strain])
    tau = stress(material, F[None], *map(float, lame_parameters(young_modulus, poisson_ratio)))[0]
    assert np.abs(tau - np.diag([young_modulus * strain, 0.0, 0.0])).max() < 5.0 * young_modulus * strain**2


def test_von_mises(device):
    # Uniaxial stress s gives s, shear t gives sqrt(3) t, pressure gives nothing; all of the Cauchy stress tau / J.
    shear = np.zeros((3, 3))
    shear[0, 1] = shear[1, 0] = 1.0
    Q = rotations(1, 8)[0]
    cases = [
        (np.diag([5.0, 0.0, 0.0]), 1.0, 5.0),
        (np.diag([5.0, 0.0, 0.0]), 2.0, 2.5),
        (Q @ np.diag([-7.0, 0.0, 0.0]) @ Q.T, 1.0, 7.0),
        (3.0 * shear, 1.0, 3.0 * np.sqrt(3.0)),
        (4.0 * np.eye(3), 1.0, 0.0),
    ]
    tau = wp.array(np.array([c[0] for c in cases], np.float32), dtype=wp.mat33, device=device)
    J = wp.array(np.array([c[1] for c in cases], np.float32), dtype=float, device=device)
    out = wp.zeros_like(J)
    wp.launch(probe_von_mises, len(cases), inputs=[tau, J, out], device=device)
    assert out.numpy() == pytest.approx([c[2] for c in cases], abs=1e-5)


def test_bad_materials_are_refused():
    with pytest.raises(ValueError, match=r"'steel'.*neo_hookean"):
        material_index("steel")
    for poisson_ratio in (0.5, 0.7, -0.1, np.nan):
        with pytest.raises(ValueError, match=rf"poisson_ratio={poisson_ratio}.*\[0, 0.5\)"):
            lame_parameters(1e5, [0.3, poisson_ratio])
    with pytest.raises(ValueError, match="young_modulus=-1"):
        lame_parameters([1.0, -1.0], 0.3)


#: St. Venant-Kirchhoff, as a user would write it in a module of their own.
USERS_MATERIAL = """
import numpy as np
import warp as wp


@wp.func
def stress(F: wp.mat33, mu: float, lam: float):
    E = 0.5 * (wp.transpose(F) * F - wp.identity(n=3, dtype=float))
    S = 2.0 * mu * E + lam * wp.trace(E) * wp.identity(n=3, dtype=float)
    return F * S * wp.transpose(F)


def energy(F, mu, lam):
    E = 0.5 * (np.swapaxes(F, -1, -2) @ F - np.eye(3))
    return mu * (E**2).sum((-1, -2)) + 0.5 * lam * np.trace(E, axis1=-2, axis2=-1) ** 2
"""


@pytest.fixture
def users_material(tmp_path, monkeypatch):
    """Register a material from a module outside the package."""
    (tmp_path / "users_material.py").write_text(USERS_MATERIAL)
    monkeypatch.syspath_prepend(str(tmp_path))
    module = importlib.import_module("users_material")
    piavatar_envs.register_material("st_venant_kirchhoff", module.stress, module.energy)
    yield "st_venant_kirchhoff"
    del MATERIALS["st_venant_kirchhoff"], sys.modules["users_material"]


def test_a_registered_material_is_one_like_any_other(stress, simulate, users_material):
    # Its stress is the derivative of its energy, a body of it vibrates without gaining energy, settings accept it.
    F = deformations("moderate")
    expected = energy_gradient(MATERIALS[users_material], F) @ np.swapaxes(F, 1, 2)
    np.testing.assert_allclose(stress(users_material, F), expected, atol=1e-5 * np.abs(expected).max())
    before = energy_gradient(MATERIALS["neo_hookean"], F) @ np.swapaxes(F, 1, 2)
    np.testing.assert_allclose(stress("neo_hookean", F), before, atol=1e-5 * np.abs(before).max())
    sim = simulate(num_substeps=20, material=users_material)
    sim.set(u=0.5 * np.sin(8.0 * sim.rest[:, [1, 2, 0]]))
    history = [sim.totals(), *(sim.run().totals() for _ in range(10))]
    energy = np.array([t.kinetic + t.elastic for t in history])
    assert sim.failures == [0]
    assert max(t.elastic for t in history) > 0.05 * energy[0]
    assert np.diff(energy).max() < 1e-3 * energy[0]
    assert PhysicsConfig(material=users_material).material == users_material
    with pytest.raises(ValueError, match=r"'jelly'.*st_venant_kirchhoff"):
        PhysicsConfig(material="jelly")


def test_bad_registrations_are_refused():
    law = MATERIALS["neo_hookean"]
    with pytest.raises(ValueError, match="'neo_hookean'"):
        piavatar_envs.register_material("neo_hookean", law.kirchhoff_stress, law.energy)
    with pytest.raises(ValueError, match="'not a name'"):
        piavatar_envs.register_material("not a name", law.kirchhoff_stress, law.energy)
    with pytest.raises(TypeError, match="'mine'"):
        piavatar_envs.register_material("mine", law.energy, law.energy)


@each_material
@pytest.mark.parametrize("poisson_ratio", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("volume_ratio", [0.55, 0.3, 0.1])
@pytest.mark.parametrize("squeezed", [1, 3])
def test_the_barrier_of_squeezed_matter_needs_no_shorter_substep(material, poisson_ratio, volume_ratio, squeezed):
    # Waves in matter squeezed along one axis or all: substeps for ``c dt / dx = 0.5`` at rest are stable to CFL_STABLE.
    mu, lam = lame_parameters(1.0e5, poisson_ratio)
    law, step = MATERIALS[material], 1e-4
    log_stretch = np.zeros(3)
    log_stretch[:squeezed] = np.log(volume_ratio) / squeezed
    for axis in range(3):
        along = step * np.eye(3)[axis]
        energies = [law.energy(np.diag(np.exp(log_stretch + k * along)), mu, lam) for k in (-1.0, 0.0, 1.0)]
        modulus = np.diff(energies, 2)[0] / step**2
        assert 0.0 < modulus < (CFL_STABLE / 0.5) ** 2 * (lam + 2.0 * mu)
