"""Factors of mass matrices: ours, which know where the skeleton has zeros, beside Warp's dense tiles.

``python -m benchmarks.cholesky --device cuda --num-envs 2048 --out FILE.json``. Both get the same matrices, those of a
body's bones in random poses with what springs and tissue add to the diagonal, and the same right-hand sides:

- ``ours``: :mod:`piavatar_envs.avatar.cholesky`, a warp and shared memory a matrix on a GPU, a thread on a CPU;
- ``warp_tile``: ``wp.tile_cholesky_inplace`` and ``wp.tile_cholesky_solve_inplace``, a CUDA block a matrix, for every
  block size that is asked for, by cuSolverDx (of libmathdx, linked into the kernel when it is compiled) and by the code
  that Warp falls back to. They need one matrix of shared memory, 19 kB, those that are not in place two. A row of 69
  numbers is no multiple of 16 bytes, so matrices that are padded to 72 rows by ones on the diagonal are tried, too.

Warp's get sums of matrix and diagonal, which ours add. Times are of launches over all matrices: ``factorise`` from
global memory to a factor in global memory, ``solve`` from there, and ``together`` from matrices to solutions while the
factor stays in shared memory. What cannot be built has no times, but a row whose ``failed`` says why.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from agents.bones import Bones
from benchmarks import crowd, runner, timing
from benchmarks.poses import random_poses
from piavatar_envs.avatar.cholesky import (
    Pattern,
    factorize,
    fetch_factor,
    find_pattern,
    keep_factor,
    pack,
    solve,
)
from piavatar_envs.avatar.joint_bench import room_of_warp
from piavatar_envs.avatar.lanes import warp_threads
from piavatar_envs.avatar.mass_matrix import NUM_DOF, filled_entries
from piavatar_envs.avatar.mass_pairs import build_pairs
from piavatar_envs.avatar.skeleton import NUM_JOINTS
from piavatar_envs.mpm.program import Program

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

PARTICLES = 3000  # of the body, as at fidelity="coarse"
POSES = 64  # of which all matrices are copies
MOST_ADDED = 1.0  # by springs and tissue to the diagonal of a joint [kg m^2]
OURS, TILE = "ours", "warp_tile"
CUSOLVER, PLAIN = "cuSolverDx", "Warp's own"


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the Cholesky benchmark."""

    #: matrices
    num_envs: int = 2048
    #: launches that are timed
    repeats: int = 50
    #: threads of a CUDA block in which Warp's tiles are tried; a CPU has one
    block_dims: tuple[int, ...] = (32, 64, 128)
    #: rows to which Warp's tiles are padded
    rows: tuple[int, ...] = (69, 72)


@dataclass(frozen=True)
class Systems:
    """What is to be solved.

    Attributes:
        matrix: mass matrices, ``(n, 69, 69)`` float32.
        diagonal: what is added to their diagonals, ``(n, 69)`` float32.
        right: right-hand sides, ``(n, 69)`` float32.
        filled: where matrices need not be zero, ``(69, 69)`` bool.
        solution: in double precision, ``(n, 69)``.
    """

    matrix: np.ndarray
    diagonal: np.ndarray
    right: np.ndarray
    filled: np.ndarray
    solution: np.ndarray

    def errors(self, x: np.ndarray) -> dict[str, float]:
        """Largest error and residual of solutions ``(n, 69)``, over the largest number of each solution and side."""
        whole, right = _whole(self.matrix, self.diagonal), self.right.astype(float)
        wrong = np.abs(x - self.solution).max(1) / np.abs(self.solution).max(1)
        left = np.abs(np.einsum("nij,nj->ni", whole, x.astype(float)) - right).max(1) / np.abs(right).max(1)
        return {"largest_error": float(wrong.max()), "largest_residual": float(left.max())}


def make_systems(n: int, seed: int = 0) -> Systems:
    """``n`` systems of a body in :data:`POSES` random poses, one after the other.

    Args:
        n: number of systems.
        seed: of poses, diagonals and right-hand sides.
    """
    rng, points = np.random.default_rng(seed), crowd.interior_body(PARTICLES)[0]
    bones, filled = Bones.of(points), filled_entries(build_pairs(points, "cpu"))
    rotations = random_poses(rng, POSES)[0]
    local = Rotation.from_rotvec(rotations.reshape(-1, 3)).as_matrix().reshape(POSES, NUM_JOINTS, 3, 3)
    matrix = bones.mass_matrix(bones.posture(local))
    added = rng.uniform(0.0, MOST_ADDED, (POSES, NUM_DOF)) * (np.arange(NUM_DOF) >= 6)  # nothing holds the pelvis
    copies = np.arange(n) % POSES
    parts = matrix, added, rng.normal(size=(POSES, NUM_DOF))
    matrix, added, right = (part.astype(np.float32) for part in parts)
    solution = np.linalg.solve(_whole(matrix, added), right[..., None].astype(float))[..., 0]
    return Systems(matrix[copies], added[copies], right[copies], filled, solution[copies])


def _whole(matrix: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    return matrix.astype(float) + diagonal.astype(float)[:, :, None] * np.eye(matrix.shape[1])


# --- ours -------------------------------------------------------------------------------------------------------------


@wp.kernel
def factorize_sparse(
    pattern: Pattern,
    matrix: wp.array2d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    # out
    factor: wp.array2d(dtype=float),
):
    """A factor of every matrix, over ``(n, threads)``."""
    e, _thread = wp.tid()
    room = room_of_warp()
    factorize(pattern, matrix, diagonal, e, e, room, e, factor)
    keep_factor(room, e, factor)


@wp.kernel
def solve_sparse(
    pattern: Pattern,
    factor: wp.array2d(dtype=float),
    right: wp.array2d(dtype=float),
    threads: int,
    # out
    x: wp.array2d(dtype=float),
):
    """A solution with every factor, over ``(n, threads)``."""
    e, thread = wp.tid()
    room = room_of_warp()
    fetch_factor(factor, e, room)
    solve(pattern, factor, e, right, e, e, thread, threads, room, x)


@wp.kernel
def solve_sparse_at_once(
    pattern: Pattern,
    matrix: wp.array2d(dtype=float),
    diagonal: wp.array2d(dtype=float),
    right: wp.array2d(dtype=float),
    threads: int,
    # out
    factor: wp.array2d(dtype=float),
    x: wp.array2d(dtype=float),
):
    """Both; on a CPU the factor is kept all the same, for there is no other place for it."""
    e, thread = wp.tid()
    room = room_of_warp()
    factorize(pattern, matrix, diagonal, e, e, room, e, factor)
    solve(pattern, factor, e, right, e, e, thread, threads, room, x)


def measure_ours(systems: Systems, options: Options) -> dict[str, Any]:
    """The row of the project's own factors."""
    n, threads = len(systems.matrix), warp_threads(options.device)
    pattern = find_pattern(systems.filled, options.device)
    parts = pack(pattern, systems.matrix), systems.diagonal, systems.right
    matrix, diagonal, right = (_upload(part, options) for part in parts)
    factor = wp.zeros_like(matrix)
    x = wp.zeros((n, NUM_DOF), dtype=float, device=options.device)
    launches = {
        "factorise": (factorize_sparse, [pattern, matrix, diagonal], [factor]),
        "solve": (solve_sparse, [pattern, factor, right, threads], [x]),
        "together": (solve_sparse_at_once, [pattern, matrix, diagonal, right, threads], [factor, x]),
    }
    about = {"case": OURS, "rows": NUM_DOF, "threads": threads}
    return about | _measure(systems, options, launches, threads, x)


# --- Warp's tiles -----------------------------------------------------------------------------------------------------


@cache
def tile_kernels(rows: int, cusolver: bool) -> dict[str, wp.Kernel]:
    """Kernels for matrices of a size, which tiles have to know when they are compiled.

    Args:
        rows: of the matrices.
        cusolver: whether to use cuSolverDx where Warp has it.
    """
    options = {"enable_backward": False, "enable_mathdx_solver": cusolver}
    whole = wp.constant(rows % 4 == 0)  # rows begin at multiples of 16 bytes

    @wp.kernel(module="unique", module_options=options)
    def factorize_tile(matrix: wp.array3d(dtype=float), factor: wp.array3d(dtype=float)):
        e, _thread = wp.tid()
        L = wp.tile_load(matrix[e], shape=(rows, rows), storage="shared", bounds_check=False, aligned=whole)
        wp.tile_cholesky_inplace(L)
        wp.tile_store(factor[e], L, bounds_check=False, aligned=whole)

    @wp.kernel(module="unique", module_options=options)
    def solve_tile(factor: wp.array3d(dtype=float), right: wp.array2d(dtype=float), x: wp.array2d(dtype=float)):
        e, _thread = wp.tid()
        L = wp.tile_load(factor[e], shape=(rows, rows), storage="shared", bounds_check=False, aligned=whole)
        y = wp.tile_load(right[e], shape=rows, storage="shared", bounds_check=False)
        wp.tile_cholesky_solve_inplace(L, y)
        wp.tile_store(x[e], y, bounds_check=False)

    @wp.kernel(module="unique", module_options=options)
    def solve_tile_at_once(matrix: wp.array3d(dtype=float), right: wp.array2d(dtype=float), x: wp.array2d(dtype=float)):
        e, _thread = wp.tid()
        L = wp.tile_load(matrix[e], shape=(rows, rows), storage="shared", bounds_check=False, aligned=whole)
        wp.tile_cholesky_inplace(L)
        y = wp.tile_load(right[e], shape=rows, storage="shared", bounds_check=False)
        wp.tile_cholesky_solve_inplace(L, y)
        wp.tile_store(x[e], y, bounds_check=False)

    return {"factorise": factorize_tile, "solve": solve_tile, "together": solve_tile_at_once}


def measure_tiles(systems: Systems, options: Options, rows: int, threads: int, cusolver: bool) -> dict[str, Any]:
    """A row of Warp's tiles; of what cannot be built or run with the reason in place of times.

    Args:
        systems: to be solved.
        options: of the benchmark.
        rows: to which matrices are padded.
        threads: of a CUDA block.
        cusolver: whether by cuSolverDx.

    Raises:
        ValueError: fewer rows than the matrices have.
    """
    if rows < NUM_DOF:
        raise ValueError(f"rows={rows} must be >= {NUM_DOF}, those of the matrices")
    about = {"case": TILE, "solver": CUSOLVER if cusolver else PLAIN, "rows": rows, "threads": threads}
    if cusolver and (missing := why_no_cusolver(options.device)):
        return about | {"failed": missing}
    n = len(systems.matrix)
    padded, right = np.tile(np.eye(rows), (n, 1, 1)), np.zeros((n, rows))
    padded[:, :NUM_DOF, :NUM_DOF] = _whole(systems.matrix, systems.diagonal)
    right[:, :NUM_DOF] = systems.right
    matrix, right = _upload(padded, options), _upload(right, options)
    factor, x = wp.zeros_like(matrix), wp.zeros_like(right)
    arrays = {
        "factorise": ([matrix], [factor]),
        "solve": ([factor, right], [x]),
        "together": ([matrix, right], [x]),
    }
    try:
        kernels = tile_kernels(rows, cusolver)
        launches = {name: (kernels[name], *given) for name, given in arrays.items()}
        return about | _measure(systems, options, launches, threads, x)
    except Exception as error:  # compilers, linkers and drivers have no common one
        return about | {"failed": f"{type(error).__name__}: {error}"}


def why_no_cusolver(device: str) -> str | None:
    """Why Warp has no cuSolverDx for a device; None where it has."""
    if not wp.get_device(device).is_cuda:
        return "cuSolverDx is for GPUs"
    enabled = getattr(wp._src.context.runtime.core, "wp_is_mathdx_enabled", lambda: 0)
    return None if enabled() else f"Warp {wp.__version__} has been built without libmathdx, from which cuSolverDx comes"


# --- all --------------------------------------------------------------------------------------------------------------


def _upload(values: np.ndarray, options: Options) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=float, device=options.device)


def _measure(
    systems: Systems,
    options: Options,
    launches: Mapping[str, tuple[wp.Kernel, list[Any], list[Any]]],
    threads: int,
    x: wp.array,
) -> dict[str, Any]:
    """Times of launches over ``(n, threads)`` and errors of the solutions ``x`` of each way to them.

    Raises:
        ArithmeticError: a solution is not finite.
    """
    row, found = {}, []
    for name, (kernel, inputs, outputs) in launches.items():
        program = Program(options.device)
        program.launch(kernel, (len(systems.matrix), threads), inputs, outputs, block_dim=threads)
        x.fill_(np.nan)
        program.run()
        if name != "factorise":
            found.append(systems.errors(x.numpy()[:, :NUM_DOF]))
            if not np.isfinite(found[-1]["largest_error"]):
                raise ArithmeticError(f"{kernel.key} leaves solutions that are not finite")
        times = timing.kernel_times(program, options.repeats)
        row[f"{name}_us"] = 1e3 * sum(kernel.ms for kernel in times.values())
    return row | {name: max(one[name] for one in found) for name in found[0]}


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Rows: ours, then Warp's tiles in every size."""
    systems, about = make_systems(options.num_envs), {"num_envs": options.num_envs}
    yield about | measure_ours(systems, options)
    on_gpu = wp.get_device(options.device).is_cuda
    for cusolver in (True, False):
        for rows in options.rows:
            for threads in options.block_dims if on_gpu else (1,):
                yield about | measure_tiles(systems, options, rows, threads, cusolver)


if __name__ == "__main__":
    runner.main("cholesky", cases, Options)
