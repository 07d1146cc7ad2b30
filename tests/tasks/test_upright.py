"""Standing, pushed, walking: feet start on the ground, rewards and falls are what the joints say, balls push."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.tasks.push_recovery import PushRecoveryConfig, PushRecoveryTask

STAND, PUSH, WALK = "PIAvatar/Stand-v0", "PIAvatar/PushRecovery-v0", "PIAvatar/Walk-v0"
HEAD, CHEST = joint_index("head"), joint_index("spine3")


def still(env) -> np.ndarray:
    return np.zeros(env.action_space.shape, np.float32)


def seen(env, observation, name: str) -> np.ndarray:
    return env.observation_layout.split(observation)[name]


def shares(env) -> tuple[float, float, float]:
    """Heights of head and pelvis over those in the rest pose, and the tilt of the chest [rad]."""
    tracked, rest = env.batch.simulation.avatar.tracked, env.batch.simulation.flesh[0].points.joints[0]
    at = tracked.position.numpy()[0]
    return at[HEAD, 2] / rest[HEAD, 2], at[0, 2] / rest[0, 2], tilt_of(tracked.rotation.numpy()[0, CHEST])


def tilt_of(xyzw: np.ndarray) -> float:
    return np.arccos(np.clip(Rotation.from_quat(xyzw.astype(float)).apply([0.0, 0.0, 1.0])[2], -1.0, 1.0))


def tolerance(value: float, bound: float, margin: float) -> float:
    return 10.0 ** -((max(value - bound, 0.0) / margin) ** 2)


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
    assert abs(lowest - sim.flesh[0].points.rest[0, :, 2].min()) < 0.005
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
    for bend in (0.0, 0.6, -0.6):
        env.reset(seed=0)
        action = still(env)
        for name in ("spine1.y", "spine2.y", "spine3.y"):
            action[env.action_names.index(name)] = bend
        for _ in range(40):
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
    assert expected[0.6] > 0.1 and leaning[-0.6] == pytest.approx(-leaning[0.6], rel=0.2)
    for bend in (0.6, -0.6):
        assert leaning[bend] == pytest.approx(expected[bend], rel=0.2)


@pytest.mark.parametrize("task", [STAND, PUSH])
def test_reward_metrics_and_falls_are_what_the_joints_say(make_env, task):
    env = make_env(task, throw_interval=60.0) if task == PUSH else make_env(task)
    rule, rest, fall, outcomes = env.config.upright, env.config.still, env.config.fall, set()
    observation, _ = env.reset(seed=1)
    for _ in range(60):
        observation, _, terminated, _, info = env.step(still(env))
        head, pelvis, tilt = shares(env)
        high, terms = tolerance(1.0 - head, 0.05, rule.height_margin), info["reward_terms"]
        assert info["head_height"] == pytest.approx(head, abs=1e-5)
        assert info["pelvis_height"] == pytest.approx(pelvis, abs=1e-5)
        assert info["tilt_deg"] == pytest.approx(np.degrees(tilt), abs=0.05)
        speed = float(np.linalg.norm(env.batch.simulation.avatar.tracked.velocity.numpy()[0, 0]))
        local = Rotation.from_quat(env.batch.simulation.avatar.tracked.local.numpy()[0, 1:].astype(float))
        angle = local.magnitude().mean()
        assert terms["height"] == pytest.approx(0.3 * high, abs=1e-4)
        assert terms["upright"] == pytest.approx(0.3 * tolerance(tilt, 0.1, rule.tilt_margin), abs=1e-3)
        assert terms["still"] == pytest.approx(0.2 * high * tolerance(speed, 0.05, rest.speed_margin), abs=1e-4)
        assert terms["pose"] == pytest.approx(0.2 * high * tolerance(angle, 0.05, rest.pose_margin), abs=1e-4)
        assert terminated == (head < fall.fall_head or pelvis < fall.fall_pelvis)
        assert info["success"] == (task == STAND and head >= rule.stand_head)
        turn = Rotation.from_quat(env.batch.simulation.avatar.tracked.rotation.numpy()[0, 0].astype(float))
        assert seen(env, observation, "gravity_direction") == pytest.approx(turn.inv().apply([0, 0, -1.0]), abs=1e-5)
        outcomes.add((bool(info["success"]), terminated))
    # with the rest pose as a constant target a body falls, and has stood before
    assert outcomes >= {(task == STAND, False), (False, True)}


def test_pushes_come_at_random_moments_from_everywhere_and_are_weighed(make_env):
    """A push is the impulse that has passed between ball and body since the throw; thrown balls meet the trunk."""
    env = make_env(PUSH, control="pose", throw_interval=0.7, episode_seconds=60.0)
    sensors, azimuths, moments, masses, hits, throws = env.batch.simulation.sensors, [], [], [], 0, 0
    interval = round(0.7 / env.config.physics.control_dt)
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
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
                tracked, props = env.batch.simulation.avatar.tracked, env.batch.simulation.props.state
                turn = Rotation.from_quat(tracked.rotation.numpy()[0, 0].astype(float))
                off = props.position.numpy()[0, 0] - tracked.position.numpy()[0, 0]
                assert turn.apply(ball[0]) == pytest.approx(off, abs=1e-4)
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


@pytest.mark.parametrize("avatar", [None, {"position": [0.4, -0.2], "yaw": 2.0}])
def test_walking_is_told_along_the_way(make_env, avatar):
    """A body that is moved at the target's speed earns the speed's reward and succeeds, along its own way."""
    env = make_env(WALK, **({} if avatar is None else {"scene.avatars": [avatar]}), gravity=0.0, pose_noise=0.0)
    yaw, place = (0.0, np.zeros(2)) if avatar is None else (2.0, np.array([0.4, -0.2]))
    ahead = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    observation, _ = env.reset(seed=0)
    turn = Rotation.from_quat(env.batch.simulation.avatar.tracked.rotation.numpy()[0, 0].astype(float))
    assert turn.apply(seen(env, observation, "way_direction")) == pytest.approx(ahead, abs=1e-5)
    assert seen(env, observation, "way_offset") == pytest.approx(0.0, abs=1e-4)
    joints = env.batch.simulation.controllers[0].state
    velocity = joints.velocity.numpy()
    velocity[0, :3] = ahead
    joints.velocity.assign(velocity)
    particles = env.batch.simulation.state.vk
    particles.assign(particles.numpy() + ahead.astype(np.float32))
    for step in range(40):
        observation, _, terminated, _, info = env.step(still(env))
        pelvis = env.batch.simulation.avatar.tracked.position.numpy()[0, 0]
        rest = Rotation.from_rotvec([0, 0, yaw]).apply(env.batch.simulation.flesh[0].points.joints[0, 0])
        gone = float((pelvis - rest - [*place, 0.0]) @ ahead)
        assert info["distance"] == pytest.approx(gone, abs=1e-4)
        assert info["mean_speed"] == pytest.approx(gone / ((step + 1) / 30.0), abs=1e-3)
        assert not terminated and info["speed"] == pytest.approx(1.0, abs=0.1)
        assert info["reward_terms"]["speed"] == pytest.approx(0.35, abs=0.015)
        assert info["success"] == (gone >= 1.0)
    assert info["success"]


def test_the_reward_of_walking_is_what_the_joints_say(make_env):
    """Of a body that is left to itself: it stands, tips over and turns as it falls."""
    env = make_env(WALK, pose_noise=0.3)
    rule, seen_heads, turned = env.config.upright, [], []
    env.reset(seed=2)
    for _ in range(60):
        _, reward, _, _, info = env.step(still(env))
        head, _, tilt = shares(env)
        tracked, terms = env.batch.simulation.avatar.tracked, info["reward_terms"]
        facing = Rotation.from_quat(tracked.rotation.numpy()[0, 0].astype(float)).apply([0.0, -1.0, 0.0])
        off_way = np.arccos(np.clip(-facing[1] / np.hypot(*facing[:2]), -1.0, 1.0))
        off_speed = abs(-float(tracked.velocity.numpy()[0, 0, 1]) - env.config.target_speed)
        high = tolerance(1.0 - head, 0.05, rule.height_margin)
        assert terms["speed"] == pytest.approx(0.35 * high * tolerance(off_speed, 0.1, 1.0), abs=1e-3)
        heading = tolerance(off_way, 0.1, env.config.heading_margin)
        assert terms["heading"] == pytest.approx(0.1 * high * heading, abs=1e-3)
        assert terms["height"] == pytest.approx(0.1 * high, abs=1e-4)
        assert terms["upright"] == pytest.approx(0.1 * tolerance(tilt, 0.1, rule.tilt_margin), abs=1e-3)
        assert terms["control"] == 0.0 and reward == pytest.approx(sum(terms.values()), abs=1e-6)
        seen_heads.append(head)
        turned.append(off_way)
    assert max(seen_heads) > 0.95 and min(seen_heads) < 0.6 and max(turned) > 0.2


def test_standing_still_is_worth_less_than_half_of_walking(make_env):
    """Else a policy learns to stand, which is safe, and never to walk, which pays 1 a step."""
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0)
    env.reset(seed=0)
    rewards, gait = [], []
    for _ in range(30):  # a stride
        _, reward, _, _, info = env.step(still(env))
        rewards.append(reward)
        gait.append(info["reward_terms"]["gait"])
    assert info["head_height"] > 0.95 and abs(info["distance"]) < 0.1
    # 0.3 for its posture and its heading, what a Gaussian leaves of 0.35 at no speed, and feet that share the load
    assert rewards[-1] - gait[-1] == pytest.approx(0.3 + 0.35 * tolerance(1.0, 0.1, 1.0), abs=0.02)
    assert np.mean(rewards) < 0.5


@pytest.mark.parametrize("drift", [(1.0, 0.0), (-1.0, 0.0), (0.0, -4.0)], ids=["left", "right", "the end"])
def test_who_leaves_the_way_is_out(make_env, drift):
    """To either side of the lane, or beyond its end: one and a half times as far as its speed goes in an episode."""
    env = make_env(WALK, lane=0.3, gravity=0.0, pose_noise=0.0, episode_seconds=0.6)
    env.reset(seed=0)
    state = env.batch.simulation.state
    joints = env.batch.simulation.controllers[0].state
    velocity = joints.velocity.numpy()
    velocity[0, :2] = drift
    joints.velocity.assign(velocity)
    state.vk.assign(state.vk.numpy() + np.float32([*drift, 0.0]))
    steps = 0
    terminated = False
    while not terminated and steps < 18:
        observation, _, terminated, _, info = env.step(still(env))
        aside = abs(seen(env, observation, "way_offset")[0])
        assert terminated == (aside > np.float32(0.3) or info["distance"] > 0.9)
        steps += 1
    assert 5 < steps < 14


@pytest.mark.parametrize("most_behind", [0.2, None])
def test_who_falls_behind_the_pace_is_out(make_env, most_behind):
    """Of a body that stands: by 0.9 of the target's speed it is 0.2 m behind after 0.22 s, and not out without."""
    env = make_env(WALK, root_assist=1.0, pose_noise=0.0, most_behind=most_behind)
    env.reset(seed=0)
    ends = []
    for step in range(12):
        _, _, terminated, _, info = env.step(still(env))
        behind = 0.9 * (step + 1) * env.config.physics.control_dt - info["distance"]
        assert terminated == (most_behind is not None and behind > most_behind)
        ends.append(terminated)
        if terminated:
            break
    assert len(ends) == (12 if most_behind is None else 7)


@pytest.mark.parametrize("name", ["ball_mass", "throw_speed", "throw_distance"])
def test_falling_ranges_are_refused(name):
    with pytest.raises(ConfigError, match=rf"{name}=\[3.0, 2.0\]"):
        PushRecoveryTask(load_config(PushRecoveryConfig, None, {name: [3.0, 2.0]}))
