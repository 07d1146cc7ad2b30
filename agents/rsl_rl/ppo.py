"""rsl_rl's PPO with scaled rewards, noisy observations, declining updates, and reflected steps.

A body is the same on both sides, so the reflection of a good action is a good action in the reflected state, and every
step can be learned from twice (Mittal, Rudin, Klemm, Allshire & Hutter, "Symmetry considerations for learning task
symmetric robot policies", ICRA 2024).

The mirror is the plane x = 0, in which a body that faces -y looks straight ahead. Vectors change their x; spins and
rotation vectors keep it and change y and z; a rotation matrix becomes ``S R S`` with ``S = diag(-1, 1, 1)``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, JOINT_NAMES
from piavatar_envs.config import ConfigError


class ScaledPPO(PPO):
    """rsl_rl's PPO with scaled rewards, noisy observations, and a target divergence that declines.

    What is logged are the environment's own rewards.

    Attributes:
        updates: how many there have been; to be set where a training run goes on.
        check: is called after each, also after one that torch has refused to end; to be set.
        learned: is called after each that has ended, by all ranks; to be set.
    """

    check: Callable[[], None]
    learned: Callable[[], None]

    def __init__(
        self, *args: Any, reward_scale: float, observation_noise: float, kl_targets: Sequence[float], **settings: Any
    ) -> None:
        """Build the algorithm.

        Args:
            args: of the base.
            reward_scale: the factor.
            observation_noise: standard deviation of what is added to every component.
            kl_targets: of the first update and all that follow, in place of ``desired_kl``; none for a fixed one.
            settings: of the base.
        """
        super().__init__(*args, **settings)
        self.reward_scale, self.kl_targets, self.updates = reward_scale, kl_targets, 0
        self.observation_noise = observation_noise

    def update(self) -> dict[str, float]:
        """Learn from a rollout.

        Raises:
            Diverged: the networks are not finite any more.
        """
        if self.kl_targets:
            self.desired_kl = self.kl_targets[min(self.updates, len(self.kl_targets) - 1)]
        self.updates += 1
        try:
            losses = super().update()
        except (RuntimeError, ValueError):  # torch's message about broken networks does not name the cause
            self.check()
            raise
        self.check()
        self.learned()
        return losses

    def process_env_step(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: dict[str, torch.Tensor]
    ) -> None:
        """Record a step with its reward scaled."""
        super().process_env_step(obs, self.reward_scale * rewards, dones, extras)

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Draw actions and record them with the observations that they were drawn for."""
        if self.observation_noise > 0.0:
            obs = obs.apply(lambda seen: seen + self.observation_noise * torch.randn_like(seen))
        return super().act(obs)


if TYPE_CHECKING:
    from piavatar_envs.envs.observations import ObservationTerm

#: Signs in the mirror of one scalar, of a scalar that counts to the left, and of the kinds above.
_SCALAR, _ASIDE = (1.0,), (-1.0,)
_VECTOR, _SPIN = (-1.0, 1.0, 1.0), (1.0, -1.0, -1.0)
_ROOT = (-1.0, 1.0, -1.0)  # x, y, yaw
_ROTATION = (1.0, -1.0, -1.0, -1.0, 1.0, 1.0)  # two columns
_HALF_A_STRIDE = (-1.0, -1.0)  # sine and cosine of a clock
_SIDES, _BODY, _JOINTS, _PARTS = ("left", "right"), JOINT_NAMES, JOINT_NAMES[1:], tuple(BODY_PARTS)

#: What terms of observations hold: the signs of one item, and the names of the items.
_TERMS: Mapping[str, tuple[tuple[float, ...], Sequence[str]]] = {
    "root_height": (_SCALAR, ("root",)),
    "root_orientation": (_ROTATION, ("root",)),
    "joint_rotations": (_ROTATION, _JOINTS),
    "bone_positions": (_VECTOR, _JOINTS),
    "bone_velocities": (_VECTOR, _BODY),
    "stress": (_SCALAR, _PARTS),
    "contact_impulse": (_VECTOR, _PARTS),
    "root_spin": (_SPIN, ("root",)),
    "joint_velocities": (_SPIN, _JOINTS),
    "ground_impulse": (_VECTOR, ("root",)),
    "gravity_direction": (_VECTOR, ("root",)),
    "foot_impulses": (_SCALAR, _SIDES),
    "ball_position": (_VECTOR, ("ball",)),
    "ball_velocity": (_VECTOR, ("ball",)),
    "reference_positions": (_VECTOR, _BODY),
    "reference_root": (_ROTATION, ("root",)),
    "reference_turns": (_SPIN, _JOINTS),
    "path_direction": (_VECTOR, ("path",)),
    "path_offset": (_ASIDE, ("path",)),
    "gait_phase": (_HALF_A_STRIDE, ("clock",)),
}


def other_side(name: str) -> str:
    """Return the name of the opposite joint or part; names in the middle stay."""
    side, underscore, rest = name.partition("_")
    return {"left": "right", "right": "left"}.get(side, side) + underscore + rest


class Mirror:
    """Reflection of observations and actions; both are tensors with the components in the last dimension."""

    def __init__(
        self, terms: Iterable[ObservationTerm], joints: Sequence[str], device: str | torch.device, root: bool = False
    ) -> None:
        """Build the permutation and the signs of all components.

        Args:
            terms: of the observation, in order.
            joints: names of those that act, in order.
            root: whether x, y and yaw of the root follow.
            device: of the tensors.

        Raises:
            ConfigError: a term of which it is not known what it becomes, or a joint acts and its other side does not.
        """
        pairs: list[tuple[np.ndarray, np.ndarray]] = []
        for term in terms:
            signs, items = _TERMS.get(term.name, (_SCALAR, ()))
            if len(signs) * len(items) != term.size:
                raise ConfigError(
                    f"no reflection of observation term {term.name!r} of size {term.size} is known; use "
                    "ppo.mirrored=false"
                )
            pairs.append(_changed_over(items, signs))
        lonely = [joint for joint in joints if other_side(joint) not in joints]
        if lonely:
            raise ConfigError(f"{lonely[0]!r} acts, but {other_side(lonely[0])!r} does not; use ppo.mirrored=false")
        self._seen = _joined(pairs, device)
        acts = [_changed_over(joints, _SPIN)] + ([_changed_over(("root",), _ROOT)] if root else [])
        self._done = _joined(acts, device)

    def observations(self, seen: torch.Tensor) -> torch.Tensor:
        """Return the observations of the reflected state."""
        source, sign = self._seen
        return seen[..., source] * sign

    def actions(self, done: torch.Tensor) -> torch.Tensor:
        """Return the reflected actions: rotation vectors or torques, as shares of ranges that are reflected too."""
        source, sign = self._done
        return done[..., source] * sign


def _changed_over(items: Sequence[str], signs: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return source indices and signs of the components of items."""
    first = len(signs) * np.array([items.index(other_side(item)) for item in items])
    return (first[:, None] + np.arange(len(signs))).ravel(), np.tile(signs, len(items))


def _joined(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]], device: str | torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    starts = np.cumsum([0, *(len(source) for source, _ in pairs)])
    source = np.concatenate([start + own for start, (own, _) in zip(starts, pairs, strict=False)])
    sign = np.concatenate([own for _, own in pairs])
    return torch.as_tensor(source, device=device), torch.as_tensor(sign, dtype=torch.float32, device=device)
