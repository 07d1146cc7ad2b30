"""``make demo``: PPO learns to reach on the CPU in ten minutes at most, from untrained to filmed.

Trains, plays zero, random, scripted and trained actions in the same episodes, and leaves in ``runs/demo``: policy.zip,
curve.png, before_after.mp4, config.yaml and results.json. The exit status is 1 if nothing was learned.
"""

from __future__ import annotations

import copy
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from agents.checkpoint import Diverged
from agents.command import one_line_errors, read_options
from agents.evaluate import Evaluation, baselines, evaluate, separated
from agents.files import RESULTS, claim, hold
from agents.interrupt import StopRequest, command, ended_by_interrupt
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
#: Agents that are compared: zero, random, scripted and trained actions.
PLAYED = 4
#: Files that appear after the training.
LATER = ("policy.zip", "curve.csv", "curve.png", "before_after.mp4")
_RESERVE = 1.25  # margin on the estimated time after the training
_FRAME = 0.1  # rendering and encoding a frame whose halves are drawn in parallel, on slow cores [s]


@dataclass(frozen=True)
class Options:
    """Train PPO on Reach on the CPU, and show what it has learned."""

    #: settings that override configs/sb3/reach_ppo.yaml: total_steps=1000 env.fidelity=tiny
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: folder to write to
    out: Path = Path("runs/demo")
    #: of the networks and the training episodes
    seed: int = 0
    #: where to simulate
    device: str = "cpu"
    #: time for everything [s]; the training ends early where the machine is too slow, after half of it at the earliest
    seconds: float = 570.0
    #: write a video of the arms before and after
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


def run(options: Options, console: Console, stop: StopRequest | None = None) -> Outcome:
    """Run all of ``make demo``.

    Args:
        options: of the command line.
        console: where to report.
        stop: by which the training ends with a policy.

    Raises:
        KeyboardInterrupt: Ctrl-C; if it was in the training, the policy is there.
        ConfigError: a setting that is unknown, of the wrong type or out of range; or the folder is not the demo's.
        ValueError: there is no such device.
        OSError: something cannot be written.
    """
    begun, stop = time.monotonic(), stop or StopRequest()
    config = demonstrated(options)
    claim(options.out, "demo", own=("policy.zip",))
    make = factory(config, options.device)
    console.print(
        f"{config.env_id}: PPO trains the arms for {config.total_steps} steps; all takes about {options.seconds:g} s"
    )
    facts = prepare(make)
    seen = components(facts.layout, config.observe)
    options.out.mkdir(parents=True, exist_ok=True)
    hold(options.out)
    venv = start_workers(make, config.num_workers)
    try:
        # marks the folder as a demo's, which the next demo may replace, even if this one is stopped
        about = versions("demo", options.device) | {"seed": config.seed, "config": config.model_dump(mode="json")}
        write_results(options.out / RESULTS, about, [], {})
        for name in LATER:  # files of an earlier demo do not belong to this one's figures
            (options.out / name).unlink(missing_ok=True)
        untrained = ppo.build(config.ppo, venv, seen, config.seed)
        before = policy_agent(copy.deepcopy(untrained.policy))

        def deadline(steps: int, seconds: float) -> float:
            if stop.made:
                return begun
            after = _RESERVE * time_after(options, config, facts, seconds / max(1, steps))
            return max(begun + options.seconds - after, started + 0.5 * options.seconds)

        started = time.monotonic()
        with stop.listening():
            model, curve = train(config, venv, facts, options.out, deadline=deadline)
        stop.obey(f"{model.num_timesteps} of {config.total_steps} steps")
        if model.num_timesteps < config.total_steps:
            console.print(
                f"training ended after {model.num_timesteps} of {config.total_steps} steps, because the demo may take "
                f"{options.seconds:g} s on this machine; python -m agents.demo --seconds {3.0 * options.seconds:g} "
                "gives it more"
            )
        references = play_references(config, venv, facts)
        trained = _play("trained", policy_agent(model), config, venv)
    finally:
        venv.close()
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


def _play(name: str, agent, config: TrainingConfig, venv) -> Evaluation:
    return evaluate(name, agent, venv, config.evaluation.episodes, config.evaluation.first_seed)


def play_references(config: TrainingConfig, venv, facts: EnvFacts) -> list[Evaluation]:
    """Evaluate the agents that the trained policy is compared with."""
    size = len(facts.action_names)
    agents = {
        **baselines(size, config.evaluation.first_seed),
        "scripted IK": ReachIK(facts.layout, facts.action_names, facts.action_step, facts.control_dt),
    }
    return [_play(name, agent, config, venv) for name, agent in agents.items()]


def time_after(options: Options, config: TrainingConfig, facts: EnvFacts, step: float) -> float:
    """Estimate the time of the evaluations and the video after the training [s].

    Args:
        options: of the demo.
        config: resolved.
        facts: of the environment.
        step: time of the training per control step [s], over all workers.
    """
    episode = config.env["episode_seconds"] / facts.control_dt
    evaluations = PLAYED * config.evaluation.episodes * episode * step
    # the workers play an episode each at a time, the film two
    return evaluations + (FILM_EPISODES * episode * (2.0 * step + _FRAME) if options.video else 0.0)


def main(args: list[str] | None = None) -> None:
    """Run the command line; the exit status is 1 if nothing was learned."""
    options = read_options(Options, "demo", args)
    console = Console(highlight=False, soft_wrap=True)

    stop = StopRequest()

    def remedy() -> str:
        again = f"begin anew with {command('demo', args)}"
        if not stop.reached:
            return f"before the end; {again}"
        return f"after {stop.reached}; play what it has learned with python -m agents.play {options.out}, or {again}"

    with ended_by_interrupt(remedy), one_line_errors(ValueError, Diverged, OSError):
        outcome = run(options, console, stop)
    show_table(outcome.evaluations, console)
    verdict = "lies above" if outcome.separated else "does NOT lie above"
    console.print(f"The trained policy's interval {verdict} those of zero and of random actions.")
    console.print(
        f"{outcome.train_steps} steps of training in {outcome.train_s:.0f} s "
        f"({outcome.train_steps_per_s:.0f} a second), {outcome.total_s:.0f} s in all"
    )
    files = "policy.zip, curve.png, before_after.mp4, config.yaml, results.json"
    console.print(f"in {options.out}: {files if options.video else files.replace(' before_after.mp4,', '')}")
    if not outcome.separated:
        sys.exit(
            f"error: nothing was learned in {outcome.train_steps} steps that shows in "
            f"{len(outcome.evaluations[0].episodes)} episodes; give it more time with --seconds, or more total_steps"
        )


if __name__ == "__main__":
    main()
