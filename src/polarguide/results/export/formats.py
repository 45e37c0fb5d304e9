"""Export of a run to the file formats of other programs.

The file ``model.json`` of a package states units, axes, provenance, cameras, scores, and unknown quantities. The
surface of the scene is exported as a triangle mesh, and its points as a point cloud.

Posed pictures and normal maps are exported for other trainers. The rules of the readers of normal maps, with their
sources, are in ``docs/how-to/normal-maps.md``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.lib.recfunctions import unstructured_to_structured
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from torch import Tensor

from polarguide.capture import View
from polarguide.capture.layout import refuse_scene
from polarguide.capture.presentation import colored
from polarguide.capture.view import listed
from polarguide.capture.write import write_png_file
from polarguide.core.errors import PolarguideError
from polarguide.core.files import (
    atomic,
    atomic_folder,
    holds_files,
    make_folder,
    require_inside,
    temporary_folder,
    write_text,
)
from polarguide.core.options import (
    Axes,
    ExportFormat,
    ModelOptions,
    NormalLayout,
    NormalOptions,
    PathLike,
    PlyFields,
    check_choice,
    check_finite,
)
from polarguide.core.progress import SILENT, Reporter
from polarguide.geometry.camera import Camera
from polarguide.geometry.coverage import OPAQUE
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.geometry.vectors import dot
from polarguide.optics.color import srgb_encode
from polarguide.results.evaluation.evaluate import METRICS_FILE, read_metrics
from polarguide.results.evaluation.table import shown_metrics
from polarguide.results.export.adapters import ply_fields
from polarguide.results.export.model.build import BASE_COLORS, Charted, charted_subject, textured_model
from polarguide.results.export.model.gltf import ELEMENTS, Binary, write_glb
from polarguide.results.export.model.topology import subject_surface, write_stl
from polarguide.results.export.placement import (
    GENERATOR,
    IMAGES,
    IN_PLACE,
    NOBODY,
    SUFFIX,
    Origin,
    Placement,
    Presented,
    comments,
    rewrite_splats,
    transforms,
    write_colmap,
    write_transforms,
)
from polarguide.results.export.splats import COLOR_SPACES, Encoding, write_splat_glb, write_spz
from polarguide.results.export.usd import write_splat_usdz, write_usdz
from polarguide.results.rendering.mesh import RESOLUTION, ColoredMesh, Subject, scene_mesh
from polarguide.results.rendering.relight import (
    mirrored_light,
    needs_radiance,
    panorama,
    write_exr,
    write_hdr,
)
from polarguide.runs.model import write_run_ply
from polarguide.runs.opened import OpenedRun
from polarguide.shading.model import radiance_cubemap
from polarguide.shading.result import RenderResult
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture

MODEL = "sparse/0"
"""Folder of the COLMAP model."""
TRANSFORMS = "transforms.json"


def export_cameras(run: OpenedRun, presented: Presented, folder: Path, reporter: Reporter) -> list[Path]:
    """Write ``sparse/0`` (COLMAP), ``transforms.json`` and the photographs in ``images/``.

    The cameras are pinholes, so the images are undistorted and have the size of the cameras. They show the color of the
    presentation (8 bits, sRGB).

    Raises:
        PolarguideError: the folder contains pictures or a model that were not exported by this program.
    """
    views = {view.name: view for view in run.scene.views}
    require_own(folder, MODEL, IMAGES)
    paths = _write_poses(run, presented, folder, views)
    make_folder(folder / IMAGES)
    with reporter.track("photographs", len(views)) as advance:
        for number, (name, view) in enumerate(views.items(), start=1):
            _write_picture(folder / IMAGES / f"{name}{SUFFIX}", view.photograph(), presented)
            advance(number)
    return [*paths, folder / IMAGES]


def require_own(folder: Path, *names: str) -> None:
    """Check that subfolders contain no files, or files of an earlier export.

    An earlier export is recognized by ``transforms.json``, which is written first.

    Raises:
        PolarguideError: a subfolder contains other files, or leads out of the folder.
    """
    for name in names:
        place = folder / name
        require_inside(folder, place)
        if place.is_dir() and holds_files(place) and not (folder / TRANSFORMS).exists():
            raise PolarguideError(
                place,
                expected="an empty folder or an earlier export",
                found="other files",
                remedy="Choose another --out.",
            )


def _refuse_other_pictures(folder: Path, names: Collection[str]) -> None:
    """Check that a folder contains no pictures with other names, because some trainers read all pictures of a folder.

    Raises:
        PolarguideError: the folder contains other pictures.
    """
    others = sorted(path.name for path in folder.glob(f"*{SUFFIX}") if path.stem not in names)
    if others:
        raise PolarguideError(
            folder,
            expected="pictures of the training views only",
            found=listed(others),
            remedy="Choose another --out.",
        )


def _write_poses(
    run: OpenedRun,
    presented: Presented,
    folder: Path,
    views: Mapping[str, View],
    *,
    masks: str = "",
    points: str = "",
) -> list[Path]:
    """Write ``transforms.json`` and the COLMAP model ``sparse/0``.

    Args:
        run: the run.
        presented: the run's placement and origin.
        folder: the folder to write.
        views: views by the names of their pictures.
        masks: folder of the masks in ``transforms.json``; empty without masks.
        points: name of the PLY file of the scene's points in ``transforms.json``; empty without a file.
    """
    scene = run.scene
    placement = presented.placement
    cameras = {name: placement.camera(view.camera) for name, view in views.items()}
    about = {**presented.origin.record(), **placement.record()}
    if points:
        about["ply_file_path"] = points
    write_transforms(folder / TRANSFORMS, cameras, about, masks=masks)
    places = placement.points(scene.points)
    write_colmap(folder / MODEL, cameras, places, scene.point_colors, comments=presented.comments)
    return [folder / MODEL, folder / TRANSFORMS]


def _write_picture(path: Path, linear: Tensor, presented: Presented) -> None:
    """Write linear radiance [H, W, 3] as an 8-bit sRGB picture in the color of the presentation."""
    figures.write_png(path, figures.radiance_to_rgb(colored(linear, presented.presentation.color)))


@dataclass(frozen=True)
class NormalReader:
    """Rules by which a program reads normal maps.

    Attributes:
        folder: folder of the normal maps.
        axes: signs of the camera axes right, up and toward the viewer in the normal maps.
        numbered: True if the program pairs pictures and normal maps by their order instead of by their names. Two
            different sort orders give equal pairs if names begin with a number of fixed width.
        masks: folder of the masks, for a program that ignores the alpha of normal maps; else empty.
        points: PLY file of the scene's points, for a program that does not read them from COLMAP; else empty.
    """

    folder: str
    axes: tuple[int, int, int]
    numbered: bool = False
    masks: str = ""
    points: str = ""

    def picture_name(self, number: int, view: str) -> str:
        """Return the name of the pictures of a view, without a suffix."""
        return f"{number:05d}_{view}" if self.numbered else view

    def encode(self, colors: Picture) -> Picture:
        """Convert colors of ``figures.normal_to_rgb`` to the axes of the program."""
        flipped = np.array(self.axes) < 0
        return np.where(flipped, 255 - colors, colors).astype(np.uint8)


NORMAL_READERS: dict[NormalLayout, NormalReader] = {
    "brush": NormalReader("normals", (1, 1, 1)),
    "dn-splatter": NormalReader("normals_from_pretrain", (1, -1, -1), True, "masks", "points.ply"),
}
"""Rules of the programs that read normal maps."""


def export_normals(
    run: OpenedRun, presented: Presented, folder: Path, options: NormalOptions, reporter: Reporter
) -> list[Path]:
    """Write poses, pictures and normal maps of the training views for a trainer with a normal loss.

    A normal map has 8 bits per channel, with ``(n + 1) / 2`` in camera axes. Its alpha is 255 for decided pixels and 0
    elsewhere, see ``decided_pixels``.

    Args:
        run: the run.
        presented: the run's placement and origin.
        folder: the folder to write.
        options: layout of the reader, and the kind of pictures.
        reporter: receives the progress.

    Raises:
        PolarguideError: the folder contains other files, or the run lacks the requested pictures.
    """
    _require_pictures(run, options)
    reader = NORMAL_READERS[options.layout]
    places = [name for name in (IMAGES, reader.folder, reader.masks) if name]
    require_own(folder, MODEL, *places)
    views = {reader.picture_name(k, v.name): v for k, v in enumerate(run.scene.train_views, start=1)}
    for name in places:
        _refuse_other_pictures(folder / name, views)
    paths = _write_poses(run, presented, folder, views, masks=reader.masks, points=reader.points)
    for name in places:
        make_folder(folder / name)
    if reader.points:
        points = presented.placement.points(run.scene.points)
        colors = run.scene.point_colors / 255
        write_points(folder / reader.points, points, torch.zeros_like(points), colors, presented.comments)
    with reporter.track("normal maps", len(views)) as advance:
        for number, (name, view) in enumerate(views.items(), start=1):
            result = run.result(view.camera).to("cpu")
            decided = decided_pixels(result, view.camera, presented.subject)
            normal = torch.where(decided[..., None], result.normal, 0.0)
            alpha = 255 * decided.numpy().astype(np.uint8)
            file = f"{name}{SUFFIX}"
            codes = reader.encode(figures.normal_to_rgb(normal, view.camera))
            figures.write_png(folder / reader.folder / file, codes, alpha)
            if reader.masks:
                write_png_file(folder / reader.masks / file, alpha)  # nerfstudio accepts one channel only
            _write_picture(folder / IMAGES / file, training_picture(run, view, result, options), presented)
            advance(number)
    return [*paths, *(folder / name for name in (*places, reader.points) if name)]


def _require_pictures(run: OpenedRun, options: NormalOptions) -> None:
    """Check, before a file is written, that the requested pictures exist.

    Raises:
        PolarguideError: the recipe has no diffuse layer, or the pictures of a view do not determine Stokes vectors.
    """
    views = run.scene.train_views
    if options.picture == "minimum":
        view = next((view for view in views if not view.is_determined), views[0])
        view.stokes()
    elif options.picture == "diffuse":
        run.chosen_layers(run.result(views[0].camera), ["diffuse"])


def decided_pixels(result: RenderResult, camera: Camera, subject: Subject) -> Tensor:
    """Return a mask [H, W] of the pixels with a decided normal.

    Their alpha is above one half, so that the median depth lies on a surface. This surface belongs to the subject: few
    pictures determine the geometry of its surroundings. Its normal points toward the camera, as that of a visible
    surface does.

    Args:
        result: rendering with normals and depth of the surface.
        camera: camera of the rendering.
        subject: the part of the scene that exports contain.
    """
    rays = camera.rays()
    places = camera.to_world(rays / rays[..., 2:] * result.depth[..., None]) + camera.center
    inside = subject.holds(places.reshape(-1, 3)).view(result.alpha.shape)
    toward = dot(result.normal, camera.world_rays()) < 0
    return inside & toward & (result.alpha > OPAQUE)


def training_picture(run: OpenedRun, view: View, result: RenderResult, options: NormalOptions) -> Tensor:
    """Return the picture of a view for a trainer: linear radiance [H, W, 3] on the scale of S0/2.

    Args:
        run: the run.
        view: the view.
        result: rendering of the view.
        options: kind of the picture. ``minimum`` is the least radiance behind a polarizer at any angle,
            ``(S0 - sqrt(S1^2 + S2^2)) / 2`` for each color.

    Raises:
        PolarguideError: the recipe has no diffuse layer, or the pictures do not determine Stokes vectors.
    """
    if options.picture == "diffuse":
        return run.chosen_layers(result, ["diffuse"])["diffuse"]
    if options.picture == "minimum":
        s0, s1, s2 = view.stokes()
        return (s0 - torch.hypot(s1, s2)).clamp(min=0).cpu() / 2
    return view.photograph()


RECORD = "model.json"
FILES = {
    "model.glb": "textured mesh, lit by the viewer",
    "model-unlit.glb": "textured mesh with the picture's colors, for viewers without light",
    "splats.ply": "splats, -y up (SuperSplat, Spark, Unity, Unreal)",
    "splats.spz": "the same, compressed, +y up",
    "splats-srgb.glb": "splats for readers that blend encoded colors (Babylon, PlayCanvas)",
    "splats-linear.glb": "splats for readers that blend linear colors (three.js)",
    "environment.exr": "the learned light as a panorama of linear radiance",
    "environment.hdr": "the same in the Radiance format",
    "environment.png": "the same as a picture",
    "preview.png": "a view of the run as a picture",
}


def package_record(run: OpenedRun, placement: Placement, origin: Origin, base_color: str) -> dict[str, Any]:
    """Return the content of ``model.json`` except the list of files.

    Args:
        run: the run; its scene is read.
        placement: placement of the files (+y up).
        origin: author and provenance.
        base_color: description of the base color.
    """
    unknown = [
        "the absolute brightness of base color and light: the learned light has no absolute scale",
        "surfaces that no camera saw: they are closed or continued from the nearest ones",
        *([] if placement.metric else ["the length of a unit"]),
    ]
    color = origin.presentation.color  # applies to linear RGB of the photographs
    cameras = {name: placement.camera(camera) for name, camera in run.cameras.items()}
    scored = (run.folder / METRICS_FILE).exists()
    return {
        "generator": GENERATOR,
        **origin.record(),
        "units": "meters" if placement.metric else "units of the scene",
        "up_axis": "+y",
        "rotation_of_scene": placement.rotation.flatten().tolist(),
        "scale_of_scene": placement.scale,
        "color": None if color is None else color.tolist(),
        "base_color": base_color,
        "not_known": unknown,
        "scores": dict(shown_metrics(read_metrics(run.folder), scores_only=True)) if scored else {},
        "cameras": [
            {"view": name, **{key: value for key, value in frame.items() if key != "file_path"}}
            for name, frame in zip(cameras, transforms(cameras)["frames"], strict=True)
        ],
    }


PANORAMA_HEIGHT = 512
"""Number of rows of an exported environment map."""
MILLIMETERS = 1000.0
"""Millimeters per meter. An STL file has no unit, and slicers assume millimeters."""


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
    normals: NormalOptions = NormalOptions(),
    reporter: Reporter = SILENT,
) -> list[Path]:
    """Export a run: its subject upright, in meters, and in the color of its presentation.

    Args:
        run: the run. The formats ply and spz read only poses and masks of its scene.
        format: format of the file. Splats (ply, spz, splat-glb, splat-usdz) have reflections baked into harmonics.
            The mesh (GLB and PLY) is fused from rendered depth and has diffuse colors and learned normals. The textured
            model is glb or usdz, and its closed surface stl. The environment is the learned light as a panorama (EXR,
            HDR and PNG). The cameras are a COLMAP model and transforms.json. The normals are poses, pictures and normal
            maps of the training views, in a folder with the name of the layout.
        out: folder to write; default: ``export`` in the run's folder.
        resolution: number of voxels of the mesh along its longest side, 16 to 1024.
        spz_version: version of the SPZ file, 3 or 4. Most programs can read only one of the versions.
        fields: fields of a PLY file. release writes the 62 floats of the 3DGS release. all also writes polarguide.ply
            with linear fields.
        axes: upright turns the scene so that up is +y in GLB and USD files, and -y in other files. scene keeps the axes
            of the scene, except in GLB and USD files.
        model: options of the textured model.
        normals: options of the normal maps.
        reporter: receives the progress, and a line if the presentation has a tone curve, which no file contains.

    Returns:
        The written files and folders.

    Raises:
        PolarguideError: a package is missing, or the recipe does not learn the data that the format needs.
    """
    folder = run.folder / "export" if out is None else Path(out)
    if out is None:
        require_inside(run.folder, folder)
    refuse_scene(folder)
    check_choice("format", format, _WRITERS)
    check_finite("resolution", resolution, 16, 1024)
    check_finite("spz_version", spz_version, 3, 4)
    check_choice("fields", fields, get_args(PlyFields))
    check_choice("axes", axes, get_args(Axes))
    if fields != "release" and format != "ply":
        raise PolarguideError(
            "fields", expected="release, except for --format ply", found=fields, remedy="Omit the option."
        )
    if normals != NormalOptions() and format != "normals":
        raise PolarguideError(
            "layout and picture",
            expected="the defaults, except for --format normals",
            found=f"{normals.layout}, {normals.picture}",
            remedy="Omit these options.",
        )
    # The number of Gaussians matters only for formats with Gaussians.
    listener = SILENT if format in ("environment", "cameras", "normals") else reporter
    presented = Presented(run, axes=axes, masked=model.masked, reporter=listener)
    if presented.presentation.tone_curve is not None and format != "stl":
        reporter.say("the tone curve is not part of the exported files")
    make_folder(folder)
    with reporter.track(f"writing {format}", None):
        return _WRITERS[format](
            _Exporter(run, presented, folder, resolution, spz_version, fields, model, normals, reporter)
        )


@dataclass(frozen=True, eq=False)
class _Exporter:
    """Export of one run to a folder; see ``export``. Each method writes one format and returns the written files."""

    run: OpenedRun
    presented: Presented
    folder: Path
    resolution: int
    spz_version: int
    fields: PlyFields
    options: ModelOptions
    normal_options: NormalOptions
    reporter: Reporter

    def plys(self) -> list[Path]:
        paths = [self._ply(self.folder / "splats.ply")]
        if self.fields == "all":
            paths.append(self._ply(self.folder / "polarguide.ply", own_fields=True))
        return paths

    def _ply(
        self,
        path: Path,
        placement: Placement | None = None,
        *,
        linear: bool = False,
        own_fields: bool = False,
    ) -> Path:
        model = self.run.model
        presented = self.presented
        with temporary_folder(path.with_suffix(".unplaced")) as folder:
            unplaced = folder / path.name
            write_run_ply(
                unplaced,
                model.state,
                model.shading,
                presented.centers,
                color=presented.presentation.color,
                linear=linear,
                own_fields=ply_fields(model.shading, model.state.gaussians) if own_fields else {},
            )
            inside = presented.inside.cpu()
            rewrite_splats(path, unplaced, placement or presented.placement, inside, presented.comments)
        return path

    def _from_ply(
        self, name: str, write: Callable[[Path, Path], None], placement: Placement | None = None
    ) -> list[Path]:
        """Write a temporary PLY file, and call ``write`` to convert it to the file ``name``."""
        path = self.folder / name
        with temporary_folder(path.with_suffix(".ply")) as parts:
            write(path, self._ply(parts / "splats.ply", placement))
        return [path]

    def spz(self) -> list[Path]:
        """Write an SPZ file in units of the scene, because the format rounds positions to 1/4096 of a unit."""
        # Programs expect +y up and revert this half turn.
        half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
        rotation = half_turn @ self.presented.placement.rotation
        placement = replace(self.presented.placement, rotation=rotation, scale=1.0, metric=False)
        return self._from_ply("splats.spz", partial(write_spz, version=self.spz_version), placement)

    def splat_glbs(self) -> list[Path]:
        """Write splats as GLB files, one for each encoding of colors."""
        placement = self.presented.upright(self.run)
        paths: dict[Encoding, Path] = {kind: self.folder / f"splats-{kind}.glb" for kind in COLOR_SPACES}
        with temporary_folder(self.folder / "splats.ply") as parts:
            for kind, path in paths.items():
                ply = self._ply(parts / f"{kind}.ply", placement, linear=kind == "linear")
                write_splat_glb(path, ply, asset_record(placement, self.presented.origin), kind)
        return [*paths.values()]

    def splat_usdz(self) -> list[Path]:
        """Write splats as a USDZ file with sRGB-encoded colors. USD does not define the color space of splats."""
        placement = self.presented.upright(self.run)
        about = asset_record(placement, self.presented.origin)
        return self._from_ply("splats.usdz", partial(write_splat_usdz, about=about), placement)

    def mesh(self) -> list[Path]:
        presented = self.presented
        mesh = scene_mesh(self.run.cameras, presented.surface_view(self.run), resolution=self.resolution)
        mesh = mesh.within(presented.subject.holds(torch.from_numpy(mesh.surface.vertices)).numpy())
        colors = colored(torch.from_numpy(mesh.colors), presented.presentation.color).clamp(max=1)
        mesh = replace(mesh, colors=colors.numpy())
        paths = [self.folder / "mesh.glb", self.folder / "mesh.ply"]
        for path in paths:
            write_mesh(path, mesh, self.run.frame, presented.placement, presented.origin)
        surface = mesh.surface
        self.reporter.say(f"{len(surface.vertices):,} vertices, {len(surface.faces):,} triangles")
        return paths

    def model(self, kind: str) -> list[Path]:
        return self._textured(self._charted(kind), self.options, kind)

    def _charted(self, kind: str) -> Charted:
        view = self.presented.surface_view(self.run)
        inside = self.presented.subject.inside
        with temporary_folder(self.folder / kind) as parts:
            return charted_subject(
                self.run, view, inside, self.options, self.resolution, parts, self.reporter
            )

    def _textured(self, subject: Charted, options: ModelOptions, kind: str) -> list[Path]:
        presented = self.presented
        placement = presented.placement
        textured = textured_model(
            self.run, subject, presented.presentation, placement, options, self.reporter
        )
        meaning = BASE_COLORS[options.resolved_base_color]
        asset = asset_record(placement, presented.origin)
        asset["extras"]["base_color"] = meaning
        path = self.folder / f"model{'-unlit' if options.unlit else ''}.{kind}"
        (write_glb if kind == "glb" else write_usdz)(path, textured, asset, jpeg=options.jpeg)
        return [path]

    def stl(self) -> list[Path]:
        """Write a closed surface for 3D printing, with +z up and in millimeters if the scale is known."""
        presented = self.presented
        surface, _, _ = subject_surface(
            self.run,
            presented.surface_view(self.run),
            presented.subject.inside,
            replace(self.options, close_bottom=True),
            self.resolution,
            self.reporter,
        )
        right, up, back = self.run.frame.panorama_axes().numpy().T
        axes = np.stack([right, -back, up], axis=1)
        scale = presented.placement.scale * (MILLIMETERS if presented.placement.metric else 1.0)
        path = self.folder / "model.stl"
        write_stl(
            path,
            scale * surface.vertices @ axes,
            surface.faces,
            f"{GENERATOR} {presented.presentation.credit}",
        )
        return [path]

    def all(self) -> list[Path]:
        """Write a package of files for other programs.

        It contains the model with and without shading, splats, an environment map, a preview, and the record
        ``model.json``.
        """
        run = self.run
        lit = replace(self.options, unlit=False)
        radiant = radiance_cubemap(run.model.shading) is not None
        if not radiant and lit.base_color is None:
            lit = replace(lit, base_color="diffuse")
        with atomic_folder(self.folder) as parts:
            package = replace(self, folder=parts, options=lit)
            subject = package._charted("glb")
            for options in (lit, replace(self.options, unlit=True, base_color=None)):
                package._textured(subject, options, "glb")
            package._ply(parts / "splats.ply")
            package.spz()
            package.splat_glbs()
            if radiant:
                package.environment()
            view = (run.scene.test_views + run.scene.train_views)[0]
            preview = colored(run.result(view.camera).to("cpu").final, self.presented.presentation.color)
            figures.write_png(parts / "preview.png", figures.radiance_to_rgb(preview))
            names = sorted(path.name for path in parts.iterdir())
            placement = self.presented.upright(run)
            meaning = BASE_COLORS[lit.resolved_base_color]
            record = package_record(run, placement, self.presented.origin, meaning)
            record["files"] = {name: FILES[name] for name in names}
            write_text(parts / RECORD, json.dumps(record, indent=1) + "\n")
        return [self.folder / name for name in [RECORD, *names]]

    def environment(self) -> list[Path]:
        run = self.run
        presentation = self.presented.presentation
        cubemap = needs_radiance(run.model.shading, what="format")
        with self.reporter.track("reflected light", len(run.scene.train_views)) as progress:
            learned = panorama(mirrored_light(run, cubemap, progress), cubemap, run.frame, PANORAMA_HEIGHT)
        picture = colored(learned, presentation.color)
        paths = [self.folder / f"environment.{kind}" for kind in ("exr", "hdr", "png")]
        write_exr(paths[0], picture, {"owner": presentation.credit} if presentation.credit else {})
        write_hdr(paths[1], picture)
        figures.write_png(paths[2], figures.radiance_to_rgb(picture))
        return paths

    def cameras(self) -> list[Path]:
        return export_cameras(self.run, self.presented, self.folder, self.reporter)

    def normals(self) -> list[Path]:
        folder = self.folder / self.normal_options.layout
        require_inside(self.folder, folder)
        make_folder(folder)
        return export_normals(self.run, self.presented, folder, self.normal_options, self.reporter)


_WRITERS: dict[str, Callable[[_Exporter], list[Path]]] = {
    "ply": _Exporter.plys,
    "spz": _Exporter.spz,
    "splat-glb": _Exporter.splat_glbs,
    "splat-usdz": _Exporter.splat_usdz,
    "mesh": _Exporter.mesh,
    **{kind: partial(_Exporter.model, kind=kind) for kind in ("glb", "usdz")},
    "stl": _Exporter.stl,
    "environment": _Exporter.environment,
    "cameras": _Exporter.cameras,
    "normals": _Exporter.normals,
    "all": _Exporter.all,
}


def write_mesh(
    path: Path,
    mesh: ColoredMesh,
    around: SceneFrame,
    placement: Placement = IN_PLACE,
    origin: Origin = NOBODY,
) -> None:
    """Write a mesh as PLY with display colors, or as GLB (+y up) with linear colors.

    Args:
        path: the file, .ply or .glb.
        mesh: the mesh in the scene's axes.
        around: the scene's frame.
        placement: placement of a PLY file. A GLB file uses only the scale of the placement.
        origin: author and provenance.
    """
    surface = mesh.surface
    if path.suffix.lower() == ".glb":
        axes = around.panorama_axes().numpy()
        rgba = np.rint(255 * np.pad(mesh.colors, ((0, 0), (0, 1)), constant_values=1))
        binary = Binary()
        attributes = {
            "POSITION": binary.array((placement.scale * surface.vertices @ axes).astype("<f4"), bounds=True),
            "NORMAL": binary.array((surface.normals @ axes).astype("<f4")),
            "COLOR_0": binary.array(rgba.astype("u1")),
        }
        faces = binary.array(surface.faces.reshape(-1).astype("<u4"), ELEMENTS)
        primitive = {"attributes": attributes, "indices": faces, "material": 0}
        # The default material of glTF is a rough metal, which shows no diffuse color.
        material = {"name": "diffuse", "pbrMetallicRoughness": DIELECTRIC}
        binary.write(path, asset_record(placement, origin), primitive, {"materials": [material]})
        return
    points = placement.points(torch.from_numpy(surface.vertices))
    normals = placement.directions(torch.from_numpy(surface.normals))
    colors = srgb_encode(torch.from_numpy(mesh.colors))
    write_points(path, points, normals, colors, comments(origin, placement), surface.faces)


def write_points(
    path: Path,
    points: Tensor,
    normals: Tensor,
    colors: Tensor,
    remarks: Sequence[str],
    faces: NDArray[np.integer[Any]] | None = None,
) -> None:
    """Write points, and optionally the triangles between them, as a PLY file.

    Args:
        path: the file.
        points: [N, 3] positions.
        normals: [N, 3] unit normals; zero if unknown.
        colors: [N, 3] sRGB colors in [0, 1].
        remarks: comments of the file.
        faces: [F, 3] indices of the points of each triangle.
    """
    values = np.concatenate((points.numpy(), normals.numpy(), np.rint(colors.numpy() * 255)), axis=1)
    table = unstructured_to_structured(values, np.dtype(FIELDS))
    elements = [PlyElement.describe(table, "vertex", comments=list(remarks))]
    if faces is not None:
        rows = faces.astype("<i4").view([("vertex_indices", "<i4", (3,))])[:, 0]
        elements.append(PlyElement.describe(rows, "face"))
    with atomic(path) as temporary:
        PlyData(elements, byte_order="<").write(temporary)


def asset_record(placement: Placement, origin: Origin) -> dict[str, Any]:
    """Return the asset record of a glTF file.

    The unit of glTF is the meter. If the scale of the scene is unknown, the field ``units`` states this.
    """
    units = "meters" if placement.metric else "units of the scene; their length is unknown"
    credit = origin.presentation.credit
    return {
        "generator": GENERATOR,
        **({"copyright": credit} if credit else {}),
        "extras": {**origin.record(), "units": units},
    }


DIELECTRIC = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
"""glTF material that shows vertex colors as a diffuse surface."""
FIELDS = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [
    (name, "u1") for name in ("red", "green", "blue")
]
