"""Velocity fields in NumPy terms: which subject owns them, and how they rub."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from piavatar_envs.mpm.types import Contact

#: One bit of an int32 a field; the sign is left alone.
MAX_FIELDS = 31
#: Gap between two bodies' surfaces below which they touch [grid spacings].
CONTACT_GATE = 0.15


@dataclass(frozen=True)
class Fields:
    """Velocity fields of a world; the default is a single body.

    Attributes:
        subject: subject of each field, counted from 0, the fields of a subject next to each other, its trunk first.
        friction: Coulomb coefficient of every pair of fields, shape ``(F, F)`` or one number.
        density: reference density of each field's matter [kg/m^3], shape ``(F,)`` or one number.
        gate: gap between the surfaces of two fields below which they touch [grid spacings]; from 3 on any.
        normals: ``"shared"`` (one normal a pair) or ``"own"`` (the paper's rule, which loses momentum).
        num_sensors: rows of the contact sensor that particles refer to.
    """

    subject: Sequence[int] = (0,)
    friction: np.ndarray | float = 0.0
    density: np.ndarray | float = 1000.0
    gate: float = CONTACT_GATE
    normals: str = "shared"
    num_sensors: int = 0

    @property
    def num_fields(self) -> int:
        """Number of velocity fields."""
        return len(self.subject)

    @property
    def num_subjects(self) -> int:
        """Number of subjects."""
        return max(self.subject) + 1

    def check(self) -> None:
        """Refuse what the grid cannot hold.

        Raises:
            ValueError: too many fields, subjects out of order, a negative friction, an unknown rule for normals, or
                fields of one subject with different reference densities.
        """
        if self.num_fields > MAX_FIELDS:
            raise ValueError(
                f"{self.num_fields} velocity fields exceed {MAX_FIELDS}; use fewer subjects, or self_contact=False"
            )
        steps = np.diff(np.array([-1, *self.subject]))
        if not np.isin(steps, (0, 1)).all() or self.subject[0] != 0:
            raise ValueError(f"subjects of the fields {list(self.subject)} must be 0, 1, ... in order")
        if not np.all(np.asarray(self.friction) >= 0.0):
            raise ValueError(f"friction={np.min(self.friction):g} between bodies must not be negative")
        density = np.broadcast_to(np.asarray(self.density, float), (self.num_fields,))
        for subject in range(self.num_subjects):
            own = density[np.array(self.subject) == subject]
            if np.ptp(own) > 0.0:
                raise ValueError(
                    f"density={own.tolist()} of the fields of subject {subject}: fields that grow together share one "
                    f"reference density"
                )
        if self.normals not in ("shared", "own"):
            raise ValueError(f"normals={self.normals!r} must be 'shared' or 'own'")
        if not (np.isfinite(self.gate) and self.gate >= 0.0):
            raise ValueError(f"gate={self.gate} must be a gap of at least 0 grid spacings")

    def upload(self, dx: float, rows: int, device: str) -> Contact:
        """Kernel argument; ``rows`` (1 or ``num_envs``) copies of the densities and coefficients.

        Raises:
            ValueError: see :meth:`check`.
        """
        self.check()
        count = self.num_fields
        friction = np.broadcast_to(np.asarray(self.friction, np.float32), (rows, count, count)).reshape(rows, -1)
        density = np.broadcast_to(np.asarray(self.density, np.float32), (rows, count))
        contact = Contact()
        contact.num_fields, contact.num_subjects = count, self.num_subjects
        contact.own_normals = int(self.normals == "own")
        contact.gate = self.gate * dx
        trunk = [self.subject.index(subject) for subject in self.subject]
        contact.subject = wp.array(np.array(self.subject, np.int32), dtype=int, device=device)
        contact.trunk = wp.array(np.array(trunk, np.int32), dtype=int, device=device)
        contact.friction = wp.array(np.ascontiguousarray(friction), dtype=float, device=device)
        contact.density = wp.array(np.ascontiguousarray(density), dtype=float, device=device)
        return contact
