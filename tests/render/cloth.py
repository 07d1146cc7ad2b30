"""Garments that stand in for simulated ones: a tube around the legs or the trunk, moved by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import warp as wp

from piavatar_envs.cloth.garment import Garment, Held
from piavatar_envs.cloth.mesh import ClothMesh
from piavatar_envs.sim.world import Simulation

COLORS = SimpleNamespace(front=(0.8, 0.1, 0.1), back=(0.1, 0.1, 0.8))


def tube(
    bottom: float, top: float, radius: float, *, kind: str = "skirt", wearer: int = 0, around: int = 32, rows: int = 8
) -> Garment:
    """Return a tube about the z axis, held at its upper end; lengths in m."""
    angle, height = np.meshgrid(2.0 * np.pi * np.arange(around) / around, np.linspace(bottom, top, rows))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1).reshape(-1, 3)
    index = np.arange(around * rows).reshape(rows, around)
    after = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1].ravel(), after[:-1].ravel(), index[1:].ravel(), after[1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    mesh = ClothMesh.build(faces, lambda pairs: np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1))
    held = Held(index[-1].astype(np.int32), np.zeros(around, np.int32), np.zeros((around, 3)), np.zeros(around))
    return Garment(kind, wearer, mesh, points, held, np.full(len(points), -1, np.int32), 0.004, COLORS)


def worn_by(simulation: Simulation, *garments: Garment, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)):
    """Return garments at rest in all environments of a simulation, shifted by ``shift`` [m]."""
    points = np.concatenate([garment.draped for garment in garments]) + shift
    x = wp.array(np.tile(points, (simulation.num_envs, 1, 1)), dtype=wp.vec3, device=simulation.device)
    return SimpleNamespace(garments=garments, cloth=SimpleNamespace(state=SimpleNamespace(x=x)))
