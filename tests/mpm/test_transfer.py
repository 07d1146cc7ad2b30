"""Transfers: what leaves the particles arrives on them again, and nothing else does."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.mpm.materials import MATERIALS


def smooth_velocity(x, seed=0, amplitude=1.0, wavelength=0.3):
    """Return a random smooth velocity field without drift [m/s], shape of ``x``."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(4, 3)) * 2.0 * np.pi / wavelength / np.sqrt(3.0)
    velocity = amplitude * np.sin(x @ waves.T + rng.uniform(0.0, 6.0, 4)) @ rng.normal(size=(4, 3))
    return velocity - velocity.mean(axis=0)


def strain(F):
    """Return the largest entry of ``F^T F - I``."""
    return np.abs(np.swapaxes(F, 1, 2) @ F - np.eye(3)).max()


@pytest.mark.parametrize("decoupling", ["split", "paper", "none", "no_stress"])
def test_momentum_of_a_free_body_is_kept(simulate, decoupling):
    # Linear and angular momentum, to round-off, while it deforms by tens of percent and moves by ``vk``.
    rng = np.random.default_rng(2)
    sim = simulate(num_substeps=40, decoupling=decoupling, control_dt=0.06, young_modulus=1.0e4)
    u, C = smooth_velocity(sim.rest, 1) + [0.5, -0.3, 0.2], rng.normal(size=(len(sim.rest), 3, 3))
    sim.set(u=u, C=C)
    if decoupling in ("split", "no_stress"):
        sim.set(vk=smooth_velocity(sim.rest, 3, 0.5))
    before = sim.totals()
    after = sim.run(2).totals()
    assert sim.failures == [0]
    assert strain(sim.get("F")) > 0.1 or decoupling == "no_stress"
    reach = 0.2  # of the lever arms [m]
    assert np.abs(after.momentum - before.momentum).max() < 1e-6 * before.momentum_scale
    assert np.abs(after.angular_momentum - before.angular_momentum).max() < 1e-6 * reach * before.momentum_scale


@pytest.mark.parametrize("material", MATERIALS)
def test_energy_never_rises(simulate, material):
    # A free body that vibrates and tumbles: APIC may lose energy, never gain any.
    sim = simulate(num_substeps=20, material=material)
    sim.set(u=smooth_velocity(sim.rest, 1, 1.0, wavelength=0.8))
    history = [sim.totals(), *(sim.run().totals() for _ in range(40))]
    energy = np.array([t.kinetic + t.elastic for t in history])
    assert sim.failures == [0]
    assert max(t.elastic for t in history) > 0.2 * energy[0]  # it does vibrate
    assert np.diff(energy).max() < 1e-4 * energy[0]


def test_free_fall(simulate):
    # Symplectic Euler of the particle alone: v = g t and x = g dt^2 n (n + 1) / 2, with no strain.
    gravity, steps = np.array([0.3, -0.5, -9.81]), 40
    sim = simulate(num_substeps=steps, control_dt=0.2, gravity=gravity, young_modulus=5.0e4)
    dt = 0.2 / steps
    sim.set(u=[1.0, 0.0, 2.0]).run()
    assert np.abs(sim.get("u") - [1.0, 0.0, 2.0] - gravity * 0.2).max() < 1e-5
    path = np.array([1.0, 0.0, 2.0]) * 0.2 + gravity * dt**2 * steps * (steps + 1) / 2
    assert np.abs(sim.get("x") - sim.rest - path).max() < 1e-6
    assert strain(sim.get("F")) < 1e-5


def test_affine_field_is_reproduced(simulate):
    # APIC carries an affine velocity through the grid and back, whatever the particles' masses.
    rng = np.random.default_rng(4)
    offset, B = rng.normal(size=3), rng.normal(size=(3, 3))
    sim = simulate(num_substeps=1, control_dt=1e-4, decoupling="no_stress")
    x = sim.rest + rng.uniform(-0.01, 0.01, sim.rest.shape)
    sim.model.particles.mass.assign(rng.uniform(0.1, 3.0, (1, len(x))).astype(np.float32))
    sim.set(x=x, u=offset + x @ B.T, C=B).run()
    assert np.abs(sim.get("u") - offset - x @ B.T).max() < 5e-6
    assert np.abs(sim.get("C") - B).max() < 1e-4
    assert np.abs(sim.get("F") - np.eye(3) - 1e-4 * B).max() < 1e-6
    assert np.abs(sim.get("x") - x - 1e-4 * (offset + x @ B.T)).max() < 1e-7


def test_spinning_body(simulate):
    # A rigid spin makes no stress but that of its centrifugal force, and keeps its angular momentum and speed.
    omega, young_modulus = np.array([1.0, -2.0, 3.0]), 1.0e6
    sim = simulate(young_modulus=young_modulus, control_dt=0.5, num_substeps=700)
    x = sim.rest
    spin = np.array([[0.0, -omega[2], omega[1]], [omega[2], 0.0, -omega[0]], [-omega[1], omega[0], 0.0]])
    sim.set(u=x @ spin.T, C=spin)
    before = sim.totals()
    after = sim.run().totals()
    turned = sim.get("F")
    rotation = np.linalg.svd(turned)
    assert np.abs(turned - rotation[0] @ rotation[2]).max() < 2.0 * 1000.0 * (omega @ omega) * 0.03 / young_modulus
    assert np.trace(turned.mean(0)) < 2.9  # it did turn, by 1.87 rad
    scale = np.linalg.norm(before.angular_momentum)
    assert np.abs(after.angular_momentum - before.angular_momentum).max() < 2e-5 * scale
    assert after.kinetic == pytest.approx(before.kinetic, rel=2e-3)


def test_gravity_is_the_only_force_without_stress(simulate):
    # ``"no_stress"``: a body squeezed to half its size stays so, with stress it bursts.
    squeezed = 0.5 * np.eye(3)
    still = simulate(decoupling="no_stress").set(F=squeezed).run()
    assert np.abs(still.get("u")).max() == 0.0
    assert np.array_equal(still.get("F"), np.broadcast_to(squeezed, (len(still.rest), 3, 3)))
    burst = simulate(decoupling="split").set(F=squeezed).run()
    assert np.abs(burst.get("u")).max() > 1.0
