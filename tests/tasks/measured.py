"""Measurements of single environments in NumPy: what tests of tasks hold rewards, metrics and observations against."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.api.pictures import SceneReader
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.pixels import task_camera
from piavatar_envs.sim.markers import Markers, allocate_markers


def still(env) -> np.ndarray:
    """Return an action of zeros."""
    return np.zeros(env.action_space.shape, np.float32)


def seen(env, observation, name: str) -> np.ndarray:
    """Return a term of an observation."""
    return env.observation_layout.split(observation)[name]


def tolerance(value: float, bound: float, margin: float) -> float:
    """Return dm_control's Gaussian tolerance: 1 within the bound, a tenth at the margin beyond it."""
    return 10.0 ** -((max(value - bound, 0.0) / margin) ** 2)


def markers_of(batch) -> Markers:
    """Return where the task's markers are now, in all environments."""
    markers = allocate_markers(batch.task.marker_specs(), batch.num_envs, batch.device)
    graph = LaunchGraph(batch.device)
    batch.task.record_markers(batch, graph, markers)
    graph.run()
    return markers


def joints(env) -> np.ndarray:
    """Return the tracked joints ``(22, 3)`` [m]."""
    return env.batch.simulation.avatar.tracked.position.numpy()[0].astype(float)


def pelvis(env) -> tuple[np.ndarray, Rotation]:
    """Return the position [m] and the rotation of the pelvis."""
    tracked = env.batch.simulation.avatar.tracked
    return tracked.position.numpy()[0, 0].astype(float), Rotation.from_quat(tracked.rotation.numpy()[0, 0])


def middle(env, bone: str) -> np.ndarray:
    """Return the middle of a bone's flesh [m]: its rest centre of mass, carried by the bone's particles."""
    simulation, index = env.batch.simulation, joint_index(bone)
    points, x = simulation.flesh[0].points, simulation.state.x.numpy()[0].astype(float)
    rest, mass = points.rest[0].astype(float), points.mass[0].astype(float)
    weight = mass * (points.skin_weights * (points.skin_joints == index)).sum(1)
    p = np.flatnonzero(points.bone == index)
    turn = Rotation.align_vectors(x[p] - x[p].mean(0), rest[p] - rest[p].mean(0))[0]
    return x[p].mean(0) + turn.apply(weight @ rest / weight.sum() - rest[p].mean(0))


def prop_particles(batch, name: str = "ball") -> slice:
    """Return where the particles of a prop are in the arrays."""
    prop = batch.simulation.props.props[batch.simulation.props.index(name)]
    return slice(prop.first, prop.first + prop.count)


def prop_motion(batch, name: str = "ball") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mass [kg], centre [m] and velocity [m/s] of a prop in every environment, from its particles."""
    own, state = prop_particles(batch, name), batch.simulation.state
    mass = np.broadcast_to(
        batch.simulation.model.particles.mass.numpy()[:, own], (batch.num_envs, own.stop - own.start)
    )
    x, v = state.x.numpy()[:, own], state.u.numpy()[:, own] + state.vk.numpy()[:, own]
    total = mass.sum(1, dtype=float)
    return total, *(np.einsum("ep,epi->ei", mass, a.astype(float)) / total[:, None] for a in (x, v))


def places_in(camera, points: np.ndarray, center=(0.0, 0.0)) -> np.ndarray:
    """Return where a pinhole camera sees points: from -1 to 1 across a square picture, shape ``(n, 2)``."""
    eye, target = np.array(camera.position), np.array(camera.target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = (points - eye - [*center, 0.0]) @ np.stack([right, np.cross(right, forward), forward]).T
    assert (seen[:, 2] > 0.1).all()
    return seen[:, :2] / seen[:, 2:] / math.tan(math.radians(0.5 * camera.field_of_view))


def assert_all_is_seen(env, seeds=range(3)) -> None:
    """Assert that pictures of new episodes hold all bodies and markers."""
    batch, scenes = env.batch, SceneReader(env.batch)
    for seed in seeds:
        env.reset(seed=seed)
        scene = scenes.scene(0)
        points = [body.vertices for body in scene.bodies] + [marker.mesh()[0] for marker in scene.markers]
        center = (0.0, 0.0) if scene.follow is None else scene.follow[:2]
        seen = places_in(task_camera(batch, batch.task, 1.0), np.concatenate(points), center)
        assert np.abs(seen).max() < 1.0
        assert np.ptp(seen[:, 1]) > 0.3  # and not a dot
