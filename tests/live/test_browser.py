"""The live view in a real Chromium: every control of the page changes the simulation, and the pictures show it.

Skipped without Playwright, which ``make test-live`` installs in a folder of its own. Pictures go to ``LIVE_PICTURES``,
a folder, if it is set.
"""

from __future__ import annotations

import io
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from piavatar_envs.live.agents import agent_kinds
from piavatar_envs.live.setup import Setup
from piavatar_envs.live.show import Show
from piavatar_envs.sim.tuning import ALPHA, FRICTION, GRAVITY, STIFFNESS, TONE
from tests.live.shows import steps_done

pytest.importorskip("viser", reason='needs pip install "piavatar-envs[live]"')
playwright = pytest.importorskip("playwright.sync_api", reason="needs a browser: make test-live")
Image = pytest.importorskip("PIL.Image", reason="needs the extra render")

WIDTH, HEIGHT = 760, 480
#: Pages draw without a GPU here, so that everything takes long [ms].
PATIENCE = 120_000
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


def chromium() -> str | None:
    """Return the browser that CHROMIUM names or that is installed; None for Playwright's own."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)


class Page:
    """A page of the live view, and the show behind it."""

    def __init__(self, page, show: Show) -> None:
        self.page, self.show = page, show
        page.set_default_timeout(PATIENCE)
        page.goto(show.live.view.url)
        page.get_by_role("button", name="Single step").wait_for()
        # the note on rendering without a GPU lies over the scene
        page.add_style_tag(content="[class*=Notifications-root] {display: none}")

    def open(self, tab: str) -> None:
        """Open a tab of the panel."""
        self.page.get_by_role("tab", name=tab).click()

    def press(self, button: str) -> None:
        """Press a button."""
        self.page.get_by_role("button", name=button, exact=True).click()

    def choose(self, label: str, option: str) -> None:
        """Choose an option of a list."""
        self._row(label).locator("input").first.click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def slide(self, label: str, value: float) -> None:
        """Type a value into the field of a slider."""
        field = self._row(label).locator("input:not([type=hidden])").last
        field.fill(f"{value:g}")
        field.press("Enter")
        field.blur()

    def _row(self, label: str):
        """Return the innermost element that has both a label and an input."""
        named = self.page.locator("div").filter(has=self.page.get_by_text(label, exact=True))
        return named.filter(has=self.page.locator("input")).last

    def pixel(self, point: np.ndarray) -> tuple[float, float]:
        """Return where a point of the scene [m] is on the page [px]."""
        (client, *_) = self.show.live.view.server.get_clients().values()
        camera = client.camera
        seen = (
            Rotation.from_quat(camera.wxyz, scalar_first=True)
            .inv()
            .apply(np.asarray(point) + self.show.live.view.offset - camera.position)
        )
        focal = 0.5 * HEIGHT / np.tan(0.5 * camera.fov)
        return 0.5 * WIDTH + focal * seen[0] / seen[2], 0.5 * HEIGHT + focal * seen[1] / seen[2]

    def picture(self, name: str) -> np.ndarray:
        """Return a picture of the page, and keep it if a folder is given."""
        content = self.page.screenshot(timeout=PATIENCE)
        if folder := os.environ.get("LIVE_PICTURES"):
            Path(folder, f"{name}.png").write_bytes(content)
        return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), float)

    def until(self, what: Callable[[], object], seconds: float = 60.0) -> None:
        """Wait until a condition holds.

        Raises:
            AssertionError: it does not.
        """
        end = time.monotonic() + seconds
        while not what():
            assert time.monotonic() < end, f"{self.show.words!r}, {self.show.tuned}"
            self.page.wait_for_timeout(100)


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as library:
        opened = library.chromium.launch(executable_path=chromium(), args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture
def show(device, tmp_path) -> Iterator[Show]:
    """A show that plays in a thread."""
    setup = Setup("PIAvatar/KickBall-v0", {"fidelity": "tiny"}, "zero", 2, 4, device)
    show, ended, errors = Show(setup, agent_kinds(setup.env_id), 8700, folder=tmp_path), threading.Event(), []
    show.begin(4)

    def play() -> None:
        try:
            while not ended.is_set():
                show.turn()
        except BaseException as error:
            errors.append(error)
            raise

    thread = threading.Thread(target=play)
    thread.start()
    yield show
    ended.set()
    thread.join()
    show.close()
    assert not errors


@pytest.fixture
def page(browser, show) -> Iterator[Page]:
    opened = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    yield Page(opened, show)
    opened.close()


def tracked(show: Show, name: str) -> np.ndarray:
    """Return the position of a bone in the environment that is shown [m]."""
    batch, own = show.host.group_of(show.env)
    target = batch.simulation.receivers.find(name, 0)
    return target.frame.position.numpy()[own, target.column].astype(float)


def still(page: Page, show: Show, name: str) -> bool:
    """Return whether a bone moves by less than a millimetre in five control steps."""
    before, done = tracked(show, name), steps_done(show)
    page.until(lambda: not done <= steps_done(show) <= done + 5)  # a new episode counts from 0
    return bool(np.linalg.norm(tracked(show, name) - before) < 1e-3)


def test_play(page, show):
    page.press("Pause")
    page.until(lambda: not show.playing)
    before = show.played
    first = page.picture("paused")
    for expected in (1, 2):
        page.press("Single step")
        page.until(lambda expected=expected: show.played == before + expected)
    page.press("New episode")
    page.until(lambda: steps_done(show) == 0)
    page.slide("Speed", 0.5)
    page.until(lambda: show.speed == 0.5)
    page.choose("Environment", "1")
    page.until(lambda: show.env == 1)
    page.choose("Colour", "strain")
    page.until(lambda: show.live.color == "strain")
    page.page.wait_for_timeout(3000)
    assert np.abs(page.picture("strain") - first)[:, : WIDTH // 2].max() > 60.0
    page.press("Play")
    page.until(lambda: show.playing and show.played > before + 3)
    page.choose("Agent", "clip:squat")
    page.until(lambda: show.setup.agent == "clip:squat")
    height = tracked(show, "pelvis")[2]
    page.slide("Speed", 4.0)
    page.until(lambda: abs(show.host.groups[-1].simulation.avatars[0].tracked.local.numpy()[0, 4, 0]) > 0.1)
    assert height > 0.5
    page.picture("squat")


def test_tune(page, show):
    page.open("Tune")
    host = show.host
    for label, name, value in (
        ("Stiffness [kPa]", STIFFNESS, 40.0),
        ("Friction", FRICTION, 0.3),
        ("Gravity [m/s²]", GRAVITY, 2.0),
        ("Tone", TONE, 0.2),
        ("Alpha", ALPHA, 0.8),
    ):
        page.slide(label, value)
        page.until(
            lambda name=name, value=value: show.tuned.get(name) == value * (1000.0 if name == STIFFNESS else 1.0)
        )
    assert show.host is host
    page.slide("Stiffness [kPa]", 180.0)
    page.until(lambda: show.host is not host)
    page.page.get_by_text("shorter time step").wait_for()
    assert show.host.config.physics.young_modulus == 180_000.0 and show.host.config.control.tone == 0.2
    page.picture("tune")


def test_drag(page, show):
    """Drag the left hand and then the pelvis: the body part follows the mouse, and the force is read."""
    page.open("Touch")
    page.choose("Pointer", "drag")
    page.until(lambda: show.live.view.pointer == "drag")
    mouse = page.page.mouse
    for name in ("left_wrist", "pelvis"):
        page.until(lambda name=name: still(page, show, name))  # else the body may swing away before the button is down
        x, y = page.pixel(tracked(show, name))
        before = tracked(show, name)
        mouse.move(x, y)
        mouse.down()
        for step in range(1, 7):
            mouse.move(x + 10.0 * step, y - 5.0 * step)
        page.until(lambda: show.live.pull > 0.1)
        page.until(lambda name=name, before=before: np.linalg.norm(tracked(show, name) - before) > 0.01)
        page.picture(f"drag_{name}")
        mouse.up()
        page.until(lambda: show.live.pull == 0.0)


def test_throw(page, show):
    page.open("Touch")
    page.choose("Pointer", "throw")
    page.until(lambda: show.setup.ball and "ball to throw" in show.words)
    page.slide("Ball mass [kg]", 2.0)
    page.slide("Ball speed [m/s]", 8.0)
    page.until(lambda: show.ball == {"ball_mass": 2.0, "ball_speed": 8.0})
    page.page.mouse.click(*page.pixel(tracked(show, "spine3")))
    page.until(lambda: "thrown" in show.words)
    page.until(lambda: show.panel.impulse.data[2].max() > 1.0)
    props = show.host.groups[0].simulation.props
    ball = props.index("thrown_ball")
    assert props.density.numpy()[0, ball] * props.volume[ball] == pytest.approx(2.0)
    page.picture("throw")


def test_files(page, show, tmp_path):
    page.open("Files")
    with page.page.expect_download() as waiting:
        page.press("Record a clip")
        page.until(lambda: show.recording is not None and len(show.recording.frames) > 3)
        page.press("Stop, and download")
    clip = waiting.value
    assert clip.suggested_filename == "KickBall-v0.mp4" and b"ftyp" in Path(clip.path()).read_bytes()[:12]
    with page.page.expect_download() as waiting:
        page.press("Save the scene")
    scene = waiting.value
    assert scene.suggested_filename == "KickBall-v0-0.npz"
    played = np.load(scene.path())["state/env.step_count"]
    page.page.get_by_role("link", name="/open?scene=").wait_for()
    address = page.page.get_by_role("link", name="/open?scene=").get_attribute("href")
    page.choose("Clip", "gif")
    page.open("Play")
    page.choose("Agent", "random")
    page.until(lambda: show.setup.agent == "random")
    page.press("Pause")
    page.until(lambda: not show.playing)
    page.page.goto(address)
    page.until(lambda: show.setup.agent == "zero")
    np.testing.assert_array_equal(show.host.read(lambda group: group.step_count), played)
    assert page.page.url.rstrip("/") == show.live.view.url
    page.page.get_by_role("button", name="Single step").wait_for()
    page.press("New episode")
    page.until(lambda: steps_done(show) == 0)
    page.open("Files")
    copy = tmp_path / "copy.npz"
    scene.save_as(copy)
    page.page.locator("input[type=file]").set_input_files(copy)
    page.until(lambda: steps_done(show) == played[0])
    page.picture("files")


def test_two_browsers(browser, page, show):
    """Controls are shared, cameras are not."""
    page.press("Pause")  # two pages that draw on the processor starve each other
    page.until(lambda: not show.playing)
    other = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    second = Page(other, show)
    second.choose("Colour", "strain")
    page.until(lambda: show.live.color == "strain")
    assert page._row("Colour").locator("input").first.input_value() == "strain"
    first, last = (show.live.view.server.get_clients()[key] for key in sorted(show.live.view.server.get_clients()))
    before = first.camera.position
    other.mouse.move(200.0, 60.0)
    other.mouse.down()
    other.mouse.move(320.0, 80.0, steps=4)
    other.mouse.up()
    assert not show.playing
    page.until(lambda: np.linalg.norm(np.subtract(last.camera.position, before)) > 0.1)
    np.testing.assert_allclose(first.camera.position, before, atol=1e-6)
    assert np.abs(page.picture("first") - second.picture("second"))[:, : WIDTH // 2].max() > 60.0
    other.close()


def test_a_phone(browser, show):
    """The panel lies at the foot of a narrow window, and the whole body above it."""
    phone = browser.new_page(viewport={"width": 390, "height": 760}, has_touch=True, is_mobile=True)
    page = Page(phone, show)
    page.page.get_by_role("button", name="Pause", exact=True).tap()
    page.until(lambda: not show.playing)
    panel = phone.get_by_role("button", name="Single step").bounding_box()
    assert panel["y"] > 300.0 and panel["x"] + panel["width"] <= 390.0
    picture = page.picture("phone")
    assert picture[:, :, 2].std() > 5.0
    phone.close()
