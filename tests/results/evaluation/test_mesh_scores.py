"""Mesh against true depth: spheres whose distance from the truth is known, and other packages' distances."""

import dataclasses
import importlib.util
import math

import numpy as np
import pytest
import torch
from random_runs import ring

from polarguide.capture import GroundTruth, View
from polarguide.geometry.camera import Camera
from polarguide.results.evaluation import mesh as measured
from polarguide.results.rendering.mesh import Surface, fused_surface
from polarguide.shading.result import RenderResult

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("skimage")
CAMERAS = ring(5, width=80, height=60)
KEYS = {f"mesh_{name}_{end}" for name in ("accuracy", "completeness", "fscore") for end in ("05", "1")}


def sphere_depth(camera: Camera, radius: float = 1.0) -> torch.Tensor:
    """Camera depth of a sphere about the origin, 0 beside it."""
    rays, center = camera.world_rays(dtype=torch.float64), camera.center
    along = rays @ center
    root = along**2 - (center @ center - radius**2)
    points = center + (-along - root.clamp(min=0).sqrt())[..., None] * rays
    return torch.where(root > 0, (points - center) @ camera.rotation[2], torch.zeros(()).double())


def views(mask: bool = True) -> list[View]:
    made = []
    for name, camera in CAMERAS.items():
        depth = sphere_depth(camera).float()
        nowhere = torch.zeros(depth.shape, dtype=torch.bool)
        truth = GroundTruth(depth=depth, mask=depth > 0 if mask else None)
        made.append(
            View(
                name,
                camera,
                torch.zeros(4, *depth.shape, 3, dtype=torch.uint16),
                nowhere,
                nowhere,
                None,
                truth,
            )
        )
    return made


def ball(radius: float = 1.0, subdivisions: int = 4) -> Surface:
    made = trimesh.creation.icosphere(subdivisions, radius)
    return Surface(np.asarray(made.vertices), np.asarray(made.faces), np.asarray(made.vertices) / radius)


def fused(render):
    return lambda: fused_surface(CAMERAS, render, resolution=64)[0]


def scores(surface: Surface, known: list[View]) -> dict[str, float]:
    return measured.surface_scores(surface, known)


def diagonal() -> float:
    points = np.concatenate([measured.true_points(view)[0] for view in views()])
    return float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))


def test_true_points_lie_on_the_sphere() -> None:
    for view in views():
        front, whole = measured.true_points(view)
        np.testing.assert_allclose(np.linalg.norm(front, axis=1), 1, atol=1e-5)
        assert len(front) == len(whole) == int((view.ground_truth.depth > 0).sum())


def test_the_true_surface_scores_one() -> None:
    for key, value in scores(ball(), views()).items():
        assert value > 0.95, key


@pytest.mark.parametrize(
    ("share", "half", "one"), [(0.003, True, True), (0.0075, False, True), (0.015, False, False)]
)
def test_a_surface_at_a_distance(share: float, half: bool, one: bool) -> None:
    """A sphere that is too large by a share of the diagonal is right for the thresholds above that share."""
    got = scores(ball(1 + share * diagonal()), views())
    for name in ("accuracy", "completeness", "fscore"):
        assert (got[f"mesh_{name}_05"] > 0.9) == half
        assert (got[f"mesh_{name}_1"] > 0.9) == one
        assert half or got[f"mesh_{name}_05"] < 0.1
        assert one or got[f"mesh_{name}_1"] < 0.1


def test_half_a_surface_is_accurate_and_half_complete() -> None:
    whole = ball()
    kept = whole.faces[(whole.vertices[whole.faces][..., 0] > 0).all(axis=1)]
    got = scores(Surface(whole.vertices, kept, whole.normals), views())
    points = np.concatenate([measured.true_points(view)[0] for view in views()])
    expected = float((points[:, 0] > -0.01 * diagonal()).mean())
    assert got["mesh_accuracy_1"] > 0.95
    assert got["mesh_completeness_1"] == pytest.approx(expected, abs=0.03)  # the edge is jagged
    a, c = got["mesh_accuracy_1"], got["mesh_completeness_1"]
    assert got["mesh_fscore_1"] == pytest.approx(2 * a * c / (a + c))


def test_distances_agree_with_another_package() -> None:
    """A bumpy ball, against trimesh's distances to its triangles."""
    rough = ball()
    bumps = 1 + 0.02 * np.sin(7 * rough.vertices[:, :1]) * np.cos(5 * rough.vertices[:, 1:2])
    surface = Surface(rough.vertices * bumps, rough.faces, rough.normals)
    known = views()
    points = np.concatenate([measured.true_points(view)[0] for view in known])[::37]
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, points[:200])
    samples, _ = measured._sampled(surface, np.ones(len(surface.vertices), bool), 0.002 * diagonal())
    got = measured._distances(points[:200], samples, 1.0)
    np.testing.assert_allclose(got, distance, atol=0.003 * diagonal())
    assert np.abs(got - distance).mean() < 0.001 * diagonal()


def test_what_no_test_view_sees_is_not_judged() -> None:
    whole, inner = ball(), ball(0.5)
    both = Surface(
        np.concatenate((whole.vertices, inner.vertices)),
        np.concatenate((whole.faces, inner.faces + len(whole.vertices))),
        np.concatenate((whole.normals, inner.normals)),
    )
    assert scores(both, views())["mesh_accuracy_1"] > 0.95, "it is hidden"
    floating = ball(0.2)
    outside = floating.vertices + np.asarray(CAMERAS["v0"].center) * 0.45
    seen = Surface(
        np.concatenate((whole.vertices, outside)),
        np.concatenate((whole.faces, floating.faces + len(whole.vertices))),
        np.concatenate((whole.normals, floating.normals)),
    )
    got = scores(seen, views())
    assert got["mesh_accuracy_1"] < 0.97, "it hangs before the sphere"
    assert got["mesh_completeness_1"] > 0.95


def test_judged_points() -> None:
    view = views()[0]
    camera, depth = view.camera, view.ground_truth.depth
    row, column = 30, 40
    assert depth[row, column] > 0
    ray = (
        camera.world_rays(dtype=torch.float64)[row, column] / camera.rays(dtype=torch.float64)[row, column, 2]
    )
    places = [(depth[row, column].item() + shift) for shift in (-0.5, 0.0, 0.09, 0.11)]
    points = np.stack([(camera.center + z * ray).numpy() for z in places])
    assert measured.judged(points, [view], 0.1).tolist() == [True, True, True, False]
    beside = (camera.center + 3 * camera.world_rays(dtype=torch.float64)[2, 2]).numpy()[None]
    assert measured.judged(beside, [view], 0.1).tolist() == [False], "outside the mask"
    assert measured.judged(2 * np.asarray(camera.center)[None], [view], 0.1).tolist() == [False], (
        "behind the camera"
    )


def sphere_result(camera: Camera, radius: float = 1.0) -> RenderResult:
    depth = sphere_depth(camera, radius)
    points = (
        camera.center
        + depth[..., None]
        * camera.world_rays(dtype=torch.float64)
        / camera.rays(dtype=torch.float64)[..., 2:]
    )
    alpha, zero = (depth > 0).float(), torch.zeros(*depth.shape, 3)
    normal = torch.where((depth > 0)[..., None], points, torch.zeros(()).double()).float()
    lobes = dict.fromkeys(("final", "base", "specular", "diffuse"), zero)
    return RenderResult({**lobes, "normal": normal, "depth": depth.float(), "alpha": alpha})


def test_the_mesh_of_a_run_is_scored() -> None:
    got = measured.mesh_scores(fused(sphere_result), views())
    assert set(got) == KEYS
    assert got["mesh_fscore_1"] > 0.8
    wrong = measured.mesh_scores(fused(lambda camera: sphere_result(camera, 1.1)), views())
    assert wrong["mesh_fscore_1"] < 0.1


def test_nothing_to_compare_or_to_fuse(monkeypatch: pytest.MonkeyPatch) -> None:
    unknown = [dataclasses.replace(view, truth=None) for view in views()]
    assert measured.mesh_scores(fused(sphere_result), unknown) == {}

    def nothing(camera: Camera) -> RenderResult:
        seen = sphere_result(camera)
        return seen.with_layers(alpha=0 * seen.alpha)

    assert measured.mesh_scores(fused(nothing), views()) == dict.fromkeys(KEYS, 0.0)


def test_a_package_that_is_missing_is_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "skimage" else find_spec(name)
    )
    got = measured.mesh_scores(fused(sphere_result), views())
    assert set(got) == {"mesh_fscore_1_reason"}
    assert str(got["mesh_fscore_1_reason"]).startswith("not installed: the Python package skimage; ")
    unknown = [dataclasses.replace(view, truth=None) for view in views()]
    assert measured.mesh_scores(fused(sphere_result), unknown) == {}


def test_without_masks_everything_is_judged() -> None:
    assert scores(ball(), views(mask=False)) == pytest.approx(scores(ball(), views()))
    assert math.isclose(diagonal(), 2 * math.sqrt(3), rel_tol=0.1)
