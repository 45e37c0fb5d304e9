"""polarguide present, and what export, share and render make of it, on a short training."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from plyfile import PlyData

import polarguide
from polarguide.capture.presentation import PRESENTATION_FILE, Crop, Presentation, read_presentation
from polarguide.cli.app import run
from polarguide.gaussians.ply import read_ply
from polarguide.results.rendering import present as presenting
from polarguide.results.rendering.pictures import path_cameras

ONE = ("--threads", "1")


@pytest.fixture
def scene(demo_scene: Path, tmp_path: Path) -> Path:
    """A copy of the demo scene."""
    return Path(shutil.copytree(demo_scene, tmp_path / "scene"))


def present(folder: Path, *options: str) -> Presentation:
    assert run(["present", str(folder), *options, *ONE]) == 0
    return read_presentation(folder)


def test_a_file_with_an_unknown_name_is_refused(scene: Path, refused: Callable[..., str]) -> None:
    (scene / PRESENTATION_FILE).write_text('{"autor": "A"}')
    assert "found autor" in refused("present", scene)


def test_options_are_kept_one_by_one_and_taken_back(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    present(copy, "--author", "Museum of Things", "--license", "CC-BY-4.0", "--white-balance", "1.5,1,0.5")
    found = present(copy, "--up-axis=-y", "--meters-per-unit", "0.5", "--crop=-40,30,-20,10,-5,50")
    assert found == Presentation(
        white_balance=(1.5, 1.0, 0.5),
        up_axis=(0.0, -1.0, 0.0),
        meters_per_unit=0.5,
        crop=Crop((-0.4, -0.2, -0.05), (0.3, 0.1, 0.5), (0.0, -1.0, 0.0)),
        author="Museum of Things",
        license="CC-BY-4.0",
    )
    capsys.readouterr()
    assert present(copy) == found
    said = capsys.readouterr().out
    assert "white balance: 1.5, 1, 0.5" in said
    assert "scale: 1 unit is 50 cm" in said
    assert "crop: -40, 30, -20, 10, -5, 50 %" in said
    gone = ("white-balance", "up-axis", "meters-per-unit", "crop", "author", "license")
    assert present(copy, *(word for name in gone for word in (f"--{name}", "none"))) == Presentation()


def test_a_scene_s_holds_for_its_runs_which_may_have_others(
    copy: Path, scene: Path, refused: Callable[..., str]
) -> None:
    present(scene, "--author", "A", "--meters-per-unit", "2")
    configuration = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps({**configuration, "scene": str(scene)}))
    present(copy, "--meters-per-unit", "3")
    trained = polarguide.open_run(copy, device="cpu")
    assert (trained.presentation.author, trained.presentation.meters_per_unit) == ("A", 3.0)
    assert "a value of its scene" in refused("present", copy, "--author", "none")
    assert polarguide.load_scene(scene).digest == configuration["scene_digest"], "it is no part of the data"


def test_white_is_picked_in_a_photograph_or_is_their_mean(scene: Path) -> None:
    view = polarguide.load_scene(scene, views=["v000"]).views[0]
    gains = torch.tensor(present(scene, "--white-balance", "v000,60.5,80.5").white_balance)
    color = presenting.photograph_color(view, 60.5, 80.5)
    torch.testing.assert_close(color * gains, color[1].expand(3))
    views = polarguide.load_scene(scene).train_views
    gains = torch.tensor(present(scene, "--white-balance", "gray").white_balance)
    mean = torch.cat([view.photograph()[~(view.invalid | view.saturated)] for view in views]).mean(dim=0)
    torch.testing.assert_close(mean * gains, mean[1].expand(3), rtol=1e-4, atol=0)


def test_scale_from_two_points(copy: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert present(copy, "--points", "0,0,0", "0,3,4", "--distance", "85mm").meters_per_unit == pytest.approx(
        0.017
    )
    cameras = polarguide.open_run(copy, device="cpu").cameras
    apart = float((cameras["v000"].center - cameras["v003"].center).norm())
    for folder in (copy, scene):
        found = present(folder, "--points", "v000", "v003", "--distance", "2m").meters_per_unit
        assert found == pytest.approx(2 / apart)
    monkeypatch.setattr(presenting, "LEAST_ALPHA", 0.0)  # nothing is opaque yet
    trained = polarguide.open_run(copy, device="cpu")
    result, camera = trained.result("v000"), cameras["v000"]
    places = [presenting.surface_at(result, camera, x, y) for x, y in ((5.5, 12.5), (25.5, 12.5))]
    apart = float((places[0].point - places[1].point).norm())
    found = present(copy, "--points", "v000,5.5,12.5", "v000,25.5,12.5", "--distance", "1in").meters_per_unit
    assert found == pytest.approx(0.0254 / apart, rel=1e-4)


def test_exports_are_cropped_upright_in_meters_and_say_whose_they_are(copy: Path, tmp_path: Path) -> None:
    trained = polarguide.open_run(copy, device="cpu")
    present(copy, "--crop", "all")
    plain = trained.export("ply", tmp_path / "plain", axes="scene")[0]
    axis = (0.0, 1.0, 0.0)
    options = [
        "--up-axis",
        "y",
        "--meters-per-unit",
        "0.25",
        "--crop=-60,60,-60,60,-60,60",
        "--author",
        "A",
        "--license",
        "CC0",
    ]
    crop = present(copy, *options).crop
    before, inside = read_ply(plain), crop.inside(read_ply(plain)["means"], trained.camera_frame)
    assert 0 < int(inside.sum()) < len(inside)
    trained.export("ply", tmp_path)
    found = read_ply(tmp_path / "splats.ply")
    assert len(found["means"]) == int(inside.sum())
    up = before["means"][inside] @ torch.tensor(axis)
    torch.testing.assert_close(-found["means"][:, 1], 0.25 * up, atol=1e-5, rtol=1e-4)
    header = (tmp_path / "splats.ply").read_bytes().split(b"end_header")[0].decode()
    for line in ("author A", "license CC0", "units meters", "up_axis -y", "meters_per_unit_of_scene 0.25"):
        assert f"comment {line}\n" in header
    trained.export("cameras", tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    for image in model.images.values():
        center = trained.cameras[Path(image.name).stem].center
        assert -image.projection_center()[1] == pytest.approx(
            0.25 * float(center @ torch.tensor(axis).double())
        )
    assert "# units meters" in (tmp_path / "sparse" / "0" / "cameras.txt").read_text()
    poses = json.loads((tmp_path / "transforms.json").read_text())
    assert (poses["author"], poses["units"]) == ("A", "meters")
    trained.export("spz", tmp_path)


def test_a_crop_box_with_nothing_in_it_is_refused(copy: Path, refused: Callable[..., str]) -> None:
    present(copy, "--crop=9000,9001,9000,9001,9000,9001")
    for verb in (["export", copy, "--format", "ply"], ["share", copy]):
        assert "the crop box: expected" in refused(*verb, *ONE)


def test_the_mesh_says_its_units_and_whose_it_is(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setattr("polarguide.results.rendering.mesh.OPAQUE", 0.05)  # nothing is opaque yet
    trained = polarguide.open_run(copy, device="cpu")
    trained.export("mesh", tmp_path / "plain", resolution=24, axes="scene")
    present(copy, "--meters-per-unit", "0.5", "--author", "Zoë", "--license", "CC-BY-4.0", "--title", "Cup")
    trained.export("mesh", tmp_path / "half", resolution=24, axes="scene")
    sizes = {}
    for name in ("mesh.ply", "mesh.glb"):
        plain, half = (trimesh.load(tmp_path / folder / name, force="mesh") for folder in ("plain", "half"))
        sizes[name] = half.extents
        np.testing.assert_allclose(half.extents, 0.5 * plain.extents, rtol=1e-5)
    data = (tmp_path / "half" / "mesh.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (material,) = tree["materials"]
    assert material["pbrMetallicRoughness"] == {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    assert tree["meshes"][0]["primitives"][0]["material"] == 0
    asset = tree["asset"]
    assert asset["copyright"] == "Zoë, CC-BY-4.0"
    assert asset["extras"].items() >= {"author": "Zoë", "title": "Cup", "units": "meters"}.items()
    assert {"author Zoe", "units meters"} <= set(
        PlyData.read(tmp_path / "half" / "mesh.ply")["vertex"].comments
    ) | set(PlyData.read(tmp_path / "half" / "mesh.ply").comments)
    present(copy, "--crop=-30,30,-30,30,-30,30")
    trained.export("mesh", tmp_path / "cropped", resolution=24, axes="scene")
    cropped = trimesh.load(tmp_path / "cropped" / "mesh.ply", force="mesh")
    inside = read_presentation(copy).crop.inside(torch.tensor(cropped.vertices) / 0.5, trained.camera_frame)
    assert bool(inside.all())


def test_pictures_are_balanced_and_numbers_are_not(copy: Path, tmp_path: Path) -> None:
    def rendered(folder: str, *options: str) -> Path:
        out = tmp_path / folder
        command = ["render", str(copy), "--views", "v000", "--layers", "final", "--out", str(out)]
        assert run([*command, *options, *ONE]) == 0
        return out

    before = rendered("before"), rendered("before_npy", "--format", "npy")
    present(copy, "--exposure", "2")
    bright = cv2.imread(str(rendered("bright") / "v000_final.png"))
    present(copy, "--tone-curve", "soft")
    soft = rendered("soft"), rendered("soft_npy", "--format", "npy")
    curved = cv2.imread(str(soft[0] / "v000_final.png"))
    assert (bright == 255).any()
    assert not (curved[(bright == 255).any(axis=2)] == 255).any()
    dark = (bright < 180).all(axis=2)
    assert np.array_equal(curved[dark], bright[dark])
    present(copy, "--exposure", "none", "--tone-curve", "none")
    present(copy, "--white-balance", "0.25,1,1")
    after = rendered("after"), rendered("after_npy", "--format", "npy")
    pictures = [cv2.imread(str(folder / "v000_final.png")) for folder in (before[0], after[0])]
    assert np.array_equal(pictures[0][..., :2], pictures[1][..., :2])  # blue, green
    assert pictures[1][..., 2].mean() < 0.7 * pictures[0][..., 2].mean()
    numbers = [np.load(folder / "v000_final.npy") for folder in (before[1], after[1])]
    assert np.array_equal(*numbers)
    assert np.array_equal(np.load(soft[1] / "v000_final.npy"), numbers[0])


def test_an_orbit_goes_round_the_chosen_axis(copy: Path) -> None:
    present(copy, "--up-axis", "1,2,3")
    trained = polarguide.open_run(copy, device="cpu")
    axis = torch.tensor([1.0, 2, 3], dtype=torch.float64) / 14**0.5
    heights = [
        float((camera.center - trained.camera_frame.center) @ axis)
        for camera in path_cameras(trained, "orbit", 6)[0]
    ]
    np.testing.assert_allclose(heights, heights[0], atol=1e-6)


def test_the_tone_curve_is_set_printed_and_removed(
    copy: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    assert present(copy, "--tone-curve", "soft") == Presentation(tone_curve="soft")
    assert "tone curve: soft" in capsys.readouterr().out
    assert "--tone-curve: expected none or soft, found hard" in refused(
        "present", copy, "--tone-curve", "hard"
    )
    assert read_presentation(copy) == Presentation(tone_curve="soft")
    assert present(copy, "--tone-curve", "none") == Presentation()


def test_exports_have_no_tone_curve_and_say_so(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def exported(name: str) -> tuple[bytes, str]:
        out = tmp_path / name
        assert run(["export", str(copy), "--format", "ply", "--out", str(out), *ONE]) == 0
        printed = capsys.readouterr()
        return (out / "splats.ply").read_bytes(), printed.out + printed.err

    plain, silent = exported("plain")
    present(copy, "--tone-curve", "soft")
    curved, said = exported("curved")
    assert curved == plain
    assert "tone curve" not in silent
    assert said.count("the tone curve is not part of the exported files") == 1
