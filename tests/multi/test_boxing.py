"""Boxing: points of a blow, the agent that scores them, and the winner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, joint_index
from piavatar_envs.envs.episodes import Episodes
from piavatar_envs.mpm.types import Sensors
from tests.conftest import reward_terms

BOXING = "boxing_v0"
PARTS = tuple(BODY_PARTS)
LEAST, POINTS = 1.5, (1.0, 0.4)


class Scorer:
    """The kernel that counts points, over made-up impulses of one environment of ``agents``."""

    def __init__(self, device: str, agents: int = 2) -> None:
        from piavatar_envs.tasks.games.boxing import Rules, count_points

        self.device, self.agents, self.kernel, self.rules = device, agents, count_points, Rules()
        self.rules.blow_impulse, self.rules.points = LEAST, wp.vec2(*POINTS)
        pairs = 1, agents, agents
        self.impulse = wp.full(pairs, wp.vec2(np.nan, np.nan), dtype=wp.vec2, device=device)
        self.points = wp.full(pairs, np.nan, dtype=float, device=device)
        self.peak = wp.zeros(pairs, dtype=wp.vec2, device=device)
        self.score = wp.zeros(pairs[:2], dtype=float, device=device)
        self.alive = np.ones((1, agents), bool)
        self.failure = 0

    def count(self, touches: dict[tuple[int, str, int], tuple[float, float, float]]) -> np.ndarray:
        """Points ``(agents, agents)`` for impulses [N s] by (agent, its body part, other agent)."""
        part_impulse = np.zeros((1, self.agents * len(PARTS), self.agents, 3), np.float32)
        for (agent, part, by), impulse in touches.items():
            part_impulse[0, agent * len(PARTS) + PARTS.index(part), by] = impulse
        sensors = Sensors()
        sensors.part_impulse = wp.array(part_impulse, dtype=wp.vec3, device=self.device)
        episodes = Episodes()
        episodes.alive = wp.array(self.alive, dtype=wp.bool, device=self.device)
        episodes.failure = wp.array([self.failure], dtype=int, device=self.device)
        outputs = [self.peak, self.score, self.impulse, self.points]
        wp.launch(self.kernel, (1, self.agents), [self.rules, episodes, sensors, *outputs], device=self.device)
        return self.points.numpy()[0]

    def blow(self, strength: float, target: str = "head", arm: str = "right_arm", felt: float | None = None) -> float:
        """Points for agent 0 of one step in which it strikes agent 1."""
        felt = strength if felt is None else felt
        points = self.count({(1, target, 0): (0.0, strength, 0.0), (0, arm, 1): (0.0, -felt, 0.0)})
        assert points[1, 0] == points[0, 0] == points[1, 1] == 0.0
        return float(points[0, 1])


def expected(strength: float, full: float) -> float:
    return full * min(max(strength / LEAST - 1.0, 0.0), 1.0)


@pytest.mark.parametrize("strength", [1.5, 2.0, 30.0])
@pytest.mark.parametrize(("target", "full"), [("head", POINTS[0]), ("torso", POINTS[1]), ("left_leg", 0.0)])
def test_points_depend_on_target_and_strength(games, device, strength, target, full):
    for arm in ("left_arm", "right_arm"):
        assert Scorer(device).blow(strength, target, arm) == pytest.approx(expected(strength, full), abs=1e-6)


def test_only_the_impulse_on_the_arms_counts(games, device):
    assert Scorer(device).blow(9.0, felt=2.0) == pytest.approx(expected(2.0, 1.0), abs=1e-6)
    assert Scorer(device).blow(9.0, arm="left_leg") == Scorer(device).blow(9.0, arm="head") == 0.0


def test_a_contact_counts_once_by_its_strongest_step(games, device):
    scorer = Scorer(device)
    strengths = [2.0, 2.6, 2.2, 1.0, 2.4, 2.8, 0.7, 2.3, 0.0, 3.5]
    gained = [scorer.blow(strength) for strength in strengths]
    value = [expected(strength, 1.0) for strength in strengths]
    # 2.0 to 2.8 are one contact (it never falls below 0.75); 2.3 and 3.5 are new ones
    first = [value[0], value[1] - value[0], 0.0, 0.0, 0.0, value[5] - value[1]]
    assert gained == pytest.approx([*first, 0.0, value[7], 0.0, 1.0], abs=1e-6)
    assert scorer.score.numpy()[0] == pytest.approx([sum(gained), 0.0], abs=1e-6)


def test_points_belong_to_the_striking_agent(games, device):
    scorer = Scorer(device, agents=3)
    points = scorer.count({
        (2, "head", 0): (3.0, 0.0, 0.0), (0, "left_arm", 2): (-3.0, 0.0, 0.0),
        (0, "torso", 1): (0.0, 0.0, 9.0), (1, "right_arm", 0): (0.0, 0.0, -9.0),
        (1, "head", 2): (9.0, 0.0, 0.0),  # not by the arms of 2
    })  # fmt: skip
    wanted = np.zeros((3, 3))
    wanted[0, 2], wanted[1, 0] = 1.0, POINTS[1]
    assert points == pytest.approx(wanted, abs=1e-6)


def test_an_agent_that_is_out_neither_scores_nor_is_scored_on(games, device):
    for out in (0, 1):
        scorer = Scorer(device)
        scorer.alive[0, out] = False
        assert scorer.blow(9.0) == 0.0 and not scorer.score.numpy().any()
    scorer = Scorer(device)
    scorer.failure = 1
    assert scorer.blow(9.0) == 0.0


def straight_right() -> tuple[np.ndarray, np.ndarray]:
    """Local rotations on guard and at the end of a straight right at the head, wxyz ``(22, 4)``."""
    from piavatar_envs.avatar.motion.keyframes import Arm
    from piavatar_envs.tasks.common.multi_agent import Stance
    from piavatar_envs.tasks.games.boxing import STANCE

    turns = {**STANCE.turns, "spine2": (5.0, 0.0, 14.0), "spine3": (0.0, 0.0, 14.0)}
    struck = replace(STANCE, turns=turns, right_arm=Arm((-0.15, -0.88, 0.42), (-0.22, -0.88, 0.42)))
    return tuple(Stance(key).local_rotations for key in (STANCE, struck))


def strike(game, steps: int = 20) -> list[tuple]:
    """Agent 0 steps in, throws a straight right and draws it back; agent 1 keeps its guard."""
    poses, log = [Rotation.from_quat(pose, scalar_first=True) for pose in straight_right()], []
    step = game.config.control.joint_speed_limit * game.config.physics.control_dt
    for _ in range(steps):
        k = int(game.batch.step_count.numpy()[0])
        actions = {name: np.zeros(game.action_space(name).shape) for name in game.agents}
        now = Rotation.from_quat(game.batch.simulation.avatars[0].state.command_rotation.numpy()[0])
        way = (now.inv() * poses[4 <= k < 15]).as_rotvec() / step
        for n, joint in enumerate(game.batch.task.joints):
            actions["agent_0"][3 * n : 3 * n + 3] = np.clip(way[joint_index(joint)], -1.0, 1.0)
        actions["agent_0"][game.action_names.index("root.y")] = -1.0 if k < 8 else 0.0
        log.append(game.step(actions))
    return log


#: Here any touch by the arms is nearly a full blow: these tests are about the bout, not about how hard bodies are.
SOFT = {"pose_noise": 0.0, "place_noise": 0.0, "blow_impulse": 0.12}


def test_a_straight_right_scores(make_game):
    game = make_game(BOXING, **SOFT)
    game.reset(seed=0)
    log = strike(game)
    hits = [row[4]["agent_0"]["reward_hit"] for row in log]
    taken = [row[4]["agent_1"]["reward_taken"] for row in log]
    assert sum(hits) > 0.4 and log[-1][4]["agent_0"]["score"] == pytest.approx(sum(hits), abs=1e-5)
    assert taken == pytest.approx([-game.config.taken_weight * hit for hit in hits], abs=1e-6)
    for row in log:
        assert row[4]["agent_0"]["given_impulse"] == row[4]["agent_1"]["taken_impulse"]
    assert sum(hits) > log[-1][4]["agent_1"]["score"]
    game.reset()
    assert not game.batch.task.score.numpy().any() and not game.batch.task.peak.numpy().any()


@pytest.mark.parametrize(
    ("score", "winner"), [((2.0, 1.0), 0), ((0.0, 0.5), 1), ((1.0, 1.0), None), ((0.0, 0.0), None)]
)
def test_points_decide_when_the_clock_runs_out(make_game, play, score, winner):
    game = make_game(BOXING, max_cycles=3)
    game.reset(seed=0)
    state = game.get_state()
    state["task.score"][0] = score
    game.set_state(state)
    rows = play(game, 5)
    assert len(rows) == 3 and all(rows[-1][3].values()) and not any(rows[-1][2].values())
    assert not any(info["success"] for row in rows[:-1] for info in row[4].values())
    assert [info["success"] for info in rows[-1][4].values()] == [winner == 0, winner == 1]


@pytest.mark.parametrize("settings", [{}, {"max_cycles": 1}, {"num_agents": 3}], ids=["two", "at the gong", "three"])
def test_an_agent_that_is_down_is_out_whatever_its_points(make_game, play, settings):
    """The last one up wins; of three, the two others go on."""
    game = make_game(BOXING, **settings)
    game.reset(seed=0)
    state = game.get_state()
    state["task.score"][0, 0] = 3.0
    state["avatar_0.state.released"][:] = 1
    game.set_state(state)
    [(_, _, terminations, _, infos)] = play(game, 1)
    goes_on = settings.get("num_agents") == 3
    assert list(terminations.values()) == [True, not goes_on, not goes_on][: len(terminations)]
    assert game.agents == (["agent_1", "agent_2"] if goes_on else [])
    assert [info["success"] for info in infos.values()] == [False, not goes_on, False][: len(infos)]
    terms = [reward_terms(infos[name]) for name in ("agent_0", "agent_1")]
    assert [term["down"] for term in terms] == [-game.config.down_cost, 0.0]
    assert [term["win"] for term in terms] == [0.0, 0.0 if goes_on else game.config.win_reward]


def test_when_both_are_down_at_the_gong_points_do_not_decide(make_game, play):
    game = make_game(BOXING, max_cycles=1)
    game.reset(seed=0)
    state = game.get_state()
    state["task.score"][0] = (3.0, 0.0)
    for agent in (0, 1):
        state[f"avatar_{agent}.state.released"][:] = 1
    game.set_state(state)
    [(_, _, terminations, truncations, infos)] = play(game, 1)
    assert all(terminations.values()) and not any(truncations.values())
    assert not any(info["success"] for info in infos.values())


@pytest.mark.parametrize(
    "settings", [{}, {"control": "torque", "fall.fall_head": 0.0, "fall.fall_pelvis": 0.0}], ids=str
)
def test_the_ropes_hold(make_game, play, settings):
    """An agent that walks backwards or is thrown into them; limp bodies need more room to fall where no ropes are."""
    game = make_game(BOXING, ring_size=2.2, **settings)
    game.reset(seed=0)
    if settings:
        state, body = game.get_state(), game.batch.simulation.avatars[0].body
        state["particles.u"][0, body.first : body.first + body.count] = [0.0, 3.0, 0.0]  # away from the middle
        game.set_state(state)
    dx, farthest = game.batch.simulation.dx, []
    for _ in range(30):
        [(*_, infos)] = play(game, 1, **({} if settings else {"root.y": 1.0}))
        assert infos["agent_0"]["failure"] == 0 and len(game.agents) == 2
        farthest.append(np.abs(game.batch.simulation.state.x.numpy()[0, :, 1]).max())
    assert 1.1 - dx < max(farthest) < 1.1 + 0.5 * dx
