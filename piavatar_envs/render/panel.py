"""What the visitors of a live view can ask for, and what they are told, beside the scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import viser

SLOWEST, FASTEST = 0.1, 4.0
COLORS = ("skin", "strain")


class Panel:
    """Buttons and a table in the browser. Clicks come from other threads: they only leave a wish here.

    Attributes:
        playing: whether the simulation shall run.
        speed: simulated over real time, at most.
        color: of the bodies, ``"skin"`` or ``"strain"``.
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
        self._color = gui.add_dropdown("Colour", COLORS, initial_value=color)
        self._text = gui.add_markdown("")
        self._play.on_click(lambda _event: self.play(not self.playing))
        self._step.on_click(lambda _event: self.ask_for_step())
        self._begin.on_click(lambda _event: self.ask_for_episode())
        self._speed.on_update(lambda _event: setattr(self, "speed", self._speed.value))
        self._color.on_update(lambda _event: setattr(self, "color", self._color.value))

    def play(self, playing: bool) -> None:
        """Let it run, or stand still."""
        self.playing = playing
        self._play.label = "Pause" if playing else "Play"

    def ask_for_step(self) -> None:
        """Stand still after one more step."""
        self.play(False)
        self._single_step = True

    def ask_for_episode(self) -> None:
        """Begin a new episode before the next step."""
        self._new_episode = True

    def take_step(self) -> bool:
        """Whether to make a step now; a single one that was asked for is granted once."""
        asked, self._single_step = self._single_step, False
        return asked or self.playing

    def take_episode(self) -> bool:
        """Whether a new episode was asked for since the last call."""
        asked, self._new_episode = self._new_episode, False
        return asked

    def tell(self, title: str, values: Mapping[str, str]) -> None:
        """Show a table.

        Args:
            title: above it.
            values: what stands beside each name.
        """
        rows = [f"| {name} | {value} |" for name, value in values.items()]
        self._text.content = "\n".join([f"**{title}**", "", "| | |", "| :-- | --: |", *rows])
