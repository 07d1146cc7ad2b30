"""Settings that may change while a world runs: stiffness of the flesh, friction of the ground, gravity, tone and alpha.

Moduli and friction lie in arrays that every step reads, and are written in place. Gravity, tone and alpha are arguments
of recorded launches: their steps are recorded anew. The time step stays, so that whatever would need a shorter one is
refused with the reason, and needs a world of its own. What a substep damps stays with it, also in softer flesh, whose
own world would retain more (:mod:`piavatar_envs.mpm.retention`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar.pose_control.controller import PoseController
from piavatar_envs.avatar.pose_control.resistance import ResistingPoseController
from piavatar_envs.config import replace
from piavatar_envs.config.schema import UNCHANGED
from piavatar_envs.sim.bodies import pose_control

if TYPE_CHECKING:
    from piavatar_envs.sim.world import Simulation

STIFFNESS, FRICTION, GRAVITY = "physics.young_modulus", "physics.friction", "physics.gravity"
TONE, ALPHA = "control.tone", "control.alpha"
#: Settings that :class:`Tuning` changes.
TUNABLE = (STIFFNESS, FRICTION, GRAVITY, TONE, ALPHA)


@dataclass
class Tuning:
    """Changes settings of a running world.

    Attributes:
        simulation: the world.
        values: present values of the settings, by name; those that the control lacks are missing.
    """

    simulation: Simulation

    def __post_init__(self) -> None:
        simulation, config = self.simulation, self.simulation.config
        physics, control = config.physics, config.control
        self.values = {STIFFNESS: physics.young_modulus, FRICTION: physics.friction, GRAVITY: physics.gravity}
        if control.mode == "pose":
            self.values |= {TONE: control.tone, ALPHA: control.alpha}
        self._built = dict(self.values)
        particles = simulation.model.particles
        self._moduli = {name: getattr(particles, name).numpy().copy() for name in ("mu", "lam")}

    def refusal(self, name: str, value: float) -> str | None:
        """Return the reason why a setting cannot take a value in this world; None where it can."""
        config, simulation = self.simulation.config, self.simulation
        if name not in self.values:
            return f"control={config.control.mode!r} has no {name.partition('.')[2]}"
        if name == STIFFNESS and config.randomize.stiffness_factor != UNCHANGED:
            return "every episode draws the stiffness"
        if name == STIFFNESS and value > self._built[name]:
            return "stiffer flesh needs a shorter time step"
        if name == FRICTION and config.randomize.ground_friction_factor != UNCHANGED:
            return "every episode draws the friction of the ground"
        if name == FRICTION and not simulation.scene.ground:
            return "the scene has no ground"
        if name == GRAVITY and simulation.garments:
            return "garments have their own constant of gravity"
        if name == GRAVITY and value > self._built[name] and simulation.props:
            return "props that fall faster need a shorter time step"
        if name == ALPHA and any(isinstance(own, ResistingPoseController) for own in simulation.controllers):
            return "joints that resist have held their flesh by it from the start"
        if name == ALPHA and any(len(flesh.shape_rates(simulation.model)) for flesh in simulation.flesh):
            return "regions of the body have their own alpha"
        return None

    def set(self, values: Mapping[str, float]) -> bool:
        """Change settings, each without a :meth:`refusal`.

        Args:
            values: by name.

        Returns:
            Whether the launches of a control step have to be recorded anew.

        Raises:
            ConfigError: a value is out of range; nothing has changed then.
            ValueError: a value is refused; nothing has changed then.
        """
        replace(self.simulation.config, dict(values))
        for name, value in values.items():
            if reason := self.refusal(name, value):
                raise ValueError(f"{name}={value:g} needs an environment of its own: {reason}")
        changed = {name: value for name, value in values.items() if value != self.values[name]}
        self.values |= changed
        if STIFFNESS in changed:
            self._scale_moduli(changed[STIFFNESS] / self._built[STIFFNESS])
        if FRICTION in changed:
            self._set_friction(changed[FRICTION])
        if GRAVITY in changed:
            self.simulation.model.step.gravity = wp.vec3(0.0, 0.0, -changed[GRAVITY])
        again = changed.keys() & {GRAVITY, TONE, ALPHA}
        if again:
            self._set_control()
        return bool(again)

    def _scale_moduli(self, factor: float) -> None:
        """Set the moduli of all flesh to a factor times those that it was built with."""
        for name, built in self._moduli.items():
            array = getattr(self.simulation.model.particles, name)
            values = array.numpy().copy()
            for avatar in self.simulation.avatars:
                own = slice(avatar.body.first, avatar.body.first + avatar.body.count)
                values[:, own] = factor * built[:, own]
            array.assign(values)

    def _set_friction(self, friction: float) -> None:
        """Set the friction of avatars on the ground, the first collider."""
        array = self.simulation.model.boundaries.friction
        subjects = np.array(self.simulation.subjects.fields.subject)
        values = array.numpy().copy()
        of_fields = values.reshape(len(values), len(subjects), -1)  # (rows, fields, colliders)
        of_fields[:, subjects < len(self.simulation.avatars), 0] = friction
        array.assign(values)

    def _set_control(self) -> None:
        """Set tone, alpha and gravity of the pose controllers."""
        simulation = self.simulation
        for flesh, controller in zip(simulation.flesh, simulation.controllers, strict=True):
            if isinstance(controller, PoseController | ResistingPoseController):
                settings = {"tone": self.values[TONE], "alpha": self.values[ALPHA]}
                control = flesh.control.model_copy(update=settings)
                controller.parameters = pose_control(control, simulation.model)
