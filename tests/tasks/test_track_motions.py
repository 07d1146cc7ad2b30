"""TrackMotion on several motions: each episode follows one of them, and a split by name holds some out."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import Motion, collection, load_motion
from piavatar_envs.avatar.motion.collection import (
    Entry,
    Sampling,
    chosen,
    find_motions,
    load_all,
    load_frames,
    place_in_split,
    sample_frames,
)
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.core import result_cache
from piavatar_envs.tasks import load_task
from tests.avatar.skeletons import Skeleton, write_bvh
from tests.tasks.measured import still

TRACK = "PIAvatar/TrackMotion-v0"
WALK_0 = 0.636576779487609  # on every machine
DT = 1.0 / 30.0
#: Motions of four that the seeds 7, 8, ... draw with equal probability.
UNIFORM = [2, 3, 2, 2, 2, 1, 1, 1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with clips of half a second and of a second, and files that are not motions."""
    folder = tmp_path_factory.mktemp("motions")
    rest = load_asset().joints.astype(np.float64)
    for name, clip, frames in (("short", "kick", 16), ("below/long", "arm_wave", 31)):
        motion = load_motion(clip).resample(30.0)
        part = Motion(name, 30.0, motion.local_rotations[20 : 20 + frames], motion.root_position[20 : 20 + frames])
        (folder / name).parent.mkdir(exist_ok=True)
        write_bvh(folder / f"{name}.bvh", part, rest, Skeleton())
    np.savez(folder / "shape.npz", betas=np.zeros(10))
    (folder / "notes.md").write_text("nothing")
    return folder


def test_every_episode_follows_one_of_the_motions(make_batch, folder):
    with pytest.warns(UserWarning, match=r"1 of 4 files are left out: .*shape\.npz"):
        batch = make_batch(TRACK, 24, motion=("squat", str(folder)), impulse=0.0)
    names = batch.task.frames.names
    assert names == ("squat", "below/long.bvh", "short.bvh")
    places = ["squat", str(folder / "below/long.bvh"), str(folder / "short.bvh")]
    motions = [load_motion(place) for place in places]
    batch.reset(seeds=np.arange(24))
    playing, start = batch.task.playing.numpy(), batch.task.start.numpy()
    assert np.bincount(playing, minlength=3).min() > 2 and not start[playing > 0].any() and start[playing == 0].any()
    rest = load_asset().joints.astype(np.float64)
    for step in range(40):  # beyond the ends of the files, whose last poses are held
        batch.action.zero_()
        batch.step()
        positions, mpjpe = batch.simulation.avatar.tracked.position.numpy(), batch.metrics.numpy()[:, 0, 0]
        assert mpjpe.max() < 0.03
        for e in (0, 5, 11) if step % 13 == 0 else ():
            motion, begin = motions[playing[e]], start[e] * DT
            pose, root = motion.sample(begin + (step + 1) * DT)
            frame = Motion("now", 30.0, np.stack([pose] * 2), np.stack([root] * 2))
            joints = frame.joint_frames(rest)[1][0] - motion.sample(begin)[1] * [1.0, 1.0, 0.0]
            assert np.linalg.norm(positions[e] - joints, axis=1).mean() == pytest.approx(mpjpe[e], abs=2e-4)
    again = make_batch(TRACK, 24, motion=("squat", str(folder)), impulse=0.0)
    again.reset(seeds=np.arange(24))
    assert np.array_equal(again.task.playing.numpy(), playing)


def test_a_part_of_a_folder_is_held_out(make_env, folder):
    places = {name: place_in_split(name) for name in ("below/long.bvh", "short.bvh")}
    share = sum(places.values()) / 2  # one to each side
    kept = {}
    for split in ("train", "held_out"):
        env = make_env(TRACK, motion=f"{folder}/", split=split, held_out_share=share, impulse=0.0)
        kept[split] = list(env.batch.task.frames.names)
    assert kept == {
        "train": [max(places, key=places.get)],
        "held_out": [min(places, key=places.get)],
    }
    with pytest.raises(ConfigError, match="split='held_out' has none of the 1 motions"):
        make_env(TRACK, motion="squat", split="held_out", held_out_share=0.0)


def test_a_split_depends_on_names_only():
    entries = [Entry(f"walk_{n}.bvh", f"/somewhere/walk_{n}.bvh") for n in range(2000)]
    train, held_out = (chosen(entries, split, 0.2) for split in ("train", "held_out"))
    assert len(held_out) == pytest.approx(400, abs=4 * np.sqrt(2000 * 0.16))
    assert {*train} | {*held_out} == {*entries} and not {*train} & {*held_out}
    assert chosen(entries[::-1], "held_out", 0.2) == held_out[::-1]
    assert {*held_out} < {*chosen(entries, "held_out", 0.3)}  # a greater share adds to it
    assert place_in_split("walk_0.bvh") == pytest.approx(WALK_0, abs=1e-12)


def test_folders_without_motions_are_refused(make_env, tmp_path, folder):
    with pytest.raises(ConfigError, match="has no motions"):
        make_env(TRACK, motion=str(tmp_path))
    shutil.copy(folder / "shape.npz", tmp_path / "shape.npz")
    with pytest.raises(ConfigError, match="none of 1 files can be read"):
        make_env(TRACK, motion=str(tmp_path))
    with pytest.raises(ConfigError, match=r"shape\.npz"):
        make_env(TRACK, motion=("squat", str(tmp_path / "shape.npz")))


def test_named_files_must_be_motions(folder):
    names, motions = load_all([Entry("squat", "squat")], load_motion)
    assert names == ["squat"] and motions[0].name == "squat"
    with pytest.raises(ValueError, match="shape"):
        load_all([Entry("shape.npz", str(folder / "shape.npz"))], load_motion)
    assert find_motions(["kick", str(folder)])[0] == Entry("kick", "kick")


def test_frames_of_loops_and_of_long_clips_allow_starts_anywhere():
    loop = load_motion("squat")  # 2.6 s
    long = Motion("long", loop.fps, loop.local_rotations, loop.root_position * [0.0, 0.0, 1.0] + walk(loop), loop=False)
    frames = sample_frames(["a", "b"], [loop, long], Sampling(DT, 30, True))
    period = round(loop.duration / DT)
    assert frames.starts.tolist() == [period, period - 30 + 1]
    assert frames.first.tolist() == [0, period + 32, period + 32 + period + 2]
    np.testing.assert_allclose(frames.roots[frames.first[1] + 10], long.sample(10 * DT)[1])
    np.testing.assert_allclose(frames.roots[frames.first[1] - 1], loop.sample((period + 31) * DT)[1], atol=1e-9)
    ways = []
    for first, end, starts in zip(frames.first, frames.first[1:], frames.starts, strict=False):
        own = frames.roots[first:end, :2]
        ways += [own[s : s + len(own) - starts + 1] - own[s] for s in range(starts)]
    least, most = frames.reach()
    np.testing.assert_array_equal(least, np.concatenate(ways).min(axis=0))
    np.testing.assert_array_equal(most, np.concatenate(ways).max(axis=0))
    assert sample_frames(["a", "b"], [loop, long], Sampling(DT, 30, False)).starts.tolist() == [1, 1]


def walk(motion: Motion) -> np.ndarray:
    """Return a way of 1 m/s along -y, ``(num_frames, 3)``."""
    return np.outer(np.arange(motion.num_frames) / motion.fps, [0.0, -1.0, 0.0])


def test_a_state_knows_the_files_of_its_folder(make_env, folder, tmp_path):
    own = tmp_path / "own"
    shutil.copytree(folder, own, ignore=shutil.ignore_patterns("shape.npz"))
    env = make_env(TRACK, motion=str(own), impulse=0.0)
    env.reset(seed=0)
    state = env.get_state()
    env.set_state(state)
    assert np.isfinite(env.step(still(env))[0]).all()
    (own / "short.bvh").unlink()
    other = make_env(TRACK, twin=1, motion=str(own), impulse=0.0)
    other.reset(seed=0)
    with pytest.raises(ValueError, match="motion"):
        other.set_state(state)


@pytest.mark.usefixtures("empty_kernel_cache")
def test_what_took_long_to_read_is_kept_until_a_file_changes(monkeypatch, folder, tmp_path):
    monkeypatch.setattr(result_cache, "LEAST_SECONDS", 0.0)
    own = tmp_path / "own"
    shutil.copytree(folder, own)
    loaded: list[str] = []

    def counted(place, *args, **kwargs):
        loaded.append(Path(place).name)
        return load_motion(place, *args, **kwargs)

    monkeypatch.setattr(collection, "load_motion", counted)
    asset = load_asset()
    shape = np.zeros(len(asset.shape_names))

    def load(loop: bool = False):
        with pytest.warns(UserWarning, match="1 of 3 files are left out"):
            return load_frames(find_motions(f"{own}/"), asset, shape, None, loop, Sampling(DT, 30, True))

    first, again = load(), load()
    assert loaded == ["long.bvh", "shape.npz", "short.bvh"] and first.names == again.names
    for name in ("rotations", "roots", "first", "starts"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    load(loop=True)
    assert len(loaded) == 6
    text = (own / "short.bvh").read_text()
    (own / "short.bvh").write_text(text.replace("Frame Time: 0.0333333", "Frame Time: 0.0400000"))
    assert load().first[-1] > first.first[-1] and len(loaded) == 9


def test_references_are_those_of_the_avatar_in_the_scene(make_batch):
    """Its source and shape go before the environment's, also where the clip is made."""
    tall = {"avatars": [{"shape": {"parameters": {"height": 1.0}}}]}
    heights = [make_batch(TRACK, 1, scene=scene).task.frames.roots[:, 2].max() for scene in ({}, tall)]
    assert heights[1] > 1.05 * heights[0]


def test_no_motions_and_folders_without_a_slash_are_refused(make_batch, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="motion"):
        make_batch(TRACK, 1, motion=[])
    (tmp_path / "walks").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"write '\./walks'"):
        make_batch(TRACK, 1, motion="walks")


@pytest.fixture
def make_host(device):
    """Function that builds a host of four clips."""
    task = load_task(TRACK)
    settings = {"motion": ["idle", "kick", "squat", "step"], "fidelity": "tiny"}

    def make(num_envs: int, **kwargs) -> EpisodeHost:
        return EpisodeHost(task(load_config(task.Config, settings)), num_envs, device, **kwargs)

    return make


def drawn(host: EpisodeHost, seed: int | None = None) -> np.ndarray:
    """Begin episodes, and return the motions that they follow."""
    host.reset(seed)
    return np.concatenate([group.task.playing.numpy() for group in host.groups])


def test_weights_say_how_often_motions_are_drawn(make_host):
    host = make_host(32)
    uniform = drawn(host, 7)
    assert np.array_equal(uniform[:8], UNIFORM)
    host.weigh_motions([0.0, 3.0, 1.0, 0.0])
    counts = np.bincount(np.concatenate([drawn(host) for _ in range(10)]), minlength=4)
    assert counts[[0, 3]].sum() == 0 and counts[1] / 320 == pytest.approx(0.75, abs=4 * np.sqrt(0.75 * 0.25 / 320))
    state, later = host.get_state(), [drawn(host) for _ in range(2)]
    other = make_host(32, num_threads=1)
    other.reset(0)
    other.set_state(state)
    assert np.array_equal([drawn(other) for _ in range(2)], later), "the weights are part of the state"
    own = np.arange(32) % 4
    host.weigh_motions(np.eye(4)[own])
    assert np.array_equal(drawn(host), own)
    host.step(np.zeros((32, 1, host.action_size), np.float32))
    assert np.array_equal(host.read(lambda group: group.metrics)[:, 0, host.task.metric_names.index("motion")], own)
    host.weigh_motions(None)
    assert np.array_equal(drawn(host, 7), uniform)


def test_weights_are_checked(make_host, make_env):
    host = make_host(2)
    host.weigh_motions([0.0, 0.0, 1.0, 0.0])
    for weights, message in (
        ([1.0, 2.0], r"shape \(2,\); use shape \(4,\) or \(2, 4\)"),
        ([1.0, -2.0, 0.0, 0.0], r"weights\[1\] is -2"),
        ([[1.0, 0.0, 0.0, np.nan], [1.0] * 4], r"weights\[0, 3\] is nan"),
        (np.zeros((2, 4)), "all zero"),
        ("kick", "use shape"),
    ):
        with pytest.raises(ValueError, match=message):
            host.weigh_motions(weights)
    assert drawn(host, 0).tolist() == [2, 2]
    with pytest.raises(ValueError, match="draws no motions"):
        make_env("PIAvatar/Reach-v0").unwrapped.weigh_motions([1.0])


def test_tensors_weigh_motions_on_their_device(make_host):
    torch = pytest.importorskip("torch", reason="needs the extra train")
    host = make_host(4, array_api="torch")
    host.weigh_motions(torch.tensor([0.0, 0.0, 0.0, 2.0], device=host.api.device))
    assert drawn(host, 7).tolist() == [3] * 4
    host.weigh_motions(torch.zeros(4, device=host.api.device))  # without a share they are drawn alike
    assert np.array_equal(drawn(host, 7), UNIFORM[:4])
