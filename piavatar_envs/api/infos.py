"""What ``info`` says of an agent: names, and where the numbers are. One list for single environments and for many."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import warp as wp

from piavatar_envs.api.arrays import Array, ArrayApi
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.task import Task
from piavatar_envs.mpm.types import failure_name

#: Reads an array of all environments, given which one it is of a batch.
Reader = Callable[[Callable[[BatchEnv], wp.array]], Array]


def standing(read: Reader, api: ArrayApi, agent: int) -> dict[str, Array]:
    """What is known of an agent at any time, by name; a row an environment. ``failure`` are bits ``FAILURE_*``."""

    def drive(name: str) -> Array:
        return read(lambda batch: getattr(batch.simulation.avatars[agent].state, name))

    return {
        "success": read(lambda batch: batch.success)[:, agent],
        "failure": read(lambda batch: batch.failure),
        # a failed environment may hold values that are not finite; what leaves the suite never does
        "root_force": api.finite(drive("wrench_force")),
        "root_torque": api.finite(drive("wrench_torque")),
        "root_let_go": drive("let_go") != 0,
    }


def outcome(read: Reader, task: Task, agent: int) -> dict[str, Any]:
    """What the last step was worth: the task's metrics, the terms of reward and cost; a row an environment."""

    def named(names: tuple[str, ...], array_of: Callable[[BatchEnv], wp.array]) -> dict[str, Array]:
        # without names there is a column that means nothing
        values = read(array_of)[:, agent] if names else None
        return {name: values[:, index] for index, name in enumerate(names)}

    found: dict[str, Any] = named(task.metric_names, lambda batch: batch.metrics)
    found["reward_terms"] = named(task.reward_names, lambda batch: batch.terms)
    if task.costs:
        found["cost"] = read(lambda batch: batch.cost)[:, agent]
        found["cost_terms"] = named(task.cost_names, lambda batch: batch.cost_terms)
    return found


def vector_format(values: Mapping[str, Any], api: ArrayApi, num_envs: int, mask: Array | None = None) -> dict[str, Any]:
    """Values by name as Gymnasium's vectors give them: zeros outside ``mask``, which stands beside each as ``_name``.

    Failures become names (None for none) where arrays are NumPy's; a tensor keeps the bits.
    """
    masks = iter(api.repeated(mask, num_envs, _count(values)))

    def put(values: Mapping[str, Any]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in values.items():
            if isinstance(value, Mapping):
                found[name] = put(value)
            else:
                found[name] = api.shown(failure_names(value) if name == "failure" else value, mask)
            found[f"_{name}"] = next(masks)
        return found

    return put(values)


def single_infos(infos: Mapping[str, Any], num_envs: int) -> list[dict[str, Any]]:
    """What :func:`vector_format` gave as one dictionary an environment, with what its masks say it has."""
    rows: list[dict[str, Any]] = [{} for _ in range(num_envs)]
    for name, mask in infos.items():
        if not name.startswith("_") or name[1:] not in infos:
            continue
        values = infos[name[1:]]
        if isinstance(values, dict):
            values = single_infos(values, num_envs)
        elif values.ndim == 1:
            values = values.tolist()
        for env, held in enumerate(mask.tolist()):
            if held:
                rows[env][name[1:]] = values[env]
    return rows


def failure_names(bits: Array) -> Array:
    """Names of failures, None for none; tensors stay as they are: the host would have to wait for them."""
    if not isinstance(bits, np.ndarray):
        return bits
    names = np.full(len(bits), None, object)
    for env in np.flatnonzero(bits):
        names[env] = failure_name(int(bits[env]))
    return names


def _count(values: Mapping[str, Any]) -> int:
    """Names in a mapping and in those within."""
    return sum(1 + (_count(value) if isinstance(value, Mapping) else 0) for value in values.values())
