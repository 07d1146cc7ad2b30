"""The paper's experiments: rigs against known motions, and the commands as smoke runs."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import runner
from benchmarks.paper import supplement, supplement_figures, tracking
from benchmarks.paper.stage import Act, keyed, perform
from benchmarks.physics.rig import Rig, World
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.config import PoseControlConfig
from piavatar_envs.mpm.diagnostics import totals


@pytest.fixture(scope="module")
def tiny(device: str) -> World:
    return World(fidelity="tiny", device=device)


def mean_shapes(count: int) -> np.ndarray:
    return np.zeros((count, len(load_asset().shape_names)))


def test_errors_of_a_body_that_was_moved_by_hand(tiny: World):
    rig = Rig(tiny, tracking.BARE, mean_shapes(1))
    rig.step()
    assert rig.distances().max() < 1e-5 and rig.strain().max() < 1e-4
    turn = Rotation.from_rotvec([0.0, 0.0, math.radians(3.0)])
    pelvis = rig.points.joints[0, 0]
    x = rig.state.x.numpy().copy()
    rig.state.x.assign((turn.apply(x[0] - pelvis) + pelvis + [0.02, 0.0, 0.0]).astype(np.float32)[None])
    rig.avatar.record_tracking(graph := tracking.LaunchGraph(rig.model.device), rig.state)
    graph.run()
    errors = rig.pose_errors()
    assert math.degrees(errors["root_rotation"][0]) == pytest.approx(3.0, abs=0.02)
    assert errors["root_translation"][0] == pytest.approx(0.02, abs=1e-4)
    # a rigid motion of the whole body leaves the joints where they are
    assert np.degrees(errors["relative_rotation"]).max() < 0.05 and errors["relative_translation"].max() < 1e-4
    expected = np.linalg.norm((rig.state.x.numpy() - x)[0][rig.flesh], axis=1)
    np.testing.assert_allclose(rig.distances()[0], expected, atol=1e-4)


def test_a_strike_gives_its_impulse_once_and_to_its_body_only(tiny: World):
    rig = Rig(tiny, PoseControlConfig(root="free", free_motion=False), mean_shapes(2))
    impulse = np.array([[0.0, 0.0, 0.0], [1.0, -2.0, 0.5]])
    rig.strike([joint_index("head"), joint_index("left_elbow")], impulse)
    for _ in range(2):
        found = np.array([totals(rig.model, rig.state, env).momentum for env in range(2)])
        # a GPU adds in fixed point, whose quantum follows the fastest and the heaviest particle
        np.testing.assert_allclose(found, impulse, atol=2e-5 if rig.model.device == "cpu" else 2e-4)
        rig.step()


def test_an_undisturbed_course_is_what_the_script_commands(device: str):
    script = keyed((0.0, {}), (0.2, {"left_elbow": (0.0, 0.0, -0.6), "head": (0.3, 0.0, 0.0)}))
    course = perform(Act("wave", 0.2, script=script), "tiny", device)
    assert len(course.time) == 7 and course.time[-1] == pytest.approx(0.2)
    elbow = Rotation.from_quat(course.local[-1, joint_index("left_elbow")]).as_rotvec()
    np.testing.assert_allclose(elbow, [0.0, 0.0, -0.6], atol=0.01)
    assert course.joint_errors.max() < 0.5 and not course.failed and not course.released
    everything = np.ones(len(course.stage.simulation.flesh[0].part), bool)
    assert course.displacements(everything)[-1].max() < 2e-3


def test_tracking_as_a_smoke_run(tmp_path: Path, device: str):
    """The split follows commanded poses to 0.2 mm at any resolution, and a body adrift keeps its momentum."""
    out = tmp_path / "tracking.json"
    arguments = ["--quick", "--no-pictures", "--out", str(out), "--device", device]
    report = runner.main("tracking", tracking.cases, tracking.Options, arguments)
    rows = report["results"]
    assert len({row["case"] for row in rows}) == len(rows)
    for table, distance in ((1, "mean_distance_m"), (2, "distance_m")):
        own = [row for row in rows if row["table"] == table]
        assert {row["decoupling"] for row in own} == {"split", "paper", "none"}
        split = [row for row in own if row["decoupling"] == "split" and not row["disturbed"]]
        assert split and all(row[distance] < 2e-4 for row in split)
        assert all(f"{distance}_ci95" in row for row in own)
    adrift = [row for row in rows if "momentum_error" in row]
    assert adrift and max(row["momentum_error"] for row in adrift) < 1e-4


def test_supplement_as_a_smoke_run(tmp_path: Path, device: str):
    out = tmp_path / "supplement.json"
    arguments = ["--quick", "--out", str(out), "--device", device]
    report = runner.main("supplement", supplement.cases, supplement.Options, arguments)
    rows = report["results"]
    assert json.loads(out.read_text()) == report and len({row["case"] for row in rows}) == len(rows)
    assert len({row["study"] for row in rows}) == 9 and not any(row["failed"] for row in rows)
    assert all(row["expectation"] and row["as_expected"] in (True, False) for row in rows)


def test_a_figure_as_a_smoke_run(tmp_path: Path):
    pytest.importorskip("pyvista")
    options = supplement_figures.Options(folder=tmp_path, only=("several_objects",), fidelity="tiny", still=True)
    (path,) = supplement_figures.main(options)
    assert 5_000 < path.stat().st_size < 250_000
    with pytest.raises(ValueError, match="limb_fields"):
        supplement_figures.main(replace(options, only=("legs",)))
