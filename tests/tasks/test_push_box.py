"""PushBox: draws and observations agree with the particles; the box obeys momentum and friction."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.tasks.push_box import ROOT_LEAD, WALK, PushBoxConfig, PushBoxTask
from tests.tasks.measured import middle, pelvis, prop_motion, prop_particles, still, tolerance

PUSH = "PIAvatar/PushBox-v0"
GRAVITY = 9.81
STRAIGHT = {"target_angle": 0.0, "box_turn": 0.0, "pose_noise": 0.0}
#: Rotation vectors [rad] of a body that is bent forward with both hands before it; right arms are mirrored.
BENT = {
    "spine1": (0.45, 0.0, 0.0),
    "spine2": (0.45, 0.0, 0.0),
    "spine3": (0.45, 0.0, 0.0),
    "left_collar": (0.0, -0.5, 0.0),
    "left_shoulder": (-0.9, -0.2, -0.8),
    "left_elbow": (0.3, 0.0, 0.3),
}


def box_pose(env) -> tuple[np.ndarray, Rotation]:
    """Centre of mass [m] and rotation of the box, from its particles."""
    own, simulation = prop_particles(env.batch, "box"), env.batch.simulation
    mass, x = (a.numpy()[0, own].astype(float) for a in (simulation.model.particles.mass, simulation.state.x))
    center = mass @ x / mass.sum()
    rest = env.batch.simulation.props.points[0].rest.astype(float)
    return center, Rotation.align_vectors(x - center, rest, weights=mass)[0]


def box_motion(env) -> tuple[float, np.ndarray]:
    """Mass [kg] and velocity [m/s] of the box."""
    mass, _, velocity = prop_motion(env.batch, "box")
    return mass[0], velocity[0]


def hands(env) -> np.ndarray:
    """Middles of the hands ``(2, 3)`` [m]."""
    return np.array([middle(env, name) for name in ("left_wrist", "right_wrist")])


def target(env) -> np.ndarray:
    return env.batch.task.target.numpy()[0].astype(float)


def gap(env, point) -> float:
    """Distance of a point from the surface of the box, 0 inside [m]."""
    center, turn = box_pose(env)
    beyond = np.abs(turn.inv().apply(point - center)) - env.config.box_half_size
    return float(np.linalg.norm(np.maximum(beyond, 0.0)))


def set_box_velocity(env, velocity) -> None:
    u = env.batch.simulation.state.u.numpy()
    u[0, prop_particles(env.batch, "box")] += np.float32(velocity)
    env.batch.simulation.state.u.assign(u)


def bend_towards_box(env) -> np.ndarray:
    """Actions that bring the commanded joints to ``BENT``."""
    command = Rotation.from_quat(env.batch.simulation.avatar.state.command_rotation.numpy()[0])
    action = still(env)
    step = env.config.control.joint_speed_limit * env.config.physics.control_dt
    for name, vector in BENT.items():
        for side, mirror in (("left", 1.0), ("right", -1.0)) if name.startswith("left") else (("", 1.0),):
            joint = name.replace("left", side) if side else name
            wanted = Rotation.from_rotvec(np.array(vector) * [1.0, mirror, mirror])
            at = env.action_names.index(f"{joint}.x")
            error = (command[joint_index(joint)].inv() * wanted).as_rotvec()
            action[at : at + 3] = np.clip(error / step, -1.0, 1.0)
    return action


def walk(env, forward: float) -> np.ndarray:
    """Bent, and walking straight ahead at ``forward`` [m/s]."""
    action = bend_towards_box(env)
    action[env.action_names.index("root.y")] = -forward / WALK
    return action


def test_box_and_target_are_drawn_before_the_avatar(make_env):
    place, yaw = np.array([0.6, -0.3]), 2.0
    env = make_env(PUSH, **{"scene.avatars": [{"position": place.tolist(), "yaw": yaw}]})
    config = env.config
    back = Rotation.from_rotvec([0.0, 0.0, -yaw])
    rows = []
    for seed in range(40):
        observation, _ = env.reset(seed=seed)
        center, turn = box_pose(env)
        mass = box_motion(env)[0]
        assert env.observation_layout.split(observation)["box_mass"] == pytest.approx(mass, rel=1e-4)
        out = back.apply([*(center[:2] - place), 0.0])
        assert out[0] == pytest.approx(0.0, abs=1e-4) and center[2] == pytest.approx(config.box_half_size[2], abs=1e-4)
        way = back.apply([*(target(env)[:2] - center[:2]), 0.0])
        heading = (back * turn).as_rotvec()
        assert np.abs(heading[:2]).max() < 1e-4 and target(env)[2] == 0.0
        rows.append([mass, -out[1], heading[2], np.hypot(*way[:2]), np.arctan2(way[0], -way[1])])
    ranges = [
        config.box_mass, config.box_distance, (-config.box_turn, config.box_turn), config.target_distance,
        (-config.target_angle, config.target_angle),
    ]  # fmt: skip
    for values, (low, high) in zip(np.transpose(rows), ranges, strict=True):
        assert low - 1e-3 < values.min() < low + 0.2 * (high - low)
        assert high - 0.2 * (high - low) < values.max() < high + 1e-3


def test_numbers_and_observations_are_those_of_numpy(make_env):
    env = make_env(PUSH, target_radius=0.45)
    successes = set()
    for seed in range(4):
        env.reset(seed=seed)
        at_first = np.linalg.norm((target(env) - box_pose(env)[0])[:2])
        for n in range(40):
            observation, _, _, _, info = env.step(walk(env, 0.8))
            if n % 4:
                continue
            center = box_pose(env)[0]
            way = target(env) - center
            distance = np.linalg.norm(way[:2])
            gaps = [gap(env, hand) for hand in hands(env)]
            assert info["distance"] == pytest.approx(distance, abs=2e-5)
            assert [info["left_hand_gap"], info["right_hand_gap"]] == pytest.approx(gaps, abs=1e-4)
            push = tolerance(distance, env.config.target_radius, max(at_first - env.config.target_radius, 0.1))
            assert info["reward_push"] == pytest.approx(0.8 * push, abs=2e-4)
            near = sum(tolerance(hand_gap, 0.1, env.config.hand_margin) for hand_gap in gaps)
            assert info["reward_hands"] == pytest.approx(0.1 * near, abs=2e-4)
            assert info["box_speed"] == pytest.approx(np.linalg.norm(box_motion(env)[1]), abs=1e-4)
            if abs(distance - env.config.target_radius) > 1e-4:
                assert info["success"] == (distance < env.config.target_radius)
            successes.add(info["success"])
            check_observation(env, observation, center, way)
    assert successes == {True, False}, "the case must see both"


def check_observation(env, observation, center, way) -> None:
    seen, (at, turn) = env.observation_layout.split(observation), pelvis(env)
    assert at + turn.apply(seen["target_position"]) == pytest.approx(target(env), abs=1e-5)
    assert turn.apply(seen["target_from_box"]) == pytest.approx([way[0], way[1], 0.0], abs=2e-5)
    for side, hand in zip(("left", "right"), hands(env), strict=True):
        assert turn.apply(seen[f"box_from_{side}_hand"]) == pytest.approx(center - hand, abs=5e-5)
    state = env.batch.simulation.avatar.state
    heading, commanded = (twist(q) for q in (turn, Rotation.from_quat(state.command_rotation.numpy()[0, 0])))
    lead = Rotation.from_rotvec([0.0, 0.0, -heading]).apply(state.command_root.numpy()[0] - at)
    assert seen["command_lead"] == pytest.approx([lead[0], lead[1], commanded - heading], abs=1e-5)


def twist(rotation: Rotation) -> float:
    """Angle of the part of a rotation that turns about the vertical [rad]."""
    _, _, z, w = rotation.as_quat()
    return 2.0 * np.arctan2(z, w)


def test_the_box_gains_the_momentum_that_the_body_gives(make_env):
    """On a floor without friction the push is all that changes its horizontal momentum."""
    env = make_env(PUSH, box_friction=0.0, **STRAIGHT)
    env.reset(seed=1)
    momentum = total = np.zeros(3)
    for _ in range(40):
        info = env.step(walk(env, 0.8))[4]
        sensors = env.batch.simulation.sensors.pair_impulse.numpy()[0]
        given = -sensors[1]  # what the box, subject 1, does to the avatar, subject 0
        assert info["push_impulse"] == pytest.approx(np.linalg.norm(given), rel=1e-5, abs=1e-7)
        mass, velocity = box_motion(env)
        now = mass * velocity
        assert (now - momentum)[:2] == pytest.approx(given[:2], abs=2e-3)
        momentum, total = now, total + given
    assert total[1] < -5.0, "the body has to have pushed"


@pytest.mark.parametrize("friction", [0.1, 0.2])
def test_friction_stops_a_sliding_box(make_env, friction):
    """As long as it slides, the floor takes ``friction`` of what it bears; on average it bears the weight."""
    env = make_env(PUSH, box_friction=friction, **STRAIGHT)
    env.reset(seed=0)
    mass, start, speed = box_motion(env)[0], box_pose(env)[0], 1.2
    set_box_velocity(env, [0.0, -speed, 0.0])
    time, dt = speed / (friction * GRAVITY), env.config.physics.control_dt
    impulses, ways = [], []
    for _ in range(round(time / dt) + 60):
        env.step(still(env))
        impulses.append(env.batch.simulation.sensors.boundary_impulse.numpy()[0, 1].astype(float))
        ways.append(start[1] - box_pose(env)[0][1])
    impulses, sliding = np.array(impulses), round(0.4 * time / dt)  # it sways, and may stick for a moment later
    assert impulses[:sliding, 1].sum() == pytest.approx(friction * impulses[:sliding, 2].sum(), rel=0.03)
    assert (np.abs(impulses[:, 1]) <= 1.02 * friction * impulses[:, 2] + 1e-3).all()
    assert impulses[:, 2].mean() == pytest.approx(mass * GRAVITY * dt, rel=0.05)
    # its middle is farthest while it still leans forward; then it swings back, and creeps a little
    assert max(ways) == pytest.approx(speed**2 / (2.0 * friction * GRAVITY), rel=0.15)
    assert abs(np.mean(ways[-15:]) - np.mean(ways[-30:-15])) < 0.02


@pytest.mark.parametrize("seed", [0, 3])
def test_a_script_pushes_the_box_to_its_target(make_env, seed):
    """Bent, straight ahead, slower as the box comes near, and then still: within three quarters of an episode."""
    env = make_env(PUSH, **STRAIGHT)
    _, info = env.reset(seed=seed)
    info["distance"] = 1.0
    for _ in range(180):
        speed = 0.5 * min(1.0, info["distance"] / 0.4) if info["distance"] > 0.1 else 0.0
        _, _, terminated, truncated, info = env.step(walk(env, speed))
        assert not terminated and not truncated
    assert info["success"] and info["distance"] < env.config.target_radius


def test_a_wall_that_blocks_the_body_holds_its_command_back(make_env):
    """Backwards into a wall: without the clamp the command would run away, and the root would let go."""
    wall = {"name": "wall", "kind": "box", "size": [1.0, 0.1, 1.0], "position": [0.0, 0.45, 1.0]}
    env = make_env(PUSH, **STRAIGHT, **{"scene.colliders": [wall]})
    env.reset(seed=0)
    action = still(env)
    action[env.action_names.index("root.y")] = 1.0
    leads = []
    for _ in range(60):
        observation, _, terminated, _, info = env.step(action)
        assert not terminated and info["failure"] == 0
        leads.append(env.observation_layout.split(observation)["command_lead"][1])
    assert env.batch.simulation.avatar.tracked.position.numpy()[0, 0, 1] < 0.4
    # taken back before the step of the action is added; and the wall throws the body back a little
    assert 0.5 * ROOT_LEAD < max(leads) <= ROOT_LEAD + 2.0 * WALK * env.config.physics.control_dt


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"box_mass": [9.0, 5.0]}, r"box_mass=\[9.0, 5.0\]"),
        ({"target_distance": [0.0, 1.0]}, r"target_distance=\[0.0, 1.0\].*positive"),
        ({"box_distance": [0.5, 1.0]}, r"box_distance=\[0.5, 1.0\].*0.74 m"),
        ({"scene.avatars": [{}, {}]}, "one avatar"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, reason):
    with pytest.raises(ConfigError, match=reason):
        PushBoxTask(load_config(PushBoxConfig, None, settings))
