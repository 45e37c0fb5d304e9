"""USDZ, STL and whole packages of a short training: what each holds, and that none names this machine."""

import getpass
import json
import shutil
import socket
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from faults import Fault
from heard import Heard
from plyfile import PlyData
from random_runs import random_state, ring

import polarguide
from polarguide.capture.presentation import Presentation, write_presentation
from polarguide.core.options import EXPORT_PACKAGES, ExportFormat, ModelOptions
from polarguide.gaussians.harmonics import SH_C0
from polarguide.gaussians.ply import read_ply
from polarguide.geometry.scene_frame import scene_frame
from polarguide.optics.color import srgb_decode_array, srgb_encode_array
from polarguide.results.export.model import build
from polarguide.results.export.model.gltf import Textured
from polarguide.results.export.usd import write_splat_usdz, write_usdz
from polarguide.results.rendering.mesh import subject_of
from polarguide.runs.model import write_run_ply

trimesh = pytest.importorskip("trimesh")
SMALL = ModelOptions(triangles=500, texture=128)
CREDIT = Presentation(
    up_axis=(0.0, 0.3, 1.0), meters_per_unit=0.5, title="A thing", author="Somebody", license="CC0"
)
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])


@pytest.fixture
def credited(trained: Path, tmp_path: Path) -> Path:
    copy = Path(shutil.copytree(trained, tmp_path / "copy"))
    write_presentation(copy, CREDIT)
    return copy


def exported(folder: Path, out: Path, kind: ExportFormat) -> None:
    polarguide.open_run(folder).export(kind, out, resolution=32, model=SMALL)


def textured(**changes: Any) -> Textured:
    gray = np.full((8, 8, 3), round(255 * float(srgb_encode_array(np.array(0.18)))), np.uint8)
    values = {"surface": np.full((8, 8, 3), 128, np.uint8), "specular": None, **changes}
    normals = np.tile([0.0, 0, 1], (3, 1))
    return Textured(
        SQUARE,
        normals,
        SQUARE[:, :2],
        np.array([[0, 1, 2]]),
        gray,
        values["surface"],
        values["specular"],
        1.4,
    )


def errors_of(path: Path) -> list[str]:
    """What the validators of USD say of a package."""
    validation, usd = pytest.importorskip("pxr.UsdValidation"), pytest.importorskip("pxr.Usd")
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    found = validation.ValidationContext(validators).Validate(usd.Stage.Open(str(path)))
    return [f"{each.GetName()}: {each.GetMessage()}" for each in found]


@pytest.mark.parametrize("lit", [True, False])
def test_a_usdz_holds_mesh_and_material(lit: bool, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="no usd-core -> pip install '.[usd]'")
    geom, shade = pytest.importorskip("pxr.UsdGeom"), pytest.importorskip("pxr.UsdShade")
    path = tmp_path / "a.usdz"
    write_usdz(path, textured() if lit else textured(surface=None), {"copyright": "Somebody"}, jpeg=False)
    assert [each.name for each in tmp_path.iterdir()] == ["a.usdz"]
    assert errors_of(path) == []
    stage = usd.Stage.Open(str(path))
    assert (geom.GetStageUpAxis(stage), geom.GetStageMetersPerUnit(stage)) == ("Y", 1)
    assert stage.GetRootLayer().customLayerData["copyright"] == "Somebody"
    mesh = geom.Mesh(stage.GetPrimAtPath("/model/mesh"))
    np.testing.assert_array_equal(mesh.GetPointsAttr().Get(), SQUARE)
    np.testing.assert_array_equal(geom.PrimvarsAPI(mesh).GetPrimvar("st").Get(), [[0, 1], [1, 1], [1, 0]])
    surface = shade.Shader(stage.GetPrimAtPath("/model/material/surface"))
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    assert surface.GetInput("ior").Get() == pytest.approx(1.4)
    color = "diffuseColor" if lit else "emissiveColor"
    source = surface.GetInput(color).GetConnectedSources()[0][0].source.GetPrim()
    assert shade.Shader(source).GetInput("sourceColorSpace").Get() == "sRGB"
    if lit:
        roughness = surface.GetInput("roughness").GetConnectedSources()[0][0]
        assert roughness.sourceName == "g"
        assert shade.Shader(roughness.source.GetPrim()).GetInput("sourceColorSpace").Get() == "raw"


def test_a_usdz_holds_splats(tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="no usd-core -> pip install '.[usd]'")
    vol = pytest.importorskip("pxr.UsdVol")
    if not hasattr(vol, "ParticleField3DGaussianSplat"):
        pytest.skip("this usd-core knows no splats")
    state, shading = random_state("3dgs-dr", 9)
    write_run_ply(tmp_path / "a.ply", state, shading)
    write_splat_usdz(tmp_path / "a.usdz", tmp_path / "a.ply", {})
    assert errors_of(tmp_path / "a.usdz") == []
    stage = usd.Stage.Open(str(tmp_path / "a.usdz"))
    field, ply = (
        vol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/model/splats")),
        read_ply(tmp_path / "a.ply"),
    )
    np.testing.assert_array_equal(field.GetPositionsAttr().Get(), ply["means"])
    np.testing.assert_allclose(field.GetScalesAttr().Get(), ply["log_scales"].exp().numpy(), rtol=1e-6)
    turns = np.array([[q.GetReal(), *q.GetImaginary()] for q in field.GetOrientationsAttr().Get()])
    np.testing.assert_allclose(turns, ply["quaternions"].numpy(), atol=1e-6)
    harmonics = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(9, 16, 3)
    np.testing.assert_array_equal(harmonics[:, 0], ply["sh_dc"][:, 0])
    np.testing.assert_array_equal(harmonics[:, 1:], ply["sh_rest"])


def mean_color(folder: Path, kind: ExportFormat, out: Path) -> np.ndarray:
    """Linear, of a PLY of splats or of a mesh."""
    exported(folder, out, kind)
    if kind == "ply":
        shown = 0.5 + SH_C0 * read_ply(out / "splats.ply")["sh_dc"][:, 0].numpy()
    else:
        rows = PlyData.read(out / "mesh.ply")["vertex"]
        shown = np.stack([rows[name] for name in ("red", "green", "blue")], axis=1) / 255
    return np.asarray(srgb_decode_array(np.clip(shown, 0, 1)).mean(axis=0))


@pytest.mark.parametrize("kind", ["ply", "mesh"])
def test_white_balance_reaches_colors(kind: ExportFormat, credited: Path, tmp_path: Path) -> None:
    before = mean_color(credited, kind, tmp_path / "a")
    write_presentation(credited, Presentation(white_balance=(1.0, 0.5, 0.25)))
    np.testing.assert_allclose(mean_color(credited, kind, tmp_path / "b"), before * [1, 0.5, 0.25], rtol=0.05)


def test_an_stl_is_closed_in_millimeters_and_upright(credited: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for kind in ("stl", "glb"):
        exported(credited, out, kind)
    printed = trimesh.load(out / "model.stl")
    assert printed.is_watertight
    assert printed.is_winding_consistent
    model = trimesh.load(out / "model.glb", process=False).to_geometry()
    x, y, z = 1000 * model.bounds.T
    expected = np.array([x, -z[::-1], y]).T
    np.testing.assert_allclose(printed.bounds, expected, atol=0.1 * np.ptp(expected, axis=0).max())
    head = (out / "model.stl").read_bytes()[:80]
    assert b"Somebody, CC0" in head
    assert not head.startswith(b"solid")


def test_a_package_tells_of_itself(credited: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    once = Mock(wraps=build.unwrap)  # its two models share their charts
    monkeypatch.setattr(build, "unwrap", once)
    exported(credited, out, "all")
    once.assert_called_once()
    record = json.loads((out / "model.json").read_text())
    assert {*record["files"], "model.json"} == {path.name for path in out.iterdir()}
    assert {"model.glb", "model-unlit.glb", "splats-srgb.glb", "environment.hdr", "preview.png"} | {
        f"splats.{kind}" for kind in ("ply", "spz")
    } <= {*record["files"]}
    about = (record["title"], record["author"], record["license"], record["units"], record["scale_of_scene"])
    assert about == ("A thing", "Somebody", "CC0", "meters", 0.5)
    assert record["color"] is None
    assert "absolute brightness" in record["not_known"][0]
    # Its cameras look at its model: both are in the same axes and units.
    model = trimesh.load(out / "model.glb", process=False).to_geometry()
    poses = np.array([frame["transform_matrix"] for frame in record["cameras"]])
    toward = model.vertices.mean(axis=0) - poses[:, :3, 3]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    assert np.median((toward * -poses[:, :3, 2]).sum(axis=1)) > 0.9


def test_no_file_names_the_machine(credited: Path, tmp_path: Path) -> None:
    """Neither folders, nor its name, nor its user, in any format."""
    out = tmp_path / "out"
    scene = json.loads((credited / "run.json").read_text())["scene"]
    folders = {str(tmp_path), str(Path.home()), str(Path(scene).parent)}
    secrets = folders | {name for name in (getpass.getuser(), socket.gethostname()) if len(name) > 5}
    for kind in get_args(ExportFormat):
        for package in EXPORT_PACKAGES.get(kind, ()):
            pytest.importorskip(package)
        exported(credited, out / kind, kind)
    files = [path for path in out.rglob("*") if path.is_file()]
    assert len(files) > 25
    for path in files:
        data = path.read_bytes()
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                data += b"".join(archive.read(name) for name in archive.namelist())
        assert not [secret for secret in secrets if secret.encode() in data], path.name


def test_masks_choose_the_subject() -> None:
    """Half of the pictures is foreground: what most of the views see there."""
    cameras = ring(12, width=96, height=72)
    frame = scene_frame(list(cameras.values()))
    up = frame.panorama_axes()[:, 1]
    mask = torch.zeros(72, 96, dtype=torch.bool)
    mask[:36] = True  # the upper half
    views = [SimpleNamespace(camera=camera, mask=mask) for camera in cameras.values()]
    plain = Presentation()
    opened: Any = SimpleNamespace(
        scene=SimpleNamespace(views=views), has_masks=True, camera_frame=frame, presentation=plain
    )
    inside = subject_of(opened).inside
    assert inside is not None
    places = (frame.center + torch.tensor([[0.3], [-0.3]]) * frame.distance * up).numpy()
    assert inside(places).tolist() == [True, False]
    opened.presentation = Presentation(whole=True)
    assert subject_of(opened).inside is None
    opened.has_masks = False
    Fault(where="--masked", found="none").raised_by(subject_of, opened, masked=True)


def test_without_masks_it_is_what_most_cameras_look_at() -> None:
    """A ring of cameras: their center, and not what lies behind it, which a few of them see, nor behind their backs."""
    cameras = ring(12, width=96, height=72)
    frame = scene_frame(list(cameras.values()))
    opened: Any = SimpleNamespace(presentation=Presentation(), has_masks=False, poses=cameras)
    subject = subject_of(opened)
    across = frame.panorama_axes()[:, 0]
    places = frame.center + torch.tensor([[0.0], [0.2], [1.0], [3.0]]) * frame.distance * across
    assert subject.holds(places).tolist() == [True, True, False, False]
    opened.folder = Path("my run")
    heard = Heard()
    subject.report_removed(torch.tensor([True, True, True]), opened, heard)
    assert heard.said == []
    subject.report_removed(torch.tensor([True, False, True]), opened, heard)
    (line,) = heard.said
    assert line.startswith("2 of 3 Gaussians")
    assert "polarguide present 'my run' --crop all" in line
