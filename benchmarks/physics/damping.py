"""Checks of what is lost in motion against theory: ringing, and results that must not follow the time step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.physics.checks import Options, Quantity, at_most, check, equal
from benchmarks.physics.probe import Probe, empty
from benchmarks.physics.resolution import strike

BAR = (0.1, 0.1, 0.3)  # half extents [m]
MODULUS, DENSITY = 1.0e5, 1000.0  # of the bar [Pa], [kg/m^3]
DAMPED, DAMPED_AT = 0.15, 25.0  # damping ratio of viscous matter, and the frequency for which it is stated [Hz]
PERIODS, SAMPLES = 6, 40  # of its first mode, and control steps in each
AMPLITUDE = 0.05  # of its velocity [m/s]
STIFF = 1.0e7  # modulus of the far prop [Pa]


@dataclass(frozen=True)
class Ring:
    """A bar's free vibration: frequency [Hz], damping ratio, substeps per control step."""

    frequency: float
    damping_ratio: float
    substeps: int


def bar_mode() -> float:
    """Return the frequency of the bar's first longitudinal mode [Hz], ``sqrt(E / rho) / (2 L)``; nu is 0."""
    return float(np.sqrt(MODULUS / DENSITY)) / (4.0 * BAR[2])


def ring(options: Options, finer: int = 1, **matter: Any) -> Ring:
    """Excite the first mode of a free bar of this ``matter`` and follow it; ``finer`` multiplies the substeps."""
    theory = bar_mode()
    dt = 1.0 / (theory * SAMPLES)
    prop = {"name": "bar", "shape": "box", "size": list(BAR), "density": DENSITY, "young_modulus": MODULUS}
    prop |= {"poisson_ratio": 0.0, "position": [-1.0, -1.0, 1.2]} | matter
    settings = {"control_dt": dt, **empty(prop)}
    probe = Probe.under(options, "pose", **settings)
    if finer > 1:
        settings["num_substeps"] = finer * probe.simulation.model.num_substeps
        probe = Probe.under(options, "pose", **settings)
    bar = probe.prop()
    mass, height = probe.mass[bar], probe.x[bar][:, 2] - probe.center(bar)[2]
    shape = np.sin(0.5 * np.pi * height / BAR[2])
    probe.give(bar, (AMPLITUDE * shape)[:, None] * [0.0, 0.0, 1.0])
    speed, energy = [], []
    for _ in range(PERIODS * SAMPLES):
        probe.step()
        v = probe.velocity[bar]
        speed.append(mass * v[:, 2] @ shape / (mass @ shape**2))
        energy.append(0.5 * mass @ (v**2).sum(1) + probe.elastic_energy(bar))
    speed, time = np.array(speed), dt * np.arange(1, len(speed) + 1)
    turns = np.flatnonzero(np.diff(np.sign(speed)))
    zeros = time[turns] - speed[turns] * dt / (speed[turns + 1] - speed[turns])
    decay = -np.polyfit(time, np.log(energy), 1)[0]  # of the energy, twice that of the amplitude [1/s]
    frequency = 0.5 / np.diff(zeros).mean()
    return Ring(float(frequency), float(decay / (4.0 * np.pi * theory)), probe.simulation.model.num_substeps)


@check("ring", "free elastic bar of 20 x 20 x 60 cm rings in its first mode")
def ringing(options: Options) -> Iterator[Quantity]:
    """Compare frequency and damping with an elastic bar's, which has no damping, at two time steps."""
    once, finer = ring(options), ring(options, 4)
    yield equal("frequency over theory", once.frequency / bar_mode(), 1.0, 0.02)
    yield at_most("damping ratio", once.damping_ratio, 0.01, theory=0.0)
    change = abs(finer.damping_ratio - once.damping_ratio)
    yield at_most("change of the damping ratio with 4 times the substeps", change, 0.005, theory=0.0)
    viscous = ring(options, damping_ratio=DAMPED)
    theory = DAMPED * bar_mode() / DAMPED_AT
    name = f"damping ratio of matter with {DAMPED:g} at {DAMPED_AT:g} Hz, less the grid's"
    yield equal(name, viscous.damping_ratio - once.damping_ratio, theory, 0.05 * theory)


@check("time_step", "ball of 1.5 kg at 4 m/s rebounds from the chest (pose)")
def time_step(options: Options) -> Iterator[Quantity]:
    """Compare restitution and dent with those beside an unrelated stiff prop, and with twice the substeps."""
    plain = strike(options, control="pose")
    far = {"name": "far", "size": [0.1], "density": 1000.0, "young_modulus": STIFF, "position": [-1.3, -1.3, 1.2]}
    others = {
        f"with a prop of {STIFF:.0e} Pa far away": strike(options, "chest", far, control="pose"),
        "with twice the substeps": strike(options, control="pose", num_substeps=2 * plain.substeps),
    }
    for how, other in others.items():
        yield equal(f"restitution {how}, relative", other.restitution / plain.restitution, 1.0, 0.05)
        yield equal(f"dent {how}, relative", other.dent / plain.dent, 1.0, 0.05)
