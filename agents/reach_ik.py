"""A scripted agent for Reach: inverse kinematics from the observation alone. What a good policy can hope for.

Damped least squares (Buss, "Introduction to Inverse Kinematics", 2004, eq. 11) for the nearer hand, with the joints of
its arm and of the spine; joints that stand at a limit and would be driven beyond it are left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index, joint_limits
from piavatar_envs.envs.observations import ObservationLayout

HANDS = ("left", "right")
DAMPING = 0.05  # [m]


class ReachIK:
    """Scripted agent that moves the nearer hand to the place of the target after the step.

    Everything is in the frame of the pelvis, as the observation is.
    """

    def __init__(
        self, layout: ObservationLayout, action_names: Sequence[str], action_step: float, control_dt: float
    ) -> None:
        """Read the layout of the action and of the observation.

        Args:
            layout: of the flat observation.
            action_names: of every component of an action, three a joint.
            action_step: rotation that an action of 1 commands in a control step [rad].
            control_dt: time of a control step [s].
        """
        self.layout, self.action_step, self.control_dt = layout, action_step, control_dt
        self.joints = [joint_index(name.partition(".")[0]) for name in action_names[::3]]
        lower, upper = joint_limits()
        self.lower, self.upper = lower[self.joints], upper[self.joints]
        self.chains = [self._chain(joint_index(f"{side}_wrist")) for side in HANDS]

    def _chain(self, wrist: int) -> list[int]:
        """Return acting joints between a hand and the pelvis, as places in ``joints``."""
        chain, joint = [], wrist
        while joint > 0:
            if joint in self.joints:
                chain.append(self.joints.index(joint))
            joint = PARENTS[joint]
        return chain

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return actions ``(n, action_size)`` for observations ``(n, observation_size)``."""
        return np.stack([self._act(self.layout.split(row)) for row in observation])

    def _act(self, observed: dict[str, np.ndarray]) -> np.ndarray:
        errors = [observed[f"target_from_{side}_hand"].astype(float) for side in HANDS]
        nearer = int(np.argmin([np.linalg.norm(error) for error in errors]))
        chain = self.chains[nearer]
        hand = observed["target_position"] - errors[nearer]
        wanted = errors[nearer] + observed["target_velocity"] * self.control_dt
        local, world = _rotations(observed["joint_rotations"])
        at = np.concatenate([np.zeros((1, 3)), observed["bone_positions"].reshape(-1, 3)])

        # a turn of dq about a joint's own axes moves the hand by R (dq x R^T arm)
        jacobian = np.concatenate([_columns(world[self.joints[i]], hand - at[self.joints[i]]) for i in chain], axis=1)
        step = _least_squares(jacobian, wanted)
        angles = Rotation.from_matrix(local[[self.joints[i] for i in chain]]).as_rotvec().ravel()
        stuck = ((angles <= self.lower[chain].ravel() + 1e-2) & (step < 0.0)) | (
            (angles >= self.upper[chain].ravel() - 1e-2) & (step > 0.0)
        )
        step = _least_squares(jacobian * ~stuck, wanted) / self.action_step
        action = np.zeros((len(self.joints), 3), np.float32)
        action[chain] = (step / max(1.0, np.abs(step).max())).reshape(-1, 3)
        return action.ravel()


def _rotations(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation matrices ``(22, 3, 3)`` to the parent and to the pelvis from the 6D observation."""
    x, y = np.moveaxis(columns.astype(float).reshape(-1, 2, 3), 1, 0)
    local = np.tile(np.eye(3), (NUM_JOINTS, 1, 1))
    local[1:] = np.stack([x, y, np.cross(x, y)], axis=-1)
    world = local.copy()
    for joint in range(1, len(JOINT_NAMES)):
        world[joint] = world[PARENTS[joint]] @ local[joint]
    return local, world


def _columns(rotation: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Return the velocity of the end of ``arm`` for unit turns about the axes of ``rotation``, shape ``(3, 3)``."""
    return np.cross(rotation.T, arm).T


def _least_squares(jacobian: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Solve damped least squares, ``J^T (J J^T + damping^2)^-1 wanted``."""
    return jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * np.eye(3), wanted)
