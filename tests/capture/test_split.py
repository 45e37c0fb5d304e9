"""Which views are held out."""

from __future__ import annotations

import math

import pytest

from polarguide.camera import Camera, look_at
from polarguide.capture.split import TEST_EVERY, chosen_views, far_from_training, held_out_band

RINGS, STOPS = 8, 12


def at(height: float, degrees: float) -> Camera:
    """A camera on a dome about the origin, looking at it."""
    up, around = math.radians(height), math.radians(degrees)
    center = (3 * math.cos(up) * math.cos(around), 3 * math.cos(up) * math.sin(around), 3 * math.sin(up))
    return Camera(24, 20, 28.0, 28.0, 12.0, 10.0, *look_at(center, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))


def dome() -> dict[str, Camera]:
    """Column by column, as a turntable with eight cameras above each other gives: every 8th is the lowest ring."""
    return {
        f"v{stop:02d}_{ring}": at(5 + 9 * ring, 360 / STOPS * stop)
        for stop in range(STOPS)
        for ring in range(RINGS)
    }


def test_no_ring_is_held_out_as_a_whole_where_every_eighth_would() -> None:
    cameras = dome()
    rings = [name[-1] for name in chosen_views(cameras, "every-8th")]
    assert set(rings) == {"0"}
    chosen = chosen_views(cameras, "directions")
    assert len(chosen) == len(cameras) / TEST_EVERY
    assert max([name[-1] for name in chosen].count(ring) for ring in map(str, range(RINGS))) < STOPS / 2
    assert len({name[:3] for name in chosen}) > STOPS / 3


@pytest.mark.parametrize("ring", range(RINGS))
def test_a_ring_that_is_held_out_as_a_whole_is_found(ring: int) -> None:
    cameras = dome()
    tests = [name for name in cameras if name.endswith(str(ring))]
    assert held_out_band(cameras, tests) == sorted(tests)
    assert held_out_band(cameras, tests[:-1]) == [], "one of the ring is trained on"
    # Cameras are held by hand: no two of a ring have quite the same height.
    shaken = {name: at(5 + 9 * int(name[-1]) + k % 5, 30 * int(name[1:3])) for k, name in enumerate(cameras)}
    assert held_out_band(shaken, tests) == sorted(tests)


def test_no_band_is_held_out_where_tests_are_spread() -> None:
    cameras = dome()
    assert held_out_band(cameras, chosen_views(cameras, "every-8th")) != []
    assert held_out_band(cameras, chosen_views(cameras, "directions")) == []
    turntable = {f"v{k}": at(20, 5 * k) for k in range(72)}
    assert held_out_band(turntable, chosen_views(turntable, "every-8th")) == []
    assert held_out_band({}, []) == held_out_band(turntable, list(turntable)) == []


def test_a_band_of_many_views_is_found() -> None:
    """Their heights are so dense that each is within a ring's tolerance of the next."""
    cameras = {f"v{k:04d}": at(60 * k / 4000, 137.5 * k) for k in range(4000)}
    tests = [f"v{k:04d}" for k in range(1800, 2200)]
    assert len(held_out_band(cameras, tests)) > 360


def test_every_held_out_view_has_training_views_near_it_and_none_is_far_from_all_held_out() -> None:
    cameras = dome()
    chosen = chosen_views(cameras, "directions")
    assert far_from_training(cameras, chosen) == []
    assert chosen == chosen_views(dict(reversed(cameras.items())), "directions"), "the order does not matter"


def test_a_view_apart_from_all_others_is_trained_on() -> None:
    cameras = {f"v{k:02d}": at(20, 3 * k) for k in range(23)} | {"w": at(80, 200)}
    assert "w" not in chosen_views(cameras, "directions")
    assert far_from_training(cameras, ["v03", "w"]) == ["w"]


@pytest.mark.parametrize(("views", "tests"), [(1, 0), (2, 1), (3, 1), (8, 1), (9, 2), (17, 3)])
def test_one_in_eight_is_held_out_and_never_all(views: int, tests: int) -> None:
    cameras = {f"v{k:02d}": at(20, 11 * k) for k in range(views)}
    for split in ("directions", "every-8th"):
        chosen = chosen_views(cameras, split)
        assert len(set(chosen)) == tests
        assert set(chosen) <= set(cameras)


def test_cameras_in_one_place_that_look_into_one_direction_can_be_split() -> None:
    cameras = {f"v{k:02d}": at(20, 0) for k in range(20)}
    assert len(set(chosen_views(cameras, "directions"))) == 3
    assert far_from_training(cameras, chosen_views(cameras, "directions")) == []


def test_a_part_of_the_directions_that_is_held_out_is_told() -> None:
    cameras = {f"v{k:02d}": at(20, 3 * k) for k in range(20)}
    assert far_from_training(cameras, [f"v{k:02d}" for k in range(10)]) == [f"v{k:02d}" for k in range(8)]
