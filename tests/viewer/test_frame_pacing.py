"""Coarse while moving, sharp at rest."""

from __future__ import annotations

from polarguide.viewer.frame_pacing import BUDGET, GREATEST_HEIGHT, LEAST_HEIGHT, REST, FramePacing

WINDOW = (1200, 900)


def test_coarse_while_something_changes_then_sharp_once():
    pacing = FramePacing()
    pacing.mark_changed(10.0)
    assert pacing.due(10.0) == "coarse"
    version = pacing.begin_frame()
    pacing.mark_changed(10.05)  # while it is drawn
    pacing.end_frame(version, "coarse", 0.05, 10.06)
    assert pacing.due(10.06) == "coarse"
    pacing.end_frame(pacing.begin_frame(), "coarse", 0.05, 10.1)
    assert pacing.due(10.1) is None
    assert pacing.due(10.06 + REST) == "sharp"
    pacing.end_frame(pacing.begin_frame(), "sharp", 0.5, 11.0)
    assert pacing.due(20.0) is None


def test_a_new_session_and_an_outdated_scene_get_a_sharp_picture():
    pacing = FramePacing()
    assert pacing.due(100.0) == "sharp"
    pacing.end_frame(pacing.begin_frame(), "sharp", 0.1, 100.0)
    pacing.mark_outdated()
    assert pacing.due(101.0) == "sharp"


def test_a_change_while_the_sharp_picture_is_drawn_is_not_forgotten():
    pacing = FramePacing()
    version = pacing.begin_frame()
    pacing.mark_changed(5.0)
    pacing.end_frame(version, "sharp", 1.0, 6.0)
    assert pacing.due(6.0) == "sharp"


def drawn(pacing, seconds_a_pixel, times):
    for _ in range(times):
        width, height = pacing.frame_size(WINDOW, "coarse")
        pacing.end_frame(pacing.begin_frame(), "coarse", seconds_a_pixel * width * height, 0.0)
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
