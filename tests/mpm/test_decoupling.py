"""Deformation-gradient decoupling: prescribed motion moves the body, and does not strain it."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.linalg import expm

wp.set_module_options({"enable_backward": False})


def skew(w):
    return np.cross(np.eye(3), w) @ -np.eye(3)


def cross(w):
    """Return the matrix of ``w x``."""
    return np.cross(w, np.eye(3)).T


#: A body wide enough for particles whose stencils' nodes see no skin: there the grid's ``vk``, which has no affine
#: matrix, has the slope of the field; at the skin it is flatter.
WIDE = {"lower": (-0.2, -0.2, -0.2), "upper": (0.2, 0.2, 0.2)}


def inner(sim):
    return np.abs(sim.rest).max(axis=1) < 0.045


def fields(x):
    """Return the prescribed velocity fields [m/s] by name."""
    squeeze = np.array([[1.0, 0.5, 0.0], [0.2, -2.0, 0.3], [0.0, 0.1, 1.0]])
    return {
        "translation": np.broadcast_to([1.0, -0.5, 0.3], x.shape),
        "rotation": x @ skew([1.0, -3.0, 2.0]).T,
        "strain": x @ squeeze.T,
        "waves": 0.5 * np.sin(25.0 * x[:, [1, 2, 0]]) + 0.3 * np.cos(18.0 * x),
    }


@pytest.mark.parametrize("field", ["translation", "rotation", "strain", "waves"])
def test_prescribed_motion_is_followed_and_strains_nothing(simulate, field):
    # Over a body length of travel every particle goes where its own ``vk`` takes it, and F stays the identity.
    sim = simulate(num_substeps=30, control_dt=0.1)
    vk = fields(sim.rest)[field].astype(np.float32)
    sim.set(vk=vk).run()
    assert sim.failures == [0]
    assert np.abs(vk).max() * 0.1 > 0.02  # it went somewhere
    assert np.abs(sim.get("x") - sim.rest - 0.1 * vk).max() < 2e-6
    assert np.abs(sim.get("F") - np.eye(3)).max() < 1e-5
    assert np.abs(sim.get("u")).max() < 1e-3


@pytest.mark.parametrize("rate", [4.0, 100.0])
def test_prescribed_rotation_turns_the_strain(simulate, rate):
    # ``Q F Q^T``: a strained body that is turned keeps its stretches, along turned axes, at the skin as within. A
    # substep turns by ``2 atan(w dt / 2)``, which is a rotation at any rate.
    sim = simulate(num_substeps=10, control_dt=0.01, decoupling="no_stress")
    spin, F = np.array([0.0, 0.0, rate]), np.diag([1.2, 0.9, 1.0])
    sim.set(F=F, vk=np.cross(spin, sim.rest), spin=spin).run()
    assert sim.failures == [0]
    Q = expm(10 * 2.0 * np.arctan(rate * 1e-3 / 2.0) * cross(spin / rate))
    assert np.abs(sim.get("F") - Q @ F @ Q.T).max() < 2e-5
    stretches = np.linalg.svd(sim.get("F"), compute_uv=False)
    assert np.abs(stretches - [1.2, 1.0, 0.9]).max() < 1e-5


def injected(simulate, decoupling, **kwargs):
    """Return a body whose one velocity state was set to the prescribed velocity, after one substep."""
    sim = simulate(num_substeps=1, control_dt=2e-3, decoupling=decoupling, **kwargs)
    vk = fields(sim.rest)["strain"]
    B = np.linalg.lstsq(sim.rest, vk, rcond=None)[0].T
    return sim.set(u=vk, C=B, vk=vk).run(), B


def test_paper_variant_cancels_the_prescribed_gradient(simulate):
    # ``(I + dt grad v) F (I + dt grad vk)^-1`` is I for v = vk within the body, where both gradients are the same.
    sim, _ = injected(simulate, "paper", **WIDE)
    assert np.abs(sim.get("F")[inner(sim)] - np.eye(3)).max() < 1e-5
    assert np.abs(sim.get("x") - sim.rest - 2e-3 * sim.get("u")).max() < 1e-7


def test_plain_variant_is_strained_by_it(simulate):
    sim, B = injected(simulate, "none")
    assert np.abs(sim.get("F") - np.eye(3) - 2e-3 * B).max() < 1e-6
