"""Header: how the ball falls, where the head is, and that a nod in time sends the ball forward."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.tasks.header import HEAD_RADIUS, TOUCH_HEIGHT

HEADER = "PIAvatar/Header-v0"
GRAVITY = 9.81


def ball(batch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass [kg], centre [m] and velocity [m/s] of every environment's ball, from the particles."""
    prop = batch.simulation.props.props[batch.task.index]
    own, state = slice(prop.first, prop.first + prop.count), batch.simulation.state
    mass = batch.simulation.model.particles.mass.numpy()[:, own].astype(float)
    share = mass / mass.sum(1, keepdims=True)
    x, v = state.x.numpy()[:, own], state.u.numpy()[:, own] + state.vk.numpy()[:, own]
    return mass.sum(1), np.einsum("ep,epi->ei", share, x), np.einsum("ep,epi->ei", share, v)


def head(env) -> np.ndarray:
    """Middle of the head's flesh in the world [m]: its rest centre of mass, carried by Kabsch in NumPy."""
    simulation = env.batch.simulation
    points, x = simulation.flesh[0].points, simulation.state.x.numpy()[0].astype(float)
    rest, mass = points.rest[0].astype(float), points.mass[0].astype(float)
    weight = mass * (points.skin_weights * (points.skin_joints == joint_index("head"))).sum(1)
    middle = weight @ rest / weight.sum()
    p = np.flatnonzero(points.bone == joint_index("head"))
    turn = Rotation.align_vectors(x[p] - x[p].mean(0), rest[p] - rest[p].mean(0))[0]
    return x[p].mean(0) + turn.apply(middle - rest[p].mean(0))


def test_balls_come_down_about_their_place(make_batch):
    """By free fall from where they start, each reaches the head's height within the jitter of the place."""
    batch = make_batch(HEADER, 32)
    config, falls, masses = batch.config, [], []
    for episode in range(5):
        observation = batch.reset(seeds=range(50, 82) if episode == 0 else None).numpy()
        mass, x, v = ball(batch)
        assert observation[:, 0, batch.layout["ball_mass"].slice][:, 0] == pytest.approx(np.log10(mass), abs=1e-5)
        time = np.sqrt(2.0 * (x[:, 2] - TOUCH_HEIGHT) / GRAVITY)
        falls.append(np.column_stack([(x + time[:, None] * v)[:, :2] - config.ball_place, v, x[:, 2]]))
        masses.append(mass)
    falls, share = np.concatenate(falls), np.log(np.concatenate(masses) / config.ball_mass[0])
    share /= np.log(config.ball_mass[1] / config.ball_mass[0])
    for column, bound in (
        (0, config.ball_jitter),
        (1, config.ball_jitter),
        (2, config.ball_speed),
        (3, config.ball_speed),
    ):
        assert 0.9 * bound < np.abs(falls[:, column]).max() <= bound + 1e-5
    assert np.abs(falls[:, 4]).max() < 1e-5, "it is let fall"
    low, high = config.ball_height
    assert low - 1e-4 <= falls[:, 5].min() < low + 0.02 and high - 0.02 < falls[:, 5].max() <= high + 1e-4
    steps = np.abs(np.sort(share) - (np.arange(share.size) + 0.5) / share.size).max()
    assert share.min() >= -1e-5 and share.max() <= 1.0 + 1e-5 and steps < 1.95 / np.sqrt(share.size)
    assert np.abs(np.corrcoef(np.column_stack([falls[:, [0, 1, 2, 3, 5]], share]).T) - np.eye(6)).max() < 0.35


def test_a_ball_falls_freely_until_the_head(make_env):
    env = make_env(HEADER)
    env.reset(seed=0)
    _, start, v = (value[0] for value in ball(env.batch))
    for step in range(1, 8):
        env.step(np.zeros(env.action_space.shape))
        _, x, now = (value[0] for value in ball(env.batch))
        time = step * env.config.physics.control_dt
        assert now == pytest.approx(v - [0.0, 0.0, GRAVITY * time], abs=1e-3)
        # a step late by half a substep
        assert x == pytest.approx(start + v * time - [0.0, 0.0, 0.5 * GRAVITY * time**2], abs=0.02)


def test_approach_and_observation_are_those_of_numpy(make_env):
    env = make_env(HEADER, pose_noise=0.2)
    observation, _ = env.reset(seed=4)
    rng, best, total = np.random.default_rng(1), None, 0.0
    for _ in range(16):
        tracked = env.batch.simulation.avatar.tracked
        turn = Rotation.from_quat(tracked.rotation.numpy()[0, 0])
        seen = env.observation_layout.split(observation)["ball_from_head"]
        assert turn.apply(seen) == pytest.approx(ball(env.batch)[1][0] - head(env), abs=2e-4)
        observation, _, _, _, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        gap = np.linalg.norm(ball(env.batch)[1][0] - head(env)) - env.config.ball_radius - float(HEAD_RADIUS)
        near = 10.0 ** -((max(gap, 0.0) / 0.4) ** 2)
        gain = 0.0 if best is None else max(near - best, 0.0)
        best = near if best is None else max(near, best)
        assert info["reward_terms"]["approach"] == pytest.approx(0.1 * gain, abs=1e-4)
        total += gain
    assert total > 0.5, "the ball has come down"


def test_a_nod_in_time_sends_the_ball_forward(make_batch):
    """Lean back, then snap forward when the ball is there: it flies towards the gate; left alone it drops off."""
    settings = {"pose_noise": 0.0, "ball_jitter": 0.0, "ball_speed": 0.0, "ball_height": [2.6, 2.6]}
    batch = make_batch(HEADER, 2, fidelity="coarse", **settings)
    batch.reset(seeds=[0, 1])
    names = batch.action_spec.names()
    spine, skull = ([names.index(f"{joint}.x") for joint in joints] for joints in (SPINE, ("neck", "head")))
    for step in range(18):
        action = np.zeros((2, 1, len(names)), np.float32)
        action[0, 0, spine] = -0.3 if 1 <= step < 5 else 0.8 if 12 <= step < 16 else 0.0
        action[0, 0, skull] = -0.36 if 1 <= step < 5 or 12 <= step < 16 else 0.0
        batch.action.assign(action)
        batch.step()
    batch.action.zero_()
    _, _, v = ball(batch)
    assert not batch.failure.numpy().any()
    assert -v[0, 1] > 3.0 > 2.0 > -v[1, 1], v
    promise = batch.task.course.best.numpy()[:, 1]
    assert promise[0] > promise[1] + 0.2


SPINE = ("spine1", "spine2", "spine3")
