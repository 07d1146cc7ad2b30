"""Scorers by measurement and by recording, on episodes whose scores are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agents.fit.recordings import read_recording
from agents.fit.rollout import Episode, World
from agents.fit.scorers import Unscored
from agents.fit.scorers.measured import Config as MeasuredConfig
from agents.fit.scorers.measured import MeasuredScorer, dominant_frequency
from agents.fit.scorers.recorded import Config as RecordedConfig
from agents.fit.scorers.recorded import RecordedScorer, at_times
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.config import ConfigError, EnvConfig, load_config

DT, STEPS, BONES = 1.0 / 30.0, 60, len(JOINT_NAMES)
PELVIS, HEAD = JOINT_NAMES.index("pelvis"), JOINT_NAMES.index("head")


@pytest.fixture
def world() -> World:
    config = load_config(EnvConfig, {"physics.control_dt": DT, "episode_seconds": STEPS * DT})
    return World(config, ("ball", "cube"), ("agent_0", "ball", "cube"), np.array([PELVIS] * 4 + [HEAD] * 4))


def measured(world, **settings) -> MeasuredScorer:
    scorer = MeasuredScorer(load_config(MeasuredConfig, {"prop": "ball", **settings}))
    scorer.connect(world)
    return scorer


def moving(dent: np.ndarray, turn: float = 0.0) -> Episode:
    """Return an episode of a body that turns and drifts as a whole, whose first particle is displaced by ``dent``."""
    steps = len(dent)
    turns = Rotation.from_rotvec(np.outer(np.linspace(0.0, turn, steps), [0.0, 0.0, 1.0]))
    drift = np.linspace(0.0, 0.4, steps)[:, None] * np.array([1.0, 2.0, 0.5])
    rest = np.random.default_rng(0).normal(0.0, 0.1, (8, 3))
    local = np.repeat(rest[None], steps, 0)
    local[:, 0, 1] += dent
    x = np.stack([turns.apply(points) for points in local.transpose(1, 0, 2)], 1) + drift[:, None]
    quaternion = np.roll(turns.as_quat(), 1, axis=1)
    readings = {"particle_position": x.astype(np.float32)}
    readings["bone_position"] = np.repeat(drift[:, None], BONES, 1)
    readings["bone_rotation"] = np.repeat(quaternion[:, None], BONES, 1)
    return Episode(0, readings)


def touched(episode: Episode, first: int, last: int, impulse: float = 1.0) -> Episode:
    """Let the ball touch one body part from a step to another one."""
    steps = STEPS + 1
    parts = np.zeros((steps, 6, 3, 3), np.float32)
    parts[first:last, 2, 1, 1] = impulse
    parts[:, 1, 2, 0] = 5.0  # another prop does all the time
    episode.readings["part_impulse"] = parts
    return episode


# Measured.


def test_a_dent_is_counted_in_the_frame_of_its_bone(world):
    dent = 0.05 * np.sin(np.linspace(0.0, np.pi, STEPS + 1))
    for turn in (0.0, 1.5):
        assert measured(world).score(moving(dent, turn)) == pytest.approx(0.05, abs=1e-5)
        assert measured(world, joints=["head"]).score(moving(dent, turn)) == pytest.approx(0.0, abs=1e-5)
    scorer = measured(world, target=0.08)
    assert scorer.direction == "minimize" and scorer.score(moving(dent)) == pytest.approx(0.03, abs=1e-5)


@pytest.mark.parametrize("frequency", [2.3, 5.0, 9.7])
def test_the_frequency_of_a_jiggle(world, frequency):
    time = DT * np.arange(STEPS + 1)
    dent = np.where(time < 0.5, 0.1, 0.01 * np.exp(-0.5 * time) * np.cos(2.0 * np.pi * frequency * time))
    episode = touched(moving(dent, 0.3), 3, 15)
    assert measured(world, quantity="jiggle_frequency").score(episode) == pytest.approx(frequency, rel=0.03)
    assert dominant_frequency(np.sin(2.0 * np.pi * frequency * time) + time, DT) == pytest.approx(frequency, rel=0.02)
    still = touched(moving(np.zeros(STEPS + 1)), 3, 15)
    with pytest.raises(Unscored, match="at rest"):
        measured(world, quantity="jiggle_frequency").score(still)
    with pytest.raises(Unscored, match="too few"):
        measured(world, quantity="jiggle_frequency").score(touched(still, 3, STEPS - 2))


def test_rebound_and_contact(world):
    velocity = np.zeros((STEPS + 1, 2, 3), np.float32)
    velocity[:10, 0], velocity[10:, 0] = (0.0, 4.0, -3.0), (0.5, -1.6, 1.2)
    episode = touched(Episode(0, {"prop_velocity": velocity}), 9, 12)
    assert measured(world, quantity="rebound_speed").score(episode) == pytest.approx(2.0)
    assert measured(world, quantity="contact_time").score(episode) == pytest.approx(3 * DT)
    with pytest.raises(Unscored, match="does not touch"):
        measured(world, quantity="contact_time").score(touched(episode, 5, 5))
    with pytest.raises(ConfigError, match=r"prop='stone' must be one of .*ball, cube"):
        measured(world, quantity="contact_time", prop="stone")


def test_pose_deviation_is_the_angle_of_all_joints(world):
    local = np.zeros((STEPS + 1, BONES, 4))
    local[..., 0] = 1.0
    local[30, 5] = [-np.cos(0.2), np.sin(0.2), 0.0, 0.0]  # the same rotation as that of the opposite sign
    local[:, 0] = [0.0, 1.0, 0.0, 0.0]
    expected = 0.4 / np.sqrt(BONES - 1)
    score = measured(world, quantity="pose_deviation").score(Episode(0, {"bone_local_rotation": local}))
    assert score == pytest.approx(expected, rel=1e-6)


# Recorded.


def recorded(world, path, **settings) -> RecordedScorer:
    scorer = RecordedScorer(load_config(RecordedConfig, {"path": str(path), **settings}))
    scorer.connect(world)
    return scorer


def test_positions_are_interpolated_in_time(world, tmp_path):
    path = tmp_path / "props.npz"
    time = np.array([0.0, 0.45 * DT, 2.0 * DT, 7.7 * DT])
    line = np.array([1.0, -2.0, 0.5])
    prop = np.repeat((time[:, None] * line)[:, None], 2, 1)
    prop[2, 1] = np.nan  # not seen
    np.savez(path, time=time, prop_position=prop + [0.0, 0.0, 0.02])
    played = np.repeat((DT * np.arange(STEPS + 1)[:, None] * line)[:, None], 2, 1)
    assert recorded(world, path).score(Episode(0, {"prop_position": played})) == pytest.approx(0.02)
    # an episode that has ended stays where it was
    assert at_times(played[:3], DT, np.array([50.0 * DT]))[0] == pytest.approx(played[2])
    other = recorded(world, path, start=1.5 * DT, end=3.0 * DT)
    assert other.kept.tolist() == [2]
    with pytest.raises(ConfigError, match="has 2 points and the environment 1"):
        other.score(Episode(0, {"prop_position": played[:, :1]}))


def test_markers_follow_their_particles_or_the_nearest(world, tmp_path):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(STEPS + 1, 20, 3))
    marker = x[:, [3, 7]]
    np.savez(tmp_path / "known.npz", marker_position=marker, marker_particle=[3, 7])
    np.savez(tmp_path / "near.npz", marker_position=marker + 1e-3)
    for name in ("known", "near"):
        scorer = recorded(world, tmp_path / f"{name}.npz")
        assert scorer.readings == ("particle_position",)
        assert scorer.score(Episode(0, {"particle_position": x})) == pytest.approx(0.0, abs=1e-9)
        assert scorer.score(Episode(0, {"particle_position": x + 0.01})) > (0.01 if name == "known" else -1.0)


def test_states_are_recordings(world, tmp_path):
    bones = np.random.default_rng(0).normal(size=(STEPS + 1, 1, BONES, 3))
    np.savez(tmp_path / "states.npz", **{"avatar_0.tracked.position": bones, "env.seed": np.zeros((STEPS + 1, 1))})
    scorer = recorded(world, tmp_path / "states.npz")
    assert scorer.readings == ("bone_position",)
    assert scorer.score(Episode(0, {"bone_position": bones[:, 0]})) == pytest.approx(0.0, abs=1e-12)


def test_files_that_are_no_recordings_are_refused(world, tmp_path):
    path = tmp_path / "bad.npz"
    seen = np.zeros((4, 2, 3))
    hidden = np.full((4, 2, 3), np.nan)
    for arrays, message in (
        ({"speed": seen}, "no positions"),
        ({"prop_position": seen[0]}, r"shape \(2, 3\)"),
        ({"prop_position": seen, "time": [0.0, 1.0, 1.0, 2.0]}, "increasing seconds"),
        ({"prop_position": seen, "bone_position": seen[:2]}, "different numbers of times"),
        ({"marker_position": hidden}, "shape"),
        ({"marker_position": np.concatenate([hidden[:1], seen])}, "seen in the first entry"),
        ({"marker_position": seen, "marker_particle": [1]}, "one particle a marker"),
        ({"prop_position": np.array([object()])}, "path="),
    ):
        np.savez(path, **arrays)
        with pytest.raises(ConfigError, match=message):
            read_recording(path)
    path.write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="path="):
        read_recording(path)
    np.savez(path, prop_position=np.zeros((STEPS + 5, 2, 3)))
    with pytest.raises(ConfigError, match=r"lasts .* s and env\.episode_seconds"):
        recorded(world, path)
    with pytest.raises(ConfigError, match="nothing is recorded"):
        recorded(world, path, start=30.0, end=40.0)
