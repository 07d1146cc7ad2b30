"""A soft prop among the particles: placed at reset, tracked as the rigid body it nearly is, made lighter or heavier."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import warp as wp

from piavatar_envs.avatar.kabsch import kabsch_rotation
from piavatar_envs.avatar.rigid_fit import point_inertia, spin_of
from piavatar_envs.mpm.matrices import store_matrix
from piavatar_envs.mpm.types import Kinematic, Particles, row

wp.set_module_options({"enable_backward": False})


@wp.struct
class Prop:
    """Constants of one prop, which occupies particles ``first ... first + count`` of each environment."""

    first: int
    count: int
    rest: wp.array(dtype=wp.vec3)  # (count,) about the centre of mass [m]


@wp.struct
class PropMatter:
    """What a prop is made of at its nominal density."""

    density: float  # [kg/m^3]
    mu: float  # shear modulus [Pa]
    lam: float  # first Lame parameter [Pa]


@dataclass
class PropState:
    """Tracked props, each of shape ``(num_envs, num_props)``; quaternions are Warp's ``xyzw``."""

    position: wp.array  # centre of mass [m]
    rotation: wp.array  # rest frame to world
    velocity: wp.array  # of the centre of mass [m/s]
    spin: wp.array  # angular velocity [rad/s]
    deformation: wp.array  # root mean square distance of the matter from the fitted rest shape [m]

    @classmethod
    def allocate(cls, num_envs: int, num_props: int, device: str) -> PropState:
        """At the origin, at rest."""
        shape = (num_envs, num_props)
        upright = np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (*shape, 1))
        return cls(
            position=wp.zeros(shape, dtype=wp.vec3, device=device),
            rotation=wp.array(upright, dtype=wp.quat, shape=shape, device=device),
            velocity=wp.zeros(shape, dtype=wp.vec3, device=device),
            spin=wp.zeros(shape, dtype=wp.vec3, device=device),
            deformation=wp.zeros(shape, dtype=float, device=device),
        )

    def numpy(self) -> dict[str, np.ndarray]:
        """A copy of every array on the host."""
        return {field.name: getattr(self, field.name).numpy().copy() for field in fields(self)}


@wp.kernel
def place_prop(
    mask: wp.array(dtype=wp.bool),
    prop: Prop,
    index: int,
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=wp.vec3),
    spin: wp.array2d(dtype=wp.vec3),
    # out
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    C: wp.array3d(dtype=float),
    F: wp.array3d(dtype=float),
    driven: Kinematic,
):
    """Particles of prop ``index`` in the masked environments into rigid motion, unstrained; over ``(E, count)``.

    Materials are isotropic, so the deformation gradient of a turned prop may as well be the identity.
    """
    e, p = wp.tid()
    if not mask[e]:
        return
    arm = wp.quat_rotate(rotation[e, index], prop.rest[p])
    q = prop.first + p
    x[e, q] = position[e, index] + arm
    u[e, q] = velocity[e, index] + wp.cross(spin[e, index], arm)
    store_matrix(C, e, q, wp.skew(spin[e, index]))
    store_matrix(F, e, q, wp.identity(n=3, dtype=float))
    driven.vk[e, q] = wp.vec3(0.0)
    driven.spin[e, q] = wp.vec3(0.0)


@wp.kernel
def track_prop(
    prop: Prop,
    index: int,
    particles: Particles,
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    vk: wp.array2d(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=wp.vec3),
    spin: wp.array2d(dtype=wp.vec3),
    deformation: wp.array2d(dtype=float),
):
    """Mass-weighted rigid fit to prop ``index``, over ``(E,)``. A failed environment keeps its last.

    One thread sums in order: the result does not depend on the schedule.
    """
    e = wp.tid()
    if failure[e] != 0:
        return
    r = row(e, particles.mass.shape[0])
    origin = x[e, prop.first]  # sums about a point of the prop lose fewer digits than about the world's origin
    mass = float(0.0)
    mx = wp.vec3()
    mv = wp.vec3()
    for p in range(prop.count):
        q = prop.first + p
        m = particles.mass[r, q]
        mass += m
        mx += m * (x[e, q] - origin)
        mv += m * (u[e, q] + vk[e, q])
    c = origin + mx / mass
    V = mv / mass
    H = wp.mat33()
    I = wp.mat33()
    L = wp.vec3()
    for p in range(prop.count):
        q = prop.first + p
        m = particles.mass[r, q]
        d = x[e, q] - c
        H += m * wp.outer(d, prop.rest[p])
        I += point_inertia(m, d)
        L += m * wp.cross(d, u[e, q] + vk[e, q] - V)
    R = kabsch_rotation(H)
    square = float(0.0)
    for p in range(prop.count):
        q = prop.first + p
        square += particles.mass[r, q] * wp.length_sq(x[e, q] - c - R * prop.rest[p])
    position[e, index] = c
    rotation[e, index] = wp.normalize(wp.quat_from_matrix(R))
    velocity[e, index] = V
    spin[e, index] = spin_of(I, L)
    deformation[e, index] = wp.sqrt(square / mass)


@wp.kernel
def scale_density(
    mask: wp.array(dtype=wp.bool),
    prop: Prop,
    density: wp.array(dtype=float),
    matter: PropMatter,
    volume: wp.array2d(dtype=float),
    # out
    mass: wp.array2d(dtype=float),
    mu: wp.array2d(dtype=float),
    lam: wp.array2d(dtype=float),
):
    """Give a prop a density ``(E,)`` [kg/m^3] in the masked environments; over ``(E, count)``.

    Its moduli follow, so that the wave speed ``sqrt((lam + 2 mu) / rho)``, and with it the largest stable time step,
    stays. ``mass``, ``mu`` and ``lam`` need a row for every environment.
    """
    e, p = wp.tid()
    if not mask[e]:
        return
    q = prop.first + p
    ratio = density[e] / matter.density
    mass[e, q] = density[e] * volume[row(e, volume.shape[0]), q]
    mu[e, q] = ratio * matter.mu
    lam[e, q] = ratio * matter.lam
