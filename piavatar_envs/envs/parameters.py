"""The term of drawn parameters: with ``observe_parameters`` an agent observes every number that the episode has drawn.

Parameters are stored once per reset, normalised to [-1, 1] over the range that they are drawn from. The order is: the
world's, those of the agent's own avatar, those of the others (counted from the agent), the task's, and the episode's
clock, which dates what is drawn for later. Under torque control an avatar's own parameters end with the current root
assistance, which may change at any time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import warp as wp

from piavatar_envs.avatar.torque_control.controller import TorqueController
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.episodes import EpisodeArrays
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.world import Simulation

wp.set_module_options({"enable_backward": False})

#: Name of the term.
PARAMETERS = "parameters"
ASSIST = Parameter("root_assist", "-", 0.0, 1.0, "current external support of the pelvis")
CLOCK = Parameter("clock", "-", 0.0, 1.0, "time since the reset over episode_seconds")


class Drawn(NamedTuple):
    """The array that holds the number of a :class:`Parameter`.

    Attributes:
        values: of every environment, shape ``(num_envs,)``, float or int.
        scale: factor from ``values`` to the unit of the parameter.
    """

    values: wp.array
    scale: float = 1.0


def component(vectors: wp.array, index: int) -> wp.array:
    """Return a view of one component of an array of vectors ``(num_envs,)``; the array must outlive it."""
    return wp.array(
        ptr=vectors.ptr + 4 * index,
        dtype=wp.float32,
        shape=vectors.shape,
        strides=vectors.strides,
        device=vectors.device,
    )


class Parameters:
    """The term :data:`PARAMETERS` of a batch.

    Attributes:
        term: name, size and meaning.
        values: normalised parameters, shape ``(num_envs, columns)``: the world's, those of each avatar, the task's.
            None before :meth:`connect`.
    """

    def __init__(self, simulation: Simulation, task: Sequence[Parameter]) -> None:
        """Collect the parameters of the world, of its avatars and of the task that have a range."""
        self.simulation, self._drawn = simulation, task
        world, own = simulation.randomization.parameters()
        shape = [parameter for parameter, _ in simulation.shapes.drawn(0).values()]
        settings = [ASSIST] if isinstance(simulation.controllers[0], TorqueController) else []
        own = *own, *shape, *settings
        self._world, self._own, self._task = (_ranging(group) for group in (world, own, task))
        others = [
            replace(parameter, name=f"other_{index}_{parameter.name}")
            for index in range(len(simulation.avatars) - 1)
            for parameter in self._own
        ]
        seen = (*self._world, *self._own, *others, *self._task, CLOCK)
        self.term = ObservationTerm(
            PARAMETERS, len(seen), "-", "-", f"{_meaning(settings)}: {_listed(seen)}", parameters=seen
        )
        self.values: wp.array | None = None

    def connect(self, num_envs: int, values: Sequence[Drawn]) -> None:
        """Find the arrays of all parameters, once the task has allocated its own."""
        simulation, count = self.simulation, len(self.simulation.avatars)
        random, device = simulation.randomization, simulation.device
        sources = [(parameter, Drawn(random.column(parameter.name))) for parameter in self._world]
        for index in range(count):
            known = {name: column for name, (_, column) in simulation.shapes.drawn(index).items()}
            if ASSIST in self._own:
                known[ASSIST.name] = simulation.controllers[index].assist
            for parameter in self._own:
                column = known.get(parameter.name)
                sources.append((parameter, Drawn(random.column(parameter.name, index) if column is None else column)))
        of_task = zip(self._drawn, values, strict=True)
        sources += [(parameter, drawn) for parameter, drawn in of_task if parameter in self._task]
        self._sources = sources
        self.values = wp.zeros((num_envs, max(1, len(sources))), dtype=float, device=device)
        self._everywhere = wp.full(num_envs, True, dtype=wp.bool, device=device)
        self._columns = [wp.array(self._columns_of(agent, count), dtype=int, device=device) for agent in range(count)]

    def _columns_of(self, agent: int, count: int) -> np.ndarray:
        """Return the columns of ``values`` in the order in which ``agent`` observes them."""
        world, own, task = len(self._world), len(self._own), len(self._task)
        bodies = [world + (agent + index) % count * own + np.arange(own) for index in range(count)]
        return np.concatenate([np.arange(world), *bodies, world + count * own + np.arange(task)]).astype(np.int32)

    def record_reset(self, graph: LaunchGraph, mask: wp.array) -> None:
        """Record the launches that normalise the parameters which the masked environments have drawn."""
        for column, (parameter, _) in enumerate(self._sources):
            if parameter != ASSIST:
                self._record(graph, mask, column)

    def record_settings(self, graph: LaunchGraph) -> None:
        """Record the launch that normalises the root assistance, which may have changed in any environment."""
        for column, (parameter, _) in enumerate(self._sources):
            if parameter == ASSIST:
                self._record(graph, self._everywhere, column)

    def _record(self, graph: LaunchGraph, mask: wp.array, column: int) -> None:
        """Record the launch that normalises one column of the masked environments."""
        parameter, drawn = self._sources[column]
        graph.launch(
            normalize if drawn.values.dtype is wp.float32 else normalize_count,
            len(mask),
            [mask, drawn.values, drawn.scale, parameter.low, parameter.high, int(parameter.log), column],
            [self.values],
        )

    def record_observe(self, graph: LaunchGraph, env: EpisodeArrays, agent: int) -> None:
        """Record the launch that writes the term for ``agent`` and changes nothing else."""
        graph.launch(
            observe_parameters,
            (env.num_envs, self.term.size),
            [
                self.values, self._columns[agent], agent, env.layout[PARAMETERS].slice.start, env.step_count,
                env.head_start, env.max_steps,
            ],
            [env.observation],
        )  # fmt: skip

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint by name."""
        return {"parameters": self.values}


def _ranging(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Return the parameters that have a range; the others are not drawn."""
    return tuple(parameter for parameter in parameters if parameter.low < parameter.high)


def _meaning(settings: Sequence[Parameter]) -> str:
    """Describe the term in a few words."""
    return "drawn parameters of the episode" + ", and the root assistance" * bool(settings)


def _listed(parameters: Sequence[Parameter]) -> str:
    """List names, ranges and units in one line."""
    lines = []
    for p in parameters:
        unit = "" if p.unit == "-" else f" {p.unit}"
        lines.append(f"{p.name} ({p.low:.4g} to {p.high:.4g}{unit}{', log' if p.log else ''})")
    return "; ".join(lines)


@wp.func
def normalized(value: float, low: float, high: float, log: int):
    """Map a parameter from its range to [-1, 1]."""
    share = (value - low) / (high - low)
    if log != 0:
        share = wp.log(value / low) / wp.log(high / low)
    return wp.clamp(2.0 * share - 1.0, -1.0, 1.0)


@wp.kernel
def normalize(
    mask: wp.array(dtype=wp.bool),
    drawn: wp.array(dtype=float),
    scale: float,
    low: float,
    high: float,
    log: int,
    column: int,
    # out
    values: wp.array2d(dtype=float),
):
    """Normalise a parameter of the masked environments; over ``(num_envs,)``."""
    e = wp.tid()
    if mask[e]:
        values[e, column] = normalized(scale * drawn[e], low, high, log)


@wp.kernel
def normalize_count(
    mask: wp.array(dtype=wp.bool),
    drawn: wp.array(dtype=int),
    scale: float,
    low: float,
    high: float,
    log: int,
    column: int,
    # out
    values: wp.array2d(dtype=float),
):
    """Normalise a whole number of the masked environments; over ``(num_envs,)``."""
    e = wp.tid()
    if mask[e]:
        values[e, column] = normalized(scale * float(drawn[e]), low, high, log)


@wp.kernel
def observe_parameters(
    values: wp.array2d(dtype=float),
    columns: wp.array(dtype=int),
    agent: int,
    start: int,
    step_count: wp.array(dtype=int),
    head_start: wp.array(dtype=int),
    max_steps: int,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the parameters of ``columns``, then the clock; over ``(num_envs, components)``."""
    e, n = wp.tid()
    if n < columns.shape[0]:
        observation[e, agent, start + n] = values[e, columns[n]]
    else:
        time = float(step_count[e] + head_start[e]) / float(max_steps)
        observation[e, agent, start + n] = 2.0 * wp.min(time, 1.0) - 1.0
