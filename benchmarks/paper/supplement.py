"""The experiments of the paper's supplement as numbers: bodies, balls, tone, regions, limbs, jiggling flesh.

The paper shows them as pictures and prints no figures, so every row states what was expected (``expectation``) and
whether the measurement agrees (``as_expected``, computed, of the study the row belongs to).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks import runner
from benchmarks.paper import acts, measures
from benchmarks.paper.stage import Act, Course, perform

Row = dict[str, Any]
Play = Callable[[Act], Course]
#: What is expected of the rows of a study, and whether they agree.
Verdict = tuple[str, bool]
QUICK_STEPS = 2


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the supplement."""

    #: resolution of bodies and grid
    fidelity: Literal["tiny", "coarse", "medium", "fine"] = "coarse"
    #: a smoke run: the coarsest grid, a few steps, the first and the last of every study; its figures mean nothing
    quick: bool = False


def cases(options: Options) -> Iterator[Row]:
    """Yield all rows."""
    yield from rows(options.fidelity, options.device, options.quick)


def rows(fidelity: str = "coarse", device: str = "cpu", quick: bool = False) -> Iterator[Row]:
    """Yield all rows, study by study; a study's rows come at its end, because its expectation needs them all."""
    fidelity = "tiny" if quick else fidelity

    def play(act: Act) -> Course:
        return perform(act, fidelity, device, steps=QUICK_STEPS if quick else None)

    with tempfile.TemporaryDirectory() as folder:
        for name, (plan, measure, judge) in studies(Path(folder)).items():
            chosen = plan if not quick else plan[:: max(1, len(plan) - 1)]
            found = [_row(act, measure, play, fidelity) for act in runner.progress(chosen, name)]
            expectation, agrees = judge(found)
            for row in found:
                yield {**row, "study": name, "expectation": expectation, "as_expected": agrees}


def studies(folder: Path) -> dict[str, tuple[list[Act], Callable[[Course], Row], Callable[[list[Row]], Verdict]]]:
    """Return acts, measure and judge of every study; mesh files are written into ``folder``."""
    torus, can = write_meshes(folder)
    jumps = acts.jumps()
    return {
        "ball mass": (acts.kicks(), measures.kick, judge_kicks),
        "ball stiffness": (acts.throws(), measures.throw, judge_throws),
        "resistance": (acts.head_hits(), measures.head_hit, judge_head_hits),
        "several objects": ([acts.crowd(torus)], measures.crowd, judge_crowd),
        "shape preservation": (acts.belly_dents(), measures.belly, judge_bellies),
        "limb fields": (acts.crossed_legs(), measures.legs, judge_legs),
        "pillow": (acts.pillows(), measures.pillow, judge_pillows),
        "regions": (acts.cans(can), measures.can, judge_cans),
        "jiggle": (acts.drops(), measures.jump, judge_jumps),
    } | ({"jiggle in a jump": (jumps, measures.jump, judge_jumps)} if jumps else {})


def write_meshes(folder: Path) -> tuple[Path, Path]:
    """Write mesh files of a torus of 43 cm and of a can of 12 cm."""
    import trimesh

    torus, can = folder / "torus.obj", folder / "can.obj"
    trimesh.creation.torus(0.15, 0.065, 32, 16).export(torus)
    trimesh.creation.cylinder(0.036, 0.122, sections=24).export(can)
    return torus, can


def _row(act: Act, measure: Callable[[Course], Row], play: Play, fidelity: str) -> Row:
    course = play(act)
    simulation = course.stage.simulation
    row = {
        "case": act.name,
        "normals": act.scene.contact_normals,
        "resolution": fidelity,
        "substeps": simulation.model.num_substeps,
        "particles": course.x.shape[1],
        "tone": simulation.flesh[0].control.tone,
        "failed": course.failed,
        "released": course.released,
        **act.tags,
    }
    measured = {} if course.failed else measure(course)
    return row | {name: _rounded(value) for name, value in measured.items()}


def _rounded(value: Any) -> Any:
    """Round to four digits."""
    return float(f"{value:.4g}") if isinstance(value, (float, np.floating)) else value


def rises(found: Sequence[Row], name: str) -> bool:
    """Return whether a value rises from row to row."""
    values = [row.get(name) for row in found]
    return None not in values and bool((np.diff(values) > 0.0).all())


def falls(found: Sequence[Row], name: str) -> bool:
    """Return whether a value falls from row to row."""
    return rises([{name: None if row.get(name) is None else -row[name]} for row in found], name)


def judge_kicks(found: list[Row]) -> Verdict:
    """Judge heavier and heavier balls, after the kick without one."""
    struck = [row for row in found if row["ball_kg"] is not None]
    expected = rises(found, "peak_leg_error_deg") and falls(struck, "ball_speed_m_s")
    return "a heavier ball bends the leg more and leaves more slowly", expected


def judge_throws(found: list[Row]) -> Verdict:
    """Judge stiffer and stiffer balls."""
    return "a stiffer ball is dented less", falls(found, "peak_ball_dent_mm")


def judge_head_hits(found: list[Row]) -> Verdict:
    """Judge less and less tone."""
    names = "peak_head_deg", "settled_head_deg", "settled_trunk_and_legs_deg"
    return "less resistance: more recoil, and joints that stay bent (collapse)", all(rises(found, n) for n in names)


def judge_crowd(found: list[Row]) -> Verdict:
    """Judge the act with several objects."""
    expected = all(row.get("objects_that_touched") == 4 and not row["released"] for row in found)
    return "all four objects touch the avatar, which keeps standing", expected


def judge_bellies(found: list[Row]) -> Verdict:
    """Judge rows with the physical pull, weak to strong, beside the kinematic one."""
    pulled = [row for row in found if row["shape_preservation"] == "physical"]
    return "the more shape preservation, the less of the dent is left", falls(pulled, "mean_dent_after_1_s_mm")


def judge_legs(found: list[Row]) -> Verdict:
    """Judge each pose's two rows: with limb fields first, then without."""
    agrees = []
    for own, one in zip(found[::2], found[1::2], strict=False):
        overlaps = own.get("peak_overlap_cm3"), one.get("peak_overlap_cm3")
        agrees.append(None not in overlaps and overlaps[0] < 0.1 * overlaps[1] and own["error_after_deg"] < 2.0)
    expectation = "limb fields: a tenth of the overlap or less, and the legs come back within 2 degrees"
    return expectation, bool(agrees) and all(agrees)


def judge_pillows(found: list[Row]) -> Verdict:
    """Judge stiffer and stiffer pillows."""
    expected = falls(found, "peak_pillow_dent_mm") and rises(found, "peak_impulse_n_s")
    return "a softer pillow gives way more and hits less hard", expected


def judge_cans(found: list[Row]) -> Verdict:
    """Judge each site's two rows: flesh first, then the region."""
    agrees = []
    for flesh, region in zip(found[::2], found[1::2], strict=False):
        stiffer_last = [flesh, region] if region["young_modulus_pa"] > flesh["young_modulus_pa"] else [region, flesh]
        agrees.append(falls(stiffer_last, "peak_dent_mm") and rises(stiffer_last, "peak_impulse_n_s"))
    return "softer places are dented more and take the hit more gently", bool(agrees) and all(agrees)


def judge_jumps(found: list[Row]) -> Verdict:
    """Judge softer and softer flesh; in the first row it cannot jiggle."""
    expected = rises(found, "peak_rms_mm") and all(r["rms_0.3_s_later_mm"] < 0.5 * r["peak_rms_mm"] for r in found[1:])
    return "softer and later flesh jiggles more at the landing, and is back to half within 0.3 s", expected


if __name__ == "__main__":
    runner.main("supplement", cases, Options)
