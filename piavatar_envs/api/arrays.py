"""Arrays of the views: NumPy arrays or torch tensors, always copies of the arrays on the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import warp as wp

from piavatar_envs.core.extras import missing
from piavatar_envs.envs.actions import check_actions
from piavatar_envs.envs.observations import ObservationLayout

#: An array of the chosen kind: ``numpy.ndarray`` or ``torch.Tensor``.
Array = Any

ARRAY_APIS = ("numpy", "torch")


class ArrayApi(Protocol):
    """Conversion between Warp's arrays and arrays of one kind.

    The arrays of a host's groups are joined along the first dimension, the environment.
    """

    name: str
    device: Any  # in the words of the library

    def read(self, arrays: Sequence[wp.array]) -> Array:
        """Copy the arrays, one after the other."""
        ...

    def actions(self, actions: Any, shape: tuple[int, ...], names: Sequence[str]) -> Array:
        """Check a caller's actions and convert them; nothing has changed if they are refused."""
        ...

    def vectors(self, name: str, values: Any, num_envs: int) -> Array:
        """Check a caller's vectors, one for all environments or one each, and convert them: ``(num_envs, 3)``."""
        ...

    def mask(self, envs: Any, num_envs: int) -> Array:
        """Check a caller's choice of environments, and convert it to a mask ``(num_envs,)`` bool."""
        ...

    def shares(self, name: str, weights: Any, shape: tuple[int, int]) -> Array:
        """Check a caller's weights, one row for all environments or one each, and sum their shares up: ``shape``."""
        ...

    def write(self, values: Array, arrays: Sequence[wp.array]) -> None:
        """Write checked ``values`` into the arrays, row by row."""
        ...

    def split(self, observation: Array, layout: ObservationLayout) -> dict[str, Array]:
        """Split a flat observation by name, into copies along the last axis."""
        ...

    def finite(self, values: Array) -> Array:
        """Replace numbers that are not finite by zeros; may return the same array."""
        ...

    def shown(self, values: Array, mask: Array | None = None) -> Array:
        """Convert ``values`` (a row per environment) to the type that views return; zeros outside ``mask``."""
        ...

    def repeated(self, mask: Array | None, num_envs: int, count: int) -> Array:
        """Copy a mask, or all True if there is none, ``count`` times: shape ``(count, num_envs)``."""
        ...

    def from_host(self, mask: np.ndarray) -> Array:
        """Convert a mask of the host to an array of this kind."""
        ...

    def may_hold(self, mask: Array) -> bool:
        """Return False if ``mask`` is False everywhere and reading it does not make the host wait."""
        ...

    def rows(self, values: Any, mask: Array) -> Array:
        """Select the observations of the environments in ``mask``: as objects, or as a whole batch of tensors."""
        ...

    def begin(self) -> None:
        """Order the launches that follow after pending work of the caller's library."""
        ...

    def end(self) -> None:
        """Order later work of the caller's library after the launches."""
        ...


def check_vectors(name: str, values: Any, num_envs: int) -> np.ndarray:
    """Return vectors as float32, ``(num_envs, 3)``, from one for all environments or one each.

    Raises:
        ValueError: no array of real numbers, a wrong shape, or a component that is not finite.
    """
    shapes = f"use shape (3,) or ({num_envs}, 3)"
    try:
        with np.errstate(over="ignore"):  # a value too large for float32 becomes infinite and is refused below
            vectors = np.asarray(values, np.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is a {type(values).__name__} ({error}); {shapes} of real numbers") from None
    if vectors.shape not in ((3,), (num_envs, 3)):
        raise ValueError(f"{name} has shape {vectors.shape}; {shapes}")
    if not np.isfinite(vectors).all():
        index = np.argwhere(~np.isfinite(vectors))[0].tolist()
        raise ValueError(f"{name}{index} is {vectors[tuple(index)]}; it must be finite")
    return np.broadcast_to(vectors, (num_envs, 3)).copy()


def check_envs(envs: Any, num_envs: int) -> np.ndarray:
    """Return the mask ``(num_envs,)`` bool of environments given as a mask, as indices, or as None for all.

    Raises:
        ValueError: a wrong shape or type, or there is no such environment.
    """
    if envs is None:
        return np.ones(num_envs, bool)
    given = np.atleast_1d(np.asarray(envs))
    if given.dtype == bool and given.shape == (num_envs,):
        return given
    if given.ndim != 1 or (given.size and given.dtype.kind not in "iu"):
        what = f"has shape {given.shape} and type {given.dtype}"
        raise ValueError(f"envs {what}; use a mask ({num_envs},) bool, or indices of environments")
    unknown = given[(given < 0) | (given >= num_envs)]
    if unknown.size:
        raise ValueError(f"envs={unknown.tolist()}: there are num_envs={num_envs}; use 0 to {num_envs - 1}")
    mask = np.zeros(num_envs, bool)
    mask[given.astype(int)] = True
    return mask


def check_weights(name: str, weights: Any, shape: tuple[int, int]) -> np.ndarray:
    """Return weights as float64, ``(num_envs, count)`` or ``(1, count)`` for all environments.

    Raises:
        ValueError: no array of real numbers, a wrong shape, or weights that are negative, not finite or all zero.
    """
    count = shape[1]
    shapes = f"use shape ({count},) or {shape}"
    try:
        rows = np.asarray(weights, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is a {type(weights).__name__} ({error}); {shapes} of real numbers") from None
    if rows.shape not in ((count,), shape):
        raise ValueError(f"{name} has shape {rows.shape}; {shapes}")
    bad = ~np.isfinite(rows) | (rows < 0.0)
    if bad.any():
        index = np.argwhere(bad)[0].tolist()
        raise ValueError(f"{name}{index} is {rows[tuple(index)]}; it must be finite and >= 0")
    rows = rows.reshape(-1, count)
    if not rows.any(axis=1).all():
        raise ValueError(f"{name} are all zero; give one of them a weight, or None to draw all alike")
    return rows


class NumpyArrays:
    """Arrays on the host, whatever the device."""

    name = "numpy"
    device = "cpu"

    def read(self, arrays: Sequence[wp.array]) -> np.ndarray:
        """Copy the arrays, one after the other."""
        return np.concatenate([array.numpy() for array in arrays])

    def actions(self, actions: Any, shape: tuple[int, ...], names: Sequence[str]) -> np.ndarray:
        """Convert the actions to float32.

        Raises:
            ValueError: a wrong shape, or a component that is not finite.
        """
        return check_actions(actions, shape, names)

    def vectors(self, name: str, values: Any, num_envs: int) -> np.ndarray:
        """Convert vectors to float32.

        Raises:
            ValueError: a wrong shape or type, or a component that is not finite.
        """
        return check_vectors(name, values, num_envs)

    def mask(self, envs: Any, num_envs: int) -> np.ndarray:
        """Convert a mask, indices or None (all environments) to a mask.

        Raises:
            ValueError: a wrong shape or type, or there is no such environment.
        """
        return check_envs(envs, num_envs)

    def shares(self, name: str, weights: Any, shape: tuple[int, int]) -> np.ndarray:
        """Convert weights to cumulative shares; zeros for None.

        Raises:
            ValueError: see :func:`check_weights`.
        """
        if weights is None:
            return np.zeros(shape, np.float32)
        rows = check_weights(name, weights, shape)
        sums = (rows / rows.max(axis=1, keepdims=True)).cumsum(axis=1)
        return np.broadcast_to((sums / sums[:, -1:]).astype(np.float32), shape)

    def write(self, values: np.ndarray, arrays: Sequence[wp.array]) -> None:
        """Write ``values`` into the arrays, row by row."""
        start = 0
        for array in arrays:
            array.assign(values[start : start + len(array)])
            start += len(array)

    def split(self, observation: np.ndarray, layout: ObservationLayout) -> dict[str, np.ndarray]:
        """Split a flat observation by name, into copies along the last axis."""
        return layout.split(observation)

    def finite(self, values: np.ndarray) -> np.ndarray:
        """Replace numbers that are not finite by zeros."""
        return np.nan_to_num(values, posinf=0.0, neginf=0.0)

    def shown(self, values: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
        """Copy ``values``, numbers in 64 bits as in Gymnasium's own vectors."""
        wide = {"f": np.float64, "i": np.int64} if values.ndim == 1 else {}
        values = values.astype(wide.get(values.dtype.kind, values.dtype))
        if mask is not None:
            values[~mask] = 0
        return values

    def repeated(self, mask: np.ndarray | None, num_envs: int, count: int) -> np.ndarray:
        """Copy a mask, or all True, ``count`` times."""
        return np.ones((count, num_envs), bool) if mask is None else np.tile(mask, (count, 1))

    def from_host(self, mask: np.ndarray) -> np.ndarray:
        """Return the mask."""
        return mask

    def may_hold(self, mask: np.ndarray) -> bool:
        """Return whether ``mask`` is True anywhere."""
        return bool(mask.any())

    def rows(self, values: Any, mask: np.ndarray) -> np.ndarray:
        """Return an array of objects: the observation of every environment in ``mask``, None elsewhere."""
        rows = np.full(len(mask), None, object)
        for env in np.flatnonzero(mask):
            named = isinstance(values, dict)
            rows[env] = {name: value[env].copy() for name, value in values.items()} if named else values[env].copy()
        return rows

    def begin(self) -> None:
        """Do nothing: reading an array waits for the device."""

    def end(self) -> None:
        """Do nothing: reading an array waits for the device."""


class TorchArrays:
    """Tensors on the environments' device, without copies to the host and without waiting."""

    name = "torch"

    def __init__(self, device: str) -> None:
        """Import torch.

        Args:
            device: Warp device.

        Raises:
            ImportError: torch is not installed.
            ValueError: torch cannot use the device.
        """
        try:
            import torch
        except ImportError as error:
            raise missing("array_api='torch'", "torch", "train") from error
        self._torch, self._device = torch, wp.get_device(device)
        self.device = torch.device(wp.device_to_torch(self._device))
        if self._device.is_cuda and not torch.cuda.is_available():
            raise ValueError(f"device={device!r} is a device of Warp, but this torch has no CUDA")
        self._views: dict[int, tuple[wp.array, Any]] = {}
        self._streams: dict[int, wp.Stream] = {}

    def view(self, array: wp.array) -> Any:
        """Return a tensor on the memory of ``array``, made once; the next launch overwrites it."""
        if id(array) not in self._views:
            # the array is kept, because its id could be reused; a tensor made in inference mode, in which some
            # learners step, could not be written to outside of it
            with self._torch.inference_mode(False):
                self._views[id(array)] = array, wp.to_torch(array, requires_grad=False)
        return self._views[id(array)][1]

    def read(self, arrays: Sequence[wp.array]) -> Any:
        """Copy the arrays, one after the other."""
        if len(arrays) == 1:
            return self.view(arrays[0]).clone()
        return self._torch.cat([self.view(array) for array in arrays])

    def actions(self, actions: Any, shape: tuple[int, ...], names: Sequence[str]) -> Any:
        """Convert the actions to a tensor on the device.

        The values of a tensor are not checked, because the host would have to wait for them: a component that is not
        finite acts as zero and ends its environment with ``failure="action"``. NumPy arrays are checked.

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

    def vectors(self, name: str, values: Any, num_envs: int) -> Any:
        """Convert vectors to a tensor on the device; the values of a tensor are not checked.

        Raises:
            ValueError: a wrong shape, type or device, or a component of a NumPy array that is not finite.
        """
        if not isinstance(values, self._torch.Tensor):
            return self._torch.tensor(check_vectors(name, values, num_envs), device=self.device)
        if tuple(values.shape) not in ((3,), (num_envs, 3)):
            raise ValueError(f"{name} has shape {tuple(values.shape)}; use (3,) or ({num_envs}, 3)")
        if values.dtype != self._torch.float32 or values.device != self.device:
            raise ValueError(
                f"{name} is of type {values.dtype} on {values.device}; use torch.float32 on {self.device}, or NumPy"
            )
        return values.detach().expand(num_envs, 3)

    def mask(self, envs: Any, num_envs: int) -> Any:
        """Convert a mask, indices or None (all environments) to a mask; the host waits for a tensor of indices.

        Raises:
            ValueError: a wrong shape, type or device, or there is no such environment.
        """
        torch = self._torch
        if not isinstance(envs, torch.Tensor):
            return self.from_host(check_envs(envs, num_envs))
        if envs.dtype != torch.bool:
            return self.from_host(check_envs(envs.cpu().numpy(), num_envs))
        if tuple(envs.shape) != (num_envs,) or envs.device != self.device:
            raise ValueError(
                f"envs is a mask of shape {tuple(envs.shape)} on {envs.device}; use ({num_envs},) on {self.device}"
            )
        return envs

    def shares(self, name: str, weights: Any, shape: tuple[int, int]) -> Any:
        """Convert weights to cumulative shares on the device, zeros for None; the values of a tensor are not checked.

        Raises:
            ValueError: a wrong shape or device, or see :func:`check_weights`.
        """
        if weights is None:
            return self._torch.zeros(shape, device=self.device)
        if not isinstance(weights, self._torch.Tensor):
            weights = self._torch.tensor(check_weights(name, weights, shape), device=self.device)
        elif tuple(weights.shape) not in ((shape[1],), shape):
            raise ValueError(f"{name} has shape {tuple(weights.shape)}; use ({shape[1]},) or {shape}")
        elif weights.device != self.device:
            raise ValueError(f"{name} is on {weights.device}, the environments are on {self.device}")
        sums = weights.double().reshape(-1, shape[1]).cumsum(dim=1)
        return (sums / sums[:, -1:]).float().expand(shape)

    def write(self, values: Any, arrays: Sequence[wp.array]) -> None:
        """Write ``values`` into the arrays, row by row."""
        start = 0
        for array in arrays:
            self.view(array).copy_(values[start : start + len(array)])
            start += len(array)

    def split(self, observation: Any, layout: ObservationLayout) -> dict[str, Any]:
        """Split a flat observation by name, into copies along the last axis."""
        return {name: observation[..., term.slice].clone() for name, term in layout.items()}

    def finite(self, values: Any) -> Any:
        """Replace numbers that are not finite by zeros."""
        return self._torch.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)

    def shown(self, values: Any, mask: Any | None = None) -> Any:
        """Return ``values``; with a mask a copy."""
        if mask is None:
            return values
        return values.masked_fill(~mask.reshape(-1, *[1] * (values.dim() - 1)), 0)

    def repeated(self, mask: Any | None, num_envs: int, count: int) -> Any:
        """Copy a mask, or all True, ``count`` times."""
        if mask is None:
            return self._torch.ones((count, num_envs), dtype=self._torch.bool, device=self.device)
        return mask.expand(count, num_envs).clone()

    def from_host(self, mask: np.ndarray) -> Any:
        """Copy the mask to the device."""
        return self._torch.tensor(mask, device=self.device)

    def may_hold(self, mask: Any) -> bool:
        """Return True, because the host would have to wait for the mask."""
        return True

    def rows(self, values: Any, mask: Any) -> Any:
        """Return all of ``values``."""
        return values

    def begin(self) -> None:
        """Let Warp's stream wait for torch's, without the host."""
        if self._device.is_cuda:
            with wp.ScopedDevice(self._device):  # torch's default stream has the same handle on every GPU
                self._device.stream.wait_stream(self._torch_stream())

    def end(self) -> None:
        """Let torch's stream wait for Warp's, without the host."""
        if self._device.is_cuda:
            with wp.ScopedDevice(self._device):
                self._torch_stream().wait_stream(self._device.stream)

    def _torch_stream(self) -> wp.Stream:
        """Return torch's current stream, which callers may change, as a stream of Warp."""
        stream = self._torch.cuda.current_stream(self.device)
        if stream.cuda_stream not in self._streams:
            self._streams[stream.cuda_stream] = wp.stream_from_torch(stream)
        return self._streams[stream.cuda_stream]


def find_array_api(name: str, device: str) -> ArrayApi:
    """Return the kind of arrays called ``name``.

    Raises:
        ImportError: torch is asked for and not installed.
        ValueError: an unknown name, or a device that torch cannot use.
    """
    if name not in ARRAY_APIS:
        raise ValueError(f"array_api={name!r} is not known; use one of {', '.join(ARRAY_APIS)}")
    return NumpyArrays() if name == "numpy" else TorchArrays(device)
