"""Endless play in a web browser until Ctrl-C: the command ``watch``."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from piavatar_envs.core.rng import check_seeds
from piavatar_envs.live.agents import AgentKind, agent_kinds, find_agent
from piavatar_envs.live.scenes import SavedScene, read_scene
from piavatar_envs.live.setup import Setup
from piavatar_envs.live.show import SCENES, Show
from piavatar_envs.play import settings_of
from piavatar_envs.render.live import PORT, check_port, import_viser


def watch(
    env_id: str,
    agent: str = "random",
    seed: int = 0,
    device: str = "cpu",
    port: int = PORT,
    overrides: Mapping[str, Any] | None = None,
    num_envs: int = 1,
    scenes: Path = SCENES,
) -> None:
    """Play ``env_id`` in a web browser until Ctrl-C, then say how long it was.

    Args:
        env_id: a registered id, or a module of several agents such as ``sumo_v0``, with or without its package.
        agent: its name: "random", "zero", "clip:squat", ... or, from a clone of the repository, "pid" or the folder of
            a training.
        seed: of the first episodes and of the random actions; later episodes go on from it.
        device: a Warp device.
        port: of this machine, or the next one that is free.
        overrides: settings of the environment's configuration.
        num_envs: number of environments, of which one is shown.
        scenes: folder of saved scenes.

    Raises:
        ImportError: the extra ``live`` is not installed.
        ValueError: an unknown module or agent, a seed, a port or a setting out of range.
    """
    check_seeds(seed, num_envs)
    settings = settings_of(device, overrides)
    kinds = agent_kinds(env_id, agent)
    find_agent(agent, kinds)
    setup = Setup(env_id, {name: value for name, value in settings.items() if name != "device"}, agent)
    watch_setup(replace(setup, num_envs=num_envs, seed=seed, device=device), kinds, port, scenes)


def watch_scene(path: Path, device: str = "cpu", port: int = PORT, scenes: Path = SCENES) -> None:
    """Go on with a saved scene in a web browser until Ctrl-C; arguments and errors as for :func:`watch`.

    Raises:
        FileNotFoundError: there is no such file.
    """
    scene = read_scene(path)
    setup = replace(scene.setup, device=device)
    watch_setup(setup, agent_kinds(setup.env_id, setup.agent), port, scenes, scene)


def watch_setup(
    setup: Setup,
    kinds: Mapping[str, AgentKind],
    port: int = PORT,
    scenes: Path = SCENES,
    scene: SavedScene | None = None,
) -> None:
    """Play in a web browser until Ctrl-C; then close everything and say in a line how long it was.

    Args:
        setup: what is played.
        kinds: the agents that can be chosen, by name.
        port: of this machine, or the next one that is free.
        scenes: folder of saved scenes.
        scene: of this setup, to begin with.

    Raises:
        ImportError: the extra ``live`` is not installed.
        ValueError: a setting or a port out of range.
    """
    check_port(port)
    import_viser()  # before the kernels are compiled
    show: Show | None = None
    try:
        with suppress(KeyboardInterrupt):
            show = Show(setup, kinds, port, folder=scenes)
            if scene is None:
                show.begin(setup.seed)
            else:
                show.open(scene)
            while True:
                show.turn()
        print(f"\nended after {show.played if show else 0} steps; the same command begins again")
    finally:
        if show:
            show.close()
