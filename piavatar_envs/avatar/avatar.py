"""One avatar in every environment of a batch: its body, its commands and its tracked bones.

A reset places every particle at its skinned position, unstrained and at rest. A controller moves the avatar from there,
see :mod:`piavatar_envs.avatar.controller`.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.device import BodyPoints, build_body
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS
from piavatar_envs.avatar.correctives import begin_corrections, place_corrections
from piavatar_envs.avatar.kinematics import pose_body, rest_matrices
from piavatar_envs.avatar.skinning import skinned_place
from piavatar_envs.avatar.tracking import local_rotations, track_bones
from piavatar_envs.avatar.types import AvatarState, Body, Pose, Tracked, allocate
from piavatar_envs.core.arrays import store_matrix
from piavatar_envs.core.cuda_intrinsics import environment_of, warp_threads
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.types import Kinematic, Model, State

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


class Avatar:
    """One avatar in every environment of a batch.

    Attributes:
        body: constants of its particles and bones, on the device.
        body_mass: mass of the whole body, ``(1 or num_envs,)`` [kg].
        num_points: number of its particles.
        threads: threads that share the bones of a body.
        state: commands, and what holds the root.
        tracked: the bones as fitted to the particles.
        placed: the pose of the last reset; valid only for environments that were reset in it.
    """

    def __init__(self, points: BodyPoints, first: int, model: Model) -> None:
        """Allocate the arrays of an avatar.

        Args:
            points: the body.
            first: index of its first particle.
            model: constants of the continuum.

        Raises:
            ValueError: a bone has too few tracking particles, or weights do not sum to one.
        """
        n, device = model.num_envs, model.device
        self.model, self.num_points, self.threads = model, points.num_points, warp_threads(device)
        self.body = build_body(points, first, device, n)
        self.body_mass = wp.array(points.mass.sum(1).astype(np.float32), dtype=float, device=device)
        self.state: AvatarState = allocate(AvatarState, n, device)
        self.tracked: Tracked = allocate(Tracked, n, device)
        self.placed = allocate(Pose, n, device)
        commands = self.state.command_rotation, self.state.goal_rotation, self.state.corrected_rotation
        for rotation in (*commands, self.tracked.rotation):
            rotation.fill_(wp.quat_identity())
        self._bone_from = wp.zeros((n, NUM_JOINTS), dtype=wp.mat44, device=device)
        self._still = wp.zeros((n, NUM_JOINTS), dtype=wp.vec3, device=device)
        self._before = wp.zeros((n, NUM_JOINTS), dtype=wp.quat, device=device)

    def record_pose(
        self,
        graph: LaunchGraph,
        fraction: float,
        start: tuple[wp.array, wp.array],
        change: tuple[wp.array, wp.array],
        out: Pose,
    ) -> None:
        """Append the pose of the bones at ``fraction`` of a ``change`` from a ``start``.

        Args:
            graph: the launch graph to append to.
            fraction: from 0, the start, to 1.
            start: local rotations ``(num_envs, bones)`` and root positions ``(num_envs,)`` [m].
            change: rotation vectors [rad] and translations [m] of the same shapes.
            out: world rotations and joint positions.
        """
        inputs = [self.body, fraction, *start, *change, self.threads]
        graph.launch(pose_body, (self.model.num_envs, self.threads), inputs, [out.rotation, out.position])

    def record_still_pose(self, graph: LaunchGraph, start: tuple[wp.array, wp.array], out: Pose) -> None:
        """Append the pose ``start`` of the bones."""
        self.record_pose(graph, 0.0, start, (self._still, self._still[:, 0]), out)

    def record_reset(self, graph: LaunchGraph, state: State, mask: wp.array) -> None:
        """Append the placement of the masked environments' particles in the commanded pose, at rest."""
        n, s = self.model.num_envs, self.state
        graph.launch(
            reset_commands,
            (n, NUM_JOINTS),
            [mask, s.command_rotation, s.command_root],
            [s.goal_rotation, s.goal_root, s.released, s.wrench_force, s.wrench_torque, s.corrected_rotation],
        )
        if self._corrections.size > 0:
            graph.launch(place_corrections, self._corrections.shape, [mask, s.corrected_rotation], [self.body])
        self.record_still_pose(graph, (s.command_rotation, s.command_root), self.placed)
        graph.launch(
            rest_matrices, (n, NUM_JOINTS), [self.body, self.placed.rotation, self.placed.position], [self._bone_from]
        )
        graph.launch(
            place_particles,
            n * self.num_points,
            [mask, self.body, self._bone_from],
            [state.x, state.u, state.C, state.F, state.kinematic, state.failure],
        )

    def record_set_in_motion(self, graph: LaunchGraph, state: State, mask: wp.array, after: Pose) -> None:
        """Append the velocity that takes placed particles to a pose in one control step."""
        n, matrices = self.model.num_envs, self._bone_from
        graph.launch(rest_matrices, (n, NUM_JOINTS), [self.body, after.rotation, after.position], [matrices])
        inputs = [mask, self.body, self.model.control_dt, matrices, state.x]
        graph.launch(set_in_motion, (n, self.num_points), inputs, [state.u])

    def record_corrections(self, graph: LaunchGraph, aim: wp.Kernel, inputs: list) -> None:
        """Append the correctives of a control step, for the local rotations at its end.

        Args:
            graph: the launch graph to append to.
            aim: kernel over ``(num_envs, bones)`` that advances the corrected rotations to the end of the step.
            inputs: of that kernel.
        """
        if self._corrections.size == 0:
            return
        corrected = self.state.corrected_rotation
        graph.launch(aim, corrected.shape, inputs, [corrected, self._before])
        graph.launch(begin_corrections, self._corrections.shape, [self._before, corrected], [self.body])

    @property
    def _corrections(self) -> wp.array:
        """Return the displacements of the rest pose, ``(num_envs, particles)``; empty where there are none."""
        return self.body.correctives.displacement

    def record_clear_support(self, graph: LaunchGraph) -> None:
        """Append the clearing of the mean force and torque on the root, at the start of a control step."""
        for vectors in (self.state.wrench_force, self.state.wrench_torque):
            graph.launch(clear_vectors, vectors.size, [vectors])

    def record_tracking(self, graph: LaunchGraph, state: State) -> None:
        """Append the tracking of the bones from the current particles."""
        bones, t = (self.model.num_envs, NUM_JOINTS), self.tracked
        inputs = [self.body, state.x, state.u, state.vk, state.failure]
        graph.launch(track_bones, bones, inputs, [t.rotation, t.position, t.velocity])
        graph.launch(local_rotations, bones, [self.body, t.rotation], [t.local])

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint, by name."""
        groups = {"state": self.state, "tracked": self.tracked}
        return {f"{name}.{f.name}": getattr(group, f.name) for name, group in groups.items() for f in fields(group)}


@wp.kernel
def reset_commands(
    mask: wp.array(dtype=wp.bool),
    command_rotation: wp.array2d(dtype=wp.quat),
    command_root: wp.array(dtype=wp.vec3),
    # out
    goal_rotation: wp.array2d(dtype=wp.quat),
    goal_root: wp.array(dtype=wp.vec3),
    released: wp.array(dtype=int),
    wrench_force: wp.array(dtype=wp.vec3),
    wrench_torque: wp.array(dtype=wp.vec3),
    corrected_rotation: wp.array2d(dtype=wp.quat),
):
    """Make the commanded pose the goal of the masked environments, and hold their roots again."""
    e, b = wp.tid()
    if not mask[e]:
        return
    goal_rotation[e, b] = command_rotation[e, b]
    corrected_rotation[e, b] = command_rotation[e, b]
    if b == 0:
        goal_root[e] = command_root[e]
        released[e] = 0
        wrench_force[e] = wp.vec3(0.0)
        wrench_torque[e] = wp.vec3(0.0)


@wp.kernel
def place_particles(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    bone_from: wp.array2d(dtype=wp.mat44),
    # out
    x: wp.array2d(dtype=wp.vec3),
    u: wp.array2d(dtype=wp.vec3),
    C: wp.array3d(dtype=float),
    F: wp.array3d(dtype=float),
    kinematic: Kinematic,
    failure: wp.array(dtype=int),
):
    """Place the particles of the masked environments in the pose ``bone_from``, and clear their failures."""
    at = environment_of(wp.tid(), body.count)
    e = at[0]
    p = at[1]
    if not mask[e]:
        return
    q = body.first + p
    x[e, q] = skinned_place(body, bone_from, 1.0, e, p)
    u[e, q] = wp.vec3(0.0)
    kinematic.vk[e, q] = wp.vec3(0.0)
    kinematic.spin[e, q] = wp.vec3(0.0)
    store_matrix(C, e, q, wp.mat33())
    store_matrix(F, e, q, wp.identity(n=3, dtype=float))
    failure[e] = 0


@wp.kernel
def set_in_motion(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    time: float,
    bone_after: wp.array2d(dtype=wp.mat44),
    x: wp.array2d(dtype=wp.vec3),
    # out
    u: wp.array2d(dtype=wp.vec3),
):
    """Set the physical velocity of placed particles that are in the pose ``bone_after`` a ``time`` [s] later."""
    e, p = wp.tid()
    if not mask[e]:
        return
    q = body.first + p
    u[e, q] = (skinned_place(body, bone_after, 1.0, e, p) - x[e, q]) / time


@wp.kernel
def reset_vectors(mask: wp.array(dtype=wp.bool), v: wp.array2d(dtype=wp.vec3)):
    """Zero the vectors of the masked environments."""
    e, p = wp.tid()
    if mask[e]:
        v[e, p] = wp.vec3(0.0)


@wp.kernel
def clear_vectors(v: wp.array(dtype=wp.vec3)):
    """Zero an array of vectors inside a graph."""
    v[wp.tid()] = wp.vec3(0.0)
