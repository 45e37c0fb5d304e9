"""``polarguide export``."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

from polarguide.cli.common import OpenRun, console, open_run, use_threads
from polarguide.errors import PolarguideError
from polarguide.export.cameras import write_colmap, write_transforms
from polarguide.export.environment import needs_radiance, panorama, write_exr
from polarguide.export.mesh import scene_mesh, write_mesh
from polarguide.export.points import surface_points, write_points
from polarguide.export.sog import write_sog
from polarguide.export.spz import write_spz
from polarguide.runs.point_cloud import write_run_ply
from polarguide.scene_frame import scene_frame
from polarguide.visualization import figures

Format = Literal["ply", "spz", "sog", "mesh", "points", "environment", "cameras"]
PANORAMA_HEIGHT = 512


def export(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    format: Format,
    out: Path | None = None,
    resolution: int = 192,
    threads: int = 0,
) -> None:
    """Write a run as the files of other programs.

    ply, spz and sog are ordinary splats, with reflections baked as far as harmonics carry them; mesh (GLB and PLY) is
    fused from rendered depth, with diffuse colors and learned normals; points are opaque Gaussians with normals;
    environment is the learned light as a panorama (EXR and PNG); cameras are a COLMAP model and transforms.json.

    Args:
        run: Run folder.
        format: ply, spz, sog, mesh, points, environment or cameras.
        out: Folder to write; RUN/export by default.
        resolution: Voxels of the mesh along its longest side.
        threads: Threads to use; 0 takes all cores.
    """
    use_threads(threads)
    if not 16 <= resolution <= 1024:
        raise PolarguideError(
            "--resolution", expected="16 to 1024", found=str(resolution), remedy="Choose such a number."
        )
    opened = open_run(run, device="cpu")
    folder = out or run / "export"
    folder.mkdir(parents=True, exist_ok=True)
    writers: dict[str, Callable[[], list[Path]]] = {
        "ply": lambda: [_ply(opened, folder / "splats.ply")],
        "spz": lambda: [_compressed(opened, folder / "splats.spz", write_spz)],
        "sog": lambda: [_compressed(opened, folder / "splats.sog", write_sog)],
        "mesh": lambda: _mesh(opened, folder, resolution),
        "points": lambda: _points(opened, folder),
        "environment": lambda: _environment(opened, folder),
        "cameras": lambda: _cameras(opened, folder),
    }
    with console.status(f"writing {format}"):
        written = writers[format]()
    for path in written:
        size = f" ({path.stat().st_size / 1e6:.1f} MB)" if path.is_file() else ""
        console.print(f"{format}: {path}{size}", markup=False)


def _ply(opened: OpenRun, path: Path) -> Path:
    write_run_ply(path, opened.state, opened.shading)
    return path


def _compressed(opened: OpenRun, path: Path, write: Callable[[Path, Path], None]) -> Path:
    """From a PLY that is gone afterwards."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".ply-") as place:
        write(path, _ply(opened, Path(place) / "splats.ply"))
    return path


def _mesh(opened: OpenRun, folder: Path, resolution: int) -> list[Path]:
    cameras = opened.cameras
    mesh = scene_mesh(cameras, lambda camera: opened.render_camera(camera, depth=True), resolution=resolution)
    paths = [folder / "mesh.glb", folder / "mesh.ply"]
    for path in paths:
        write_mesh(path, mesh, scene_frame(list(cameras.values())))
    console.print(f"{len(mesh.surface.vertices):,} vertices, {len(mesh.surface.faces):,} triangles")
    return paths


def _points(opened: OpenRun, folder: Path) -> list[Path]:
    path = folder / "points.ply"
    views, rasterize = opened.scene.views, opened.backend.rasterize
    points = surface_points(opened.state.gaussians, opened.shading, views, rasterize)
    write_points(path, *points)
    return [path]


def _environment(opened: OpenRun, folder: Path) -> list[Path]:
    cubemap = needs_radiance(opened.shading, what="--format environment")
    around = scene_frame(list(opened.cameras.values()))
    picture = panorama(opened.light[cubemap.name], cubemap, around, PANORAMA_HEIGHT)
    paths = [folder / "environment.exr", folder / "environment.png"]
    write_exr(paths[0], picture)
    figures.write_png(paths[1], figures.radiance_to_rgb(picture))
    return paths


def _cameras(opened: OpenRun, folder: Path) -> list[Path]:
    scene = opened.scene
    write_colmap(folder / "sparse" / "0", opened.cameras, scene.points, scene.point_colors)
    write_transforms(folder / "transforms.json", opened.cameras)
    return [folder / "sparse" / "0", folder / "transforms.json"]
