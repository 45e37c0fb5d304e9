"""Normal maps for other trainers, read by the rules of the readers, on a ball whose normals are known."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from plyfile import PlyData
from textured_ball import OFFSET, textured_ball

import polarguide
from polarguide.capture import Scene
from polarguide.capture.presentation import Presentation
from polarguide.core.errors import PolarguideError
from polarguide.core.options import NormalOptions
from polarguide.core.progress import SILENT
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import scene_frame
from polarguide.optics.color import srgb_encode_array
from polarguide.results.export.formats import export_normals
from polarguide.results.export.placement import ALL, Origin, Placement, comments
from polarguide.results.rendering.mesh import Subject
from polarguide.shading.result import RenderResult

RADIUS = 0.8
DOLP = 0.2
PRESENTATION = Presentation(up_axis=(0.0, 0.3, 1.0), meters_per_unit=0.5, title="A ball")
CENTER = torch.tensor(OFFSET, dtype=torch.float64)
ROUNDING = 1.0
"""Degrees by which a normal of 8 bits can be off, with some room."""


class BallRun:
    """A run that renders the ball exactly, on a wall at a distance of ten units."""

    def __init__(self) -> None:
        self.scene: Scene = textured_ball(views=12, width=48, height=36, radius=RADIUS, polarized=DOLP)

    def result(self, camera: Camera) -> RenderResult:
        view = next(view for view in self.scene.views if view.camera is camera)
        truth = view.ground_truth
        assert truth is not None
        assert truth.normal is not None
        assert truth.mask is not None
        rays = camera.world_rays(dtype=torch.float64)
        away = camera.center - CENTER
        along = -(rays @ away)
        distance = along - (along**2 - away @ away + RADIUS**2).clamp(min=0).sqrt()
        ball = truth.mask[..., None]
        layers = {
            "final": view.photograph(),
            "diffuse": 0.5 * view.photograph(),
            "normal": torch.where(ball, truth.normal, -rays.float()),
            "depth": torch.where(truth.mask, distance, 10.0).float() * camera.rays()[..., 2],
            "alpha": torch.ones(truth.mask.shape),
        }
        return RenderResult(layers)

    def chosen_layers(self, result: RenderResult, names: list[str]) -> dict[str, torch.Tensor]:
        return {name: result.layers[name] for name in names}


def presented(run: BallRun) -> Any:
    """The ball as the subject, turned upright and in meters."""
    placement = Placement.of(PRESENTATION, scene_frame([view.camera for view in run.scene.views]))
    assert placement.rotates
    origin = Origin(PRESENTATION, "test")

    def inside(places: np.ndarray) -> np.ndarray:
        return np.linalg.norm(places - CENTER.numpy(), axis=1) < 1.01 * RADIUS

    return SimpleNamespace(
        presentation=PRESENTATION,
        placement=placement,
        subject=Subject(inside, "the ball"),
        origin=origin,
        comments=comments(origin, placement),
    )


def exported(folder: Path, *options: Any, run: BallRun | None = None, **changes: Any) -> tuple[BallRun, Any]:
    run = run or BallRun()
    shown = presented(run)
    for name, value in changes.items():
        setattr(shown, name, value)
    folder.mkdir(exist_ok=True)
    export_normals(cast(Any, run), shown, folder, NormalOptions(*options), SILENT)
    return run, shown


def pixels_of(path: Path) -> np.ndarray:
    """RGB or RGBA codes of a PNG file."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels if pixels.ndim == 2 else pixels[..., [2, 1, 0, *range(3, pixels.shape[2])]]


def true_normals(shown: Any, rays: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals of the exported ball where rays hit it, and where they do.

    Args:
        shown: what the export was made of.
        rays: [H, W, 3] world directions in the axes of the file.
        center: center of the camera in the file.
    """
    middle = shown.placement.points(CENTER[None])[0].numpy()
    radius = RADIUS * shown.placement.scale
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    away = center - middle
    along = -rays @ away
    under = along**2 - away @ away + radius**2
    places = center + rays * (along - np.sqrt(np.maximum(under, 0)))[..., None]
    return (places - middle) / radius, under > 0


def pixel_grid(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return x, y


def brush_normals(folder: Path, shown: Any) -> list[tuple[np.ndarray, ...]]:
    """Read a folder as Brush does (docs/normal-supervision.md of its pull request 520).

    COLMAP comes first. The normal map of a picture has its name, in ``normals/``. Codes are (n + 1) / 2 * 255, and the
    signs (1, -1, -1) lead to the axes of the camera: right, down, forward. The alpha is the mask.

    Returns:
        For each view: normals in the axes of the world, mask, true normals, and where they are.
    """
    model = pycolmap.Reconstruction(str(folder / "sparse/0"))
    views = []
    for image in model.images.values():
        codes = pixels_of(folder / "normals" / image.name)
        camera = model.cameras[image.camera_id]
        assert pixels_of(folder / "images" / image.name).shape[:2] == (camera.height, camera.width)
        rotation = image.cam_from_world().rotation.matrix()
        fx, fy, cx, cy = camera.params
        x, y = pixel_grid(camera.width, camera.height)
        rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1) @ rotation
        normals = (codes[..., :3] / 127.5 - 1) * [1, -1, -1] @ rotation
        views.append((normals, codes[..., 3], *true_normals(shown, rays, image.projection_center())))
    return views


def dn_splatter_normals(folder: Path, shown: Any) -> list[tuple[np.ndarray, ...]]:
    """Read a folder as dn-splatter does (``normal_nerfstudio.py``, ``dn_dataset.py`` and ``dn_model.py``).

    Frames are sorted by path and normal maps by name, and both are paired by order. For the format omnidata, codes in
    [0, 1] become 2 n - 1, and y and z change their signs. The loss compares the result with normals in the axes of the
    nerfstudio camera: right, up, backward.
    """
    record = json.loads((folder / "transforms.json").read_text())
    frames = sorted(record["frames"], key=lambda frame: str(frame["file_path"]))
    files = sorted(
        (folder / "normals_from_pretrain").glob("*.png"), key=lambda path: int(path.name.split("_")[0])
    )
    assert {path.stem for path in files} == {Path(frame["file_path"]).stem for frame in frames}
    views = []
    for frame, file in zip(frames, files, strict=True):
        mask = pixels_of(folder / frame["mask_path"])
        assert mask.ndim == 2
        pose = np.array(frame["transform_matrix"])
        x, y = pixel_grid(frame["w"], frame["h"])
        right = (x - frame["cx"]) / frame["fl_x"]
        up = -(y - frame["cy"]) / frame["fl_y"]
        rays = np.stack([right, up, -np.ones_like(x)], -1) @ pose[:3, :3].T
        normals = (pixels_of(file)[..., :3] / 127.5 - 1) * [1, -1, -1] @ pose[:3, :3].T
        views.append((normals, mask, *true_normals(shown, rays, pose[:3, 3])))
    return views


@pytest.mark.parametrize(("layout", "read"), [("brush", brush_normals), ("dn-splatter", dn_splatter_normals)])
def test_each_reader_gets_the_normals_of_the_ball(layout: str, read: Any, tmp_path: Path) -> None:
    run, shown = exported(tmp_path / "out", layout)
    views = read(tmp_path / "out", shown)
    assert len(views) == len(run.scene.train_views) == 10
    for normals, weight, true, ball in views:
        assert set(np.unique(weight)) == {0, 255}
        np.testing.assert_array_equal(weight > 0, ball)
        cosine = (normals * true).sum(-1)[ball] / np.linalg.norm(normals, axis=-1)[ball]
        assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() < ROUNDING


def test_undecided_pixels_have_no_weight(tmp_path: Path) -> None:
    """Transparent pixels, normals that point away from the camera, and surroundings of the subject."""
    run = BallRun()
    view = run.scene.train_views[0]
    true = run.result(view.camera)
    ball = cast(Any, view.ground_truth).mask
    row, column = (int(value) for value in ball.nonzero()[len(ball.nonzero()) // 2])
    changed = {name: true.layers[name].clone() for name in ("normal", "alpha")}
    changed["normal"][row, column] *= -1
    changed["alpha"][row, column + 1] = 0.4
    run.result = lambda camera: true.with_layers(**changed) if camera is view.camera else true  # type: ignore[method-assign]
    exported(tmp_path / "out", "brush", run=run, subject=ALL)
    codes = pixels_of(tmp_path / "out/normals" / f"{view.name}.png")
    expected = np.full(ball.shape, 255)
    expected[row, column : column + 2] = 0
    np.testing.assert_array_equal(codes[..., 3], expected)
    assert codes[row, column, :3].tolist() == [128, 128, 128]


def test_pictures_are_of_choice(tmp_path: Path) -> None:
    means = {}
    for picture in ("photograph", "diffuse", "minimum"):
        run, _ = exported(tmp_path / picture, "brush", picture)
        view = run.scene.train_views[0]
        ball = cast(Any, view.ground_truth).mask.numpy()
        found = pixels_of(tmp_path / picture / "images" / f"{view.name}.png").astype(float)
        linear = view.photograph().numpy()
        share = {"photograph": 1.0, "diffuse": 0.5, "minimum": np.where(ball, 1 - DOLP, 1.0)[..., None]}
        np.testing.assert_allclose(found, 255 * srgb_encode_array(linear * share[picture]), atol=1.0)
        means[picture] = found[ball].mean()
    assert means["diffuse"] < means["minimum"] < means["photograph"]


def test_points_are_where_the_cameras_are(tmp_path: Path) -> None:
    run = BallRun()
    points = torch.eye(3)
    run.scene = polarguide.capture.Scene(
        **{**vars(run.scene), "points": points, "point_colors": torch.tensor([[9, 8, 7]] * 3).byte()}
    )
    _, shown = exported(tmp_path / "out", "dn-splatter", run=run)
    record = json.loads((tmp_path / "out/transforms.json").read_text())
    vertices = PlyData.read(tmp_path / "out" / record["ply_file_path"])["vertex"]
    found = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(found, shown.placement.points(points), atol=1e-6)
    assert [int(vertices[name][0]) for name in ("red", "green", "blue")] == [9, 8, 7]


def test_a_second_export_replaces_the_first(tmp_path: Path) -> None:
    run, _ = exported(tmp_path / "out", "dn-splatter")
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    exported(tmp_path / "out", "dn-splatter", run=run)
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("name", ["images/mine.png", "normals/mine.png", "sparse/0/mine.txt"])
def test_files_of_others_are_left_alone(name: str, tmp_path: Path) -> None:
    (tmp_path / name).parent.mkdir(parents=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(PolarguideError, match=r"other files|mine\.png"):
        exported(tmp_path, "brush")
    assert (tmp_path / name).read_text() == "mine"
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1


def test_pictures_of_views_that_are_gone_are_refused(tmp_path: Path) -> None:
    """Dn-splatter would pair each normal map with the picture of another view."""
    exported(tmp_path / "out", "dn-splatter")
    extra = tmp_path / "out/normals_from_pretrain/00000_v99.png"
    extra.write_bytes(b"")
    with pytest.raises(PolarguideError, match="00000_v99"):
        exported(tmp_path / "out", "dn-splatter")


def test_a_run_writes_both_layouts(trained: Path, tmp_path: Path) -> None:
    run = polarguide.open_run(trained)
    for layout in ("brush", "dn-splatter"):
        paths = run.export("normals", tmp_path, normals=NormalOptions(layout))
        assert all(path.exists() and path.is_relative_to(tmp_path / layout) for path in paths)
    names = [view.name for view in run.scene.train_views]
    codes = [pixels_of(tmp_path / "brush/normals" / f"{name}.png") for name in names]
    assert np.mean([(each[..., 3] > 0).mean() for each in codes]) > 0.2


@pytest.mark.parametrize(
    ("kind", "options", "words"),
    [
        ("cameras", {"layout": "dn-splatter"}, "format normals"),
        ("ply", {"picture": "minimum"}, "format normals"),
        ("normals", {"layout": "gsplat"}, "one of brush, dn-splatter"),
        ("normals", {"picture": "S0"}, "one of photograph, diffuse, minimum"),
    ],
)
def test_wrong_options_are_refused(
    kind: Any, options: Any, words: str, trained: Path, tmp_path: Path
) -> None:
    with pytest.raises(PolarguideError, match=words):
        polarguide.open_run(trained).export(kind, tmp_path, normals=NormalOptions(**options))
    assert not any(tmp_path.iterdir())
