"""Scores of the PID agent on a task: ``python -m agents.pid.score PIAvatar/Stand-v0 --film stand.gif``.

Plays the episodes that trained agents are evaluated in, beside zero and random torques, and leaves ``results.json``,
which ``agents.scores`` takes as it takes those of training runs.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

import tyro

from agents.command import one_line_errors, read_options
from agents.config import EvaluationSettings
from agents.evaluate import for_all_seats, play_with_baselines
from agents.files import claim, write_config
from agents.pid.agent import Design, make_pid_agent
from agents.play import check_film, film
from agents.report import conclude, versions
from agents.sb3.workers import EnvFactory
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.config import load_config, parse_assignments
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.tasks import listed_name, load_task


@dataclass(frozen=True)
class Options:
    """Score the PID agent on a task with one avatar."""

    #: registered id
    env_id: tyro.conf.Positional[str]
    #: settings of the environment: physics.fidelity=coarse control.root_assist=0.1
    settings: tyro.conf.Positional[tuple[str, ...]] = ()
    #: how many episodes, and from which seed on
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    #: numbers of the controller
    design: Design = field(default_factory=Design)
    #: folder to write to; by default runs/pid_ and the name of the task
    out: Path | None = None
    #: where to simulate
    device: str = "cpu"
    #: video of the first episode to write, .mp4 or .gif
    film: Path | None = None
    #: control steps between two of its pictures
    film_every: int = 1


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    options = read_options(Options, "pid.score", args)
    quiet_warp()
    episodes, first = options.evaluation.episodes, options.evaluation.first_seed
    env_id = listed_name(options.env_id)
    folder = options.out or Path("runs") / f"pid_{env_id.rpartition('/')[2].removesuffix('-v0')}"
    with one_line_errors(ValueError):
        check_film(options.film, options.film_every)
        claim(folder, "pid.score")
        task_class = load_task(env_id)
        config = load_config(task_class.Config, {"control": "torque"}, parse_assignments(options.settings))
        agent = make_pid_agent(env_id, config.model_dump(mode="json"), options.design)
        batch = EpisodeHost(task_class(config), episodes, options.device)
    results = play_with_baselines("PID", for_all_seats(agent), batch, first)
    batch.close()
    settings = {"env_id": env_id, "env": config.model_dump(mode="json"), "design": asdict(options.design)}
    about = versions("pid.score", options.device) | {"seed": 0, "config": settings}
    with one_line_errors(OSError, ImportError):
        folder.mkdir(parents=True, exist_ok=True)
        write_config(folder, config)
        conclude(folder, about, results, {}, "config.yaml, results.json")
        if options.film:
            make = EnvFactory(env_id, config.model_dump(mode="json"), options.device)
            film(options.film, make, {"PID": agent}, [first], 1.0 / config.physics.control_dt, options.film_every)
            print(f"wrote {options.film}")


if __name__ == "__main__":
    main()
