"""An outer-loop PID controller that turns poses into joint torques, for environments with ``control="torque"``.

It works on plain arrays, without a simulation. :class:`PID` works on any degrees of freedom ``(n, dof)``,
:class:`PosePID` on joints that are local rotations ``(n, joints, 3)``::

    controller = PosePID(PID(gains, dt, (n, joints, 3)))
    torque = controller.step(rotation, target, rate=rate, target_rate=target_rate, factor=schedule(forces))

The law is that of Astrom & Murray, "Feedback Systems", 2nd ed. 2021, chapter 11, a degree of freedom each::

    raw = s (kp e + kd (r' - x')) + I + f          limited to +-limit
    I'  = s ki e + (limited - raw) / tracking      (back-calculation, section 11.4)

with the error ``e`` of the state ``x`` against its target ``r``, the target's rate ``r'`` (feed-forward; zero if not
given, so that the derivative is that of the measurement and a jump of the target gives no kick), a torque ``f`` from
elsewhere, such as :mod:`agents.pid.balance`, and a factor ``s`` from a gain schedule (:mod:`agents.pid.gains`). The
integral is kept as a torque, so that a change of gains does not jump either (section 11.5).

Torques that are held for a control step of 1/30 s allow only weak gains. Where the inertia that a joint moves is given,
error and rate are those at the end of the step (Tan, Liu & Turk, "Stable Proportional-Derivative Controllers", 2011),
and strong gains are stable. That holds for a single joint. For the coupled joints of a body, ``ahead`` of
:meth:`PID.step` replaces the division by inertias (:func:`agents.pid.bones.answered`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

#: From torques if nothing moved and what springs and dampers add to the inertia to the torques that are given.
Ahead = Callable[[np.ndarray, np.ndarray], np.ndarray]
#: From wanted torques to those that the motors can give.
Given = Callable[[np.ndarray], np.ndarray]

#: A number for all, or an array that broadcasts against ``(n, joints, 3)`` or ``(n, dof)``.
PerJoint = float | np.ndarray


@dataclass(frozen=True)
class Gains:
    """Gains of every degree of freedom; for gains per joint, shape ``(joints, 1)``.

    Attributes:
        kp: torque by error [N m/rad].
        kd: torque by rate of the error [N m s/rad].
        ki: growth of the torque by error [N m/(rad s)]; where it is zero there is no integral.
        limit: largest torque, in both directions [N m].
        tracking: time in which an integral gives way that the limit leaves without effect [s]. None for
            ``sqrt(kd / ki)``, which is ``sqrt(Ti Td)``, or ``kp / ki`` = ``Ti`` where ``kd`` is zero (Astrom &
            Hagglund, "PID Controllers", 1995, section 3.5); infinite for an integral that winds up.
        inertia: that the degree of freedom moves [kg m^2]; None for a controller that does not look ahead.
    """

    kp: PerJoint
    kd: PerJoint = 0.0
    ki: PerJoint = 0.0
    limit: PerJoint = np.inf
    tracking: PerJoint | None = None
    inertia: PerJoint | None = None

    def __post_init__(self) -> None:
        """Refuse gains that drive away from the target.

        Raises:
            ValueError: one that is negative, or an inertia, a limit or a tracking time that is not positive.
        """
        for name in ("kp", "kd", "ki"):
            _check(name, getattr(self, name), strict=False)
        for name in ("limit", "tracking", "inertia"):
            if getattr(self, name) is not None:
                _check(name, getattr(self, name), strict=True)

    def tracking_time(self) -> np.ndarray:
        """Return the time constant of anti-windup [s]; infinite where there is no integral."""
        kp, kd, ki = (np.asarray(gain, float) for gain in (self.kp, self.kd, self.ki))
        with np.errstate(divide="ignore", invalid="ignore"):
            chosen = np.where(kd > 0.0, np.sqrt(kd / ki), kp / ki) if self.tracking is None else self.tracking
        return np.where(ki > 0.0, chosen, np.inf)


def _check(name: str, values: Any, strict: bool) -> None:
    found = np.asarray(values, float)
    wrong = ~(found > 0.0) if strict else ~(np.isfinite(found) & (found >= 0.0))
    if wrong.any():
        limit = "> 0" if strict else ">= 0 and finite"
        raise ValueError(f"{name}={found[wrong].flat[0] if found.ndim else found} must be {limit}")


class PID:
    """PID controllers of independent degrees of freedom.

    Attributes:
        gains: as given.
        dt: time between two calls [s].
        integral: torque that stands against what does not change [N m], of the shape that was given.
    """

    def __init__(self, gains: Gains, dt: float, shape: tuple[int, ...]) -> None:
        """Build a controller at rest.

        Args:
            gains: broadcast against ``shape``.
            dt: time between two calls [s].
            shape: of errors and torques, ``(n, dof)`` or ``(n, joints, 3)``.

        Raises:
            ValueError: a time that is not positive, or gains that do not fit the shape.
        """
        _check("dt", dt, strict=True)
        self.gains, self.dt, self.integral = gains, dt, np.zeros(shape)
        self._kp, self._kd, self._ki, self._limit = (
            np.broadcast_to(np.asarray(gain, float), shape) for gain in (gains.kp, gains.kd, gains.ki, gains.limit)
        )
        # in a time shorter than a step the integral would overtake what it gives way to
        self._give_way = dt / np.broadcast_to(np.maximum(gains.tracking_time(), dt), shape)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Clear the integral of all, or of the rows of ``mask`` ``(n,)``, such as those whose episode begins."""
        self.integral[slice(None) if mask is None else mask] = 0.0

    def step(
        self,
        error: np.ndarray,
        rate: np.ndarray,
        target_rate: np.ndarray | float = 0.0,
        feedforward: np.ndarray | float = 0.0,
        factor: np.ndarray | float = 1.0,
        ahead: Ahead | None = None,
        given: Given | None = None,
    ) -> np.ndarray:
        """Compute torques for the next ``dt`` [N m].

        Args:
            error: what is missing to the target [rad].
            rate: of the state [rad/s].
            target_rate: of the target [rad/s].
            feedforward: torque on top, within the limit [N m].
            factor: on the gains [-], from a schedule.
            ahead: how the body answers springs and dampers within the step; None where every degree of freedom answers
                alone, by the inertia of the gains, or none does.
            given: maps wanted torques to those that motors can give, where their limits are others than those of the
                gains; integrals give way to what it leaves.

        Raises:
            ValueError: an error or a rate of another shape than the controller's.
        """
        for name, value in (("error", error), ("rate", rate)):
            if np.shape(value) != self.integral.shape:
                raise ValueError(f"{name} has shape {np.shape(value)}, expected {self.integral.shape}")
        raw = self._proportional(error, target_rate - rate, factor, ahead) + self.integral + feedforward
        limited = np.clip(raw, -self._limit, self._limit)
        limited = limited if given is None else given(limited)
        self.integral += self.dt * factor * self._ki * error + self._give_way * (limited - raw)
        return limited

    def _proportional(
        self, error: np.ndarray, closing: np.ndarray, factor: np.ndarray | float, ahead: Ahead | None
    ) -> np.ndarray:
        """Return ``kp e + kd e'``, at the end of the step where the response of the body is known, else now."""
        kp, kd, dt = factor * self._kp, factor * self._kd, self.dt
        if ahead is None and self.gains.inertia is None:
            return kp * error + kd * closing
        still, added = kp * (error + dt * closing) + kd * closing, dt * (kd + dt * kp)
        return still / (1.0 + added / self.gains.inertia) if ahead is None else ahead(still, added)


class PosePID:
    """PID controllers of joints that are rotations: errors are on SO(3), not differences of rotation vectors.

    All vectors of a joint (error, rate, torque) have the axes of the bone that it moves, as actions have.
    """

    def __init__(self, pid: PID, smoothing: float = 0.0) -> None:
        """Wrap a controller of shape ``(n, joints, 3)``.

        Args:
            pid: the controller.
            smoothing: time constant of the filter of rates that are found from rotations [s], section 11.5 of Astrom &
                Murray; 0 for none.

        Raises:
            ValueError: a controller of another shape, or a negative time.
        """
        if pid.integral.ndim != 3 or pid.integral.shape[2] != 3:
            raise ValueError(f"the controller has shape {pid.integral.shape}, expected (n, joints, 3)")
        _check("smoothing", smoothing, strict=False)
        self.pid, self.smoothing = pid, smoothing
        self._before: np.ndarray | None = None
        self._rate = np.zeros(pid.integral.shape)
        self._fresh = np.ones(len(pid.integral), bool)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Clear the state of all, or of the rows of ``mask`` ``(n,)``."""
        chosen = slice(None) if mask is None else mask
        self.pid.reset(mask)
        self._rate[chosen], self._fresh[chosen] = 0.0, True

    def step(
        self,
        rotation: np.ndarray,
        target: np.ndarray,
        rate: np.ndarray | None = None,
        target_rate: np.ndarray | float = 0.0,
        feedforward: np.ndarray | float = 0.0,
        factor: np.ndarray | float = 1.0,
        ahead: Ahead | None = None,
        given: Given | None = None,
    ) -> np.ndarray:
        """Compute torques of all joints for the next step [N m], ``(n, joints, 3)``.

        Args:
            rotation: local rotation vectors of the joints [rad], ``(n, joints, 3)``.
            target: of the same kind, ``(n, joints, 3)`` or ``(joints, 3)``; a pose to hold, or a clip's at this time.
            rate: local angular velocities [rad/s]; None to find them from this rotation and the last one.
            target_rate: of the target, in the axes that its bones have in the target [rad/s].
            feedforward: torque on top, within the limit [N m].
            factor: on the gains [-], from a schedule, ``(n, joints, 1)`` or a number.
            ahead: how the body answers, see :meth:`PID.step`.
            given: what muscles give, likewise.
        """
        target = np.broadcast_to(target, rotation.shape)
        error = difference(rotation, target)
        closing = target_rate if np.ndim(target_rate) == 0 else turned(error, np.broadcast_to(target_rate, error.shape))
        rate = self._found_rate(rotation) if rate is None else rate
        return self.pid.step(error, rate, closing, feedforward, factor, ahead, given)

    def _found_rate(self, rotation: np.ndarray) -> np.ndarray:
        """Estimate rates from two rotations, through a filter of first order; zero in a first step."""
        if self._before is not None:
            moved = difference(self._before, rotation) / self.pid.dt
            share = self.pid.dt / (self.pid.dt + self.smoothing)
            self._rate = np.where(self._fresh[:, None, None], 0.0, self._rate + share * (moved - self._rate))
        self._before = np.array(rotation)
        self._fresh[:] = False
        return self._rate


def difference(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the shortest turn from one rotation to another, ``log(R_start^T R_end)``, in the axes of either.

    Args:
        start: rotation vectors [rad], ``(..., 3)``.
        end: of the same shape.

    Returns:
        Rotation vectors of at most pi [rad], ``(..., 3)``.
    """
    first, second = (_rotations(part) for part in (start, end))
    return (first.inv() * second).as_rotvec().reshape(np.shape(start))


def turned(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return ``R v`` of rotation vectors [rad] and vectors, both ``(..., 3)``."""
    return _rotations(rotation).apply(_rows(vector)).reshape(np.shape(vector))


def _rotations(vectors: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(_rows(vectors))


def _rows(vectors: np.ndarray) -> np.ndarray:
    return np.array(vectors, float).reshape(-1, 3)  # a copy: SciPy refuses what is read-only


def follow(
    poses: Callable[[np.ndarray], np.ndarray], time: float | np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a clip's pose at a time, and the rate that leads to the next one.

    Args:
        poses: from times [s] ``(n,)`` to local rotation vectors [rad] ``(n, joints, 3)``; of a
            :class:`~piavatar_envs.avatar.motion.motion.Motion` it is :func:`motion_poses`.
        time: where the clip is [s], ``(n,)`` or a number for one.
        dt: time of a control step [s].

    Returns:
        ``target`` and ``target_rate`` of :meth:`PosePID.step`, ``(n, joints, 3)``.
    """
    time = np.atleast_1d(time)
    now = poses(time)
    return now, difference(now, poses(time + dt)) / dt


def motion_poses(motion: Any, joints: list[int]) -> Callable[[np.ndarray], np.ndarray]:
    """Return poses of a clip as :func:`follow` takes them.

    Args:
        motion: a :class:`~piavatar_envs.avatar.motion.motion.Motion`.
        joints: that are wanted, as places in the skeleton.
    """

    def poses(time: np.ndarray) -> np.ndarray:
        quaternions = motion.sample(time)[0][:, joints]
        vectors = Rotation.from_quat(quaternions.reshape(-1, 4), scalar_first=True).as_rotvec()
        return vectors.reshape(len(time), len(joints), 3)

    return poses
