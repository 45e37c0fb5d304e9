"""A run as the files of other programs, and as a web page."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from polarguide.capture import read_model
from polarguide.errors import PolarguideError
from polarguide.evaluation.record import METRICS_FILE, read_metrics
from polarguide.evaluation.table import shown_metrics
from polarguide.export.cameras import write_colmap, write_transforms
from polarguide.export.mesh import write_mesh
from polarguide.export.points import surface_points, write_points
from polarguide.export.share import share_page
from polarguide.export.sog import write_sog
from polarguide.export.spz import write_spz
from polarguide.files import make_folder, require_inside, temporary_folder, write_text
from polarguide.options import ExportFormat, PathLike, check_choice, check_range
from polarguide.progress import SILENT, Reporter
from polarguide.rendering.mesh import RESOLUTION, scene_mesh
from polarguide.rendering.relight import needs_radiance, panorama, write_exr
from polarguide.runs.opened import OpenedRun
from polarguide.runs.point_cloud import write_run_ply
from polarguide.scene_frame import scene_frame
from polarguide.visualization import figures

PANORAMA_HEIGHT = 512


def export(
    run: OpenedRun,
    format: ExportFormat,
    out: PathLike | None = None,
    *,
    resolution: int = RESOLUTION,
    spz_version: int = 3,
    reporter: Reporter = SILENT,
) -> list[Path]:
    """Write a run as the files of other programs.

    Args:
        run: the run; its scene is read for all but ply, spz and sog.
        format: ply, spz and sog are ordinary splats, with reflections baked as far as harmonics carry them; mesh (GLB
            and PLY) is fused from rendered depth, with diffuse colors and learned normals; points are opaque Gaussians
            with normals; environment is the learned light as a panorama (EXR and PNG); cameras are a COLMAP model and
            transforms.json.
        out: folder to write; ``export`` in the run's folder by default.
        resolution: voxels of the mesh along its longest side, 16 to 1024.
        spz_version: of the SPZ file, 3 or 4; readers are split between them.
        reporter: told how far it is.

    Returns:
        The files and folders written.

    Raises:
        PolarguideError: an optional package is missing, or the recipe has nothing of this kind.
    """
    folder = run.folder / "export" if out is None else Path(out)
    if out is None:
        require_inside(run.folder, folder)
    writers: dict[str, Callable[[], list[Path]]] = {
        "ply": lambda: [_ply(run, folder / "splats.ply")],
        "spz": lambda: [_compressed(run, folder / "splats.spz", partial(write_spz, version=spz_version))],
        "sog": lambda: [_compressed(run, folder / "splats.sog", write_sog)],
        "mesh": lambda: _mesh(run, folder, resolution, reporter),
        "points": lambda: _points(run, folder),
        "environment": lambda: _environment(run, folder),
        "cameras": lambda: _cameras(run, folder),
    }
    check_choice("format", format, writers)
    check_range("resolution", resolution, 16, 1024)
    check_range("spz_version", spz_version, 3, 4)
    make_folder(folder)
    with reporter.track(f"writing {format}", None):
        return writers[format]()


def share(run: OpenedRun, path: PathLike | None = None, *, title: str = "", caption: str = "") -> Path:
    """Write a run as one web page that renders it with its reflections, and needs nothing beside itself.

    The photographs' poses are its views; the first test view is where it begins.

    Args:
        run: the run; its scene is read.
        path: file to write, ending in .html; ``share.html`` in the run's folder by default.
        title: heading of the page; the scene's name by default.
        caption: text below it; the recipe and its steps by default.

    Returns:
        The file's path.

    Raises:
        PolarguideError: a name that ends in something else, or scores that cannot be read.
    """
    path = run.folder / "share.html" if path is None else Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise PolarguideError(
            "out", expected="a name that ends in .html", found=str(path), remedy="Choose such a name."
        )
    views = run.scene.test_views + run.scene.train_views
    scored = (run.folder / METRICS_FILE).exists()
    scores = shown_metrics(read_metrics(run.folder), scores_only=True) if scored else []
    page = share_page(
        run.model.state.gaussians,
        run.model.light,
        run.model.shading,
        {view.name: view.camera for view in views},
        first=views[0].name,
        title=title or run.scene.name,
        caption=caption or f"{run.recipe.name}, {run.steps:,} steps",
        metrics=[
            *((f"{label}, test views", text) for label, text in scores),
            ("Gaussians", f"{len(run.model):,}"),
        ],
    )
    make_folder(path.parent)
    write_text(path, page)
    return path


def _ply(run: OpenedRun, path: Path) -> Path:
    write_run_ply(path, run.model.state, run.model.shading, _camera_centers(run))
    return path


def _camera_centers(run: OpenedRun) -> Tensor | None:
    """Centers of the scene's cameras [M, 3], which tell on what side surfaces are seen; None if it is not there."""
    try:
        model = read_model(Path(run.configuration.scene))
        return torch.stack([model.camera(name).center for name in model.names])
    except PolarguideError:
        return None


def _compressed(run: OpenedRun, path: Path, write: Callable[[Path, Path], None]) -> Path:
    """From a PLY that is gone afterwards."""
    with temporary_folder(path.with_suffix(".ply")) as place:
        write(path, _ply(run, place / "splats.ply"))
    return path


def _mesh(run: OpenedRun, folder: Path, resolution: int, reporter: Reporter) -> list[Path]:
    cameras = run.cameras
    mesh = scene_mesh(cameras, lambda camera: run.model.render(camera, depth=True), resolution=resolution)
    paths = [folder / "mesh.glb", folder / "mesh.ply"]
    for path in paths:
        write_mesh(path, mesh, scene_frame(list(cameras.values())))
    reporter.say(f"{len(mesh.surface.vertices):,} vertices, {len(mesh.surface.faces):,} triangles")
    return paths


def _points(run: OpenedRun, folder: Path) -> list[Path]:
    path, model = folder / "points.ply", run.model
    views, rasterize = run.scene.views, model.backend.rasterize
    write_points(path, *surface_points(model.state.gaussians, model.shading, views, rasterize))
    return [path]


def _environment(run: OpenedRun, folder: Path) -> list[Path]:
    cubemap = needs_radiance(run.model.shading, what="format")
    around = scene_frame(list(run.cameras.values()))
    picture = panorama(run.light[cubemap.name], cubemap, around, PANORAMA_HEIGHT)
    paths = [folder / "environment.exr", folder / "environment.png"]
    write_exr(paths[0], picture)
    figures.write_png(paths[1], figures.radiance_to_rgb(picture))
    return paths


def _cameras(run: OpenedRun, folder: Path) -> list[Path]:
    scene = run.scene
    require_inside(folder, folder / "sparse" / "0")
    write_colmap(folder / "sparse" / "0", run.cameras, scene.points, scene.point_colors)
    write_transforms(folder / "transforms.json", run.cameras)
    return [folder / "sparse" / "0", folder / "transforms.json"]
