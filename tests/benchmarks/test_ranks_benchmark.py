"""The benchmark of ranks: what it makes of a training run's figures."""

from __future__ import annotations

import pytest

pytest.importorskip("tensorboard", reason="needs the extra train")

from torch.utils.tensorboard import SummaryWriter

from benchmarks.speed import ranks


def test_time_to_a_share_of_successes_counts_episodes_of_ten_iterations(tmp_path):
    """From the twentieth iteration on, all of the episodes succeed: nine of ten do from the 29th."""
    with SummaryWriter(str(tmp_path)) as writer:
        for iteration in range(40):
            writer.add_scalar("Episodes/ended", 0.25, iteration)
            writer.add_scalar("Episodes/succeeded", 0.25 if iteration >= 20 else 0.0, iteration)
    logged = ranks.scalars(tmp_path)
    assert ranks.time_to(0.9, [2.0] * 40, logged) == pytest.approx(2.0 * 29)
    assert ranks.time_to(0.9, [2.0] * 5, logged) is None
    never = {"Episodes/ended": [0.0] * 40, "Episodes/succeeded": [0.0] * 40}
    assert ranks.time_to(0.5, [2.0] * 40, never) is None
