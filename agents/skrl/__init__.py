"""Multi-agent PPO with skrl on a batch of worlds.

skrl joins a group of GPUs where torchrun's variables stand when it is imported. A group of any devices is joined by
:mod:`agents.ranks` instead, so they are hidden from this import.
"""

import os

_size = os.environ.pop("WORLD_SIZE", None)
try:
    import skrl  # noqa: F401
finally:
    if _size is not None:
        os.environ["WORLD_SIZE"] = _size
