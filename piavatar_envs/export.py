"""Export of environments as geometry, for Blender and other programs: meshes that move, frame by frame.

A recording is of any environment of the suite, whatever chooses its actions::

    recording = Recording(env, Path("reach"), "glb")
    for _ in range(100):
        env.step(policy(observation))
        recording.add()
    recording.finish()
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.api.pictures import SceneReader
from piavatar_envs.config import BodyColor
from piavatar_envs.core.writing import check_writable
from piavatar_envs.play import Rollout, check_agent, check_steps, frames, make, settings_of
from piavatar_envs.render.film_files import check_format, film_writer


class Recording:
    """The scenes of one environment in time, written to files.

    Attributes:
        writer: of the files.
    """

    def __init__(
        self,
        env: Any,
        folder: str | Path,
        kind: str = "glb",
        index: int = 0,
        color: BodyColor = "skin",
    ) -> None:
        """Begin without a frame.

        Args:
            env: an environment of the suite, of one agent or several, or a vector of environments.
            folder: new, or empty.
            kind: "glb", "ply" or "usd".
            index: which one of a vector.
            color: of the bodies; "skin" for glb.

        Raises:
            ImportError: usd-core is not installed, for USD.
            TypeError: the folder is not a path.
            ValueError: the environment is not of the suite, there is no such index, format or colour, the format cannot
                hold the colours, or the folder holds something.
        """
        folder = Path(folder)
        check_recording(folder, kind, color)
        host = getattr(getattr(env, "unwrapped", None), "host", None)
        if not isinstance(host, EpisodeHost):
            raise ValueError(f"{env} is not of this suite; use an environment or a vector of its ids")
        if index not in range(host.num_envs):
            raise ValueError(f"index={index} is outside [0, {host.num_envs - 1}]")
        batch, self._index = host.group_of(index)
        self.writer = film_writer(folder, kind, 1.0 / host.config.physics.control_dt)
        self._scenes, self._color = SceneReader(batch), color

    def add(self) -> None:
        """Append what there is to see now, as the next frame: one per step in real time.

        What is not finite, because the simulation has failed, is left out with a warning; so are the frames after a
        glTF file is full.

        Raises:
            OSError: the folder cannot be written, for ply.
            ValueError: a single frame is too large for glTF.
        """
        self.writer.add(self._scenes.scene(self._index, self._color))

    def finish(self) -> list[Path]:
        """Write what is not written yet, and return the files, or the folders of files.

        Raises:
            OSError: the folder cannot be written.
            ValueError: there is no frame, or there is nothing to see in any.
        """
        return self.writer.finish()


def export(
    env_id: str,
    folder: Path,
    kind: str = "glb",
    agent: str = "random",
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    color: BodyColor = "skin",
    overrides: Mapping[str, Any] | None = None,
) -> tuple[Rollout, list[Path]]:
    """Play ``env_id`` as :func:`piavatar_envs.play.play` does, and write every state as a frame.

    Ctrl-C ends it early, and what was played is written.

    Args:
        env_id: a registered id, or a module of several agents, with or without its package.
        folder: to write to, new or empty.
        kind: "glb", "ply" or "usd".
        agent: "random" (uniform in the action space) or "zero".
        steps: number of steps; one episode by default.
        seed: of the first reset and of the random actions.
        device: a Warp device.
        color: of the bodies.
        overrides: settings of the environment's configuration.

    Returns:
        The rollout, and the files or folders of files.

    Raises:
        ImportError: usd-core is not installed, for USD.
        ValueError: an unknown module, agent or format, a folder that holds something, colours that the format cannot
            hold, a number of steps below 1, a seed or a setting out of range.
    """
    check_agent(agent, seed)
    check_steps(steps)
    check_recording(folder, kind, color)
    env = make(env_id, settings_of(device, overrides))
    rollout = Rollout()
    try:
        recording = Recording(env, folder, kind, color=color)
        for _ in frames(env, agent, steps, seed, rollout):
            recording.add()
    finally:
        env.close()
    return rollout, recording.finish()


def check_recording(folder: Path, kind: str, color: str = "skin") -> None:
    """Refuse what cannot be recorded, before an environment is built or played.

    Args:
        folder: to write to.
        kind: "glb", "ply" or "usd".
        color: of the bodies.

    Raises:
        ImportError: usd-core is not installed, for USD.
        ValueError: an unknown format or colour, a colour that the format cannot hold, or a folder that holds something,
            that is a file or that cannot be made.
    """
    check_format(kind)
    known = get_args(BodyColor)
    if color not in known:
        raise ValueError(f"no color {color!r}; use {', '.join(known[:-1])} or {known[-1]}")
    if color != "skin" and kind == "glb":
        raise ValueError(f"color={color} changes with time, which glTF cannot hold; use the format ply or usd")
    if folder.is_file():
        raise ValueError(f"{folder} is a file; name a folder")
    if folder.is_dir() and any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty, and frames of two films would mix; name a new folder")
    check_writable(folder / "film")
