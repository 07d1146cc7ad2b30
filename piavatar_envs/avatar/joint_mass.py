"""The mass matrix of an avatar's joints in every environment: recorded, factorised, solved with."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.avatar.cholesky import factor_size, factorize, find_pattern, solve
from piavatar_envs.avatar.lanes import warp_threads
from piavatar_envs.avatar.mass_matrix import NUM_DOF, compose_mass, filled_entries
from piavatar_envs.avatar.mass_pairs import build_pairs, sum_pairs
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.avatar.types import Body, vec12, vec16
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Model, State


class JointMass:
    """``M = J^T m J`` of one avatar; see :mod:`piavatar_envs.avatar.mass_matrix`.

    Attributes:
        matrix: the mass matrix, ``(num_envs, 69, 69)``.
    """

    def __init__(self, points: BodyPoints, body: Body, model: Model) -> None:
        n, device = model.num_envs, model.device
        self.body, self.model, self.threads = body, model, warp_threads(device)
        self.pairs = build_pairs(points, device)
        self.matrix = wp.zeros((n, NUM_DOF, NUM_DOF), dtype=float, device=device)
        self.pattern = find_pattern(filled_entries(self.pairs), device)
        self._every = wp.full(n, 1, dtype=int, device=device)
        self._sums = wp.zeros((n, len(self.pairs.entry_start) - 1), dtype=vec12, device=device)
        alone = n if self.threads == 1 else 1  # threads that share a matrix do so in shared memory
        self._scratch = wp.zeros((alone, NUM_JOINTS * NUM_JOINTS), dtype=vec16, device=device)

    def record(self, program: Program, state: State, position: wp.array) -> None:
        """Append: build the matrix for joints at ``position`` [m]."""
        program.launch(
            sum_pairs,
            (*self._sums.shape, self.threads),
            [self.body, self.pairs, self.model.particles, state.x, position, self.threads],
            [self._sums],
        )
        inputs = [self.body, self.pairs, self._sums, position, self.threads, self._scratch]
        program.launch(compose_mass, (self.model.num_envs, self.threads), inputs, [self.matrix], block_dim=self.threads)

    def make_factors(self, systems: int) -> wp.array:
        """Room for so many Cholesky factors."""
        return wp.zeros((systems, factor_size(NUM_DOF)), dtype=float, device=self.model.device)

    def record_factors(
        self, program: Program, diagonal: wp.array, factor: wp.array, wanted: wp.array | None = None
    ) -> None:
        """Append: Cholesky factors of the matrix and a diagonal, of all environments or of those ``wanted``.

        Those of several diagonals, all environments of the first one first, are found together.
        """
        wanted = self._every if wanted is None else wanted
        inputs = [self.pattern, self.matrix, diagonal, wanted, self.threads]
        program.launch(factorize, (factor.shape[0], self.threads), inputs, [factor], block_dim=self.threads)

    def record_solve(
        self, program: Program, factor: wp.array, right: wp.array, x: wp.array, wanted: wp.array | None = None
    ) -> None:
        """Append: solve with a factor, in all environments or in those ``wanted``; once or several times in each."""
        wanted = self._every if wanted is None else wanted
        inputs = [self.pattern, factor, right, wanted, self.threads]
        program.launch(solve, (x.shape[0], self.threads), inputs, [x], block_dim=self.threads)
