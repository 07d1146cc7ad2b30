"""Garments made to measure: cut for a shape of a body, draped on it until at rest, and bound to its bones.

The drape is a simulation of the cloth alone on the proxy of the skin at rest, on the CPU, which ends where no vertex
moves faster than :data:`AT_REST`. Its result is kept in a file, as all of it depends on the body, the kind with its
settings and the fabric only. For random shapes the positions of the drape change by linear fields, one for each half of
each shape parameter, as the skin's do: the difference of the garment fitted to that shape and to the mean one.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from scipy import sparse

from piavatar_envs.avatar.body import sampling
from piavatar_envs.avatar.body.asset import AvatarAsset, dense_weights, top_weights, vertex_normals
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.cloth import bodice, contact, kernels, panels, pattern, remesh, sheet, solver
from piavatar_envs.cloth import mesh as meshing
from piavatar_envs.cloth import wearer as wearers
from piavatar_envs.cloth.cut import Cut
from piavatar_envs.cloth.fabric import MOST_CLOTH_SUBSTEPS, Fabric
from piavatar_envs.cloth.garment import Garment, Held
from piavatar_envs.cloth.garments import cut_garment, cutter
from piavatar_envs.cloth.mesh import ClothMesh
from piavatar_envs.cloth.obstacles import Obstacles, Piece, allocate
from piavatar_envs.cloth.proxy import Proxy, curved, proxy_of
from piavatar_envs.cloth.solver import Cloth, fastest_bending, fewest_substeps
from piavatar_envs.cloth.types import ClothSettings
from piavatar_envs.cloth.wearer import Wearer
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.result_cache import digest_of, kept

#: Distance between garments that lie over each other, which do not touch [m].
LAYER = 0.004
#: Greatest speed of a vertex of a draped garment [m/s].
AT_REST = 0.002
#: Control step of the drape and its longest time [s], share of the velocity that is lost in a substep, and number of
#: steps in a row in which all of it must be slow.
_STEP, _LONGEST, _DAMPING, _SLOW = 1.0 / 30.0, 12.0, 0.015, 10
#: Passes over a garment in which weights of bones and changes of shape are smoothed.
_BINDING = 12
#: Modules whose code a made garment depends on.
_CODE = (bodice, contact, kernels, meshing, panels, pattern, remesh, sampling, sheet, solver, wearers)


def make_garment(
    kind: str,
    settings: Mapping[str, Any],
    fabric: Fabric,
    asset: AvatarAsset,
    parameters: Sequence[float] | np.ndarray,
    piece: int = 0,
    grading: bool = False,
    layer: int = 0,
) -> Garment:
    """Return a garment of a kind, draped on a shape of a body in its rest pose.

    Args:
        kind: in the registry of :mod:`piavatar_envs.cloth.garments`.
        settings: of the kind.
        fabric: its cloth.
        asset: the body.
        parameters: of its shape, ``(S,)``; with grading, those around which shapes are drawn.
        piece: of the obstacles that wears it.
        grading: whether to find the changes of its positions with the shape.
        layer: number of garments beneath it, over which it lies.

    Raises:
        ValueError: the settings are refused, or the garment does not fit the body.
    """
    parameters = np.asarray(parameters, np.float64)

    def compute() -> dict[str, np.ndarray]:
        return _made(kind, settings, fabric, asset, parameters, grading, layer)

    source = sys.modules.get(cutter(kind).__module__)
    if getattr(source, "__file__", None) is None:  # code without a file has no digest
        arrays = compute()
    else:
        worn = [[name, own] for name, own in asset.worn.items()]
        body = [asset.vertices, asset.faces, asset.skin_joints, asset.skin_weights, asset.shape_deltas, worn]
        given = [kind, *(_content(item) for item in sorted(settings.items()))]
        digest = digest_of([body, given, fabric, parameters, grading, layer], [*_CODE, sys.modules[__name__], source])
        arrays = kept("garment", digest, compute, f"draping {kind} on {asset.name}")
    names = [field.name for field in fields(ClothMesh) if field.name != "num_vertices"]
    return Garment(
        kind=kind,
        wearer=piece,
        mesh=ClothMesh(len(arrays["draped"]), **{name: arrays[name] for name in names}),
        draped=arrays["draped"],
        held=Held(*(arrays[name] for name in ("held", "held_face", "held_weights", "held_offset"))),
        sees=arrays["sees"],
        thickness=float(arrays["thickness"]),
        fabric=fabric,
        skin_joints=arrays["skin_joints"],
        skin_weights=arrays["skin_weights"],
        shape_deltas=arrays["shape_deltas"] if grading else None,
        colors=arrays["colors"] if len(arrays["colors"]) else None,
        source=arrays["source"] if len(arrays["source"]) else None,
        replaces=str(arrays["replaces"]),
    )


def _content(item: tuple[str, Any]) -> list[Any]:
    """Return a setting with the content of the file that it names, if it does."""
    name, value = item
    is_file = isinstance(value, str) and Path(value).is_file()
    return [name, list(value) if isinstance(value, tuple) else value, Path(value).read_bytes().hex() if is_file else ""]


def _made(
    kind: str,
    settings: Mapping[str, Any],
    fabric: Fabric,
    asset: AvatarAsset,
    parameters: np.ndarray,
    grading: bool,
    layer: int,
) -> dict[str, np.ndarray]:
    """Return the arrays of a garment."""
    wearer = Wearer.of(asset, parameters)
    cut = cut_garment(kind, wearer, settings)
    cut = replace(cut, thickness=cut.thickness + layer * LAYER)
    mesh, proxy = ClothMesh.build(cut.faces, cut.measure), proxy_of(asset)
    held = held_by(wearer, proxy, cut)
    start = wearer.outside(cut.positions, cut.thickness)
    sees = np.asarray(cut.sees, np.int32)
    garment = Garment(kind, 0, mesh, start, held, sees, cut.thickness, fabric)
    draped = drape(garment, wearer, proxy)
    joints, weights = _bound(wearer, cut.faces, draped)
    deltas = _graded(asset, cut, draped, wearer) if grading else np.zeros((0, *draped.shape))
    return {
        "draped": draped,
        "held": held.vertices,
        "held_face": held.face,
        "held_weights": held.weights,
        "held_offset": held.offset,
        "sees": sees,
        "thickness": np.array(cut.thickness),
        "skin_joints": joints,
        "skin_weights": weights,
        "shape_deltas": deltas.astype(np.float32),
        "colors": np.zeros((0, 3), np.uint8) if cut.colors is None else cut.colors,
        "source": np.zeros((0, 3)) if cut.source is None or not cut.replaces else cut.source,
        "replaces": np.array(cut.replaces),
        **{field.name: np.asarray(getattr(mesh, field.name)) for field in fields(mesh)},
    }


def held_by(wearer: Wearer, proxy: Proxy, cut: Cut) -> Held:
    """Return the places of the proxy's curved patches that hold the vertices of a cut."""
    if not len(cut.held):
        return Held.none()
    points, normals = _proxy_skin(wearer, proxy)
    goal = wearer.outside(cut.positions[cut.held], cut.thickness)
    _, face, weights = ClosedSurface(points, proxy.faces).query(goal)
    at, upright = curved(points, normals, proxy.faces[face], weights.astype(np.float64))
    offset = np.einsum("hd,hd->h", goal - at, upright)
    return Held(np.asarray(cut.held, np.int32), face.astype(np.int32), weights, offset)


def drape(garment: Garment, wearer: Wearer, proxy: Proxy, longest: float = _LONGEST) -> np.ndarray:
    """Return the positions of a garment at rest on a wearer that stands still [m], shape ``(V, 3)``.

    Args:
        garment: with its positions at the start.
        wearer: the body.
        proxy: of its skin.
        longest: time after which it ends in any case [s].

    Raises:
        ValueError: the cloth does not stay finite, or bends too stiffly for any number of substeps that may be set.
    """
    settings = ClothSettings(damping=_DAMPING)
    needed = fewest_substeps(fastest_bending(garment), _STEP)
    if needed > MOST_CLOTH_SUBSTEPS:
        raise ValueError(
            f"bending={garment.fabric.bending:g} N m of the {garment.kind} needs {needed} substeps of cloth at "
            f"{garment.fabric.areal_density:g} kg/m^2 and edges of {1e3 * garment.mesh.length.mean():.0f} mm; at most "
            f"{MOST_CLOTH_SUBSTEPS} can be set: use less `bending` or a longer `edge`"
        )
    settings = replace(settings, substeps=max(settings.substeps, needed))
    cloth = Cloth([garment], still(wearer, proxy), None, settings, num_envs=1, control_dt=_STEP, device="cpu")
    failure, graph = wp.zeros(1, dtype=int, device="cpu"), LaunchGraph("cpu")
    cloth.record_step(graph, failure)
    slow, again = 0, True
    for _ in range(round(longest / _STEP)):
        graph.run()
        if failure.numpy()[0]:
            raise ValueError(f"the {garment.kind} tears in the drape; change its settings, or length of edges")
        slow = slow + 1 if np.linalg.norm(cloth.state.v.numpy()[0], axis=1).max() < AT_REST else 0
        if slow == _SLOW and not again:
            break
        if slow == _SLOW:  # as after a reset: without the places of the skin that were nearest before
            cloth.state.near.fill_(-1)
            slow, again = 0, False
    return cloth.state.x.numpy()[0].astype(np.float64)


def still(wearer: Wearer, proxy: Proxy) -> Obstacles:
    """Return the proxy of a wearer's skin as an obstacle that does not move, on the CPU."""
    points, normals = _proxy_skin(wearer, proxy)
    empty = sparse.csr_array((len(points), 0))
    obstacles = allocate([Piece(points, proxy.faces, proxy.part, empty, lambda *_: None)], 1, "cpu")
    for name, values in {"start": points, "start_normal": normals}.items():
        getattr(obstacles, name).assign(values[None].astype(np.float32))
        getattr(obstacles, name.replace("start", "end")).assign(values[None].astype(np.float32))
    return obstacles


def _proxy_skin(wearer: Wearer, proxy: Proxy) -> tuple[np.ndarray, np.ndarray]:
    """Return points [m] and normals of the proxy, each shape ``(N, 3)``."""
    points = wearer.vertices[proxy.keep]
    return points, vertex_normals(points, proxy.faces)


def _bound(wearer: Wearer, faces: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bones and weights of a garment's vertices: those of the nearest skin, smoothed over the cloth."""
    dense = dense_weights(wearer.asset.skin_joints, wearer.asset.skin_weights)
    return top_weights(_smoothed(faces, _nearest(wearer, positions) @ dense))


def _nearest(wearer: Wearer, positions: np.ndarray) -> sparse.csr_array:
    """Return the shares of the skin's vertices in the nearest places to points, shape ``(N, V)``."""
    face, weights = wearer.anchors(positions)
    corners, rows = wearer.faces[face], np.repeat(np.arange(len(positions)), 3)
    shape = len(positions), len(wearer.vertices)
    return sparse.csr_array((weights.ravel(), (rows, corners.ravel())), shape=shape)


def _smoothed(faces: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values of vertices, each averaged with its neighbors in several passes, shape ``(V, K)``."""
    links = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    near = sparse.coo_array((np.ones(len(links)), links.T), shape=(len(values),) * 2).tocsr()
    near = ((near + near.T) > 0).astype(np.float64)
    mean = sparse.diags_array(1.0 / np.maximum(near.sum(axis=1), 1.0)) @ near
    for _ in range(_BINDING):
        values = 0.5 * values + 0.5 * (mean @ values)
    return values


def _graded(asset: AvatarAsset, cut: Cut, draped: np.ndarray, wearer: Wearer) -> np.ndarray:
    """Return changes of positions at -1 and +1 of each shape parameter [m], shape ``(2 S, V, 3)``."""
    count = len(asset.shape_names)
    nearest = _nearest(wearer, draped)

    def fitted(parameters: np.ndarray) -> np.ndarray:
        other = Wearer.of(asset, parameters)
        if cut.fit is not None:
            return cut.fit(other)
        return draped + _smoothed(cut.faces, nearest @ (other.vertices - wearer.vertices))

    mean = fitted(np.zeros(count))
    ends = [np.eye(count)[parameter] * (-1.0, 1.0)[half] for parameter, half in np.ndindex(count, 2)]
    # points that each take their nearest way out of the skin jump from one shape to another beside their neighbors
    changes = [_smoothed(cut.faces, fitted(end) - mean) for end in ends]
    return np.stack(changes) if count else np.zeros((0, *draped.shape))
