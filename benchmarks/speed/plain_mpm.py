"""A plain Material Point Method beside this suite: what a user would otherwise write, at the same particle counts.

``python -m benchmarks.speed.plain_mpm --device cuda --out benchmarks/results/plain_mpm.json``. MLS-MPM as in Hu et al.,
"A Moving Least Squares Material Point Method with Displacement Discontinuity and Two-Way Rigid Body Coupling" (2018): a
dense grid, quadratic B-splines, atomic additions, one velocity field, fixed-corotated stress, a floor that stops what
moves into it; no skeleton, no contact between bodies, no control. Particles fill boxes at the density of the suite's
bodies, eight in a cell of 1 cm. It is written twice, for Taichi and for Warp; ``backend`` says which one ran (Taichi
where it can be imported). On a GPU Warp's launches are captured in one graph, and Taichi's are not.

Rows ``suite`` are this suite at its closest public sizes (:mod:`benchmarks.speed.steps`): ``fidelity="fine"``, a grid
spacing of 1 cm too, with contact, floor, sensors and the pose controller in every substep, one avatar and four.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from benchmarks import runner
from benchmarks.speed import steps, timing

wp.set_module_options({"enable_backward": False})

#: Particles of the rows: a body's skin, four of them, a body's interior, four of them.
PARTICLES = (10_475, 41_900, 300_000, 1_200_000)
NODES, SIZE = 200, 2.0  # of the dense grid along each axis, and its length [m]
PARTICLES_PER_CELL = 8
DENSITY, YOUNG_MODULUS, POISSON_RATIO = 1000.0, 1.0e5, 0.3
MU = YOUNG_MODULUS / (2.0 * (1.0 + POISSON_RATIO))
LAM = YOUNG_MODULUS * POISSON_RATIO / ((1.0 + POISSON_RATIO) * (1.0 - 2.0 * POISSON_RATIO))
DT, GRAVITY = 2.0e-4, 9.81
FLOOR = 3  # nodes below which nothing moves down


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the comparison."""

    #: particles of the plain method
    particles: tuple[int, ...] = PARTICLES
    #: substeps of one measurement
    substeps: int = 200
    #: measurements; the row has their median
    repeats: int = 5
    #: auto, taichi or warp
    backend: str = "auto"
    #: also measure this suite at its closest sizes
    suite: bool = True
    #: a smoke run: few particles and substeps on a coarse grid
    small: bool = False


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each number of particles, then those of the suite.

    Raises:
        ValueError: ``backend`` is unknown, or it is taichi and Taichi cannot be imported.
    """
    counts, substeps, repeats = options.particles, options.substeps, options.repeats
    nodes, fidelity = NODES, ("fine",)
    if options.small:
        counts, substeps, repeats, nodes, fidelity = (1000,), 4, 2, 32, ("tiny",)
    backend = choose_backend(options.backend)
    for count in runner.progress(counts, "plain_mpm"):
        x = boxes(count, SIZE / nodes)
        method = (TaichiMPM if backend == "taichi" else WarpMPM)(x, nodes, options.device, substeps)
        method.run()  # compiles, and captures the graph
        seconds = timing.wall_times(options.device, method.run, repeats)
        ms = 1e3 * seconds / substeps
        yield {
            "case": f"plain MLS-MPM, {count} particles",
            "backend": backend,
            "particles": count,
            "nodes": nodes**3,
            "grid_spacing_m": SIZE / nodes,
            "ms_per_substep": float(np.median(ms)),
            "ms_per_substep_range": [float(ms.min()), float(ms.max())],
            "fallen_m": float(x[:, 2].mean() - method.positions()[:, 2].mean()),
        }
    if options.suite:
        ours = steps.Options(device=options.device, fidelity=fidelity, repeats=repeats, small=options.small)
        yield from ({**row, "case": f"suite, {row['case']}"} for row in steps.cases(ours))


def choose_backend(name: str) -> str:
    """Return ``"taichi"`` or ``"warp"``; for ``"auto"`` Taichi where it can be imported.

    Raises:
        ValueError: ``name`` is unknown, or it is taichi and Taichi cannot be imported.
    """
    found = importlib.util.find_spec("taichi") is not None
    if name not in ("auto", "taichi", "warp"):
        raise ValueError(f"backend={name!r} must be 'auto', 'taichi' or 'warp'")
    if name == "taichi" and not found:
        raise ValueError("backend='taichi', and Taichi cannot be imported; install it, or use backend='warp'")
    return "taichi" if name != "warp" and found else "warp"


def boxes(count: int, dx: float) -> np.ndarray:
    """Return places [m] on a jittered lattice in a cube around the centre of the grid, shape ``(count, 3)``."""
    side = int(np.ceil(count ** (1.0 / 3.0)))
    lattice = np.stack(np.meshgrid(*3 * [np.arange(side)], indexing="ij"), axis=-1).reshape(-1, 3)[:count]
    spacing = dx / PARTICLES_PER_CELL ** (1.0 / 3.0)
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, lattice.shape)
    return ((lattice - 0.5 * side + 0.5 + jitter) * spacing + 0.5 * SIZE).astype(np.float32)


class WarpMPM:
    """The plain method in Warp."""

    def __init__(self, x: np.ndarray, nodes: int, device: str, substeps: int) -> None:
        """Allocate particles at rest at ``x`` and a dense grid of ``nodes`` along each axis."""
        count, self.device, self.substeps = len(x), wp.get_device(device), substeps
        self.nodes, self.inv_dx = nodes, nodes / SIZE
        self.volume = float(1.0 / (PARTICLES_PER_CELL * self.inv_dx**3))
        self.x = wp.array(x, dtype=wp.vec3, device=device)
        self.v = wp.zeros(count, dtype=wp.vec3, device=device)
        self.C = wp.zeros(count, dtype=wp.mat33, device=device)
        self.F = wp.array(np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)), dtype=wp.mat33, device=device)
        self.momentum = wp.zeros((nodes, nodes, nodes), dtype=wp.vec3, device=device)
        self.mass = wp.zeros((nodes, nodes, nodes), dtype=float, device=device)
        self._graph: Any = None

    def run(self) -> None:
        """Advance by all substeps; on a GPU as one captured graph."""
        if not self.device.is_cuda:
            self._substeps()
            return
        if self._graph is None:
            self._substeps()  # loads the kernels before the capture
            with wp.ScopedCapture(self.device) as capture:
                self._substeps()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def positions(self) -> np.ndarray:
        """Return the particles' positions [m], shape ``(count, 3)``."""
        return self.x.numpy().copy()

    def _substeps(self) -> None:
        grid = [self.momentum, self.mass]
        particles = [self.x, self.v, self.C, self.F]
        for _ in range(self.substeps):
            self.momentum.zero_()
            self.mass.zero_()
            wp.launch(plain_p2g, self.x.shape, [*particles, self.volume, self.inv_dx], grid, device=self.device)
            wp.launch(plain_grid, self.mass.shape, grid, device=self.device)
            wp.launch(plain_g2p, self.x.shape, [self.momentum, self.inv_dx, *particles], device=self.device)


@wp.func
def _weights(fx: wp.vec3) -> wp.mat33:
    """Return quadratic B-spline weights, a row for each of three nodes."""
    one, half = wp.vec3(1.0), wp.vec3(0.5)
    a, b, c = wp.vec3(1.5) - fx, fx - one, fx - half
    return wp.matrix_from_rows(0.5 * wp.cw_mul(a, a), wp.vec3(0.75) - wp.cw_mul(b, b), 0.5 * wp.cw_mul(c, c))


@wp.func
def _polar(F: wp.mat33) -> wp.mat33:
    """Return the rotation of the polar decomposition."""
    U, _sigma, V = wp.svd3(F)
    return U * wp.transpose(V)


@wp.kernel
def plain_p2g(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    F: wp.array(dtype=wp.mat33),
    volume: float,
    inv_dx: float,
    momentum: wp.array3d(dtype=wp.vec3),
    mass: wp.array3d(dtype=float),
):
    """Update F and add mass and momentum, stress included, to 27 nodes."""
    p = wp.tid()
    dx = 1.0 / inv_dx
    xp = inv_dx * x[p]
    base = wp.vec3i(int(xp[0] - 0.5), int(xp[1] - 0.5), int(xp[2] - 0.5))
    fx = xp - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
    w = _weights(fx)
    deformed = (wp.identity(3, dtype=float) + DT * C[p]) * F[p]
    F[p] = deformed
    J = wp.determinant(deformed)
    stress = 2.0 * MU * (deformed - _polar(deformed)) * wp.transpose(deformed)
    stress += LAM * J * (J - 1.0) * wp.identity(3, dtype=float)
    m = volume * DENSITY
    affine = -DT * 4.0 * inv_dx * inv_dx * volume * stress + m * C[p]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                weight = w[i, 0] * w[j, 1] * w[k, 2]
                offset = dx * (wp.vec3(float(i), float(j), float(k)) - fx)
                wp.atomic_add(momentum, base[0] + i, base[1] + j, base[2] + k, weight * (m * v[p] + affine * offset))
                wp.atomic_add(mass, base[0] + i, base[1] + j, base[2] + k, weight * m)


@wp.kernel
def plain_grid(momentum: wp.array3d(dtype=wp.vec3), mass: wp.array3d(dtype=float)):
    """Turn momenta into velocities, add gravity and stop nodes at the floor."""
    i, j, k = wp.tid()
    m = mass[i, j, k]
    if m > 0.0:
        velocity = momentum[i, j, k] / m - wp.vec3(0.0, 0.0, DT * GRAVITY)
        if k < FLOOR:
            velocity = wp.vec3(velocity[0], velocity[1], wp.max(velocity[2], 0.0))
        momentum[i, j, k] = velocity


@wp.kernel
def plain_g2p(
    velocity: wp.array3d(dtype=wp.vec3),
    inv_dx: float,
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    F: wp.array(dtype=wp.mat33),
):
    """Read velocities and affine matrices back from 27 nodes, and move the particle."""
    p = wp.tid()
    xp = inv_dx * x[p]
    base = wp.vec3i(int(xp[0] - 0.5), int(xp[1] - 0.5), int(xp[2] - 0.5))
    fx = xp - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
    w = _weights(fx)
    new_v = wp.vec3()
    new_C = wp.mat33()
    for i in range(3):
        for j in range(3):
            for k in range(3):
                weight = w[i, 0] * w[j, 1] * w[k, 2]
                node = velocity[base[0] + i, base[1] + j, base[2] + k]
                new_v += weight * node
                new_C += 4.0 * inv_dx * weight * wp.outer(node, wp.vec3(float(i), float(j), float(k)) - fx)
    v[p] = new_v
    C[p] = new_C
    x[p] = x[p] + DT * new_v


class TaichiMPM:
    """The plain method in Taichi, after Hu et al.'s published 88 lines."""

    def __init__(self, x: np.ndarray, nodes: int, device: str, substeps: int) -> None:
        """Allocate particles at rest at ``x`` and a dense grid of ``nodes`` along each axis."""
        import taichi as ti

        ti.init(arch=ti.cuda if wp.get_device(device).is_cuda else ti.cpu, offline_cache=False, log_level=ti.ERROR)
        count, inv_dx, dx = len(x), nodes / SIZE, SIZE / nodes
        volume = float(1.0 / (PARTICLES_PER_CELL * inv_dx**3))
        self.ti, self.substeps = ti, substeps
        self.x = ti.Vector.field(3, float, shape=count)
        v, C, F = (
            ti.Vector.field(3, float, count),
            ti.Matrix.field(3, 3, float, count),
            ti.Matrix.field(3, 3, float, count),
        )
        momentum, mass = ti.Vector.field(3, float, (nodes,) * 3), ti.field(float, (nodes,) * 3)
        places = self.x
        places.from_numpy(x)
        F.from_numpy(np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)))

        @ti.kernel
        def clear():
            for node in ti.grouped(mass):
                momentum[node] = ti.Vector.zero(float, 3)
                mass[node] = 0.0

        @ti.kernel
        def p2g():
            for p in places:
                base = (places[p] * inv_dx - 0.5).cast(int)
                fx = places[p] * inv_dx - base.cast(float)
                w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
                F[p] = (ti.Matrix.identity(float, 3) + DT * C[p]) @ F[p]
                U, _sigma, V = ti.svd(F[p])
                J = F[p].determinant()
                stress = 2.0 * MU * (F[p] - U @ V.transpose()) @ F[p].transpose()
                stress += ti.Matrix.identity(float, 3) * LAM * J * (J - 1.0)
                affine = -DT * 4.0 * inv_dx * inv_dx * volume * stress + volume * DENSITY * C[p]
                for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                    offset = ti.Vector([i, j, k])
                    weight = w[i][0] * w[j][1] * w[k][2]
                    momentum[base + offset] += weight * (
                        volume * DENSITY * v[p] + affine @ ((offset.cast(float) - fx) * dx)
                    )
                    mass[base + offset] += weight * volume * DENSITY

        @ti.kernel
        def update_grid():
            for node in ti.grouped(mass):
                if mass[node] > 0.0:
                    momentum[node] = momentum[node] / mass[node]
                    momentum[node][2] -= DT * GRAVITY
                    if node[2] < FLOOR and momentum[node][2] < 0.0:
                        momentum[node][2] = 0.0

        @ti.kernel
        def g2p():
            for p in places:
                base = (places[p] * inv_dx - 0.5).cast(int)
                fx = places[p] * inv_dx - base.cast(float)
                w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
                new_v, new_C = ti.Vector.zero(float, 3), ti.Matrix.zero(float, 3, 3)
                for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                    offset = ti.Vector([i, j, k])
                    weight = w[i][0] * w[j][1] * w[k][2]
                    new_v += weight * momentum[base + offset]
                    new_C += 4.0 * inv_dx * weight * momentum[base + offset].outer_product(offset.cast(float) - fx)
                v[p], C[p] = new_v, new_C
                places[p] += DT * new_v

        self._stages: tuple[Callable[[], None], ...] = (clear, p2g, update_grid, g2p)

    def run(self) -> None:
        """Advance by all substeps."""
        for _ in range(self.substeps):
            for stage in self._stages:
                stage()
        self.ti.sync()

    def positions(self) -> np.ndarray:
        """Return the particles' positions [m], shape ``(count, 3)``."""
        return self.x.to_numpy()


if __name__ == "__main__":
    runner.main("plain_mpm", cases, Options)
