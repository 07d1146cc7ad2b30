"""What callers get and give: NumPy arrays or torch tensors, always copies of what lives on the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import warp as wp

from piavatar_envs.envs.actions import check_actions
from piavatar_envs.envs.observations import ObservationLayout

#: An array of the chosen kind: ``numpy.ndarray`` or ``torch.Tensor``.
Array = Any

ARRAY_APIS = ("numpy", "torch")


class ArrayApi(Protocol):
    """How arrays of one kind come from Warp and go there.

    ``read`` joins the arrays of a batch's groups along the first dimension; what it returns is the caller's own.
    """

    name: str

    def read(self, arrays: Sequence[wp.array]) -> Array:
        """The arrays one after the other, a copy."""
        ...

    def actions(self, actions: Any, shape: tuple[int, ...], names: Sequence[str]) -> Array:
        """What a caller gave as actions, checked before anything changes."""
        ...

    def write(self, values: Array, arrays: Sequence[wp.array]) -> None:
        """Write checked ``values`` into the arrays, row by row."""
        ...

    def split(self, observation: Array, layout: ObservationLayout) -> dict[str, Array]:
        """A flat observation by name, copies along the last axis."""
        ...

    def finite(self, values: Array) -> Array:
        """``values`` with zeros for what is not finite; may be the same array."""
        ...

    def shown(self, values: Array, mask: Array | None = None) -> Array:
        """``values`` (a row an environment) as callers get them, their own; zeros outside ``mask``."""
        ...

    def repeated(self, mask: Array | None, num_envs: int, count: int) -> Array:
        """``count`` copies of a mask, shape ``(count, num_envs)``; of all True if there is none."""
        ...

    def from_host(self, mask: np.ndarray) -> Array:
        """A mask of the host as an array of this kind."""
        ...

    def may_hold(self, mask: Array) -> bool:
        """Whether ``mask`` may be True anywhere; False only if that is known without waiting."""
        ...

    def rows(self, values: Any, mask: Array) -> Array:
        """Observations of the environments in ``mask``: their own where arrays may hold objects, else a whole batch."""
        ...

    def begin(self) -> None:
        """Before launches: what the caller's library still has to do comes first."""
        ...

    def end(self) -> None:
        """After launches: what the caller's library does next comes later."""
        ...


class NumpyArrays:
    """Arrays on the host, whatever the device."""

    name = "numpy"

    def read(self, arrays: Sequence[wp.array]) -> np.ndarray:
        """The arrays one after the other, a copy."""
        return np.concatenate([array.numpy() for array in arrays])

    def actions(self, actions: Any, shape: tuple[int, ...], names: Sequence[str]) -> np.ndarray:
        """The actions as float32.

        Raises:
            ValueError: a wrong shape, or a component that is not finite.
        """
        return check_actions(actions, shape, names)

    def write(self, values: np.ndarray, arrays: Sequence[wp.array]) -> None:
        """Write ``values`` into the arrays, row by row."""
        start = 0
        for array in arrays:
            array.assign(values[start : start + len(array)])
            start += len(array)

    def split(self, observation: np.ndarray, layout: ObservationLayout) -> dict[str, np.ndarray]:
        """A flat observation by name, copies along the last axis."""
        return layout.split(observation)

    def finite(self, values: np.ndarray) -> np.ndarray:
        """``values`` with zeros for what is not finite."""
        return np.nan_to_num(values, posinf=0.0, neginf=0.0)

    def shown(self, values: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
        """``values`` as callers get them: numbers in double precision, as in Gymnasium's own vectors; a copy."""
        values = values.astype(np.float64 if values.ndim == 1 and values.dtype.kind == "f" else values.dtype)
        if mask is not None:
            values[~mask] = None if values.dtype == object else 0
        return values

    def repeated(self, mask: np.ndarray | None, num_envs: int, count: int) -> np.ndarray:
        """``count`` copies of a mask, or of all True."""
        return np.ones((count, num_envs), bool) if mask is None else np.tile(mask, (count, 1))

    def from_host(self, mask: np.ndarray) -> np.ndarray:
        """The mask itself."""
        return mask

    def may_hold(self, mask: np.ndarray) -> bool:
        """Whether ``mask`` is True anywhere."""
        return bool(mask.any())

    def rows(self, values: Any, mask: np.ndarray) -> np.ndarray:
        """An array of objects: the observation of every environment in ``mask``, None elsewhere."""
        rows = np.full(len(mask), None, object)
        for env in np.flatnonzero(mask):
            named = isinstance(values, dict)
            rows[env] = {name: value[env].copy() for name, value in values.items()} if named else values[env].copy()
        return rows

    def begin(self) -> None:
        """Reading an array waits for the device: nothing to do."""

    def end(self) -> None:
        """Reading an array waits for the device: nothing to do."""


class TorchArrays:
    """Tensors on the environment's own device: nothing crosses the bus, and the host never waits."""

    name = "torch"

    def __init__(self, device: str) -> None:
        """Find torch.

        Args:
            device: Warp device.

        Raises:
            ImportError: torch is not installed.
            ValueError: torch cannot use the device.
        """
        try:
            import torch
        except ImportError as error:
            message = "array_api='torch' needs torch; install it with: pip install 'piavatar-envs[train]'"
            raise ImportError(message) from error
        self._torch, self._device = torch, wp.get_device(device)
        self.device = torch.device(wp.device_to_torch(self._device))
        if self._device.is_cuda and not torch.cuda.is_available():
            raise ValueError(f"device={device!r} is known to Warp but not to this torch, which has no CUDA")
        self._views: dict[int, tuple[wp.array, Any]] = {}
        self._streams: dict[int, wp.Stream] = {}

    def view(self, array: wp.array) -> Any:
        """A tensor on the memory of ``array``, made once: it is overwritten by the next launch."""
        if id(array) not in self._views:
            # the array is kept, so that no other one can get its id
            # a tensor made in inference mode, where some learners step, could not be written to outside of it
            with self._torch.inference_mode(False):
                self._views[id(array)] = array, wp.to_torch(array, requires_grad=False)
        return self._views[id(array)][1]

    def read(self, arrays: Sequence[wp.array]) -> Any:
        """The arrays one after the other, a copy."""
        if len(arrays) == 1:
            return self.view(arrays[0]).clone()
        return self._torch.cat([self.view(array) for array in arrays])

    def actions(self, actions: Any, shape: tuple[int, ...], names: Sequence[str]) -> Any:
        """The actions as a tensor on the device.

        Values of a tensor are not looked at, the host would have to wait for them: a component that is not finite
        acts as zero and ends its environment with ``failure="action"``. NumPy arrays are checked as ever.

        Raises:
            ValueError: a wrong shape, type or device, or a component of a NumPy array that is not finite.
        """
        torch = self._torch
        if not isinstance(actions, torch.Tensor):
            return torch.tensor(check_actions(actions, shape, names), device=self.device)
        if tuple(actions.shape) != shape:
            raise ValueError(f"action has shape {tuple(actions.shape)}, expected {shape}")
        if actions.dtype != torch.float32:
            raise ValueError(f"action is of type {actions.dtype}, expected torch.float32; use actions.float()")
        if actions.device != self.device:
            raise ValueError(f"action is on {actions.device}, the environments are on {self.device}; use actions.to()")
        return actions.detach()

    def write(self, values: Any, arrays: Sequence[wp.array]) -> None:
        """Write ``values`` into the arrays, row by row."""
        start = 0
        for array in arrays:
            self.view(array).copy_(values[start : start + len(array)])
            start += len(array)

    def split(self, observation: Any, layout: ObservationLayout) -> dict[str, Any]:
        """A flat observation by name, copies along the last axis."""
        return {name: observation[..., term.slice].clone() for name, term in layout.items()}

    def finite(self, values: Any) -> Any:
        """``values`` with zeros for what is not finite."""
        return self._torch.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)

    def shown(self, values: Any, mask: Any | None = None) -> Any:
        """``values`` as callers get them; with a mask a copy."""
        if mask is None:
            return values
        return values.masked_fill(~mask.reshape(-1, *[1] * (values.dim() - 1)), 0)

    def repeated(self, mask: Any | None, num_envs: int, count: int) -> Any:
        """``count`` copies of a mask, or of all True."""
        if mask is None:
            return self._torch.ones((count, num_envs), dtype=self._torch.bool, device=self.device)
        return mask.expand(count, num_envs).clone()

    def from_host(self, mask: np.ndarray) -> Any:
        """The mask as a tensor on the device."""
        return self._torch.tensor(mask, device=self.device)

    def may_hold(self, mask: Any) -> bool:
        """True: the host would have to wait to know."""
        return True

    def rows(self, values: Any, mask: Any) -> Any:
        """All of ``values``."""
        return values

    def begin(self) -> None:
        """Warp's stream waits for torch's; the host does not."""
        if self._device.is_cuda:
            self._device.stream.wait_stream(self._torch_stream())

    def end(self) -> None:
        """Torch's stream waits for Warp's; the host does not."""
        if self._device.is_cuda:
            self._torch_stream().wait_stream(self._device.stream)

    def _torch_stream(self) -> wp.Stream:
        """Torch's current stream, which callers may change, as Warp knows it."""
        stream = self._torch.cuda.current_stream(self.device)
        if stream.cuda_stream not in self._streams:
            self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
        return self._streams[stream.cuda_stream]


def find_array_api(name: str, device: str) -> ArrayApi:
    """The kind of arrays called ``name``.

    Raises:
        ImportError: torch is asked for and not installed.
        ValueError: an unknown name, or a device that torch cannot use.
    """
    if name not in ARRAY_APIS:
        raise ValueError(f"array_api={name!r} is not known; use one of {', '.join(ARRAY_APIS)}")
    return NumpyArrays() if name == "numpy" else TorchArrays(device)
