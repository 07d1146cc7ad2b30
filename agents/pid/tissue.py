"""Torques of the joints' tissue in NumPy, for a controller that counts on them.

The same as on the device in :mod:`piavatar_envs.avatar.torque_control.joint_tissue`, but for the greatest growth of a
passive moment beyond the end of its range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from piavatar_envs.avatar.body.passive import PassiveMoments, passive_moments
from piavatar_envs.avatar.body.skeleton import joint_limits


def _moment(s: np.ndarray, end: np.ndarray, moment: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a passive moment at ``s`` [N m], and its slope [N m/rad]."""
    grown = np.where(s > 0.0, moment * np.exp(rate * (np.maximum(s, 0.0) - end)), 0.0)
    return grown - np.where(s > 0.0, moment * np.exp(-rate * end), 0.0), rate * grown


@dataclass(frozen=True)
class Tissue:
    """Tissue of a body's joints.

    Attributes:
        size: mass times height over that of the reference adult [-].
        flesh: stiffness of the joints by flesh, shape ``(22, 3, 22, 3)`` [N m/rad].
    """

    size: float
    flesh: np.ndarray

    def pull(self, bend: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return minus the gradient of the energy [N m] and its stiffness about each axis [N m/rad], ``(n, 22, 3)``.

        Args:
            bend: rotation vectors of the joints, zero for the pelvis, shape ``(n, 22, 3)`` [rad].
        """
        m: PassiveMoments = passive_moments()
        lower, upper = joint_limits()
        low, low_slope = _moment(-bend, -lower, m.lower, m.lower_rate)
        high, high_slope = _moment(bend, upper, m.upper, m.upper_rate)
        pull, slope = low - high, low_slope + high_slope
        along, steep = _moment((bend[:, m.joints, 0] * m.shares).sum(-1), m.ends, m.moments, m.rates)
        for k, joints in enumerate(m.joints):
            pull[:, joints, 0] -= along[:, k, None] * m.shares[k]
            slope[:, joints, 0] += steep[:, k, None] * m.shares[k] ** 2
        own = np.einsum("aiaj,naj->nai", self.flesh, bend)
        t = (bend**2).sum(-1, keepdims=True)
        more = t / (2.0 + t) * own + 2.0 * (bend * own).sum(-1, keepdims=True) / (2.0 + t) ** 2 * bend
        held = np.einsum("aibj,nbj->nai", self.flesh, bend) + more
        return self.size * pull - held, self.size * slope + 2.0 * np.einsum("aiai->ai", self.flesh)

    def torque(self, bend: np.ndarray) -> np.ndarray:
        """Return the torques on the joints about the axes of their parents, ``(n, 22, 3)`` [N m]."""
        pull = self.pull(bend)[0]
        half = 0.5 * np.linalg.norm(bend, axis=-1, keepdims=True)
        small = half < 0.05
        safe = np.where(small, 1.0, half)
        c = np.where(small, 1.0 / 12.0, (1.0 - safe / np.tan(safe)) / (4.0 * safe**2))
        turned = np.cross(bend, pull)
        return pull + 0.5 * turned + c * np.cross(bend, turned)
