"""Dodge: balls are thrown, fly freely and are caught; costs agree with the sensors, rewards with pose and place."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, joint_index
from piavatar_envs.envs.episodes import Bones, Props
from piavatar_envs.tasks.common.thrown_balls import (
    CLEARANCE,
    HEIGHT,
    Throws,
    catching_distance,
    out_of_the_body,
    throw_or_catch,
    waiting_places,
)
from tests.tasks.measured import joints, pelvis, seen, still

DODGE = "PIAvatar/Dodge-v0"
GRAVITY = np.array([0.0, 0.0, -9.81])
#: Wide of the mark, so that most balls fly past.
WIDE = {"aim_spread": 1.0, "pose_noise": 0.0}


def ball(env, index: int, name: str = "x") -> np.ndarray:
    """Particles of a ball in the array ``name`` of the state."""
    prop = env.batch.simulation.props.props[index]
    return getattr(env.batch.simulation.state, name).numpy()[0, prop.first : prop.first + prop.count].astype(float)


def tracked(env, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Position [m] and velocity [m/s] of a ball."""
    state = env.batch.simulation.props.state
    return state.position.numpy()[0, index].astype(float), state.velocity.numpy()[0, index].astype(float)


def spawn(env, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Position [m] and velocity [m/s] with which a ball was placed last."""
    spawn = env.batch.simulation.props.initial
    return spawn.position.numpy()[0, index].astype(float), spawn.velocity.numpy()[0, index].astype(float)


def test_balls_are_thrown_in_turn_at_the_times_observed(make_env):
    env = make_env(DODGE, num_balls=3, throw_interval=0.3)
    interval, firsts = 9, set()
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
        waits = np.rint(seen(env, observation, "time_to_throw") / env.config.physics.control_dt).astype(int)
        first = int(waits[0])
        firsts.add(first)
        assert 1 <= first <= interval // 2 + 1 and waits.tolist() == [first, first + interval, first + 2 * interval]
        for step in range(1, 40):
            before = [ball(env, index) for index in range(3)]
            observation, *_ = env.step(still(env))
            waits = np.where(waits == 0, 3 * interval, waits) - 1
            expected = waits * env.config.physics.control_dt
            assert seen(env, observation, "time_to_throw") == pytest.approx(expected, abs=1e-5)
            # what is thrown has jumped; nothing else moves half a metre in a step, but a ball that is caught
            jumps = [np.linalg.norm((ball(env, i) - before[i]).mean(0)) > 0.5 for i in range(3)]
            caught = [np.array_equal(spawn(env, i)[1], np.zeros(3)) for i in range(3)]
            for i in range(3):
                assert jumps[i] == (step - 1 - first - i * interval in (0, 3 * interval, 6 * interval)) or caught[i]
    assert len(firsts) > 2


def test_throws_begin_before_the_avatar_and_lead_to_chest_or_head(make_env):
    """A free flight from each start, at the speed set, comes within the spread of the line from chest to head."""
    place, yaw = (0.5, -0.3), 2.0
    avatar = {"position": list(place), "yaw": yaw}
    env = make_env(DODGE, throw_interval=0.2, pose_noise=0.2, **{"scene.avatars": [avatar]})
    config, rows, masses = env.config, [], []
    back = Rotation.from_rotvec([0.0, 0.0, -yaw])
    for seed in range(6):
        observation, _ = env.reset(seed=seed)
        masses.append(seen(env, observation, "ball_mass"))
        for _ in range(60):
            due = np.flatnonzero(seen(env, observation, "time_to_throw") == 0.0)
            at = joints(env)
            observation, *_ = env.step(still(env))
            if not due.size:
                continue
            start, velocity = spawn(env, due[0])
            away = back.apply(start - [*place, 0.0])
            distance, angle = np.hypot(*away[:2]), np.arctan2(away[0], -away[1])
            chest, head = at[joint_index("spine3")], at[joint_index("head")]
            time = np.linspace(0.0, 0.6, 2401)[:, None]
            path = start + velocity * time + 0.5 * GRAVITY * time**2
            share = np.clip((path - chest) @ (head - chest) / np.sum((head - chest) ** 2), 0.0, 1.0)
            miss = np.linalg.norm(path - chest - share[:, None] * (head - chest), axis=1)
            speed = np.linalg.norm(path[miss.argmin()] - start) / time[miss.argmin(), 0]
            rows.append([distance, angle, start[2], speed, miss.min()])
    rows = np.array(rows)
    ranges = [config.throw_distance, (-config.throw_angle, config.throw_angle), HEIGHT, config.throw_speed]
    for values, (low, high) in zip(rows.T, ranges, strict=False):
        slack = 0.05 * (high - low)
        assert low - slack < values.min() < low + 4.0 * slack and high - 4.0 * slack < values.max() < high + slack
    assert 0.5 * config.aim_spread < rows[:, 4].max() < np.sqrt(3.0) * config.aim_spread
    low, high = config.ball_mass
    assert low <= np.min(masses) < np.max(masses) <= high + 1e-4 and np.ptp(masses) > 0.5 * (high - low)
    # numbers of a throw do not come from one another
    correlation = np.corrcoef(rows[:, :4].T) - np.eye(4)
    assert np.abs(correlation).max() < 4.0 / np.sqrt(len(rows))


def test_a_thrown_ball_flies_freely_and_keeps_its_mass(make_env):
    env = make_env(DODGE, **WIDE)
    for seed in range(2):
        observation, _ = env.reset(seed=seed)
        mass = env.batch.simulation.model.particles.mass.numpy().copy()
        observed = seen(env, observation, "ball_mass")
        for index, prop in enumerate(env.batch.simulation.props.props):
            assert mass[0, prop.first : prop.first + prop.count].sum() == pytest.approx(observed[index], rel=1e-4)
        while seen(env, observation, "time_to_throw")[0] > 0.0:
            observation, *_ = env.step(still(env))
        for step in range(1, 4):
            observation, *_ = env.step(still(env))
            (start, velocity), time = spawn(env, 0), step * env.config.physics.control_dt
            at, moving = tracked(env, 0)
            assert moving == pytest.approx(velocity + GRAVITY * time, abs=0.02)
            # a substep's gravity acts before its motion
            assert at == pytest.approx(start + velocity * time + 0.5 * GRAVITY * time**2, abs=0.01)
        assert np.array_equal(mass, env.batch.simulation.model.particles.mass.numpy())


@wp.kernel
def clear(joints: wp.array2d(dtype=wp.vec3), start: wp.vec3, outwards: wp.vec3, found: wp.array(dtype=wp.vec3)):
    e = wp.tid()
    found[e] = out_of_the_body(joints, e, start, outwards)


def test_a_ball_does_not_begin_in_a_limb_that_reaches_out(device):
    rng, start, outwards = np.random.default_rng(0), np.array([0.0, -1.25, 1.25]), np.array([0.0, -1.0, 0.0])
    limbs = rng.uniform([-0.5, -1.6, 0.8], [0.5, -0.6, 1.6], (200, 3, 3))
    limbs[0] += [0.0, 2.0, 0.0]  # an avatar that keeps its limbs to itself
    array, found = wp.array(limbs, dtype=wp.vec3, device=device), wp.zeros(200, dtype=wp.vec3, device=device)
    wp.launch(clear, 200, [array, wp.vec3(*start), wp.vec3(*outwards)], [found], device=device)
    moved = found.numpy() - start
    assert np.abs(np.cross(moved, outwards)).max() < 1e-6 and (moved @ outwards >= 0.0).all()
    before, after = (np.linalg.norm(limbs - at, axis=2).min(1) for at in (start, found.numpy()[:, None]))
    assert (after > CLEARANCE - 1e-5).all() and (before < CLEARANCE).sum() > 50
    # no farther than to the last limb's clearance
    assert after[moved @ outwards > 0.0] == pytest.approx(CLEARANCE, abs=1e-5) and not moved[0].any()


@wp.kernel
def play(
    throws: Throws,
    due: wp.array(dtype=wp.bool),
    bones: Bones,
    props: Props,
    placed: wp.array(dtype=wp.bool),
    first: Props,
):
    e = wp.tid()
    random = wp.rand_init(7, e)
    placed[e] = throw_or_catch(throws, due[e], random, e, 1, bones, props, first)


def test_a_ball_is_thrown_when_due_caught_beyond_the_radius_and_else_left_alone(make_env, device):
    """Its turn wins over catching; what lies far out, or comes back, is not a ball that flies on."""
    env = make_env(DODGE)
    env.reset(seed=0)
    out, still_there = [0.0, 1.2 * catching_distance(env.config), 0.5], [0.0, 0.0, 0.0]
    cases = [  # due, where, how fast -> thrown, caught
        (True, still_there, still_there, True, False),
        (True, out, [0.0, 3.0, 0.0], True, False),
        (False, out, [0.0, 3.0, 0.0], False, True),
        (False, out, still_there, False, False),
        (False, out, [0.0, -3.0, 0.0], False, False),
        (False, [0.0, 0.5, 0.5], [0.0, 3.0, 0.0], False, False),
    ]
    n, nowhere = len(cases), np.full((len(cases), 2, 3), np.nan, np.float32)

    def vectors(rows) -> wp.array:
        return wp.array(np.repeat(np.array(rows, np.float32)[:, None], 2, axis=1), dtype=wp.vec3, device=device)

    due, at, moving, thrown, caught = (list(column) for column in zip(*cases, strict=True))
    bones, props, first = Bones(), Props(), Props()
    bones.position = wp.array(np.repeat(joints(env)[None], n, axis=0), dtype=wp.vec3, device=device)
    props.position, props.velocity = vectors(at), vectors(moving)
    placed = wp.zeros(n, dtype=wp.bool, device=device)
    first.position, first.velocity, first.spin = (wp.array(nowhere, dtype=wp.vec3, device=device) for _ in range(3))
    due = wp.array(due, dtype=wp.bool, device=device)
    wp.launch(play, n, [env.batch.task.throws, due, bones, props], [placed, first], device=device)
    position, velocity, spin = (array.numpy() for array in (first.position, first.velocity, first.spin))
    rest = waiting_places((0.0, 0.0, 0.0), env.config)[1]
    assert placed.numpy().tolist() == [a or b for a, b in zip(thrown, caught, strict=True)]
    for e in range(n):
        if thrown[e]:
            assert np.hypot(*position[e, 1, :2]) > 1.29 and np.linalg.norm(velocity[e, 1]) > 3.0 and spin[e, 1].any()
        elif caught[e]:
            assert position[e, 1] == pytest.approx(rest) and not velocity[e, 1].any() and not spin[e, 1].any()
        else:
            assert np.isnan(position[e, 1]).all() and np.isnan(velocity[e, 1]).all() and np.isnan(spin[e, 1]).all()
    assert all(np.isnan(array[:, 0]).all() for array in (position, velocity, spin))  # the other ball's


def test_waiting_balls_do_not_disturb(make_env):
    env = make_env(DODGE, throw_interval=60.0, pose_noise=0.0)
    env.reset(seed=0)
    for index, place in enumerate(waiting_places((0.0, 0.0, 0.0), env.config)):
        assert tracked(env, index)[0] == pytest.approx(place, abs=1e-3) and place[1] > 1.0
    for _ in range(10):
        info = env.step(still(env))[4]
        assert info["impulse"] == 0.0 and info["hits"] == 0.0 and info["success"] and info["cost"] == 0.0
        assert info["rotation_error_deg"] < 1e-3 and info["root_error"] < 1e-4


def test_costs_hits_and_success_are_those_of_the_sensors(make_env):
    env = make_env(DODGE, stress_limit=0.02, throw_interval=0.4)
    sensors, outcomes = env.batch.simulation.sensors, set()
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        struck, hits = np.zeros(2, bool), 0
        rng = np.random.default_rng(seed)
        for _ in range(50):
            struck[seen(env, observation, "time_to_throw") == 0.0] = False
            observation, _, _, _, info = env.step(0.3 * rng.uniform(-1.0, 1.0, env.action_space.shape))
            impulses = np.linalg.norm(sensors.pair_impulse.numpy()[0, 1:3].astype(float), axis=1)
            parts = sensors.part_impulse.numpy()[0].astype(float)
            assert np.linalg.norm(parts[:, 1:3].sum(0), axis=1) == pytest.approx(impulses, abs=2e-3)
            assert info["impulse"] == pytest.approx(impulses.sum(), rel=1e-5, abs=1e-7)
            assert info["cost_impulse"] == pytest.approx(impulses.sum() / env.config.impulse_scale, abs=1e-5)
            above = [name not in ("left_leg", "right_leg") for name in BODY_PARTS]
            peak = float(seen(env, observation, "stress")[above].max())
            assert info["stress"] == pytest.approx(peak, rel=1e-5)
            assert info["cost_stress"] == pytest.approx(max(peak / 0.02 - 1.0, 0.0), rel=1e-4, abs=1e-5)
            assert info["cost"] == pytest.approx(sum((info["cost_impulse"], info["cost_stress"])), rel=1e-5)
            new = (impulses > env.config.hit_impulse) & ~struck
            struck |= new
            hits += new.sum()
            assert info["hits"] == hits and info["success"] == (not struck.any())
            outcomes.add((info["success"], info["cost_stress"] > 0.0))
        assert hits >= 2
    assert {success for success, _ in outcomes} == {True, False} == {costs for _, costs in outcomes}


def test_reward_is_for_the_rest_pose_in_its_place(make_env):
    avatar = {"position": [0.4, -0.2], "yaw": 2.0}
    env, place = make_env(DODGE, **{"scene.avatars": [avatar]}), avatar["position"]
    upright = Rotation.from_rotvec([0.0, 0.0, avatar["yaw"]])
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    direction = rng.uniform(-1.0, 1.0, env.action_space.shape)
    for _ in range(15):
        observation, _, _, _, info = env.step(0.5 * direction)
        state = env.batch.simulation.avatar.tracked
        local = Rotation.from_quat(state.local.numpy()[0])
        angles = [(upright.inv() * local[0]).magnitude(), *local[1:].magnitude()]
        rest = upright.apply(env.batch.simulation.flesh[0].points.joints[0, 0]) + [*place, 0.0]
        off = joints(env)[0] - rest
        assert info["rotation_error_deg"] == pytest.approx(np.degrees(np.mean(angles)), abs=2e-3)
        assert info["root_error"] == pytest.approx(np.hypot(*off[:2]), abs=1e-5)
        for name, weight, value, bound, margin in (
            ("pose", 0.6, np.mean(angles), 0.05, env.config.pose_margin),
            ("place", 0.4, np.hypot(*off[:2]), 0.02, env.config.place_margin),
        ):
            expected = weight * 10.0 ** -((max(value - bound, 0.0) / margin) ** 2)
            assert info[f"reward_{name}"] == pytest.approx(expected, abs=2e-4)
        assert pelvis(env)[1].apply(seen(env, observation, "place_position")) == pytest.approx(-off, abs=1e-5)
    assert info["reward_pose"] < 0.5 and info["reward_place"] < 0.39


def test_the_root_is_steered_to_its_range_and_no_farther(make_env):
    env = make_env(DODGE, throw_interval=60.0, pose_noise=0.0)
    for way in np.array([[1.0, 0.0], [0.0, -1.0], [-1.0, 1.0]]):
        env.reset(seed=0)
        action = still(env)
        at = env.action_names.index("root.x")
        action[at : at + 2] = way
        errors, commanded = [], []
        for _ in range(20):
            errors.append(env.step(action)[4]["root_error"])
            goal = env.batch.simulation.avatar.state.goal_root.numpy()[0]
            commanded.append(np.hypot(*(goal[:2] - env.batch.task.place[:2])))
        assert errors[-1] == pytest.approx(env.config.root_range, abs=0.03) and max(errors) < errors[-1] + 0.01
        assert max(commanded) <= env.config.root_range + 1e-6
        if abs(way).sum() == 2.0:  # a step along both axes is the longest
            assert max(commanded) == pytest.approx(env.config.root_range, abs=1e-4)
