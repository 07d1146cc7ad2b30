"""The learning curve of a training, whichever library learns."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.folders import write_whole


@dataclass
class Curve:
    """Returns of the training episodes, as they ended.

    Attributes:
        steps: control steps taken by then, over all workers and their learning agents.
        returns: undiscounted returns, of actions that were drawn at random from the policy.
        seconds: time that the training took [s], over all its parts where it was resumed.
        train_steps: control steps of all of it, set when it is over; the last episode that ended did so earlier.
    """

    steps: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    seconds: float = 0.0
    train_steps: int = 0

    def csv(self) -> str:
        """It as CSV, a row an episode."""
        rows = [f"{step},{value:.6g}" for step, value in zip(self.steps, self.returns, strict=True)]
        return "\n".join(["step,return", *rows]) + "\n"

    def save(self, path: Path) -> None:
        """Write it as CSV."""
        write_whole(path, lambda file: file.write(self.csv().encode()))

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"steps": list(self.steps), "returns": list(self.returns), "seconds": self.seconds}

    def load(self, state: dict[str, Any]) -> None:
        """Go on where :meth:`state` was."""
        self.steps, self.returns, self.seconds = list(state["steps"]), list(state["returns"]), state["seconds"]
