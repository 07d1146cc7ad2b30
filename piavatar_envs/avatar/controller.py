"""Protocol of an avatar's controller: the calls of a control step, in their order.

:class:`~piavatar_envs.avatar.pose_control.controller.PoseController` moves the flesh along a commanded pose;
:class:`~piavatar_envs.avatar.torque_control.controller.TorqueController` lets torques act between bones.
"""

from __future__ import annotations

from typing import Protocol

import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.types import Scratch, State


class Controller(Protocol):
    """Controller of one avatar in every environment; controllers of different avatars run in parallel."""

    @property
    def moves_particles(self) -> bool:
        """Return whether :meth:`record_end` moves particles: it must then wait for the sensors of the control step."""
        ...

    def record_reset(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Append the reset of the masked environments, whose particles have been placed, to their new pose."""
        ...

    def record_begin(self, graph: LaunchGraph) -> None:
        """Append the start of a control step; it must use neither particles, sensors nor failures."""
        ...

    def record_before_substep(self, graph: LaunchGraph, state: State, scratch: Scratch, step: int) -> None:
        """Append the stages before MPM substep ``step`` of a control step: write velocities of the particles."""
        ...

    def record_end(self, graph: LaunchGraph, state: State) -> None:
        """Append the end of a control step, after its last substep."""
        ...

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint, by name."""
        ...
