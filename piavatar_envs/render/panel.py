"""Controls and a table beside the scene of a live view."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from piavatar_envs.render.quantities import QUANTITIES

if TYPE_CHECKING:
    import viser

SLOWEST, FASTEST = 0.1, 4.0


class Panel:
    """Buttons and a table in the browser; clicks arrive in other threads, and are only stored here.

    Attributes:
        playing: whether the simulation runs.
        speed: greatest ratio of simulated to real time.
        color: of the bodies, ``"skin"`` or a name of :data:`~piavatar_envs.render.quantities.QUANTITIES`.
    """

    def __init__(self, server: viser.ViserServer, color: str = "skin") -> None:
        """Add everything to the server's panel.

        Args:
            server: of the live view.
            color: of the bodies at first.
        """
        self.playing, self.speed, self.color = True, 1.0, color
        self._single_step, self._new_episode = False, False
        gui = server.gui
        self._play = gui.add_button("Pause")
        self._step = gui.add_button("Single step")
        self._begin = gui.add_button("New episode")
        self._speed = gui.add_slider("Speed", SLOWEST, FASTEST, 0.1, 1.0, hint="simulated over real time, at most")
        self._color = gui.add_dropdown("Colour", ("skin", *QUANTITIES), initial_value=color)
        self._text = gui.add_markdown("")
        self._play.on_click(lambda _event: self.play(not self.playing))
        self._step.on_click(lambda _event: self.request_step())
        self._begin.on_click(lambda _event: self.request_episode())
        self._speed.on_update(lambda _event: setattr(self, "speed", self._speed.value))
        self._color.on_update(lambda _event: setattr(self, "color", self._color.value))

    def play(self, playing: bool) -> None:
        """Run or pause."""
        self.playing = playing
        self._play.label = "Pause" if playing else "Play"

    def request_step(self) -> None:
        """Pause after one more step."""
        self.play(False)
        self._single_step = True

    def request_episode(self) -> None:
        """Begin a new episode before the next step."""
        self._new_episode = True

    def take_step(self) -> bool:
        """Return whether to step now; a requested single step counts once."""
        requested, self._single_step = self._single_step, False
        return requested or self.playing

    def take_episode(self) -> bool:
        """Return whether a new episode was requested since the last call."""
        requested, self._new_episode = self._new_episode, False
        return requested

    def show_table(self, title: str, values: Mapping[str, str]) -> None:
        """Show a table.

        Args:
            title: above the table.
            values: by name, a row each.
        """
        rows = [f"| {name} | {value} |" for name, value in values.items()]
        self._text.content = "\n".join([f"**{title}**", "", "| | |", "| :-- | --: |", *rows])
