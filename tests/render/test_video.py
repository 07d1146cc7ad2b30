"""Videos and GIFs: frames, timing, memory, and refusals."""

from __future__ import annotations

import gc
import weakref

import imageio.v3 as iio
import numpy as np
import pytest

from piavatar_envs.render import label, side_by_side, write_video

pytest.importorskip("imageio_ffmpeg", reason="needs the extra render")
Image = pytest.importorskip("PIL.Image", reason="needs the extra render")


def moving_square(count: int, height: int = 64, width: int = 96):
    for index in range(count):
        frame = np.full((height, width, 3), 200, dtype=np.uint8)
        frame[20:40, 2 * index : 2 * index + 20] = (30, 60, 150)
        yield frame


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_reads_back(tmp_path, suffix):
    path = write_video(tmp_path / "new" / f"clip{suffix}", moving_square(12), fps=20)
    frames = iio.imread(path)
    assert frames.shape[:3] == (12, 64, 96)
    for index, expected in enumerate(moving_square(12)):
        assert np.abs(frames[index, ..., :3].astype(int) - expected).mean() < 6.0
    duration = 12 / iio.immeta(path)["fps"] if suffix == ".mp4" else 12 * iio.immeta(path)["duration"] / 1000.0
    assert duration == pytest.approx(0.6, abs=0.01)


def test_odd_sizes_are_padded_for_mp4(tmp_path):
    path = write_video(tmp_path / "odd.mp4", moving_square(3, height=63, width=95), fps=10)
    assert iio.imread(path).shape == (3, 64, 96, 3)


def test_mp4_frames_are_not_hoarded(tmp_path):
    alive: list[weakref.ref] = []
    most = 0

    def watched():
        nonlocal most
        for frame in moving_square(30):
            alive.append(weakref.ref(frame))
            gc.collect(0)
            most = max(most, sum(reference() is not None for reference in alive))
            yield frame

    write_video(tmp_path / "long.mp4", watched(), fps=30)
    assert len(alive) == 30 and most <= 4


@pytest.mark.parametrize("fps", [10.0, 30.0, 47.3])
def test_a_gif_keeps_time(tmp_path, fps):
    path = write_video(tmp_path / "clip.gif", moving_square(31), fps)
    with Image.open(path) as gif:
        ends = np.cumsum([gif.seek(index) or gif.info["duration"] for index in range(gif.n_frames)])
    assert len(ends) == 31
    np.testing.assert_allclose(ends, 1000.0 / fps * np.arange(1, 32), atol=10.0)


def test_frames_of_a_gif_last_as_long_as_viewers_need(tmp_path):
    with Image.open(write_video(tmp_path / "clip.gif", moving_square(9), fps=60)) as gif:
        assert {gif.seek(index) or gif.info["duration"] for index in range(gif.n_frames)} == {20}


def test_a_still_gif_is_small(tmp_path):
    still = [next(moving_square(1, 240, 240))] * 40
    assert write_video(tmp_path / "still.gif", still, fps=20).stat().st_size < 20_000


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("clip.avi", moving_square(1), 30, r"clip\.avi.*\.mp4 or \.gif"),
        ("clip.mp4", [], 30, "at least one"),
        ("clip.gif", [], 30, "at least one"),
        ("clip.mp4", moving_square(1), 0, "fps=0"),
        ("clip.mp4", [np.zeros((8, 8, 3))], 30, "frame 1 is float64"),
        ("clip.gif", [np.zeros((8, 8, 3), np.uint8), np.zeros((8, 9, 3), np.uint8)], 30, "frame 2 has shape"),
    ],
)
def test_bad_videos_are_refused(tmp_path, name, frames, fps, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / name, frames, fps)


def test_label_and_side_by_side():
    frame = next(moving_square(1, 120, 160))
    before = frame.copy()
    labelled = label(frame, "before")
    assert labelled.shape == frame.shape and (labelled != frame).any()
    np.testing.assert_array_equal(frame, before)
    # Only the plate in the upper left corner changes.
    np.testing.assert_array_equal(labelled[60:], frame[60:])
    pair = side_by_side(labelled, frame, gap=6)
    assert pair.shape == (120, 326, 3)
    np.testing.assert_array_equal(pair[:, 166:], frame)
    with pytest.raises(ValueError, match="120 and 60 px"):
        side_by_side(frame, frame[:60])
