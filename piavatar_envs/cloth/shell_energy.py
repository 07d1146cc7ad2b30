"""Energy and stress of a thin shell: a membrane, and a director that resists being pressed into it.

An element's deformation gradient ``F = [f1 f2 d]`` has two columns of the mesh and the director ``d``, the deformed
normal. With ``F = Q R``, a rotation times an upper triangular matrix, the energy per area is (Jiang, Gast & Teran,
"Anisotropic elastoplasticity for cloth, knit and hair frictional contact", ACM Trans. Graph. 36(4), 2017, section 4)::

    psi = mu |A - polar(A)|^2 + lam / 2 (det A - 1)^2 + gamma / 2 (r13^2 + r23^2) + k / 3 max(1 - r33, 0)^3

with the upper left block ``A`` of R, a fixed corotated membrane (Stomakhin et al., "Energetically consistent
invertible elasticity", SCA 2012) under plane stress. The director is what contact within the cloth compresses
(``r33 < 1``) and shears; it pulls at nothing, and Coulomb's law bounds the shear: the return mapping of section 5.

The stress follows from ``dR R^-1 = M - W`` for a change ``dF F^-1 = Q M Q^T``, where W is antisymmetric with the lower
triangle of M: ``tau = Q K Q^T`` with the symmetric K whose upper triangle is that of ``(d psi / d R) R^T``.
"""

from __future__ import annotations

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

#: Poisson's ratio of the membrane, that of the triangular lattice of springs of :mod:`piavatar_envs.cloth.kernels`.
POISSON = 1.0 / 3.0
#: Shear stiffness ``gamma`` and stiffness ``k`` of the director, over E h; twice k is the most that it resists with.
SHEAR, NORMAL = 0.1, 0.5
#: Sides of a triangle count as no shorter than this, relative to rest, where a couple is divided by them.
FLAT = 0.2
_POISSON, _SHEAR, _NORMAL, _FLAT = wp.constant(POISSON), wp.constant(SHEAR), wp.constant(NORMAL), wp.constant(FLAT)


def wave_speed(areal_density: float | np.ndarray, stretch: float | np.ndarray) -> np.ndarray:
    """Return the speed of the fastest wave in cloth [m/s], along the membrane: ``sqrt(E h / (sigma (1 - nu^2)))``.

    Args:
        areal_density: sigma [kg/m^2].
        stretch: membrane stiffness E h [N/m].
    """
    return np.sqrt(np.asarray(stretch) / (np.asarray(areal_density) * (1.0 - POISSON**2)))


def moduli(stretch: float) -> tuple[float, float]:
    """Return shear modulus and first Lame parameter of plane stress, times the thickness [N/m]."""
    return stretch / (2.0 * (1.0 + POISSON)), stretch * POISSON / (1.0 - POISSON**2)


def energy(f1: np.ndarray, f2: np.ndarray, director: np.ndarray, stretch: float) -> np.ndarray:
    """Return the energy of an element over its area at rest [N/m].

    Args:
        f1: first column of the deformation gradient, shape ``(..., 3)``.
        f2: second column, likewise.
        director: third column, likewise, which the return mapping leaves as it is.
        stretch: E h [N/m].
    """
    mu, lam = moduli(stretch)
    r11 = np.linalg.norm(f1, axis=-1)
    q1 = f1 / r11[..., None]
    q3 = np.cross(f1, f2)
    q3 = q3 / np.linalg.norm(q3, axis=-1, keepdims=True)
    q2 = np.cross(q3, q1)
    r12, r22 = (q1 * f2).sum(-1), (q2 * f2).sum(-1)
    singular = np.linalg.svd(np.stack([np.stack([r11, r12], -1), np.stack([0.0 * r11, r22], -1)], -2))[1]
    membrane = mu * ((singular - 1.0) ** 2).sum(-1) + 0.5 * lam * (r11 * r22 - 1.0) ** 2
    r13, r23, r33 = ((q * director).sum(-1) for q in (q1, q2, q3))
    pressed = np.maximum(1.0 - r33, 0.0)
    return membrane + stretch * (0.5 * SHEAR * (r13**2 + r23**2) + NORMAL / 3.0 * pressed**3)


@wp.struct
class Frame:
    """QR decomposition of the two columns of the mesh."""

    q1: wp.vec3
    q2: wp.vec3
    q3: wp.vec3
    r11: float
    r12: float
    r22: float


@wp.struct
class ShellStress:
    """First Piola-Kirchhoff stress of an element times the thickness [N/m]: its three columns."""

    p1: wp.vec3
    p2: wp.vec3
    p3: wp.vec3


@wp.func
def frame_of(f1: wp.vec3, f2: wp.vec3):
    """Return the frame of an element with these columns; degenerate ones have some frame."""
    s = Frame()
    s.r11 = wp.length(f1)
    s.q1 = f1 / wp.max(s.r11, 1.0e-12)
    s.r12 = wp.dot(s.q1, f2)
    across = f2 - s.r12 * s.q1
    s.r22 = wp.length(across)
    s.q2 = across / wp.max(s.r22, 1.0e-12)
    s.q3 = wp.cross(s.q1, s.q2)
    return s


@wp.func
def map_director(s: Frame, director: wp.vec3, friction: float):
    """Return the director in the frame after the return mapping of Jiang et al. (2017).

    It is the normal where nothing presses on the element, its shear is bounded by ``friction`` where something does,
    and it stays on its side.
    """
    r = wp.vec3(wp.dot(s.q1, director), wp.dot(s.q2, director), wp.dot(s.q3, director))
    if not r[2] < 1.0:
        return wp.vec3(0.0, 0.0, 1.0)
    pressed = wp.min(1.0 - r[2], 1.0)
    most = friction * _NORMAL * pressed * pressed / _SHEAR
    shear = wp.sqrt(r[0] * r[0] + r[1] * r[1])
    keep = float(1.0)
    if shear > most:
        keep = most / shear
    return wp.vec3(keep * r[0], keep * r[1], 1.0 - pressed)


@wp.func
def stress_of(s: Frame, r: wp.vec3, stretch: float):
    """Return the stress of an element with the director ``r`` in its frame; ``stretch`` is E h [N/m]."""
    mu = stretch / (2.0 * (1.0 + _POISSON))
    lam = stretch * _POISSON / (1.0 - _POISSON * _POISSON)
    # polar rotation of A = [[r11, r12], [0, r22]]
    p = s.r11 + s.r22
    q = -s.r12
    size = wp.max(wp.sqrt(p * p + q * q), 1.0e-12)
    c = p / size
    w = q / size
    area = lam * (s.r11 * s.r22 - 1.0)
    a11 = 2.0 * mu * (s.r11 - c) + area * s.r22
    a21 = -2.0 * mu * w - area * s.r12
    a12 = 2.0 * mu * (s.r12 + w)
    a22 = 2.0 * mu * (s.r22 - c) + area * s.r11
    pressed = wp.max(1.0 - r[2], 0.0)
    g1 = stretch * _SHEAR * r[0]
    g2 = stretch * _SHEAR * r[1]
    g3 = -stretch * _NORMAL * pressed * pressed
    # what keeps tau symmetric: the mesh turns against the director
    k1 = g1 * r[2] - g3 * r[0]
    k2 = g2 * r[2] - g3 * r[1]
    r11 = wp.max(s.r11, _FLAT)
    r22 = wp.max(s.r22, _FLAT)
    out = ShellStress()
    out.p1 = a11 * s.q1 + a21 * s.q2 + ((k1 - k2 * s.r12 / r22) / r11) * s.q3
    out.p2 = a12 * s.q1 + a22 * s.q2 + (k2 / r22) * s.q3
    out.p3 = g1 * s.q1 + g2 * s.q2 + g3 * s.q3
    return out
