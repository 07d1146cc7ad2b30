"""torchrun on two machines, here two processes: they and their ranks are forked with all that ranks import.

``python -m tests.agents.rank_launch ARGS`` is ``torchrun ARGS`` on each; it fails if both do. To import anew would take
every rank longer than its training runs.
"""

from __future__ import annotations

import os
import sys
import traceback

from torch.distributed import run

import agents.rsl_rl.train
import agents.skrl.train  # noqa: F401 - as the ranks do


def launch(args: list[str]) -> int:
    """Run torchrun and return its exit status."""
    try:
        run.main(["--start-method=fork", "--run-path", *args])
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    if (other := os.fork()) == 0:
        os._exit(launch(sys.argv[1:]))
    own = launch(sys.argv[1:])
    sys.exit(own and os.waitstatus_to_exitcode(os.waitpid(other, 0)[1]))
