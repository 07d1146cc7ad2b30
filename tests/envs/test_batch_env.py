"""Batches: environment i equals a single environment, resets spare the others, and episodes end as specified."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.avatar import clear_vectors
from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task
from tests.conftest import SAMPLE

KICK = "PIAvatar/KickBall-v0"
VARIED = {"shape.randomize": True, "observe_parameters": True}
VARIED |= {f"{name}_factor": (0.6, 1.5) for name in ("mass", "stiffness", "ground_friction", "body_friction")}
#: Tasks with bodies and worlds that differ, as ``check_task`` has them for every one; fixed bodies; bodies of a pool.
CASES = [pytest.param(name, VARIED, id=name) for name in SAMPLE]
CASES += [pytest.param(name, {}, id=f"{name}-fixed") for name in SAMPLE]
CASES += [pytest.param(name, VARIED | {"shape.pool": 3}, id=f"{name}-pool") for name in SAMPLE]
CASES += [pytest.param("PIAvatar/Reach-v0", VARIED | {"control": "torque"}, id="torque")]


def batch_step(batch, actions) -> dict[str, np.ndarray]:
    """Advance all environments and return the outcome."""
    batch.action.assign(np.asarray(actions, np.float32)[:, None])
    batch.step()
    names = ("observation", "reward", "terms", "metrics", "terminated", "truncated", "success")
    return {name: getattr(batch, name).numpy().copy() for name in names}


@pytest.mark.parametrize(("name", "settings"), CASES)
def test_environment_i_is_the_single_environment_of_seed_plus_i(make_env, make_batch, equal, name, settings):
    """Compare two episodes; reset one environment within the second and see that the others go on."""
    batch, single, seed = make_batch(name, 3, **settings), make_env(name, **settings), 21
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (2, 6, 3, *single.action_space.shape))
    mask, rows = np.array([False, True, False]), []
    for episode in range(2):
        start = batch.reset(seeds=seed + np.arange(3) if episode == 0 else None).numpy().copy()
        rows.append((start, [batch_step(batch, action) for action in actions[episode, :3]]))
        if episode == 1:
            before = batch.get_state()
            batch.reset(env_mask=mask, seeds=[90, 91, 92])
            after = batch.get_state()
            for key, value in before.items():
                assert value[~mask].tobytes() == after[key][~mask].tobytes(), key
            assert after["env.step_count"].tolist() == [3, 0, 3]
            assert after["env.seed"].tolist() == [seed, 91, seed + 2] and after["env.episode"].tolist() == [1, 0, 1]
            assert not np.allclose(before["particles.x"][1], after["particles.x"][1])
        rows[-1][1].extend(batch_step(batch, action) for action in actions[episode, 3:])
    batch.action.zero_()
    for i in range(3):
        for episode, (start, steps) in enumerate(rows):
            observation, _ = single.reset(seed=seed + i if episode == 0 else None)
            assert equal(observation, start[i, 0]), f"reset of environment {i}, episode {episode}"
            for step, outcome in enumerate(steps):
                if (i, episode, step) == (1, 1, 3):
                    single.reset(seed=91)
                observation, reward, terminated, truncated, info = single.step(actions[episode, step, i])
                where = f"environment {i}, episode {episode}, step {step}"
                assert equal(observation, outcome["observation"][i, 0]), where
                assert equal(np.float32(reward), outcome["reward"][i, 0]), where
                assert (terminated, truncated) == (outcome["terminated"][i, 0], outcome["truncated"][i]), where
                assert info["success"] == outcome["success"][i, 0]
                metrics = [info[metric] for metric in batch.task.metric_names]
                assert equal(np.float32(metrics), outcome["metrics"][i, 0]), where


def test_a_masked_reset_without_seeds_begins_the_next_episode(make_batch):
    batch = make_batch(KICK, 3)
    batch.reset(seeds=[1, 2, 3])
    batch.reset(env_mask=np.array([False, True, False]))
    state = batch.get_state()
    assert state["env.seed"].tolist() == [1, 2, 3] and state["env.episode"].tolist() == [0, 1, 0]
    batch.reset(env_mask=np.zeros(3, bool))
    assert all(state[name].tobytes() == value.tobytes() for name, value in batch.get_state().items())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"env_mask": np.ones(2, bool)}, r"env_mask.*\(2,\).*\(3,\)"),
        ({"env_mask": np.ones(3, int)}, "env_mask.*int64.*bool"),
        ({"seeds": [1, 2]}, r"seeds=.*\(3,\)"),
        ({"seeds": [1, -2, 3]}, "seeds=.*-2"),
        ({"seeds": [1, 2, 2**32]}, "seeds=.*4294967296"),
    ],
)
def test_bad_resets_are_refused_and_change_nothing(make_batch, arguments, words):
    batch = make_batch(KICK, 3)
    batch.reset(seeds=[1, 2, 3])
    before = batch.get_state()
    with pytest.raises(ValueError, match=words):
        batch.reset(**arguments)
    assert all(before[name].tobytes() == value.tobytes() for name, value in batch.get_state().items())


def test_an_empty_batch_is_refused(device):
    task = load_task(KICK)
    with pytest.raises(ValueError, match="num_envs=0"):
        BatchEnv(task(load_config(task.Config, None, {"fidelity": "tiny"})), 0, device)


@pytest.mark.parametrize(("seconds", "control_dt", "steps"), [(0.4, 1 / 30, 12), (0.3, 0.02, 15), (1e-3, 1 / 30, 1)])
def test_the_clock_truncates_at_the_episodes_length(make_env, seconds, control_dt, steps):
    env = make_env(KICK, episode_seconds=seconds, control_dt=control_dt)
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step(np.zeros(env.action_space.shape))[2:4] for _ in range(steps)]
        assert ends == [(False, False)] * (steps - 1) + [(False, True)]


def test_the_release_of_the_root_terminates_and_does_not_truncate(make_env, sample_id):
    """Give an impulse that no root wrench can hold, in the very last step, where the clock would truncate."""
    env = make_env(sample_id, control="pose", release_distance=0.05, episode_seconds=0.4)
    env.reset(seed=0)
    assert not any(any(env.step(np.zeros(env.action_space.shape))[2:4]) for _ in range(11))
    velocity = env.batch.simulation.state.u
    velocity.assign(velocity.numpy() + np.float32([0.0, 4.0, 0.0]))
    for _ in range(2):  # and it is latched
        _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        assert terminated is True and truncated is False and info["root_released"] and info["failure"] == 0
    assert not info["root_force"].any() and not info["root_torque"].any()
    env.reset(seed=0)
    assert env.step(np.zeros(env.action_space.shape))[2] is False


def test_a_body_with_a_free_root_falls(make_env):
    """Compare with g t^2 / 2."""
    env = make_env("PIAvatar/Reach-v0", root="free", pose_noise=0.0)
    env.reset(seed=0)
    state = env.get_state()
    state["particles.x"][..., 2] += 0.3
    env.set_state(state)
    heights = [float(state["particles.x"][0, :, 2].mean())]
    for _ in range(6):
        info = env.step(np.zeros(env.action_space.shape))[4]
        heights.append(float(env.get_state()["particles.x"][0, :, 2].mean()))
        assert not info["root_force"].any()
    fallen = heights[0] - heights[-1]
    assert fallen == pytest.approx(0.5 * 9.81 * (6 / 30) ** 2, rel=0.05)


def test_launch_graphs_are_recorded_once(make_batch):
    batch = make_batch(KICK, 3)
    batch.reset(seeds=[0, 1, 2])
    batch.step()
    with pytest.raises(RuntimeError, match="has run"):
        batch.step_graph.launch(clear_vectors, 3, [batch.simulation.avatar.state.wrench_force])


@pytest.mark.parametrize(("task", "moves"), [(KICK, False), ("PIAvatar/Stand-v0", True)])
def test_launches_parallel_to_activation_and_sensors(make_env, task, moves):
    """Begin avatars during activation, and track them while sensors are read, unless they move particles."""
    launches = make_env(task).unwrapped.batch.step_graph._launches
    sections = {launch.kernel.key: launch.section for launch in reversed(launches)}  # of the first launch of each
    begins = "set_springs" if moves else "begin_control"
    assert sections[begins] == sections["activate_particle_blocks"] == sections["clear_sensors"] > 0
    assert (sections["track_bones"] == sections["read_impulses"] > 0) != moves
    assert ("put_in_place" in sections) == moves and sections.get("put_in_place", 0) in (0, sections["track_bones"])
