"""The README's first picture: a heavy, soft ball in a soft belly, which knocks three bodies together, slowed down.

python -m scripts.film_ball [FILE] [--device cuda] [--fidelity coarse]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from piavatar_envs.multi import sumo_v0
from piavatar_envs.render.video import write_video
from scripts.pages.entries import ROOT

#: Control steps per second, those between two pictures, and shown pictures per second: few, for a small file.
SIMULATED, EVERY, SHOWN = 90, 2, 15
#: Place, heading [rad] and shape of each body, the first one in front.
BODIES = (
    ((0.0, 0.0), 0.0, {"sex": 1.0, "weight": 0.8, "belly": 0.8}),
    ((0.05, 0.38), 0.1, {"sex": -1.0}),
    ((-0.05, 0.80), -0.1, {"sex": 1.0, "height": 0.6}),
)
BALL = {
    "name": "ball",
    "size": [0.18],
    "mass": 15.0,
    "young_modulus": 2.0e4,
    "position": [0.0, -1.0, 1.02],
    "velocity": [0.0, 10.0, 0.4],
}
SETTINGS: dict[str, Any] = {
    "num_agents": len(BODIES),
    "control_dt": 1.0 / SIMULATED,
    "preset": "soft",
    "max_root_force": 1.2,
    "place_noise": 0.0,
    "ring_radius": 2.5,
    "overlays": False,
    "camera_position": (3.6, -1.0, 1.3),
    "camera_target": (0.0, 0.17, 0.88),
    "camera_follows": False,
    "scene": {
        "avatars": [{"position": at, "yaw": yaw, "shape": {"parameters": shape}} for at, yaw, shape in BODIES],
        "props": [BALL],
    },
}


def film(device: str, fidelity: str, seconds: float = 0.6) -> Iterator[np.ndarray]:
    """Simulate the blow and yield its pictures, shape (480, 480, 3) uint8.

    Args:
        device: a Warp device.
        fidelity: of the matter.
        seconds: simulated time [s].
    """
    env = sumo_v0.parallel_env(render_mode="rgb_array", device=device, fidelity=fidelity, **SETTINGS)
    still = {name: np.zeros(env.action_space(name).shape, np.float32) for name in env.possible_agents}
    try:
        env.reset(seed=0)
        yield env.render()
        for step in range(1, 1 + round(seconds * SIMULATED)):
            env.step({name: still[name] for name in env.agents})
            if step % EVERY == 0:
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
    parser.add_argument("--fidelity", default="medium", help="of the matter, such as coarse for a quick look")
    arguments = parser.parse_args()
    write_video(arguments.file, film(arguments.device, arguments.fidelity), SHOWN)


if __name__ == "__main__":
    main()
