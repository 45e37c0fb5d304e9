"""The viewer in a real browser: its picture at a photograph's pose against ``render``, and its controls.

Needs a Chromium of the system; the extra ``test`` brings Playwright.
"""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import viser
from browsers import PATIENCE, REBOUND, chromium
from random_runs import ring
from viewer_scenes import photograph, shown

from polarguide.capture.presentation import Presentation
from polarguide.viewer import Viewer
from polarguide.visualization import figures

pytestmark = pytest.mark.slow
WIDTH, HEIGHT = 960, 600
# Not under the panel, what viser says of software rendering, or the key of normals.
FREE = np.s_[200:520, : WIDTH - 350]
HOSTILE = '<img src=x onerror="window.hurt=1">{window.hurt=1}'


class Opened:
    """A viewer over random Gaussians, and a browser that looks at it."""

    def __init__(self, browser: Any) -> None:
        self.seen = shown()
        cameras = {**ring(width=WIDTH // 4, height=HEIGHT // 4)}
        cameras[HOSTILE] = cameras.pop("v5")
        self.photographs = {name: photograph(name, camera, self.seen) for name, camera in cameras.items()}
        self.viewer = Viewer(
            lambda: self.seen,
            self.photographs,
            shading=self.seen.shading,
            port=18080,
            save=lambda presentation: self.saved.append(presentation) or "Saved!",
            title=HOSTILE,
        )
        self.saved: list[Presentation] = []
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        self.page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        self.page.set_default_timeout(1000 * PATIENCE)
        self.requests: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(self.viewer.address)
        self.page.get_by_label("Layer", exact=True).first.wait_for()

    def _serve(self) -> None:
        while not self._ends.is_set():
            self.viewer.serve(0.2)

    def close(self) -> None:
        self.page.close()
        self._ends.set()
        self._thread.join()
        self.viewer.close()

    def screenshot(self) -> np.ndarray:
        data = np.frombuffer(self.page.screenshot(timeout=1000 * PATIENCE), dtype=np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])

    def until(self, holds: Callable[[np.ndarray], bool]) -> np.ndarray:
        """A screenshot for which something holds; the last one if it never does."""
        deadline = time.monotonic() + PATIENCE
        while True:
            picture = self.screenshot()
            if holds(picture) or time.monotonic() > deadline:
                return picture
            time.sleep(0.2)

    def choose(self, label: str, value: str) -> None:
        self.page.get_by_label(label, exact=True).first.click()
        self.page.get_by_role("option", name=value, exact=True).click()

    def expected(self, name: str, layer: str = "final") -> np.ndarray:
        """What ``render`` gives for a photograph's camera at the window's size, the aspect being the same."""
        lens = self.photographs[name].view.camera
        scaled = {key: 4 * getattr(lens, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        camera = replace(lens, **scaled)
        result = self.seen.render(camera, depth=True, surface=True)
        if layer == "normal":
            return figures.normal_to_rgb(result.normal, camera)
        return figures.radiance_to_rgb(result.layers[layer])


def psnr(picture: np.ndarray, expected: np.ndarray) -> float:
    error = np.mean(((picture - expected.astype(float))[FREE] / 255) ** 2)
    return float(-10 * np.log10(max(error, 1e-12)))


@pytest.fixture(scope="module")
def opened() -> Iterator[Opened]:
    with chromium() as browser, pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "polarguide.viewer.scenery.ARRIVAL", PATIENCE
        )  # a busy machine's browser takes its time
        viewing = Opened(browser)
        yield viewing
        viewing.close()


@pytest.mark.parametrize("layer", ["final", "specular", "normal", "diffuse"])
def test_layers_at_a_photographs_pose_are_those_of_render(opened, layer):
    opened.choose("Layer", layer)
    expected = opened.expected("v0", layer)
    found = opened.until(lambda picture: psnr(picture, expected) > 35)
    assert psnr(found, expected) > 35, opened.page.get_by_label("Go to").first.input_value()


def test_going_on_to_the_next_photograph(opened):
    opened.choose("Layer", "final")
    opened.page.get_by_text("next", exact=True).click()
    expected = opened.expected("v1")
    assert psnr(opened.until(lambda picture: psnr(picture, expected) > 35), expected) > 35


def test_dragging_turns_the_scene(opened):
    before = opened.screenshot()
    opened.page.mouse.move(200, 400)
    opened.page.mouse.down()
    opened.page.mouse.move(320, 430, steps=6)
    opened.page.mouse.up()
    assert psnr(opened.until(lambda picture: psnr(picture, before) < 30), before) < 30
    assert opened.page.get_by_label("Go to").first.input_value() == "(free)"


def test_a_path_and_a_picture_are_downloaded(opened):
    opened.page.get_by_text("Picture and camera path", exact=True).click()
    opened.page.get_by_role("button", name="Add keyframe").click()
    with opened.page.expect_download() as path:
        opened.page.get_by_role("button", name="Save path").click()
    assert path.value.suggested_filename == "camera_path.json"
    with opened.page.expect_download() as picture:
        opened.page.get_by_role("button", name="Save picture").click()
    assert picture.value.suggested_filename == "polarguide.png"


def test_the_exposure_is_saved(opened):
    opened.page.get_by_text("Crop", exact=True).first.click()
    opened.page.get_by_role("button", name="Save to the run").click()
    opened.page.get_by_text("Saved!").wait_for()
    assert opened.saved == [Presentation()]


def test_names_run_nothing_and_nothing_is_asked_of_others(opened):
    opened.choose("Go to", HOSTILE)
    expected = opened.expected(HOSTILE)
    opened.until(lambda picture: psnr(picture, expected) > 35)
    assert opened.page.evaluate("window.hurt") is None
    ours = opened.viewer.address.removeprefix("http://")
    strangers = [url for url in opened.requests if ours not in url and not url.startswith(("data:", "blob:"))]
    assert strangers == []


TALK = """(address) => new Promise((done) => {
    const socket = new WebSocket(address, [PROTOCOL]);
    socket.binaryType = "arraybuffer";
    socket.onmessage = () => done("pictures");
    socket.onerror = () => done("refused");
})""".replace("PROTOCOL", f'"viser-v{viser.__version__}"')
FRAME = """(address) => new Promise((done) => {
    const frame = document.createElement("iframe");
    frame.onload = () => setTimeout(() => done(frame.contentDocument === null ? "none" : "own"), 500);
    frame.src = address;
    document.body.append(frame);
})"""


@pytest.mark.parametrize(
    "site", ["http://hostile.example/", "https://hostile.example/", "http://localhost:9/"]
)
def test_a_hostile_page_sees_nothing(opened, site):
    """The page is another site's in the same browser; a sandboxed one has no origin at all."""
    page = opened.page.context.browser.new_page()
    page.route("**/*", lambda route: route.fulfill(body="<p>win</p>", content_type="text/html")
               if route.request.url.startswith(site) else route.continue_())  # fmt: skip
    page.goto(site)
    address = opened.viewer.address.replace("http", "ws")
    before = len(opened.viewer._sessions)
    if not site.startswith("https"):  # from there, the browser itself allows none
        assert page.evaluate(TALK, address) == "refused"
    page.evaluate(FRAME, opened.viewer.address)
    assert not any("Layer" in frame.content() for frame in page.frames)
    assert len(opened.viewer._sessions) == before
    page.close()


ASK = """async (address) => {
    const found = [];
    const loaded = (tag, name) => new Promise((done) => {
        const made = document.createElement(tag);
        made.onload = () => done(found.push(tag));
        made.onerror = () => done();
        made[name] = address + "/?" + tag;
        document.body.append(made);
    });
    await Promise.all([loaded("script", "src"), loaded("img", "src"), loaded("embed", "src"), new Promise((done) => {
        const events = new EventSource(address);
        events.onopen = () => done(found.push("events"));
        events.onerror = () => done(events.close());
    })]);
    const ways = [{}, {mode: "no-cors"}, {method: "POST", mode: "no-cors", body: "x"}, {credentials: "include"}];
    for (const more of ways)
        try {
            const answer = await fetch(address, more);
            if (answer.type !== "opaque" || (await answer.text()).length) found.push(JSON.stringify(more));
        } catch { }
    navigator.sendBeacon(address, "x");
    return found.filter((what) => what !== "embed");
}"""


def test_a_hostile_page_loads_nothing_of_the_viewer(opened):
    page = opened.page.context.browser.new_page()
    site = "http://hostile.example/"
    page.route("**/*", lambda route: route.fulfill(body="<p>win</p>", content_type="text/html")
               if route.request.url.startswith(site) else route.continue_())  # fmt: skip
    page.goto(site)
    assert page.evaluate(ASK, opened.viewer.address) == []
    assert opened._thread.is_alive()
    page.close()


def test_a_name_that_was_bound_to_this_machine_sees_nothing(opened):
    page = opened.page.context.browser.new_page()
    port = opened.viewer.address.rpartition(":")[2]
    answer = page.goto(f"http://{REBOUND}:{port}/")
    assert answer.status == 403
    assert "--allow-host" in answer.text()
    assert page.evaluate(TALK, f"ws://{REBOUND}:{port}") == "refused"
    page.close()


def test_the_viewers_own_page_talks_to_no_other_server(opened):
    """viser's page goes to any server that its address names, and would run what that one sends as the viewer's."""
    stranger = viser.ViserServer(port=18280, verbose=False)
    page = opened.page.context.browser.new_page()
    try:
        stranger.gui.add_html('<img src=x onerror="window.hurt = 1">')
        with page.expect_console_message(lambda said: "Connecting to" in said.text, timeout=1000 * PATIENCE):
            page.goto(f"{opened.viewer.address}/?websocket=ws://127.0.0.1:18280")
        page.wait_for_timeout(5000)
        assert not stranger.get_clients()
        assert page.evaluate("window.hurt") is None
    finally:
        page.close()
        stranger.stop()


def test_the_viewers_own_page_does_talk(opened):
    assert opened.page.evaluate(TALK, opened.viewer.address.replace("http", "ws")) == "pictures"
