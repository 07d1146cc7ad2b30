"""Pictures of bodies and markers: projection, camera, colours, and every thread and process."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from piavatar_envs.avatar.body.textures import Texture, Textures
from piavatar_envs.render import Arrow, Body, Box, Camera, Renderer, Sphere
from piavatar_envs.render.overlay import draw_scale
from piavatar_envs.render.views import Shot

SIZE = 160
GREEN = (0.1, 0.9, 0.1)
FIXED = Camera(follow=0.0)


@pytest.fixture(scope="module")
def renderer():
    with Renderer(SIZE, SIZE, camera=FIXED) as renderer:
        yield renderer


@pytest.fixture
def body(subject) -> Body:
    return Body(subject.body.vertices, subject.asset.faces, color=GREEN)


def shifted(body: Body, offset) -> Body:
    return Body(body.vertices + np.asarray(offset, dtype=np.float32), body.faces, color=body.color)


def green(frame: np.ndarray) -> np.ndarray:
    """Return the pixels that a green thing covers, ``(H, W)`` bool; the ground, its shadow and the sky are grey."""
    red, greens, blue = np.moveaxis(frame.astype(int), -1, 0)
    return greens - np.maximum(red, blue) > 25


def bounds(mask: np.ndarray) -> np.ndarray:
    """Return the first and last column and row that are covered, ``(left, right, top, bottom)``."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    return np.array([columns[0], columns[-1], rows[0], rows[-1]])


def project(points: np.ndarray, camera: Camera = FIXED) -> np.ndarray:
    """Return the pixel coordinates of a pinhole camera, ``(N, 2)``."""
    eye, forward = np.array(camera.position), np.subtract(camera.target, camera.position)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offset = points - eye
    depth = offset @ forward
    focal = 0.5 * SIZE / np.tan(np.deg2rad(camera.field_of_view) / 2.0)
    return SIZE / 2 + focal * np.stack([offset @ right, -offset @ np.cross(right, forward)], axis=-1) / depth[:, None]


def test_a_body_is_drawn_where_a_pinhole_camera_projects_it(renderer, body):
    frame = renderer.render([body])
    assert frame.shape == (SIZE, SIZE, 3) and frame.dtype == np.uint8
    pixels = project(body.vertices.astype(np.float64))
    expected = [pixels[:, 0].min(), pixels[:, 0].max(), pixels[:, 1].min(), pixels[:, 1].max()]
    assert np.abs(bounds(green(frame)) + 0.5 - expected).max() < 3.0


def test_moving_the_body_moves_its_pixels(renderer, body):
    step = np.array([0.25, 0.0, 0.1])
    before, after = (green(renderer.render([b])) for b in (body, shifted(body, step)))
    center = np.array([[0.0, 0.0, 0.9]])
    expected = (project(center + step) - project(center))[0]
    shift = [
        np.flatnonzero(after.any(axis=axis)).mean() - np.flatnonzero(before.any(axis=axis)).mean() for axis in (0, 1)
    ]
    np.testing.assert_allclose(shift, expected, atol=2.5)


def test_the_camera_follows(body):
    with Renderer(SIZE, SIZE, camera=Camera(follow=1.0)) as renderer:
        here = green(renderer.render([body], follow=np.zeros(3)))
        there = green(renderer.render([shifted(body, (3.0, -2.0, 0.0))], follow=np.array([3.0, -2.0, 0.9])))
        assert (here != there).mean() < 0.003
    with Renderer(SIZE, SIZE, camera=Camera(follow=0.5)) as renderer:
        renderer.render([body], follow=np.zeros(3))
        lefts = [
            bounds(green(renderer.render([shifted(body, (0.4, 0, 0))], follow=np.array([0.4, 0, 1]))))[0]
            for _ in range(6)
        ]
        assert lefts[0] > lefts[1] > lefts[2] >= lefts[5], "it glides, and does not jump"
        renderer.reset_camera()
        assert abs(int(bounds(green(renderer.render([body], follow=np.zeros(3))))[0]) - int(bounds(here)[0])) <= 1


def test_the_camera_glides_by_time_not_by_pictures(body):
    """Compare its place behind a walking body for several numbers of pictures; without time it stays."""

    def left_of(times: list[float]) -> int:
        with Renderer(SIZE, SIZE, camera=Camera(follow=0.2)) as renderer:
            renderer.render([body], follow=np.zeros(3))
            gone = 0.0
            for elapsed in times:
                gone += 2.0 * elapsed
                at = np.array([gone, 0.0, 1.0])
                picture = renderer.render([shifted(body, (gone, 0.0, 0.0))], follow=at, elapsed=elapsed)
        return bounds(green(picture))[0]

    assert left_of([0.2]) == left_of([1.0 / 30.0] * 6) == left_of([0.1, 0.0, 0.1]) != left_of([0.1])
    camera, still, begin, end = Camera(follow=0.2), np.ones(2), np.array([1.0, 0.0]), np.array([1.6, -0.3])
    assert camera.glide(still, begin, begin, 1.0 / 30.0) == pytest.approx(still + 0.2 * (begin - still))
    # far behind a point of constant speed it lags by speed / k
    assert camera.glide(still, begin - 100.0, begin, 100.0) == pytest.approx(begin + 1.0 / (30.0 * np.log(0.8)))
    assert (Camera(follow=1.0).glide(still, begin, end, 0.01) == end).all()
    assert (Camera(follow=0.0).glide(still, begin, end, 9.0) == still).all()


def test_pictures_repeat(renderer, body):
    markers = [Sphere((0.4, -0.4, 1.2), 0.06), Arrow((0, -1, 1), (0, 0.5, 0)), Box((0.6, 0, 0.2), (0.1, 0.1, 0.2))]
    first = renderer.render([body], markers)
    kept = first.copy()
    renderer.render([shifted(body, (0.2, 0.0, 0.0))])
    np.testing.assert_array_equal(first, kept, err_msg="a picture belongs to its caller")
    np.testing.assert_array_equal(renderer.render([body], markers), first)


def test_an_interrupted_picture_leaves_nothing_behind(body, monkeypatch):
    from piavatar_envs.core.launch_graph import LaunchGraph

    armed, launches = [], LaunchGraph.launches.fget

    def interrupt():
        if armed:
            raise KeyboardInterrupt

    # before the samples become pixels
    monkeypatch.setattr(
        LaunchGraph, "launches", property(lambda graph: [*(own := launches(graph))[:-2], ("", interrupt), *own[-2:]])
    )
    there, gone = [shifted(body, (0.3, 0.0, 0.0))], [shifted(body, (50.0, 0.0, 0.0))]
    with Renderer(SIZE, SIZE, camera=FIXED) as renderer:
        empty = renderer.render(gone)
        armed.append(True)
        with pytest.raises(KeyboardInterrupt):
            renderer.render(there)
        armed.clear()
        np.testing.assert_array_equal(renderer.render(gone), empty)


def test_near_things_hide_far_ones(renderer, body):
    eye, middle = np.array(FIXED.position), np.array([0.0, -0.05, 1.15])
    toward = (eye - middle) / np.linalg.norm(eye - middle)
    red = (0.9, 0.1, 0.1)
    column, row = project(middle[None])[0].astype(int)
    front = renderer.render([body], [Sphere(middle + 0.6 * toward, 0.08, color=red)])[row, column].astype(int)
    behind = renderer.render([body], [Sphere(middle - 0.6 * toward, 0.08, color=red)])[row, column].astype(int)
    assert front[0] > front[1] + 40
    assert behind[1] > behind[0] + 40


def test_the_shadow_lies_behind_and_fades(renderer, body):
    """Compare the ground at the left rear with that at the right front, where the key light comes from."""
    empty = renderer.render([], [Sphere((0.0, 30.0, 0.5), 0.01)]).astype(float).mean(axis=-1)
    frame = renderer.render([body])
    dark = np.where(green(frame), 0.0, empty - frame.astype(float).mean(axis=-1))
    column, row = project(np.array([[0.3, 0.55, 0.0]]))[0].astype(int)
    assert dark[row - 3 : row + 4, column - 3 : column + 4].max() > 15.0
    column, row = project(np.array([[-0.4, -0.7, 0.0]]))[0].astype(int)
    assert np.abs(dark[row - 3 : row + 4, column - 3 : column + 4]).max() < 3.0


def test_the_scale_goes_where_it_covers_no_body():
    """Also in a video, where it stays as long as nothing is behind it."""
    height, width = 240, 320
    empty = np.full((height, width, 3), 200, np.uint8)
    corners = {0: (width - 20, height - 40), 1: (width - 20, 40), 2: (20, height - 40), 3: (20, 40)}
    for taken in range(4):
        frame = empty.copy()
        seen = np.array([place for corner, place in corners.items() if corner <= taken and corner < 3], float)
        assert draw_scale(frame, 0.2, "strain", seen) == min(taken + 1, 3)
        x, y = corners[min(taken + 1, 3)]
        drawn = np.argwhere((frame != empty).any(2)).mean(0)
        assert (drawn[1] > width / 2) == (x > width / 2) and (drawn[0] > height / 2) == (y > height / 2)
    assert draw_scale(empty.copy(), 0.2, "strain", np.array([corners[1]], float), last=2) == 2
    assert draw_scale(empty.copy(), 0.2, "strain", np.array(list(corners.values()), float), last=2) == 2


def test_a_shot_projects_as_the_pictures_are_drawn():
    camera, points = FIXED, np.array([[0.3, 0.55, 0.0], [-0.4, -0.7, 1.2]])
    shot = Shot(np.asarray(camera.position), np.asarray(camera.target), camera.field_of_view, np.zeros(2))
    behind = np.concatenate([points, 3.0 * shot.eye[None]])
    np.testing.assert_allclose(shot.project(behind, SIZE, SIZE), project(points), atol=0.5)


def test_strain_colors_and_their_scale(renderer, body, subject):
    count = len(body.vertices)
    strained = [Body(body.vertices, body.faces, scalars=np.full(count, s), scalar_max=0.3) for s in (0.0, 0.3)]
    pale, dark = (renderer.render([b]) for b in strained)
    mask = green(renderer.render([body]))
    assert pale[mask].mean() > dark[mask].mean() + 50.0
    plain = renderer.render([body])
    corner = (slice(int(0.55 * SIZE), None), slice(int(0.75 * SIZE), None))
    assert np.abs(pale[corner].astype(int) - plain[corner]).max() > 100, "the scale is in the lower right corner"
    with pytest.raises(ValueError, match="scalars have shape"):
        renderer.render([Body(body.vertices, body.faces, scalars=np.zeros(3))])


def test_a_body_is_drawn_in_the_colours_of_its_vertices(renderer, body):
    plain = renderer.render([body])
    colors = np.tile(np.rint(255.0 * np.array(GREEN)).astype(np.uint8), (len(body.vertices), 1))
    dressed = Body(body.vertices, body.faces, colors=colors)
    assert np.abs(renderer.render([dressed]).astype(int) - plain).max() <= 2
    upper = np.asarray(body.vertices)[:, 2] > 1.0
    half = Body(body.vertices, body.faces, colors=np.where(upper[:, None], colors, np.uint8(128)))
    covered = bounds(green(renderer.render([half])))
    assert covered[2] == bounds(green(plain))[2] and covered[3] < bounds(green(plain))[3] - 20
    strained = Body(body.vertices, body.faces, colors=colors, scalars=np.zeros(len(colors)))
    assert green(renderer.render([strained])).sum() == 0
    with pytest.raises(ValueError, match="colors have shape"):
        renderer.render([Body(body.vertices, body.faces, colors=colors[:3])])


def test_a_body_is_drawn_in_its_texture(renderer, body):
    """Stripes whose places are the columns of the picture, each wider than the triangles that show them."""
    at = project(np.asarray(body.vertices, np.float64)) / SIZE
    stripes = np.zeros((8, 8, 3), np.uint8)
    stripes[:, ::2], stripes[:, 1::2] = (255, 0, 0), (0, 0, 255)
    count = len(body.vertices)
    white = np.full((count, 3), 255, np.uint8)
    textures = Textures((Texture(stripes),), np.zeros(len(body.faces), int), at.astype(np.float32), white)
    beside = np.full((count, 3), (10, 230, 10), np.uint8)
    textured = Body(body.vertices, body.faces, colors=beside, textures=textures)
    seen = renderer.render([textured]).astype(int)
    covered = green(renderer.render([body]))
    stripe, within = np.divmod((np.arange(SIZE) + 0.5) * 8.0 / SIZE, 1.0)
    clear = covered & (np.abs(within - 0.5) < 0.35)[None]
    clear[1:-1] &= covered[:-2] & covered[2:]
    clear[:, 1:-1] &= covered[:, :-2] & covered[:, 2:]
    red = np.broadcast_to(stripe % 2 == 0, clear.shape)
    assert (clear & red).sum() > 200 and (clear & ~red).sum() > 200
    assert ((seen[..., 0] > seen[..., 2]) == red)[clear].mean() > 0.99
    # without their textures, and in the colours of a quantity, they are as they were
    colored = renderer.render([Body(body.vertices, body.faces, colors=beside)])
    assert (green(colored) == covered).mean() > 0.99
    scalars = np.zeros(count)
    plain, both = (
        renderer.render([Body(body.vertices, body.faces, scalars=scalars, textures=own)]) for own in (None, textures)
    )
    assert np.array_equal(plain, both)
    assert np.array_equal(renderer.render([textured]), seen)


def test_only_fronts_are_drawn(renderer, body):
    # Cloth has two sides at the same place: drawn from behind, either would flicker through the other.
    eye = np.array(FIXED.position)
    side, up, middle = np.cross(eye, [0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.9])
    side *= 0.3 / np.linalg.norm(side)
    corners = np.stack([middle - side, middle + side, middle + side + 0.4 * up, middle - side + 0.4 * up])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    shown = [green(renderer.render([Body(corners, way, color=GREEN)])).sum() for way in (faces, faces[:, ::-1].copy())]
    assert min(shown) == 0 and max(shown) > 100


def test_a_body_that_blew_up_is_drawn(renderer, body):
    vertices = body.vertices.copy()
    vertices[::50] = np.nan
    vertices[7] = np.inf
    assert renderer.render([Body(vertices, body.faces)]).shape == (SIZE, SIZE, 3)
    assert renderer.render([Body(np.full_like(vertices, np.nan), body.faces)], follow=np.full(3, np.nan)).any()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_memory_does_not_grow(renderer, body):
    def resident() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    def draw(count: int) -> None:
        for index in range(count):
            markers = [Sphere((0.4, -0.4, 1.2), 0.06)] * (index % 3)
            renderer.render([shifted(body, (0.001 * index, 0.0, 0.0))], markers)

    draw(10)
    before = resident()
    draw(40)
    assert resident() - before < 10.0, "MiB in 40 frames"


def test_bad_requests_are_refused(body):
    with pytest.raises(ValueError, match="width=4 px"):
        Renderer(4, 100)
    with pytest.raises(ValueError, match="field_of_view=0"):
        Camera(field_of_view=0)
    renderer = Renderer(SIZE, SIZE)
    with pytest.raises(ValueError, match="nothing to show"):
        renderer.render([])
    renderer.close()
    renderer.close()
    with pytest.raises(RuntimeError, match="closed"):
        renderer.render([body])


def test_pictures_without_text_need_no_library(body):
    code = (
        "import sys; sys.modules['PIL'] = None\n"
        "from piavatar_envs.render import Renderer, Sphere\n"
        "with Renderer(64, 64) as renderer: assert renderer.render([], [Sphere((0, 0, 1), 0.3)]).any()\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=180)
    assert result.returncode == 0, result.stderr


#: Draws here and in the place that ``argv`` names: threads, or processes started by a method of multiprocessing.
ELSEWHERE = """
import multiprocessing, sys, threading
import numpy as np
from piavatar_envs.render import Renderer, Sphere

def picture(renderer):
    return renderer.render([], [Sphere((0, 0, 1), 0.3)], elapsed=0.0)

def send(pipe, kept):
    pipe.send([picture(Renderer(64, 64)) for _ in range(2)] + ([picture(kept)] if kept else []))

if __name__ == "__main__":
    here, kept, place = Renderer(64, 64), Renderer(64, 64), sys.argv[1]
    expected, found = picture(here), []
    picture(kept)
    if place == "thread":
        threads = [
            threading.Thread(target=lambda own: found.extend(picture(own) for _ in range(20)), args=(own,))
            for own in (Renderer(64, 64), kept)
        ]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            picture(here)
    else:
        context = multiprocessing.get_context(place)
        ours, theirs = context.Pipe()
        process = context.Process(target=send, args=(theirs, kept if place == "fork" else None))
        process.start()
        assert ours.poll(100.0), "no picture came"
        found = ours.recv()
        process.join()
    assert len(found) in (2, 3, 40) and all(np.array_equal(each, expected) for each in found)
    assert np.array_equal(picture(here), expected)
"""


@pytest.mark.parametrize("place", ["thread", "spawn", "fork", "forkserver"])
def test_pictures_elsewhere_are_the_same(place, tmp_path):
    if place != "thread" and place not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {place} on this system")
    script = tmp_path / "elsewhere.py"
    script.write_text(ELSEWHERE)
    result = subprocess.run([sys.executable, script, place], capture_output=True, text=True, timeout=180)
    assert result.returncode == 0 and not result.stdout, result.stderr
