"""A run as the files of other programs."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch

from polarguide.capture.layout import refuse_scene
from polarguide.capture.presentation import colored
from polarguide.core.errors import PolarguideError
from polarguide.core.files import (
    atomic_folder,
    make_folder,
    require_inside,
    temporary_folder,
    write_text,
)
from polarguide.core.options import (
    Axes,
    ExportFormat,
    ModelOptions,
    PathLike,
    PlyFields,
    check_choice,
    check_finite,
)
from polarguide.core.progress import SILENT, Reporter
from polarguide.optics.color import srgb_encode
from polarguide.results.export.adapters import ply_fields
from polarguide.results.export.cameras import export_cameras
from polarguide.results.export.mesh import asset_record, surface_points, write_mesh, write_points
from polarguide.results.export.model.build import BASE_COLORS, Charted, charted_subject, textured_model
from polarguide.results.export.model.gltf import write_glb
from polarguide.results.export.model.obj import write_obj
from polarguide.results.export.model.subject import subject_surface, write_stl
from polarguide.results.export.package import RECORD, about_files, package_record
from polarguide.results.export.placement import (
    GENERATOR,
    Placement,
    comments,
    rewrite_splats,
)
from polarguide.results.export.presented import Presented
from polarguide.results.export.splat_glb import COLOR_SPACES, Encoding, write_splat_glb
from polarguide.results.export.splats import write_sog, write_spz
from polarguide.results.export.usd import write_splat_usdz, write_usdz
from polarguide.results.rendering.mesh import RESOLUTION, scene_mesh
from polarguide.results.rendering.relight import (
    mirrored_light,
    needs_radiance,
    panorama,
    write_exr,
    write_hdr,
)
from polarguide.runs.model import write_run_ply
from polarguide.runs.opened import OpenedRun
from polarguide.visualization import figures

PANORAMA_HEIGHT = 512


def export(
    run: OpenedRun,
    format: ExportFormat,
    out: PathLike | None = None,
    *,
    resolution: int = RESOLUTION,
    spz_version: int = 3,
    fields: PlyFields = "release",
    axes: Axes = "upright",
    model: ModelOptions = ModelOptions(),
    reporter: Reporter = SILENT,
) -> list[Path]:
    """Write a run as the files of other programs, as it is presented: its subject, in its color, in meters, upright.

    Args:
        run: the run; of its scene, ply, spz and sog need poses and masks alone.
        format: ply, spz, sog and splat-glb are ordinary splats, with reflections baked as far as harmonics carry
            them; mesh (GLB and PLY) is fused from rendered depth, with diffuse colors and learned normals; glb and
            obj are a textured model; points are opaque Gaussians with normals; environment is the learned light as a
            panorama (EXR, HDR and PNG); cameras are a COLMAP model and transforms.json.
        out: folder to write; ``export`` in the run's folder by default.
        resolution: voxels of the mesh along its longest side, 16 to 1024.
        spz_version: version of the SPZ file, 3 or 4; readers are split between them.
        fields: of ply: release is the 62 floats of the 3DGS release; all adds polarguide.ply, with our linear fields.
        axes: upright, +y in GLB and USD, -y elsewhere; or scene, the scene's own in all but GLB and USD.
        model: options of the textured model.
        reporter: receives progress.

    Returns:
        The files and folders written.

    Raises:
        PolarguideError: a package is missing, or the recipe has nothing of this kind.
    """
    folder = run.folder / "export" if out is None else Path(out)
    if out is None:
        require_inside(run.folder, folder)
    refuse_scene(folder)
    writers: dict[str, Callable[[], list[Path]]] = {
        "ply": lambda: _plys(run, presented, folder, fields),
        "spz": lambda: _spz(run, presented, folder, spz_version),
        "sog": lambda: _sog(run, presented, folder),
        "splat-glb": lambda: _splat_glb(run, presented, folder),
        "splat-usdz": lambda: _splat_usdz(run, presented, folder),
        "mesh": lambda: _mesh(run, presented, folder, resolution, reporter),
        "glb": lambda: _model(run, presented, folder, resolution, model, reporter, "glb"),
        "obj": lambda: _model(run, presented, folder, resolution, model, reporter, "obj"),
        "usdz": lambda: _model(run, presented, folder, resolution, model, reporter, "usdz"),
        "stl": lambda: _stl(run, presented, folder / "model.stl", resolution, model, reporter),
        "points": lambda: _points(run, presented, folder),
        "environment": lambda: _environment(run, presented, folder, reporter),
        "cameras": lambda: export_cameras(run, presented, folder, reporter),
        "all": lambda: _all(run, presented, folder, resolution, spz_version, model, reporter),
    }
    check_choice("format", format, writers)
    check_finite("resolution", resolution, 16, 1024)
    check_finite("spz_version", spz_version, 3, 4)
    check_choice("fields", fields, get_args(PlyFields))
    check_choice("axes", axes, get_args(Axes))
    if fields != "release" and format != "ply":
        raise PolarguideError(
            "fields", expected="release, but for --format ply", found=fields, remedy="Leave it out."
        )
    # Formats without Gaussians print no number of them.
    heard = SILENT if format in ("environment", "cameras") else reporter
    presented = Presented(run, axes=axes, masked=model.masked, reporter=heard)
    make_folder(folder)
    with reporter.track(f"writing {format}", None):
        return writers[format]()


def _plys(run: OpenedRun, presented: Presented, folder: Path, fields: PlyFields) -> list[Path]:
    paths = [_ply(run, presented, folder / "splats.ply")]
    if fields == "all":
        paths.append(_ply(run, presented, folder / "polarguide.ply", own_fields=True))
    return paths


def _ply(
    run: OpenedRun,
    presented: Presented,
    path: Path,
    placement: Placement | None = None,
    *,
    linear: bool = False,
    own_fields: bool = False,
) -> Path:
    with temporary_folder(path.with_suffix(".whole")) as folder:
        whole = folder / path.name
        model = run.model
        write_run_ply(
            whole,
            model.state,
            model.shading,
            presented.centers,
            color=presented.presentation.color,
            linear=linear,
            own_fields=ply_fields(model.shading, model.state.gaussians) if own_fields else {},
        )
        selected = None if presented.inside is None else presented.inside.cpu()
        rewrite_splats(path, whole, placement or presented.placement, selected, presented.comments)
    return path


def _from_ply(
    run: OpenedRun,
    presented: Presented,
    path: Path,
    write: Callable[[Path, Path], None],
    placement: Placement | None = None,
) -> list[Path]:
    """Write a file by a function of its path and of a temporary PLY."""
    with temporary_folder(path.with_suffix(".ply")) as parts:
        write(path, _ply(run, presented, parts / "splats.ply", placement))
    return [path]


def _spz(run: OpenedRun, presented: Presented, folder: Path, version: int) -> list[Path]:
    """In units of the scene: positions of the format are multiples of 1/4096 of a unit."""
    placement = replace(presented.placement, scale=1.0, metric=False)
    return _from_ply(run, presented, folder / "splats.spz", partial(write_spz, version=version), placement)


def _sog(run: OpenedRun, presented: Presented, folder: Path) -> list[Path]:
    credit = presented.presentation.credit
    asset = {
        **({"copyright": credit} if credit else {}),
        "extras": {**presented.origin.record(), **presented.placement.record()},
    }
    return _from_ply(run, presented, folder / "splats.sog", partial(write_sog, asset=asset))


def _splat_glb(run: OpenedRun, presented: Presented, folder: Path) -> list[Path]:
    """From PLY files that are gone afterwards, one for each kind of reader."""
    place = presented.upright(run)
    paths: dict[Encoding, Path] = {kind: folder / f"splats-{kind}.glb" for kind in COLOR_SPACES}
    with temporary_folder(folder / "splats.ply") as parts:
        for kind, path in paths.items():
            ply = _ply(run, presented, parts / f"{kind}.ply", place, linear=kind == "linear")
            write_splat_glb(path, ply, asset_record(place, presented.origin), kind)
    return [*paths.values()]


def _splat_usdz(run: OpenedRun, presented: Presented, folder: Path) -> list[Path]:
    """Colors are encoded: USD leaves their space open."""
    place = presented.upright(run)
    about = asset_record(place, presented.origin)
    return _from_ply(run, presented, folder / "splats.usdz", partial(write_splat_usdz, about=about), place)


def _mesh(
    run: OpenedRun, presented: Presented, folder: Path, resolution: int, reporter: Reporter
) -> list[Path]:
    mesh = scene_mesh(run.cameras, presented.surface_view(run), resolution=resolution)
    mesh = mesh.within(presented.subject.holds(torch.from_numpy(mesh.surface.vertices)).numpy())
    colors = colored(torch.from_numpy(mesh.colors), presented.presentation.color).clamp(max=1)
    mesh = replace(mesh, colors=colors.numpy())
    paths = [folder / "mesh.glb", folder / "mesh.ply"]
    for path in paths:
        write_mesh(path, mesh, run.frame, presented.placement, presented.origin)
    reporter.say(f"{len(mesh.surface.vertices):,} vertices, {len(mesh.surface.faces):,} triangles")
    return paths


def _model(
    run: OpenedRun,
    presented: Presented,
    folder: Path,
    resolution: int,
    options: ModelOptions,
    reporter: Reporter,
    kind: Literal["glb", "obj", "usdz"],
) -> list[Path]:
    subject = _charted(run, presented, folder, resolution, options, reporter, kind)
    return _textured(run, presented, folder, subject, options, reporter, kind)


def _charted(
    run: OpenedRun,
    presented: Presented,
    folder: Path,
    resolution: int,
    options: ModelOptions,
    reporter: Reporter,
    kind: str,
) -> Charted:
    view = presented.surface_view(run)
    with temporary_folder(folder / kind) as parts:
        return charted_subject(run, view, presented.subject.inside, options, resolution, parts, reporter)


def _textured(
    run: OpenedRun,
    presented: Presented,
    folder: Path,
    subject: Charted,
    options: ModelOptions,
    reporter: Reporter,
    kind: Literal["glb", "obj", "usdz"],
) -> list[Path]:
    place = presented.placement
    textured = textured_model(run, subject, presented.presentation, place, options, reporter)
    meaning = BASE_COLORS[options.resolved_base_color]
    if kind == "obj":
        upright = replace(place, upright=False)  # +y is up whatever was chosen
        lines = [*comments(presented.origin, upright), "up_axis +y", f"base_color {meaning}"]
        return write_obj(folder, textured, lines, jpeg=options.jpeg)
    asset = asset_record(place, presented.origin)
    asset["extras"]["base_color"] = meaning
    path = folder / f"model{'-unlit' if options.unlit else ''}.{kind}"
    (write_glb if kind == "glb" else write_usdz)(path, textured, asset, jpeg=options.jpeg)
    return [path]


MILLIMETERS = 1000.0
"""In a meter: slicers take the numbers of an STL file for millimeters."""


def _stl(
    run: OpenedRun,
    presented: Presented,
    path: Path,
    resolution: int,
    options: ModelOptions,
    reporter: Reporter,
) -> list[Path]:
    """For 3D printing: closed, in millimeters where the scale is known, and with up along z, as slicers have it."""
    view = presented.surface_view(run)
    options = replace(options, close_bottom=True)
    inside = presented.subject.inside
    surface, _, _ = subject_surface(run, view, inside, options, resolution, reporter)
    right, up, back = run.frame.panorama_axes().numpy().T
    axes = np.stack([right, -back, up], axis=1)
    scale = presented.placement.scale * (MILLIMETERS if presented.placement.metric else 1.0)
    write_stl(
        path, scale * surface.vertices @ axes, surface.faces, f"{GENERATOR} {presented.presentation.credit}"
    )
    return [path]


def _all(
    run: OpenedRun,
    presented: Presented,
    folder: Path,
    resolution: int,
    spz_version: int,
    options: ModelOptions,
    reporter: Reporter,
) -> list[Path]:
    """A package: the model lit and unlit, splats, the light, a preview, and ``model.json``, which tells of them."""
    lit = replace(options, unlit=False)
    radiant = run.model.shading.radiance_cubemap is not None
    if not radiant and options.base_color is None:
        lit = replace(lit, base_color="diffuse")
    unlit = replace(options, unlit=True, base_color=None)
    with atomic_folder(folder) as parts:
        subject = _charted(run, presented, parts, resolution, lit, reporter, "glb")
        for chosen in (lit, unlit):
            _textured(run, presented, parts, subject, chosen, reporter, "glb")
        _ply(run, presented, parts / "splats.ply")
        _spz(run, presented, parts, spz_version)
        _sog(run, presented, parts)
        _splat_glb(run, presented, parts)
        if radiant:
            _environment(run, presented, parts, reporter)
        view = (run.scene.test_views + run.scene.train_views)[0]
        picture = colored(run.result(view.camera).to("cpu").final, presented.presentation.color)
        figures.write_png(parts / "preview.png", figures.radiance_to_rgb(picture))
        names = sorted(path.name for path in parts.iterdir())
        record = package_record(
            run, presented.upright(run), presented.origin, BASE_COLORS[lit.resolved_base_color]
        )
        write_text(parts / RECORD, json.dumps({**record, "files": about_files(names)}, indent=1) + "\n")
    return [folder / name for name in [RECORD, *names]]


def _points(run: OpenedRun, presented: Presented, folder: Path) -> list[Path]:
    path = folder / "points.ply"
    model = run.model
    placement = presented.placement
    views = run.scene.views
    rasterize = model.backend.rasterize
    places, normals, linear = surface_points(presented.gaussians, model.shading, views, rasterize)
    colors = srgb_encode(colored(linear, presented.presentation.color).clamp(0, 1))
    write_points(path, placement.points(places), placement.directions(normals), colors, presented.comments)
    return [path]


def _environment(run: OpenedRun, presented: Presented, folder: Path, reporter: Reporter) -> list[Path]:
    cubemap = needs_radiance(run.model.shading, what="format")
    with reporter.track("light that is mirrored", len(run.scene.train_views)) as progress:
        learned = panorama(mirrored_light(run, cubemap, progress), cubemap, run.frame, PANORAMA_HEIGHT)
    picture = colored(learned, presented.presentation.color)
    paths = [folder / f"environment.{kind}" for kind in ("exr", "hdr", "png")]
    credit = presented.presentation.credit
    write_exr(paths[0], picture, {"owner": credit} if credit else {})
    write_hdr(paths[1], picture)
    figures.write_png(paths[2], figures.radiance_to_rgb(picture))
    return paths
