"""Exported Gaussians, turned and in other units, look as before to cameras that were turned and moved with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from random_runs import random_state, ring

from polarguide.capture.presentation import Presentation
from polarguide.gaussians.harmonics import evaluate_sh
from polarguide.gaussians.ply import read_ply
from polarguide.geometry.scene_frame import scene_frame
from polarguide.raster import Splats
from polarguide.raster.cpu import rasterize_cpu
from polarguide.results.export.placement import (
    IN_PLACE,
    Origin,
    Placement,
    comments,
    rewrite_splats,
    with_comments,
)
from polarguide.runs.model import write_run_ply

CAMERAS = ring()
AROUND = scene_frame(list(CAMERAS.values()))
UP = (0.3, 0.8, -0.5)
TURNED = Presentation(up_axis=UP, meters_per_unit=0.2)


def placed(presentation: Presentation) -> Placement:
    return Placement.of(presentation, presentation.upright(AROUND))


def picture(ply: Path, camera, field: str = "") -> torch.Tensor:  # type: ignore[no-untyped-def]
    """What a viewer of splats shows; of other harmonics in the file, if a field is named."""
    found = read_ply(ply)
    dc, rest = found["sh_dc"], found["sh_rest"]
    if field:
        dc, rest = (
            found["extra"][f"{field}_dc"].reshape(-1, 1, 3),
            found["extra"][f"{field}_rest"].reshape(-1, 15, 3),
        )
    colors = evaluate_sh(found["means"], camera.center.float(), dc[:, 0], rest, 3)
    splats = Splats(
        found["means"],
        found["quaternions"],
        found["log_scales"].exp(),
        torch.sigmoid(found["opacity_logits"]),
        colors,
    )
    return rasterize_cpu(splats, camera).features


@pytest.mark.parametrize(
    "presentation", [TURNED, Presentation(meters_per_unit=3.0), Presentation(up_axis=UP)]
)
def test_the_same_picture_from_the_same_place(presentation: Presentation, tmp_path: Path) -> None:
    state, shading = random_state("polarguide-stokes")
    whole, moved, placement = tmp_path / "whole.ply", tmp_path / "moved.ply", placed(presentation)
    write_run_ply(whole, state, shading)
    rewrite_splats(moved, whole, placement, None, [])
    camera = CAMERAS["v2"]
    for field in ("", "linear"):
        before, after = picture(whole, camera, field), picture(moved, placement.camera(camera), field)
        assert float(before.std()) > 0.02
        torch.testing.assert_close(after, before, atol=2e-3, rtol=0)
    normals = [
        np.stack([PlyData.read(p)["vertex"][n] for n in ("nx", "ny", "nz")], 1) for p in (whole, moved)
    ]
    np.testing.assert_allclose(placement.directions(torch.from_numpy(normals[0])), normals[1], atol=1e-6)


def test_up_is_minus_y_and_lengths_are_meters() -> None:
    placement = placed(TURNED)
    up = torch.tensor([UP], dtype=torch.float64)
    torch.testing.assert_close(
        placement.directions(up / up.norm())[0],
        torch.tensor([0.0, -1, 0], dtype=torch.float64),
        atol=1e-12,
        rtol=0,
    )
    assert float(torch.linalg.det(placement.rotation)) == pytest.approx(1.0)
    ends = placement.points(torch.tensor([[0.0, 0, 0], [5.0, 0, 0]]))
    assert float((ends[1] - ends[0]).norm()) == pytest.approx(1.0)
    assert placement.record()["units"] == "meters"
    assert not IN_PLACE.changes


def test_only_what_is_kept_is_written_and_the_third_line_stays(tmp_path: Path) -> None:
    state, shading = random_state("3dgs-dr")
    write_run_ply(tmp_path / "whole.ply", state, shading)
    kept = torch.zeros(300, dtype=torch.bool)
    kept[7] = kept[11] = True
    origin = Origin(Presentation(author="Renée ©", license="CC0", provenance="北京"), "a recipe")
    rewrite_splats(tmp_path / "some.ply", tmp_path / "whole.ply", IN_PLACE, kept, comments(origin, IN_PLACE))
    all_of_them, found = read_ply(tmp_path / "whole.ply"), read_ply(tmp_path / "some.ply")
    for name in ("means", "sh_rest", "quaternions"):
        assert torch.equal(found[name], all_of_them[name][kept])
    assert found["extra"].keys() == all_of_them["extra"].keys()
    lines = (tmp_path / "some.ply").read_bytes().split(b"end_header")[0].decode("ascii").splitlines()
    assert lines[2] == "element vertex 2"
    assert {"comment author Renee (c)", "comment license CC0", "comment source \\u5317\\u4eac"} <= set(lines)
    assert "comment units units of the scene" in lines


def test_comments_are_put_into_a_ply_of_others(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.box()
    data = with_comments(mesh.export(file_type="ply"), ["author A", "units meters"])
    (tmp_path / "box.ply").write_bytes(data)
    read = PlyData.read(tmp_path / "box.ply")
    assert {"author A", "units meters"} <= {*read.comments, *read["vertex"].comments}
    assert len(trimesh.load(tmp_path / "box.ply").faces) == 12
