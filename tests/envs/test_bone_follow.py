"""Particles of bones that follow them through their flesh: tracked bones stay together, and all else holds."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.rig import joint_gaps
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.config import ConfigError, load_config
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.multi.sumo_v0 import SumoTask

REACH = "PIAvatar/Reach-v0"
FIRM = {"control": "pd", "bone_follow": 1.0, "flesh_rate": (30.0, 3000.0)}


def swing(batch, steps: int, seed: int = 0) -> np.ndarray:
    """Random joint targets; the largest gap between tracked bones after each step [m], shape ``(steps, num_envs)``."""
    rng, avatar, gaps = np.random.default_rng(seed), batch.simulation.avatar, []
    rest = avatar.body.rest_joint.numpy().astype(float)
    for _ in range(steps):
        batch.action.assign(0.5 * rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
        gaps.append(joint_gaps(avatar.tracked, rest).max(axis=1))
    return np.array(gaps)


@pytest.mark.parametrize("assist", [0.0, 1.0])
def test_bones_stay_together(make_batch, assist):
    """Under random targets, held by the pelvis or falling on the floor, with feet and hands that hit it."""
    worst = {}
    for name, settings in {"firm": FIRM, "slipping": {"control": "pd"}}.items():
        batch = make_batch(REACH, 2, root_assist=assist, pose_noise=0.0, **settings)
        batch.reset(seeds=[1, 2])
        worst[name] = swing(batch, 40)
        assert not batch.failure.numpy().any()
    assert np.median(worst["firm"]) < 0.25 * np.median(worst["slipping"])
    assert worst["firm"].max() < 0.5 * worst["slipping"].max()


def test_momentum_is_kept(make_batch):
    """In empty space, though particles go their own ways: the flesh makes room, and the pull does not count them."""
    scene = {"ground": False, "walls": False}
    batch = make_batch(REACH, 1, gravity=0.0, scene=scene, pose_noise=0.0, **FIRM)
    batch.reset(seeds=[0])
    model, state = batch.simulation.model, batch.simulation.state
    start, scale, drift = totals(model, state), 0.0, np.zeros(2)
    for step in range(20):
        swing(batch, 1, step)
        now = totals(model, state)
        scale = max(scale, now.momentum_scale)
        changes = now.momentum - start.momentum, now.angular_momentum - start.angular_momentum
        drift = np.maximum(drift, [np.linalg.norm(change) for change in changes])
    assert scale > 5.0
    assert (drift < 1e-5 * scale).all(), drift / scale


def test_a_run_is_taken_up_again_and_a_reset_forgets(make_batch, equal):
    batch = make_batch(REACH, 2, pose_noise=0.0, **FIRM)
    batch.reset(seeds=[3, 4])
    swing(batch, 3)
    state = batch.get_state()
    assert state["joints_0.followed"].any(axis=(1, 2)).all()
    first = swing(batch, 3, 1)
    batch.set_state(state)
    assert equal(first, swing(batch, 3, 1))
    batch.reset(env_mask=np.array([False, True]))
    followed = batch.get_state()["joints_0.followed"]
    assert followed[0].any() and not followed[1].any()


def test_flesh_and_commanded_poses_are_left_alone(make_batch):
    """Only particles of bones under torques are carried; without any, nobody keeps what nobody needs."""
    batch = make_batch(REACH, 1, **FIRM)
    carried = batch.simulation.model.particles.carried.numpy()
    assert 0 < carried.sum() < 0.9 * carried.size
    assert batch.simulation.avatar.joints.state.followed.shape[1] == carried.size
    for settings in ({"control": "pd"}, {"bone_follow": 1.0}):
        other = make_batch(REACH, 1, **settings)
        assert not other.simulation.model.particles.carried.numpy().any()
        if other.simulation.avatar.joints is not None:
            assert other.simulation.avatar.joints.state.followed.shape[1] == 1


def test_two_bodies_that_collide_keep_their_momentum(device):
    """The particles of the second body's bones are carried as the first one's are, and nobody's flesh."""
    settings = {"fidelity": "tiny", "joints": None, "start_distance": 0.6, "gravity": 0.0, **FIRM}
    config = load_config(SumoTask.Config, None, settings | {"scene": {"ground": False, "walls": False}})
    batch = BatchEnv(SumoTask(config), 1, device)
    batch.reset(seeds=[0])
    simulation = batch.simulation
    model, state, first = simulation.model, simulation.state, simulation.subjects.first
    carried, bodies = model.particles.carried.numpy(), [slice(*first[i : i + 2]) for i in range(2)]
    x, u = state.x.numpy()[0], state.u.numpy()
    way = x[bodies[1]].mean(0) - x[bodies[0]].mean(0)
    for body, speed in zip(bodies, (0.7, -0.7), strict=True):
        u[0, body] += speed * way / np.linalg.norm(way)
    state.u.assign(u)
    start, pushed, gaps = totals(model, state), 0.0, []
    rng = np.random.default_rng(0)
    for _ in range(15):
        batch.action.assign(0.5 * rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
        pushed += np.linalg.norm(simulation.sensors.pair_impulse.numpy()[0], axis=-1).max()
        rests = [avatar.body.rest_joint.numpy().astype(float) for avatar in simulation.avatars]
        gaps.append([joint_gaps(a.tracked, rest).max() for a, rest in zip(simulation.avatars, rests, strict=True)])
    now = totals(model, state)
    assert pushed > 5.0
    assert (np.median(gaps, axis=0) < 1e-3).all()
    for change in (now.momentum - start.momentum, now.angular_momentum - start.angular_momentum):
        assert np.linalg.norm(change) < 1e-5 * now.momentum_scale
    for body, flesh, avatar in zip(bodies, simulation.flesh, simulation.avatars, strict=True):
        of_bone = flesh.sampled.bone >= 0
        np.testing.assert_array_equal(carried[body] != 0, of_bone)
        np.testing.assert_array_equal(avatar.joints.state.followed.numpy()[0].any(axis=1), of_bone)


def test_bones_that_hold_nothing_cannot_be_followed(make_batch):
    with pytest.raises(ConfigError, match="flesh_rate is zero"):
        make_batch(REACH, 1, **FIRM | {"flesh_rate": (0.0, 0.0)})
