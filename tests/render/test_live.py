"""Live view: the server has the meshes of the scene. No browser is opened."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import socket
import sys
import urllib.request
import weakref
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.render import Arrow, Body, Camera, MovedSplats, Scene, Sphere
from piavatar_envs.render.coloring import NUM_BANDS, bands_of, color_by
from piavatar_envs.render.live import LiveView, _fitter
from scripts.synthetic_splats import on_body

GREEN = (0.0, 1.0, 0.0)


def test_a_missing_viser_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"\[live\]"):
        LiveView()


@pytest.fixture
def body(subject) -> Body:
    return Body(subject.body.vertices, subject.asset.faces, color=GREEN)


@pytest.fixture
def view():
    pytest.importorskip("viser", reason='needs pip install "piavatar-envs[live]"')
    view = LiveView(Camera(follow=1.0), port=8200)
    yield view
    view.close()


def handle(view: LiveView, name: str):
    return view.server.scene.get_handle_by_name(f"/world/{name}")


def names(view: LiveView) -> set[str]:
    return {name.removeprefix("/world/") for name in view._nodes}


def test_everything_in_the_scene_is_shown(view, body):
    markers = [Sphere((0.4, -0.4, 1.2), 0.06), Arrow((0, -1, 1), (0, 0.5, 0))]
    view.show(Scene([body], markers), None)
    assert names(view) == {"body_0", "sphere_0", "arrow_1"}
    shown = handle(view, "body_0")
    np.testing.assert_array_equal(shown.vertices, np.asarray(body.vertices, np.float32))
    np.testing.assert_array_equal(shown.faces, body.faces)
    assert shown.color == (0, 255, 0) and not shown.flat_shading
    for name, marker in (("sphere_0", markers[0]), ("arrow_1", markers[1])):
        np.testing.assert_allclose(handle(view, name).vertices, marker.mesh()[0], atol=1e-6)


def test_splats_are_shown_instead_of_the_mesh(view, body):
    cloud = on_body(load_asset(), 200)
    covariances = cloud.covariances()[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)
    splats = MovedSplats(cloud, cloud.means, covariances, cloud.rotations)
    view.show(Scene([replace(body, splats=splats)], []), None)
    assert names(view) == {"body_0_splats"}
    shown = handle(view, "body_0_splats")
    scale = np.asarray(shown.scale)
    np.testing.assert_allclose(shown.centers * scale, cloud.means, atol=1e-6)
    # splats of millimetres keep their shapes in half precision
    packed = np.ascontiguousarray(shown.buffer[:, 4:7]).view(np.float16).astype(float) * scale**2
    np.testing.assert_allclose(packed, covariances, atol=2e-3 * covariances.max(), rtol=2e-3)
    expected = np.rint(255.0 * np.clip(0.5 + 0.28209479 * cloud.sh[:, 0], 0.0, 1.0))
    np.testing.assert_allclose(shown.buffer[:, 7].copy().view(np.uint8).reshape(-1, 4)[:, :3], expected, atol=1)
    moved = MovedSplats(cloud, cloud.means + np.float32(0.25), np.full_like(covariances, np.nan), cloud.rotations)
    view.show(Scene([replace(body, splats=moved)], []), 0.1)
    assert handle(view, "body_0_splats") is shown
    np.testing.assert_allclose(shown.centers * scale, moved.means, atol=1e-6)
    colors = np.linspace(0.0, 1.0, 600).reshape(200, 3)
    view.show(Scene([replace(body, splats=replace(moved, colors=colors))], []), 0.1)
    sent = shown.buffer[:, 7].copy().view(np.uint8).reshape(-1, 4)
    np.testing.assert_array_equal(sent[:, :3], np.rint(255.0 * colors))
    np.testing.assert_array_equal(sent[:, 3], np.rint(255.0 * cloud.opacities))
    view.show(Scene([body], []), 0.1)
    assert names(view) == {"body_0"}


def test_meshes_are_moved_and_not_made_anew(view, body):
    view.show(Scene([body], [Sphere((0, 0, 1), 0.1)]), None)
    before = handle(view, "body_0")
    moved = Body(body.vertices + np.float32(0.25), body.faces, color=(1.0, 0.0, 0.0))
    view.show(Scene([moved], []), 0.1)
    assert handle(view, "body_0") is before and before.color == (255, 0, 0)
    np.testing.assert_array_equal(before.vertices, np.asarray(moved.vertices, np.float32))
    assert handle(view, "sphere_0") is None


def test_the_world_moves_below_the_camera_and_not_the_camera(view, body):
    """Move the world instead of the user's camera."""
    view.show(Scene([body], [], follow=np.array([3.3, -7.2, 0.9])), None)
    np.testing.assert_allclose(view.server.scene.get_handle_by_name("/world").position, [-3.3, 7.2, 0.0])
    np.testing.assert_array_equal(handle(view, "body_0").vertices, np.asarray(body.vertices, np.float32))
    # the ground repeats every metre: it moves with the world, and stays below the camera
    ground = np.array(view.server.scene.get_handle_by_name("/ground").position)
    assert np.abs(ground[:2]).max() <= 1.0
    np.testing.assert_allclose((ground[:2] + [3.3, -7.2]) % 1.0 % 1.0, 0.0, atol=1e-9)
    view.show(Scene([body], []), None)
    np.testing.assert_allclose(view.server.scene.get_handle_by_name("/world").position, 0.0)


def test_the_camera_follows_as_that_of_pictures(body):
    pytest.importorskip("viser")
    camera = Camera(follow=0.2)
    view = LiveView(camera, port=8200)
    view.show(Scene([body], [], follow=np.zeros(3)), None)
    view.show(Scene([body], [], follow=np.array([1.0, 0.0, 0.9])), 0.2)
    expected = camera.glide(np.zeros(2), np.zeros(2), np.array([1.0, 0.0]), 0.2)
    np.testing.assert_allclose(-np.array(view.server.scene.get_handle_by_name("/world").position)[:2], expected)
    view.close()


def test_strain_is_shown_in_bands_that_are_the_body(view, body):
    height = np.asarray(body.vertices, float)[:, 2]
    strained = Body(body.vertices, body.faces, scalars=0.2 * height - 0.01, scalar_max=0.3)  # beyond both ends, too
    bands = bands_of(strained)
    assert len(bands) == NUM_BANDS
    assert sum(len(band.faces) for band in bands) == len(body.faces)
    corners = np.sort(np.concatenate([band.vertices[band.faces].reshape(-1, 9) for band in bands]), axis=0)
    np.testing.assert_array_equal(corners, np.sort(body.vertices[body.faces].reshape(-1, 9), axis=0))
    for band in bands[1:-1]:
        middle = 0.2 * band.vertices[band.faces][..., 2].mean(axis=1) - 0.01
        assert (np.abs(middle * NUM_BANDS / 0.3 - band.number - 0.5) < 0.5 + 1e-4).all()
        np.testing.assert_allclose(band.color, color_by([(band.number + 0.5) * 0.3 / NUM_BANDS], 0.3)[0], atol=0.03)
    view.show(Scene([strained], []), None)
    assert names(view) == {f"body_0_band_{number}" for number in range(NUM_BANDS)} and view._scale.visible
    view.show(Scene([body], []), None)
    assert names(view) == {"body_0"} and not view._scale.visible


def test_a_look_is_shown_in_bands_of_its_colours(view, body):
    colors = np.zeros((len(body.vertices), 3), np.uint8)
    upper = np.asarray(body.vertices)[:, 2] > 1.0
    colors[upper] = (255, 0, 0)
    dressed = Body(body.vertices, body.faces, colors=colors)
    bands = bands_of(dressed)
    assert sum(len(band.faces) for band in bands) == len(body.faces)
    assert {(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)} == {tuple(np.round(band.color, 6)) for band in bands}
    view.show(Scene([dressed], []), None)
    before = {name: handle(view, name) for name in names(view)}
    assert len(before) == len(bands)
    view.show(Scene([Body(body.vertices + np.float32(0.1), body.faces, colors=colors)], []), 0.1)
    assert {name: handle(view, name) for name in names(view)} == before
    many = np.random.default_rng(0).integers(0, 256, colors.shape).astype(np.uint8)
    assert 1 < len(bands_of(Body(body.vertices, body.faces, colors=many))) <= NUM_BANDS


def test_strain_beyond_all_bounds_has_the_last_colour(body):
    broken = Body(body.vertices, body.faces, scalars=np.full(len(body.vertices), np.nan))
    assert [band.number for band in bands_of(broken)] == [NUM_BANDS - 1]
    scalars = np.zeros(len(body.vertices))
    scalars[body.faces[0]] = 1e30
    torn = {band.number: len(band.faces) for band in bands_of(Body(body.vertices, body.faces, scalars=scalars))}
    assert set(torn) == {0, NUM_BANDS - 1} and torn[NUM_BANDS - 1] >= 1


def test_a_body_that_blew_up_is_shown(view, body):
    vertices = np.array(body.vertices)
    vertices[::50] = np.nan
    vertices[7] = np.inf
    view.show(Scene([Body(vertices, body.faces)], [], follow=np.full(3, np.nan)), None)
    assert np.isfinite(handle(view, "body_0").vertices).all()
    assert np.isfinite(view.server.scene.get_handle_by_name("/world").position).all()


class Mouse:
    """Events of a mouse that drags a node, as the library sends them."""

    def __init__(self, node, number=0):
        self.node, self.number = node, number

    def send(self, phase: str, start, end, modifier: str = "cmd/ctrl") -> None:
        event = SimpleNamespace(
            phase=phase, start_position=tuple(start), end_position=tuple(end), target=self.node, client_id=self.number
        )
        for entry in self.node._impl.drag_cb:
            if entry.button == "left" and entry.modifier == modifier:
                asyncio.run(entry.callback(event))


def test_a_mouse_drags_bodies_and_nothing_else(view, body):
    view.show(Scene([body], [Sphere((0, 0, 1), 0.1)], follow=np.array([2.0, 3.0, 0.9])), None)
    mouse, start, end = Mouse(handle(view, "body_0")), np.array([0.1, 0.2, 1.0]), np.array([0.5, 0.2, 1.2])
    assert not view.drags
    mouse.send("start", start, start)
    mouse.send("update", start + 0.1, end)
    assert view.drags[0].body == 0
    np.testing.assert_allclose(view.drags[0].start, start + [2.0, 3.0, 0.0])  # the world has moved below the camera
    np.testing.assert_allclose(view.drags[0].end, end + [2.0, 3.0, 0.0])
    Mouse(handle(view, "body_0"), 5).send("start", start, end)  # of another browser
    mouse.send("end", start, end)
    assert list(view.drags) == [5]
    view.drags.clear()
    mouse.send("start", start, end, modifier=None)  # this turns the camera
    Mouse(handle(view, "sphere_0")).send("start", start, end)
    mouse.send("update", start, end)
    assert not view.drags
    view.pointer = "drag"
    mouse.send("start", start, end, modifier=None)
    assert list(view.drags) == [0]


def test_clicks_throw_while_the_pointer_does(view, body):
    view.show(Scene([body], [], follow=np.array([2.0, 3.0, 0.9])), None)

    class Thrower:
        thrown: ClassVar = []

        def throw(self, client, origin, direction):
            self.thrown.append((client, origin, direction))

    thrower = Thrower()
    view.on_throw(thrower.throw)
    event = SimpleNamespace(client_id=4, ray_origin=(1.0, 2.0, 3.0), ray_direction=(0.0, 1.0, 0.0))
    (entry,) = view.server.scene._scene_pointer_cb
    asyncio.run(entry.callback(event))
    assert not thrower.thrown
    view.pointer = "throw"
    asyncio.run(entry.callback(event))
    ((client, origin, direction),) = thrower.thrown
    assert client == 4
    np.testing.assert_allclose(origin, (3.0, 5.0, 3.0))
    np.testing.assert_allclose(direction, (0.0, 1.0, 0.0))


def test_a_window_higher_than_wide_begins_farther_away(monkeypatch):
    monkeypatch.setattr("piavatar_envs.render.live._SETTLE", 0.0)

    class Client:
        def __init__(self, aspect):
            self.camera = SimpleNamespace(aspect=aspect, position=None, look_at=None)

        def atomic(self):
            return contextlib.nullcontext()

    wide, narrow = Client(1.5), Client(0.5)
    for client in (wide, narrow):
        asyncio.run(_fitter(Camera((0.0, -4.0, 1.0), (0.0, 0.0, 1.0)))(client))
    assert wide.camera.position is None
    np.testing.assert_allclose(narrow.camera.position - narrow.camera.look_at, (0.0, -8.0, 0.0), atol=1e-9)
    assert -0.5 < narrow.camera.look_at[2] < 0.5


def port_of(view: LiveView) -> int:
    return int(view.url.rpartition(":")[2])


def test_the_next_port_is_used_where_one_is_busy(view, capsys):
    second = LiveView(port=port_of(view))
    assert port_of(second) > port_of(view)
    assert capsys.readouterr().out == f"live view: {second.url}\n"
    for url in (view.url, second.url):
        with urllib.request.urlopen(url, timeout=5.0) as answer:
            assert answer.status == 200 and b"<html" in answer.read()
    second.close()


def test_a_view_that_is_dropped_frees_the_port(body):
    pytest.importorskip("viser")
    view = LiveView(port=8200)
    view.show(Scene([body], []), None)
    port, gone = port_of(view), weakref.ref(view)
    del view
    gc.collect()
    assert gone() is None
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=5.0)


def test_closing_frees_the_port(capsys, monkeypatch):
    pytest.importorskip("viser")
    view, stops = LiveView(port=8200), []
    stop = view.server.stop
    monkeypatch.setattr(view.server, "stop", lambda: (stop(), stops.append(1)))
    capsys.readouterr()
    view.close()
    view.close()
    assert capsys.readouterr().out == "" and len(stops) == 1
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port_of(view)), timeout=5.0)


def test_no_page_of_the_browser_can_publish_it(view, monkeypatch):
    """Send the message by which the library would open a tunnel to the internet."""
    from viser import _messages

    handlers = view.server._websock_server._incoming_handlers[_messages.ShareUrlRequest]
    asked = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *_a, **_m: asked.append(1), raising=False)
    for handler in handlers:
        handler(0, _messages.ShareUrlRequest())
    view.server._thread_executor.submit(int).result(timeout=5.0)
    assert asked == [] and view.server.request_share_url() is None


@pytest.mark.parametrize("port", [0, -1, 65000])
def test_ports_out_of_range_are_refused(port):
    with pytest.raises(ValueError, match=rf"port={port} .*64536"):
        LiveView(port=port)
