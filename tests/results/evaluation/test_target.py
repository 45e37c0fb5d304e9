"""Facts of a scene, and errors by object and material against loops over pixels."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from known_scene import HEIGHT, NAMES, WIDTH, known_scene, rendered

from polarguide.capture.metadata import Material, SceneObject
from polarguide.results.evaluation.scores import ErrorsByObject, score_view
from polarguide.results.evaluation.target import SceneFacts, ViewTarget

SCENE = known_scene()


def changed(scene, number, **fields):
    """The scene with other ground truth in one view."""
    views = list(scene.views)
    truth = views[number].ground_truth
    views[number] = dataclasses.replace(views[number], truth=dataclasses.replace(truth, **fields))
    return dataclasses.replace(scene, views=tuple(views))


def test_of_a_whole_scene_nothing_is_said():
    facts = SceneFacts.of(SCENE)
    assert facts.warnings == ()
    assert [item.name for item in facts.objects] == ["cup", "spoon", "cloth", "clay"], "the foreground's"
    assert set(facts.masks) == {"v0", "v1"}


CLAY = SceneObject(7, "clay", material=Material("clay"))


@pytest.mark.parametrize(
    ("scene", "warned", "objects"),
    [
        (changed(SCENE, 1, normal=None, specular=None), ["normals of 1, specular layers of 1 of 2 test"], 4),
        (dataclasses.replace(SCENE, objects=()), ["scene.json", "objid"], 0),
        (
            dataclasses.replace(SCENE, objects=tuple(o for o in SCENE.objects if o.id not in (3, 7))),
            ["3, 7", "gt/v0.npz", "objid"],
            2,
        ),
        (
            dataclasses.replace(SCENE, objects=(*SCENE.objects[:-1], CLAY)),
            ["clay", "material"],
            4,
        ),
    ],
)
def test_what_the_ground_truth_lacks_is_one_warning(scene, warned, objects):
    facts = SceneFacts.of(scene)
    (warning,) = facts.warnings
    assert all(text in warning for text in warned)
    assert len(facts.objects) == objects


def test_masks_of_some_views():
    views = (SCENE.views[0], dataclasses.replace(SCENE.views[1], truth=None))
    facts = SceneFacts.of(dataclasses.replace(SCENE, views=views))
    assert facts.masks is None, "or some views would be scored over their foreground, others whole"
    assert "masks of 1, normals of 1" in facts.warnings[0]
    assert "1 of 2" in facts.warnings[1]
    assert "(not v1)" in facts.warnings[1]


def test_a_scene_without_ground_truth_has_no_objects_and_no_warnings():
    views = tuple(dataclasses.replace(view, truth=None) for view in SCENE.views)
    facts = SceneFacts.of(dataclasses.replace(SCENE, views=views))
    assert (facts.objects, facts.warnings, facts.masks, facts.object_only) == ((), (), None, False)


def test_extent_of_many_cameras_and_of_one():
    centers = torch.stack([view.camera.center for view in SCENE.views])
    assert SceneFacts.of(SCENE).extent == pytest.approx(1.1 * float((centers[0] - centers[1]).norm()))
    assert SceneFacts.of(dataclasses.replace(SCENE, views=SCENE.views[:1])).extent == 1


CPU = torch.device("cpu")
SEEDS = (5, 6)


def errors(scene, *, layers=True, **more):
    facts = SceneFacts.of(scene)
    pool = ErrorsByObject(facts.objects)
    for view, seed in zip(scene.views, SEEDS, strict=True):
        result, stokes, _ = rendered(view, seed)
        if not layers:
            stokes = None
            del result.layers["specular"], result.layers["diffuse"]
        result.layers.update({name: layer(view) for name, layer in more.items()})
        score_view(ViewTarget.of_view(view, facts, CPU), result, stokes=stokes, by_object=pool)
    return pool.records()


def srgb(v):
    v = np.clip(np.asarray(v, np.float64), 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 1e-9) ** (1 / 2.4) - 0.055)


def by_loop(scene, numbers):
    """The errors over the pixels with these object numbers."""
    squares = {"psnr": [], "specular_psnr": [], "diffuse_psnr": []}
    angles, error, size, views = [], 0.0, 0.0, set()
    for view, seed in zip(scene.views, SEEDS, strict=True):
        result, stokes, _ = rendered(view, seed)
        truth = view.ground_truth
        true = {
            "psnr": view.photograph(),
            "specular_psnr": truth.specular / 2,
            "diffuse_psnr": truth.diffuse / 2,
        }
        made = {"psnr": result.final, "specular_psnr": result.specular, "diffuse_psnr": result.diffuse}
        four = view.codes.numpy().astype(np.float64) / 65535
        for y in range(HEIGHT):
            for x in range(WIDTH):
                if int(truth.object_ids[y, x]) not in numbers or view.invalid[y, x]:
                    continue
                views.add(view.name)
                for key in squares:
                    squares[key] += list((srgb(made[key][y, x]) - srgb(true[key][y, x])) ** 2)
                n = truth.normal[y, x].double().numpy()
                if np.linalg.norm(n) > 0:
                    m = result.normal[y, x].double().numpy()
                    cosine = n @ m / np.linalg.norm(n) / np.linalg.norm(m)
                    angles.append(math.degrees(math.acos(np.clip(cosine, -1, 1))))
                if not view.saturated[y, x]:
                    i0, i45, i90, i135 = four[:, y, x]
                    for component, measured in ((1, i0 - i90), (2, i45 - i135)):
                        error += np.abs(stokes[component, y, x].double().numpy() - measured).sum()
                        size += np.abs(measured).sum()
    found = {key: -10 * math.log10(np.mean(values)) for key, values in squares.items()}
    return found | {
        "normal_mae_deg": np.mean(angles),
        "stokes_error": error / size,
        "pixels": len(squares["psnr"]) // 3,
        "views": len(views),
    }


def test_errors_of_each_object():
    by_object, _ = errors(SCENE)
    assert set(by_object) == {"cup", "spoon", "cloth", "clay"}
    for name, number in (("cup", 2), ("spoon", 3), ("cloth", 4), ("clay", 7)):
        found = dict(by_object[name])
        kind = found.pop("material")
        assert (
            kind
            == {"cup": "dielectric", "spoon": "metal", "cloth": "rough dielectric", "clay": "matte"}[name]
        )
        assert found == pytest.approx(by_loop(SCENE, (number,)), rel=1e-5), name
    assert (by_object["cup"]["views"], by_object["clay"]["views"]) == (2, 1)


def test_errors_of_each_class_of_material():
    by_object, materials = errors(SCENE)
    assert list(materials) == ["dielectric", "matte", "metal", "rough dielectric"]
    assert materials["metal"] == {k: v for k, v in by_object["spoon"].items() if k != "material"}


def test_a_class_is_pooled_over_its_objects():
    cup, cloth = SCENE.objects[1], SCENE.objects[3]
    alike = type(cloth)(cloth.id, cloth.name, material=cup.material)
    objects = tuple(alike if item.id == cloth.id else item for item in SCENE.objects)
    _, materials = errors(dataclasses.replace(SCENE, objects=objects))
    assert materials["dielectric"] == pytest.approx(by_loop(SCENE, (2, 4)), rel=1e-5)
    assert materials["dielectric"]["views"] == len(NAMES)


def test_what_a_recipe_has_not_is_none():
    by_object, _ = errors(SCENE, layers=False)
    for key in ("specular_psnr", "diffuse_psnr", "stokes_error"):
        assert by_object["cup"][key] is None
    assert by_object["cup"]["psnr"] is not None


def test_an_object_that_no_test_view_shows():
    hidden = type(SCENE.objects[1])(9, "hidden", material=SCENE.objects[1].material)
    by_object, _ = errors(dataclasses.replace(SCENE, objects=(*SCENE.objects, hidden)))
    found = by_object["hidden"]
    assert (found["pixels"], found["views"]) == (0, 0)
    assert {found[key] for key in found if key not in ("pixels", "views", "material")} == {None}


def test_views_without_numbers_add_nothing():
    truth = dataclasses.replace(SCENE.views[1].ground_truth, object_ids=None)
    views = (SCENE.views[0], dataclasses.replace(SCENE.views[1], truth=truth))
    by_object, _ = errors(dataclasses.replace(SCENE, views=views))
    assert by_object["cup"]["views"] == 1
    bare = tuple(
        dataclasses.replace(v, truth=dataclasses.replace(v.ground_truth, object_ids=None)) for v in views
    )
    assert errors(dataclasses.replace(SCENE, views=bare)) == ({}, {})


@pytest.mark.parametrize(("layer", "share"), [("metalness", "metal_share"), ("undecided", "undecided_share")])
def test_shares_of_metals_and_of_undecided_surfaces(layer: str, share: str) -> None:
    spoon = next(item.id for item in SCENE.objects if item.name == "spoon")
    by_object, materials = errors(
        SCENE, **{layer: lambda view: 0.4 + 0.2 * (view.ground_truth.object_ids == spoon)}
    )
    shares = {name: found[share] for name, found in by_object.items()}
    assert shares == {"cup": 0, "spoon": 1, "cloth": 0, "clay": 0}
    assert materials["metal"][share] == 1
    assert {"metal_share", "undecided_share"} & by_object["cup"].keys() == {share}
    assert share not in errors(SCENE)[0]["cup"]
