"""Poles that are driven across an outstretched arm: how often a bone of it ends on their other side."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import runner
from benchmarks.physics import checks
from benchmarks.physics.probe import EMPTY, Probe
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import ConfigError

#: Half the length of a pole, and its gap from the arm's axis at the start, less its radius [m].
HALF_LENGTH, AHEAD = 0.25, 0.1
#: Directions in which poles move, before their part along the arm is taken out.
DIRECTIONS = {"up": (0.0, 0.0, 1.0), "back": (0.0, 1.0, 0.0), "front": (0.0, -1.0, 0.0)}
#: Where poles meet the arm, as shares of the way from shoulder to wrist.
PLACES = (0.25, 0.45, 0.62, 0.75, 0.9)
#: Settings of each control.
CONTROLS: dict[str, tuple[str, dict[str, Any]]] = {
    "pose": ("pose", {}),
    "pd": ("pd", {}),
    "limp": ("pd", {"preset": "limp"}),
}


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the poles."""

    #: resolution of the body
    fidelity: str = "coarse"
    #: diameters of the poles [m]
    diameters: tuple[float, ...] = (0.02, 0.04, 0.06, 0.12)
    #: controls of the body
    controls: tuple[str, ...] = tuple(CONTROLS)
    #: speed of the poles [m/s]
    speed: float = 0.75
    #: how far poles move [m]
    way: float = 0.75


class Pole:
    """A capsule that moves across the left arm of a body.

    Attributes:
        probe: the body.
        along, toward: axis of the pole, and the direction in which it moves.
    """

    def __init__(
        self,
        options: Options,
        control: str,
        diameter: float,
        direction: str = "up",
        place: float = 0.75,
        held: bool = True,
    ) -> None:
        """Put the pole below, before or behind the arm; ``held`` says whether the pelvis is.

        Raises:
            ConfigError: it would begin in the body.
        """
        mode, own = CONTROLS[control]
        world = checks.Options(device=options.device, fidelity=options.fidelity)
        joints = Probe.under(world, "pose", **EMPTY).pose[1]
        shoulder, wrist = (joints[joint_index(f"left_{name}")] for name in ("shoulder", "wrist"))
        arm = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
        toward = np.array(DIRECTIONS[direction]) - (np.array(DIRECTIONS[direction]) @ arm) * arm
        self.toward = toward / np.linalg.norm(toward)
        self.along = np.cross(arm, self.toward)
        frame = np.stack([self.toward, np.cross(self.along, self.toward), self.along], axis=1)
        start = shoulder + place * (wrist - shoulder) - (AHEAD + 0.5 * diameter) * self.toward
        pole = {
            "name": "pole",
            "kind": "capsule",
            "size": [0.5 * diameter, HALF_LENGTH],
            "position": start.tolist(),
            "rotation": np.roll(Rotation.from_matrix(frame).as_quat(), 1).tolist(),
            "velocity": (options.speed * self.toward).tolist(),
            "friction": 0.5,
        }
        scene = {"ground": False, "colliders": [pole]}
        self.probe = Probe.under(world, mode, held, gravity=0.0, scene=scene, **own)
        self._sides: dict[int, tuple[float, bool]] = {}

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Both ends of the pole's axis [m]."""
        center = self.probe.simulation.model.boundaries.position.numpy()[0, 0].astype(float)
        return center - HALF_LENGTH * self.along, center + HALF_LENGTH * self.along

    def crossed(self) -> bool:
        """Take a control step, and return whether a bone between two joints of the arm has passed the pole's axis."""
        self.probe.step()
        joints, found = self.probe.pose[1], False
        names = ("left_collar", "left_shoulder", "left_elbow", "left_wrist")
        for index, (first, last) in enumerate(itertools.pairwise(names)):
            bone = joints[joint_index(first)], joints[joint_index(last)]
            side, beside = side_of(self.ends, bone)
            before = self._sides.get(index, (side, False))
            found |= side != before[0] and (beside or before[1])
            self._sides[index] = side, beside
        return found


def side_of(pole: Sequence[np.ndarray], bone: Sequence[np.ndarray]) -> tuple[float, bool]:
    """Return the side on which a bone passes a pole, 1 or -1, and whether both are beside each other there."""
    d1, d2, between = pole[1] - pole[0], bone[1] - bone[0], pole[0] - bone[0]
    side = float(np.sign(np.cross(d1, d2) @ -between))
    a, b, c = d1 @ d1, d1 @ d2, d2 @ d2
    shares = np.linalg.solve([[a, -b], [-b, c]], [-d1 @ between, d2 @ between])
    return side, bool((shares > 0.0).all() and (shares < 1.0).all())


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each control and diameter."""
    for control in options.controls:
        for diameter in options.diameters:
            tried, crossed = 0, []
            for direction in DIRECTIONS:
                for place in PLACES:
                    try:
                        pole = Pole(options, control, diameter, direction, place)
                    except ConfigError:  # it would begin in the trunk
                        continue
                    tried += 1
                    steps = round(options.way / options.speed / pole.probe.dt)
                    if any(pole.crossed() for _ in range(steps)):
                        crossed.append(f"{direction} {place:g}")
            yield {
                "case": f"{control} {100 * diameter:g} cm",
                "control": control,
                "diameter_m": diameter,
                "tried": tried,
                "crossed": len(crossed),
                "which": crossed,
            }


if __name__ == "__main__":
    runner.main("poles", cases, Options)
