"""Data structures of cloth.

The first dimension of arrays is the environment; constants have 1 row, the same for all environments, or ``num_envs``.
Symbols in kernels: ``e`` environment, ``i`` vertex, ``x`` position [m], ``v`` velocity [m/s], ``sigma`` mass per area
[kg/m^2], ``J`` impulse [N s], ``dt`` substep [s], ``share`` part of the control step that has passed.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class ClothSettings:
    """Numerical parameters of cloth.

    Attributes:
        substeps: of a control step.
        sweeps: over the edges in a substep; two buzz where cloth is stiff.
        look_every: substeps between searches for the nearest places of the obstacles.
        forces_every: substeps between evaluations of bending and air.
        pop: fastest way out of an obstacle [m/s].
        wind: velocity of the air [m/s].
        damping: share of the velocity that is lost in a substep; to bring a garment to rest.
        self_collision: whether cloth keeps apart from itself and other garments.
    """

    substeps: int = 20
    sweeps: int = 4
    look_every: int = 4
    forces_every: int = 2
    pop: float = 0.3
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    damping: float = 0.0
    self_collision: bool = False

    def __post_init__(self) -> None:
        for name in ("substeps", "sweeps", "look_every", "forces_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} of cloth must be at least 1")
        if not self.pop >= 0.0:
            raise ValueError(f"pop={self.pop} of cloth must not be negative")
        if not 0.0 <= self.damping < 1.0:
            raise ValueError(f"damping={self.damping} of cloth must be in [0, 1)")


@wp.struct
class ClothState:
    """All that a checkpoint stores of cloth with ``V`` vertices."""

    x: wp.array2d(dtype=wp.vec3)  # (num_envs, V) [m]
    v: wp.array2d(dtype=wp.vec3)  # (num_envs, V) [m/s]
    near: wp.array3d(dtype=int)  # (num_envs, V, 2) nearest point of the wearer and of all other pieces; -1: not known


@wp.struct
class Fabrics:
    """Properties of ``G`` garments, each ``(rows, G)``; see :class:`piavatar_envs.cloth.fabric.Fabric`."""

    areal_density: wp.array2d(dtype=float)  # [kg/m^2]
    stretch: wp.array2d(dtype=float)  # [N/m]
    bending: wp.array2d(dtype=float)  # [N m]
    friction: wp.array2d(dtype=float)
    drag: wp.array2d(dtype=float)  # [kg/m^3]
    skin_drag: wp.array2d(dtype=float)  # [kg/m^3]
