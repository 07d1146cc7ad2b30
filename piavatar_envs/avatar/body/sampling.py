"""Particles of a body, from its closed skin: positions, volumes, skinning weights and memory order.

*Flesh* particles sit in the cells of a regular lattice, each at the centroid of the part of its cell that is inside the
skin, so thin limbs are filled as well as thick ones. *Bone* particles are ordinary particles too, a small lattice along
every bone, rigidly skinned to it: the Kabsch fit that tracks the pose reads only them. Where the asset has a skeleton,
they are its points, one a cube of the lattice, and the small lattice fills up bones that have too few. *Surface*
particles are points that an asset brings, such as Gaussian splats; flesh of the lattice makes room for them.

Values are interpolated inside the body by harmonic functions on the graph of its particles. In memory neighbours should
be neighbours in the body: then the threads of a warp access the same nodes of the grid, or blend the same bones.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body import skeleton_mesh
from piavatar_envs.avatar.body.asset import (
    AvatarAsset,
    ShapedBody,
    SkeletonPoints,
    SurfacePoints,
    dense_weights,
    mesh_volume,
    top_weights,
)
from piavatar_envs.avatar.body.skeleton import BODY_PARTS, JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.avatar.body.skeleton_mesh import thinned
from piavatar_envs.core.launch_graph import available_cores
from piavatar_envs.core.result_cache import digest_of, kept

wp.set_module_options({"enable_backward": False})


SMALL_BODY = 8192  # particles up to which they are in the order of their bones
BOXES = (128, 64, 32)  # particles that lie together in larger ones, as many as P2G takes together or a warp has


@wp.func
def _edge_crossing(a: wp.vec3d, b: wp.vec3d):
    """Return 1 or -1 if the edge from ``a`` to ``b`` crosses the half line from the origin along +x, and else 0.

    Products of single-precision numbers are exact in double precision, so that neighbours agree on their edge.
    """
    side = a[0] * b[1] - a[1] * b[0]
    zero = wp.float64(0.0)
    if a[1] <= zero and b[1] > zero and side > zero:
        return 1
    if b[1] <= zero and a[1] > zero and side < zero:
        return -1
    return 0


@wp.func
def _winding_number(mesh: wp.uint64, point: wp.vec3, top: float):
    """Return how often the skin encloses ``point``: the triangles above it, those that face downwards negative."""
    origin = wp.vec3d(point)
    winding = int(0)
    face = int(0)
    above = wp.mesh_query_aabb(mesh, point, wp.vec3(point[0], point[1], top))
    while wp.mesh_query_aabb_next(above, face):
        a = wp.vec3d(wp.mesh_get_point(mesh, 3 * face)) - origin
        b = wp.vec3d(wp.mesh_get_point(mesh, 3 * face + 1)) - origin
        c = wp.vec3d(wp.mesh_get_point(mesh, 3 * face + 2)) - origin
        covers = _edge_crossing(a, b) + _edge_crossing(b, c) + _edge_crossing(c, a)
        if wp.float64(covers) * wp.dot(a, wp.cross(b, c)) > wp.float64(0.0):
            winding += covers
    return winding


@wp.kernel
def _closest_point_kernel(
    mesh: wp.uint64,
    top: float,
    points: wp.array(dtype=wp.vec3),
    # out
    distance: wp.array(dtype=float),
    face: wp.array(dtype=int),
    coordinates: wp.array(dtype=wp.vec3),
):
    """Return the signed distance (negative inside) and nearest point of the skin, which ends below ``top``."""
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e3)
    length = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])
    distance[i] = wp.where(_winding_number(mesh, points[i], top) > 0, -length, length)
    face[i] = query.face
    coordinates[i] = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)


class ClosedSurface:
    """Point queries against a closed triangle mesh; on the CPU whatever the simulation runs on."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self._mesh = wp.Mesh(
            points=wp.array(vertices, dtype=wp.vec3, device="cpu"),
            indices=wp.array(faces.ravel(), dtype=wp.int32, device="cpu"),
        )
        self._top = float(vertices[:, 2].max()) + 1.0

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the nearest point of the skin to each of ``points`` ``(N, 3)``.

        Returns:
            Signed distance [m], negative inside, ``(N,)``; triangle ``(N,)``; barycentric coordinates ``(N, 3)``.
        """
        count = len(points)
        distance = wp.empty(count, dtype=float, device="cpu")
        face = wp.empty(count, dtype=int, device="cpu")
        coordinates = wp.empty(count, dtype=wp.vec3, device="cpu")
        where = wp.array(np.asarray(points, dtype=np.float32), dtype=wp.vec3, device="cpu")
        wp.launch(
            _closest_point_kernel,
            dim=count,
            inputs=[self._mesh.id, self._top, where],
            outputs=[distance, face, coordinates],
            device="cpu",
        )
        return distance.numpy(), face.numpy(), coordinates.numpy()

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance to the skin [m], negative inside, shape ``(N,)``."""
        return self.query(points)[0]

    def distance_near(self, points: np.ndarray, band: float) -> np.ndarray:
        """Return the signed distance within ``band`` [m] of the skin, and elsewhere an infinite one; shape ``(N,)``.

        Most points of a lattice are far from the skin: all of a cube are, if its centre is further than they can be.
        """
        found, left = np.empty(len(points)), np.arange(len(points))
        for size in (16.0 * band, 8.0 * band, 4.0 * band, 2.0 * band):
            cube = np.floor(points[left] / size).astype(np.int64)
            first, count = cube.min(axis=0), np.ptp(cube, axis=0) + 1
            cube = np.ravel_multi_index((cube - first).T, count)
            occupied = np.flatnonzero(np.bincount(cube))
            centres = np.stack(np.unravel_index(occupied, count), axis=1) + first + 0.5
            distance = np.zeros(count.prod())
            distance[occupied] = self.distance(centres * size)
            # a little more than half a diagonal, for what single precision rounds
            beyond = np.where(np.abs(distance) > band + 0.87 * size, np.copysign(np.inf, distance), 0.0)[cube]
            found[left] = beyond
            left = left[beyond == 0.0]
        found[left] = self.distance(points[left])
        return found


def order_of_body(
    positions: np.ndarray, bone: np.ndarray, skin_joints: np.ndarray, skin_weights: np.ndarray
) -> np.ndarray:
    """Return the order ``(P,)`` of a body's particles: by their bones if it is small, else in compact boxes.

    Args:
        positions: in the rest pose [m], shape ``(P, 3)``.
        bone: of which bone a particle is one's own, -1 for flesh, shape ``(P,)``.
        skin_joints: the bones that move it, shape ``(P, K)``.
        skin_weights: by which weights, 0 for none, shape ``(P, K)``.
    """
    if len(positions) <= SMALL_BODY:
        return order_by_bones(bone, skin_joints, skin_weights)
    return order_in_boxes(positions)


def order_along_curve(positions: np.ndarray, spacing: float) -> np.ndarray:
    """Return the order of the particles along Morton's curve, ``(P,)``: neighbours in memory are close in the body.

    Threads and cache lines then share grid nodes and bones.
    """
    cells = ((positions - positions.min(axis=0)) / spacing).astype(np.uint64)
    code = np.zeros(len(cells), np.uint64)
    for bit, axis in np.ndindex(16, 3):
        code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def order_by_bones(bone: np.ndarray, skin_joints: np.ndarray, skin_weights: np.ndarray) -> np.ndarray:
    """Return the order ``(P,)`` with bone particles first, then those that one bone moves, two, and so on.

    Of as many bones those of the same ones follow each other, as they did. Threads that work together then blend as
    many bones, and mostly the same: one that blends four makes 31 others wait. Neighbours of large bodies are alike
    anyway, see :func:`order_in_boxes`.
    """
    moves = np.sort(np.where(skin_weights > 0.0, skin_joints, NUM_JOINTS), axis=1)
    return np.lexsort((*moves.T[::-1], (skin_weights > 0.0).sum(axis=1), bone < 0))


def order_in_boxes(positions: np.ndarray) -> np.ndarray:
    """Order ``(P,)`` in which each ``BOXES[0]`` particles have a compact box of their own, each ``BOXES[1]`` in it, ...

    Boxes are halved along their longest edge; in the smallest, particles stay as they are. The P2G of large bodies
    takes so many together and adds up on the nodes of the box around them, which a curve's jumps would make large.
    """

    def halve(inside: np.ndarray, level: int) -> list[np.ndarray]:
        while level < len(BOXES) and len(inside) <= BOXES[level]:
            level += 1
        if level == len(BOXES):
            return [np.sort(inside)]
        along = positions[inside, np.ptp(positions[inside], axis=0).argmax()]
        order = inside[np.argsort(along, kind="stable")]
        lower = BOXES[level] * -(-len(order) // (2 * BOXES[level]))
        return halve(order[:lower], level) + halve(order[lower:], level)

    return np.concatenate(halve(np.arange(len(positions)), 0))


TOLERANCE = 1e-6  # of the residual, relative to the right-hand side
ROWS_AT_ONCE = 8192  # of a system, whose columns then stay in a core's cache
MAX_ITERATIONS = 2000


def adjacency(links: np.ndarray, points: np.ndarray) -> sparse.csr_matrix:
    """Return the symmetric matrix of link weights 1/length^2, which make it a Laplacian on scattered points.

    Args:
        links: pairs of linked points, shape ``(L, 2)``.
        points: positions [m], shape ``(P, 3)``.

    Returns:
        Matrix of shape ``(P, P)``.
    """
    first, second = links.T
    weight = 1.0 / np.maximum(np.sum((points[first] - points[second]) ** 2, axis=1), 1e-8)
    rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
    return sparse.csr_matrix((np.concatenate([weight, weight]), (rows, columns)), shape=(len(points),) * 2)


def fill(links: np.ndarray, points: np.ndarray, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Extend ``values`` from the known points to the others by solving Laplace's equation on the graph.

    Weighted averages of neighbours obey a maximum principle: weights stay in [0, 1] and keep their sum. Parts of
    the graph without a known point keep the values they came with.

    Args:
        links: pairs of linked points, shape ``(L, 2)``.
        points: positions [m], shape ``(P, 3)``.
        values: values at the known points and a first guess elsewhere, shape ``(P, K)``.
        known: which points are known, shape ``(P,)`` bool.

    Returns:
        Values, shape ``(P, K)`` float64.
    """
    graph = adjacency(links, points)
    count, part = connected_components(graph, directed=False)
    anchored = np.zeros(count, dtype=bool)
    anchored[part[known]] = True
    free = ~known & anchored[part]
    filled = np.array(values, dtype=np.float64)
    if free.any():
        laplacian = sparse.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph
        inner = laplacian.tocsr()[free]
        filled[free] = _conjugate_gradient(inner[:, free], -(inner[:, ~free] @ filled[~free]), filled[free])
    return filled


def _conjugate_gradient(matrix: sparse.csr_matrix, right: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Solve by conjugate gradients with a diagonal preconditioner, all columns at once.

    Blocks of rows are shared between threads. Sums are taken block by block, so that they do not depend on the threads.
    """
    blocks = [slice(first, first + ROWS_AT_ONCE) for first in range(0, len(right), ROWS_AT_ONCE)]
    rows = [matrix[block] for block in blocks]
    inverse_diagonal = 1.0 / matrix.diagonal()[:, None]
    solution = guess.copy()
    residual = right - matrix @ solution
    direction = inverse_diagonal * residual
    image, energy = np.empty_like(direction), np.sum(residual * direction, axis=0)

    def multiply(number: int) -> np.ndarray:
        block = blocks[number]
        image[block] = rows[number] @ direction
        return np.sum(direction[block] * image[block], axis=0)

    def advance(block: slice) -> np.ndarray:
        solution[block] += step * direction[block]
        residual[block] -= step * image[block]
        return np.sum(residual[block] * (inverse_diagonal[block] * residual[block]), axis=0)

    def turn(block: slice) -> None:
        direction[block] *= gain
        direction[block] += inverse_diagonal[block] * residual[block]

    limit = TOLERANCE * max(np.linalg.norm(right), 1e-12)
    with ThreadPoolExecutor(available_cores()) as pool:
        for _ in range(MAX_ITERATIONS):
            if np.linalg.norm(residual) <= limit:
                break
            # a column that is already solved has a zero direction: leave it where it is
            step = energy / np.maximum(sum(pool.map(multiply, range(len(blocks)))), 1e-300)
            new_energy = sum(pool.map(advance, blocks))
            gain = new_energy / np.maximum(energy, 1e-300)
            list(pool.map(turn, blocks))
            energy = new_energy
    return solution


def volume_ratios(links: np.ndarray, rest: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the local volume change of a smooth map, from the least-squares gradient over each point's links.

    Args:
        links: pairs of linked points, shape ``(L, 2)``.
        rest: positions before [m], shape ``(P, 3)``.
        moved: positions after [m], shape ``(P, 3)``.

    Returns:
        Determinants of the gradient, kept within [0.1, 10], shape ``(P,)``.
    """
    first, second = np.concatenate([links.T, links.T[::-1]], axis=1).astype(np.intp)
    edge = (rest[second] - rest[first]).T
    weight = 1.0 / np.maximum(np.sum(edge**2, axis=0), 1e-8)
    change = ((moved - rest)[second] - (moved - rest)[first]).T
    spread, shear = np.empty((len(rest), 3, 3)), np.empty((len(rest), 3, 3))
    for i, j in np.ndindex(3, 3):
        spread[:, i, j] = np.bincount(first, weight * edge[i] * edge[j], len(rest))
        shear[:, i, j] = np.bincount(first, weight * change[i] * edge[j], len(rest))
    # Regularised, so that a point with few neighbours falls back to no change rather than to noise.
    gradient = np.eye(3) + shear @ np.linalg.inv(spread + 0.1 * np.eye(3))
    return np.clip(np.linalg.det(gradient), 0.1, 10.0)


MOST_SPACING = 0.06  # lattice spacing over the height of the body
SPACING_PER_DX = 0.57  # lattice spacing over grid spacing: about 5 particles a cell
SUBDIVISIONS = 3  # points per axis and cell that decide how much of it is inside
MIN_FILL = 0.3  # share of a cell that must be inside for a particle of its own
LINK_LENGTH = 1.8  # of a link between neighbouring particles, over the spacing
SURFACE_LINKS = 8  # of a point that the asset brings, to flesh of the lattice
SHELL = 0.75  # depth of the particles that simply follow the skin, over the spacing
INSET = 0.05  # depth of a particle that a change of shape would leave outside, over the spacing
MIN_WEIGHT = 0.01  # smaller skinning weights are dropped
BONE_CLEARANCE = 0.45  # flesh particles nearer than this to a bone particle are left out, over the spacing
BONE_RING = 4  # bone particles on each ring, besides the one on the axis
BONE_RADIUS = 0.5  # of a ring, over the depth of its centre below the skin
BONE_RADIUS_LIMITS = (0.003, 0.045)  # [m]
BONE_RANGE = (0.18, 0.82)  # part of the bone that carries rings
MIN_BONE_PARTICLES = 18
#: Where bones with several children point; bones without any point to the middle of their flesh.
MAIN_CHILD = {"pelvis": "spine1", "spine3": "neck"}


@dataclass(frozen=True, eq=False)
class ParticleSet:
    """The particles of an asset; their number does not depend on its shape. Arrays are read-only.

    Attributes:
        spacing: lattice spacing [m].
        rest_positions: positions in the mean shape's rest pose [m], shape ``(P, 3)`` float32.
        volumes: volumes [m^3], their sum is the skin's volume, shape ``(P,)`` float32.
        skin_joints: joints that move each particle, shape ``(P, 4)`` int32.
        skin_weights: their weights, descending, rows sum to one, shape ``(P, 4)`` float32.
        bone: the joint a bone particle belongs to, -1 for flesh, shape ``(P,)`` int32.
        links: pairs of neighbouring particles of the same limb, shape ``(L, 2)`` int32.
        anchor_vertices: corners of the skin triangle nearest to each particle, shape ``(P, 3)`` int32.
        anchor_weights: barycentric coordinates of the nearest point in it, shape ``(P, 3)`` float32.
        shell: particles that follow their nearest skin point when the shape changes, shape ``(P,)`` bool.
        depth: below the skin of the mean shape [m], shape ``(P,)`` float32.
    """

    spacing: float
    rest_positions: np.ndarray
    volumes: np.ndarray
    skin_joints: np.ndarray
    skin_weights: np.ndarray
    bone: np.ndarray
    links: np.ndarray
    anchor_vertices: np.ndarray
    anchor_weights: np.ndarray
    shell: np.ndarray
    depth: np.ndarray

    def __len__(self) -> int:
        return len(self.rest_positions)


def spacing_for(dx: float) -> float:
    """Return the lattice spacing [m] that suits a grid of spacing ``dx`` [m]."""
    return SPACING_PER_DX * dx


@lru_cache(maxsize=16)
def sample_particles(
    asset: AvatarAsset, spacing: float, seed: int = 0, bone_rings: int = 4, bone_voxel: float = 1.0
) -> ParticleSet:
    """Fill the mean shape of an asset with particles; the same on every call and machine.

    Args:
        asset: the body.
        spacing: lattice spacing [m]; see :func:`spacing_for`.
        seed: shifts the lattice in y and z. Not in x, where it stays as symmetric as the body.
        bone_rings: rings of five bone particles along every bone.
        bone_voxel: edge of the cubes that have one point of the asset's skeleton each, over the spacing.

    Raises:
        ValueError: the spacing is not positive or too coarse for the body, too few rings, or a bone outside the skin.
    """
    coarsest = MOST_SPACING * float(np.ptp(asset.vertices[:, 2]))
    if not 0.0 < spacing <= coarsest:
        raise ValueError(f"spacing={spacing} m is outside (0, {coarsest:.3g}]; coarser would lose hands and feet")
    if bone_rings < 4:
        raise ValueError(f"bone_rings={bone_rings} gives under {MIN_BONE_PARTICLES} particles per bone; use 4 or more")
    surface = (asset.vertices, asset.faces, asset.joints, asset.skin_joints, asset.skin_weights)
    values = [*surface, asset.skeleton, asset.surface_points, spacing, seed, bone_rings, bone_voxel]
    digest = digest_of(values, [sys.modules[__name__], skeleton_mesh])
    doing = f"filling {asset.name} with particles {1e3 * spacing:.2g} mm apart"
    arrays = kept("particles", digest, lambda: _sample(asset, spacing, seed, bone_rings, bone_voxel), doing)
    for array in arrays.values():
        array.setflags(write=False)
    return ParticleSet(float(spacing), **arrays)


def _sample(asset: AvatarAsset, spacing: float, seed: int, bone_rings: int, bone_voxel: float) -> dict[str, np.ndarray]:
    """Return the arrays of :class:`ParticleSet` by name."""
    skin = ClosedSurface(asset.vertices, asset.faces)
    flesh, interior, cell = _flesh_lattice(asset, skin, spacing, seed)
    bones, bone_of = _bone_particles(asset, skin, bone_rings, spacing, bone_voxel)
    added = _no_points() if asset.surface_points is None else asset.surface_points
    clear = cKDTree(np.concatenate([bones, added.points])).query(flesh)[0] > BONE_CLEARANCE * spacing
    flesh = flesh[clear]
    positions = np.concatenate([bones, flesh, added.points]).astype(np.float32)
    bone = np.concatenate([bone_of, np.full(len(flesh) + len(added.points), -1)]).astype(np.int32)
    # the index of a particle among the points that the asset brings, or -1
    brought = np.concatenate([np.full(len(bones) + len(flesh), -1), np.arange(len(added.points))])
    order = order_along_curve(positions, spacing)
    positions, bone, brought = positions[order], bone[order], brought[order]
    distance, face, coordinates = skin.query(positions)
    anchors = asset.faces[face]
    surface = np.einsum("pc,pcj->pj", coordinates, dense_weights(asset.skin_joints, asset.skin_weights)[anchors])
    surface[brought >= 0] = dense_weights(added.skin_joints, added.skin_weights)[brought[brought >= 0]]
    links = _links(positions, -distance, surface, skin, spacing, brought >= 0)
    surface[bone >= 0] = np.eye(NUM_JOINTS)[bone[bone >= 0]]
    shell = (distance > -SHELL * spacing) | (brought >= 0)
    weights = fill(links, positions, surface, shell | (bone >= 0))
    skin_joints, skin_weights = top_weights(_local(weights))
    # the particle of each cell of the lattice, or -1; the last entry is that of no cell
    owner = np.append(np.where(clear, np.argsort(order)[len(bones) - 1 + np.cumsum(clear)], -1), -1)
    total = mesh_volume(asset.vertices, asset.faces)
    volumes = _volumes(positions, bone, brought >= 0, interior, owner[cell], total)
    depth = np.maximum(-distance, 0.0)
    order = order_of_body(positions, bone, skin_joints, skin_weights)
    links = np.argsort(order).astype(np.int32)[links]
    of_particles = {
        "rest_positions": positions,
        "volumes": volumes,
        "skin_joints": skin_joints,
        "skin_weights": skin_weights,
        "bone": bone,
        "anchor_vertices": anchors,
        "anchor_weights": coordinates,
        "shell": shell,
        "depth": depth,
    }
    return {"links": links, **{name: array[order] for name, array in of_particles.items()}}


def _no_points() -> SurfacePoints:
    return SurfacePoints(np.zeros((0, 3), np.float32), np.zeros((0, 4), np.int32), np.zeros((0, 4), np.float32))


def morph(asset: AvatarAsset, particles: ParticleSet, body: ShapedBody) -> tuple[np.ndarray, np.ndarray]:
    """Move the particles of the mean shape into a shape of the same asset.

    Particles near the skin follow their nearest skin point; the interior follows smoothly. Volumes change with the
    local stretch and add up to the shape's volume.

    Args:
        asset: the body the particles were sampled from.
        particles: its particles.
        body: the shape, from :meth:`AvatarAsset.shape`.

    Returns:
        Rest positions [m] ``(P, 3)`` and volumes [m^3] ``(P,)``, both float32.
    """
    volume = mesh_volume(body.vertices, asset.faces)
    if np.array_equal(body.vertices, asset.vertices):
        same = particles.volumes.astype(np.float64)
        return particles.rest_positions.copy(), (same * (volume / same.sum())).astype(np.float32)
    corners = particles.anchor_vertices
    displacement = (body.vertices - asset.vertices).astype(np.float64)[corners]
    guess = np.einsum("pc,pci->pi", particles.anchor_weights, displacement)
    rest = particles.rest_positions.astype(np.float64)
    moved = rest + fill(particles.links, rest, guess, particles.shell)
    skin = ClosedSurface(body.vertices, asset.faces)
    inside = particles.depth > 0.0  # points that an asset brings may be outside of its skin
    moved[inside] = _pushed_inside(moved[inside], skin, asset.faces, body, INSET * particles.spacing)
    volumes = particles.volumes * volume_ratios(particles.links, rest, moved)
    volumes *= volume / volumes.sum()
    return moved.astype(np.float32), volumes.astype(np.float32)


def _flesh_lattice(asset: AvatarAsset, skin: ClosedSurface, spacing: float, seed: int) -> tuple[np.ndarray, ...]:
    """Return flesh particles ``(N, 3)``, and the finer lattice of interior points that measures volumes.

    Returns:
        Flesh particles; interior points ``(M, 3)``; the particle in the cell of each of these, -1 for none, ``(M,)``.
    """
    low, high = asset.vertices.min(axis=0), asset.vertices.max(axis=0)
    shift = np.random.default_rng(seed).uniform(0.0, spacing, 3) * [0.0, 1.0, 1.0]
    first = np.floor((low - shift) / spacing).astype(int)
    counts = np.ceil((high - shift) / spacing).astype(int) - first
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    centres = (cells + first + 0.5) * spacing + shift
    half_diagonal = 0.5 * np.sqrt(3.0) * spacing
    distance = skin.distance_near(centres, half_diagonal)
    near = distance < half_diagonal
    centres, distance = centres[near], distance[near]
    steps = (np.arange(SUBDIVISIONS) + 0.5) / SUBDIVISIONS - 0.5
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3) * spacing
    fine = centres[:, None, :] + offsets
    inside = np.repeat(distance[:, None] < 0.0, len(offsets), axis=1)
    # A point nearer to the centre than the skin is on the centre's side: only the others need a query.
    unsure = np.abs(distance)[:, None] <= np.linalg.norm(offsets, axis=1)
    inside[unsure] = skin.distance(fine[unsure]) < 0.0
    keep = inside.mean(axis=1) >= MIN_FILL
    share = inside[keep] / inside[keep].sum(axis=1, keepdims=True)
    flesh = np.einsum("nk,nki->ni", share, fine[keep])
    # The centroid of a cell that the skin cuts twice may lie in the gap: take the nearest interior point instead.
    outside = distance[keep] >= -half_diagonal  # the others are the centres of whole cells
    outside[outside] = skin.distance(flesh[outside]) > -0.02 * spacing
    gap = np.linalg.norm(fine[keep][outside] - flesh[outside][:, None], axis=-1)
    gap[~inside[keep][outside]] = np.inf
    flesh[outside] = fine[keep][outside][np.arange(outside.sum()), gap.argmin(axis=1)]
    cell = np.repeat(np.where(keep, np.cumsum(keep) - 1, -1)[:, None], len(offsets), axis=1)
    return flesh, fine[inside], cell[inside]


def _bone_ends(asset: AvatarAsset, skin: ClosedSurface) -> np.ndarray:
    """Return the far end of every bone [m], shape ``(22, 3)``: the next joint, or the middle of its flesh."""
    ends = np.empty((NUM_JOINTS, 3))
    for joint, name in enumerate(JOINT_NAMES):
        children = [child for child in range(NUM_JOINTS) if PARENTS[child] == joint]
        if children:
            ends[joint] = asset.joints[joint_index(MAIN_CHILD.get(name, JOINT_NAMES[children[0]]))]
            continue
        own = asset.vertices[asset.skin_joints[:, 0] == joint]
        low, high = own.min(axis=0), own.max(axis=0)
        steps = np.stack(np.meshgrid(*[np.arange(0.5, 16.0) / 16.0] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        points = low + steps * (high - low)
        distance, face, _ = skin.query(points)
        ends[joint] = points[(distance < 0.0) & (asset.skin_joints[asset.faces[face, 0], 0] == joint)].mean(axis=0)
    return ends


def _bone_starts(asset: AvatarAsset, ends: np.ndarray) -> np.ndarray:
    """Return the near end of every bone [m], shape ``(22, 3)``: its joint, but the heel for feet, which bear on it."""
    starts = asset.joints.astype(np.float64)
    for joint in (joint_index("left_ankle"), joint_index("right_ankle")):
        own = asset.vertices[asset.skin_joints[:, 0] == joint]
        starts[joint, 1:] = own[:, 1].max(initial=starts[joint, 1]), ends[joint, 2]
    return starts


def _bone_particles(
    asset: AvatarAsset, skin: ClosedSurface, rings: int, spacing: float, voxel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return bone particles ``(B, 3)`` and the joint each belongs to ``(B,)``: of the skeleton, or of the lattice.

    A bone with fewer than :data:`MIN_BONE_PARTICLES` points of the skeleton gets those of the lattice that are furthest
    from them, and from each other.
    """
    lattice, owner = _bone_lattice(asset, skin, rings)
    if asset.skeleton is None:
        return lattice, owner
    inside = skin.distance(asset.skeleton.points) < -INSET * spacing
    skeleton = thinned(SkeletonPoints(asset.skeleton.points[inside], asset.skeleton.bone[inside]), voxel * spacing)
    points = []
    for joint in range(NUM_JOINTS):
        own, spare = skeleton.points[skeleton.bone == joint], lattice[owner == joint]
        if len(own) == 0:
            own = spare[:1]
        while len(own) < MIN_BONE_PARTICLES:
            gap = np.linalg.norm(spare[:, None] - own, axis=2).min(axis=1)
            own = np.append(own, spare[[gap.argmax()]], axis=0)
        points.append(own)
    return np.concatenate(points), np.repeat(np.arange(NUM_JOINTS), [len(own) for own in points])


def _bone_lattice(asset: AvatarAsset, skin: ClosedSurface, rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Return bone particles ``(B, 3)`` and the joint each belongs to ``(B,)``: rings around every bone's axis."""
    ends = _bone_ends(asset, skin)
    starts = _bone_starts(asset, ends)
    points = np.empty((NUM_JOINTS, rings * (BONE_RING + 1), 3))
    angles = 2.0 * np.pi * np.arange(BONE_RING) / BONE_RING
    for joint, name in enumerate(JOINT_NAMES):
        axis = ends[joint] - starts[joint]
        centres = starts[joint] + np.linspace(*BONE_RANGE, rings)[:, None] * axis
        depth = -skin.distance(centres)
        if depth.max() <= 0.0:
            raise ValueError(f"the bone of {name} lies outside the skin by {-depth.max():.3f} m; move its joint inside")
        # The reference is in the sagittal plane, so that left and right bones get mirrored rings.
        side = np.cross(axis, [0.0, 1.0, 0.3])
        side /= np.linalg.norm(side)
        up = np.cross(axis / np.linalg.norm(axis), side)
        radius = np.clip(BONE_RADIUS * depth, *BONE_RADIUS_LIMITS)
        spokes = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * up
        ring = centres[:, None, :] + radius[:, None, None] * spokes
        lattice = np.concatenate([centres, ring.reshape(-1, 3)])
        for _ in range(8):  # between toes and the like: towards the deepest centre until inside
            outside = skin.distance(lattice) > 0.0
            lattice[outside] += 0.4 * (centres[depth.argmax()] - lattice[outside])
        points[joint] = lattice
    return points.reshape(-1, 3), np.repeat(np.arange(NUM_JOINTS), points.shape[1])


def _links(
    positions: np.ndarray,
    depth: np.ndarray,
    surface: np.ndarray,
    skin: ClosedSurface,
    spacing: float,
    brought: np.ndarray,
) -> np.ndarray:
    """Return neighbouring particles ``(L, 2)`` int32, not across an air gap or between limbs that touch.

    Two limbs that touch have an air gap between their particles (the link's middle is outside) or skin weights
    without a joint in common. Points that the asset has ``brought`` are linked to flesh of the lattice only.
    """
    lattice, others = np.flatnonzero(~brought), np.flatnonzero(brought)
    tree = cKDTree(positions[lattice])
    links = lattice[tree.query_pairs(LINK_LENGTH * spacing, output_type="ndarray")]
    if len(others):
        near = lattice[tree.query(positions[others], k=SURFACE_LINKS)[1]]
        links = np.concatenate([links, np.sort(np.stack([np.repeat(others, SURFACE_LINKS), near.ravel()], axis=1))])
    pair = np.sort(links[:, 0].astype(np.int64) * len(positions) + links[:, 1])
    links = np.stack([pair // len(positions), pair % len(positions)], axis=1)
    joints = (surface > 0.0) @ (1 << np.arange(NUM_JOINTS))  # a bit for each
    links = links[(joints[links[:, 0]] & joints[links[:, 1]]) != 0]
    reach = 0.5 * np.linalg.norm(positions[links[:, 0]] - positions[links[:, 1]], axis=1)
    # the ball about the deeper end holds the middle
    inside = (depth[links].max(axis=1) > reach) | brought[links].any(axis=1)
    inside[~inside] = skin.distance(positions[links[~inside]].mean(axis=1)) < 0.0
    return links[inside].astype(np.int32)


def _local(weights: np.ndarray) -> np.ndarray:
    """Return weights ``(P, 22)`` without the harmonic functions' far ends and without the body's other side.

    A particle that a left joint moves most follows no right joint, and the reverse.
    """
    side = np.array([name.startswith("left") * 1 - name.startswith("right") * 1 for name in JOINT_NAMES])
    opposite = side[weights.argmax(axis=1)][:, None] * side[None, :] < 0
    kept = np.where(opposite | (weights < MIN_WEIGHT), 0.0, weights)
    return kept / kept.sum(axis=1, keepdims=True)


def _volumes(
    positions: np.ndarray,
    bone: np.ndarray,
    brought: np.ndarray,
    interior: np.ndarray,
    likely: np.ndarray,
    total: float,
) -> np.ndarray:
    """Return volumes [m^3] ``(P,)`` float32; each interior point counts for the nearest particle.

    ``likely`` is a particle near each interior point, or -1. It is the nearest if the point is nearer to it than half
    its distance from any other particle: only the other points need a search.
    The particles of one bone share theirs evenly: some are closer together than the interior points. So may those be
    that the asset has ``brought``; at least a twentieth of all is theirs.
    """
    tree = cKDTree(positions)
    gap = tree.query(positions, k=[2], workers=-1)[0][:, 0]
    sure = likely >= 0
    away = np.linalg.norm(interior[sure] - positions[likely[sure]], axis=1)
    sure[sure] = 2.0 * away < (1.0 - 1e-6) * gap[likely[sure]]
    nearest = np.concatenate([likely[sure], tree.query(interior[~sure], workers=-1)[1]])
    share = np.bincount(nearest, minlength=len(positions)).astype(np.float64)
    for joint in range(NUM_JOINTS):
        share[bone == joint] = share[bone == joint].mean()
    share = np.maximum(share, np.where(brought, 0.05 * len(interior) / max(brought.sum(), 1), 0.25))
    return (share * (total / share.sum())).astype(np.float32)


def _pushed_inside(
    points: np.ndarray, skin: ClosedSurface, faces: np.ndarray, body: ShapedBody, inset: float
) -> np.ndarray:
    """Return points ``(P, 3)``, those outside the skin moved to ``inset`` [m] below it."""
    distance, face, coordinates = skin.query(points)
    outside = distance > 0.0
    corners = body.vertices[faces[face[outside]]].astype(np.float64)
    nearest = np.einsum("pc,pci->pi", coordinates[outside], corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    points = points.copy()
    points[outside] = nearest - inset * normal
    return points


#: The torso, which head, neck and collars belong to, and the limbs that grow out of it.
LIMB_GROUPS: tuple[str, ...] = ("torso", "left_arm", "right_arm", "left_leg", "right_leg")

#: Skinning weight that each of two groups must have in a particle for it to lie in the seam between them.
SEAM_WEIGHT = 0.05


def limb_group_of_joint() -> np.ndarray:
    """Return the index into :data:`LIMB_GROUPS` of every joint, shape ``(22,)`` int32."""
    group = np.zeros(NUM_JOINTS, dtype=np.int32)
    for index, name in enumerate(LIMB_GROUPS[1:], start=1):
        group[[joint_index(joint) for joint in BODY_PARTS[name]]] = index
    return group


def limb_groups(skin_joints: np.ndarray, skin_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the group of every particle, and where two groups grow together.

    Args:
        skin_joints: joints that move each particle, shape ``(P, K)`` int.
        skin_weights: their weights, rows sum to one, shape ``(P, K)``.

    Returns:
        Index into :data:`LIMB_GROUPS` of the group with the largest summed weight (of equals the first), shape
        ``(P,)`` int32, and the seam, 1 where two groups have :data:`SEAM_WEIGHT` each and else 0, shape ``(P,)``
        float32.
    """
    share = dense_weights(skin_joints, skin_weights) @ np.eye(len(LIMB_GROUPS))[limb_group_of_joint()]
    second = np.sort(share, axis=1)[:, -2]
    return share.argmax(axis=1).astype(np.int32), (second >= SEAM_WEIGHT).astype(np.float32)
