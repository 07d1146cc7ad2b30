"""PassBall: the serve, whose turn it is, what counts as a pass, and that a ball which is kicked on arrives."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.episodes import Outcome
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.multi import pass_ball_v0
from piavatar_envs.tasks.games import pass_ball as passing

PASS = "pass_ball_v0"


def flat(a: np.ndarray, b: np.ndarray) -> float:
    """Horizontal distance [m]."""
    return float(np.linalg.norm(np.asarray(a, float)[:2] - np.asarray(b, float)[:2]))


def ball_of(batch: BatchEnv, env: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Place and velocity of the ball's centre of mass, from its particles."""
    state, mass = batch.simulation.state, batch.simulation.model.particles.mass.numpy()
    own = slice(batch.simulation.subjects.first[-2], batch.simulation.subjects.first[-1])
    weight = mass[min(env, len(mass) - 1), own].astype(float)
    total = state.u.numpy()[env, own].astype(float) + state.vk.numpy()[env, own]
    return weight @ state.x.numpy()[env, own] / weight.sum(), weight @ total / weight.sum()


def pelvises(batch: BatchEnv, env: int = 0) -> np.ndarray:
    return np.array([avatar.tracked.position.numpy()[env, 0] for avatar in batch.simulation.avatars], float)


def put_ball(game, at: tuple[float, float, float], velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
    """Move the ball of a game without turning it."""
    state, first = game.get_state(), game.batch.simulation.subjects.first[-2]
    state["particles.x"][0, first:] += (np.array(at) - ball_of(game.batch)[0]).astype(np.float32)
    state["particles.u"][0, first:] = velocity
    state["particles.C"][0, :, first:] = 0.0
    game.set_state(state)


class Kicker:
    """A scripted agent: a foot behind the ball, then through it, so that it goes to the next; else back home."""

    SPEED, LEAD, BEHIND, WIDTH = 2.0, 0.1, 0.25, 0.12  # of the pass [m/s]; ahead of the ball [s]; of the ball [m]
    FEET = ("left", "right")

    def __init__(self, batch: BatchEnv) -> None:
        self.layout, self.names, self.root_speed = batch.layout, batch.action_spec.names(), batch.config.root_speed

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        rows = observation.reshape(-1, observation.shape[-1])
        actions = [self.act(self.layout.split(row.astype(float))) for row in rows]
        return np.clip(actions, -1.0, 1.0).reshape(*observation.shape[:-1], -1).astype(np.float32)

    def act(self, seen: dict[str, np.ndarray]) -> list[float]:
        bones = seen["bone_positions"].reshape(-1, 3)
        thighs = {side: joint_index(f"{side}_knee") - 1 for side in ("left", "right")}
        lifted = {side: (bones[thighs[side] - 3] - bones[thighs[side]])[1] / 0.4 for side in thighs}
        hips = {f"{side}_hip.x": lifted[side] / 0.15 for side in thighs}
        ball = facing = seen["ball_position"][:2]
        move = seen["place"][:2] / 0.2
        if seen["passer"][0]:
            facing = seen["other_0_position"][:2] - ball
            # the change of velocity that sends it there
            way = self.SPEED * facing / np.linalg.norm(facing) - seen["ball_velocity"][:2]
            way /= np.linalg.norm(way)
            lead = self.LEAD * seen["ball_velocity"][:2]
            feet = {side: seen[f"ball_from_{side}_foot"][:2] + lead for side in self.FEET}  # to where the ball will be
            side = min(feet, key=lambda side: np.linalg.norm(feet[side] - self.BEHIND * way))
            aside = abs(feet[side] @ [-way[1], way[0]])
            behind = -0.05 < feet[side] @ way < self.BEHIND + 0.05 and aside < self.WIDTH
            move = way if behind else (feet[side] - self.BEHIND * way) / (0.15 * self.root_speed)
            hips[f"{side}_hip.x"] = -1.0 * (lifted[side] < 0.6) if behind else 0.5 * (lifted[side] > -0.25)
            facing = way
        turn = np.arctan2(facing[0], -facing[1]) / 0.2
        chosen = hips | {"root.x": move[0], "root.y": move[1], "root.yaw": turn}
        return [chosen.get(name, 0.0) for name in self.names]


@pytest.fixture(scope="module")
def circle(device, games):
    """Four environments at once, in which a single pass is a success."""
    config = load_config(pass_ball_v0.TASK.Config, None, {"fidelity": "tiny", "goal_passes": 1, "progress_weight": 3.0})
    return BatchEnv(pass_ball_v0.TASK(config), 4, device)


def test_a_ball_that_is_kicked_on_arrives(circle):
    """All of a team have the same rewards but for their actions, and know whose turn it is; the rules are below."""
    circle.reset(seeds=range(4))
    policy, over = Kicker(circle), np.zeros(4, bool)
    for _ in range(45):
        circle.action.assign(policy(circle.observation.numpy()))
        circle.step()
        terms, metrics, play = circle.terms.numpy(), circle.metrics.numpy(), circle.task.play
        assert (terms[..., :2] == terms[:, :1, :2]).all() and (metrics[..., 2] == metrics[:, :1, 2]).all()
        cost = -0.01 * np.mean(circle.action.numpy().astype(float) ** 2, axis=2)
        passer, touched, passes = (field.numpy() for field in (play.passer, play.touched, play.passes))
        assert (circle.success.numpy() == (passes >= 1)[:, None]).all()
        for env in np.flatnonzero(~over):
            assert terms[env, :, 2] == pytest.approx(cost[env], abs=1e-5)
            assert metrics[env, :, 3] == pytest.approx(np.full(3, np.linalg.norm(ball_of(circle, env)[1])), abs=2e-4)
            for agent in range(3):
                seen = circle.layout.split(circle.observation.numpy()[env, agent])
                assert np.argmax(seen["passer"]) == (passer[env] - agent) % 3 and seen["passer"].sum() == 1.0
                assert seen["touched"] == touched[env]
        over |= circle.terminated.numpy().any(1)
    assert (passes >= 1).sum() >= 3, "the script must get it across"
    assert metrics[..., 1].sum() >= 4, "touches"


def test_the_serve_rolls_to_one_of_them(circle):
    """Without slip, from the middle, at a speed and with a mass in their ranges; every agent is served at times."""
    config, first, masses, speeds = circle.config, set(), [], []
    places = np.array([avatar.position for avatar in circle.task.scene.avatars])
    for start in range(0, 24, 4):
        circle.reset(seeds=range(start, start + 4))
        state, props = circle.simulation.props.state, circle.simulation.props
        for env in range(4):
            position, velocity, spin = (getattr(state, n).numpy()[env, 0] for n in ("position", "velocity", "spin"))
            assert position == pytest.approx([0.0, 0.0, config.ball_radius], abs=1e-3)
            passer = int(circle.task.play.passer.numpy()[env])
            speed, to = np.linalg.norm(velocity), places[passer] / np.linalg.norm(places[passer])
            assert velocity[:2] @ to >= speed * np.cos(config.serve_angle) - 1e-3 and abs(velocity[2]) < 1e-3
            # the point on the ground is at rest
            assert velocity + np.cross(spin, [0.0, 0.0, -config.ball_radius]) == pytest.approx(np.zeros(3), abs=5e-3)
            first.add(passer)
            masses.append(float(props.density.numpy()[env, 0] * props.volume[0]))
            speeds.append(speed)
    assert first == {0, 1, 2}
    for values, (low, high) in ((masses, config.ball_mass), (speeds, config.serve_speed)):
        assert low - 1e-3 <= min(values) and max(values) <= high + 1e-3 and np.ptp(values) > 0.6 * (high - low)


def test_observed_is_where_the_ball_shall_go(circle):
    circle.reset(seeds=range(4))
    rng = np.random.default_rng(0)
    for _ in range(5):
        circle.action.assign(rng.uniform(-1.0, 1.0, circle.action.shape).astype(np.float32))
        circle.step()
    for env in range(4):
        at, ball = pelvises(circle, env), ball_of(circle, env)[0]
        passer, play = int(circle.task.play.passer.numpy()[env]), circle.task.play
        to = at[(passer + int(play.touched.numpy()[env])) % 3]
        mass = circle.simulation.props.density.numpy()[env, 0] * circle.simulation.props.volume[0]
        for agent, avatar in enumerate(circle.simulation.avatars):
            seen = circle.layout.split(circle.observation.numpy()[env, agent].astype(float))
            turn = Rotation.from_quat(avatar.tracked.rotation.numpy()[env, 0])
            place = np.array([*circle.task.scene.avatars[agent].position, 0.0])
            assert turn.apply(seen["receiver"]) == pytest.approx(to - at[agent], abs=1e-4)
            assert turn.apply(seen["receiver_from_ball"]) == pytest.approx(to - ball, abs=1e-3)
            assert turn.apply(seen["place"]) == pytest.approx((place - at[agent]) * [1, 1, 0], abs=1e-4)
            assert seen["ball_mass"] == pytest.approx([np.log10(mass)], abs=1e-4)
            foot = avatar.tracked.position.numpy()[env, joint_index("right_foot")]
            assert turn.apply(seen["ball_from_right_foot"]) == pytest.approx(ball - foot, abs=1e-3)


#: Where three stand in the made-up games below.
STANDING = ((0.0, 1.0, 1.0), (-1.0, 0.0, 1.0), (1.0, 0.0, 1.0))


#: The first agent has kicked the ball: its place and the agents that touch it; then the agent whose turn it is, whether
#: it has touched the ball, the passes, and the touches of the first two agents.
KICKED = ((0.0, 0.8), (0,), (0, 1, 0, 1, 0))


@pytest.mark.parametrize(
    ("story", "steps"),
    [
        ("no pass without a touch", [((-0.9, 0.0), (), (0, 0, 0, 0, 0)), ((-0.9, 0.0), (1,), (0, 0, 0, 0, 1))]),
        ("near the next", [KICKED, ((-0.5, 0.4), (), (0, 1, 0, 1, 0)), ((-0.8, 0.1), (), (1, 0, 1, 1, 0))]),
        ("a touch by the next, far from the pelvis", [KICKED, ((-0.4, 0.3), (1,), (1, 1, 1, 1, 1))]),
        ("the third does not count", [KICKED, ((0.9, 0.1), (2,), (0, 1, 0, 1, 0))]),
        ("a tap to the next foot is none", [KICKED, ((-0.2, 0.6), (1,), (0, 1, 0, 1, 1))]),
        ("nor a ball that both hold, wherever they take it", [KICKED, ((-0.8, 0.1), (0, 1), (0, 1, 0, 1, 1))]),
        (
            "what was tapped may go on",
            [KICKED, ((-0.2, 0.6), (1,), (0, 1, 0, 1, 1)), ((-0.8, 0.1), (), (1, 0, 1, 1, 1))],
        ),
        ("a touch that lasts is one", [KICKED] * 3),
    ],
)
def test_whose_turn_it_is(device, story, steps):
    """The rules alone, on made-up balls and touches."""

    def array(shape, dtype=float):
        return wp.zeros(shape, dtype=dtype, device=device)

    rule, play, sensors = passing.PassRule(), passing.Play(), Sensors()
    rule.subject, rule.reach, rule.fetch, rule.rim, rule.goal_passes = 3, 0.3, 9.0, 9.0, 1
    rule.least_pass, rule.progress_weight, rule.pass_bonus = 0.5, 1.0, 5.0
    play.passer, play.touched, play.passes, play.gap = *(array(1, int) for _ in range(3)), array(1)
    play.left = array(1, wp.vec3)
    play.gap.fill_(-1.0)
    play.contact, play.touches = array((1, 3), int), array((1, 3), int)
    sensors.pair_impulse, sensors.boundary_impulse = array((1, 16), wp.vec3), array((1, 4), wp.vec3)
    pelvis = wp.array(np.array([STANDING], np.float32), dtype=wp.vec3, device=device)
    outcome = Outcome()
    outcome.terms, outcome.metrics = array((1, 3, 3)), array((1, 3, 4))
    outcome.success, outcome.terminated = array((1, 3), wp.bool), array((1, 3), wp.bool)
    passes, gap, goal = 0, None, 0
    for at, touching, expected in steps:
        impulses = np.zeros((1, 4, 4, 3), np.float32)
        impulses[0, list(touching), 3, 2] = 0.5
        sensors.pair_impulse.assign(impulses.reshape(1, 16, 3))
        ball = wp.array([(*at, 0.1)], dtype=wp.vec3, device=device)
        inputs = [rule, ball, array(1, wp.vec3), pelvis, sensors, array((1, 3, 2))]
        wp.launch(passing.judge, 1, inputs, [play, outcome], device=device)
        state = [int(field.numpy()[0]) for field in (play.passer, play.touched, play.passes)]
        assert (*state, *play.touches.numpy()[0, :2]) == expected, story
        bonus = 5.0 * (expected[2] - passes)
        assert outcome.terms.numpy()[0, :, 1] == pytest.approx(np.full(3, bonus))
        progress = 0.0 if gap is None else gap - flat(at, STANDING[goal])
        assert outcome.terms.numpy()[0, :, 0] == pytest.approx(np.full(3, progress), abs=1e-6)
        goal = (expected[0] + expected[1]) % 3
        assert outcome.metrics.numpy()[0, :, 2] == pytest.approx(np.full(3, flat(at, STANDING[goal])), abs=1e-6)
        passes, gap = expected[2], flat(at, STANDING[goal])
        assert outcome.success.numpy().all() == outcome.success.numpy().any() == (passes >= 1)


@pytest.mark.parametrize(
    ("where", "velocity", "over"),
    [
        ((0.0, 0.0, 0.11), (0.0, 0.0, 0.0), True),  # at rest in the middle, where no agent reaches it
        ((0.0, 0.0, 0.11), (0.5, 0.0, 0.0), False),  # it may still roll to an agent
        ((0.0, 0.5, 0.11), (0.0, 0.0, 0.0), False),  # at rest before the first of them
        ((0.5, 1.4, 0.11), (0.5, 0.5, 0.0), True),  # out
        ((0.5, 1.2, 0.11), (0.5, 0.5, 0.0), False),  # not yet
    ],
)
def test_a_ball_that_nobody_can_play_ends_it_for_all(make_game, play, where, velocity, over):
    game = make_game(PASS)
    assert game.batch.task.rim == pytest.approx(0.8 / np.sin(np.pi / 3) + 0.5)
    game.reset(seed=0)
    put_ball(game, where, velocity)
    [(_, _, terminations, _, infos)] = play(game, 1)
    assert set(terminations.values()) == {over} and (not game.agents) == over
    assert all(info["failure"] == 0 and not info["root_released"] for info in infos.values())


def test_roots_stay_near_their_places(make_game, play):
    """However long they are sent forwards, or to the side; and they come back."""
    game = make_game(PASS, root_range=0.25, dead_speed=1e-6)
    places = np.array([avatar.position for avatar in game.batch.task.scene.avatars])
    for command in ({"root.y": -1.0}, {"root.x": 1.0}, {"root.x": -1.0, "root.y": -1.0}):
        game.reset(seed=1)
        put_ball(game, (0.0, 0.0, 0.11))  # out of the way
        play(game, 20, **command)
        assert len(game.agents) == 3
        goals = np.array([avatar.state.goal_root.numpy()[0] for avatar in game.batch.simulation.avatars])
        assert np.linalg.norm(goals[:, :2] - places, axis=1).max() <= 0.25 + 1e-6
        off = np.linalg.norm(pelvises(game.batch)[:, :2] - places, axis=1)
        assert off == pytest.approx(np.full(3, 0.25), abs=0.05), "1 m, were it not for the limit"
        play(game, 6 // len(command), **{name: -value for name, value in command.items()})
        assert (np.linalg.norm(pelvises(game.batch)[:, :2] - places, axis=1) < 0.15).all()


@pytest.mark.parametrize("agents", [2, 4])
def test_any_number_stands_around_the_circle(make_game, play, agents):
    game = make_game(PASS, num_agents=agents, spacing=1.4)
    game.reset(seed=0)
    at = pelvises(game.batch)
    neighbours = np.linalg.norm(at - np.roll(at, -1, axis=0), axis=1)
    assert len(game.possible_agents) == agents and neighbours == pytest.approx(np.full(agents, 1.4), abs=0.15)
    seen = game.observation_layout.split(game.batch.observation.numpy()[0, 0])
    assert seen["passer"].shape == (agents,)
    for at_agent, avatar in zip(at, game.batch.simulation.avatars, strict=True):
        facing = Rotation.from_quat(avatar.tracked.rotation.numpy()[0, 0]).apply([0.0, -1.0, 0.0])
        assert facing @ (-at_agent * [1, 1, 0]) / np.linalg.norm(at_agent[:2]) > 0.99
    # the next one is to the right of an agent that faces the middle
    if agents > 2:
        assert np.cross(-at[0] * [1, 1, 0], at[1] - at[0])[2] < 0.0
    assert len(play(game, 3)) == 3
