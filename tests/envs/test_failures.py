"""Blow-ups, forced: they end the episode, are named, leave nothing that is not finite, and the next reset works."""

from __future__ import annotations

import numpy as np
import pytest

#: What is broken in the middle of an episode -> (array of the state, value, name of the failure).
FAULTS = {
    "a position is not a number": ("particles.x", np.nan, "nonfinite"),
    "a velocity is infinite": ("particles.u", np.inf, "nonfinite"),
    "an affine matrix is not a number": ("particles.C", np.nan, "nonfinite"),
    "a deformation is not a number": ("particles.F", np.nan, "nonfinite"),
    "a deformation is absurd": ("particles.F", 1e20, "nonfinite"),
    "a particle has left": ("particles.x", 50.0, "out_of_grid"),
    "a particle is far below": ("particles.x", -1e3, "out_of_grid"),
    "a velocity is absurd": ("particles.u", 1e6, "cfl"),
}
PARTICLE = 123


def every_number(observation, reward, info) -> np.ndarray:
    values = [observation, [reward], list(info["reward_terms"].values()), list(info.get("cost_terms", {}).values())]
    values += [np.ravel(info[name]) for name in info if name not in ("failure", "reward_terms", "cost_terms")]
    return np.concatenate([np.ravel(np.asarray(value, float)) for value in values])


def steps(env, count: int, seed: int = 0) -> list:
    rng = np.random.default_rng(seed)
    return [env.step(rng.uniform(-1.0, 1.0, env.action_space.shape)) for _ in range(count)]


def assert_next_episode_is_normal(env, expected, equal) -> None:
    """``expected``: reset with seed 1 and five steps, before anything failed."""
    observation, info = env.reset(seed=1)
    assert info["failure"] is None and not env.batch.terminated.numpy()[0]
    got = [(observation, 0.0), *(row[:2] for row in steps(env, 5))]
    assert all(equal(a[0], b[0]) and equal(a[1], b[1]) for a, b in zip(expected, got, strict=True))


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_end_the_episode_and_are_named(make_env, env_id, equal, fault):
    name, value, failure = FAULTS[fault]
    env = make_env(env_id)
    expected = [(env.reset(seed=1)[0], 0.0), *(row[:2] for row in steps(env, 5))]
    env.reset(seed=2)
    steps(env, 3)
    state = env.get_state()
    where = (0, slice(None), PARTICLE) if name in ("particles.C", "particles.F") else (0, PARTICLE)
    state[name][where] = value
    env.set_state(state)
    observation, reward, terminated, truncated, info = steps(env, 1)[0]
    assert terminated is True and truncated is False and info["failure"] == failure
    assert np.isfinite(every_number(observation, reward, info)).all()
    # stepping on is allowed and changes nothing but the clock
    later = steps(env, 1)[0]
    assert later[2] is True and later[4]["failure"] == failure
    assert np.isfinite(every_number(later[0], later[1], later[4])).all()
    assert_next_episode_is_normal(env, expected, equal)


@pytest.mark.parametrize("name", ["particles.vk", "particles.spin"])
def test_what_drives_props_does_not_outlast_a_reset(make_env, equal, name):
    """Nothing drives a prop: only a state brings numbers there, and only a reset can take them away."""
    env = make_env("PIAvatar/KickBall-v0")
    expected = [(env.reset(seed=1)[0], 0.0), *(row[:2] for row in steps(env, 5))]
    state = env.batch.get_state()
    state[name][:] = np.nan
    env.batch.set_state(state)
    assert steps(env, 1)[0][4]["failure"] is not None
    env.reset()
    after = env.get_state()
    assert np.isfinite(after[name]).all()
    env.set_state(after)
    assert_next_episode_is_normal(env, expected, equal)


@pytest.mark.parametrize("stiffness", [1e4, 1e8])
def test_absurd_stiffness_at_a_forced_time_step(make_env, env_id, equal, stiffness):
    """The builder refuses such a step (see test_gymnasium); a body that stiffens afterwards blows up."""
    env = make_env(env_id, young_modulus=1.1e5)
    expected = [(env.reset(seed=1)[0], 0.0), *(row[:2] for row in steps(env, 5))]
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
        assert info["failure"] in ("cfl", "nonfinite", "out_of_grid", "nonfinite+cfl", "out_of_grid+cfl"), info
    finally:
        for name, value in kept.items():
            getattr(particles, name).assign(value)
    assert_next_episode_is_normal(env, expected, equal)


def test_huge_increments(make_env, env_id, equal):
    """Joints commanded at 50 rad/s, an order beyond a human, cross more than a cell a substep: said, and mended."""
    env = make_env(env_id, control="pose", joint_speed_limit=50.0, num_substeps=10)
    expected = [(env.reset(seed=1)[0], 0.0), *(row[:2] for row in steps(env, 5))]
    env.reset(seed=0)
    rng = np.random.default_rng(3)
    failures = set()
    for _ in range(40):
        action = rng.choice([-1.0, 1.0], env.action_space.shape)
        observation, reward, terminated, _, info = env.step(action)
        assert np.isfinite(every_number(observation, reward, info)).all()
        assert terminated or info["failure"] is None
        failures.add(info["failure"])
        if terminated:
            env.reset()
    assert "cfl" in failures
    assert_next_episode_is_normal(env, expected, equal)


def test_a_body_that_flies_too_fast_is_flagged(make_env):
    """300 m/s are more than a cell a substep, although the body as a whole is not strained at all."""
    env = make_env("PIAvatar/Reach-v0")
    env.reset(seed=0)
    velocity = env.batch.simulation.state.u
    velocity.assign(np.broadcast_to(np.float32([0.0, 300.0, 0.0]), velocity.shape + (3,)).copy())
    *_, terminated, _, info = steps(env, 1)[0]
    assert terminated and info["failure"] == "cfl"


def test_a_failure_stays_in_its_environment(make_batch, env_id, equal):
    batch = make_batch(env_id, 3)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (12, *batch.action.shape)).astype(np.float32)
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
            rows.append(
                (batch.observation.numpy().copy(), batch.reward.numpy().copy(), batch.terminated.numpy().copy())
            )
        runs.append(rows)
    for healthy, hurt in zip(*runs, strict=True):
        assert equal(healthy[0][[0, 2]], hurt[0][[0, 2]]) and equal(healthy[1][[0, 2]], hurt[1][[0, 2]])
    assert [bool(row[2][1]) for row in runs[1]] == [False] * 4 + [True] * 8
    assert not runs[1][-1][2][[0, 2]].any()
    batch.action.zero_()


@pytest.mark.parametrize(
    "task, settings",
    [
        ("PIAvatar/KickBall-v0", {"young_modulus": 1e4}),
        ("PIAvatar/TrackMotion-v0", {"young_modulus": 2e3}),
    ],
)
def test_soft_bodies_get_the_substeps_that_they_need(task, settings, make_env):
    """Few were enough for their waves, and every episode ended with the failure ``cfl`` within a second."""
    env = make_env(task, fidelity="coarse", **settings)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(35):
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        assert info["failure"] is None
        if terminated or truncated:
            env.reset()
    env.close()


def test_no_body_of_the_defaults_has_other_substeps_than_its_waves_ask_for(make_env):
    model = make_env("PIAvatar/Reach-v0", fidelity="coarse").unwrapped.batch.simulation.model
    assert model.num_substeps == np.ceil(model.control_dt * model.sound_speed / (0.5 * model.grid.dx) - 1e-6) == 15
