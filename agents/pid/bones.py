"""A body as a tree of rigid bones for a controller: positions, masses, and the moments about its joints.

Generalised velocities are those of the pelvis joint in the world [m/s], then of every bone against its parent about the
bone's own axes [rad/s], the pelvis' against the world first: :data:`NUM_DOF` numbers. With the velocity ``J q'`` of the
bones' centres and their spins, the mass matrix is the sum over bones of ``m J^T J`` and the same of the spins with the
inertia (Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 9.2). A force ``f`` where a bone is has the
generalised force ``J^T f``: about a joint, the moment of what acts beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from piavatar_envs.avatar.body.device import BodyPoints
from piavatar_envs.avatar.body.skeleton import BEYOND, NUM_JOINTS, forward_kinematics

NUM_DOF = 3 + 3 * NUM_JOINTS


@dataclass(frozen=True)
class Posture:
    """Places and rotations of the bones of ``n`` bodies, in the world's axes.

    Attributes:
        rotation: from the rest pose, ``(n, 22, 3, 3)``.
        joints: places of the joints [m], from any origin, ``(n, 22, 3)``.
        centres: of mass of the bones [m], from the same, ``(n, 22, 3)``.
    """

    rotation: np.ndarray
    joints: np.ndarray
    centres: np.ndarray


@dataclass(frozen=True)
class Bones:
    """Rigid bones in the rest pose.

    Attributes:
        mass: [kg], ``(22,)``.
        joints: places of the joints [m], ``(22, 3)``.
        centres: of mass [m], ``(22, 3)``.
        inertia: about the centres [kg m^2], ``(22, 3, 3)``.
    """

    mass: np.ndarray
    joints: np.ndarray
    centres: np.ndarray
    inertia: np.ndarray

    @classmethod
    def of(cls, points: BodyPoints) -> Bones:
        """Lump the first body of a batch into bones by its skinning weights."""
        share = np.zeros((points.num_points, NUM_JOINTS))
        np.add.at(share, (np.arange(points.num_points)[:, None], points.skin_joints), points.skin_weights)
        share *= points.mass[0][:, None]
        rest, mass = points.rest[0].astype(float), share.sum(0)
        centres = share.T @ rest / mass[:, None]
        away = rest[None] - centres[:, None]
        second = np.einsum("pb,bpi,bpj->bij", share, away, away)
        inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
        return cls(mass, points.joints[0].astype(float), centres, inertia)

    def posture(self, local: np.ndarray, places: np.ndarray | None = None) -> Posture:
        """Compute the posture of local rotations.

        Args:
            local: rotations against the parents, of the pelvis against the world, ``(n, 22, 3, 3)``.
            places: of the joints [m], ``(n, 22, 3)``; None to place them by the bones' lengths, with the pelvis at
            zero.
        """
        rotation, found = forward_kinematics(local, np.zeros((len(local), 3)), self.joints)
        joints = found if places is None else places
        return Posture(rotation, joints, joints + _turned(rotation, self.centres - self.joints))

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the mass-weighted mean ``(n, 3)`` of a vector per bone, ``(n, 22, 3)``."""
        return np.einsum("b,nbi->ni", self.mass, values) / self.mass.sum()

    def mass_matrix(self, now: Posture) -> np.ndarray:
        """Compute the mass matrix ``(n, 69, 69)``; the module has its definition."""
        n = len(now.joints)
        axes = now.rotation[:, None] * BEYOND.T[None, :, :, None, None]  # (n, bone, joint, 3, axis)
        arms = now.centres[:, :, None] - now.joints[:, None]
        moved = np.cross(axes, arms[..., None], axisa=3, axisb=3, axisc=3)
        matrix = np.zeros((n, NUM_DOF, NUM_DOF))
        linear = np.zeros((n, NUM_JOINTS, 3, NUM_DOF))
        linear[..., :3] = np.eye(3)
        linear[..., 3:] = moved.transpose(0, 1, 3, 2, 4).reshape(n, NUM_JOINTS, 3, -1)
        rows = (np.sqrt(self.mass)[:, None, None] * linear).reshape(n, -1, NUM_DOF)
        spins = axes.transpose(0, 1, 3, 2, 4).reshape(n, NUM_JOINTS, 3, -1)
        inertia = now.rotation @ self.inertia @ np.swapaxes(now.rotation, -1, -2)
        matrix += np.swapaxes(rows, 1, 2) @ rows
        flat = spins.reshape(n, -1, spins.shape[-1])
        matrix[:, 3:, 3:] += np.swapaxes(flat, 1, 2) @ (inertia @ spins).reshape(flat.shape)
        return matrix

    def weight_moments(self, now: Posture, gravity: float) -> np.ndarray:
        """Return the moment about every joint of the weight beyond it, in the world's axes [N m], ``(n, 22, 3)``."""
        pull = self.mass[:, None] * np.array([0.0, 0.0, -gravity])
        arms = (now.centres[:, None] - now.joints[:, :, None]) * BEYOND[None, :, :, None]
        return np.cross(arms, pull).sum(2)


def force_moments(now: Posture, bone: int, place: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the moment about every joint of a force on a bone, in the world's axes [N m], ``(n, 22, 3)``.

    Args:
        now: posture of the bodies.
        bone: that it acts on.
        place: where [m], ``(n, 3)``.
        force: [N], ``(n, 3)``.
    """
    moments = np.cross(place[:, None] - now.joints, force[:, None])
    return moments * BEYOND[:, bone][None, :, None]


def in_bones(now: Posture, vectors: np.ndarray) -> np.ndarray:
    """Turn vectors ``(n, 22, 3)`` from the world's axes to the bones' own."""
    return np.einsum("nbij,nbi->nbj", now.rotation, vectors)


def _turned(rotation: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return ``R v``; ``(n, 22, 3, 3)`` and ``(22, 3)``."""
    return np.einsum("nbij,bj->nbi", rotation, vectors)


def answered(matrix: np.ndarray, torque: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    """Return the torques of springs and dampers after all joints have responded: ``A (M + A)^-1`` is taken off.

    Of springs with stiffness ``K`` and damping ``D`` at the end of a step, ``A = dt D + dt^2 K`` times the acceleration
    that they cause is missing to what they would be if nothing moved (Tan, Liu & Turk, "Stable Proportional-Derivative
    Controllers", 2011, section 4). Joints of a chain move each other: with ``M`` a number a joint, light bones between
    strong joints are thrown to and fro. All other forces are taken to be in balance.

    Args:
        matrix: mass matrix, ``(n, 69, 69)``.
        torque: if nothing moved, of all joints but the root, about the bones' own axes [N m], ``(n, 21, 3)``.
        stiffness: ``A`` [kg m^2], of the same shape.
    """
    start = NUM_DOF - torque[0].size
    given = np.zeros(matrix.shape[:2])
    given[:, start:] = torque.reshape(len(torque), -1)
    added = np.zeros(matrix.shape[:2])
    added[:, start:] = stiffness.reshape(len(torque), -1)
    rows = np.arange(NUM_DOF)
    driven = matrix.copy()
    driven[:, rows, rows] += added
    change = np.linalg.solve(driven, given[..., None])[..., 0]
    return (given - added * change)[:, start:].reshape(torque.shape)
