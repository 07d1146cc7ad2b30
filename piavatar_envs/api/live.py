"""One environment of a batch, shown in a web browser while it is simulated, at no more than real time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from piavatar_envs.api.scenery import Progress, Scenery
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.render.live import PORT, import_viser

if TYPE_CHECKING:
    from piavatar_envs.render.live import LiveView

#: Time between two scenes that are sent, at least [s]: no screen shows more.
_LEAST_INTERVAL = 1.0 / 60.0


class Pace:
    """Holds a loop back to a given time a turn; one that is slower goes on at once."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep):
        """The first turn begins now.

        Args:
            clock: the time [s].
            sleep: waits for a time [s].
        """
        self.clock, self._sleep = clock, sleep
        self.begin()

    def begin(self) -> None:
        """A turn begins now."""
        self._began = self.clock()

    def wait(self, seconds: float) -> None:
        """Sleep for what is left of a turn of that length, and begin the next one."""
        due, now = self._began + seconds, self.clock()
        if due <= now:
            self._began = now
            return
        self._sleep(due - now)
        # when it was due, not when the sleep ended, so that what sleeps oversleep does not add up
        self._began = due

    def rest(self, seconds: float) -> None:
        """Sleep, and begin a turn."""
        self._sleep(seconds)
        self.begin()


class Live:
    """Shows an environment in a web browser. The server starts with the first scene.

    Attributes:
        color: of the bodies, ``"skin"`` or ``"strain"``; may be changed at any time.
        pace: holds the steps back.
    """

    def __init__(
        self,
        batch: BatchEnv,
        color: Literal["skin", "strain"] = "skin",
        port: int = PORT,
        env: int = 0,
        pace: Pace | None = None,
    ) -> None:
        """Nothing is opened yet.

        Args:
            batch: where the environment lives.
            color: of the bodies.
            port: of this machine, or the next one that is free.
            env: the environment's number in the batch.
            pace: holds the steps back to real time; by the computer's clock.

        Raises:
            ImportError: the extra ``live`` is not installed.
        """
        import_viser()  # what is missing shows now, not at the first reset
        self.color, self.pace = color, pace or Pace()
        self._batch, self._port, self._env = batch, port, env
        self._progress, self._scenery = Progress(batch, env), Scenery(batch)
        self._view: LiveView | None = None
        self._shown, self._behind = 0.0, False

    @property
    def view(self) -> LiveView:
        """The view, opened if it is not.

        Raises:
            ValueError: a port that cannot be.
        """
        if self._view is None:
            from piavatar_envs.render import Camera
            from piavatar_envs.render.live import LiveView

            task = self._batch.task
            self._view = LiveView(Camera(task.camera_position, task.camera_target), self._port)
        return self._view

    def begin(self) -> None:
        """Show what a reset has left, and begin a control step now."""
        self.show()
        self.pace.begin()

    def step(self, speed: float = 1.0) -> None:
        """Show what a control step has left, and wait for what is left of its time.

        Args:
            speed: simulated over real time, at most.
        """
        self._behind = True
        if self._view is not None and self.pace.clock() - self._shown >= _LEAST_INTERVAL:
            self.show()
        self.pace.wait(self._batch.config.physics.control_dt / speed)

    def catch_up(self) -> None:
        """Show the last step, if it came too soon after the one before to be shown."""
        if self._behind and self._view is not None:
            self.show()

    def show(self) -> None:
        """Show how things are."""
        self._shown, self._behind = self.pace.clock(), False
        self.view.show(self._scenery.scene(self._env, self.color), self._progress.since_last())

    def close(self) -> None:
        """Stop the server, if it was started; closing twice is fine.

        What begins anew opens it again, a step does not.
        """
        if self._view is not None:
            self._view.close()
            self._view = None
