"""Surfaces of a glTF file: triangles, skinning and colours, in the pose that the skin was bound in.

Colours are those of the base: factor times vertex colour times texture, which is also sampled at the vertices for
pictures without textures. A texture's opacity makes holes where it is below the cutoff of its material, or below a half
where the material blends. Morph targets, normals and every other texture are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from piavatar_envs.avatar.body.groups import MOST_GROUPS
from piavatar_envs.avatar.body.textures import CLAMP, MIRROR, REPEAT, Texture, Textures, decoded, decoded_alpha
from piavatar_envs.avatar.gltf import MAX_VALUES, Gltf, numbers, whole
from piavatar_envs.core.extras import install_command
from piavatar_envs.core.reading import UNREADABLE, first_line, reading
from piavatar_envs.core.srgb import linear_to_srgb

MAX_VERTICES, MAX_TRIANGLES = 6_000_000, 6_000_000
MAX_IMAGES = 64  # of textures of a file
MAX_UV = 1.0e4  # images to either side, far more than single precision can place well
MAX_SETS = 4  # of JOINTS_n and WEIGHTS_n
SAME_PLACE = 5e-3  # of the size of a skeleton, within which skins agree on a joint
_SIMPLIFY = "simplify it with: npx @gltf-transform/cli simplify IN.glb OUT.glb"


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles of one primitive of one node.

    Attributes:
        name: of the node, or of its mesh.
        node: that has the mesh.
        skin: index of its skin; None for a rigid one.
        material: name of the material, empty without one.
        points: in the space of the mesh, shape ``(V, 3)`` float64.
        faces: shape ``(T, 3)`` int64.
        nodes: that move each vertex, shape ``(V, K)`` int64.
        weights: their weights, rows sum to one, shape ``(V, K)`` float64.
        colors: sRGB, of the texture as well, shape ``(V, 3)`` uint8.
        painted: weights in [0, 1] by lower-case name, each shape ``(V,)`` float64.
        textures: of the base colour; None without one.
    """

    name: str
    node: int
    skin: int | None
    material: str
    points: np.ndarray
    faces: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    colors: np.ndarray
    painted: dict[str, np.ndarray]
    textures: Textures | None = None


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Pieces of a file, and where they and its nodes are at rest.

    Attributes:
        pieces: of the scene that is shown.
        places: points of each piece in the scene, each shape ``(V, 3)`` float64.
        faces: triangles of each piece, outwards there, each shape ``(T, 3)``.
        world: transforms of the nodes to the scene, shape ``(N, 4, 4)``.
        notes: what was left out or guessed, one sentence each.
    """

    pieces: list[Piece]
    places: list[np.ndarray]
    faces: list[np.ndarray]
    world: np.ndarray
    notes: tuple[str, ...]


def read_surfaces(gltf: Gltf) -> Surfaces:
    """Return the surfaces of a file at rest.

    That is the pose in which the skins were bound, where they agree on one and its bones are as long as those that the
    file shows; else the pose that the file shows.

    Raises:
        ValueError: the file is damaged, or larger than the limits of this module.
    """
    with reading(gltf.path, "a glTF character"):
        reader = _Reader(gltf)
        pieces = reader.pieces()
        bound = bind_pose(gltf)
        if bound is None:
            world = gltf.world
            if gltf.skins:
                reader.notes.append("the skins were bound in poses that do not agree: the pose that is shown is taken")
            transforms = [world[skin.joints] @ skin.inverse_binds for skin in gltf.skins]
            places = [_blended(piece, gltf, transforms, world) for piece in pieces]
            leads = [transform[0] for transform in transforms]
        else:
            world, leads = bound
            moved = np.abs(world[:, :3, 3] - gltf.world[:, :3, 3])
            if gltf.skins and moved.max() > 2.0 * SAME_PLACE * float(np.ptp(world[:, :3, 3], axis=0).max()):
                reader.notes.append("the file shows another pose than its skin was bound in, which is taken")
            places = [
                _moved(piece.points, world[piece.node] if piece.skin is None else leads[piece.skin]) for piece in pieces
            ]
        faces = []
        for piece in pieces:
            lead = world[piece.node] if piece.skin is None else leads[piece.skin]
            faces.append(piece.faces[:, ::-1] if np.linalg.det(lead[:3, :3]) < 0.0 else piece.faces)
        return Surfaces(pieces, places, faces, world, tuple(dict.fromkeys(reader.notes)))


def bind_pose(gltf: Gltf) -> tuple[np.ndarray, list[np.ndarray]] | None:
    """Return transforms of the nodes to the scene in the bind pose, and of the meshes of each skin.

    An inverse bind matrix ``I`` takes a mesh to the node of its joint, so the joint was at ``M inverse(I)``, with one
    ``M`` of the whole skin, which the joint nearest to the root gives: it stays where the file shows it.

    Returns:
        Shapes ``(N, 4, 4)`` and ``(4, 4)`` each; None where no such pose is to be had.
    """
    bound: dict[int, np.ndarray] = {}
    leads: list[np.ndarray] = [np.eye(4)] * len(gltf.skins)
    depth = np.zeros(len(gltf.parents), dtype=int)
    for node in gltf.order:
        depth[node] = 0 if gltf.parents[node] < 0 else depth[gltf.parents[node]] + 1
    apart = 0.0
    for index in sorted(range(len(gltf.skins)), key=lambda i: -len(gltf.skins[i].joints)):
        skin = gltf.skins[index]
        if np.abs(np.linalg.det(skin.inverse_binds[:, :3, :3])).min() < 1e-18:
            return None
        binds = np.linalg.inv(skin.inverse_binds)
        shared = [j for j, node in enumerate(skin.joints) if int(node) in bound]
        first = shared[0] if shared else int(depth[skin.joints].argmin())
        node = int(skin.joints[first])
        leads[index] = bound.get(node, gltf.world[node]) @ skin.inverse_binds[first]
        for joint, place in zip(skin.joints, leads[index] @ binds, strict=True):
            known = bound.setdefault(int(joint), place)
            apart = max(apart, float(np.abs(known[:3, 3] - place[:3, 3]).max()))
    if not bound:
        return (gltf.world, leads) if not gltf.skins else None
    world = gltf.world.copy()
    for node in gltf.order:
        parent = gltf.parents[node]
        if int(node) in bound:
            world[node] = bound[int(node)]
        elif parent >= 0:
            world[node] = world[parent] @ gltf.local[node]
    inner = [node for node in bound if gltf.parents[node] in bound]
    above = gltf.parents[inner]
    lengths, shown = (np.linalg.norm(w[inner, :3, 3] - w[above, :3, 3], axis=1) for w in (world, gltf.world))
    size = float(np.ptp(gltf.world[list(bound), :3, 3], axis=0).max())
    if not np.isfinite(world).all() or apart > SAME_PLACE * size:
        return None
    if len(inner) and np.abs(lengths - shown).max() > 0.1 * size:
        return None
    return world, leads


def _moved(points: np.ndarray, transform: np.ndarray) -> np.ndarray:
    return points @ transform[:3, :3].T + transform[:3, 3]


def _blended(piece: Piece, gltf: Gltf, transforms: list[np.ndarray], world: np.ndarray) -> np.ndarray:
    """Return the points of a piece by linear blend skinning in the pose that the file shows, shape ``(V, 3)``."""
    if piece.skin is None:
        return _moved(piece.points, world[piece.node])
    by_node = np.zeros((len(world), 4, 4))
    by_node[gltf.skins[piece.skin].joints] = transforms[piece.skin]
    blend = np.einsum("vk,vkij->vij", piece.weights, by_node[piece.nodes])
    return np.einsum("vij,vj->vi", blend[:, :3, :3], piece.points) + blend[:, :3, 3]


@dataclass
class _Reader:
    """Reads primitives once each, within the limits of this module."""

    gltf: Gltf
    notes: list[str] = field(default_factory=list)
    _arrays: dict[int, np.ndarray] = field(default_factory=dict)
    _textures: dict[tuple[int, float | None], Texture | None] = field(default_factory=dict)
    _images: dict[tuple[int, bool], np.ndarray | None] = field(default_factory=dict)

    def pieces(self) -> list[Piece]:
        """Return the triangles of all nodes that are shown."""
        found = []
        vertices = triangles = 0
        for index, node in enumerate(self.gltf.items("nodes")):
            if "mesh" not in node or not self.gltf.shown[index]:
                continue
            mesh = self.gltf.item("meshes", node["mesh"])
            name = self.gltf.names[index] or str(mesh.get("name", ""))
            for primitive in mesh.get("primitives", []):
                if primitive.get("mode", 4) in (4, 5, 6) and "POSITION" in primitive.get("attributes", {}):
                    corners = self.count(primitive["attributes"]["POSITION"])
                    vertices += corners
                    triangles += (self.count(primitive["indices"]) if "indices" in primitive else corners) // 3
                    found.append((index, node, name, primitive))
                if primitive.get("targets"):
                    self.notes.append("morph targets are left out")
                if vertices > MAX_VERTICES or triangles > MAX_TRIANGLES:
                    raise ValueError(f"it has over {MAX_VERTICES} vertices or {MAX_TRIANGLES} triangles; {_SIMPLIFY}")
        pieces = [self.piece(*primitive) for primitive in found]
        return [piece for piece in pieces if len(piece.faces)]

    def count(self, index: Any) -> int:
        """Return how many elements an accessor says that it has."""
        return whole(self.gltf.item("accessors", index).get("count"), f"count of accessor {index}", MAX_VALUES, low=1)

    def array(self, index: Any, width: int, what: str) -> np.ndarray:
        """Return an accessor of some width, read once."""
        if index not in self._arrays:
            self._arrays[index] = self.gltf.accessor(index)
        found = self._arrays[index]
        if found.shape[1] != width:
            raise ValueError(f"{what} has {found.shape[1]} numbers per vertex, it must have {width}")
        return found

    def piece(self, index: int, node: dict[str, Any], name: str, primitive: dict[str, Any]) -> Piece:
        """Return one primitive, with the vertices that its triangles have."""
        attributes = primitive["attributes"]
        what = f"mesh of node {index}"
        points = self.array(attributes["POSITION"], 3, f"POSITION of the {what}")
        faces = self.triangles(primitive, len(points), what)
        used, inverse = np.unique(faces, return_inverse=True)
        faces = inverse.reshape(-1, 3)
        skin = None
        nodes, weights = np.full((len(used), 1), index), np.ones((len(used), 1))
        if "skin" in node and "JOINTS_0" in attributes:
            skin = whole(node["skin"], f"skin of node {index}", len(self.gltf.skins) - 1)
            nodes, weights = self.skinning(attributes, skin, used, len(points), what)
        number = primitive.get("material")
        material = {} if number is None else self.gltf.item("materials", number)
        colors, textures = self.textured(material, attributes, used, faces, len(points), what)
        label = str(material.get("name", ""))[:200]
        painted = self.painted(attributes, used, len(points))
        points = points[used].astype(np.float64)
        return Piece(name, index, skin, label, points, faces, nodes, weights, colors, painted, textures)

    def painted(self, attributes: dict[str, Any], used: np.ndarray, count: int) -> dict[str, np.ndarray]:
        """Return scalar attributes of the file's author, of which the names begin with ``_``, with values in [0, 1]."""
        found = {}
        for name in [name for name in attributes if name.startswith("_")][:MOST_GROUPS]:
            try:
                scalar = self.gltf.item("accessors", attributes[name]).get("type") == "SCALAR"
                values = self.gltf.accessor(attributes[name]) if scalar else np.zeros((0, 1))
            except ValueError as error:
                self.notes.append(f"vertex attribute {name[:200]} is left out: {error}")
                continue
            if values.shape == (count, 1) and ((values >= 0.0) & (values <= 1.0)).all():
                found[name.lstrip("_").lower()] = values[used, 0].astype(np.float64)
        return found

    def triangles(self, primitive: dict[str, Any], count: int, what: str) -> np.ndarray:
        """Return the triangles of a primitive, of a list, a strip or a fan; shape ``(T, 3)`` int64."""
        if "indices" in primitive:
            corners = self.array(primitive["indices"], 1, f"indices of the {what}")[:, 0]
            if corners.dtype.kind not in "iu":
                raise ValueError(f"indices of the {what} are not whole numbers")
            corners = corners.astype(np.int64)
            if corners.min() < 0 or corners.max() >= count:
                raise ValueError(
                    f"indices of the {what} reach from {corners.min()} to {corners.max()} of {count} vertices"
                )
        else:
            corners = np.arange(count)
        if primitive.get("mode", 4) == 4:
            return corners[: len(corners) // 3 * 3].reshape(-1, 3)
        steps = np.arange(max(len(corners) - 2, 0))
        if primitive["mode"] == 5:
            odd = steps % 2
            return np.stack([corners[steps + odd], corners[steps + 1 - odd], corners[steps + 2]], axis=1)
        return np.stack([np.full(len(steps), corners[0]), corners[steps + 1], corners[steps + 2]], axis=1)

    def skinning(
        self, attributes: dict[str, Any], skin: int, used: np.ndarray, count: int, what: str
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return nodes and weights of the vertices, shapes ``(V, K)``; one without weight hangs on the skin's first."""
        joints = self.gltf.skins[skin].joints
        found = []
        for number in range(MAX_SETS):
            if f"JOINTS_{number}" not in attributes:
                break
            columns = [
                self.array(attributes.get(f"{key}_{number}"), 4, f"{key}_{number} of the {what}")
                for key in ("JOINTS", "WEIGHTS")
            ]
            if len(columns[0]) != count or len(columns[1]) != count:
                raise ValueError(f"skinning of the {what} has {len(columns[0])} rows for {count} vertices")
            found.append([column[used] for column in columns])
        which = np.concatenate([pair[0] for pair in found], axis=1).astype(np.int64)
        weights = np.maximum(np.concatenate([pair[1] for pair in found], axis=1).astype(np.float64), 0.0)
        which = np.where(weights > 0.0, which, 0)
        if which.max() >= len(joints):
            raise ValueError(f"JOINTS of the {what} name joint {which.max()} of {len(joints)}")
        total = weights.sum(axis=1)
        if (total < 1e-6).any():
            self.notes.append(f"{int((total < 1e-6).sum())} vertices of {what} have no weights: they follow the root")
            weights[total < 1e-6, 0] = 1.0
        return joints[which], weights / weights.sum(axis=1, keepdims=True)

    def textured(
        self, material: dict[str, Any], attributes: dict[str, Any], used: np.ndarray, faces: np.ndarray, count: int,
        what: str,
    ) -> tuple[np.ndarray, Textures | None]:  # fmt: skip
        """Return sRGB base colours of the vertices, ``(V, 3)`` uint8, and the textures that give them, if any."""
        base = material.get("pbrMetallicRoughness") or {}
        factor, texture = base.get("baseColorFactor"), base.get("baseColorTexture")
        older = (material.get("extensions") or {}).get("KHR_materials_pbrSpecularGlossiness")
        if older and factor is None and texture is None:
            factor, texture = older.get("diffuseFactor"), older.get("diffuseTexture")
        linear = np.ones((len(used), 3))
        if factor is not None:
            linear = linear * numbers(factor, 4, "base colour of a material")[:3]
        if "COLOR_0" in attributes:
            stored = self.gltf.accessor(attributes["COLOR_0"])
            if stored.shape[1] not in (3, 4) or len(stored) != count:
                raise ValueError(f"COLOR_0 of the {what} has shape {stored.shape} for {count} vertices")
            linear = linear * stored[used, :3]
        tints = np.round(255.0 * linear_to_srgb(linear)).astype(np.uint8)
        placed = None
        if texture is not None:
            opacity = 1.0 if factor is None else float(factor[3])
            placed = self.placed(texture, self.cutoff(material, opacity), attributes, used, count, what)
        if placed is None:
            return tints, None
        textures = Textures((placed[0],), np.zeros(len(faces), np.int32), placed[1].astype(np.float32), tints)
        return textures.colors(faces), textures

    def cutoff(self, material: dict[str, Any], opacity: float) -> float | None:
        """Return the opacity of a texture below which a material of an opacity has holes; None where it has none."""
        mode = material.get("alphaMode")
        if mode not in ("MASK", "BLEND"):
            return None
        given = material.get("alphaCutoff", 0.5) if mode == "MASK" else 0.5
        return float(numbers([given], 1, "alphaCutoff of a material")[0] / max(opacity, 1e-6))

    def placed(
        self, info: dict[str, Any], cutoff: float | None, attributes: dict[str, Any], used: np.ndarray, count: int,
        what: str,
    ) -> tuple[Texture, np.ndarray] | None:  # fmt: skip
        """Return a texture, and the places of the vertices in it, ``(V, 2)``; None where it cannot be read."""
        number = whole(info.get("index"), "index of a texture", len(self.gltf.items("textures")) - 1)
        if (number, cutoff) not in self._textures:
            self._textures[number, cutoff] = self.texture(number, cutoff)
        texture = self._textures[number, cutoff]
        moved = (info.get("extensions") or {}).get("KHR_texture_transform") or {}
        channel = f"TEXCOORD_{moved.get('texCoord', info.get('texCoord', 0))}"
        if texture is None or channel not in attributes:
            return None
        uv = self.array(attributes[channel], 2, f"{channel} of the {what}")
        if len(uv) != count:
            raise ValueError(f"{channel} of the {what} has {len(uv)} rows for {count} vertices")
        uv = uv[used] * numbers(moved.get("scale", (1, 1)), 2, "scale of a texture")
        turn = numbers([moved.get("rotation", 0)], 1, "rotation of a texture")[0]
        cos, sin = np.cos(turn), np.sin(turn)
        uv = uv @ np.array([[cos, -sin], [sin, cos]]) + numbers(moved.get("offset", (0, 0)), 2, "offset of a texture")
        return texture, np.clip(uv, -MAX_UV, MAX_UV)

    def texture(self, number: int, cutoff: float | None) -> Texture | None:
        """Return a texture, with holes below a cutoff; None, and a note, where it cannot be read."""
        entry = self.gltf.item("textures", number)
        source = ((entry.get("extensions") or {}).get("EXT_texture_webp") or entry).get("source")
        if source is None:
            self.notes.append(f"texture {number} is in a format that is not read: its surfaces have plain colours")
            return None
        sampler = entry.get("sampler")
        wraps = {} if sampler is None else self.gltf.item("samplers", sampler)
        pixels = self.image(source, number)
        across, down = (wraps.get(key, REPEAT) for key in ("wrapS", "wrapT"))
        known = (REPEAT, CLAMP, MIRROR)
        if pixels is None:
            return None
        inside = across if across in known else REPEAT, down if down in known else REPEAT
        if cutoff is None:
            return Texture(pixels, inside)
        return Texture(pixels, inside, self.image(source, number, alpha=True), cutoff)

    def image(self, source: int, number: int, alpha: bool = False) -> np.ndarray | None:
        """Return the pixels of the image of a texture, ``(H, W, 3)`` uint8, or its opacity, ``(H, W)``; read once.

        None where it has no opacity, and, with a note, where it cannot be read.
        """
        if (source, alpha) not in self._images:
            self._images[source, alpha] = self.read_image(source, number, decoded_alpha if alpha else decoded)
        return self._images[source, alpha]

    def read_image(self, source: int, number: int, read: Callable[[bytes], np.ndarray | None]) -> np.ndarray | None:
        """Return what ``read`` makes of the file of an image; None, and a note, where it is not read."""
        image = self.gltf.item("images", source)
        what = f"image {source}"
        try:
            if len({known for known, _ in self._images} | {source}) > MAX_IMAGES:
                raise ValueError(f"the file has more than {MAX_IMAGES} images of base colours")
            content = (
                self.gltf.resource(image["uri"], what)
                if "uri" in image
                else self.gltf.buffer_view(image["bufferView"], what)
            )
            return read(content)
        except ImportError:
            self.notes.append(f"textures are left out, for want of Pillow: {install_command('render')}")
        except UNREADABLE as error:
            self.notes.append(f"texture {number} is left out: {first_line(error)}")
        return None
