"""Readings of the world by name: bones, particles, props and contact as copies, quaternions ``wxyz``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import warp as wp

from piavatar_envs.api.arrays import Array
from piavatar_envs.sim.world import Simulation


@dataclass(frozen=True)
class Reading:
    """Quantity of the world that a view reads by name.

    Attributes:
        array_of: selects its array, ``(num_envs, ...)``; given the world and, of a bone, the index of the avatar.
        about: shape without environments, and unit.
        of_bones: whether each avatar has its own.
        of_props: whether its second dimension is the prop.
        kind: ``"quaternion"`` or ``"matrix"`` if it is stored otherwise than it is read.
    """

    array_of: Callable[[Simulation, int], wp.array]
    about: str
    of_bones: bool = False
    of_props: bool = False
    kind: str = ""

    def converted(self, values: Array, num_props: int) -> Array:
        """Convert a copy of the array to what is read."""
        if self.of_props:
            values = values[:, :num_props]  # the arrays have a column even without props
        if self.kind == "quaternion":
            return values[..., [3, 0, 1, 2]]  # Warp stores xyzw
        if self.kind == "matrix":
            return values.swapaxes(1, 2).reshape(len(values), -1, 3, 3)  # stored by component
        return values


def _bones(name: str, about: str, kind: str = "") -> Reading:
    return Reading(lambda world, agent: getattr(world.avatars[agent].tracked, name), about, of_bones=True, kind=kind)


def _particles(name: str, about: str, kind: str = "") -> Reading:
    return Reading(lambda world, _: getattr(world.state, name), about, kind=kind)


def _props(name: str, about: str, kind: str = "") -> Reading:
    return Reading(lambda world, _: getattr(world.props.state, name), about, of_props=True, kind=kind)


def _contact(name: str, about: str) -> Reading:
    return Reading(lambda world, _: getattr(world.sensors, name), about)


#: By name. Bones are in the order of ``JOINT_NAMES``; particles are those of avatars, then of props.
READINGS = {
    "bone_position": _bones("position", "(22, 3) joints [m]"),
    "bone_rotation": _bones("rotation", "(22, 4) in the world, wxyz", "quaternion"),
    "bone_local_rotation": _bones("local", "(22, 4) relative to the parent bone, wxyz", "quaternion"),
    "bone_velocity": _bones("velocity", "(22, 3) [m/s]"),
    "particle_position": _particles("x", "(particles, 3) [m]"),
    "particle_physical_velocity": _particles("u", "(particles, 3) by forces [m/s]"),
    "particle_kinematic_velocity": _particles("vk", "(particles, 3) by the commanded pose [m/s]"),
    "particle_velocity_gradient": _particles("C", "(particles, 3, 3) of the physical velocity [1/s]", "matrix"),
    "particle_deformation": _particles("F", "(particles, 3, 3) deformation gradient", "matrix"),
    "prop_position": _props("position", "(props, 3) centre of mass [m]"),
    "prop_rotation": _props("rotation", "(props, 4) wxyz", "quaternion"),
    "prop_velocity": _props("velocity", "(props, 3) [m/s]"),
    "prop_spin": _props("spin", "(props, 3) [rad/s]"),
    "prop_deformation": _props("deformation", "(props,) distance of the matter from its rest shape [m]"),
    "part_impulse": _contact("part_impulse", "(parts, subjects, 3) on a body part by a subject in the last step [N s]"),
    "boundary_impulse": _contact(
        "boundary_impulse", "(subjects, 3) by ground, walls and colliders in the last step [N s]"
    ),
    "penetration": _contact("penetration", "(subjects,) deepest particle inside another subject [m]"),
}


def find_reading(name: str) -> Reading:
    """Return the reading ``name``.

    Raises:
        ValueError: there is none.
    """
    if name not in READINGS:
        raise ValueError(f"there is no reading {name!r}; use one of {', '.join(READINGS)}")
    return READINGS[name]
