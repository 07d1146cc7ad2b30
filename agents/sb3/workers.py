"""Environments in processes of their own, as stable-baselines3 wants them."""

from __future__ import annotations

import multiprocessing
import signal
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from agents.config import multi_game
from agents.sb3.config import TrainingConfig
from agents.sb3.parallel import World, WorldFactory
from piavatar_envs.api.sb3 import SB3VecEnv
from piavatar_envs.config import ConfigError
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.envs.observations import ObservationLayout

MOST_THREADS = 8  # of torch, beside environments on a GPU


@dataclass(frozen=True)
class EnvFactory:
    """Factory of one environment, in whichever process calls it."""

    env_id: str
    settings: dict[str, Any]
    device: str = "cpu"
    render_mode: str | None = None

    def __call__(self) -> gym.Env:
        """Build the environment."""
        import piavatar_envs  # noqa: F401 - registers the ids, also in a fresh process

        quiet_warp()
        return gym.make(
            self.env_id,
            config=self.settings,
            device=self.device,
            render_mode=self.render_mode,
            disable_env_checker=True,
        )


def factory(config: TrainingConfig, device: str = "cpu") -> EnvFactory | WorldFactory:
    """Return the factory of a training run's environments: of worlds, where there are several agents."""
    if config.is_multi:
        return WorldFactory(multi_game(config.env_id).name, dict(config.env), device)
    return EnvFactory(config.env_id, dict(config.env), device)


@dataclass(frozen=True)
class EnvFacts:
    """Facts about an environment that agents depend on.

    Attributes:
        layout: what lies where in the flat observation.
        action_names: of every component of an action.
        action_step: rotation that an action of 1 commands in a control step [rad].
        control_dt: time of a control step [s].
        agents: names, where there are several.
        motions: names of the task's motions, if it has any.
    """

    layout: ObservationLayout
    action_names: tuple[str, ...]
    action_step: float
    control_dt: float
    agents: tuple[str, ...] = ()
    motions: tuple[str, ...] = ()


def prepare(make: EnvFactory | WorldFactory) -> EnvFacts:
    """Compile the kernels before the workers start: in parallel they would race for each other's files."""
    env = make()
    try:
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape, np.float32))
        bare = env.unwrapped
        control_dt = bare.config.physics.control_dt
        step = bare.config.control.joint_speed_limit * control_dt
        agents = bare.names if isinstance(bare, World) else ()
        motions = () if agents else bare.host.task.motion_names
        return EnvFacts(bare.observation_layout, bare.action_names, step, control_dt, agents, motions)
    finally:
        env.close()


def start(config: TrainingConfig, make: EnvFactory | WorldFactory, device: str = "cpu") -> VecEnv:
    """Start the environments of a configuration: one batch, or processes.

    Raises:
        ValueError: a batch that does not fit.
    """
    return start_vector(config, device) if config.vector else start_workers(make, config.num_workers)


@dataclass(frozen=True)
class InWorker:
    """Factory of an environment in a process of its own."""

    make: EnvFactory | WorldFactory

    def __call__(self) -> gym.Env:
        """Build the environment, and leave Ctrl-C, which reaches all processes of a terminal, to the parent."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        return self.make()


def start_workers(make: EnvFactory | WorldFactory, num_workers: int) -> VecEnv:
    """Start ``num_workers`` environments; a single one stays in this process."""
    torch.set_num_threads(1)  # the workers have the cores; the networks are small
    if num_workers == 1:
        return DummyVecEnv([make])
    methods = multiprocessing.get_all_start_methods()  # never fork: a copy of a running Warp is not a working one
    method = "forkserver" if "forkserver" in methods else "spawn"
    multiprocessing.set_forkserver_preload([__name__])  # once, and not in each worker
    return SubprocVecEnv([InWorker(make)] * num_workers, start_method=method)


def start_vector(config: TrainingConfig, device: str = "cpu") -> VecEnv:
    """Start the environments of a configuration as one batch, in this process.

    Raises:
        ValueError: an unknown device, or a batch that does not fit.
    """
    # a CPU's cores are for the environments; beside a GPU's, many threads on small networks mostly wait for each other
    torch.set_num_threads(1 if device == "cpu" else min(torch.get_num_threads(), MOST_THREADS))
    return SB3VecEnv(config.env_id, config.num_workers, device=device, config=dict(config.env))


def components(layout: ObservationLayout, observe: tuple[str, ...] | None) -> list[int]:
    """Return places in the flat observation of the named terms; all of it for None.

    Raises:
        ConfigError: there is no such term, or none is named.
    """
    names = tuple(layout) if observe is None else observe
    if not names:
        raise ConfigError(f"observe=[] shows the networks nothing; use some of {', '.join(layout)}, or null for all")
    unknown = [name for name in names if name not in layout]
    if unknown:
        raise ConfigError(f"observe: there is no term {unknown[0]!r}; use some of {', '.join(layout)}")
    return [index for name in names for index in range(layout[name].slice.start, layout[name].slice.stop)]
