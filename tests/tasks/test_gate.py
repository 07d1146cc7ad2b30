"""Balls and gates: what counts as through, what a flight promises, and what the steps of a shot earn."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.tasks.common.ball_goal import Course, Gate, closest_pass, draw_gate, judge_ball, passes
from piavatar_envs.tasks.header import HeaderConfig, HeaderTask
from piavatar_envs.tasks.kick_ball import KickBallConfig, KickBallTask

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


@pytest.mark.parametrize("angle", [0.0, 0.35, -1.0])
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


def gate_struct(**values) -> Gate:
    gate = Gate()
    settings = {
        "target_radius": 0.4,
        "target_height": 0.3,
        "near": 1.0,
        "far": 2.0,
        "target_angle": 0.5,
        "ball_radius": BALL_RADIUS,
    }
    for name, value in {**settings, "ball_volume": 0.005, "gravity": GRAVITY, "control_cost": 0.1, **values}.items():
        setattr(gate, name, value)
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
    inputs = [wp.array(mask, dtype=wp.bool, device=device)]
    inputs += [wp.array(a.astype(np.int32), dtype=int, device=device) for a in (np.arange(n), np.arange(n) // 7)]
    wp.launch(draw_gate, n, [*inputs, gate, vectors(start, device), course], device=device)
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
    """A judge and its memory in NumPy, for one environment."""

    def __init__(self, center, forward, length: float, start) -> None:
        self.center, self.forward, self.length, self.last = center, forward, length, start
        self.best, self.through = None, False

    def step(self, x, v, gap: float, action, gate: Gate) -> tuple[list[float], bool]:
        near = 10.0 ** -((max(gap, 0.0) / 0.4) ** 2)
        way, flat = self.center - x, np.array([v[0], v[1], 0.0])
        t = np.clip(way @ flat / max(flat @ flat, 1e-6), 0.0, 1.0)
        height = max(x[2] + v[2] * t - 0.5 * GRAVITY * t**2, min(BALL_RADIUS, x[2]))
        miss = np.linalg.norm([*(way - t * flat)[:2], self.center[2] - height])
        promise = 1.0 - np.clip((miss - 0.5 * gate.target_radius) / (self.length - 0.5 * gate.target_radius), 0.0, 1.0)
        best = self.best or (near, promise)
        earned = [0.1 * max(near - best[0], 0.0), 0.4 * max(promise - best[1], 0.0), 0.0]
        self.best = (max(near, best[0]), max(promise, best[1]))
        s = [(p - self.center) @ self.forward for p in (self.last, x)]
        if s[0] < 0.0 <= s[1]:
            cross = self.last + s[0] / (s[0] - s[1]) * (x - self.last)
            inside = np.linalg.norm(cross - self.center) <= gate.target_radius
            earned[2] = 0.5 if inside and not self.through else 0.0
            self.through = self.through or inside
        self.last = x
        return [*earned, -gate.control_cost * np.mean(np.clip(action, -1.0, 1.0) ** 2)], self.through


def test_a_shot_earns_what_numpy_says(device):
    """Balls of random ways, some of them through the gate, judged step by step; an episode earns at most one."""
    rng, n, steps = np.random.default_rng(3), 12, 25
    gate, course = gate_struct(), empty_course(n, device)
    angles = rng.uniform(-0.4, 0.4, n)
    start = np.tile([0.0, -0.4, 0.11], (n, 1))
    forward = np.stack([heading(a) for a in angles])
    center = start + 1.2 * forward + [0.0, 0.0, 0.19]
    for name, value in (("center", center), ("forward", forward), ("last", start)):
        getattr(course, name).assign(value.astype(np.float32))
    course.length.fill_(1.2)
    course.best.fill_(wp.vec2(-1.0, -1.0))
    shots = [Shot(center[e], forward[e], 1.2, start[e]) for e in range(n)]
    speed = rng.uniform(0.5, 5.0, n)
    v = speed[:, None] * np.stack([heading(a) for a in angles + rng.normal(0.0, 0.2, n)])
    x, total, ends = start.copy(), np.zeros(n), np.zeros(n, bool)
    terms = wp.zeros((n, 1, 4), dtype=float, device=device)
    success, terminated = (wp.zeros((n, 1), dtype=wp.bool, device=device) for _ in range(2))
    for step in range(steps):
        if step >= 5:  # struck in the fifth step, and blown about from then on
            v = v + rng.normal(0.0, 0.3, v.shape)
            x = x + v / 30.0
        gap, action = rng.uniform(-0.1, 0.8, n), rng.uniform(-1.5, 1.5, (n, 1, 5))
        moving = v if step >= 5 else np.zeros_like(v)
        wp.launch(
            judge_ball,
            n,
            [
                gate, vectors(x, device), vectors(moving, device),
                wp.array(gap, dtype=float, device=device), wp.array(action, dtype=float, device=device),
                course, terms, success, terminated,
            ],
            device=device,
        )  # fmt: skip
        for e in range(n):
            expected, through = shots[e].step(x[e], moving[e], gap[e], action[e, 0], gate)
            assert terms.numpy()[e, 0] == pytest.approx(expected, abs=2e-5), f"shot {e}, step {step}"
            assert bool(success.numpy()[e, 0]) == bool(terminated.numpy()[e, 0]) == through
            total[e] += sum(expected[:3])
            ends[e] |= through
    assert 2 <= ends.sum() <= n - 2, "the case must see both"
    assert total.max() <= 1.0 and total[ends].min() > 0.5


@pytest.mark.parametrize("task", [KickBallTask, HeaderTask])
@pytest.mark.parametrize("name", ["ball_mass", "target_distance"])
@pytest.mark.parametrize("bounds", [[2.0, 1.0], [0.0, 1.0]])
def test_a_range_that_is_none_is_refused(task, name, bounds):
    with pytest.raises(ConfigError, match=rf"{name}(\.0)?=.* must be (positive|>= 0.001)"):
        task(load_config(task.Config, {name: bounds}, {}))


@pytest.mark.parametrize(("task", "config"), [(KickBallTask, KickBallConfig), (HeaderTask, HeaderConfig)])
def test_every_gate_and_ball_is_inside_the_domain(task, config):
    for settings in ({}, {"joints": None}, {"target_angle": 1.0, "target_distance": [2.0, 3.0]}):
        made = task(load_config(config, settings, {}))
        lower, upper = np.array(made.domain().lower), np.array(made.domain().upper)
        for distance in made.config.target_distance:
            for angle in (-made.config.target_angle, 0.0, made.config.target_angle):
                center = np.array([*made.config.ball_place, 0.0]) + distance * heading(angle)
                assert (lower[:2] + 0.3 < center[:2] + 1e-9).all() and (center[:2] < upper[:2]).all()
        ball = made.scene.props[0]
        assert (lower < np.array(ball.position) - ball.size[0]).all()
        assert (np.array(ball.position) + ball.size[0] < upper).all()
