"""Workspace of the torque controller: its arrays, and their views in shared memory.

On a GPU the arrays that pass values from bone to bone are in the shared memory of a warp (its *arena*), to hide the
latency of global memory between dependent steps. On a CPU they stay in the workspace.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.torque_control.joint_stops import Stops
from piavatar_envs.avatar.torque_control.tree_cholesky import ARENA_WORDS, COLUMN, MOST_ROWS, SPARE, Pattern
from piavatar_envs.avatar.types import Pose
from piavatar_envs.core.arrays import vec8, vec12, vec16

wp.set_module_options({"enable_backward": False})


@wp.struct
class TorqueWorkspace:
    """Arrays of the torque controller in a substep; arrays of several kinds have the rows of one after the other."""

    pose: Pose
    velocity: wp.array2d(dtype=float)  # (num_envs, 69) as in JointState
    outside: wp.array2d(dtype=float)
    # the mass matrix
    pair_sums: wp.array2d(dtype=vec12)  # (num_envs, chunks of pairs)
    records: wp.array(dtype=vec16)
    pattern: Pattern
    matrix: wp.array2d(dtype=float)  # (num_envs, entries)
    diagonals: wp.array2d(dtype=float)  # (2 num_envs, 69) added to the mass matrix before factorization
    # (2 num_envs + 1, entries); the last one, for muscles at their limits, is used on a CPU only
    factors: wp.array2d(dtype=float)
    stops: Stops
    bend: wp.array2d(dtype=wp.vec3)  # (num_envs, bones) rotation vectors of the joints [rad]
    tissue: wp.array2d(dtype=float)  # (num_envs, bones) stiffness of tissue in the factor [N m/rad]
    # sums over particles
    moments: wp.array2d(dtype=vec16)  # (num_envs, chunks)
    # (num_envs, chunks) momenta of the velocity after the pull, and of the displacements to the skinned places
    other_moments: wp.array2d(dtype=vec12)
    bones: wp.array2d(dtype=vec16)  # (num_envs, bones)
    linear: wp.array2d(dtype=wp.vec3)  # (4 num_envs, bones)
    angular: wp.array2d(dtype=wp.vec3)
    # (4 num_envs, 69) momenta, then velocity changes by the joints and by the projection, the change of ``qdot`` by
    # the bias forces, and the fit of the pose
    shares: wp.array2d(dtype=float)
    # (3 num_envs, 69) columns J^T, then Y, of the point of a bone, an axis each; used on a CPU only
    touch: wp.array2d(dtype=float)
    whole: wp.array2d(dtype=float)  # (num_envs, 69) predicted velocity of the joints, with the impulses of bone contact
    # (num_envs, bones) bounding boxes of bones' points, in the rest pose: middle from the joint, half extents [m]
    middle: wp.array2d(dtype=wp.vec3)
    half: wp.array2d(dtype=wp.vec3)
    # torques
    muscle: wp.array2d(dtype=float)  # (num_envs, 69) impulses
    impulse: wp.array2d(dtype=float)
    push: wp.array2d(dtype=float)  # (num_envs, 69) generalised impulses of external forces; no rows without any
    left: wp.array2d(dtype=float)  # (num_envs, 69) diagonal without muscles that have reached their limits
    # motion for the particles
    place: wp.array2d(dtype=wp.mat44)  # (num_envs, bones) from rest to current places, relative to the pelvis
    moving: wp.array2d(dtype=vec8)  # (num_envs, bones) rigid motions by the joints
    # (num_envs, bones) rigid motion by which the total velocity exceeds the physical one, and the spin at the midpoint
    steps: wp.array2d(dtype=vec12)
    # (num_envs, bones) from rest to the places at the end of a substep, relative to the pelvis at its beginning
    end: wp.array2d(dtype=wp.mat44)
    slip: wp.array2d(dtype=wp.vec3)  # as in JointState
    pelvis: wp.array(dtype=wp.vec3)  # (num_envs,) position of its joint at the start of the substep [m]
    # commanded motion, in which the joints move; arrays without entries where there is none
    reference: wp.array2d(dtype=float)  # (num_envs, 69) commanded velocity of the joints
    # (num_envs, particles) commanded velocity in the last substep, less what it has changed of ``J qdot`` [m/s]
    commanded: wp.array2d(dtype=wp.vec3)


# Words of a warp's arena: the factor, whose place first holds the bones' momenta; four shares, the bones'
# motion, and the pose.
_ROWS, _VECTORS = wp.constant(MOST_ROWS), wp.constant(3 * NUM_JOINTS)
_LINEAR = wp.constant(0)
_ANGULAR = wp.constant(int(_LINEAR) + 4 * int(_VECTORS))
_SHARES = wp.constant(ARENA_WORDS)
_MOVING = wp.constant(-(-(int(_SHARES) + 4 * MOST_ROWS) // 4) * 4)
_ROTATION = wp.constant(int(_MOVING) + 8 * NUM_JOINTS)
_POSITION = wp.constant(int(_ROTATION) + 4 * NUM_JOINTS)
_WORDS = -(-(int(_POSITION) + 3 * NUM_JOINTS) // 4) * 4
# First word of the right-hand sides in an arena, and words of each.
_SPARE, _COLUMN = wp.constant(SPARE), wp.constant(COLUMN)


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
__shared__ float __align__(16) arena[{_WORDS}];
return reinterpret_cast<wp::uint64>(arena);
#else
return 0;
#endif
""")
def warp_arena() -> wp.uint64:
    """Return the arena of a warp that is a CUDA block of its own; it begins with the factor."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return there;
#else
return row;
#endif
""")
def row_in_arena(row: int, there: int) -> int:
    """Return the row of an array in a warp's arena: ``there`` on a GPU, ``row`` on a CPU."""
    ...


_VIEW = """
#if defined(__CUDA_ARCH__)
rows.data = reinterpret_cast<decltype(rows.data)>(reinterpret_cast<float*>(arena) + at);
rows.strides[0] = 4 * words;
rows.strides[1] = sizeof(*rows.data);  // known when it is compiled
#endif
return rows;
"""


@wp.func_native(_VIEW)
def view_numbers(rows: wp.array2d(dtype=float), arena: wp.uint64, at: int, words: int) -> wp.array2d(dtype=float):
    """Return a view whose first row is at word ``at`` of the arena, with ``words`` from row to row."""
    ...


@wp.func_native(_VIEW)
def view_vectors(rows: wp.array2d(dtype=wp.vec3), arena: wp.uint64, at: int, words: int) -> wp.array2d(dtype=wp.vec3):
    """Run :func:`view_numbers` for vectors."""
    ...


@wp.func_native(_VIEW)
def view_rotations(rows: wp.array2d(dtype=wp.quat), arena: wp.uint64, at: int, words: int) -> wp.array2d(dtype=wp.quat):
    """Run :func:`view_numbers` for rotations."""
    ...


@wp.func_native(_VIEW)
def view_motions(rows: wp.array2d(dtype=vec8), arena: wp.uint64, at: int, words: int) -> wp.array2d(dtype=vec8):
    """Run :func:`view_numbers` for rigid motions."""
    ...


@wp.func
def view_columns(rows: wp.array2d(dtype=float), arena: wp.uint64):
    """Return the three right-hand sides in the arena of a warp; on a CPU ``rows``. See :func:`place_of_triple`."""
    return view_numbers(rows, arena, _SPARE, _COLUMN)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 4 * k;
#else
return 3 * k;
#endif
""")
def place_of_triple(k: int) -> int:
    """Return the first index of triple ``k`` in a column of :func:`view_columns`; 0 is the pelvis' position."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
float* const to = reinterpret_cast<float*>(arena) + at;
const float* const from = reinterpret_cast<const float*>(&wp::index(position, e, 0));
for (int n = thread; n < {3 * NUM_JOINTS}; n += threads) to[n] = from[n];
#endif
""")
def load_positions(position: wp.array2d(dtype=wp.vec3), e: int, thread: int, threads: int, arena: wp.uint64, at: int):
    """Copy the joint positions of an environment to the arena, from word ``at`` on."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
float* const to = reinterpret_cast<float*>(arena);
const float* const rotation = reinterpret_cast<const float*>(&wp::index(w.pose.rotation, e, 0));
const float* const position = reinterpret_cast<const float*>(&wp::index(w.pose.position, e, 0));
for (int n = threadIdx.x & 31; n < {4 * NUM_JOINTS}; n += 32) to[{_ROTATION} + n] = rotation[n];
for (int n = threadIdx.x & 31; n < {3 * NUM_JOINTS}; n += 32) to[{_POSITION} + n] = position[n];
__syncwarp();
#endif
""")
def load_pose(w: TorqueWorkspace, e: int, arena: wp.uint64):
    """Copy the pose of an environment to the arena."""
    ...


@wp.func
def load_workspace(w: TorqueWorkspace, e: int):
    """Return the workspace with pose, motion, momenta and shares of an environment in the arena of its warp.

    Arrays with several rows have them as :func:`row_in_arena` numbers them; all others have one row, which any
    environment index reads. On a CPU it returns the workspace itself.
    """
    arena = warp_arena()
    load_pose(w, e, arena)
    w.linear = view_vectors(w.linear, arena, _LINEAR, _VECTORS)
    w.angular = view_vectors(w.angular, arena, _ANGULAR, _VECTORS)
    w.shares = view_numbers(w.shares, arena, _SHARES, _ROWS)
    w.moving = view_motions(w.moving, arena, _MOVING, 0)
    w.pose.rotation = view_rotations(w.pose.rotation, arena, _ROTATION, 0)
    w.pose.position = view_vectors(w.pose.position, arena, _POSITION, 0)
    return w


def _store(first: int, count: int, at: int) -> str:
    """Return a snippet that copies ``count`` numbers of each bone from component ``first`` to component ``at``."""
    return f"""
const float* const from = reinterpret_cast<const float*>(&wp::index(motion, e, 0)) + {first};
float* const to = reinterpret_cast<float*>(&wp::index(steps, e, 0)) + {at};
for (int n = thread; n < {count * NUM_JOINTS}; n += threads) {{
    const int b = n / {count}, c = n % {count};
    to[12 * b + c] = from[8 * b + c];
}}
"""


@wp.func_native(_store(first=0, count=6, at=0))
def store_motion(motion: wp.array2d(dtype=vec8), e: int, thread: int, threads: int, steps: wp.array2d(dtype=vec12)):
    """Copy the motion of all bones to their records in ``steps``."""
    ...


@wp.func_native(_store(first=3, count=3, at=6))
def store_spin(motion: wp.array2d(dtype=vec8), e: int, thread: int, threads: int, steps: wp.array2d(dtype=vec12)):
    """Copy the spin of all bones to their records in ``steps``, after the motion."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
const auto store = [&](const auto& rows, const auto& into, int words) {{
    const float* const from = reinterpret_cast<const float*>(rows.data);
    float* const to = reinterpret_cast<float*>(&wp::index(into, e, 0));
    for (int n = threadIdx.x & 31; n < words; n += 32) to[n] = from[n];
}};
store(near.moving, w.moving, {8 * NUM_JOINTS});
store(near.pose.rotation, w.pose.rotation, {4 * NUM_JOINTS});
store(near.pose.position, w.pose.position, {3 * NUM_JOINTS});
#endif
""")
def store_workspace(w: TorqueWorkspace, e: int, near: TorqueWorkspace):
    """Copy motion and pose from the arena back to the workspace."""
    ...
