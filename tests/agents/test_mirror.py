"""Left and right changed over: of observations, of actions, and of what bodies do."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="needs the extra train")

from agents.rsl_rl.ppo import Mirror  # noqa: E402
from piavatar_envs.api.host import EpisodeHost  # noqa: E402
from piavatar_envs.config import load_config  # noqa: E402
from piavatar_envs.tasks import load_task  # noqa: E402

STANDING = ("Stand-v0", "PushRecovery-v0", "Walk-v0", "GetUp-v0")


def batch(name: str, num_envs: int, device: str, **settings) -> EpisodeHost:
    """A small body that stands exactly in its rest pose."""
    task = load_task(name)
    config = load_config(task.Config, {"fidelity": "tiny", **settings})
    return EpisodeHost(task(config), num_envs, device, "torch", 1)


def mirror_of(episodes: EpisodeHost) -> Mirror:
    return Mirror(episodes.layout.values(), episodes.groups[0].action_spec.joints, episodes.api.device)


@pytest.mark.parametrize("name", STANDING)
def test_twice_is_as_before_and_once_is_not(name, device):
    episodes = batch(name, 1, device)
    mirror = mirror_of(episodes)
    seen = torch.randn(5, episodes.layout.size, device=episodes.api.device)
    done = torch.randn(5, episodes.action_size, device=episodes.api.device)
    assert torch.equal(mirror.observations(mirror.observations(seen)), seen)
    assert torch.equal(mirror.actions(mirror.actions(done)), done)
    assert not torch.allclose(mirror.observations(seen), seen) and not torch.allclose(mirror.actions(done), done)
    episodes.close()


def test_a_symmetric_clip_is_its_own_mirror_image(device):
    """Return the remaining reference of a squat for a body that lags behind."""
    settings = {"motion": "squat", "random_start": False, "impulse": 0.0, "root_action": False, "fail_distance": 2.0}
    episodes = batch("TrackMotion-v0", 1, device, **settings, control="torque")
    mirror = mirror_of(episodes)
    episodes.reset([0])
    for _ in range(8):
        episodes.step(torch.zeros(1, 1, episodes.action_size, device=episodes.api.device))
    seen = episodes.observation()[0, 0]
    mirrored = mirror.observations(seen)
    for name in ("reference_positions", "reference_root", "reference_turns"):
        own = episodes.layout[name].slice
        assert seen[own].abs().max() > 0.05
        torch.testing.assert_close(mirrored[own], seen[own], atol=2e-2, rtol=0.0)  # particles lie a little aslant
    episodes.close()


LEGS = ["left_hip", "right_hip", "left_knee", "right_knee"]


@pytest.mark.parametrize(
    ("control", "settings", "before"),
    [
        # from rest, all joints
        ("pd", {"gait": {"arm_swing": 0.0}}, 0),
        ("torque", {"gait": {"arm_swing": 0.0}}, 0),
        # held until the arms of both are where their clocks have them
        ("pd", {"control": {"root_assist": 0.5}}, 20),
        ("torque", {"control": {"root_assist": 0.5}, "joints": LEGS}, 20),
    ],
)
def test_mirrored_actions_have_mirrored_consequences(control, settings, before, device):
    """The body, its muscles, the ground and what is observed of them are the same on both sides."""
    section = {"mode": control, **settings.get("control", {})}
    episodes = batch("Walk-v0", 2, device, pose_noise=0.0, **{**settings, "control": section})
    mirror = mirror_of(episodes)
    episodes.reset([0, 0])
    episodes.groups[0].step_count.assign([0, 15])  # in the mirror the clock is half a stride on
    still = torch.zeros(2, 1, episodes.action_size, device=episodes.api.device)
    for _ in range(before):
        episodes.step(still)
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        action = torch.rand(1, 1, episodes.action_size, generator=generator).to(episodes.api.device) - 0.5
        episodes.step(torch.cat([action, mirror.actions(action)]))
    seen, mirrored = episodes.observation()[:, 0]
    expected = mirror.observations(seen)
    for name, term in episodes.layout.items():
        off = float((mirrored - expected)[term.slice].norm())
        # the points of so small a body are not quite symmetric
        assert off < 5.0e-4 + 0.05 * float(expected[term.slice].norm()), name
        if name in ("joint_rotations", "joint_velocities", "bone_velocities", "root_spin", "path_offset"):
            assert off < 0.1 * float((mirrored - seen)[term.slice].norm()), name
    episodes.close()
