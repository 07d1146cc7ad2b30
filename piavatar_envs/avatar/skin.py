"""The skin of an avatar on the device, by linear blend skinning plus displacement of particles.

The particles fill the body; the skin mesh is not simulated. Each skin vertex therefore follows its bones, and adds
the displacement ``x - LBS`` of the particles beneath it. Which particles, and with which weights, is baked once, on the
configured shape; where episodes draw shapes, the rest pose of the mesh follows the shape parameters on the device.

A surface may have displacements of its own that depend on the pose. They then stand in place of those that particles
are skinned with, see :mod:`piavatar_envs.avatar.body.pose_correctives`, which would count the same bulge twice.

Symbols in kernels: ``i`` picture, ``e = envs[i]`` its environment, ``v`` vertex, ``k`` neighbour of a vertex.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp
from scipy import sparse
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body import interpolation
from piavatar_envs.avatar.body.asset import dense_weights
from piavatar_envs.avatar.body.interpolation import interpolation_matrix
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS
from piavatar_envs.avatar.correctives import with_joint
from piavatar_envs.avatar.rotation import rigid_matrix
from piavatar_envs.avatar.skinning import blend_places, in_order, pack
from piavatar_envs.core.kernel_cache import init_warp
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.result_cache import digest_of, kept
from piavatar_envs.core.structs import fill
from piavatar_envs.mpm.types import row

if TYPE_CHECKING:
    from piavatar_envs.avatar.avatar import Avatar
    from piavatar_envs.avatar.body.asset import AvatarAsset, PoseDisplacements
    from piavatar_envs.avatar.body.pose_correctives import PoseCorrectives
    from piavatar_envs.avatar.types import Pose

wp.set_module_options({"enable_backward": False})

#: Particles that move a vertex. With few, what neighbours differ by crumples the skin where it is finer than they are:
#: toes on the ground, between bones that are put into their places and flesh that is not.
NUM_NEIGHBOURS = 24
#: Joints that move points, and their weights, both shape ``(N, K)``.
Skinning = tuple[np.ndarray, np.ndarray]
#: Skins that :meth:`Skin.baked` keeps in a process.
_MOST_BAKED = 8
#: Vertices whose displacements by the pose lie side by side: a warp then reads them together, and a CPU from few pages.
TILE = wp.constant(32)


@wp.struct
class SkinSurface:
    """Constants of a skin of ``V`` vertices that ``U`` particles move.

    The entries of the correctives of such a particle ``n`` are ``[start[n] : start[n + 1]]``. Where shapes are fixed,
    ``deltas`` has no rows; where nothing is displaced by the pose, ``directions`` and the correctives have none.
    """

    rest: wp.array(dtype=wp.vec3)  # (V,) of the shape, or of the mean shape where shapes differ [m]
    skin: wp.array(dtype=wp.vec4)  # (V,) bones that move a vertex, see piavatar_envs.avatar.skinning
    near: wp.array2d(dtype=int)  # (K, V) index in ``used`` of the particles that move a vertex
    weight: wp.array2d(dtype=float)  # (K, V) their weights, which sum to one
    used: wp.array(dtype=int)  # (U,) particles of the body
    deltas: wp.array2d(dtype=wp.vec3)  # (2 S, V) displacements at -1 and at +1 of each shape parameter [m]
    pelvis: wp.array(dtype=wp.vec3)  # (1 + 2 S,) pelvis of the mean shape, and its displacements likewise [m]
    # (V / TILE, 189 TILE) displacement by elements of the joints' rotation matrices, vertices side by side [m]
    directions: wp.array2d(dtype=wp.vec3)
    reference: wp.array(dtype=wp.mat33)  # (bones,) see PoseDisplacements
    parent: wp.array(dtype=int)  # (bones,)
    start: wp.array(dtype=int)
    joint: wp.array(dtype=int)
    linear: wp.array(dtype=wp.mat33)  # [m]
    quadratic: wp.array(dtype=wp.mat33)  # [m]


@wp.struct
class SkinMotion:
    """Bones and particles that move a skin: live arrays of the simulation, of ``num_envs`` or 1 rows."""

    first: int  # index of the body's first particle
    skin: wp.array(dtype=wp.vec4)  # (P,) bones that move a particle
    rest: wp.array2d(dtype=wp.vec3)  # (rows, P) rest positions of the particles [m]
    rest_joint: wp.array2d(dtype=wp.vec3)  # (rows, bones) [m]
    rotation: wp.array2d(dtype=wp.quat)  # (num_envs, bones) in the world
    position: wp.array2d(dtype=wp.vec3)  # (num_envs, bones) of the joints [m]
    x: wp.array2d(dtype=wp.vec3)  # (num_envs, all particles) [m]
    shape: wp.array2d(dtype=float)  # (num_envs, S) shape parameters; not read where shapes are fixed


@wp.struct
class SkinWorkspace:
    """Poses of the bones of every picture, and the displacements of the particles that move its skin."""

    place: wp.array2d(dtype=wp.mat44)  # (pictures, bones) from rest to the world
    local: wp.array2d(dtype=wp.quat)  # (pictures, bones) rotation relative to the parent bone
    change: wp.array2d(dtype=wp.mat33)  # (pictures, bones) change of that matrix from the reference pose
    shift: wp.array(dtype=wp.vec3)  # (pictures,) from where the mean shape is to where the body stands [m]
    displacement: wp.array2d(dtype=wp.vec3)  # (pictures, U) of the particles from where the bones put them [m]


@wp.func
def with_shape(surface: SkinSurface, shape: wp.array2d(dtype=float), e: int, v: int):
    """Return a vertex of the rest pose in the shape of an environment, where the mean shape is [m]."""
    rest = surface.rest[v]
    for s in range(surface.deltas.shape[0] / 2):
        value = shape[e, s]
        rest += wp.abs(value) * surface.deltas[2 * s + wp.where(value > 0.0, 1, 0), v]
    return rest


@wp.func_native("""
wp::vec3 sum;
const int columns = near.shape[1];
const wp::vec3* const from = values.data + wp::int64(values.shape[1]) * i;
for (int k = 0; k < near.shape[0]; ++k) {
    const int at = columns * k + v;
    sum = wp::add(sum, wp::mul(weight.data[at], from[near.data[at]]));
}
return sum;
""")
def weighted_sum(
    near: wp.array2d(dtype=int), weight: wp.array2d(dtype=float), values: wp.array2d(dtype=wp.vec3), i: int, v: int
) -> wp.vec3:
    """Return ``sum_k weight[k, v] values[i, near[k, v]]``."""
    ...


@wp.kernel
def pose_skin(envs: wp.array(dtype=int), surface: SkinSurface, motion: SkinMotion, workspace: SkinWorkspace):
    """Write the pose of the bones of every picture, over ``(pictures, bones)``."""
    i, b = wp.tid()
    e = envs[i]
    if e < 0:
        return
    rest = motion.rest_joint[row(e, motion.rest_joint.shape[0]), b]
    workspace.place[i, b] = rigid_matrix(motion.rotation[e, b], rest, motion.position[e, b])
    turn = surface.reference[b]
    before = turn
    after = wp.quat_to_matrix(motion.rotation[e, b]) * turn
    local = motion.rotation[e, b]
    if b > 0:
        parent = surface.parent[b]
        local = wp.quat_inverse(motion.rotation[e, parent]) * local
        before = wp.transpose(surface.reference[parent]) * before
        after = wp.transpose(wp.quat_to_matrix(motion.rotation[e, parent]) * surface.reference[parent]) * after
    workspace.local[i, b] = local
    workspace.change[i, b] = after - before
    if b == 0:
        shift = wp.vec3()
        if surface.pelvis.shape[0] > 1:
            pelvis = surface.pelvis[0]
            for s in range(surface.deltas.shape[0] / 2):
                value = motion.shape[e, s]
                pelvis += wp.abs(value) * surface.pelvis[1 + 2 * s + wp.where(value > 0.0, 1, 0)]
            shift = rest - pelvis
        workspace.shift[i] = shift


@wp.kernel
def displace_particles(envs: wp.array(dtype=int), surface: SkinSurface, motion: SkinMotion, workspace: SkinWorkspace):
    """Write how far the particles are from where the bones put them, over ``(pictures, U)``."""
    i, n = wp.tid()
    e = envs[i]
    if e < 0:
        return
    p = surface.used[n]
    rest = motion.rest[row(e, motion.rest.shape[0]), p]
    if surface.start.shape[0] > 1:
        for c in range(surface.start[n], surface.start[n + 1]):
            rest = with_joint(rest, surface.linear[c], surface.quadratic[c], workspace.local[i, surface.joint[c]])
    place = blend_places(workspace.place, i, motion.skin, p, rest)
    workspace.displacement[i, n] = motion.x[e, motion.first + p] - place


@wp.kernel
def deform_skin(
    envs: wp.array(dtype=int),
    surface: SkinSurface,
    motion: SkinMotion,
    workspace: SkinWorkspace,
    first: int,
    # out
    vertices: wp.array2d(dtype=wp.vec3),
):
    """Write the vertices of a skin, from vertex ``first`` of every picture on; over ``(pictures, V)``."""
    i, v = wp.tid()
    e = envs[i]
    if e < 0:
        return
    rest = with_shape(surface, motion.shape, e, v) + workspace.shift[i]
    if surface.directions.shape[0] > 0:
        for b in range(1, surface.parent.shape[0]):
            change = workspace.change[i, b]
            for d in range(9):
                at_change = ((b - 1) * 9 + d) * TILE + v % TILE
                rest += change[d / 3, d % 3] * surface.directions[v / TILE, at_change]
    at = blend_places(workspace.place, i, surface.skin, v, rest)
    vertices[i, first + v] = at + weighted_sum(surface.near, surface.weight, workspace.displacement, i, v)


def record_skin(
    graph: LaunchGraph,
    envs: wp.array,
    surface: SkinSurface,
    motion: SkinMotion,
    workspace: SkinWorkspace,
    vertices: wp.array,
    first: int = 0,
) -> None:
    """Append the launches that write a skin into ``vertices``, from vertex ``first`` of every picture on.

    Args:
        graph: the launch graph to append to.
        envs: environment of each picture, ``(pictures,)`` int32; a picture of a negative one keeps its vertices.
        surface: from :meth:`Skin.upload`.
        motion: bones and particles.
        workspace: from :func:`skin_workspace`, of as many pictures.
        vertices: of all pictures ``(pictures, ...)`` [m].
        first: index of the skin's first vertex.
    """
    inputs, pictures = [envs, surface, motion, workspace], len(envs)
    graph.launch(pose_skin, (pictures, NUM_JOINTS), inputs)
    if len(surface.used):
        graph.launch(displace_particles, (pictures, len(surface.used)), inputs)
    graph.launch(deform_skin, (pictures, len(surface.rest)), [*inputs, first], [vertices])


def motion_of(avatar: Avatar, x: wp.array, pose: Pose | None = None, shape: wp.array | None = None) -> SkinMotion:
    """Return what moves the skin of an avatar, in live arrays.

    Args:
        avatar: the avatar.
        x: positions of all particles ``(num_envs, particles)`` [m].
        pose: of its bones; as they are tracked if not given.
        shape: parameters ``(num_envs, S)``, where shapes are random.
    """
    none = wp.zeros((1, 1), dtype=float, device=avatar.model.device)
    sources = avatar.body, pose or avatar.tracked
    return fill(SkinMotion(), *sources, x=x, shape=none if shape is None else shape)


def skin_workspace(surface: SkinSurface, pictures: int, device: str) -> SkinWorkspace:
    """Allocate what :func:`record_skin` works in."""
    bones = (pictures, NUM_JOINTS)
    return fill(
        SkinWorkspace(),
        place=wp.zeros(bones, dtype=wp.mat44, device=device),
        local=wp.zeros(bones, dtype=wp.quat, device=device),
        change=wp.zeros(bones, dtype=wp.mat33, device=device),
        shift=wp.zeros(pictures, dtype=wp.vec3, device=device),
        displacement=wp.zeros((pictures, len(surface.used)), dtype=wp.vec3, device=device),
    )


def skin_bytes(particles: int) -> int:
    """Return the memory of :func:`skin_workspace` for a picture, if so many particles move the skin [bytes]."""
    return 4 * (NUM_JOINTS * (16 + 4 + 9) + 3 + 3 * particles)


class SkinnedSurface(Protocol):
    """Skinning of an asset's vertices."""

    skin_joints: np.ndarray
    skin_weights: np.ndarray


class RestShape(Protocol):
    """Rest pose of a shaped body."""

    vertices: np.ndarray
    joints: np.ndarray


class Skin:
    """One body's skin mesh, which its bones and particles deform."""

    def __init__(
        self,
        asset: SkinnedSurface,
        body: RestShape,
        rest_positions: np.ndarray,
        skin_joints: np.ndarray,
        skin_weights: np.ndarray,
        correctives: PoseCorrectives | None = None,
    ) -> None:
        """Bake the weights.

        Args:
            asset: the skinning of the vertices, ``skin_joints (V, K)`` and ``skin_weights (V, K)``.
            body: the rest pose of one shape, ``vertices (V, 3)`` [m] and ``joints (22, 3)`` [m].
            rest_positions: the particles in the rest pose of that same shape [m], shape ``(P, 3)``.
            skin_joints: joints that move each particle, shape ``(P, K)`` int.
            skin_weights: their weights, rows sum to one, shape ``(P, K)``.
            correctives: displacements of the particles' rest pose by the pose, if they have such.

        Raises:
            ValueError: there are no particles, or their arrays differ in length.
        """
        counts = {len(rest_positions), len(skin_joints), len(skin_weights)}
        if len(counts) != 1 or 0 in counts:
            raise ValueError(
                f"rest_positions, skin_joints and skin_weights have {len(rest_positions)}, {len(skin_joints)} and "
                f"{len(skin_weights)} rows; give one row per particle, and at least one particle"
            )
        self._rest, self._particles = np.asarray(body.vertices, np.float64), np.asarray(rest_positions, np.float64)
        self._rest_joints = np.asarray(body.joints, np.float64)
        self._vertex_skin = pack(*in_order(np.asarray(asset.skin_joints), np.asarray(asset.skin_weights)))
        self._particle_skin = pack(*in_order(np.asarray(skin_joints), np.asarray(skin_weights)))
        skinnings = (asset.skin_joints, asset.skin_weights), (skin_joints, skin_weights)
        self._interpolation = _interpolation(self._rest, self._particles, *skinnings)
        self._pose: PoseDisplacements | None = getattr(asset, "pose", None)
        self._correctives = correctives if self._pose is not None else None
        self._uploaded: dict[tuple[str, int], tuple[AvatarAsset | None, SkinSurface]] = {}

    @classmethod
    def baked(
        cls,
        asset: SkinnedSurface,
        body: RestShape,
        rest_positions: np.ndarray,
        skin_joints: np.ndarray,
        skin_weights: np.ndarray,
        correctives: PoseCorrectives | None = None,
    ) -> Skin:
        """Return the skin of these arrays, baked once per process for all environments; arguments as for the class."""
        digest = hashlib.blake2b()
        surface = (asset.skin_joints, asset.skin_weights, body.vertices, body.joints)
        pose: PoseDisplacements | None = getattr(asset, "pose", None)
        moved = () if pose is None else (pose.directions, pose.reference)
        for array in (*surface, rest_positions, skin_joints, skin_weights, *moved):
            digest.update(f"{np.shape(array)} {np.asarray(array).dtype}".encode())
            digest.update(np.ascontiguousarray(array))
        key = digest.digest()
        skin = _baked.pop(key, None) or cls(asset, body, rest_positions, skin_joints, skin_weights, correctives)
        _baked[key] = skin
        while len(_baked) > _MOST_BAKED:
            _baked.popitem(last=False)
        return skin

    @property
    def num_vertices(self) -> int:
        """Vertices of the skin mesh."""
        return self._interpolation.shape[0]

    @property
    def weights(self) -> sparse.csr_array:
        """Weights of the particles in the displacements of vertices, rows sum to one, shape ``(V, P)``."""
        return self._interpolation

    @property
    def num_particles(self) -> int:
        """Particles of the body."""
        return self._interpolation.shape[1]

    @property
    def stencil(self) -> tuple[np.ndarray, np.ndarray]:
        """Particles of the body that move each vertex, and their weights, both shape ``(V, K)``."""
        shape = (self.num_vertices, -1)
        return self._interpolation.indices.reshape(shape), self._interpolation.data.reshape(shape)

    def upload(self, device: str, varying: AvatarAsset | None = None) -> SkinSurface:
        """Return the constants on a device, uploaded once; where shapes differ, with the shapes of an asset."""
        key = (device, id(varying))
        if key not in self._uploaded:
            self._uploaded[key] = varying, self._upload(device, varying)  # an id is only unique while its owner lives
        return self._uploaded[key][1]

    def _upload(self, device: str, varying: AvatarAsset | None) -> SkinSurface:
        count, neighbours = self.num_vertices, self._interpolation.indices.reshape(self.num_vertices, -1)
        used, near = np.unique(neighbours, return_inverse=True)
        rest, deltas, pelvis = self._rest, np.zeros((0, count, 3)), np.zeros((1, 3))
        if varying is not None:
            drawn = varying.drawn
            rest, deltas = drawn.vertices, drawn.shape_deltas.reshape(-1, count, 3)
            pelvis = np.concatenate([varying.joints[:1], varying.shape_joints[:, :, 0].reshape(-1, 3)])
        directions, reference = np.zeros((0, TILE, 3)), np.tile(np.eye(3), (NUM_JOINTS, 1, 1))
        if self._pose is not None:
            elements = self._pose.directions.reshape(count, 3, -1)
            padded = np.pad(elements, ((0, -count % TILE), (0, 0), (0, 0)))
            directions = padded.reshape(-1, TILE, *elements.shape[1:]).transpose(0, 3, 1, 2)
            directions, reference = directions.reshape(len(directions), -1, 3), self._pose.reference

        return _upload(
            device,
            rest=rest,
            skin=self._vertex_skin,
            near=near.reshape(neighbours.shape).T,
            weight=self._interpolation.data.reshape(neighbours.shape).T,
            used=used,
            deltas=deltas,
            pelvis=pelvis,
            directions=directions,
            reference=reference,
            **self._correctives_of(used),
        )

    def _correctives_of(self, used: np.ndarray) -> dict[str, np.ndarray]:
        """Return the correctives of some particles, by the names of the surface."""
        if self._correctives is None:
            return {}
        own = self._correctives
        counts = np.diff(own.start)[used]
        start = np.concatenate([[0], np.cumsum(counts)])
        entries = np.repeat(own.start[used] - start[:-1], counts) + np.arange(start[-1])
        return {"start": start} | {name: getattr(own, name)[entries] for name in ("joint", "linear", "quadratic")}

    def deform(self, rotations: np.ndarray, positions: np.ndarray, particle_positions: np.ndarray) -> np.ndarray:
        """Compute the skin vertices of one state, on the CPU.

        Args:
            rotations: world rotations of the bones, identity in the rest pose, shape ``(22, 3, 3)``.
            positions: world positions of the joints [m], shape ``(22, 3)``.
            particle_positions: the simulated particles [m], shape ``(P, 3)``.

        Returns:
            World positions of the skin vertices [m], shape ``(V, 3)`` float32.

        Raises:
            ValueError: another number of particles than were baked.
        """
        if np.shape(particle_positions) != (self.num_particles, 3):
            raise ValueError(
                f"particle_positions has shape {np.shape(particle_positions)}, not ({self.num_particles}, 3)"
            )

        def array(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values, np.float32), dtype=dtype, device="cpu")

        init_warp()
        quaternions = Rotation.from_matrix(rotations).as_quat()
        motion = fill(
            SkinMotion(),
            first=0,
            skin=array(self._particle_skin, wp.vec4),
            rest=array(self._particles[None], wp.vec3),
            rest_joint=array(self._rest_joints[None], wp.vec3),
            rotation=array(quaternions[None], wp.quat),
            position=array(np.asarray(positions)[None], wp.vec3),
            x=array(np.asarray(particle_positions)[None], wp.vec3),
            shape=wp.zeros((1, 1), dtype=float, device="cpu"),
        )
        surface, envs = self.upload("cpu"), wp.zeros(1, dtype=int, device="cpu")
        vertices = wp.zeros((1, self.num_vertices), dtype=wp.vec3, device="cpu")
        graph = LaunchGraph("cpu")
        record_skin(graph, envs, surface, motion, skin_workspace(surface, 1, "cpu"), vertices)
        graph.run_eager()
        return vertices.numpy()[0]

    def interpolate(self, per_particle: np.ndarray) -> np.ndarray:
        """Interpolate a quantity of the particles on the skin, shape ``(P, ...)`` to ``(V, ...)``."""
        return self._interpolation @ np.asarray(per_particle, dtype=np.float64)


def bone_surface(
    rest: np.ndarray,
    skin_joints: np.ndarray,
    skin_weights: np.ndarray,
    device: str,
    deltas: np.ndarray | None = None,
) -> SkinSurface:
    """Return a surface on a device that only bones move, for :func:`record_skin`.

    Args:
        rest: vertices in the rest pose, of the mean shape if there are ``deltas`` [m], shape ``(V, 3)``.
        skin_joints: joints that move each vertex, shape ``(V, 4)``.
        skin_weights: their weights, shape ``(V, 4)``.
        device: Warp device.
        deltas: displacements at -1 and at +1 of each shape parameter [m], shape ``(2 S, V, 3)``.
    """
    none = np.zeros((0, len(rest)))
    return _upload(
        device,
        rest=rest,
        skin=pack(*in_order(np.asarray(skin_joints), np.asarray(skin_weights))),
        near=none,
        weight=none,
        used=np.zeros(0),
        deltas=np.zeros((0, len(rest), 3)) if deltas is None else deltas,
        pelvis=np.zeros((1, 3)),
        directions=np.zeros((0, TILE, 3)),
        reference=np.tile(np.eye(3), (NUM_JOINTS, 1, 1)),
    )


#: Arrays of a surface without correctives.
_NO_CORRECTIVES = {
    "start": np.zeros(1),
    "joint": np.zeros(0),
    "linear": np.zeros((0, 3, 3)),
    "quadratic": np.zeros((0, 3, 3)),
}


def _upload(device: str, **values: np.ndarray) -> SkinSurface:
    """Return a surface on a device from its arrays by name."""
    surface = SkinSurface()
    for name, value in ({"parent": np.array(PARENTS)} | _NO_CORRECTIVES | values).items():
        dtype = SkinSurface.vars[name].type.dtype
        scalar = np.int32 if dtype is wp.int32 else np.float32
        setattr(surface, name, wp.array(np.ascontiguousarray(value, scalar), dtype=dtype, device=device))
    return surface


def _interpolation(vertices: np.ndarray, particles: np.ndarray, own: Skinning, others: Skinning) -> sparse.csr_array:
    """Return the weights of particles at vertices, shape ``(V, P)``, from a file if they take long to compute.

    Args:
        vertices: in the rest pose [m], shape ``(V, 3)``.
        particles: likewise, shape ``(P, 3)``.
        own: joints and weights of the vertices.
        others: those of the particles.
    """

    def compute() -> dict[str, np.ndarray]:
        weights = dense_weights(*own), dense_weights(*others)
        found = interpolation_matrix(vertices, weights[0], particles, weights[1], NUM_NEIGHBOURS)
        return {name: getattr(found, name) for name in ("data", "indices", "indptr")}

    given = [vertices, particles, *map(np.asarray, (*own, *others)), NUM_NEIGHBOURS]
    doing = f"binding {len(vertices)} points to {len(particles)} particles"
    arrays = kept("bound", digest_of(given, [interpolation]), compute, doing)
    parts = (arrays["data"], arrays["indices"], arrays["indptr"])
    return sparse.csr_array(parts, shape=(len(vertices), len(particles)))


#: Skins by the digest of what they were baked from, the one that was used last at the end.
_baked: OrderedDict[bytes, Skin] = OrderedDict()
