"""Trainings whose numbers are not finite any more: they end with a line, before what they would leave is written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch


class Diverged(ArithmeticError):
    """A training that has nothing left to go on from; the message is one line."""


def check_finite(
    modules: Mapping[str, torch.nn.Module],
    outputs: Mapping[str, torch.Tensor],
    steps: int,
    rate: tuple[str, float],
    checkpoint: Path | None = None,
) -> None:
    """End a training that has diverged.

    Args:
        modules: the networks, by name.
        outputs: what they make of what was observed last, by name.
        steps: of the environments, so far.
        rate: name and value of the learning rate's setting.
        checkpoint: of the training, if it has one.

    Raises:
        Diverged: a parameter or an output is not finite.
    """
    named = [(f"{name}.{own}", tensor) for name, part in modules.items() for own, tensor in part.named_parameters()]
    named += outputs.items()
    # one answer of all, for which a GPU is waited for once
    if torch.stack([tensor.isfinite().all() for _, tensor in named]).all():
        return
    name, tensor = next((name, tensor) for name, tensor in named if not tensor.isfinite().all())
    place = (~tensor.isfinite()).nonzero()[0].tolist()
    kept = f"; {checkpoint} is left as it was before" if checkpoint is not None and checkpoint.exists() else ""
    setting, value = rate
    raise Diverged(
        f"the training has diverged: {name}{place or ''} is {tensor[tuple(place)].item()}, not finite, after {steps} "
        f"steps; begin anew in another folder (--out) with a smaller {setting}, now {value:g}{kept}"
    )
