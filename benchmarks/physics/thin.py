"""Soft balls thrown at thin plates, edges, poles and balls: how many hang impaled, and how many are pierced."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import runner
from benchmarks.physics.collisions import grid_spacing
from benchmarks.physics.matter import Matter, build_matter
from piavatar_envs.avatar.body.sampling import spacing_for
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.model import MaterialPoints
from piavatar_envs.sim.prop_geometry import primitive_distance, sphere

#: Radius [m] and mass [kg] of the ball.
RADIUS, MASS = 0.11, 1.5
#: Half the size of a plate, and half the length of a pole [m].
HALF = 0.4
#: How far from the collider balls begin, and the greatest distance of their path from its middle [m].
AHEAD, ASIDE = 0.03, 0.03
#: Distance of a ball's centre from the collider, below which it is pierced if it comes to the front [radii].
PIERCED = 0.35
#: Least share of a ball's particles on each side of a collider on which it hangs.
BOTH_SIDES = 0.08
#: Room around the collider [m], frames a second, and the way of the ball in the last third of a second by which it
#: hangs [m].
ROOM, RATE, STILL = 1.2, 60, 0.03


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the throws."""

    #: resolution of the grid
    fidelity: str = "coarse"
    #: thicknesses of plates that are struck at their face and edge [m]
    plates: tuple[float, ...] = (0.005, 0.01, 0.02, 0.04)
    #: diameters of poles [m]
    poles: tuple[float, ...] = (0.02, 0.04, 0.06)
    #: diameters of hard balls [m]
    spheres: tuple[float, ...] = (0.062, 0.083, 0.125)
    #: what is struck
    kinds: tuple[str, ...] = ("face", "edge", "pole", "upright", "sphere")
    #: Young's moduli of the ball [Pa]; its waves at the second are as fast as the flesh's
    moduli: tuple[float, ...] = (1.0e4, 2.7e4, 1.0e5)
    #: speeds of the ball [m/s]
    speeds: tuple[float, ...] = (3.0, 9.0)
    #: places in the grid and turns of the ball
    places: int = 24
    #: seconds that are simulated
    seconds: float = 1.5
    #: whether props have cores
    cores: bool = True


def solid(kind: str, thickness: float) -> Collider:
    """Return a collider about the origin that a ball strikes along x.

    It is the ``"face"`` or ``"edge"`` of a plate, a level ``"pole"`` along y, an ``"upright"`` one, or a ``"sphere"``.
    """
    half = 0.5 * thickness
    if kind == "upright":
        return Collider("capsule", (half, HALF), friction=0.5)
    if kind == "sphere":
        return Collider("sphere", (half,), friction=0.5)
    if kind == "pole":
        return Collider("capsule", (half, HALF), rotation=(0.5**0.5, 0.5**0.5, 0.0, 0.0), friction=0.5)
    return Collider("box", (half, HALF, HALF) if kind == "face" else (HALF, HALF, half), friction=0.5)


class Throw:
    """Balls that fly at a collider, one an environment, each elsewhere in the grid.

    Attributes:
        matter: the balls and the collider.
        front: where the collider begins along x [m].
        across: axis along which the two sides of the collider lie.
        centers: centres of the balls from the collider's after every step [m], ``(steps, places, 3)``.
        distances: their distances from the collider [m], ``(steps, places)``.
    """

    def __init__(self, options: Options, kind: str, thickness: float, modulus: float, speed: float) -> None:
        """Place the balls."""
        dx, count, rng = grid_spacing(options.fidelity), options.places, np.random.default_rng(0)
        points, collider = sphere(RADIUS, spacing_for(dx)), solid(kind, thickness)
        matter = MaterialPoints.uniform(points.volume, MASS / float(points.volume.sum()), modulus)
        self.matter: Matter = build_matter(
            [-ROOM] * 3,
            [ROOM] * 3,
            dx=dx,
            margin=0.0,
            rest=points.rest,
            points=matter,
            gravity=(0.0, 0.0, -9.81),
            colliders=[collider],
            prop=points if options.cores else None,
            num_envs=count,
            control_dt=1.0 / RATE,
            sound_speed=max(matter.sound_speed(), 1.5 * speed),
            device=options.device,
        )
        boundaries = self.matter.model.boundaries
        self._shift = rng.uniform(0.0, dx, (count, 3))
        boundaries.position.assign(self._shift[:, None].astype(np.float32))
        self.front, self.across = -collider.size[0], 1 if kind == "upright" else 2
        start = self._shift + rng.uniform(-ASIDE, ASIDE, (count, 3)) * (0.0, 1.0, 1.0)
        start[:, 0] += self.front - RADIUS - AHEAD
        turned = np.stack([turn.apply(points.rest) for turn in Rotation.random(count, random_state=0)])
        self._momentum = self.matter.totals().mass * speed
        self.matter.set(x=start[:, None] + turned, u=np.broadcast_to([speed, 0.0, 0.0], turned.shape))
        turn, local = Rotation.from_quat(np.roll(collider.rotation, -1)), (*collider.size, 0.0, 0.0)[:3]
        self._distance = lambda x: primitive_distance(collider.kind, local)(turn.inv().apply(x))
        self.centers, self.distances = np.empty((0, count, 3)), np.empty((0, count))

    @property
    def x(self) -> np.ndarray:
        """Particles from the collider's centre [m], shape ``(places, particles, 3)``."""
        return self.matter.state.x.numpy().astype(float) - self._shift[:, None]

    def run(self, seconds: float) -> Throw:
        """Advance by a time, or until all balls have left."""
        for _ in range(round(seconds * RATE)):
            now = self.matter.run().state.x.numpy().astype(float).mean(axis=1) - self._shift
            self.centers = np.concatenate([self.centers, now[None]])
            self.distances = np.concatenate([self.distances, self._distance(now)[None]])
            if (self.distances[-1] > 3.0 * RADIUS).all():
                break
        return self

    @property
    def hangs(self) -> np.ndarray:
        """Whether each ball hangs with the collider in it, shape ``(places,)``."""
        still = np.ptp(self.centers[-RATE // 3 :], axis=0).max(axis=1) < STILL
        beyond = self.x[..., 0] > self.front
        sides = [(beyond & (sign * self.x[..., self.across] > 0.0)).mean(axis=1) for sign in (-1.0, 1.0)]
        return still & (np.minimum(*sides) > BOTH_SIDES) & (self.distances[-1] < 0.75 * RADIUS)

    @property
    def pierced(self) -> np.ndarray:
        """Whether the front has come to the middle of each ball, shape ``(places,)``."""
        beyond = self.centers[..., 0] > self.front
        return ((self.distances[1:] < PIERCED * RADIUS) & beyond[1:] & ~beyond[:-1]).any(axis=0)

    @property
    def rebounds(self) -> np.ndarray:
        """Speed along x after over that before, shape ``(places,)``; -1 for what is not slowed, 0 for what stops."""
        impulse = self.matter.scratch.sensors.boundary_impulse.numpy()[:, 0, 0]  # not cleared in between
        return -impulse / self._momentum - 1.0


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each collider, modulus and speed."""
    sizes = {"face": options.plates, "edge": options.plates, "sphere": options.spheres}
    sizes |= {"pole": options.poles, "upright": options.poles}
    for kind in options.kinds:
        for thickness, modulus, speed in itertools.product(sizes[kind], options.moduli, options.speeds):
            throw = Throw(options, kind, thickness, modulus, speed).run(options.seconds)
            yield {
                "case": f"{kind} {100 * thickness:g} cm, {modulus:g} Pa, {speed:g} m/s",
                "places": options.places,
                "hang": int(throw.hangs.sum()),
                "pierced": int((throw.pierced & ~throw.hangs).sum()),
                "rebound": float(throw.rebounds.mean()),
                "nearest_radii": float(throw.distances.min() / RADIUS),
            }


if __name__ == "__main__":
    runner.main("thin", cases, Options)
