"""Soft tissue: where it is, that it is late, that it comes back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.flesh import softness, velocity_lag
from piavatar_envs.avatar.body.sampling import sample_particles, spacing_for
from piavatar_envs.avatar.body.skeleton import BODY_PARTS, joint_index, skin
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.config import load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task


def test_softness_is_at_the_bones_zero_and_in_belly_and_thighs_high():
    particles = sample_particles(load_asset(), spacing_for(0.052))
    soft = softness(particles.rest_positions, particles.bone, particles.skin_joints, particles.skin_weights)
    assert soft.min() >= 0.0 and soft.max() <= 1.0
    assert (soft[particles.bone >= 0] == 0.0).all()
    limbs = [joint_index(name) for part in ("head", "left_arm", "right_arm") for name in BODY_PARTS[part]]
    assert soft[np.isin(particles.skin_joints[:, 0], limbs) & (particles.skin_weights[:, 0] > 0.99)].max() == 0.0
    x = particles.rest_positions
    belly = (np.abs(x[:, 0]) < 0.1) & (x[:, 1] < -0.05) & (np.abs(x[:, 2] - 1.0) < 0.1)
    assert belly.sum() > 10 and soft[belly].mean() > 0.4


@pytest.mark.parametrize("amount", [-0.1, 1.1, np.nan])
def test_an_amount_out_of_range_is_refused(amount):
    with pytest.raises(ValueError, match=r"outside \[0, 1\]"):
        velocity_lag(amount, np.ones(3))


def lag(device: str, amount: float) -> np.ndarray:
    """Return the mean distance of soft flesh from its skinned place over a squat [m]."""
    task = load_task("TrackMotion-v0")
    settings = {"motion": "squat", "impulse": 0.0, "random_start": False, "root_action": False}
    settings |= {"soft_tissue": amount, "soft_young_modulus": 5.0e3, "fidelity": "tiny"}
    env = BatchEnv(task(load_config(task.Config, None, settings)), 1, device)
    env.reset(seeds=[0])
    simulation, course = env.simulation, []
    points, particles, tracked = simulation.flesh[0].points, simulation.flesh[0].sampled, simulation.avatar.tracked
    soft = softness(points.rest[0], particles.bone, particles.skin_joints, particles.skin_weights) > 0.5
    for _ in range(60):
        env.step()
        rotations = Rotation.from_quat(tracked.rotation.numpy()[0]).as_matrix()
        place = skin(
            points.rest[0], points.skin_joints, points.skin_weights, rotations, tracked.position.numpy()[0],
            points.joints[0],
        )  # fmt: skip
        course.append(np.linalg.norm(simulation.state.x.numpy()[0] - place, axis=1)[soft].mean())
    assert env.failure.numpy()[0] == 0
    return np.array(course)


def test_soft_flesh_is_late_in_a_squat_and_comes_back(device):
    firm, soft = lag(device, 0.0), lag(device, 1.0)
    assert soft.max() > 4.0 * firm.max()
    assert 1.0e-5 < soft.max() < 0.05, "flesh must jiggle, not stay behind"
