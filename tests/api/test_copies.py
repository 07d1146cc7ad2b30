"""Copies by copy.deepcopy and pickle continue as the original view does, over the ends of episodes."""

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
from piavatar_envs.mpm.types import FAILURE_NONFINITE
from piavatar_envs.tasks import load_task
from tests.api.runs import SHORT, actions_of, arrays_in, on_host
from tests.conftest import SAMPLE

KICK, REACH = "PIAvatar/KickBall-v0", "PIAvatar/Reach-v0"
#: Tasks as they are, and one under settings by which more or other things are kept.
CASES = [(name, {}) for name in SAMPLE]
CASES += [
    (KICK, {"shape.randomize": True, "obs_mode": "dict"}),
    (KICK, {"shape.randomize": True, "shape.pool": 3, "randomize.mass_factor": (0.8, 1.25)}),
    (KICK, {"control": "pd", "root_assist": 0.3}),
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


def play(env) -> list:
    """Play to the end of an episode, and into the next one."""
    answers = []
    for action in actions_of(env, 9, seed=1):
        answers.append(env.step(action))
        if answers[-1][2] or answers[-1][3]:
            answers.append(env.reset())
    return answers


def assert_copies_continue(view, same, run=play, copies=None) -> None:
    copies = copies or copies_of(view)
    expected = run(view)
    for how, other in copies.items():
        same(run(other), expected, how)
        other.close()


@pytest.mark.parametrize(("name", "settings"), CASES, ids=str)
def test_a_copy_continues_as_the_original(make_env, same, name, settings):
    """Copy by pickle what needs no extra settings, and in both ways what does."""
    env = make_env(name, **SHORT, **settings)
    env.reset(seed=6)
    env.reset()
    env.step(actions_of(env, 1)[0])
    copies = copies_of(env) if settings else {"pickle": pickle.loads(pickle.dumps(env))}
    assert all(other.config == env.config for other in copies.values())
    assert_copies_continue(env, same, copies=copies)


def test_a_copy_shares_nothing_with_the_original(make_env, equal):
    env = make_env(REACH, **SHORT)
    observation, _ = env.reset(seed=6)
    other = copy.deepcopy(env)
    play(other)
    assert equal(env.set_state(env.get_state()), observation) and other.np_random is not env.np_random


def test_a_failed_run_is_copied(make_env, same):
    env = make_env(KICK, **SHORT)
    env.reset(seed=0)
    state = env.get_state()
    state["particles.x"][0, 5] = np.nan
    env.set_state(state)
    assert env.step(actions_of(env, 1)[0])[4]["failure"] == FAILURE_NONFINITE
    assert not np.isfinite(env.get_state()["particles.x"]).all()
    assert_copies_continue(env, same)


def test_a_copy_of_a_view_without_reset_needs_one(device, same):
    """Root assistance that was set before is copied; episodes without a seed differ."""
    env = AvatarEnv("PushRecovery-v0", device=device, fidelity="tiny", **SHORT)
    env.assist_root(0.7)
    vector = AvatarVectorEnv("KickBall-v0", 2, device=device, fidelity="tiny")
    for view in (env, vector):
        with pytest.raises(gymnasium.error.ResetNeeded):
            copy.deepcopy(view).step(np.zeros(view.action_space.shape, np.float32))
    assert_copies_continue(env, same, lambda view: [view.reset(seed=4), *play(view)])
    starts = [other.reset()[0] for other in (copy.deepcopy(vector), copy.deepcopy(vector))]
    assert np.abs(starts[0] - starts[1]).max() > 1e-4


def test_attributes_of_the_view_are_copied(device):
    env = gymnasium.make(REACH, device=device, fidelity="tiny")
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


def test_tasks_and_views_of_users_are_copied(device, same):
    env = OwnEnv(device)
    env.reset(seed=0)
    env.step(actions_of(env, 1)[0])
    copies = copies_of(env)
    for other in copies.values():
        assert type(other) is OwnEnv and type(other.batch.task) is OwnTask and other.steps_taken == 1
    assert_copies_continue(env, same, copies=copies)


def test_another_process_continues(make_env, same):
    env = make_env(REACH, **SHORT)
    env.reset(seed=2)
    first, second = actions_of(env, 2)
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


@pytest.mark.parametrize(
    ("mode", "steps"),
    [(AutoresetMode.NEXT_STEP, 6), (AutoresetMode.SAME_STEP, 2), (AutoresetMode.DISABLED, 6)],
)
def test_vectors_continue(make_vec, same, mode, steps):
    """Copy also where resets are pending and episodes end at different times."""
    vector = make_vec(KICK, 3, autoreset_mode=mode, **SHORT)
    vector.reset(seed=[5, 9, 2])
    actions = actions_of(vector, steps)
    vector.step(actions[0])
    vector.reset(options={"reset_mask": np.array([False, True, False])})
    for action in actions[1:]:
        vector.step(action)
    copies = copies_of(vector)
    for other in copies.values():
        assert other.autoreset_mode is mode and len(other.host.groups) == len(vector.host.groups)
    assert_copies_continue(vector, same, play_vector, copies)


def test_vectors_of_tensors_continue(make_vec, equal):
    pytest.importorskip("torch")
    vector = make_vec(REACH, 2, array_api="torch", **SHORT)
    vector.reset(seed=5)
    other = copy.deepcopy(vector)
    for a, b in zip(arrays_in(play_vector(vector)), arrays_in(play_vector(other)), strict=True):
        assert type(a) is type(b) and equal(on_host(a), on_host(b))


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


def play_learners(view, steps: int = 9, seed: int = 1) -> list:
    """Return the answers of a view for learners, over the ends of its episodes."""
    import torch

    episodes, rng = view.host, np.random.default_rng(seed)
    answers = []
    for _ in range(steps):
        actions = rng.uniform(-1.0, 1.0, (episodes.num_agents, view.num_envs, episodes.action_size))
        rows = [torch.tensor(row, dtype=torch.float32, device=view.device) for row in actions]
        named = dict(zip(getattr(view, "agents", ()), rows, strict=False))
        answers.append(view.step(named or rows[0]))
    return answers


@pytest.mark.parametrize("make", [skrl_view, skrl_view_of_several, rsl_view])
def test_views_for_learners_continue(device, make, equal, monkeypatch):
    """A copy resets nothing: a user's view may be unable to before the copy has its attributes."""
    pytest.importorskip("torch")
    view = make(device)
    play_learners(view, 2, seed=0)
    view.note = {"of": "the user"}
    with monkeypatch.context() as patch:
        patch.setattr(type(view), "reset", None)
        copies = copies_of(view)
    expected = list(arrays_in(play_learners(view)))
    assert len(expected) > 50
    for other in copies.values():
        assert other.config == view.config and len(other.host.groups) == len(view.host.groups)
        assert getattr(other, "groups", None) == getattr(view, "groups", None)
        assert other.note == view.note and other.note is not view.note
        found = list(arrays_in(play_learners(other)))
        assert all(equal(on_host(a), on_host(b)) for a, b in zip(found, expected, strict=True))
        other.close()
    view.close()


def test_a_copy_of_a_closed_view_is_open(device):
    vector = AvatarVectorEnv("Reach-v0", 2, device=device, fidelity="tiny", num_threads=2)
    vector.reset(seed=0)
    vector.close()
    other = copy.deepcopy(vector)
    assert not other.closed
    for action in actions_of(vector, 3):
        other.step(action)
    other.close()
    assert other.closed


def test_a_copy_opens_no_live_view_before_its_reset(device):
    pytest.importorskip("viser")
    env = AvatarEnv("Reach-v0", render_mode="human", device=device, fidelity="tiny")
    env.reset(seed=0)
    other = copy.deepcopy(env)
    other.step(actions_of(env, 1)[0])
    assert other.render_mode == "human" and other.host.live._view is None
    other.reset()
    assert other.host.live._view is not None
    env.close()
    other.close()
