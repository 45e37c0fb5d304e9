"""A browser's session: coarse pictures while something changes, sharp ones at rest, and its controls."""

import json

import cv2
import numpy as np
import pytest
from fake_browser import FakeClient
from viewer_scenes import frame_of_scene, photographs, shown

from polarguide.shading.result import LAYERS
from polarguide.viewer.session import (
    BUDGET,
    FREE_VIEW,
    GREATEST_HEIGHT,
    LEAST_HEIGHT,
    NO_LAYER,
    PATH_FILE,
    PICTURE_FILE,
    REST,
    FramePacing,
    PanelOptions,
    Session,
)
from polarguide.visualization import figures


class ViewingSession:
    """A session, its fake browser, and the scene."""

    def __init__(self, clock):
        self.clock, self.seen = clock, shown()
        self.photographs = photographs(self.seen)
        self.client = FakeClient()
        options = PanelOptions(LAYERS, turns=True, views=tuple(self.photographs), trains=True)
        self.session = Session(self.client, self.photographs, frame_of_scene(), options, lambda: None)
        self.session.go("v0")
        self.client.camera.report()

    def picture(self):
        """The next picture, if one is due."""
        kind = self.session.due()
        if kind is None:
            return None
        self.session.draw(self.seen, kind)
        return self.client.scene.pictures[-1]

    def rest(self):
        """The sharp picture after a rest."""
        self.clock.now += 1.0
        picture = self.picture()
        assert self.picture() is None
        return picture[0]

    def at(self, name):
        return self.photographs[name].view


class Clock:
    now = 100.0

    def __call__(self):
        self.now += 0.001
        return self.now


@pytest.fixture
def viewing(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("polarguide.viewer.session.time.monotonic", clock)
    return ViewingSession(clock)


def rendered(seen, camera):
    return figures.radiance_to_rgb(seen.render(camera, depth=False).final)


def psnr(a, b):
    return -10 * np.log10(max(np.mean((a / 255.0 - b / 255.0) ** 2), 1e-12))


def test_a_session_begins_at_the_first_photograph_and_sees_what_render_gives(viewing):
    view = viewing.at("v0")
    # The window is twice the photograph's size.
    expected = rendered(viewing.seen, view.camera.extended(128, 96))
    assert psnr(viewing.rest(), expected) > 60
    assert viewing.client.control("Go to").value == "v0"


def test_the_controls_begin_folded_in_a_window_that_is_higher_than_wide(viewing):
    client = FakeClient()
    client.camera.image_width, client.camera.image_height = 390, 844
    options = PanelOptions(LAYERS, turns=True, views=("v0",), trains=True)
    Session(client, viewing.photographs, frame_of_scene(), options, lambda: None)
    assert client.gui.folders["Controls"] is False
    assert "Controls" not in viewing.client.gui.folders


def test_coarse_jpegs_while_moving_and_a_png_at_rest(viewing):
    viewing.rest()
    viewing.client.camera.drag((1.0, -1.0, -4.0))
    assert viewing.picture()[1] == "jpeg"
    assert viewing.picture() is None
    viewing.clock.now += 1.0
    assert viewing.picture()[1] == "png"


def test_measured_layers_are_there_until_the_camera_moves(viewing):
    viewing.client.control("Layer").value = "photograph"
    sharp = viewing.rest()
    shown_photograph = figures.radiance_to_rgb(viewing.at("v0").photograph())
    assert psnr(cv2.resize(sharp, (64, 48), interpolation=cv2.INTER_AREA), shown_photograph) > 30
    viewing.client.camera.drag((1.0, -1.0, -4.0))
    assert (viewing.rest() == 64).all()
    assert NO_LAYER in viewing.client.control("status").value
    assert viewing.client.control("Go to").value == FREE_VIEW


def test_a_late_report_from_before_a_jump_does_not_undo_it(viewing):
    camera = viewing.client.camera
    before = camera.position
    viewing.session.go("v3")
    camera.call_back()  # of a report that had arrived before
    there, camera.position = camera.position, before
    camera.report()
    camera.position = there
    camera.report()
    assert viewing.client.control("Go to").value == "v3"
    camera.drag((1.0, -1.0, -4.0))
    assert viewing.client.control("Go to").value == FREE_VIEW
    camera.drag(tuple(there))
    assert viewing.client.control("Go to").value == "v3"


def test_jumping_by_list_by_buttons_and_by_a_click_on_a_camera(viewing):
    client = viewing.client
    client.control("Go to").value = "v2"
    assert np.allclose(client.camera.position, viewing.at("v2").camera.center)
    step = client.control("")
    step.value = "next"
    assert np.allclose(client.camera.position, viewing.at("v3").camera.center)
    step.value = "previous"
    step.click()
    assert client.control("Go to").value == "v1"
    client.scene.frusta[4].click()
    assert client.control("Go to").value == "v4"


def test_cameras_that_would_cover_the_picture_are_left_out(viewing):
    viewing.rest()
    assert not any(frustum.visible for frustum in viewing.client.scene.frusta)
    near = viewing.at("v2").camera.center.numpy()
    viewing.client.camera.drag(tuple(1.05 * near))
    viewing.rest()
    visible = [frustum.visible for frustum in viewing.client.scene.frusta]
    assert not visible[2]
    assert sum(visible) == 5
    viewing.client.control("Show cameras").value = False
    assert not any(frustum.visible for frustum in viewing.client.scene.frusta)


def test_a_saved_picture_is_the_sharp_one(viewing):
    sharp = viewing.rest()
    viewing.client.control("Save picture").click()
    viewing.picture()
    data = np.frombuffer(viewing.client.files[PICTURE_FILE], dtype=np.uint8)
    assert np.array_equal(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1], sharp)


def test_a_path_is_set_down_and_saved(viewing):
    client = viewing.client
    for name in ("v1", "v2"):
        viewing.session.go(name)
        client.control("Add keyframe").click()
    client.control("Add keyframe").click()
    client.control("Remove last keyframe").click()
    assert client.control("Keyframes").value == "2, 2 s"
    client.control("Seconds per segment").value = 3.0
    assert client.control("Keyframes").value == "2, 3 s"
    client.control("Seconds per segment").value = 2.0
    client.control("Save path").click()
    cameras = json.loads(client.files[PATH_FILE])["cameras"]
    assert len(cameras) == 61


def test_the_crop_is_drawn_as_a_box_and_hides_the_rest(viewing):
    whole = viewing.rest()
    client = viewing.client
    client.control("Left, right").value = (-10, 10)
    client.control("Crop").value = True
    assert client.scene.boxes == []  # it is drawn where it is asked for
    client.control("Show box").value = True
    assert client.scene.boxes[-1].shape == (12, 2, 3)
    assert viewing.rest().sum() < 0.8 * whole.sum()
    client.control("Crop").value = False
    assert np.array_equal(viewing.rest(), whole)


def test_a_training_waits_when_asked(viewing):
    assert not viewing.session.paused
    viewing.client.control("Pause training").value = True
    assert viewing.session.paused


WINDOW = (1200, 900)


def test_coarse_while_something_changes_then_sharp_once():
    pacing = FramePacing()
    pacing.mark_changed(10.0)
    assert pacing.due(10.0) == "coarse"
    version = pacing.version
    pacing.mark_changed(10.05)  # while it is drawn
    pacing.end_frame(version, "coarse", 0.05, 10.06)
    assert pacing.due(10.06) == "coarse"
    pacing.end_frame(pacing.version, "coarse", 0.05, 10.1)
    assert pacing.due(10.1) is None
    assert pacing.due(10.06 + REST) == "sharp"
    pacing.end_frame(pacing.version, "sharp", 0.5, 11.0)
    assert pacing.due(20.0) is None


def test_a_new_session_and_an_outdated_scene_get_a_sharp_picture():
    pacing = FramePacing()
    assert pacing.due(100.0) == "sharp"
    pacing.end_frame(pacing.version, "sharp", 0.1, 100.0)
    pacing.mark_outdated()
    assert pacing.due(101.0) == "sharp"


def test_a_change_while_the_sharp_picture_is_drawn_is_not_forgotten():
    pacing = FramePacing()
    version = pacing.version
    pacing.mark_changed(5.0)
    pacing.end_frame(version, "sharp", 1.0, 6.0)
    assert pacing.due(6.0) == "sharp"


def drawn(pacing, seconds_a_pixel, times):
    for _ in range(times):
        width, height = pacing.frame_size(WINDOW, "coarse")
        pacing.end_frame(pacing.version, "coarse", seconds_a_pixel * width * height, 0.0)
    return pacing.frame_size(WINDOW, "coarse")


def test_the_size_of_coarse_pictures_follows_their_time():
    slow = drawn(FramePacing(), 4e-6, 3)
    assert slow[0] * slow[1] * 4e-6 < 1.2 * BUDGET
    fast = drawn(FramePacing(), 1e-8, 40)
    assert fast == WINDOW
    assert drawn(FramePacing(), 1.0, 40)[1] == LEAST_HEIGHT


def test_sharp_pictures_have_the_size_of_the_window_up_to_a_limit():
    assert FramePacing().frame_size(WINDOW, "sharp") == WINDOW
    assert FramePacing().frame_size((4000, 3000), "sharp") == (
        round(4000 * GREATEST_HEIGHT / 3000),
        GREATEST_HEIGHT,
    )
    assert FramePacing().frame_size((10, 0), "coarse")[1] == 1
