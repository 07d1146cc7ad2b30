"""What the joints of an environment work on. A warp has in shared memory what goes from bone to bone.

In global memory each bone would wait some hundred cycles for the one before.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.torque_control.tree_cholesky import ARENA_WORDS, MOST_ROWS, SPARE, Pattern
from piavatar_envs.avatar.types import Pose
from piavatar_envs.core.arrays import vec8, vec12, vec16

wp.set_module_options({"enable_backward": False})


@wp.struct
class TorqueWorkspace:
    """What the joints work on in a substep; rows are environments', where there are several of a kind times as many."""

    pose: Pose
    velocity: wp.array2d(dtype=float)  # (num_envs, 69) as in JointState
    outside: wp.array2d(dtype=float)
    # the mass matrix
    pair_sums: wp.array2d(dtype=vec12)  # (num_envs, chunks of pairs)
    records: wp.array(dtype=vec16)
    pattern: Pattern
    matrix: wp.array2d(dtype=float)  # (num_envs, entries)
    diagonals: wp.array2d(dtype=float)  # (2 num_envs, 69) what factors have besides
    # (2 num_envs + 1, entries); the last one, where muscles reach their limits, is a CPU's
    factors: wp.array2d(dtype=float)
    stop: wp.array2d(dtype=float)  # (num_envs, bones) stiffness beyond the range [N m/rad]
    # what particles have
    moments: wp.array2d(dtype=vec16)  # (num_envs, chunks)
    # (num_envs, chunks) momenta of what the pull leaves, and of the ways to the particles' places, as velocities
    other_moments: wp.array2d(dtype=vec12)
    bones: wp.array2d(dtype=vec16)  # (num_envs, bones)
    linear: wp.array2d(dtype=wp.vec3)  # (3 num_envs, bones)
    angular: wp.array2d(dtype=wp.vec3)
    # (3 num_envs, 69) momenta, then changes of the velocity: the joints' own, what is taken over; and of the pose
    shares: wp.array2d(dtype=float)
    # (3 num_envs, 69) moments of an impulse on a bone along each axis, and how far they are solved for; a CPU's
    touch: wp.array2d(dtype=float)
    whole: wp.array2d(dtype=float)  # (num_envs, 69) velocity of all that acts
    # (num_envs, bones) boxes that hold the points of bones, in the rest pose: from joints to middles, half extents [m]
    middle: wp.array2d(dtype=wp.vec3)
    half: wp.array2d(dtype=wp.vec3)
    # what the joints do
    muscle: wp.array2d(dtype=float)  # (num_envs, 69) impulses
    impulse: wp.array2d(dtype=float)
    left: wp.array2d(dtype=float)  # (num_envs, 69) diagonal without muscles that have reached their limits
    # what particles get
    place: wp.array2d(dtype=wp.mat44)  # (num_envs, bones) from rest to where bones are, from the pelvis joint
    moving: wp.array2d(dtype=vec8)  # (num_envs, bones) motion of the joints
    # (num_envs, bones) what the physical velocity lacks of the whole one, and the joints' motion half-way
    steps: wp.array2d(dtype=vec12)
    slip: wp.array2d(dtype=wp.vec3)  # as in JointState
    pelvis: wp.array(dtype=wp.vec3)  # (num_envs,) where its joint begins the substep [m]


# Words of shared memory of a warp: the factor's, which have the bones' momenta until it comes; three shares, the bones'
# motion, and the pose.
_ROWS, _VECTORS = wp.constant(MOST_ROWS), wp.constant(3 * NUM_JOINTS)
_LINEAR = wp.constant(0)
_ANGULAR = wp.constant(int(_LINEAR) + 3 * int(_VECTORS))
_SHARES = wp.constant(ARENA_WORDS)
_MOVING = wp.constant(int(_SHARES) + 3 * MOST_ROWS)
_ROTATION = wp.constant(int(_MOVING) + 8 * NUM_JOINTS)
_POSITION = wp.constant(int(_ROTATION) + 4 * NUM_JOINTS)
_WORDS = -(-(int(_POSITION) + 3 * NUM_JOINTS) // 4) * 4
# Of vectors that are solved for: where they are in an arena, and words of one.
_SPARE, _COLUMN = wp.constant(SPARE), wp.constant((ARENA_WORDS - SPARE) // 3)


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
__shared__ float __align__(16) arena[{_WORDS}];
return reinterpret_cast<wp::uint64>(arena);
#else
return 0;
#endif
""")
def warp_arena() -> wp.uint64:
    """Room of a warp that has a CUDA block of its own; a factor's is at its beginning."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return there;
#else
return row;
#endif
""")
def row_in_arena(row: int, there: int) -> int:
    """Return row ``there``, where an array has several rows in a warp's arena; on a CPU ``row``."""
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
    """Return the array with its first row at word ``at`` of the arena, and rows every so many ``words``."""
    ...


@wp.func_native(_VIEW)
def view_vectors(rows: wp.array2d(dtype=wp.vec3), arena: wp.uint64, at: int, words: int) -> wp.array2d(dtype=wp.vec3):
    """Do the same as :func:`view_numbers` for vectors."""
    ...


@wp.func_native(_VIEW)
def view_rotations(rows: wp.array2d(dtype=wp.quat), arena: wp.uint64, at: int, words: int) -> wp.array2d(dtype=wp.quat):
    """Do the same as :func:`view_numbers` for rotations."""
    ...


@wp.func_native(_VIEW)
def view_motions(rows: wp.array2d(dtype=vec8), arena: wp.uint64, at: int, words: int) -> wp.array2d(dtype=vec8):
    """Do the same as :func:`view_numbers` for rigid motions."""
    ...


@wp.func
def view_columns(rows: wp.array2d(dtype=float), arena: wp.uint64):
    """Three vectors that are solved for, in the arena of a warp; on a CPU ``rows``. See :func:`place_of_triple`."""
    return view_numbers(rows, arena, _SPARE, _COLUMN)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 4 * k;
#else
return 3 * k;
#endif
""")
def place_of_triple(k: int) -> int:
    """Return where joint ``k`` begins in a column of :func:`view_columns`; the pelvis' position comes first."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
float* const to = reinterpret_cast<float*>(arena) + at;
const float* const from = reinterpret_cast<const float*>(&wp::index(position, e, 0));
for (int n = thread; n < {3 * NUM_JOINTS}; n += threads) to[n] = from[n];
#endif
""")
def load_positions(position: wp.array2d(dtype=wp.vec3), e: int, thread: int, threads: int, arena: wp.uint64, at: int):
    """Write where the joints of an environment are to the arena, from word ``at`` on."""
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
    """Write the pose of an environment to the arena."""
    ...


@wp.func
def load_workspace(w: TorqueWorkspace, e: int):
    """Return the workspace with pose, motion, momenta and shares of an environment in the arena of its warp.

    What has several rows has them as :func:`row_in_arena` says; all else has one there, whatever the environment. On a
    CPU it is the bench itself.
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


@wp.func_native(f"""
const float* const from = reinterpret_cast<const float*>(&wp::index(motion, e, 0));
float* const to = reinterpret_cast<float*>(&wp::index(steps, e, 0)) + first;
for (int n = thread; n < {6 * NUM_JOINTS}; n += threads) to[12 * (n / 6) + n % 6] = from[8 * (n / 6) + n % 6];
""")
def store_motion(
    motion: wp.array2d(dtype=vec8), e: int, first: int, thread: int, threads: int, steps: wp.array2d(dtype=vec12)
):
    """Write the motion of all bones to their records, from number ``first`` on."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
const auto keep = [&](const auto& rows, const auto& into, int words) {{
    const float* const from = reinterpret_cast<const float*>(rows.data);
    float* const to = reinterpret_cast<float*>(&wp::index(into, e, 0));
    for (int n = threadIdx.x & 31; n < words; n += 32) to[n] = from[n];
}};
keep(near.moving, w.moving, {8 * NUM_JOINTS});
keep(near.pose.rotation, w.pose.rotation, {4 * NUM_JOINTS});
keep(near.pose.position, w.pose.position, {3 * NUM_JOINTS});
#endif
""")
def store_workspace(w: TorqueWorkspace, e: int, near: TorqueWorkspace):
    """Write motion and pose from the arena, as all threads have left them."""
    ...
