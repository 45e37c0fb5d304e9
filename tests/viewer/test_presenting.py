"""Crop box and exposure that are chosen in the viewer with a fake browser, and the saved presentation."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
from fake_browser import FakeClient
from viewer_scenes import frame_of_scene, photographs, shown

from polarguide.capture.presentation import (
    PRESENTATION_FILE,
    Crop,
    Presentation,
    read_presentation,
    write_presentation,
)
from polarguide.shading.result import LAYERS
from polarguide.viewer.server import save_to_run
from polarguide.viewer.session import PanelOptions, Session

AROUND = frame_of_scene()
WHITE = Presentation(white_balance=(0.5, 1.0, 1.5))


def visit(
    presentation: Presentation, save: Callable[[Presentation], str] | None
) -> tuple[FakeClient, Session]:
    """A session at the pose of a photograph."""
    pictures = photographs(shown())
    client = FakeClient()
    options = PanelOptions(LAYERS, True, tuple(pictures), False, presentation, saves=save is not None)
    session = Session(client, pictures, AROUND, options, lambda: None, save=save)
    session.go("v0")
    client.camera.report()
    return client, session


def test_what_was_saved_is_shown_and_the_box_stands_as_it_was() -> None:
    crop = Crop((-0.123, -0.5, -0.5), (0.456, 0.5, 0.5), (0.0, 0.0, 1.0))
    saved: list[Presentation] = []

    def save(presentation: Presentation) -> str:
        saved.append(presentation)
        return "Saved"

    client, session = visit(msgspec.structs.replace(WHITE, crop=crop, author="A"), save)
    client.control("Show box").value = True
    np.testing.assert_allclose(client.scene.boxes[-1][0][0], crop.corners(AROUND)[0], atol=1e-5)
    client.control("Save to the run").click()
    assert "Saved" in client.control("status").value
    assert saved == [Presentation(white_balance=(0.5, 1.0, 1.5), crop=crop, author="A")]
    client.control("Down, up").value = (-10, 20)
    assert session.panel.crop() == Crop((-0.12, -0.1, -0.5), (0.46, 0.2, 0.5))


def test_a_free_camera_stands_along_the_saved_up_axis() -> None:
    client, _ = visit(Presentation(up_axis=(0.6, 0.0, 0.8)), None)
    client.camera.drag((1.0, -1.0, -4.0))
    np.testing.assert_allclose(client.camera.up_direction, (0.6, 0.0, 0.8))


def test_where_nothing_may_be_saved_the_browser_downloads_it() -> None:
    client, _ = visit(WHITE, None)
    client.control("Exposure").value = 0.5
    client.control("Download").click()
    content = json.loads(client.files[PRESENTATION_FILE])
    assert content == {"white_balance": [0.5, 1.0, 1.5], "exposure": 0.5}


def test_saving_keeps_the_run_s_values_and_leaves_to_the_scene_what_it_says(tmp_path: Path) -> None:
    run = SimpleNamespace(folder=tmp_path / "run", scene_folder=tmp_path / "scene")
    run.folder.mkdir()
    run.scene_folder.mkdir()
    write_presentation(run.folder, Presentation(author="A"))
    write_presentation(run.scene_folder, Presentation(exposure=2.0, license="CC0"))
    crop = Crop((-0.1, -0.5, -0.5), (0.4, 0.5, 0.5), None)
    chosen = Presentation(crop=crop, exposure=2.0, author="A", license="CC0")
    assert save_to_run(run, chosen) == f"Saved to {PRESENTATION_FILE}"
    assert read_presentation(run.folder) == Presentation(crop=crop, author="A")
    said = save_to_run(run, msgspec.structs.replace(chosen, exposure=None))
    assert "the scene's own exposure still counts" in said
