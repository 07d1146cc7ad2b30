"""TrackMotion: zero actions follow a clip, metrics agree with the bodies; impulses are as drawn, and decay."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, forward_kinematics, joint_index
from piavatar_envs.avatar.motion import deepmimic, load_motion
from piavatar_envs.avatar.motion.library import list_embedded
from piavatar_envs.config import ConfigError
from piavatar_envs.envs.episodes import Episodes
from piavatar_envs.tasks.track_motion import STRUCK, apply_impulse, draw_impulse
from tests.conftest import reward_terms
from tests.tasks.measured import still, tolerance

TRACK = "PIAvatar/TrackMotion-v0"


def follow(env, seconds: float, seed: int = 0) -> dict[str, np.ndarray]:
    """Metrics at every step of zero actions."""
    env.reset(seed=seed)
    rows = []
    for _ in range(round(seconds / env.config.physics.control_dt)):
        _, reward, terminated, _, info = env.step(still(env))
        assert not terminated and info["failure"] == 0
        rows.append({**{name: info[name] for name in env.batch.task.metric_names}, "reward": reward})
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def clip_frame(env, ahead: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The clip ``ahead`` steps from now: local and world rotations ``(22, 3, 3)``, joints ``(22, 3)`` in the world."""
    state, dt = env.get_state(), env.config.physics.control_dt
    start, now = int(state["task.start"][0]), int(state["env.step_count"][0])
    motion = load_motion(env.config.motion)
    quaternions, root = motion.sample((start + now + ahead) * dt)
    origin = motion.sample(start * dt)[1] * [1.0, 1.0, 0.0]
    local = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    joints = env.batch.simulation.flesh[0].points.joints[0].astype(float)
    world, positions = forward_kinematics(local, root - origin, joints)
    return local, world, positions


def tracked(env) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Local and world rotations ``(22, 3, 3)`` and joints ``(22, 3)`` of the body."""
    bones = env.batch.simulation.avatar.tracked
    local, world = (Rotation.from_quat(q.numpy()[0].astype(float)).as_matrix() for q in (bones.local, bones.rotation))
    return local, world, bones.position.numpy()[0].astype(float)


@pytest.mark.parametrize("motion", list_embedded())
def test_clips_are_followed_without_actions(make_env, motion):
    """At the coarsest body; feet that press on a ground of 14 cm cells are what is left of the error."""
    log = follow(
        make_env(TRACK, motion=motion, impulse=0.0, random_start=False), min(load_motion(motion).duration, 2.0)
    )
    assert log["mpjpe"].mean() < 0.012 and log["rotation_error_deg"].mean() < 2.5
    assert log["reward"].min() > 0.98 and not log["impulse"].any()


def test_a_clip_is_followed_closely_at_the_default_resolution(make_env):
    log = follow(make_env(TRACK, fidelity="coarse", motion="kick", impulse=0.0, random_start=False), 1.5)
    assert log["mpjpe"].mean() < 0.005 and log["rotation_error_deg"].mean() < 1.0
    assert log["mpjpe"].max() < 0.01


@pytest.mark.skipif(
    deepmimic.clip_folder() is None,
    reason="no pybullet here (its wheels are for Python 3.10 and 3.11): the DeepMimic clips are not tested",
)
def test_a_deepmimic_clip_walks_on(make_env):
    env = make_env(TRACK, motion="deepmimic:walk", impulse=0.0, random_start=False)
    log = follow(env, 2.4)
    assert log["mpjpe"].mean() < 0.02 and log["root_error"].max() < 0.02
    walked = np.linalg.norm(tracked(env)[2][0, :2])
    assert walked == pytest.approx(np.linalg.norm(clip_frame(env, 0)[2][0, :2]), abs=0.02) and walked > 1.5


@pytest.mark.parametrize("settings", [{"shape.parameters": {"legs": -0.9, "height": -0.5}}, {"shape.randomize": True}])
def test_every_body_stands_on_the_ground_and_follows(make_env, settings):
    """Short legs take short steps: none starts in the air or in the floor."""
    env = make_env(TRACK, motion="step", impulse=0.0, random_start=False, **settings)
    for seed in range(4):
        env.reset(seed=seed)
        lowest = env.batch.simulation.state.x.numpy()[0, :, 2].min()
        assert 0.0 <= lowest < 0.5 * env.batch.simulation.dx, f"seed {seed}: {lowest} m"
        infos = [env.step(still(env))[4] for _ in range(30)]
        assert np.mean([info["mpjpe"] for info in infos]) < 0.015


def write_amass(path, frames: int = 121, rate: float = 60.0) -> float:
    """An AMASS file of an elbow that swings up by ``0.5 (1 - cos)`` rad within two seconds; returns its amplitude."""
    poses, angle = np.zeros((frames, 156)), 0.5 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, frames)))
    poses[:, 0] = np.pi / 2  # stands SMPL's y-up body up
    elbow = joint_index("left_elbow")
    poses[:, 3 * elbow + 1] = -angle
    np.savez(path, poses=poses, trans=np.zeros((frames, 3)), mocap_framerate=np.array(rate), gender=np.array("neutral"))
    return float(angle.max())


def test_an_amass_file_is_followed_by_its_path(make_env, tmp_path):
    amplitude = write_amass(tmp_path / "swing.npz")
    env = make_env(TRACK, motion=str(tmp_path / "swing.npz"), impulse=0.0)
    env.reset(seed=0)
    elbow, start = joint_index("left_elbow"), tracked(env)[0]
    turned, errors = [], []
    for _ in range(75):  # the clip is over after 60: its last pose is held
        info = env.step(still(env))[4]
        turned.append(np.linalg.norm(Rotation.from_matrix(start[elbow].T @ tracked(env)[0][elbow]).as_rotvec()))
        errors.append(info["mpjpe"])
    assert max(turned) == pytest.approx(amplitude, abs=0.02) and np.argmax(turned) == pytest.approx(29, abs=1)
    assert turned[-1] == pytest.approx(0.0, abs=0.02) and max(errors) < 0.01


@pytest.mark.parametrize(
    ("motion", "error", "reason"),
    [
        ("moonwalk", ConfigError, "'moonwalk'.*arm_wave.*squat"),
        ("/no/such/clip.npz", ConfigError, "motion: .*/no/such/clip.npz"),
        ("deepmimic:moonwalk", (ConfigError, ImportError), "moonwalk|motions"),
    ],
)
def test_unknown_motions_are_refused(make_env, motion, error, reason):
    with pytest.raises(error, match=reason):
        make_env(TRACK, motion=motion)


def test_impulses_push_the_body_and_it_recovers(make_env):
    env = make_env(TRACK, motion="idle", impulse=40.0, impulse_interval=1.5)
    log = follow(env, 3.6, seed=1)
    strikes = np.flatnonzero(log["impulse"])
    assert len(strikes) == 2 and (np.diff(strikes) == 45).all()
    assert ((log["impulse"][strikes] > 0.3 * 40.0) & (log["impulse"][strikes] <= 40.0 + 1e-4)).all()
    for at in strikes:
        peak = log["mpjpe"][at : at + 6].max()
        assert log["mpjpe"][at - 1] < 0.001 and 0.005 < peak < 0.2
        later = log["mpjpe"][at + 15 : at + 16]
        assert (later < 0.15 * peak).all()
    assert log["reward"][strikes].max() < log["reward"].max()
    undisturbed = follow(make_env(TRACK, motion="idle", impulse=0.0), 0.5, seed=1)
    assert undisturbed["mpjpe"].max() < 0.001


def test_metrics_are_those_of_numpy(make_env):
    """Against the clip sampled, posed and compared in NumPy, under random actions."""
    env = make_env(TRACK, motion="kick", impulse=30.0)
    config = env.config
    for seed in range(3):
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        errors = [np.zeros((NUM_JOINTS, 3))] * 2  # before an episode
        for _ in range(8):
            info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))[4]
            (local, _, joints), (clip_local, _, clip_joints) = tracked(env), clip_frame(env, 0)
            errors.append(joints - clip_joints)
            distance = np.linalg.norm(errors[-1], axis=1)
            apart = np.linalg.norm(errors[-1] - errors[-1][0], axis=1)
            jerks = np.linalg.norm(errors[-1] - 2.0 * errors[-2] + errors[-3], axis=1)
            assert info["local_mpjpe"] == pytest.approx(apart.mean(), abs=2e-5)
            assert info["acceleration_error"] == pytest.approx(1000.0 * jerks.mean(), abs=0.05)
            turns = Rotation.from_matrix(clip_local.transpose(0, 2, 1) @ local).magnitude()
            assert info["mpjpe"] == pytest.approx(distance.mean(), abs=2e-5)
            assert info["root_error"] == pytest.approx(distance[0], abs=2e-5)
            assert info["rotation_error_deg"] == pytest.approx(np.degrees(turns.mean()), abs=5e-3)
            assert info["success"] == (distance.mean() <= config.success_distance)
            terms = reward_terms(info)
            assert terms["position"] == pytest.approx(0.6 * tolerance(distance.mean(), 0.01, 0.3), abs=2e-4)
            assert terms["rotation"] == pytest.approx(0.4 * tolerance(turns.mean(), 0.01, 0.5), abs=2e-4)


def test_the_observed_reference_is_the_clips_next_pose(make_env):
    env = make_env(TRACK, motion="kick", impulse=30.0)
    observation, _ = env.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(6):
        seen = env.observation_layout.split(observation.astype(float))
        (local, world, joints), (clip_local, clip_world, clip_joints) = tracked(env), clip_frame(env, 1)
        error = seen["reference_positions"].reshape(NUM_JOINTS, 3) @ world[0].T
        assert error == pytest.approx(clip_joints - joints, abs=2e-5)
        columns = seen["reference_root"].reshape(2, 3).T
        assert columns == pytest.approx((world[0].T @ clip_world[0])[:, :2], abs=2e-5)
        turns = Rotation.from_matrix(local.transpose(0, 2, 1) @ clip_local).as_rotvec()[1:]
        assert seen["reference_turns"].reshape(-1, 3) == pytest.approx(turns, abs=1e-4)
        observation, *_ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))


def test_straying_too_far_terminates(make_env):
    env = make_env(TRACK, motion="idle", impulse=0.0, fail_distance=0.06)
    env.reset(seed=0)
    action = still(env)
    action[env.action_names.index("root.x")] = 1.0
    rows = [env.step(action) for _ in range(6)]
    errors, ended = [row[4]["mpjpe"] for row in rows], [row[2] for row in rows]
    assert ended == [error > 0.06 for error in errors] and ended[-1] and not ended[0]
    assert rows[-1][4]["failure"] == 0 and not rows[-1][4]["root_released"]


def test_episodes_begin_anywhere_in_a_clip_that_loops(make_env):
    starts = {True: [], False: []}
    for random_start, found in starts.items():
        env = make_env(TRACK, motion="kick", random_start=random_start)
        for seed in range(12):
            env.reset(seed=seed)
            found.append(int(env.get_state()["task.start"][0]))
            _, _, clip_joints = clip_frame(env, 0)
            assert tracked(env)[2] == pytest.approx(clip_joints, abs=1e-4)
    assert starts[False] == [0] * 12 and len(set(starts[True])) > 6
    assert min(starts[True]) >= 0 and max(starts[True]) < round(load_motion("kick").duration * 30)


def test_zero_actions_hold_the_clip_and_actions_leave_it(make_env):
    env = make_env(TRACK, motion="arm_wave", impulse=0.0, random_start=False)
    env.reset(seed=0)
    action = still(env)
    action[env.action_names.index("left_elbow.z")] = -1.0
    for _ in range(3):
        env.step(action)
    elbow = joint_index("left_elbow")
    offset = Rotation.from_matrix(clip_frame(env, 0)[0][elbow].T @ tracked(env)[0][elbow]).magnitude()
    step = env.config.control.joint_speed_limit * env.config.physics.control_dt
    assert offset == pytest.approx(3 * step, abs=0.02)
    for _ in range(3):
        env.step(-action)
    offset = Rotation.from_matrix(clip_frame(env, 0)[0][elbow].T @ tracked(env)[0][elbow]).magnitude()
    assert offset == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("control", ["pose", "torque"])
def test_under_torques_bodies_begin_as_fast_as_the_clip(make_batch, control):
    """Particles and joints move from where a frame puts them to where the next one does: other episodes begin there."""
    n, dt = 48, 1.0 / 30.0
    batch = make_batch(TRACK, n, motion="arm_wave", impulse=0.0, control=control)
    batch.reset(seeds=np.arange(n))
    state, avatar = batch.simulation.state, batch.simulation.avatar
    start, x, u, local = (a.numpy() for a in (batch.task.start, state.x, state.u, avatar.tracked.local))
    own = slice(avatar.body.first, avatar.body.first + avatar.num_points)
    pairs = [(i, j) for i in range(n) for j in range(n) if start[j] == start[i] + 1]
    assert len(pairs) > 5 and not state.vk.numpy().any()
    ways = np.array([(x[j, own] - x[i, own]) / dt for i, j in pairs])
    assert np.abs(ways).max() > 0.5
    np.testing.assert_allclose([u[i, own] for i, _ in pairs], ways if control == "torque" else 0.0 * ways, atol=3e-4)
    if control == "pose":
        return
    observed = batch.observation.numpy()[:, 0, batch.layout["joint_velocities"].slice].reshape(n, NUM_JOINTS - 1, 3)
    turns = [Rotation.from_quat(local[j, 1:]) * Rotation.from_quat(local[i, 1:]).inv() for i, j in pairs]
    turns = np.array([turn.as_rotvec() / dt for turn in turns])
    np.testing.assert_allclose([observed[i] for i, _ in pairs], turns, atol=0.1)
    assert np.abs(turns).max() > 2.0


@pytest.mark.parametrize("name", ["env.step_count", "task.start", "task.playing"])
def test_a_state_from_before_the_clip_begins_with_it(make_env, name):
    """Whatever a state says, no frame is read that the clip does not have."""
    env = make_env(TRACK, random_start=False)
    env.reset(seed=0)
    state, turns = env.get_state(), env.observation_layout["reference_turns"].slice
    state[name] = np.full_like(state[name], -1)
    first = env.set_state(state)[turns]
    state[name] = np.full_like(state[name], -(2**30))
    assert np.array_equal(env.set_state(state)[turns], first)
    assert np.isfinite(env.step(still(env))[0]).all()


def schedule(device, seed: int, episode: int, steps: int, interval: int, magnitude: float, bones=(3, 9, 15)):
    """Impulses ``(steps, 3)`` [N s] and struck bones ``(steps,)`` of an episode."""
    out, struck = wp.zeros(steps, dtype=wp.vec3, device=device), wp.zeros(steps, dtype=int, device=device)

    def constant(value):
        return wp.array(np.full(steps, value, np.int32), dtype=int, device=device)

    count = wp.array(np.arange(steps, dtype=np.int32), dtype=int, device=device)
    targets = wp.array(list(bones), dtype=int, device=device)
    episodes = Episodes()
    episodes.seed, episodes.episode, episodes.step_count = constant(seed), constant(episode), count
    wp.launch(draw_impulse, steps, [episodes, interval, magnitude, targets], [out, struck], device=device)
    return out.numpy(), struck.numpy()


@pytest.mark.parametrize("interval", [1, 30])
def test_one_impulse_an_interval_at_a_moment_of_the_episodes_own(device, interval):
    firsts = []
    for episode in range(20):
        impulses, _ = schedule(device, 5, episode, 4 * interval, interval, 20.0)
        strikes = np.flatnonzero(np.linalg.norm(impulses, axis=1))
        assert len(strikes) == 4 and (np.diff(strikes) == interval).all()
        firsts.append(strikes[0])
    assert interval == 1 or len(set(firsts)) > 2
    assert not schedule(device, 1, 0, 100, 3, 0.0)[0].any(), "no magnitude"


def test_impulses_are_bounded_spread_and_reproducible(device):
    impulses, struck = schedule(device, 1, 0, 4000, 1, 20.0)
    sizes = np.linalg.norm(impulses, axis=1)
    assert 0.3 * 20.0 <= sizes.min() < 7.0 and 19.0 < sizes.max() <= 20.0 + 1e-4
    directions = impulses / sizes[:, None]
    # uniform on the sphere: mean 0 and second moments 1/3, within four standard errors of 4000 draws
    assert np.abs(directions.mean(0)).max() < 4.0 * np.sqrt(1.0 / 3.0 / 4000)
    assert np.abs(directions.T @ directions / 4000 - np.eye(3) / 3.0).max() < 4.0 * 0.3 / np.sqrt(4000)
    assert set(struck) == {3, 9, 15} and np.bincount(struck)[[3, 9, 15]].min() > 1100
    again, _ = schedule(device, 1, 0, 4000, 1, 20.0)
    assert np.array_equal(impulses, again)
    for seed, episode in ((2, 0), (1, 1)):
        other, _ = schedule(device, seed, episode, 4000, 1, 20.0)
        assert np.abs(np.corrcoef(other[:, 0], impulses[:, 0])[0, 1]) < 4.0 / np.sqrt(4000)


def test_the_momentum_that_arrives_is_the_impulse(make_batch):
    """Per body, also where shapes differ; only the struck bone's flesh moves, and nothing in a failed environment."""
    batch = make_batch(TRACK, 2, **{"shape.randomize": True})
    batch.reset(seeds=[0, 1])
    simulation, points = batch.simulation, batch.simulation.flesh[0].points
    J = np.array([[3.0, -4.0, 12.0], [-20.0, 0.5, 1.0]], np.float32)
    mass = simulation.model.particles.mass.numpy().astype(float)

    def strike(bone: int) -> np.ndarray:
        """Return the velocities that the impulses give."""
        velocity = wp.zeros_like(simulation.state.u)
        impulse = wp.array(J, dtype=wp.vec3, device=batch.device)
        struck = wp.array([bone, bone], dtype=int, device=batch.device)
        inputs = [simulation.avatar.body, impulse, struck, simulation.state.failure]
        wp.launch(apply_impulse, (2, simulation.avatar.num_points), inputs, [velocity], device=batch.device)
        return velocity.numpy().astype(float)

    for bone in map(joint_index, STRUCK):
        du = strike(bone)
        assert np.einsum("ep,epi->ei", mass, du) == pytest.approx(J, rel=2e-6)
        weight = (points.skin_weights * (points.skin_joints == bone)).sum(1)
        assert np.array_equal(np.abs(du).max((0, 2)) > 0.0, weight > 0.0)
        # heavy enough that the flesh is not torn
        assert np.linalg.norm(du, axis=2).max() / np.linalg.norm(J, axis=1).max() < 1.0
    batch.failure.assign([0, 1])
    du = strike(bone)
    assert du[0].any() and not du[1].any()
    batch.reset(seeds=[0, 1])
