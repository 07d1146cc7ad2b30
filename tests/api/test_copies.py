"""Copies by copy.deepcopy and pickle go on as the view they were made of, over the ends of episodes."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from operator import methodcaller

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from piavatar_envs.api.gym_env import AvatarEnv
from piavatar_envs.api.vector_env import AvatarVectorEnv
from piavatar_envs.tasks import load_task

#: An episode of six steps.
SHORT = {"episode_seconds": 0.2}
#: Settings under which more, or other things are kept.
SETTINGS = [
    {"shape.randomize": True, "obs_mode": "dict"},
    {"shape.randomize": True, "shape.pool": 3, "randomize.mass_factor": (0.8, 1.25)},
    {"control": "pose", "control.tone": 0.2},
    {"control": "pd", "root_assist": 0.3},
]


class OwnTask(load_task("Reach-v0")):
    """A task that is not of this package."""


class OwnEnv(AvatarEnv):
    """A view with a constructor of its own."""

    def __init__(self, device: str):
        super().__init__(OwnTask, device=device, fidelity="tiny", **SHORT)
        self.steps_taken = 0

    def step(self, action):
        self.steps_taken += 1
        return super().step(action)


def copies_of(view) -> dict:
    return {"deepcopy": copy.deepcopy(view), "pickle": pickle.loads(pickle.dumps(view))}


def actions_of(view, steps: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, *view.action_space.shape)).astype(np.float32)


def play(env, seed: int = 1) -> list:
    """To the end of an episode, and into the next two."""
    answers = []
    for action in actions_of(env, 14, seed):
        answers.append(env.step(action))
        if answers[-1][2] or answers[-1][3]:
            answers.append(env.reset())
    return answers


def assert_copies_go_on(view, same, run=play) -> None:
    copies = copies_of(view)
    expected = run(view)
    for how, other in copies.items():
        same(run(other), expected, how)
        other.close()


def test_a_copy_goes_on_as_the_original(make_env, env_id, same):
    env = make_env(env_id, **SHORT)
    env.reset(seed=6)
    env.reset()
    for action in actions_of(env, 3, seed=0):
        env.step(action)
    assert_copies_go_on(env, same)


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_settings_are_copied(make_env, same, settings):
    env = make_env("PIAvatar/KickBall-v0", **SHORT, **settings)
    env.reset(seed=6)
    env.step(actions_of(env, 1, seed=0)[0])
    assert all(other.config == env.config for other in copies_of(env).values())
    assert_copies_go_on(env, same)


def test_the_copy_is_another_world(make_env, equal):
    env = make_env("PIAvatar/Reach-v0", **SHORT)
    observation, _ = env.reset(seed=6)
    other = copy.deepcopy(env)
    play(other)
    assert equal(env.set_state(env.get_state()), observation) and other.np_random is not env.np_random


def test_a_failed_run_is_copied(make_env, same):
    """Numbers that are not finite are no reason to refuse the copy of a failed run."""
    env = make_env("PIAvatar/KickBall-v0", **SHORT)
    env.reset(seed=0)
    state = env.get_state()
    state["particles.x"][0, 5] = np.nan
    env.set_state(state)
    assert env.step(actions_of(env, 1, seed=0)[0])[4]["failure"] == "nonfinite"
    assert not np.isfinite(env.get_state()["particles.x"]).all()
    assert_copies_go_on(env, same)


def test_a_copy_of_a_view_without_reset_needs_one(device, same):
    """Without a seed it is different every time; root assistance set before is copied."""
    env = AvatarEnv("PushRecovery-v0", device=device, fidelity="tiny", **SHORT)
    env.assist_root(0.7)
    vector = AvatarVectorEnv("KickBall-v0", 2, device=device, fidelity="tiny")
    for view in (env, vector):
        for other in copies_of(view).values():
            with pytest.raises(gymnasium.error.ResetNeeded):
                other.step(np.zeros(view.action_space.shape, np.float32))
    assert_copies_go_on(env, same, lambda view: [view.reset(seed=4), *play(view)])
    starts = [other.reset()[0] for other in (copy.deepcopy(vector), copy.deepcopy(vector))]
    assert np.abs(starts[0] - starts[1]).max() > 1e-4


def test_attributes_of_the_view_are_copied(device):
    env = gymnasium.make("PIAvatar/Reach-v0", device=device, fidelity="tiny")
    env.reset(seed=3)
    env.action_space.seed(5)
    env.unwrapped.note = {"of": "the user"}
    copies = copies_of(env)
    expected = env.action_space.sample(), env.unwrapped.np_random.random()
    for other in copies.values():
        assert np.array_equal(other.action_space.sample(), expected[0])
        assert other.unwrapped.np_random.random() == expected[1]
        assert other.unwrapped.note == env.unwrapped.note and other.unwrapped.note is not env.unwrapped.note
        assert other.spec == env.spec and other.get_wrapper_attr("_has_reset")


def test_users_tasks_and_views_are_copied(device, same):
    env = OwnEnv(device)
    env.reset(seed=0)
    env.step(actions_of(env, 1, seed=0)[0])
    for other in copies_of(env).values():
        assert type(other) is OwnEnv and type(other.batch.task) is OwnTask and other.steps_taken == 1
    assert_copies_go_on(env, same)


def test_another_process_goes_on(make_env, same):
    env = make_env("PIAvatar/Reach-v0", **SHORT)
    env.reset(seed=2)
    first, second = actions_of(env, 2, seed=0)
    env.step(first)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        answer = pool.apply_async(methodcaller("step", second), (env,)).get(timeout=300)
    same(answer, env.step(second))


def play_vector(vector) -> list:
    answers = []
    for action in actions_of(vector, 9, seed=1):
        ended = np.array(vector.host.find_ended().tolist())
        if vector.autoreset_mode == AutoresetMode.DISABLED and ended.any():
            answers.append(vector.reset(options={"reset_mask": ended}))
        answers.append(vector.step(vector.host.api.from_host(action)))
    return answers


@pytest.mark.parametrize("steps", [2, 6])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vectors_go_on(make_vec, same, mode, steps):
    """Also where resets are pending and clocks run out at different times."""
    vector = make_vec("PIAvatar/KickBall-v0", 3, autoreset_mode=mode, **SHORT)
    vector.reset(seed=[5, 9, 2])
    actions = actions_of(vector, steps, seed=0)
    vector.step(actions[0])
    vector.reset(options={"reset_mask": np.array([False, True, False])})
    for action in actions[1:]:
        vector.step(action)
    assert_copies_go_on(vector, same, play_vector)
    other = copy.deepcopy(vector)
    assert other.autoreset_mode is mode and len(other.host.groups) == len(vector.host.groups)
    other.close()


def test_vectors_of_tensors_go_on(make_vec, arrays_in, equal):
    pytest.importorskip("torch")
    vector = make_vec("PIAvatar/Reach-v0", 2, array_api="torch", **SHORT)
    vector.reset(seed=5)
    copies = copies_of(vector)
    expected = list(arrays_in(play_vector(vector)))
    for other in copies.values():
        for a, b in zip(arrays_in(play_vector(other)), expected, strict=True):
            assert type(a) is type(b) and equal(a.cpu(), b.cpu())


def skrl_view(device):
    from piavatar_envs.api.skrl import AvatarSkrlEnv

    env = AvatarSkrlEnv("KickBall-v0", 2, device, fidelity="tiny", num_threads=2, obs_mode="dict", **SHORT)
    env.reset(seed=5)
    return env


def skrl_view_of_several(device):
    pytest.importorskip("pettingzoo")
    from piavatar_envs.api.skrl import AvatarSkrlMultiEnv
    from piavatar_envs.multi import sumo_v0

    env = AvatarSkrlMultiEnv(sumo_v0.TASK, 2, device, fidelity="tiny", **SHORT)
    env.reset(seed=5)
    return env


def rsl_view(device):
    for needed in ("rsl_rl", "tensordict"):
        pytest.importorskip(needed)
    import torch

    from piavatar_envs.api.rsl_rl import AvatarRslEnv

    groups = {"actor": ["target_position"], "critic": ["root_height"]}
    env = AvatarRslEnv("Reach-v0", 2, device, groups=groups, seed=5, fidelity="tiny", num_threads=1, **SHORT)
    env.episode_length_buf = torch.tensor([0, 3], device=env.device)
    return env


def plain(answer):
    """An answer with dictionaries in the place of what a library makes of them."""
    if hasattr(answer, "items"):
        return {name: plain(value) for name, value in answer.items()}
    return [plain(part) for part in answer] if isinstance(answer, (tuple, list)) else answer


def play_learners(view, steps: int = 9, seed: int = 1) -> list:
    """Answers of a view for learners, over the ends of its episodes."""
    import torch

    episodes, rng = view.host, np.random.default_rng(seed)
    answers = []
    for _ in range(steps):
        actions = rng.uniform(-1.0, 1.0, (episodes.num_agents, view.num_envs, episodes.action_size))
        rows = [torch.tensor(row, dtype=torch.float32, device=view.device) for row in actions]
        named = dict(zip(getattr(view, "agents", ()), rows, strict=False))
        answers.append(plain(view.step(named or rows[0])))
    return answers


@pytest.mark.parametrize("make", [skrl_view, skrl_view_of_several, rsl_view])
def test_views_for_learners_go_on(device, make, arrays_in, equal):
    pytest.importorskip("torch")
    view = make(device)
    play_learners(view, 2, seed=0)
    view.note = {"of": "the user"}
    copies = copies_of(view)
    expected = list(arrays_in(play_learners(view)))
    assert len(expected) > 50
    for other in copies.values():
        assert other.config == view.config and len(other.host.groups) == len(view.host.groups)
        assert getattr(other, "groups", None) == getattr(view, "groups", None)
        assert other.note == view.note and other.note is not view.note
        found = list(arrays_in(play_learners(other)))
        assert all(equal(a.cpu(), b.cpu()) for a, b in zip(found, expected, strict=True))
        other.close()
    view.close()


def test_a_copy_for_rsl_rl_begins_no_episode(device, monkeypatch):
    """A user's view may be unable to reset before the copy has its attributes."""
    view = rsl_view(device)
    monkeypatch.setattr(type(view), "reset", None)
    other = copy.deepcopy(view)
    assert other.episode_length_buf.tolist() == view.episode_length_buf.tolist() == [0, 3]
    for made in (view, other):
        made.close()


def test_a_copy_of_a_closed_view_is_open(device):
    vector = AvatarVectorEnv("Reach-v0", 2, device=device, fidelity="tiny", num_threads=2)
    vector.reset(seed=0)
    vector.close()
    other = copy.deepcopy(vector)
    assert not other.closed
    for action in actions_of(vector, 3, seed=0):
        other.step(action)
    other.close()
    assert other.closed


def test_a_copy_opens_no_live_view_before_its_reset(device):
    pytest.importorskip("viser")
    env = AvatarEnv("Reach-v0", render_mode="human", device=device, fidelity="tiny")
    env.reset(seed=0)
    other = copy.deepcopy(env)
    other.step(actions_of(env, 1, seed=0)[0])
    assert other.render_mode == "human" and other.host.live._view is None
    other.reset()
    assert other.host.live._view is not None
    env.close()
    other.close()
