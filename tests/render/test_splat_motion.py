"""Splats that move with particles and bones: gradients against theory."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.sampling import sample_particles
from piavatar_envs.avatar.body.skeleton import forward_kinematics, joint_index, skin
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.skin import Skin, SkinMotion, record_skin, skin_workspace
from piavatar_envs.avatar.skinning import in_order, pack
from piavatar_envs.core.arrays import vec6
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.render.painter import Painter
from piavatar_envs.render.splat_motion import STRETCH, BoundSplats, record_turns, stencils_of
from piavatar_envs.render.splats import SplatPainter
from piavatar_envs.render.surfaces import MeshPart, Surfaces
from piavatar_envs.render.views import Shot, view_rows
from scripts.synthetic_splats import drawn_as, on_body


class Puppet:
    """Splats on a body whose bones and particles a test moves."""

    def __init__(self, count: int, device: str, inset: float = 0.0) -> None:
        plain = load_asset()
        cloud = on_body(plain, count, inset=inset)
        self.asset = asset = drawn_as(plain, cloud)
        self.particles, self.device = sample_particles(plain, 0.05), device
        origin = asset.mean_body().joints[0] - asset.joints[0]
        self.rest = self.particles.rest_positions + origin
        self.joints = asset.mean_body().joints.astype(np.float64)
        skinning = self.particles.skin_joints, self.particles.skin_weights
        self.bound = BoundSplats.of(asset, np.zeros(len(asset.shape_names)), self.rest, *skinning)

    def move(self, x: np.ndarray, rotations: Rotation | None = None, positions: np.ndarray | None = None):
        """Return centres, covariances and rotations of particles at ``x`` and of bones."""

        def array(values, dtype):
            return wp.array(np.ascontiguousarray(values, np.float32)[None], dtype=dtype, device=self.device)

        turns = Rotation.identity(22) if rotations is None else rotations
        skin = pack(*in_order(self.particles.skin_joints, self.particles.skin_weights))
        motion = fill(
            SkinMotion(),
            first=0,
            skin=wp.array(skin, dtype=wp.vec4, device=self.device),
            rest=array(self.rest, wp.vec3),
            rest_joint=array(self.joints, wp.vec3),
            rotation=array(turns.as_quat(), wp.quat),
            position=array(self.joints if positions is None else positions, wp.vec3),
            x=array(x, wp.vec3),
            shape=wp.zeros((1, 1), dtype=float, device=self.device),
        )
        count, envs = len(self.bound.cloud), wp.zeros(1, dtype=int, device=self.device)
        means = wp.zeros((1, count), dtype=wp.vec3, device=self.device)
        covariances = wp.zeros((1, count), dtype=vec6, device=self.device)
        turned = wp.zeros((1, count), dtype=wp.quat, device=self.device)
        graph, surface = LaunchGraph(self.device), self.bound.skin.upload(self.device)
        workspace = skin_workspace(surface, 1, self.device)
        record_skin(graph, envs, surface, motion, workspace, means)
        stencils = self.bound.upload(self.device)
        record_turns(graph, envs, surface, motion, workspace, stencils, covariances, turned)
        graph.run()
        c = covariances.numpy()[0][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        return means.numpy()[0], c, Rotation.from_quat(turned.numpy()[0])


@pytest.fixture(scope="module")
def puppet(device) -> Puppet:
    return Puppet(800, device)


def test_affine_maps_are_exact(puppet):
    """The covariance is that of the map, far from the origin as well."""
    stretch = np.eye(3) + 0.4 * np.random.default_rng(0).normal(size=(3, 3))
    assert STRETCH[0] < np.linalg.svd(stretch)[1].min() and np.linalg.svd(stretch)[1].max() < STRETCH[1]
    _, covariances, turns = puppet.move(puppet.rest @ stretch.T + [2.0, -1.0, 0.5])
    expected = stretch @ puppet.bound.cloud.covariances() @ stretch.T
    size = np.trace(expected, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(covariances / size, expected / size, atol=2e-5)
    u, _, vt = np.linalg.svd(stretch)
    assert (turns * Rotation.from_matrix(u @ vt).inv()).magnitude().max() < 1e-3


def test_a_rigid_turn_leaves_the_eigenvalues(puppet):
    turn, shift = Rotation.from_rotvec([0.3, -2.0, 1.1]), np.array([0.5, 0.2, 1.0])
    bones = Rotation.from_matrix(np.tile(turn.as_matrix(), (22, 1, 1)))
    means, covariances, turns = puppet.move(turn.apply(puppet.rest) + shift, bones, turn.apply(puppet.joints) + shift)
    np.testing.assert_allclose(means, turn.apply(puppet.bound.cloud.means) + shift, atol=1e-5)
    before, after = (np.linalg.eigvalsh(c.astype(float)) for c in (puppet.bound.cloud.covariances(), covariances))
    np.testing.assert_allclose(after, before, atol=1e-5 * before.max())
    assert (turns * turn.inv()).magnitude().max() < 1e-4


@pytest.mark.parametrize("factor", [0.05, 20.0, -1.0])
def test_stretch_is_bounded(puppet, factor):
    """Also where the map turns matter inside out."""
    _, covariances, _ = puppet.move(puppet.rest * [1.0, 1.0, factor])
    before, after = (np.linalg.eigvalsh(c.astype(float))[:, 2] for c in (puppet.bound.cloud.covariances(), covariances))
    assert np.isfinite(covariances).all()
    assert (after < 1.01 * STRETCH[1] ** 2 * before).all() and (after > 0.99 * STRETCH[0] ** 2 * before).all()


def test_directions_that_particles_do_not_span_are_bound_to_the_bones():
    line = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [1e-3, 0.0, 0.1]])
    slope, bound = stencils_of(np.arange(4)[None], np.full((1, 4), 0.25), line)
    np.testing.assert_allclose(bound[0], np.diag([1.0, 1.0, 0.0]), atol=0.02)
    np.testing.assert_allclose(line.T @ slope[0] + bound[0], np.eye(3), atol=1e-5)
    # a turn of the bones that the line follows is found again
    turn = Rotation.from_rotvec([0.4, 0.0, 0.9]).as_matrix()
    np.testing.assert_allclose((line @ turn.T).T @ slope[0] + turn @ bound[0], turn, atol=1e-5)


def silhouettes(puppet: Puppet, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of the skin's mesh and those of the splats, of a body with bent limbs."""
    body, device = load_asset().mean_body(), puppet.device
    local = np.tile(np.eye(3), (22, 1, 1))
    local[joint_index("left_shoulder")] = Rotation.from_rotvec([0.0, -0.6, -0.5]).as_matrix()
    local[joint_index("left_elbow")] = Rotation.from_rotvec([0.0, 0.0, -1.8]).as_matrix()
    local[joint_index("right_knee")] = Rotation.from_rotvec([1.2, 0.0, 0.0]).as_matrix()
    rotations, positions = forward_kinematics(local, puppet.joints[0], puppet.joints)
    particles, cloud = puppet.particles, puppet.bound.cloud
    skinning = particles.skin_joints, particles.skin_weights
    x = skin(puppet.rest, *skinning, rotations, positions, puppet.joints)
    means, covariances, turns = puppet.move(x, Rotation.from_matrix(rotations), positions)
    mesh = Skin.baked(load_asset(), body, puppet.rest, *skinning).deform(rotations, positions, x)
    shots = [Shot(np.array([1.5, -3.2, 1.4]), np.array([0.1, 0.0, 0.85]), 34.0, np.zeros(2))]
    masks = []
    for drawn in (True, False):
        part = MeshPart(len(mesh), load_asset().faces, subject=1, is_drawn=drawn)
        painter = Painter(Surfaces.build([part], device), 1, *size, device, segmentation=True)
        painter.vertices.assign(mesh[None])
        painter.views.assign(view_rows(shots, *size))
        if not drawn:
            over = SplatPainter(cloud.opacities, cloud.sh, 1, *size, device, subjects=np.ones(len(cloud)))
            over.means.assign(means[None])
            over.covariances.assign(covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]][None])
            over.turns.assign(turns.as_quat().astype(np.float32)[None])
            painter.layers.append(over)
        graph = LaunchGraph(device)
        painter.record(graph)
        graph.run()
        masks.append(painter.labels.numpy()[0] == 1)
    return masks[0], masks[1]


@pytest.fixture(scope="module")
def covered(device) -> Puppet:
    """Return a body with splats all over whose centres are half as deep as they are wide: they end where it does."""
    return Puppet(50_000, device, inset=0.5)


@pytest.mark.parametrize(("size", "tolerance"), [(32, 0.13), (64, 0.05), (128, 0.03)])
def test_a_body_has_the_area_of_its_mesh_in_small_pictures(covered, size, tolerance):
    """Each splat is far smaller than a pixel."""
    mesh, splats = silhouettes(covered, (size, size))
    assert splats.sum() == pytest.approx(mesh.sum(), rel=tolerance)


def test_bent_limbs_have_no_holes(covered):
    """The mesh has none."""
    mesh, splats = silhouettes(covered, (480, 400))
    assert mesh.sum() > 20_000
    assert (binary_erosion(mesh) & ~splats).sum() == 0
    assert (mesh & splats).sum() > 0.99 * mesh.sum()
    assert (mesh & splats).sum() > 0.98 * (mesh | splats).sum()


def test_constants_are_uploaded_once(puppet):
    assert puppet.bound.upload(puppet.device).slope.ptr == puppet.bound.upload(puppet.device).slope.ptr
