"""`jaxpose view` in a browser: the slider moves the camera and shows the render of its time."""

import io as std_io
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import trimesh
from PIL import Image

from jaxpose.cli.view import page as view_page
from jaxpose.cli.view.scene import WIDTH, read_scene

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# WebGL without a graphics card, and a sandbox that root may not have.
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SIZE, PANEL = (1280, 800), 940  # [px] the page, and where its panel begins
PICTURE = "img[src^='blob:'], img[src^='data:image/png']"


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason='needs pip install -e ".[viewer-test]"')
    found = next((path for path in map(shutil.which, BROWSERS) if path), None)
    if found is None:
        pytest.skip(f"needs a browser: none of {', '.join(BROWSERS)} is installed")
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=found, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module", params=["rgbd_slam", "noisy_nerf", "event_nerf"])
def smoke_run(request, tmp_path_factory):
    """A run of seconds, by the command itself."""
    out = tmp_path_factory.mktemp("runs") / request.param
    command = [sys.executable, "-m", f"jaxpose.experiments.{request.param}", "--smoke", "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True)
    return out


@pytest.fixture
def address(smoke_run):
    """Where the viewer shows the run; Ctrl-C then ends it without a word."""
    command = [sys.executable, "-m", "jaxpose", "view", str(smoke_run), "--port", "0", "--frustums", "3"]
    viewer = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield viewer.stdout.readline().split()[0]
        viewer.send_signal(signal.SIGINT)
        assert viewer.wait(20) == 0 and viewer.stderr.read() == ""
    finally:
        viewer.kill()


def pixels(png):
    return np.asarray(Image.open(std_io.BytesIO(png)).convert("RGB"))


def shown_picture(page):
    """The render in the panel, as the browser has it."""
    read = """async image => {
        const bytes = new Uint8Array(await (await fetch(image.src)).arrayBuffer());
        return Array.from(bytes);
    }"""
    return pixels(bytes(page.locator(PICTURE).evaluate(read)))


def until(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.2)


def to_green(screenshot, place):
    """Distance [px] from a row and column to the nearest pixel of the camera's frustum, by its colour."""
    r, g, b = np.moveaxis(screenshot[:, :PANEL].astype(int), -1, 0)
    found = np.argwhere((g > r + 30) & (g > b + 30))
    assert len(found) > 100
    return np.linalg.norm(found - place, axis=1).min()


def on_screen(scene, points):
    """Row and column of points, from where the page is looked at first (field of view 75 degrees)."""
    surface = trimesh.load(scene.surface, process=False).vertices if scene.surface else scene.path[:0]
    eye, centre, _ = view_page.overview(scene, np.asarray(surface))
    forward = centre - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, scene.up)
    right = right / np.linalg.norm(right)
    away = points - eye
    scale = SIZE[1] / 2 / np.tan(np.radians(75) / 2) / (away @ forward)
    row = SIZE[1] / 2 - scale * (away @ np.cross(right, forward))
    return np.stack([row, SIZE[0] / 2 + scale * (away @ right)], axis=-1)


@pytest.mark.slow
def test_the_slider_moves_the_camera_and_shows_the_render_of_its_time(browser, address, smoke_run):
    scene = read_scene(smoke_run, 0)
    last = float(scene.t[-1])
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(address)
    page.wait_for_selector("canvas")
    page.wait_for_selector(PICTURE)
    np.testing.assert_array_equal(shown_picture(page), scene.render(0.0, WIDTH))
    switches = page.get_by_role("checkbox").first.bounding_box()
    for label in ("estimate (blue)", "frames", "map"):  # what may hide the camera or be as green
        text = page.get_by_text(label, exact=True)
        if text.count():
            box = text.bounding_box()
            page.mouse.click(switches["x"] + switches["width"] / 2, box["y"] + box["height"] / 2)
    time.sleep(5)
    before = pixels(page.screenshot())
    value = round(0.7 * last, 2)
    field = page.locator("input[inputmode]").first
    field.fill(str(value))
    field.press("Enter")
    expected = scene.render(value, WIDTH)
    assert (expected != scene.render(0.0, WIDTH)).any()
    until(lambda: np.array_equal(shown_picture(page), expected))
    time.sleep(5)
    after = pixels(page.screenshot())
    # Where the tip of its frustum has to be, before and after: there it is, and not at the other time.
    first, then = on_screen(scene, scene.poses(np.array([0, value]))[:, :3, 3])
    assert np.linalg.norm(first - then) > 20
    there = to_green(before, first), to_green(after, then)
    elsewhere = to_green(before, then), to_green(after, first)
    assert max(there) < 8 and min(elsewhere) > 12, (there, elsewhere)
    here = ("data:", "blob:", address)
    assert [url for url in asked if not url.startswith(here)] == []  # nothing from the network
