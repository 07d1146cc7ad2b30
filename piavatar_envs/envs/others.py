"""What an agent observes of props and of other agents, in the frame of its own root."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.skeleton import joint_index
from piavatar_envs.envs.observations import ObservationTerm, write_rotation, write_vector

wp.set_module_options({"enable_backward": False})

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
