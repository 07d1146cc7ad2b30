"""The command line: ``python -m piavatar_envs list | doctor | inspect | play | watch | export``.

Each command imports its own modules, so that ``--help`` is quick.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import os
import re
import sys
from collections.abc import Container
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from piavatar_envs.config import BodyColor
from piavatar_envs.core.command_start import again
from piavatar_envs.tasks import NAMESPACE, instead_of, listed_name

EnvId = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ID", help="an id or a module: see list")]
AgentName = Annotated[Literal["random", "zero"], tyro.conf.arg(help="where the actions come from")]
Steps = Annotated[int | None, tyro.conf.arg(help="steps to play, over as many episodes; default one episode")]
Seed = Annotated[int, tyro.conf.arg(help="of the first reset and of the random actions")]
Device = Annotated[str, tyro.conf.arg(help="where to simulate: cpu, cuda, cuda:1, ...")]
AvatarFile = Annotated[Path | None, tyro.conf.arg(help="file of a character; its ending chooses avatar.source")]
Overrides = Annotated[
    tuple[str, ...], tyro.conf.arg(aliases=["-c"], help="settings, e.g. -c fidelity=tiny control.tone=0")
]


def list_command() -> None:
    """List the registered environments, one line each."""
    ids = registered_ids()
    width = max(map(len, ids), default=0)
    for env_id in ids:
        print(f"{env_id:{width}}  {describe(env_id)}".rstrip())


def doctor_command(
    json: Annotated[bool, tyro.conf.arg(help="print one JSON object, for scripts and bug reports")] = False,
    compile: Annotated[bool, tyro.conf.arg(help="compile every kernel now, and take the time")] = False,
    device: Device = "cpu",
) -> None:
    """Show this machine's devices, versions, kernel cache and extras, and the memory of the default environment.

    Args:
        json: machine-readable output.
        compile: build the kernels of all environments for the device, so that nothing later waits for them.
        device: the device to compile for; it must be there.
    """
    from piavatar_envs import doctor

    doctor.find_device(device)
    seconds = doctor.compile_kernels(device) if compile else None
    report = doctor.examine()
    if seconds is not None:
        report["compile"] = {"device": device, "seconds": round(seconds, 1)}
    doctor.show(report, as_json=json)


def inspect_command(
    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help="a character or a motion")],
    picture: Annotated[
        Path | None, tyro.conf.arg(help="write a .png of the body and its skeleton (needs the extra render)")
    ] = None,
    json: Annotated[bool, tyro.conf.arg(help="print one JSON object, for scripts and bug reports")] = False,
    config: Annotated[
        tuple[str, ...],
        tyro.conf.arg(aliases=["-c"], help="settings of the source, e.g. -c height=1.8 mapping=map.json"),
    ] = (),
) -> None:
    """Show what a file of an avatar or a motion becomes: joints, size, mass, what is worn, and what was guessed.

    Args:
        file: to look at, e.g. knight.glb.
        picture: file to write a picture to.
        json: machine-readable output.
        config: settings of the source that reads the file.
    """
    from piavatar_envs import doctor, inspection
    from piavatar_envs.config import parse_assignments

    doctor.quiet_warp()
    # as an environment has them, too
    settings = {name.removeprefix("avatar."): value for name, value in parse_assignments(config).items()}
    inspection.show(inspection.examine(file, settings, picture), as_json=json)


def play_command(
    env_id: EnvId,
    agent: AgentName = "random",
    video: Annotated[Path | None, tyro.conf.arg(help="write an .mp4 or .gif (needs the extra render)")] = None,
    steps: Steps = None,
    seed: Seed = 0,
    device: Device = "cpu",
    color: Annotated[BodyColor, tyro.conf.arg(help="colour of the body in the video")] = "skin",
    avatar: AvatarFile = None,
    config: Overrides = (),
) -> None:
    """Play an environment, print its return and metrics, and write a video if given a file.

    Args:
        env_id: the environment, e.g. PIAvatar/Reach-v0.
        agent: random or zero actions.
        video: the file to write.
        steps: number of steps.
        seed: seed of the run.
        device: where to simulate.
        color: skin, strain, distortion or impulse.
        avatar: the body, instead of the package's own.
        config: overrides of the environment's configuration.
    """
    from piavatar_envs import play

    overrides = prepare(env_id, config, avatar)
    play.show(play.play(env_id, agent, video, steps, seed, device, color, overrides), video)


def watch_command(
    env_id: EnvId = "",
    agent: Annotated[
        str, tyro.conf.arg(help="random, zero, clip:NAME, or from a clone pid or the folder of a training run")
    ] = "random",
    num_envs: Annotated[int, tyro.conf.arg(help="environments, of which the browser shows one")] = 1,
    seed: Seed = 0,
    device: Device = "cpu",
    port: Annotated[int, tyro.conf.arg(help="of this machine, or the next one that is free")] = 8080,
    scene: Annotated[Path | None, tyro.conf.arg(help="go on with a scene that was saved in a live view")] = None,
    scenes: Annotated[Path, tyro.conf.arg(help="folder of the scenes that browsers save")] = Path("runs/scenes"),
    avatar: AvatarFile = None,
    config: Overrides = (),
) -> None:
    """Play an environment for ever, live in a web browser, until Ctrl-C (needs the extra live).

    Args:
        env_id: the environment, e.g. PIAvatar/Reach-v0; none with --scene.
        agent: which agent plays at first.
        num_envs: number of environments.
        seed: seed of the run.
        device: where to simulate.
        port: of the view.
        scene: file of a scene.
        scenes: folder of saved scenes.
        avatar: the body, instead of the package's own.
        config: overrides of the environment's configuration.
    """
    from piavatar_envs import watch

    if scene is not None:
        if env_id or config or avatar:
            raise ValueError("a scene has its own environment and settings; leave out ID, -c and --avatar")
        from piavatar_envs import doctor

        doctor.quiet_warp()
        watch.watch_scene(scene, device, port, scenes)
        return
    if not env_id:
        raise ValueError("give the ID of an environment, as piavatar_envs list shows them, or --scene FILE")
    watch.watch(env_id, agent, seed, device, port, prepare(env_id, config, avatar), num_envs, scenes)


def export_command(
    env_id: EnvId,
    out: Annotated[Path, tyro.conf.arg(help="folder to write to, new or empty")] = Path("export"),
    format: Annotated[
        Literal["glb", "ply", "usd"],
        tyro.conf.arg(help="one animated glTF file, a file for each mesh and frame, or USD (needs the extra usd)"),
    ] = "glb",
    agent: AgentName = "random",
    steps: Steps = None,
    seed: Seed = 0,
    device: Device = "cpu",
    color: Annotated[BodyColor, tyro.conf.arg(help="colour of the bodies; glb files have skin only")] = "skin",
    avatar: AvatarFile = None,
    config: Overrides = (),
) -> None:
    """Play an environment and write its meshes, frame by frame, for Blender and other programs.

    Args:
        env_id: the environment, e.g. PIAvatar/Reach-v0.
        out: folder of the files.
        format: of the files.
        agent: random or zero actions.
        steps: number of steps.
        seed: seed of the run.
        device: where to simulate.
        color: skin, strain, distortion or impulse.
        avatar: the body, instead of the package's own.
        config: overrides of the environment's configuration.
    """
    from piavatar_envs import export

    overrides = prepare(env_id, config, avatar)
    rollout, paths = export.export(env_id, out, format, agent, steps, seed, device, color, overrides)
    for path in paths:
        print(path)
    if rollout.interrupted:
        raise KeyboardInterrupt(f"after {rollout.steps} steps, exported to {out}")


def prepare(env_id: str, config: tuple[str, ...], avatar: Path | None = None) -> dict[str, Any]:
    """Check the id, silence Warp, and return the settings, with those of the source of a character's file.

    Raises:
        ImportError: there is no such module.
        FileNotFoundError: there is no such file.
        ValueError: there is no such environment, an assignment is not a setting, or no source reads the file.
    """
    from piavatar_envs import doctor
    from piavatar_envs.config import parse_assignments

    check_id(env_id)
    overrides = parse_assignments(config)
    if avatar is not None:
        from piavatar_envs.avatar.body.sources import source_of
        from piavatar_envs.core.reading import check_file

        check_file(avatar)
        overrides = {"avatar.source": source_of(avatar), "avatar.path": str(avatar), **overrides}
    doctor.quiet_warp()
    return overrides


def check_id(env_id: str) -> None:
    """Refuse an id that is not in the list, in either spelling; import the module of ``module:id``.

    Raises:
        ImportError: there is no such module.
        ValueError: there is no such environment.
    """
    module, _, own_id = listed_name(env_id).rpartition(":")
    if module:
        importlib.import_module(module)
    if own_id not in registered_ids():
        raise ValueError(f"no environment {env_id!r}; {instead_of(env_id, registered_ids())}")


def registered_ids() -> list[str]:
    """Return the registered ids, sorted, with those of users' tasks; then the modules of several agents."""
    import gymnasium

    from piavatar_envs import ENTRY_POINT, GAME_ENTRY_POINT  # importing the package registers the ids
    from piavatar_envs.multi import listed_games

    found = [(name, spec) for name, spec in gymnasium.registry.items() if spec.entry_point != GAME_ENTRY_POINT]
    ids = [name for name, spec in found if spec.namespace == NAMESPACE or spec.entry_point == ENTRY_POINT]
    return [*sorted(ids), *listed_games()]


def describe(env_id: str) -> str:
    """Return the first line of the docstring of a task's file, read without importing it; empty if there is none.

    ``PIAvatar/TrackMotion-v0`` is described by ``tasks/track_motion.py``, ``sumo_v0`` by ``tasks/games/sumo.py``.
    """
    namespace, _, _ = env_id.rpartition("/")
    if namespace not in ("", NAMESPACE):
        return ""  # of another package
    if namespace:
        name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", env_id.partition("/")[2].partition("-v")[0]).lower()
        path = Path(__file__).parent / "tasks" / f"{name}.py"
    else:
        path = Path(__file__).parent / "tasks" / "games" / f"{env_id.rpartition('_v')[0]}.py"
    if not path.is_file():
        return ""
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return docstring.partition("\n")[0]


def hint_settings(args: list[str], options: Container[str]) -> None:
    """Print the remedy for settings that were given as options: ``--fidelity tiny`` is ``-c fidelity=tiny``.

    Args:
        args: the command line.
        options: names that are options of the command.
    """
    from piavatar_envs.config import EnvConfig
    from piavatar_envs.config.errors import setting_keys

    keys = setting_keys(EnvConfig)
    known = {*keys, *(key.rpartition(".")[2] for key in keys), "control"}
    for option, following in zip(args, [*args[1:], ""], strict=True):
        name, _, value = option.removeprefix("--").partition("=")
        name, value = name.replace("-", "_"), value or following
        if option.startswith("--") and name in known and name not in options:
            print(f"error: {name} is a setting of the environment; use -c {name}={value or '...'}", file=sys.stderr)


def print_any_text() -> None:
    """Let standard output and error replace characters that the terminal's encoding lacks, where they would fail."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # not every stand-in of a notebook or a test has it
            stream.reconfigure(errors="replace")


def main(args: list[str] | None = None) -> None:
    """Run a command; a user's mistake ends in one line and exit status 2, Ctrl-C in one line and 130."""
    print_any_text()
    if (sys.argv[1:] if args is None else list(args)) == ["--version"]:
        from piavatar_envs import __version__

        print(f"piavatar-envs {__version__}")
        return
    commands = {
        "list": list_command,
        "doctor": doctor_command,
        "inspect": inspect_command,
        "play": play_command,
        "watch": watch_command,
        "export": export_command,
    }
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog="piavatar-envs",
            description="Soft human avatars behind reset/step. --version prints the version.",
            args=args,
        )
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of a pipe, such as head, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except (ValueError, ImportError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt as stop:
        reached = str(stop) or "before the first step"
        command = again(list(sys.argv[1:] if args is None else args))
        print(f"\ninterrupted {reached}; begin again with {command}", file=sys.stderr)
        raise SystemExit(130) from None
    except SystemExit as stop:  # the parser has printed its complaint
        if stop.code == 2:
            given = sys.argv[1:] if args is None else args
            command = commands.get(given[0]) if given else None
            hint_settings(given, inspect.signature(command).parameters if command else ())
        raise
