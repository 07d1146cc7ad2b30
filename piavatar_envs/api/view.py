"""What the views of one environment do alike, and those of many."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    import numpy as np

    from piavatar_envs.api.batched import BatchedEpisodes
    from piavatar_envs.api.episode import Episode
    from piavatar_envs.envs.observations import ObservationLayout


class EpisodeView:
    """Passes on to the only environment what has nothing to do with how it is shown."""

    _episode: Episode
    _built: ClassVar[tuple[str, ...]] = ("_episode", "batch")

    @property
    def _host(self) -> Episode:
        return self._episode

    @property
    def observation_layout(self) -> ObservationLayout:
        """Name, slice, unit and frame of everything in the flat observation of an agent."""
        return self._episode.batch.layout

    def render(self) -> np.ndarray | None:
        """The scene as ``(height, width, 3)`` uint8 with ``render_mode="rgb_array"``, else None.

        With ``"human"`` there is nothing to do: resets and steps update the live view.

        Raises:
            ImportError: the extra ``render`` is not installed.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        return self._episode.render()

    def close(self) -> None:
        """Free the renderer's window, and stop the live view; closing twice is fine."""
        self._episode.close()

    def assist_root(self, share: float) -> None:
        """Help the pelvis of every avatar from now on: a share in [0, 1]; ``control="pd"`` or ``"torque"``.

        Resets leave it.

        Raises:
            ValueError: it is out of range, or the pose is driven.
        """
        self._episode.batch.assist_root(share)

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on; ``set_state()`` restores it, bit for bit."""
        return self._episode.get_state()


class BatchedView:
    """Passes on to the environments what has nothing to do with how they are shown.

    Attributes:
        episodes: the environments.
    """

    episodes: BatchedEpisodes
    # a copy of what was closed is open: it has threads of its own
    _built: ClassVar[tuple[str, ...]] = ("episodes", "_pictures", "closed")

    @property
    def _host(self) -> BatchedEpisodes:
        return self.episodes

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
