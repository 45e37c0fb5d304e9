"""What a visitor's browser is told, with a stand-in for the browser."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from sights import around, photographs_of, shown
from stand_in import StandIn

from polarguide.viewer.lens import fit
from polarguide.viewer.panel import NOWHERE, Offer
from polarguide.viewer.visitor import NO_LAYER, PATH_FILE, PICTURE_FILE, Visitor
from polarguide.visualization import figures


class Looking:
    """A visitor, its stand-in browser, and what it looks at."""

    def __init__(self, clock):
        self.clock, self.seen = clock, shown()
        self.photographs = photographs_of(self.seen)
        self.client = StandIn()
        offer = Offer(lit=True, turns=True, views=tuple(self.photographs), trains=True)
        self.visitor = Visitor(self.client, self.photographs, around(), offer, lambda: None)
        self.visitor.go("v0")
        self.client.camera.tell()

    def picture(self):
        """The next picture, if one is due."""
        kind = self.visitor.wants()
        if kind is None:
            return None
        self.visitor.draw(self.seen, kind)
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
def looking(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("polarguide.viewer.visitor.time.monotonic", clock)
    return Looking(clock)


def rendered(seen, camera):
    result = seen.render(camera, seen.gaussians, seen.environment, depth=False)
    return figures.radiance_to_rgb(result.final)


def psnr(a, b):
    return -10 * np.log10(max(np.mean((a / 255.0 - b / 255.0) ** 2), 1e-12))


def test_a_visitor_begins_at_the_first_photograph_and_sees_what_render_gives(looking):
    view = looking.at("v0")
    # The window is twice the photograph's size.
    expected = rendered(looking.seen, fit(view.camera, (128, 96)).camera(view.camera))
    assert psnr(looking.rest(), expected) > 60
    assert looking.client.control("Go to").value == "v0"


def test_coarse_jpegs_while_moving_and_a_png_at_rest(looking):
    looking.rest()
    looking.client.camera.drag((1.0, -1.0, -4.0))
    assert looking.picture()[1] == "jpeg"
    assert looking.picture() is None
    looking.clock.now += 1.0
    assert looking.picture()[1] == "png"


def test_measured_layers_are_there_until_the_camera_moves(looking):
    looking.client.control("Layer").value = "photograph"
    sharp = looking.rest()
    shown_photograph = figures.radiance_to_rgb(looking.at("v0").photograph())
    assert psnr(cv2.resize(sharp, (64, 48), interpolation=cv2.INTER_AREA), shown_photograph) > 30
    looking.client.camera.drag((1.0, -1.0, -4.0))
    assert (looking.rest() == 64).all()
    assert NO_LAYER in looking.client.control("told").value
    assert looking.client.control("Go to").value == NOWHERE


def test_a_late_word_from_before_a_jump_does_not_undo_it(looking):
    camera = looking.client.camera
    before = camera.position
    looking.visitor.go("v3")
    there, camera.position = camera.position, before
    camera.tell()
    camera.position = there
    camera.tell()
    assert looking.client.control("Go to").value == "v3"
    looking.client.camera.drag((1.0, -1.0, -4.0))
    assert looking.client.control("Go to").value == NOWHERE


def test_jumping_by_list_by_buttons_and_by_a_click_on_a_camera(looking):
    client = looking.client
    client.control("Go to").value = "v2"
    assert np.allclose(client.camera.position, looking.at("v2").camera.center)
    step = client.control("")
    step.value = "next"
    assert np.allclose(client.camera.position, looking.at("v3").camera.center)
    step.value = "previous"
    step.click()
    assert client.control("Go to").value == "v1"
    client.scene.frusta[4].click()
    assert client.control("Go to").value == "v4"


def test_cameras_that_would_cover_the_picture_are_left_out(looking):
    looking.rest()
    assert not any(frustum.visible for frustum in looking.client.scene.frusta)
    near = looking.at("v2").camera.center.numpy()
    looking.client.camera.drag(tuple(1.05 * near))
    looking.rest()
    visible = [frustum.visible for frustum in looking.client.scene.frusta]
    assert not visible[2]
    assert sum(visible) == 5
    looking.client.control("Show cameras").value = False
    assert not any(frustum.visible for frustum in looking.client.scene.frusta)


def test_a_saved_picture_is_the_sharp_one(looking):
    sharp = looking.rest()
    looking.client.control("Save picture").click()
    looking.picture()
    data = np.frombuffer(looking.client.files[PICTURE_FILE], dtype=np.uint8)
    assert np.array_equal(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1], sharp)


def test_a_path_is_set_down_played_and_saved(looking):
    client = looking.client
    for name in ("v1", "v2"):
        looking.visitor.go(name)
        client.control("Add this pose").click()
    client.control("Add this pose").click()
    client.control("Remove the last").click()
    assert client.control("Poses").value == "2, 2 s"
    client.control("Seconds each").value = 3.0
    assert client.control("Poses").value == "2, 3 s"
    client.control("Seconds each").value = 2.0
    client.control("Save path").click()
    cameras = json.loads(client.files[PATH_FILE])["cameras"]
    assert len(cameras) == 61
    client.control("Play").click()
    assert client.control("Go to").value == NOWHERE
    looking.clock.now += 1.0
    assert looking.visitor.wants() == "coarse"
    middle = client.camera.position
    ends = [looking.at(name).camera.center.numpy() for name in ("v1", "v2")]
    assert np.linalg.norm(middle - ends[0]) < 0.7 * np.linalg.norm(ends[1] - ends[0])
    assert np.linalg.norm(middle - ends[1]) < 0.7 * np.linalg.norm(ends[1] - ends[0])
    looking.clock.now += 5.0
    assert looking.visitor.wants() == "sharp"


def test_the_crop_is_drawn_as_a_box_and_hides_the_rest(looking):
    whole = looking.rest()
    client = looking.client
    client.control("Left, right").value = (-10, 10)
    client.control("Crop").value = True
    assert client.scene.boxes[-1].shape == (12, 2, 3)
    cropped = looking.rest()
    assert cropped.sum() < 0.8 * whole.sum()
    client.control("Crop").value = False
    assert np.array_equal(looking.rest(), whole)


def test_a_training_waits_when_asked(looking):
    assert not looking.visitor.paused
    looking.client.control("Pause training").value = True
    assert looking.visitor.paused
