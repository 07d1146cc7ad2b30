"""Throws: their times, origins and speeds; a ball flies freely, is caught, and keeps its mass."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.core.launch_graph import LaunchGraph
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

DODGE = "PIAvatar/Dodge-v0"
GRAVITY = np.array([0.0, 0.0, -9.81])
#: Wide of the mark, so that most balls fly past.
WIDE = {"aim_spread": 1.0, "pose_noise": 0.0}


def still(env) -> np.ndarray:
    return np.zeros(env.action_space.shape)


def seen(env, observation, name: str) -> np.ndarray:
    return env.observation_layout.split(observation)[name]


def ball(env, index: int, name: str = "x") -> np.ndarray:
    """Particles of a ball in the array ``name`` of the state."""
    prop = env.batch.simulation.props.props[index]
    return getattr(env.batch.simulation.state, name).numpy()[0, prop.first : prop.first + prop.count].astype(float)


def tracked(env, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Position [m] and velocity [m/s] of a ball."""
    state = env.batch.simulation.props.state
    return state.position.numpy()[0, index].astype(float), state.velocity.numpy()[0, index].astype(float)


def spawn(env, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Where and how fast a ball was placed last."""
    spawn = env.batch.simulation.props.initial
    return spawn.position.numpy()[0, index].astype(float), spawn.velocity.numpy()[0, index].astype(float)


def joints(env) -> np.ndarray:
    return env.batch.simulation.avatar.tracked.position.numpy()[0].astype(float)


def throws(env, steps: int, seed: int) -> list[dict]:
    """Every throw of an episode without actions: step, ball, where from, how fast, and the joints at that time."""
    observation, _ = env.reset(seed=seed)
    found = []
    for step in range(steps):
        due = np.flatnonzero(seen(env, observation, "time_to_throw") == 0.0)
        at = joints(env)
        observation, *_ = env.step(still(env))
        for index in due:
            start, velocity = spawn(env, index)
            found.append({"step": step, "ball": index, "start": start, "velocity": velocity, "joints": at})
    return found


def test_balls_are_thrown_in_turn_at_the_times_that_are_told(make_env):
    env = make_env(DODGE, num_balls=3, throw_interval=0.3)
    interval, firsts = 9, set()
    for seed in range(6):
        observation, _ = env.reset(seed=seed)
        waits = np.rint(seen(env, observation, "time_to_throw") / env.config.physics.control_dt).astype(int)
        first = int(waits[0])
        firsts.add(first)
        assert 1 <= first <= interval // 2 + 1 and waits.tolist() == [first, first + interval, first + 2 * interval]
        for step in range(1, 40):
            before = [ball(env, index) for index in range(3)]
            observation, *_ = env.step(still(env))
            waits = np.where(waits == 0, 3 * interval, waits) - 1
            told = seen(env, observation, "time_to_throw")
            assert told == pytest.approx(waits * env.config.physics.control_dt, abs=1e-5)
            # what is thrown has jumped; nothing else moves half a metre in a step, but a ball that is caught
            jumps = [np.linalg.norm((ball(env, i) - before[i]).mean(0)) > 0.5 for i in range(3)]
            caught = [np.array_equal(spawn(env, i)[1], np.zeros(3)) for i in range(3)]
            for i in range(3):
                assert jumps[i] == (step - 1 - first - i * interval in (0, 3 * interval, 6 * interval)) or caught[i]
    assert len(firsts) > 2


@pytest.mark.parametrize(("place", "yaw"), [((0.0, 0.0), 0.0), ((0.5, -0.3), 2.0)])
def test_throws_begin_before_the_avatar_and_lead_to_chest_or_head(make_env, place, yaw):
    """A free flight from each start, at the speed set, comes within the spread of the line from chest to head."""
    avatar = {"position": list(place), "yaw": yaw}
    env = make_env(DODGE, throw_interval=0.2, pose_noise=0.2, **{"scene.avatars": [avatar]})
    config, rows = env.config, []
    back = Rotation.from_rotvec([0.0, 0.0, -yaw])
    for seed in range(6):
        for throw in throws(env, 60, seed):
            start, velocity = throw["start"], throw["velocity"]
            away = back.apply(start - [*place, 0.0])
            distance, angle = np.hypot(*away[:2]), np.arctan2(away[0], -away[1])
            chest, head = throw["joints"][joint_index("spine3")], throw["joints"][joint_index("head")]
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
    # numbers of a throw do not come from one another
    correlation = np.corrcoef(rows[:, :4].T) - np.eye(4)
    assert np.abs(correlation).max() < 4.0 / np.sqrt(len(rows))


def test_a_thrown_ball_flies_freely_and_keeps_its_mass(make_env):
    env = make_env(DODGE, **WIDE)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        mass = env.batch.simulation.model.particles.mass.numpy().copy()
        told = seen(env, observation, "ball_mass")
        for index, prop in enumerate(env.batch.simulation.props.props):
            assert mass[0, prop.first : prop.first + prop.count].sum() == pytest.approx(told[index], rel=1e-4)
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


def test_masses_are_spread_and_drawn_for_each_ball(make_env):
    env = make_env(DODGE, num_balls=2)
    masses = np.array([seen(env, env.reset(seed=seed)[0], "ball_mass") for seed in range(80)])
    low, high = env.config.ball_mass
    assert low <= masses.min() < low + 0.1 and high - 0.1 < masses.max() <= high + 1e-4
    assert np.abs(np.corrcoef(masses.T)[0, 1]) < 4.0 / np.sqrt(len(masses))


def test_placing_a_prop_touches_its_particles_in_the_masked_environments_only(make_batch):
    """Rigid motion with the momentum and spin that were asked for, unstrained, of the same mass."""
    batch = make_batch(DODGE, 3)
    batch.reset(seeds=[0, 1, 2])
    for _ in range(12):
        batch.step()
    simulation, index = batch.simulation, 1
    props, rng = simulation.props, np.random.default_rng(0)
    for name, values in (("position", rng.normal(size=(3, 2, 3))), ("velocity", rng.normal(size=(3, 2, 3)) * 5.0)):
        getattr(props.initial, name).assign(values.astype(np.float32))
    props.initial.spin.assign(rng.normal(size=(3, 2, 3)).astype(np.float32))
    graph, before = LaunchGraph(batch.device), simulation.state.numpy()
    before = {name: value.copy() for name, value in before.items()}
    mask = np.array([True, False, True])
    props.record_place(graph, simulation.state, wp.array(mask, dtype=wp.bool, device=batch.device), index)
    graph.run()
    after, prop = simulation.state.numpy(), props.props[index]
    own = slice(prop.first, prop.first + prop.count)
    for name, value in after.items():
        if value.ndim > 1:
            others = np.ones(value.shape[1], bool)
            others[own] = False
            assert np.array_equal(value[:, others], before[name][:, others]), name
            assert np.array_equal(value[~mask], before[name][~mask]), name
    mass = simulation.model.particles.mass.numpy()[:, own].astype(float)
    for e in np.flatnonzero(mask):
        x, u, C, F = (after[name][e, own].astype(float) for name in ("x", "u", "C", "F"))
        center, velocity, spin = (
            getattr(props.initial, name).numpy()[e, index].astype(float) for name in ("position", "velocity", "spin")
        )
        m = mass[e]
        assert m @ x / m.sum() == pytest.approx(center, abs=1e-5)
        assert m @ u / m.sum() == pytest.approx(velocity, abs=1e-5)
        arm = x - center
        inertia = (m * (arm**2).sum(1)).sum() * np.eye(3) - np.einsum("p,pi,pj", m, arm, arm)
        assert np.cross(arm, m[:, None] * (u - velocity)).sum(0) == pytest.approx(inertia @ spin, abs=1e-6)
        assert np.array_equal(F, np.broadcast_to(np.eye(3), F.shape))
        assert np.allclose(np.cross(spin, arm), np.einsum("pij,pj->pi", C, arm), atol=1e-5)


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
    """Its turn wins over catching; what lies far out, or comes back, is no ball that flies on."""
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


def test_a_ball_that_has_flown_past_is_caught_and_waits(make_env):
    """It lies behind the avatar until its turn, and never comes back from a wall."""
    env = make_env(DODGE, throw_speed=[7.0, 8.0], throw_interval=1.0, **WIDE)
    waiting, radius = waiting_places((0.0, 0.0, 0.0), env.config), catching_distance(env.config)
    caught = 0
    for seed in range(4):
        env.reset(seed=seed)
        was = [tracked(env, index) for index in range(2)]
        for index in range(2):
            assert was[index][0] == pytest.approx(waiting[index], abs=1e-3) and was[index][0][1] > 1.0
        for _ in range(60):
            env.step(still(env))
            for index in range(2):
                at, velocity = tracked(env, index)
                jumped = np.linalg.norm(at - was[index][0]) > 0.5
                if jumped and np.linalg.norm(at - waiting[index]) < 0.05:
                    caught += 1
                    distance = np.hypot(*was[index][0][:2])
                    assert distance > radius and was[index][0][:2] @ was[index][1][:2] > 0.0
                    assert np.linalg.norm(velocity) < 0.4
                out = at[:2] / np.hypot(*at[:2])
                if np.hypot(*at[:2]) > radius:
                    assert velocity[:2] @ out > -0.2 or velocity[:2] @ spawn(env, index)[1][:2] > 0.0
                was[index] = at, velocity
    assert caught >= 3


def test_throws_go_on_from_a_restored_state(make_env, equal):
    """Saved with a ball in the air and restored elsewhere, everything happens again, throws to come included."""
    env, twin = make_env(DODGE), make_env(DODGE, twin=1)
    observation, _ = env.reset(seed=5)
    while seen(env, observation, "time_to_throw")[0] > 0.0:
        observation, *_ = env.step(still(env))
    for _ in range(3):
        env.step(still(env))
    assert tracked(env, 0)[0][2] > 0.5 and np.linalg.norm(tracked(env, 0)[1]) > 2.0
    state = env.get_state()
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.5, 0.5, (45, *env.action_space.shape))
    first = [env.step(action) for action in actions]
    twin.reset(seed=99)
    twin.set_state(state)
    for action, row in zip(actions, first, strict=True):
        again = twin.step(action)
        assert equal(row[0], again[0]) and equal(row[1], again[1]) and equal(row[4]["cost"], again[4]["cost"])
    assert first[-1][4]["hits"] >= 2


def test_seeds_and_episodes_have_throws_of_their_own(make_env):
    env = make_env(DODGE, throw_interval=0.2)
    runs = [throws(env, 20, seed) for seed in (0, 0, 1)]
    starts = [np.array([throw["start"] for throw in run]) for run in runs]
    assert np.array_equal(starts[0], starts[1])
    few = min(map(len, starts))
    assert np.abs(starts[0][:few] - starts[2][:few]).min(0).max() > 1e-3
    distinct = np.unique(starts[0].round(5), axis=0)
    assert len(distinct) == len(starts[0]) >= 3
