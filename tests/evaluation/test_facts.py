"""What holds for all test views of a scene, and what is said where something is missing."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from known_scene import known_scene

from polarguide.capture.ground_truth import Material, SceneObject
from polarguide.evaluation.facts import SceneFacts


def changed(scene, number, **fields):
    """The scene with other ground truth in one view."""
    views = list(scene.views)
    truth = views[number].ground_truth
    views[number] = dataclasses.replace(views[number], truth=dataclasses.replace(truth, **fields))
    return dataclasses.replace(scene, views=tuple(views))


def test_of_a_whole_scene_nothing_is_said():
    facts = SceneFacts.of(known_scene())
    assert facts.warnings == ()
    assert [item.name for item in facts.objects] == ["cup", "spoon", "cloth", "clay"], "the foreground's"
    assert set(facts.masks) == {"v0", "v1"}


def test_ground_truth_of_some_views():
    scene = changed(known_scene(), 1, normal=None, specular=None)
    (warning,) = SceneFacts.of(scene).warnings
    assert warning == (
        "The ground truth gives normals of 1, specular layers of 1 of 2 test views: scores against it are means over "
        "these alone."
    )


def test_masks_of_some_views():
    scene = known_scene()
    views = (scene.views[0], dataclasses.replace(scene.views[1], truth=None))
    facts = SceneFacts.of(dataclasses.replace(scene, views=views))
    assert facts.masks is None, "or some views would be scored over their foreground, others whole"
    assert "masks of 1, normals of 1" in facts.warnings[0]
    assert (
        "Only 1 of 2 test views have a mask (not v1): stokes_error is over whole pictures." in facts.warnings
    )


def test_numbers_without_a_table():
    facts = SceneFacts.of(dataclasses.replace(known_scene(), objects=()))
    (warning,) = facts.warnings
    assert "known/scene.json lists none" in warning.replace("\\", "/")
    assert "no errors by object or material" in warning
    assert facts.objects == ()


def test_a_number_that_the_table_lacks():
    scene = known_scene()
    listed = tuple(item for item in scene.objects if item.id not in (3, 7))
    (warning,) = SceneFacts.of(dataclasses.replace(scene, objects=listed)).warnings
    assert "does not list 3, 7, which gt/v0.npz shows (objid)" in warning


def test_a_material_that_is_not_said():
    scene = known_scene()
    objects = (*scene.objects[:-1], SceneObject(7, "clay", material=Material("clay")))
    facts = SceneFacts.of(dataclasses.replace(scene, objects=objects))
    (warning,) = facts.warnings
    assert "does not say whether clay is a metal or a dielectric" in warning
    assert len(facts.objects) == 4


def test_a_scene_without_ground_truth_has_no_objects_and_no_warnings():
    scene = known_scene()
    views = tuple(dataclasses.replace(view, truth=None) for view in scene.views)
    facts = SceneFacts.of(dataclasses.replace(scene, views=views))
    assert (facts.objects, facts.warnings, facts.masks, facts.object_only) == ((), (), None, False)


def test_extent_of_many_cameras_and_of_one():
    scene = known_scene()
    centers = torch.stack([view.camera.center for view in scene.views])
    assert SceneFacts.of(scene).extent == pytest.approx(1.1 * float((centers[0] - centers[1]).norm()))
    assert SceneFacts.of(dataclasses.replace(scene, views=scene.views[:1])).extent == 1
