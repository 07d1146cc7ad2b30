"""KickBall: where the ball lies and how heavy it is, that it waits for the kick, and what a kick does to it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.core.launch_graph import LaunchGraph

KICK = "PIAvatar/KickBall-v0"
FEET = ("left_foot", "right_foot")


def ball_particles(batch) -> slice:
    prop = batch.simulation.props.props[batch.task.index]
    return slice(prop.first, prop.first + prop.count)


def ball(batch, env: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass [m] and its velocity [m/s], from the particles."""
    own, state = ball_particles(batch), batch.simulation.state
    mass = batch.simulation.model.particles.mass.numpy()[env, own].astype(float)
    total = state.u.numpy()[env, own] + state.vk.numpy()[env, own]
    return mass @ state.x.numpy()[env, own] / mass.sum(), mass @ total / mass.sum()


def put_ball(env, position, velocity) -> None:
    """Move the ball of a single environment somewhere else, with another velocity."""
    state, own = env.get_state(), ball_particles(env.batch)
    x = state["particles.x"][0, own]
    state["particles.x"][0, own] = x - ball(env.batch)[0] + position
    state["particles.u"][0, own], state["particles.vk"][0, own] = velocity, 0.0
    state["particles.C"][0, :, own] = 0.0
    state["task.last"][0] = position
    env.set_state(state)


def gate(env) -> tuple[np.ndarray, np.ndarray]:
    """Centre and normal of the gate as it is drawn."""
    (ring,) = env.batch.task.markers(env.batch, 0)
    assert ring.radius == env.config.target_radius
    return ring.position.astype(float), ring.normal.astype(float)


def test_masses_are_uniform_in_their_logarithm_and_observed(make_batch):
    batch, n, masses, places = make_batch(KICK, 32), 32, [], []
    where = batch.layout["ball_mass"].slice
    for episode in range(6):
        observation = batch.reset(seeds=range(100, 100 + n) if episode == 0 else None).numpy()
        mass = batch.simulation.model.particles.mass.numpy()[:, ball_particles(batch)].astype(float).sum(1)
        assert observation[:, 0, where][:, 0] == pytest.approx(np.log10(mass), abs=1e-5)
        batch.step()
        assert batch.metrics.numpy()[:, 0, 2] == pytest.approx(mass, rel=1e-5)
        masses.append(mass)
        places.append(batch.simulation.props.initial.position.numpy()[:, batch.task.index])
    low, high = np.log(batch.config.ball_mass)
    share = (np.log(np.concatenate(masses)) - low) / (high - low)
    # Kolmogorov-Smirnov: the 0.1 % quantile of the distance is 1.95 / sqrt(n)
    steps = np.abs(np.sort(share) - (np.arange(share.size) + 0.5) / share.size).max()
    assert share.min() >= -1e-5 and share.max() <= 1.0 + 1e-5 and steps < 1.95 / np.sqrt(share.size)
    offset = (np.concatenate(places)[:, :2] - batch.config.ball_place) / batch.config.ball_jitter
    assert np.abs(offset).max() <= 1.0 + 1e-5 and np.abs(offset).max(0).min() > 0.9
    assert np.abs(np.corrcoef(np.column_stack([offset, share]).T) - np.eye(3)).max() < 4.0 / np.sqrt(share.size)


def test_a_ball_at_rest_waits_for_the_kick(make_batch):
    """Nobody acts for a second: the ball settles where it lies, no step is worth anything, the foot stays off it."""
    batch = make_batch(KICK, 2, fidelity="coarse")
    batch.reset(seeds=[0, 1])
    start = [ball(batch, e)[0] for e in range(2)]
    for _ in range(30):
        batch.step()
        assert not batch.success.numpy().any() and not batch.terms.numpy()[:, 0, 2].any()
        assert not batch.metrics.numpy()[:, 0, 3].any(), "no body touches it"
    for e in range(2):
        position, velocity = ball(batch, e)
        assert np.hypot(*(position - start[e])[:2]) < 0.03 and np.linalg.norm(velocity) < 0.05
        assert 0.8 * batch.config.ball_radius < position[2] < 1.05 * batch.config.ball_radius


def kick(batch) -> np.ndarray:
    """Forward speed of the balls [m/s] after a swing of the right leg from behind."""
    names = batch.action_spec.names()
    thigh, knee = names.index("right_hip.x"), names.index("right_knee.x")
    for step in range(13):
        action = np.zeros(batch.action.shape, np.float32)
        action[..., thigh] = 1.0 if step < 2 else -1.0 if 3 <= step < 10 else 0.0
        action[..., knee] = 1.0 if step < 5 else -1.0 if step < 10 else 0.0
        batch.action.assign(action)
        batch.step()
    batch.action.zero_()
    return np.array([-ball(batch, e)[1][1] for e in range(batch.num_envs)])


def test_a_kick_sends_heavier_balls_off_slower(make_batch):
    batch = make_batch(KICK, 3, fidelity="coarse", pose_noise=0.0, ball_jitter=0.0)
    batch.reset(seeds=range(3))
    # balls of other masses than those drawn
    props, density = batch.simulation.props, np.array([[0.3], [1.5], [7.0]]) / batch.task.gate.ball_volume
    props.density.assign(density.astype(np.float32))
    graph = LaunchGraph(batch.device)
    props.record_reset(graph, batch.simulation.state, batch.mask)
    graph.run()
    speed = kick(batch)
    assert not batch.failure.numpy().any()
    assert speed[0] > 1.2 * speed[1] > 1.2**2 * speed[2] and speed[2] > 0.8, speed
    assert batch.task.course.best.numpy()[:, 0].min() > 0.9, "the foot was at the ball"


@pytest.mark.parametrize(("aside", "through"), [(0.0, True), (0.3, True), (0.5, False)])
def test_the_ball_in_the_gate_ends_the_episode(make_env, aside, through):
    env = make_env(KICK)
    env.reset(seed=1)
    center, forward = gate(env)
    side = np.cross(forward, [0.0, 0.0, 1.0])
    height = [0.0, 0.0, 0.2 - center[2]]
    put_ball(env, center + aside * side - 0.25 * forward + height, 4.0 * forward)
    outcomes = [env.step(np.zeros(env.action_space.shape)) for _ in range(5)]
    rewards = [row[4]["reward_terms"]["goal"] for row in outcomes]
    ended = [row[2] for row in outcomes]
    if not through:
        assert not any(rewards) and not any(ended) and not outcomes[-1][4]["success"]
        return
    first = ended.index(True)
    assert 0 < first < 4 and rewards == [0.5 if step == first else 0.0 for step in range(5)]
    assert all(row[4]["success"] for row in outcomes[first:]) and not outcomes[first - 1][4]["success"]
    put_ball(env, center - 0.05 * forward + height, 4.0 * forward)
    assert env.step(np.zeros(env.action_space.shape))[4]["reward_terms"]["goal"] == 0.0, "a goal counts once"
    env.reset(seed=1)
    assert not env.step(np.zeros(env.action_space.shape))[4]["success"], "the next episode begins anew"


def test_a_ball_back_through_the_gate_does_not_count(make_env):
    env = make_env(KICK)
    env.reset(seed=1)
    center, forward = gate(env)
    put_ball(env, center + 0.15 * forward, -4.0 * forward)
    outcomes = [env.step(np.zeros(env.action_space.shape)) for _ in range(4)]
    assert (ball(env.batch)[0] - center) @ forward < -0.1, "the case must cross"
    assert not any(row[2] or row[4]["success"] for row in outcomes)


def test_reward_and_metrics_are_those_of_numpy(make_env):
    """A ball that comes before the other foot and is pushed towards the gate, feet that move at random."""
    env = make_env(KICK)
    env.reset(seed=5)
    center, forward = gate(env)
    start = ball(env.batch)[0]
    length, spare = np.linalg.norm((center - start)[:2]), 0.5 * env.config.target_radius
    rng, best = np.random.default_rng(0), None
    earned = []
    for step in range(14):
        if step == 4:
            put_ball(env, [0.2, -0.3, 0.15], 2.0 * forward + [-0.3, 0.0, 1.0])  # nearer to the left foot
        action = rng.uniform(-1.0, 1.0, env.action_space.shape)
        info = env.step(action)[4]
        (x, v), terms = ball(env.batch), info["reward_terms"]
        assert info["ball_speed"] == pytest.approx(np.linalg.norm(v), abs=1e-4)
        assert info["distance_to_target"] == pytest.approx(np.linalg.norm(center - x), abs=1e-4)
        feet = env.batch.simulation.avatar.tracked.position.numpy()[0, [joint_index(name) for name in FEET]]
        gap = np.linalg.norm(feet - x, axis=1).min() - env.config.ball_radius
        way, flat = center - x, v * [1.0, 1.0, 0.0]
        t = np.clip(way @ flat / max(flat @ flat, 1e-6), 0.0, 1.0)
        height = max(x[2] + v[2] * t - 0.5 * 9.81 * t * t, min(env.config.ball_radius, x[2]))
        miss = np.linalg.norm([*(way - flat * t)[:2], center[2] - height])
        now = np.array(
            [10.0 ** -((max(gap, 0.0) / 0.4) ** 2), 1.0 - np.clip((miss - spare) / (length - spare), 0.0, 1.0)]
        )
        gain = np.zeros(2) if best is None else np.maximum(now - best, 0.0)
        best = now if best is None else np.maximum(now, best)
        assert (terms["approach"], terms["aim"]) == pytest.approx((0.1 * gain[0], 0.4 * gain[1]), abs=1e-4), step
        assert terms["control"] == pytest.approx(-env.config.control_cost * np.mean(action**2), rel=1e-4)
        earned.append(gain)
    assert np.sum(earned, axis=0)[1] > 0.3, "the push must promise something"


def test_observed_gate_and_ball_are_where_they_are(make_env):
    env = make_env(KICK)
    observation, _ = env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(6):
        tracked = env.batch.simulation.avatar.tracked
        at, turn = tracked.position.numpy()[0], Rotation.from_quat(tracked.rotation.numpy()[0, 0])
        seen, (x, _), (center, _) = env.observation_layout.split(observation), ball(env.batch), gate(env)
        assert at[0] + turn.apply(seen["target_position"]) == pytest.approx(center, abs=1e-5)
        assert turn.apply(seen["target_from_ball"]) == pytest.approx(center - x, abs=1e-4)
        for name in FEET:
            assert turn.apply(seen[f"ball_from_{name}"]) == pytest.approx(x - at[joint_index(name)], abs=1e-4)
        observation, *_ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
    best = env.get_state()["task.best"][0]
    assert env.observation_layout.split(observation)["progress"] == pytest.approx(best) and best.min() >= 0.0
