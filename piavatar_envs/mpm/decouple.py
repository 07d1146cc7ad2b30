"""Deformation-gradient decoupling: how prescribed motion is kept out of the elastic deformation.

The avatar's commanded motion must not strain its flesh, contact must. PIAvatar (Han et al., arXiv 2606.21162)
decouples the two by ``F <- F (F^k)^-1`` with the deformation gradient ``F^k`` of the kinematic velocity. Variants:

- ``"split"`` (default): physical and kinematic velocity are never mixed into one state, and prescribed motion only
  turns the elastic deformation: ``F <- (I + dt grad u) Q F Q^T`` with ``Q = Cayley(dt w)`` and the spin ``w`` of the
  bones that a particle follows, as it moves with its own ``vk``. It is the paper's decoupling with the round-off taken
  out. (Half the curl of the grid's ``vk`` would do as well, and as exactly; but all nodes would have to know it.)
- ``"paper"``: one velocity state, ``v += vk_new - vk_old`` once a control step,
  ``F <- (I + dt grad v) F (I + dt grad vk)^-1``, with ``F^k`` restarting at the identity each substep.
- ``"none"``: the same injection without decoupling, the plain MPM the paper compares with. (Overwriting the velocity
  instead of adding the difference gives about 0.05 m where the paper prints 0.25.)
- ``"no_stress"``: as ``"split"`` with the stress switched off, the paper's motivation figure: bodies merge.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.types import PAPER, SPLIT

wp.set_module_options({"enable_backward": False})

I3 = wp.constant(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


@wp.func
def cayley(turn: wp.vec3):
    """Rotation ``(I - W/2)^-1 (I + W/2)`` with ``W = skew(turn)`` [rad]; orthogonal to round-off for any ``turn``.

    With ``a = turn / 2`` it has the closed form ``I + 2 (A + A A) / (1 + a.a)``, ``A = skew(a)``, where
    ``A A = a a^T - a.a I``: written down, it takes a third of the operations.
    """
    a = 0.5 * turn
    square = wp.dot(a, a)
    share = 2.0 / (1.0 + square)
    b = share * a
    rest = 1.0 - share * square
    # fmt: off
    return wp.mat33(
        rest + b[0] * a[0], b[0] * a[1] - b[2], b[0] * a[2] + b[1],
        b[0] * a[1] + b[2], rest + b[1] * a[1], b[1] * a[2] - b[0],
        b[0] * a[2] - b[1], b[1] * a[2] + b[0], rest + b[2] * a[2],
    )
    # fmt: on


@wp.func
def advance_deformation(F: wp.mat33, grad_v: wp.mat33, grad_vk: wp.mat33, spin: wp.vec3, dt: float, decoupling: int):
    """Deformation gradient after one substep.

    Args:
        F: deformation gradient before.
        grad_v: gradient of the physical velocity (``"split"``) or of the one velocity state [1/s].
        grad_vk: gradient of the kinematic velocity [1/s]; for ``"paper"``.
        spin: of the prescribed motion [rad/s]; for ``"split"``.
        dt: substep [s].
        decoupling: one of :data:`piavatar_envs.mpm.types.DECOUPLING`.
    """
    step = I3 + dt * grad_v
    if decoupling == SPLIT:
        Q = cayley(dt * spin)
        return step * (Q * F * wp.transpose(Q))
    if decoupling == PAPER:
        return step * F * wp.inverse(I3 + dt * grad_vk)
    return step * F
