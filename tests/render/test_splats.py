"""Drawing of Gaussians: projection, order, blending with surfaces, colours, and rows of a batch."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.core.arrays import vec16
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.render import Body, Camera, MovedSplats, Renderer, Sphere, splats
from piavatar_envs.render.ground import GroundStyle
from piavatar_envs.render.painter import Painter
from piavatar_envs.render.splats import SplatPainter
from piavatar_envs.render.surfaces import MeshPart, Surfaces
from piavatar_envs.render.views import Shot, View, view_rows
from scripts.synthetic_splats import on_body

HEIGHT, WIDTH, FOCAL = 44, 52, 60.0
SH0 = 0.28209479177387814
#: Looks along y, x to the right, z up.
EYE, AXES = np.array([0.0, -3.0, 0.0]), np.eye(3)[[0, 2, 1]]


def view(eye=EYE, axes=AXES, width=WIDTH, height=HEIGHT) -> View:
    row = View()
    row.eye, (row.right, row.up, row.forward) = wp.vec3(*eye), (wp.vec3(*axis) for axis in axes)
    row.focal, row.width, row.height = FOCAL, width, height
    return row


def draw(device, views, means, covariances, colors, opacities, turns=None, background=0.2, nearest=0.0, **more):
    """Return colours, inverse depths and labels over a surface that covers whole pixels, if any.

    ``colors`` are ``(S, 3)``, or harmonics ``(S, K, 3)``.
    """
    colors = np.asarray(colors, dtype=float)
    harmonics = colors if colors.ndim == 3 else ((colors - 0.5) / SH0)[:, None]
    painter = SplatPainter(opacities, harmonics, len(views), HEIGHT, WIDTH, device, **more)
    rows = (len(views), *np.shape(means)[-2:])
    painter.means.assign(np.broadcast_to(means, rows))
    packed = np.asarray(covariances)[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    painter.covariances.assign(np.broadcast_to(packed, (*rows[:2], 6)))
    if turns is not None:
        painter.turns.assign(np.broadcast_to(turns, (*rows[:2], 4)))
    pictures = (len(views), HEIGHT, WIDTH)
    canvas = SimpleNamespace(
        views=wp.array(views, dtype=View, device=device),
        color=wp.array(np.broadcast_to(np.float32(background), (*pictures, 3)), dtype=wp.vec3, device=device),
        nearest=wp.array(np.broadcast_to(np.float32(nearest), pictures), dtype=float, device=device),
        coverage=wp.ones(pictures, dtype=float, device=device),
        backdrop=wp.array(
            np.broadcast_to(np.float32(nearest), pictures)[..., None] * [0, 0, 0, 1], dtype=wp.vec4, device=device
        ),
        labels=wp.full(pictures, 9, dtype=wp.uint8, device=device),
    )
    graph = LaunchGraph(device)
    painter.record(graph, canvas)
    graph.run()
    return canvas.color.numpy(), canvas.nearest.numpy(), canvas.labels.numpy()


def cloud(count: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1.2, -1.0, -1.0], [1.2, 1.0, 1.0], (count, 3))
    axes = Rotation.random(count, random_state=seed).as_matrix() * rng.uniform(0.005, 0.15, (count, 1, 3))
    return means, axes @ axes.transpose(0, 2, 1), rng.uniform(0, 1, (count, 3)), rng.uniform(0.0, 1.0, count)


def reference(means, covariances, colors, opacities, background, nearest, eye=EYE, axes=AXES):
    """Blend in float64, splat by splat."""
    x, y, z = axes @ (means - eye).T
    u, v = WIDTH / 2 + FOCAL * x / z, HEIGHT / 2 - FOCAL * y / z
    light, rest = np.zeros((HEIGHT, WIDTH, 3)), np.ones((HEIGHT, WIDTH))
    done = np.zeros((HEIGHT, WIDTH), bool)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for i in np.argsort(z.astype(np.float32), kind="stable"):
        if z[i] < 0.05:
            continue
        wide, high = np.clip([x[i] / z[i], -y[i] / z[i]], *(np.outer([-1, 1], [WIDTH, HEIGHT]) * 0.65 / FOCAL))
        jacobian = FOCAL / z[i] * np.array([axes[0] - wide * axes[2], -axes[1] - high * axes[2]])
        own = jacobian @ covariances[i] @ jacobian.T
        shape = np.linalg.inv(own + 0.1 * np.eye(2))
        offset = np.stack([columns - u[i], rows - v[i]], axis=-1)
        alpha = opacities[i] * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", offset, shape, offset))
        alpha = np.where(alpha < 1 / 255, 0.0, np.minimum(alpha, 0.99))
        alpha *= np.sqrt(np.linalg.det(own) * np.linalg.det(shape))
        done |= (alpha > 0) & ((1 / z[i] < nearest) | (rest * (1 - alpha) < 1e-4))
        alpha[done] = 0.0
        light += (rest * alpha)[..., None] * colors[i]
        rest *= 1 - alpha
    return light + rest[..., None] * background


def test_one_gaussian_is_its_analytic_image(device):
    # A sphere of 0.2 m seen from 3 m at the axis: an isotropic Gaussian of (0.2 focal / 3)^2 + 0.1 px^2.
    color, depth, _ = draw(device, [view()], [[0, 0, 0]], [0.04 * np.eye(3)], [[1.0, 0.5, 0.0]], [0.8])
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    square = (rows - HEIGHT / 2) ** 2 + (columns - WIDTH / 2) ** 2
    alpha = 0.8 * np.exp(-0.5 * square / ((0.2 * FOCAL / 3) ** 2 + 0.1))
    alpha[alpha < 1 / 255] = 0.0
    alpha *= 16 / 16.1
    expected = alpha[..., None] * [1.0, 0.5, 0.0] + (1 - alpha[..., None]) * 0.2
    np.testing.assert_allclose(color[0], expected, atol=1e-5)
    assert alpha.min() == 0.0 < (depth > 0).mean() < 1.0
    np.testing.assert_allclose(depth[0][alpha > 0.51], 1 / 3, rtol=1e-6)


@pytest.mark.parametrize("sizes", [(0.01, 0.01, 0.01), (0.02, 0.002, 0.005), (0.001, 0.001, 0.001)])
@pytest.mark.parametrize("tiled", [True, False])
def test_a_gaussian_below_a_pixel_keeps_its_integrated_opacity(device, sizes, tiled):
    """The integral of ``o exp(-d^T C^-1 d / 2)`` above 1/255 is ``2 pi sqrt(det C) (o - 1/255)``."""
    shifts = 3 / FOCAL * np.arange(4) / 4  # the mean over places in a pixel
    means = np.stack([axis.ravel() for axis in np.meshgrid(shifts, 0.0, shifts)], axis=1)[:, None]
    given = (means, [np.diag(np.square(sizes))], [[1, 1, 1]], [0.9])
    color, _, _ = draw(device, 16 * [view()], *given, background=0.0, tiled=tiled)
    exact = 2.0 * np.pi * sizes[0] * sizes[2] * (FOCAL / 3) ** 2 * (0.9 - 1 / 255)
    assert color[..., 0].sum() / 16 == pytest.approx(exact, rel=0.02)


def test_the_image_of_a_gaussian_beside_the_picture_is_bounded(device):
    given = np.array([[2.7, 0.0, 0.0]]), np.array([np.eye(3)]), np.array([[1.0, 0.5, 0.0]]), np.array([0.9])
    color, _, _ = draw(device, [view()], *given)
    expected = reference(*given, 0.2, 0.0)
    np.testing.assert_allclose(color[0], expected, atol=1e-5)
    assert np.abs(expected - 0.2).max() > 0.1


def test_many_gaussians_equal_a_slow_reference(device):
    means, covariances, colors, opacities = cloud(700)
    turn = Rotation.from_euler("zxy", [40, -20, 10], degrees=True)
    eye, axes = turn.apply(EYE), turn.apply(AXES)
    nearest = np.where(np.arange(WIDTH) < WIDTH // 2, 0.0, 1 / 3.1)
    color, _, _ = draw(device, [view(eye, axes)], means, covariances, colors, opacities, nearest=nearest)
    expected = reference(means, covariances, colors, opacities, 0.2, nearest, eye, axes)
    np.testing.assert_allclose(color[0], expected, atol=1e-4)
    assert np.abs(expected - 0.2).max(axis=-1).mean() > 0.1  # there is something to see


def test_a_surface_hides_what_is_behind_it(device):
    means, covariances = [[0, 0.5, 0], [0, -0.5, 0]], [0.09 * np.eye(3)] * 2
    colors, opacities = [[1, 0, 0], [0, 1, 0]], [0.9, 0.6]
    center = (0, HEIGHT // 2, WIDTH // 2)
    for surface, hidden in ((1 / 4.0, ()), (1 / 3.0, (0,)), (1 / 2.0, (0, 1))):
        color, depth, _ = draw(device, [view()], means, covariances, colors, opacities, background=0.5, nearest=surface)
        left = [i for i in range(2) if i not in hidden]
        expected = reference(*(np.array(a)[left] for a in (means, covariances, colors, opacities)), 0.5, 0.0)
        np.testing.assert_allclose(color[center], expected[center[1:]], atol=1e-5)
        assert depth[center] == pytest.approx(1 / 2.5 if not hidden or hidden == (0,) else surface)


def sheet_behind_a_ball(device, size: int, splats_too: bool, tiled: bool) -> np.ndarray:
    """Return the red of a grey ball, above a bright ground, before a black wall of splats, which ends at its middle."""
    vertices, faces = Sphere(np.array([0.0, 0.0, 1.0]), 0.3).mesh()
    part = MeshPart(len(vertices), faces, color=(0.5, 0.5, 0.5))
    painter = Painter(Surfaces.build([part], device), 1, size, size, device, ground=GroundStyle(*6 * [(1.0, 1.0, 1.0)]))
    painter.vertices.assign(vertices[None].astype(np.float32))
    shot = Shot(np.array([0.0, -4.0, 1.0]), np.array([0.0, 0.0, 1.0]), 30.0, np.zeros(2))
    painter.views.assign(view_rows([shot], size, size))
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-1.2, 0.0, 61), np.linspace(0.0, 2.0, 101)))
    count = len(x)
    layer = SplatPainter(np.full(count, 0.97), np.full((count, 1, 3), -0.5 / SH0), 1, size, size, device, tiled=tiled)
    layer.means.assign(np.stack([x, np.full(count, 1.0), z], axis=1)[None].astype(np.float32))
    layer.covariances.assign(np.tile(np.float32([9e-4, 0, 0, 1e-6, 0, 9e-4]), (1, count, 1)))
    if splats_too:
        painter.layers.append(layer)
    graph = LaunchGraph(device)
    painter.record(graph)
    graph.run()
    return painter.color.numpy()[0, ..., 0]


@pytest.mark.parametrize("tiled", [True, False])
def test_splats_show_beside_the_edge_of_a_surface_before_them(device, tiled):
    """Where samples show the ball ``c`` of a pixel, a black wall leaves ``c`` of its light; ``1 - c`` was the sky's."""
    plain = sheet_behind_a_ball(device, 64, False, tiled)
    walled = sheet_behind_a_ball(device, 64, True, tiled)
    ball = plain < 0.99
    left, right = ball.copy(), ball.copy()
    left[:, 28:], right[:, :36] = False, False
    assert np.abs(walled - plain)[right].max() < 1e-6, "no splat is there"
    # the ball is as bright on both sides, so that nothing is brighter than its inner part
    inside = binary_erosion(ball, iterations=2)
    assert left.sum() > 50 and walled[left].max() < plain[inside].max() + 0.02
    edge = left & ~binary_erosion(ball)
    assert walled[edge].min() > 0.02 and walled[edge].max() - walled[edge].min() > 0.1, "the edge is smooth"


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_are_those_of_scipy(degree):
    @wp.kernel
    def evaluate(directions: wp.array[wp.vec3], values: wp.array[vec16]):
        i = wp.tid()
        values[i] = splats.harmonics_of(directions[i])

    directions = np.random.default_rng(degree).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = wp.zeros(50, dtype=vec16, device="cpu")
    wp.launch(evaluate, 50, [wp.array(directions, dtype=wp.vec3, device="cpu")], [values], device="cpu")
    polar, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    for order in range(-degree, degree + 1):
        # Real harmonics of complex ones that have the Condon-Shortley phase, which the convention keeps.
        full = sph_harm_y(degree, abs(order), polar, azimuth)
        part = full.real if order >= 0 else full.imag
        expected = part * (np.sqrt(2.0) if order else 1.0)
        np.testing.assert_allclose(values.numpy()[:, degree * (degree + 1) + order], expected, atol=2e-6)


def test_colour_turns_with_the_splat(device):
    # Degree 1: c_3 multiplies -x, so the colour is brightest seen along -x of the rest frame.
    harmonics = np.zeros((1, 4, 3))
    harmonics[0, 3] = 1.0
    for degrees, expected in ((0, 0.5), (90, 0.5 - 0.48860251), (-90, 0.5 + 0.48860251)):
        # the eye looks along y: turned by 90 degrees about z, that is along x of the rest frame
        turn = Rotation.from_euler("z", degrees, degrees=True).as_quat()
        given = ([[0, 0, 0]], [50 * np.eye(3)], harmonics, [0.99])
        color, _, _ = draw(device, [view()], *given, turns=turn, background=0.0)
        assert color[0, HEIGHT // 2, WIDTH // 2, 1] == pytest.approx(0.99 * expected, abs=2e-3)


def test_labels_are_those_of_what_takes_half_of_the_light(device):
    means, covariances = [[-0.4, 0.0, 0], [0.4, -0.2, 0], [0.4, 0.2, 0]], [0.01 * np.eye(3)] * 3
    given = (means, covariances, np.ones((3, 3)), [0.9, 0.3, 0.9])
    _, _, labels = draw(device, [view()], *given, subjects=[1, 2, 3])
    row = labels[0, HEIGHT // 2]
    assert (row[0], row[WIDTH // 2 - 8], row[WIDTH // 2 + 8]) == (9, 1, 3)


def test_opacity_has_limits(device):
    def alpha(opacity, count=1):
        given = (count * [[0, 0, 0]], count * [1e4 * np.eye(3)], count * [[1, 1, 1]], count * [opacity])
        return draw(device, [view()], *given, background=0.0)[0][0, HEIGHT // 2, WIDTH // 2, 0]

    assert alpha(0.0) == alpha(0.9 / 255) == 0.0
    assert alpha(1.1 / 255) == pytest.approx(1.1 / 255, rel=1e-3)
    assert alpha(1.0) == pytest.approx(0.99, rel=1e-4)
    assert alpha(1.0, 5) == pytest.approx(0.99, rel=1e-4)  # the second would leave less than 1e-4


def test_what_is_not_a_number_or_out_of_sight_is_not_drawn(device):
    means = [[np.nan, 0, 0], [0, 0, 0], [0, -3.1, 0], [0, -2.96, 0], [0, 9e3, 0], [0, 0, 0], [500.0, 0, 0]]
    covariances = [np.eye(3), np.full((3, 3), np.nan), *(4 * [np.eye(3)]), 1e-4 * np.eye(3)]
    opacities = [1, 1, 1, 1, 1, 0, 1]
    color, depth, _ = draw(device, [view()], means, covariances, 7 * [[1, 1, 1]], opacities, nearest=0.01)
    assert (color == np.float32(0.2)).all() and (depth == np.float32(0.01)).all()


def test_rows_of_a_batch_equal_single_pictures_and_a_second_run(device, equal, monkeypatch):
    parts = cloud(300, seed=3)
    means = np.stack([parts[0] + shift for shift in np.linspace(-0.3, 0.3, 5)])
    means[:, 100:150] = means[:, 50:100]  # equal depths: the lower index is in front
    views = [view(EYE + [0, 0.1 * i, 0]) for i in range(5)]
    together = draw(device, views, means, *parts[1:])
    for a, b in zip(together, draw(device, views, means, *parts[1:]), strict=True):
        assert equal(a, b)
    monkeypatch.setattr(splats, "SPLAT_WORKSPACE", 2 * splats._SPLAT_BYTES * 300)  # in chunks of two
    monkeypatch.setattr(splats, "MASK_WORKSPACE", 1)  # in single rows of tiles
    for a, b in zip(together, draw(device, views, means, *parts[1:]), strict=True):
        assert equal(a, b)
    for i in range(5):
        for a, b in zip(together, draw(device, views[i : i + 1], means[i], *parts[1:]), strict=True):
            assert equal(a[i], b[0])


def test_tiles_and_splats_blend_the_same(device):
    given = ([view(), view(1.1 * EYE)], *cloud(2200))  # more than a word of words
    for a, b in zip(draw(device, *given, tiled=True), draw(device, *given, tiled=False), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6)


def test_wrong_clouds_are_refused():
    for opacities, shape in (([0.5, 0.5], (2, 3)), ([0.5], (1, 2, 3)), ([], (0, 1, 3)), ([1.5], (1, 1, 3))):
        with pytest.raises(ValueError, match="give"):
            SplatPainter(opacities, np.zeros(shape), 1, 8, 8, "cpu")


def on_the_body(count: int = 20_000) -> tuple[Body, Body]:
    """The embedded body as a mesh, and with splats on its skin instead."""
    asset = load_asset()
    cloud = on_body(asset, count, vertices=asset.mean_body().vertices)
    covariances = cloud.covariances().reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    splats = MovedSplats(cloud, cloud.means, covariances, np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)))
    mesh = Body(asset.mean_body().vertices, asset.faces, (0.1, 0.2, 0.5))
    return mesh, replace(mesh, splats=splats)


def test_splats_cover_the_body_and_cast_its_shadow():
    mesh, splats = on_the_body()
    with Renderer(160, 160) as renderer:
        empty = renderer.render([replace(mesh, vertices=mesh.vertices + [0.0, 0.0, 100.0])]).astype(int)
        drawn, covered = (renderer.render([body]).astype(int) for body in (mesh, splats))
        again = renderer.render([splats]).astype(int)
    changed = np.abs(drawn - empty).max(axis=-1) > 12, np.abs(covered - empty).max(axis=-1) > 12
    # the shadow, too; splats reach a pixel or two beyond
    assert changed[1][changed[0]].mean() > 0.98
    assert binary_dilation(changed[0], iterations=2)[changed[1]].mean() > 0.999
    assert (again == covered).all()
    # the shirt of the splats is striped, the mesh has one colour
    assert np.abs(drawn - covered).max(axis=-1)[changed[0]].mean() > 20


def test_markers_before_splats_hide_them():
    _, splats = on_the_body(2_000)
    camera = Camera(position=(0.0, -4.0, 1.0), target=(0.0, 0.0, 1.0))
    with Renderer(64, 64, camera) as renderer:
        for y, hidden in ((-0.6, True), (0.6, False)):
            ball = Sphere(np.array([0.0, y, 1.15]), 0.1, (0.0, 1.0, 0.0))
            red, green, _ = renderer.render([splats], [ball])[25, 32].astype(int)
            assert (green > red) == hidden
