"""A color chart drawn by a camera of known matrix: it is found again, its error is stated, and exports follow it."""

from __future__ import annotations

import functools
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from glb_files import read_glb
from plyfile import PlyData
from skimage.color import lab2xyz

import polarguide
from polarguide.capture import Scene, View
from polarguide.capture.presentation import (
    Presentation,
    colored,
    colored_reflectance,
    in_camera,
    read_presentation,
)
from polarguide.gaussians.harmonics import sh_basis
from polarguide.gaussians.ply import read_ply
from polarguide.geometry.camera import Camera
from polarguide.optics.color import srgb_decode
from polarguide.results.rendering.present import LAB, XYZ_OF_SRGB, chart_of, presentation_lines
from polarguide.results.rendering.relight import read_panorama

# Of a camera whose green is strong and whose channels overlap.
MATRIX = np.array([(2.1, -0.5, -0.1), (-0.3, 1.4, -0.2), (0.05, -0.5, 2.4)])
CORNERS = np.array([(70.0, 60.0), (310.0, 85.0), (290.0, 225.0), (60.0, 190.0)])
SIZE = 380, 280


def picture(corners: np.ndarray = CORNERS, size: tuple[int, int] = SIZE, scale: float = 1.0) -> np.ndarray:
    """Linear RGB of a camera [H, W, 3]: the chart on gray, its corner patches' centers at ``corners``."""
    srgb = lab2xyz(LAB, illuminant="D50") @ np.linalg.inv(XYZ_OF_SRGB).T
    patches = (scale * srgb @ np.linalg.inv(MATRIX).T).reshape(4, 6, 3)
    to_chart = cv2.getPerspectiveTransform(
        corners.astype(np.float32), np.array([(0, 0), (5, 0), (5, 3), (0, 3)], np.float32)
    )
    y, x = np.mgrid[0 : size[1], 0 : size[0]] + 0.5
    place = np.stack([x, y, np.ones_like(x)], axis=-1) @ to_chart.T
    place = place[..., :2] / place[..., 2:]
    nearest = np.rint(place)
    inside = (np.abs(place - nearest) < 0.42).all(-1) & (nearest >= 0).all(-1) & (nearest <= (5, 3)).all(-1)
    column, row = np.moveaxis(np.clip(nearest, 0, (5, 3)).astype(int), -1, 0)
    return np.clip(np.where(inside[..., None], patches[row, column], 0.05), 0, 1)


def view_of(linear: np.ndarray) -> View:
    """A view of a photograph, unpolarized."""
    height, width, _ = linear.shape
    lens = [[300, 0, width / 2], [0, 300, height / 2], [0, 0, 1]]
    moved = np.eye(4)
    moved[0, 3] = 1
    cameras = [Camera.from_matrices(lens, pose, width, height) for pose in (np.eye(4), moved)]
    return Scene.from_arrays([np.stack([linear] * 4)] * 2, cameras, points=np.array([(0.0, 0, 2)])).view(
        "v000"
    )


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0, 1), (1, 0, 3, 2), (3, 0, 1, 2)])
def test_the_matrix_of_a_camera_is_found_again_from_any_corner(order: tuple[int, ...]) -> None:
    found = chart_of(view_of(picture()), CORNERS[list(order)].ravel())
    np.testing.assert_allclose(found.matrix, MATRIX, atol=0.01)
    assert found.patches == 24
    assert found.delta_e_worst < 0.05


def test_noise_and_uneven_light_are_stated_as_what_they_do_to_patches_that_were_left_out() -> None:
    random = np.random.default_rng(0)
    light = np.linspace(0.85, 1.15, SIZE[0])[:, None] * random.normal(1, 0.03, (SIZE[1], SIZE[0], 1))
    found = chart_of(view_of(0.9 * picture() * light), CORNERS.ravel())
    true = np.linalg.inv(MATRIX) @ np.array(found.matrix)
    np.testing.assert_allclose(0.9 * true, np.eye(3), atol=0.1)
    assert 1 < found.delta_e < 3
    assert found.delta_e < found.delta_e_worst


@pytest.mark.parametrize(
    ("scale", "corners", "fault"),
    [
        (4.0, CORNERS, Fault("chart", "18 of 24 patches", "in v000")),
        (1.0, CORNERS / 8, Fault("chart", "16 pixels", "0 in v000")),
        (1.0, CORNERS + (45, 0), Fault("chart", "mean CIEDE2000 of at most 6", "in v000")),
        (1.0, CORNERS * 0 + 5, Fault("chart", "18 of 24 patches", "0 in v000")),
    ],
)
def test_clipped_and_small_patches_and_wrong_corners_are_refused(
    scale: float, corners: np.ndarray, fault: Fault
) -> None:
    fault.raised_by(chart_of, view_of(picture(scale=scale)), corners.ravel())


def test_what_is_relit_and_shown_is_what_was_given() -> None:
    color = Presentation(chart=chart_of(view_of(picture()), CORNERS.ravel()), exposure=-1.0).color
    light = torch.rand(5, 3)
    torch.testing.assert_close(colored(in_camera(light, color), color), light, atol=1e-5, rtol=1e-4)
    gray = torch.full((3,), 0.4)
    torch.testing.assert_close(colored_reflectance(gray, color), gray)
    tinted = torch.tensor([0.9, 0.6, 0.3])
    white = Presentation(white_balance=(2.0, 1.0, 0.5)).color
    torch.testing.assert_close(colored_reflectance(tinted, white), tinted)


def test_a_chart_of_a_scene_reaches_pictures_splats_mesh_points_and_light_of_its_run(
    trained: Path,
    demo_scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("polarguide.results.rendering.mesh.OPAQUE", 0.05)  # nothing is opaque yet
    charted, run_folder = (
        Path(shutil.copytree(folder, tmp_path / folder.name)) for folder in (demo_scene, trained)
    )
    corners = np.array([(20.0, 20), (100, 24), (96, 76), (24, 72)])
    drawn = np.rint(65535 * picture(corners, (128, 96))[..., ::-1]).astype(np.uint16)
    for file in (charted / "polar").glob("v000_*.png"):
        cv2.imwrite(str(file), drawn)
    places = ",".join(f"{value:g}" for value in corners.ravel())
    said = presentation_lines(polarguide.present(charted, chart=f"v000,{places}"))
    assert "color chart: 24 patches in v000, CIEDE2000 0.0, up to 0.0" in said
    before = exported(run_folder, tmp_path / "before")
    polarguide.present(run_folder, chart=str(charted), exposure="0.5")
    presented = read_presentation(run_folder)
    assert presented.chart == read_presentation(charted).chart
    color = presented.color
    np.testing.assert_allclose(color, MATRIX * 2**0.5, atol=0.05)
    after = exported(run_folder, tmp_path / "after")
    for name, linear in before.items():
        expected = colored(linear, color).clamp(max=200 if name == "light" else 1)
        error = (after[name] - expected).abs().median()  # splats are fits to colors that clip
        assert error < 0.02 < (after[name] - linear).abs().mean(), f"{name}: {error}"
    assert polarguide.present(run_folder, white_balance="2,1,1").chart is None
    wrong = functools.partial(polarguide.present, run_folder)
    Fault("chart", "VIEW and the four corners", str(tmp_path)).raised_by(wrong, chart=str(tmp_path))
    Fault("exposure", "-8 to 8", "9").raised_by(wrong, exposure="9")


def exported(folder: Path, out: Path) -> dict[str, torch.Tensor]:
    """Linear colors [N, 3] of what a run's exports and pictures show."""
    trained = polarguide.open_run(folder, device="cpu")
    for kind in ("ply", "mesh", "environment"):
        trained.export(kind, out, resolution=24)
    trained.write_pictures(out, views="v001", layers=["final", "dolp"])
    mesh = read_glb(out / "mesh.glb")[1]["COLOR_0"][:, :3]
    vertices = PlyData.read(out / "mesh.ply")["vertex"]
    splats = read_ply(out / "splats.ply")
    shown = 0.5 + sh_basis(torch.tensor([[0.0, 0, 1]]), 3) @ torch.cat(
        (splats["sh_dc"], splats["sh_rest"]), dim=1
    )
    shades = torch.from_numpy(np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1)) / 255
    final = cv2.imread(str(out / "v001_final.png"))[..., ::-1].reshape(-1, 3) / 255
    return {
        "mesh": torch.tensor(np.asarray(mesh)).float() / 255,
        "splats": srgb_decode(shown[:, 0].clamp(0, 1)),
        "mesh, PLY": srgb_decode(shades),
        "light": read_panorama(out / "environment.hdr").reshape(-1, 3),
        "final": srgb_decode(torch.from_numpy(final.copy())).float(),
    }
