"""Actions: refused and clipped values, angles and axes of the motion, joint limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, joint_limits
from piavatar_envs.config.schema import select_joints
from piavatar_envs.mpm.types import FAILURE_ACTION

KICK = "PIAvatar/KickBall-v0"


def tracked_local(env, index: int = 0) -> Rotation:
    """Return the tracked joint rotations relative to their parents."""
    batch = getattr(env, "batch", env)
    return Rotation.from_quat(batch.simulation.avatar.tracked.local.numpy()[index].astype(float))


def tracked_root(env) -> tuple[np.ndarray, float]:
    """Return the tracked pelvis position [m] and heading [rad]."""
    position = env.batch.simulation.avatar.tracked.position.numpy()[0, 0].astype(float)
    left = tracked_local(env)[0].apply([1.0, 0.0, 0.0])
    return position, float(np.arctan2(left[1], left[0]))


def command(env) -> np.ndarray:
    """Return the commanded rotation vectors [rad], shape ``(22, 3)``."""
    return Rotation.from_quat(env.batch.get_state()["avatar_0.state.command_rotation"][0].astype(float)).as_rotvec()


def clip_pose(env) -> np.ndarray:
    """Return the rotation vectors of the clip at the last step [rad], shape ``(22, 3)``; zeros without a clip."""
    clip, state = getattr(env.batch.task, "clip", None), env.batch.get_state()
    if clip is None:
        return np.zeros((NUM_JOINTS, 3))
    frame = int(state["task.start"][0] + state["env.step_count"][0])
    return Rotation.from_quat(clip.rotation.numpy()[frame].astype(float)).as_rotvec()


def bad_actions(size: int) -> dict[str, tuple[object, str]]:
    """Return cases: an action, and a pattern of its error with ``{index}`` for the component's name."""

    def at(index, value):
        action = np.zeros(size, np.float32)
        action[index] = value
        return action

    return {
        "too long": (np.zeros(size + 1), rf"shape \({size + 1},\).*\({size},\)"),
        "too short": (np.zeros(size - 1), rf"shape \({size - 1},\).*\({size},\)"),
        "a row": (np.zeros((1, size)), rf"shape \(1, {size}\).*\({size},\)"),
        "a number": (0.5, rf"shape \(\).*\({size},\)"),
        "not a number": (at(7, np.nan), r"action\[7\] \({7}\) is nan.*finite"),
        "infinite": (at(size - 1, np.inf), rf"action\[{size - 1}\] \({{{size - 1}}}\) is inf.*finite"),
        "complex": (np.zeros(size) * 1j, "complex.*action.real"),
        "minus infinity": (at(0, -np.inf), r"action\[0\] \({0}\) is -inf.*finite"),
    }


@pytest.mark.parametrize("case", bad_actions(9))
def test_bad_actions_are_refused_before_anything_changes(make_env, case):
    env = make_env(KICK)
    env.reset(seed=0)
    env.step(np.full(env.action_space.shape, 0.3))
    action, words = bad_actions(env.action_space.shape[0])[case]
    before, observation = env.get_state(), env.batch.observation.numpy().copy()
    pattern = words if words.startswith("shape") else words.format(*env.action_names)
    with pytest.raises(ValueError, match=pattern):
        env.step(action)
    after = env.get_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)
    assert np.array_equal(env.batch.observation.numpy(), observation)
    assert env.step(np.zeros(env.action_space.shape))[4]["failure"] == 0


def test_a_batch_ends_the_environment_of_a_nonfinite_action_only(make_batch, sample_id, equal):
    """Count such an action as zero and as a failure: a refusal would have to wait for the device."""
    batch = make_batch(sample_id, 3)
    batch.reset(seeds=[0, 1, 2])
    batch.step()
    action = np.full(batch.action.shape, 0.5, np.float32)
    batch.action.assign(action)
    state = batch.get_state()
    batch.step()
    expected = batch.observation.numpy().copy()
    batch.set_state(state)
    action[1, 0, 4] = np.nan
    batch.action.assign(action)
    batch.step()
    assert batch.failure.numpy().tolist() == [0, FAILURE_ACTION, 0]
    assert batch.terminated.numpy().tolist() == [[False], [True], [False]]
    got = batch.observation.numpy()
    assert np.isfinite(got).all() and np.isfinite(batch.reward.numpy()).all()
    assert equal(got[[0, 2]], expected[[0, 2]])
    batch.action.zero_()


def test_actions_beyond_one_are_clipped(make_env, sample_id, equal):
    env = make_env(sample_id)
    rng = np.random.default_rng(0)
    wild = rng.uniform(-50.0, 50.0, (4, *env.action_space.shape))
    runs = []
    for actions in (wild, np.clip(wild, -1.0, 1.0)):
        env.reset(seed=0)
        runs.append([env.step(action)[:2] for action in actions])
    assert all(equal(a[0], b[0]) and equal(a[1], b[1]) for a, b in zip(*runs, strict=True))


def test_integers_and_lists_are_actions_too(make_env, equal):
    env = make_env(KICK)
    size, results = env.action_space.shape[0], []
    for action in (np.ones(size, np.float32), np.ones(size, np.int64), [1] * size, np.ones(2 * size)[::2]):
        env.reset(seed=0)
        results.append(env.step(action)[0])
    assert all(equal(results[0], other) for other in results[1:])


@pytest.mark.parametrize("component", ["left_elbow.z", "right_shoulder.x", "neck.y", "spine2.x", "left_hip.z"])
@pytest.mark.parametrize("sign", [1.0, -0.5])
def test_a_named_component_turns_its_joint_and_no_other(make_env, component, sign):
    """Expect speed times time about the joint's own axis, tracked; without gravity no foot presses on the ground."""
    env = make_env("PIAvatar/Reach-v0", gravity=0.0, pose_noise=0.0)
    joint, axis = component.split(".")
    index = JOINT_NAMES.index(joint)
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape))
    before = tracked_local(env)
    action = np.zeros(env.action_space.shape)
    action[env.action_names.index(component)] = sign
    env.step(action)
    expected = np.zeros((NUM_JOINTS, 3))
    expected[index, "xyz".index(axis)] = sign * env.config.control.joint_speed_limit * env.config.physics.control_dt
    turned = (before.inv() * tracked_local(env)).as_rotvec()
    assert np.degrees(np.abs(turned - expected).max()) < 0.01


def test_increments_are_composed_on_the_right(make_env):
    """Expect the second turn about the axis that the first has turned, not about the one of the rest pose."""
    env = make_env("PIAvatar/Reach-v0", gravity=0.0, pose_noise=0.0)
    env.reset(seed=0)
    step = env.config.control.joint_speed_limit * env.config.physics.control_dt
    for component in ["left_shoulder.x"] * 5 + ["left_shoulder.z"] * 5:
        action = np.zeros(env.action_space.shape)
        action[env.action_names.index(component)] = 1.0
        env.step(action)
    expected = Rotation.from_rotvec([5 * step, 0, 0]) * Rotation.from_rotvec([0, 0, 5 * step])
    wrong = Rotation.from_rotvec([0, 0, 5 * step]) * Rotation.from_rotvec([5 * step, 0, 0])
    got = tracked_local(env)[JOINT_NAMES.index("left_shoulder")]
    assert np.degrees((expected.inv() * got).magnitude()) < 0.2 < np.degrees((expected.inv() * wrong).magnitude())


@pytest.mark.parametrize("task", [KICK, "PIAvatar/TrackMotion-v0"])
def test_held_actions_end_at_the_joint_limits(make_env, task):
    """Hold corners of the action space: commanded rotation vectors stay in their box, widened by the clip's pose."""
    env = make_env(task, control="pose")
    lower, upper = (bound[1:] for bound in joint_limits())
    rng = np.random.default_rng(1)
    reached = np.zeros((NUM_JOINTS - 1, 3), bool)
    for episode in range(3):
        env.reset(seed=episode)
        corner = rng.choice([-1.0, 1.0], env.action_space.shape)
        corner[3 * (NUM_JOINTS - 1) :] = 0.0
        for step in range(40):
            env.step(corner)
            v, own = command(env)[1:], clip_pose(env)[1:]
            low, high = np.minimum(lower, own) - 1e-4, np.maximum(upper, own) + 1e-4
            wrong = np.argwhere((v < low) | (v > high))
            report = ", ".join(f"{JOINT_NAMES[1 + b]}.{'xyz'[a]} {v[b, a]:.3f} rad" for b, a in wrong)
            assert not report, f"episode {episode}, step {step}: {report}"
        reached |= (v < lower + 1e-3) | (v > upper - 1e-3)
    assert reached.mean() > 0.3, "the case must run into the limits"


def test_the_tracked_joints_respect_the_limits(make_env):
    env = make_env("PIAvatar/Reach-v0")
    lower, _ = joint_limits()
    index = JOINT_NAMES.index("left_elbow")
    action = np.zeros(env.action_space.shape)
    action[env.action_names.index("left_elbow.z")] = -1.0
    env.reset(seed=0)
    angles = []
    for _ in range(30):
        env.step(action)
        angles.append(np.degrees(tracked_local(env)[index].as_rotvec()[2]))
    assert angles[5] < angles[0] - 20.0
    assert np.degrees(lower[index, 2]) - 2.0 < angles[-1] < np.degrees(lower[index, 2]) + 5.0


@pytest.mark.parametrize(
    ("component", "moves", "turns"), [("root.x", (1, 0), 0), ("root.y", (0, 1), 0), ("root.yaw", (0, 0), 1)]
)
def test_root_actions_move_the_root(make_env, component, moves, turns):
    """Expect the root's speed, along the axes of the turned body."""
    env = make_env("PIAvatar/TrackMotion-v0", motion="idle", impulse=0.0, fail_distance=10.0, gravity=0.0)
    spec, dt = env.batch.action_spec, env.config.physics.control_dt
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape)
    action[env.action_names.index("root.yaw")] = 1.0
    for _ in range(8):
        env.step(action)
    env.step(np.zeros(env.action_space.shape))
    start, heading = tracked_root(env)
    assert heading > 0.4, "the case must have turned"
    action[:] = 0.0
    action[env.action_names.index(component)] = 1.0
    for _ in range(3):
        env.step(action)
    end, after = tracked_root(env)
    c, s = np.cos(heading), np.sin(heading)
    expected = 3 * dt * spec.root_speed * np.array([[c, -s], [s, c]]) @ moves
    assert end[:2] - start[:2] == pytest.approx(expected, abs=0.02)
    assert end[2] == pytest.approx(start[2], abs=0.02)
    assert after - heading == pytest.approx(3 * dt * spec.root_turn_speed * turns, abs=0.02)


def test_without_root_action_the_vector_is_shorter(make_env):
    assert make_env("PIAvatar/TrackMotion-v0", root_action=False).action_space.shape == (63,)
    assert make_env("PIAvatar/TrackMotion-v0").action_names[-3:] == ("root.x", "root.y", "root.yaw")


def test_acting_joints_can_be_chosen(make_env):
    env = make_env("PIAvatar/Reach-v0", joints=["right_elbow", "left_shoulder"])
    assert env.action_names == tuple(f"{joint}.{axis}" for joint in ("left_shoulder", "right_elbow") for axis in "xyz")
    env.reset(seed=0)
    before = command(env)
    env.step(np.ones(6))
    moved = np.flatnonzero(np.abs(command(env) - before).max(1) > 0.05)
    assert [JOINT_NAMES[b] for b in moved] == ["left_shoulder", "right_elbow"]


@pytest.mark.parametrize("names", [["pelvis"], ["left_tail"], ["neck", "neck"], []])
def test_bad_joints_are_refused(names):
    with pytest.raises(ValueError, match="joints="):
        select_joints(names)
