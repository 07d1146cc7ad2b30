"""Poles and edges stop limbs, whatever the control, and sensors report what they give."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.physics.poles import Options, Pole
from piavatar_envs.mpm.diagnostics import totals

pytestmark = pytest.mark.filterwarnings("ignore:collider 'pole' is")


@pytest.mark.parametrize(
    ("control", "diameter", "direction", "place"),
    [("pd", 0.04, "up", 0.45), ("pose", 0.06, "up", 0.75), ("pose", 0.12, "front", 0.25)],
)
def test_a_pole_does_not_pass_a_limb(device, control, diameter, direction, place):
    # Before bones had hulls, and contact under pose control, each of these came out on the other side of the arm.
    pole = Pole(Options(device=device), control, diameter, direction, place)
    assert not any(pole.crossed() for _ in range(20))
    assert pole.probe.sensor("boundary_impulse")[0] @ pole.toward > 1.0  # it still pushes


@pytest.mark.parametrize("control", ["pose", "limp"])
def test_sensors_report_all_that_a_pole_gives(device, control):
    probe = Pole(Options(device=device), control, 0.06, held=False).probe
    simulation, gained, turned = probe.simulation, np.zeros(3), np.zeros(3)
    before = totals(simulation.model, simulation.state)
    for _ in range(12):
        probe.step()
        gained += probe.sensor("boundary_impulse")[0]
        turned += probe.sensor("boundary_moment")[0]
    after = totals(simulation.model, simulation.state)
    scale = after.momentum_scale
    assert np.linalg.norm(gained) > 0.2 * scale
    np.testing.assert_allclose(after.momentum - before.momentum, gained, atol=1e-5 * scale)
    np.testing.assert_allclose(after.angular_momentum - before.angular_momentum, turned, atol=1e-5 * scale)


@pytest.mark.parametrize("control", ["pose", "pd"])
def test_only_solids_need_hulls(make_batch, control):
    box = {"name": "box", "kind": "box", "size": [0.2, 0.2, 0.2], "position": [1.2, 0.0, 0.5]}
    found = []
    for colliders in ([], [box]):
        batch = make_batch("PIAvatar/Reach-v0", control=control, scene={"colliders": colliders})
        found.append({launch.kernel.key for launch in batch.step_graph._launches})
    assert "find_deepest_points" in found[1]
    assert not {"find_deepest_points", "place_hulls", "stop_bones"} & found[0]
