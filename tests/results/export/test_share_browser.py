"""The page in a browser: what it draws against our rasterizer, every control pressed, and no request made.

Needs a Chromium of the system; the extra ``test`` brings Playwright.
"""

import base64
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from browsers import PATIENCE, chromium
from random_runs import KINDS, random_state, ring
from torch import Tensor

from polarguide.capture.presentation import Chart, Presentation
from polarguide.core.files import write_text
from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import rasterize_cpu
from polarguide.raster.magnification import footprints
from polarguide.results.export.web_page import share_page
from polarguide.shading.gbuffer import render
from polarguide.shading.model import ShadingModel
from polarguide.shading.result import RenderResult
from polarguide.training.context import TrainingState
from polarguide.visualization.figures import layer_picture

pytestmark = pytest.mark.slow
CHART = Chart(((1.2, -0.3, 0.1), (-0.2, 1.1, 0.1), (0.1, -0.4, 1.5)), 1.0, 2.0, 24, "v0")
LEAST = 40.0  # dB; the promise is 30, what is seen is above 55


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


class Opened:
    """A page in the browser, with what it asked for and complained about."""

    def __init__(self, browser: Any, path: Path, width: int = 640, height: int = 420) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": height}, has_touch=True)
        self.page.set_default_timeout(1000 * PATIENCE)
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        self.page.goto(path.as_uri())
        self.until("document.getElementById('message').hidden")

    def until(self, condition: str) -> None:
        """Wait for an expression; Playwright's own waiting evaluates text, which the page's policy forbids."""
        end = time.monotonic() + PATIENCE
        while not self.page.evaluate(condition):
            assert time.monotonic() < end, f"{condition}: {self.message()} {self.complaints}"
            time.sleep(0.05)

    def message(self) -> str:
        return str(self.page.evaluate("document.getElementById('message').textContent"))

    def settled(self) -> None:
        self.until("!polarguide.waiting && !polarguide.drawing && !polarguide.moving")

    def shot(self) -> np.ndarray:
        """The picture without what is written over it, and without a frame around it."""
        self.page.evaluate("document.activeElement.blur()")
        for name in ("legend", "drag", "left", "right"):
            self.page.evaluate(f"document.getElementById('{name}').hidden = true")
        self.settled()
        return decoded(self.page.locator("#stage").screenshot())

    def look(self) -> dict[str, Any]:
        found = self.page.evaluate("({eye: polarguide.navigation.eye, looks: polarguide.looks})")
        return dict(found)

    def pictures(self, view: str, layers: list[str]) -> list[np.ndarray]:
        addresses = self.page.evaluate("([v, l]) => polarguide.pictures(v, l)", [view, layers])
        return [decoded(base64.b64decode(address.split(",")[1])) for address in addresses]


def decoded(data: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return np.ascontiguousarray(picture[..., ::-1])


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-9)))


def trained_at_half_size(state: TrainingState, *, metal: bool = False) -> Tensor | None:
    """Footprints with which Gaussians of the ring's pictures are drawn wider; none for metals."""
    cameras = [camera.downscaled(2) for camera in ring().values()]
    return None if metal else footprints(state.gaussians["means"].detach(), cameras)


def written(recipe: str, folder: Path, *, metal: bool = False) -> Path:
    state, shading = random_state(recipe, metal=metal)
    path = folder / f"{recipe}.html"
    write_text(
        path,
        share_page(
            state.gaussians,
            state.light,
            shading,
            ring(),
            first="v0",
            title="<b>title</b>",
            caption="&",
            footprints=trained_at_half_size(state, metal=metal),
        ),
    )
    return path


def drawn(
    state: TrainingState, shading: ShadingModel, camera: Camera, footprints: Tensor | None
) -> RenderResult:
    return render(
        state.gaussians, camera, rasterize_cpu, shading=shading, light=state.light, footprints=footprints
    )


@torch.no_grad()
def ours(recipe: str, layer: str, camera: Camera, *, metal: bool = False) -> np.ndarray:
    state, shading = random_state(recipe, metal=metal)
    result = drawn(state, shading, camera, trained_at_half_size(state, metal=metal))
    picture = layer_picture(result, layer, camera)
    assert picture is not None
    return picture


@pytest.mark.parametrize(
    ("recipe", "metal"), [*((recipe, False) for recipe in KINDS), ("polarguide-stokes", True)]
)
def test_layers_agree_with_the_rasterizer(recipe: str, metal: bool, browser: Any, tmp_path: Path) -> None:
    opened = Opened(browser, written(recipe, tmp_path, metal=metal), 200, 300)
    cameras = ring()
    layers = opened.page.evaluate("polarguide.scene.layers")
    assert ("metalness" in layers) == metal
    for view in ("v0", "v2"):
        for layer, picture in zip(layers, opened.pictures(view, layers), strict=True):
            found = psnr(picture, ours(recipe, layer, cameras[view], metal=metal))
            assert found > LEAST, f"{view} {layer}: {found:.1f} dB"
    own = [url for url in opened.requests if not url.startswith(("file:", "blob:null/"))]
    assert not own
    assert opened.requests[0].startswith("file:")
    assert sum(url.startswith("file:") for url in opened.requests) == 1
    assert not opened.complaints
    opened.page.close()


@pytest.fixture(scope="module")
def local(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    opened = Opened(browser, written("polarguide-stokes", tmp_path_factory.mktemp("page")))
    yield opened
    assert not opened.complaints
    opened.page.close()


@pytest.fixture
def fresh(local: Opened) -> Opened:
    local.page.click("#reset")
    local.settled()
    return local


def test_names_are_text(fresh: Opened) -> None:
    assert fresh.page.inner_text("h1") == "<b>title</b>"
    assert fresh.page.title() == "<b>title</b>"


def test_layer_buttons_and_keys(fresh: Opened) -> None:
    final = fresh.shot()
    for key, name in enumerate(fresh.page.evaluate("polarguide.scene.layers"), start=1):
        fresh.page.click(f"button[data-layer={name}]")
        assert fresh.page.get_attribute(f"button[data-layer={name}]", "aria-pressed") == "true"
        chosen = fresh.shot()
        assert (name == "final") == bool((chosen == final).all())
        fresh.page.click("button[data-layer=final]")
        fresh.page.focus("#picture")
        fresh.page.keyboard.press(str(key))
        assert (fresh.shot() == chosen).all()


def test_a_layer_is_explained_and_the_hint_goes_when_it_was_followed(fresh: Opened) -> None:
    fresh.page.click("button[data-layer=roughness]")
    said = [fresh.page.inner_text(f"#{part}") for part in ("sentence", "low", "high")]
    assert said == ["roughness: the blur of mirror images", "mirror", "matte"]
    fresh.page.click("#compare")
    assert [fresh.page.inner_text(f"#{side}") for side in ("left", "right")] == ["without gloss", "roughness"]
    fresh.page.click("#reset")
    assert not fresh.page.is_visible("#ends")
    fresh.page.evaluate("document.getElementById('drag').className = ''")
    fresh.page.focus("#picture")
    fresh.page.keyboard.press("ArrowLeft")
    fresh.settled()
    assert fresh.page.get_attribute("#drag", "class") == "done"


def test_mouse_turns_shifts_and_zooms(fresh: Opened) -> None:
    def drag(**how: Any) -> float:
        before, distance = (
            fresh.look()["eye"],
            fresh.page.evaluate("Math.hypot(...polarguide.navigation.eye)"),
        )
        fresh.page.mouse.move(300, 150)
        fresh.page.mouse.down(**how)
        fresh.page.mouse.move(340, 160)
        fresh.page.mouse.up(**how)
        assert fresh.look()["eye"] != before
        return float(abs(fresh.page.evaluate("Math.hypot(...polarguide.navigation.eye)") - distance))

    assert drag() < 1e-3  # about the scene: the distance stays
    assert drag(button="right") > 1e-3
    fresh.page.keyboard.down("Shift")
    assert drag() > 1e-3
    fresh.page.keyboard.up("Shift")
    before = fresh.page.evaluate("Math.hypot(...polarguide.navigation.eye)")
    fresh.page.mouse.wheel(0, -200)
    fresh.until(f"Math.hypot(...polarguide.navigation.eye) < 0.9 * {before}")


def test_keyboard_moves(fresh: Opened) -> None:
    fresh.page.focus("#picture")
    for key in ("ArrowLeft", "ArrowUp", "Shift+ArrowRight", "Shift+ArrowDown", "+", "-", "n", "p"):
        before = fresh.look()["eye"]
        fresh.page.keyboard.press(key)
        assert fresh.look()["eye"] != before, key


def test_keys_work_without_a_click_and_sliders_keep_theirs(fresh: Opened) -> None:
    fresh.page.evaluate("document.activeElement.blur()")
    before = fresh.look()
    fresh.page.keyboard.press("ArrowLeft")
    fresh.page.keyboard.press("2")
    after = fresh.look()
    assert after["eye"] != before["eye"]
    assert after["looks"]["layer"] != before["looks"]["layer"]
    fresh.page.focus("#exposure")
    fresh.page.keyboard.press("ArrowRight")
    assert fresh.look()["eye"] == after["eye"]
    assert fresh.look()["looks"]["exposure"] > 1


@pytest.mark.parametrize("size", [(1280, 720), (390, 844)])
def test_title_and_picture_fit_without_scrolling(fresh: Opened, size: tuple[int, int]) -> None:
    fresh.page.set_viewport_size({"width": size[0], "height": size[1]})
    for name in ("h1", "header p", "#picture", "#panel"):
        box = fresh.page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["y"] >= 0
        assert box["x"] + box["width"] <= size[0]
        assert box["y"] + box["height"] <= size[1]
    picture = fresh.page.locator("#picture").bounding_box()
    assert picture["height"] > 0.6 * size[1]


def test_the_subject_is_in_the_middle_when_it_opens(fresh: Opened) -> None:
    shown = """() => {
        const camera = polarguide.navigation.camera(400, 800), point = polarguide.scene.center;
        const local = add(apply(camera.rotation, point), camera.translation);
        return [camera.fx * local[0] / local[2] + camera.cx, camera.fy * local[1] / local[2] + camera.cy, camera.fx];
    }"""
    fresh.page.click("#reset")
    x, y, upright = fresh.page.evaluate(shown)
    assert abs(x - 200) < 20
    assert abs(y - 400) < 40
    fresh.page.keyboard.press("n")
    fresh.page.keyboard.press("p")
    assert fresh.page.evaluate(shown)[2] < upright  # at a photograph's pose, all of it is shown


def test_fingers_turn_and_pinch(fresh: Opened) -> None:
    send = fresh.page.context.new_cdp_session(fresh.page).send

    def touch(kind: str, *points: tuple[int, int]) -> None:
        send(
            "Input.dispatchTouchEvent",
            {"type": kind, "touchPoints": [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]},
        )

    before = fresh.look()["eye"]
    touch("touchStart", (300, 150))
    touch("touchMove", (330, 150))
    touch("touchEnd")
    assert fresh.look()["eye"] != before
    distance = fresh.page.evaluate("Math.hypot(...polarguide.navigation.eye)")
    touch("touchStart", (280, 150), (320, 150))
    touch("touchMove", (240, 150), (360, 150))
    touch("touchEnd")
    fresh.until(f"Math.hypot(...polarguide.navigation.eye) < 0.8 * {distance}")


@pytest.mark.parametrize(("slider", "value"), [("turn", "90"), ("gain", "0"), ("exposure", "1")])
def test_sliders_change_the_picture(fresh: Opened, slider: str, value: str) -> None:
    before = fresh.shot()
    fresh.page.fill(f"#{slider}", value)
    assert not (fresh.shot() == before).all()
    fresh.page.click("#reset")
    assert (fresh.shot() == before).all()


def test_turning_the_environment_by_keys(fresh: Opened) -> None:
    fresh.page.focus("#picture")
    fresh.page.keyboard.press("]")
    fresh.page.keyboard.press("]")
    fresh.page.keyboard.press("[")
    assert fresh.look()["looks"]["turn"] == 5


def test_the_slider_parts_diffuse_from_final(fresh: Opened) -> None:
    final = fresh.shot()
    fresh.page.click("button[data-layer=diffuse]")
    diffuse = fresh.shot()
    fresh.page.click("button[data-layer=final]")
    fresh.page.click("#compare")
    width, handle = final.shape[1], fresh.page.locator("#handle").bounding_box()
    assert handle
    fresh.page.mouse.move(handle["x"] + 12, 40)
    fresh.page.mouse.down()
    fresh.page.mouse.move(0.25 * width, 40)
    fresh.page.mouse.up()
    parted = fresh.shot()
    left, right = slice(0, width // 4 - 30), slice(width // 4 + 30, width)
    assert (parted[:, left] == diffuse[:, left]).all()
    assert (parted[:, right] == final[:, right]).all()
    fresh.page.focus("#handle")
    fresh.page.keyboard.press("ArrowRight")
    assert fresh.page.get_attribute("#handle", "aria-valuenow") == "27"


def test_views_are_chosen_by_name(fresh: Opened) -> None:
    fresh.page.select_option("#view", label="v3")
    np.testing.assert_allclose(fresh.look()["eye"], ring()["v3"].center.tolist(), atol=1e-6)


def test_the_screen_shows_what_pictures_gives(fresh: Opened) -> None:
    """At rest the whole photograph fits the stage: its middle rows are those of our rasterizer at that size."""
    size = fresh.page.evaluate("[polarguide.canvas.width, polarguide.canvas.height]")
    record = fresh.page.evaluate(f"polarguide.navigation.camera({size[0]}, {size[1]})")
    camera = ring()["v0"]
    numbers = {key: record[key] for key in ("width", "height", "fx", "fy", "cx", "cy")}
    seen = Camera(**numbers, rotation=camera.rotation, translation=camera.translation)
    shot = fresh.shot()[: size[1], : size[0]]  # the stage may end within a pixel
    assert psnr(shot, ours("polarguide-stokes", "final", seen)) > LEAST


def test_a_page_with_a_tone_curve_shows_highlights_as_our_pictures_do(browser: Any, tmp_path: Path) -> None:
    state, shading = random_state("polarguide-stokes")
    presentation = Presentation(chart=CHART, exposure=2.0, tone_curve="soft")
    path = tmp_path / "page.html"
    page = share_page(
        state.gaussians, state.light, shading, ring(), first="v0", title="t", presentation=presentation
    )
    write_text(path, page)
    opened = Opened(browser, path)
    camera = ring()["v0"]
    layers = ["final", "diffuse", "specular", "normal"]
    with torch.no_grad():
        result = drawn(state, shading, camera, None)
    shown = dict(zip(layers, opened.pictures("v0", layers), strict=True))
    for layer in layers:
        expected = layer_picture(result, layer, camera, presentation=presentation)
        assert psnr(shown[layer], expected) > LEAST, layer
    clipped = layer_picture(result, "final", camera, presentation=Presentation(chart=CHART, exposure=2.0))
    assert psnr(shown["final"], clipped) < 25
    opened.page.evaluate("delete polarguide.scene.toneCurve")
    assert psnr(opened.pictures("v0", ["final"])[0], clipped) > LEAST
    assert not opened.complaints
    opened.page.close()


def test_a_presented_page_shows_white_scale_and_credit_and_turns_about_its_axis(
    browser: Any, tmp_path: Path
) -> None:
    state, shading = random_state("polarguide-stokes")
    axis = np.array([0.36, -0.8, 0.48])
    presentation = Presentation(
        chart=CHART,
        exposure=-0.5,
        up_axis=(0.36, -0.8, 0.48),
        meters_per_unit=0.1,
        author="A & B",
        license="CC0",
    )
    path = tmp_path / "page.html"
    text = share_page(
        state.gaussians,
        state.light,
        shading,
        ring(),
        first="v0",
        title="t",
        presentation=presentation,
        footprints=trained_at_half_size(state),
    )
    write_text(path, text)
    opened = Opened(browser, path)
    camera = ring()["v0"]
    with torch.no_grad():
        result = drawn(state, shading, camera, trained_at_half_size(state))
    expected = layer_picture(result, "final", camera, presentation=presentation)
    assert psnr(opened.pictures("v0", ["final"])[0], expected) > LEAST
    plain = ours("polarguide-stokes", "normal", camera)
    assert psnr(opened.pictures("v0", ["normal"])[0], plain) > LEAST
    opened.page.keyboard.press("w")
    unbalanced = opened.pictures("v0", ["final"])[0]
    exposed = layer_picture(result, "final", camera, presentation=Presentation(exposure=-0.5))
    assert psnr(unbalanced, exposed) > LEAST
    assert not opened.page.is_checked("#white")
    opened.page.click("#white")

    assert opened.page.inner_text(".credit") == "© A & B, CC0"
    pixels, words = opened.page.evaluate(
        "[document.getElementById('scale').offsetWidth, document.getElementById('scale').textContent]"
    )
    number, unit = words.split()
    units = float(number) * {"cm": 0.01, "mm": 0.001, "m": 1.0}[unit] / 0.1
    pivot, eye, size = opened.page.evaluate(
        "[polarguide.navigation.pivot, polarguide.navigation.eye, "
        "[polarguide.canvas.clientWidth, polarguide.canvas.clientHeight]]"
    )
    shown = opened.page.evaluate(f"polarguide.navigation.camera({size[0]}, {size[1]}).fx")
    apart = float(np.linalg.norm(np.subtract(pivot, eye)))
    assert abs(pixels - units / apart * shown) < 1.5
    assert 0.09 * size[0] < pixels <= 0.25 * size[0] + 1

    height = float(np.dot(eye, axis))
    for _ in range(5):
        opened.page.keyboard.press("ArrowRight")
    turned = opened.look()["eye"]
    assert np.linalg.norm(np.subtract(turned, eye)) > 0.5
    assert abs(float(np.dot(turned, axis)) - height) < 1e-6
    opened.page.set_viewport_size({"width": 390, "height": 844})
    opened.settled()
    box, stage = (opened.page.locator(name).bounding_box() for name in ("#scale", "#stage"))
    assert stage["x"] <= box["x"]
    assert box["x"] + box["width"] <= stage["x"] + stage["width"]
    assert not opened.complaints
    opened.page.close()
