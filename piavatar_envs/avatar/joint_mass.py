"""The mass matrix of an avatar's joints in every environment, and what is solved with it: arrays, and sums of pairs."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.avatar.cholesky import factor_size, find_pattern
from piavatar_envs.avatar.lanes import warp_threads
from piavatar_envs.avatar.mass_matrix import NUM_DOF, filled_entries
from piavatar_envs.avatar.mass_pairs import build_pairs, sum_pairs
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import Body, vec12, vec16
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Model, State


class JointMass:
    """``M = J^T m J`` of one avatar; see :mod:`piavatar_envs.avatar.mass_matrix`.

    Attributes:
        pairs: of bones that have particles in common.
        sums: their moments, ``(num_envs, chunks)``.
        matrix: the mass matrix, ``(num_envs, 69, 69)``.
        pattern: where its factors have entries.
        records: on a CPU, where the matrix is composed, one body after the other.
    """

    def __init__(self, points: BodyPoints, body: Body, model: Model) -> None:
        n, device = model.num_envs, model.device
        self.body, self.model, self.threads = body, model, warp_threads(device)
        self.pairs = build_pairs(points, device)
        self.matrix = wp.zeros((n, NUM_DOF, NUM_DOF), dtype=float, device=device)
        self.pattern = find_pattern(filled_entries(self.pairs), device)
        self.sums = wp.zeros((n, len(self.pairs.entry_start) - 1), dtype=vec12, device=device)
        self.records = wp.zeros(NUM_JOINTS * NUM_JOINTS, dtype=vec16, device=device)

    def make_factors(self, systems: int) -> wp.array:
        """Room for so many Cholesky factors."""
        return wp.zeros((systems, factor_size(NUM_DOF)), dtype=float, device=self.model.device)

    def record_sums(self, program: Program, state: State, position: wp.array) -> None:
        """Append: moments of all pairs for joints at ``position`` [m]."""
        program.launch(
            sum_pairs,
            (*self.sums.shape, self.threads),
            [self.body, self.pairs, self.model.particles, state.x, position, self.threads],
            [self.sums],
        )
