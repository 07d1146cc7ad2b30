"""Controls, plots and a table beside the scene of a live view.

Browsers share them: what one changes, all see. A change only puts a :class:`Command` into a queue, from which the
thread that steps takes it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from piavatar_envs.render.live import POINTERS
from piavatar_envs.render.quantities import QUANTITIES

if TYPE_CHECKING:
    import viser

SLOWEST, FASTEST = 0.1, 4.0
#: Formats of recorded clips.
FORMATS = ("mp4", "gif")
#: Points of a plot: the last 10 s of control steps of 1/30 s.
POINTS = 300
#: Ranges of mass [kg] and speed [m/s] of a thrown ball, and their first values.
BALL_MASS, BALL_SPEED = (0.1, 5.0, 0.5), (1.0, 10.0, 6.0)


@dataclass(frozen=True)
class Command:
    """A change of a control in a browser.

    Attributes:
        name: of the control.
        value: its value; of a button None.
        client: number of the browser; None for a change by the program.
    """

    name: str
    value: Any = None
    client: int | None = None


@dataclass(frozen=True)
class Slider:
    """A slider of a setting.

    Attributes:
        name: of the setting.
        label: shown beside it.
        low, high, step: range and smallest change.
        value: the first one.
        scale: the setting over what is shown.
    """

    name: str
    label: str
    low: float
    high: float
    step: float
    value: float
    scale: float = 1.0


class Plot:
    """A plot of the last :data:`POINTS` control steps."""

    def __init__(self, gui: viser.GuiApi, title: str, lines: Mapping[str, str]) -> None:
        """Add an empty plot.

        Args:
            gui: of the server.
            title: with the unit.
            lines: CSS colours by label.
        """
        self._rows: deque[tuple[float, ...]] = deque(maxlen=POINTS)
        self._width = 1 + len(lines)
        series = (
            {"label": "time [s]"},
            *({"label": name, "stroke": color, "width": 2} for name, color in lines.items()),
        )
        self._handle = gui.add_uplot(
            self.data, series, title=title, scales={"x": {"time": False}}, height=140, padding=(4, 8, 0, 0)
        )

    @property
    def data(self) -> tuple[np.ndarray, ...]:
        """Times [s] and values of every line, shape ``(steps,)`` each."""
        return tuple(np.array(list(self._rows), float).reshape(-1, self._width).T.copy())

    def add(self, time: float, *values: float) -> None:
        """Append a step, which :meth:`show` shows; time that has jumped back clears the plot."""
        if self._rows and time <= self._rows[-1][0]:
            self._rows.clear()
        self._rows.append((time, *(value if np.isfinite(value) else 0.0 for value in values)))

    def show(self) -> None:
        """Send the steps to the browsers."""
        self._handle.data = self.data


class Panel:
    """Controls and a table in tabs, and plots.

    Attributes:
        handles: the library's handles of all controls, by the names of their commands.
        reward, impulse: plots.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        color: str,
        agents: Sequence[str],
        agent: str,
        num_envs: int,
        sliders: Sequence[Slider],
    ) -> None:
        """Add everything to the server's panel.

        Args:
            server: of the live view.
            color: of the bodies at first.
            agents: names of all agents.
            agent: the first one.
            num_envs: number of environments.
            sliders: of settings.
        """
        self.handles: dict[str, Any] = {}
        self._scales: dict[str, float] = {}
        self._commands: SimpleQueue[Command] = SimpleQueue()
        self._gui = gui = server.gui
        self._words = gui.add_markdown("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Play"):
            for name, label in (("play", "Pause"), ("step", "Single step"), ("episode", "New episode")):
                self._button(name, label)
            self._slider(Slider("speed", "Speed", SLOWEST, FASTEST, 0.1, 1.0), "simulated over real time, at most")
            self._choice("agent", "Agent", agents, agent)
            self._choice("env", "Environment", [str(env) for env in range(num_envs)], "0", visible=num_envs > 1)
            self._choice("color", "Colour", ("skin", *QUANTITIES), color)
            self._table = gui.add_markdown("")
        with tabs.add_tab("Touch"):
            self._choice("pointer", "Pointer", POINTERS, POINTERS[0])
            gui.add_markdown(
                "**drag** pulls bodies and props by a spring, **throw** throws a ball to where you click. Ctrl and the "
                "left button drag with any pointer."
            )
            self._slider(Slider("ball_mass", "Ball mass [kg]", *BALL_MASS[:2], 0.1, BALL_MASS[2]))
            self._slider(Slider("ball_speed", "Ball speed [m/s]", *BALL_SPEED[:2], 0.5, BALL_SPEED[2]))
        with tabs.add_tab("Tune"):
            for slider in sliders:
                self._slider(slider)
            if not sliders:
                gui.add_markdown("This environment has no such settings.")
        with tabs.add_tab("Files"):
            self._choice("format", "Clip", FORMATS, FORMATS[0])
            self._button("record", "Record a clip")
            self._button("save", "Save the scene")
            upload = gui.add_upload_button("Open a scene", mime_type=".npz")
            upload.on_upload(self._sender("open", lambda handle: handle.value.content))
            self.handles["open"] = upload
            self._link = gui.add_markdown("")
        with gui.add_folder("Plots"):
            self.reward = Plot(gui, "reward of a step", {"reward": "#228be6"})
            lines = {"ground": "#868e96", "bodies": "#e8590c", "mouse": "#2f9e44"}
            self.impulse = Plot(gui, "impulse in a step [N s]", lines)

    def _sender(
        self, name: str, value_of: Callable[[Any], Any] = lambda handle: handle.value
    ) -> Callable[[viser.GuiEvent], Coroutine]:
        """Return a callback that queues a command; a coroutine, because the library runs others in any order."""
        commands = self._commands

        async def send(event: viser.GuiEvent) -> None:
            commands.put(Command(name, value_of(event.target), event.client_id))

        return send

    def _button(self, name: str, label: str) -> None:
        self.handles[name] = self._gui.add_button(label)
        self.handles[name].on_click(self._sender(name, lambda _handle: None))

    def _slider(self, slider: Slider, hint: str | None = None) -> None:
        value, scale = min(max(slider.value / slider.scale, slider.low), slider.high), slider.scale
        handle = self._gui.add_slider(slider.label, slider.low, slider.high, slider.step, value, hint=hint)
        handle.on_update(self._sender(slider.name, lambda handle: scale * handle.value))
        self.handles[slider.name], self._scales[slider.name] = handle, scale

    def _choice(self, name: str, label: str, options: Sequence[str], first: str, visible: bool = True) -> None:
        handle = self._gui.add_dropdown(label, tuple(options), initial_value=first, visible=visible)
        handle.on_update(self._sender(name))
        self.handles[name] = handle

    def send(self, command: Command) -> None:
        """Queue a command, from any thread."""
        self._commands.put(command)

    def take(self) -> list[Command]:
        """Return the commands since the last call; of repeated values of a control only the last one."""
        taken: list[Command] = []
        while True:
            try:
                command = self._commands.get_nowait()
            except Empty:
                return taken
            if taken and command.value is not None and taken[-1].name == command.name and command.name != "throw":
                taken.pop()
            taken.append(command)

    def set(self, name: str, value: Any) -> None:
        """Show a value of a control, which queues no command where it is shown already."""
        self.handles[name].value = value / self._scales[name] if name in self._scales else value

    def show_playing(self, playing: bool) -> None:
        """Label the button that pauses or plays."""
        self.handles["play"].label = "Pause" if playing else "Play"

    def show_recording(self, recording: bool) -> None:
        """Label the button that records or stops."""
        self.handles["record"].label = "Stop, and download" if recording else "Record a clip"

    def show_words(self, words: str) -> None:
        """Show a message above all controls; none for an empty one."""
        self._words.content = f"*{words}*" if words else ""

    def show_link(self, url: str, command: str) -> None:
        """Show the address and the command that open a saved scene."""
        self._link.content = f"[{url}]({url})\n\n`{command}`"

    def show_table(self, title: str, values: Mapping[str, str]) -> None:
        """Show a table.

        Args:
            title: above the table.
            values: by name, a row each.
        """
        rows = [f"| {name} | {value} |" for name, value in values.items()]
        self._table.content = "\n".join([f"**{title}**", "", "| | |", "| :-- | --: |", *rows])
