"""The README's first picture: a heavy, soft ball in a soft belly, filmed slowed down.

python -m scripts.film_ball [FILE] [--device cuda]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np

import piavatar_envs  # noqa: F401 - registers the ids
from piavatar_envs.render.video import write_video
from scripts.pages.entries import ROOT

#: Simulated pictures a second, and shown ones.
SIMULATED, SHOWN = 90, 30
SETTINGS = {
    "control": "pose",
    "control_dt": 1.0 / SIMULATED,
    "preset": "soft",
    "fidelity": "medium",
    "camera_position": (2.6, -0.75, 1.15),
    "camera_target": (0.0, -0.12, 1.0),
    "camera_follows": False,
    "scene": {
        "props": [
            {
                "name": "ball",
                "size": [0.15],
                "mass": 4.0,
                "young_modulus": 2.0e4,
                "position": [0.0, -0.9, 1.08],
                "velocity": [0.0, 8.0, 0.0],
            }
        ]
    },
}


def film(device: str, seconds: float = 0.5) -> Iterator[np.ndarray]:
    """Simulate the blow and yield its pictures, shape (480, 480, 3) uint8.

    Args:
        device: a Warp device.
        seconds: simulated time [s].
    """
    env = gymnasium.make("PIAvatar/Stand-v0", render_mode="rgb_array", device=device, **SETTINGS)
    still = np.zeros(env.action_space.shape, dtype=np.float32)
    try:
        env.reset(seed=0)
        yield env.render()
        for _ in range(round(seconds * SIMULATED)):
            env.step(still)
            yield env.render()
    finally:
        env.close()


def main() -> None:
    """Write the film."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "file", nargs="?", type=Path, default=ROOT / "docs" / "images" / "soft.gif", help=".gif or .mp4"
    )
    parser.add_argument("--device", default="cpu", help="a Warp device")
    arguments = parser.parse_args()
    write_video(arguments.file, film(arguments.device), SHOWN)


if __name__ == "__main__":
    main()
