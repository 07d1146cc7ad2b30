"""Which particles the P2G of large bodies takes together, see :mod:`piavatar_envs.mpm.groups`."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.mpm.group_bricks import CAPACITY, THREADS

#: Up to how many particles of an environment a group has so many: smaller worlds fill a GPU with small groups only. The
#: numbers must not depend on the batch: units do on the group.
SHARES = ((16384, 32), (65536, 64), (2**31, THREADS))
#: Ways in which a body may be turned, of which a group's box should be small enough in each.
_TURNS = Rotation.random(8, random_state=0).as_matrix()


def share_of(per_env: int) -> int:
    """Particles of a group, at most, where an environment has ``per_env``."""
    return next(share for most, share in SHARES if per_env <= most)


def begin_groups(field: np.ndarray, rest: np.ndarray | None, dx: float) -> np.ndarray:
    """First particles and velocity fields of groups, ``(G + 1, 2)`` int32; the last row says where the others end.

    A group is of one field, and is halved where the box around it would be too large: then it would go in turns, and a
    substep would wait for it.

    Args:
        field: velocity fields of the particles of an environment, shape ``(P,)``.
        rest: where they are at rest [m], shape ``(P, 3)``; if not given, nothing is halved.
        dx: grid spacing [m].
    """
    share, changes = share_of(len(field)), np.flatnonzero(np.diff(field)) + 1
    bounds = np.concatenate([[0], changes, [len(field)]])
    begins = np.concatenate([*(np.arange(*ends, share) for ends in pairwise(bounds)), [len(field)]])
    while rest is not None and (too_large := _too_large(rest, begins, dx)).any():
        middle = (begins[:-1] + begins[1:] + 1) // 2
        begins = np.sort(np.concatenate([begins, middle[too_large]]))
    return np.column_stack([begins, np.append(field[begins[:-1]], 0)]).astype(np.int32)


def _too_large(rest: np.ndarray, begins: np.ndarray, dx: float) -> np.ndarray:
    """Of which groups, of more than one particle, the box has too many bricks in one of ``_TURNS``, shape ``(G,)``."""
    most = np.zeros(len(begins) - 1)
    for turn in _TURNS:
        places = rest @ turn.T / dx
        edges = np.maximum.reduceat(places, begins[:-1]) - np.minimum.reduceat(places, begins[:-1])
        most = np.maximum(most, np.prod((edges + 3.0) / 2.0 + 1.0, axis=1))  # a stencil is three nodes long
    return (most > int(CAPACITY)) & (np.diff(begins) > 1)
