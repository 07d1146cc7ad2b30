"""Flat patterns: flared panels as sectors of an annulus, which hang from any closed convex curve around a body.

A sector of an annulus with inner radius r0, whose angle over a full turn is f, closes to a cone about a round waist of
radius f r0: ``c(t) + f (r - r0) n(t) - sqrt(1 - f^2) (r - r0) z``. It is developable (do Carmo, "Differential Geometry
of Curves and Surfaces", 1976, sec. 3-5), and rest lengths are those of the flat sheet: a hem is 2 pi f (r0 + L) long.
About another convex curve of that length the rulings are spread evenly, and the drape settles the rest; so it does for
f beyond :data:`STEEPEST`, where the cloth falls into folds.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull

#: Height of a row of equilateral triangles over their side.
ROW = np.sqrt(0.75)
#: Greatest outward share of a hung panel's rulings before the drape; what is too wide then goes into folds.
STEEPEST = 0.5
#: Outward share of the folds that a wider panel starts with, and their number around the body.
_FOLD, _FOLDS = 0.12, 9
_SAMPLES, _SMOOTHING = 1024, 20.0


class Belt:
    """A closed convex curve around a section of a body, by arc length: an angle in [0, 2 pi), from the left forwards.

    Attributes:
        length: of the curve [m].
        height: above the ground [m].
    """

    def __init__(self, points: np.ndarray, ease: float) -> None:
        """Lay a smooth curve around points.

        Args:
            points: of the section [m], shape ``(K, 3)``.
            ease: distance of the curve from their convex hull [m].
        """
        hull = points[ConvexHull(points[:, :2]).vertices, :2]
        angle = np.linspace(0.0, 2.0 * np.pi, _SAMPLES, endpoint=False)
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        tangent = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        support = (hull @ normal.T).max(axis=0)  # smoothed, it still is one of a convex curve
        turn = (np.arange(_SAMPLES) + _SAMPLES // 2) % _SAMPLES - _SAMPLES // 2
        kernel = np.exp(-0.5 * (turn / _SMOOTHING) ** 2)
        support = np.real(np.fft.ifft(np.fft.fft(support) * np.fft.fft(kernel / kernel.sum())))
        low = np.maximum((hull @ normal.T).max(axis=0) - support, 0.0).max()
        support += ease + low
        slope = (np.roll(support, -1) - np.roll(support, 1)) / (4.0 * np.pi / _SAMPLES)
        curve = support[:, None] * normal + slope[:, None] * tangent
        self._curve = np.concatenate([curve, curve[:1]])
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._curve, axis=0), axis=1))])
        self.length, self.height = float(along[-1]), float(points[:, 2].mean())
        self._angle = along / along[-1] * 2.0 * np.pi

    def at(self, angle: np.ndarray) -> np.ndarray:
        """Return points of the curve [m], shape ``(N, 3)``."""
        x, y = (np.interp(angle % (2.0 * np.pi), self._angle, self._curve[:, axis]) for axis in range(2))
        return np.stack([x, y, np.full(len(angle), self.height)], axis=1)

    def angle(self, points: np.ndarray) -> np.ndarray:
        """Return the angles of the nearest points of the curve, shape ``(N,)``."""
        apart = np.linalg.norm(points[:, None, :2] - self._curve[None, :-1], axis=2)
        return self._angle[apart.argmin(axis=1)]


@dataclass(frozen=True, eq=False)
class Sector:
    """A mesh of a flat sector of an annulus, whose ends are sewn together where it is closed.

    Attributes:
        radius: inner radius r0 [m].
        flare: angle over a full turn.
        polar: radius [m] and angle of the vertices, counted on the wearer, a full turn if closed, shape ``(V, 2)``.
        faces: shape ``(T, 3)`` int32; their outsides are up.
        rows: vertices of the rings from the inner one outwards.
    """

    radius: float
    flare: float
    polar: np.ndarray
    faces: np.ndarray
    rows: tuple[np.ndarray, ...]

    @staticmethod
    def around(
        girth: float,
        length: float,
        flare: float,
        edge: float,
        first: np.ndarray | None = None,
        span: tuple[float, float] | None = None,
    ) -> Sector:
        """Return a panel.

        Args:
            girth: length of its inner arc over a full turn [m].
            length: from the inner to the outer arc [m].
            flare: angle over a full turn: 1 is a full circle.
            edge: length of its edges, about [m].
            first: ascending angles of the inner ring; by default as many as the edges' length wants.
            span: angles at which it begins and ends, ascending; None for a closed one.
        """
        radius = girth / (2.0 * np.pi * flare)
        start, end = span or (0.0, 2.0 * np.pi)
        rings: list[np.ndarray] = []
        rows: list[np.ndarray] = []
        for index, at in enumerate(np.linspace(radius, radius + length, max(1, round(length / (edge * ROW))) + 1)):
            count = max(8, round((end - start) * flare * at / edge))
            steps = np.arange(count) + 0.5 * (index % 2)
            if span is not None:
                steps = np.concatenate([[0.0], steps[steps > 0.0], [count]])
            angle = first if index == 0 and first is not None else start + (end - start) * steps / count
            rows.append(sum(len(row) for row in rows) + np.arange(len(angle)))
            rings.append(np.stack([np.full(len(angle), at), angle], axis=1))
        polar = np.concatenate(rings)
        faces = [between(upper, lower, polar[:, 1], span is None) for upper, lower in pairwise(rows)]
        return Sector(radius, flare, polar, np.concatenate(faces), tuple(rows))

    def lengths(self, pairs: np.ndarray) -> np.ndarray:
        """Return distances of pairs of vertices ``(K, 2)`` in the flat pattern [m]."""
        first, second = self.polar[pairs[:, 0]], self.polar[pairs[:, 1]]
        turn = self.flare * ((first[:, 1] - second[:, 1] + np.pi) % (2.0 * np.pi) - np.pi)  # over the seam, if closed
        square = first[:, 0] ** 2 + second[:, 0] ** 2 - 2.0 * first[:, 0] * second[:, 0] * np.cos(turn)
        return np.sqrt(np.maximum(square, 0.0))

    def hung(self, belt: Belt, scale: float = 1.0) -> np.ndarray:
        """Return the vertices hung from a curve [m], shape ``(V, 3)``.

        Args:
            belt: as long as the inner arc.
            scale: of the way down, for bodies of another size.
        """
        way, angle = scale * (self.polar[:, 0] - self.radius), self.polar[:, 1]
        outward = min(self.flare, STEEPEST)
        out, down = way * outward, way * np.sqrt(1.0 - outward**2)
        if self.flare > STEEPEST:
            out = out + _FOLD * way * np.cos(_FOLDS * angle + 0.7)
        ruling = np.stack([out * np.cos(angle), out * np.sin(angle), -down], axis=1)
        return belt.at(angle) + ruling


def between(upper: np.ndarray, lower: np.ndarray, angle: np.ndarray, closed: bool = True) -> np.ndarray:
    """Return the triangles between two rows of vertices whose angles ascend, shape ``(T, 3)`` int32.

    Args:
        upper: vertices of the one row.
        lower: those of the row below it.
        angle: of all vertices, or another measure along the rows; outsides face away from the axis that it turns about.
        closed: whether the rows are closed after a full turn.
    """
    tops, bottoms = (row.tolist() + ([row[0]] if closed else []) for row in (upper, lower))
    above, below = angle[tops].copy(), angle[bottoms].copy()
    if closed:
        above[-1] += 2.0 * np.pi
        below[-1] += 2.0 * np.pi
    faces, i, k = [], 0, 0
    while i < len(tops) - 1 or k < len(bottoms) - 1:
        if k == len(bottoms) - 1 or (i < len(tops) - 1 and above[i + 1] <= below[k + 1]):
            faces.append((tops[i], bottoms[k], tops[i + 1]))
            i += 1
        else:
            faces.append((tops[i], bottoms[k], bottoms[k + 1]))
            k += 1
    return np.array(faces, np.int32)
