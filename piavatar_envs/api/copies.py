"""What ``copy.deepcopy`` and ``pickle`` make of a view, and which states may be put into one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol

import numpy as np

#: What is not finite here a step finds, and ends the episode with the failure that says so.
_FOUND_BY_STEPS = ("particles.x", "particles.u", "particles.C", "particles.F")
#: How the names of shares of help for the pelvis end.
_HELP = ".assist"


class Host(Protocol):
    """What holds the environments of a view.

    Attributes:
        ready: whether there has been a reset.
    """

    ready: bool

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on."""

    def adopt(self, state: dict[str, np.ndarray], ready: bool) -> None:
        """Take over what :meth:`get_state` and ``ready`` were elsewhere."""


class Copied:
    """A view that ``copy.deepcopy`` and ``pickle`` copy; a copy goes on as the view does, on a CPU bit for bit.

    Nothing that a device, a graph or a thread holds can be copied. So a copy is built anew, by the arguments that the
    view was built by, and is given the view's state and all its other attributes: who plays, random generators,
    spaces, and what users have added. Pictures begin anew: windows, the camera's glide, the live view.

    Attributes:
        _host: what holds the environments.
        _build: the constructor, or as much of it as makes ``_built``, with all arguments but the view; importable, so
            that another process can call it.
        _built: names of the attributes that a copy has of its own.
    """

    _host: Host
    _build: Callable[[Any], None]
    _built: ClassVar[tuple[str, ...]]

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in vars(self).items() if name not in self._built}
        return {"kept": kept, "ready": self._host.ready, "state": self._host.get_state()}

    def __setstate__(self, copied: dict[str, Any]) -> None:
        kept = copied["kept"]
        kept["_build"](self)
        vars(self).update(kept)
        self._host.adopt(copied["state"], copied["ready"])


def check_state(state: Any, num_envs: int) -> None:
    """Refuse what cannot be a state of ``num_envs`` environments; which arrays there must be, they know themselves.

    Raises:
        ValueError: no mapping, an array of another number of environments, or a number that is not finite, unless a
            step would find it or its environment has failed; what resets leave as it is must be in range even then.
    """
    if not isinstance(state, Mapping):
        raise ValueError(f"the state is a {type(state).__name__} without any arrays; use what get_state() returned")
    arrays = {name: np.asarray(value) for name, value in state.items()}
    for name, value in arrays.items():
        if value.shape[:1] != (num_envs,):
            expected = (num_envs, *value.shape[1:])
            raise ValueError(f"state[{name!r}] has shape {value.shape}, expected {expected} for num_envs={num_envs}")
    failed = np.zeros(num_envs, bool)
    failure = arrays.get("particles.failure")
    if failure is not None and failure.dtype.kind == "i":
        failed = failure.reshape(num_envs, -1).any(1)
    for name, value in arrays.items():
        if value.dtype.kind == "f" and name not in _FOUND_BY_STEPS:
            stays = _stays(name)
            _check_finite(name, value, failed & (not stays))
            if stays:
                _check_range(name, value, 1.0 if name.endswith(_HELP) else np.inf)


def _stays(name: str) -> bool:
    """Whether resets leave an array as it is, or parts of it: what bodies are made of, and help from outside."""
    return name.startswith(("matter.", "contact.")) or name.endswith(_HELP)


def _check_range(name: str, value: np.ndarray, most: float) -> None:
    """Refuse numbers that are negative or above ``most``."""
    strange = (value < 0.0) | (value > most)
    if strange.any():
        first = tuple(np.argwhere(strange)[0].tolist())
        limit = f" and <= {most:g}" if np.isfinite(most) else ""
        raise ValueError(
            f"state[{name!r}]{list(first)}={value[first]} must be >= 0{limit}; use what get_state() returned"
        )


def _check_finite(name: str, value: np.ndarray, failed: np.ndarray) -> None:
    """Refuse numbers that are not finite where the environment has not failed."""
    strange = ~np.isfinite(value)
    if strange.any():
        strange[failed] = False
    if strange.any():
        first = tuple(np.argwhere(strange)[0].tolist())
        raise ValueError(f"state[{name!r}]{list(first)} is {value[first]}, not finite; use what get_state() returned")
