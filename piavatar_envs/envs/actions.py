"""Actions: increments of a commanded pose, joint targets or joint torques, by the mode of control.

Under pose control an action turns a reference pose by scaled increments, within joint limits. Under torque control it
is a joint target (``control="pd"``) or a torque (``"torque"``). A *target* is absolute: action 0 is the pose of the
rest position (or of the task's reference), 1 and -1 are the ends of the joint's range about that axis, linear in the
rotation vector in between, so that an action always means the same pose. A *torque* is a share of the greatest torque
of the joint in that direction. Joints that do not act are held in the rest position (or the reference).
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
from piavatar_envs.avatar.torque_control.joint_torques import Strength
from piavatar_envs.config.load import ConfigError
from piavatar_envs.mpm.types import FAILURE_ACTION

wp.set_module_options({"enable_backward": False})


_ACTION = wp.constant(FAILURE_ACTION)


@wp.struct
class ActionMap:
    """Map from an action vector to the goal, with increments per control step."""

    size: int
    offset: wp.array(dtype=int)  # (22,) first action component of a joint, -1 if it does not act
    scale: wp.array(dtype=float)  # (22,) increment at action 1 [rad]
    lower: wp.array(dtype=wp.vec3)  # (22,) bounds of the rotation vectors [rad]
    upper: wp.array(dtype=wp.vec3)
    root_offset: int  # first of three components x, y, yaw; -1 if the root does not act
    root_step: float  # root translation at action 1 [m], along x and along y
    root_turn: float  # root turn at action 1 [rad]


#: Distance of a root action along both axes, over that along one.
_DIAGONAL = math.sqrt(2.0)


def speed_within(reach: float, most: float, control_dt: float) -> float:
    """Return the root speed [m/s], at most ``most``, that moves at most ``reach`` [m] in ``control_dt`` [s]."""
    return min(most, reach / (_DIAGONAL * control_dt))


@dataclass(frozen=True)
class ActionSpec:
    """Meaning of an action vector: three components per joint, then those of the root.

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
        """Greatest horizontal speed of the root [m/s], along x and y at once."""
        return _DIAGONAL * self.root_speed

    @property
    def size(self) -> int:
        """Length of the action vector."""
        return 3 * len(self.joints) + 3 * self.root

    def under(self, control: str) -> ActionSpec:
        """Return the specification under a mode of control: torques move neither the root nor the stiff toes.

        Raises:
            ConfigError: no joint is left.
        """
        if control == "pose":
            return self
        joints = tuple(name for name in self.joints if name not in LOCKED_JOINTS)
        if not joints:
            raise ConfigError(f"joints={list(self.joints)} do not move under control.mode={control!r}; name others")
        return replace(self, joints=joints, root=False)

    def names(self) -> list[str]:
        """Return a name for every component, such as ``left_elbow.x``."""
        names = [f"{joint}.{axis}" for joint in self.joints for axis in "xyz"]
        return names + (["root.x", "root.y", "root.yaw"] if self.root else [])

    def upload(self, control_dt: float, limits: tuple[np.ndarray, np.ndarray], device: str) -> ActionMap:
        """Upload the action map for control steps of ``control_dt`` [s] and joint ``limits`` [rad]."""
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
    """Return the action as float32.

    Args:
        action: an array of real numbers.
        shape: the expected shape.
        names: of the components, for messages.

    Raises:
        ValueError: the action is not an array of real numbers, has another shape, or is not finite; the message names
            the component.
    """
    try:
        is_complex = np.iscomplexobj(action)
        with np.errstate(over="ignore"):  # a value too large for float32 becomes infinite and is refused below
            real = action if is_complex else np.asarray(action, dtype=np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        kind = type(action).__name__
        raise ValueError(f"action is a {kind} ({error}); use an array of shape {shape} of real numbers") from None
    if is_complex:
        raise ValueError("action is of complex numbers; actions must be real, in [-1, 1]: give action.real")
    action = real
    if action.shape != shape:
        raise ValueError(f"action has shape {action.shape}; use shape {shape}")
    if not np.isfinite(action).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(action))[0])
        where = index[0] if len(index) == 1 else index
        raise ValueError(f"action[{where}] ({names[index[-1]]}) is {action[index]}; actions must be finite, in [-1, 1]")
    return action


@wp.func
def bounded(action: wp.array3d(dtype=float), e: int, agent: int, n: int):
    """Return an action component clipped to [-1, 1], or zero if it is not finite."""
    a = action[e, agent, n]
    if not wp.isfinite(a):
        return 0.0
    return wp.clamp(a, -1.0, 1.0)


@wp.func
def keep_within(goal: wp.quat, lower: wp.vec3, upper: wp.vec3, allowed: wp.vec3):
    """Clamp the rotation vector of ``goal`` to limits [rad], widened where ``allowed`` exceeds them."""
    v = wp.max(wp.min(allowed, lower), wp.min(quat_log(goal), wp.max(allowed, upper)))
    return quat_exp(short_of_pi(v))


@wp.func
def within_limits(reference: wp.quat, step: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """Return ``reference`` turned by ``step`` [rad], within the limits of the joint's rotation vector.

    A reference may exceed the limits, as in a clip, but actions cannot increase the excess.
    """
    before = quat_log(reference)
    goal = reference * quat_exp(step)
    if wp.length(before) > MAX_ANGLE + 1.0e-3:
        # near the jump at pi limits mean nothing, so an action may only lead away from it
        if wp.length(quat_log(goal)) > wp.length(before):
            return reference
        return goal
    return keep_within(goal, lower, upper, before)


@wp.kernel
def refuse_nonfinite(
    action: wp.array3d(dtype=float), agent: int, alive: wp.array2d(dtype=wp.bool), failure: wp.array(dtype=int)
):
    """Flag the failure of an environment whose action is not finite; views of the host have refused it before."""
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
    """Turn the reference pose by the action, within the limits of the acting joints; over ``(num_envs, bones)``.

    The action of an agent that is out has no effect.
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
            # in the avatar's frame, forward is -y
            step = wp.vec3(bounded(action, e, agent, n), bounded(action, e, agent, n + 1), 0.0)
            root += action_map.root_step * wp.quat_rotate(turn_about_z(tracked_rotation[e, 0]), step)
            turn = action_map.root_turn * bounded(action, e, agent, n + 2)
            goal = quat_exp(wp.vec3(0.0, 0.0, turn)) * goal
        goal_root[e] = root
    goal_rotation[e, b] = goal


@wp.func
def action_vector(action: wp.array3d(dtype=float), e: int, agent: int, n: int):
    """Return three clipped action components, zero where they are not finite."""
    return wp.vec3(bounded(action, e, agent, n), bounded(action, e, agent, n + 1), bounded(action, e, agent, n + 2))


@wp.func
def share_of(a: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """Map ``a`` linearly to ``lower`` at -1, 0 at 0 and ``upper`` at 1, axis by axis."""
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
    """Set the goal before actions to the reference, with its joints in the rest pose if ``about_rest``.

    The command becomes the reference as well, since the next one is relative to it. Over ``(num_envs, bones)``.
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
    """Move the goal of every acting joint towards the ends of its range; over ``(num_envs, bones)``.

    A goal may exceed the range, as in a clip, but actions cannot increase the excess. The action of an agent that is
    out has no effect.
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
    """Set the torque of every acting joint for the reference adult [N m]; zero for an agent that is out."""
    e, b = wp.tid()
    n = action_map.offset[b]
    if n < 0:
        return
    torque[e, b] = wp.vec3(0.0)
    if alive[e, agent]:
        torque[e, b] = share_of(action_vector(action, e, agent, n), strength.lower[b], strength.upper[b])
