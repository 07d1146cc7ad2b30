"""Checks of fast and heavy hits against theory: nothing is inside anything, sensors say so, momentum is kept."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.physics.checks import Options, Quantity, at_least, at_most, check, equal
from benchmarks.physics.probe import CHEST, GRAVITY, HEAD, Probe, ball, empty
from benchmarks.physics.resolution import finer, strike

BOX = (0.2, 0.2, 0.15)  # half extents of a box [m]


def fast(options: Options, at: tuple[float, float], mass: float = 4.0, speed: float = 40.0) -> Iterator[Quantity]:
    """Throw a ball at a floating body, and look at each 240th of a second where the two are."""
    probe = Probe.under(options, "pd", held=False, control_dt=1.0 / 240.0, **empty(ball(mass, speed, at)))
    thrown, dx = probe.prop(), probe.simulation.dx
    before = probe.momentum(slice(None))
    share, depth, least, sensed = 0.0, 0.0, 1.0, 0.0
    for _ in range(round(0.12 / probe.dt)):
        probe.step()
        now = probe.overlap(thrown, probe.body)
        share, depth = max(share, now[0]), max(depth, now[1])
        least = min(least, float(probe.volume_ratio(probe.body).min()))
        sensed = max(sensed, float(probe.sensor("penetration").max()))
    lost = np.linalg.norm(probe.momentum(slice(None)) - before) / np.linalg.norm(before)
    yield at_most("share of the ball inside the body, at most", share, 0.14, theory=0.0)
    yield at_most("depth of the ball in the body, at most", depth / dx, 1.0, "dx", theory=0.0)
    yield at_least("least volume ratio J of the flesh", least, 0.3)
    yield at_most("error of the momentum, relative", lost, 1e-5, theory=0.0)
    if depth > 0.0:
        yield equal("depth by the sensor over the depth measured", sensed / depth, 1.0, 0.25)


@check("fast_chest", "ball of 4 kg at 40 m/s hits the chest (pd, floating)")
def fast_chest(options: Options) -> Iterator[Quantity]:
    """Hit the chest."""
    yield from fast(options, CHEST)


@check("fast_head", "ball of 4 kg at 40 m/s hits the head (pd, floating)")
def fast_head(options: Options) -> Iterator[Quantity]:
    """Hit the head."""
    yield from fast(options, HEAD)


@check("box_on_body", "box of 50 kg falls 0.5 m onto a lying body (torque)")
def box_on_body(options: Options) -> Iterator[Quantity]:
    """Drop a box of 40 x 40 x 30 cm on the trunk of a limp body on its back."""
    spine = Probe.of(options, "GetUp", control="torque").pose[1][[3, 6, 9]].mean(0)
    place = [float(spine[0]), float(spine[1]), 0.3 + 0.5 + BOX[2]]
    prop = {"name": "box", "shape": "box", "size": list(BOX), "mass": 50.0, "position": place, "top_speed": 6.0}
    probe = Probe.of(options, "GetUp", control="torque", scene={"props": [prop]})
    box, dx, depth, least, floor = probe.prop(), probe.simulation.dx, 0.0, 1.0, np.zeros(3)
    begun, everything = probe.momentum(slice(None)), slice(None)
    steps = round(2.0 / probe.dt)
    for step in range(steps):
        probe.step()
        floor += probe.sensor("boundary_impulse").sum(0)
        least = min(least, float(probe.volume_ratio(probe.body).min()))
        if step % 3 == 0:
            depth = max(depth, probe.overlap(box, probe.body)[1])
    yield at_most("depth of the box in the body, at most", depth / dx, 1.0, "dx", theory=0.0)
    yield at_least("least volume ratio J of the flesh", least, 0.3)
    weight = GRAVITY * steps * probe.dt * probe.mass.sum()
    carried = (floor - probe.momentum(everything) + begun)[2] / weight
    yield equal("impulse of the floor less change of momentum, over all weights", carried, 1.0, 0.001)


@check("resolution", "ball of 1.5 kg at 4 m/s hits the chest (pd, held)")
def resolution(options: Options) -> Iterator[Quantity]:
    """Compare an impact with that on a grid twice as fine."""
    own, fine = strike(options), strike(finer(options))
    yield equal("dent over that at half the grid spacing", own.dent / fine.dent, 1.0, 0.1)
    yield equal("restitution less that at half the grid spacing", own.restitution - fine.restitution, 0.0, 0.05)
    yield equal("impulse over that at half the grid spacing", own.impulse / fine.impulse, 1.0, 0.05)
