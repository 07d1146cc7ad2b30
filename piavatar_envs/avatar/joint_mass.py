"""The mass matrix of an avatar's joints in every environment, and what is solved with it: arrays, and sums of pairs."""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.avatar.body import BodyPoints, normal_weights
from piavatar_envs.avatar.cholesky import factor_size, find_pattern
from piavatar_envs.avatar.lanes import warp_threads
from piavatar_envs.avatar.mass_matrix import NUM_DOF, filled_entries
from piavatar_envs.avatar.mass_pairs import build_pairs, sum_pairs
from piavatar_envs.avatar.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.avatar.types import Body, vec12, vec16
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.types import Model, State

#: What joints know of the inertia that flesh has on the grid. Without it 14 of 32 ``tiny`` bodies that lie on the floor
#: fail within 200 control steps of random torques; with it none of 48 does, nor with three times as many substeps.
GRID_SHARE = 0.25
TRUNK = ("pelvis", "spine1", "spine2", "spine3")


def grid_inertia(points: BodyPoints, dx: float) -> np.ndarray:
    """Inertia of joints besides that of the limbs they move, for the grid's sake, ``(22,)`` [kg m^2].

    Between particles and nodes matter is spread: with quadratic weights by ``dx^2/4`` along each axis, as mean square
    (``D_p`` of Jiang et al. 2015), so that flesh of mass ``m`` turns on the grid with ``m dx^2/2`` besides its own
    inertia. Joints that know nothing of it turn a hand that is smaller than a cell by more than the grid lets it go,
    and the two throw it about until it fails. A share of it is enough; what it is for has a name in other engines,
    ``armature``. The mass is that of the bones' own flesh in the shape that the body is built with. The trunk, which is
    several cells thick, has none: a spine that resists so would bend by a tenth more under a ball of 8 kg.
    """
    shares = normal_weights(points) * points.mass[0][:, None]
    mass = np.bincount(points.skin_joints.ravel(), shares.ravel(), minlength=NUM_JOINTS)
    mass[[joint_index(name) for name in TRUNK]] = 0.0
    return GRID_SHARE * 0.5 * dx**2 * mass


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
