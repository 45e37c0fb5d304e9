"""The picture of the errors: its columns, its scales, and what is gray in it."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import torch
from known_scene import HEIGHT, WIDTH, known_scene, rendered

from polarguide.results.evaluation import evaluate
from polarguide.results.evaluation.evaluate import COLUMNS, ErrorSheet
from polarguide.results.evaluation.target import SceneFacts, ViewTarget
from polarguide.visualization import figures

CPU = torch.device("cpu")


def drawn(monkeypatch, tmp_path: Path, scene, *, layers=True, shown=None):
    """The tiles by row and column heading, and the scales, that a sheet of a scene is made of."""
    seen = {}

    def catch(rows, labels, columns, footer=()):
        seen.update(rows=rows, labels=labels, columns=columns, footer=footer)
        return np.zeros((4, 4, 3), np.uint8)

    monkeypatch.setattr(evaluate, "contact_sheet", catch)
    facts, sheet = SceneFacts.of(scene), ErrorSheet(len(scene.views))
    for view in scene.views:
        result, stokes, _ = rendered(known_scene().views[0] if view.ground_truth is None else view, 5)
        if not layers:
            stokes = None
            del result.layers["specular"], result.layers["diffuse"]
        target = ViewTarget.of_view(view, facts, CPU).with_coverage(
            torch.ones_like(view.invalid) if shown is None else shown
        )
        sheet.add(view, target, result, stokes)
    sheet.write(tmp_path / "errors.png")
    return seen


def test_heat_maps_have_the_colors_of_their_errors(monkeypatch, tmp_path):
    scene = known_scene()
    seen = drawn(monkeypatch, tmp_path, scene)
    view = scene.views[0]
    result, stokes, _ = rendered(view, 5)
    tiles = dict(zip(seen["columns"], seen["rows"][0], strict=True))
    picture = figures.error_to_rgb(result.final, view.photograph())
    valid = ~view.invalid.numpy()
    assert (np.abs(tiles["picture error"].astype(int) - picture)[valid] <= 1).all()
    assert (tiles["picture error"][~valid] == evaluate.NOT_COUNTED).all()
    outside = ~view.ground_truth.mask.numpy()
    for name in ("normal error", "specular error", "diffuse error", "S1, S2 error"):
        assert (tiles[name][outside] == evaluate.NOT_COUNTED).all(), name
        assert len(np.unique(tiles[name][~outside], axis=0)) > 20, name
    four = view.intensities()
    errors = (stokes[1] - (four[0] - four[2])).abs() + (stokes[2] - (four[1] - four[3])).abs()
    expected = figures.scalar_to_rgb(errors.mean(-1), 0, 0.2, "inferno")
    counts = (view.ground_truth.mask & ~view.invalid & ~view.saturated).numpy()
    assert (np.abs(tiles["S1, S2 error"].astype(int) - expected)[counts] <= 1).all()


def test_stripes_mark_pixels_that_no_training_view_shows(monkeypatch, tmp_path):
    shown = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    shown[:, WIDTH // 2 :] = False
    plain, striped = (drawn(monkeypatch, tmp_path, known_scene(), shown=mask) for mask in (None, shown))
    columns = plain["columns"]
    for name in ("picture error", "S1, S2 error"):
        before, after = (sheet["rows"][0][columns.index(name)] for sheet in (plain, striped))
        changed = (before != after).any(-1)
        assert not changed[:, : WIDTH // 2].any()
        assert 0.1 < changed[:, WIDTH // 2 :].mean() < 0.3
        assert (after[changed] == evaluate.NOT_COUNTED).all()
    normals = columns.index("normal error")
    assert np.array_equal(plain["rows"][0][normals], striped["rows"][0][normals])


def test_columns_are_those_that_a_run_has(monkeypatch, tmp_path):
    scene = known_scene()
    whole = [name if name != "AoLP x DoLP" else "AoLP x DoLP / 0.5" for name in COLUMNS.values()]
    assert drawn(monkeypatch, tmp_path, scene)["columns"] == whole
    assert drawn(monkeypatch, tmp_path, scene, layers=False)["columns"] == [
        "photograph",
        "picture error",
        "normal error",
    ]
    bare = tuple(dataclasses.replace(view, truth=None) for view in scene.views)
    assert drawn(monkeypatch, tmp_path, dataclasses.replace(scene, views=bare))["columns"] == [
        "photograph",
        "picture error",
        "AoLP x DoLP / 0.5",
        "predicted",
        "S1, S2 error",
    ]


def test_a_key_to_its_colors_stands_below_every_column(monkeypatch, tmp_path):
    seen = drawn(monkeypatch, tmp_path, known_scene())
    keys = dict(zip(seen["columns"], seen["footer"], strict=True))
    assert len(keys) == len(COLUMNS)
    assert (keys["photograph"][:22] == evaluate.NOT_COUNTED).all()
    for name in ("AoLP x DoLP / 0.5", "predicted"):
        assert np.array_equal(keys[name], figures.angle_wheel())
    for name in ("picture error", "normal error", "specular error", "diffuse error", "S1, S2 error"):
        assert keys[name][0, -1].sum() > 600 > 60 > keys[name][0, 0].sum()


def test_many_views_are_thinned_out(monkeypatch, tmp_path):
    scene = known_scene()
    names = [f"v{k}" for k in range(20)]
    views = tuple(dataclasses.replace(scene.views[0], name=name) for name in names)
    many = dataclasses.replace(scene, views=views, test_names=tuple(names))
    assert drawn(monkeypatch, tmp_path, many)["labels"] == names[::3]


def test_a_sheet_on_disk(tmp_path):
    scene = known_scene()
    facts, sheet = SceneFacts.of(scene), ErrorSheet(2)
    sheet.write(tmp_path / "nothing.png")
    assert not (tmp_path / "nothing.png").exists()
    for view in scene.views:
        result, stokes, _ = rendered(view, 5)
        result.normal[3, 3] = torch.nan
        target = ViewTarget.of_view(view, facts, CPU).with_coverage(torch.ones_like(view.invalid))
        sheet.add(view, target, result, stokes)
    sheet.write(tmp_path / "errors.png")
    picture = cv2.imread(str(tmp_path / "errors.png"))
    assert picture.shape[0] > 2 * HEIGHT
    assert picture.shape[1] > len(COLUMNS) * WIDTH
