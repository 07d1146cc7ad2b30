"""The view for rsl_rl: attributes of its runners, the episodes of the other views, groups, clocks, inference mode."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra rsl")
for needed in ("rsl_rl", "tensordict"):
    pytest.importorskip(needed, reason="needs the extra rsl")

from rsl_rl.env import VecEnv  # noqa: E402

from piavatar_envs.api.rsl_rl import AvatarRslEnv  # noqa: E402
from piavatar_envs.config import ConfigError  # noqa: E402
from tests.api.runs import arrays_in  # noqa: E402

STEPS = 9  # of an episode
SETTINGS = {"fidelity": "tiny", "episode_seconds": 0.3}
REACH = "PIAvatar/Reach-v0"


@pytest.fixture(scope="module")
def env(device):
    """Two avatars that reach."""
    made = AvatarRslEnv(REACH, 2, device, seed=11, **SETTINGS)
    yield made
    made.close()


def drawn(env, rng) -> torch.Tensor:
    """Return random actions."""
    actions = rng.uniform(-1.0, 1.0, (env.num_envs, env.num_actions)).astype(np.float32)
    return torch.from_numpy(actions).to(env.device)


def test_it_has_the_attributes_that_runners_read(env):
    assert isinstance(env, VecEnv) and env.unwrapped is env
    assert (env.num_envs, env.max_episode_length) == (2, STEPS)
    assert env.step_dt == pytest.approx(1.0 / 30.0)
    assert env.cfg["physics"]["fidelity"] == "tiny" and env.cfg["episode_seconds"] == 0.3
    seen, (again, extras) = env.get_observations(), env.reset(seed=11)
    assert list(seen.keys()) == ["policy"] and seen.batch_size == (2,) and extras == {}
    assert torch.equal(seen["policy"], again["policy"]), "it begins with the episodes of its seed, without a reset"
    step = env.step(drawn(env, np.random.default_rng(0)))
    assert step[0]["policy"].shape == (2, env.observation_layout.size) and step[0]["policy"].dtype == torch.float32
    assert step[1].shape == step[2].shape == step[3]["time_outs"].shape == (2,)
    assert (step[1].dtype, step[2].dtype, step[3]["time_outs"].dtype) == (torch.float32, torch.int64, torch.bool)
    assert {"final_observations", "info", "log"} < set(step[3]) and len(list(arrays_in(step))) > 15
    assert all(tensor.device == env.device for tensor in list(arrays_in(step)))


@pytest.mark.parametrize("row", [0, 1])
def test_every_row_equals_the_environment_of_gymnasium(env, make_env, equal, row):
    """Compare bit for bit, into the next episode, with the last observation of the first."""
    single, rng = make_env(REACH, episode_seconds=0.3), np.random.default_rng(2)
    observed, _ = env.reset(seed=21)
    expected, _ = single.reset(seed=21 + row)
    assert equal(observed["policy"][row].cpu(), expected)
    ends = []
    for step in range(STEPS + 3):
        actions = drawn(env, rng)
        observed, reward, done, extras = env.step(actions)
        expected, value, terminated, truncated, info = single.step(actions[row].cpu().numpy())
        assert equal(extras["final_observations"]["policy"][row].cpu(), expected)
        assert equal(reward[row].cpu(), np.float32(value))
        assert done[row] == (terminated or truncated) and extras["time_outs"][row] == truncated
        assert extras["info"]["distance"][row].item() == pytest.approx(info["distance"], abs=2e-3)
        if terminated or truncated:
            ends.append(step)
            expected, _ = single.reset()
        assert equal(observed["policy"][row].cpu(), expected)
        assert equal(env.get_observations()["policy"][row].cpu(), expected)
    assert ends == [STEPS - 1]


def test_a_failure_is_done_and_no_time_out(env):
    env.reset(seed=0)
    actions = drawn(env, np.random.default_rng(0))
    actions[1, 3] = torch.inf
    observed, reward, done, extras = env.step(actions)
    assert done.tolist() == [0, 1] and extras["time_outs"].tolist() == [False, False]
    assert (extras["info"]["failure"] != 0).tolist() == [False, True]
    assert env.episode_length_buf.tolist() == [1, 0], "its next episode has begun"
    assert all(torch.isfinite(tensor).all() for tensor in list(arrays_in((observed, reward, extras))))


def test_logs_are_means_of_the_infos(env):
    env.reset(seed=0)
    rng = np.random.default_rng(5)
    for _ in range(3):
        _, reward, _, extras = env.step(drawn(env, rng))
    info, log = extras["info"], extras["log"]
    assert set(log) == {"Task/success"} | {f"Task/{name}" for name in env.host.task.metric_names} | {
        f"Reward/{name}" for name in env.host.task.reward_names
    }
    for name in env.host.task.metric_names:
        assert log[f"Task/{name}"].item() == pytest.approx(info[name].mean().item(), rel=1e-5)
    terms = sum(log[f"Reward/{name}"].item() for name in env.host.task.reward_names)
    assert terms == pytest.approx(reward.mean().item(), rel=1e-4)


def test_clocks_can_be_set_and_end_the_episodes(env):
    """Set them as `init_at_random_ep_len` does: environments then end one after the other."""
    env.reset(seed=0)
    env.episode_length_buf = torch.tensor([STEPS - 2, STEPS + 7], device=env.device)
    assert env.episode_length_buf.tolist() == [STEPS - 2, STEPS - 1], "a clock that has run out is not a start"
    still = torch.zeros(2, env.num_actions, device=env.device)
    done = [env.step(still)[2].tolist() for _ in range(2)]
    assert done == [[0, 1], [1, 0]] and env.episode_length_buf.tolist() == [0, 1]
    assert env.episode_length_buf.dtype == torch.int64
    with pytest.raises(ValueError, match=r"shape \(3,\), expected \(2,\)"):
        env.episode_length_buf = torch.zeros(3)
    for length in (torch.nan, 0.5):  # one that is not a number would never end
        with pytest.raises(ValueError, match="whole numbers"):
            env.episode_length_buf = torch.tensor([length, 1.0])


def test_clocks_that_are_set_change_the_time_limit_only(device):
    """Compare in Walk, which ends episodes that are behind a pace, and has its gait by the clock."""
    walk = {"fidelity": "tiny", "control": "torque", "observe_parameters": True, "seed": 3}
    env, other = (AvatarRslEnv("PIAvatar/Walk-v0", 4, device, **walk) for _ in range(2))
    lengths = torch.tensor([0, 120, 298, 299], device=env.device)
    env.episode_length_buf = lengths
    assert env.episode_length_buf.tolist() == lengths.tolist()
    still = torch.zeros(4, env.num_actions, device=env.device)
    clock = env.observation_layout["parameters"].slice.stop - 1
    for step in (1, 2):
        (seen, reward, done, extras), (alone, own, _, _) = env.step(still), other.step(still)
        begun = torch.tensor([False, False, step == 2, step == 1])
        assert done.bool().tolist() == extras["time_outs"].tolist() == begun.tolist()
        assert torch.equal(reward[:3], own[:3])
        same = alone["policy"].clone()
        same[:, clock] = seen["policy"][:, clock]
        assert torch.equal(seen["policy"][:2], same[:2])
        assert seen["policy"][1, clock].item() == pytest.approx(2.0 * (120 + step) / 300 - 1.0, abs=1e-6)
    assert env.episode_length_buf.tolist() == [2, 122, 0, 1]
    env.close()
    other.close()


def test_groups_hold_their_terms_in_order(env, device):
    groups = {"actor": ["target_velocity", "target_position"], "critic": ["root_height"]}
    grouped = AvatarRslEnv(REACH, 2, device, groups=groups, seed=7, **SETTINGS)
    named = AvatarRslEnv(REACH, 2, device, obs_mode="dict", seed=7, **SETTINGS)
    flat, layout = env.reset(seed=7)[0]["policy"], env.observation_layout
    assert list(named.get_observations().keys()) == list(layout)
    for name, term in layout.items():
        assert torch.equal(named.get_observations()[name], flat[:, term.slice])
    seen, position, velocity = grouped.get_observations(), layout["target_position"], layout["target_velocity"]
    assert list(seen.keys()) == ["actor", "critic"] and seen["critic"].shape == (2, 1)
    assert torch.equal(seen["actor"], torch.cat([flat[:, velocity.slice], flat[:, position.slice]], dim=1))
    for bad, words in (({"actor": ["target"]}, "no term 'target'; use some of root_height"), ({"actor": []}, "empty")):
        with pytest.raises(ConfigError, match=words):
            AvatarRslEnv(REACH, 2, device, groups=bad, **SETTINGS)
    grouped.close()
    named.close()


def test_inference_mode_leaves_no_trace(device):
    """Step in it as runners do: arrays that were made there must be usable outside."""
    fresh = AvatarRslEnv(REACH, 2, device, seed=3, **SETTINGS)
    actions = drawn(fresh, np.random.default_rng(0))
    with torch.inference_mode():
        fresh.step(actions)
        fresh.episode_length_buf = fresh.episode_length_buf
    observed = fresh.step(actions)[0]
    fresh.episode_length_buf = torch.zeros(2, device=fresh.device)
    assert not observed["policy"].is_inference()
    again, _ = fresh.reset(seed=3)
    for _ in range(2):
        again = fresh.step(actions)[0]
    assert torch.allclose(again["policy"], observed["policy"], atol=2e-3)
    fresh.close()


def test_nothing_that_was_returned_changes(env):
    env.reset(seed=0)
    rng = np.random.default_rng(1)
    returned = list(arrays_in((env.get_observations(), *env.step(drawn(env, rng)))))
    before = [tensor.clone() for tensor in returned]
    for _ in range(2):
        env.step(drawn(env, rng))
    assert all(torch.equal(kept, was) for kept, was in zip(returned, before, strict=True))


def test_actions_of_a_wrong_shape_or_type_are_refused(env):
    env.reset(seed=0)
    before = env.get_observations()["policy"]
    with pytest.raises(ValueError, match="expected"):
        env.step(torch.zeros(2, env.num_actions + 1, device=env.device))
    with pytest.raises(ValueError, match="float64"):
        env.step(torch.zeros(2, env.num_actions, dtype=torch.float64, device=env.device))
    assert torch.equal(env.get_observations()["policy"], before)
