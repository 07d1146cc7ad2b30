"""Gains of a PID by joint, by what it carries or how strong it is, and a schedule that scales them by the load on legs.

A schedule is anything that is called with what it depends on, a row per environment, and returns factors
``(n, joints, 1)`` for :meth:`agents.pid.controller.PosePID.step`. Factors of several schedules are multiplied.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from agents.pid.controller import Gains


@dataclass(frozen=True)
class Subtrees:
    """Mass, centre and inertia beyond every joint, its own bone included, in one pose.

    Attributes:
        mass: of the bones [kg], ``(joints,)``.
        arm: from the joint to their centre of mass [m], ``(joints,)``.
        inertia: largest about an axis through the joint, of the bones as points [kg m^2], ``(joints,)``.
    """

    mass: np.ndarray
    arm: np.ndarray
    inertia: np.ndarray


def subtrees(parents: Sequence[int], masses: np.ndarray, centres: np.ndarray, positions: np.ndarray) -> Subtrees:
    """Sum up mass, centre and inertia beyond every joint.

    Args:
        parents: of every joint, before their children; -1 for the root.
        masses: of the bones [kg], ``(joints,)``.
        centres: of mass of the bones [m], ``(joints, 3)``.
        positions: of the joints [m], ``(joints, 3)``.

    Raises:
        ValueError: a child before its parent.
    """
    beyond = np.eye(len(parents), dtype=bool)
    for joint in range(len(parents) - 1, -1, -1):
        if parents[joint] >= joint:
            raise ValueError(f"joint {joint} comes before its parent {parents[joint]}; order parents first")
        if parents[joint] >= 0:
            beyond[parents[joint]] |= beyond[joint]
    mass = beyond @ masses
    centre = beyond @ (masses[:, None] * centres) / mass[:, None]
    arms = centres[None] - positions[:, None]
    tensor = np.einsum("jb,b,jbx,jby->jxy", beyond, masses, arms, arms)
    # about the axis across all arms: the trace of the second moments without their least
    second = np.linalg.eigvalsh(tensor)
    return Subtrees(mass, np.linalg.norm(centre - positions, axis=-1), second[:, 1] + second[:, 2])


def gains_for(
    load: Subtrees, stiffness: float, damping_ratio: float, limit: np.ndarray, integral_time: float = np.inf
) -> Gains:
    """Scale gains by the inertia beyond each joint, so that all joints respond alike.

    ``kp = stiffness m g l``, which leaves ``1 / stiffness`` of a limb that is held out level as its sag [rad], and
    ``kd = 2 damping_ratio sqrt(kp inertia)``, as of a mass on a spring.

    Args:
        load: what every joint carries.
        stiffness: times that the joint's torque at 1 rad is the largest of gravity [1/rad].
        damping_ratio: 1 for critical damping [-].
        limit: largest torques [N m], ``(joints,)`` or ``(joints, 3)``.
        integral_time: ``kp / ki`` [s]; infinite for no integral.

    Returns:
        Gains for a controller of shape ``(n, joints, 3)``, with the inertia.
    """
    kp = stiffness * 9.81 * load.mass * load.arm
    kd = 2.0 * damping_ratio * np.sqrt(kp * load.inertia)
    limit = np.asarray(limit, float)
    columns = (part[:, None] for part in (kp, kd, kp / integral_time))
    return Gains(*columns, limit=limit if limit.ndim == 2 else limit[:, None], inertia=load.inertia[:, None])


def gains_by_strength(
    limit: np.ndarray, stiffness: float, damping_time: float, integral_time: float | np.ndarray = np.inf
) -> Gains:
    """Scale gains by the strength of each joint, for a body that stands on its legs.

    There what hangs on a joint is not what it carries. How light it is matters to a controller that acts in steps all
    the same, so give it the answer of the whole body, ``ahead`` of :meth:`agents.pid.controller.PID.step`.

    Args:
        limit: largest torques [N m], ``(joints, 3)``.
        stiffness: share of the largest torque of a joint about any axis for an error of 1 rad [1/rad].
        damping_time: ``kd / kp`` [s].
        integral_time: ``kp / ki`` [s]; infinite for no integral. For all joints, or ``(joints, 1)``.

    Returns:
        Gains for a controller of shape ``(n, joints, 3)``.
    """
    kp = stiffness * np.max(limit, axis=-1, keepdims=True)
    return Gains(kp, kp * damping_time, kp / integral_time, limit=limit)


@dataclass(frozen=True)
class LoadSchedule:
    """Factors by the share of the weight on each leg: a leg that bears weight is stiff, one that swings is soft.

    Attributes:
        joints: number of joints.
        legs: places of the joints of each leg.
        unloaded: factor of a leg that carries nothing [-], 1 for no schedule; one that carries its even share, or more,
            has 1.
    """

    joints: int
    legs: Mapping[str, Sequence[int]]
    unloaded: float

    def __call__(self, forces: np.ndarray) -> np.ndarray:
        """Return factors ``(n, joints, 1)`` for forces of the ground on the legs [N], ``(n, legs)`` in their order.

        Where nothing rests on the ground all legs count as unloaded.
        """
        total = np.sum(forces, axis=-1, keepdims=True)
        share = np.divide(forces, total, out=np.zeros_like(forces, dtype=float), where=total > 0.0)
        share = np.clip(share * len(self.legs), 0.0, 1.0)
        factors = np.ones((len(forces), self.joints, 1))
        for leg, places in enumerate(self.legs.values()):
            factors[:, list(places), 0] = (self.unloaded + (1.0 - self.unloaded) * share[:, leg])[:, None]
        return factors
