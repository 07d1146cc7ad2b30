"""Throws of a prop from the host: between two control steps it is placed anew, with a velocity and a mass."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.sim.props import PropState

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from piavatar_envs.sim.world import Simulation


class Thrower:
    """Throws one prop of a world."""

    def __init__(self, simulation: Simulation, name: str) -> None:
        """Record the launches of a throw.

        Args:
            simulation: the world.
            name: of the prop.

        Raises:
            ValueError: there is no such prop.
        """
        props, n, device = simulation.props, simulation.num_envs, simulation.device
        self._simulation, self._index = simulation, props.index(name)
        self._start = PropState.allocate(n, len(props), device)
        self._mask = wp.zeros(n, dtype=wp.bool, device=device)
        self._graph = LaunchGraph(device)
        props.record_density(self._graph, self._mask, self._index)
        props.record_place(self._graph, simulation.state, self._mask, self._index, self._start)
        props.record_tracking(self._graph, simulation.state)

    def throw(self, env: int, position: ArrayLike, velocity: ArrayLike, mass: float) -> None:
        """Throw the prop in environment ``env``, from wherever it is.

        Args:
            env: index of the environment.
            position: of its centre [m], shape ``(3,)``.
            velocity: of its centre [m/s], shape ``(3,)``.
            mass: its new mass, which it keeps [kg].
        """
        props = self._simulation.props
        for array, row in ((self._start.position, position), (self._start.velocity, velocity)):
            values = array.numpy().copy()
            values[env, self._index] = row
            array.assign(values)
        density = props.density.numpy().copy()
        density[env, self._index] = mass / props.volume[self._index]
        props.density.assign(density)
        mask = np.zeros(self._simulation.num_envs, bool)
        mask[env] = True
        self._mask.assign(mask)
        self._graph.run()
