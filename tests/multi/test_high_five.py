"""HighFive: conditions of a slap, metrics that agree with the bodies, and success of two that swing."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, forward_kinematics, joint_index, joint_limits
from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.episodes import Outcome
from piavatar_envs.mpm.types import Sensors
from piavatar_envs.multi import high_five_v0
from piavatar_envs.tasks.games import high_five as slap

FIVE = "high_five_v0"
SIDES = ("left", "right")


@pytest.fixture(scope="module")
def pairs(device, games):
    """Eight environments at once."""
    return BatchEnv(high_five_v0.TASK(load_config(high_five_v0.TASK.Config, None, {"fidelity": "tiny"})), 8, device)


class Swing:
    """A scripted agent: the hand to where both can reach it, pointing up, and through the other's once that is there.

    Damped least squares (Buss 2004) on finite differences of forward kinematics, from the observation alone.
    """

    HEIGHT, AHEAD, THROUGH = 1.42, 0.12, 0.1  # of the meeting point; before it to wait; beyond the hand to aim [m]

    def __init__(self, batch: BatchEnv, speed: float = 1.0) -> None:
        self.layout, self.speed = batch.layout, speed
        self.joints = [joint_index(name.partition(".")[0]) for name in batch.action_spec.names()[::3]]
        self.rest = batch.simulation.flesh[0].points.joints[0].astype(float)
        body, self.wrist = batch.simulation.avatar.body, joint_index("right_wrist")
        self.arm = (body.rest_center.numpy()[0] - body.rest_joint.numpy()[0])[self.wrist].astype(float)
        self.step = batch.config.control.joint_speed_limit * batch.config.physics.control_dt
        self.bounds = [bound[self.joints].ravel() for bound in joint_limits()]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        rows = observation.reshape(-1, observation.shape[-1])
        return np.stack([self.act(self.layout.split(row)) for row in rows]).reshape(*observation.shape[:-1], -1)

    def hand(self, local: np.ndarray) -> np.ndarray:
        """Middle of the hand from the pelvis [m], and a fifth of the upward part of its direction."""
        rotations, joints = forward_kinematics(local, np.zeros(3), self.rest)
        arm = rotations[..., self.wrist, :, :] @ self.arm
        return np.concatenate(
            [joints[..., self.wrist, :] + arm, 0.2 * arm[..., 2:] / np.linalg.norm(self.arm)], axis=-1
        )

    def act(self, seen: dict[str, np.ndarray]) -> np.ndarray:
        forward = seen["other_0_position"] * [1.0, 1.0, 0.0]
        forward /= np.linalg.norm(forward)
        gap = seen["partner_hand"].astype(float)
        aside = np.linalg.norm(gap - (gap @ forward) * forward)
        there = aside < 0.03 and gap @ forward > 0.0 and seen["own_hand_direction"][2] > 0.6
        meeting = 0.5 * seen["other_0_position"] * [1.0, 1.0, 0.0] + [0.0, 0.0, self.HEIGHT - seen["root_height"][0]]
        goal = seen["own_hand"] + gap + self.THROUGH * forward if there else meeting - self.AHEAD * forward
        x, y = np.moveaxis(seen["joint_rotations"].astype(float).reshape(-1, 2, 3), 1, 0)
        local = np.concatenate([np.eye(3)[None], np.stack([x, y, np.cross(x, y)], axis=-1)])
        here = self.hand(local)
        wanted = np.append(goal, 0.2 * 0.9) - here
        wanted[3] = max(wanted[3], 0.0)
        angles = Rotation.from_matrix(local[self.joints]).as_rotvec().ravel()
        jacobian = self.jacobian(local, here)
        turn = least_squares(jacobian, wanted)
        lower, upper = self.bounds
        stuck = ((angles < lower + 0.01) & (turn < 0.0)) | ((angles > upper - 0.01) & (turn > 0.0))
        turn = least_squares(jacobian * ~stuck, wanted) / self.step
        return self.speed * turn / max(1.0, np.abs(turn).max())

    def jacobian(self, local: np.ndarray, here: np.ndarray, small: float = 1e-4) -> np.ndarray:
        turned = np.tile(local, (3 * len(self.joints), 1, 1, 1))
        turns = Rotation.from_rotvec(small * np.eye(3)).as_matrix()
        for n, joint in enumerate(self.joints):
            turned[3 * n : 3 * n + 3, joint] = local[joint] @ turns
        return (self.hand(turned) - here).T / small


def least_squares(jacobian: np.ndarray, wanted: np.ndarray, damping: float = 0.05) -> np.ndarray:
    return jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping**2 * np.eye(len(wanted)), wanted)


def hand_of(batch: BatchEnv, agent: int, side: str, env: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Middle of a hand and unit vector to it from the wrist joint: rest points carried by Kabsch in NumPy."""
    simulation, wrist = batch.simulation, joint_index(f"{side}_wrist")
    points, body = simulation.flesh[agent].points, simulation.avatars[agent].body
    x = simulation.state.x.numpy()[env, body.first : body.first + body.count].astype(float)
    rest, mass = points.rest[0].astype(float), points.mass[0].astype(float)
    weight = mass * (points.skin_weights * (points.skin_joints == wrist)).sum(1)
    middle = weight @ rest / weight.sum()
    p = points.bone == wrist
    turn = Rotation.align_vectors(x[p] - x[p].mean(0), rest[p] - rest[p].mean(0))[0]
    arm = turn.apply(middle - points.joints[0, wrist])
    return x[p].mean(0) + turn.apply(middle - rest[p].mean(0)), arm / np.linalg.norm(arm)


def gaussian(excess: float, margin: float) -> float:
    """dm_control's tolerance: a tenth at the margin."""
    return 10.0 ** (-((max(excess, 0.0) / margin) ** 2))


def test_agents_that_swing_succeed(pairs):
    """All eight, within a second; what they earn is a little approach and the bonus, alike for both."""
    pairs.reset(seeds=range(8))
    policy, over, total = Swing(pairs), np.zeros(8, bool), np.zeros((8, 2))
    rule = pairs.config
    for _ in range(30):
        pairs.action.assign(policy(pairs.observation.numpy()).astype(np.float32))
        pairs.step()
        total += np.where(over[:, None], 0.0, pairs.reward.numpy())
        success, ended, metrics = (array.numpy() for array in (pairs.success, pairs.terminated, pairs.metrics))
        for e in np.flatnonzero(ended.any(1) & ~over):
            assert success[e].all() and ended[e].all()
            distance, height, upright, impulse = metrics[e, 0]
            assert distance <= rule.reach and height >= rule.least_height and upright >= rule.upright
            assert rule.impulse[0] <= impulse <= rule.impulse_window * rule.impulse[0]
        over |= ended.any(1)
    assert over.all() and (total > rule.slap_bonus).all() and (total < rule.slap_bonus + 0.2 * 30).all()
    assert np.array_equal(total[:, 0], total[:, 1])


@pytest.mark.parametrize(
    ("why", "success", "ended"),
    [
        ("a slap", True, True),
        ("too soft", False, False),
        ("too hard", False, True),
        ("too far apart", False, False),
        ("one hand too low", False, False),
        ("one hand hangs", False, False),
        ("one arm strikes a body", False, False),
        ("the other arms", False, False),
    ],
)
def test_the_rule_of_a_slap(device, why, success, ended):
    """The rule alone, on made-up hands and impulses."""
    middle = np.array([[[0.0, 0.0, 1.5], [0.0, 0.1, 1.4]]], np.float32)
    direction = np.array([[[0.0, -0.6, 0.8], [0.0, 0.8, 0.6]]], np.float32)
    parts, arm = np.zeros((1, 2 * len(BODY_PARTS), 2, 3), np.float32), list(BODY_PARTS).index("right_arm")
    blow = {"too soft": 1.9, "too hard": 6.1}.get(why, 3.0)
    parts[0, arm, 1], parts[0, len(BODY_PARTS) + arm, 0] = (0.0, -blow, 0.0), (0.0, blow, 0.0)
    if why == "too far apart":
        middle[0, 1, 1] = 0.2
    elif why == "one hand too low":
        middle[0, 1, 2] = 1.29
        middle[0, 0, 2] = 1.31
    elif why == "one hand hangs":
        direction[0, 1] = (0.0, -0.9, 0.4)
    elif why == "one arm strikes a body":
        parts[0, arm, 1] = 0.0
    elif why == "the other arms":
        parts = np.roll(parts, -1, axis=1)
    rule, hands, sensors = slap.SlapRule(), slap.Hands(), Sensors()
    rule.impulse_window, rule.reach, rule.least_height, rule.upright = 3.0, 0.15, 1.3, 0.5
    rule.margin, rule.slap_bonus, rule.approach_weight = 0.5, 7.0, 0.2
    hands.middle, hands.direction = (wp.array(a, dtype=wp.vec3, device=device) for a in (middle, direction))
    sensors.part_impulse = wp.array(parts, dtype=wp.vec3, device=device)
    side, least = wp.array([1], dtype=int, device=device), wp.array([2.0], dtype=float, device=device)
    outcome = Outcome()
    outcome.terms, outcome.metrics, action = (wp.zeros((1, 2, n), dtype=float, device=device) for n in (3, 4, 5))
    outcome.success, outcome.terminated = (wp.zeros((1, 2), dtype=wp.bool, device=device) for _ in range(2))
    wp.launch(slap.judge, 1, [rule, side, least, hands, sensors, action], [outcome], device=device)
    assert outcome.success.numpy().tolist() == [[success] * 2] and outcome.terminated.numpy().tolist() == [[ended] * 2]
    distance, height = np.linalg.norm(middle[0, 0] - middle[0, 1]), middle[0, :, 2].min()
    lacks = max(1.3 - height, 0.0) + 0.2 * max(0.5 - direction[0, :, 2].min(), 0.0)
    approach = 0.2 * gaussian(distance + lacks - 0.15, 0.5)
    assert outcome.terms.numpy()[0] == pytest.approx(np.array([[approach, 7.0 * success, 0.0]] * 2), abs=1e-5)
    impulse = {"one arm strikes a body": 0.0, "the other arms": 0.0}.get(why, blow)
    metrics = [distance, height, direction[0, :, 2].min(), impulse]
    assert outcome.metrics.numpy()[0] == pytest.approx(np.array([metrics] * 2), abs=1e-5)


def test_they_stand_face_to_face_and_a_little_apart(make_game):
    game = make_game(FIVE, place_noise=0.1, spacing=0.9)
    ways = []
    for seed in range(12):
        game.reset(seed=seed)
        roots = [avatar.tracked.position.numpy()[0, 0] for avatar in game.batch.simulation.avatars]
        ways.append(roots[0] - roots[1])
        heading = [
            Rotation.from_quat(avatar.tracked.rotation.numpy()[0, 0]).apply([0.0, -1.0, 0.0])
            for avatar in game.batch.simulation.avatars
        ]
        assert heading[0] == pytest.approx([0, -1, 0], abs=1e-3) and heading[1] == pytest.approx([0, 1, 0], abs=1e-3)
    spread = np.array(ways) - [0.0, 0.9, 0.0]
    assert np.abs(spread).max() <= 0.2 + 1e-3 and np.ptp(spread, axis=0)[:2].min() > 0.1


def test_what_is_observed_is_where_the_hands_are(make_game, play):
    """Each from its own pelvis, of the hand that is drawn for the episode."""
    game = make_game(FIVE, hand="random", impulse=(0.5, 2.0))
    batch, sides, weakest = game.batch, set(), []
    for seed in range(8):
        game.reset(seed=seed)
        play(game, 3, np.random.default_rng(seed))
        side = int(batch.task.side.numpy()[0])
        sides.add(side)
        weakest.append(float(batch.task.least.numpy()[0]))
        for agent, avatar in enumerate(batch.simulation.avatars):
            seen = game.observation_layout.split(batch.observation.numpy()[0, agent].astype(float))
            hands = [hand_of(batch, a, SIDES[side]) for a in (0, 1)]
            distance, height = np.linalg.norm(hands[0][0] - hands[1][0]), min(hand[0][2] for hand in hands)
            upright = min(hand[1][2] for hand in hands)
            assert batch.metrics.numpy()[0, agent, :3] == pytest.approx([distance, height, upright], abs=5e-4)
            at, turn = avatar.tracked.position.numpy()[0, 0], Rotation.from_quat(avatar.tracked.rotation.numpy()[0, 0])
            (own, direction), (other, _) = hands[agent], hands[1 - agent]
            assert at + turn.apply(seen["own_hand"]) == pytest.approx(own, abs=5e-4)
            assert turn.apply(seen["own_hand_direction"]) == pytest.approx(direction, abs=5e-3)
            assert turn.apply(seen["partner_hand"]) == pytest.approx(other - own, abs=1e-3)
            velocity = batch.simulation.avatars[1 - agent].tracked.velocity.numpy()[0]
            expected = velocity[joint_index(f"{SIDES[side]}_wrist")]
            assert turn.apply(seen["partner_hand_velocity"]) == pytest.approx(expected, abs=1e-4)
            assert seen["hand_side"] == [(-1.0, 1.0)[side]] and seen["least_impulse"] == pytest.approx(weakest[-1:])
    assert sides == {0, 1} and 0.5 <= min(weakest) < 0.9 and 1.6 < max(weakest) <= 2.0


@pytest.mark.parametrize(("hand", "arms"), [("right", {"right"}), ("left", {"left"}), ("random", {"left", "right"})])
def test_the_hands_arm_acts_and_what_does_not_vary_is_not_observed(hand, arms):
    impulse = (0.5, 2.0) if hand == "random" else (1.0, 1.0)
    task = high_five_v0.TASK(load_config(high_five_v0.TASK.Config, None, {"hand": hand, "impulse": impulse}))
    acting = {name.partition(".")[0] for name in task.action_spec().names()}
    sided = {name for name in acting if name.partition("_")[0] in SIDES}
    assert acting - sided == {"spine1", "spine2", "spine3"}
    assert sided == {f"{side}_{joint}" for side in arms for joint in ("collar", "shoulder", "elbow", "wrist")}
    observed = {term.name for term in task.terms()}
    assert ({"hand_side", "least_impulse"} <= observed) == (hand == "random") == ("hand_side" in observed)
