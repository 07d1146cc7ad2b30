"""Balls and gates (KickBall, Header): draws, what counts as through, what the steps of a shot earn, a kick, a nod."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.sources import load_asset, register_source
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.episodes import Episodes
from piavatar_envs.tasks import load_task
from piavatar_envs.tasks.common.ball_goal import Course, Gate, closest_pass, draw_gate, passes
from piavatar_envs.tasks.header import HEAD_RADIUS, TOUCH_HEIGHT
from tests.conftest import reward_terms
from tests.tasks.measured import (
    joints,
    markers_of,
    middle,
    pelvis,
    prop_motion,
    prop_particles,
    seen,
    still,
    tolerance,
)

KICK, HEADER = "PIAvatar/KickBall-v0", "PIAvatar/Header-v0"
FEET = ("left_foot", "right_foot")
GRAVITY, BALL_RADIUS = 9.81, 0.11


@wp.kernel
def through(
    center: wp.array(dtype=wp.vec3),
    forward: wp.array(dtype=wp.vec3),
    radius: float,
    before: wp.array(dtype=wp.vec3),
    after: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.bool),
):
    n = wp.tid()
    out[n] = passes(center[n], forward[n], radius, before[n], after[n])


@wp.kernel
def fly(
    center: wp.array(dtype=wp.vec3),
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    gravity: float,
    lowest: float,
    out: wp.array(dtype=float),
):
    n = wp.tid()
    out[n] = closest_pass(center[n], x[n], v[n], gravity, lowest)


def vectors(values, device) -> wp.array:
    return wp.array(np.ascontiguousarray(np.atleast_2d(values), np.float32), dtype=wp.vec3, device=device)


def heading(angle: float) -> np.ndarray:
    """Unit vector that is turned by ``angle`` from straight ahead, -y, to the left."""
    return np.array([np.sin(angle), -np.cos(angle), 0.0])


#: Way of a ball relative to the gate's centre: (sideways, up, along) before and after, and whether it is through.
WAYS = {
    "through the middle": ((0.0, 0.0, -0.1), (0.0, 0.0, 0.1), True),
    "just inside": ((0.0, 0.0, -0.1), (0.68, 0.0, 0.1), True),
    "just outside": ((0.0, 0.0, -0.1), (0.72, 0.0, 0.1), False),
    "below the opening": ((0.0, -0.36, -0.1), (0.0, -0.36, 0.1), False),
    "aslant, outside before and after, inside between": ((-0.5, 0.0, -0.1), (0.5, 0.2, 0.1), True),
    "aslant, inside before and after, outside between": ((0.3, 0.3, -0.1), (0.3, 0.0, 0.5), False),
    "backwards": ((0.0, 0.0, 0.1), (0.0, 0.0, -0.1), False),
    "not yet there": ((0.0, 0.0, -0.3), (0.0, 0.0, -0.01), False),
    "long through": ((0.0, 0.0, 0.01), (0.0, 0.0, 0.3), False),
    "slowly past it, early in the step inside": ((-0.4, 0.0, -0.3), (0.8, 0.0, 0.1), False),
    "at rest in the plane": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), False),
    "from before into the plane": ((0.0, 0.0, -0.1), (0.0, 0.0, 0.0), True),
    "from the plane onwards": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), False),
}


@pytest.mark.parametrize("angle", [0.0, -1.0])
@pytest.mark.parametrize("way", WAYS)
def test_a_ball_is_through_where_its_way_crosses_the_opening(device, way, angle):
    center, forward = np.array([0.4, -1.5, 0.9]), heading(angle)
    axes = np.array([np.cross(forward, [0.0, 0.0, 1.0]), [0.0, 0.0, 1.0], forward])
    *ends, expected = WAYS[way]
    before, after = (center + np.array(end) @ axes for end in ends)
    # an end in the plane is there without round-off
    before, after = (center if not any(end) else at for end, at in zip(ends, (before, after), strict=True))
    out = wp.zeros(1, dtype=wp.bool, device=device)
    arrays = [vectors(value, device) for value in (center, forward, before, after)]
    wp.launch(through, 1, [*arrays[:2], 0.35, *arrays[2:], out], device=device)
    assert bool(out.numpy()[0]) is expected


def test_a_flight_passes_as_near_as_its_parabola(device):
    """Against the flight in NumPy, at the moment when the way along the ground is nearest within a second."""
    rng = np.random.default_rng(0)
    n = 200
    center, x = rng.uniform(-1.0, 1.0, (n, 3)) + [0, -2, 1], rng.uniform(-0.5, 0.5, (n, 3)) + [0, 0, 0.8]
    v = rng.normal(0.0, 3.0, (n, 3))
    v[:20, :2] = 0.0
    out = wp.zeros(n, dtype=float, device=device)
    wp.launch(fly, n, [*(vectors(a, device) for a in (center, x, v)), GRAVITY, BALL_RADIUS, out], device=device)
    time = np.linspace(0.0, 1.0, 20001)[:, None, None]
    path = x + time * v - 0.5 * GRAVITY * time**2 * [0.0, 0.0, 1.0]
    path[..., 2] = np.maximum(path[..., 2], np.minimum(BALL_RADIUS, x[:, 2]))
    nearest = np.linalg.norm((path - center)[..., :2], axis=2).argmin(0)
    expected = np.linalg.norm(path[nearest, np.arange(n)] - center, axis=1)
    assert out.numpy() == pytest.approx(expected, abs=2e-3)
    assert out.numpy()[:20] == pytest.approx(np.linalg.norm(x - center, axis=1)[:20], abs=1e-4), "a ball without way"


def gate_struct() -> Gate:
    gate = Gate()
    gate.target_radius, gate.target_height, gate.target_angle = 0.4, 0.3, 0.5
    gate.near, gate.far, gate.control_cost, gate.gravity = 1.0, 2.0, 0.1, GRAVITY
    gate.ball_radius, gate.ball_volume = BALL_RADIUS, 0.005
    return gate


def empty_course(n: int, device: str) -> Course:
    course = Course()
    for name, dtype in (("center", wp.vec3), ("forward", wp.vec3), ("length", float), ("last", wp.vec3)):
        setattr(course, name, wp.zeros(n, dtype=dtype, device=device))
    course.best = wp.zeros(n, dtype=wp.vec2, device=device)
    return course


def test_gates_are_drawn_before_the_ball_and_spread(device):
    n, gate = 2000, gate_struct()
    course = empty_course(n, device)
    rng = np.random.default_rng(0)
    start = rng.uniform(-0.2, 0.2, (n, 3)) + [0.0, -0.4, 0.1]
    mask = np.arange(n) % 10 != 0
    episodes = Episodes()
    episodes.mask = wp.array(mask, dtype=wp.bool, device=device)
    episodes.seed = wp.array(np.arange(n, dtype=np.int32), dtype=int, device=device)
    episodes.episode = wp.array(np.arange(n, dtype=np.int32) // 7, dtype=int, device=device)
    wp.launch(draw_gate, n, [gate, episodes, vectors(start, device), course], device=device)
    center, forward = course.center.numpy(), course.forward.numpy()
    assert not center[~mask].any() and not course.best.numpy()[~mask].any(), "those not reset keep theirs"
    way = (center - start)[mask]
    distance, angle = np.hypot(way[:, 0], way[:, 1]), np.arctan2(way[:, 0], -way[:, 1])
    assert center[mask, 2] == pytest.approx(0.3) and course.length.numpy()[mask] == pytest.approx(distance, rel=1e-5)
    assert np.linalg.norm(forward[mask] - np.stack([heading(a) for a in angle]), axis=1).max() < 1e-5
    assert course.last.numpy()[mask] == pytest.approx(start[mask], abs=1e-6) and (course.best.numpy()[mask] < 0.0).all()
    # uniform within the bounds: four standard errors of the mean
    for value, low, high in ((distance, 1.0, 2.0), (angle, -0.5, 0.5)):
        assert low - 1e-5 <= value.min() < low + 0.01 and high - 0.01 < value.max() <= high + 1e-5
        assert value.mean() == pytest.approx(0.5 * (low + high), abs=4.0 * (high - low) / np.sqrt(12 * mask.sum()))
    assert abs(np.corrcoef(distance, angle)[0, 1]) < 4.0 / np.sqrt(mask.sum())


class Shot:
    """A shot's best approach and promise in NumPy, of a ball that does not reach the gate."""

    def __init__(self, gate: Gate, center, start) -> None:
        self.gate, self.center, self.best = gate, center, None
        self.length = np.linalg.norm((center - start)[:2])

    def step(self, x, v, gap: float, action) -> list[float]:
        """Return the reward terms of a step."""
        gate, near = self.gate, tolerance(gap, 0.0, 0.4)
        way, flat = self.center - x, np.array([v[0], v[1], 0.0])
        t = np.clip(way @ flat / max(flat @ flat, 1e-6), 0.0, 1.0)
        height = max(x[2] + v[2] * t - 0.5 * GRAVITY * t**2, min(gate.ball_radius, x[2]))
        miss = np.linalg.norm([*(way - t * flat)[:2], self.center[2] - height])
        promise = 1.0 - np.clip((miss - 0.5 * gate.target_radius) / (self.length - 0.5 * gate.target_radius), 0.0, 1.0)
        best = self.best or (near, promise)
        self.best = (max(near, best[0]), max(promise, best[1]))
        control = -gate.control_cost * np.mean(np.clip(action, -1.0, 1.0) ** 2)
        return [0.1 * (self.best[0] - best[0]), 0.4 * (self.best[1] - best[1]), 0.0, control]


@pytest.mark.parametrize("task", [KICK, HEADER])
@pytest.mark.parametrize("name", ["ball_mass", "target_distance"])
@pytest.mark.parametrize("bounds", [[2.0, 1.0], [0.0, 1.0]])
def test_ranges_that_cannot_be_are_refused(task, name, bounds):
    with pytest.raises(ConfigError, match=rf"{name}(\.0)?=.* (positive|>= 0.001)"):
        load_task(task)(load_config(load_task(task).Config, {name: bounds}, {}))


def test_a_ball_that_begins_in_the_head_of_a_tall_body_is_refused(device):
    asset = load_asset()
    lengths = {name: 1.5 * getattr(asset, name) for name in ("vertices", "joints", "shape_deltas", "shape_joints")}
    giant = dataclasses.replace(asset, **lengths)
    register_source("giant", lambda: giant)
    cls, settings = load_task(HEADER), {"fidelity": "tiny", "avatar.source": "giant"}
    with pytest.raises(ConfigError, match=r"ball_height=\[2.5, 2.7\] m begins in the head of a body of 2.*use at"):
        BatchEnv(cls(load_config(cls.Config, None, settings)), 1, device)
    BatchEnv(cls(load_config(cls.Config, None, settings | {"ball_height": [2.95, 3.1]})), 1, device)


@pytest.mark.parametrize("task", [KICK, HEADER])
def test_every_gate_and_ball_is_inside_the_domain(task):
    for settings in ({}, {"joints": None}, {"target_angle": 1.0, "target_distance": [2.0, 3.0]}):
        made = load_task(task)(load_config(load_task(task).Config, settings, {}))
        lower, upper = np.array(made.domain().lower), np.array(made.domain().upper)
        for distance in made.config.target_distance:
            for angle in (-made.config.target_angle, 0.0, made.config.target_angle):
                center = np.array([*made.config.ball_place, 0.0]) + distance * heading(angle)
                assert (lower[:2] + 0.3 < center[:2] + 1e-9).all() and (center[:2] < upper[:2]).all()
        ball = made.scene.props[0]
        assert (lower < np.array(ball.position) - ball.size[0]).all()
        assert (np.array(ball.position) + ball.size[0] < upper).all()


@pytest.mark.parametrize("task", [KICK, HEADER])
def test_balls_are_drawn_about_their_place_with_masses_uniform_in_their_logarithm(make_batch, task):
    """A header's ball reaches the head's height there, by free fall from where it starts."""
    batch, rows, masses = make_batch(task, 32), [], []
    config = batch.config
    for episode in range(5):
        observation = batch.reset(seeds=range(50, 82) if episode == 0 else None).numpy()
        mass, x, v = prop_motion(batch)
        assert observation[:, 0, batch.layout["ball_mass"].slice][:, 0] == pytest.approx(np.log10(mass), abs=1e-5)
        time = np.sqrt(2.0 * (x[:, 2:] - TOUCH_HEIGHT) / GRAVITY) if task == HEADER else 0.0
        rows.append(np.column_stack([(x + time * v)[:, :2] - config.ball_place, v, x[:, 2]]))
        masses.append(mass)
    rows, share = np.concatenate(rows), np.log(np.concatenate(masses) / config.ball_mass[0])
    share /= np.log(config.ball_mass[1] / config.ball_mass[0])
    bounds = [(-config.ball_jitter, config.ball_jitter)] * 2
    if task == HEADER:
        bounds += [(-config.ball_speed, config.ball_speed)] * 2 + [(0.0, 0.0), config.ball_height]
    for values, (low, high) in zip(rows.T, bounds, strict=False):
        slack = 0.05 * (high - low) + 1e-4
        assert low - 1e-4 <= values.min() <= low + slack and high - slack <= values.max() <= high + 1e-4
    # Kolmogorov-Smirnov: the 0.1 % quantile of the distance is 1.95 / sqrt(n)
    steps = np.abs(np.sort(share) - (np.arange(share.size) + 0.5) / share.size).max()
    assert share.min() >= -1e-5 and share.max() <= 1.0 + 1e-5 and steps < 1.95 / np.sqrt(share.size)
    drawn = [column for column in range(len(bounds)) if np.ptp(rows[:, column]) > 1e-3]
    assert np.abs(np.corrcoef(np.column_stack([rows[:, drawn], share]).T) - np.eye(len(drawn) + 1)).max() < 0.35


def ball(env) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass [m] of the ball and its velocity [m/s]."""
    _, x, v = prop_motion(env.batch)
    return x[0], v[0]


def put_ball(env, position, velocity) -> None:
    """Move the ball of a single environment somewhere else, with another velocity."""
    state, own = env.get_state(), prop_particles(env.batch)
    state["particles.x"][0, own] += np.asarray(position - ball(env)[0], np.float32)
    state["particles.u"][0, own], state["particles.vk"][0, own] = velocity, 0.0
    state["particles.C"][0, :, own] = 0.0
    state["task.last"][0] = position
    env.set_state(state)


def gate_of(env) -> tuple[np.ndarray, np.ndarray]:
    """Centre and normal of the gate as it is drawn."""
    (spec,) = env.batch.task.marker_specs()
    assert spec.kind == "ring" and spec.size[0] == env.config.target_radius
    markers = markers_of(env.batch)
    turn = Rotation.from_quat(markers.rotation.numpy()[0, 0].astype(float))
    return markers.position.numpy()[0, 0].astype(float), turn.apply([0.0, 0.0, 1.0])


@pytest.mark.parametrize("task", [KICK, HEADER])
def test_rewards_metrics_and_observations_are_those_of_numpy(make_env, task):
    """Random motion; KickBall's ball is put before the other foot and pushed towards the gate."""
    env = make_env(task, pose_noise=0.2)
    env.reset(seed=4)
    center, forward = gate_of(env)
    shot, earned = Shot(env.batch.task.gate, center, ball(env)[0]), []
    rng = np.random.default_rng(1)
    for step in range(16):
        if step == 4 and task == KICK:
            # nearer to the left foot
            put_ball(env, [0.2, -0.3, 0.15], 2.0 * forward + [-0.3, 0.0, 1.0])
        action = rng.uniform(-1.0, 1.0, env.action_space.shape)
        observation, *_, info = env.step(action)
        (x, v), (at, turn) = ball(env), pelvis(env)
        feet = {name: joints(env)[joint_index(name)] for name in FEET}
        parts = feet if task == KICK else {"head": middle(env, "head")}
        reach = env.config.ball_radius + (0.0 if task == KICK else float(HEAD_RADIUS))
        expected = shot.step(x, v, min(np.linalg.norm(part - x) for part in parts.values()) - reach, action)
        terms = reward_terms(info)
        terms.pop("stance", None)  # see the next test
        assert list(terms.values()) == pytest.approx(expected, abs=2e-4), step
        assert not info["success"]
        assert info["ball_speed"] == pytest.approx(np.linalg.norm(v), abs=1e-4)
        assert info["distance_to_target"] == pytest.approx(np.linalg.norm(center - x), abs=1e-4)
        assert info["ball_mass"] == pytest.approx(prop_motion(env.batch)[0][0], rel=1e-5)
        for part, position in parts.items():
            assert turn.apply(seen(env, observation, f"ball_from_{part}")) == pytest.approx(x - position, abs=2e-4)
        assert at + turn.apply(seen(env, observation, "target_position")) == pytest.approx(center, abs=1e-5)
        assert turn.apply(seen(env, observation, "target_from_ball")) == pytest.approx(center - x, abs=1e-4)
        assert seen(env, observation, "progress") == pytest.approx(shot.best, abs=1e-3)
        earned.append(expected)
    assert np.sum(earned, axis=0)[1 if task == KICK else 0] > (0.1 if task == KICK else 0.05)


def test_kicks_cost_while_neither_foot_is_on_the_ground(make_env):
    env = make_env(KICK, pose_noise=0.0)
    hips = [index for index, name in enumerate(env.action_names) if name in ("left_hip.x", "right_hip.x")]
    for both in (False, True):
        env.reset(seed=0)
        rest = [
            joints(env)[joint_index(f"{side}_{bone}")][2] for side in ("left", "right") for bone in ("ankle", "foot")
        ]
        action = np.zeros(env.action_space.shape, np.float32)
        action[hips if both else hips[:1]] = -1.0  # swings the leg forwards
        for _ in range(6):
            *_, info = env.step(action)
        now = [
            joints(env)[joint_index(f"{side}_{bone}")][2] for side in ("left", "right") for bone in ("ankle", "foot")
        ]
        rise = np.subtract(now, rest).reshape(2, 2).max(axis=1)
        lift = rise.min()
        assert rise.max() > 0.1
        assert (lift > 0.1) == both
        assert info["lift"] == pytest.approx(lift, abs=1e-3)
        assert info["reward_stance"] == pytest.approx(-0.01 * np.clip((lift - 0.02) / 0.1, 0.0, 1.0), abs=1e-4)


def test_a_ball_at_rest_waits_for_the_kick(make_batch):
    """Without actions the ball settles where it lies, no step is worth anything, the foot stays off it."""
    batch = make_batch(KICK, 2, fidelity="coarse")
    batch.reset(seeds=[0, 1])
    start = prop_motion(batch)[1]
    for _ in range(20):
        batch.step()
        assert not batch.success.numpy().any() and not batch.terms.numpy()[:, 0, 2].any()
        assert not batch.metrics.numpy()[:, 0, 3].any(), "no body touches it"
    _, position, velocity = prop_motion(batch)
    assert np.linalg.norm((position - start)[:, :2], axis=1).max() < 0.03 and np.abs(velocity).max() < 0.05
    assert (
        (position[:, 2] / batch.config.ball_radius > 0.8) & (position[:, 2] / batch.config.ball_radius < 1.05)
    ).all()


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
    return -prop_motion(batch)[2][:, 1]


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


@pytest.mark.parametrize(("aside", "through"), [(0.3, True), (0.5, False)])
def test_the_ball_in_the_gate_ends_the_episode(make_env, aside, through):
    env = make_env(KICK)
    env.reset(seed=1)
    center, forward = gate_of(env)
    side = np.cross(forward, [0.0, 0.0, 1.0])
    height = [0.0, 0.0, 0.2 - center[2]]
    put_ball(env, center + aside * side - 0.25 * forward + height, 4.0 * forward)
    outcomes = [env.step(still(env)) for _ in range(5)]
    rewards = [row[4]["reward_goal"] for row in outcomes]
    ended = [row[2] for row in outcomes]
    if not through:
        assert not any(rewards) and not any(ended) and not outcomes[-1][4]["success"]
        return
    first = ended.index(True)
    assert 0 < first < 4 and rewards == [0.5 if step == first else 0.0 for step in range(5)]
    assert all(row[4]["success"] for row in outcomes[first:]) and not outcomes[first - 1][4]["success"]
    put_ball(env, center - 0.05 * forward + height, 4.0 * forward)
    assert env.step(still(env))[4]["reward_goal"] == 0.0, "a goal counts once"
    env.reset(seed=1)
    assert not env.step(still(env))[4]["success"], "the next episode begins anew"


def test_a_nod_in_time_sends_the_ball_forward(make_batch):
    """Lean back, then snap forward when the ball is there: it flies towards the gate; left alone it drops off."""
    settings = {"pose_noise": 0.0, "ball_jitter": 0.0, "ball_speed": 0.0, "ball_height": [2.6, 2.6]}
    batch = make_batch(HEADER, 2, fidelity="coarse", **settings)
    batch.reset(seeds=[0, 1])
    names = batch.action_spec.names()
    spine, skull = (
        [names.index(f"{joint}.x") for joint in chain] for chain in (("spine1", "spine2", "spine3"), ("neck", "head"))
    )
    for step in range(18):
        action = np.zeros((2, 1, len(names)), np.float32)
        action[0, 0, spine] = -0.3 if 1 <= step < 5 else 0.8 if 12 <= step < 16 else 0.0
        action[0, 0, skull] = -0.36 if 1 <= step < 5 or 12 <= step < 16 else 0.0
        batch.action.assign(action)
        batch.step()
    batch.action.zero_()
    v = prop_motion(batch)[2]
    assert not batch.failure.numpy().any()
    assert -v[0, 1] > 3.0 > 2.0 > -v[1, 1], v
    promise = batch.task.course.best.numpy()[:, 1]
    assert promise[0] > promise[1] + 0.2
