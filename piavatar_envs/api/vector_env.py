"""What single environments are asked for by name: ``call``, ``get_attr``, ``set_attr``, as of Gymnasium's vectors.

The view of many environments: ``gymnasium.vector.VectorEnv`` over a batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from piavatar_envs.api.arrays import Array
from piavatar_envs.api.batched import BatchedEpisodes
from piavatar_envs.api.copies import Copied, check_state
from piavatar_envs.api.episode import BATCH_RENDER_MODES, Settings, check_batch_render_mode
from piavatar_envs.api.infos import outcome, single_infos, standing, vector_format
from piavatar_envs.api.picture import Pictures
from piavatar_envs.api.view import BatchedView
from piavatar_envs.config import EnvConfig, load_config
from piavatar_envs.config.load import setting_keys
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_registered

#: Attributes of a single environment that the vector has under another name.
_SINGLE = {"action_space": "single_action_space", "observation_space": "single_observation_space"}
#: Attributes of a single environment that are not one thing of all of them, and where there is the like.
_ELSEWHERE = {
    "batch": "the environments are stepped together in vector.episodes",
    "np_random": "what an environment draws follows from its seed and its episode, without a generator",
}


class Each:
    """A vector that can be asked as if it were a tuple of single environments.

    They share their attributes, and what is asked of all of them is answered as often as there are environments. Of
    their methods there are those that make sense one by one.

    Attributes:
        config: the settings.
        episodes: the environments.
        num_envs: how many.
        _own: names of the attributes that the vector was built with.
    """

    config: EnvConfig
    episodes: BatchedEpisodes
    num_envs: int
    _own: frozenset[str]

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call what every single environment has: ``reset``, ``render``, ``get_state``, ``set_state``, ``assist_root``.

        Args:
            name: of the method; of anything else it is :meth:`get_attr`.
            *args: of the method, the same for all.
            **kwargs: likewise.

        Returns:
            What each single environment would have returned.

        Raises:
            AttributeError: environments of a vector have no such method of their own.
        """
        return tuple(self.call_some(range(self.num_envs), name, *args, **kwargs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of every single environment.

        Raises:
            AttributeError: there is none of this name.
        """
        return tuple(self.attr_of_some(range(self.num_envs), name))

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of one's own, which all environments share and nothing of this package reads.

        Args:
            name: of the attribute.
            values: its value; a list or a tuple has one for every environment, all the same.

        Raises:
            ValueError: different values or a wrong number of them, a setting, or what the vector is made of.
        """
        values = list(values) if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(f"set_attr({name!r}): there are {len(values)} values for num_envs={self.num_envs}")
        if any(value is not values[0] and not np.array_equal(value, values[0]) for value in values):
            raise ValueError(
                f"set_attr({name!r}): the environments share their attributes; give one value for all of them"
            )
        if name in self._own or name in _SINGLE or name in _ELSEWHERE or hasattr(type(self), name):
            raise ValueError(f"set_attr({name!r}): it is what the environments are made with; make others")
        if any(name in (key, *key.split(".")) for key in setting_keys(type(self.config))):
            raise ValueError(
                f"set_attr({name!r}): settings hold for as long as the environments live; make others with {name}=..., "
                "or have episodes draw it from a range, where the settings have one"
            )
        setattr(self, name, values[0])

    def attr_of_some(self, envs: Sequence[int], name: str) -> list[Any]:
        """An attribute as single environments have it, for each of ``envs``.

        Raises:
            AttributeError: there is none of this name.
        """
        if name == "np_random_seed":
            seeds = np.concatenate([group.seed.numpy() for group in self.episodes.groups]).view(np.uint32)
            return [int(seeds[env]) for env in envs]
        if name in _ELSEWHERE:
            raise AttributeError(f"environments of a vector have no {name!r} of their own: {_ELSEWHERE[name]}")
        value = getattr(self, _SINGLE.get(name, name))
        return [value for _ in envs]

    def call_some(self, envs: Sequence[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """As :meth:`call`, for each of ``envs``; the others go on."""
        own = {"reset": self._reset_some, "get_state": self._states, "set_state": self._set_states}
        own |= {"render": self._frames, "assist_root": self._assist_some}
        if name in own:
            return own[name](list(envs), *args, **kwargs)
        if not callable(getattr(type(self), name, None)):
            return self.attr_of_some(envs, name)
        raise AttributeError(
            f"{name!r} is not for single environments of a vector, which are stepped and closed together; they have "
            f"{', '.join(map(repr, sorted(own)))}, everything else is the vector's own"
        )

    def _reset_some(
        self, envs: Sequence[int], *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> list[tuple[Any, dict[str, Any]]]:
        """Begin episodes, each of the same seed or the next one of its own."""
        mask = self._mask(envs)
        if not (self.episodes.ready or mask.all()):
            self.reset()
        seeds = [seed if held else None for held in mask]
        observation, infos = self.reset(seed=seeds, options={**(options or {}), "reset_mask": mask})
        told = single_infos(infos, self.num_envs)
        return [(_row(observation, env), told[env]) for env in envs]

    def _states(self, envs: Sequence[int]) -> list[dict[str, np.ndarray]]:
        state = self.episodes.get_state()
        return [{name: value[env : env + 1].copy() for name, value in state.items()} for env in envs]

    def _set_states(self, envs: Sequence[int], state: dict[str, np.ndarray]) -> list[Any]:
        """Give all of ``envs`` the state of one environment; returns their observations."""
        check_state(state, 1)
        others = ~self._mask(envs)
        if others.any():
            self.episodes.check_ready("set_state")
        present, given = self.episodes.get_state(), {}
        for name, value in state.items():
            given[name] = np.repeat(value, self.num_envs, axis=0)
            # what does not fit is refused below, with the reason
            if name in present and given[name].shape == present[name].shape:
                given[name][others] = present[name][others]
        observation = self.set_state(given)
        return [_row(observation, env) for env in envs]

    def _frames(self, envs: Sequence[int]) -> list[np.ndarray | None]:
        frames = self.render() or (None,) * self.num_envs
        return [frames[env] for env in envs]

    def _assist_some(self, envs: Sequence[int], share: float) -> list[None]:
        if self._mask(envs).all():
            self.assist_root(share)
            return [None for _ in envs]
        raise ValueError("assist_root by name is for all environments; give the vector's own a share for each of them")

    def _mask(self, envs: Sequence[int]) -> np.ndarray:
        mask = np.zeros(self.num_envs, bool)
        mask[list(envs)] = True
        return mask


def _row(observation: Any, env: int) -> Any:
    """One environment's part of observations."""
    if isinstance(observation, dict):
        return {name: value[env] for name, value in observation.items()}
    return observation[env]


class AvatarVectorEnv(Copied, Each, BatchedView, VectorEnv):
    """Many worlds of one soft avatar and a task, stepped at once.

    Environment ``i`` is the single environment of seed ``seed + i``, bit for bit. Its ``info`` is the single
    one's in Gymnasium's vector format: arrays, and beside each ``name`` the mask ``_name`` of environments that it
    holds for. With ``array_api="torch"`` all of it are tensors on the environments' device and nothing in :meth:`step`
    makes the host wait; then ``info["failure"]`` are bits (``piavatar_envs.mpm.types.failure_name`` knows their names),
    and under SAME_STEP ``info["final_obs"]`` is a whole batch of observations; ``_final_obs`` says which ended.

    When an episode ends, ``metadata["autoreset_mode"]`` says what happens, as Gymnasium defines it. The terminal
    observation is what :meth:`step` returns, except under SAME_STEP, where it is in ``info["final_obs"]``:

    - NEXT_STEP: the next :meth:`step` ignores the action of this environment (which is checked all the same) and
      begins its next episode instead.
    - SAME_STEP: the same step begins the next episode; what it ended with is in ``final_obs`` and ``final_info``.
    - DISABLED: the caller resets, with ``reset(options={"reset_mask": ...})``, before the next :meth:`step`.

    Attributes:
        episodes: the environments.
        config: their settings.
        action_names: of every component of an action.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": list(BATCH_RENDER_MODES),
        "render_fps": 30,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        task: str | type[Task] = "Reach-v0",
        num_envs: int = 1,
        render_mode: str | None = None,
        device: str = "cpu",
        config: Settings = None,
        array_api: str = "numpy",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        num_threads: int | None = None,
        registered: Sequence[str] | None = None,
        **overrides: Any,
    ) -> None:
        """Build the environments.

        Args:
            task: id of the task, this suite's with or without the namespace, or its class.
            num_envs: number of environments.
            render_mode: None or ``"rgb_array"``.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            config: settings as a mapping, a YAML file or a configuration.
            array_api: what goes in and comes out: ``"numpy"`` or ``"torch"`` (on ``device``).
            autoreset_mode: what happens at the end of an episode; an ``AutoresetMode`` or its value.
            num_threads: threads that share the environments on a CPU; one a core if not given. Changes no result.
            registered: for Gymnasium alone: the id that is made, and the task that it was registered for.
            **overrides: settings that win over ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown, of the wrong type or out of range.
            ImportError: ``array_api="torch"`` and torch is not installed.
            ValueError: an unknown task or one that is not the id's, an unknown render mode, device, kind of arrays or
                autoreset mode, or no environments.
        """
        self.render_mode, self.autoreset_mode = check_batch_render_mode(render_mode), _autoreset_mode(autoreset_mode)
        task_class = load_registered(task, registered)
        self.config = load_config(task_class.Config, config, overrides)
        made = {"num_envs": num_envs, "render_mode": render_mode, "device": device, "array_api": array_api}
        made |= {"autoreset_mode": self.autoreset_mode, "num_threads": num_threads, "config": self.config}
        self._build = partial(AvatarVectorEnv.__init__, task=task_class, **made)
        self.episodes = BatchedEpisodes(task_class(self.config).alone(), num_envs, device, array_api, num_threads)
        self.num_envs = num_envs
        self.metadata = {
            **self.metadata,
            "render_fps": round(1.0 / self.config.physics.control_dt),
            "autoreset_mode": self.autoreset_mode,
        }
        self.action_names = self.episodes.action_names
        self.single_action_space = self.episodes.action_space()
        self.single_observation_space = self.episodes.observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._pictures = Pictures(self.episodes.group_of, self.config.render)
        self._own = frozenset(vars(self))

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: of these and all following episodes: of environment ``i`` it is ``seed + i``, or ``seed[i]``. Without
                one (None), the next episode of the seed before.
            options: ``{"reset_mask": mask}`` resets some environments only, ``mask`` a NumPy array of ``num_envs`` bool
                with at least one True; it is removed from ``options``. Nothing else is known.

        Returns:
            Observations of all environments, and infos of those that were reset.

        Raises:
            TypeError: options that are no dict, or a mask that is not a NumPy array of bool.
            ValueError: a mask of the wrong shape or without any True, an unknown option, a wrong number of seeds, or a
                seed outside [0, 2^32); nothing has changed then.
            gymnasium.error.Error: what is no seed, or a first reset with a mask that leaves environments out.
        """
        mask = self._reset_mask(options)
        self.episodes.reset(seed, mask)
        if mask is not None:
            del options["reset_mask"]  # not before: who is refused may try again
        super().reset(seed=int(seed) if isinstance(seed, (int, np.integer)) else None)
        held = None if mask is None else self.episodes.api.from_host(mask)
        return self._observation(), self._in_vector_format(self._standing(), held)

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray | None:
        """The mask in ``options``."""
        if options is not None and not isinstance(options, dict):
            raise TypeError(f"options are of type {type(options).__name__}; use a dict")
        strange = sorted(set(options or {}) - {"reset_mask"})
        if strange:
            raise ValueError(f"unknown reset options {strange}; there is only 'reset_mask'")
        if not options:
            return None
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != bool:
            kind = f"an array of {mask.dtype}" if isinstance(mask, np.ndarray) else f"a {type(mask).__name__}"
            raise TypeError(f"options['reset_mask'] is {kind}; use a NumPy array of bool")
        if mask.shape != (self.num_envs,):
            raise ValueError(f"options['reset_mask'] has shape {mask.shape}, expected ({self.num_envs},)")
        if not mask.any():
            raise ValueError("options['reset_mask'] has no True: there is nothing to reset")
        return mask

    def step(self, actions: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Advance all environments by one control step.

        Args:
            actions: shape ``(num_envs, action_size)``; a NumPy array, or with ``array_api="torch"`` a float32 tensor
                on the environments' device.

        Returns:
            Observations, rewards, terminations, truncations and infos.

        Raises:
            ValueError: a wrong shape, type or device, or (NumPy) a component that is not finite; nothing has changed
                then. A tensor's values are not looked at: what is not finite acts as zero and ends its environment with
                the failure ``"action"``.
            gymnasium.error.ResetNeeded: before the first reset; under DISABLED (NumPy) also where an environment has
                ended and was not reset.
        """
        episodes = self.episodes
        episodes.check_ready("step")
        shape = self.num_envs, episodes.action_size
        actions = episodes.api.actions(actions, shape, self.action_names)[:, None]
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            return self._step_or_reset(actions)
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            return self._step_and_reset(actions)
        self._check_none_ended()
        episodes.advance(actions)
        return self._observation(), *self._outcome(), self._in_vector_format(self._standing() | self._worth())

    def _step_or_reset(self, actions: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """NEXT_STEP: what ended in the step before begins anew (where it was stepped on, nothing of that is left)."""
        episodes = self.episodes
        ended = episodes.find_ended()
        episodes.advance(actions)
        episodes.reset_ended()
        reward, terminated, truncated = self._outcome()
        infos = self._in_vector_format(self._standing())
        if episodes.api.may_hold(~ended):
            infos |= self._in_vector_format(self._worth(), ~ended)
        return self._observation(), episodes.api.shown(reward, ~ended), terminated, truncated, infos

    def _step_and_reset(self, actions: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """SAME_STEP: what ends begins anew at once, and what it ended with is kept in the infos."""
        episodes = self.episodes
        api = episodes.api
        episodes.advance(actions)
        ended, observation, outcome = episodes.find_ended(), self._observation(), self._outcome()
        worth = self._worth()
        infos = self._in_vector_format(worth, ~ended) if api.may_hold(~ended) else {}
        if api.may_hold(ended):
            infos["final_obs"], infos["_final_obs"] = api.rows(observation, ended), api.shown(ended)
            infos |= self._in_vector_format({"final_info": self._standing() | worth}, ended)
            episodes.reset_ended()
            observation = self._observation()
        return observation, *outcome, infos | self._in_vector_format(self._standing())

    def _check_none_ended(self) -> None:
        """DISABLED: refuse to step on where the host knows that an episode has ended."""
        ended = self.episodes.find_ended() if self.episodes.api.name == "numpy" else np.zeros(1, bool)
        if ended.any():
            raise gym.error.ResetNeeded(
                f"environments {np.flatnonzero(ended).tolist()} have ended and autoreset_mode is DISABLED; call "
                'reset(options={"reset_mask": terminated | truncated}) before step()'
            )

    def _observation(self) -> Any:
        """What the avatars see, by name with ``obs_mode="dict"``."""
        return self.episodes.named(self.episodes.observation()[:, 0])

    def _outcome(self) -> tuple[Array, Array, Array]:
        """Rewards, terminations and truncations."""
        episodes = self.episodes
        reward = episodes.api.shown(episodes.reward()[:, 0])
        return reward, episodes.terminated()[:, 0], episodes.truncated()

    def _standing(self) -> dict[str, Any]:
        return standing(self.episodes.read, self.episodes.api, 0)

    def _worth(self) -> dict[str, Any]:
        return outcome(self.episodes.read, self.episodes.task, 0)

    def _in_vector_format(self, values: dict[str, Any], mask: Array | None = None) -> dict[str, Any]:
        return vector_format(values, self.episodes.api, self.num_envs, mask)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of every environment, ``(height, width, 3)`` uint8, with ``render_mode="rgb_array"``, else None.

        Raises:
            ImportError: the extra ``render`` is not installed.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn('render() needs environments made with render_mode="rgb_array"')
            return None
        self.episodes.check_ready("render")
        return tuple(self._pictures.frame(env) for env in range(self.num_envs))

    def close_extras(self, **_kwargs: Any) -> None:
        """Free the renderer's windows and end the threads."""
        self._pictures.close()
        self.episodes.close()

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on; :meth:`set_state` restores it, bit for bit.

        The first dimension of every array is the environment; whether one is about to be reset is part of it.
        """
        return self.episodes.get_state()

    def set_state(self, state: dict[str, np.ndarray]) -> Any:
        """Restore what :meth:`get_state` returned; returns the observations.

        Raises:
            ValueError: the state is of other environments, of other settings or not finite; nothing has changed then.
        """
        self.episodes.set_state(state)
        return self._observation()


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """The mode itself.

    Raises:
        ValueError: there is no such mode.
    """
    try:
        return AutoresetMode(mode)
    except ValueError:
        values = ", ".join(repr(known.value) for known in AutoresetMode)
        raise ValueError(f"autoreset_mode={mode!r} is not known; use an AutoresetMode or one of {values}") from None
