"""Figures: colors of known values, and the geometry of a contact sheet."""

import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from faults import Fault

import polarguide
from polarguide.geometry.camera import Camera
from polarguide.visualization import figures
from polarguide.visualization.figures import clipping_exposure, contact_sheet
from polarguide.visualization.pages import content_policy

# A camera that looks along world +x, with world +z up: its right is world -y.
ROTATION = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
CAMERA = Camera(4, 2, 4.0, 4.0, 2.0, 1.0, ROTATION, torch.zeros(3, dtype=torch.float64))


@pytest.mark.parametrize(
    ("world", "color"),
    [
        ((-1.0, 0.0, 0.0), (128, 128, 255)),  # toward the camera: blue
        ((0.0, -1.0, 0.0), (255, 128, 128)),  # right: red
        ((0.0, 0.0, 1.0), (128, 255, 128)),  # up: green
        ((0.0, 0.0, -0.2), (128, 0, 128)),  # down, not of unit length
        ((0.0, 0.0, 0.0), (128, 128, 128)),
        ((math.nan, 0.0, 0.0), (128, 128, 128)),
    ],
)
def test_normal_colors(world, color):
    picture = figures.normal_to_rgb(torch.tensor(world).expand(2, 4, 3), CAMERA)
    assert picture.shape == (2, 4, 3)
    assert picture.dtype == np.uint8
    assert tuple(picture[1, 2]) == color


def test_radiance_colors():
    linear = torch.tensor([[[0.0, 0.2158605, 1.0], [-3.0, 7.0, math.nan]]])
    assert figures.radiance_to_rgb(linear).tolist() == [[[0, 128, 255], [0, 255, 0]]]


def test_scalar_colors():
    viridis = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_VIRIDIS)[0, :, ::-1]
    values = torch.tensor([[2.0, 3.0, 4.0, 1.0, 9.0, math.nan, math.inf]])
    row = figures.scalar_to_rgb(values, 2.0, 4.0)[0]
    assert row.tolist() == [*viridis[[0, 128, 255, 0, 255]].tolist(), [0, 0, 0], [0, 0, 0]]
    assert (figures.scalar_to_rgb(values, 2.0, 4.0, "turbo")[0, 0] != row[0]).any()


def test_scalar_refuses_what_it_cannot_draw():
    with pytest.raises(ValueError, match="low < high"):
        figures.scalar_to_rgb(torch.zeros(2, 2), 1.0, 1.0)


@pytest.mark.parametrize(
    ("degrees", "color"),
    [(0, (255, 0, 0)), (30, (255, 255, 0)), (60, (0, 255, 0)), (120, (0, 0, 255)), (150, (255, 0, 255))],
)
@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_aolp_hue_turns_once_in_pi(degrees, color, turns):
    angle = torch.full((1, 1), math.radians(degrees) + turns * math.pi, dtype=torch.float64)
    assert tuple(figures.aolp_to_rgb(angle)[0, 0]) == color


def test_aolp_brightness():
    angle = torch.tensor([[0.0, 0.0, math.nan, 0.0]])
    dolp = torch.tensor([[1.0, 0.0, 1.0, math.nan]])
    assert figures.aolp_to_rgb(angle, dolp)[0, :, 0].tolist() == [255, 0, 0, 0]


def test_dolp_and_error_grow_brighter():
    dolp = figures.dolp_to_rgb(torch.tensor([[0.0, 0.3, 0.6, 1.0]]))[0].astype(int).sum(-1)
    assert dolp[0] < 10
    assert (np.diff(dolp) > 0).all()
    true = torch.full((1, 3, 3), 0.2)
    pred = true + torch.tensor([0.0, 0.05, -0.15])[None, :, None]
    error = figures.error_to_rgb(pred, true)[0].astype(int).sum(-1)
    assert error[0] == dolp[0]
    assert error[0] < error[1] < error[2]


def test_png_round_trip_keeps_the_order_of_channels(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    figures.write_png(tmp_path / "p.png", picture)
    assert (cv2.imread(str(tmp_path / "p.png"))[..., ::-1] == picture).all()
    assert [p.name for p in tmp_path.iterdir()] == ["p.png"]


def test_png_refuses_what_is_not_a_picture(tmp_path):
    with pytest.raises(ValueError, match=r"float64"):
        figures.write_png(tmp_path / "p.png", np.zeros((2, 2, 3)))
    Fault("p.png", "to write").raised_by(
        figures.write_png, tmp_path / "no" / "p.png", np.zeros((2, 2, 3), np.uint8)
    )


def flat(color, height, width):
    return np.full((height, width, 3), color, np.uint8)


RED, GREEN, BLUE = (200, 0, 0), (0, 200, 0), (0, 0, 200)


def boxes(sheet, color):
    """(top, left, height, width) of the only rectangle of a color."""
    y, x = np.nonzero((sheet == color).all(-1))
    top, left, height, width = y.min(), x.min(), np.ptp(y) + 1, np.ptp(x) + 1
    assert len(y) == height * width
    return int(top), int(left), int(height), int(width)


def test_sheet_enlarges_small_tiles_by_a_whole_factor():
    fine = np.random.default_rng(1).integers(0, 256, (60, 100, 3)).astype(np.uint8)
    sheet = contact_sheet([[fine]], [""], [""], gutter=8)
    assert sheet.shape == (180 + 16, 300 + 16, 3)
    assert (sheet[8:-8, 8:-8] == fine.repeat(3, 0).repeat(3, 1)).all()


def test_sheet_places_rows_and_columns():
    rows = [[flat(RED, 96, 128), flat(GREEN, 96, 128)], [None, flat(BLUE, 96, 128)]]
    sheet = contact_sheet(rows, ["first", "second"], ["a", "b"])
    red, green, blue = (boxes(sheet, color) for color in (RED, GREEN, BLUE))
    assert red[2:] == green[2:] == blue[2:] == (192, 256)
    assert (green[0], green[1]) == (red[0], red[1] + 256 + 8)
    assert (blue[0], blue[1]) == (green[0] + 192 + 8, green[1])
    assert sheet.shape == (blue[0] + 192 + 8, blue[1] + 256 + 8, 3)
    blank = sheet[blue[0] : blue[0] + 192, red[1] : red[1] + 256]
    assert (blank == 255).all()
    assert (contact_sheet([rows[0], []], ["first", "second"], ["a", "b"]).shape) == sheet.shape


def test_sheet_reduces_large_pictures_and_fits_odd_ones():
    rows = [[flat(RED, 500, 1000), flat(GREEN, 100, 100)]]
    sheet = contact_sheet(rows, [""], ["", ""], maximum_width=400)
    assert boxes(sheet, RED)[2:] == (200, 400)
    top, left, height, width = boxes(sheet, GREEN)
    assert (height, width) == (400, 400)
    assert boxes(sheet, RED)[0] == top + 100  # centered in the height of the tallest
    assert left == boxes(sheet, RED)[1] + 400 + 8


def test_labels_are_drawn_beside_the_tiles_they_name():
    def sheet(row, column):
        return contact_sheet([[flat(RED, 96, 128)]], [row], [column]).astype(int)

    plain, other = sheet("view", "normal"), sheet("view", "depth")
    _, left, _, _ = boxes(plain, RED)
    changed = np.nonzero((plain != other).any(-1))
    assert len(changed[0]) > 20
    assert changed[0].max() < boxes(plain, RED)[0]
    assert changed[1].min() >= left
    assert (sheet("view", "normal")[:, : left - 8] < 128).any()
    wide = sheet("", "a label that is far too long for a tile of 256 pixels")
    ink = np.nonzero((wide[: boxes(wide, RED)[0]] < 128).any(-1).any(0))[0]
    assert ink.max() - ink.min() <= 300


def test_sheet_refuses_labels_that_do_not_fit():
    tile = flat(RED, 4, 4)
    for rows, found in (
        ([tile, tile], r"\[2\]"),
        ([None], "picture"),
        ([tile.astype(np.float32)], "float32"),
    ):
        with pytest.raises(ValueError, match=found):
            contact_sheet([rows], ["a"], ["b"])


def test_the_wheel_has_the_color_of_each_angle_in_its_direction():
    wheel = figures.angle_wheel().astype(int)
    for degrees in (10, 45, 90, 135, 170):
        a = math.radians(degrees)
        x, y = round(128 + 72 * math.cos(a)), round(100 - 72 * math.sin(a))
        expected = figures.aolp_to_rgb(torch.tensor([[a]]))[0, 0].astype(int)
        assert np.abs(wheel[y, x] - expected).max() <= 20, degrees
    assert (wheel[105] == 255).all(axis=-1).mean() > 0.7


def test_the_ball_has_the_colors_of_normals():
    ball = figures.normal_ball()
    for (x, y), color in (
        ((128, 32), (128, 128, 255)),
        ((157, 32), (251, 128, 160)),
        ((128, 3), (128, 251, 160)),
    ):
        assert np.abs(ball[y, x].astype(int) - color).max() <= 8


def test_a_key_lies_over_the_lower_left_corner():
    picture = np.zeros((100, 300, 3), np.uint8)
    keyed = figures.with_key(picture, figures.scale_bar(0, 1, "viridis"), 128)
    assert (keyed[-1, :134] == 255).all()
    assert (keyed[:70] == 0).all()
    assert (keyed[:, 140:] == 0).all()
    assert (picture == 0).all()
    ball = figures.with_key(picture, figures.normal_ball(), 128)
    assert (ball[-1, :34] == 255).all()
    assert (ball[:, 40:] == 0).all(), "it is as wide as the ball"


def test_scale_bar_runs_through_the_colors_of_its_map():
    bar = figures.scale_bar(0.0, 45.0, "inferno")
    assert bar.shape == (44, 256, 3)
    expected = figures.scalar_to_rgb(torch.linspace(0, 45, 256)[None], 0, 45, "inferno")[0]
    assert (bar[:22] == expected).all()
    below = bar[22:]
    assert (below[:, :60] < 128).any(), "the number at the left end"
    assert (below[:, -60:] < 128).any(), "the number at the right end"
    assert (below[:, 80:180] == 255).all()
    assert (figures.scale_bar(0.0, 45.0, "inferno") != figures.scale_bar(0.0, 0.25, "inferno")).any()


def test_a_footer_stands_below_its_columns():
    tile = np.full((20, 300, 3), 10, np.uint8)
    bar = np.full((30, 300, 3), (200, 0, 0), np.uint8)
    plain = contact_sheet([[tile, tile]], ["a"], ["x", "y"])
    sheet = contact_sheet([[tile, tile]], ["a"], ["x", "y"], footer=[None, bar])
    assert (sheet[: plain.shape[0]] == plain).all()
    strip = sheet[plain.shape[0] :]
    assert strip.shape[0] == 30 + 8
    red = (strip == (200, 0, 0)).all(axis=2)
    assert red.sum() == 30 * 300
    columns = np.flatnonzero((plain == 10).all(axis=(2)).any(axis=0))
    assert np.flatnonzero(red.any(axis=0)).tolist() == columns[-300:].tolist()
    assert (
        contact_sheet([[tile]], ["a"], ["x"], footer=[None]).shape
        == contact_sheet([[tile]], ["a"], ["x"]).shape
    )


def test_an_exposure_clips_under_a_hundredth() -> None:
    rng = np.random.default_rng(0)
    values = torch.from_numpy(rng.gamma(0.4, 1.5, (60, 80, 3)).astype(np.float32))
    assert float((values.amax(dim=-1) > 1).float().mean()) > 0.3
    factor = clipping_exposure(values)
    clipped = float((values.amax(dim=-1) * factor > 1).float().mean())
    assert 0.005 < clipped < 0.01
    assert clipping_exposure(values * 0.01) == 1.0
    assert clipping_exposure(values * 0) == 1.0


PAGES = sorted(
    page
    for package in ("polarguide", "polarguide_shots", "polarguide_bench")
    for page in Path(polarguide.__file__).parents[1].joinpath(package).rglob("*.html")
)


def test_there_are_pages() -> None:
    assert {page.stem for page in PAGES} >= {"report", "page", "inspection", "shot", "base"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_the_policy_before_anything_else(page: Path) -> None:
    text = page.read_text("utf-8")
    if page.stem != "base":
        assert text.startswith('{% extends "base.html" %}\n')
        assert "<head>" not in text
        return
    policy = text.index('<meta http-equiv="Content-Security-Policy" content="{{ policy|safe }}">')
    assert not re.search(r"<(script|style|link|body|img)|{% block", text[:policy])


@pytest.mark.parametrize("script", ["", "let x = 1;"])
def test_the_policy_asks_for_nothing(script: str) -> None:
    rules = dict(rule.strip().partition(" ")[::2] for rule in content_policy(script).split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["base-uri"] == rules["form-action"] == "'none'"
    assert re.fullmatch(r"'sha256-[A-Za-z0-9+/]{43}='" if script else "", rules.get("script-src", ""))
    assert not re.search(r"https?:|\*|unsafe-eval", content_policy(script)), "nothing comes from elsewhere"
