"""Contract of every registered environment: the API checkers, determinism, observations, rewards."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest

from piavatar_envs import ENTRY_POINT
from piavatar_envs.api.pictures import SceneReader
from piavatar_envs.avatar.body.skeleton import NUM_ACTUATED
from piavatar_envs.tasks import NAMESPACE, task_modules
from piavatar_envs.tasks.games import game_modules
from tests.conftest import SAMPLE, reward_terms

#: The one complaint of Gymnasium's checker that is wanted: these observations have no honest limits.
UNBOUNDED = r".*A Box observation space (minimum|maximum) value is -?infinity.*"

#: Terms that may stay nearly the same, and the components that do. The pelvis hangs in the root wrench, so that it
#: keeps its height and hardly tilts, and three joints are fixed to it by bone; a command leads a blocked joint;
#: toes are stiff under torques.
ALMOST_CONSTANT = {
    "root_height": (0,),
    "root_orientation": (0, 2, 4, 5),
    "bone_positions": range(9),
    "command_lead": (0, 1, 2),
    "joint_velocities": range(27, 33),
}


def rollout(env, steps: int, seed: int | None = None, actions: int = 0, episodes: int = 1) -> list[tuple]:
    """Return the answers of the environment to every reset and step under random actions."""
    rng, log = np.random.default_rng(actions), []
    for episode in range(episodes):
        observation, info = env.reset(seed=seed if episode == 0 else None)
        log.append((observation, 0.0, False, False, info))
        log += [env.step(rng.uniform(-1.0, 1.0, env.action_space.shape)) for _ in range(steps)]
    return log


def piavatar_specs() -> list[tuple[str, gymnasium.envs.registration.EnvSpec]]:
    return [(env_id, spec) for env_id, spec in gymnasium.registry.items() if spec.namespace == NAMESPACE]


def test_gym_make_of_a_game_names_its_module():
    """A game has no single agent; its id in Gymnasium's style says where it is, instead of that there is none."""
    games = [(env_id, spec) for env_id, spec in piavatar_specs() if spec.entry_point != ENTRY_POINT]
    assert len(games) == len(game_modules()) and "PIAvatar/PassBall-v0" in dict(games)
    for make in (gymnasium.make, gymnasium.make_vec):
        for env_id, spec in games:
            with pytest.raises(ValueError, match=rf"piavatar_envs\.multi import {spec.kwargs['game']}; .*parallel_env"):
                make(env_id)


def test_every_task_file_is_registered():
    registered = {env_id for env_id, spec in piavatar_specs() if spec.entry_point == ENTRY_POINT}
    assert registered == set(task_modules()) >= {"PIAvatar/Reach-v0", "PIAvatar/TrackMotion-v0"}
    # a TimeLimit wrapper would escape get_state
    assert all(gymnasium.spec(env_id).max_episode_steps is None for env_id in registered)


GYMNASIUM, SB3 = "gymnasium.utils.env_checker", "stable_baselines3.common.env_checker"


@pytest.mark.parametrize(
    ("checker", "name", "obs_mode"),
    [(GYMNASIUM, name, "flat") for name in task_modules()]
    + [(GYMNASIUM, name, "dict") for name in SAMPLE]
    + [(SB3, name, obs_mode) for name in SAMPLE for obs_mode in ("flat", "dict")],
)
def test_api_checkers_pass(make_env, checker, name, obs_mode):
    module = pytest.importorskip(checker)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", UNBOUNDED)
        # pictures have tests of their own
        module.check_env(make_env(name, obs_mode=obs_mode), skip_render_check=True)


def test_same_seed_and_actions_give_the_same_run(make_env, sample_id, equal):
    """Repeat two episodes in the same environment and in another one; ``check_task`` does so for every task."""
    first = rollout(make_env(sample_id), 10, seed=11, episodes=2)
    for env in (make_env(sample_id), make_env(sample_id, twin=1)):
        rollout(env, 3, seed=3)
        for a, b in zip(first, rollout(env, 10, seed=11, episodes=2), strict=True):
            assert equal(a[0], b[0]) and equal(a[1], b[1]) and a[2:4] == b[2:4]
            assert a[4].keys() == b[4].keys() and all(equal(value, b[4][name]) for name, value in a[4].items())


def test_seeds_and_episodes_differ(make_env, env_id):
    env = make_env(env_id)
    starts = {f"seed {seed}": env.reset(seed=seed)[0] for seed in (0, 1, 2)}
    starts |= {f"episode {n} of seed 2": env.reset()[0] for n in (1, 2)}
    ends = {f"seed {seed}": rollout(env, 5, seed)[-1][0] for seed in (0, 1, 2)}
    for observations in (starts, ends):
        names = list(observations)
        for i, a in enumerate(names):
            for b in names[:i]:
                assert np.abs(observations[a] - observations[b]).max() > 1e-4, f"{a} is {b}"


def test_environments_without_a_seed_differ(device):
    settings = {"fidelity": "tiny", "device": device}
    starts = [gymnasium.make("PIAvatar/Reach-v0", **settings).reset()[0] for _ in range(3)]
    assert max(np.abs(starts[0] - start).max() for start in starts) > 1e-4


def test_observations_are_finite_and_none_is_constant(make_env, env_id):
    env = make_env(env_id)
    seen = np.array([row[0] for row in rollout(env, 25, seed=0, episodes=4)])
    assert seen.dtype == np.float32 and np.isfinite(seen).all()
    assert all(env.observation_space.contains(row) for row in seen)
    partly = len(env.batch.action_spec.joints) < NUM_ACTUATED
    for name, term in env.observation_layout.items():
        spread = np.ptp(seen[:, term.slice], axis=0)
        assert (spread > 0.0).all(), f"{name}{np.flatnonzero(spread == 0.0)} never changes"
        # where only some joints act, the rest of a body that is held up moves as its flesh does; props lie on the floor
        least = 1e-6 if partly else 5e-4
        small = set(np.flatnonzero(spread < least)) - set(ALMOST_CONSTANT.get(name, ()))
        assert not small, f"{name}{sorted(small)} hardly changes: {spread[sorted(small)]}"


def test_environments_with_the_same_body_share_a_skin(make_env):
    batch = make_env(SAMPLE[0]).batch
    skins = [SceneReader(batch).stage.skins[0] for _ in range(2)]
    assert skins[0] is skins[1]


def test_returned_arrays_belong_to_the_caller(make_env, sample_id):
    """Write into returned arrays, which changes neither the environment nor later answers."""
    env = make_env(sample_id)
    internal = [array.numpy() for array in (*env.batch.arrays().values(), env.batch.observation)]
    rows = rollout(env, 3, seed=1, episodes=2)
    returned = [array for row in rows for array in (row[0], *row[4].values()) if np.ndim(array)]
    for i, a in enumerate(returned):
        assert not any(np.shares_memory(a, b) for b in (*returned[:i], *internal))
        assert a.flags.writeable
    untouched = [row[0] for row in rollout(env, 5, seed=1)]
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    for expected in untouched[1:]:
        action = rng.uniform(-1.0, 1.0, env.action_space.shape)
        kept = action.copy()
        observation, _, _, _, info = env.step(action)
        assert np.array_equal(observation, expected) and np.array_equal(action, kept)
        observation[:] = np.nan
        for value in info.values():
            if isinstance(value, np.ndarray):
                value[:] = np.nan


def test_infos_are_flat_numbers_under_the_same_keys(make_env, env_id):
    """Buffers of other libraries take neither None, text, mappings nor later keys; TorchRL takes numbers by dtype."""
    before, *_, after = (row[4] for row in rollout(make_env(env_id), 2, seed=0))
    assert list(before) == list(after) and before["failure"] == 0
    for info in (before, after):
        for name, value in info.items():
            kind = value.dtype if isinstance(value, np.ndarray) else type(value)
            assert kind in (bool, int, np.float64, np.float32), f"{name}: {kind}"
    assert not any(before[name] for name in before if name.startswith(("reward_", "cost")))


def test_reward_is_the_sum_of_its_terms(make_env, env_id):
    env = make_env(env_id)
    task = env.batch.task
    for _, reward, terminated, truncated, info in rollout(env, 15, seed=2)[1:]:
        assert type(reward) is float and type(terminated) is bool and type(truncated) is bool
        terms = reward_terms(info)
        assert tuple(terms) == task.reward_names and np.isfinite(list(terms.values())).all()
        assert reward == pytest.approx(sum(terms.values()), abs=1e-6)
        assert set(task.metric_names) <= set(info) and all(np.isfinite(info[name]) for name in task.metric_names)
        # the shaping is at most one; only costs are negative
        costs = env.config.control_cost + getattr(env.config, "stance_cost", 0.0)
        assert -costs <= reward <= 1.0
    for scale in (0.0, 0.5, 7.0):
        env.reset(seed=0)
        info = env.step(np.full(env.action_space.shape, scale, np.float32))[4]
        expected = -env.config.control_cost * min(scale, 1.0) ** 2
        assert info["reward_control"] == pytest.approx(expected, rel=1e-5, abs=1e-9)
