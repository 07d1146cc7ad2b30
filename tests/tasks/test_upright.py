"""Stand, PushRecovery and Walk: first poses, the load of the feet, rewards, falls and ends, pushes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.tasks import load_task
from tests.conftest import reward_terms
from tests.tasks.measured import joints, pelvis, seen, still, tolerance

STAND, PUSH, WALK = "PIAvatar/Stand-v0", "PIAvatar/PushRecovery-v0", "PIAvatar/Walk-v0"
GET_UP = "PIAvatar/GetUp-v0"
HEAD, CHEST = joint_index("head"), joint_index("spine3")
TRUNK = [joint_index(name) for name in ("spine1", "spine2", "spine3")]


def shares(env) -> tuple[float, float, float]:
    """Heights of head and pelvis over those in the rest pose, and the tilt of the chest [rad]."""
    at, rest = joints(env), env.batch.simulation.flesh[0].points.joints[0]
    chest = Rotation.from_quat(env.batch.simulation.avatar.tracked.rotation.numpy()[0, CHEST].astype(float))
    return at[HEAD, 2] / rest[HEAD, 2], at[0, 2] / rest[0, 2], np.arccos(min(chest.apply([0.0, 0.0, 1.0])[2], 1.0))


@pytest.mark.parametrize("task", [STAND, PUSH, WALK])
def test_every_first_pose_stands_on_the_ground(make_env, task):
    """Whatever the joints' noise, the lowest flesh is as high as that of the rest pose, which stands at z = 0."""
    env = make_env(task, pose_noise=0.4)
    sim, heights = env.batch.simulation, []
    rest = sim.flesh[0].points.rest[0, :, 2].min()
    for seed in range(5):
        env.reset(seed=seed)
        assert sim.state.x.numpy()[0, : sim.avatar.num_points, 2].min() == pytest.approx(rest, abs=1e-5)
        heights.append(sim.avatar.tracked.position.numpy()[0, 0, 2])
    assert np.ptp(heights) > 0.01  # bent legs are shorter


def test_the_ground_bears_the_body_and_feet_neither_sink_nor_hover(make_env):
    """With an upright pelvis that no force holds up but its own weight's, the floor's impulse is that of the weight."""
    env = make_env(STAND, root_assist=1.0, pose_noise=0.0, fidelity="coarse")
    env.reset(seed=0)
    for _ in range(20):
        _, _, terminated, _, info = env.step(still(env))
        assert not terminated and info["success"]
    sim = env.batch.simulation
    lowest = sim.state.x.numpy()[0, :, 2].min()
    assert abs(lowest - sim.flesh[0].points.rest[0, :, 2].min()) < 0.01  # heels give way by millimetres
    ground = sim.sensors.boundary_impulse.numpy()[0, 0, 2] / env.config.physics.control_dt
    weight = 9.81 * sim.flesh[0].points.mass.sum()
    assert ground + info["root_force"][2] == pytest.approx(weight, rel=0.01) and ground > 0.5 * weight


def test_feet_share_the_load(make_env):
    """Upright both bear the same; a body whose trunk is bent to a side loads that foot.

    Point feet would differ by the moment about the middle between them of the weight and of what assists the pelvis,
    ``(a - b) / (a + b) = moment / (ground distance / 2)``. Pressure that moves within each sole takes some of it.
    """
    env = make_env(STAND, root_assist=0.3, pose_noise=0.0)
    sim, loads, expected = env.batch.simulation, {}, {}
    mass, feet = sim.flesh[0].points.mass[0], [joint_index("left_ankle"), joint_index("right_ankle")]
    pelvis = sim.controllers[0].joints.support
    for bend in (0.0, 1.0, -1.0):
        env.reset(seed=0)
        action = still(env)
        for name in ("spine1.y", "spine2.y", "spine3.y"):
            action[env.action_names.index(name)] = bend
        for _ in range(60):  # until it has ceased to sway
            observation = env.step(action)[0]
        loads[bend] = seen(env, observation, "foot_impulses")
        ground = sim.sensors.boundary_impulse.numpy()[0, 0, 2]
        assert loads[bend].sum() == pytest.approx(ground, rel=1e-5) and (loads[bend] >= 0.0).all()
        at = sim.controllers[0].state.position.numpy()[0]
        middle, distance = at[feet].mean(0) * (1.0, 1.0, 0.0), at[feet[0], 0] - at[feet[1], 0]
        center = np.average(sim.state.x.numpy()[0, : sim.avatar.num_points], axis=0, weights=mass) - middle
        held = pelvis.torque.numpy()[0] + np.cross(at[0] - middle, pelvis.force.numpy()[0])
        moment = 9.81 * mass.sum() * center[0] + held[1]
        expected[bend] = moment * env.config.physics.control_dt / (ground * distance / 2.0)
    assert loads[0.0][0] == pytest.approx(loads[0.0][1], rel=0.05) and loads[0.0].min() > 1.0
    # about y a positive turn takes the head to the left
    leaning = {bend: (load[0] - load[1]) / load.sum() for bend, load in loads.items()}
    assert expected[1.0] > 0.05 and leaning[-1.0] == pytest.approx(-leaning[1.0], rel=0.2)
    for bend in (1.0, -1.0):
        assert leaning[bend] == pytest.approx(expected[bend], rel=0.1)


#: Settings of the posture that differ from the defaults.
OTHERS = {"upright.stand_head": 0.9, "upright.height_margin": 0.4, "upright.tilt_margin": 0.7}
STILL = {"still.speed_margin": 1.5, "still.pose_margin": 0.3}
FALL = {"fall.fall_head": 0.75, "fall.fall_pelvis": 0.7}


@pytest.mark.parametrize("task", [STAND, PUSH])
@pytest.mark.parametrize("settings", [{}, OTHERS | STILL | FALL], ids=["default", "others"])
def test_reward_metrics_and_falls_are_what_the_joints_say(make_env, task, settings):
    env = make_env(task, **settings, **({"throw_interval": 60.0} if task == PUSH else {}))
    rule, rest, fall, outcomes = env.config.upright, env.config.still, env.config.fall, set()
    env.reset(seed=1)
    for _ in range(60):
        observation, _, terminated, _, info = env.step(still(env))
        head, pelvis_height, tilt = shares(env)
        high, terms = tolerance(1.0 - head, 0.05, rule.height_margin), reward_terms(info)
        assert info["head_height"] == pytest.approx(head, abs=1e-5)
        assert info["pelvis_height"] == pytest.approx(pelvis_height, abs=1e-5)
        assert info["tilt_deg"] == pytest.approx(np.degrees(tilt), abs=0.05)
        tracked = env.batch.simulation.avatar.tracked
        speed = float(np.linalg.norm(tracked.velocity.numpy()[0, 0]))
        angles = Rotation.from_quat(tracked.local.numpy()[0].astype(float)).magnitude()
        angle = max(angles[1:].mean(), angles[TRUNK].mean())
        assert terms["height"] == pytest.approx(0.3 * high, abs=1e-4)
        assert terms["upright"] == pytest.approx(0.3 * tolerance(tilt, 0.1, rule.tilt_margin), abs=1e-3)
        assert terms["still"] == pytest.approx(0.2 * high * tolerance(speed, 0.05, rest.speed_margin), abs=2e-4)
        assert terms["pose"] == pytest.approx(0.2 * high * tolerance(angle, 0.05, rest.pose_margin), abs=1e-4)
        assert terminated == (head < fall.fall_head or pelvis_height < fall.fall_pelvis)
        assert info["success"] == (task == STAND and head >= rule.stand_head)
        down = pelvis(env)[1].inv().apply([0.0, 0.0, -1.0])
        assert seen(env, observation, "gravity_direction") == pytest.approx(down, abs=1e-5)
        outcomes.add((bool(info["success"]), terminated))
        if terminated:
            break
    # with the rest pose as a constant target a body falls, and has stood before
    assert outcomes >= {(task == STAND, False), (False, True)}


@pytest.mark.parametrize(
    ("task", "name", "remedy"),
    [
        (WALK, "still.speed_margin", "still"),
        (WALK, "upright.pose_margin", "upright.pose_margin"),
        (GET_UP, "fall.fall_head", "fall"),
        (STAND, "upright.fall_head", "did you mean fall.fall_head"),
        (PUSH, "upright.speed_margin", "did you mean still.speed_margin"),
    ],
)
def test_settings_of_the_posture_that_would_do_nothing_are_refused(task, name, remedy):
    """Walk has no margins of stillness, and GetUp no fall."""
    with pytest.raises(ConfigError, match=remedy):
        load_config(load_task(task).Config, None, {name: 0.5})


def test_pushes_come_at_random_moments_from_everywhere_and_are_weighed(make_env):
    """A push is the impulse that has passed between ball and body since the throw; thrown balls meet the trunk."""
    env = make_env(PUSH, control="pose", throw_interval=0.7, episode_seconds=60.0)
    sensors, azimuths, moments, masses, hits, throws = env.batch.simulation.sensors, [], [], [], 0, 0
    interval = round(0.7 / env.config.physics.control_dt)
    for seed in range(4):
        env.reset(seed=seed)
        masses.append(env.batch.simulation.props.density.numpy()[0, 0] * env.batch.task.throws.volume)
        total, strongest, flew = np.zeros(3), 0.0, False
        for step in range(5 * interval):
            before = env.batch.task.push.numpy()[0].copy()
            observation, *_, info = env.step(still(env))
            spawn = env.batch.simulation.props.initial
            thrown = bool(env.batch.task.placed.numpy()[0]) and spawn.velocity.numpy()[0, 0].any()
            if thrown:
                at, way = spawn.position.numpy()[0, 0], spawn.velocity.numpy()[0, 0]
                azimuths.append(np.arctan2(at[0], -at[1]))
                moments.append(step % interval)
                assert step // interval == throws % 5
                throws += 1
                total = np.zeros(3)
                assert np.hypot(*at[:2]) >= 0.9 and np.dot(way[:2], at[:2]) < 0.0
                assert 1.0 < np.linalg.norm(way[:2]) < 5.0
            else:
                assert before == pytest.approx(total, abs=1e-4)
            impulse = sensors.pair_impulse.numpy()[0, 1].astype(float)
            total = total + impulse
            strongest = max(strongest, float(np.linalg.norm(total)))
            flew = flew or thrown
            assert info["impulse"] == pytest.approx(np.linalg.norm(impulse), rel=1e-4, abs=1e-6)
            assert info["push_impulse"] == pytest.approx(np.linalg.norm(total), rel=1e-3, abs=1e-3)
            assert info["strongest_push"] == pytest.approx(strongest, rel=1e-3, abs=1e-3)
            flying = bool(env.batch.task.flying.numpy()[0])
            ball = seen(env, observation, "ball_position"), seen(env, observation, "ball_velocity")
            assert flying == ball[0].any() and (flying or not ball[1].any())
            if flying:
                (at, turn), props = pelvis(env), env.batch.simulation.props.state
                assert turn.apply(ball[0]) == pytest.approx(props.position.numpy()[0, 0] - at, abs=1e-4)
            if info["root_released"]:
                break
        hits += strongest > env.config.hit_impulse
        throws = 0
    assert hits == 4 and len(set(moments)) > 4 and max(moments) <= interval // 2 + 1 and min(moments) >= 1
    assert min(azimuths) < -1.0 and max(azimuths) > 1.0
    assert 0.5 <= min(masses) < max(masses) <= 8.0


@pytest.mark.parametrize("mass", [0.5, 8.0])
def test_a_push_is_at_most_what_the_ball_carries(make_env, mass):
    """A soft ball that falls dead gives its whole momentum, one that bounces at most twice of it; few are grazing."""
    env = make_env(PUSH, control="pose", ball_mass=(mass, mass), throw_interval=0.7, aim_spread=0.0)
    found = []
    for seed in range(3):
        env.reset(seed=seed)
        infos = [env.step(still(env))[4] for _ in range(18)]
        spawn = env.batch.simulation.props.initial.velocity.numpy()[0, 0]
        found.append(infos[-1]["strongest_push"] / (mass * np.linalg.norm(spawn)))
    assert np.median(found) > 0.2 and max(found) < 2.5


def test_a_push_lands_in_the_whole_body_and_fells_it(make_env):
    """Eight kilograms at five metres a second against the assisted body and the one that nothing helps."""
    settings = {"ball_mass": (8.0, 8.0), "throw_speed": (5.0, 5.0), "throw_interval": 0.7, "pose_noise": 0.0}
    env = make_env(PUSH, **settings)
    env.reset(seed=0)
    infos = []
    for _ in range(45):
        *_, terminated, _, info = env.step(still(env))
        infos.append(info)
        if terminated:
            break
    assert terminated and 10.0 < infos[-1]["strongest_push"] < 60.0


@pytest.mark.parametrize("task", [PUSH, "PIAvatar/Dodge-v0"])
@pytest.mark.parametrize("name", ["ball_mass", "throw_speed", "throw_distance"])
def test_falling_ranges_are_refused(task, name):
    with pytest.raises(ConfigError, match=rf"{name}=\[3.0, 2.0\]"):
        load_task(task)(load_config(load_task(task).Config, None, {name: [3.0, 2.0]}))
