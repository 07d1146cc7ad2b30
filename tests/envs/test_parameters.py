"""Observed parameters, over all tasks: the values that were drawn, in the order of the layout."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.envs.parameters import ASSIST, PARAMETERS
from tests.sim.randomized import VARIED, by_name, check_term, factors_of
from tests.tasks.measured import markers_of

REACH = "PIAvatar/Reach-v0"


@pytest.fixture
def observed(make_batch, env_id):
    settings = {"observe_parameters": True, "shape.randomize": True, **VARIED}
    if env_id.endswith("TrackMotion-v0"):
        settings["impulse_interval"] = 0.3
    batch = make_batch(env_id, 3, **settings)
    batch.reset(seeds=[11, 12, 13])
    return batch


def test_parameters_are_what_was_drawn(observed):
    check_term(observed, np.array([False, True, False]))


def test_without_ranges_only_the_task_and_the_clock_are_observed(make_env, sample_id):
    plain = make_env(sample_id).batch
    assert PARAMETERS not in plain.layout and "env.parameters" not in plain.get_state()
    assert not any(term.parameters for term in plain.layout.values())
    batch = make_env(sample_id, observe_parameters=True).batch
    drawn = [p.name for p in batch.task.drawn() if p.low < p.high]
    settings = [] if batch.control == "pose" else [ASSIST.name]
    assert [p.name for p in batch.layout[PARAMETERS].parameters] == [*settings, *drawn, "clock"]


@pytest.mark.parametrize("control", ["pd", "torque"])
def test_root_assistance_is_observed_as_it_is_now(make_batch, control):
    """Compare in every environment, from the first observation after a change, through resets and restored states."""
    batch = make_batch(REACH, 3, observe_parameters=True, control=control, root_assist=0.25, **VARIED)
    batch.assist_root(0.25)  # the batch may have been used before
    batch.reset(seeds=[1, 2, 3])
    name = ASSIST.name
    assert by_name(batch)[name] == pytest.approx(0.25)
    shares = np.array([0.0, 0.6, 1.0])
    batch.assist_root(shares)
    before = by_name(batch)
    batch.step()
    values = by_name(batch)
    assert values[name] == pytest.approx(shares, abs=1e-6)
    assert all(np.array_equal(values[other], before[other]) for other in values if other not in (name, "clock"))
    state = batch.get_state()
    batch.reset(env_mask=np.array([True, True, False]))
    assert by_name(batch)[name] == pytest.approx(shares, abs=1e-6)
    batch.assist_root(1.0)
    batch.reset()
    assert by_name(batch)[name] == pytest.approx(1.0)
    batch.set_state(state)
    assert by_name(batch)[name] == pytest.approx(shares, abs=1e-6)


def test_masses_of_props_are_observed(observed):
    """Compare with the masses of their particles."""
    sim, values = observed.simulation, by_name(observed)
    masses = sim.model.particles.mass.numpy().astype(float)
    for prop, name in zip(sim.props.props, sim.props.names, strict=True):
        mass = masses[:, prop.first : prop.first + prop.count].sum(1)
        assert values[f"{name}_mass"] == pytest.approx(mass, rel=1e-4), name


def test_the_path_of_the_target_follows_from_its_parameters(make_batch):
    batch = make_batch(REACH, 3, observe_parameters=True, **VARIED)
    batch.reset(seeds=[1, 2, 3])
    config, body = batch.config, batch.simulation.avatar.body
    center = np.broadcast_to(body.rest_joint.numpy()[:, joint_index("spine3")], (3, 3))
    for _ in range(3):
        batch.step()
        values = by_name(batch)
        time = values["clock"] * batch.max_steps * config.physics.control_dt
        rate = config.target_speed * values["target_pace"] / (0.35 * config.radius * 1.4143)
        azimuth, elevation = (
            values[f"target_{angle}"] + 0.35 * part * np.sin(rate * time + values[f"target_phase_{angle}"])
            for angle, part in (
                ("azimuth", np.cos(values["target_tilt"])),
                ("elevation", np.sin(values["target_tilt"])),
            )
        )
        out = [np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
        goal = center + config.radius * np.stack(out, axis=1)
        assert markers_of(batch).position.numpy()[:, 0] == pytest.approx(goal, abs=1e-4)


@pytest.mark.parametrize("task", ["KickBall", "Header"])
def test_the_gate_stands_where_its_parameters_say(make_batch, task):
    batch = make_batch(f"PIAvatar/{task}-v0", 3, observe_parameters=True)
    batch.reset(seeds=[1, 2, 3])
    values, course = by_name(batch), batch.task.course
    start = batch.simulation.props.initial.position.numpy()[:, 0]
    side = values["target_side"]
    way = values["target_distance"][:, None] * np.stack([side, -np.sqrt(1.0 - side**2)], axis=1)
    assert course.center.numpy()[:, :2] == pytest.approx(start[:, :2] + way, abs=1e-4)


def test_impulses_and_clips_begin_where_their_parameters_say(make_batch):
    batch = make_batch("PIAvatar/TrackMotion-v0", 4, observe_parameters=True, impulse_interval=0.3)
    batch.reset(seeds=[1, 2, 3, 4])
    values, interval, dt = by_name(batch), 9, batch.config.physics.control_dt
    start = np.round(values["motion_start"] / dt).astype(int)
    first = batch.task.frames.rotations[start][:, :, [1, 2, 3, 0]]  # before a step is done
    commanded = batch.simulation.avatar.state.command_rotation.numpy()
    assert len(set(start.tolist())) > 1 and np.abs((first * commanded).sum(-1)) == pytest.approx(
        np.ones((4, 22)), abs=1e-5
    )
    struck = []
    for _ in range(interval):
        batch.step()
        struck.append(np.linalg.norm(batch.task.impulse.numpy(), axis=1) > 0.0)
    expected = interval - 1 - np.round(values["impulse_offset"] / dt).astype(int)
    assert np.array_equal(np.argmax(struck, axis=0), expected) and (np.sum(struck, axis=0) == 1).all()


def test_named_shape_parameters_and_points_are_no_parameters(make_batch):
    settings = {"shape.randomize": True, "shape.parameters": {"height": 0.4}, "shape.scale": 0.5}
    batch = make_batch(REACH, 3, observe_parameters=True, **settings, **{"randomize.mass_factor": (1.3, 1.3)})
    batch.reset(seeds=[1, 2, 3])
    parameters = batch.layout[PARAMETERS].parameters
    names = [p.name for p in parameters]
    assert "shape_height" not in names and "shape_weight" in names and "mass_factor" not in names
    assert (factors_of(batch)["mass_factor"] == np.float32(1.3)).all()
    assert by_name(batch)["shape_weight"] == pytest.approx(
        batch.simulation.flesh[0].shape_parameters[:, batch.simulation.asset.shape_names.index("weight")], abs=1e-6
    )
    assert {(p.low, p.high) for p in batch.layout[PARAMETERS].parameters if p.name.startswith("shape_")} == {
        (-0.5, 0.5)
    }
