"""Command line: ``list``, ``doctor`` and ``play``, and their refusals."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import piavatar_envs
from piavatar_envs import cli, doctor, play
from piavatar_envs.core.extras import install_command
from piavatar_envs.mpm.types import FAILURE_CFL
from piavatar_envs.render import write_video
from piavatar_envs.tasks import task_modules

PROBE = "PIAvatar/HouseProbe-v0"


class Probe(gymnasium.Env):
    """Three-step episodes whose reward is the first action; nothing is simulated."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012 - as Gymnasium declares it
    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, device="cpu", render_mode=None, **settings):
        self.render_mode, self.settings, self.seeds = render_mode, {"device": device, **settings}, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.t = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.t += 1
        ended = self.t == 3
        info = {"reward_first": float(action[0]), "wrench": np.zeros(3), "t": np.int64(self.t)}
        if ended:
            info["failure"] = FAILURE_CFL
        return np.zeros(2, np.float32), float(action[0]), ended, False, info

    def render(self):
        frame = np.full((34, 50, 3), 50, np.uint8)
        frame[:, : 10 + 10 * self.t] = 200
        return frame


@pytest.fixture
def probe():
    made = []

    def make(**settings):
        made.append(Probe(**settings))
        return made[-1]

    gymnasium.register(PROBE, entry_point=make, disable_env_checker=True)
    yield made
    del gymnasium.registry[PROBE]


def run(*args: str) -> str:
    command = [sys.executable, "-m", "piavatar_envs", *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=True).stdout


def test_help_names_the_commands():
    shown = run("--help")
    assert all(word in shown for word in ("list", "doctor", "inspect", "play", "watch", "export"))


def test_version_is_printed(capsys):
    cli.main(["--version"])
    assert capsys.readouterr().out == f"piavatar-envs {piavatar_envs.__version__}\n"


def test_the_file_of_an_avatar_chooses_its_source(probe, tmp_path, capsys):
    file = tmp_path / "scan.ply"
    file.touch()
    cli.main(["play", PROBE, "--avatar", str(file), "-c", "avatar.height=1.7", "--steps", "1"])
    given = {name: value for name, value in probe[0].settings.items() if name.startswith("avatar")}
    assert given == {"avatar.source": "mesh", "avatar.path": str(file), "avatar.height": 1.7}
    capsys.readouterr()
    for name, message in (("none.glb", "no file"), (".", "is a folder"), ("a.xyz", "no avatar source reads")):
        (tmp_path / "a.xyz").touch()
        with pytest.raises(SystemExit):
            cli.main(["play", PROBE, "--avatar", str(tmp_path / name)])
        assert message in capsys.readouterr().err


def test_list_shows_every_id_with_a_description(capsys):
    cli.main(["list"])
    lines = capsys.readouterr().out.splitlines()
    # other tests may have registered tasks of their own in this process
    ids = {line.split()[0] for line in lines if len(line.split(maxsplit=1)) == 2}
    assert {*task_modules(), "sumo_v0", "boxing_v0", "high_five_v0", "pass_ball_v0"} <= ids


def test_doctor_reports_this_machine(monkeypatch, capsys):
    monkeypatch.setitem(doctor.EXTRAS, "render", ("a_package_that_is_missing",))
    cli.main(["doctor", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert report["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}.")
    assert report["packages"]["numpy"] == np.__version__ and report["devices"][0]["alias"] == "cpu"
    assert Path(report["kernel_cache"]["path"]).is_absolute() and report["kernel_cache"]["bytes"] >= 0
    assert report["extras"].keys() == doctor.EXTRAS.keys()
    assert report["extras"]["render"] == ["a_package_that_is_missing"]
    assert report["default_env"]["particles"] >= 2500 and report["default_env"]["bytes"] > 108 * 2500
    monkeypatch.setenv("COLUMNS", "40")
    doctor.show(report)
    lines = capsys.readouterr().out.splitlines()
    assert any(line.endswith(install_command("render")) for line in lines), "a command that is copied is whole"


def test_play_sums_rewards_over_episodes(probe):
    rollout = play.play(PROBE, "random", steps=7, seed=5)
    space = gymnasium.spaces.Box(-1, 1, (2,), np.float32, seed=5)
    paid = [float(space.sample()[0]) for _ in range(7)]
    assert rollout.returns == pytest.approx([sum(paid[:3]), sum(paid[3:6]), paid[6]])
    assert rollout.steps == 7 and rollout.failures == ["cfl", "cfl"]
    assert rollout.metrics == {"reward_first": pytest.approx(paid[6]), "t": 1.0}
    assert probe[0].seeds == [5, None, None]
    one = play.play(PROBE, "zero", overrides={"fidelity": "tiny"})
    assert one.steps == 3 and one.returns == [0.0], "without a number of steps: one episode"
    assert probe[1].settings == {"device": "cpu", "fidelity": "tiny"} and probe[1].render_mode is None


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_video_has_a_frame_for_each_state(probe, tmp_path, suffix):
    imageio = pytest.importorskip("imageio.v3")
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "new" / f"clip{suffix}"
    play.play(PROBE, "zero", video=path, steps=4, color="strain")
    frames = np.stack(list(imageio.imiter(path)))[..., :3]
    assert frames.shape == (6, 34, 50, 3)  # two resets and four steps
    white = 50 + 150 * (10 + 10 * np.array([0, 1, 2, 3, 0, 1])) / 50
    np.testing.assert_allclose(frames.mean((1, 2, 3)), white, atol=6)  # compressed
    assert probe[0].settings["color"] == "strain" and probe[0].render_mode == "rgb_array"


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["doctor", "--device", "cuda:99"], "device='cuda:99'"),
        (["doctor", "--compile", "--device", "cuda:99"], "device='cuda:99'"),
        (["play", "PIAvatar/Nothing-v9"], "no environment 'PIAvatar/Nothing-v9'; there are "),
        (["play", PROBE, "--video", "clip.avi"], "'.avi'; use .mp4 or .gif"),
        (["play", "PIAvatar/Raech-v0"], "did you mean PIAvatar/Reach-v0?"),
        (["play", "piavatar_envs.multi.sumo_v9"], "did you mean sumo_v0?"),
        (["play", "Mine/Walk-v0"], "did you mean PIAvatar/Walk-v0?"),
        (["play", PROBE, "--steps", "0"], "steps=0 must be >= 1"),
        (["play", PROBE, "--seed", "-1"], "seed=-1 must be >= 0"),
        (["play", PROBE, "--config", "tone"], "'tone' is not an override"),
        (["play", PROBE, "--fidelity", "tiny"], "use -c fidelity=tiny"),
        (["play", PROBE, "--control.tone=0"], "use -c control.tone=0"),
        (["play", PROBE, "-c", "render_mode=human"], "render_mode is not a setting"),
    ],
)
def test_mistakes_end_in_one_line(probe, capsys, args, words):
    with pytest.raises(SystemExit) as stop:
        cli.main(args)
    error = capsys.readouterr().err
    assert stop.value.code == 2 and words in error.splitlines()[-1] and "Traceback" not in error


@pytest.mark.parametrize("suffix", [".gif", None])
def test_an_interrupted_play_ends_in_one_line_with_what_was_filmed(probe, capsys, tmp_path, monkeypatch, suffix):
    step = Probe.step

    def interrupted(self, action):
        if self.t == 2:
            raise KeyboardInterrupt
        return step(self, action)

    monkeypatch.setattr(Probe, "step", interrupted)
    video = tmp_path / "new" / f"film{suffix}"
    options = ["--video", str(video)] if suffix else []
    with pytest.raises(SystemExit) as stop:
        cli.main(["play", PROBE, "--steps", "9", *options])
    assert stop.value.code == 130
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.strip().splitlines()) == 1
    assert (
        f"interrupted after 2 steps{f', filmed in {video}' if suffix else ''}; begin again with python -m" in said.err
    )
    assert video.exists() == bool(suffix)


@pytest.mark.parametrize("place", ["file/x.mp4", "file/deep/x.gif", "folder.mp4", "/proc/nowhere/x.mp4"])
def test_a_video_that_cannot_be_written_is_refused_and_nothing_is_created(probe, capsys, tmp_path, place):
    (tmp_path / "file").touch()
    (tmp_path / "folder.mp4").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as stop:
        cli.main(["play", PROBE, "--video", str(tmp_path / place)])
    error = capsys.readouterr().err
    assert stop.value.code == 2 and error.count("\n") == 1 and place in error
    assert sorted(tmp_path.rglob("*")) == before and probe == []


def test_a_video_that_fails_leaves_no_folder(tmp_path, monkeypatch):
    for suffix, module in ((".mp4", "imageio_ffmpeg"), (".gif", "PIL")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ImportError, match=r"\[render\]"):
            write_video(tmp_path / "new" / f"x{suffix}", [np.zeros((16, 16, 3), np.uint8)], 30.0)
    assert list(tmp_path.iterdir()) == []


def test_play_prints_the_return(probe, capsys):
    cli.main(["play", PROBE, "--agent", "zero", "--steps", "2", "-c", "fidelity=tiny", "tone=0.5"])
    shown = capsys.readouterr().out.split()
    assert shown[shown.index("steps") + 1] == "2" and shown[shown.index("return") + 1] == "0.000"
    assert probe[0].settings == {"device": "cpu", "fidelity": "tiny", "tone": 0.5}


@pytest.mark.parametrize("name", ["Reach-v0", "PIAvatar/Stand-v0"])
def test_an_environment_is_played_and_filmed(name, device, tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    cli.check_id(name)
    settings = {"fidelity": "tiny", "width": 96, "height": 96}
    rollout = play.play(name, "random", tmp_path / "a.mp4", 2, 0, device, "strain", settings)
    assert rollout.steps == 2 and np.isfinite(rollout.returns).all() and rollout.metrics
    frames = np.stack(list(imageio.imiter(tmp_path / "a.mp4")))
    assert frames.shape == (3, 96, 96, 3) and frames.std() > 5.0


@pytest.mark.parametrize("name", ["sumo_v0", "piavatar_envs.multi.sumo_v0"])
def test_games_are_played(name):
    cli.check_id(name)
    rollout = play.play(name, agent="zero", steps=3, overrides={"fidelity": "tiny"})
    assert rollout.steps == 3 and len(rollout.returns) == 1 and not rollout.failures
    assert {"agent_0.success", "agent_1.reward_control"} <= set(rollout.metrics)
    with pytest.raises(ValueError, match=r"'sumo_v9'.*sumo_v0"):
        play.play("sumo_v9", steps=1)


@pytest.mark.parametrize("module", ["gymnasium", "tyro", "warp"])
@pytest.mark.parametrize("start", ["-m", "script"])
def test_ctrl_c_during_the_imports_ends_in_one_line(module, start, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        "            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupting())\n"
    )
    script = tmp_path / "piavatar-envs"
    script.write_text("from piavatar_envs.cli import main\nmain()\n")
    env = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(cli.__file__).parents[1]}"}
    command = [sys.executable, *(["-m", "piavatar_envs"] if start == "-m" else [str(script)]), "play", "An id"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode != 0 and done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert line == "interrupted before the first step; begin again with python -m piavatar_envs play 'An id'"


@pytest.mark.parametrize("imported", ["piavatar_envs", "agents"])
def test_modules_of_others_keep_their_tracebacks(imported, tmp_path):
    """Their package may import this one while Python looks for what it runs."""
    own = tmp_path / "own"
    own.mkdir()
    (own / "__init__.py").write_text(f"import {imported}\n")
    (own / "train.py").write_text("import sys\nprint(sys.excepthook is sys.__excepthook__)\n")
    env = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(cli.__file__).parents[1]}"}
    command = [sys.executable, "-m", "own.train"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
    assert done.stdout == "True\n", done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="pipes end in another error there")
def test_a_reader_that_has_had_enough_ends_it_quietly():
    command = f"{sys.executable} -m piavatar_envs list | head -n 0"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=300)
    assert done.stdout == done.stderr == ""
