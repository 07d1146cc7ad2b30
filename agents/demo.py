"""``make demo``: PPO learns to reach on the CPU in ten minutes at most, from untrained to filmed.

Plays zero, random and scripted actions, trains, plays the trained policy in the same episodes, and leaves in
``runs/demo``: policy.zip, curve.png, before_after.mp4, config.yaml and results.json.
"""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console

from agents.checkpoint import Diverged
from agents.command import one_line_errors, read_options
from agents.evaluate import Evaluation, baselines, evaluate, separated
from agents.files import RESULTS, claim, hold
from agents.play import film
from agents.reach_ik import ReachIK
from agents.report import draw_curve, show_table, versions, write_results
from agents.sb3 import ppo
from agents.sb3.config import TrainingConfig, load_training
from agents.sb3.policy import policy_agent
from agents.sb3.train import train
from agents.sb3.workers import EnvFacts, components, factory, prepare, start_workers
from piavatar_envs.config import ConfigError, parse_assignments
from piavatar_envs.sim.world import check_device

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "sb3" / "reach_ppo.yaml"
FILM_EPISODES = 2
#: Files that appear after the training.
LATER = ("policy.zip", "curve.csv", "curve.png", "before_after.mp4")
_RESERVE = 1.25  # margin on the estimated time after the training
_FRAME = 0.1  # rendering and encoding a frame whose halves are drawn in parallel, on slow cores [s]


@dataclass(frozen=True)
class Options:
    """Train PPO on Reach on the CPU, and show what it has learned."""

    #: settings that win over configs/sb3/reach_ppo.yaml: total_steps=1000 env.fidelity=tiny
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: folder to write to
    out: Path = Path("runs/demo")
    #: of the networks and the training episodes
    seed: int = 0
    #: where to simulate
    device: str = "cpu"
    #: time for everything [s]; the training ends early where the machine is too slow for all steps
    seconds: float = 570.0
    #: leave the video out
    video: bool = True


@dataclass(frozen=True)
class Outcome:
    """Result of a demo.

    Attributes:
        evaluations: of zero, random, scripted and trained actions, in this order.
        train_steps: control steps trained for.
        train_steps_per_s: speed of the training, over all workers.
        train_s, total_s: time of the training and of everything [s].
        separated: whether the trained policy's interval lies wholly above that of zero and of random actions.
    """

    evaluations: tuple[Evaluation, ...]
    train_steps: int
    train_steps_per_s: float
    train_s: float
    total_s: float
    separated: bool


def run(options: Options, console: Console) -> Outcome:
    """Run all of ``make demo``.

    Raises:
        ConfigError: a setting that is unknown, of the wrong type or out of range; or the folder is not the demo's.
        ValueError: there is no such device.
        OSError: something cannot be written.
    """
    begun = time.monotonic()
    config = demonstrated(options)
    claim(options.out, "demo", own=("policy.zip",))
    make = factory(config, options.device)
    with console.status("compiling kernels (once; they are cached)"):
        facts = prepare(make)
    seen = components(facts.layout, config.observe)
    options.out.mkdir(parents=True, exist_ok=True)
    hold(options.out)
    console.print(f"{config.env_id}: kernels ready after {time.monotonic() - begun:.0f} s")
    venv = start_workers(make, config.num_workers)
    try:
        references = play_references(config, venv, facts)
        # marks the folder as a demo's, which the next demo may replace, even if this one is stopped
        about = versions("demo", options.device) | {"seed": config.seed, "config": config.model_dump(mode="json")}
        write_results(options.out / RESULTS, about, [evaluation for evaluation, _ in references], {})
        for name in LATER:  # files of an earlier demo do not belong to this one's figures
            (options.out / name).unlink(missing_ok=True)
        deadline = begun + options.seconds - _RESERVE * _time_after(options, config, facts, references)
        untrained = ppo.build(config.ppo, venv, seen, config.seed)
        before = policy_agent(copy.deepcopy(untrained.policy))
        model, curve = train(config, venv, facts, options.out, deadline=deadline)
        if model.num_timesteps < config.total_steps:
            console.print(
                f"training ended after {model.num_timesteps} of {config.total_steps} steps, because the demo may take "
                f"{options.seconds:g} s on this machine; python -m agents.demo --seconds {3.0 * options.seconds:g} "
                "gives it more"
            )
        trained, _ = _timed_play("trained", policy_agent(model), config, venv)
    finally:
        venv.close()
    references = [evaluation for evaluation, _ in references]
    estimates = {evaluation.agent: evaluation.estimate() for evaluation in (*references, trained)}
    draw_curve(options.out / "curve.png", curve.steps, curve.returns, estimates, f"PPO on {config.env_id}")
    if options.video:
        first = config.evaluation.first_seed
        agents = {"before training": before, "after": policy_agent(model)}
        seeds = range(first, first + FILM_EPISODES)
        film(options.out / "before_after.mp4", make, agents, seeds, 1.0 / facts.control_dt)
    outcome = Outcome(
        evaluations=(*references, trained),
        train_steps=model.num_timesteps,
        train_steps_per_s=model.num_timesteps / curve.seconds,
        train_s=curve.seconds,
        total_s=time.monotonic() - begun,
        separated=separated(trained, references[:2]),
    )
    figures = {key: value for key, value in vars(outcome).items() if key != "evaluations"}
    write_results(options.out / RESULTS, about, outcome.evaluations, figures)
    return outcome


def demonstrated(options: Options) -> TrainingConfig:
    """Return the resolved configuration of the demo.

    Raises:
        ConfigError: a setting that is unknown, of the wrong type or out of range, or that makes it no demo of Reach by
            PPO; or there is no time.
        ValueError: there is no such device.
    """
    if not options.seconds > 0.0:
        raise ConfigError(f"seconds={options.seconds} must be > 0")
    check_device(options.device)
    config = load_training(CONFIG, {"seed": options.seed, **parse_assignments(options.settings)})
    shown = load_training(CONFIG)
    for name in ("env_id", "sac", "vector", "selfplay"):
        if getattr(config, name) != getattr(shown, name):
            raise ConfigError(
                f"{name}={getattr(config, name)!r}: the demo is of PPO on {shown.env_id} in processes; train others by "
                "python -m agents.sb3.train"
            )
    if config.env["control"]["mode"] != "pose":
        raise ConfigError(
            f"env.control.mode={config.env['control']['mode']!r} must be 'pose': the scripted agent of the demo poses"
        )
    return config


def _timed_play(name: str, agent, config: TrainingConfig, venv) -> tuple[Evaluation, float]:
    start = time.monotonic()
    played = evaluate(name, agent, venv, config.evaluation.episodes, config.evaluation.first_seed)
    return played, time.monotonic() - start


def play_references(config: TrainingConfig, venv, facts: EnvFacts) -> list[tuple[Evaluation, float]]:
    """Evaluate the agents that the trained policy is compared with, and return the time that each took [s]."""
    size = len(facts.action_names)
    agents = {
        **baselines(size, config.evaluation.first_seed),
        "scripted IK": ReachIK(facts.layout, facts.action_names, facts.action_step, facts.control_dt),
    }
    return [_timed_play(name, agent, config, venv) for name, agent in agents.items()]


def _time_after(
    options: Options, config: TrainingConfig, facts: EnvFacts, references: list[tuple[Evaluation, float]]
) -> float:
    """Estimate the time of the evaluation and video after the training, from the time of the references [s]."""
    episode = max(e.steps for evaluation, _ in references for e in evaluation.episodes)
    one = float(np.median([seconds for _, seconds in references]))  # the first also waits for the workers
    if not options.video:
        return one
    # the workers play an episode each at a time, the film two
    step = one / (config.evaluation.episodes * episode)
    return one + FILM_EPISODES * episode * (2.0 * step + _FRAME)


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    options = read_options(Options, "demo", args)
    console = Console(highlight=False, soft_wrap=True)
    with one_line_errors(ValueError, Diverged, OSError):
        outcome = run(options, console)
    show_table(outcome.evaluations, console)
    verdict = "lies above" if outcome.separated else "does NOT lie above"
    console.print(f"The trained policy's interval {verdict} those of zero and of random actions.")
    console.print(
        f"{outcome.train_steps} steps of training in {outcome.train_s:.0f} s "
        f"({outcome.train_steps_per_s:.0f} a second), {outcome.total_s:.0f} s in all"
    )
    files = "policy.zip, curve.png, before_after.mp4, config.yaml, results.json"
    console.print(
        f"in {options.out}: {files}"
        if options.video
        else f"in {options.out}: {files.replace(' before_after.mp4,', '')}"
    )


if __name__ == "__main__":
    main()
