"""Coarse while moving, sharp at rest."""

from __future__ import annotations

from polarguide.viewer.pace import BUDGET, GREATEST_HEIGHT, LEAST_HEIGHT, REST, Pace

WINDOW = (1200, 900)


def test_coarse_while_something_changes_then_sharp_once():
    pace = Pace()
    pace.change(10.0)
    assert pace.wants(10.0) == "coarse"
    version = pace.begin()
    pace.change(10.05)  # while it is drawn
    pace.end(version, "coarse", 0.05, 10.06)
    assert pace.wants(10.06) == "coarse"
    pace.end(pace.begin(), "coarse", 0.05, 10.1)
    assert pace.wants(10.1) is None
    assert pace.wants(10.06 + REST) == "sharp"
    pace.end(pace.begin(), "sharp", 0.5, 11.0)
    assert pace.wants(20.0) is None


def test_a_new_visitor_and_a_stale_scene_get_a_sharp_picture():
    pace = Pace()
    assert pace.wants(100.0) == "sharp"
    pace.end(pace.begin(), "sharp", 0.1, 100.0)
    pace.stale()
    assert pace.wants(101.0) == "sharp"


def test_a_change_while_the_sharp_picture_is_drawn_is_not_forgotten():
    pace = Pace()
    version = pace.begin()
    pace.change(5.0)
    pace.end(version, "sharp", 1.0, 6.0)
    assert pace.wants(6.0) == "sharp"


def drawn(pace, seconds_a_pixel, times):
    for _ in range(times):
        width, height = pace.size(WINDOW, "coarse")
        pace.end(pace.begin(), "coarse", seconds_a_pixel * width * height, 0.0)
    return pace.size(WINDOW, "coarse")


def test_the_size_of_coarse_pictures_follows_their_time():
    slow = drawn(Pace(), 4e-6, 3)
    assert slow[0] * slow[1] * 4e-6 < 1.2 * BUDGET
    fast = drawn(Pace(), 1e-8, 40)
    assert fast == WINDOW
    assert drawn(Pace(), 1.0, 40)[1] == LEAST_HEIGHT


def test_sharp_pictures_have_the_size_of_the_window_up_to_a_limit():
    assert Pace().size(WINDOW, "sharp") == WINDOW
    assert Pace().size((4000, 3000), "sharp") == (round(4000 * GREATEST_HEIGHT / 3000), GREATEST_HEIGHT)
    assert Pace().size((10, 0), "coarse")[1] == 1
