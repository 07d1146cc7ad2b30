"""What the views of many environments do alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from piavatar_envs.api.batched import BatchedEpisodes
    from piavatar_envs.envs.observations import ObservationLayout


class BatchedView:
    """Passes on to the environments what has nothing to do with how they are shown.

    Attributes:
        episodes: the environments.
    """

    episodes: BatchedEpisodes

    @property
    def observation_layout(self) -> ObservationLayout:
        """Name, slice, unit and frame of everything in the flat observation of an agent."""
        return self.episodes.layout

    def assist_root(self, share: float | np.ndarray) -> None:
        """Help the pelvis from now on: one share in [0, 1], or one an environment; ``control="pd"`` or ``"torque"``.

        Every avatar of an environment gets its share. Resets leave it.

        Raises:
            ValueError: it is out of range, of another shape, or the pose is driven.
        """
        self.episodes.assist_root(share)
