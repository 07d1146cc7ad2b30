"""Substeps of worlds with fast parts: each moves less than a grid spacing in one."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_index
from piavatar_envs.config import ConfigError, EnvConfig, load_config
from piavatar_envs.mpm.model import choose_num_substeps
from piavatar_envs.mpm.retention import retained_share
from piavatar_envs.multi import listed_games, load_game
from piavatar_envs.sim.time_step import STRUCK, lever
from piavatar_envs.sim.world import Simulation
from piavatar_envs.tasks import load_task, task_modules

REACH = "PIAvatar/Reach-v0"
BALL = {"name": "ball", "mass": 2.0, "position": [0.0, -1.2, 1.2]}
POST = {"name": "post", "kind": "sphere", "size": [0.2], "position": [0.0, -1.2, 1.2]}


def world(device, **settings) -> Simulation:
    return Simulation(load_config(EnvConfig, None, {"fidelity": "tiny", **settings}), 1, device)


def substep_way(simulation: Simulation, speed: float) -> float:
    """Return the distance in a substep at a speed [grid spacings]."""
    return speed * float(simulation.model.step.dt) / simulation.dx


def test_no_default_has_other_substeps_than_its_waves_ask_for(device):
    # Under pose control at any fidelity alike: the steps of waves and of moving parts go with the grid spacing.
    tasks = [load_task(env_id) for env_id in task_modules()]
    if importlib.util.find_spec("pettingzoo"):
        tasks += [load_game(name).TASK for name in listed_games()]
    for cls in tasks:
        fidelity = "tiny" if load_config(cls.Config).control.mode == "pose" else "coarse"
        task = cls(load_config(cls.Config, None, {"fidelity": fidelity}))
        world_of = task.config, 1, device, task.domain(), task.scene
        simulation = Simulation(*world_of, avatar_names=task.agent_names, largest_impulses=task.impulses())
        model, physics = simulation.model, task.config.physics
        wave = choose_num_substeps(physics.control_dt, simulation.dx, model.sound_speed, physics.cfl)
        assert model.num_substeps == wave, cls.__name__
        assert model.retained_share is None, cls.__name__


@pytest.mark.parametrize("fidelity", ["tiny", "coarse"])
def test_substeps_beyond_those_of_the_flesh_keep_its_damping(device, fidelity):
    far = {"name": "far", "size": [0.1], "density": 1000.0, "position": [-1.2, -1.2, 1.2]}
    usual = world(device, fidelity=fidelity, scene={"props": [far]}).model
    assert usual.retained_share is None
    stiff = {"scene": {"props": [far | {"young_modulus": 1e6}]}}
    for more in ({"num_substeps": 2 * usual.num_substeps}, {"cfl": 0.25}, {"damping_ratio": 0.5}, stiff):
        model = world(device, fidelity=fidelity, **more).model
        share = retained_share(model.num_substeps / usual.num_substeps)
        assert share > 0.05
        assert model.retained_share.numpy() == pytest.approx(share), more
    assert world(device, fidelity=fidelity, num_substeps=usual.num_substeps).model.retained_share is None


def test_a_chain_of_joints_adds_up_what_they_are_from_its_end():
    places = np.zeros((NUM_JOINTS, 3))
    hip, knee, ankle = (joint_index(f"left_{name}") for name in ("hip", "knee", "ankle"))
    places[hip], places[knee], places[ankle] = (0.0, 0.0, 0.9), (0.0, 0.0, 0.5), (0.0, 0.0, 0.1)
    toe, shin = np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.3]])
    of, about_all = (np.array([ankle]), np.array([knee])), math.sqrt(3.0)
    assert lever(JOINT_NAMES, toe, places, of[0]) == pytest.approx(about_all * (0.9 + 0.1) + 0.5)
    assert lever(("left_hip", "left_ankle"), toe, places, of[0]) == pytest.approx(about_all * (0.9 + 0.1))
    assert lever(("left_hip", "left_ankle"), shin, places, of[1]) == pytest.approx(about_all * 0.6)
    assert lever(("right_hip",), toe, places, of[0]) == 0.0


@pytest.mark.parametrize(
    ("scene", "speed"),
    [
        ({"props": [BALL | {"velocity": [0.0, 40.0, 30.0]}]}, 50.0),
        ({"props": [BALL | {"spin": [0.0, 0.0, 400.0]}]}, 400.0 * 0.08),
        ({"colliders": [POST | {"velocity": [0.0, 30.0, 0.0]}]}, 30.0),
        ({"colliders": [POST | {"spin": [0.0, 0.0, 200.0]}]}, 40.0),
        ({"colliders": [POST | {"kind": "capsule", "size": [0.1, 0.3], "spin": [99.0, 0.0, 0.0]}]}, 39.6),
        ({"colliders": [POST | {"kind": "plane", "size": [], "position": [0, 0, -0.2], "spin": [9.0, 0, 0]}]}, 28.6),
        ({"colliders": [POST | {"top_speed": 60.0}]}, 60.0),
    ],
)  # fmt: skip
def test_fast_things_go_less_than_a_grid_spacing_in_a_substep(device, scene, speed):
    plain = substep_way(world(device), speed)
    assert plain > 1.0 / STRUCK, "it would have been slow enough anyway"
    assert 0.6 / STRUCK < substep_way(world(device, scene=scene), speed) <= 1.0 / STRUCK + 1e-6


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        (REACH, {"scene": {"props": [BALL | {"velocity": [0.0, 30.0, 0.0]}]}}),
        (REACH, {"scene": {"colliders": [POST | {"velocity": [0.0, 0.0, 40.0], "position": [0.0, -0.75, 0.5]}]}}),
        ("PIAvatar/Dodge-v0", {"throw_speed": (30.0, 30.0)}),
        ("PIAvatar/Dodge-v0", {"throw_speed": (0.2, 0.2)}),
    ],
)
def test_they_do_not_end_episodes(make_env, task, settings):
    # All of these ended with the failure ``cfl`` in the step in which they became so fast.
    env = make_env(task, **settings)
    env.reset(seed=0)
    for _ in range(25):
        assert env.step(np.zeros(env.action_space.shape))[4]["failure"] == 0


def test_a_fast_serve_does_not_end_the_game(device):
    pytest.importorskip("pettingzoo", reason="needs the extra multi")
    from piavatar_envs.multi.pass_ball_v0 import parallel_env

    game = parallel_env(device=device, fidelity="tiny", serve_speed=(30.0, 30.0))
    game.reset(seed=0)
    while game.agents:  # until the ball is out
        infos = game.step({agent: np.zeros(game.action_space(agent).shape) for agent in game.agents})[4]
        assert all(info["failure"] == 0 for info in infos.values())
    game.close()


def test_too_few_substeps_are_refused_with_the_number_that_would_do(device):
    scene = {"props": [BALL | {"velocity": [0.0, 60.0, 0.0]}]}
    with pytest.raises(ConfigError, match=r"num_substeps=9: 'ball', at up to 60\.5 m/s, .*; use at least 15"):
        world(device, scene=scene, num_substeps=9)
    assert world(device, scene=scene, num_substeps=15).model.num_substeps == 15
    with pytest.raises(ConfigError, match=r"1\.16e\+05 m/s .* need \d+ substeps .*10000"):
        world(device, young_modulus=1e9, density=0.1)


def test_flesh_that_gets_a_great_impulse_goes_less_than_a_cell_in_a_substep(make_batch):
    # Of 2 kg in a shoulder 200 N s make 100 m/s; in the default's substeps bodies ended in the failure ``cfl``.
    batch = make_batch("PIAvatar/TrackMotion-v0", 4, impulse=200.0, impulse_interval=0.3)
    simulation, usual = batch.simulation, make_batch("PIAvatar/TrackMotion-v0", 1).simulation
    assert simulation.model.num_substeps > 1.5 * usual.model.num_substeps
    batch.reset(seeds=list(range(4)))
    for _ in range(30):
        batch.action.zero_()
        batch.step()
    assert batch.failure.numpy().sum() == 0
    assert np.linalg.norm(simulation.state.u.numpy(), axis=2).max() > 0.1


def test_too_few_substeps_for_an_impulse_are_refused(make_batch):
    with pytest.raises(ConfigError, match=r"num_substeps=6: 'the impulse on .*shoulder', at up to"):
        make_batch("PIAvatar/TrackMotion-v0", 1, impulse=300.0, num_substeps=6)
