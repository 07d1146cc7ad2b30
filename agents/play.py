"""Let what a training run has left play again: ``python -m agents.play runs/stand_rsl --film stand.gif``.

Takes the folder of a run with one agent, by ``agents.rsl_rl.train`` or ``agents.rllib.train`` (policy.pt), or by
``agents.sb3.train`` (policy.zip), builds the environment of its config.yaml, and plays the episodes of its evaluation.
Of an interrupted training run it takes the policy in the checkpoint. With ``--film`` or ``--export`` alone it plays no
others; with ``--live`` it plays in a web browser instead, until Ctrl-C. Nothing in the files is unpickled.

A video of one agent, or of two in the same episodes side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from agents.checkpoint import read_checkpoint
from agents.command import one_line_errors, read_options
from agents.config import EvaluationSettings, changed, check_imports
from agents.evaluate import Agent, Seen, begin_round, each_array, for_all_seats, play
from agents.files import CHECKPOINT, RESULTS, check_figures
from agents.report import show_table, versions, write_results
from agents.sb3.config import load_training
from agents.sb3.workers import EnvFactory, start_workers
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import ConfigError, load_config, parse_assignments, read_yaml
from piavatar_envs.config import replace as replace_settings
from piavatar_envs.core.rng import check_seeds
from piavatar_envs.core.writing import check_writable
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.envs.observations import ObservationLayout
from piavatar_envs.envs.task import Task
from piavatar_envs.export import Recording, check_recording
from piavatar_envs.render import label, side_by_side, write_video
from piavatar_envs.render.video import check_suffix
from piavatar_envs.tasks import load_task


@dataclass(frozen=True)
class Run:
    """A training run, finished or interrupted, as read from its folder.

    Attributes:
        env_id: registered id.
        env: settings of the environment, resolved.
        evaluation: of the training.
        observe: terms of the observation that the policy sees; None for all.
        make_agent: the agent, from the layout of the observation and the length of an action; its observations are
            ``(num_envs, 1, size)``, or as :func:`agents.evaluate.seen_by` returns them.
    """

    env_id: str
    env: dict[str, Any]
    evaluation: EvaluationSettings
    observe: tuple[str, ...] | None
    make_agent: Callable[[ObservationLayout, int], Agent]


def open_run(folder: Path, device: str = "cpu", imports: Collection[str] = ()) -> Run:
    """Open a run by its folder.

    Args:
        folder: with config.yaml and policy.pt, policy.zip or, of an interrupted training run, checkpoint.pt.
        device: torch's, where a policy of rsl_rl computes.
        imports: modules that the id of its environment may import.

    Raises:
        ConfigError: there is no such folder, it holds no such run, the files do not fit each other, or it would import
            another module.
    """
    if not folder.is_dir():
        raise ConfigError(f"no folder {folder}; give the one that a training run has left, as in runs/")
    settings, kinds = folder / "config.yaml", {"policy.pt": _open_torch, "policy.zip": _open_sb3}
    found = [folder / name for name in (*kinds, CHECKPOINT) if (folder / name).is_file()]
    if not settings.is_file() or not found:
        raise ConfigError(
            f"{folder} must hold config.yaml and {', '.join(kinds)} or {CHECKPOINT}, as a training run leaves them"
        )
    check_imports(read_yaml(settings).get("env_id", ""), settings, imports)
    # of a training run that was resumed and interrupted, the checkpoint is the newer one
    latest = max(found, key=lambda path: (path.stat().st_mtime, path.name != CHECKPOINT))
    if latest.name == CHECKPOINT:
        return _open_interrupted(settings, latest, device)
    return kinds[latest.name](settings, latest, device)


def _open_interrupted(settings: Path, checkpoint: Path, device: str) -> Run:
    about = read_checkpoint(checkpoint)["about"]
    kinds = {"rsl_rl.train": _open_rsl, "rllib.train": _open_rllib, "sb3.train": _open_sb3}
    if about["script"] not in kinds:
        raise ConfigError(f"{checkpoint} is of agents.{about['script']}, which trains several agents; this plays one")
    return kinds[about["script"]](settings, checkpoint, device)


def _open_torch(settings: Path, policy: Path, device: str) -> Run:
    """Open the run of a ``policy.pt``, whose library its settings tell."""
    return (_open_rllib if "env_runners" in read_yaml(settings) else _open_rsl)(settings, policy, device)


def _open_rllib(settings: Path, policy: Path, _device: str) -> Run:
    from agents.rllib.policy import load_agent, load_rllib

    config = load_rllib(settings)
    _check_single("/" in config.env_id, config.env_id, settings)
    return Run(
        config.env_id,
        dict(config.env),
        config.evaluation,
        config.observe,
        lambda layout, size: load_agent(policy, config, layout, size),
    )


def _open_rsl(settings: Path, policy: Path, device: str) -> Run:
    from agents.rsl_rl.policy import load_agent, load_rsl  # needs the extra rsl

    config = load_rsl(settings)
    return Run(
        config.env_id,
        dict(config.env),
        config.evaluation,
        config.observe,
        lambda layout, size: load_agent(policy, config, layout, size, device),
    )


def _open_sb3(settings: Path, policy: Path, _device: str) -> Run:
    from agents.sb3.policy import load_agent

    config = load_training(settings)
    _check_single(not config.is_multi, config.env_id, settings)
    return Run(
        config.env_id,
        dict(config.env),
        config.evaluation,
        config.observe,
        lambda layout, size: for_all_seats(load_agent(policy, config, layout, size)),
    )


def _check_single(single: bool, env_id: str, settings: Path) -> None:
    if not single:
        raise ConfigError(f"{settings}: env_id={env_id!r} is a world of several agents; this plays one")


@dataclass(frozen=True)
class Options:
    """Play the policy of a training run, finished or interrupted."""

    #: folder of the run
    run: tyro.conf.Positional[Path]
    #: settings of the environment that override the run's: fidelity=tiny, or as for the training env.fidelity=tiny
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: episodes to score, by default as many as the training's evaluation has, or none with --film or --export alone
    episodes: int | None = None
    #: seed of the first episode, by default that of the training's evaluation
    first_seed: int | None = None
    #: where to simulate
    device: str = "cpu"
    #: module of a task of your own, which the run may import
    imports: tuple[str, ...] = ()
    #: JSON file for the figures
    out: Path | None = None
    #: video to write, .mp4 or .gif
    film: Path | None = None
    #: episodes in the video
    film_episodes: int = 1
    #: control steps between two of its pictures
    film_every: int = 1
    #: folder for the meshes of the same episodes, frame by frame, for Blender and other programs
    export: Path | None = None
    #: of those files; usd needs the extra usd
    format: Literal["glb", "ply", "usd"] = "glb"
    #: play one episode after the other in a web browser until Ctrl-C, instead of evaluating (needs the extra live)
    live: bool = False
    #: port of that view on this machine, or the next one that is free
    port: int = 8080


def check_options(options: Options) -> None:
    """Refuse options that are wrong whatever the run is.

    Raises:
        ConfigError: options that do not go together, no episodes, no pictures, or files that cannot be written.
        ImportError: the extra ``usd`` is not installed, for that format.
        ValueError: a seed that there is not, what is not a video by its name, or a folder that holds something.
    """
    if options.live and (options.out or options.film or options.export or options.episodes is not None):
        others = "--out, --film, --export and --episodes"
        raise ConfigError(f"--live plays until Ctrl-C and evaluates nothing; leave out {others}")
    if options.episodes is not None and options.episodes < 2:
        advice = "of one there is no interval; a film alone needs no --episodes"
        raise ConfigError(f"episodes={options.episodes} must be >= 2: {advice}")
    if options.out and (options.out.suffix != ".json" or options.out.name == RESULTS):
        raise ConfigError(f"out={options.out} must be a .json file of its own, and {RESULTS} is the training's")
    if options.out:
        check_figures(options.out, "play")
    check_film(options.film, options.film_every, options.film_episodes)
    if options.export:
        check_recording(options.export, options.format)
    if options.first_seed is not None:
        check_seeds(options.first_seed, name="first_seed")


def environment(run: Run, assignments: Sequence[str]) -> Task:
    """Build the task of a run's environment, with settings that override those of the training.

    Raises:
        ConfigError: a setting is unknown, given twice or out of range, or makes another environment of it than the one
            that the policy was trained for: it would play nonsense.
    """
    given = [assignment.removeprefix("env.") for assignment in assignments]
    task_class = load_task(run.env_id)
    learnt = load_config(task_class.Config, run.env)
    trained = task_class(replace_settings(learnt, obs_mode="pixels+state" if learnt.observes_pixels else "flat"))
    task = task_class(load_config(task_class.Config, trained.config, parse_assignments(given)))
    if unlike := changed(trained, task, run.observe):
        alone = [one for one in given if _changes_alone(trained, one, run.observe)]
        raise ConfigError(
            f"{' '.join(alone or given)} changes {', '.join(unlike)}: the policy was trained for other ones; leave it "
            "out, or train a policy with it"
        )
    return task


def _changes_alone(trained: Task, assignment: str, observe: Collection[str] | None) -> bool:
    """Return whether a setting alone changes what the policy was made for."""
    try:
        config = load_config(type(trained.config), trained.config, parse_assignments([assignment]))
        return bool(changed(trained, type(trained)(config), observe))
    except ConfigError:
        return False  # it needs another one, which is to blame then


def first_seed(run: Run, options: Options) -> int:
    """Return the seed of the first episode."""
    return run.evaluation.first_seed if options.first_seed is None else options.first_seed


def watch_run(run: Run, env: dict[str, Any], options: Options) -> None:
    """Show the agent in a web browser until Ctrl-C.

    Args:
        run: what the training has left.
        env: settings of the environment, resolved.
        options: of the command line.

    Raises:
        ConfigError: the files do not fit each other.
        ImportError: the extra ``live`` is not installed.
        ValueError: an unknown device, or a port out of range.
    """
    from agents.live import policy_kind
    from piavatar_envs.live.agents import agent_kinds
    from piavatar_envs.live.setup import Setup
    from piavatar_envs.watch import watch_setup

    name = options.run.name
    setup = Setup(run.env_id, {"config": env}, name, seed=first_seed(run, options), device=options.device)
    watch_setup(setup, {**agent_kinds(run.env_id), name: policy_kind(run)}, options.port)


def act_alone(agent: Agent, observation: Seen) -> np.ndarray:
    """Return the action of an agent in a single environment, for the observation that this gives."""
    return agent(each_array(lambda own: own[None, None], observation))[0, 0]


def score_run(agent: Agent, batch: EpisodeHost, first: int, options: Options, env: dict[str, Any]) -> None:
    """Play an episode in every environment of a batch, show the figures, and write them if asked for.

    Args:
        agent: what the training has left.
        batch: of NumPy arrays.
        first: seed of the first episode.
        options: of the command line.
        env: settings of the environment, resolved.
    """
    evaluation = play("trained", agent, batch, first)
    show_table([evaluation], Console(highlight=False, soft_wrap=True))
    if options.out:
        about = versions("play", options.device) | {"run": options.run.resolve().name, "env": env}
        write_results(options.out, about, [evaluation], {"num_envs": batch.num_envs})


def film_run(run: Run, agent: Agent, seconds: float, first: int, options: Options, env: dict[str, Any]) -> None:
    """Film episodes; arguments as for :func:`score_run`, and ``seconds``, the time of a control step."""
    make = EnvFactory(run.env_id, env, options.device)
    alone = {options.run.name: lambda observation: agent(each_array(lambda own: own[:, None], observation))[:, 0]}
    film(options.film, make, alone, range(first, first + options.film_episodes), 1.0 / seconds, options.film_every)
    print(f"wrote {options.film}")


def export_run(run: Run, first: int, options: Options, env: dict[str, Any]) -> None:
    """Write the meshes of the episodes of a film; arguments as for :func:`film_run`."""
    made = EnvFactory(run.env_id, env, options.device)()
    agent = run.make_agent(made.unwrapped.observation_layout, made.action_space.shape[0])
    try:
        recording = Recording(made, options.export, options.format)
        for seed in tqdm(range(first, first + options.film_episodes), desc="export", unit="episode"):
            begin_round(agent, 1)
            (observation, _), over = made.reset(seed=seed), False
            recording.add()
            while not over:
                observation, _, terminated, truncated, _ = made.step(act_alone(agent, observation))
                recording.add()
                over = terminated or truncated
        paths = recording.finish()
    finally:
        made.close()
    print("wrote", *paths)


def film(
    path: Path, make: EnvFactory, agents: dict[str, Agent], seeds: Sequence[int], fps: float, every: int = 1
) -> Path:
    """Write a video in which all agents play the episodes ``seeds``; two have a process each.

    Args:
        path: ``.mp4`` or ``.gif``.
        make: makes the environments.
        agents: one or two of them, by the text that stands in their half.
        seeds: of the episodes.
        fps: control steps per second, so that the video runs as fast as life.
        every: control steps between two pictures.

    Raises:
        ImportError: the extra ``render`` is not installed.
        ValueError: no agents, or more than two.
    """
    if len(agents) not in (1, 2):
        raise ValueError(f"{len(agents)} agents; a film shows one, or two side by side")
    halves = start_workers(replace(make, render_mode="rgb_array"), len(agents))
    try:
        return write_video(path, _frames(halves, agents, seeds, every), fps / every)
    finally:
        halves.close()


def check_film(path: Path | None, every: int, episodes: int = 1) -> None:
    """Refuse a video without pictures, or one that cannot be written.

    Raises:
        ConfigError: ``every`` or ``episodes`` is less than 1, or nothing can be written there.
        ValueError: an unknown suffix.
    """
    for name, value in (("film_every", every), ("film_episodes", episodes)):
        if value < 1:
            raise ConfigError(f"{name}={value} must be >= 1")
    if path is not None:
        check_suffix(path)
        check_writable(path)


def _frames(halves: VecEnv, agents: dict[str, Agent], seeds: Sequence[int], every: int) -> Iterator[np.ndarray]:
    for seed in tqdm(seeds, desc="film", unit="episode"):
        for agent in agents.values():
            begin_round(agent, 1)
        started = [first for first, _ in halves.env_method("reset", seed=int(seed))]
        observation = each_array(lambda *rows: np.stack(rows), *started)
        totals, playing = np.zeros(len(agents)), np.ones(len(agents), bool)
        shown: list[np.ndarray] = []
        for step in count():
            if step % every == 0:
                pictures = halves.env_method("render")
                # a half that has ended stands still until the other one has
                shown = [pictures[i] if playing[i] else shown[i] for i in range(len(agents))]
                texts = [f"{name}: {round(float(total))}" for name, total in zip(agents, totals, strict=True)]
                labelled = [label(picture, text) for picture, text in zip(shown, texts, strict=True)]
                yield side_by_side(*labelled) if len(agents) == 2 else labelled[0]
            rows = [each_array(lambda own, i=i: own[i : i + 1], observation) for i in range(len(agents))]
            action = np.stack([agent(row)[0] for agent, row in zip(agents.values(), rows, strict=True)])
            observation, rewards, dones, _ = halves.step(action)
            totals += rewards * playing
            playing &= ~dones
            if not playing.any():
                break


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    options = read_options(Options, "play", args)
    quiet_warp()
    scores = not (options.film or options.export) or options.out is not None or options.episodes is not None
    with one_line_errors(ValueError, ImportError):
        check_options(options)
        run = open_run(options.run, options.device, options.imports)
        task = environment(run, options.settings)
        env = task.config.model_dump(mode="json")
        if options.live:
            watch_run(run, env, options)
            return
        episodes = (options.episodes or run.evaluation.episodes) if scores else 1
        first = first_seed(run, options)
        check_seeds(first, max(episodes, options.film_episodes), "first_seed")
        batch = EpisodeHost(task, episodes, options.device)
        agent = run.make_agent(batch.layout, batch.action_size)
    with one_line_errors(OSError, ImportError):
        if scores:
            score_run(agent, batch, first, options, env)
        batch.close()
        if options.film:
            film_run(run, agent, task.config.physics.control_dt, first, options, env)
        if options.export:
            export_run(run, first, options, env)


if __name__ == "__main__":
    main()
