"""Forced blow-ups: they end the episode, are named, leave finite numbers only, and the next reset works."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs import failure_name
from piavatar_envs.tasks import task_modules

KICK = "PIAvatar/KickBall-v0"
#: Array of the state, value written into it, and name of the failure.
FAULTS = [
    ("particles.x", np.nan, "nonfinite"),
    ("particles.u", np.inf, "nonfinite"),
    ("particles.C", np.nan, "nonfinite"),
    ("particles.F", np.nan, "nonfinite"),
    ("particles.F", 1e20, "nonfinite"),
    ("particles.x", 50.0, "out_of_grid"),
    ("particles.x", -1e3, "out_of_grid"),
    ("particles.u", 1e6, "cfl"),
]
#: Every fault in one task, and one fault in every task.
CASES = [(KICK, *fault) for fault in FAULTS] + [(name, *FAULTS[0]) for name in task_modules() if name != KICK]
PARTICLE = 123


def every_number(observation, reward, info) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(value, float)) for value in (observation, reward, *info.values())])


def steps(env, count: int, seed: int = 0) -> list:
    rng = np.random.default_rng(seed)
    return [env.step(rng.uniform(-1.0, 1.0, env.action_space.shape)) for _ in range(count)]


def play(env) -> list:
    """Return observations and rewards of a short episode of seed 1."""
    observation, info = env.reset(seed=1)
    assert info["failure"] == 0 and not env.batch.terminated.numpy()[0]
    return [(observation, 0.0), *(row[:2] for row in steps(env, 5))]


def alike(equal, first, second) -> bool:
    return all(equal(a[0], b[0]) and equal(a[1], b[1]) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize(("task", "name", "value", "failure"), CASES)
def test_faults_end_the_episode_and_are_named(make_env, equal, task, name, value, failure):
    env = make_env(task)
    expected = play(env)
    env.reset(seed=2)
    steps(env, 3)
    state = env.get_state()
    where = (0, slice(None), PARTICLE) if name in ("particles.C", "particles.F") else (0, PARTICLE)
    state[name][where] = value
    env.set_state(state)
    for observation, reward, terminated, truncated, info in steps(env, 2):  # stepping on is allowed
        assert terminated is True and truncated is False and failure_name(info["failure"]) == failure
        assert np.isfinite(every_number(observation, reward, info)).all()
    assert alike(equal, expected, play(env))


@pytest.mark.parametrize("name", ["particles.vk", "particles.spin"])
def test_kinematic_velocities_of_props_do_not_outlast_a_reset(make_env, equal, name):
    """Write numbers there by a state: no controller drives a prop, so that only a reset can remove them."""
    env = make_env(KICK)
    expected = play(env)
    state = env.batch.get_state()
    state[name][:] = np.nan
    env.batch.set_state(state)
    assert steps(env, 1)[0][4]["failure"] != 0
    env.reset()
    after = env.get_state()
    assert np.isfinite(after[name]).all()
    env.set_state(after)
    assert alike(equal, expected, play(env))


@pytest.mark.parametrize("stiffness", [1e4, 1e8])
def test_absurd_stiffness_at_a_forced_time_step(make_env, sample_id, equal, stiffness):
    """Stiffen a body after it was built: at the build such a time step is refused."""
    env = make_env(sample_id, young_modulus=1.1e5)
    expected = play(env)
    particles = env.batch.simulation.model.particles
    kept = {name: getattr(particles, name).numpy().copy() for name in ("mu", "lam")}
    try:
        for name, value in kept.items():
            getattr(particles, name).assign(stiffness * value)
        env.reset(seed=0)
        for row in range(60):
            observation, reward, terminated, _, info = steps(env, 1, seed=row)[0]
            assert np.isfinite(every_number(observation, reward, info)).all()
            assert env.observation_space.contains(observation)
            if terminated:
                break
        assert set(failure_name(info["failure"]).split("+")) <= {"cfl", "nonfinite", "out_of_grid"}, info
    finally:
        for name, value in kept.items():
            getattr(particles, name).assign(value)
    assert alike(equal, expected, play(env))


def test_joints_that_turn_too_fast_fail_by_name(make_env, sample_id, equal):
    """Command joints at 50 rad/s, an order beyond a human: limbs cross more than a cell a substep."""
    env = make_env(sample_id, control="pose", joint_speed_limit=50.0, num_substeps=4)
    expected = play(env)
    env.reset(seed=0)
    rng, failures = np.random.default_rng(3), set()
    for _ in range(40):
        observation, reward, terminated, _, info = env.step(rng.choice([-1.0, 1.0], env.action_space.shape))
        assert np.isfinite(every_number(observation, reward, info)).all()
        assert terminated or info["failure"] == 0
        failures.add(failure_name(info["failure"]))
        if terminated:
            env.reset()
    assert "cfl" in failures
    assert alike(equal, expected, play(env))


def test_a_failure_stays_in_its_environment(make_batch, sample_id, equal):
    batch = make_batch(sample_id, 3)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (10, *batch.action.shape)).astype(np.float32)
    runs = []
    for broken in (False, True):
        batch.reset(seeds=[3, 4, 5])
        rows = []
        for step, action in enumerate(actions):
            if broken and step == 4:
                state = batch.get_state()
                state["particles.x"][1, PARTICLE] = np.nan
                batch.set_state(state)
            batch.action.assign(action)
            batch.step()
            rows.append([array.numpy().copy() for array in (batch.observation, batch.reward, batch.terminated)])
        runs.append(rows)
    for healthy, hurt in zip(*runs, strict=True):
        assert all(equal(a[[0, 2]], b[[0, 2]]) for a, b in zip(healthy, hurt, strict=True))
    assert [bool(row[2][1]) for row in runs[1]] == [False] * 4 + [True] * 6
    batch.action.zero_()


@pytest.mark.parametrize(("task", "stiffness"), [(KICK, 1e4), ("PIAvatar/TrackMotion-v0", 2e3)])
def test_soft_bodies_get_the_substeps_that_they_need(task, stiffness, make_env):
    """Few substeps are enough for their waves, but not for the speed of their joints."""
    env = make_env(task, fidelity="coarse", young_modulus=stiffness)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(35):
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        assert info["failure"] == 0
        if terminated or truncated:
            env.reset()
