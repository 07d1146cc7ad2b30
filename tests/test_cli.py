"""The command line: help is quick, list and doctor tell the truth, play plays what it says."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from piavatar_envs import cli, doctor, play
from piavatar_envs.tasks import listed_name, task_modules

PROBE = "PIAvatar/HouseProbe-v0"


class Probe(gymnasium.Env):
    """Three-step episodes that pay the first action; a stand-in that needs no simulation."""

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
        info = {"reward_terms": {"first": float(action[0])}, "wrench": np.zeros(3), "t": np.int64(self.t)}
        if ended:
            info["failure"] = "probe"
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


def run(*args: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "piavatar_envs", *args], capture_output=True, text=True, timeout=600, cwd=Path.cwd()
    )


def test_help_is_quick_and_names_the_commands():
    start = time.perf_counter()
    done = run("--help")
    assert done.returncode == 0 and all(word in done.stdout for word in ("list", "doctor", "play"))
    assert (
        time.perf_counter() - start < 10.0
    )  # 0.4 s on an idle core; only an import of torch or a build would break it


def test_list_shows_every_id_with_a_line_about_it():
    lines = run("list").stdout.splitlines()
    ids = [line.split()[0] for line in lines]
    # other tests may have registered tasks of their own in this process
    assert ids == [name for name in cli.registered_ids() if name in ids]
    assert {*task_modules(), "sumo_v0", "boxing_v0", "high_five_v0", "pass_ball_v0"} == set(ids)
    assert all(len(line.split(maxsplit=1)) == 2 for line in lines), "a task's file begins with a line about it"


def test_doctor_reports_this_machine():
    done = run("doctor", "--json")
    report = json.loads(done.stdout)
    assert report["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}.")
    assert report["packages"]["numpy"] == np.__version__
    assert report["devices"][0]["alias"] == "cpu" and report["devices"][0]["name"]
    assert Path(report["kernel_cache"]["path"]).is_absolute() and report["kernel_cache"]["bytes"] >= 0
    assert set(report["extras"]) == set(doctor.EXTRAS)
    assert report["default_env"]["particles"] >= 2500 and report["default_env"]["bytes"] > 108 * 2500


def test_doctor_names_what_an_extra_lacks(monkeypatch):
    monkeypatch.setitem(doctor.EXTRAS, "render", ("pyvista_that_is_not_there",))
    monkeypatch.setattr(doctor, "memory_estimate", dict)
    assert doctor.examine()["extras"]["render"] == ["pyvista_that_is_not_there"]


def test_doctor_refuses_an_unknown_device(capsys):
    for rest in ([], ["--compile"]):
        with pytest.raises(SystemExit) as stop:
            cli.main(["doctor", *rest, "--device", "cuda:99"])
        assert stop.value.code == 2 and "device='cuda:99' is not available (" in capsys.readouterr().err


def test_play_sums_rewards_over_episodes(probe):
    rollout = play.play(PROBE, "random", steps=7, seed=5)
    space = gymnasium.spaces.Box(-1, 1, (2,), np.float32, seed=5)
    paid = [float(space.sample()[0]) for _ in range(7)]
    assert rollout.returns == pytest.approx([sum(paid[:3]), sum(paid[3:6]), paid[6]])
    assert rollout.steps == 7 and rollout.failures == ["probe", "probe"]
    assert rollout.metrics == {"reward_terms.first": pytest.approx(paid[6]), "t": 1.0}
    assert probe[0].seeds == [5, None, None]


def test_play_takes_one_episode_when_no_steps_are_given(probe):
    rollout = play.play(PROBE, "zero", overrides={"fidelity": "tiny"})
    assert rollout.steps == 3 and rollout.returns == [0.0]
    assert probe[0].settings == {"device": "cpu", "fidelity": "tiny"} and probe[0].render_mode is None


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
    ("args", "told"),
    [
        (["play", "PIAvatar/Nothing-v9"], "no environment 'PIAvatar/Nothing-v9'; there are "),
        (["play", PROBE, "--video", "clip.avi"], "video clip.avi ends in '.avi'; use .mp4 or .gif"),
        (["play", "PIAvatar/Raech-v0"], "no environment 'PIAvatar/Raech-v0'; did you mean PIAvatar/Reach-v0?\n"),
        (["play", "piavatar_envs.multi.sumo_v9"], "; did you mean sumo_v0?\n"),
        (["play", "Mine/Walk-v0"], "such as my_tasks:Mine/Walk-v0; did you mean PIAvatar/Walk-v0?\n"),
        (["play", PROBE, "--steps", "0"], "steps=0 must be >= 1"),
        (["play", PROBE, "--seed", "-1"], "error: seed=-1 must be >= 0 and <= 4294967295\n"),
        (["play", PROBE, "--config", "tone"], "'tone' is not an override"),
    ],
)
def test_mistakes_end_in_one_line(probe, capsys, args, told):
    with pytest.raises(SystemExit) as stop:
        cli.main(args)
    error = capsys.readouterr().err
    assert stop.value.code == 2 and told in error and "Traceback" not in error


@pytest.mark.parametrize(
    ("spelling", "listed"),
    [
        ("HouseProbe-v0", "HouseProbe-v0"),  # not of this package
        ("Reach-v0", "PIAvatar/Reach-v0"),
        ("PIAvatar/PushBox-v0", "PIAvatar/PushBox-v0"),
        ("piavatar_envs.multi.sumo_v0", "sumo_v0"),
        ("sumo_v0", "sumo_v0"),
        ("mine:Mine/Reach-v0", "mine:Mine/Reach-v0"),
    ],
)
def test_names_are_also_known_without_what_they_stand_in(spelling, listed):
    assert listed_name(spelling) == listed
    if "Probe" not in spelling and ":" not in spelling:
        cli.check_id(spelling)


def test_play_prints_the_return(probe, capsys):
    cli.main(["play", PROBE, "--agent", "zero", "--steps", "2", "-c", "fidelity=tiny", "tone=0.5"])
    shown = capsys.readouterr().out.split()
    assert shown[shown.index("steps") + 1] == "2" and shown[shown.index("return") + 1] == "0.000"
    assert probe[0].settings == {"device": "cpu", "fidelity": "tiny", "tone": 0.5}


def test_play_a_real_environment(env_id, device):
    rollout = play.play(env_id, "random", steps=3, device=device, overrides={"fidelity": "tiny"})
    assert rollout.steps == 3 and np.isfinite(rollout.returns).all() and rollout.metrics


def test_real_video_is_coloured_by_strain(device, tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    pytest.importorskip("pyvista")
    settings = {"fidelity": "tiny", "width": 96, "height": 96}
    play.play("PIAvatar/Reach-v0", "random", tmp_path / "a.mp4", 2, 0, device, "strain", settings)
    frames = np.stack(list(imageio.imiter(tmp_path / "a.mp4")))
    assert frames.shape == (3, 96, 96, 3) and frames.std() > 5.0


@pytest.mark.parametrize("name", ["sumo_v0", "piavatar_envs.multi.sumo_v0"])
def test_modules_of_several_agents_are_played_too(name):
    rollout = play.play(name, agent="zero", steps=3, overrides={"fidelity": "tiny"})
    assert rollout.steps == 3 and len(rollout.returns) == 1 and not rollout.failures
    assert {"agent_0.success", "agent_1.reward_terms.control"} <= set(rollout.metrics)
    with pytest.raises(ValueError, match=r"unknown game 'sumo_v9'.*sumo_v0"):
        play.play("sumo_v9", steps=1)


def test_a_task_is_played_without_its_namespace(device):
    assert play.play("Reach-v0", steps=1, device=device, overrides={"fidelity": "tiny"}).steps == 1
