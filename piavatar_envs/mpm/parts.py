"""Parts of a world that share no velocity field, each of which need not wait for the others.

Between two grid passes particles are gathered, then scattered again, and no scatter has to do with the nodes of another
field, nor with its blocks. So a part may be scattered while another is still gathered: the launches that end, when few
CUDA blocks are left, fill up with those that begin.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import warp as wp

from piavatar_envs.mpm.types import Model

#: As many as are worth it: where two parts take 289 us a substep, four take 292 and one takes 292.
MOST_PARTS = 2
#: Scatters by groups of particles.
GROUPED = ("runs", "runs_float")


@dataclass(frozen=True)
class Part:
    """Some of the groups of every environment, and their particles: of both, the first and how many there are."""

    groups: wp.vec2i
    particles: wp.vec2i


def has_groups(model: Model) -> bool:
    """Whether particles are scattered by groups, see :mod:`piavatar_envs.mpm.groups`."""
    return model.scatter in GROUPED


def whole_world(model: Model) -> Part:
    """All groups, and all particles."""
    return Part(wp.vec2i(0, model.particles.groups.shape[0] - 1), wp.vec2i(0, model.num_particles))


def parts_of_world(model: Model) -> list[Part]:
    """Parts of about the same size; one where fields lie among each other, or where it is not groups that scatter."""
    if not has_groups(model):
        return [whole_world(model)]
    groups = model.particles.groups.numpy()
    begins, cuts = groups[:, 0], first_groups(groups)
    return [Part(wp.vec2i(a, b - a), wp.vec2i(int(begins[a]), int(begins[b] - begins[a]))) for a, b in pairwise(cuts)]


def first_groups(groups: np.ndarray) -> list[int]:
    """The first group of each part, and how many groups there are.

    Args:
        groups: see :func:`piavatar_envs.mpm.group_plan.begin_groups`, shape ``(G + 1, 2)``.
    """
    begins, field = groups[:, 0], groups[:-1, 1]
    count = len(field)
    apart = [g for g in range(1, count) if field[g] != field[g - 1] and not np.isin(field[:g], field[g:]).any()]
    wanted = begins[-1] * np.arange(1, MOST_PARTS) / MOST_PARTS
    nearest = {min(apart, key=lambda g: abs(begins[g] - size)) for size in wanted} if apart else set()
    return [0, *sorted(nearest), count]
