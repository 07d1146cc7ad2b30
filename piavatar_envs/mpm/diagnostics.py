"""Conserved quantities, computed on the host in double precision, for tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from piavatar_envs.mpm.materials import MATERIALS
from piavatar_envs.mpm.types import NO_STRESS, SPLIT, Model, State

_TWO_STATE = {int(SPLIT), int(NO_STRESS)}


@dataclass(frozen=True)
class Totals:
    """Totals over some particles of one environment.

    Attributes:
        mass: [kg].
        momentum: linear momentum [kg m/s], shape ``(3,)``.
        angular_momentum: about ``about`` [kg m^2/s], shape ``(3,)``, with the affine part.
        momentum_scale: sum of ``m |v|`` [kg m/s], the scale of round-off errors of the momentum.
        kinetic: kinetic energy with the affine part [J].
        elastic: elastic energy [J].
    """

    mass: float
    momentum: np.ndarray
    angular_momentum: np.ndarray
    momentum_scale: float
    kinetic: float
    elastic: float


def totals(model: Model, state: State, env: int = 0, select=slice(None), about=(0.0, 0.0, 0.0)) -> Totals:
    """Return the conserved totals of the particles ``select`` of environment ``env``.

    An affine velocity on quadratic splines carries the angular momentum ``m dx^2/4 axial(C)`` and the kinetic energy
    ``m dx^2/8 |C|^2`` (Jiang et al. 2015, supplement: ``D_p = dx^2/4 I``).
    """
    host = {name: array[env][select].astype(float) for name, array in state.numpy().items() if array.ndim > 1}
    properties = {
        name: np.asarray(getattr(model.particles, name).numpy()) for name in ("mass", "volume", "mu", "lam", "material")
    }
    m, volume, mu, lam, material = (p[min(env, len(p) - 1)][select] for p in properties.values())
    m, volume = m.astype(float), volume.astype(float)
    v = host["u"] + (host["vk"] if model.step.decoupling in _TWO_STATE else 0.0)
    x, C, F = host["x"] - np.asarray(about, float), host["C"], host["F"]
    axial = np.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], axis=1)
    inertia = 0.25 * model.grid.dx**2
    elastic = 0.0
    for index, law in enumerate(MATERIALS.values()):
        chosen = material == index
        if chosen.any():
            elastic += float((law.energy(F[chosen], mu[chosen], lam[chosen]) * volume[chosen]).sum())
    return Totals(
        mass=float(m.sum()),
        momentum=(m[:, None] * v).sum(0),
        angular_momentum=(m[:, None] * (np.cross(x, v) + inertia * axial)).sum(0),
        momentum_scale=float((m * np.linalg.norm(v, axis=1)).sum()),
        kinetic=float(0.5 * (m * ((v**2).sum(1) + inertia * (C**2).sum((1, 2)))).sum()),
        elastic=elastic,
    )
