"""Pictures of surfaces: silhouettes, depth, labels, shadows, textures, and rows of a batch, against geometry."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.avatar.body.textures import CLAMP, MIRROR, REPEAT, Texture, Textures
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.srgb import srgb_to_linear
from piavatar_envs.render import Box, Capsule, Sphere
from piavatar_envs.render.ground import GroundStyle
from piavatar_envs.render.painter import Painter
from piavatar_envs.render.surfaces import MeshPart, Surfaces
from piavatar_envs.render.views import Shot, view_rows

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
#: Without a ground: all that is not a surface is black.
NIGHT = GroundStyle(*6 * [BLACK])
AHEAD = Shot(np.array([0.0, -4.0, 1.0]), np.array([0.0, 0.0, 1.0]), 30.0, np.array([100.0, 0.0]))


def paint(device, meshes, shots=(AHEAD,), size=64, vertices=None, layers=(), **options):
    """Return a painter that has drawn meshes ``(vertices, faces)`` or markers, a picture a shot."""
    meshes = [mesh if isinstance(mesh, tuple) else (*mesh.mesh(), {}) for mesh in meshes]
    parts = [MeshPart(len(own), faces, **{"color": WHITE, **more}) for own, faces, more in meshes]
    height, width = (size, size) if isinstance(size, int) else size
    painter = Painter(Surfaces.build(parts, device), len(shots), height, width, device, **options)
    if vertices is None:
        vertices = np.concatenate([own for own, _, _ in meshes])[None].repeat(len(shots), axis=0)
    painter.vertices.assign(np.asarray(vertices, np.float32))
    painter.views.assign(view_rows(shots, height, width))
    painter.centers.assign(np.array([shot.center for shot in shots], np.float32))
    painter.layers += layers
    graph = LaunchGraph(device)
    painter.record(graph)
    graph.run()
    painter.graph = graph
    return painter


def rays(shot: Shot, size: int, samples: int = 1) -> np.ndarray:
    """Return the rays of the samples of a picture, of depth one along the axis, ``(n, n, 3)``."""
    forward, right, up = shot.axes
    count = size * samples
    at = (np.arange(count) + 0.5) / samples - 0.5 * size
    x, y = np.meshgrid(at, -at)
    return forward + (x[..., None] * right + y[..., None] * up) / shot.focal(size)


def sphere_depth(rays: np.ndarray, eye: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Return the depth of the first intersection of rays with a sphere [m]; infinite where there is none."""
    offset = center - eye
    along, square = rays @ offset, (rays**2).sum(-1)
    inside = along**2 - square * (offset @ offset - radius**2)
    return np.where(inside > 0.0, (along - np.sqrt(np.maximum(inside, 0.0))) / square, np.inf)


def shares(mask: np.ndarray, samples: int = 2) -> np.ndarray:
    """Return the share of a pixel's samples that is set."""
    n = len(mask) // samples
    return mask.reshape(n, samples, n, samples).mean(axis=(1, 3))


def fine_sphere(center, radius, rings=160):
    """Return vertices and faces of a sphere whose facets are far below a pixel."""
    polar, angle = np.linspace(0.0, np.pi, rings), np.linspace(0.0, 2.0 * np.pi, 2 * rings, endpoint=False)
    p, a = np.meshgrid(polar, angle, indexing="ij")
    points = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(2 * rings), indexing="ij")
    k = (j + 1) % (2 * rings)
    a, b, c, d = (row * 2 * rings + column for row, column in ((i, j), (i + 1, j), (i + 1, k), (i, k)))
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return np.asarray(center) + radius * points, faces.astype(np.int32), {}


def sheet(place, count):
    """Return vertices and faces of a grid over two coordinates in [-1, 1], which ``place`` turns into x, y and z."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, count), np.linspace(-1.0, 1.0, count))
    i, j = np.meshgrid(np.arange(count - 1), np.arange(count - 1), indexing="ij")
    a = (count * i + j).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + count + 1], -1), np.stack([a, a + count + 1, a + count], -1)])
    return np.stack(place(x, y), -1).reshape(-1, 3), faces.astype(np.int32), {"color": 3 * (0.5,)}


def test_a_sphere_covers_its_silhouette_and_has_its_depth(device):
    center, radius = np.array([0.21, 0.3, 1.13]), 0.6
    painter = paint(device, [fine_sphere(center, radius)], ground=NIGHT, depth=True, segmentation=True)
    exact = sphere_depth(rays(AHEAD, 64, 2), AHEAD.eye, center, radius)
    covered = (painter.color.numpy()[0] > 0.0).all(-1)
    share = shares(np.isfinite(exact))
    labels = painter.labels.numpy()[0]
    assert (covered == (share > 0.0)).mean() > 0.999 and (labels == covered).all()
    inner = (labels == 1) & (share == 1.0)
    depth = painter.depth.numpy()[0]
    nearest = exact.reshape(64, 2, 64, 2).min(axis=(1, 3))
    assert np.abs(depth[inner] - nearest[inner]).max() < 2e-3 and np.isinf(depth[~covered]).all()
    brightness = painter.color.numpy()[0].mean(-1)
    rim = (share > 0.0) & (share < 1.0)
    assert rim.sum() > 60 and np.abs(brightness[rim] / share[rim] - np.median(brightness[inner])).mean() < 0.2


def test_edges_take_the_share_of_their_samples(device):
    half = np.array([0.4013, 0.3, 0.3547])
    painter = paint(device, [Box((0.05, 0.3, 1.02), half)], ground=NIGHT, samples=4, size=96)
    brightness = painter.color.numpy()[0].mean(-1)
    front = AHEAD.eye[1] - 0.0  # the side towards the eye is the plane y = 0
    focal = AHEAD.focal(96) / -front
    left, right = 48.0 + focal * (0.05 - half[0]), 48.0 + focal * (0.05 + half[0])
    row = brightness[48] / brightness[48, 48]
    covered = row[:48].sum() + row[48:].sum()
    assert covered == pytest.approx(right - left, abs=0.26)
    column = brightness[:, 48] / brightness[48, 48]
    assert (column > 0.5).sum() == pytest.approx(2.0 * focal * half[2], abs=1.0)


def test_a_box_has_the_depth_of_its_side_and_the_ground_that_of_its_plane(device):
    high = Shot(np.array([0.0, -4.0, 2.0]), np.array([0.0, 0.0, 0.3]), 30.0, np.zeros(2))
    painter = paint(device, [Box((0.0, 0.0, 0.3), (0.3, 0.2, 0.3))], (high,), depth=True, segmentation=True)
    depth, labels = painter.depth.numpy()[0], painter.labels.numpy()[0]
    way = rays(high, 64)
    ground = -high.eye[2] / np.minimum(way[..., 2], -1e-9)
    hit = high.eye + ground[..., None] * way
    seen = (labels == 0) & (np.hypot(hit[..., 0], hit[..., 1]) < 1.5)
    assert seen.sum() > 100 and np.abs(depth / ground - 1.0)[seen].max() < 0.005
    front = (-0.2 - high.eye[1]) / way[..., 1]
    at = high.eye + front[..., None] * way
    side = (np.abs(at[..., 0]) < 0.27) & (np.abs(at[..., 2] - 0.3) < 0.27)
    assert side.sum() > 50 and (labels[side] == 1).all()
    assert np.abs(depth - front)[side].max() < 0.02


def test_only_fronts_are_drawn_and_a_vertex_that_is_not_finite_hides_its_triangles(device):
    corners = np.array([[-0.5, 0.0, 0.6], [0.5, 0.0, 0.6], [0.5, 0.0, 1.4], [-0.5, 0.0, 1.4]])
    front, back = np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.array([[0, 2, 1], [0, 3, 2]], np.int32)

    def covered(faces, corners):
        return int((paint(device, [(corners, faces, {})], ground=NIGHT, segmentation=True).labels.numpy() > 0).sum())

    whole = covered(front, corners)
    assert whole == pytest.approx(0.8 * (AHEAD.focal(64) / 4.0) ** 2, rel=0.1) and covered(back, corners) == 0
    for value in (np.nan, np.inf, -np.inf):
        corners[1, 2] = value
        assert covered(front, corners) == pytest.approx(0.5 * whole, rel=0.1)
    assert covered(front, np.full_like(corners, np.nan)) == 0


def test_a_hidden_vertex_leaves_light_and_shadow_of_the_rest(device):
    boxes = [Box((0.0, 0.0, 0.3), (0.3, 0.2, 0.3)), Sphere((0.3, -0.6, 0.9), 0.2)]
    count = len(boxes[1].mesh()[0])
    alone = paint(device, boxes[:1]).picture.numpy()
    vertices = np.concatenate([box.mesh()[0] for box in boxes])
    vertices[-count:] = np.nan
    np.testing.assert_array_equal(paint(device, boxes, vertices=vertices[None]).picture.numpy(), alone)


def test_what_is_very_far_leaves_light_and_shadow_of_the_rest(device):
    box, far = Box((0.0, 0.0, 0.3), (0.3, 0.2, 0.3)), Sphere((0.0, -300.0, 0.9), 0.2)  # behind the eye
    np.testing.assert_array_equal(paint(device, [box, far]).picture.numpy(), paint(device, [box]).picture.numpy())


def test_what_crosses_the_near_plane_is_cut_there(device):
    """Look along a large floor that passes below the eye and behind it; one plane gives the depth of every pixel."""
    square = np.array([[-9.0, -9.0, 0.5], [9.0, -9.0, 0.5], [9.0, 9.0, 0.5], [-9.0, 9.0, 0.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    steep = Shot(np.array([0.0, -1.0, 0.7]), np.array([0.0, -0.8, 0.5]), 60.0, np.array([100.0, 0.0]))
    painter = paint(device, [(square, faces, {})], (steep,), depth=True, ground=NIGHT, segmentation=True)
    way = rays(steep, 64)
    exact = (0.5 - steep.eye[2]) / np.minimum(way[..., 2], -1e-9)
    seen = (exact > 0.06) & (exact < 3.0)
    assert (painter.labels.numpy()[0][seen] == 1).all()
    assert np.abs(painter.depth.numpy()[0] / exact - 1.0)[seen].max() < 0.02
    inside = Shot(np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 1.0]), 60.0, np.array([100.0, 0.0]))
    assert not paint(device, [Sphere((0, 0, 1), 0.3)], (inside,), ground=NIGHT).picture.numpy().any(), "only backs"


def test_no_sample_between_two_triangles_is_lost(device):
    """Cover the whole picture with a crumpled sheet of triangles larger and smaller than a sample."""
    rng = np.random.default_rng(3)
    points, faces, _ = sheet(lambda x, z: (1.5 * x, 0.02 * rng.standard_normal(x.shape), 1.0 + 1.5 * z), 70)
    points[:, [0, 2]] += 0.01 * rng.standard_normal((len(points), 2))
    painter = paint(device, [(points, faces, {})], size=200, ground=NIGHT, segmentation=True, samples=1)
    assert (painter.labels.numpy() == 1).all()


def test_the_key_light_is_shaded_where_geometry_says(device):
    """Hold a plate between the light and a table: its shadow lies on the ground and on the table where rays end."""
    from piavatar_envs.render.shadows import KEY

    key = np.array([*KEY])
    above = Shot(np.array([0.0, -0.01, 6.0]), np.array([0.0, 0.0, 0.0]), 40.0, np.zeros(2))
    top, center = 0.4, np.array([0.9, 0.9])
    plate = Box((*(center + (1.5 - top) * key[:2] / key[2]), 1.5), (0.25, 0.25, 0.01))
    table = sheet(lambda x, y: (center[0] + 0.5 * x, center[1] + 0.5 * y, np.full_like(x, top)), 50)
    lit, shaded = (
        paint(device, meshes, (above,), 128).color.numpy()[0].mean(-1) for meshes in ([table], [table, plate])
    )

    def at(image, point):
        column, row = above.project(np.array([point]), 128, 128)[0].astype(int)
        return image[row - 1 : row + 2, column - 1 : column + 2].mean()

    middle = np.array([*center, top])
    assert at(shaded, middle) < 0.75 * at(lit, middle)
    rim = middle + [0.42, 0.42, 0.0]
    assert at(shaded, rim) == pytest.approx(at(lit, rim), abs=0.02)
    alone = paint(device, [Box((0.0, 0.0, 1.0), (0.2, 0.2, 0.02))], (above,), 128).color.numpy()[0].mean(-1)
    empty = paint(device, [Box((0.0, 0.0, -9.0), (0.2, 0.2, 0.02))], (above,), 128).color.numpy()[0].mean(-1)
    on_ground = np.array([*(-key[:2] / key[2]), 0.0])
    assert at(alone, on_ground) < at(empty, on_ground) - 0.08
    for side in ([0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [-0.6, 0.2, 0.0]):
        assert at(alone, on_ground + side) == pytest.approx(at(empty, on_ground + side), abs=0.02)


def quad(size=0.5):
    """Return a square towards the eye with the coordinates of a picture."""
    corners = np.array([[-size, 0, 1 - size], [size, 0, 1 - size], [size, 0, 1 + size], [-size, 0, 1 + size]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)


def test_a_texture_is_the_right_way_round_and_is_averaged_where_it_is_fine(device):
    corners, faces, uv = quad()
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4, :4], image[:4, 4:], image[4:, :4] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    painter = paint(device, [(corners, faces, {"textures": on_all(faces, uv, image)})], ground=NIGHT)
    color = painter.color.numpy()[0]
    middle, reach = 32, int(0.25 * AHEAD.focal(64) / 4.0)
    high_left, high_right = color[middle - reach, middle - reach], color[middle - reach, middle + reach]
    low_left, low_right = color[middle + reach, middle - reach], color[middle + reach, middle + reach]
    assert high_left.argmax() == 0 and high_right.argmax() == 1 and low_left.argmax() == 2
    assert high_left[1:].max() < 0.3 * high_left[0] and low_right.max() < 0.3
    fine = np.zeros((512, 512, 3), np.uint8)
    fine[::2, ::2] = fine[1::2, 1::2] = 255
    seen = paint(device, [(corners, faces, {"textures": on_all(faces, uv, fine)})], ground=NIGHT).color.numpy()[0]
    inner = seen[middle - reach : middle + reach, middle - reach : middle + reach].mean(-1)
    assert np.ptp(inner) < 0.05, "a fine pattern is grey at a distance, not noise"


@pytest.mark.parametrize("wrap", [REPEAT, CLAMP, MIRROR])
def test_a_checker_is_drawn_where_its_coordinates_say(device, wrap):
    """Pixels of a quad of two triangles, whose corners are beyond the image, show a checker of 8 by 8 fields."""
    corners, faces, uv = quad()
    low, high, size = -0.3, 1.4, 256
    fields = np.add.outer(np.arange(8), np.arange(8)) % 2
    pixels = np.repeat(np.repeat(np.where(fields[..., None] > 0, [255, 255, 255], [0, 0, 0]), 16, 0), 16, 1)
    tints = np.tile(np.array([[255, 188, 0]], np.uint8), (4, 1))
    image = Texture(pixels.astype(np.uint8), (wrap, wrap))
    textures = Textures((image,), np.zeros(2, int), low + (high - low) * uv, tints)
    painter = paint(device, [(corners, faces, {"textures": textures})], size=size, ground=NIGHT)
    color = painter.color.numpy()[0]
    # the quad is at the distance that the view looks at, so a place on it is linear in the pixel
    reach = AHEAD.focal(size) * 0.5 / 4.0
    y, x = (np.arange(size) + 0.5 - 0.5 * size for _ in range(2))
    places = low + (high - low) * (0.5 + 0.5 * np.stack(np.meshgrid(x, y), -1) / reach)
    inside = (np.abs(x)[None] < reach - 2) & (np.abs(y)[:, None] < reach - 2)
    cell = {REPEAT: places % 1.0, CLAMP: np.clip(places, 0.0, 0.999), MIRROR: 1.0 - np.abs(places % 2.0 - 1.0)}[wrap]
    edge = np.abs(8.0 * places - np.round(8.0 * places)).min(-1) * reach / (4.0 * (high - low))
    clear = inside & (edge > 1.5)  # [px] from the next border of a field
    white = (np.floor(8.0 * cell).sum(-1).astype(int) % 2)[clear] > 0
    assert clear.sum() > 1000 and 0.3 < white.mean() < 0.7
    seen = color[clear]
    assert (seen[white, 0] > 0.5).all() and (seen[~white, 0] < 0.1).all()
    # the tint lets half of the green light pass, and no blue
    light = srgb_to_linear(seen[white])
    assert light[:, 1] / light[:, 0] == pytest.approx(0.5, abs=0.03) and light[:, 2].max() < 0.05


def on_all(faces, uv, pixels):
    """Return an image on all triangles."""
    return Textures((Texture(pixels),), np.zeros(len(faces), int), uv, np.full((len(uv), 3), 255, np.uint8))


def test_colours_of_vertices_and_rows_of_albedo(device):
    corners, faces, _ = quad()
    red, green = (np.tile(np.array([value], np.uint8), (4, 1)) for value in ([200, 10, 10], [10, 200, 10]))
    color = paint(device, [(corners, faces, {"colors": red})], ground=NIGHT).color.numpy()[0, 32, 32]
    assert color.argmax() == 0 and color[0] > 3.0 * color[1]
    surfaces = Surfaces.build([MeshPart(4, faces, colors=red)], device, num_albedos=2)
    albedo = surfaces.albedo.numpy()
    albedo[1] = albedo[1][:, [1, 0, 2]]
    surfaces.albedo.assign(albedo)
    painter = Painter(surfaces, 2, 16, 16, device, ground=NIGHT)
    painter.vertices.assign(corners[None].repeat(2, 0).astype(np.float32))
    painter.views.assign(view_rows(2 * [AHEAD], 16, 16))
    graph = LaunchGraph(device)
    painter.record(graph)
    graph.run()
    first, second = painter.color.numpy()[:, 8, 8]
    np.testing.assert_allclose(first[[1, 0, 2]], second, atol=0.05)
    assert second.argmax() == 1
    with pytest.raises(ValueError, match="a row per vertex"):
        MeshPart(5, faces, colors=green)
    with pytest.raises(ValueError, match="corners from 0 to 3"):
        Surfaces.build([MeshPart(3, faces)], device)
    with pytest.raises(ValueError, match="at least one mesh"):
        Surfaces.build([], device)


def test_a_row_of_a_batch_is_the_picture_alone_and_runs_are_equal(device, monkeypatch):
    """Also where pictures are drawn in several chunks."""
    rng = np.random.default_rng(0)
    meshes = [Sphere((0.0, 0.0, 1.0), 0.3), Box((0.5, 0.2, 0.3), (0.2, 0.2, 0.3)), Capsule((-0.5, 0, 0.6), 0.1, 0.3)]
    base = np.concatenate([mesh.mesh()[0] for mesh in meshes])
    count = 5
    vertices = base + 0.3 * rng.standard_normal((count, 1, 3))
    vertices[3, -50:] = np.nan
    eyes = np.array([0.0, -4.0, 1.2]) + rng.standard_normal((count, 3)) * [1.0, 0.5, 0.3]
    shots = [Shot(eye, np.array([0.0, 0.0, 0.8]), 35.0, np.zeros(2)) for eye in eyes]
    options = {"size": (40, 56), "depth": True, "segmentation": True}

    def bytes_of(painter):
        painter.graph.run()
        return [array.numpy() for array in (painter.picture, painter.depth, painter.labels)]

    batch = paint(device, meshes, shots, vertices=vertices, **options)
    whole = bytes_of(batch)
    for first, again in zip(whole, bytes_of(batch), strict=True):
        np.testing.assert_array_equal(first, again)
    for row in range(count):
        alone = bytes_of(paint(device, meshes, shots[row : row + 1], vertices=vertices[row : row + 1], **options))
        for own, all_ in zip(alone, whole, strict=True):
            np.testing.assert_array_equal(own[0], all_[row])
    monkeypatch.setattr("piavatar_envs.render.painter._WORKSPACE", 1)
    chunked = paint(device, meshes, shots, vertices=vertices, **options)
    assert chunked.chunk == 1
    for own, all_ in zip(bytes_of(chunked), whole, strict=True):
        np.testing.assert_array_equal(own, all_)


def test_layers_draw_over_the_surfaces_before_they_become_bytes(device):
    class Fog:
        def record(self, graph, painter):
            graph.launch(fog, painter.color.shape, [painter.nearest], [painter.color])

    faces, corners = quad()[1], quad()[0]
    painter = Painter(Surfaces.build([MeshPart(4, faces, color=WHITE)], device), 1, 16, 16, device, ground=NIGHT)
    painter.vertices.assign(corners[None].astype(np.float32))
    painter.views.assign(view_rows([AHEAD], 16, 16))
    painter.layers.append(Fog())
    graph = LaunchGraph(device)
    painter.record(graph)
    graph.run()
    seen = painter.picture.numpy()[0]
    assert (seen[8, 8] == 64).all() and (seen[0, 0] == 0).all()


def test_pictures_with_and_without_layers_are_rounded_alike(device):
    class Clear:
        def record(self, graph, painter):
            """Draw nothing."""

    meshes = [Sphere(np.array([0.0, 0.0, 1.0]), 0.5), Box((0.3, -0.4, 0.9), (0.2, 0.2, 0.2))]
    bare = paint(device, meshes, size=(24, 40), depth=True, segmentation=True)
    layered = paint(device, meshes, size=(24, 40), depth=True, segmentation=True, layers=[Clear()])
    expected = np.floor(np.clip(255.0 * bare.color.numpy() + np.float32(0.5), 0.0, 255.0)).astype(int)
    assert np.abs(bare.picture.numpy().astype(int) - expected).max() <= 1  # by rounding, at halves
    assert len(np.unique(bare.picture.numpy())) > 50 and np.isfinite(bare.depth.numpy()).any()
    for name in ("picture", "depth", "labels"):
        np.testing.assert_array_equal(getattr(bare, name).numpy(), getattr(layered, name).numpy())


@wp.kernel
def fog(nearest: wp.array3d[float], color: wp.array3d[wp.vec3]):
    n, i, j = wp.tid()
    color[n, i, j] = wp.vec3(nearest[n, i, j])


def test_bad_requests_are_refused(device):
    surfaces = Surfaces.build([MeshPart(4, quad()[1])], device)
    for options, match in (
        ({"height": 2}, "height=2"), ({"samples": 9}, "samples=9"), ({"num_pictures": 0}, "num_pictures=0"),
        ({"vertices": wp.zeros((1, 3), dtype=wp.vec3, device="cpu")}, r"\(1, 3\)"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=match):
            Painter(surfaces, **{"num_pictures": 1, "height": 16, "width": 16, "device": device, **options})
    _, faces, uv = quad()
    with pytest.raises(ValueError, match="uv of 4 vertices and images of 2 triangles; the mesh has 5 and 2"):
        MeshPart(5, faces, textures=on_all(faces, uv, np.zeros((4, 4, 3), np.uint8)))
    with pytest.raises(ValueError, match="subject=300"):
        MeshPart(4, quad()[1], subject=300)


def test_pictures_that_are_not_chosen_stay(device):
    balls = [Sphere(np.array([0.0, 0.0, 1.0]), 0.5)]
    painter = paint(device, balls, [AHEAD, AHEAD], size=24, depth=True, segmentation=True)
    before = [array.numpy().copy() for array in (painter.picture, painter.depth, painter.labels)]
    moved = painter.vertices.numpy() + np.array([0.3, 0.0, 0.2], np.float32)
    painter.vertices.assign(moved)
    painter.drawn.assign(np.array([False, True]))
    painter.graph.run()
    alone = paint(device, balls, [AHEAD], size=24, vertices=moved[:1], depth=True, segmentation=True)
    now = [array.numpy() for array in (painter.picture, painter.depth, painter.labels)]
    then = [array.numpy() for array in (alone.picture, alone.depth, alone.labels)]
    for old, new, expected in zip(before, now, then, strict=True):
        assert np.array_equal(new[0], old[0]) and np.array_equal(new[1], expected[0])
        assert not np.array_equal(new[1], old[1])
