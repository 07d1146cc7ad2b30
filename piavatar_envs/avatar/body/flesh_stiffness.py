"""Stiffness of the joints by their flesh: the elastic energy of the strain that skinning makes in bent joints.

A small turn ``theta_ca`` of joint ``c`` about axis ``a`` moves a particle at ``X`` by
``S_c(X) theta_ca a x (X - p_c)``, with ``S_c`` the sum of its weights of all bones beyond the joint. With the linear
strain ``e_ca`` of this displacement

    K_ca,db = sum_p V_p (2 mu e_ca : e_db + lambda tr e_ca tr e_db).

The gradient is fitted to the neighbours of each particle by moving least squares, as in
:mod:`piavatar_envs.mpm.measured_strain`. ``1/2 q^T K q`` is the energy of flesh held at its skinned
places, of the rotation vectors ``q`` of all joints. At large angles ``t = |v|^2`` a joint's own part grows by the
factor ``1 + t / (2 + t)``: over random poses within the ranges the sum is 0.93 +- 0.08 of the Neo-Hookean energy of the
skinned flesh, and 0.96 +- 0.07 where the trunk alone is bent.

Real flesh need not follow its bones so closely: it gives way until it is in equilibrium. With the particles of bones
held and all others free, linear elasticity leaves 0.08 to 0.44 of that energy, :data:`FREE_SHARE` on average.
"""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.body.asset import turned_shares
from piavatar_envs.avatar.body.interpolation import rest_gradient
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS

#: Energy of flesh that is free to give way over that of flesh held at its skinned places [-].
FREE_SHARE = 0.25
_EPSILON = np.cross(np.eye(3)[:, None], np.eye(3)[None])  # (a, r, i): a x r


def flesh_stiffness(
    rest: np.ndarray,
    volume: np.ndarray,
    joints: np.ndarray,
    links: np.ndarray,
    skin_joints: np.ndarray,
    skin_weights: np.ndarray,
    mu: np.ndarray,
    lam: np.ndarray,
) -> np.ndarray:
    """Return the stiffness of the joints by flesh held at its skinned places, ``(22, 3, 22, 3)`` [N m/rad].

    Args:
        rest: rest positions [m], shape ``(P, 3)``.
        volume: volumes of the particles [m^3], shape ``(P,)``.
        joints: rest joint positions [m], shape ``(22, 3)``.
        links: pairs of neighbouring particles, shape ``(L, 2)``.
        skin_joints: bones that move a particle, shape ``(P, 4)``.
        skin_weights: their weights, shape ``(P, 4)``.
        mu: shear modulus [Pa], shape ``(P,)``.
        lam: Lame's first parameter [Pa], shape ``(P,)``.
    """
    share = turned_shares(skin_joints, skin_weights)
    moves = share.T[:, None, :, None] * np.einsum("arj,cpr->capj", _EPSILON, rest - joints[:, None])
    fields = moves.reshape(3 * NUM_JOINTS, -1, 3).transpose(1, 0, 2).reshape(len(rest), -1)
    gradient = np.stack([along @ fields for along in rest_gradient(rest, links)[0]], axis=-1)
    gradient = gradient.reshape(len(rest), 3 * NUM_JOINTS, 3, 3).swapaxes(0, 1)
    gradient[:3] = 0.0  # of the pelvis, with which the whole body turns
    strains = 0.5 * (gradient + gradient.swapaxes(2, 3))
    trace = np.trace(strains, axis1=2, axis2=3)
    flat = strains.reshape(len(strains), -1)
    weighted = flat * np.repeat(2.0 * mu * volume, 9)
    stiffness = weighted @ flat.T + (trace * (lam * volume)) @ trace.T
    return stiffness.reshape(NUM_JOINTS, 3, NUM_JOINTS, 3)
