"""Torques of the joints' tissue in a test."""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import PARENTS
from piavatar_envs.avatar.rotation import torques_of_vector
from piavatar_envs.avatar.torque_control.joint_tissue import Tissue, tissue_pull


@wp.kernel
def find_tissue_torques(tissue: Tissue, factor: wp.array(dtype=float), bend: wp.array2d(dtype=wp.vec3),
                        torque: wp.array2d(dtype=wp.vec3)):  # fmt: skip
    e, b = wp.tid()
    torque[e, b] = torques_of_vector(bend[e, b]) * tissue_pull(tissue, bend, factor[0], e, b)


def tissue_torques(batch) -> np.ndarray:
    """Return the torques of the joints' tissue, in the world's axes, ``(22, 3)`` [N m]."""
    joints = batch.simulation.controllers[0].joints
    world = Rotation.from_quat(joints.state.rotation.numpy()[0].astype(float))
    above = [world[max(PARENTS[b], 0)] for b in range(len(PARENTS))]
    bend = np.array([[(a.inv() * w).as_rotvec() for a, w in zip(above, world, strict=True)]], np.float32)
    device = joints.model.device
    torque = wp.zeros(bend.shape[:2], dtype=wp.vec3, device=device)
    inputs = [joints.tissue, joints.target.factor, wp.array(bend, dtype=wp.vec3, device=device)]
    wp.launch(find_tissue_torques, torque.shape, inputs, [torque], device=device)
    return np.stack([a.apply(t) for a, t in zip(above, torque.numpy()[0].astype(float), strict=True)])
