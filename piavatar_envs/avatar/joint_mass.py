"""The mass matrix of an avatar's joints in every environment, and what is solved with it: arrays, and sums of pairs."""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.avatar.cholesky import factor_size, find_pattern, lower_entries
from piavatar_envs.avatar.influences import in_order
from piavatar_envs.avatar.lanes import BLOCK, warp_threads
from piavatar_envs.avatar.mass_matrix import NUM_DOF, filled_entries
from piavatar_envs.avatar.mass_pairs import build_pairs, sum_pairs
from piavatar_envs.avatar.quarters import warps_of
from piavatar_envs.avatar.skeleton import JOINT_NAMES, NUM_JOINTS
from piavatar_envs.avatar.types import Body, vec12, vec16
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Model, State

#: Age that a mass matrix may reach [s]: a little older, and fast limbs are unstable.
LONGEST_REFRESH = 0.005
#: Substeps that a mass matrix may be used in. What the joints take over by an old one is wrong by more than itself in
#: directions in which a turned limb is much heavier than it was, and that grows from substep to substep. Moments of its
#: pairs must be as new: with those of the control step's beginning, turned with the bones, 71 of 192 ``tiny`` bodies
#: that lay on the floor failed within 200 control steps of random torques; with new ones none.
MOST_USES = 2
#: What joints whose limbs are thinner than a cell know of the inertia that flesh has on the grid. Without it 20 of 48
#: ``tiny`` bodies that lie on the floor fail within 200 control steps of random torques, with it 1 of 96. Ankles have
#: less: at 0.5 two of five walkers fell in every fifth episode, at 0.25 in 2 of 100 at most. Without, feet jerk.
GRID_SHARES = {"elbow": 0.5, "wrist": 0.5, "ankle": 0.25}


def grid_inertia(points: BodyPoints, dx: float) -> np.ndarray:
    """Inertia besides that of its limb with which a light joint takes over what particles do, ``(22,)`` [kg m^2].

    Between particles and nodes matter is spread: with quadratic weights by ``dx^2/4`` along each axis, as mean square
    (``D_p`` of Jiang et al. 2015), so that flesh of mass ``m`` turns on the grid with ``m dx^2/2`` besides its own
    inertia. Joints that know nothing of it take over more from a hand than the grid lets it have, and the two throw it
    about until it fails. A share of it is enough. What is not taken over stays with the particles: no momentum is
    lost. The mass is that of the bones' own flesh in the shape that the body is built with.

    Torques are to know nothing of it, or what reaches the ground of them would be less by this inertia than what a
    joint gives. Heavier joints neither: they take over from flesh that is pulled to bones, too, and something of that
    would be missing (a knee that bears 22 N m would give 1 more).
    """
    joints, weights = in_order(points.skin_joints, points.skin_weights)
    shares = weights * points.mass[0][:, None]
    mass = np.bincount(joints.ravel(), shares.ravel(), minlength=NUM_JOINTS)
    known = np.array([GRID_SHARES.get(name.split("_")[-1], 0.0) for name in JOINT_NAMES])
    return known * 0.5 * dx**2 * mass


class JointMass:
    """``M = J^T m J`` of one avatar; see :mod:`piavatar_envs.avatar.mass_matrix`.

    Attributes:
        pairs: of bones that have particles in common.
        sums: their moments, ``(num_envs, chunks)``.
        pattern: where its factors have entries.
        matrix: the mass matrix, ``(num_envs, factor_size)``; see :meth:`read`.
        records: on a CPU, where the matrix is composed, one body after the other.
        refresh: substeps that a matrix is used in.
    """

    def __init__(self, points: BodyPoints, body: Body, model: Model) -> None:
        n, device = model.num_envs, model.device
        self.body, self.model, self.threads = body, model, warp_threads(device)
        self.pairs = build_pairs(points, device)
        self.pattern = find_pattern(filled_entries(self.pairs), device)
        self.matrix = self.make_factors(n)
        self.sums = wp.zeros((n, int(self.pairs.chunk_start.numpy()[-1])), dtype=vec12, device=device)
        self.records = wp.zeros(NUM_JOINTS * NUM_JOINTS, dtype=vec16, device=device)
        self.refresh = min(MOST_USES, max(1, int(LONGEST_REFRESH / model.step.dt + 1e-6)))

    def is_due(self, step: int) -> bool:
        """Whether substep ``step`` of a control step has a matrix of its own."""
        return step % self.refresh == 0

    def make_factors(self, systems: int) -> wp.array:
        """Room for so many Cholesky factors, or matrices."""
        return wp.zeros((systems, factor_size(self.pattern)), dtype=float, device=self.model.device)

    def read(self) -> np.ndarray:
        """The mass matrices of all environments, ``(num_envs, 69, 69)``."""
        rows, columns, numbers = lower_entries(self.pattern)
        matrix = np.zeros((self.model.num_envs, NUM_DOF, NUM_DOF))
        matrix[:, rows, columns] = matrix[:, columns, rows] = self.matrix.numpy()[:, numbers]
        return matrix

    def record_sums(self, program: Program, state: State, position: wp.array) -> None:
        """Append: moments of all pairs for joints at ``position`` [m]."""
        program.launch(
            sum_pairs,
            (self.sums.shape[0], warps_of(self.pairs.quarters, self.threads), self.threads),
            [self.body, self.pairs, self.model.particles, state.x, position, self.threads],
            [self.sums],
            block_dim=BLOCK,
        )
