"""Train an agent as a configuration says: ``python -m agents.train configs/reach_ppo.yaml --out runs/reach``.

Leaves in the folder: the resolved configuration, checkpoints, the policy, and every training episode's return.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from tqdm import tqdm

from agents import ppo
from agents.config import TrainingConfig, load_training
from agents.evaluate import evaluate, policy_agent
from agents.report import draw_curve, show_table, versions, write_results
from agents.workers import EnvFacts, components, factory, prepare, start_workers
from piavatar_envs.envs.config import ConfigError, dump_yaml, parse_assignments


@dataclass
class Curve:
    """Returns of the training episodes, as they ended.

    Attributes:
        steps: control steps taken by then, over all workers.
        returns: undiscounted returns, of actions that were drawn at random from the policy.
        seconds: time that the training took [s].
    """

    steps: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    seconds: float = 0.0

    def save(self, path: Path) -> None:
        """Write it as CSV."""
        rows = [f"{step},{value:.6g}" for step, value in zip(self.steps, self.returns, strict=True)]
        path.write_text("\n".join(["step,return", *rows]) + "\n", encoding="utf-8")


class Progress(BaseCallback):
    """Books the episodes, shows a bar, and ends the training when its time is over."""

    def __init__(self, curve: Curve, total_steps: int, deadline: float | None) -> None:
        """Watch a training.

        Args:
            curve: where to book.
            total_steps: at which the bar is full.
            deadline: by ``time.monotonic()``, or None.
        """
        super().__init__()
        self.curve, self.total_steps, self.deadline = curve, total_steps, deadline

    def _on_training_start(self) -> None:
        # where nobody watches, a line now and then will do
        interval = 0.5 if sys.stderr.isatty() else 30.0
        self.bar = tqdm(
            total=self.total_steps, initial=self.num_timesteps, desc="train", unit="step", mininterval=interval
        )

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.curve.steps.append(self.num_timesteps)
                self.curve.returns.append(float(info["episode"]["r"]))
                self.bar.set_postfix({"return": f"{np.mean(self.curve.returns[-20:]):.1f}"}, refresh=False)
        self.bar.update(self.num_timesteps - self.bar.n)
        return self.deadline is None or time.monotonic() < self.deadline

    def _on_training_end(self) -> None:
        self.bar.close()


def train(
    config: TrainingConfig,
    venv: VecEnv,
    facts: EnvFacts,
    folder: Path,
    resume: Path | None = None,
    deadline: float | None = None,
) -> tuple[PPO, Curve]:
    """Train until the steps or the time are over; leaves checkpoints and the policy in ``folder``.

    Args:
        config: resolved.
        venv: the workers.
        facts: of their environment.
        folder: where to write; exists.
        resume: a checkpoint to go on from, up to the same total number of steps.
        deadline: by ``time.monotonic()``, or None.

    Raises:
        ValueError: the checkpoint has had all its steps already.
    """
    monitored = VecMonitor(venv)
    if resume is None:
        seen = components(facts.layout, config.observe)
        model = ppo.build(config.ppo, monitored, seen, config.seed)
    else:
        model = ppo.resume(resume, monitored)
    left = config.total_steps - model.num_timesteps
    if left <= 0:
        raise ValueError(
            f"{resume} has had {model.num_timesteps} steps, total_steps={config.total_steps}; ask for more of them"
        )
    curve, start = Curve(), time.monotonic()
    checkpoints = CheckpointCallback(max(1, config.checkpoint_every // venv.num_envs), str(folder / "checkpoints"))
    watch = CallbackList([checkpoints, Progress(curve, config.total_steps, deadline)])
    model.learn(left, callback=watch, reset_num_timesteps=False)
    curve.seconds = time.monotonic() - start
    model.save(folder / "policy.zip")
    curve.save(folder / "curve.csv")
    return model, curve


@dataclass(frozen=True)
class Options:
    """Train an agent and evaluate it."""

    #: YAML file with what differs from the defaults
    config: tyro.conf.Positional[Path]
    #: settings that win over the file: total_steps=1000 env.fidelity=tiny ppo.discount=0.95
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: folder to write to; by default runs/ and the name of the file
    out: Path | None = None
    #: where to simulate
    device: str = "cpu"
    #: checkpoint to go on from
    resume: Path | None = None


def main(args: list[str] | None = None) -> None:
    """The command line."""
    options = tyro.cli(Options, prog="python -m agents.train", args=args)
    console = Console(highlight=False, soft_wrap=True)
    try:
        config = load_training(options.config, parse_assignments(options.settings))
        folder = options.out or Path("runs") / options.config.stem
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "config.yaml").write_text(dump_yaml(config), encoding="utf-8")
        make = factory(config, options.device)
        facts = prepare(make)
        components(facts.layout, config.observe)
    except ConfigError as error:
        sys.exit(f"error: {error}")
    venv = start_workers(make, config.num_workers)
    try:
        model, curve = train(config, venv, facts, folder, options.resume)
        result = evaluate(
            "trained", policy_agent(model), venv, config.evaluation.episodes, config.evaluation.first_seed
        )
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"error: {error}")
    finally:
        venv.close()
    draw_curve(folder / "curve.png", curve.steps, curve.returns, {}, config.env_id)
    write_results(folder / "results.json", versions("train", options.device), [result], {"training_s": curve.seconds})
    show_table([result], console)
    console.print(f"in {folder}: policy.zip, curve.png, curve.csv, config.yaml, results.json, checkpoints/")


if __name__ == "__main__":
    main()
