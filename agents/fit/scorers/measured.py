"""Physical quantities of an episode as a judge: how deep a body is dented, how fast and how long a contact is.

Without a target the quantity itself is the score, with one its distance from the target: which parameters do what was
measured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import BaseModel, Field
from scipy.spatial.transform import Rotation

from agents.fit.scorers import Unscored
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.config import FROZEN, ConfigError
from piavatar_envs.config.schema import JointName

if TYPE_CHECKING:
    from agents.fit.rollout import Episode, World

#: Least impulse of a touch in a control step [N s].
TOUCH = 1.0e-4
#: Least amplitude of a vibration [m], and least number of steps after the contact in which to find one.
LEAST_JIGGLE, LEAST_STEPS = 1.0e-5, 8
#: Zero padding of a spectrum: places between two of its independent frequencies.
PADDING = 16


class Config(BaseModel):
    """Settings of the scorer."""

    model_config = FROZEN

    quantity: Literal["indentation_depth", "rebound_speed", "contact_time", "pose_deviation", "jiggle_frequency"] = (
        Field("indentation_depth", description="what is measured; see docs/fit.md for definitions")
    )
    prop: str | None = Field(None, description="name of the prop that touches the body; null for the only one")
    joints: tuple[JointName, ...] = Field(
        ("pelvis", "spine1", "spine2"), description="bones whose flesh is measured: that of dent and jiggle"
    )
    target: float | None = Field(
        None, description="measured value, in the unit of the quantity; null to score the quantity itself"
    )


def flesh_motion(episode: Episode, chosen: np.ndarray, bone: np.ndarray) -> np.ndarray:
    """Return the displacement of particles in the frames of their bones since the reset [m].

    Args:
        episode: with positions of particles and bones, and rotations of bones.
        chosen: indices of the particles.
        bone: of each of them.

    Returns:
        Shape ``(steps + 1, particles, 3)``, in the frame of each particle's bone.
    """
    x = episode.readings["particle_position"][:, chosen].astype(np.float64)
    origin, turn = episode.readings["bone_position"][:, bone], episode.readings["bone_rotation"][:, bone]
    arm = x - origin
    frames = Rotation.from_quat(np.roll(turn.reshape(-1, 4), -1, axis=1))
    local = frames.inv().apply(arm.reshape(-1, 3)).reshape(arm.shape)
    return local - local[:1]


def dominant_frequency(signal: np.ndarray, dt: float) -> float:
    """Return the frequency at the peak of a signal's spectrum [Hz], refined by a parabola through three amplitudes.

    Args:
        signal: shape ``(steps,)``.
        dt: time between two entries [s].
    """
    steps = np.arange(len(signal))
    signal = signal - np.polyval(np.polyfit(steps, signal, 1), steps)
    size = PADDING * len(signal)
    spectrum = np.abs(np.fft.rfft(signal * np.hanning(len(signal)), size))
    first = PADDING  # a single period of the whole signal is a trend
    peak = first + int(np.argmax(spectrum[first:]))
    offset = 0.0
    if 0 < peak < len(spectrum) - 1:
        left, middle, right = spectrum[peak - 1 : peak + 2]
        bend = left - 2.0 * middle + right
        offset = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return (peak + offset) / (size * dt)


class MeasuredScorer:
    """Score of an episode by a physical quantity."""

    Config = Config
    direction = "maximize"
    pictures = 0

    def __init__(self, config: Config) -> None:
        """Choose what is read."""
        self.config = config
        self._measure, self.unit, self.readings = _QUANTITIES[config.quantity]
        if config.target is not None:
            self.direction = "minimize"

    def connect(self, world: World) -> None:
        """Find the prop and the flesh of the joints.

        Raises:
            ConfigError: there is no such prop, or no flesh.
        """
        self.dt = world.config.physics.control_dt
        if "prop_velocity" in self.readings or "part_impulse" in self.readings:
            self.prop = world.prop(self.config.prop)
            self.subject = world.subjects.index(world.props[self.prop])
        bones = [JOINT_NAMES.index(name) for name in self.config.joints]
        self.chosen = np.flatnonzero(np.isin(world.particle_bone, bones))
        if not len(self.chosen):
            raise ConfigError(
                f"scorers.measured.joints={list(self.config.joints)} have no flesh of their own; name more"
            )
        self.bone = world.particle_bone[self.chosen]

    def score(self, episode: Episode) -> float:
        """Return the quantity, or its distance from the target.

        Raises:
            Unscored: nothing touched, or nothing vibrates.
        """
        value = self._measure(self, episode)
        return value if self.config.target is None else abs(value - self.config.target)

    def touching(self, episode: Episode) -> np.ndarray:
        """Return in which control steps the prop touched the body, shape ``(steps + 1,)`` bool.

        Raises:
            Unscored: in none.
        """
        impulse = episode.readings["part_impulse"][:, :, self.subject]
        touch = np.linalg.norm(impulse.astype(np.float64), axis=-1).sum(axis=1) > TOUCH
        if not touch.any():
            raise Unscored("the prop does not touch the body")
        return touch

    def indentation_depth(self, episode: Episode) -> float:
        """Return the greatest displacement of flesh from its place on its bone [m]."""
        moved = np.linalg.norm(flesh_motion(episode, self.chosen, self.bone), axis=-1)
        return float(moved.max())

    def rebound_speed(self, episode: Episode) -> float:
        """Return the greatest speed of the prop against its direction before the contact [m/s]."""
        first = int(np.argmax(self.touching(episode)))
        velocity = episode.readings["prop_velocity"][:, self.prop].astype(np.float64)
        before = velocity[max(first - 1, 0)]
        speed = np.linalg.norm(before)
        if speed == 0.0:
            raise Unscored("the prop is at rest before the contact")
        return float((-velocity[first:] @ before / speed).max())

    def contact_time(self, episode: Episode) -> float:
        """Return the time in which the prop touches the body, in whole control steps [s]."""
        return float(self.touching(episode).sum() * self.dt)

    def pose_deviation(self, episode: Episode) -> float:
        """Return the greatest root mean square angle of all joints from the pose at the reset [rad]."""
        local = episode.readings["bone_local_rotation"].astype(np.float64)
        cosine = np.abs((local * local[:1]).sum(axis=-1)).clip(0.0, 1.0)
        angle = 2.0 * np.arccos(cosine)[:, 1:]  # the root is not a joint
        return float(np.sqrt((angle**2).mean(axis=1)).max())

    def jiggle_frequency(self, episode: Episode) -> float:
        """Return the frequency of the flesh's greatest vibration after the last contact, on its bones [Hz].

        It is that of the first principal component of all displacements, between one period of the time that is left
        and half the rate of the control steps.
        """
        touch = self.touching(episode)
        last = len(touch) - int(np.argmax(touch[::-1]))
        moved = flesh_motion(episode, self.chosen, self.bone)[last:].reshape(len(touch) - last, -1)
        if len(moved) < LEAST_STEPS:
            raise Unscored(f"{len(moved)} steps are left after the contact, too few for a frequency")
        moved = moved - moved.mean(axis=0)
        shape = np.linalg.svd(moved, full_matrices=False)[2][0]
        signal = moved @ shape
        if np.abs(signal).max() / np.sqrt(moved.shape[1] / 3) < LEAST_JIGGLE:
            raise Unscored("the flesh is at rest after the contact")
        return dominant_frequency(signal, self.dt)


_FLESH = ("particle_position", "bone_position", "bone_rotation")
#: Measurement, unit and readings of each quantity.
_QUANTITIES: dict[str, tuple[Callable[[MeasuredScorer, Episode], float], str, tuple[str, ...]]] = {
    "indentation_depth": (MeasuredScorer.indentation_depth, "m", _FLESH),
    "rebound_speed": (MeasuredScorer.rebound_speed, "m/s", ("prop_velocity", "part_impulse")),
    "contact_time": (MeasuredScorer.contact_time, "s", ("part_impulse",)),
    "pose_deviation": (MeasuredScorer.pose_deviation, "rad", ("bone_local_rotation",)),
    "jiggle_frequency": (MeasuredScorer.jiggle_frequency, "Hz", (*_FLESH, "part_impulse")),
}
SCORER = MeasuredScorer
