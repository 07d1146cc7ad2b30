"""Sheets of cloth in MPM without a body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from piavatar_envs.cloth.garment import Garment
from piavatar_envs.cloth.shell import Holds, Shell, ShellMatter
from piavatar_envs.cloth.types import ClothSettings
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import Collider
from piavatar_envs.mpm.memory import allocate
from piavatar_envs.mpm.model import Fields, MaterialPoints, build_model, make_grid
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep
from piavatar_envs.sim.scene import join

CONTROL_DT = 1.0 / 30.0


class ShellRun:
    """Cloth in MPM, each garment in a velocity field of its own, and its step; held vertices stay where they are.

    Flesh may lie beneath, in the first field.
    """

    def __init__(
        self,
        *garments: Garment,
        dx: float = 0.026,
        margin: float = 0.4,
        num_envs: int = 1,
        substeps: int | None = None,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        colliders: Sequence[Collider] = (),
        device: str = "cpu",
        rows: int = 1,
        flesh: np.ndarray | None = None,
        **settings,
    ) -> None:
        matter = ShellMatter.of(garments)
        flesh = np.zeros((0, 3)) if flesh is None else flesh
        below, places = len(flesh), np.concatenate([flesh, *(garment.draped for garment in garments)])
        points, field, density = matter.points(dx), matter.garment, matter.density(dx)
        if below:
            points = join([MaterialPoints.uniform(np.full(below, (dx / 2) ** 3)), points], 1)
            field = np.concatenate([np.zeros(below, int), 1 + field])
            density = np.append(1000.0, density)
        fields = Fields(subject=tuple(range(field.max() + 1)), friction=0.3, density=density)
        self.model = build_model(
            replace(points, field=field), make_grid(places.min(axis=0) - margin, places.max(axis=0) + margin, dx),
            num_envs=num_envs,
            device=device, control_dt=CONTROL_DT, num_substeps=substeps, gravity=gravity, colliders=colliders,
            fields=fields,
        )  # fmt: skip
        self.state, self.scratch = allocate(self.model)
        x = self.state.x.numpy()
        x[:, :below] = flesh
        self.state.x.assign(x)
        held = np.concatenate([garment.draped[garment.held.vertices] for garment in garments])
        holds = Holds.fixed(held, points.num_particles)
        world = self.model, self.state, self.scratch, below
        self.cloth = Shell(garments, matter, holds, *world, settings=ClothSettings(**settings), rows=rows)
        self._reset = LaunchGraph(device)
        self.cloth.record_reset(self._reset, wp.array(np.ones(num_envs, bool), dtype=wp.bool, device=device))
        self._reset.run()
        self.graph = LaunchGraph(device)
        record_begin(self.graph, *world[:3])
        for index in range(self.model.num_substeps):
            self.cloth.record_before_substep(self.graph)
            record_substep(self.graph, *world[:3], index)
        record_end(self.graph, *world[:3])
        self.cloth.record_places(self.graph)

    def steps(self, count: int) -> ShellRun:
        """Take control steps."""
        for _ in range(count):
            self.graph.run()
        return self

    def get(self, name: str = "x", e: int = 0) -> np.ndarray:
        """Return positions or velocities of the vertices in double precision."""
        return getattr(self.cloth.state, name).numpy()[e].astype(float)

    def put(self, x: np.ndarray | None = None, v: np.ndarray | None = None) -> ShellRun:
        """Place the vertices of all environments, and triangles with them; without ``v`` they are at rest."""
        places = self.cloth.state.x
        if x is not None:
            places.assign(np.broadcast_to(x, (*places.shape, 3)).astype(np.float32))
        self._reset.run()
        if v is not None:
            matter, u = self.cloth.matter, self.state.u.numpy()
            v, free = np.broadcast_to(v, (places.shape[1], 3)), matter.vertex >= 0
            cloth = u[:, u.shape[1] - len(matter.mass) :]
            cloth[:, matter.triangle] = v[self.cloth.mesh.faces].mean(axis=1)
            cloth[:, matter.vertex[free]] = v[free]
            self.state.u.assign(u)
        return self

    def speed(self) -> float:
        """Return the root mean square of the velocity [m/s]."""
        return float(np.sqrt((self.get("v") ** 2).sum(axis=1).mean()))
