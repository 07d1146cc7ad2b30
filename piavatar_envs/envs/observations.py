"""What an avatar observes of itself, and where each quantity lies in the flat vector.

What an agent observes of props and of other agents, in the frame of its own root.

What the agents of a world observe, term by term, and the launches that write it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, NUM_ACTUATED, NUM_JOINTS, joint_index
from piavatar_envs.avatar.types import Body, Tracked
from piavatar_envs.config.errors import ConfigError
from piavatar_envs.core.arrays import matrix_at
from piavatar_envs.core.cuda_intrinsics import environment_of
from piavatar_envs.mpm.materials import kirchhoff_stress, von_mises_stress
from piavatar_envs.mpm.types import Particles, Sensors, row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


_NUM_PARTS = wp.constant(len(BODY_PARTS))


@dataclass(frozen=True)
class Parameter:
    """A number that every episode draws from a range, or that may be set to anything in it.

    Attributes:
        name: by which it is told.
        unit: physical unit, ``"-"`` if it has none.
        low, high: bounds of the range, in that unit.
        description: one line.
        log: whether it is drawn, and observed, on a logarithmic scale.
    """

    name: str
    unit: str
    low: float
    high: float
    description: str
    log: bool = False

    def value(self, observed: float | np.ndarray) -> float | np.ndarray:
        """The parameter in its unit, from what is observed of it in [-1, 1]."""
        share = 0.5 * (np.asarray(observed, float) + 1.0)
        if self.log:
            return self.low * np.exp(share * math.log(self.high / self.low))
        return self.low + share * (self.high - self.low)


@dataclass(frozen=True)
class ObservationTerm:
    """A named part of the observation.

    Attributes:
        name: key in ``obs_mode="dict"``.
        size: number of components.
        unit: physical unit, ``"-"`` if it has none.
        frame: ``"world"``, ``"root"`` (origin at the pelvis, turned with it), ``"parent"`` bone, or ``"-"``.
        description: one line.
        parameters: where it holds what episodes draw: what its components mean, each normalised to [-1, 1].
    """

    name: str
    size: int
    unit: str
    frame: str
    description: str
    parameters: tuple[Parameter, ...] = field(default=(), kw_only=True)


@dataclass(frozen=True)
class PlacedTerm(ObservationTerm):
    """A term with its place in the flat vector."""

    slice: slice


#: Terms every avatar observes, in order.
SELF_TERMS: tuple[ObservationTerm, ...] = (
    ObservationTerm("root_height", 1, "m", "world", "height of the pelvis joint"),
    ObservationTerm("root_orientation", 6, "-", "world", "first two columns of the pelvis' rotation matrix"),
    ObservationTerm(
        "joint_rotations", 6 * NUM_ACTUATED, "-", "parent", "Kabsch-tracked rotations, two columns a joint"
    ),
    ObservationTerm("bone_positions", 3 * NUM_ACTUATED, "m", "root", "joint positions relative to the pelvis"),
    ObservationTerm("bone_velocities", 3 * NUM_JOINTS, "m/s", "root", "velocities of all bones, the pelvis first"),
    ObservationTerm("stress", len(BODY_PARTS), "young_modulus", "-", "peak von Mises stress of each body part"),
)

#: What tasks with contact add: impulses of the last control step by all that is not oneself.
CONTACT_TERMS: tuple[ObservationTerm, ...] = (
    ObservationTerm("contact_impulse", 3 * len(BODY_PARTS), "N s", "root", "impulse of other bodies on each body part"),
)

#: What avatars add whose joints move under torques.
JOINT_TERMS: tuple[ObservationTerm, ...] = (
    ObservationTerm("root_spin", 3, "rad/s", "root", "angular velocity of the pelvis"),
    ObservationTerm("joint_velocities", 3 * NUM_ACTUATED, "rad/s", "parent", "angular velocities of the joints"),
    ObservationTerm("ground_impulse", 3, "N s", "root", "impulse of ground, walls and colliders in the last step"),
)


class ObservationLayout(dict[str, PlacedTerm]):
    """Terms by name, in the order of the flat vector."""

    def __init__(self, terms: Iterable[ObservationTerm]) -> None:
        start = 0
        for term in terms:
            if term.name in self:
                raise ConfigError(
                    f"observation term {term.name!r} occurs twice; name props (scene.props) or the task's terms anew"
                )
            self[term.name] = PlacedTerm(**vars(term), slice=slice(start, start + term.size))
            start += term.size
        self.size = start

    def split(self, flat: np.ndarray) -> dict[str, np.ndarray]:
        """A flat observation by name: copies along the last axis."""
        return {name: flat[..., term.slice].copy() for name, term in self.items()}


@wp.func
def write_rotation(observation: wp.array3d(dtype=float), e: int, agent: int, start: int, q: wp.quat):
    """Two columns of a rotation matrix: the continuous 6D representation of Zhou et al. (CVPR 2019)."""
    x = wp.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    y = wp.quat_rotate(q, wp.vec3(0.0, 1.0, 0.0))
    for n in range(3):
        observation[e, agent, start + n] = x[n]
        observation[e, agent, start + 3 + n] = y[n]


@wp.func
def write_vector(observation: wp.array3d(dtype=float), e: int, agent: int, start: int, v: wp.vec3):
    """Three components of a vector."""
    for n in range(3):
        observation[e, agent, start + n] = v[n]


@wp.kernel
def observe_body(
    agent: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
    local: wp.array2d(dtype=wp.quat),
    # out
    observation: wp.array3d(dtype=float),
):
    """The terms of ``SELF_TERMS`` that come from the tracked bones."""
    e, b = wp.tid()
    bones = rotation.shape[1]
    to_root = wp.quat_inverse(rotation[e, 0])
    joints_at = 7
    positions_at = joints_at + 6 * (bones - 1)
    velocities_at = positions_at + 3 * (bones - 1)
    if b == 0:
        observation[e, agent, 0] = position[e, 0][2]
        write_rotation(observation, e, agent, 1, rotation[e, 0])
    else:
        write_rotation(observation, e, agent, joints_at + 6 * (b - 1), local[e, b])
        offset = wp.quat_rotate(to_root, position[e, b] - position[e, 0])
        write_vector(observation, e, agent, positions_at + 3 * (b - 1), offset)
    write_vector(observation, e, agent, velocities_at + 3 * b, wp.quat_rotate(to_root, velocity[e, b]))


@wp.kernel
def clear_stress(mask: wp.array(dtype=wp.bool), agent: int, start: int, observation: wp.array3d(dtype=float)):
    """Peaks are taken anew every control step."""
    e, part = wp.tid()
    if mask[e]:
        observation[e, agent, start + part] = 0.0


# neighbours mostly are of the same part: then a warp raises its peak once
@wp.func_native("""
wp::float32* const at = &wp::index(observation, e, agent, n);
#if defined(__CUDA_ARCH__)
int one = 0;
const unsigned together = __activemask(), bits = __float_as_uint(value) & 0x7fffffffu;  // in the order of numbers
__match_all_sync(together, (unsigned long long)at, &one);
#if __CUDA_ARCH__ >= 800
if (one) {
    const unsigned peak = __reduce_max_sync(together, bits);
    if ((threadIdx.x & 31) == __ffs(together) - 1) atomicMax((unsigned*)at, peak);
    return;
}
#endif
atomicMax((unsigned*)at, bits);
#else
if (value > *at) *at = value;
#endif
""")
def raise_peak(observation: wp.array3d(dtype=float), e: int, agent: int, n: int, value: float):
    """Make a component of the observation at least ``value``, neither of which is negative."""
    ...


@wp.kernel
def observe_stress(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    particles: Particles,
    F: wp.array3d(dtype=float),
    part: wp.array(dtype=int),
    agent: int,
    start: int,
    inverse_modulus: float,
    # out
    observation: wp.array3d(dtype=float),
):
    """Peak von Mises stress of each body part, in units of Young's modulus. A maximum does not depend on its order."""
    at = environment_of(wp.tid(), body.count)
    e = at[0]
    p = at[1]
    if not mask[e]:
        return
    q = body.first + p
    G = matrix_at(F, e, q)
    tau = kirchhoff_stress(
        particles.material[row(e, particles.material.shape[0]), q],
        G,
        particles.mu[row(e, particles.mu.shape[0]), q],
        particles.lam[row(e, particles.lam.shape[0]), q],
    )
    stress = von_mises_stress(tau, wp.determinant(G)) * inverse_modulus
    if wp.isfinite(stress):
        raise_peak(observation, e, agent, start + part[p], stress)


@wp.kernel
def observe_contact(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    sensors: Sensors,
    # out
    observation: wp.array3d(dtype=float),
):
    """Impulse on each body part by all subjects but the avatar itself; ``agent`` is its subject."""
    e, part = wp.tid()
    total = wp.vec3()
    for s in range(sensors.part_impulse.shape[2]):
        if s != agent:
            total += sensors.part_impulse[e, agent * _NUM_PARTS + part, s]
    write_vector(observation, e, agent, start + 3 * part, wp.quat_rotate(wp.quat_inverse(rotation[e, 0]), total))


@wp.kernel
def observe_joints(
    agent: int,
    start: int,
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=float),
    sensors: Sensors,
    # out
    observation: wp.array3d(dtype=float),
):
    """The terms of ``JOINT_TERMS``, from component ``start``; over ``(num_envs, bones)``."""
    e, b = wp.tid()
    frame = rotation[e, 0]
    if b > 0:
        frame = rotation[e, body.parent[b]]
    spin = wp.vec3(velocity[e, 3 + 3 * b], velocity[e, 4 + 3 * b], velocity[e, 5 + 3 * b])
    write_vector(observation, e, agent, start + 3 * b, wp.quat_rotate_inv(frame, spin))
    if b == 0:
        impulse = wp.quat_rotate_inv(frame, sensors.boundary_impulse[e, agent])
        write_vector(observation, e, agent, start + 3 * rotation.shape[1], impulse)


@wp.kernel
def clean_observation(observation: wp.array3d(dtype=float)):
    """A failed environment may hold values that are not finite; what leaves the suite never does."""
    e, agent, n = wp.tid()
    if not wp.isfinite(observation[e, agent, n]):
        observation[e, agent, n] = 0.0


def tracked_arrays(tracked: Tracked) -> list[wp.array]:
    """Inputs of :func:`observe_body` from the tracked bones."""
    return [tracked.rotation, tracked.position, tracked.velocity, tracked.local]


#: Bones of another agent that are observed.
LANDMARKS = ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle")
_LANDMARK = wp.constant(wp.types.vector(length=5, dtype=wp.int32)(*(joint_index(name) for name in LANDMARKS)))


def prop_terms(name: str) -> tuple[ObservationTerm, ...]:
    """What is observed of the prop ``name``."""
    return (
        ObservationTerm(f"{name}_position", 3, "m", "root", f"the {name} from the pelvis"),
        ObservationTerm(f"{name}_rotation", 6, "-", "root", f"turn of the {name} by Kabsch, two columns"),
        ObservationTerm(f"{name}_velocity", 3, "m/s", "root", f"velocity of the {name}"),
        ObservationTerm(f"{name}_spin", 3, "rad/s", "root", f"angular velocity of the {name}"),
        ObservationTerm(f"{name}_deformation", 1, "m", "-", f"RMS distance of the {name} from its own shape"),
    )


def other_terms(index: int) -> tuple[ObservationTerm, ...]:
    """What is observed of the agent ``index + 1`` places on."""
    name = f"other_{index}"
    return (
        ObservationTerm(f"{name}_position", 3, "m", "root", "the other's pelvis from one's own"),
        ObservationTerm(f"{name}_orientation", 6, "-", "root", "the other's pelvis, two columns"),
        ObservationTerm(f"{name}_velocity", 3, "m/s", "root", "velocity of the other's pelvis"),
        ObservationTerm(f"{name}_landmarks", 3 * len(LANDMARKS), "m", "root", f"its {', '.join(LANDMARKS)}"),
    )


@wp.kernel
def observe_prop(
    agent: int,
    start: int,
    prop: int,
    root_rotation: wp.array2d(dtype=wp.quat),
    root_position: wp.array2d(dtype=wp.vec3),
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=wp.vec3),
    spin: wp.array2d(dtype=wp.vec3),
    deformation: wp.array2d(dtype=float),
    # out
    observation: wp.array3d(dtype=float),
):
    """The terms of :func:`prop_terms`, from component ``start``."""
    e = wp.tid()
    to_root = wp.quat_inverse(root_rotation[e, 0])
    offset = position[e, prop] - root_position[e, 0]
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, offset))
    write_rotation(observation, e, agent, start + 3, to_root * rotation[e, prop])
    write_vector(observation, e, agent, start + 9, wp.quat_rotate(to_root, velocity[e, prop]))
    write_vector(observation, e, agent, start + 12, wp.quat_rotate(to_root, spin[e, prop]))
    observation[e, agent, start + 15] = deformation[e, prop]


@wp.kernel
def observe_other(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    other_rotation: wp.array2d(dtype=wp.quat),
    other_position: wp.array2d(dtype=wp.vec3),
    other_velocity: wp.array2d(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """The terms of :func:`other_terms`, from component ``start``."""
    e = wp.tid()
    to_root = wp.quat_inverse(rotation[e, 0])
    at = position[e, 0]
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, other_position[e, 0] - at))
    write_rotation(observation, e, agent, start + 3, to_root * other_rotation[e, 0])
    write_vector(observation, e, agent, start + 9, wp.quat_rotate(to_root, other_velocity[e, 0]))
    for n in range(5):
        mark = other_position[e, _LANDMARK[n]]
        write_vector(observation, e, agent, start + 12 + 3 * n, wp.quat_rotate(to_root, mark - at))


if TYPE_CHECKING:
    pass
