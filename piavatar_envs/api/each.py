"""What single environments are asked for by name: ``call``, ``get_attr``, ``set_attr``, as of Gymnasium's vectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from piavatar_envs.api.batched import BatchedEpisodes
from piavatar_envs.api.copies import check_state
from piavatar_envs.api.infos import single_infos
from piavatar_envs.envs.config import EnvConfig
from piavatar_envs.envs.config_io import setting_keys

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
        if any(name in (key, key.rpartition(".")[2]) for key in setting_keys(type(self.config))):
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
