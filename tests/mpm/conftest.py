"""Small bodies of matter for the tests of the material point method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from benchmarks.physics.matter import Matter, ball, build_matter, lattice
from piavatar_envs.mpm.model import BODY_CONTACT_GATE, Fields, MaterialPoints


@pytest.fixture(scope="session")
def simulate(device: str) -> Callable[..., Matter]:
    """Build a box of matter, see :func:`benchmarks.physics.matter.build_matter`."""
    return partial(build_matter, device=device)


@pytest.fixture(scope="session")
def meet(simulate) -> Callable[..., Matter]:
    """Build boxes and balls with velocities, each a subject and a row of the contact sensor of its own.

    A body is ``{"box": (lower, upper)}`` or ``{"ball": (center, radius)}`` and may have a ``velocity`` [m/s] and a
    ``density`` [kg/m^3]; its Young's modulus is ``stiffness * density``, so that all have the same speed of sound.
    """

    def build(
        bodies: Sequence[dict],
        friction: np.ndarray | float = 0.0,
        gate: float = BODY_CONTACT_GATE,
        normals: str = "shared",
        spacing: float = 0.025,
        stiffness: float = 100.0,
        retardation: float = 0.0,
        material: str = "neo_hookean",
        domain: Sequence[Sequence[float]] = ((-1.0, -0.8, -0.8), (1.0, 0.8, 0.8)),
        **kwargs,
    ) -> Matter:
        parts = [lattice(*b["box"], spacing) if "box" in b else ball(*b["ball"], spacing) for b in bodies]
        counts = [len(part) for part in parts]
        density = np.array([body.get("density", 1000.0) for body in bodies])
        fields = Fields(tuple(range(len(bodies))), friction, density, gate, normals, len(bodies))
        field = np.repeat(np.arange(len(bodies)), counts)
        points = replace(
            MaterialPoints.uniform(np.full(len(field), spacing**3), material=material, retardation=retardation),
            density=density[None, field],
            young_modulus=stiffness * density[None, field],
            field=field,
            sensor=field,
        )
        scene = {"rest": np.concatenate(parts), "points": points, "fields": fields, "margin": 0.0}
        sim = simulate(*domain, **scene, **kwargs)
        velocity = np.array([body.get("velocity", (0.0, 0.0, 0.0)) for body in bodies])
        return sim.set(u=velocity[field])

    return build
