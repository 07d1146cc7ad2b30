"""The supplement's acts are played and measured as told, and its command as a smoke run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import runner
from benchmarks.paper import acts, measures, supplement
from benchmarks.paper import supplement_figures as paper_figures
from benchmarks.paper.stage import Act, keyed, perform, standing
from piavatar_envs.avatar.body.skeleton import BODY_PARTS, joint_index

STUDIES = {
    "ball mass", "ball stiffness", "resistance", "several objects", "shape preservation", "limb fields", "pillow",
    "regions", "jiggle",
}  # fmt: skip


def test_a_script_passes_through_its_keys_and_holds_outside_of_them():
    script = keyed((0.5, {"left_hip": (0.0, 0.0, 0.0)}), (1.5, {"left_hip": (0.8, 0.0, 0.2), "root": (0.0, 0.0, 0.3)}))
    hip, rest = joint_index("left_hip"), standing(0.0)[1]
    for time, share in ((0.0, 0.0), (0.5, 0.0), (1.0, 0.5), (1.5, 1.0), (9.0, 1.0)):
        rotation, root = script(time)
        np.testing.assert_allclose(rotation[hip], share * np.array([0.8, 0.0, 0.2]), atol=1e-12)
        np.testing.assert_allclose(root - rest, [0.0, 0.0, 0.3 * share], atol=1e-12)
    assert 0.0 < script(0.6)[0][hip, 0] < 0.08  # eased, not linear


def test_a_course_is_what_the_script_commands(device: str):
    """Undisturbed, the tracked pose is the commanded one, and the flesh is where the bones have it."""
    script = keyed((0.0, {}), (0.2, {"left_elbow": (0.0, 0.0, -0.6), "head": (0.3, 0.0, 0.0)}))
    course = perform(Act("wave", 0.2, script=script), "tiny", device)
    assert len(course.time) == 7 and course.time[-1] == pytest.approx(0.2)
    elbow = Rotation.from_quat(course.local[-1, joint_index("left_elbow")]).as_rotvec()
    np.testing.assert_allclose(elbow, [0.0, 0.0, -0.6], atol=0.01)
    assert course.joint_errors.max() < 0.5 and not course.failed and not course.let_go
    everything = np.ones(len(course.stage.simulation.flesh[0].part), bool)
    assert course.displacements(everything)[-1].max() < 2e-3


def test_the_act_begins_with_the_prop_where_the_scene_has_it(device: str):
    act = replace(acts.throws((1e5,))[0], seconds=0.05)
    course = perform(act, "tiny", device)
    ball = act.scene.props[0]
    np.testing.assert_allclose(course.place[0, 0], ball.position, atol=1e-4)
    np.testing.assert_allclose(course.speed[0, 0], ball.velocity, atol=1e-4)
    assert course.place[-1, 0, 1] > ball.position[1] + 0.05  # it flies


def test_overlap_is_the_volume_that_both_legs_fill(device: str):
    course = perform(Act("still", 0.0), "coarse", device, steps=0)
    part, names = course.stage.simulation.flesh[0].part, list(BODY_PARTS)
    left, right = (part == names.index(f"{side}_leg") for side in ("left", "right"))
    x = course.x[0].copy()
    volume = course.stage.simulation.model.particles.volume.numpy()[0]
    assert 0.0 <= measures.overlap_volume(course, x, left, right) < 0.005 * volume[right].sum()  # they stand apart
    leg = measures.overlap_volume(course, x, left, left)
    assert leg == pytest.approx(volume[left].sum(), rel=1e-4)
    x[right] = x[left]  # legs are mirror images: as many particles
    assert 0.85 * leg < measures.overlap_volume(course, x, left, right) < leg
    x[right, 2] += 0.5 * np.ptp(x[left, 2])  # the thin lower half of one leg in the thick upper half of the other
    assert 0.15 * leg < measures.overlap_volume(course, x, left, right) < 0.5 * leg


@pytest.mark.parametrize(("values", "rising", "falling"), [((1, 2, 3), 1, 0), ((3, 2, 1), 0, 1), ((1, 3, 2), 0, 0)])
def test_trends(values: tuple[float, ...], rising: int, falling: int):
    found = [{"value": value} for value in values]
    assert supplement.rises(found, "value") == rising and supplement.falls(found, "value") == falling
    assert not supplement.rises([*found, {}], "value") and not supplement.falls([*found, {}], "value")


def test_expectations_can_fail():
    rows = [{"self_contact": fields, "peak_overlap_cm3": overlap, "error_after_deg": 1.0} for fields, overlap in
            ((True, 10.0), (False, 900.0))]  # fmt: skip
    assert supplement.judge_legs(rows)[1]
    assert not supplement.judge_legs([{**rows[0], "error_after_deg": 3.0}, rows[1]])[1]
    assert not supplement.judge_legs([{**rows[0], "peak_overlap_cm3": 200.0}, rows[1]])[1]
    soft, hard = ({"peak_dent_mm": d, "peak_impulse_n_s": j, "young_modulus_pa": e} for d, j, e in
                  ((9.0, 1.0, 1e3), (2.0, 1.5, 1e5)))  # fmt: skip
    assert supplement.judge_cans([hard, soft])[1]
    assert not supplement.judge_cans([hard, {**soft, "peak_dent_mm": 1.0}])[1]


def test_supplement_as_a_smoke_run(tmp_path: Path, device: str):
    out = tmp_path / "supplement.json"
    arguments = ["--quick", "--out", str(out), "--device", device]
    report = runner.main("supplement", supplement.cases, supplement.Options, arguments)
    rows = report["results"]
    assert json.loads(out.read_text()) == report and report["complete"]
    assert {row["study"] for row in rows} == STUDIES and len({row["case"] for row in rows}) == len(rows)
    assert all(row["normals"] == "shared" and row["resolution"] == "tiny" and not row["failed"] for row in rows)
    assert all(row["expectation"] and row["as_expected"] in (True, False) for row in rows)


def test_a_figure_as_a_smoke_run(tmp_path: Path):
    pytest.importorskip("pyvista")
    options = paper_figures.Options(folder=tmp_path, only=("several_objects",), fidelity="tiny", still=True)
    (path,) = paper_figures.main(options)
    assert 5_000 < path.stat().st_size < 250_000
    with pytest.raises(ValueError, match="limb_fields"):
        paper_figures.main(replace(options, only=("legs",)))
