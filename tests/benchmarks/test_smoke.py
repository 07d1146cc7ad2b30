"""Benchmarks of speed, physics, the paper and learning as smoke runs: rows that fit each other and known motions."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agents import files
from benchmarks import runner
from benchmarks.paper import acts, disturbance, figures, measures, supplement, tracking
from benchmarks.paper.stage import Act, keyed, perform
from benchmarks.physics import blows, contact, elastodynamics, regions, sources, stability, torque, wear
from benchmarks.physics.limbs import Options
from benchmarks.physics.rig import Rig, World
from benchmarks.speed import cpu, failures, pixels, plain_mpm, profile, soak, steps, vector
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.config import PoseControlConfig
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.mpm.types import FAILURE_CFL
from piavatar_envs.tasks import task_modules
from scripts.synthetic_character import character


def run(module: ModuleType, path: Path, device: str, *arguments: str) -> list[dict]:
    """Run a benchmark from its command line and return the rows that its file holds."""
    name = module.__name__.rpartition(".")[2]
    report = runner.main(name, module.cases, module.Options, [*arguments, "--out", str(path), "--device", device])
    assert json.loads(path.read_text()) == report and report["complete"]
    return report["results"]


def check_finite(rows: list[dict]) -> None:
    """Assert that there are rows, all of finite numbers and without failures."""
    numbers = [v for row in rows for v in row.values() if isinstance(v, (int, float, np.number))]
    assert rows and all(map(math.isfinite, numbers)) and not any(row.get("failed") for row in rows)


def test_pictures_are_counted(tmp_path, device):
    arguments = ("--fidelity", "tiny", "--seconds", "0.01", "--repeats", "1", "--num-envs", "2", "--sizes", "16")
    (row,) = run(pixels, tmp_path / "pixels.json", device, *arguments, "--worlds", "PIAvatar/Reach-v0")
    assert row["refused"] is None and (row["num_envs"], row["size"]) == (2, 16)
    assert min(row[name] for name in ("frames_per_s", "drawing_only", "without_pixels", "with_autoreset")) > 0.0
    assert len(row["drawing_ms_by_kernel"]) > 5 and row["launches_of_drawing"] > 5


def test_avatars_of_a_source_act_at_random(tmp_path, device):
    arguments = ("--fidelity", "tiny", "--num-envs", "3", "--steps", "3", "--worlds", "PIAvatar/Reach-v0", "sumo_v0")
    rows = run(sources, tmp_path / "sources.json", device, *arguments)
    check_finite(rows)
    assert [(row["source"], row["agents"], row["failures"], row["nonfinite"]) for row in rows] == [
        ("embedded", agents, {}, 0) for agents in (1, 2)
    ]
    chosen = ("avatar.source=gaussian", "avatar.path=a.glb")
    assert sources.settings_of("a.glb#gaussian") == ("gaussian", chosen)


def test_a_can_dents_soft_hair_more(tmp_path, device):
    hero = character(thick=True).save(tmp_path / "hero.glb")
    rows = run(regions, tmp_path / "regions.json", device, str(hero), "--fidelity", "tiny")
    check_finite(rows)
    dents = {(row["site"], row["material"]): row["peak_dent_mm"] for row in rows}
    assert len(dents) == 6 and dents["hair", "region"] > 2.0 * dents["hair", "flesh"]


def test_vector_rates_are_consistent(tmp_path, device):
    arguments = ["--fidelity", "tiny", "--num-envs", "1", "3", "--seconds", "0.01", "--repeats", "1"]
    worlds = ("PIAvatar/Reach-v0", "sumo_v0")
    rows = run(vector, tmp_path / "vector.json", device, *arguments, "--worlds", *worlds)
    batches = [row for row in rows if row["case"] != "cpu_scaling"]
    assert [(row["case"], row["num_envs"]) for row in batches] == [(w, n) for w in worlds for n in (1, 3)]
    for row in batches:
        assert row["refused"] is None and row["failed_envs"] == 0 and row["mb_per_env"] > 0.0
        product = row["env_steps_per_s"] * row["particles"] * row["substeps"]
        assert row["particle_substeps_per_s"] == pytest.approx(product)
        assert min(row["step_only"], row["with_autoreset"]) > 0.0


def test_a_stepper_restarts_ended_episodes_and_counts_failures(device):
    batch = BatchEnv(vector.make_task("PIAvatar/Reach-v0", "tiny"), 3, device)
    batch.reset()
    stepper = vector.Stepper(batch)
    stepper.step()
    batch.step_count.assign(np.array([1, batch.max_steps - 1, 1], np.int32))
    stepper.step()
    stepper.step()
    assert batch.step_count.numpy().tolist() == [3, 1, 3] and stepper.failed.numpy()[0] == 0
    batch.failure.assign(np.array([0, 0, FAILURE_CFL], np.int32))
    stepper.step()  # ends the episode
    stepper.step()
    assert stepper.failed.numpy()[0] == 1
    assert batch.step_count.numpy().tolist() == [5, 3, 1] and not batch.failure.numpy().any()


def test_profile_shares_add_up(tmp_path, device):
    small = ["--fidelity", "tiny", "--num-envs", "2", "--repeats", "2"]
    step, *kernels = run(profile, tmp_path / "profile.json", device, *small)
    assert step["case"] == profile.STEP and step["failed_envs"] == 0 and step["ms_per_step"] > 0.0
    assert sum(row["share"] for row in kernels) == pytest.approx(1.0)


def test_a_soak_run_continues_where_it_was_stopped(tmp_path, device):
    out = tmp_path / "soak.json"
    small = ["--fidelity", "tiny", "--num-envs", "1", "--steps", "6", "--window", "2"]
    first = run(soak, out, device, *small)
    assert first[-1]["case"] == "verdict" and first[-1]["failed_envs"] == 0
    arrays = [row["arrays_mb"] for row in first[:-1]]
    assert max(arrays) - min(arrays) < 0.01  # a step allocates nothing
    files.write_json(out, json.loads(out.read_text()) | {"complete": False, "results": first[:2]})
    again = run(soak, out, device, *small)
    assert again[:2] == first[:2]
    assert [(row["steps"], row["process"]) for row in again[:-1]] == [(2, 0), (4, 0), (6, 1)]
    files.write_json(out, json.loads(out.read_text()) | {"complete": False, "results": first[:2]})
    with pytest.raises(ValueError, match="options"):
        run(soak, out, device, *small, "--steps", "8")


def test_failures_are_counted_by_control_mode(tmp_path, device):
    small = ["--fidelity", "tiny", "--num-envs", "2", "--env-steps", "5"]
    rows = run(
        failures, tmp_path / "failures.json", device, "--worlds", "PIAvatar/Stand-v0", "PIAvatar/Reach-v0", *small
    )
    assert [row["case"].split()[1] for row in rows] == 2 * ["pose", "pd", "torque"]
    steps = [row["env_steps"] for row in rows if row["refused"] is None]
    assert len(steps) >= 4 and set(steps) == {6}
    assert all(row["failures"]["cfl"] == 0 and row["limited_share_max"] < 0.05 for row in rows if not row["refused"])


def test_cpu_rates_are_consistent(tmp_path, monkeypatch):
    monkeypatch.setattr(cpu, "ENVIRONMENTS", {"PIAvatar/Reach-v0": 10})
    monkeypatch.setattr(cpu, "_in_own_process", lambda function, *arguments: function(*arguments[:-1], None))
    reach, stages = run(cpu, tmp_path / "cpu.json", "cpu", "--quick")
    product = reach["env_steps_per_s"] * reach["particles"] * reach["substeps"] * reach["us_per_particle_substep"]
    assert product == pytest.approx(1e6) and 0.0 < reach["cfl"] <= 0.5
    assert set(cpu.CONTINUUM) <= set(stages["stages_ms"])


def test_steps_rates_are_consistent(tmp_path, device, monkeypatch):
    monkeypatch.setattr(steps, "_in_own_process", lambda cold, *arguments: steps.measure(*arguments))
    rows = run(steps, tmp_path / "steps.json", device, "--small", "--num-envs", "1", "2")
    through = [(row["through"].partition(",")[0], row["num_envs"]) for row in rows]
    assert through == [("gym.make", 1), ("gym.make_vec", 2), ("sumo_v0.parallel_env", 1)]
    for row in rows:
        assert row["ms_per_step"] == pytest.approx(row["ms_per_substep"] * row["substeps"])
        assert row["ms_per_step"] * row["env_steps_per_s"] == pytest.approx(1e3 * row["num_envs"])
        assert min(row["first_make_s"], row["arrays_mb"]) > 0.0 and row["failed_envs"] == 0
    assert rows[2]["particles"] == 4 * rows[0]["particles"]


def test_the_plain_method_falls_as_gravity_says(device):
    x = plain_mpm.boxes(500, plain_mpm.SIZE / 32)
    method = plain_mpm.WarpMPM(x, 32, device, substeps=50)
    method.run()
    before = method.positions().copy()
    method.run()
    # n substeps from rest at semi-implicit steps: g dt^2 n (n + 1) / 2; a GPU has run once more before the capture
    runs = (1, 2) if device == "cpu" else (2, 3)
    fall = [plain_mpm.GRAVITY * plain_mpm.DT**2 * n * (n + 1) / 2.0 for n in (50 * count for count in runs)]
    moved = (before - method.positions())[:, 2].mean()
    assert moved == pytest.approx(fall[1] - fall[0], rel=1e-2)


@pytest.mark.parametrize("hold", blows.HOLDS)
def test_bodies_under_torques_exchange_momentum_with_balls_and_keep_their_own(device, hold):
    options = Options(device=device, fidelity="tiny", steps=3, refresh=1, halvings=1, poses=1)
    floats = [torque.flail(options, torque.RATE, hold), torque.flail_under_pd(options, "", hold)]
    for row in floats:
        assert row["momentum_scale"] > 1.0
        assert max(row["linear_momentum_rel"], row["angular_momentum_rel"]) < 1e-5
    # heavier balls bend joints more, stiffer joints bend less; an elastic wall would take 2 m v
    balls = [[blows.hit(options, mass, kp, hold) for kp in (100.0, 1000.0)] for mass in (0.45, 8.0)]
    peak = np.array([[row["peak_deg"] for row in rows] for rows in balls])
    assert np.all(np.diff(peak, axis=0) > 0.0) and np.all(np.diff(peak, axis=1) < 0.0)
    for mass, (row, _) in zip((0.45, 8.0), balls, strict=True):
        assert row["mismatch_rel"] < 1e-4 and 0.5 < row["ball_lost_n_s"] / (mass * 5.0) < 2.0
    kicks = []
    for held in (False, True):
        kicks.append(blows.kick(options, 1.5, held, hold, blows.swing(options, held, hold)))
        assert kicks[-1]["ball_n_s"] > 1.0 and kicks[-1]["mismatch_rel"] < 1e-4
        assert kicks[-1]["pelvis_recoil_m_s"] > 0.01 and (kicks[-1]["support_n_s"] > 1.0) == held
    others = [torque.stretch_arms(options, 200.0, hold), torque.press(options, 20.0, hold), torque.cost(options, hold)]
    others += [wear.on_floor(options, "falling", hold)]
    check_finite([*floats, *balls[0], *balls[1], *kicks, *others])


def test_stability_limits_are_found(device):
    options = Options(device=device, fidelity="tiny", steps=3, refresh=1, halvings=1, poses=1)
    check_finite([next(stability.cases(options))])


def test_shared_normals_keep_momentum_and_gain_no_energy(device):
    if device != "cpu":
        pytest.skip("a smoke run; the benchmark itself runs on a GPU with --device")
    rows = list(contact.cases(contact.Options(quick=True, only_contact=True)))
    check_finite(rows)
    assert {row["normals"] for row in rows} == {"shared", "own"}
    kept = [row for row in rows if row["normals"] == "shared" and "linear_momentum_rel" in row]
    assert kept and all(row["linear_momentum_rel"] < 1e-5 and row["angular_momentum_rel"] < 1e-5 for row in kept)
    assert all(row["energy_ratio_max"] <= 1.01 for row in kept)


def test_elastodynamics_has_a_row_for_every_case(device, monkeypatch):
    """Leave out the balls: ``tests/mpm/test_elastodynamics.py`` holds each case against theory."""
    monkeypatch.setattr(elastodynamics, "ball_impact", lambda cells, *_, **__: {"cells": cells})
    rows = list(elastodynamics.cases(elastodynamics.Options(quick=True, device=device)))
    check_finite(rows)
    assert {"bar", "cantilever", "bar on wall", "ball on plane"} <= {row["case"] for row in rows}


@pytest.fixture(scope="module")
def tiny(device: str) -> World:
    return World(fidelity="tiny", device=device)


def mean_shapes(count: int) -> np.ndarray:
    return np.zeros((count, len(load_asset().shape_names)))


def test_tracking_errors_are_those_of_a_body_that_was_moved_by_hand(tiny):
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


def test_a_strike_gives_its_impulse_once_and_to_its_body_only(tiny):
    rig = Rig(tiny, PoseControlConfig(root="free", free_motion=False), mean_shapes(2))
    impulse = np.array([[0.0, 0.0, 0.0], [1.0, -2.0, 0.5]])
    rig.strike([joint_index("head"), joint_index("left_elbow")], impulse)
    for _ in range(2):
        found = np.array([totals(rig.model, rig.state, env).momentum for env in range(2)])
        # a GPU adds in fixed point, whose quantum follows the fastest and the heaviest particle
        np.testing.assert_allclose(found, impulse, atol=2e-5 if rig.model.device == "cpu" else 2e-4)
        rig.step()


def test_the_split_tracks_poses_and_a_body_adrift_keeps_its_momentum(tiny):
    """To 0.2 mm at any resolution, as in the tables of the paper."""
    options = tracking.shortened(tracking.Options(quick=True))
    target = tracking.changed(tracking.BARE, {"command": "target"})
    for decoupling in ("split", "paper"):
        world = replace(tiny, decoupling=decoupling)
        rows = {"mean_distance_m": [*tracking.table_1(options, world, tracking.BARE, 2)]}
        rows["distance_m"] = [*tracking.table_2(options, world, target, options.poses)]
        for distance, table in rows.items():
            check_finite(table)
            assert all(row["decoupling"] == decoupling and f"{distance}_ci95" in row for row in table)
            assert decoupling != "split" or all(row[distance] < 2e-4 for row in table)
    adrift = [*next(disturbance.plan(2, True, tiny))()]
    assert adrift and max(row["momentum_error"] for row in adrift) < 1e-4


def test_an_undisturbed_course_is_what_the_script_commands(device):
    script = keyed((0.0, {}), (0.2, {"left_elbow": (0.0, 0.0, -0.6), "head": (0.3, 0.0, 0.0)}))
    course = perform(Act("wave", 0.2, script=script), "tiny", device)
    assert len(course.time) == 7 and course.time[-1] == pytest.approx(0.2)
    elbow = Rotation.from_quat(course.local[-1, joint_index("left_elbow")]).as_rotvec()
    np.testing.assert_allclose(elbow, [0.0, 0.0, -0.6], atol=0.01)
    assert course.joint_errors.max() < 0.5 and not course.failed and not course.released
    everything = np.ones(len(course.stage.simulation.flesh[0].part), bool)
    assert course.displacements(everything)[-1].max() < 2e-3


def test_every_study_of_the_supplement_is_judged(tmp_path, device):
    rows = run(supplement, tmp_path / "supplement.json", device, "--quick")
    assert len({row["case"] for row in rows}) == len(rows)
    assert len({row["study"] for row in rows} - {"jiggle in a jump"}) == 9 and not any(row["failed"] for row in rows)
    assert all(row["expectation"] and row["as_expected"] in (True, False) for row in rows)


def test_a_figure_of_the_paper_is_drawn_and_measured(tmp_path, capsys, device):
    pytest.importorskip("PIL", reason="needs the extra render")
    pytest.importorskip("matplotlib", reason="needs the extra train")
    options = figures.Options("several_objects", tmp_path, "tiny", device, steps=2)
    picture, measured = figures.main(options)
    assert picture.stat().st_size > 5_000
    report = json.loads(measured.read_text())
    assert report["commit"] and report["device"] and report["versions"]["python"]
    (row,) = report["results"]
    assert set(row["series"]) == {"ball", "box", "capsule", "torus"} and len(row["time_s"]) == 3 and not row["failed"]
    assert figures.main(replace(options, name="list")) == [] and "belly_mass" in capsys.readouterr().out
    with pytest.raises(ValueError, match="resistance"):
        figures.main(replace(options, name="arms"))


def test_heavier_balls_dent_a_belly_more(device):
    courses = [perform(act, "tiny", device) for act in acts.belly_balls()]
    rows = [measures.belly(course) for course in courses]
    assert np.diff([row["peak_mean_dent_mm"] for row in rows]).min() > 0.0
    for act, row in zip(acts.belly_balls(), rows, strict=True):
        most = 2.0 * 3.0 * act.tags["ball_kg"]  # of an elastic rebound
        assert 0.5 * most < row["impulse_n_s"] < most


def test_soft_pillows_give_way_more_and_hit_body_and_hair_less_hard(device):
    found = {}
    for act in acts.pillows_on_body_and_hair():
        row = measures.pillow(perform(act, "tiny", device, steps=8))
        found.setdefault(act.tags["site"], []).append((row["peak_pillow_dent_mm"], row["peak_impulse_n_s"]))
    assert sorted(found) == ["chest", "hair"]
    for (soft_dent, soft_blow), (stiff_dent, stiff_blow) in found.values():
        assert soft_dent > 3.0 * stiff_dent and 0.2 < soft_blow < 0.9 * stiff_blow


@pytest.mark.parametrize(("young", "speed"), [(1e4, 3.67), (1e5, 11.6)])
def test_strain_of_a_blow_travels_as_pressure_waves_do(young, speed, device):
    act = acts.blow()
    row = measures.waves(perform(replace(act, physics={**act.physics, "young_modulus": young}), "coarse", device))
    assert row["pressure_wave_m_s"] == pytest.approx(speed, rel=0.01) and row["heights_reached"] >= 6
    assert row["front_m_s"] == pytest.approx(speed, rel=0.2)


def test_every_environment_is_scored(monkeypatch):
    pytest.importorskip("stable_baselines3", reason="the scores need the extra train")
    pytest.importorskip("pettingzoo", reason="the scores need the extra multi")
    from benchmarks.learning import scores

    found = scores.every_environment()
    assert set(task_modules()) < set(found) and "sumo_v0" in found and len(found) == len(set(found))
    for env_id in found:
        config = scores.training_config(env_id, scores.Options(train_steps=5000, workers=3, fidelity="tiny"))
        assert (config.env_id, config.total_steps, config.num_workers) == (env_id, 5000, 3)
    monkeypatch.setitem(scores.GENERIC, "ppo", {"rollout_steps": 16, "batch_size": 16})
    load = scores.load_training
    short = {"env.episode_seconds": 0.5}
    monkeypatch.setattr(scores, "load_training", lambda source, changes: load(source, changes | short))
    options = scores.Options(ids=("sumo_v0",), episodes=2, train_steps=40, workers=1, fidelity="tiny")
    rows = list(scores.cases(options))
    assert [(row["case"], row["agent"]) for row in rows] == [("sumo_v0", a) for a in ("zero", "random", "trained")]
    assert rows[2]["trained_for_steps"] == 40 and rows[2]["training_s"] > 0.0
    assert rows[0]["return_mean"] != rows[1]["return_mean"] and all(row["failures"] == 0 for row in rows)
