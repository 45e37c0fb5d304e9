"""Picking white, up and a length in the viewer, with a fake in place of the browser; and what is saved of it."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import torch
from fake_browser import FakeClient
from viewer_scenes import frame_of_scene, photographs, shown

from polarguide.capture.presentation import (
    PRESENTATION_FILE,
    Crop,
    Presentation,
    read_presentation,
    write_presentation,
)
from polarguide.results.rendering.picking import gray_world_gains, surface_at, white_balance_gains
from polarguide.shading.result import LAYERS
from polarguide.viewer.guard import Refused, checked_message
from polarguide.viewer.panel import PanelOptions
from polarguide.viewer.server import save_to_run
from polarguide.viewer.session import Session
from polarguide.visualization import figures

AROUND = frame_of_scene()
WHITE = Presentation(white_balance=(0.5, 1.0, 1.5))


class Visit:
    """A session at a photograph's pose, whose every change is drawn at once."""

    def __init__(self, presentation: Presentation, save: Callable[[Presentation], str] | None) -> None:
        self.seen = shown()
        self.photographs = photographs(self.seen)
        self.client = FakeClient()
        options = PanelOptions(
            LAYERS, True, tuple(self.photographs), False, presentation, saves=save is not None
        )
        views = [p.view for p in self.photographs.values()]
        self.session = Session(
            self.client,
            self.photographs,
            AROUND,
            options,
            lambda: None,
            gray_world=lambda: gray_world_gains(views),
            save=save,
        )
        self.session.go("v0")
        self.client.camera.report()

    @property
    def camera(self):  # type: ignore[no-untyped-def]
        """With which the window, twice the photograph's size, is drawn."""
        return self.photographs["v0"].view.camera.extended(128, 96)

    def draw(self) -> np.ndarray:
        self.session.draw(self.seen, "sharp")
        return self.client.scene.pictures[-1][0]

    def press(self, label: str, value: str | None = None) -> None:
        control = self.client.control(label)
        if value is None:
            control.click()
        else:
            control.value = value

    def pick(self, what: str, *places: tuple[float, float]) -> list:  # type: ignore[type-arg]
        """Surfaces at places in pixels, after picking them."""
        result = self.seen.render(self.camera, depth=True, surface=True)
        self.press("Pick", what)
        found = []
        for x, y in places:
            found.append(surface_at(result, self.camera, x, y))
            self.client.scene.click(x / 128, y / 96)
            self.draw()
        return found

    @property
    def status(self) -> str:
        return str(self.client.control("status").value)

    @property
    def chosen(self) -> Presentation:
        return self.session._presenting.chosen


@pytest.fixture
def visit() -> Visit:
    return Visit(Presentation(), None)


def places(visit: Visit) -> list[tuple[float, float]]:
    """Two pixels where there is a surface with a normal, well apart."""
    result = visit.seen.render(visit.camera, depth=True, surface=True)
    rows, columns = torch.nonzero((result.alpha > 0.8) & (result.final.amin(dim=-1) > 0.02)).unbind(1)
    first, last = int(columns.argmin()), int(columns.argmax())
    return [(float(columns[k]) + 0.5, float(rows[k]) + 0.5) for k in (first, last)]


def test_a_picked_white_is_gray_in_the_picture_and_no_click_is_asked_for_any_more(visit: Visit) -> None:
    place = places(visit)[0]
    before = visit.draw()
    (found,) = visit.pick("white", place)
    gains = white_balance_gains(found.color)
    assert visit.chosen.white_balance == gains
    gray = found.color * torch.tensor(gains)
    torch.testing.assert_close(gray, gray[1].expand(3))
    result = visit.seen.render(visit.camera, depth=False)
    expected = figures.radiance_to_rgb(result.final * torch.tensor(gains))
    assert np.abs(visit.draw().astype(int) - expected).mean() < 0.5
    assert np.abs(before.astype(int) - expected).mean() > 2
    assert visit.client.scene.listeners == []
    visit.press("White", "as photographed")
    assert np.array_equal(visit.draw(), before)
    visit.press("White", "picked")
    assert visit.chosen.white_balance == gains


def test_gray_world_is_that_of_the_photographs(visit: Visit) -> None:
    visit.press("White", "gray world")
    mean = torch.cat([p.view.photograph()[~p.view.saturated] for p in visit.photographs.values()]).mean(dim=0)
    gains = torch.tensor(visit.chosen.white_balance)
    torch.testing.assert_close(mean * gains, mean[1].expand(3), rtol=1e-4, atol=0)


def test_nothing_and_black_are_no_white(visit: Visit) -> None:
    result = visit.seen.render(visit.camera, depth=True, surface=True)
    row, column = torch.nonzero(result.alpha < 0.1)[0].tolist()
    visit.pick("white", (column + 0.5, row + 0.5))
    assert "Nothing is there" in visit.status
    assert visit.chosen.white_balance is None
    assert len(visit.client.scene.listeners) == 1, "another click is waited for"


def test_a_level_surface_gives_up_and_the_camera_stands_along_it(visit: Visit) -> None:
    visit.press("Up", "as shown")
    upward = -visit.photographs["v0"].view.camera.rotation[1]
    assert visit.chosen.up_axis == pytest.approx(tuple(upward.tolist()))
    (found,) = visit.pick("level", places(visit)[0])
    assert visit.chosen.up_axis == pytest.approx(tuple(found.normal.tolist()))
    np.testing.assert_allclose(visit.client.camera.up_direction, found.normal.numpy())
    visit.press("Up", "of cameras")
    assert visit.chosen.up_axis is None


def test_a_length_is_measured_and_becomes_the_scale(visit: Visit) -> None:
    visit.press("Set scale")
    assert "Pick a length first" in visit.status
    ends = visit.pick("length", *places(visit))
    apart = float((ends[0].point - ends[1].point).norm())
    assert visit.client.control("Length").value == f"{apart:.4g} units"
    visit.client.control("Known, mm").value = 250.0
    visit.press("Set scale")
    assert visit.chosen.meters_per_unit == pytest.approx(0.25 / apart)
    assert visit.client.control("Length").value == "25 cm"
    line = visit.client.scene.boxes[-1][-1]
    np.testing.assert_allclose(line, torch.stack([end.point for end in ends]), atol=1e-5)


def test_what_was_saved_is_shown_and_the_box_stands_as_it_was(visit: Visit) -> None:
    crop = Crop((-0.123, -0.5, -0.5), (0.456, 0.5, 0.5), (0.0, 0.0, 1.0))
    saved: list[Presentation] = []

    def save(presentation: Presentation) -> str:
        saved.append(presentation)
        return "Saved"

    again = Visit(msgspec.structs.replace(WHITE, crop=crop, author="A"), save)
    assert again.client.control("White").value == "picked"
    again.press("Show box", True)  # type: ignore[arg-type]
    np.testing.assert_allclose(again.client.scene.boxes[-1][0][0], crop.corners(AROUND)[0], atol=1e-5)
    again.press("Save to the run")
    assert saved == [Presentation(white_balance=(0.5, 1.0, 1.5), crop=crop, author="A")]
    again.press("Down, up", (-10, 20))  # type: ignore[arg-type]
    assert again.session.panel.crop() == Crop((-0.12, -0.1, -0.5), (0.46, 0.2, 0.5))


def test_where_nothing_may_be_saved_the_browser_downloads_it(visit: Visit) -> None:
    visit.press("White", "gray world")
    visit.press("Download them")
    content = json.loads(visit.client.files[PRESENTATION_FILE])
    assert content == {"white_balance": list(visit.chosen.white_balance)}


def test_saving_keeps_the_run_s_credit_and_leaves_to_the_scene_what_it_says(tmp_path: Path) -> None:
    run = SimpleNamespace(folder=tmp_path / "run", scene_folder=tmp_path / "scene")
    run.folder.mkdir()
    run.scene_folder.mkdir()
    write_presentation(run.folder, Presentation(author="A"))
    write_presentation(run.scene_folder, Presentation(meters_per_unit=2.0, license="CC0"))
    chosen = Presentation(white_balance=(0.5, 1, 1.5), meters_per_unit=2.0, author="A", license="CC0")
    assert save_to_run(run, chosen) == f"Saved to {PRESENTATION_FILE}"
    assert read_presentation(run.folder) == Presentation(white_balance=(0.5, 1, 1.5), author="A")
    said = save_to_run(run, msgspec.structs.replace(chosen, meters_per_unit=None))
    assert "the scene's own meters_per_unit still counts" in said


def pointer(**changes: object) -> bytes:
    message = {
        "type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1],
        "screen_pos": [[0.25, 0.5]], "modifier": None,
    }  # fmt: skip
    return msgspec.msgpack.encode({**message, **changes})


def test_clicks_pass_the_gate_with_their_place_alone() -> None:
    raw = checked_message(pointer(ray_origin=[1e300, 0, 0], modifier="evil"), lambda name: None, 1.0)
    assert raw is not None
    message = msgspec.msgpack.decode(raw)
    assert (message["screen_pos"], message["modifier"]) == ([[0.25, 0.5]], None)
    assert message["ray_origin"] == [0, 0, 0]
    clamped = checked_message(pointer(screen_pos=[[-3, 9]]), lambda name: None, 1.0)
    assert msgspec.msgpack.decode(clamped or b"")["screen_pos"] == [[0.0, 1.0]]
    assert checked_message(pointer(event_type="rect-select"), lambda name: None, 1.0) is None


@pytest.mark.parametrize(
    "place", [[], [[0.5]], [[0.5, float("nan")]], [[0.1, 0.2], [0.3, 0.4]], None, "x", [["a", 0]]]
)
def test_clicks_without_a_place_are_refused(place: object) -> None:
    with pytest.raises(Refused):
        checked_message(pointer(screen_pos=place), lambda name: None, 1.0)
