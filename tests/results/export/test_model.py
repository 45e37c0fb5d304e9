"""Textured models: clean topology, charts, textures with their padding, delighting, and the file as others read it."""

import json
import math
import struct
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from faults import Fault
from random_runs import ring
from scipy.ndimage import maximum_filter, minimum_filter

from polarguide.capture.presentation import Crop, Presentation
from polarguide.core.errors import install_package, require_package
from polarguide.core.options import ModelOptions
from polarguide.core.progress import SILENT
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import scene_frame
from polarguide.optics.color import srgb_decode_array
from polarguide.results.export.model import build
from polarguide.results.export.model.bake import Surroundings, arriving_light, irradiance
from polarguide.results.export.model.build import charted_subject, require_room, textured_model
from polarguide.results.export.model.gltf import Textured, color_pixels, write_glb
from polarguide.results.export.model.topology import Topology, cleaned, topology
from polarguide.results.export.model.unwrap import Unwrapped, rasterized_texels, unwrap
from polarguide.results.export.placement import IN_PLACE
from polarguide.results.rendering.mesh import ColoredMesh, Surface, subject_of
from polarguide.results.rendering.relight import mirrored_light
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.model import radiance_cubemap
from polarguide.shading.result import RenderResult

trimesh = pytest.importorskip("trimesh")
for name in ("xatlas", "fast_simplification", "embreex", "skimage"):
    pytest.importorskip(name, reason=f"no {name} -> pip install '.[model]'")

BALL = trimesh.creation.icosphere(5)
POINTS, FACES = np.array(BALL.vertices), np.array(BALL.faces, np.int64)


def with_island() -> tuple[np.ndarray, np.ndarray]:
    crumb = trimesh.creation.icosphere(0, radius=0.05)
    return np.concatenate([POINTS, crumb.vertices + 3]), np.concatenate([FACES, crumb.faces + len(POINTS)])


DIRTY = {
    "clean": (POINTS, FACES),
    "a face twice": (POINTS, np.concatenate([FACES, FACES[:1]])),
    "a face turned around": (POINTS, np.concatenate([FACES[1:], FACES[:1, ::-1]])),
    "a fin": (
        np.concatenate([POINTS, [[2.0, 2.0, 2.0]]]),
        np.concatenate([FACES, [[*FACES[7, :2], len(POINTS)]]]),
    ),
    "a face without area": (POINTS, np.concatenate([FACES, [[3, 3, 5]]])),
    "an island": with_island(),
    "a missing face": (POINTS, FACES[1:]),
    "four missing faces": (POINTS, FACES[~(FACES[0, 0] == FACES).any(axis=1)]),
}


@pytest.mark.parametrize("fault", DIRTY)
def test_cleaning_leaves_one_closed_piece(fault: str) -> None:
    before = topology(DIRTY[fault][1])
    perfect = (before.boundary_edges, before.non_manifold_edges, before.pieces) == (0, 0, 1)
    assert perfect == (fault == "clean")
    surface = cleaned(*DIRTY[fault])
    after = topology(surface.faces)
    assert (after.boundary_edges, after.non_manifold_edges, after.pieces) == (0, 0, 1)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(BALL.volume, rel=0.02)
    assert (surface.normals * surface.vertices).sum(axis=1).min() > 0.9


def test_large_holes_stay_and_are_counted() -> None:
    half = cleaned(POINTS, FACES[POINTS[FACES][..., 2].mean(axis=1) > 0])
    counts = topology(half.faces)
    assert counts.boundary_edges > 30
    assert (counts.non_manifold_edges, counts.pieces) == (0, 1)


HOLES = {
    "half of it": POINTS[FACES][..., 2].mean(axis=1) > 0,
    "two that touch in a vertex": ~np.isin(
        np.arange(len(FACES)), (FACES[0, 0] == FACES).any(axis=1).nonzero()[0][[0, 3]]
    ),
}


@pytest.mark.parametrize("hole", HOLES)
def test_what_is_to_be_closed_has_no_holes(hole: str) -> None:
    surface = cleaned(POINTS, FACES[HOLES[hole]], closed=True)
    assert topology(surface.faces) == Topology(0, 0, 1)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight
    share = 0.5 if hole == "half of it" else 1.0
    assert mesh.volume == pytest.approx(share * BALL.volume, rel=0.03)


def test_a_surface_without_area_is_refused() -> None:
    Fault(where="the model", found="none").raised_by(cleaned, np.zeros((3, 3)), np.array([[0, 1, 2]]))


def test_texels_interpolate_and_textures_are_filled_to_their_end() -> None:
    """A square of two triangles in the middle of a texture: texel centers at half texels, the first row at v = 0."""
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
    square = Unwrapped(np.arange(4), np.array([[0, 1, 2], [0, 2, 3]]), uv, 1)
    texels = rasterized_texels(square, 64)
    assert len(texels.index) == 32 * 32
    row, column = np.divmod(texels.index, 64)
    expected = np.stack([column + 0.5, row + 0.5], axis=1) / 64
    np.testing.assert_allclose(texels.interpolated(square.faces, uv), expected, atol=1e-6)
    picture = texels.texture(expected)
    np.testing.assert_allclose(picture[0, 0], [16.5 / 64] * 2, atol=1e-6)
    np.testing.assert_allclose(picture[40, 63], [47.5 / 64, 40.5 / 64], atol=1e-6)
    Fault(where="texture", found="none").raised_by(rasterized_texels, replace(square, uv=0.001 * uv), 64)


def test_charts_keep_their_distance(tmp_path: Path) -> None:
    """Eight texels at 2,048, and each vertex belongs to the one that it was."""
    ball = trimesh.creation.icosphere(3)
    faces = np.array(ball.faces, np.int64)
    unwrapped = unwrap(np.array(ball.vertices), faces, 2048, tmp_path, SILENT)
    assert unwrapped.charts > 1
    np.testing.assert_array_equal(unwrapped.source[unwrapped.faces], faces)
    texels = rasterized_texels(unwrapped, 2048)
    mesh = trimesh.Trimesh(unwrapped.uv, unwrapped.faces, process=False)
    chart = np.zeros(len(unwrapped.faces), int)
    for number, part in enumerate(trimesh.graph.connected_components(mesh.face_adjacency)):
        chart[part] = number
    picture = np.full(2048 * 2048, -1)
    picture[texels.index] = chart[texels.face]
    largest = picture.reshape(2048, 2048)
    smallest = np.where(largest < 0, chart.max() + 1, largest)
    # Within seven texels of each other there is one chart alone.
    covered = largest >= 0
    assert (maximum_filter(largest, 15) == largest)[covered].all()
    assert (minimum_filter(smallest, 15) == largest)[covered].all()


def wall_and_floor(wall: float) -> ColoredMesh:
    """A floor at z = 0, black, and a wall of a radiance at x = 0, both wide."""
    w = 50.0
    vertices = np.array(
        [[-w, -w, 0], [w, -w, 0], [w, w, 0], [-w, w, 0], [0, -w, 0], [0, w, 0], [0, w, w], [0, -w, w]]
    )
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    colors = np.where(np.arange(8)[:, None] < 4, 0.0, wall) * np.ones(3)
    return ColoredMesh(Surface(vertices, faces, np.zeros_like(vertices)), colors)


@pytest.mark.parametrize(("wall", "share"), [(0.0, 0.5), (1.0, 1.0), (0.4, 0.7)])
def test_irradiance_beside_a_wall(wall: float, share: float) -> None:
    """Half of the light of an even sky, and what the wall gives back; of it all, a dielectric of index 1.5 lets pass
    all but 9.2 % (Walsh's integral of Fresnel's reflectance)."""
    places = np.array([[0.05, y, 0.0] for y in np.linspace(-1, 1, 40)])
    normals = np.tile([0.0, 0.0, 1.0], (40, 1))
    around = Surroundings(lambda directions: np.full_like(directions, 2.0), wall_and_floor(2 * wall))
    light = irradiance(arriving_light(places, normals, around, lambda *_, **__: None), normals, 1.5)
    assert light.mean() == pytest.approx(2 * share * 0.908, rel=0.02)


@pytest.mark.parametrize(
    ("normal", "share"), [((0.0, 0.0, 1.0), 1.0), ((1.0, 0.0, 0.0), 0.5), ((0.0, 0.0, -1.0), 0.0)]
)
def test_irradiance_is_that_of_the_normal_asked_for(normal: tuple[float, float, float], share: float) -> None:
    """Over a black floor under an even sky: all of its light for what looks up, half of it for what looks aside."""
    both = wall_and_floor(0.0)
    floor = ColoredMesh(replace(both.surface, faces=both.surface.faces[:2]), both.colors)
    sky = Surroundings(lambda directions: np.full_like(directions, 2.0), floor)
    light = arriving_light(np.zeros((40, 3)), np.tile([0.0, 0.0, 1.0], (40, 1)), sky, lambda *_, **__: None)
    found = irradiance(light, np.tile(normal, (40, 1)), 1.5)
    assert found.mean() == pytest.approx(2 * share * 0.908, abs=0.04)


def glb_tree(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    assert data[:4] == b"glTF"
    assert struct.unpack("<I", data[8:12])[0] == len(data)
    tree: dict[str, Any] = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    return tree


def test_a_known_gray_is_its_srgb_byte(tmp_path: Path) -> None:
    """18 % gray is byte 118 in sRGB; roughness and factors are linear: 0.5 is 128."""
    gray = color_pixels(np.full((8, 8, 3), 0.18, np.float32))
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    half = np.full((8, 8, 3), 128, np.uint8)
    mesh = Textured(square, np.tile([0.0, 0, 1], (3, 1)), square[:, :2], np.array([[0, 1, 2]]), gray, half,
                    half[..., 0], 1.4)  # fmt: skip
    write_glb(tmp_path / "a.glb", mesh, {"generator": "test"}, jpeg=False)
    material = trimesh.load(tmp_path / "a.glb", process=False).to_geometry().visual.material
    assert np.unique(np.array(material.baseColorTexture)[..., :3]).tolist() == [118]
    assert np.unique(np.array(material.metallicRoughnessTexture)[..., :3]).tolist() == [128]
    tree = glb_tree(tmp_path / "a.glb")
    extensions = tree["materials"][0]["extensions"]
    assert extensions["KHR_materials_ior"] == {"ior": 1.4}
    assert sorted(tree["extensionsUsed"]) == ["KHR_materials_ior", "KHR_materials_specular"]
    write_glb(tmp_path / "b.glb", replace(mesh, surface=None, specular=None), {}, jpeg=True)
    tree = glb_tree(tmp_path / "b.glb")
    assert tree["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    assert [image["mimeType"] for image in tree["images"]] == ["image/jpeg"]


IN_SCENE = Presentation()
CAMERAS = ring(12, width=96, height=72)


def albedo(points: np.ndarray) -> np.ndarray:
    """A smooth pattern over the unit sphere, of three different channels."""
    return 0.5 + 0.3 * points * np.array([1.0, -1.0, 0.5])


def ball_view(camera: Camera, mirrored: float = 1.0) -> RenderResult:
    """The unit sphere under an even light of radiance 1: index 1.5, roughness 0.3, strength 0.5. It mirrors another."""
    rays = camera.world_rays(dtype=torch.float64)
    center = camera.center
    along = rays @ center
    root = along**2 - (center @ center - 1)
    hit = root > 0
    points = center + (-along - root.clamp(min=0).sqrt())[..., None] * rays
    depth = torch.where(hit, (points - center) @ camera.rotation[2], 0.0).float()
    # Seen at normal incidence 96 % passes outward, and of even light 90.8 % inward.
    diffuse = torch.from_numpy(albedo(points.numpy())) * 0.96 * 0.908 * hit[..., None]
    picture, alpha = diffuse.float(), hit.float()
    normal = torch.where(hit[..., None], points, 0.0).float()
    specular = 0.2 * alpha[..., None].expand_as(picture)
    lobes = {"final": picture + specular, "specular": specular, "diffuse": picture, "base": picture}
    surface = {"normal": normal, "depth": depth, "alpha": alpha}
    shaded = {"reflection": 5 * mirrored * specular, "strength": 0.5 * alpha, "roughness": 0.3 * alpha}
    return RenderResult({**lobes, **surface, **shaded})


def ball_run(light: float = 1.0) -> Any:
    """What exports read of a run, of the sphere; ``light`` is the radiance that it has learned."""
    shading = DeferredShading(blend="fresnel", environment_resolution=4)
    model = SimpleNamespace(shading=shading, state=SimpleNamespace(gaussians={}))
    frame = scene_frame(list(CAMERAS.values()))
    views = [SimpleNamespace(camera=camera) for camera in CAMERAS.values()]
    texels = torch.full((6, 4, 4, 3), math.log(light))
    return SimpleNamespace(
        model=model, gaussian_model=lambda _: model, light={"texels": texels}, cameras=CAMERAS,
        camera_frame=frame, frame=frame, result=partial(ball_view, mirrored=light),
        scene=SimpleNamespace(train_views=views),
    )  # fmt: skip


def model_of(
    folder: Path, presentation: Presentation = IN_SCENE, light: float = 1.0, **options: Any
) -> Textured:
    folder.mkdir(exist_ok=True)
    chosen = ModelOptions(triangles=3000, texture=512, **options)
    run = ball_run(light)
    run.presentation, run.has_masks, run.poses = presentation, False, CAMERAS
    inside = subject_of(run).inside
    subject = charted_subject(run, ball_view, inside, chosen, 64, folder, SILENT)
    return textured_model(run, subject, presentation, IN_PLACE, chosen, SILENT)


@pytest.mark.parametrize(
    ("options", "color"),
    [
        ({}, lambda p: albedo(p)),
        ({"albedo_scale": 0.5}, lambda p: 0.5 * albedo(p)),
        ({"base_color": "diffuse"}, lambda p: 0.96 * 0.908 * albedo(p)),
        ({"unlit": True}, lambda p: 0.96 * 0.908 * albedo(p) + 0.2),
    ],
)
def test_the_texture_holds_the_color_that_went_in(
    options: dict[str, Any], color: Any, tmp_path: Path
) -> None:
    """From a ring of views to a file, and back by rays that other programs would cast."""
    write_glb(tmp_path / "model.glb", model_of(tmp_path / "parts", **options), {}, jpeg=False)
    mesh = trimesh.load(tmp_path / "model.glb", process=False).to_geometry()
    counts = topology(
        np.array(trimesh.Trimesh(mesh.vertices, mesh.faces, merge_tex=True, merge_norm=True).faces)
    )
    assert counts.non_manifold_edges == 0
    assert counts.pieces == 1
    np.testing.assert_allclose(np.median(np.linalg.norm(mesh.vertices, axis=1)), 1, atol=0.02)
    axes = ball_run().frame.panorama_axes().numpy()
    views = np.concatenate([camera.world_rays(dtype=torch.float64)[20:52, 32:64].reshape(-1, 3).numpy() @ axes
                            for camera in CAMERAS.values()])  # fmt: skip
    starts = np.repeat([camera.center.numpy() @ axes for camera in CAMERAS.values()], 32 * 32, axis=0)
    places, ray, face = mesh.ray.intersects_location(starts, views, multiple_hits=False)
    assert len(ray) > 0.9 * len(views)
    shares = trimesh.triangles.points_to_barycentric(mesh.triangles[face], places)
    uv = (mesh.visual.uv[mesh.faces[face]] * shares[..., None]).sum(axis=1)
    image = np.array(mesh.visual.material.baseColorTexture)[..., :3]
    row, column = ((1 - uv[:, 1]) * 512).astype(int), (uv[:, 0] * 512).astype(int)
    error = np.abs(image[row, column] - 255.0 * encode(color(places @ axes.T)))
    assert np.median(error) < 2
    assert np.quantile(error, 0.99) < 12
    if not options.get("unlit"):
        surface = np.array(mesh.visual.material.metallicRoughnessTexture)[row, column]
        assert np.median(surface[:, 1]) == pytest.approx(0.3 * 255, abs=1.5)
        assert surface[:, 2].max() == 0


def encode(linear: np.ndarray) -> np.ndarray:
    """sRGB's curve, above its straight part."""
    return np.asarray(1.055 * np.clip(linear, 0.01, 1) ** (1 / 2.4) - 0.055)


def test_nothing_is_whiter_than_surfaces_are(tmp_path: Path) -> None:
    """Learned light that is too dark makes base color too bright: it is taken back by one factor."""
    right, bright = (model_of(tmp_path, light=light).base_color for light in (1.0, 0.3))
    linear = [srgb_decode_array(pixels / 255) for pixels in (right, bright)]
    assert np.quantile(linear[1].max(axis=-1), 0.9) == pytest.approx(0.88, abs=0.03)  # without: 1
    assert max(values.max() for values in linear) < 0.91
    middle = (right > 60) & (bright < 250)
    ratio = (linear[1] / linear[0].clip(0.01))[middle]
    assert np.quantile(ratio, 0.75) < 1.02 * np.quantile(ratio, 0.25)


def test_light_that_gaussians_add_is_folded_in() -> None:
    """The learned light is 0.2 everywhere, and what the sphere mirrors is 3; where it mirrors nothing, 0.2 stays."""
    run = ball_run(3.0)
    cubemap = radiance_cubemap(run.model.shading)
    run.light["texels"] = torch.full((6, 4, 4, 3), math.log(0.2))
    found = [cubemap.radiance(mirrored_light(run, cubemap, lambda *_: None))]
    run.result = lambda camera: ball_view(camera).with_layers(
        specular=torch.zeros(camera.height, camera.width, 3)
    )
    found.append(cubemap.radiance(mirrored_light(run, cubemap, lambda *_: None)))
    for values, expected in zip(found, (3.0, 0.2), strict=True):
        np.testing.assert_allclose(values, expected, rtol=5e-3)


def test_a_crop_box_takes_part_of_it_and_the_rest_still_shades(tmp_path: Path) -> None:
    frame = ball_run().camera_frame
    upper = Crop((-1.0, 0.0, -1.0), (1.0, 1.0, 1.0))
    model = model_of(tmp_path, Presentation(crop=upper))
    assert model.vertices[:, 1].min() > -0.05 * frame.distance
    assert model.vertices[:, 1].max() == pytest.approx(1, abs=0.05)
    nothing = Presentation(crop=Crop((50.0, 50.0, 50.0), (60.0, 60.0, 60.0)))
    Fault(where="crop").raised_by(model_of, tmp_path, nothing)


def test_faults_are_named_before_work_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Fault(where="triangles", expected="100 or more").raised_by(ModelOptions, triangles=5)
    Fault(where="texture", expected="16384").raised_by(ModelOptions, texture=99_999)
    Fault(where="albedo_scale").raised_by(ModelOptions, albedo_scale=float("nan"))
    remedy = install_package("no_such")
    Fault(where="--format glb", expected="no_such", remedy=remedy).raised_by(
        require_package, "no_such", "--format glb"
    )
    monkeypatch.setattr(build, "free_memory", lambda: 10**9)
    Fault(where="--texture", found="8192 x 8192").raised_by(require_room, 8192)
    require_room(512)


def test_a_process_that_fails_is_an_error_and_one_that_is_stopped_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("polarguide.results.export.model.unwrap._ENTRY", "raise SystemExit('no room')")
    Fault(where="xatlas", found="no room").raised_by(unwrap, POINTS, FACES, 64, tmp_path, SILENT)
    started: list[subprocess.Popen[bytes]] = []

    class Stopped(subprocess.Popen):  # type: ignore[type-arg]
        def communicate(self, *_: Any, **__: Any) -> Any:
            started.append(self)
            raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", Stopped)
    monkeypatch.setattr("polarguide.results.export.model.unwrap._ENTRY", "import time; time.sleep(600)")
    with pytest.raises(KeyboardInterrupt):
        unwrap(POINTS, FACES, 64, tmp_path, SILENT)
    assert started[0].returncode is not None
