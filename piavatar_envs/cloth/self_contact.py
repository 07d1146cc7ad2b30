"""Contact of cloth with itself and with other garments.

Every few substeps each vertex searches the nearest vertex that is no neighbor of it, in a grid of cells that is hashed
(Teschner et al., "Optimized spatial hashing for collision detection of deformable objects", 2003), and stores the
nearest triangle there and on which side of it it is. Until the next search it stays on that side, at the thickness of
its garment, with friction after Coulomb. Cloth that has passed through itself stays where it is.

A vertex has many contacts: its own, and one as a corner of each triangle that others touch. They act at once, each by a
share of what it needs, and are added up in fixed point, so that neither the momentum nor the result depends on the
order of the threads. Lists of a cell do depend on it, the nearest vertex in them does not.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from piavatar_envs.cloth.contact import weights_of_nearest
from piavatar_envs.cloth.mesh import ClothMesh
from piavatar_envs.core.arrays import int_at, vector_at
from piavatar_envs.core.structs import fill

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

#: Width of a cell and reach of a search, in rest lengths of an edge: less than the distance of second neighbors.
REACH_IN_EDGES = 1.2
#: Speed [m/s] at which layers may approach each other until the next search.
APPROACH = wp.constant(4.0)
#: Share of a contact's correction: each vertex of two layers has three contacts on average, of which two are others'.
SHARE = wp.constant(0.35)
#: Quanta of a correction times mass [kg m]: 1e-15, and sums reach 4,000.
_QUANTA = wp.constant(float(2**50))
_QUANTUM = wp.constant(2.0**-50)
_NO_LENGTH = wp.constant(1.0e-12)
_FAR = wp.constant(1.0e30)


@wp.struct
class SelfContacts:
    """Workspace of a step in row ``b`` of ``B``: a hash table of ``N`` buckets and a contact of each vertex."""

    cell: float  # [m]
    first: wp.array2d(dtype=int)  # (B, N) a vertex in a bucket, -1 for none
    next: wp.array2d(dtype=int)  # (B, V) another one in the same bucket
    corners: wp.array2d(dtype=wp.vec3i)  # (B, V) triangle in contact; the first is -1 for none
    weights: wp.array2d(dtype=wp.vec3)  # (B, V) of its corners
    side: wp.array2d(dtype=float)  # (B, V) 1 in front of the triangle, -1 behind it
    sums: wp.array3d(dtype=wp.int64)  # (B, V, 3) corrections times mass, in quanta


def allocate_self_contacts(mesh: ClothMesh, rows: int, device: str, enabled: bool) -> SelfContacts:
    """Allocate the workspace; without entries if it is not ``enabled``."""
    vertices = mesh.num_vertices if enabled else 0
    buckets = buckets_of(vertices) if enabled else 0
    shape = (rows, vertices)
    return fill(
        SelfContacts(),
        cell=REACH_IN_EDGES * float(np.median(mesh.length)),
        first=wp.full((rows, buckets), -1, dtype=int, device=device),
        next=wp.zeros(shape, dtype=int, device=device),
        corners=wp.full(shape, wp.vec3i(-1, -1, -1), dtype=wp.vec3i, device=device),
        weights=wp.zeros(shape, dtype=wp.vec3, device=device),
        side=wp.zeros(shape, dtype=float, device=device),
        sums=wp.zeros((*shape, 3), dtype=wp.int64, device=device),
    )


def buckets_of(vertices: int) -> int:
    """Return the number of buckets for so many vertices, a power of two."""
    return 1 << (2 * vertices).bit_length()


def bytes_of_self_contact(mesh: ClothMesh) -> int:
    """Return the memory of the workspace in an environment [bytes]."""
    return mesh.num_vertices * (4 + 12 + 12 + 4 + 3 * 8) + 4 * buckets_of(mesh.num_vertices)


@wp.func
def corrected(x: wp.array2d(dtype=wp.vec3), correction: wp.array2d(dtype=wp.vec3), e: int, b: int, i: int):
    """Return the position of a vertex after the corrections by edges [m]."""
    return vector_at(x, e, i) + vector_at(correction, b, i)


@wp.func
def bucket_of(contacts: SelfContacts, i: int, j: int, k: int):
    """Return the bucket of a cell."""
    mixed = wp.uint32(i) * wp.uint32(73856093) ^ wp.uint32(j) * wp.uint32(19349663) ^ wp.uint32(k) * wp.uint32(83492791)
    return int(mixed & wp.uint32(contacts.first.shape[1] - 1))


@wp.func
def cell_of(contacts: SelfContacts, z: wp.vec3):
    """Return the cell of a position."""
    c = z / contacts.cell
    return wp.vec3i(int(wp.floor(c[0])), int(wp.floor(c[1])), int(wp.floor(c[2])))


@wp.func
def insert_vertex(contacts: SelfContacts, b: int, i: int, z: wp.vec3):
    """Add a vertex to the list of its bucket."""
    c = cell_of(contacts, z)
    contacts.next[b, i] = wp.atomic_exch(contacts.first, b, bucket_of(contacts, c[0], c[1], c[2]), i)


@wp.func
def is_neighbor(fan_start: wp.array(dtype=int), fan: wp.array(dtype=wp.vec2i), i: int, j: int):
    """Return whether two vertices share a triangle."""
    for k in range(int_at(fan_start, i), int_at(fan_start, i + 1)):
        pair = fan[k]
        if pair[0] == j or pair[1] == j:
            return True
    return False


@wp.func
def nearest_vertex(
    contacts: SelfContacts, fan_start: wp.array(dtype=int), fan: wp.array(dtype=wp.vec2i),
    x: wp.array2d(dtype=wp.vec3), correction: wp.array2d(dtype=wp.vec3), e: int, b: int, i: int, z: wp.vec3,
):  # fmt: skip
    """Return the nearest vertex within reach that is no neighbor, the lower one of equals; -1 for none."""
    found = int(-1)
    best = float(contacts.cell * contacts.cell)
    c = cell_of(contacts, z)
    for n in range(27):
        j = int(contacts.first[b, bucket_of(contacts, c[0] + n % 3 - 1, c[1] + n // 3 % 3 - 1, c[2] + n // 9 - 1)])
        while j >= 0:
            distance = wp.length_sq(corrected(x, correction, e, b, j) - z)
            nearer = distance < best or (distance == best and j < found)
            if nearer and j != i:  # noqa: SIM102 - Warp evaluates both sides of an `and`
                if not is_neighbor(fan_start, fan, i, j):
                    best = distance
                    found = j
            j = contacts.next[b, j]
    return found


@wp.func
def search_self(
    contacts: SelfContacts, fan_start: wp.array(dtype=int), fan: wp.array(dtype=wp.vec2i),
    x: wp.array2d(dtype=wp.vec3), correction: wp.array2d(dtype=wp.vec3), e: int, b: int, i: int, reach: float,
):  # fmt: skip
    """Store the triangle that a vertex may touch until the next search: the nearest one, if the vertex is over it."""
    z = corrected(x, correction, e, b, i)
    contacts.corners[b, i] = wp.vec3i(-1, -1, -1)
    j = nearest_vertex(contacts, fan_start, fan, x, correction, e, b, i, z)
    if j >= 0:
        best = float(reach * reach)
        near = corrected(x, correction, e, b, j)
        for k in range(int_at(fan_start, j), int_at(fan_start, j + 1)):
            pair = fan[k]
            if pair[0] != i and pair[1] != i:
                c = corrected(x, correction, e, b, pair[0])
                d = corrected(x, correction, e, b, pair[1])
                w = weights_of_nearest(near, c, d, z)
                away = z - w[0] * near - w[1] * c - w[2] * d
                distance = wp.length_sq(away)
                along = wp.dot(away, wp.normalize(wp.cross(c - near, d - near)))
                # a vertex beside a border is not in contact with it
                if distance < best and 2.0 * along * along >= distance:
                    best = distance
                    contacts.corners[b, i] = wp.vec3i(j, pair[0], pair[1])
                    contacts.weights[b, i] = w
                    contacts.side[b, i] = wp.where(along < 0.0, -1.0, 1.0)


@wp.func
def add_correction(contacts: SelfContacts, b: int, i: int, P: wp.vec3):
    """Add a correction times mass [kg m] to a vertex."""
    for axis in range(3):
        wp.atomic_add(contacts.sums, b, i, axis, wp.int64(wp.rint(_QUANTA * P[axis])))


@wp.func
def take_correction(contacts: SelfContacts, b: int, i: int):
    """Return and clear the sum of a vertex's corrections times mass [kg m]."""
    P = wp.vec3(
        float(contacts.sums[b, i, 0]) * _QUANTUM,
        float(contacts.sums[b, i, 1]) * _QUANTUM,
        float(contacts.sums[b, i, 2]) * _QUANTUM,
    )
    for axis in range(3):
        contacts.sums[b, i, axis] = wp.int64(0)
    return P


@wp.func
def keep_apart(
    contacts: SelfContacts, x: wp.array2d(dtype=wp.vec3), correction: wp.array2d(dtype=wp.vec3),
    v: wp.array2d(dtype=wp.vec3), inverse_mass: wp.vec4, e: int, b: int, i: int, thickness: float,
    friction: float, pop: float, dt: float,
):  # fmt: skip
    """Push a vertex and its triangle apart where they are nearer than ``thickness``.

    ``inverse_mass`` is that of the vertex and of the corners; ``v`` is the velocity before the corrections. The push
    ends the approach and parts the two at ``pop`` at most.
    """
    f = contacts.corners[b, i]
    w = contacts.weights[b, i]
    p = corrected(x, correction, e, b, f[0])
    q = corrected(x, correction, e, b, f[1])
    r = corrected(x, correction, e, b, f[2])
    n = contacts.side[b, i] * wp.normalize(wp.cross(q - p, r - p))
    away = corrected(x, correction, e, b, i) - (w[0] * p + w[1] * q + w[2] * r)
    depth = thickness - wp.dot(away, n)
    if depth > 0.0:
        way = dt * vector_at(v, e, i) + vector_at(correction, b, i)
        for corner in range(3):
            way -= w[corner] * (dt * vector_at(v, e, f[corner]) + vector_at(correction, b, f[corner]))
        along = wp.dot(way, n)
        out = wp.clamp(pop * dt - along, 0.0, depth)
        slip = way - along * n
        most = friction * out
        size = wp.length(slip)
        needed = out * n - wp.where(size > most, most / wp.max(size, _NO_LENGTH), 1.0) * slip
        inertia = inverse_mass[0]
        for corner in range(3):
            inertia += w[corner] * w[corner] * inverse_mass[corner + 1]
        P = (SHARE / wp.max(inertia, _NO_LENGTH)) * needed
        if wp.isfinite(P):
            add_correction(contacts, b, i, P)
            for corner in range(3):
                add_correction(contacts, b, f[corner], -w[corner] * P)
