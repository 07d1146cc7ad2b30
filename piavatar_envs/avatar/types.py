"""Data structures of an avatar: constants, parameters, checkpointed state and workspaces, and their allocation.

Symbols in kernels: ``b`` bone, ``c`` chunk of a bone's particle list, ``q`` rotation, ``G`` the motion by which contact
has carried a bone within this control step. A body occupies particles ``first ... first + count`` of each environment.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, is_dataclass
from functools import partial
from typing import Any

import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.core.arrays import vec8, vec12, vec16
from piavatar_envs.core.structs import make_struct

wp.set_module_options({"enable_backward": False})


#: Tone 1 pulls bones to the commanded pose at this natural frequency [1/s].
TONE_RATE = 30.0
#: Natural frequency of the root wrench [1/s].
ROOT_RATE = 10.0
#: Decay of motion between bones at any tone [1/s]; without it a limp body rings like rubber.
DAMPING = 3.0
#: Meaning of a command to the pose controller, by the setting ``control.command``.
COMMANDS = {"increment": 0, "target": 1, "reference": 2}
COMMAND_TARGET = wp.constant(COMMANDS["target"])
COMMAND_REFERENCE = wp.constant(COMMANDS["reference"])

#: Record of a bone, and its blend at a particle, see :mod:`piavatar_envs.avatar.skinning`.
vec44 = wp.types.vector(length=44, dtype=wp.float32)
vec24 = wp.types.vector(length=24, dtype=wp.float32)


@wp.struct
class Correctives:
    """Displacements of the rest pose that depend on the pose, see :mod:`piavatar_envs.avatar.correctives`.

    Of the particles from ``Body.alone`` on, which several bones move; arrays without entries where there are none. The
    entries of such a particle ``p`` are ``[start[p] : start[p + 1]]``.
    """

    start: wp.array(dtype=int)
    joint: wp.array(dtype=int)  # of an entry
    linear: wp.array(dtype=wp.mat33)  # [m]
    quadratic: wp.array(dtype=wp.mat33)  # [m]
    displacement: wp.array2d(dtype=wp.vec3)  # (num_envs, particles) at the beginning of a control step [m]
    change: wp.array2d(dtype=wp.vec3)  # (num_envs, particles) in the control step [m]


@wp.struct
class Body:
    """Constants of one avatar, and the displacements of its rest pose. ``(rows, ...)`` arrays have 1 or E rows."""

    first: int
    count: int
    rest: wp.array2d(dtype=wp.vec3)  # (rows, count) rest positions [m]
    skin: wp.array(dtype=wp.vec4)  # (count,) bones that move a particle, see piavatar_envs.avatar.skinning
    alone: int  # number of particles that a single bone moves; they come first
    correctives: Correctives
    velocity_lag: wp.array2d(dtype=float)  # (rows, count) share of a change of commanded motion that a particle misses
    rest_joint: wp.array2d(dtype=wp.vec3)  # (rows, bones) [m]
    rest_center: wp.array2d(dtype=wp.vec3)  # (rows, bones) skinning-weighted centre of mass [m]
    bone_mass: wp.array2d(dtype=float)  # (rows, bones) skinning-weighted mass [kg]
    parent: wp.array(dtype=int)  # (bones,)
    children: wp.array(dtype=int)  # (bones,) a bit for each bone that hangs on a bone
    depth: wp.array(dtype=int)  # (bones,) joints between a bone and the root
    levels: int  # different depths
    level_start: wp.array(dtype=int)  # (levels + 1,) bones of depth d are level_start[d] ... level_start[d + 1] - 1
    # particles that track bone b: tracker[tracker_start[b] : tracker_start[b + 1]]
    tracker_start: wp.array(dtype=int)
    tracker: wp.array(dtype=int)
    # particles moved by bone b, in chunks: bone b owns chunks chunk_start[b] : chunk_start[b + 1]
    chunk_start: wp.array(dtype=int)
    chunk_bone: wp.array(dtype=int)
    quarters: wp.array(dtype=wp.vec4i)  # of warps that share chunks, see piavatar_envs.avatar.segment_sums
    entry: wp.array(dtype=int)
    entry_weight: wp.array(dtype=float)


@wp.struct
class PoseControl:
    """Parameters of the pose controller, named like the settings of ``control`` that they follow from.

    Rates are natural frequencies of critically damped pulls [1/s].
    """

    dt: float  # substep [s]
    control_dt: float  # control step [s]
    num_substeps: int
    command: int  # one of COMMANDS
    shape_rate: float  # physical shape preservation, alpha / control_dt
    kinematic_shape_rate: float  # the paper's shape preservation inside vk; breaks momentum
    tone_rate: float  # pull towards the commanded pose, TONE_RATE tone
    damping: float  # decay of motion between bones [1/s]
    free_motion: int  # 1: commanded motion carries no net momentum (0: not until the root wrench is released)
    gravity: wp.vec3
    # root wrench
    root_rate: float  # 0: none
    bones_bear: int  # 1: the root's support acts at the bones, which bear the flesh; 0: at every particle
    max_root_force: float  # [m/s^2], a force limit over the mass
    max_root_torque: float  # [m^2/s^2], a torque limit over the mass
    bound_motion: int  # 1: both limits bound the momentum of commanded motion, too
    release_tilt_cos: float
    release_distance: float  # horizontal [m]
    release_height: float  # [m]


@wp.struct
class RigidFits:
    """Rigid motion of every bone, fitted to the physical velocity; ``(num_envs, bones)``."""

    center: wp.array2d(dtype=wp.vec3)  # skinning-weighted centre of mass [m]
    velocity: wp.array2d(dtype=wp.vec3)  # of the centre [m/s]
    spin: wp.array2d(dtype=wp.vec3)  # angular velocity [rad/s]
    inertia: wp.array2d(dtype=wp.mat33)  # about the centre [kg m^2]


@wp.struct
class RigidFit:
    """Rigid motion of the whole body, like :class:`RigidFits`; ``(num_envs,)``."""

    center: wp.array(dtype=wp.vec3)
    velocity: wp.array(dtype=wp.vec3)
    spin: wp.array(dtype=wp.vec3)
    inertia: wp.array(dtype=wp.mat33)


@wp.struct
class RemovedMotion:
    """Rigid motion taken out of the kinematic velocity of a body that nothing supports; ``(num_envs,)``."""

    velocity: wp.array(dtype=wp.vec3)
    turn: wp.array(dtype=wp.mat33)  # (R - I) / dt [1/s]
    center: wp.array(dtype=wp.vec3)
    turning: wp.array(dtype=wp.vec3)  # angular momentum of what was taken out, about the centre [N m s]
    acceleration: wp.array(dtype=wp.vec3)  # of the spin, at constant angular momentum [rad/s^2]


@wp.struct
class Pose:
    """World rotations and joint positions of all bones; ``(num_envs, bones)``."""

    rotation: wp.array2d(dtype=wp.quat)
    position: wp.array2d(dtype=wp.vec3)


@wp.struct
class Carry:
    """``G``: motion by which contact has carried each bone in this control step; ``(num_envs, bones)``."""

    rotation: wp.array2d(dtype=wp.quat)
    translation: wp.array2d(dtype=wp.vec3)


@wp.struct
class Anchor:
    """Rigid motion that aligns the commanded pose with the body; ``(num_envs,)``."""

    rotation: wp.array(dtype=wp.quat)
    translation: wp.array(dtype=wp.vec3)


@wp.struct
class Command:
    """Commanded pose at the start of the control step, and its increment until the end."""

    rotation: wp.array2d(dtype=wp.quat)  # (num_envs, bones) local
    increment: wp.array2d(dtype=wp.vec3)  # (num_envs, bones) [rad]
    root: wp.array(dtype=wp.vec3)  # (num_envs,) [m]
    goal_root: wp.array(dtype=wp.vec3)


@wp.struct
class Wrench:
    """Pull of the root in a substep, and what it still owes to commanded motion; ``(num_envs,)``."""

    force: wp.array(dtype=wp.vec3)  # of the pull and against gravity, bounded [N]
    torque: wp.array(dtype=wp.vec3)  # of the pull about the body's centre, bounded [N m]
    # impulses of commanded motion that the bounds have put off, in this control step
    owed: wp.array(dtype=wp.vec3)  # [N s]
    owed_turn: wp.array(dtype=wp.vec3)  # [N m s]


@wp.struct
class RootState:
    """Results of the root wrench, see :class:`AvatarState`; ``(num_envs,)``."""

    released: wp.array(dtype=int)
    wrench_force: wp.array(dtype=wp.vec3)
    wrench_torque: wp.array(dtype=wp.vec3)


@wp.struct
class PoseWorkspace:
    """Arrays of the pose controller in a substep; ``now`` and ``after`` swap their roles every substep."""

    start_rotation: wp.array2d(dtype=wp.quat)  # (num_envs, bones) the pose that the control step starts from, local
    start_root: wp.array(dtype=wp.vec3)
    increment: wp.array2d(dtype=wp.vec3)  # (num_envs, bones) rotation vector added to the start pose [rad]
    root_increment: wp.array(dtype=wp.vec3)  # (num_envs,) translation added to it [m]
    command: Command
    tracked: wp.array2d(dtype=wp.vec3)  # (num_envs, bones) joint positions at the start of the control step [m]
    now: Pose  # the kinematic pose at the substep's start
    after: Pose  # the same at its end
    command_pose: Pose  # the commanded pose at the substep's start, before alignment
    carry: Carry
    anchor: Anchor
    gap: wp.array2d(dtype=wp.vec3)  # (num_envs, bones) tracked joint positions less those at fixed offsets [m]
    bones: RigidFits
    whole: RigidFit
    removed: RemovedMotion
    wrench: Wrench
    moments: wp.array2d(dtype=vec16)  # (num_envs, chunks)
    record: wp.array2d(dtype=vec44)  # (num_envs, bones) records that particles blend
    pull: wp.array2d(dtype=wp.vec3)  # (num_envs, count) velocity change by shape preservation and tone [m/s]
    lean: wp.array2d(dtype=wp.vec3)  # (num_envs, count) displacement from the carried to the commanded pose [m]
    # (num_envs, count) change of velocity as commanded [m/s]; without columns if no root is held, like their sums
    jump: wp.array2d(dtype=wp.vec3)
    jumps: wp.array2d(dtype=vec8)  # (num_envs, chunks) their momenta
    load: wp.array(dtype=float)  # (count,) weight and support over mass and gravity; empty unless bones bear the flesh
    corrections: wp.array2d(dtype=vec12)  # (num_envs, chunks)
    bone_corrections: wp.array2d(dtype=vec12)  # (num_envs, bones) their sums
    change: wp.array2d(dtype=vec8)  # (num_envs, bones) correction field


@dataclass
class AvatarState:
    """Commands of an avatar, and its root wrench. Quaternions are Warp's ``xyzw``; ``[:, 0]`` is the root's."""

    command_rotation: wp.array2d(dtype=wp.quat)  # (num_envs, bones) local rotations commanded so far
    command_root: wp.array(dtype=wp.vec3)  # (num_envs,) commanded pelvis position [m]
    goal_rotation: wp.array2d(dtype=wp.quat)  # (num_envs, bones) local rotations at the end of this control step
    goal_root: wp.array(dtype=wp.vec3)  # (num_envs,) pelvis position to reach [m]
    released: wp.array(dtype=int)  # (num_envs,) 1 once the root is no longer held
    wrench_force: wp.array(dtype=wp.vec3)  # (num_envs,) mean external force on the root in the last control step [N]
    wrench_torque: wp.array(dtype=wp.vec3)  # (num_envs,) mean torque on it [N m]
    # (num_envs, bones) local rotations that the correctives of the rest pose suit at the end of the control step
    corrected_rotation: wp.array2d(dtype=wp.quat)


@dataclass
class Tracked:
    """Bones tracked from the particles: live arrays, recomputed whenever these have moved.

    Quaternions are Warp's ``xyzw``; :meth:`piavatar_envs.api.host.HostView.read` returns copies with ``wxyz``.
    """

    rotation: wp.array2d(dtype=wp.quat)  # (num_envs, bones) world rotation
    position: wp.array2d(dtype=wp.vec3)  # (num_envs, bones) joint position [m]
    velocity: wp.array2d(dtype=wp.vec3)  # (num_envs, bones) mean velocity of the bone's tracking particles [m/s]
    local: wp.array2d(dtype=wp.quat)  # (num_envs, bones) rotation relative to the parent bone


@dataclass
class JointState:
    """State of joints that move under torques."""

    rotation: wp.array2d(dtype=wp.quat)  # (num_envs, bones) world rotation
    position: wp.array2d(dtype=wp.vec3)  # (num_envs, bones) joint position [m]
    # (num_envs, 69) the pelvis' [m/s], then spins of all joints in the world's axes [rad/s]
    velocity: wp.array2d(dtype=float)
    outside: wp.array2d(dtype=float)  # (num_envs, 69) its change in the last substep, except by the joints
    # (num_envs, bones) torques, of the reference adult, about the rest pose's axes as the parent has turned them [N m]
    torque: wp.array2d(dtype=wp.vec3)
    # (num_envs, 1 + last firm particle) sum of the displacements of firm particles, in the frame of the rest pose [m]
    slip: wp.array2d(dtype=wp.vec3)


def allocate(declaration: Any, num_envs: int, device: str, **given: Any) -> Any:
    """Return an instance of ``declaration`` with zeroed arrays of the types that it declares.

    Args:
        declaration: a Warp struct, whose structs are allocated likewise, or a dataclass of arrays.
        num_envs: rows of every array.
        device: where to allocate.
        given: by name, the number of columns of a two-dimensional array, if not one a bone, or an existing value to use
            instead of an allocation.
    """
    if is_dataclass(declaration):
        declared, build = inspect.get_annotations(declaration, eval_str=True), declaration
    else:
        declared = {name: variable.type for name, variable in declaration.vars.items()}
        build = partial(make_struct, declaration)
    values = {}
    for name, kind in declared.items():
        value = given.get(name, NUM_JOINTS)
        if not isinstance(value, int):
            values[name] = value
        elif hasattr(kind, "dtype"):
            values[name] = wp.zeros((num_envs, value)[: kind.ndim], dtype=kind.dtype, device=device)
        else:
            values[name] = allocate(kind, num_envs, device)
    return build(**values)
