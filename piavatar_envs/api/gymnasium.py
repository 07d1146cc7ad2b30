"""The single-environment view: ``gymnasium.Env`` over a batch of one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from piavatar_envs.api.picture import Picture
from piavatar_envs.envs.actions import check_actions
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.config import EnvConfig, load_config
from piavatar_envs.envs.observations import ObservationLayout
from piavatar_envs.mpm.types import failure_name
from piavatar_envs.tasks import load_task


class AvatarEnv(gym.Env):
    """One soft avatar and a task.

    Observations are a flat float32 vector, or a dictionary with ``obs_mode="dict"``; ``observation_layout`` says what
    lies where. Actions are in [-1, 1]: increments of the joints' rotations, see ``action_names``.

    ``info`` holds the reward's terms (``info["reward_terms"]``), the task's metrics, ``success``, ``failure`` (None, or
    why the simulation gave up: then ``terminated`` is True and the next reset starts afresh), and the root wrench used.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(
        self,
        task: str = "Reach-v0",
        render_mode: str | None = None,
        device: str = "cpu",
        config: EnvConfig | Mapping[str, Any] | str | Path | None = None,
        **overrides: Any,
    ) -> None:
        """Build the environment.

        Args:
            task: id of the task, with or without the namespace.
            render_mode: None or ``"rgb_array"``.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            config: settings as a mapping, a YAML file or a configuration.
            **overrides: settings that win over ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown, of the wrong type or out of range.
            ValueError: an unknown task, render mode or device.
        """
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            modes = ", ".join(self.metadata["render_modes"])
            raise ValueError(f"render_mode={render_mode!r} is not known; use None or {modes}")
        task_class = load_task(task)
        self.config: EnvConfig = load_config(task_class.Config, config, overrides)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.config.physics.control_dt)}
        self.batch = BatchEnv(task_class(self.config), 1, device)
        self.action_names: tuple[str, ...] = tuple(self.batch.action_spec.names())
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.batch.action_spec.size,), np.float32)
        layout = self.batch.layout
        if self.config.obs_mode == "dict":
            self.observation_space = gym.spaces.Dict(
                {name: gym.spaces.Box(-np.inf, np.inf, (term.size,), np.float32) for name, term in layout.items()}
            )
        else:
            self.observation_space = gym.spaces.Box(-np.inf, np.inf, (layout.size,), np.float32)
        self._picture: Picture | None = None
        self._ready = False

    @property
    def observation_layout(self) -> ObservationLayout:
        """Name, slice, unit and frame of everything in the flat observation."""
        return self.batch.layout

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of this and all following episodes. Without one, the next episode of the seed before.
            options: none are known.

        Raises:
            ValueError: an option that is not known, or a seed outside [0, 2^32).
        """
        if options:
            raise ValueError(f"unknown reset options {sorted(options)}; there are none")
        super().reset(seed=seed)
        if seed is None and not self._ready:
            # an environment that was never seeded is different every time, as Gymnasium asks
            seed = int(self.np_random.integers(2**32))
        self.batch.reset(seeds=None if seed is None else [seed])
        self._ready = True
        if self._picture:
            self._picture.cut()
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one control step.

        Raises:
            ValueError: an action of the wrong shape, or one that is not finite; nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if not self._ready:
            raise gym.error.ResetNeeded("call reset() before step()")
        action = check_actions(action, self.action_space.shape, self.action_names)
        self.batch.action.assign(action.reshape(1, 1, -1))
        self.batch.step()
        info = self._info()
        info |= dict(zip(self.batch.task.metrics, self._row(self.batch.metrics), strict=True))
        info["reward_terms"] = dict(zip(self.batch.task.reward_terms, self._row(self.batch.terms), strict=True))
        reward = float(self.batch.reward.numpy()[0, 0])
        terminated, truncated = (bool(flag.numpy()[0]) for flag in (self.batch.terminated, self.batch.truncated))
        return self._observation(), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The scene as ``(height, width, 3)`` uint8 with ``render_mode="rgb_array"``, else None.

        Raises:
            ImportError: the extra ``render`` is not installed.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn('render() needs gym.make(..., render_mode="rgb_array")')
            return None
        if not self._ready:
            raise gym.error.ResetNeeded("call reset() before render()")
        if self._picture is None:
            self._picture = Picture(self.batch, self.config.render)
        return self._picture.frame(0)

    def close(self) -> None:
        """Free the renderer's window."""
        if self._picture:
            self._picture.close()
            self._picture = None

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on; :meth:`set_state` restores it, bit for bit on the CPU."""
        return self.batch.get_state()

    def set_state(self, state: dict[str, np.ndarray]) -> Any:
        """Restore what :meth:`get_state` returned; returns the observation.

        Raises:
            ValueError: the state is of another environment; nothing has changed then.
        """
        self.batch.set_state(state)
        self._ready = True
        return self._observation()

    def _observation(self) -> Any:
        flat = self.batch.observation.numpy()[0, 0].copy()
        return self.batch.layout.split(flat) if self.config.obs_mode == "dict" else flat

    @staticmethod
    def _row(array) -> list[float]:
        return [float(value) for value in array.numpy()[0]]

    def _info(self) -> dict[str, Any]:
        batch = self.batch
        drive = batch.simulation.avatar.state
        return {
            "success": bool(batch.success.numpy()[0]),
            "failure": failure_name(int(batch.failure.numpy()[0])),
            # a failed environment may hold values that are not finite; what leaves the suite never does
            "root_force": np.nan_to_num(drive.wrench_force.numpy()[0], posinf=0.0, neginf=0.0),
            "root_torque": np.nan_to_num(drive.wrench_torque.numpy()[0], posinf=0.0, neginf=0.0),
            "root_let_go": bool(drive.let_go.numpy()[0]),
        }
