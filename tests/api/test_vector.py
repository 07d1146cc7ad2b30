"""The vector view equals Gymnasium's vector of single environments, in all autoreset modes and for all arguments."""

from __future__ import annotations

import gc
import tracemalloc

import gymnasium
import numpy as np
import pytest
import warp as wp
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from piavatar_envs.api.vector_env import AvatarVectorEnv
from piavatar_envs.mpm.types import FAILURE_ACTION, FAILURE_CFL
from piavatar_envs.tasks import task_modules
from tests.api.runs import SHORT, actions_of, arrays_in, bytes_of, on_host
from tests.conftest import SAMPLE

KICK, REACH = "PIAvatar/KickBall-v0", "PIAvatar/Reach-v0"
SAME_STEP, NEXT_STEP, DISABLED = AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED
#: Tasks in every mode.
MODES = (SAME_STEP, "flat"), (NEXT_STEP, "flat"), (DISABLED, "flat"), (SAME_STEP, "dict")
CASES = [(name, *mode) for name in SAMPLE for mode in MODES]


def to_tensor(vector, action: np.ndarray):
    import torch

    return torch.from_numpy(action.copy()).to(vector.host.api.device)


def run(vector, actions) -> list:
    """Return the answers of a run, with the resets that DISABLED leaves to the caller."""
    answers = []
    for action in actions:
        answers.append(vector.step(action))
        ended = answers[-1][2] | answers[-1][3]
        if vector.metadata["autoreset_mode"] == DISABLED and ended.any():
            answers.append(vector.reset(options={"reset_mask": ended}))
    return answers


def vector_of(singles, **keywords) -> SyncVectorEnv:
    """Return Gymnasium's vector of environments that other tests share; collected ones close theirs in release 1.1."""
    vector = SyncVectorEnv([lambda env=env: env for env in singles], **keywords)
    vector.closed = True
    return vector


@pytest.mark.parametrize(("name", "mode", "obs_mode"), CASES)
def test_it_equals_gymnasiums_vector_of_single_environments(make_vec, make_env, same, name, mode, obs_mode):
    """Compare bit for bit, infos and all: over ends at different times, a failure, and the episodes after these."""
    settings = {**SHORT, "obs_mode": obs_mode}
    vector = make_vec(name, 3, autoreset_mode=mode, **settings)
    singles = [make_env(name, twin=twin, **settings) for twin in range(3)]
    oracle = vector_of(singles, autoreset_mode=mode)
    assert vector.metadata == {**oracle.metadata, "render_modes": ["rgb_array"]}
    for space in ("action_space", "observation_space", "single_action_space", "single_observation_space"):
        assert getattr(vector, space) == getattr(oracle, space)
    answers = [[env.reset(seed=31)] for env in (vector, oracle)]
    actions, mask = actions_of(vector, 11), {"reset_mask": np.array([False, True, False])}
    for env, log in zip((vector, oracle), answers, strict=True):
        log += run(env, actions[:2])
        log.append(env.reset(options=dict(mask)))
        log += run(env, actions[2:4])
    state = vector.get_state()
    state["particles.u"][2] = 1e6
    vector.set_state(state)
    singles[2].set_state({name: value[2:3] for name, value in state.items()})
    for env, log in zip((vector, oracle), answers, strict=True):
        log += run(env, actions[4:])
    for step, (a, b) in enumerate(zip(*answers, strict=True)):
        same(a, b, f"{step}")
    assert FAILURE_CFL in [row[-1].get("final_info", row[-1])["failure"][2] for row in answers[0]]


def test_random_bodies_and_worlds_equal_those_of_single_environments(make_vec, make_env, same):
    """Draw by seed and episode, whatever the batch and its threads."""
    settings = {"shape.randomize": True, "mass_factor": (0.8, 1.25), "stiffness_factor": (0.8, 1.25), **SHORT}
    vector = make_vec(KICK, 3, autoreset_mode=SAME_STEP, **settings)
    singles = [make_env(KICK, twin=twin, **settings) for twin in range(3)]
    oracle = vector_of(singles, autoreset_mode=SAME_STEP)
    same(vector.reset(seed=3), oracle.reset(seed=3))
    for step, action in enumerate(actions_of(vector, 8)):
        same(vector.step(action), oracle.step(action), f"{step}")
    assert len({body.tobytes() for body in vector.get_state()["shape.0"]}) == 3


def test_a_disabled_vector_does_not_step_on(make_vec):
    vector = make_vec(KICK, 3, autoreset_mode=DISABLED, **SHORT)
    actions = actions_of(vector, 8)
    vector.reset(seed=0)
    vector.step(actions[0])
    vector.reset(options={"reset_mask": np.array([True, False, True])})
    for action in actions[1:6]:
        vector.step(action)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[1\].*reset_mask"):
        vector.step(actions[6])
    vector.reset(options={"reset_mask": np.array([False, True, False])})
    assert vector.step(actions[6])[3].tolist() == [True, False, True]


def test_make_vec_builds_it_for_every_id(device):
    assert all(gymnasium.spec(name).vector_entry_point for name in task_modules())
    settings = {"device": device, "fidelity": "tiny", "autoreset_mode": "SameStep"}
    vector = gymnasium.make_vec(REACH, num_envs=2, **settings)
    again = gymnasium.make_vec(vector.spec)
    assert isinstance(vector, AvatarVectorEnv) and again.num_envs == 2 and again.autoreset_mode is SAME_STEP
    assert again.config == vector.config and "Reach-v0" in repr(again)
    for env in (vector, vector, again):
        env.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"num_envs": 0}, ["num_envs=0"]),
        ({"num_envs": 1.5}, ["num_envs=1.5", "whole number"]),
        ({"num_envs": True}, ["num_envs=True", "whole number"]),
        ({"cfl": 1.0}, ["cfl=1.0", "0.84"]),
        ({"array_api": "jax"}, ["array_api='jax'", "numpy", "torch"]),
        ({"autoreset_mode": "never"}, ["autoreset_mode='never'", "'NextStep'", "'SameStep'", "'Disabled'"]),
        ({"num_threads": 0}, ["num_threads=0"]),
        ({"render_mode": "human"}, ["render_mode='human'", "rgb_array"]),
        ({"device": "cuda:99"}, ["device='cuda:99'", "cpu"]),
        ({"fidelty": "tiny"}, ["fidelty", "physics.fidelity"]),
    ],
)
def test_bad_settings_are_refused(device, settings, words):
    with pytest.raises(ValueError) as caught:
        AvatarVectorEnv("Reach-v0", **{"device": device, "fidelity": "tiny", **settings})
    assert all(word in str(caught.value) for word in words), caught.value


# seeds and masks


def test_seeds_count_up_and_lists_are_taken_as_they_are(make_vec, equal):
    vector = make_vec(KICK, 3)
    by_number = vector.reset(seed=7)[0]
    assert np.abs(by_number[0] - by_number[1]).max() > 1e-4
    assert equal(vector.reset(seed=[7, 8, 9])[0], by_number)
    assert equal(vector.reset(seed=[9, 7, 8])[0], by_number[[2, 0, 1]])
    # None: the next episode of the seed before
    following = vector.reset()[0]
    vector.reset(seed=[9, 7, 8])
    mixed = vector.reset(seed=[None, 8, None])[0]
    assert equal(mixed, np.stack([following[0], by_number[1], following[2]]))


MASK = np.array([True, False, False])


@pytest.mark.parametrize(
    "arguments",
    [
        *({"seed": seed} for seed in (-1, 2**32 - 2, [1, 2], [1, -1, 2], [1, 2**32, 2], "one", 1.5, [0.5, 1, 2])),
        *({"seed": seed, "options": {"reset_mask": MASK}} for seed in (-1, [1, 2], "one")),
        {"options": {"reset_mask": np.zeros(3, bool)}},
        {"options": {"reset_mask": np.ones(3, int)}},
        {"options": {"reset_mask": np.ones(2, bool)}},
        {"options": {"reset_mask": [True, True, True]}},
        {"options": {"pose": 1, "reset_mask": MASK}},
        {"options": {"pose": 1}},
        {"options": ["reset_mask"]},
    ],
    ids=str,
)
def test_bad_resets_are_refused_before_anything_changes(make_vec, arguments):
    """Also the mask in the options stays: a second call with them resets the same environments, not all of them."""
    vector = make_vec(KICK, 3)
    vector.reset(seed=5)
    before, options = bytes_of(vector.get_state()), arguments.get("options")
    kept = options.copy() if options else None
    with pytest.raises((ValueError, TypeError, gymnasium.error.Error)):
        vector.reset(**arguments)
    assert bytes_of(vector.get_state()) == before
    assert options is None or list(options) == list(kept)


@pytest.mark.parametrize("seed", [None, 90, [91, None, 92]])
def test_a_reset_mask_touches_its_environments_only(make_vec, equal, seed):
    vector = make_vec(KICK, 3, **SHORT)
    actions = actions_of(vector, 8)
    vector.reset(seed=1)
    expected = [vector.step(action)[0] for action in actions]
    vector.reset(seed=1)
    for action in actions[:4]:
        observation = vector.step(action)[0]
    before = vector.get_state()
    mask = np.array([False, False, True])
    options = {"reset_mask": mask.copy()}
    started, infos = vector.reset(seed=seed, options=options)
    assert options == {} and infos["_success"].tolist() == mask.tolist()
    after = vector.get_state()
    for name, value in before.items():
        assert value[~mask].tobytes() == after[name][~mask].tobytes(), name
    number = 1 if seed is None else 0
    assert after["env.seed"].tolist() == [1, 2, 3 if seed is None else 92]
    assert after["env.episode"].tolist() == [0, 0, number] and after["env.step_count"].tolist() == [4, 4, 0]
    assert equal(started[~mask], observation[~mask]) and np.abs(started[2] - observation[2]).max() > 1e-4
    for action, row in zip(actions[4:], expected[4:], strict=True):
        assert equal(vector.step(action)[0][~mask], row[~mask])
    # also the next episodes of the others, whatever seeds were given for them
    assert vector.get_state()["env.episode"].tolist() == [1, 1, number]


def test_calls_before_the_first_reset_are_refused(device):
    vector = AvatarVectorEnv("Reach-v0", 2, render_mode="rgb_array", device=device, fidelity="tiny", obs_mode="dict")
    mask, state = {"reset_mask": np.array([True, False])}, {"particles.x": np.zeros((1, 2, 3), np.float32)}
    for call in (
        lambda: vector.step(vector.action_space.sample()),
        vector.render,
        lambda: vector.reset(options=mask),
        lambda: vector.call_some([0], "set_state", state),
    ):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    [(seen, info)] = vector.call_some([1], "reset", seed=3)
    assert seen["root_height"].shape == (1,) and info["failure"] == 0
    vector.step(np.zeros(vector.action_space.shape))
    vector.close()


# actions


def with_nan(action):
    action = action.copy()
    action[1, 4] = np.nan
    return action


#: Faults of an array, and words of the refusal.
BAD_ARRAYS = [
    (with_nan, r"action\[\(1, 4\)\] \(.*\) is nan"),
    (lambda action: action * np.inf, "inf"),
    (lambda action: action[:2], "shape"),
    (lambda action: action[:, 1:], "shape"),
    (lambda action: action[:, None], "shape"),
    (lambda action: action[0], "shape"),
]
BAD_TENSORS = [
    (lambda action: action[:2], r"shape \(2, "),
    (lambda action: action[:, None], "shape"),
    (lambda action: action.double(), "float64.*float32"),
    (lambda action: action.to("meta"), "meta"),
]


@pytest.mark.parametrize("array_api", ["numpy", "torch"])
def test_bad_actions_are_refused_before_anything_changes(make_vec, array_api):
    if array_api == "torch":
        pytest.importorskip("torch")
    vector = make_vec(KICK, 3, array_api=array_api)
    action = np.ones(vector.action_space.shape, np.float32)
    vector.reset(seed=0)
    vector.step(0.0 * action)
    vector.reset(seed=1)
    before = bytes_of(vector.get_state())
    cases = [(spoil(action), words) for spoil, words in BAD_ARRAYS]
    if array_api == "torch":
        cases += [(spoil(to_tensor(vector, action)), words) for spoil, words in BAD_TENSORS]
    for bad, words in cases:
        with pytest.raises(ValueError, match=words):
            vector.step(bad)
        assert bytes_of(vector.get_state()) == before
    assert not any(group.action.numpy().any() for group in vector.host.groups)


def test_a_nonfinite_tensor_acts_as_zero_and_ends_its_environment(make_vec, equal):
    torch = pytest.importorskip("torch")
    vector = make_vec(KICK, 3, array_api="torch", autoreset_mode=SAME_STEP, **SHORT)
    vector.reset(seed=1)
    following = vector.reset()[0]
    bad = torch.full(vector.action_space.shape, 0.5, device=vector.host.api.device)
    vector.reset(seed=1)
    expected, *_, clean = vector.step(bad)
    assert not clean["_final_info"].any()
    bad[1] = float("nan")
    vector.reset(seed=1)
    observation, _, terminated, truncated, infos = vector.step(bad)
    assert terminated.tolist() == [False, True, False] and not truncated.any()
    assert infos["final_info"]["failure"].tolist() == [0, FAILURE_ACTION, 0] and not infos["failure"].any()
    assert torch.isfinite(infos["final_obs"]).all()
    assert equal(observation[[0, 2]].cpu(), expected[[0, 2]].cpu())
    assert equal(observation[1].cpu(), following[1].cpu())


# arrays


@pytest.mark.parametrize(
    ("array_api", "num_threads", "mode"),
    [("numpy", 1, NEXT_STEP), ("numpy", 2, SAME_STEP), ("torch", 1, NEXT_STEP), ("torch", 2, SAME_STEP)],
)
def test_returned_arrays_belong_to_the_caller(make_vec, array_api, num_threads, mode):
    """No two share memory, none is a buffer of the environments, and writing into them changes nothing later."""
    if array_api == "torch":
        pytest.importorskip("torch")
    vector = make_vec(KICK, 3, array_api=array_api, num_threads=num_threads, autoreset_mode=mode, **SHORT)
    actions = [action if array_api == "numpy" else to_tensor(vector, action) for action in actions_of(vector, 8)]

    def run(spoil: bool) -> tuple[list, list]:
        returned, copies = [], []
        for answer in [vector.reset(seed=3), *(lambda action=action: vector.step(action) for action in actions)]:
            arrays = list(arrays_in(answer() if callable(answer) else answer))
            returned.append(arrays)
            copies.append([np.array(on_host(array)) for array in arrays])
            for array in arrays if spoil else ():
                array[...] = 1
        return returned, copies

    returned, copies = run(spoil=False)
    for arrays, kept in zip(returned, copies, strict=True):
        assert all(np.array_equal(on_host(a), b) for a, b in zip(arrays, kept, strict=True)), "written to afterwards"
    assert np.array_equal(run(spoil=True)[1][-1][0], copies[-1][0])
    if vector.host.device != "cpu":
        return
    buffers = [
        array.numpy()
        for group in vector.host.groups
        for array in (*group.arrays().values(), group.observation, group.reward, group.terms, group.metrics, group.mask)
    ]
    flat = [on_host(array) for arrays in returned[-2:] for array in arrays]
    for i, a in enumerate(flat):
        assert a.flags.writeable
        assert not any(np.shares_memory(a, b) for b in (*flat[:i], *buffers))


@pytest.mark.parametrize(("mode", "obs_mode"), [("NextStep", "dict"), ("SameStep", "flat"), ("Disabled", "flat")])
def test_tensors_equal_arrays(make_vec, equal, mode, obs_mode):
    """Compare numbers and names; a tensor has ends as a whole batch with a mask."""
    torch = pytest.importorskip("torch")
    settings = {**SHORT, "autoreset_mode": mode, "obs_mode": obs_mode}
    numpy, tensor = (make_vec(KICK, 3, array_api=name, **settings) for name in ("numpy", "torch"))
    pairs = [(numpy.reset(seed=2), tensor.reset(seed=2))]
    for action in actions_of(numpy, 6 if mode == "Disabled" else 8):
        pairs.append((numpy.step(action), tensor.step(to_tensor(tensor, action))))

    def compare(a, b, where):
        if isinstance(a, (dict, tuple)):
            for name in a if isinstance(a, dict) else range(len(a)):
                compare(a[name], b[name], f"{where}.{name}")
        elif a.dtype == object:
            for i in [i for i, value in enumerate(a) if value is not None]:
                compare(a[i], b[i], f"{where}[{i}]")
        else:
            assert isinstance(b, torch.Tensor) and b.device == tensor.host.api.device
            assert b.dtype == {"f": torch.float32, "b": torch.bool, "i": torch.int32}[a.dtype.kind], where
            assert equal(a.astype(b.cpu().numpy().dtype), b.cpu().numpy()), where

    for step, (a, b) in enumerate(pairs):
        for part, (x, y) in enumerate(zip(a, b, strict=True)):
            compare(x, y, f"{step}.{part}")


def test_a_step_with_tensors_does_not_block_the_host(make_vec, monkeypatch, device):
    torch = pytest.importorskip("torch")
    if not wp.get_device(device).is_cuda:
        pytest.skip("a CPU's arrays are on the host; run with --device cuda")
    for mode in (NEXT_STEP, SAME_STEP):
        vector = make_vec(KICK, 3, array_api="torch", autoreset_mode=mode, **SHORT)
        vector.reset(seed=0)
        action = torch.zeros(vector.action_space.shape, device=vector.host.api.device)
        vector.step(action)
        with monkeypatch.context() as patch:
            for name in ("synchronize", "synchronize_device", "synchronize_stream"):
                patch.setattr(wp, name, lambda *args, **kwargs: pytest.fail("the host waits for the device"))
            patch.setattr(wp.array, "numpy", lambda self: pytest.fail("an array is copied to the host"))
            torch.cuda.set_sync_debug_mode("error")
            try:
                for _ in range(8):
                    vector.step(action)
            finally:
                torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize(("array_api", "mode"), [("numpy", NEXT_STEP), ("torch", SAME_STEP)])
def test_objects_do_not_pile_up(make_vec, array_api, mode):
    if array_api == "torch":
        pytest.importorskip("torch")
    vector = make_vec(KICK, 3, array_api=array_api, autoreset_mode=mode, **SHORT)
    action = np.zeros(vector.action_space.shape, np.float32)

    def held(steps: int) -> int:
        for _ in range(steps):
            vector.step(action)
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    vector.reset(seed=0)
    tracemalloc.start()
    try:
        before = held(8)
        grown = held(24) - before
    finally:
        tracemalloc.stop()
    # a leak of one observation a step would be 24 x 3 kB
    assert grown < 20_000, f"{grown} bytes in 24 steps"


# threads, and states


@pytest.mark.parametrize("mode", [NEXT_STEP, SAME_STEP])
def test_a_run_is_continued_elsewhere_by_another_number_of_threads(make_vec, same, tmp_path, mode):
    """Save where an environment is about to be reset, too; threads change nothing."""
    settings = {**SHORT, "autoreset_mode": mode}
    vector, other = make_vec(KICK, 3, **settings), make_vec(KICK, 3, num_threads=1, **settings)
    assert vector.host.device != "cpu" or (len(vector.host.groups), len(other.host.groups)) == (2, 1)
    actions = actions_of(vector, 10)
    for at in (4, 6):
        vector.reset(seed=5)
        for action in actions[:at]:
            observation = vector.step(action)[0]
        np.savez(tmp_path / "state.npz", **vector.get_state())
        expected = [vector.step(action) for action in actions[at:]]
        other.reset(seed=77)
        with np.load(tmp_path / "state.npz", allow_pickle=False) as state:
            restored = other.set_state(dict(state))
        same(restored, observation)
        for step, action in enumerate(actions[at:]):
            same(other.step(action), expected[step], f"{at}.{step}")


def test_a_restored_vector_needs_no_reset(device, same):
    """Restore into a fresh vector: its threads then record their graphs, which Warp can do one at a time only."""
    settings = {"device": device, "fidelity": "tiny", "autoreset_mode": "SameStep", **SHORT}
    vector, fresh = (AvatarVectorEnv("KickBall-v0", 3, num_threads=2, **settings) for _ in range(2))
    vector.reset(seed=1)
    fresh.set_state(vector.get_state())
    fresh.host.reset_ended()
    assert all(group.reset_graph.is_captured for group in fresh.host.groups)
    for action in actions_of(vector, 8):
        same(vector.step(action), fresh.step(action))
    vector.close()
    fresh.close()


def without(name):
    return lambda state: {key: value for key, value in state.items() if key != name}


@pytest.mark.parametrize(
    "spoil",
    [
        without("particles.F"),
        lambda state: {**state, "particles.G": state["particles.F"]},
        lambda state: {**state, "particles.u": state["particles.u"].astype(np.float64)},
        lambda state: {**state, "particles.x": state["particles.x"][:, 1:]},
        lambda state: {**state, "task.best": np.full_like(state["task.best"], np.nan)},
        lambda state: {name: value[:2] for name, value in state.items()},
        lambda state: None,
    ],
)
def test_a_bad_state_is_refused_and_changes_nothing(make_vec, spoil):
    vector = make_vec(KICK, 3)
    vector.reset(seed=1)
    state = vector.get_state()
    before = bytes_of(state)
    with pytest.raises(ValueError, match="state"):
        vector.set_state(spoil(state))
    assert bytes_of(vector.get_state()) == before


# pictures and wrappers


def test_pictures_are_those_of_single_environments(device):
    settings = {"device": device, "fidelity": "tiny", "render_mode": "rgb_array", "width": 64, "height": 48}
    vector = AvatarVectorEnv("KickBall-v0", 3, num_threads=2, **settings)
    single = gymnasium.make(KICK, **settings).unwrapped
    vector.reset(seed=5)
    single.reset(seed=7)
    for step in range(2):
        frames, expected = vector.render(), single.render()
        assert len(frames) == 3 and all(f.shape == (48, 64, 3) and f.dtype == np.uint8 for f in frames)
        assert np.abs(frames[2].astype(int) - expected).mean() <= (0.0 if device == "cpu" else 2.0), step
        assert not np.array_equal(frames[0], frames[2])
        actions = actions_of(vector, 1, seed=step)[0]
        vector.step(actions)
        single.step(actions[2])
    vector.close()
    single.close()


def test_without_a_render_mode_there_are_no_pictures(make_vec):
    vector = make_vec(KICK)
    vector.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert vector.render() is None


@pytest.mark.skipif(gymnasium.__version__ < "1.3", reason="older wrappers of vectors do not fit each other")
@pytest.mark.parametrize("mode", [NEXT_STEP, SAME_STEP])
def test_gymnasiums_wrappers_accept_it(device, mode):
    from gymnasium.wrappers.vector import DictInfoToList, NormalizeObservation, RecordEpisodeStatistics

    vector = AvatarVectorEnv("Reach-v0", 2, device=device, fidelity="tiny", autoreset_mode=mode, **SHORT)
    # Gymnasium's own normalization does not support SAME_STEP
    normalized = NormalizeObservation(vector) if mode == NEXT_STEP else vector
    wrapped = DictInfoToList(RecordEpisodeStatistics(normalized))
    wrapped.reset(seed=0)
    lengths = []
    for action in actions_of(vector, 14):
        infos = wrapped.step(action)[4]
        assert len(infos) == 2 and all("root_force" in info for info in infos)
        lengths += [int(info["episode"]["l"]) for info in infos if "episode" in info]
    assert lengths == [6] * 4
    wrapped.close()


# calls of single environments


@pytest.fixture
def pair(make_vec, make_env):
    """A vector, and Gymnasium's of the same environments."""
    singles = [make_env(REACH, twin=twin, **SHORT) for twin in range(2)]
    oracle = vector_of(singles)
    vector = make_vec(REACH, 2, **SHORT)
    for env in (vector, oracle):
        env.reset(seed=31)
    return vector, oracle


def test_calls_equal_those_of_single_environments(pair, same):
    vector, oracle = pair
    for name in ("action_names", "action_space", "observation_space", "config", "render_mode", "observation_layout"):
        assert vector.get_attr(name) == vector.call(name) == oracle.get_attr(name)
    assert vector.get_attr("np_random_seed") == oracle.get_attr("np_random_seed") == (31, 32)
    action = vector.action_space.sample()
    for env in (vector, oracle):
        env.step(action)
    states = vector.call("get_state")
    same(states, oracle.call("get_state"))
    same(vector.call("set_state", states[1]), oracle.call("set_state", states[1]))
    same(vector.step(action), oracle.step(action))
    same(vector.call("reset", seed=5), oracle.call("reset", seed=5))
    same(vector.call("reset"), oracle.call("reset"))
    same(vector.step(action), oracle.step(action))


def test_calls_that_do_not_exist_are_refused(pair):
    vector, _ = pair
    for name in ("bogus", "batch", "np_random"):
        with pytest.raises(AttributeError, match=name):
            vector.get_attr(name)
    for name in ("step", "close", "vector_step_wait"):
        with pytest.raises(AttributeError, match=name):
            vector.call(name, None)
    with pytest.raises(ValueError, match="root wrench"):
        vector.call("assist_root", 0.5)


def test_one_environment_is_restored_and_the_others_go_on(pair, equal):
    vector, _ = pair
    first = vector.get_state()
    [seen] = vector.call_some([1], "set_state", vector.call("get_state")[0])
    both = vector.host.observation()[:, 0]
    assert equal(seen, both[1]) and equal(both[0], both[1])
    assert equal(vector.get_state()["particles.x"][0], first["particles.x"][0])
    with pytest.raises(ValueError, match="state"):
        vector.call_some([1], "set_state", without("particles.F")(vector.call("get_state")[0]))
    with pytest.raises(ValueError, match=r"expected \(1, "):
        vector.call("set_state", first)


def test_attributes_of_users_are_shared(device):
    vector = AvatarVectorEnv(REACH, 2, device=device, fidelity="tiny")
    vector.set_attr("note", 3)
    vector.set_attr("list", [[1, 2], [1, 2]])
    vector.set_attr("note", (4, 4))
    assert vector.get_attr("note") == (4, 4) and vector.list == [1, 2]
    refused = {"note": [1, 2], "list": [1, 2, 3], "tone": 0.5, "control.tone": 0.5}
    refused |= {"config": None, "render_mode": "rgb_array", "observation_space": None, "step": None}
    for name, value in refused.items():
        with pytest.raises(ValueError, match=name.rpartition(".")[2]):
            vector.set_attr(name, value)
    assert vector.get_attr("note") == (4, 4)
    vector.close()


def test_tensors_are_split_by_environment(make_vec, equal):
    torch = pytest.importorskip("torch")
    vector, arrays = make_vec(REACH, 2, array_api="torch", **SHORT), make_vec(REACH, 2, **SHORT)
    for (seen, info), (expected, other) in zip(vector.call("reset", seed=3), arrays.call("reset", seed=3), strict=True):
        assert isinstance(seen, torch.Tensor) and equal(seen.cpu(), expected) and set(info) == set(other)
        assert info["success"] is other["success"] is False
