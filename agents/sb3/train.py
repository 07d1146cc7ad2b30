"""Train with stable-baselines3: ``python -m agents.sb3.train configs/sb3/reach_ppo.yaml --out runs/reach``.

The environment is one agent's, or a world of several: then all its learning agents share one policy, and with a section
``selfplay`` they compete, also with snapshots of earlier policies. Leaves in the folder: the resolved configuration,
the policy and some on the way there, every training episode's return, TensorBoard's files, the evaluation, and the
snapshots. What was killed goes on with ``--resume``, from the latest checkpoint and as if nothing had happened.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from agents.checkpoint import Checkpoint, Diverged
from agents.command import read_options, script_hint
from agents.evaluate import Evaluation, baselines, evaluate
from agents.files import made
from agents.interrupt import command, ended_by_interrupt
from agents.report import Curve, conclude, draw_curve, versions
from agents.sb3 import matches, selfplay
from agents.sb3.config import TrainingConfig, load_training
from agents.sb3.learning import Deadline, begin, learn
from agents.sb3.parallel import AgentVecEnv
from agents.sb3.policy import policy_agent
from agents.sb3.workers import EnvFacts, components, factory, prepare, start
from piavatar_envs.config import ConfigError, parse_assignments
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.sim.world import check_device

Results = Sequence[Evaluation] | Sequence[matches.Match]


def train(
    config: TrainingConfig,
    venv: VecEnv,
    facts: EnvFacts,
    folder: Path,
    checkpoint: Checkpoint | None = None,
    deadline: Deadline | None = None,
) -> tuple[BaseAlgorithm, Curve]:
    """Train until the steps or the time are over; leaves policies and the curve in ``folder``.

    Args:
        config: resolved.
        venv: the workers, or the learning agents of their worlds.
        facts: of their environment.
        folder: where to write; exists.
        checkpoint: from which to go on, and which to keep up; None for a training run that cannot be resumed.
        deadline: when to end before all steps, or None.

    Raises:
        ConfigError: the checkpoint has more steps than the configuration sets.
    """
    model = begin(config, venv, facts, checkpoint)
    return model, learn(config, model, folder, checkpoint, deadline)


def train_single(
    config: TrainingConfig, workers: VecEnv, facts: EnvFacts, folder: Path, checkpoint: Checkpoint | None
) -> tuple[Curve, Results]:
    """Train and evaluate one agent."""
    model, curve = train(config, workers, facts, folder, checkpoint)
    episodes, first_seed = config.evaluation.episodes, config.evaluation.first_seed
    players = baselines(len(facts.action_names), first_seed) | {"trained": policy_agent(model)}
    return curve, [
        evaluate(name, agent, workers, episodes, first_seed, motions=facts.motions) for name, agent in players.items()
    ]


def train_cooperative(
    config: TrainingConfig, workers: VecEnv, facts: EnvFacts, folder: Path, checkpoint: Checkpoint | None
) -> tuple[Curve, Results]:
    """Train and evaluate agents with a common aim: one policy for all, which all learn."""
    model, curve = train(config, AgentVecEnv(workers), facts, folder, checkpoint)
    return curve, matches.play_cooperative(config, model, workers)


def train_selfplay(
    config: TrainingConfig, workers: VecEnv, facts: EnvFacts, folder: Path, checkpoint: Checkpoint | None
) -> tuple[Curve, Results]:
    """Train and evaluate agents that compete: one policy for all, against itself and its snapshots."""
    venv = AgentVecEnv(workers, config.selfplay.num_duels(workers.num_envs))
    model = begin(config, venv, facts, checkpoint)
    snapshots = selfplay.enter(config.selfplay, venv, model, folder, pool_of(checkpoint))
    curve = learn(config, model, folder, checkpoint, watchers=[snapshots])
    return curve, matches.play_matches(config, model, snapshots.pool, workers)


def pool_of(checkpoint: Checkpoint | None) -> list[int]:
    """Return the steps of the snapshots that a resumed training plays against; empty for a new one."""
    resumed = checkpoint is not None and checkpoint.state is not None
    return checkpoint.state["envs"]["folded"]["pool"] if resumed else []


@dataclass(frozen=True)
class Options:
    """Train agents and evaluate them."""

    #: YAML file with what differs from the defaults
    config: tyro.conf.Positional[Path]
    #: settings that override the file: total_steps=1000 env.fidelity=tiny ppo.discount=0.95
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: folder to write to; by default runs/ and the name of the file
    out: Path | None = None
    #: where to simulate
    device: str = "cpu"
    #: go on from the folder's checkpoint; where there is none, begin
    resume: bool = False


def run(config: TrainingConfig, folder: Path, device: str, resume: bool, again: str) -> None:
    """Train, or resume a training run, and evaluate.

    Args:
        config: resolved.
        folder: where to write; nothing in it changes before all that can be refused has been.
        device: where to simulate.
        resume: whether to go on from the folder's checkpoint.
        again: command line that resumes this training.

    Raises:
        ConfigError: the folder is another run's, the checkpoint does not fit, or the configuration does not fit
            the environment or the device.
        Diverged: the networks are not finite any more.
        OSError: something cannot be written.
        SystemExit: Ctrl-C, in one line.
    """
    learns = train_selfplay if config.selfplay else train_cooperative if config.is_multi else train_single
    with made(folder):
        checkpoint = Checkpoint(folder, "sb3.train", config, device, resume)
        make = factory(config, device)
        facts = prepare(make)
        components(facts.layout, config.observe)
        try:
            workers = start(config, make, device)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        try:
            with ended_by_interrupt(partial(checkpoint.remedy, again)):
                curve, results = learns(config, workers, facts, folder, checkpoint)
        finally:
            workers.close()
    bands = {result.agent: result.estimate() for result in results if isinstance(result, Evaluation)}
    draw_curve(folder / "curve.png", curve.steps, curve.returns, bands, config.env_id)
    about = versions("sb3.train", device) | {"seed": config.seed, "config": config.model_dump(mode="json")}
    cost = {"training_s": curve.seconds, "train_steps": curve.train_steps}
    files = "policy.zip, curve.png, curve.csv, config.yaml, results.json, checkpoints/, tensorboard/"
    files += ", pool/" if config.selfplay else ""
    conclude(folder, about, results, {**cost, "agents": facts.agents}, files)


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    options = read_options(Options, "sb3.train", args)
    quiet_warp()
    try:
        config = load_training(options.config, parse_assignments(options.settings))
        check_device(options.device)
    except ValueError as error:
        sys.exit(f"error: {error}{script_hint(options.config, 'sb3.train')}")
    again = command("sb3.train", args, "--resume")
    try:
        with ended_by_interrupt(lambda: f"before the training; begin again with {again}"):
            run(config, options.out or Path("runs") / options.config.stem, options.device, options.resume, again)
    except (ConfigError, Diverged, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
