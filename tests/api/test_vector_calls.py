"""Vectors: accepted and refused arguments, ownership of returned arrays, independence of threads and array kinds."""

from __future__ import annotations

import gc
import tracemalloc

import gymnasium
import numpy as np
import pytest
import warp as wp
from gymnasium.vector import AutoresetMode

from piavatar_envs.api.vector_env import AvatarVectorEnv
from piavatar_envs.mpm.types import FAILURE_ACTION

#: An episode of six steps: several fit into a test.
SHORT = {"episode_seconds": 0.2}


def actions_of(vector, steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, *vector.action_space.shape)).astype(np.float32)


def bytes_of(state: dict[str, np.ndarray]) -> dict[str, bytes]:
    return {name: value.tobytes() for name, value in state.items()}


# seeds and masks


def test_seeds_count_up_and_lists_are_taken_as_they_are(make_vec, env_id, equal):
    vector = make_vec(env_id, 3)
    by_number = vector.reset(seed=7)[0]
    assert np.abs(by_number[0] - by_number[1]).max() > 1e-4
    assert equal(vector.reset(seed=[7, 8, 9])[0], by_number)
    assert equal(vector.reset(seed=[9, 7, 8])[0], by_number[[2, 0, 1]])
    # None: the next episode of the seed before
    following = vector.reset()[0]
    vector.reset(seed=[9, 7, 8])
    mixed = vector.reset(seed=[None, 8, None])[0]
    assert equal(mixed, np.stack([following[0], by_number[1], following[2]]))


def test_never_seeded_vectors_differ(device):
    starts = []
    for _ in range(2):
        vector = AvatarVectorEnv("Reach-v0", 2, device=device, fidelity="tiny")
        starts += list(vector.reset()[0])
        vector.close()
    assert all(np.abs(a - b).max() > 1e-4 for i, a in enumerate(starts) for b in starts[:i])


@pytest.mark.parametrize(
    "seed", [-1, 2**32 - 2, [1, 2], [1, 2, 3, 4], [1, -1, 2], [1, 2**32, 2], "one", [0.5, 1, 2], {3, 1, 2}]
)
@pytest.mark.parametrize("masked", [False, True])
def test_bad_seeds_are_refused_before_anything_changes(make_vec, seed, masked):
    vector = make_vec("PIAvatar/KickBall-v0", 3)
    vector.reset(seed=1)
    before = bytes_of(vector.get_state())
    options = {"reset_mask": np.array([True, False, False])} if masked else None
    with pytest.raises((ValueError, TypeError, gymnasium.error.Error)):
        vector.reset(seed=seed, options=options)
    assert bytes_of(vector.get_state()) == before


@pytest.mark.parametrize("seed", [None, 90, [91, None, 92]])
def test_a_reset_mask_touches_its_environments_only(make_vec, env_id, equal, seed):
    vector = make_vec(env_id, 3, **SHORT)
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
    assert after["env.seed"].tolist() == [1, 2, {None: 3, 90: 92}.get(seed if number == 1 else 90, 92)]
    assert after["env.episode"].tolist() == [0, 0, number] and after["env.step_count"].tolist() == [4, 4, 0]
    assert equal(started[~mask], observation[~mask]) and np.abs(started[2] - observation[2]).max() > 1e-4
    for action, row in zip(actions[4:], expected[4:], strict=True):
        assert equal(vector.step(action)[0][~mask], row[~mask])
    # also the next episodes of the others, whatever seeds were given to them in vain
    assert vector.get_state()["env.episode"].tolist() == [1, 1, number]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"reset_mask": np.zeros(3, bool)}, "no True"),
        ({"reset_mask": np.ones(3, int)}, "int64"),
        ({"reset_mask": np.ones(2, bool)}, r"\(2,\)"),
        ({"reset_mask": [True, True, True]}, "list"),
        ({"pose": 1}, "pose"),
        ({"pose": 1, "reset_mask": np.ones(3, bool)}, "pose"),
    ],
)
def test_bad_options_are_refused_before_anything_changes(make_vec, options, told):
    vector = make_vec("PIAvatar/KickBall-v0", 3)
    vector.reset(seed=1)
    before = bytes_of(vector.get_state())
    with pytest.raises((TypeError, ValueError), match=told):
        vector.reset(seed=2, options=options)
    assert bytes_of(vector.get_state()) == before


# actions


def with_nan(action: np.ndarray) -> np.ndarray:
    action = action.copy()
    action[1, 4] = np.nan
    return action


#: What may be wrong with an array -> what the refusal says.
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
    (lambda action: action.double(), "torch.float64.*float32"),
    (lambda action: action.to("meta"), "on meta"),
]


def assert_refused(vector, action, cases) -> None:
    """Before anything changes: what the vector does next is what it would have done."""
    vector.reset(seed=1)
    before = bytes_of(vector.get_state())
    for spoil, told in cases:
        with pytest.raises(ValueError, match=told):
            vector.step(spoil(action))
        assert bytes_of(vector.get_state()) == before
    assert not any(group.action.numpy().any() for group in vector.host.groups)


@pytest.mark.parametrize("array_api", ["numpy", "torch"])
def test_bad_actions_are_refused_before_anything_changes(make_vec, env_id, array_api):
    if array_api == "torch":
        pytest.importorskip("torch")
    vector = make_vec(env_id, 3, array_api=array_api)
    action = np.ones(vector.action_space.shape, np.float32)
    vector.reset(seed=0)
    vector.step(0.0 * action)
    assert_refused(vector, action, BAD_ARRAYS)
    if array_api == "torch":
        assert_refused(vector, _tensor(vector, action), BAD_TENSORS)


def test_a_tensor_that_is_not_finite_acts_as_zero_and_ends_its_environment(make_vec, env_id, equal):
    torch = pytest.importorskip("torch")
    vector = make_vec(env_id, 3, array_api="torch", autoreset_mode=AutoresetMode.SAME_STEP)
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


@pytest.mark.parametrize(("array_api", "num_threads"), [("numpy", 1), ("torch", 1), ("torch", 2)])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_returned_arrays_are_the_callers(make_vec, env_id, arrays_in, array_api, num_threads, mode):
    """No two share memory, none is a buffer of the environments, and writing into them changes nothing later."""
    if array_api == "torch":
        pytest.importorskip("torch")
    vector = make_vec(env_id, 3, array_api=array_api, num_threads=num_threads, autoreset_mode=mode, **SHORT)
    actions = [action if array_api == "numpy" else _tensor(vector, action) for action in actions_of(vector, 8)]

    def run(spoil: bool) -> tuple[list, list]:
        returned, copies = [], []
        for answer in [vector.reset(seed=3), *(lambda action=action: vector.step(action) for action in actions)]:
            arrays = list(arrays_in(answer() if callable(answer) else answer))
            returned.append(arrays)
            copies.append([np.array(_on_host(array)) for array in arrays])
            for array in arrays if spoil else ():
                array[...] = 1
        return returned, copies

    returned, copies = run(spoil=False)
    for arrays, kept in zip(returned, copies, strict=True):
        assert all(np.array_equal(_on_host(a), b) for a, b in zip(arrays, kept, strict=True)), "written to afterwards"
    spoilt = run(spoil=True)[1]
    assert np.array_equal(spoilt[-1][0], copies[-1][0])
    if vector.host.device != "cpu":
        return
    buffers = [
        array.numpy()
        for group in vector.host.groups
        for array in (*group.arrays().values(), group.observation, group.reward, group.terms, group.metrics, group.mask)
    ]
    flat = [_on_host(array) for arrays in returned[-2:] for array in arrays]
    for i, a in enumerate(flat):
        assert a.flags.writeable
        assert not any(np.shares_memory(a, b) for b in (*flat[:i], *buffers))


def _on_host(array) -> np.ndarray:
    return array if isinstance(array, np.ndarray) else array.cpu().numpy()


def _tensor(vector, action: np.ndarray):
    import torch

    return torch.from_numpy(action.copy()).to(vector.host.api.device)


@pytest.mark.parametrize(("mode", "obs_mode"), [("NextStep", "dict"), ("SameStep", "flat"), ("Disabled", "flat")])
def test_tensors_say_what_arrays_say(make_vec, env_id, equal, mode, obs_mode):
    """The same numbers and names; a tensor has failures as bits, and ends as a whole batch with a mask."""
    torch = pytest.importorskip("torch")
    settings = {**SHORT, "autoreset_mode": mode, "obs_mode": obs_mode}
    numpy, tensor = (make_vec(env_id, 3, array_api=name, **settings) for name in ("numpy", "torch"))
    pairs = [(numpy.reset(seed=2), tensor.reset(seed=2))]
    for action in actions_of(numpy, 6 if mode == "Disabled" else 8):
        pairs.append((numpy.step(action), tensor.step(_tensor(tensor, action))))

    def compare(a, b, where):
        if isinstance(a, (dict, tuple)):
            for name in a if isinstance(a, dict) else range(len(a)):
                compare(a[name], b[name], f"{where}.{name}")
        elif a.dtype == object and where.endswith("failure"):
            assert b.dtype == torch.int32 and not b.any() and not any(a)
        elif a.dtype == object:
            for i in [i for i, value in enumerate(a) if value is not None]:
                compare(a[i], b[i], f"{where}[{i}]")
        else:
            assert isinstance(b, torch.Tensor) and b.device == tensor.host.api.device
            assert b.dtype == {"f": torch.float32, "b": torch.bool}[a.dtype.kind], where
            assert equal(a.astype(b.cpu().numpy().dtype), b.cpu().numpy()), where

    for step, (a, b) in enumerate(pairs):
        for part, (x, y) in enumerate(zip(a, b, strict=True)):
            compare(x, y, f"{step}.{part}")


def test_a_step_with_tensors_never_makes_the_host_wait(make_vec, env_id, monkeypatch, device):
    torch = pytest.importorskip("torch")
    if not wp.get_device(device).is_cuda:
        pytest.skip("a CPU's arrays are on the host")
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
        vector = make_vec(env_id, 3, array_api="torch", autoreset_mode=mode, **SHORT)
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


@pytest.mark.parametrize(("array_api", "mode"), [("numpy", "NextStep"), ("torch", "SameStep")])
def test_objects_do_not_pile_up(make_vec, array_api, mode):
    if array_api == "torch":
        pytest.importorskip("torch")
    vector = make_vec("PIAvatar/KickBall-v0", 3, array_api=array_api, autoreset_mode=mode, **SHORT)
    action = np.zeros(vector.action_space.shape, np.float32)

    def held(steps: int) -> int:
        for _ in range(steps):
            vector.step(action)
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    vector.reset(seed=0)
    tracemalloc.start()
    try:
        before = held(10)
        grown = held(60) - before
    finally:
        tracemalloc.stop()
    # a leak of one observation a step would be 60 x 3 kB
    assert grown < 20_000, f"{grown} bytes in 60 steps"


# threads, and leaving and coming back


def test_threads_change_nothing(make_vec, env_id, same):
    actions, runs = None, []
    for threads in (1, 3):
        vector = make_vec(env_id, 3, num_threads=threads, autoreset_mode=AutoresetMode.SAME_STEP, **SHORT)
        if vector.host.device == "cpu":
            assert len(vector.host.groups) == threads
        actions = actions_of(vector, 8)
        runs.append([vector.reset(seed=8)])
        for action in actions[:3]:
            runs[-1].append(vector.step(action))
        runs[-1].append(vector.reset(options={"reset_mask": np.array([False, True, False])}))
        for action in actions[3:]:
            runs[-1].append(vector.step(action))
    for other in runs[1:]:
        for step, (a, b) in enumerate(zip(runs[0], other, strict=True)):
            same(a, b, f"{step}")


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_run_taken_up_elsewhere_is_the_same(make_vec, env_id, same, tmp_path, mode):
    """Also where an environment is about to be reset, and by another number of threads."""
    settings = {**SHORT, "autoreset_mode": mode}
    vector, other = make_vec(env_id, 3, **settings), make_vec(env_id, 3, num_threads=1, **settings)
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
    settings = {"device": device, "fidelity": "tiny", "autoreset_mode": "SameStep", **SHORT}
    vector, fresh = (AvatarVectorEnv("KickBall-v0", 3, num_threads=2, **settings) for _ in range(2))
    vector.reset(seed=1)
    fresh.set_state(vector.get_state())
    for action in actions_of(vector, 8):
        same(vector.step(action), fresh.step(action))
    vector.close()
    fresh.close()


def test_threads_never_capture_at_once(device):
    """Warp records one graph at a time: what was restored captures in turns, though no episode begins yet."""
    settings = {"device": device, "fidelity": "tiny", "num_threads": 2}
    vector, fresh = (AvatarVectorEnv("KickBall-v0", 3, **settings) for _ in range(2))
    vector.reset(seed=1)
    fresh.set_state(vector.get_state())
    assert not fresh.host.find_ended().any()
    fresh.host.reset_ended()
    assert all(group.reset_graph.is_captured for group in fresh.host.groups)
    vector.close()
    fresh.close()


@pytest.mark.parametrize("how", ["fewer", "missing", "unknown", "double", "particles", "nan", "none"])
def test_a_state_of_others_is_refused_and_changes_nothing(make_vec, how):
    vector = make_vec("PIAvatar/KickBall-v0", 3)
    vector.reset(seed=1)
    state = vector.get_state()
    before = bytes_of(state)
    bad = dict(make_vec("PIAvatar/KickBall-v0", 2).get_state()) if how == "fewer" else dict(state)
    if how == "missing":
        del bad["particles.F"]
    elif how == "unknown":
        bad["particles.G"] = bad["particles.F"]
    elif how == "double":
        bad["particles.u"] = bad["particles.u"].astype(np.float64)
    elif how == "particles":
        bad["particles.x"] = bad["particles.x"][:, 1:]
    elif how == "nan":
        bad["task.best"] = np.full_like(bad["task.best"], np.nan)
    elif how == "none":
        bad = None
    with pytest.raises(ValueError, match="state"):
        vector.set_state(bad)
    assert bytes_of(vector.get_state()) == before
