"""Terms of the observation: names, units, frames, and their places in the flat vector.

An agent observes itself, then props and other agents in the frame of its own root, then the terms of the task.
:mod:`piavatar_envs.envs.observer` has the kernels that write them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, NUM_ACTUATED, NUM_JOINTS
from piavatar_envs.config.errors import ConfigError
from piavatar_envs.sim.randomize import Parameter

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class ObservationTerm:
    """A named part of the observation.

    Attributes:
        name: key in ``obs_mode="dict"``.
        size: number of components.
        unit: physical unit, ``"-"`` if it has none.
        frame: ``"world"``, ``"root"`` (origin at the pelvis, turned with it), ``"parent"`` bone,
            the ``"bone"`` itself, or ``"-"``.
        description: one line.
        parameters: the drawn parameters that its components hold, each normalised to [-1, 1]; empty for other terms.
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


#: Terms that every avatar observes, in order.
SELF_TERMS: tuple[ObservationTerm, ...] = (
    ObservationTerm("root_height", 1, "m", "world", "height of the pelvis joint"),
    ObservationTerm("root_orientation", 6, "-", "world", "first two columns of the pelvis' rotation matrix"),
    ObservationTerm(
        "joint_rotations", 6 * NUM_ACTUATED, "-", "parent", "Kabsch-tracked rotations, two columns per joint"
    ),
    ObservationTerm("bone_positions", 3 * NUM_ACTUATED, "m", "root", "joint positions relative to the pelvis"),
    ObservationTerm("bone_velocities", 3 * NUM_JOINTS, "m/s", "root", "velocities of all bones, the pelvis first"),
    ObservationTerm("stress", len(BODY_PARTS), "young_modulus", "-", "peak von Mises stress of each body part"),
)

#: Terms of tasks with contact: impulses of the last control step by all other subjects.
CONTACT_TERMS: tuple[ObservationTerm, ...] = (
    ObservationTerm("contact_impulse", 3 * len(BODY_PARTS), "N s", "root", "impulse of other bodies on each body part"),
)

#: Terms of avatars under torque control.
JOINT_TERMS: tuple[ObservationTerm, ...] = (
    ObservationTerm("root_spin", 3, "rad/s", "root", "angular velocity of the pelvis"),
    ObservationTerm("joint_velocities", 3 * NUM_ACTUATED, "rad/s", "parent", "angular velocities of the joints"),
    ObservationTerm("ground_impulse", 3, "N s", "root", "impulse of ground, walls and colliders in the last step"),
)


class ObservationLayout(dict[str, PlacedTerm]):
    """Terms by name, in the order of the flat vector."""

    def __init__(self, terms: Iterable[ObservationTerm]) -> None:
        """Place the terms one after the other.

        Raises:
            ConfigError: a name occurs twice.
        """
        start = 0
        for term in terms:
            if term.name in self:
                raise ConfigError(
                    f"observation term {term.name!r} occurs twice; rename a prop (scene.props) or a term of the task"
                )
            self[term.name] = PlacedTerm(**vars(term), slice=slice(start, start + term.size))
            start += term.size
        self.size = start

    def split(self, flat: np.ndarray) -> dict[str, np.ndarray]:
        """Split a flat observation along its last axis into copies by name."""
        return {name: flat[..., term.slice].copy() for name, term in self.items()}


@wp.func
def write_rotation(observation: wp.array3d(dtype=float), e: int, agent: int, start: int, q: wp.quat):
    """Write two columns of a rotation matrix, the continuous 6D representation of Zhou et al. (CVPR 2019)."""
    x = wp.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    y = wp.quat_rotate(q, wp.vec3(0.0, 1.0, 0.0))
    for n in range(3):
        observation[e, agent, start + n] = x[n]  # type: ignore[index]
        observation[e, agent, start + 3 + n] = y[n]  # type: ignore[index]


@wp.func
def write_vector(observation: wp.array3d(dtype=float), e: int, agent: int, start: int, v: wp.vec3):
    """Write the three components of a vector."""
    for n in range(3):
        observation[e, agent, start + n] = v[n]


#: Observed bones of another agent.
LANDMARKS = ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle")


def prop_terms(name: str) -> tuple[ObservationTerm, ...]:
    """Return the terms of the prop ``name``."""
    return (
        ObservationTerm(f"{name}_position", 3, "m", "root", f"the {name} from the pelvis"),
        ObservationTerm(f"{name}_rotation", 6, "-", "root", f"turn of the {name} by Kabsch, two columns"),
        ObservationTerm(f"{name}_velocity", 3, "m/s", "root", f"velocity of the {name}"),
        ObservationTerm(f"{name}_spin", 3, "rad/s", "root", f"angular velocity of the {name}"),
        ObservationTerm(f"{name}_deformation", 1, "m", "-", f"RMS distance of the {name} from its own shape"),
    )


def other_terms(index: int) -> tuple[ObservationTerm, ...]:
    """Return the terms of the agent ``index + 1`` places on, counted from the observing agent."""
    name = f"other_{index}"
    return (
        ObservationTerm(f"{name}_position", 3, "m", "root", "the other's pelvis from one's own"),
        ObservationTerm(f"{name}_orientation", 6, "-", "root", "the other's pelvis, two columns"),
        ObservationTerm(f"{name}_velocity", 3, "m/s", "root", "velocity of the other's pelvis"),
        ObservationTerm(f"{name}_landmarks", 3 * len(LANDMARKS), "m", "root", f"its {', '.join(LANDMARKS)}"),
    )
