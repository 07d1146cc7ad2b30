"""The loop of the live view: one thread takes the commands of the browsers, steps, and shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.api.pictures import Live, Pace
from piavatar_envs.config import ConfigError
from piavatar_envs.envs.state import file_digests
from piavatar_envs.envs.task import REWARD
from piavatar_envs.live.agents import AgentKind, find_agent
from piavatar_envs.live.recording import MOST_FRAMES, Recording
from piavatar_envs.live.scenes import LinkServer, SavedScene, SceneFolder, read_scene
from piavatar_envs.live.setup import BALL, BALL_RADIUS, Setup
from piavatar_envs.live.throwing import aim, throw
from piavatar_envs.render.live import PORT
from piavatar_envs.render.panel import BALL_MASS, BALL_SPEED, Command, Panel, Slider
from piavatar_envs.sim.throws import Thrower
from piavatar_envs.sim.tuning import ALPHA, FRICTION, GRAVITY, STIFFNESS, TONE, TUNABLE

#: Time between two looks at the panel while nothing moves, and between two tables [s].
_REST, _TABLE_EVERY = 0.05, 0.2
#: Folder of saved scenes.
SCENES = Path("runs/scenes")
#: Sections of settings that another mode of control does not have.
_OF_CONTROL = "control"


class Show:
    """Endless play of the environments of a setup, a turn at a time.

    Attributes:
        setup: what is played.
        host: the environments.
        live: the view.
        panel: the controls in the browser.
        playing, speed, env: whether it steps, ratio of simulated to real time at most, and the environment shown.
        played: control steps of all episodes.
        steps, total: those of the episode that is shown, and its return.
        tuned: settings that were changed while the environments ran.
        ball: mass [kg] and speed [m/s] of the next throw.
        recording: the clip that is being recorded, or None.
        clip: the last one, as a file, or None.
        words: the last message.
    """

    def __init__(
        self,
        setup: Setup,
        kinds: Mapping[str, AgentKind],
        port: int = PORT,
        pace: Pace | None = None,
        folder: Path = SCENES,
    ) -> None:
        """Build the environments and open the view; :meth:`begin` or :meth:`open` comes next.

        Args:
            setup: what is played.
            kinds: the agents, by name.
            port: of this machine, or the next one that is free.
            pace: holds the steps back to real time.
            folder: of saved scenes.

        Raises:
            ConfigError: a setting is unknown or out of range.
            ImportError: the extra ``live`` is not installed.
            ValueError: there is no such environment, agent or device, or a port out of range.
        """
        setup = replace(setup, settings={**find_agent(setup.agent, kinds).needs, **setup.settings})
        self._kinds, self.setup, self.host = kinds, setup, setup.make()
        words = self._adapt_control()
        first, color = self.host.groups[0], self.host.config.render.color
        self.live = Live(first, self.host.apply_force, color, port, pace=pace)
        self.playing, self.speed, self.env = True, 1.0, 0
        self.played, self.steps, self.total = 0, 0, 0.0
        self.ball = {"ball_mass": BALL_MASS[2], "ball_speed": BALL_SPEED[2]}
        self.tuned: dict[str, float] = {}
        self.recording: Recording | None = None
        self.clip: bytes | None = None
        self.words = ""
        self._single, self._format, self._table_at = False, "mp4", 0.0
        self._scenes = SceneFolder(folder)
        self._populate()
        view = self.live.view
        self.panel = Panel(view.server, color, list(kinds), setup.agent, setup.num_envs, sliders(self.host))
        self._say(words)
        view.on_throw(self._click)
        open_file = self.panel.send
        self._links = LinkServer(
            view.url, self._scenes, lambda path: open_file(Command("open", path)), view.server.get_port() + 1
        )

    def close(self) -> None:
        """Stop the view and free the environments."""
        self._links.close()
        self.live.close()
        self.host.close()

    # what is shown

    def begin(self, seed: int | None = None) -> None:
        """Begin an episode in every environment: of ``seed`` and those that follow, or the next one."""
        self.host.reset(seed)
        self._over = np.zeros(self.host.num_envs, bool)
        self._agent.begin(~self._over)
        self._begin_shown()

    def _begin_shown(self) -> None:
        """Show the episode that has begun in the environment that is shown."""
        self.steps, self.total, self._info = 0, 0.0, {}
        self.live.begin()
        self._fill_table()

    def _populate(self) -> None:
        """Build the agent, and what throws the ball, for new environments."""
        self._agent = self._kinds[self.setup.agent].make(self.host, self.setup.seed)
        self._over = np.zeros(self.host.num_envs, bool)
        groups = self.host.groups if self.setup.ball else []
        self._throwers = [Thrower(group.simulation, BALL) for group in groups]

    def _adapt_control(self) -> str:
        """Build the environments anew if the agent cannot act under their control; return the reason, or nothing."""
        kind = self._kinds[self.setup.agent]
        if self.host.config.control.mode in kind.controls:
            return ""
        self.host.close()
        self.setup = with_control(self.setup, kind.controls[0])
        self.host = self.setup.make()
        return f"agent {self.setup.agent} needs control={kind.controls[0]!r}"

    def _select(self) -> None:
        """Let the view show the environment of :attr:`env`."""
        batch, own = self.host.group_of(self.env)
        self.live.select(batch, self.host.apply_force, own, self.env)

    def _say(self, words: str) -> None:
        """Show a message."""
        self.words = words
        self.panel.show_words(words)

    # the loop

    def turn(self) -> None:
        """Obey the browsers' commands, then step or, while paused, rest."""
        for command in self.panel.take():
            try:
                self._obey(command)
            except (ValueError, ImportError, OSError) as error:
                self._say(f"{command.name}: {error}")
        if not (self.playing or self._single):
            self.live.catch_up()
            self.live.pace.rest(_REST)
            return
        self._single = False
        self._step()

    def _step(self) -> None:
        """Advance all environments by a control step; those that have ended begin their next episode before."""
        host, live = self.host, self.live
        if self._over.any():
            over = self._over
            host.reset(mask=over)
            self._agent.begin(over)
            self._over = np.zeros(host.num_envs, bool)
            if over[self.env]:
                self._begin_shown()
        actions = self._agent.act(self.played)
        live.before_step()
        host.step(actions)
        self._over = host.find_ended()
        reward = float(host.reward()[self.env].sum())
        self.played += 1
        self.steps += 1
        self.total += reward
        self._plot(reward)
        if self.recording:
            self.recording.add(live.scene())
            if self.recording.full:
                self._stop_recording()
        live.step(self.speed)
        if self._over[self.env] or not self.playing or live.pace.clock() - self._table_at >= _TABLE_EVERY:
            self._info = self._outcome()
            self._fill_table()

    def _plot(self, reward: float) -> None:
        """Add the step to the plots."""
        batch, own = self.host.group_of(self.env)
        sensors, time = batch.simulation.sensors, self.steps * self.host.config.physics.control_dt
        ground = np.linalg.norm(sensors.boundary_impulse.numpy()[own], axis=-1).sum()
        bodies = np.linalg.norm(sensors.pair_impulse.numpy()[own], axis=-1).sum()
        self.panel.reward.add(time, reward)
        self.panel.impulse.add(time, float(ground), float(bodies), self.live.pull)

    def _outcome(self) -> dict[str, float]:
        """Return the terms of the reward in the last step, by name, with the agent's where there are several."""
        names, found = self.host.task.agent_names, {}
        for index, name in enumerate(names):
            for key, values in self.host.outcome(index).items():
                if key.startswith(REWARD):
                    title = key.removeprefix(REWARD)
                    found[title if len(names) == 1 else f"{name}.{title}"] = float(values[self.env])
        return found

    def _fill_table(self) -> None:
        """Fill table and plots; not in every step, because a browser takes longer for them than for the scene."""
        self._table_at = self.live.pace.clock()
        time = self.steps * self.host.config.physics.control_dt
        about = {"step": str(self.steps), "time": f"{time:.2f} s", "return": f"{self.total:.2f}"}
        self.panel.show_table(self.setup.env_id, about | {name: f"{value:+.3f}" for name, value in self._info.items()})
        self.panel.reward.show()
        self.panel.impulse.show()

    # commands

    def _obey(self, command: Command) -> None:
        """Carry out a command of a browser; without effect where nothing would change."""
        name, value = command.name, command.value
        if name in TUNABLE:
            self._tune(name, float(value))
        elif name in self.ball:
            self.ball[name] = float(value)
        elif name == "play":
            self._play(not self.playing)
        elif name == "step":
            self._play(False)
            self._single = True
        elif name == "speed":
            self.speed = float(value)
        elif name == "format":
            self._format = value
        else:
            handlers: dict[str, Callable[[Any, int | None], None]] = {
                "episode": lambda _value, _client: self.begin(),
                "agent": self._choose_agent,
                "env": self._choose_env,
                "color": self._choose_color,
                "pointer": self._choose_pointer,
                "throw": self._throw,
                "record": self._record,
                "save": self._save,
                "open": self._open,
            }
            handlers[name](value, command.client)

    def _play(self, playing: bool) -> None:
        self.playing = playing
        self.panel.show_playing(playing)

    def _choose_color(self, color: str, _client: int | None) -> None:
        if color != self.live.color:
            self.live.color = color
            self.live.show()

    def _choose_env(self, env: str, _client: int | None) -> None:
        if int(env) != self.env:
            self.env = int(env)
            self._select()
            self.steps = int(self.host.read(lambda group: group.step_count)[self.env])
            self.total, self._info = 0.0, {}
            self.live.begin()
            self._fill_table()

    def _choose_agent(self, name: str, _client: int | None) -> None:
        if name == self.setup.agent:
            return
        kind = find_agent(name, self._kinds)
        setup = replace(self.setup, agent=name, settings={**self.setup.settings, **kind.needs})
        mode = self.host.config.control.mode
        if mode not in kind.controls:
            why = f"agent {name} needs control={kind.controls[0]!r}"
            done = self._restart(with_control(setup, kind.controls[0]), why)
        elif setup.settings != self.setup.settings:
            done = self._restart(setup, f"agent {name} has settings of its own")
        else:
            self._agent, done = kind.make(self.host, setup.seed), True
            self.setup = setup
            self._agent.begin(np.ones(self.host.num_envs, bool))
            self._say("")
        if not done:
            self.panel.set("agent", self.setup.agent)

    def _tune(self, name: str, value: float) -> None:
        """Change a setting at once where the running environments allow it, else in new ones."""
        tuning = self.host.groups[0].tuning
        if name not in tuning.values:
            self._say(tuning.refusal(name, value) or "")
        elif value != tuning.values[name]:
            reason = tuning.refusal(name, value)
            if reason is None:
                self.host.tune({name: value})
                self.tuned[name] = value
                self._say(f"{name} = {value:g}")
            elif not self._restart(self._tuned_setup({name: value}), f"{name} = {value:g}: {reason}"):
                self.panel.set(name, tuning.values[name])

    def _tuned_setup(self, more: Mapping[str, float] | None = None) -> Setup:
        """Return the setup with the settings that were changed since, and more of them."""
        values, physics = self.tuned | dict(more or {}), self.host.config.physics
        if STIFFNESS in values and physics.soft_young_modulus is not None:
            values["physics.soft_young_modulus"] = (
                physics.soft_young_modulus * values[STIFFNESS] / physics.young_modulus
            )
        bare = [name.rpartition(".")[2] for name in values]
        kept = {name: value for name, value in self.setup.settings.items() if name not in bare}
        return replace(self.setup, settings=kept | values)

    def _restart(self, setup: Setup, why: str) -> bool:
        """Build other environments and begin there; without success everything stays as it is.

        Returns:
            Whether it was done.
        """
        self._say("building the environment ...")
        try:
            host = setup.make()
        except (ConfigError, ValueError, ImportError) as error:
            self._say(f"{why}: not possible: {error}")
            return False
        self._adopt(setup, host)
        self.begin(setup.seed)
        self._say(f"begun anew: {why}")
        return True

    def _adopt(self, setup: Setup, host: EpisodeHost) -> None:
        """Play other environments from now on."""
        before, self.host, self.setup = self.host, host, setup
        self.tuned, self.env = {}, min(self.env, setup.num_envs - 1)
        self._populate()
        self._select()
        before.close()
        for name, value in host.groups[0].tuning.values.items():
            if name in self.panel.handles:
                self.panel.set(name, value)
        self.panel.set("agent", setup.agent)

    # balls

    def _choose_pointer(self, pointer: str, _client: int | None) -> None:
        self.live.view.pointer = pointer
        if pointer == "throw" and not self.setup.ball:
            self._restart(replace(self._tuned_setup(), ball=True), "there is a ball to throw")

    def _click(self, client: int, origin: np.ndarray, direction: np.ndarray) -> None:
        """Queue a throw, in the server's thread."""
        self.panel.send(Command("throw", (origin, direction), client))

    def _throw(self, ray: tuple[np.ndarray, np.ndarray], _client: int | None) -> None:
        """Throw the ball to where a ray from the viewer hits a body, in the environment that is shown."""
        if not self._throwers:
            return
        batch, own = self.host.group_of(self.env)
        simulation = batch.simulation
        last = simulation.avatars[-1].body
        bodies = simulation.state.x.numpy()[own, : last.first + last.count]
        target = aim(*ray, bodies)
        gravity, box = -float(simulation.model.step.gravity[2]), simulation.domain
        start, velocity = throw(
            ray[0], target, self.ball["ball_speed"], gravity, BALL_RADIUS, (np.array(box.lower), np.array(box.upper))
        )
        self._throwers[self.host.groups.index(batch)].throw(own, start, velocity, self.ball["ball_mass"])
        self._say(f"{self.ball['ball_mass']:g} kg thrown at {self.ball['ball_speed']:g} m/s")

    # files

    def _record(self, _value: None, client: int | None) -> None:
        """Begin a clip, or end it and offer it to the browser that has begun it."""
        if self.recording:
            self._stop_recording()
            return
        rate = self.host.frame_rate
        self.recording = Recording(self.live.view.camera_of(client), rate, self._format, client)
        self.panel.show_recording(True)
        self._say(f"recording, {MOST_FRAMES} control steps at most")

    def _stop_recording(self) -> None:
        recording, self.recording = self.recording, None
        self.panel.show_recording(False)
        self.clip = recording.finish()
        self._say(f"a clip of {len(recording.frames)} pictures")
        self._offer(f"{name_of(self.setup)}.{recording.kind}", self.clip, recording.client)

    def _offer(self, name: str, content: bytes, client: int | None) -> None:
        """Offer a file as a download, to a browser or to all."""
        server = self.live.view.server
        receiver = server if client is None else server.get_clients().get(client)
        if receiver is not None:
            receiver.send_file_download(name, content, save_immediately=True)

    def saved(self) -> SavedScene:
        """Return the scene as it is now."""
        about = self.setup, dict(self.tuned), self.env, self.live.color, self.played, self.total
        return SavedScene(*about, self.host.get_state())

    def _save(self, _value: None, client: int | None) -> None:
        """Save the scene, offer the file, and show a link to it."""
        content = self.saved().to_bytes()
        path = self._scenes.save(content, name_of(self.setup))
        self.panel.show_link(self._links.link(path), f"python -m piavatar_envs watch --scene {path}")
        self._offer(path.name, content, client)
        self._say(f"saved {path}")

    def _open(self, given: Path | bytes, _client: int | None) -> None:
        """Open a saved scene: a file of the folder, or what a browser has sent."""
        if isinstance(given, Path):
            self.open(read_scene(given))
            return
        scene = SavedScene.from_bytes(given)
        unknown = file_digests(scene.setup.task().config).keys() - file_digests(self.host.config).keys()
        if unknown:
            raise ValueError(f"{', '.join(sorted(unknown))} names a file of this machine; open the scene by --scene")
        self.open(scene)

    def open(self, scene: SavedScene) -> None:
        """Go on where a scene was saved, on this machine's device.

        Raises:
            ValueError: it does not fit this version, these files or these agents; then everything stays as it is.
        """
        setup = replace(scene.setup, device=self.setup.device)
        find_agent(setup.agent, self._kinds)
        self._say("building the environment ...")
        host = setup.make()
        try:
            host.set_state(dict(scene.state))
            host.tune(scene.tuned)
        except ValueError:
            host.close()
            raise
        self.env = min(max(int(scene.env), 0), setup.num_envs - 1)
        self._adopt(setup, host)
        self.tuned = dict(scene.tuned)
        self.played, self.total, self._info = int(scene.played), float(scene.total), {}
        self.steps = int(host.read(lambda group: group.step_count)[self.env])
        self._over = host.find_ended()
        self.panel.set("env", str(self.env))
        self.live.color = scene.color
        self.panel.set("color", scene.color)
        for name, value in scene.tuned.items():
            self.panel.set(name, value)
        self.live.begin()
        self._fill_table()
        self._say(f"{setup.env_id}, step {self.steps}")


def with_control(setup: Setup, mode: str) -> Setup:
    """Return a setup under another mode of control, without settings that are only of the one before."""
    of_control = {_OF_CONTROL, "tone", "alpha"}
    kept = {
        name: value
        for name, value in setup.settings.items()
        if name not in of_control and not name.startswith(f"{_OF_CONTROL}.")
    }
    return replace(setup, settings={**kept, _OF_CONTROL: mode})


def name_of(setup: Setup) -> str:
    """Return the name of a setup's files."""
    return setup.env_id.rpartition("/")[2].rpartition(":")[2]


def sliders(host: EpisodeHost) -> list[Slider]:
    """Return the sliders of the settings that environments can change, or could in new ones."""
    values = host.groups[0].tuning.values
    kilo = values[STIFFNESS] / 1000.0
    given = {
        STIFFNESS: ("Stiffness [kPa]", 0.1 * kilo, 2.0 * kilo, 0.05 * kilo, values[STIFFNESS], 1000.0),
        FRICTION: ("Friction", 0.0, 2.0, 0.05, values[FRICTION]),
        GRAVITY: ("Gravity [m/s²]", 0.0, 20.0, 0.01, values[GRAVITY]),
    }
    if TONE in values:
        given |= {name: (label, 0.0, 1.0, 0.05, values[name]) for name, label in ((TONE, "Tone"), (ALPHA, "Alpha"))}
    return [Slider(name, *rest) for name, rest in given.items()]
