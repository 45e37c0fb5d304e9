"""What the viewer shows of Gaussians and of fields, against the renderer itself."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from faults import Fault
from random_runs import KINDS, random_state, ring
from small_fields import small
from textured_ball import textured_ball
from viewer_scenes import frame_of_scene, photograph, shown

from polarguide.capture.presentation import Crop
from polarguide.geometry.camera import quaternion
from polarguide.geometry.scene_frame import scene_frame
from polarguide.geometry.trajectory import read_path
from polarguide.raster.magnification import footprints
from polarguide.runs.folder import resolve
from polarguide.runs.train import train
from polarguide.shading.result import LAYERS, POLARIZED
from polarguide.training.settings import TrainSettings
from polarguide.viewer.cameras import FRAMES_PER_SECOND, Keyframes, free_camera, letterbox, window_fov
from polarguide.viewer.scenery import (
    BESIDE,
    MEASURED,
    Appearance,
    FieldScenery,
    Painter,
    run_scenery,
    training_scenery,
)
from polarguide.viewer.server import view_run
from polarguide.visualization import figures
from polarguide.visualization.layers import polarization_picture
from polarguide_bench.gnerp.trainer import FieldTrainer

CAMERAS = ring()
CAMERA = CAMERAS["v1"]
EVERYTHING = Crop((-9, -9, -9), (9, 9, 9))


PLAIN = Appearance()


def paint(seen, appearance=PLAIN, view=None, camera=CAMERA, **named):
    return Painter(frame_of_scene()).paint(seen, camera, appearance, view, **named)


@pytest.mark.parametrize("recipe", KINDS)
def test_every_layer_of_a_recipe_is_drawn_as_it_is_rendered(recipe):
    seen = shown(recipe)
    result = seen.render(CAMERA, depth=True, surface=True)
    for layer in LAYERS:
        picture = paint(seen, Appearance(layer=layer))
        if getattr(result, layer) is None:
            assert picture is None
        else:
            assert picture.shape == (CAMERA.height, CAMERA.width, 3)
            assert picture.std() > 3
    assert np.array_equal(paint(seen), figures.radiance_to_rgb(result.final))
    normals = figures.normal_to_rgb(result.normal, CAMERA)
    assert np.array_equal(paint(seen, Appearance(layer="normal")), normals)


def test_exposure_and_reflection():
    seen = shown()
    result = seen.render(CAMERA, depth=False)
    brighter = paint(seen, Appearance(exposure=-1.5))
    assert np.array_equal(brighter, figures.radiance_to_rgb(result.final / 2**1.5))
    without = paint(seen, Appearance(strength=0.0))
    assert np.array_equal(without, figures.radiance_to_rgb(result.diffuse))
    doubled = paint(seen, Appearance(strength=2.0))
    assert np.array_equal(doubled, figures.radiance_to_rgb(result.diffuse + 2 * result.specular))


def test_turning_the_environment_turns_what_a_mirror_shows():
    seen = shown("3dgs-dr")
    assert np.array_equal(paint(seen, Appearance(turn=360)), paint(seen))
    # Any turn samples the light anew, so compare with one that is too small to see.
    barely, far = (
        np.abs(paint(seen, Appearance(turn=degrees)).astype(int) - paint(seen)).mean()
        for degrees in (0.01, 90)
    )
    assert far > 5 * barely
    assert far > 1
    # Light that is the same all around stays; so does what does not reflect.
    even = replace(seen, light={"texels": torch.full((6, 8, 8, 3), 0.3)})
    assert np.abs(paint(even, Appearance(turn=90)).astype(int) - paint(even)).max() <= 1
    base = Appearance(layer="base")
    assert np.array_equal(paint(seen, replace(base, turn=90)), paint(seen, base))


def test_features_for_a_network_are_not_turned():
    seen = shown("ref-gs")
    assert np.array_equal(paint(seen, Appearance(turn=90)), paint(seen))


def test_a_crop_shows_what_is_inside():
    seen = shown()
    alpha = Appearance(layer="alpha")
    assert np.array_equal(paint(seen, replace(alpha, crop=EVERYTHING)), paint(seen, alpha))
    nothing = figures.scalar_to_rgb(torch.zeros(CAMERA.height, CAMERA.width), 0, 1)
    outside = Crop((8, 8, 8), (9, 9, 9))
    assert np.array_equal(paint(seen, replace(alpha, crop=outside)), nothing)
    # What lies above the middle is in the upper half of the picture.
    upper = paint(seen, replace(alpha, crop=Crop((-9, 0.15, -9), (9, 9, 9)))).astype(int) - nothing
    rows = np.abs(upper).sum(axis=(1, 2))
    assert rows[: CAMERA.height // 2].sum() > 3 * rows[CAMERA.height // 2 :].sum()


def test_a_crops_corners_are_inside_and_a_bit_more_is_not():
    placement, crop = frame_of_scene(), Crop((-0.5, -0.25, -1), (0.5, 0.75, 0.1))
    corners = crop.corners(placement)
    middle = corners.mean(dim=0)
    assert crop.inside(middle + 0.999 * (corners - middle), placement).all()
    assert not crop.inside(middle + 1.001 * (corners - middle), placement).any()


def test_at_a_photograph_the_pose_is_the_photographs():
    seen = shown()
    view = photograph("v2", CAMERAS["v2"], seen).view
    picture = paint(seen, view=view, camera=replace(CAMERA, width=200, height=90))
    expected = view.camera.extended(200, 90)
    assert np.array_equal(picture, paint(seen, camera=expected))


def test_what_was_measured_there():
    seen = shown()
    view = photograph("v1", CAMERA, seen).view
    assert all(paint(seen, Appearance(layer=layer)) is None for layer in MEASURED)
    found = {layer: paint(seen, Appearance(layer=layer), view) for layer in MEASURED}
    assert np.array_equal(found["photograph"], figures.radiance_to_rgb(view.photograph()))
    # S1 / S0 = (1.3 - 0.7) / 2 everywhere, along the rows.
    there = view.photograph().mean(dim=-1) > 0.02
    dolp = figures.dolp_to_rgb(torch.full(there.shape, 0.3), 0.5)
    assert np.abs(found["dolp, measured"].astype(int) - dolp)[there].max() <= 3
    aolp = figures.aolp_to_rgb(torch.zeros(there.shape))
    assert np.abs(found["aolp, measured"].astype(int) - aolp)[there].max() <= 3
    final = seen.render(CAMERA, depth=False).final
    assert np.array_equal(found["error"], figures.error_to_rgb(final, view.photograph()))
    right = paint(replace(seen, gaussians=seen.gaussians), Appearance(layer="error"), view)
    assert np.array_equal(right, found["error"])


def test_predicted_polarization_is_the_runs_and_has_a_key_to_its_colors():
    seen = shown()
    for layer in POLARIZED:
        picture = paint(seen, Appearance(layer=layer))
        result = seen.render(CAMERA, depth=False)
        predicted = seen.shading.predicted_stokes(result, CAMERA)
        assert np.array_equal(picture, polarization_picture(layer, predicted)), layer
        assert np.array_equal(picture, paint(seen, Appearance(layer=layer, strength=0.5))), layer
    wide = replace(CAMERA, width=640, height=480)
    for layer, keyed in (("dolp", True), ("aolp", True), ("depth", True), ("final", False)):
        corner = paint(seen, Appearance(layer=layer), camera=wide)[-8:-4, :160]
        assert bool((corner == 255).all(axis=-1).mean() > 0.5) == keyed, layer


def test_a_wipe_shows_what_was_measured_from_the_left():
    seen = shown()
    view = photograph("v1", CAMERA, seen).view
    for layer, measured in BESIDE.items():
        left, right = (
            paint(seen, Appearance(layer=measured), view),
            paint(seen, Appearance(layer=layer), view),
        )
        wiped = paint(seen, Appearance(layer=layer, wipe=0.5), view)
        middle = CAMERA.width // 2
        assert np.array_equal(wiped[:, : middle - 1], left[:, : middle - 1]), layer
        assert np.array_equal(wiped[:, middle + 1 :], right[:, middle + 1 :]), layer
        assert (wiped[:, middle] == 255).all()
    free, depth = Appearance(wipe=0.5), Appearance(layer="depth", wipe=0.5)
    assert np.array_equal(paint(seen, free), paint(seen))
    assert np.array_equal(paint(seen, depth, view), paint(seen, replace(depth, wipe=0.0), view))


@pytest.mark.parametrize("layer", ["final", "normal", "dolp"])
def test_a_wipe_between_two_runs_shows_the_other_from_the_left(layer: str) -> None:
    seen = shown()
    other = replace(seen, gaussians=random_state("polarguide-stokes", 200)[0].gaussians)
    painter, plain = Painter(frame_of_scene(), other), Appearance(layer=layer)
    middle = CAMERA.width // 2
    for view in (None, photograph("v1", CAMERA, seen).view):
        wiped = painter.paint(seen, CAMERA, replace(plain, wipe=0.5), view)
        left, right = (paint(each, plain, view) for each in (other, seen))
        assert not np.array_equal(left, right)
        assert np.array_equal(wiped[:, : middle - 1], left[:, : middle - 1])
        assert np.array_equal(wiped[:, middle + 1 :], right[:, middle + 1 :])
    without = shown("3dgs")
    assert np.array_equal(
        Painter(frame_of_scene(), without).paint(seen, CAMERA, Appearance(layer="dolp", wipe=0.5)),
        paint(seen, Appearance(layer="dolp")),
    )


def test_a_run_of_another_scene_is_not_put_beside() -> None:
    one, other = (
        SimpleNamespace(folder=Path(name), configuration=SimpleNamespace(scene=name, scene_digest=name))
        for name in ("cup", "car")
    )
    Fault("car", "a run of cup", "one of car").raised_by(view_run, one, beside=other)


def test_colors_of_depths_stay_while_the_camera_moves():
    seen, painter, depth = shown(), Painter(frame_of_scene()), Appearance(layer="depth")
    first = painter.paint(seen, CAMERA, depth)
    nearer = replace(CAMERA, translation=0.7 * CAMERA.translation)
    moving = painter.paint(seen, nearer, depth, settled=False)
    assert not np.array_equal(moving, painter.paint(seen, nearer, depth, settled=True))
    assert np.array_equal(painter.paint(seen, CAMERA, depth), first)


SCENE = textured_ball(views=6, width=40, height=32, tests=1, radius=1.2)
AROUND = scene_frame([view.camera for view in SCENE.views])


def test_gaussians_are_drawn_with_the_blur_of_their_training() -> None:
    camera = ring()["v0"]
    plain = shown()
    sizes = footprints(plain.gaussians["means"].detach(), [camera.downscaled(3)])
    smooth = replace(plain, footprints=sizes)
    for kept in (None, lambda means: means[:, 0] > 0):
        pictures = [seen.render(camera, depth=False, within=kept).alpha for seen in (plain, smooth)]
        assert float((pictures[1] - pictures[0]).max()) > 0.05


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> FieldScenery:
    folder = tmp_path_factory.mktemp("field") / "run"
    made = run_scenery(train(SCENE, folder, recipe=small(), settings=TrainSettings(steps=3)))
    assert isinstance(made, FieldScenery)
    return made


@pytest.mark.parametrize("layer", ["final", "normal", "depth", "alpha", "photograph", "error"])
def test_pictures_have_the_windows_size(field: FieldScenery, layer: str) -> None:
    view = SCENE.views[0]
    picture = Painter(AROUND).paint(field, view.camera, Appearance(layer=layer), view)
    assert picture.shape == (32, 40, 3)


def test_a_layer_that_there_is_not_is_not_drawn(field: FieldScenery) -> None:
    assert Painter(AROUND).paint(field, SCENE.views[0].camera, Appearance(layer="specular")) is None


def test_blocks_of_four_are_one_pixel(field: FieldScenery) -> None:
    camera = SCENE.views[1].camera
    blocks = field.render(camera, depth=False).final.view(8, 4, 10, 4, 3)
    torch.testing.assert_close(blocks, blocks[:, :1, :, :1].expand_as(blocks))
    exact = field.model.render(camera.downscaled(4)).final
    torch.testing.assert_close(blocks[:, 0, :, 0], exact)


def test_what_is_cropped_is_black(field: FieldScenery) -> None:
    nothing = Crop((0.9, 0.9, 0.9), (0.91, 0.91, 0.91))
    picture = Painter(AROUND).paint(field, SCENE.views[0].camera, Appearance(crop=nothing))
    assert int(picture.max()) < 5


def test_a_training_is_shown_without_a_change(tmp_path: Path) -> None:
    looked, alone = (
        FieldTrainer(SCENE, small(), resolve(TrainSettings(steps=20), SCENE, small()), torch.device("cpu"))
        for _ in range(2)
    )
    for _ in range(20):
        looked.step(), alone.step()
        made = training_scenery(looked)
        assert f"step {looked.state.step} of 20" in made.status
        made.render(SCENE.views[0].camera.downscaled(2), depth=True)
    one, other = looked.state.tensors(), alone.state.tensors()
    assert [name for name in one if one[name].numpy().tobytes() != other[name].numpy().tobytes()] == []


LENS = next(iter(ring().values()))


def project(camera, point):
    x, y, z = (camera.rotation @ point + camera.translation).tolist()
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def test_a_free_camera_takes_the_pose_of_its_quaternion_and_the_fov_from_top_to_bottom():
    camera = free_camera(quaternion(LENS.rotation.T), LENS.center.tolist(), 2 * math.atan(0.5), (300, 200))
    assert torch.allclose(camera.rotation, LENS.rotation, atol=1e-9)
    assert torch.allclose(camera.center, LENS.center, atol=1e-9)
    ahead, down = LENS.rotation[2], LENS.rotation[1]
    assert project(camera, camera.center + 3 * ahead) == pytest.approx((150, 100))
    assert project(camera, camera.center + 2 * ahead + down) == pytest.approx((150, 200))


@pytest.mark.parametrize("size", [(640, 480), (1000, 300), (200, 900), (64, 48), (31, 17)])
def test_a_photograph_fits_into_a_window_and_its_camera_with_it(size):
    placement = letterbox(LENS, size)
    camera = LENS.extended(*size)
    assert (camera.width, camera.height) == size
    corners = np.array([(0, 0), (LENS.width, LENS.height)])
    inside = corners * placement.scale + (placement.left, placement.top)
    assert (inside >= -1e-9).all()
    assert (inside <= np.array(size) + 1e-9).all()
    assert np.isclose(inside, [(0, 0), size]).all(axis=0).any()  # it touches two borders
    point = LENS.center + LENS.rotation.T @ torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)
    before, after = np.array(project(LENS, point)), np.array(project(camera, point))
    assert after == pytest.approx(before * placement.scale + (placement.left, placement.top))


@pytest.mark.parametrize("scale", [1, 3])
def test_a_placed_picture_lies_where_the_camera_sees_it(scale):
    size = (scale * LENS.width + 20, scale * LENS.height)
    picture = np.random.default_rng(0).integers(0, 255, (LENS.height, LENS.width, 3), dtype=np.uint8)
    apply = letterbox(LENS, size).apply(picture)
    assert apply.shape == (size[1], size[0], 3)
    middles = apply[scale // 2 :: scale, 10 + scale // 2 : -10 : scale]
    assert np.array_equal(middles, picture)
    assert (apply[:, :9] == 64).all()


@pytest.mark.parametrize("aspect", [0.5, 4 / 3, 3.0])
def test_the_window_holds_the_photograph(aspect):
    fov = window_fov(LENS, aspect)
    high, wide = math.tan(fov / 2), aspect * math.tan(fov / 2)
    assert high >= LENS.height / 2 / LENS.fy - 1e-9
    assert wide >= LENS.width / 2 / LENS.fx - 1e-9
    assert min(high - LENS.height / 2 / LENS.fy, wide - LENS.width / 2 / LENS.fx) < 1e-9


def test_a_path_goes_through_its_poses(tmp_path):
    keyframes, poses = Keyframes((80, 50)), list(ring().values())[:3]
    for camera in poses:
        keyframes.add(camera)
    file = tmp_path / "path.json"
    file.write_text(keyframes.to_json(1.5))
    cameras, speed = read_path(file)
    step = round(1.5 * FRAMES_PER_SECOND)
    assert (speed, len(cameras)) == (FRAMES_PER_SECOND, 1 + 2 * step)
    assert {(c.width, c.height) for c in cameras} == {(80, 50)}
    for pose, camera in zip(poses, cameras[::step], strict=True):
        assert torch.allclose(camera.center, pose.center, atol=1e-9)
        assert torch.allclose(camera.rotation, pose.rotation, atol=1e-9)
        # The same from top to bottom.
        assert camera.height / camera.fy == pytest.approx(pose.height / pose.fy)


def test_one_pose_is_a_path_of_one_and_none_is_none():
    keyframes = Keyframes((80, 50))
    assert keyframes.path(2.0) == []
    keyframes.add(ring()["v0"])
    assert len(keyframes.path(2.0)) == 1
