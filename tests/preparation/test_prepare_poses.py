"""Poses and points of prepared scenes."""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from camera_files import (
    COLOR,
    behind,
    mosaic,
    read_invalid,
    read_mask,
    read_polar,
    smooth_light,
    write_model,
    write_mosaic,
    write_mosaics,
    write_picture,
    write_shots,
)
from faults import Fault
from heard import Heard
from relief import DEPTHS, write_relief

from polarguide.capture import load_scene
from polarguide.capture.colmap import sfm as points_module
from polarguide.capture.colmap.model import PosedCamera, posed_model
from polarguide.capture.colmap.sfm import colors_of_points, match_features, sample_visual_hull, tone_mapped
from polarguide.capture.write import write_png_file
from polarguide.core.progress import SILENT
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

MOSAIC = PrepareSettings(sensor="IMX250MYR", gains="none")
FILTER = PrepareSettings(gains="none", align=False, transfer="linear")
NAMES = ("v000", "v001", "v002")


@pytest.mark.parametrize(
    ("demosaic", "camera", "inner"),
    [
        ("half", "PINHOLE 64 48 80 82 33 25", (40, 41, 16.5, 12.5)),
        ("half", "PINHOLE 32 24 40 41 16.5 12.5", (40, 41, 16.5, 12.5)),
        ("half", "SIMPLE_PINHOLE 128 96 160 66 50", (40, 40, 16.5, 12.5)),
        ("quarter", "PINHOLE 64 48 80 82 33 25", (20, 20.5, 8.25, 6.25)),
        ("full", "SIMPLE_RADIAL 64 48 80 33 25 0", (80, 80, 33, 25)),
        # of pictures of 1.55 times the size, and of 0.64, both rounded to whole pixels
        ("full", "PINHOLE 99 74 99 74 49.5 37", (64, 48, 32, 24)),
        ("full", "PINHOLE 41 30 41 30 20.5 15", (64, 48, 32, 24)),
    ],
)
def test_intrinsics_follow_the_size(
    tmp_path: Path, demosaic: str, camera: str, inner: tuple[float, ...]
) -> None:
    write_mosaics(tmp_path / "in")
    model = write_model(tmp_path / "sparse" / "0", NAMES, camera)
    for number, place in enumerate((tmp_path, tmp_path / "sparse", model)):
        out = tmp_path / f"out{number}"
        prepare_scene(tmp_path / "in", out, replace(MOSAIC, demosaic=demosaic, poses=str(place)))
        scene = load_scene(out)
        assert [view.name for view in scene.views] == list(NAMES)
        found = scene.views[1].camera
        assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx(inner)
        assert scene.points.shape == (4, 3)
        np.testing.assert_allclose(found.translation, [0.1, -0.25, 2.5])


def test_a_cut_cell_moves_the_principal_point(tmp_path: Path) -> None:
    light = smooth_light(49, 65)
    for name in NAMES:
        write_mosaic(tmp_path / "in" / f"{name}.png", mosaic(behind(light), COLOR, (1, 3)))
    model = write_model(tmp_path / "model", NAMES, "PINHOLE 65 49 80 82 33 25")
    prepare_scene(
        tmp_path / "in", tmp_path / "out", replace(MOSAIC, offset_x=1, offset_y=3, poses=str(model))
    )
    camera = load_scene(tmp_path / "out").views[0].camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (32, 24, 16.0, 12.0)


def test_views_without_a_pose_are_left_out_and_named(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in", 4)
    model = write_model(tmp_path / "model", ("sub/v000", "v001", "v003"), "PINHOLE 64 48 80 82 32 24")
    heard = Heard()
    done = prepare_scene(tmp_path / "in", tmp_path / "out", replace(MOSAIC, poses=str(model)), heard)
    assert done.left_out == ["v002"]
    assert any("1 of 4 views have no pose" in text for text in heard.said)
    assert not any("Other models" in text for text in heard.said)
    assert len(load_scene(tmp_path / "out").views) == 3


def test_views_that_are_in_the_model_beside_are_told(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in", 4)
    for number, names in enumerate((NAMES, (*NAMES, "v003"))):
        write_model(tmp_path / "sparse" / str(number), names, "PINHOLE 64 48 80 82 32 24")
    heard = Heard()
    settings = replace(MOSAIC, poses=str(tmp_path))
    assert prepare_scene(tmp_path / "in", tmp_path / "out", settings, heard).left_out == ["v003"]
    assert any(f"Other models: {tmp_path / 'sparse' / '1'}." in text for text in heard.said)


@pytest.mark.parametrize(
    ("camera", "found"), [("PINHOLE 67 50 80 82 33 25", "67x50"), ("PINHOLE 99 80 99 74 49 37", "99x80")]
)
def test_sizes_of_a_crop_are_refused(tmp_path: Path, camera: str, found: str) -> None:
    write_mosaics(tmp_path / "in")
    model = write_model(tmp_path / "model", NAMES, camera)
    settings = replace(MOSAIC, demosaic="full", poses=str(model))
    Fault(found=found).raised_by(prepare_scene, tmp_path / "in", tmp_path / "out", settings)


def test_one_map_undistorts_all_four_intensities(tmp_path: Path) -> None:
    """Light that is a function of the ray: where a ray lands is known with and without distortion."""
    distorted = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=128, height=96, params=[110.0, 64.0, 48.0, 0.12], camera_id=1
    )

    def light_of(camera: pycolmap.Camera) -> np.ndarray:
        rows, columns = np.mgrid[: camera.height, : camera.width]
        rays = camera.cam_from_img(np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1))
        x, y = rays.T.reshape(2, camera.height, camera.width)
        s0 = (0.8 + 0.3 * np.sin(9 * x) * np.cos(7 * y))[..., None] * np.ones(3)
        return np.stack([s0, s0 * 0.4 * np.cos(5 * x)[..., None], s0 * 0.4 * np.sin(5 * y)[..., None]])

    light = behind(light_of(distorted))
    light[0, 40, 50] = 1.0
    for name in NAMES:
        write_shots(tmp_path / "in", name, light)
    model = write_model(tmp_path / "model", NAMES, "SIMPLE_RADIAL 128 96 110 64 48 0.12")
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(FILTER, poses=str(model)))
    camera = load_scene(tmp_path / "out").views[0].camera
    straight = pycolmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height,
        params=[camera.fx, camera.fy, camera.cx, camera.cy],
    )  # fmt: skip
    invalid = read_invalid(tmp_path / "out", "v000")
    error = np.abs(read_polar(tmp_path / "out", "v000") - behind(light_of(straight)))[:, ~invalid]
    assert error.max() < 2e-3
    assert 1 <= invalid.sum() <= 4
    place = distorted.cam_from_img(np.array([[50.5, 40.5]]))
    x, y = straight.img_from_cam(np.column_stack([place, [1.0]]))[0]
    assert np.abs(np.argwhere(invalid) + 0.5 - [y, x]).max() <= 1.5


def test_sfm_on_a_textured_scene(tmp_path: Path) -> None:
    """A textured, polarized relief seen by a camera on an arc: all views register, and training can read them."""
    write_relief(tmp_path / "in")
    heard = Heard()
    done = prepare_scene(tmp_path / "in", tmp_path / "out", FILTER, heard)
    assert len(done.views) >= 5
    assert any("views registered" in text for text in heard.said)
    assert not (tmp_path / "out" / ".sfm").exists()
    scene = load_scene(tmp_path / "out")
    assert len(scene.points) > 100
    assert scene.views[0].camera.fx == pytest.approx(260, rel=0.25)


def test_sfm_with_known_intrinsics_looks_at_masks_alone(tmp_path: Path) -> None:
    """Features are found inside the masks only, the camera stays as it was given, and the masks are kept."""
    cameras = write_relief(tmp_path / "in")
    mask = np.zeros((240, 320), np.uint8)
    mask[:, :200] = 255
    for view in list(cameras)[1:]:
        write_picture(tmp_path / "masks" / f"{view}.png", mask / 255.0, bits=8)
    asked = replace(
        FILTER, masks=str(tmp_path / "masks"), intrinsics="260,260,160.5,120.5", sfm_pictures="minimum"
    )
    heard = Heard()
    done = prepare_scene(tmp_path / "in", tmp_path / "out", asked, heard)
    assert len(done.views) >= 5
    assert any(text.startswith("1 of 6 views have no mask") for text in heard.said)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    for camera in model.cameras.values():
        assert (camera.model_name, camera.params.tolist()) == ("PINHOLE", [260, 260, 160.5, 120.5])
    seen = {view: [] for view in done.views}
    for image in model.images.values():
        seen[Path(image.name).stem] += [p.xy[0] for p in image.points2D]
    assert len(seen["v2"]) > 50
    assert max(max(columns) for view, columns in seen.items() if view != "v0") < 202
    assert not (tmp_path / "out" / "masks" / "v0.png").exists()
    assert (read_mask(tmp_path / "out", "v2") == (mask > 0)).all()


def test_pictures_for_sfm_with_less_glare() -> None:
    intensities = np.full((4, 6, 8, 3), 0.5, np.float32)
    intensities[2, :, :4] = 0.1
    darkest = tone_mapped(intensities, "minimum")
    assert (darkest[:, 4:] == 255).all()
    assert (darkest[:, :4] == round(255 * (1.055 * 0.2 ** (1 / 2.4) - 0.055))).all()
    assert (tone_mapped(intensities)[:, :4] > darkest[:, :4]).all()


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"intrinsics": "260,260,160"}, Fault("--intrinsics", expected="fx,fy,cx,cy or")),
        ({"intrinsics": "260,0,160,120"}, Fault("--intrinsics", expected="fx,fy,cx,cy or")),
        ({"intrinsics": "9,9,9,9", "poses": "none"}, Fault(expected="--poses sfm")),
        ({"masks": "nowhere"}, Fault("--masks", expected="a folder of masks")),
    ],
)
def test_wrong_use_is_told(tmp_path: Path, changes: dict[str, Any], fault: Fault) -> None:
    write_shots(tmp_path / "in", "v0", behind(smooth_light()))
    fault.raised_by(prepare_scene, tmp_path / "in", tmp_path / "out", replace(FILTER, **changes))
    assert not (tmp_path / "out").exists()


def test_masks_are_called_as_colmap_and_metashape_call_them(tmp_path: Path) -> None:
    disc = np.hypot(*(np.mgrid[:48, :64] - np.array([20, 30])[:, None, None])) < 12
    names = {"v0": "v0", "v1": "v1.png", "v2": "v2_mask", "v3.JPG": "v3.JPG"}
    for view, name in names.items():
        write_shots(tmp_path / "in", view, behind(smooth_light()))
        shifted = np.roll(disc, 3 * len(name), axis=1)
        write_picture(tmp_path / "masks" / f"{name}.png", shifted.astype(float), bits=8)
    write_shots(tmp_path / "in", "v4", behind(smooth_light()))
    write_picture(tmp_path / "masks" / "v4.png", np.zeros((48, 64)), bits=8)
    settings = replace(FILTER, masks=str(tmp_path / "masks"), poses="none")
    heard = Heard()
    prepare_scene(tmp_path / "in", tmp_path / "out", settings, heard)
    assert [text for text in heard.said if "mask" in text] == ["v4: its mask shows no object."]
    for view, name in names.items():
        assert (read_mask(tmp_path / "out", view) == np.roll(disc, 3 * len(name), axis=1)).all()


def test_masks_have_to_fit(tmp_path: Path) -> None:
    write_shots(tmp_path / "in", "v0", behind(smooth_light()))
    settings = replace(FILTER, masks=str(tmp_path / "masks"), poses="none")
    write_picture(tmp_path / "masks" / "other.png", np.ones((4, 4)), bits=8)
    Fault(expected="masks named like the views").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", settings
    )
    write_picture(tmp_path / "masks" / "v0.png", np.ones((4, 4)), bits=8)
    Fault("v0.png", expected="the size of the picture").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", settings
    )


@pytest.mark.parametrize(("files", "model"), [("NFD", "NFC"), ("NFC", "NFD")])
@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_names_are_compared_in_one_form_of_unicode(tmp_path: Path, files: str, model: str, kind: str) -> None:
    views = [f"B\N{LATIN SMALL LETTER U WITH DIAERESIS}hne {k}" for k in range(3)]
    stored = [unicodedata.normalize(files, view) for view in views]
    for name in stored:
        write_mosaic(tmp_path / "in" / f"{name}.png", mosaic(behind(smooth_light()), COLOR))
        write_picture(
            tmp_path / "masks" / f"{unicodedata.normalize(model, name)}.png", np.ones((24, 32)), bits=8
        )
    named = [unicodedata.normalize(model, view) for view in views]
    poses = write_model(tmp_path / "model", named, "PINHOLE 64 48 80 82 33 25")
    if kind == "transforms":
        poses = write_transforms_of(tmp_path / "t.json", named)
    settings = replace(MOSAIC, poses=str(poses), masks=tmp_path / "masks")
    assert prepare_scene(tmp_path / "in", tmp_path / "out", settings).views == views
    split = {"test": [unicodedata.normalize("NFD", views[1])]}
    (tmp_path / "out" / "split.json").write_text(json.dumps(split))
    scene = load_scene(tmp_path / "out")
    assert [view.name for view in scene.test_views] == [views[1]]
    assert scene.view(unicodedata.normalize("NFD", views[2])).mask is not None


def write_transforms_of(path: Path, views: Sequence[str]) -> Path:
    """A transforms.json of cameras on a circle, which look at its middle."""
    frames = []
    for view in views:
        turn = int(view[-1]) / 10
        pose = np.eye(4)
        pose[:3, 0] = np.cos(turn), 0, -np.sin(turn)
        pose[:3, 2] = np.sin(turn), 0, np.cos(turn)
        pose[:3, 3] = 2.5 * pose[:3, 2]
        frames.append({"file_path": f"{view}.png", "transform_matrix": pose.tolist()})
    path.write_text(json.dumps({"fl_x": 80, "cx": 33, "cy": 25, "w": 64, "h": 48, "frames": frames}))
    return path


def test_parts_of_poses_make_one_scene(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in", 4)
    write_transforms_of(tmp_path / "transforms_train.json", NAMES[:2])
    write_transforms_of(tmp_path / "transforms_val.json", NAMES[2:])
    write_transforms_of(tmp_path / "transforms_test.json", ["v003"])
    heard = Heard()
    settings = replace(MOSAIC, poses=str(tmp_path))
    prepare_scene(tmp_path / "in", tmp_path / "out", settings, heard)
    assert any("1 views of transforms_test.json are held out" in text for text in heard.said)
    scene = load_scene(tmp_path / "out")
    assert [view.name for view in scene.train_views] == list(NAMES)
    assert [view.name for view in scene.test_views] == ["v003"]
    heard = Heard()
    one = replace(MOSAIC, poses=str(tmp_path / "transforms_train.json"))
    prepare_scene(tmp_path / "in", tmp_path / "one", one, heard)
    assert any(f"--poses {tmp_path} reads all" in text for text in heard.said)


def test_a_view_in_two_parts_of_poses_is_refused(tmp_path: Path) -> None:
    write_mosaics(tmp_path / "in")
    write_transforms_of(tmp_path / "transforms_train.json", NAMES)
    write_transforms_of(tmp_path / "transforms_test.json", NAMES[1:2])
    Fault("transforms_test.json", found="v001 again").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", replace(MOSAIC, poses=str(tmp_path))
    )


def summary(scene: Path) -> dict:
    return json.loads((scene / "scene.json").read_text())


def ring(count: int = 8, *, radius: float = 3.0) -> dict[str, PosedCamera]:
    """Cameras all around that look at the origin."""
    cameras = {}
    for index in range(count):
        angle = 2 * np.pi * index / count
        forward = -np.array([np.sin(angle), 0, np.cos(angle)])
        right = np.cross([0, 1.0, 0], forward)
        rotation = np.stack([right, np.cross(forward, right), forward])
        translation = np.array([0, 0, radius])
        cameras[f"v{index}"] = PosedCamera(
            64, 48, "PINHOLE", (60.0, 60.0, 32.0, 24.0), rotation, translation
        )  # fmt: skip
    return cameras


@pytest.mark.parametrize("points_file", [True, False])
def test_points_are_triangulated_with_the_poses_as_they_are(tmp_path: Path, points_file: bool) -> None:
    cameras = write_relief(tmp_path / "in")
    model = tmp_path / "model"
    model.mkdir()
    posed_model(cameras).write_binary(str(model))
    if not points_file:
        (model / "points3D.bin").unlink()
    heard = Heard()
    prepare_scene(tmp_path / "in", tmp_path / "out", replace(FILTER, poses=str(model)), heard)
    found = summary(tmp_path / "out")["points"]
    assert found["from"] == "triangulation with fixed poses"
    assert found["count"] > points_module.FEWEST
    assert found["reprojection_error_pixels"] < 1
    assert any(f"{found['count']} were triangulated" in text for text in heard.said)
    scene = load_scene(tmp_path / "out")
    for view in scene.views:
        given = cameras[view.name]
        np.testing.assert_allclose(view.camera.rotation, given.rotation, atol=1e-9)
        np.testing.assert_allclose(view.camera.translation, given.translation, atol=1e-9)
        assert (view.camera.fx, view.camera.cx) == pytest.approx((260, 160.5))
    off = np.abs((-scene.points.numpy()[:, 2])[:, None] - DEPTHS).min(axis=1)
    assert np.median(off) < 0.01
    assert not (tmp_path / "out" / ".sfm").exists()


def test_pictures_without_texture_get_samples(tmp_path: Path) -> None:
    cameras = ring(5)
    for view in cameras:
        write_shots(tmp_path / "in", view, behind(smooth_light()))
    (tmp_path / "model").mkdir()
    posed_model(cameras).write_binary(str(tmp_path / "model"))
    heard = Heard()
    settings = replace(FILTER, poses=str(tmp_path / "model"))
    prepare_scene(tmp_path / "in", tmp_path / "out", settings, heard)
    found = summary(tmp_path / "out")["points"]
    assert found["from"] == "random samples in the cameras' common field of view"
    assert any("sampled at random" in text for text in heard.said)
    places = load_scene(tmp_path / "out").points.numpy()
    assert len(places) == found["count"] > 10_000
    assert np.abs(places.mean(axis=0)).max() < 0.1


def test_a_stopped_preparation_keeps_its_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = ring(4)
    for view in cameras:
        write_shots(tmp_path / "in", view, behind(smooth_light()))
    (tmp_path / "model").mkdir()
    posed_model(cameras).write_binary(str(tmp_path / "model"))
    settings = replace(FILTER, poses=str(tmp_path / "model"))

    def stop(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("polarguide.preparation.prepare._write_views", stop)
    with pytest.raises(KeyboardInterrupt):
        prepare_scene(tmp_path / "in", tmp_path / "out", settings)
    monkeypatch.undo()
    monkeypatch.setattr(points_module, "_triangulated", stop)
    assert prepare_scene(tmp_path / "in", tmp_path / "out", settings).views == sorted(cameras)
    assert summary(tmp_path / "out")["points"]["count"] > 1000


def test_cameras_that_look_apart_are_refused(tmp_path: Path) -> None:
    cameras = ring(4)
    turn = np.diag([-1.0, 1.0, -1.0])
    apart = {
        view: replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)
        for view, camera in cameras.items()
    }
    for view in cameras:
        write_shots(tmp_path / "in", view, behind(smooth_light()))
    (tmp_path / "model").mkdir()
    posed_model(apart).write_binary(str(tmp_path / "model"))
    Fault(expected="poses of cameras with a common field of view").raised_by(
        prepare_scene, tmp_path / "in", tmp_path / "out", replace(FILTER, poses=str(tmp_path / "model"))
    )
    assert not (tmp_path / "out" / "scene.json").exists()


@pytest.mark.parametrize("distorted", [False, True])
def test_samples_fill_the_hull_of_a_ball(distorted: bool) -> None:
    """Silhouettes of a ball of radius 0.5, from all around."""
    cameras = ring(12)
    y, x = np.mgrid[:48, :64] + 0.5
    # The silhouette of a ball at distance 3: sin of the half angle is 1/6.
    disc = np.hypot(x - 32, y - 24) < 60 * np.tan(np.arcsin(0.5 / 3))
    if distorted:
        parameters = (60.0, 32.0, 24.0, 0.0)
        cameras = {
            view: replace(camera, model="SIMPLE_RADIAL", parameters=parameters)
            for view, camera in cameras.items()
        }
    places = sample_visual_hull(cameras, dict.fromkeys(cameras, disc), 5000, np.random.default_rng(0))
    assert len(places) == 5000
    assert np.hypot(places[:, 0], places[:, 2]).max() < 0.56
    assert np.abs(places[:, 1]).max() < 0.56
    assert (np.linalg.norm(places, axis=1) < 0.4).mean() > 0.3
    assert np.abs(places.mean(axis=0)).max() < 0.03


def test_parallel_cameras_are_not_a_traceback() -> None:
    rotation = np.eye(3)
    cameras = {
        f"v{index}": PosedCamera(
            64, 48, "PINHOLE", (60.0, 60.0, 32.0, 24.0), rotation, np.array([-0.1 * index, 0, 0])
        )
        for index in range(3)
    }
    places = sample_visual_hull(cameras, {}, 100, np.random.default_rng(0))
    assert len(places) == 0 or (places[:, 2] > 0).all()


def test_colors_of_sampled_points_follow_the_distortion_of_the_lens(tmp_path: Path) -> None:
    camera = PosedCamera(64, 48, "SIMPLE_RADIAL", (60.0, 32.0, 24.0, 0.5), np.eye(3), np.zeros(3))
    columns = np.broadcast_to(3 * np.arange(64, dtype=np.uint8)[None, :, None], (48, 64, 3))
    write_png_file(tmp_path / "images" / "a.png", columns)
    x = 0.45
    column = int(60.0 * x * (1 + 0.5 * x**2) + 32.0)
    assert column != int(60.0 * x + 32.0)
    found = colors_of_points(tmp_path, {"a": camera}, np.array([[x, 0.0, 1.0]]))
    np.testing.assert_array_equal(found, [[3 * column] * 3])


@pytest.mark.parametrize(
    ("sizes", "groups"),
    [
        ({"a": (64, 48), "b": (64, 48), "c": (64, 48)}, [{"a", "b", "c"}]),
        ({"a": (64, 48), "b": (48, 64), "c": (64, 48), "d": (48, 64)}, [{"a", "c"}, {"b", "d"}]),
        ({"a": (64, 48), "b": (48, 64)}, [{"a"}, {"b"}]),
    ],
)
def test_pictures_of_one_size_share_a_camera(
    tmp_path: Path, sizes: dict[str, tuple[int, int]], groups: list[set[str]]
) -> None:
    """A camera that was held upright and on its side has two cameras in the model, not one for each picture."""
    rng = np.random.default_rng(0)
    for view, (width, height) in sizes.items():
        write_png_file(
            tmp_path / "images" / f"{view}.png", rng.integers(0, 255, (height, width, 3), np.uint8)
        )
    database = tmp_path / "database.db"
    match_features(
        database, tmp_path / "images", sizes, matching="exhaustive", seed=0, reporter=SILENT
    )  # fmt: skip
    found: dict[int, set[str]] = {}
    with pycolmap.Database.open(database) as link:
        for image in link.read_all_images():
            found.setdefault(image.camera_id, set()).add(image.name.removesuffix(".png"))
    assert sorted(found.values(), key=sorted) == groups
