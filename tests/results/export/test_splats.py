"""Splats as PLY and SPZ."""

import dataclasses
import gzip
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.lib.recfunctions import structured_to_unstructured
from plyfile import PlyData
from random_runs import random_state, ring
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

import polarguide
from polarguide.capture.presentation import Presentation
from polarguide.core.errors import PolarguideWarning
from polarguide.gaussians.geometry import quaternions_to_rotations, shortest_axis_normals
from polarguide.gaussians.harmonics import evaluate_sh, sh_basis
from polarguide.gaussians.ply import RELEASE_FIELDS, read_ply
from polarguide.geometry.scene_frame import scene_frame
from polarguide.raster import Splats
from polarguide.raster.cpu import rasterize_cpu
from polarguide.results.export.adapters import ply_fields
from polarguide.results.export.placement import (
    IN_PLACE,
    Origin,
    Placement,
    comments,
    rewrite_splats,
)
from polarguide.results.export.splats import write_spz
from polarguide.runs.model import gaussian_colors, write_run_ply
from polarguide.shading.gbuffer import single_colors

COUNT = 7
FIELDS = {
    "3dgs": {"linear_dc", "linear_rest"},
    "3dgs-dr": {"linear_dc", "linear_rest", "strength"},
    "ref-gs": {"linear_dc", "linear_rest", "albedo", "roughness", "feature", "surface"},
}


@pytest.mark.parametrize("name", FIELDS)
def test_the_file_holds_display_colors_and_the_fields_of_the_model(name: str, tmp_path: Path) -> None:
    state, shading = random_state(name, COUNT)
    write_run_ply(tmp_path / "run.ply", state, shading)
    assert read_ply(tmp_path / "run.ply")["extra"] == {}
    write_run_ply(tmp_path / "run.ply", state, shading, own_fields=ply_fields(shading, state.gaussians))
    read = read_ply(tmp_path / "run.ply")
    assert set(read["extra"]) == FIELDS[name]
    assert all(bool(torch.isfinite(t).all()) for t in (read["sh_dc"], read["sh_rest"]))
    for field, values in ply_fields(shading, state.gaussians).items():
        torch.testing.assert_close(read["extra"][field], values.detach())


def test_a_directional_gaussian_shows_its_albedo_and_the_light_in_its_mirror() -> None:
    state, shading = random_state("ref-gs", COUNT)
    gaussians, ray = state.gaussians, torch.tensor([[0.0, 0.6, 0.8]])
    shape = (gaussians[name] for name in ("means", "quaternions", "log_scales"))
    normals = shortest_axis_normals(*shape, torch.zeros(3))
    facing = torch.where(normals @ ray[0][:, None] > 0, -normals, normals)
    linear = single_colors(gaussians, state.light, shading, ray.expand(COUNT, 3), facing)
    found = gaussian_colors(state.gaussians, state.light, shading, ray)[:, 0]
    torch.testing.assert_close(found, linear.detach())


def test_an_exported_file_has_the_records_of_the_release(trained: Path, tmp_path: Path) -> None:
    """A viewer that reads 62 floats per record, and a parser that reads fields by name, get the same values."""
    trimesh = pytest.importorskip("trimesh")
    run = polarguide.open_run(trained)
    run.export("ply", tmp_path)
    lines, _, body = (tmp_path / "splats.ply").read_bytes().partition(b"end_header\n")
    header = lines.decode("ascii").splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(header[2].removeprefix("element vertex "))
    records = np.frombuffer(body, "<f4").reshape(count, 62)
    cloud = trimesh.load(tmp_path / "splats.ply", process=False)
    by_name = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert by_name.dtype.names == RELEASE_FIELDS
    np.testing.assert_array_equal(structured_to_unstructured(by_name), records)
    np.testing.assert_allclose(cloud.vertices, records[:, :3])
    gaussians = read_ply(tmp_path / "splats.ply")
    np.testing.assert_array_equal(records[:, 54], gaussians["opacity_logits"])
    np.testing.assert_array_equal(records[:, 55:58], gaussians["log_scales"])
    np.testing.assert_array_equal(records[:, 58:62], gaussians["quaternions"])
    np.testing.assert_array_equal(records[:, 6:9], gaussians["sh_dc"][:, 0])
    np.testing.assert_array_equal(records[:, 9:24], gaussians["sh_rest"][..., 0])


def test_normals_are_the_learned_ones_and_face_the_nearest_camera(tmp_path: Path) -> None:
    """Read by trimesh, which takes nx, ny, nz for the normals of its vertices."""
    trimesh = pytest.importorskip("trimesh")
    state, shading = random_state("3dgs", 50)
    centers = torch.tensor([[9.0, 0.0, 0.0], [-9.0, 0.0, 0.0]])
    write_run_ply(tmp_path / "run.ply", state, shading, centers)
    raw = trimesh.load(tmp_path / "run.ply").metadata["_ply_raw"]["vertex"]["data"]
    normals = torch.from_numpy(
        np.stack([raw[name] for name in ("nx", "ny", "nz")], axis=1).astype(np.float64)
    )
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(50, dtype=torch.float64), atol=1e-5, rtol=0)
    means = state.gaussians["means"].detach().double()
    rotations = Rotation.from_quat(state.gaussians["quaternions"].detach().double()[:, [1, 2, 3, 0]].numpy())
    axes = torch.from_numpy(rotations.as_matrix())
    shortest = axes[torch.arange(50), :, state.gaussians["log_scales"].detach().argmin(dim=1)]
    assert bool(((normals * shortest).sum(dim=1).abs() > 0.9999).all())
    nearest = centers.double()[(means[:, :1] < 0).long()[:, 0]]
    assert bool(((normals * (nearest - means)).sum(dim=1) >= -1e-6).all())


TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


def test_the_whole_scene_is_turned(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(1)
    state, shading = random_state("3dgs", 7)
    write_run_ply(tmp_path / "run.ply", state, shading)
    ours = read_ply(tmp_path / "run.ply")
    placement = dataclasses.replace(IN_PLACE, rotation=TURN.double())
    rewrite_splats(
        tmp_path / "turned.ply", tmp_path / "run.ply", placement, torch.ones(7, dtype=torch.bool), []
    )
    turned = read_ply(tmp_path / "turned.ply")
    torch.testing.assert_close(turned["means"], ours["means"] @ TURN.T)
    # Both sets of axes span the same ellipsoid.
    ellipsoids = [
        quaternions_to_rotations(rows["quaternions"]) * rows["log_scales"].exp()[:, None]
        for rows in (ours, turned)
    ]
    expected, found = (axes @ axes.mT for axes in (TURN @ ellipsoids[0], ellipsoids[1]))
    torch.testing.assert_close(found, expected)
    # What is seen along a turned direction is what was seen along the direction.
    directions = normalize(torch.randn(20, 3, generator=generator), dim=-1)
    for rest in (ours["sh_rest"], turned["sh_rest"]):
        assert rest.shape[1] == 15
        assert bool((rest.abs().amax(dim=(0, 2)) > 1e-3).all()), "every harmonic takes part"
    before = torch.einsum("dk,nkc->ndc", sh_basis(directions, 3)[:, 1:], ours["sh_rest"])
    after = torch.einsum("dk,nkc->ndc", sh_basis(directions @ TURN.T, 3)[:, 1:], turned["sh_rest"])
    torch.testing.assert_close(after, before, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("version", [3, 4])
def test_both_versions_are_written_and_read(tmp_path: Path, version: int) -> None:
    forge = pytest.importorskip("gaussforge").GaussForge()
    state, shading = random_state("3dgs", 7)
    write_run_ply(tmp_path / "run.ply", state, shading)
    write_spz(tmp_path / "run.spz", tmp_path / "run.ply", version)
    data = (tmp_path / "run.spz").read_bytes()
    head = gzip.decompress(data) if version == 3 else data
    assert head[:4] == b"NGSP"
    assert int.from_bytes(head[4:8], "little") == version
    (tmp_path / "back.ply").write_bytes(forge.convert(data, "spz", "ply")["data"])
    found, ours = read_ply(tmp_path / "back.ply"), read_ply(tmp_path / "run.ply")
    torch.testing.assert_close(found["means"], ours["means"], atol=1 / 4096, rtol=0)


def test_gaussians_beyond_the_range_of_spz_look_the_same_from_the_origin(tmp_path: Path) -> None:
    forge = pytest.importorskip("gaussforge").GaussForge()
    state, shading = random_state("3dgs", 7)
    means = state.gaussians["means"].detach()
    means[2] = torch.tensor([500.0, -4094.0, 0.0])
    write_run_ply(tmp_path / "run.ply", state, shading)
    with pytest.warns(PolarguideWarning, match="1 of 7 Gaussians"):
        write_spz(tmp_path / "run.spz", tmp_path / "run.ply")
    data = forge.convert((tmp_path / "run.spz").read_bytes(), "spz", "ply")["data"]
    (tmp_path / "back.ply").write_bytes(data)
    found = read_ply(tmp_path / "back.ply")
    expected = read_ply(tmp_path / "run.ply")
    expected["means"][2] /= 2
    expected["log_scales"][2] -= math.log(2)
    torch.testing.assert_close(found["means"], expected["means"], atol=1 / 4096, rtol=0)
    torch.testing.assert_close(found["log_scales"], expected["log_scales"], atol=1 / 16, rtol=0)


CAMERAS = ring()
AROUND = scene_frame(list(CAMERAS.values()))
UP = (0.3, 0.8, -0.5)
TURNED = Presentation(up_axis=UP, meters_per_unit=0.2)


def placed(presentation: Presentation) -> Placement:
    """In the scene's own axes where no up axis was chosen."""
    return Placement.of(presentation, presentation.upright(AROUND) if presentation.up_axis else None)


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
    write_run_ply(whole, state, shading, own_fields=ply_fields(shading, state.gaussians))
    everything = torch.ones(len(read_ply(whole)["means"]), dtype=torch.bool)
    rewrite_splats(moved, whole, placement, everything, [])
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
