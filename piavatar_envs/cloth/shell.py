"""Cloth as a thin shell in the material point method (MPM).

Vertices and triangles of a garment are two kinds of particles of the world's MPM state (Jiang, Gast & Teran,
"Anisotropic elastoplasticity for cloth, knit and hair frictional contact", 2017; Guo et al., "A material point method
for thin shells with frictional contact", 2018). All of them move with the grid, so that cloth touches bodies, props,
colliders and itself there. A triangle lies at the middle of its corners, and carries the director
(:mod:`piavatar_envs.cloth.shell_energy`), which the grid's velocity gradient turns and presses. Three quarters of the
mass belong to the vertices. Before each substep, from the state that the last one left::

    places      vertices from their particles; held ones x_h = sum_p W_hp x_p of the wearer's particles p
    elements    d <- F d with F = I + dt grad v, then its return mapping; stress (P1, P2, P3)
                C <- C - 4 dt / dx^2 (A / m) P3 d^T      (the stress force of MLS-MPM, Hu et al. 2018, eq. 16)
                forces of P1 and P2 on the corners, which the mesh strains: in-plane strain never drifts
    vertices    u <- u + dt (f_membrane + f_bending + f_air) / m
    wearers     u_p <- u_p + dt sum_h W_hp f_h / m_p     (keeps angular momentum as well, for sum_p W_hp x_p = x_h)

So forces enter through velocities and gradients that P2G reads anyway, and F of these particles is reset to the
identity, where their material has no stress of its own; its modulus is that of the membrane's waves, which limit the
substep. Sums are gathers in a fixed order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from scipy import sparse

from piavatar_envs.cloth.garment import Garment
from piavatar_envs.cloth.kernels import Constants, Pattern, air_acceleration, bending_force
from piavatar_envs.cloth.shell_energy import frame_of, map_director, stress_of, wave_speed
from piavatar_envs.cloth.solver import Textile
from piavatar_envs.cloth.types import ClothSettings, ClothState, Fabrics
from piavatar_envs.core.arrays import matrix_at, store_matrix
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill, make_struct
from piavatar_envs.mpm.bspline import base_node, grid_position, in_same_subblock, stencil_inside
from piavatar_envs.mpm.g2p import I3
from piavatar_envs.mpm.materials import material_index
from piavatar_envs.mpm.model import MaterialPoints
from piavatar_envs.mpm.sparse_grid import activate_stencil
from piavatar_envs.mpm.types import Blocks, Grid, Model, Moving, Particles, Scratch, State, row

wp.set_module_options({"enable_backward": False})

#: Share of a triangle's mass that its own particle carries; as much belongs to each corner.
SHARE = 0.25
#: Thickness of a sheet in contact [grid spacings].
LAYER = 0.5
#: Longest mean edge of a garment [grid spacings], beyond which nodes between its particles have no mass.
LONGEST_EDGE = 2.0


@dataclass(frozen=True, eq=False)
class ShellMatter:
    """Garments as ``P`` particles: of each garment its free vertices, then its triangles.

    Attributes:
        vertex: particle of each of ``V`` vertices, counted from the first, -1 for held ones, shape ``(V,)``.
        triangle: particle of each of ``T`` triangles, likewise, shape ``(T,)``.
        garment: of each particle, shape ``(P,)``.
        mass: of each particle [kg], shape ``(P,)``.
        wave: speed of the waves of its fabric [m/s], shape ``(P,)``.
        rest: draped positions [m], shape ``(P, 3)``.
        areal_density: of each garment [kg/m^2], shape ``(G,)``.
    """

    vertex: np.ndarray
    triangle: np.ndarray
    garment: np.ndarray
    mass: np.ndarray
    wave: np.ndarray
    rest: np.ndarray
    areal_density: np.ndarray

    @classmethod
    def of(cls, garments: Sequence[Garment], stiffness_factor: float = 1.0) -> ShellMatter:
        """Return the particles of some garments, whose stiffness may grow by a factor."""
        vertex, triangle, owner, masses, waves, places, count = [], [], [], [], [], [], 0
        for index, garment in enumerate(garments):
            mesh, fabric = garment.mesh, garment.fabric
            free = np.setdiff1d(np.arange(mesh.num_vertices), garment.held.vertices)
            own = np.full(mesh.num_vertices, -1)
            own[free] = count + np.arange(len(free))
            vertex.append(own)
            triangle.append(count + len(free) + np.arange(len(mesh.faces)))
            area = np.concatenate([(1.0 - SHARE) * mesh.area[free], SHARE * mesh.face_area])
            masses.append(fabric.areal_density * area)
            waves.append(np.full(len(area), wave_speed(fabric.areal_density, stiffness_factor * fabric.stretch)))
            owner.append(np.full(len(area), index))
            places += [garment.draped[free], garment.draped[mesh.faces].mean(axis=1)]
            count += len(area)
        areal = np.array([garment.fabric.areal_density for garment in garments])
        return cls(*map(np.concatenate, (vertex, triangle, owner, masses, waves, places)), areal)

    def density(self, dx: float) -> np.ndarray:
        """Return the reference densities of the garments' velocity fields, shape ``(G,)`` [kg/m^3].

        A sheet counts as a layer of half a grid spacing ``dx`` [m]: contact locates the surface of a field
        by the space that it fills, and would stop thinner layers twice as far from a body.
        """
        return self.areal_density / (LAYER * dx)

    def points(self, dx: float) -> MaterialPoints:
        """Return the matter of the particles, of densities as :meth:`density`.

        Without deformation it has no stress, and its waves are those of the fabric.
        """
        density = self.density(dx)[self.garment][None]
        one = np.ones_like(density)
        material = np.full(one.shape, material_index("neo_hookean"), np.int32)
        return MaterialPoints(self.mass / density, density, density * self.wave**2, 0.0 * one, material, 0.0 * one)


@dataclass(frozen=True, eq=False)
class Holds:
    """Places of the ``H`` held vertices: ``place + weights @ x`` with the positions of all particles.

    Attributes:
        place: what does not move with particles [m], shape ``(H, 3)``.
        weights: shape ``(H, num_particles)``.
    """

    place: np.ndarray
    weights: sparse.csr_array

    @classmethod
    def fixed(cls, places: np.ndarray, num_particles: int) -> Holds:
        """Return vertices that are held in space at ``places`` [m], shape ``(H, 3)``."""
        return cls(places, sparse.csr_array((len(places), num_particles)))


def hold_weights(places: np.ndarray, particles: np.ndarray, count: int = 24) -> np.ndarray:
    """Return weights of the nearest particles that give places, and that any affine motion carries along.

    Of all such weights those with the least sum of ``w^2 / falloff``: moving least squares with a linear basis.

    Args:
        places: shape ``(H, 3)`` [m].
        particles: shape ``(P, 3)`` [m].
        count: particles of a place.

    Returns:
        Shape ``(H, P)``, dense.
    """
    weights = np.zeros((len(places), len(particles)))
    for h, place in enumerate(places):
        arm = particles - place
        distance = np.linalg.norm(arm, axis=1)
        near = np.argsort(distance, kind="stable")[: min(count, len(particles))]
        reach = distance[near].max()
        falloff = np.maximum(1.0 - (distance[near] / (1.2 * reach)) ** 2, 1e-3)
        basis = np.c_[np.ones(len(near)), arm[near] / reach]
        weights[h, near] = falloff * (basis @ np.linalg.pinv(basis.T * falloff @ basis)[0])
    return weights


@wp.struct
class ShellPattern:
    """Constants of the shell besides :class:`~piavatar_envs.cloth.kernels.Pattern`; ``U`` particles hold vertices."""

    particle: wp.array(dtype=int)  # (V,) of a vertex, -1 for held ones
    faces: wp.array(dtype=wp.vec3i)  # (T,)
    sides: wp.array(dtype=wp.vec3i)  # (T,) edges of corners 01, 12 and 20
    element: wp.array(dtype=int)  # (T,) particle of a triangle
    corner: wp.array(dtype=int)  # rows of corner forces of a vertex, from ``fan_start`` on
    place: wp.array(dtype=wp.vec3)  # (H,) of held vertices [m]
    hold_start: wp.array(dtype=int)  # (H + 1,)
    hold_particle: wp.array(dtype=int)
    hold_weight: wp.array(dtype=float)
    holder: wp.array(dtype=int)  # (U,) particles
    holder_start: wp.array(dtype=int)  # (U + 1,)
    holder_held: wp.array(dtype=int)
    holder_weight: wp.array(dtype=float)


class Shell(Textile):
    """All garments of a world as particles of its MPM state; see :class:`~piavatar_envs.cloth.solver.Textile`.

    Attributes:
        matter: its particles.
        director: of the triangles, shape ``(num_envs, T)``; a unit normal where nothing presses on the cloth.
    """

    def __init__(
        self,
        garments: Sequence[Garment],
        matter: ShellMatter,
        holds: Holds,
        model: Model,
        state: State,
        scratch: Scratch,
        first_particle: int,
        settings: ClothSettings | None = None,
        rows: int = 1,
    ) -> None:
        """Upload the garments; :meth:`record_reset` places them.

        Args:
            garments: at least one.
            matter: of these garments.
            holds: of their held vertices, in the order of the garments.
            model: of the world, with this matter from ``first_particle`` on.
            state: likewise.
            scratch: likewise.
            first_particle: of the cloth.
            settings: of cloth, of which only the wind has an effect; no wind if None.
            rows: 1 for the same lengths and fabrics in all environments, else ``num_envs``.

        Raises:
            ValueError: edges are too long for the grid, or the cloth would collide with itself twice.
        """
        if settings is not None and settings.self_collision:
            raise ValueError("self_collision=True of cloth in MPM: its layers touch on the grid anyway; leave it out")
        check_edges(garments, model.grid.dx)
        faces = np.zeros(1 + max(0, *(garment.wearer for garment in garments)) + 1, int)
        super().__init__(garments, settings, model.num_envs, model.control_dt, model.device, rows, faces)
        self.matter, self._model, self._state, self._scratch = matter, model, state, scratch
        mesh, n = self.mesh, model.num_envs
        self._shell = self._upload_shell(matter, holds, first_particle)
        self.director = wp.zeros((n, len(mesh.faces)), dtype=wp.vec3, device=model.device)
        self._corner_force = wp.zeros((n, 3 * len(mesh.faces)), dtype=wp.vec3, device=model.device)
        self._held_force = wp.zeros((n, len(self._shell.place)), dtype=wp.vec3, device=model.device)
        self._constants = fill(
            Constants(),
            replace(self.settings, forces_every=1),
            dt=model.step.dt,
            gravity=model.step.gravity,
            wind=wp.vec3(*map(float, self.settings.wind)),
            keep=1.0,
        )

    def record_reset(self, graph: LaunchGraph, mask: wp.array) -> None:
        """Append: in the masked environments, put the particles at rest where ``state.x`` has the vertices."""
        inputs = [mask, self._shell, self.state.x]
        moving = self._moving
        graph.launch(place_vertices, self.state.x.shape, inputs, [moving])
        graph.launch(place_elements, self.director.shape, inputs, [moving, self.director])

    def record_before_substep(self, graph: LaunchGraph) -> None:
        """Append the forces of the cloth, which act on velocities before a substep's P2G."""
        m, moving, blocks, shell = self._model, self._moving, self._scratch.blocks, self._shell
        self.record_places(graph)
        graph.launch(
            strain_elements,
            self.director.shape,
            [m.grid, m.step.dt, m.particles, self._pattern, shell, self.fabric, self.state.x],
            [self.director, moving, self._corner_force, blocks, self._state.failure],
        )
        graph.launch(
            push_vertices,
            self.state.x.shape,
            [m.particles, self._pattern, shell, self._constants, self.fabric, self.state, self._corner_force, blocks],
            [moving, self._held_force],
        )
        if len(shell.holder):
            inputs = [m.particles, shell, m.step.dt, self._held_force, blocks]
            graph.launch(push_holders, (self.num_envs, len(shell.holder)), inputs, [moving])

    def record_places(self, graph: LaunchGraph) -> None:
        """Append: read positions and velocities of the vertices from the particles."""
        graph.launch(
            read_vertices, self.state.x.shape, [self._pattern, self._shell, self._moving, self._state.failure],
            [self.state],
        )  # fmt: skip

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays that a checkpoint stores besides the particles, by name."""
        return {"x": self.state.x, "v": self.state.v, "director": self.director}

    @property
    def _moving(self) -> Moving:
        s = self._state
        return make_struct(Moving, x=s.x, u=s.u, C=s.C, F=s.F, vk=s.vk, spin=s.spin)

    def _upload_shell(self, matter: ShellMatter, holds: Holds, first: int) -> ShellPattern:
        mesh = self.mesh
        order = np.argsort(mesh.faces.T.ravel(), kind="stable")  # as the fans of the pattern
        shift, face = np.divmod(order, len(mesh.faces))
        weights = sparse.csr_array(holds.weights)
        back = sparse.csr_array(weights.T)
        back.sort_indices()
        holder = np.flatnonzero(np.diff(back.indptr))
        integers = {
            "particle": np.where(matter.vertex < 0, -1, first + matter.vertex),
            "element": first + matter.triangle,
            "corner": 3 * face + shift,
            "hold_start": weights.indptr,
            "hold_particle": weights.indices,
            "holder": holder,
            "holder_start": np.append(back.indptr[holder], back.nnz),
            "holder_held": back.indices,
        }
        triples = {"faces": mesh.faces, "sides": mesh.sides}
        return fill(
            ShellPattern(),
            place=self._vectors(holds.place),
            hold_weight=self._floats(weights.data),
            holder_weight=self._floats(back.data),
            **{name: self._integers(values) for name, values in integers.items()},
            **{
                name: wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.vec3i, device=self.device)
                for name, values in triples.items()
            },
        )


def check_edges(garments: Sequence[Garment], dx: float) -> None:
    """Check that no garment's edges are too long for a grid spacing ``dx`` [m].

    Raises:
        ValueError: edges are too long.
    """
    for garment in garments:
        mean = float(garment.mesh.length.mean())
        if mean > LONGEST_EDGE * dx:
            raise ValueError(
                f"edges of a {garment.kind} are {1e3 * mean:.0f} mm long, and cloth in MPM would have holes from "
                f"{LONGEST_EDGE:g} grid spacings, {1e3 * LONGEST_EDGE * dx:.0f} mm, on; give the garment a smaller "
                f"`edge`, or use a coarser fidelity or solver='xpbd'"
            )


@wp.func
def rest_particle(moving: Moving, e: int, p: int, x: wp.vec3):
    """Put a particle at ``x``, at rest and undeformed."""
    moving.x[e, p] = x
    moving.u[e, p] = wp.vec3(0.0)
    moving.vk[e, p] = wp.vec3(0.0)
    moving.spin[e, p] = wp.vec3(0.0)
    store_matrix(moving.C, e, p, wp.mat33())
    store_matrix(moving.F, e, p, I3)


@wp.kernel
def place_vertices(
    mask: wp.array(dtype=wp.bool),
    shell: ShellPattern,
    x: wp.array2d(dtype=wp.vec3),
    # out
    moving: Moving,
):
    """Put the particles of vertices at rest in the masked environments; over ``(num_envs, V)``."""
    e, i = wp.tid()
    p = shell.particle[i]
    if mask[e] and p >= 0:
        rest_particle(moving, e, p, x[e, i])


@wp.kernel
def place_elements(
    mask: wp.array(dtype=wp.bool),
    shell: ShellPattern,
    x: wp.array2d(dtype=wp.vec3),
    # out
    moving: Moving,
    director: wp.array2d(dtype=wp.vec3),
):
    """Put the particles of triangles at rest, and directors along normals; over ``(num_envs, T)``."""
    e, t = wp.tid()
    if mask[e]:
        f = shell.faces[t]
        a = x[e, f[0]]
        b = x[e, f[1]]
        c = x[e, f[2]]
        rest_particle(moving, e, shell.element[t], (a + b + c) / 3.0)
        director[e, t] = wp.normalize(wp.cross(b - a, c - a))


@wp.kernel
def read_vertices(
    p: Pattern,
    shell: ShellPattern,
    moving: Moving,
    failure: wp.array(dtype=int),
    # out
    s: ClothState,
):
    """Read positions and velocities of the vertices; held ones are where the wearer's particles have them."""
    e, i = wp.tid()
    if failure[e] != 0:
        return
    own = shell.particle[i]
    if own >= 0:
        s.x[e, i] = moving.x[e, own]
        s.v[e, i] = moving.u[e, own] + moving.vk[e, own]
    else:
        h = p.held[i]
        x = shell.place[h]
        v = wp.vec3()
        for k in range(shell.hold_start[h], shell.hold_start[h + 1]):
            q = shell.hold_particle[k]
            w = shell.hold_weight[k]
            x += w * moving.x[e, q]
            v += w * (moving.u[e, q] + moving.vk[e, q])
        s.x[e, i] = x
        s.v[e, i] = v


@wp.kernel
def strain_elements(
    grid: Grid,
    dt: float,
    particles: Particles,
    p: Pattern,
    shell: ShellPattern,
    fabric: Fabrics,
    x: wp.array2d(dtype=wp.vec3),
    # in and out
    director: wp.array2d(dtype=wp.vec3),
    moving: Moving,
    # out
    corner_force: wp.array2d(dtype=wp.vec3),
    blocks: Blocks,
    failure: wp.array(dtype=int),
):
    """Move triangles to the middle of their corners, and find their stress; over ``(num_envs, T)``."""
    e, t = wp.tid()
    if blocks.frozen[e] != 0:
        return
    f = shell.faces[t]
    own = shell.element[t]
    o = x[e, f[0]]
    a = x[e, f[1]] - o
    b = x[e, f[2]] - o
    # the triangle at rest has corners (0, 0), (base, 0) and (foot, height)
    lengths = row(e, p.length.shape[0])
    side = shell.sides[t]
    base = p.length[lengths, side[0]]
    l12 = p.length[lengths, side[1]]
    l20 = p.length[lengths, side[2]]
    foot = 0.5 * (base * base + l20 * l20 - l12 * l12) / base
    height = wp.sqrt(wp.max(l20 * l20 - foot * foot, 1.0e-4 * base * base))
    area = 0.5 * base * height
    g = p.garment[f[0]]
    stretch = fabric.stretch[row(e, fabric.stretch.shape[0]), g]
    friction = fabric.friction[row(e, fabric.friction.shape[0]), g]
    s = frame_of(a / base, (b - (foot / base) * a) / height)
    r = map_director(s, matrix_at(moving.F, e, own) * director[e, t], friction)
    d = r[0] * s.q1 + r[1] * s.q2 + r[2] * s.q3
    director[e, t] = d
    stress = stress_of(s, r, stretch)
    at_first = area * (stress.p1 - (foot / height) * stress.p2) / base
    at_second = (area / height) * stress.p2
    corner_force[e, 3 * t] = at_first + at_second
    corner_force[e, 3 * t + 1] = -at_first
    corner_force[e, 3 * t + 2] = -at_second
    mass = particles.mass[row(e, particles.mass.shape[0]), own]
    change = (4.0 * dt * grid.inv_dx * grid.inv_dx * area / mass) * wp.outer(stress.p3, d)
    store_matrix(moving.C, e, own, matrix_at(moving.C, e, own) - change)
    store_matrix(moving.F, e, own, I3)
    middle = o + (a + b) / 3.0
    to = base_node(grid_position(grid, middle))
    if stencil_inside(grid, to):
        if not in_same_subblock(to, base_node(grid_position(grid, moving.x[e, own]))):
            activate_stencil(grid, blocks, to, particles.field[own], e, failure)
        moving.x[e, own] = middle


@wp.kernel
def push_vertices(
    particles: Particles,
    p: Pattern,
    shell: ShellPattern,
    c: Constants,
    fabric: Fabrics,
    s: ClothState,
    corner_force: wp.array2d(dtype=wp.vec3),
    blocks: Blocks,
    # out
    moving: Moving,
    held_force: wp.array2d(dtype=wp.vec3),
):
    """Accelerate the vertices by membrane, bending and air; held ones pass the force on; over ``(num_envs, V)``."""
    e, i = wp.tid()
    if blocks.frozen[e] != 0:
        return
    g = p.garment[i]
    r = row(e, fabric.bending.shape[0])
    force = fabric.bending[r, g] * bending_force(p, e, i, 0.0, s)
    for k in range(p.fan_start[i], p.fan_start[i + 1]):
        force += corner_force[e, shell.corner[k]]
    own = shell.particle[i]
    if own < 0:
        held_force[e, p.held[i]] = force
        return
    v = s.v[e, i]
    air = air_acceleration(p, c, fabric, r, e, i, s.x[e, i], v, s.x)
    force += fabric.areal_density[r, g] * p.area[i] * air
    mass = particles.mass[row(e, particles.mass.shape[0]), own]
    moving.u[e, own] = moving.u[e, own] + (c.dt / mass) * force
    store_matrix(moving.F, e, own, I3)


@wp.kernel
def push_holders(
    particles: Particles,
    shell: ShellPattern,
    dt: float,
    held_force: wp.array2d(dtype=wp.vec3),
    blocks: Blocks,
    # out
    moving: Moving,
):
    """Accelerate the particles that hold vertices by the forces on these; over ``(num_envs, U)``."""
    e, n = wp.tid()
    if blocks.frozen[e] != 0:
        return
    force = wp.vec3()
    for k in range(shell.holder_start[n], shell.holder_start[n + 1]):
        force += shell.holder_weight[k] * held_force[e, shell.holder_held[k]]
    own = shell.holder[n]
    mass = particles.mass[row(e, particles.mass.shape[0]), own]
    moving.u[e, own] = moving.u[e, own] + (dt / mass) * force
