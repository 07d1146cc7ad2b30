"""Training runs on one batch, for any library: configuration, command line, evaluation.

A batch advances all its environments in the same kernel launches and hands out tensors on their device. The learning
itself is in ``agents/skrl/train.py`` and ``agents/rsl_rl/train.py``. Where torchrun has started several processes, each
has a batch of its own, and their episodes are those of one batch that is as large as all of them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from pydantic import AfterValidator, BaseModel, Field, field_validator

from agents.checkpoint import Checkpoint, Diverged, seed_all
from agents.command import read_options, script_hint
from agents.config import MOST_ENVS, MOST_RUNS, EvaluationSettings, first_training_seed, load_resolved
from agents.evaluate import Agent, play_with_baselines
from agents.files import made
from agents.interrupt import command, ended_by_interrupt
from agents.ranks import ALONE, Ranks, joined
from agents.report import Curve, conclude, draw_curve, versions
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import (
    FROZEN,
    ConfigError,
    EnvConfig,
    FrozenDict,
    load_config,
    parse_assignments,
)
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.world import check_device
from piavatar_envs.tasks import listed_name


class BatchTraining(BaseModel):
    """Settings of a training run on a batch; a library's own settings come in a subclass."""

    model_config = FROZEN

    env_id: str = Field(description="registered id, or a module of piavatar_envs.multi such as high_five_v0")
    env: Annotated[dict[str, Any], AfterValidator(FrozenDict)] = Field(
        default_factory=dict, description="settings of the environment that differ from its defaults"
    )
    observe: tuple[str, ...] | None = Field(
        None, description="terms of the observation that the networks see; null for all of it"
    )
    num_envs: int = Field(64, ge=1, le=MOST_ENVS, description="environments of the batch, of each rank its own")
    iterations: int = Field(100, ge=1, description="rollouts, each followed by an update")
    seed: int = Field(0, ge=0, lt=MOST_RUNS, description="of the networks, the actions and the training episodes")
    checkpoint_every: int = Field(10, ge=1, description="iterations between two checkpoints")
    evaluation: EvaluationSettings = Field(default_factory=EvaluationSettings, description="how agents are compared")

    _list_env_id = field_validator("env_id")(listed_name)

    @property
    def first_seed(self) -> int:
        """Return the seed of environment 0's episodes; environment ``i`` plays those of ``first_seed + i``."""
        return first_training_seed(self.seed)

    def first_seed_on(self, ranks: Ranks) -> int:
        """Return the seed of environment 0's episodes on a rank, whose batch follows that of the rank before.

        Raises:
            ConfigError: all ranks together have more environments than a training run may have.
        """
        if (count := ranks.size * self.num_envs) > MOST_ENVS:
            raise ConfigError(
                f"num_envs={self.num_envs} on each of {ranks.size} ranks are {count} environments, and a training run "
                f"may have {MOST_ENVS}; use fewer"
            )
        return self.first_seed + ranks.rank * self.num_envs

    def seed_draws(self, ranks: Ranks) -> None:
        """Let ranks draw actions and minibatches of their own; call it once networks, the same on all, are built."""
        if ranks.rank:
            seed_all(self.seed + MOST_RUNS * ranks.rank)


Training = TypeVar("Training", bound=BatchTraining)
#: From a training run's environment id to the task.
FindTask = Callable[[str], type[Task]]


def load_batched(
    cls: type[Training],
    find_task: FindTask,
    source: Mapping[str, Any] | str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Training:
    """Load a configuration and fill in the task's defaults for what ``env`` leaves open.

    Args:
        cls: of the library's training.
        find_task: the task of an environment's id; a ValueError where there is none.
        source: a YAML file or a mapping.
        overrides: settings that override it, as from a command line; ``env.NAME`` for those of the environment.

    Raises:
        ConfigError: a setting that is unknown, of the wrong type or out of range, also of the environment; or more
            minibatches than there are steps to share.
    """
    config = load_resolved(cls, lambda config: find_task(config.env_id).Config, source, overrides)
    for name in ("ppo", "mappo"):
        settings = getattr(config, name, None)
        if settings is not None and settings.minibatches > (steps := config.num_envs * settings.rollout_steps):
            raise ConfigError(
                f"{name}.minibatches={settings.minibatches} must be <= {steps}, the steps of a rollout of num_envs="
                f"{config.num_envs} environments"
            )
    return config


@dataclass(frozen=True)
class Learned:
    """Result of a library's training.

    Attributes:
        agent: the trained policy's mean action, as :func:`play` takes it.
        curve: returns of the training episodes.
    """

    agent: Agent
    curve: Curve


def iterations_of(checkpoint: Checkpoint, asked: int) -> int:
    """Return the iterations that a training run has had when it begins or resumes.

    Raises:
        ConfigError: more than are asked for.
    """
    had = checkpoint.state["iterations"] if checkpoint.state else 0
    if had > asked:
        raise ConfigError(f"{checkpoint.path} has had {had} iterations, iterations={asked}; ask for as many or more")
    return had


@dataclass(frozen=True)
class Options:
    """Train agents on one batch of environments, and evaluate them."""

    #: YAML file with what differs from the defaults
    config: tyro.conf.Positional[Path]
    #: settings that override the file: iterations=10 env.fidelity=tiny num_envs=256
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: folder to write to; by default runs/ and the name of the file
    out: Path | None = None
    #: where to simulate and to learn
    device: str = "cpu"
    #: go on from the folder's checkpoint; where there is none, begin
    resume: bool = False


def run(
    name: str,
    cls: type[Training],
    find_task: FindTask,
    learn: Callable[[Training, Task, Path, str, Checkpoint], Learned],
    args: list[str] | None = None,
) -> None:
    """Run a training script: train as a file says, evaluate, and write ``results.json`` and a curve.

    Args:
        name: of the script.
        cls: its configuration.
        find_task: the task of an environment's id.
        learn: trains on all ranks; given the configuration, the task, the folder to write to, the device of the rank,
            and the checkpoint from which to go on and which to keep up. Rank 0 leaves the configuration in the folder
            when it refuses no more.
        args: command line, by default the process's own.
    """
    options, ranks = read_options(Options, name, args), Ranks.here()
    quiet_warp()
    try:
        with joined(ranks, options.device) as device:
            _run(name, cls, find_task, learn, args, options, ranks, device)
    except (ConfigError, Diverged, OSError) as error:
        sys.exit(f"error: {error}")


def _run(
    name: str,
    cls: type[Training],
    find_task: FindTask,
    learn: Callable[[Training, Task, Path, str, Checkpoint], Learned],
    args: list[str] | None,
    options: Options,
    ranks: Ranks,
    device: str,
) -> None:
    """Train and evaluate on a rank.

    Raises:
        ConfigError: a setting, an option, or what the folder holds.
        Diverged: the networks are not finite any more.
        OSError: a file cannot be written.
    """
    try:
        config = load_batched(cls, find_task, options.config, parse_assignments(options.settings))
        check_device(device)
    except ValueError as error:
        raise ConfigError(f"{error}{script_hint(options.config, name)}") from None
    if int(restarts := os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")) and not options.resume:
        raise ConfigError(
            f"torchrun --max-restarts={restarts} starts what has failed with the same command; add --resume, with "
            "which it goes on from the checkpoint"
        )
    folder = options.out or Path("runs") / options.config.stem
    task = new_task(config, find_task)
    with made(folder) if ranks.first else nullcontext():
        checkpoint = Checkpoint(folder, name, config, options.device, options.resume, ranks)
        iterations_of(checkpoint, config.iterations)
        again = command(name, args, "--resume", ranks=ranks)
        with ended_by_interrupt(partial(checkpoint.remedy, again), silent=not ranks.first):
            learned = learn(config, task, folder, device, checkpoint)
            if ranks.first:
                evaluate_batch(name, config, find_task, learned, folder, device, ranks)


def evaluate_batch(
    name: str,
    config: BatchTraining,
    find_task: FindTask,
    learned: Learned,
    folder: Path,
    device: str,
    ranks: Ranks = ALONE,
) -> None:
    """Evaluate a trained agent and write ``results.json`` and the curve. Arguments are as for :func:`run`."""
    task = new_task(config, find_task)
    batch = EpisodeHost(task, config.evaluation.episodes, device)
    results = play_with_baselines("trained", learned.agent, batch, config.evaluation.first_seed)
    batch.close()
    learned.curve.save(folder / "curve.csv")
    bands = {result.agent: result.estimate() for result in results}
    draw_curve(folder / "curve.png", learned.curve.steps, learned.curve.returns, bands, config.env_id)
    about = versions(name, device) | {"seed": config.seed, "config": config.model_dump(mode="json")}
    cost = {"training_s": learned.curve.seconds, "train_steps": learned.curve.train_steps}
    extra = {**cost, "num_envs": config.num_envs, "ranks": ranks.size, "agents": task.agent_names}
    conclude(folder, about, results, extra, "policy.pt, curve.png, curve.csv, config.yaml, results.json")


def new_task(config: BatchTraining, find_task: FindTask) -> Task:
    """Build the task of a resolved configuration; every batch needs one of its own, which holds its arrays."""
    task_class = find_task(config.env_id)
    settings: EnvConfig = load_config(task_class.Config, config.env)
    return task_class(settings)
