"""The cost model against the committed measurements."""

from __future__ import annotations

import pytest

from benchmarks.speed import model


def test_the_time_of_a_step_is_that_of_every_measured_batch():
    rows = [row for row in model.measured_rows("vector") if row["refused"] is None]
    assert len(rows) > 8
    for row in rows:
        world, large = model.measured_world(row["case"]), row["num_envs"] > 1000
        predicted = world.ms_per_step(row["num_envs"])
        assert predicted == pytest.approx(row["ms_per_step"], rel=0.05 if large else 0.2), row["case"]
        used = world.mb_of_process + world.mb_per_env * row["num_envs"]
        assert used == pytest.approx(row["mb_of_the_device"], rel=0.05 if large else 0.25), row["case"]


def test_the_time_of_pictures_is_that_of_every_measured_batch():
    for row in model.measured_rows("pixels"):
        assert 1e-3 * model.drawing_us(row["size"]) * row["num_envs"] == pytest.approx(row["drawing_ms"], rel=0.2)


def test_a_scaled_world_costs_its_particles_and_substeps():
    world = model.measured_world("PIAvatar/Reach-v0")
    twice = world.scaled(2 * world.particles, 3 * world.substeps)
    assert twice.ns_per_particle_substep == pytest.approx(world.ns_per_particle_substep)
    assert twice.ms_per_step(10**6) == pytest.approx(6.0 * world.ms_per_step(10**6), rel=2e-3)
    assert twice.mb_per_env == pytest.approx(2.0 * world.mb_per_env)


def test_networks_and_gradients_are_counted():
    torch = pytest.importorskip("torch")
    layers = [torch.nn.Linear(*size) for size in ((11, 8), (8, 4), (4, 3), (11, 8), (8, 4), (4, 1))]
    assert model.network_parameters(11, 3, (8, 4)) == sum(p.numel() for one in layers for p in one.parameters())
    assert model.gradient_bytes(1000, 1) == 0.0
    assert model.gradient_bytes(1000, 4) == pytest.approx(6000.0)  # three quarters of it twice, 4 bytes each


def test_a_plan_adds_up(capsys):
    alone = model.Plan(num_envs=4096, gpus=1).predict()
    assert alone["network_ms"] == 0.0 and alone["efficiency"] == 1.0
    many = model.Plan(num_envs=64 * 4096, gpus=64).predict()
    assert many["simulation_ms"] == alone["simulation_ms"] and 0.9 < many["efficiency"] < 1.0
    parts = sum(many[name] for name in ("simulation_ms", "drawing_ms", "learner_ms", "network_ms"))
    assert many["env_steps_per_s_trained"] == pytest.approx(1e3 * 64 * 4096 / parts)
    model.main(["--num-envs", "1000", "--gpus", "2", "--pictures", "64"])
    assert "envs_per_gpu                 500" in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "named"), [(["--gpus", "0"], "gpus=0"), (["--world", "Nowhere"], "Nowhere")])
def test_plans_that_cannot_be_are_refused(arguments, named):
    with pytest.raises(SystemExit, match=named):
        model.main(arguments)
