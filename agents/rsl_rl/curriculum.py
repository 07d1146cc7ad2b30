"""Curricula: a root assist that declines, motions that are drawn by their failures, and easier settings."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol

import torch
from pydantic import BaseModel, Field, model_validator
from tensordict import TensorDict

from agents.config import changed
from agents.ranks import ALONE, Ranks
from piavatar_envs.api.rsl_rl import AvatarRslEnv
from piavatar_envs.config import FROZEN, ConfigError, EnvConfig, load_config
from piavatar_envs.envs.task import Task


class AssistSchedule(BaseModel):
    """Schedule of ``root_assist``: by time (``rollouts``), or by success (``step``)."""

    model_config = FROZEN

    first: float = Field(gt=0.0, le=1.0, description="greatest assist in the first rollout, as root_assist [-]")
    rollouts: int | None = Field(
        None, ge=1, description="rollouts over which it falls to nothing, in equal steps; null to give step"
    )
    step: float | None = Field(
        None,
        gt=0.0,
        le=1.0,
        description="by which the assist of an environment falls after an episode that ends in success, and rises, up "
        "to first, after any other [-]; null to give rollouts",
    )

    @model_validator(mode="after")
    def _one_of_them(self) -> AssistSchedule:
        if (self.rollouts is None) == (self.step is None):
            raise ValueError(f"rollouts={self.rollouts} and step={self.step}: give one of them")
        return self


class MotionSchedule(BaseModel):
    """Schedule of the weights by which episodes draw their motions."""

    model_config = FROZEN

    by: Literal["failures"] = Field(description="failures: the share of its episodes that ended before their time")
    memory: int = Field(
        20, ge=1, description="episodes of a motion over which its share is smoothed: the latest counts 1 / memory"
    )
    floor: float = Field(
        0.1,
        gt=0.0,
        le=1.0,
        description="least weight, with 1 that of a motion that always fails [-]; what fails less often than that is "
        "drawn as if it failed so often",
    )


class Curriculum(Protocol):
    """Adaptation of the environments while an agent learns."""

    def begin(self, env: CurriculumEnv) -> None:
        """Prepare a control step, of which ``env.steps`` have been taken."""
        ...

    def end(self, env: CurriculumEnv, ended: torch.Tensor, extras: dict[str, Any]) -> None:
        """Adapt after a control step, the last of the ``env.steps`` taken.

        Args:
            env: the environments.
            ended: where an episode has ended, ``(num_envs,)`` bool.
            extras: of the step; figures to be logged go into ``extras["log"]``.
        """
        ...

    def state(self) -> torch.Tensor:
        """Return what a checkpoint holds besides the state of the environments."""
        ...

    def load(self, saved: torch.Tensor) -> None:
        """Restore what :meth:`state` returned, on any device."""
        ...


class Assist:
    """Root assist that declines.

    Environment ``i`` of the ``n`` of all ranks begins with ``i / (n - 1)`` of the greatest assist, so that some train
    almost without it from the start; a single one has all of it. By time it keeps that share of a greatest assist that
    falls. By success, every environment settles where half of its episodes succeed, and loses its assist where more do,
    as the pulling force of Huang et al., "Learning Humanoid Standing-up Control across Diverse Postures" (2025), which
    never rises.

    Attributes:
        assist: of every environment, ``(num_envs,)`` float32 on the device.
    """

    def __init__(self, settings: AssistSchedule, env: AvatarRslEnv) -> None:
        """Begin with the first assist."""
        self.settings, n = settings, env.ranks.size * env.num_envs
        spread = torch.linspace(0.0, 1.0, n, device=env.device) if n > 1 else torch.ones(1, device=env.device)
        self._spread = spread[env.ranks.rank * env.num_envs :][: env.num_envs]
        self.assist = settings.first * self._spread

    def begin(self, env: CurriculumEnv) -> None:
        """Set the assist; by time, it changes before the first step of a rollout."""
        if self.settings.rollouts is not None and env.steps % env.rollout_steps == 0:
            left = max(0.0, 1.0 - env.steps // env.rollout_steps / self.settings.rollouts)
            self.assist = self.settings.first * left * self._spread
        env.host.api.write(self.assist, [group.simulation.controllers[0].assist for group in env.host.groups])

    def end(self, env: CurriculumEnv, ended: torch.Tensor, extras: dict[str, Any]) -> None:
        """Log the mean assist; by success, change it where an episode has ended."""
        extras["log"]["Task/root_assist"] = self.assist.mean()
        if self.settings.step is not None:
            change = torch.where(extras["info"]["success"], -self.settings.step, self.settings.step)
            changed = (self.assist + change).clamp(0.0, self.settings.first)
            self.assist = torch.where(ended, changed, self.assist)

    def state(self) -> torch.Tensor:
        """Return the assist."""
        return self.assist

    def load(self, saved: torch.Tensor) -> None:
        """Restore the assist."""
        self.assist = saved.to(self.assist.device)


class MotionWeights:
    """Weights of the motions, which follow their failures, as in Luo et al. (PHC, 2023).

    An episode fails if it ends before its time. Where ``k`` episodes of a motion ended in a rollout, a share ``s`` of
    them failures, its smoothed share becomes ``s + (failed - s) (1 - 1 / memory)^k``. It begins at 1, so that motions
    that have not been tried yet are drawn as often as the worst. The weight is the smoothed share, at least ``floor``.
    Weights change between rollouts only, for all ranks alike, and no environment depends on another within one.

    Attributes:
        failed: smoothed share of failures of every motion, ``(motions,)`` float32 on the device.
    """

    def __init__(self, settings: MotionSchedule, env: AvatarRslEnv) -> None:
        """Begin with all motions alike.

        Raises:
            ConfigError: there are no motions to choose from.
        """
        names = env.host.task.motion_names
        if len(names) < 2:
            raise ConfigError(
                f"motions.by={settings.by!r} weighs motions, and the environment has {len(names)}; give env.motion "
                "several, or leave it out"
            )
        self.settings = settings
        self.failed = torch.ones(len(names), device=env.device)
        self._episodes = torch.zeros(2, len(names), device=env.device)  # of this rollout: all, and the failed ones
        self._playing = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)

    def begin(self, env: CurriculumEnv) -> None:
        """Read the motions that are being followed, because a step that ends an episode draws the next."""
        self._playing = env.host.read(lambda group: group.task.playing).long()

    def end(self, env: CurriculumEnv, ended: torch.Tensor, extras: dict[str, Any]) -> None:
        """Count the episodes that have ended; after the last step of a rollout, set the weights."""
        failed = ended & ~extras["time_outs"]
        self._episodes.index_add_(1, self._playing, torch.stack([ended, failed]).float())
        if env.steps % env.rollout_steps == 0:
            episodes, failures = env.ranks.add(self._episodes)
            share = failures / episodes.clamp(min=1.0)
            self.failed = share + (self.failed - share) * (1.0 - 1.0 / self.settings.memory) ** episodes
            self._episodes = torch.zeros_like(self._episodes)
            env.host.weigh_motions(self.failed.clamp(min=self.settings.floor))
        extras["log"]["Motions/failed"] = self.failed.mean()
        extras["log"]["Motions/failed_worst"] = self.failed.max()

    def state(self) -> torch.Tensor:
        """Return the smoothed shares; the weights are part of the environments' state."""
        return self.failed

    def load(self, saved: torch.Tensor) -> None:
        """Restore the smoothed shares."""
        self.failed = saved.to(self.failed.device)

    def table(self, names: Sequence[str]) -> str:
        """Format the smoothed share of failures and the share of episodes of every motion as CSV."""
        weights = self.failed.clamp(min=self.settings.floor).double()
        rows = zip(names, self.failed.tolist(), (weights / weights.sum()).tolist(), strict=True)
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["motion", "failed", "drawn"])
        writer.writerows([name, f"{failed:.4f}", f"{drawn:.6f}"] for name, failed, drawn in rows)
        return file.getvalue()


#: Curricula by the name that they have in a checkpoint, which is that of their setting.
CURRICULA = {"assist": Assist, "motions": MotionWeights}


class CurriculumEnv(AvatarRslEnv):
    """Environments that adapt while an agent learns; evaluations do without.

    Attributes:
        steps: control steps of every environment so far; to be set when a training run resumes.
        rollout_steps: of them in a rollout.
        ranks: of the training; each has such environments.
        curricula: by name, see :data:`CURRICULA`.
    """

    def __init__(
        self, schedules: Mapping[str, Any], rollout_steps: int, *args: Any, ranks: Ranks = ALONE, **kwargs: Any
    ) -> None:
        """Build the environments.

        Args:
            schedules: settings of the curricula, by name.
            rollout_steps: control steps of a rollout.
            *args: those of the base.
            ranks: of the training.
            **kwargs: those of the base.

        Raises:
            ConfigError: also for a curriculum that does not fit the environment.
        """
        super().__init__(*args, **kwargs)
        self.rollout_steps, self.steps, self.ranks = rollout_steps, 0, ranks
        self.curricula: dict[str, Curriculum] = {
            name: CURRICULA[name](settings, self) for name, settings in schedules.items()
        }

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance by one control step; ``extras["log"]`` also holds figures of the curricula, and of ended episodes.

        ``Episodes/ended`` and ``Episodes/succeeded`` are shares of the environments whose episode has ended in this
        step, and has ended in success.
        """
        for curriculum in self.curricula.values():
            curriculum.begin(self)
        stepped = super().step(actions)
        self.steps += 1
        _, _, ended, extras = stepped
        extras["log"]["Episodes/ended"] = ended.float().mean()
        extras["log"]["Episodes/succeeded"] = (ended.bool() & extras["info"]["success"].bool()).float().mean()
        for curriculum in self.curricula.values():
            curriculum.end(self, ended.bool(), extras)
        return stepped


def training_settings(task: Task, curriculum: Mapping[str, Any]) -> EnvConfig:
    """Return the settings of the training environments: those of ``task``, changed by the curriculum.

    Raises:
        ConfigError: a setting is unknown, or changes the policy's actions or observations.
    """
    settings = load_config(type(task.config), task.config, dict(curriculum))
    if unlike := changed(task, type(task)(settings)):
        raise ConfigError(
            f"curriculum={dict(curriculum)} changes {', '.join(unlike)}, and the policy would not fit the environment "
            "that is evaluated; give such settings as env"
        )
    return settings
