"""Garments of a world: the surfaces that cloth touches, and cloth within the control step.

A control step moves the bodies first, then the cloth along with them, and at last the particles receive what the cloth
has given to the surfaces. Nothing but the cloth itself is carried from one step to the next.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy import sparse

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.skin import Skin, motion_of, record_skin, skin_workspace
from piavatar_envs.cloth.obstacles import Piece
from piavatar_envs.cloth.proxy import ALL_PARTS, proxy_of
from piavatar_envs.cloth.remesh import remesh
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.types import State
from piavatar_envs.sim.bodies import Flesh
from piavatar_envs.sim.prop_surface import SolidSurface, deform_prop
from piavatar_envs.sim.props import PropSet
from piavatar_envs.sim.shapes import Shapes

wp.set_module_options({"enable_backward": False})

#: Most vertices of a prop's surface that cloth touches as it is drawn; of a finer one so many remain.
MOST_PROP_VERTICES = 800


def avatar_piece(index: int, flesh: Flesh, avatar: Avatar, shapes: Shapes, state: State) -> Piece:
    """Return the proxy skin of avatar ``index`` of a world, which its bones and particles deform."""
    device, n = avatar.model.device, avatar.model.num_envs
    proxy = proxy_of(flesh.asset)
    few, body = proxy.of(flesh.asset), flesh.asset.shape(flesh.base_parameters)
    points, _ = flesh.shaped(flesh.base_parameters)
    rest = type(body)(body.vertices[proxy.keep], body.joints)
    skin = Skin.baked(few, rest, points.rest[0], points.skin_joints, points.skin_weights)
    varies = flesh.shape.randomize
    surface = skin.upload(device, few if varies else None)
    motion = motion_of(avatar, state.x, shape=shapes.parameters(index) if varies else None)
    workspace, envs = skin_workspace(surface, n, device), _all(n, device)

    def record(graph: LaunchGraph, vertices: wp.array, first: int) -> None:
        record_skin(graph, envs, surface, motion, workspace, vertices, first)

    weights = _placed(skin.weights, avatar.body.first, avatar.model.num_particles)
    return Piece(rest.vertices, proxy.faces, proxy.part, weights, record)


def prop_piece(column: int, props: PropSet, state: State) -> Piece:
    """Return the surface of the prop in a ``column``, which its particles deform."""
    model, prop, points = props.model, props.props[column], props.points[column]
    vertices, faces = points.vertices, points.faces
    if len(vertices) > MOST_PROP_VERTICES:
        found = remesh(vertices, faces, MOST_PROP_VERTICES)
        vertices, faces = vertices[found.keep], found.faces
    solid = SolidSurface(points.rest, vertices, faces)
    surface, envs = solid.upload(model.device), _all(model.num_envs, model.device)

    def record(graph: LaunchGraph, into: wp.array, first: int) -> None:
        tracked = props.state.position, props.state.rotation
        inputs = [envs, surface, prop.first, column, *tracked, state.x, first]
        graph.launch(deform_prop, (model.num_envs, len(vertices)), inputs, [into])

    weights = _placed(solid.weights(), prop.first, model.num_particles)
    return Piece(vertices, faces, np.full(len(vertices), ALL_PARTS), weights, record)


def _placed(weights: sparse.csr_array, first: int, num_particles: int) -> sparse.csr_array:
    """Return weights of a body's particles as weights of all, of which its own begin at ``first``."""
    parts = (weights.data, weights.indices + first, weights.indptr)
    return sparse.csr_array(parts, shape=(weights.shape[0], num_particles))


def _all(num_envs: int, device: str) -> wp.array:
    return wp.array(np.arange(num_envs, dtype=np.int32), dtype=int, device=device)
