"""A batch is as many single environments; the clock truncates, a fall terminates, a mask spares the others."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.avatar import clear_vectors
from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task

VARIED = {"shape.randomize": True, "observe_parameters": True}
VARIED |= {f"{name}_factor": (0.6, 1.5) for name in ("mass", "stiffness", "ground_friction", "body_friction")}
SETTINGS = [{}, {"shape.randomize": True}, VARIED, VARIED | {"shape.pool": 3}]
IDS = ["plain", "random shapes", "all random", "all random, bodies of a pool"]


def batch_step(batch, actions) -> dict[str, np.ndarray]:
    """Outcome of a step of all environments."""
    batch.action.assign(np.asarray(actions, np.float32)[:, None])
    batch.step()
    names = ("observation", "reward", "terms", "metrics", "terminated", "truncated", "success")
    return {name: getattr(batch, name).numpy().copy() for name in names}


@pytest.mark.parametrize("settings", SETTINGS, ids=IDS)
def test_environment_i_is_the_single_environment_of_seed_plus_i(make_env, make_batch, env_id, equal, settings):
    batch, seed = make_batch(env_id, 3, **settings), 21
    steps_a_run = 12
    single = make_env(env_id, **settings)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (2, steps_a_run, 3, *single.action_space.shape))
    rows = []
    for episode in range(2):
        start = batch.reset(seeds=seed + np.arange(3) if episode == 0 else None).numpy().copy()
        rows.append((start, [batch_step(batch, action) for action in actions[episode]]))
    for i in range(3):
        for episode, (start, steps) in enumerate(rows):
            observation, _ = single.reset(seed=seed + i if episode == 0 else None)
            assert equal(observation, start[i, 0]), f"reset of environment {i}, episode {episode}"
            for step, outcome in enumerate(steps):
                observation, reward, terminated, truncated, info = single.step(actions[episode, step, i])
                where = f"environment {i}, episode {episode}, step {step}"
                assert equal(observation, outcome["observation"][i, 0]), where
                assert equal(np.float32(reward), outcome["reward"][i, 0]), where
                assert (terminated, truncated) == (outcome["terminated"][i, 0], outcome["truncated"][i]), where
                assert info["success"] == outcome["success"][i, 0]
                metrics = [info[name] for name in batch.task.metric_names]
                assert equal(np.float32(metrics), outcome["metrics"][i, 0]), where
    batch.action.zero_()


@pytest.mark.parametrize("settings", SETTINGS, ids=IDS)
@pytest.mark.parametrize("seeded", [True, False])
def test_a_masked_reset_touches_its_environments_only(make_batch, env_id, equal, settings, seeded):
    batch = make_batch(env_id, 3, **settings)
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.0, 1.0, (10, 3, batch.action_spec.size))
    batch.reset(seeds=[1, 2, 3])
    expected = [batch_step(batch, action) for action in actions]
    batch.reset(seeds=[1, 2, 3])
    for action in actions[:5]:
        batch_step(batch, action)
    before = batch.get_state()
    mask = np.array([False, True, False])
    batch.reset(env_mask=mask, seeds=[90, 91, 92] if seeded else None)
    after = batch.get_state()
    for name, value in before.items():
        assert value[~mask].tobytes() == after[name][~mask].tobytes(), name
    assert after["env.step_count"].tolist() == [5, 0, 5]
    assert after["env.seed"].tolist() == ([1, 91, 3] if seeded else [1, 2, 3])
    assert after["env.episode"].tolist() == ([0, 0, 0] if seeded else [0, 1, 0])
    assert not np.allclose(before["particles.x"][1], after["particles.x"][1])
    for action, row in zip(actions[5:], expected[5:], strict=True):
        got = batch_step(batch, action)
        assert all(equal(got[name][~mask], row[name][~mask]) for name in got)
    batch.action.zero_()


def test_no_environment_in_the_mask_changes_nothing(make_batch, env_id):
    batch = make_batch(env_id, 3)
    batch.reset(seeds=[1, 2, 3])
    before = batch.get_state()
    batch.reset(env_mask=np.zeros(3, bool))
    assert all(before[name].tobytes() == value.tobytes() for name, value in batch.get_state().items())


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"env_mask": np.ones(2, bool)}, r"env_mask has shape \(2,\).*\(3,\) bool"),
        ({"env_mask": np.ones(3, int)}, "env_mask.*int64.*bool"),
        ({"seeds": [1, 2]}, r"seeds=.*\(3,\)"),
        ({"seeds": [1, -2, 3]}, "seeds=.*-2.*in"),
        ({"seeds": [1, 2, 2**32]}, "seeds=.*4294967296"),
    ],
)
def test_bad_resets_are_refused_and_change_nothing(make_batch, env_id, arguments, told):
    batch = make_batch(env_id, 3)
    batch.reset(seeds=[1, 2, 3])
    before = batch.get_state()
    with pytest.raises(ValueError, match=told):
        batch.reset(**arguments)
    assert all(before[name].tobytes() == value.tobytes() for name, value in batch.get_state().items())
    batch.reset()
    assert batch.get_state()["env.episode"].tolist() == [1, 1, 1]


def test_an_empty_batch_is_refused(env_id, device):
    task = load_task(env_id)
    with pytest.raises(ValueError, match="num_envs=0"):
        BatchEnv(task(load_config(task.Config, None, {"fidelity": "tiny"})), 0, device)


@pytest.mark.parametrize(("seconds", "control_dt", "steps"), [(0.4, 1 / 30, 12), (0.3, 0.02, 15), (1e-3, 1 / 30, 1)])
def test_the_clock_truncates_at_the_episodes_length(make_env, env_id, seconds, control_dt, steps):
    env = make_env(env_id, episode_seconds=seconds, control_dt=control_dt)
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step(np.zeros(env.action_space.shape))[2:4] for _ in range(steps)]
        assert ends == [(False, False)] * (steps - 1) + [(False, True)]


def test_letting_go_of_the_root_terminates_and_does_not_truncate(make_env, env_id):
    """An impulse that no root wrench can hold; the end comes in the very last step, where the clock would truncate."""
    env = make_env(env_id, control="pose", release_distance=0.05, episode_seconds=0.4)
    env.reset(seed=0)
    assert not any(any(env.step(np.zeros(env.action_space.shape))[2:4]) for _ in range(11))
    velocity = env.batch.simulation.state.u
    velocity.assign(velocity.numpy() + np.float32([0.0, 4.0, 0.0]))
    for _ in range(2):  # and it is latched
        _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        assert terminated is True and truncated is False and info["root_released"] and info["failure"] is None
    assert not info["root_force"].any() and not info["root_torque"].any()
    env.reset(seed=0)
    assert env.step(np.zeros(env.action_space.shape))[2] is False


def test_a_body_that_nothing_holds_falls(make_env):
    """``root="free"``: under gravity alone the pelvis comes down by g t^2 / 2 until the feet take the weight."""
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


def test_the_programs_are_recorded_once(make_batch, env_id):
    """What a step does is fixed when the environment is built: nothing is decided later."""
    batch = make_batch(env_id, 3)
    batch.reset(seeds=[0, 1, 2])
    batch.step()
    with pytest.raises(RuntimeError, match="has run"):
        batch.step_graph.launch(clear_vectors, 3, [batch.simulation.avatar.state.wrench_force])


@pytest.mark.parametrize(("task", "moves"), [("PIAvatar/KickBall-v0", False), ("PIAvatar/Stand-v0", True)])
def test_what_runs_parallel_to_activation_and_sensors(make_env, task, moves):
    """Avatars begin during activation, and are tracked while sensors are read, unless they move particles."""
    launches = make_env(task).unwrapped.batch.step_graph._launches
    sections = {launch.kernel.key: launch.section for launch in reversed(launches)}  # of the first launch of each
    begins = "set_springs" if moves else "begin_control"
    assert sections[begins] == sections["activate_particle_blocks"] == sections["clear_sensors"] > 0
    assert (sections["track_bones"] == sections["read_impulses"] > 0) != moves
    assert ("put_in_place" in sections) == moves and sections.get("put_in_place", 0) in (0, sections["track_bones"])
