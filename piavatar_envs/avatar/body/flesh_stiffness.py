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

import sys

import numpy as np
from scipy import sparse

from piavatar_envs.avatar.body import interpolation
from piavatar_envs.avatar.body.asset import turned_shares
from piavatar_envs.avatar.body.interpolation import rest_gradient
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.core.result_cache import digest_of, kept

#: Energy of flesh that is free to give way over that of flesh held at its skinned places [-].
FREE_SHARE = 0.25
#: Particles that are taken together: neighbours of large bodies have few joints that bend them.
AT_ONCE = 8192
#: Least change of a joint's share among neighbours; below, it is round-off.
LEAST_CHANGE = 1e-6
_EPSILON = np.cross(np.eye(3)[:, None], np.eye(3)[None])  # (a, r, i): a x r


def kept_stiffness(*body: np.ndarray) -> np.ndarray:
    """Return :func:`flesh_stiffness` of the same arguments, from a file if it takes long to compute."""
    digest = digest_of(list(body), [sys.modules[__name__], interpolation])
    doing = f"measuring how the flesh of {len(body[0])} particles stiffens joints"
    return kept("stiffness", digest, lambda: {"stiffness": flesh_stiffness(*body)}, doing)["stiffness"]


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
    share, along = turned_shares(skin_joints, skin_weights), rest_gradient(rest, links)[0]
    stiffness = np.zeros((3 * NUM_JOINTS, 3 * NUM_JOINTS))
    for first in range(0, len(rest), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        rows = [own[part] for own in along]
        near = np.unique(np.concatenate([own.indices for own in rows]))
        # all others, the pelvis among them, turn these particles rigidly
        bent = 1 + np.flatnonzero(np.ptp(share[near, 1:], axis=0) > LEAST_CHANGE)
        if len(bent):
            strains = _strains(rest[near], joints[bent], share[near][:, bent], [own[:, near] for own in rows])
            trace = np.trace(strains, axis1=2, axis2=3)
            flat = strains.reshape(len(strains), -1)
            weighted = flat * np.repeat(2.0 * mu[part] * volume[part], 9)
            entries = (3 * bent[:, None] + np.arange(3)).ravel()
            stiffness[np.ix_(entries, entries)] += weighted @ flat.T + (trace * (lam[part] * volume[part])) @ trace.T
    return stiffness.reshape(NUM_JOINTS, 3, NUM_JOINTS, 3)


def _strains(rest: np.ndarray, joints: np.ndarray, share: np.ndarray, along: list[sparse.csr_matrix]) -> np.ndarray:
    """Return the strains of particles by small turns of joints about each axis, ``(3 J, n, 3, 3)``.

    Args:
        rest: positions of the particles and of their neighbours [m], shape ``(N, 3)``.
        joints: positions of the joints [m], shape ``(J, 3)``.
        share: how far each joint moves each of these, shape ``(N, J)``.
        along: derivatives along each axis, ``(n, N)`` [1/m].
    """
    moves = share.T[:, None, :, None] * np.einsum("arj,cpr->capj", _EPSILON, rest - joints[:, None])
    fields = moves.reshape(3 * len(joints), -1, 3).transpose(1, 0, 2).reshape(len(rest), -1)
    gradient = np.stack([own @ fields for own in along], axis=-1)
    gradient = gradient.reshape(len(gradient), 3 * len(joints), 3, 3).swapaxes(0, 1)
    return 0.5 * (gradient + gradient.swapaxes(2, 3))
