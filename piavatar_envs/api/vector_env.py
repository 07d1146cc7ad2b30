"""Gymnasium's view of many environments: ``gymnasium.vector.VectorEnv``, and its calls of single environments."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from piavatar_envs.api.arrays import Array
from piavatar_envs.api.host import EpisodeHost, HostView, Settings, limited
from piavatar_envs.api.pictures import BATCH_RENDER_MODES, check_batch_render_mode
from piavatar_envs.config import EnvConfig, load_keywords
from piavatar_envs.config.load import setting_keys
from piavatar_envs.envs.state import check_state
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_registered

#: Attributes of a single environment that the vector has under another name.
_SINGLE = {"action_space": "single_action_space", "observation_space": "single_observation_space"}
#: Attributes of a single environment that the environments of a vector lack, with the reason.
_MISSING = {
    "batch": "the environments are stepped together in vector.host",
    "np_random": "random numbers of an environment follow from its seed and its episode, without a generator",
}


class VectorCalls:
    """Calls of single environments by name, as Gymnasium's vectors have them: ``call``, ``get_attr``, ``set_attr``.

    The environments share their attributes; a value is returned once for every environment. Callable are the methods
    that make sense for one environment while the others go on.

    Attributes:
        config: the settings.
        host: holds the environments.
        num_envs: number of environments.
        _own: names of the attributes that the vector was built with.
        reset, render, set_state, assist_root: methods of the vector.
    """

    config: EnvConfig
    host: EpisodeHost
    num_envs: int
    _own: frozenset[str]
    reset: Callable[..., tuple[Any, dict[str, Any]]]
    render: Callable[[], tuple[Any, ...] | None]
    set_state: Callable[[dict[str, np.ndarray]], Any]
    assist_root: Callable[[Any], None]

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each: reset, render, read, get_state, set_state, assist_root or apply_force.

        Args:
            name: of the method; other attributes are read as by :meth:`get_attr`.
            *args: of the method, the same for all.
            **kwargs: likewise.

        Returns:
            The result that each single environment would have returned.

        Raises:
            AttributeError: there is no such method of single environments.
        """
        return tuple(self.call_some(range(self.num_envs), name, *args, **kwargs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of every single environment.

        Raises:
            AttributeError: there is none of this name.
        """
        return tuple(self.attr_of_some(range(self.num_envs), name))

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of your own, which all environments share and this package does not read.

        Args:
            name: of the attribute.
            values: its value; or a list or tuple of equal values, one for every environment.

        Raises:
            ValueError: different values or a wrong number of them, a setting, or an attribute of the vector itself.
        """
        values = list(values) if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(f"set_attr({name!r}): there are {len(values)} values for num_envs={self.num_envs}")
        if any(value is not values[0] and not np.array_equal(value, values[0]) for value in values):
            raise ValueError(
                f"set_attr({name!r}): the environments share their attributes; give one value for all of them"
            )
        if name in self._own or name in _SINGLE or name in _MISSING or hasattr(type(self), name):
            raise ValueError(f"set_attr({name!r}): it is part of the environments; make new ones")
        if any(name in (key, *key.split(".")) for key in setting_keys(type(self.config))):
            raise ValueError(
                f"set_attr({name!r}): settings are fixed when environments are made; make new ones with {name}=..., "
                "or let episodes draw it from a range, where the settings have one"
            )
        setattr(self, name, values[0])

    def attr_of_some(self, envs: Sequence[int], name: str) -> list[Any]:
        """Return an attribute of single environments, for each of ``envs``.

        Raises:
            AttributeError: there is none of this name.
        """
        if name == "np_random_seed":
            seeds = np.concatenate([group.seed.numpy() for group in self.host.groups]).view(np.uint32)
            return [int(seeds[env]) for env in envs]
        if name in _MISSING:
            raise AttributeError(f"environments of a vector have no {name!r} of their own: {_MISSING[name]}")
        value = getattr(self, _SINGLE.get(name, name))
        return [value for _ in envs]

    def call_some(self, envs: Sequence[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method as :meth:`call` does, for each of ``envs``; the others go on."""
        own: dict[str, Callable[..., list[Any]]] = {
            "reset": self._reset_some,
            "get_state": self._states,
            "set_state": self._set_states,
        }
        own |= {"render": self._frames, "assist_root": self._assist_some, "apply_force": self._push_some}
        own |= {"read": self._read_some}
        if name in own:
            return own[name](list(envs), *args, **kwargs)
        if not callable(getattr(type(self), name, None)):
            return self.attr_of_some(envs, name)
        raise AttributeError(
            f"{name!r} is not a call of single environments of a vector, which are stepped and closed together; "
            f"callable are {', '.join(map(repr, sorted(own)))}"
        )

    def _reset_some(
        self, envs: Sequence[int], *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> list[tuple[Any, dict[str, Any]]]:
        """Begin episodes, each of the same seed, or the next one of its own seed."""
        mask = self._mask(envs)
        if not (self.host.ready or mask.all()):
            self.reset()
        seeds = [seed if held else None for held in mask]
        observation, infos = self.reset(seed=seeds, options={**(options or {}), "reset_mask": mask})
        rows = single_infos(infos, self.num_envs)
        return [(_row(observation, env), rows[env]) for env in envs]

    def _states(self, envs: Sequence[int]) -> list[dict[str, np.ndarray]]:
        state = self.host.get_state()
        return [{name: value[env : env + 1].copy() for name, value in state.items()} for env in envs]

    def _set_states(self, envs: Sequence[int], state: dict[str, np.ndarray]) -> list[Any]:
        """Give all of ``envs`` the state of one environment; returns their observations."""
        check_state(state, 1)
        others = ~self._mask(envs)
        if others.any():
            self.host.check_ready("set_state")
        state = self.host.with_forces(state)
        present, given = self.host.get_state(), {}
        for name, value in state.items():
            given[name] = np.repeat(value, self.num_envs, axis=0)
            # an array that does not fit is refused by set_state, with the reason
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
        raise ValueError("assist_root by name is for all environments; give vector.assist_root() a share for each")

    def _push_some(self, envs: Sequence[int], *args: Any, **kwargs: Any) -> list[None]:
        self.host.apply_force(*args, **kwargs, envs=self._mask(envs))
        return [None for _ in envs]

    def _read_some(self, envs: Sequence[int], name: str, agent: str | None = None) -> list[Array]:
        values = self.host.reading(name, agent)
        return [values[env] for env in envs]

    def _mask(self, envs: Sequence[int]) -> np.ndarray:
        mask = np.zeros(self.num_envs, bool)
        mask[list(envs)] = True
        return mask


def _row(observation: Any, env: int) -> Any:
    """Return the observation of one environment."""
    if isinstance(observation, dict):
        return {name: value[env] for name, value in observation.items()}
    return observation[env]


class AvatarVectorEnv(VectorCalls, HostView, VectorEnv):
    """Many environments of one soft avatar and a task, stepped at once.

    Environment ``i`` equals the single environment of seed ``seed + i``, bit for bit. Infos have Gymnasium's vector
    format: arrays, and beside each ``name`` the mask ``_name`` of the environments that it holds for. With
    ``array_api="torch"`` all arrays are tensors on the environments' device and :meth:`step` never makes the host wait;
    then ``info["final_obs"]`` under SAME_STEP is a whole batch of observations, of which ``_final_obs`` marks those
    that ended.

    At the end of an episode ``metadata["autoreset_mode"]`` applies, as Gymnasium defines it. :meth:`step` returns the
    terminal observation, except under SAME_STEP, where it is in ``info["final_obs"]``:

    - NEXT_STEP: the next :meth:`step` ignores the action of this environment (which is checked all the same) and
      begins its next episode instead.
    - SAME_STEP: the same step begins the next episode; the end of the last one is in ``final_obs`` and ``final_info``.
    - DISABLED: the caller resets, with ``reset(options={"reset_mask": ...})``, before the next :meth:`step`.

    Attributes:
        host: holds the environments.
        config: their settings.
        action_names: of every component of an action.
    """

    # no ClassVar, because Gymnasium declares it of the instance
    metadata: dict[str, Any] = {  # noqa: RUF012
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
        max_episode_steps: int | None = None,
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
            array_api: kind of arrays: ``"numpy"`` or ``"torch"`` (on ``device``).
            autoreset_mode: an ``AutoresetMode`` or its value, see above.
            num_threads: threads that share the environments on a CPU; one per core if not given. Changes no result.
            max_episode_steps: control steps until truncation; overrides ``episode_seconds``.
            registered: set by Gymnasium only: the id, and the task that it is registered for.
            **overrides: settings that override ``config``, such as ``fidelity="tiny"``.

        Raises:
            ConfigError: a setting that is unknown (a TypeError, too), of the wrong type or out of range.
            ImportError: ``array_api="torch"`` and torch is not installed.
            ValueError: an unknown task or one that the id is not registered for, an unknown render mode, device, kind
                of arrays or autoreset mode, no environments, or less than one control step.
        """
        self.render_mode, self.autoreset_mode = check_batch_render_mode(render_mode), _autoreset_mode(autoreset_mode)
        task_class = load_registered(task, registered)
        settings = load_keywords(task_class.Config, config, overrides)
        self.config = limited(settings, "max_episode_steps", max_episode_steps)
        made: dict[str, Any] = {
            "num_envs": num_envs,
            "render_mode": render_mode,
            "device": device,
            "array_api": array_api,
        }
        made |= {"autoreset_mode": self.autoreset_mode, "num_threads": num_threads, "config": self.config}
        self._build = partial(AvatarVectorEnv.__init__, task=task_class, **made)
        alone = task_class(self.config).alone()
        self.host = EpisodeHost(alone, num_envs, device, array_api, num_threads, render_mode)
        self.num_envs = num_envs
        frame_rate = self.host.frame_rate
        self.metadata = {**self.metadata, "render_fps": frame_rate, "autoreset_mode": self.autoreset_mode}
        self.action_names = self.host.action_names
        self.single_action_space = self.host.action_space()
        self.single_observation_space = self.host.observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._own = frozenset(vars(self))

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: of these and all following episodes: of environment ``i`` it is ``seed + i``, or ``seed[i]``. Without
                one (None), the next episode of the seed before.
            options: ``{"reset_mask": mask}`` resets some environments only, ``mask`` a NumPy array of ``num_envs`` bool
                with at least one True; it is removed from ``options``. There are no other options.

        Returns:
            Observations of all environments, and infos of those that were reset.

        Raises:
            TypeError: options that are no dict, or a mask that is not a NumPy array of bool.
            ValueError: a mask of the wrong shape or without any True, an unknown option, a wrong number of seeds, or a
                seed outside [0, 2^32); nothing has changed then.
            gymnasium.error.Error: a seed that is not a whole number, or a first reset that leaves environments out.
        """
        mask = self._reset_mask(options)
        self.host.reset(seed, mask)
        if options and mask is not None:
            del options["reset_mask"]  # after the reset, so that a refused call changes nothing
        super().reset(seed=int(seed) if isinstance(seed, (int, np.integer)) else None)
        held = None if mask is None else self.host.api.from_host(mask)
        none = self.host.api.from_host(np.zeros(self.num_envs, bool))
        return self._observation(), self._in_vector_format(self._info(none), held)

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray | None:
        """Return the mask in ``options``, if there is one."""
        if options is not None and not isinstance(options, dict):
            raise TypeError(f"options are of type {type(options).__name__}; use a dict")
        unknown = sorted(set(options or {}) - {"reset_mask"})
        if unknown:
            raise ValueError(f"unknown reset options {unknown}; there is only 'reset_mask'")
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
                then. The values of a tensor are not checked on the host: a component that is not finite acts as zero
                and ends its environment with the failure ``"action"``.
            gymnasium.error.ResetNeeded: before the first reset; under DISABLED (NumPy) also where an environment has
                ended and was not reset.
        """
        host = self.host
        host.check_ready("step")
        actions = host.api.actions(actions, (self.num_envs, host.action_size), self.action_names)[:, None]
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            return self._step_or_reset(actions)
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            return self._step_and_reset(actions)
        self._check_none_ended()
        host.advance(actions)
        return self._observation(), *self._ends(), self._in_vector_format(self._info())

    def _step_or_reset(self, actions: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step, and reset the environments that ended in the step before (NEXT_STEP).

        These are stepped as well, which the reset undoes.
        """
        host = self.host
        ended = host.find_ended()
        host.advance(actions)
        host.reset_ended()
        reward, terminated, truncated = self._ends()
        infos = self._in_vector_format(self._info(~ended))
        return self._observation(), host.api.shown(reward, ~ended), terminated, truncated, infos

    def _step_and_reset(self, actions: Array) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step, and reset the environments that end; the infos keep the end of their episodes (SAME_STEP)."""
        host = self.host
        api = host.api
        host.advance(actions)
        ended, observation, ends = host.find_ended(), self._observation(), self._ends()
        outcome = host.outcome(0)
        infos: dict[str, Any] = {}
        if api.may_hold(ended):
            infos["final_obs"], infos["_final_obs"] = api.rows(observation, ended), api.shown(ended)
            infos |= self._in_vector_format({"final_info": host.status(0) | outcome}, ended)
            host.reset_ended()
            observation = self._observation()
        return observation, *ends, infos | self._in_vector_format(self._info(~ended, outcome))

    def _check_none_ended(self) -> None:
        """Refuse a step after the end of an episode (DISABLED), where the arrays are on the host."""
        ended = self.host.find_ended() if self.host.api.name == "numpy" else np.zeros(1, bool)
        if ended.any():
            raise gym.error.ResetNeeded(
                f"environments {np.flatnonzero(ended).tolist()} have ended and autoreset_mode is DISABLED; call "
                'reset(options={"reset_mask": terminated | truncated}) before step()'
            )

    def _observation(self) -> Any:
        """Return the observations, in the form that ``obs_mode`` has."""
        return self.host.named(self.host.observation()[:, 0], self.host.observed_pictures(0))

    def _ends(self) -> tuple[Array, Array, Array]:
        """Return rewards, terminations and truncations."""
        host = self.host
        return host.api.shown(host.reward()[:, 0]), host.terminated()[:, 0], host.truncated()

    def _info(self, stepped: Array | None = None, outcome: dict[str, Array] | None = None) -> dict[str, Array]:
        """Return the infos, a row per environment; the outcome of the last step is zero where ``stepped`` is False."""
        host = self.host
        outcome = host.outcome(0) if outcome is None else outcome
        if stepped is not None:
            outcome = {name: host.api.shown(value, stepped) for name, value in outcome.items()}
        return host.status(0) | outcome

    def _in_vector_format(self, values: dict[str, Any], mask: Array | None = None) -> dict[str, Any]:
        """Format values by name as Gymnasium's vectors do: zeros outside ``mask``, and a mask ``_name`` beside each."""
        api = self.host.api
        masks = iter(api.repeated(mask, self.num_envs, _count(values)))

        def put(values: Mapping[str, Any]) -> dict[str, Any]:
            found: dict[str, Any] = {}
            for name, value in values.items():
                if isinstance(value, Mapping):
                    found[name] = put(value)
                else:
                    found[name] = api.shown(value, mask)
                found[f"_{name}"] = next(masks)
            return found

        return put(values)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw every environment, ``(height, width, 3)`` uint8, with ``render_mode="rgb_array"``; else return None.

        With ``render.mosaic`` every entry is the same picture, of several environments side by side: for Gymnasium's
        ``RecordVideo`` with ``record_first_only=True``.

        Raises:
            ImportError: pictures have text, and Pillow is not installed (extra ``render``).
            gymnasium.error.ResetNeeded: before the first reset.
        """
        return self.host.render()

    def close_extras(self, **_kwargs: Any) -> None:
        """Free the renderer's windows and end the threads."""
        self.host.close()

    def set_state(self, state: dict[str, np.ndarray]) -> Any:
        """Restore the result of :meth:`get_state`; returns the observations.

        Raises:
            ValueError: the state is of other environments, of other settings or not finite; nothing has changed then.
        """
        self.host.set_state(state)
        return self._observation()


def single_infos(infos: Mapping[str, Any], num_envs: int) -> list[dict[str, Any]]:
    """Split infos in vector format into one dictionary per environment, of the values that the masks grant it."""
    rows: list[dict[str, Any]] = [{} for _ in range(num_envs)]
    for name, mask in infos.items():
        if not name.startswith("_") or name[1:] not in infos:
            continue
        values = infos[name[1:]]
        if isinstance(values, dict):
            values = single_infos(values, num_envs)
        elif values.ndim == 1:
            # a real number is NumPy's float64, as in the info of a single environment
            values = [np.float64(v) if isinstance(v, float) else v for v in values.tolist()]
        for env, held in enumerate(mask.tolist()):
            if held:
                rows[env][name[1:]] = values[env]
    return rows


def _count(values: Mapping[str, Any]) -> int:
    """Count the names in a mapping and in those within it."""
    return sum(1 + (_count(value) if isinstance(value, Mapping) else 0) for value in values.values())


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """Return the mode.

    Raises:
        ValueError: it is unknown.
    """
    try:
        return AutoresetMode(mode)
    except ValueError:
        values = ", ".join(repr(known.value) for known in AutoresetMode)
        raise ValueError(f"autoreset_mode={mode!r} is not known; use an AutoresetMode or one of {values}") from None
