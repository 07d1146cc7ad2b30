"""A rank of training runs that leaves what it has, fails, or interrupts: started by torchrun in ``test_ranks``.

``torchrun --nproc-per-node=2 -m tests.agents.rank_probe FOLDER LIBRARY FATE ARGS [-- LIBRARY FATE ARGS ...]`` is
``-m agents.LIBRARY.train ARGS``, one after the other. FATE is ``whole``; ``fails``: once, rank 1 raises an error in its
second iteration; or ``interrupts``: each sends Ctrl-C to its torchrun in its second. FOLDER gets ``FATE_N.json`` of
each rank, and the training ``FATE``.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import signal
import sys
from pathlib import Path

import torch

from agents.interrupt import StopRequest
from agents.ranks import Ranks
from piavatar_envs.config import ConfigError


def bits(tensors: dict[str, torch.Tensor]) -> str:
    """Return a digest of named tensors."""
    parts = [name.encode() + tensor.cpu().numpy().tobytes() for name, tensor in sorted(tensors.items())]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def main(folder: Path, library: str, fate: str, *args: str) -> None:
    """Train, and leave a file."""
    train = importlib.import_module(f"agents.{library}.train")
    ranks, facts, questions = Ranks.here(), {}, 0
    asked, learn, checked = StopRequest.asked, train.learn, train.check_finite

    def counted(stop: StopRequest) -> bool:
        nonlocal questions  # one per iteration, and one more after a checkpoint, as rsl_rl's first iteration has
        questions += 1
        if fate == "fails" and ranks.rank == 1 and questions == 3 and not (folder / "failed").exists():
            (folder / "failed").touch()
            raise ConfigError("the cable of rank 1 has come off")
        if fate == "interrupts" and questions == 2:
            os.kill(os.getppid(), signal.SIGINT)
        return asked(stop)

    def learned(config, task, folder, device, checkpoint):
        facts["resumed"] = checkpoint.state["iterations"] if checkpoint.state else 0
        return learn(config, task, folder, device, checkpoint)

    def watched(networks: dict[str, torch.nn.Module], *rest) -> None:
        facts["networks"] = bits({f"{n}.{k}": t for n, own in networks.items() for k, t in own.state_dict().items()})
        checked(networks, *rest)

    StopRequest.asked, train.learn, train.check_finite = counted, learned, watched
    try:
        train.main([*args, "--out", str(folder / fate), "--resume"])
    finally:
        StopRequest.asked, train.learn, train.check_finite = asked, learn, checked
    (folder / f"{fate}_{ranks.rank}.json").write_text(json.dumps(facts | {"ranks": ranks.size}))


if __name__ == "__main__":
    words = sys.argv[2:]
    while words:
        end = words.index("--") if "--" in words else len(words)
        main(Path(sys.argv[1]), *words[:end])
        words = words[end + 1 :]
