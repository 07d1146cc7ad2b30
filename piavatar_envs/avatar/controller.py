"""Controllers of an avatar: their protocol, and the implicit pull by which they act on velocities.

:class:`~piavatar_envs.avatar.pose_control.controller.PoseController` moves the flesh along a commanded pose;
:class:`~piavatar_envs.avatar.torque_control.controller.TorqueController` lets torques act between bones.

Shape, tone, root and flesh are pulled as by springs that are critically damped and integrated implicitly.
"""

from __future__ import annotations

from typing import Any, Protocol

import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.types import Scratch, State

wp.set_module_options({"enable_backward": False})


class Controller(Protocol):
    """Controller of one avatar in every environment, its calls in the order of a control step.

    Controllers of different avatars run in parallel.
    """

    @property
    def moves_particles(self) -> bool:
        """Return whether :meth:`record_end` moves particles: it must then wait for the sensors of the control step."""
        ...

    @property
    def joints(self) -> Any:
        """Return the articulated body that takes the forces on bones; None where flesh takes them."""
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


@wp.func
def pull_denominator(rate: float, dt: float):
    """Return ``1 + 2 w dt + w^2 dt^2``, the divisor of backward Euler at natural frequency ``w`` = ``rate`` [1/s]."""
    return 1.0 + 2.0 * rate * dt + rate * rate * dt * dt


@wp.func
def pull_gain(rate: float, dt: float):
    """Return the velocity change per displacement of one implicit step [1/s]."""
    return dt * rate * rate / pull_denominator(rate, dt)


@wp.func
def critical_pull(rate: float, dt: float, error: wp.vec3, v: wp.vec3):
    """Return the acceleration of an implicit critically damped spring of natural frequency ``rate`` [1/s]."""
    return (rate * rate * (error - dt * v) - 2.0 * rate * v) / pull_denominator(rate, dt)


@wp.func
def implicit_velocity(rate: float, dt: float, displacement: wp.vec3, v: wp.vec3):
    """Return the velocity after ``dt`` of an implicit critically damped pull of natural frequency ``rate`` [1/s]."""
    return (1.0 / pull_denominator(rate, dt)) * (v + dt * rate * rate * displacement)
