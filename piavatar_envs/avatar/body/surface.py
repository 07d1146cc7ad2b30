"""Queries against a closed skin: signed distance and nearest point (Warp, always on the CPU)."""

from __future__ import annotations

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _closest_point_kernel(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    face: wp.array(dtype=int),
    coordinates: wp.array(dtype=wp.vec3),
):
    """Return the signed distance (negative inside) and nearest point of the skin."""
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0e3)
    nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    distance[i] = query.sign * wp.length(nearest - points[i])
    face[i] = query.face
    coordinates[i] = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)


class ClosedSurface:
    """Point queries against a closed triangle mesh; on the CPU whatever the simulation runs on."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self._mesh = wp.Mesh(
            points=wp.array(vertices, dtype=wp.vec3, device="cpu"),
            indices=wp.array(faces.ravel(), dtype=wp.int32, device="cpu"),
            support_winding_number=True,
        )

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
            inputs=[self._mesh.id, where],
            outputs=[distance, face, coordinates],
            device="cpu",
        )
        return distance.numpy(), face.numpy(), coordinates.numpy()

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance to the skin [m], negative inside, shape ``(N,)``."""
        return self.query(points)[0]
