"""What a task is: a configuration, where bodies start, what they shall do, what it is worth.

A task records kernel launches into the programs of the :class:`~piavatar_envs.envs.batch_env.BatchEnv`; it never sees
single environments, and nothing it does leaves the device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
import warp as wp

from piavatar_envs.avatar.limits import joint_limits
from piavatar_envs.envs.actions import ActionSpec, select_joints
from piavatar_envs.envs.config import EnvConfig
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.simulation import Domain

if TYPE_CHECKING:
    from piavatar_envs.envs.batch_env import BatchEnv
    from piavatar_envs.mpm.program import Program


class Task:
    """Base of all tasks; a task subclasses it once.

    Class attributes:
        Config: the task's configuration class.
        description: one line for listings.
        observation_terms: what the task adds to the observation.
        reward_terms: names of the reward's terms; the reward is their sum.
        metrics: names of other numbers reported in ``info``.
    """

    Config: ClassVar[type[EnvConfig]] = EnvConfig
    description: ClassVar[str] = ""
    observation_terms: ClassVar[tuple[ObservationTerm, ...]] = ()
    reward_terms: ClassVar[tuple[str, ...]] = ()
    metrics: ClassVar[tuple[str, ...]] = ()

    def __init__(self, config: EnvConfig) -> None:
        self.config = config

    def action_spec(self) -> ActionSpec:
        """Joints that act, and whether the root does."""
        return ActionSpec(select_joints(None), joint_speed=self.config.drive.joint_speed_limit)

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the joints' rotation vectors [rad], each ``(22, 3)``."""
        return joint_limits()

    def domain(self) -> Domain:
        """Where particles may go."""
        return Domain()

    def allocate(self, env: BatchEnv) -> None:
        """Create the task's arrays."""

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of the task that a checkpoint must hold."""
        return {}

    def record_reset(self, env: BatchEnv, program: Program) -> None:
        """Append: for environments of ``env.mask``, write the avatar's first commanded pose and draw the task."""
        raise NotImplementedError

    def record_reference(self, env: BatchEnv, program: Program) -> tuple[wp.array, wp.array]:
        """Append what comes before the physics; return the pose that actions are added to: rotations and root."""
        drive = env.simulation.avatar.state
        return drive.command_rotation, drive.command_root

    def record_outcome(self, env: BatchEnv, program: Program) -> None:
        """Append, after the physics: write reward terms, metrics, success and termination."""
        raise NotImplementedError

    def record_observe(self, env: BatchEnv, program: Program, agent: int, start: int) -> None:
        """Append: write the task's observation terms from component ``start``. Must not change any state."""

    def markers(self, env: BatchEnv, index: int) -> list[tuple[np.ndarray, float, tuple[float, float, float]]]:
        """Things to draw for environment ``index``: ``(position [m], radius [m], rgb)`` spheres."""
        return []
