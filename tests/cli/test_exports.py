"""share, export and render --path on a short training: what each writes, what it refuses, what others read of it."""

import importlib.util
import json
import os
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import polarguide
from polarguide.cli.app import run
from polarguide.core import errors
from polarguide.core.errors import PolarguideWarning, install_package
from polarguide.gaussians.ply import read_ply
from polarguide.geometry.camera import seen_at
from polarguide.geometry.camera_path import camera_record
from polarguide.results.rendering.mesh import subject_of
from polarguide.results.rendering.pictures import path_cameras
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION

ONE = ("--threads", "1")


def exported(trained: Path, folder: Path, kind: str, *more: str) -> Path:
    assert run(["export", str(trained), "--format", kind, "--out", str(folder), *more, *ONE]) == 0
    return folder


@pytest.fixture
def whole(copy: Path) -> Path:
    """A run of which all is exported, not its subject alone."""
    polarguide.present(copy, crop="all")
    return copy


def test_share(trained: Path, tmp_path: Path) -> None:
    assert run(["share", str(trained), "--out", str(tmp_path / "a" / "page.html"), *ONE]) == 0
    text = (tmp_path / "a" / "page.html").read_text()
    assert "<h1>demo</h1>" in text
    assert str(trained) not in text, "a page tells nothing of the folders it was made from"
    assert not [p for p in (tmp_path / "a").iterdir() if p.name != "page.html"]


@pytest.mark.parametrize("kind", ["ply", "spz"])
def test_splats_are_read_back(kind: str, whole: Path, tmp_path: Path) -> None:
    gaussforge = None if kind == "ply" else pytest.importorskip("gaussforge")
    out = exported(whole, tmp_path / "out", kind, "--axes", "scene")
    ours = read_ply(whole / "point_cloud.ply")["means"].numpy()
    if gaussforge is None:
        found = read_ply(out / "splats.ply")["means"].numpy()
    else:
        reader = gaussforge.GaussForge()
        data = reader.read((out / f"splats.{kind}").read_bytes(), kind)["data"]
        found = np.frombuffer(data["positions"], np.float32).reshape(-1, 3)
        if kind == "spz":  # right, up, back
            found = found * np.array([1, -1, -1])
    assert sorted(p.name for p in out.iterdir()) == [f"splats.{kind}"]
    assert found.shape == ours.shape
    np.testing.assert_allclose(found, ours, atol=0.02, rtol=2e-3)


RELEASE_VERTEX = 62
"""Floats of a vertex that readers with a fixed layout take, whatever the header says: the release's viewer, Unity's."""


def by_fixed_layout(path: Path) -> np.ndarray:
    """The vertices of a PLY as such a reader has them, [N, 62]."""
    header, _, data = path.read_bytes().partition(b"end_header\n")
    count = int(header.split(b"element vertex ")[1].split()[0])
    assert len(data) == 4 * RELEASE_VERTEX * count
    return np.frombuffer(data, "<f4").reshape(count, RELEASE_VERTEX)


def test_a_reader_with_a_fixed_layout_sees_what_is_there(whole: Path, tmp_path: Path) -> None:
    """In the export and in the run's own file. Our fields have a file of their own."""
    out = exported(whole, tmp_path / "out", "ply", "--axes", "scene", "--fields", "all")
    assert sorted(p.name for p in out.iterdir()) == ["polarguide.ply", "splats.ply"]
    gaussians = polarguide.open_run(whole).gaussians
    for path in (out / "splats.ply", whole / "point_cloud.ply"):
        seen = by_fixed_layout(path)
        np.testing.assert_allclose(seen[:, :3], gaussians["means"], rtol=1e-6)
        np.testing.assert_allclose(seen[:, 54:55], gaussians["opacity_logits"].reshape(-1, 1), rtol=1e-5)
        np.testing.assert_allclose(seen[:, 55:58], gaussians["log_scales"], rtol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(seen[:, 58:62], axis=1), 1, atol=1e-5)
    assert {"linear_dc", "linear_rest", "strength"} <= read_ply(out / "polarguide.ply")["extra"].keys()


def test_only_ply_has_fields(trained: Path, refused, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    assert "fields" in refused(
        "export", trained, "--format", "spz", "--fields", "all", "--out", tmp_path / "x"
    )


@pytest.mark.parametrize("kind", ["ply", "spz"])
def test_splats_are_upright_and_of_the_subject(
    kind: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exported is the part that most cameras see; the command prints its size, and up is where GLB has it."""
    forge = pytest.importorskip("gaussforge").GaussForge()
    exported(trained, tmp_path, kind)
    data = forge.read((tmp_path / f"splats.{kind}").read_bytes(), kind)["data"]
    found = np.frombuffer(data["positions"], np.float32).reshape(-1, 3)
    opened = polarguide.open_run(trained)
    means = opened.gaussians["means"].double()
    votes = torch.stack([seen_at(means - c.center, c)[2] for c in opened.cameras.values()])
    inside = votes.double().mean(dim=0) > 0.5
    assert 0 < int(inside.sum()) < len(inside)
    assert f"{int(inside.sum()):,} of {len(inside):,} Gaussians" in capsys.readouterr().out
    heights = means[inside] @ opened.frame.up
    up = found[:, 1] if kind == "spz" else -found[:, 1]
    np.testing.assert_allclose(np.sort(up), np.sort(heights), atol=0.02, rtol=2e-3)


def test_environment(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("OpenEXR")
    monkeypatch.setattr("polarguide.results.export.formats.PANORAMA_HEIGHT", 128)
    exported(trained, tmp_path, "environment")
    assert {p.name for p in tmp_path.iterdir()} == {"environment.exr", "environment.hdr", "environment.png"}
    flags = ["--views", "v000", "--layers", "final,specular", "--out", str(tmp_path / "a")]
    assert (
        run(["render", str(trained), "--environment", str(tmp_path / "environment.exr"), *flags, *ONE]) == 0
    )
    assert run(["render", str(trained), *flags[:-1], str(tmp_path / "b"), *ONE]) == 0
    pictures = [cv2.imread(str(tmp_path / x / "v000_specular.png")).astype(float) for x in "ab"]
    assert np.abs(pictures[0] - pictures[1]).mean() < 2, "its own environment gives nearly the same picture"


def test_cameras_are_read_by_pycolmap_and_as_opengl_poses(trained: Path, tmp_path: Path) -> None:
    exported(trained, tmp_path, "cameras", "--axes", "scene")
    cameras = polarguide.open_run(trained).cameras
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert {image.name.removesuffix(".png") for image in model.images.values()} == set(cameras)
    for image in model.images.values():
        camera, pose = cameras[image.name.removesuffix(".png")], image.cam_from_world()
        np.testing.assert_allclose(pose.rotation.matrix(), camera.rotation.numpy(), atol=1e-9)
        np.testing.assert_allclose(pose.translation, camera.translation.numpy(), atol=1e-9)
        inner = model.cameras[image.camera_id]
        assert (inner.width, inner.height) == (camera.width, camera.height)
        np.testing.assert_allclose(inner.params, [camera.fx, camera.fy, camera.cx, camera.cy])
    assert len(model.points3D) == len(polarguide.open_run(trained).scene.points)
    data = json.loads((tmp_path / "transforms.json").read_text())
    for frame in data["frames"]:
        picture = cv2.imread(str(tmp_path / frame["file_path"]))
        assert picture.shape == (frame["h"], frame["w"], 3)
        camera = cameras[Path(frame["file_path"]).stem]
        pose = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(pose[:3, 3], camera.center.numpy())
        np.testing.assert_allclose(-pose[:3, 2], camera.rotation[2].numpy())  # looks along -z
        np.testing.assert_allclose(pose[:3, 1], -camera.rotation[1].numpy())  # y is up


def frames_of(video: Path) -> list[np.ndarray]:
    film, pictures = cv2.VideoCapture(str(video)), []
    while (read := film.read())[0]:
        pictures.append(read[1])
    return pictures


def test_a_video_of_an_orbit_and_pictures_of_a_file(trained: Path, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    video = tmp_path / "orbit.mp4"
    flags = ["--layers", "final,normal,depth", *ONE]
    assert (
        run(["render", str(trained), "--path", "orbit", "--frames", "5", "--video", str(video), *flags]) == 0
    )
    pictures = frames_of(video)
    camera = next(iter(polarguide.open_run(trained).cameras.values()))
    assert {picture.shape for picture in pictures} == {(camera.height // 2 * 2, 3 * camera.width // 2 * 2, 3)}
    assert len(pictures) == 5
    assert [p.name for p in tmp_path.iterdir()] == ["orbit.mp4"]
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"cameras": [camera_record(camera)] * 2}))
    assert run(["render", str(trained), "--path", str(path), "--out", str(tmp_path / "out"), *flags]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["path_00000.png", "path_00001.png"]


def test_a_film_has_the_size_that_was_asked_for_and_names_its_layers(trained: Path, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    path = ("--path", "turntable", "--frames", "2", "--size", "401x240")
    film, alone = tmp_path / "film.mp4", tmp_path / "alone.mp4"
    assert run(["render", str(trained), *path, "--layers", "alpha,final", "--video", str(film), *ONE]) == 0
    assert run(["render", str(trained), *path, "--layers", "alpha", "--video", str(alone), *ONE]) == 0
    pictures = frames_of(film)
    assert [picture.shape for picture in pictures] == [(240, 400, 3)] * 2, "H.264 takes even sides"
    corner = pictures[0][:20, 200:260].astype(int)
    assert corner.max() > 200, "a name in white"
    assert frames_of(alone)[0][:20, :60].max() < 250, "one layer needs no name"


def test_a_turntable_holds_the_subject_from_all_sides(trained: Path) -> None:
    opened = polarguide.open_run(trained)
    means = opened.gaussians["means"]
    inner = means[subject_of(opened).holds(means)].double()
    cameras, _ = path_cameras(opened, "turntable", 5, (160, 90))
    for camera in cameras:
        assert (camera.width, camera.height) == (160, 90)
        assert float(seen_at(inner - camera.center, camera)[2].double().mean()) > 0.85
    heights = [float((camera.center - opened.frame.center) @ opened.frame.up) for camera in cameras]
    np.testing.assert_allclose(heights, heights[0], atol=1e-6)


@pytest.mark.parametrize(
    "words",
    [["--size", "wide", "--path", "orbit"], ["--size", "64x48"], ["--size", "64x48", "--path", "FILE"]],
)
def test_sizes_that_do_not_fit_are_refused(words: list[str], trained: Path, refused, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    camera = next(iter(polarguide.open_run(trained).cameras.values()))
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"cameras": [camera_record(camera)]}))
    words = [str(file) if word == "FILE" else word for word in words]
    assert "size" in refused("render", trained, *words, "--video", tmp_path / "x.mp4", *ONE)


def test_a_scene_that_was_moved(copy: Path, demo_scene: Path, refused, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """The error says that the run names the place; the command that it names points the run to the new one."""
    edit(copy, scene=str(tmp_path / "was here"))
    remedy = f"polarguide present {copy} --scene NEWPLACE"
    for verb in ("eval", "view", "render", "share"):
        line = refused(verb, copy, *ONE)
        assert str(tmp_path / "was here") in line
        assert f"expected the scene of {copy}" in line
        assert "found nothing" in line
        assert remedy in line
    with pytest.warns(PolarguideWarning, match="--scene NEWPLACE"):
        polarguide.open_run(copy).export("ply", tmp_path / "out")
    moved = shutil.copytree(demo_scene, tmp_path / "new place")
    assert run(["present", str(copy), "--scene", str(moved)]) == 0
    assert run(["share", str(copy), *ONE]) == 0
    assert json.loads((copy / CONFIGURATION).read_text())["scene"] == str(moved)


def test_another_scene_is_not_taken_for_a_moved_one(
    copy: Path, demo_scene: Path, refused, tmp_path: Path
) -> None:  # type: ignore[no-untyped-def]
    other = Path(shutil.copytree(demo_scene, tmp_path / "other"))
    first, second = sorted((other / "polar").iterdir())[:2]
    shutil.copy(second, first)
    before = (copy / CONFIGURATION).read_text()
    assert "found another scene" in refused("present", copy, "--scene", other)
    assert (copy / CONFIGURATION).read_text() == before


@pytest.mark.parametrize(
    ("kind", "module"), [("spz", "gaussforge"), ("mesh", "skimage.measure"), ("environment", "OpenEXR")]
)
def test_a_missing_library_is_named(
    kind: str, module: str, refused, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> object:
        if name == module:
            raise ImportError(name)
        return importlib.import_module(name)

    monkeypatch.setattr(errors, "importlib", SimpleNamespace(import_module=missing, util=importlib.util))
    line = refused("export", trained, "--format", kind, "--out", tmp_path)
    assert module.partition(".")[0] in line
    assert f"Install it with {install_package(module)} and" in line


def edit(run_folder: Path, **changes: object) -> None:
    data = json.loads((run_folder / CONFIGURATION).read_text())
    (run_folder / CONFIGURATION).write_text(json.dumps(data | changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"recipe": "../../etc/passwd"},
        {"recipe": "tomorrow"},
        {"scene": "/etc"},
        {"scene": "\0"},
        {"scene": "[/red] [link=x]"},
        {"future": 1},
        {"settings": {"steps": "<script>", "seed": 0, "refractive_index": 1.5}},
        {"settings": {"steps": 1, "seed": 0, "refractive_index": 1e308}},
        {"downscale": 0},
        {"transfer": "x"},
    ],
)
def test_foreign_configurations_are_refused_or_harmless(
    changes: dict[str, object], copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(copy, **changes)
    before = sorted(tmp_path.rglob("*"))
    status = run(["share", str(copy), "--out", str(tmp_path / "page.html"), *ONE])
    said = capsys.readouterr().err.splitlines()
    if status:
        assert status == 2
        assert len(said) == 1
        assert sorted(tmp_path.rglob("*")) == before
    else:
        assert "<script>" not in (tmp_path / "page.html").read_text().split("</main>")[0]


@pytest.mark.parametrize("damage", ["short", "shape", "nan", "type", "missing", "texels"])
def test_damaged_checkpoints_are_refused(damage: str, refused, copy: Path, tmp_path: Path) -> None:
    path = copy / CHECKPOINT
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    if damage == "shape":
        tensors["gaussians.sh_rest"] = tensors["gaussians.sh_rest"][:, :8].contiguous()
    elif damage == "nan":
        tensors["gaussians.means"][0, 0] = float("nan")
    elif damage == "type":
        tensors["gaussians.sh_dc"] = tensors["gaussians.sh_dc"].double()
    elif damage == "missing":
        del tensors["gaussians.log_scales"]
    elif damage == "texels":
        tensors["environment.texels"] = tensors["environment.texels"][:5].contiguous()
    save_file(tensors, path, metadata=metadata)
    if damage == "short":
        path.write_bytes(path.read_bytes()[:-1000])
    for command in (["share"], ["export", "--format", "ply"], ["render"]):
        assert str(path) in refused(command[0], copy, *command[1:])


@pytest.mark.parametrize("text", ["", "{", "[]", '{"psnr": "<script>"}', "\xff"])
def test_damaged_scores_are_refused(text: str, refused, copy: Path) -> None:
    (copy / "metrics.json").write_text(text, encoding="latin-1")
    assert "metrics.json" in refused("share", copy)


def test_another_model_is_not_written_over(trained: Path, refused, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    flags = ["export", trained, "--format", "cameras", "--out", tmp_path, *ONE]
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("mine")
    assert "found other files" in refused(*flags)
    assert (model / "cameras.txt").read_text() == "mine"
    (tmp_path / "images").mkdir()
    (model / "cameras.txt").rename(tmp_path / "images" / "v000.png")
    assert "found other files" in refused(*flags)
    (tmp_path / "images" / "v000.png").unlink()
    for _ in range(2):  # its own is written anew
        assert run([str(flag) for flag in flags]) == 0


PLACES = (
    str(Path(__file__).resolve().parents[2] / "build/node/node_modules/.bin"),
    os.environ.get("PATH", ""),
)
PROGRAM = shutil.which(os.environ.get("SPLAT_TRANSFORM", "splat-transform"), path=os.pathsep.join(PLACES))
# Largest error of the median Gaussian. Harmonics have 4 bits in SPZ (steps of 1/8).
EXACT = 1e-5
TOLERANCES = {
    "ply": dict.fromkeys(("means", "opacity", "log_scales", "turn", "sh_dc", "sh_rest"), EXACT),
    "spz": {"means": 3e-4, "opacity": 3e-3, "log_scales": 0.04, "turn": 0.02, "sh_dc": 0.02, "sh_rest": 0.07},
}


def described(path: Path) -> dict[str, np.ndarray]:
    """What both programs agree to call a Gaussian: [N, ...] by name, quaternions of unit length with w positive."""
    rows = {name: values.double().numpy() for name, values in read_ply(path).items() if name != "extra"}
    turn = rows["quaternions"] / np.linalg.norm(rows["quaternions"], axis=1, keepdims=True)
    return {
        "means": rows["means"],
        "opacity": (1 / (1 + np.exp(-rows["opacity_logits"])))[:, None],
        "log_scales": rows["log_scales"],
        "turn": turn * np.where(turn[:, :1] < 0, -1, 1),
        "sh_dc": rows["sh_dc"].reshape(len(turn), -1),
        "sh_rest": rows["sh_rest"].reshape(len(turn), -1),
    }


def axis_differences(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the sine of half the largest angle between the axes of rotations [N, 4]; an axis has no sign."""
    turns = (Rotation.from_quat(each[:, [1, 2, 3, 0]]).as_matrix() for each in (first, second))
    cosines = np.abs(np.einsum("nij,nij->nj", *turns)).min(axis=1)
    return np.sqrt(np.clip(1 - cosines, 0, None) / 2)


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="no splat-transform -> apt-get install nodejs npm; make test")
@pytest.mark.parametrize("kind", TOLERANCES)
def test_another_program_reads_our_splats(kind: str, whole: Path, tmp_path: Path) -> None:
    if kind == "spz":
        pytest.importorskip("gaussforge")
    exported(whole, tmp_path, kind, "--axes", "scene")
    back = tmp_path / "back.ply"
    subprocess.run([PROGRAM, "-q", str(tmp_path / f"splats.{kind}"), str(back)], check=True, timeout=300)
    ours, theirs = described(whole / "point_cloud.ply"), described(back)
    assert len(ours["means"]) == len(theirs["means"])
    distance, nearest = cKDTree(theirs["means"]).query(ours["means"])
    extent = np.ptp(ours["means"], axis=0).max()
    assert np.quantile(distance, 0.99) < 1e-3 * extent
    for name, tolerance in TOLERANCES[kind].items():
        if name == "turn":
            error = axis_differences(theirs[name][nearest], ours[name])
        else:
            error = np.abs(theirs[name][nearest] - ours[name]).max(axis=1)
        assert np.median(error) < tolerance, name
