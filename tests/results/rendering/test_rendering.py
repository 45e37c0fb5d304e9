"""What is rendered of a run: panoramas, meshes and videos."""

import os
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from faults import Fault
from glb_files import read_glb
from random_runs import ring

from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import scene_frame
from polarguide.results.export.formats import write_mesh
from polarguide.results.rendering.mesh import (
    Surface,
    box_around,
    fuse,
    largest_pieces,
    scene_mesh,
    seen_points,
)
from polarguide.results.rendering.pictures import write_video
from polarguide.results.rendering.relight import (
    cubemap_of_panorama,
    needs_radiance,
    panorama,
    read_panorama,
    turned_cubemap,
    write_exr,
)
from polarguide.shading.cubemap import cubemap_lookup, texel_directions
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.directional import DirectionalShading
from polarguide.shading.model import PLAIN, radiance_cubemap
from polarguide.shading.result import RenderResult

AROUND = scene_frame(list(ring().values()))
LERP, FRESNEL = DeferredShading(), DeferredShading("fresnel")


def smooth_texels(resolution: int = 32) -> torch.Tensor:
    """Raw texels of a light that varies slowly, and differently in all directions."""
    x, y, z = texel_directions(resolution).unbind(-1)
    return torch.stack((x + 0.3 * y, y - 0.5 * z, z * x), dim=-1)


@pytest.mark.parametrize("shading", [LERP, FRESNEL])
def test_a_panorama_becomes_the_light_it_was(shading: DeferredShading) -> None:
    texels = smooth_texels()
    picture = panorama(texels, radiance_cubemap(shading), AROUND, 256)
    back = cubemap_of_panorama(picture, radiance_cubemap(shading), AROUND, 32)
    torch.testing.assert_close(shading.radiance(back), shading.radiance(texels), atol=0.01, rtol=0.01)


def test_a_panorama_is_upright_and_runs_to_the_right() -> None:
    axes = AROUND.panorama_axes().float()
    texels = texel_directions(32) @ axes  # light = (right, up, back)
    picture = panorama(texels, radiance_cubemap(FRESNEL), AROUND, 64).log()
    right, up, back = picture.unbind(-1)
    assert float(up[0].mean()) > 0.99
    assert float(up[-1].mean()) < -0.99
    assert float(back[32, 64]) < -0.99  # the middle looks ahead
    assert float(right[32, 96]) > 0.99  # a quarter of the width further, to the right


def test_turning_moves_what_is_seen_counter_clockwise() -> None:
    texels = smooth_texels()
    turned = turned_cubemap(texels, AROUND.turn(90), 32)
    ahead = -AROUND.panorama_axes()[:, 2]
    left = AROUND.turn(90) @ ahead
    torch.testing.assert_close(
        cubemap_lookup(turned, left.float()[None]),
        cubemap_lookup(texels, ahead.float()[None]),
        atol=0.02,
        rtol=0,
    )


def test_exr_is_read_by_ffmpeg(tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR")
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    picture = torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(0)) * 100
    path = tmp_path / "light.exr"
    write_exr(path, picture)
    command = [ffmpeg, "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "gbrpf32le", "-"]
    planes = np.frombuffer(subprocess.run(command, capture_output=True, check=True).stdout, "<f4").reshape(
        3, 8, 16
    )
    np.testing.assert_array_equal(planes[[2, 0, 1]].transpose(1, 2, 0), picture.numpy())
    torch.testing.assert_close(read_panorama(path), picture)


def test_radiance_hdr_is_read(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).uniform(0.1, 50, (8, 16, 3)).astype(np.float32)
    assert cv2.imwrite(str(tmp_path / "light.hdr"), picture[..., ::-1])
    np.testing.assert_allclose(read_panorama(tmp_path / "light.hdr").numpy(), picture, rtol=0.02, atol=0.3)


def test_what_is_no_panorama_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR")
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE nonsense")
    (tmp_path / "b.hdr").write_bytes(b"")
    (tmp_path / "c.png").write_bytes(b"")
    (tmp_path / "damaged.exr").write_bytes(b"v/1\x01 nonsense" * 20)
    cv2.imwrite(str(tmp_path / "square.hdr"), np.ones((8, 8, 3), np.float32))
    write_exr(tmp_path / "dark.exr", torch.zeros(8, 16, 3))
    picture = torch.ones(8, 16, 3)
    picture[3, 4, 1] = float("nan")
    write_exr(tmp_path / "one.exr", picture)
    found = {"dark.exr": "no value above 0", "one.exr": "NaN at 1 of 128 pixels"}
    for name in ("a.hdr", "b.hdr", "c.png", "damaged.exr", "square.hdr", "none.exr", "dark.exr", "one.exr"):
        Fault(name, "", found.get(name, "")).raised_by(read_panorama, tmp_path / name)


@pytest.mark.skipif(sys.platform != "linux", reason="the file system takes names in UTF-8 alone")
def test_an_exr_is_written_under_a_name_that_is_no_utf8(tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR")
    folder = tmp_path / os.fsdecode(b"a\xff")
    folder.mkdir()
    write_exr(folder / "a.exr", torch.ones(8, 16, 3))
    assert [path.name for path in folder.iterdir()] == ["a.exr"]
    assert not (folder / "a.exr").is_symlink()
    assert (read_panorama(folder / "a.exr") == 1).all()


def test_recipes_without_radiance_say_so() -> None:
    for shading in (DirectionalShading(), PLAIN):
        Fault("--environment", "radiance").raised_by(needs_radiance, shading, what="--environment")
    assert needs_radiance(FRESNEL, what="") == radiance_cubemap(FRESNEL)


trimesh = pytest.importorskip("trimesh")
pytest.importorskip("skimage")
CAMERAS = ring(10, width=96, height=72)
COLOR = torch.tensor([0.8, 0.2, 0.05])


def sphere(camera: Camera) -> RenderResult:
    """A unit sphere about the origin, of one color, as the renderer would show it."""
    rays = camera.world_rays(dtype=torch.float64)
    center = camera.center
    along = rays @ center
    root = along**2 - (center @ center - 1)
    hit = root > 0
    distance = -along - root.clamp(min=0).sqrt()
    points = center + distance[..., None] * rays
    depth = torch.where(hit, (points - center) @ camera.rotation[2], torch.zeros(()).double())
    alpha, zero = hit.float(), torch.zeros(*hit.shape, 3)
    normal = torch.where(hit[..., None], points, torch.zeros(()).double()).float()
    base = alpha[..., None] * COLOR
    lobes = {"final": base, "base": base, "diffuse": base, "specular": zero}
    return RenderResult({**lobes, "normal": normal, "depth": depth.float(), "alpha": alpha})


def test_seen_points_lie_on_the_sphere() -> None:
    camera = CAMERAS["v0"]
    seen = sphere(camera)
    assert seen.depth is not None
    points = seen_points(camera, seen.depth, seen.alpha > 0.5)
    torch.testing.assert_close(points.norm(dim=1), torch.ones(len(points)).double(), atol=1e-5, rtol=0)


def test_the_field_is_the_distance_near_the_surface() -> None:
    views = [(camera, sphere(camera)) for camera in CAMERAS.values()]
    points = [seen_points(c, s.depth, s.alpha > 0.5) for c, s in views]  # type: ignore[arg-type]
    box = box_around(points, torch.zeros(3).double(), 4.0, 48)
    field, weight = fuse(box, ((c, s.depth, s.alpha > 0.5) for c, s in views))  # type: ignore[misc]
    assert float(field.abs().max()) <= 1
    assert int(weight.max()) <= len(views)


def test_a_mesh_of_the_sphere(tmp_path) -> None:  # type: ignore[no-untyped-def]
    mesh = scene_mesh(CAMERAS, sphere, resolution=64)
    radius = np.linalg.norm(mesh.surface.vertices, axis=1)
    assert abs(float(np.median(radius)) - 1) < 0.02
    assert float(np.abs(radius - 1).max()) < 0.12
    cosine = (mesh.surface.normals * mesh.surface.vertices).sum(axis=1) / radius
    assert float(np.median(cosine)) > 0.99
    assert float((cosine > 0).mean()) > 0.97, "normals point outward, but at the rim of what no camera sees"
    corners = mesh.surface.vertices[mesh.surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert float(((across * corners.mean(axis=1)).sum(axis=1) > 0).mean()) > 0.97, "faces turn outward"
    np.testing.assert_allclose(np.median(mesh.colors, axis=0), COLOR.numpy(), atol=0.02)

    around = scene_frame(list(CAMERAS.values()))
    for name in ("mesh.ply", "mesh.glb"):
        write_mesh(tmp_path / name, mesh, around)
    ply = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_allclose(ply.vertices, mesh.surface.vertices, atol=1e-5)
    np.testing.assert_allclose(ply.vertex_normals, mesh.surface.normals, atol=1e-3)
    assert np.median(ply.visual.vertex_colors[:, 0]) == pytest.approx(231, abs=3)  # sRGB of 0.8
    glb = trimesh.load(tmp_path / "mesh.glb", process=False).to_geometry()
    assert len(glb.faces) == len(mesh.surface.faces)
    upright = mesh.surface.vertices @ around.panorama_axes().numpy()
    np.testing.assert_allclose(np.sort(glb.vertices[:, 1]), np.sort(upright[:, 1]), atol=1e-5)
    colors = read_glb(tmp_path / "mesh.glb")[1]["COLOR_0"]
    assert np.median(colors[:, 0]) == pytest.approx(0.8 * 255, abs=3)  # linear


def test_nothing_to_see_is_said() -> None:
    def nothing(camera: Camera) -> RenderResult:
        seen = sphere(camera)
        return seen.with_layers(alpha=0 * seen.alpha)

    Fault(expected="surfaces", found="none").raised_by(scene_mesh, CAMERAS, nothing, resolution=32)


def test_small_pieces_go() -> None:
    ball, crumb = trimesh.creation.icosphere(3), trimesh.creation.icosphere(0, radius=0.1)
    vertices = np.concatenate((crumb.vertices + 5, ball.vertices))
    faces = np.concatenate((crumb.faces, ball.faces + len(crumb.vertices)))
    kept = largest_pieces(Surface(vertices, faces, vertices), 0.05)
    assert len(kept.vertices) == len(ball.vertices)
    np.testing.assert_allclose(kept.vertices[kept.faces], ball.vertices[ball.faces])


encoder = pytest.importorskip("imageio_ffmpeg")
PICTURES = [np.full((16, 16, 3), 40 * k, np.uint8) for k in range(5)]


def test_all_pictures_are_in_it(tmp_path: Path) -> None:
    assert write_video(tmp_path / "a.mp4", PICTURES, frames_per_second=10) == 5
    assert encoder.count_frames_and_secs(tmp_path / "a.mp4")[0] == 5


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_an_encoder_that_ends_on_a_full_disk_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    (tmp_path / "a.mp4").write_bytes(b"the older one")
    write_frames = encoder.write_frames

    def cut(name: str, *given: object, **options: object) -> Iterator[object]:
        inner = write_frames(name, *given, **options)
        try:
            inner.send(None)
            while True:
                inner.send((yield))
        finally:
            inner.close()
            whole = Path(name).read_bytes()
            Path(name).write_bytes(whole[: int(share * len(whole))])

    monkeypatch.setattr(encoder, "write_frames", cut)
    Fault("a.mp4", "", "of 5 pictures", "space").raised_by(
        write_video, tmp_path / "a.mp4", PICTURES, frames_per_second=10
    )
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"the older one"


def test_pictures_that_fail_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def pictures() -> Iterator[np.ndarray]:
        yield from PICTURES
        raise PolarguideError("path", expected="cameras", found="none", remedy="Give some.")

    write_frames, writers = encoder.write_frames, []

    def kept(*given: object, **options: object) -> Generator[object, object, None]:
        writers.append(write_frames(*given, **options))
        return writers[0]

    monkeypatch.setattr(encoder, "write_frames", kept)
    Fault("path", "cameras").raised_by(write_video, tmp_path / "a.mp4", pictures(), frames_per_second=10)
    assert writers[0].gi_frame is None, "the encoder is at work yet"
    assert list(tmp_path.iterdir()) == []
