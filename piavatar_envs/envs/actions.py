"""From actions to the pose that the avatar shall reach: scaled increments on a reference, within joint limits.

Actions of avatars whose joints move under torques: joint targets (``control="pd"``) or torques (``"torque"``).

A *target* is absolute. At action 0 a joint is asked for its pose in the rest position (or in the task's reference),
at 1 and -1 for the ends of its range about that axis, and in between linearly in the rotation vector, so that the
same action always means the same pose. A *torque* is the share of the greatest that the joint has in that direction.
Joints that do not act are held in the rest position (the reference).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.muscles import LOCKED_JOINTS
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.avatar.rotation import MAX_ANGLE, quat_exp, quat_log, short_of_pi, turn_about_z
from piavatar_envs.avatar.torque_control.dynamics import Strength
from piavatar_envs.config.load import ConfigError
from piavatar_envs.mpm.types import FAILURE_ACTION

wp.set_module_options({"enable_backward": False})


_ACTION = wp.constant(FAILURE_ACTION)


@wp.struct
class ActionMap:
    """How an action vector moves the goal. Increments are per control step."""

    size: int
    offset: wp.array(dtype=int)  # (22,) first action component of a joint, -1 if it does not act
    scale: wp.array(dtype=float)  # (22,) increment at action 1 [rad]
    lower: wp.array(dtype=wp.vec3)  # (22,) bounds of the rotation vectors [rad]
    upper: wp.array(dtype=wp.vec3)
    root_offset: int  # first of three components x, y, yaw; -1 if the root does not act
    root_step: float  # root translation at action 1 [m], along x and along y
    root_turn: float  # root turn at action 1 [rad]


#: How much farther than along one axis an action moves the root along both.
_DIAGONAL = math.sqrt(2.0)


def speed_within(reach: float, most: float, control_dt: float) -> float:
    """``root_speed`` [m/s], ``most`` or less, by which no step of ``control_dt`` [s] goes beyond ``reach`` [m]."""
    return min(most, reach / (_DIAGONAL * control_dt))


@dataclass(frozen=True)
class ActionSpec:
    """Meaning of an action vector, in order: three rotation increments a joint, then the root's.

    Attributes:
        joints: names of the acting joints.
        root: whether x, y and yaw of the root follow.
        joint_speed: rotation speed at action 1 [rad/s].
        root_speed: speed of the root at action 1 [m/s], along x and along y.
        root_turn_speed: turning speed of the root at action 1 [rad/s].
    """

    joints: tuple[str, ...]
    root: bool = False
    joint_speed: float = 4.0
    root_speed: float = 1.5
    root_turn_speed: float = 2.0

    @property
    def greatest_speed(self) -> float:
        """How fast an action can move the root horizontally [m/s]: along x and y at once."""
        return _DIAGONAL * self.root_speed

    @property
    def size(self) -> int:
        """Length of the action vector."""
        return 3 * len(self.joints) + 3 * self.root

    def under(self, control: str) -> ActionSpec:
        """The same under ``control``: where torques move the body, nothing moves its root, and its toes are stiff.

        Raises:
            ConfigError: no joint is left.
        """
        if control == "pose":
            return self
        joints = tuple(name for name in self.joints if name not in LOCKED_JOINTS)
        if not joints:
            raise ConfigError(f"joints={list(self.joints)} do not move under control={control!r}; name others")
        return replace(self, joints=joints, root=False)

    def names(self) -> list[str]:
        """A name for every component, such as ``left_elbow.x``."""
        names = [f"{joint}.{axis}" for joint in self.joints for axis in "xyz"]
        return names + (["root.x", "root.y", "root.yaw"] if self.root else [])

    def upload(self, control_dt: float, limits: tuple[np.ndarray, np.ndarray], device: str) -> ActionMap:
        """Kernel argument for control steps of ``control_dt`` [s] and joint ``limits`` [rad]."""
        offset = np.full(NUM_JOINTS, -1, np.int32)
        for index, joint in enumerate(self.joints):
            offset[joint_index(joint)] = 3 * index
        action_map = ActionMap()
        action_map.size = self.size
        action_map.offset = wp.array(offset, dtype=int, device=device)
        scale = np.full(NUM_JOINTS, self.joint_speed * control_dt, np.float32)
        action_map.scale = wp.array(scale, dtype=float, device=device)
        lower, upper = (np.ascontiguousarray(bound, np.float32) for bound in limits)
        action_map.lower = wp.array(lower, dtype=wp.vec3, device=device)
        action_map.upper = wp.array(upper, dtype=wp.vec3, device=device)
        action_map.root_offset = 3 * len(self.joints) if self.root else -1
        action_map.root_step = self.root_speed * control_dt
        action_map.root_turn = self.root_turn_speed * control_dt
        return action_map


def check_actions(action: np.ndarray, shape: tuple[int, ...], names: Sequence[str]) -> np.ndarray:
    """The action as float32, refused before anything changes.

    Raises:
        ValueError: what is no array of real numbers, a wrong shape, or a component that is not finite, whose index and
            name are given.
    """
    try:
        is_complex = np.iscomplexobj(action)
        with np.errstate(over="ignore"):  # what is too large for float32 is infinite there, and refused
            real = action if is_complex else np.asarray(action, dtype=np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        kind = type(action).__name__
        raise ValueError(f"action is a {kind} ({error}); use an array of shape {shape} of real numbers") from None
    if is_complex:
        raise ValueError("action is of complex numbers; actions must be real, in [-1, 1]: give action.real")
    action = real
    if action.shape != shape:
        raise ValueError(f"action has shape {action.shape}, expected {shape}")
    if not np.isfinite(action).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(action))[0])
        where = index[0] if len(index) == 1 else index
        raise ValueError(f"action[{where}] ({names[index[-1]]}) is {action[index]}; actions must be finite, in [-1, 1]")
    return action


@wp.func
def bounded(action: wp.array3d(dtype=float), e: int, agent: int, n: int):
    """An action component clipped to [-1, 1]; zero if it is not finite."""
    a = action[e, agent, n]
    if not wp.isfinite(a):
        return 0.0
    return wp.clamp(a, -1.0, 1.0)


@wp.func
def keep_within(goal: wp.quat, lower: wp.vec3, upper: wp.vec3, allowed: wp.vec3):
    """``goal`` with its rotation vector between limits that are widened as far as ``allowed`` exceeds them [rad]."""
    v = wp.max(wp.min(allowed, lower), wp.min(quat_log(goal), wp.max(allowed, upper)))
    return quat_exp(short_of_pi(v))


@wp.func
def within_limits(reference: wp.quat, step: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """``reference`` turned by ``step`` [rad], kept between the limits of the joint's rotation vector.

    What the reference itself exceeds (a clip may) is allowed, but actions cannot push further.
    """
    before = quat_log(reference)
    goal = reference * quat_exp(step)
    if wp.length(before) > MAX_ANGLE + 1.0e-3:
        # so near to the jump at pi there is no box: an action may only lead away from it
        if wp.length(quat_log(goal)) > wp.length(before):
            return reference
        return goal
    return keep_within(goal, lower, upper, before)


@wp.kernel
def refuse_nonfinite(
    action: wp.array3d(dtype=float), agent: int, alive: wp.array2d(dtype=wp.bool), failure: wp.array(dtype=int)
):
    """End the environment of an action that is not finite; host-side views have refused it before."""
    e, n = wp.tid()
    if alive[e, agent] and not wp.isfinite(action[e, agent, n]):
        wp.atomic_or(failure, e, _ACTION)


@wp.kernel
def apply_actions(
    action_map: ActionMap,
    action: wp.array3d(dtype=float),
    agent: int,
    alive: wp.array2d(dtype=wp.bool),
    reference_rotation: wp.array2d(dtype=wp.quat),
    reference_root: wp.array(dtype=wp.vec3),
    tracked_rotation: wp.array2d(dtype=wp.quat),
    # out
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
):
    """Goal of the control step: the reference pose turned by the action, within the limits of the acting joints.

    An agent that is out does not act.
    """
    e, b = wp.tid()
    goal = reference_rotation[e, b]
    acts = alive[e, agent]
    n = action_map.offset[b]
    if n >= 0 and acts:
        step = wp.vec3(bounded(action, e, agent, n), bounded(action, e, agent, n + 1), bounded(action, e, agent, n + 2))
        goal = within_limits(goal, action_map.scale[b] * step, action_map.lower[b], action_map.upper[b])
    if b == 0:
        root = reference_root[e]
        n = action_map.root_offset
        if n >= 0 and acts:
            # steps are in the avatar's heading: forward is -y
            step = wp.vec3(bounded(action, e, agent, n), bounded(action, e, agent, n + 1), 0.0)
            root += action_map.root_step * wp.quat_rotate(turn_about_z(tracked_rotation[e, 0]), step)
            turn = action_map.root_turn * bounded(action, e, agent, n + 2)
            goal = quat_exp(wp.vec3(0.0, 0.0, turn)) * goal
        goal_root[e] = root
    goal_rotation[e, b] = goal


@wp.func
def action_vector(action: wp.array3d(dtype=float), e: int, agent: int, n: int):
    """Three action components, clipped; zero where they are not finite."""
    return wp.vec3(bounded(action, e, agent, n), bounded(action, e, agent, n + 1), bounded(action, e, agent, n + 2))


@wp.func
def share_of(a: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """From 0 to ``upper`` where ``a`` goes from 0 to 1, to ``lower`` where it goes to -1, axis by axis."""
    return wp.cw_mul(wp.max(a, wp.vec3(0.0)), upper) - wp.cw_mul(wp.min(a, wp.vec3(0.0)), lower)


@wp.kernel
def follow_reference(
    about_rest: int,
    reference_rotation: wp.array2d(dtype=wp.quat),
    reference_root: wp.array(dtype=wp.vec3),
    failure: wp.array(dtype=int),
    # out
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
):
    """The goal before actions: the reference, its joints in the rest pose if ``about_rest``.

    The reference has been commanded: it is what the next one is counted from.
    """
    e, b = wp.tid()
    if failure[e] != 0:
        return
    goal = reference_rotation[e, b]
    command_rotation[e, b] = goal
    if b == 0:
        command_root[e] = reference_root[e]
        goal_root[e] = reference_root[e]
    elif about_rest != 0:
        goal = wp.quat(0.0, 0.0, 0.0, 1.0)
    goal_rotation[e, b] = goal


@wp.kernel
def apply_targets(
    action_map: ActionMap,
    action: wp.array3d(dtype=float),
    agent: int,
    alive: wp.array2d(dtype=wp.bool),
    # in and out
    goal_rotation: wp.array2d(dtype=wp.quat),
):
    """Move the goal of every acting joint towards the ends of its range. An agent that is out does not act.

    What the goal itself exceeds (a clip may) is allowed, but actions cannot push further.
    """
    e, b = wp.tid()
    n = action_map.offset[b]
    if n < 0 or not alive[e, agent]:
        return
    v = quat_log(goal_rotation[e, b])
    lower = wp.min(action_map.lower[b] - v, wp.vec3(0.0))
    upper = wp.max(action_map.upper[b] - v, wp.vec3(0.0))
    v += share_of(action_vector(action, e, agent, n), lower, upper)
    goal_rotation[e, b] = quat_exp(short_of_pi(v))


@wp.kernel
def apply_torques(
    action_map: ActionMap,
    action: wp.array3d(dtype=float),
    agent: int,
    alive: wp.array2d(dtype=wp.bool),
    strength: Strength,
    # out
    torque: wp.array2d(dtype=wp.vec3),
):
    """Torque of every acting joint, of the reference adult [N m]. An agent that is out is limp."""
    e, b = wp.tid()
    n = action_map.offset[b]
    if n < 0:
        return
    torque[e, b] = wp.vec3(0.0)
    if alive[e, agent]:
        torque[e, b] = share_of(action_vector(action, e, agent, n), strength.lower[b], strength.upper[b])
