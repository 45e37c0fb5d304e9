"""Pictures of the viewer, against the renderer itself."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from faults import Fault
from random_runs import KINDS, random_state, ring
from trainings import make_trainer
from viewer_scenes import frame_of_scene, photograph, shown

from polarguide.capture import Scene
from polarguide.capture.presentation import Crop, Presentation, with_tone_curve
from polarguide.methods import recipe_named
from polarguide.raster.magnification import footprints
from polarguide.shading.result import LAYERS, POLARIZED
from polarguide.viewer.scenery import (
    BESIDE,
    MEASURED,
    Appearance,
    Painter,
    training_scenery,
)
from polarguide.viewer.server import view_run
from polarguide.visualization import figures
from polarguide.visualization.figures import polarization_picture

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
        if layer not in result.layers:
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
    brighter = paint(seen, Appearance(presentation=Presentation(exposure=-1.5)))
    assert np.array_equal(brighter, figures.radiance_to_rgb(result.final / 2**1.5))
    curved = Presentation(exposure=2.0, tone_curve="soft")
    expected = figures.radiance_to_rgb(with_tone_curve(4 * result.final, "soft"))
    assert np.array_equal(paint(seen, Appearance(presentation=curved)), expected)
    assert not np.array_equal(expected, figures.radiance_to_rgb(4 * result.final))
    alpha = Appearance(layer="alpha", presentation=curved)
    assert np.array_equal(paint(seen, alpha), paint(seen, Appearance(layer="alpha")))
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
    assert np.array_equal(
        paint(seen, replace(alpha, presentation=Presentation(crop=EVERYTHING))), paint(seen, alpha)
    )
    nothing = figures.scalar_to_rgb(torch.zeros(CAMERA.height, CAMERA.width), 0, 1)
    outside = Crop((8, 8, 8), (9, 9, 9))
    assert np.array_equal(paint(seen, replace(alpha, presentation=Presentation(crop=outside))), nothing)
    # What lies above the middle is in the upper half of the picture.
    upper = (
        paint(seen, replace(alpha, presentation=Presentation(crop=Crop((-9, 0.15, -9), (9, 9, 9))))).astype(
            int
        )
        - nothing
    )
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
    Fault("car", "a run of cup", "a run of car").raised_by(view_run, one, beside=other)


def test_colors_of_depths_stay_while_the_camera_moves():
    seen, painter, depth = shown(), Painter(frame_of_scene()), Appearance(layer="depth")
    first = painter.paint(seen, CAMERA, depth)
    nearer = replace(CAMERA, translation=0.7 * CAMERA.translation)
    moving = painter.paint(seen, nearer, depth, settled=False)
    assert not np.array_equal(moving, painter.paint(seen, nearer, depth, settled=True))
    assert np.array_equal(painter.paint(seen, CAMERA, depth), first)


def test_gaussians_are_drawn_with_the_blur_of_their_training() -> None:
    camera = ring()["v0"]
    plain = shown()
    sizes = footprints(plain.gaussians["means"].detach(), [camera.downscaled(3)])
    smooth = replace(plain, footprints=sizes)
    for kept in (None, lambda means: means[:, 0] > 0):
        pictures = [seen.render(camera, depth=False, within=kept).alpha for seen in (plain, smooth)]
        assert float((pictures[1] - pictures[0]).max()) > 0.05


def test_a_training_is_shown_without_a_change(tiny_scene: Scene) -> None:
    looked, alone = (make_trainer(tiny_scene, recipe_named("3dgs"), 20) for _ in range(2))
    camera = tiny_scene.views[0].camera
    for _ in range(20):
        looked.step()
        alone.step()
        made = training_scenery(looked)
        assert f"step {looked.state.step} of 20" in made.status
        made.render(camera, depth=True)
    one, other = looked.state.tensors(), alone.state.tensors()
    assert [name for name in one if one[name].numpy().tobytes() != other[name].numpy().tobytes()] == []
