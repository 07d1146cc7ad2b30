"""From a closed skin to the particles of the simulation: positions, volumes, skinning weights and bone particles.

*Flesh* particles sit in the cells of a regular lattice, each at the centroid of the part of its cell that is
inside the skin, so thin limbs are filled as well as thick ones. *Bone* particles are ordinary particles too, a
small lattice along every bone, rigidly skinned to it: the Kabsch fit that tracks the pose reads only them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from piavatar_envs.avatar import harmonic
from piavatar_envs.avatar.asset import AvatarAsset, ShapedBody, dense_weights, mesh_volume, top_weights
from piavatar_envs.avatar.ordering import order_along_curve, order_of_body
from piavatar_envs.avatar.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.avatar.surface import ClosedSurface

SPACING_PER_DX = 0.57  # lattice spacing over grid spacing: about 5 particles a cell
SUBDIVISIONS = 3  # points per axis and cell that decide how much of it is inside
MIN_FILL = 0.3  # share of a cell that must be inside for a particle of its own
LINK_LENGTH = 1.8  # of a link between neighbouring particles, over the spacing
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
    """Lattice spacing [m] that suits a grid of spacing ``dx`` [m]."""
    return SPACING_PER_DX * dx


@lru_cache(maxsize=16)
def sample_particles(asset: AvatarAsset, spacing: float, seed: int = 0, bone_rings: int = 4) -> ParticleSet:
    """Fill the mean shape of an asset with particles; the same on every call and machine.

    Args:
        asset: the body.
        spacing: lattice spacing [m]; see :func:`spacing_for`.
        seed: shifts the lattice in y and z. Not in x, where it stays as symmetric as the body.
        bone_rings: rings of five bone particles along every bone.

    Raises:
        ValueError: the spacing is not positive or above 8 cm, too few rings, or a bone outside the skin.
    """
    if not 0.0 < spacing <= 0.08:
        raise ValueError(f"spacing={spacing} m is outside (0, 0.08]; coarser would lose hands and feet")
    if bone_rings < 4:
        raise ValueError(f"bone_rings={bone_rings} gives under {MIN_BONE_PARTICLES} particles a bone; use 4 or more")
    skin = ClosedSurface(asset.vertices, asset.faces)
    flesh, interior = _flesh_lattice(asset, skin, spacing, seed)
    bones, bone_of = _bone_lattice(asset, skin, bone_rings)
    flesh = flesh[cKDTree(bones).query(flesh)[0] > BONE_CLEARANCE * spacing]
    positions = np.concatenate([bones, flesh]).astype(np.float32)
    bone = np.concatenate([bone_of, np.full(len(flesh), -1)]).astype(np.int32)
    order = order_along_curve(positions, spacing)
    positions, bone = positions[order], bone[order]
    distance, face, coordinates = skin.query(positions)
    anchors = asset.faces[face]
    surface = np.einsum("pc,pcj->pj", coordinates, dense_weights(asset.skin_joints, asset.skin_weights)[anchors])
    links = _links(positions, -distance, surface, skin, spacing)
    surface[bone >= 0] = np.eye(NUM_JOINTS)[bone[bone >= 0]]
    shell = distance > -SHELL * spacing
    weights = harmonic.fill(links, positions, surface, shell | (bone >= 0))
    skin_joints, skin_weights = top_weights(_local(weights))
    volumes = _volumes(positions, bone, interior, mesh_volume(asset.vertices, asset.faces))
    depth = np.maximum(-distance, 0.0)
    order = order_of_body(positions, bone, skin_joints, skin_weights)
    links = np.argsort(order).astype(np.int32)[links]
    first = (positions, volumes, skin_joints, skin_weights, bone)
    rest = (anchors, coordinates, shell, depth)
    arrays = (*(a[order] for a in first), links, *(a[order] for a in rest))
    for array in arrays:
        array.setflags(write=False)
    return ParticleSet(float(spacing), *arrays)


def morph(asset: AvatarAsset, particles: ParticleSet, body: ShapedBody) -> tuple[np.ndarray, np.ndarray]:
    """Move the particles of the mean shape into another shape of the same asset.

    Particles near the skin follow their nearest skin point; the interior follows smoothly. Volumes change with the
    local stretch and add up to the shape's volume.

    Args:
        asset: the body the particles were sampled from.
        particles: its particles.
        body: the shape, from :meth:`AvatarAsset.shape`.

    Returns:
        Rest positions [m] ``(P, 3)`` and volumes [m^3] ``(P,)``, both float32.
    """
    corners = particles.anchor_vertices
    displacement = (body.vertices - asset.vertices).astype(np.float64)[corners]
    guess = np.einsum("pc,pci->pi", particles.anchor_weights, displacement)
    rest = particles.rest_positions.astype(np.float64)
    moved = rest + harmonic.fill(particles.links, rest, guess, particles.shell)
    skin = ClosedSurface(body.vertices, asset.faces)
    moved = _pushed_inside(moved, skin, asset.faces, body, INSET * particles.spacing)
    volumes = particles.volumes * harmonic.volume_ratios(particles.links, rest, moved)
    volumes *= mesh_volume(body.vertices, asset.faces) / volumes.sum()
    return moved.astype(np.float32), volumes.astype(np.float32)


def _flesh_lattice(asset: AvatarAsset, skin: ClosedSurface, spacing: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Flesh particles ``(N, 3)`` and the finer lattice of interior points that measures volumes ``(M, 3)``."""
    low, high = asset.vertices.min(axis=0), asset.vertices.max(axis=0)
    shift = np.random.default_rng(seed).uniform(0.0, spacing, 3) * [0.0, 1.0, 1.0]
    first = np.floor((low - shift) / spacing).astype(int)
    counts = np.ceil((high - shift) / spacing).astype(int) - first
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    centres = (cells + first + 0.5) * spacing + shift
    distance = skin.distance(centres)
    near = distance < 0.5 * np.sqrt(3.0) * spacing
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
    outside = skin.distance(flesh) > -0.02 * spacing
    gap = np.linalg.norm(fine[keep][outside] - flesh[outside][:, None], axis=-1)
    gap[~inside[keep][outside]] = np.inf
    flesh[outside] = fine[keep][outside][np.arange(outside.sum()), gap.argmin(axis=1)]
    return flesh, fine[inside]


def _bone_ends(asset: AvatarAsset, skin: ClosedSurface) -> np.ndarray:
    """Where every bone points from its joint [m], shape ``(22, 3)``: the next joint, or the middle of its flesh."""
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


def _bone_lattice(asset: AvatarAsset, skin: ClosedSurface, rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Bone particles ``(B, 3)`` and the joint each belongs to ``(B,)``: rings around every bone's axis."""
    ends = _bone_ends(asset, skin)
    points = np.empty((NUM_JOINTS, rings * (BONE_RING + 1), 3))
    angles = 2.0 * np.pi * np.arange(BONE_RING) / BONE_RING
    for joint, name in enumerate(JOINT_NAMES):
        start = asset.joints[joint].astype(np.float64)
        axis = ends[joint] - start
        centres = start + np.linspace(*BONE_RANGE, rings)[:, None] * axis
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
    positions: np.ndarray, depth: np.ndarray, surface: np.ndarray, skin: ClosedSurface, spacing: float
) -> np.ndarray:
    """Neighbouring particles ``(L, 2)`` int32, but not across an air gap or between limbs that merely touch.

    Two limbs that touch have an air gap between their particles (the link's middle is outside) or skin weights
    without a joint in common.
    """
    links = cKDTree(positions).query_pairs(LINK_LENGTH * spacing, output_type="ndarray")
    links = links[np.lexsort((links[:, 1], links[:, 0]))]
    shared = np.minimum(surface[links[:, 0]], surface[links[:, 1]]).sum(axis=1)
    links = links[shared > 0.0]
    reach = 0.5 * np.linalg.norm(positions[links[:, 0]] - positions[links[:, 1]], axis=1)
    inside = depth[links].max(axis=1) > reach  # the ball about the deeper end holds the middle
    inside[~inside] = skin.distance(positions[links[~inside]].mean(axis=1)) < 0.0
    return links[inside].astype(np.int32)


def _local(weights: np.ndarray) -> np.ndarray:
    """Weights ``(P, 22)`` without the harmonic functions' faint far ends and without the body's other side.

    A particle that a left joint moves most follows no right joint, and the reverse.
    """
    side = np.array([name.startswith("left") * 1 - name.startswith("right") * 1 for name in JOINT_NAMES])
    opposite = side[weights.argmax(axis=1)][:, None] * side[None, :] < 0
    kept = np.where(opposite | (weights < MIN_WEIGHT), 0.0, weights)
    return kept / kept.sum(axis=1, keepdims=True)


def _volumes(positions: np.ndarray, bone: np.ndarray, interior: np.ndarray, total: float) -> np.ndarray:
    """Volumes [m^3] ``(P,)`` float32: interior points go to the nearest particle, so nothing is counted twice.

    The particles of one bone share theirs evenly: some are closer together than the interior points.
    """
    nearest = cKDTree(positions).query(interior)[1]
    share = np.bincount(nearest, minlength=len(positions)).astype(np.float64)
    for joint in range(NUM_JOINTS):
        share[bone == joint] = share[bone == joint].mean()
    share = np.maximum(share, 0.25)
    return (share * (total / share.sum())).astype(np.float32)


def _pushed_inside(
    points: np.ndarray, skin: ClosedSurface, faces: np.ndarray, body: ShapedBody, inset: float
) -> np.ndarray:
    """Points ``(P, 3)`` of which none is outside the skin: those that are move to ``inset`` [m] below it."""
    distance, face, coordinates = skin.query(points)
    outside = distance > 0.0
    corners = body.vertices[faces[face[outside]]].astype(np.float64)
    nearest = np.einsum("pc,pci->pi", coordinates[outside], corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    points = points.copy()
    points[outside] = nearest - inset * normal
    return points
