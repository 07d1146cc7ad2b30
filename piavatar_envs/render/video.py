"""Video files from frames: MP4 (imageio-ffmpeg) and GIF (Pillow), chosen by the file's suffix."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from piavatar_envs.core.extras import missing

SUFFIXES = (".mp4", ".gif")
_GIF_COLORS, _GIF_SAMPLES = 128, 12
_GIF_FASTEST = 50.0  # frames per second; viewers slow down what is quicker


def check_suffix(path: Path) -> None:
    """Refuse a file that is no video by its name, before there is anything to film.

    Raises:
        ValueError: an unknown suffix.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"video {path} ends in {path.suffix!r}; use {' or '.join(SUFFIXES)}")


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> Path:
    """Write frames to a file.

    MP4 frames are written as they come, so a generator of any length will do. GIF frames are all kept, because they
    share one palette of 128 colours: meant for short clips.

    Args:
        path: the file; its suffix, ``.mp4`` or ``.gif``, says how. Missing folders are made once there is a picture.
        frames: pictures of one size, shape ``(H, W, 3)`` uint8.
        fps: frames per second, in a GIF 50 at most. A GIF counts hundredths of a second: its frames take turns to be
            longer and shorter, so that each begins within 10 ms of its time.

    Returns:
        The path.

    Raises:
        ImportError: the extra ``render`` is not installed.
        ValueError: an unknown suffix, an ``fps`` that is not positive, no frames, or a frame that is not such a
            picture or differs in size.
    """
    path = Path(path)
    check_suffix(path)
    if not fps > 0.0:
        raise ValueError(f"fps={fps} must be positive")
    if path.suffix.lower() == ".mp4":
        count = _write_mp4(path, frames, fps)
    else:
        count = _write_gif(path, frames, fps)
    if count == 0:
        raise ValueError(f"no frames for {path.name!r}: a video needs at least one")
    return path


def _write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float) -> int:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise missing("MP4 video", "imageio-ffmpeg", "render") from error
    writer, shape, count = None, None, 0
    try:
        for count, frame in enumerate(frames, start=1):
            frame = _checked(frame, shape, count)
            if writer is None:
                shape = frame.shape
                even = _even(frame)
                path.parent.mkdir(parents=True, exist_ok=True)
                # H.264 with 4:2:0 colour plays everywhere, and needs even sides.
                writer = imageio_ffmpeg.write_frames(
                    str(path), (even.shape[1], even.shape[0]), fps=fps, codec="libx264", pix_fmt_out="yuv420p",
                    macro_block_size=2, output_params=["-crf", "20", "-preset", "fast", "-movflags", "+faststart"],
                    ffmpeg_log_level="error",
                )  # fmt: skip
                writer.send(None)
            writer.send(_even(frame).tobytes())
    finally:
        if writer is not None:
            writer.close()
    return count


def _write_gif(path: Path, frames: Iterable[np.ndarray], fps: float) -> int:
    try:
        from PIL import Image
    except ImportError as error:
        raise missing("GIF video", "Pillow", "render") from error
    shape, images = None, []
    for count, frame in enumerate(frames, start=1):
        frame = _checked(frame, shape, count)
        shape = frame.shape
        images.append(Image.fromarray(frame.copy()))
    if images:
        # One palette, from pictures spread over the whole clip, and no dither: what does not move stays equal from
        # frame to frame, and costs nothing. The octree keeps small bright things, a median cut loses them.
        chosen = images[:: max(1, len(images) // _GIF_SAMPLES)]
        strip = Image.fromarray(np.concatenate([np.asarray(image)[::2, ::2] for image in chosen]))
        palette = strip.quantize(_GIF_COLORS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
        durations = _gif_durations(len(images), fps)
        path.parent.mkdir(parents=True, exist_ok=True)
        images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=False)
    return len(images)


def _gif_durations(count: int, fps: float) -> list[int]:
    """Return the duration of each frame [ms], in whole hundredths of a second that do not drift from ``fps``."""
    begins = np.rint(np.arange(count + 1) * 100.0 / min(fps, _GIF_FASTEST))
    return (10 * np.diff(begins)).astype(int).tolist()


def _checked(frame: np.ndarray, shape: tuple[int, ...] | None, count: int) -> np.ndarray:
    """Return the frame as contiguous bytes, and refuse one of another type or size than the first."""
    frame = np.asarray(frame)
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise ValueError(f"frame {count} is {frame.dtype} of shape {frame.shape}; give uint8 (H, W, 3)")
    if shape is not None and frame.shape != shape:
        raise ValueError(f"frame {count} has shape {frame.shape}, the first had {shape}; give frames of one size")
    return np.ascontiguousarray(frame)


def _even(frame: np.ndarray) -> np.ndarray:
    """Return the frame with its last row or column doubled where a side is odd."""
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge") if height % 2 or width % 2 else frame
