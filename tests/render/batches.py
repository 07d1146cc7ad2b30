"""Batches in motion, and what a stage shows of them."""

from __future__ import annotations

import numpy as np

from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.render.stage import Stage


def act(batch: BatchEnv, steps: int, rows: slice | None = None) -> None:
    """Step a batch under random actions, those of ``rows`` of a batch of three."""
    rng = np.random.default_rng(0)
    for _ in range(steps):
        actions = rng.uniform(-1.0, 1.0, (3, *batch.action.shape[1:])).astype(np.float32)
        batch.action.assign(actions[: batch.num_envs] if rows is None else actions[rows])
        batch.step()


def seen(batch: BatchEnv, stage: Stage | None = None) -> np.ndarray:
    """Return the vertices of all pictures now, ``(pictures, V, 3)`` [m]; of all environments by default."""
    stage = stage or Stage(batch.simulation, batch.task.marker_specs())
    graph = LaunchGraph(batch.device)
    batch.task.record_markers(batch, graph, stage.markers)
    stage.record(graph)
    graph.run()
    return stage.vertices.numpy().copy()
