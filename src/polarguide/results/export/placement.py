"""Presentation of a run in exported files: subject, axes, units, comments, provenance and camera poses."""

from __future__ import annotations

import json
import math
import unicodedata
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation
from torch import Tensor

from polarguide import __version__
from polarguide.capture.presentation import Presentation
from polarguide.core.errors import PolarguideError, PolarguideWarning
from polarguide.core.files import atomic, atomic_folder, write_text
from polarguide.core.options import Axes
from polarguide.core.progress import SILENT, Reporter
from polarguide.gaussians.harmonics import sh_basis
from polarguide.gaussians.ply import REST_COUNT
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.geometry.vectors import spread_directions
from polarguide.results.rendering.mesh import Subject, subject_of
from polarguide.runs.opened import OpenedRun
from polarguide.shading.gbuffer import RenderRequest, render
from polarguide.shading.model import Parameters
from polarguide.shading.result import RenderResult


@dataclass(frozen=True, eq=False)
class Placement:
    """Rotation and scale from the scene to an exported file.

    Attributes:
        rotation: [3, 3] float64, from the scene's axes to the file's.
        scale: units of the file per unit of the scene, positive.
        metric: True if the unit of the file is the meter.
        upright: True if up is -y in the file.
    """

    rotation: Tensor
    scale: float
    metric: bool
    upright: bool

    @classmethod
    def of(cls, presentation: Presentation, around: SceneFrame | None) -> Placement:
        """Create a placement in meters if the scale is known, with -y up or in the axes of the scene.

        Up is -y in files of Gaussians, because their axes are camera axes: x right, y down, z forward.

        Args:
            presentation: presentation of the run.
            around: the scene's frame with its up axis. None keeps the axes of the scene.
        """
        scale = presentation.meters_per_unit
        rotation = torch.eye(3, dtype=torch.float64)
        if around is not None:
            right, up, back = around.panorama_axes().unbind(1)
            rotation = torch.stack((right, -up, -back))
        return cls(rotation, scale or 1.0, scale is not None, around is not None)

    @property
    def rotates(self) -> bool:
        """True if the axes of the file differ from the axes of the scene."""
        return not torch.equal(self.rotation, torch.eye(3, dtype=torch.float64))

    @property
    def changes(self) -> bool:
        """True if the placement is not the identity."""
        return self.rotates or self.scale != 1.0

    def points(self, places: Tensor) -> Tensor:
        """Convert points [N, 3] from the scene to the file."""
        return self.scale * self.directions(places)

    def directions(self, vectors: Tensor) -> Tensor:
        """Convert directions [N, 3] from the scene to the file."""
        return vectors @ self.rotation.T.to(vectors)

    def camera(self, camera: Camera) -> Camera:
        """Convert a camera from the scene to the file."""
        return Camera(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
            camera.rotation @ self.rotation.T, self.scale * camera.translation,
        )  # fmt: skip

    def harmonics(self) -> NDArray[np.float64]:
        """Return the matrix [15, 15] that rotates spherical harmonics of degrees 1 to 3: new = matrix @ old.

        The matrix is fitted to samples. The fit is exact, because a rotation maps the harmonics of a degree to
        harmonics of the same degree.
        """
        directions = spread_directions(64)
        before = sh_basis(directions @ self.rotation, 3)[:, 1:]
        return np.asarray(torch.linalg.lstsq(sh_basis(directions, 3)[:, 1:], before).solution.numpy())

    def place(self, table: NDArray[Any]) -> None:
        """Transform Gaussians in place. They are a structured array in the layout of ``write_ply``."""
        if not self.changes:
            return
        rotation = self.rotation.numpy()
        _transform(table, ["x", "y", "z"], self.scale * rotation)
        _transform(table, ["nx", "ny", "nz"], rotation)
        for k in range(3):
            table[f"scale_{k}"] += math.log(self.scale)
        if not self.rotates:
            return
        names = [f"rot_{k}" for k in (1, 2, 3, 0)]
        quaternions = np.stack([table[name] for name in names], axis=1).astype(np.float64)
        rotated = Rotation.from_matrix(rotation) * Rotation.from_quat(quaternions)
        for name, column in zip(names, rotated.as_quat().T, strict=True):
            table[name] = column
        matrix = self.harmonics()
        for channel in range(3):
            # f_rest is channel-major; linear_rest has the channel last.
            _transform(table, [f"f_rest_{channel * REST_COUNT + k}" for k in range(REST_COUNT)], matrix)
            if "linear_rest_0" in (table.dtype.names or ()):
                _transform(table, [f"linear_rest_{3 * k + channel}" for k in range(REST_COUNT)], matrix)

    def record(self) -> dict[str, Any]:
        """Return the record in exported files: ``units``, ``up_axis``, rotation and scale of the scene."""
        return {
            "units": "meters" if self.metric else "units of the scene",
            **({"up_axis": "-y"} if self.upright else {}),
            **({"meters_per_unit_of_scene": self.scale} if self.metric else {}),
            **({"rotation_of_scene": self.rotation.flatten().tolist()} if self.upright else {}),
        }


def _transform(table: NDArray[Any], names: Sequence[str], matrix: NDArray[np.float64]) -> None:
    """Multiply the vectors whose components are the fields ``names`` of a structured array by a matrix, in place."""
    values = np.stack([table[name] for name in names]).astype(np.float64)
    for name, column in zip(names, matrix @ values, strict=True):
        table[name] = column


@dataclass(frozen=True)
class Origin:
    """Author and provenance of a file.

    Attributes:
        presentation: author, license, provenance and title.
        made_of: recipe, number of steps and digest of the scene.
    """

    presentation: Presentation
    made_of: str

    def record(self) -> dict[str, str]:
        """Return the known values as extras of a glTF asset, with the names that Sketchfab uses."""
        presentation = self.presentation
        texts = {
            "title": presentation.title,
            "author": presentation.author,
            "license": presentation.license,
            "source": presentation.provenance,
            "made_of": self.made_of,
        }
        return {name: text for name, text in texts.items() if text}


IN_PLACE = Placement(torch.eye(3, dtype=torch.float64), 1.0, metric=False, upright=False)
NOBODY = Origin(Presentation(), "")
GENERATOR = f"polarguide {__version__}"


def comments(origin: Origin, placement: Placement) -> list[str]:
    """Return the comments of a PLY or COLMAP file, one ASCII line each."""
    about = {"generator": GENERATOR, **origin.record(), **placement.record()}
    return [f"{name} {_ascii(value)}" for name, value in about.items()]


def _ascii(value: Any) -> str:
    """Convert a value to ASCII for the header of a PLY file: remove accents and escape all other characters."""
    text = " ".join(f"{number:.9g}" for number in value) if isinstance(value, list) else str(value)
    decomposed = unicodedata.normalize("NFKD", text.replace("©", "(c)"))
    plain = "".join(character for character in decomposed if not unicodedata.combining(character))
    return plain.encode("ascii", "backslashreplace").decode()


def rewrite_splats(path: Path, ply: Path, placement: Placement, mask: Tensor, lines: list[str]) -> None:
    """Transform a PLY file of Gaussians by a placement, keep only masked Gaussians, and add comments.

    Args:
        path: the file to write.
        ply: file from ``write_run_ply``.
        placement: placement of the file.
        mask: [N] bool, the Gaussians to keep.
        lines: comments.
    """
    element = PlyData.read(ply)["vertex"]
    table = element.data[mask.numpy()]
    placement.place(table)
    vertices = PlyElement.describe(table, "vertex", comments=[*element.comments, *lines])
    with atomic(path) as temporary:
        PlyData([vertices], byte_order="<").write(temporary)


IMAGES = "images"
SUFFIX = ".png"
"""File name suffix of the exported images."""
# nerfstudio uses OpenGL axes: the camera looks along -z, and y is up.
_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def write_colmap(
    folder: Path,
    cameras: Mapping[str, Camera],
    points: Tensor,
    colors: Tensor,
    *,
    comments: Sequence[str] = (),
) -> None:
    """Write a COLMAP model as text, with one camera and one image per view, and points without tracks.

    Args:
        folder: the folder to write.
        cameras: cameras by view.
        points: [M, 3].
        colors: [M, 3] uint8.
        comments: lines for the header of each file.
    """
    model = pycolmap.Reconstruction()
    for number, (name, camera) in enumerate(cameras.items(), start=1):
        params = [camera.fx, camera.fy, camera.cx, camera.cy]
        inner = pycolmap.Camera(
            camera_id=number, model="PINHOLE", width=camera.width, height=camera.height, params=params
        )
        model.add_camera_with_trivial_rig(inner)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(camera.rotation.numpy()), camera.translation.numpy())
        image = pycolmap.Image(name=name + SUFFIX, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
    for place, color in zip(points.double().numpy(), colors.numpy().astype(np.uint8), strict=True):
        model.add_point3D(place, pycolmap.Track(), color)
    with atomic_folder(folder) as temporary:
        model.write_text(str(temporary))
        head = "".join(f"# {line}\n" for line in comments).encode()
        for path in temporary.iterdir():
            path.write_bytes(head + path.read_bytes())
        _require_complete(temporary, len(cameras), len(points))


def _require_complete(folder: Path, images: int, points: int) -> None:
    """Check a written model by reading it, because pycolmap does not report a full disk.

    Raises:
        OSError: the model is incomplete.
    """
    try:
        model = pycolmap.Reconstruction()
        model.read_text(str(folder))
        complete = (len(model.images), len(model.points3D)) == (images, points)
    except Exception:  # pycolmap raises different exceptions of C++.
        complete = False
    if not complete:
        raise OSError("a truncated file; the disk may be full")


def transforms(cameras: Mapping[str, Camera], masks: str = "") -> dict[str, Any]:
    """Return the record of ``transforms.json``: intrinsics and camera-to-world matrices in OpenGL axes.

    Args:
        cameras: cameras by view.
        masks: folder of the masks of the views; empty without masks.
    """
    frames = []
    for name, camera in cameras.items():
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = camera.rotation.T, camera.center
        frames.append(
            {
                "file_path": f"{IMAGES}/{name}{SUFFIX}",
                "fl_x": camera.fx,
                "fl_y": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "w": camera.width,
                "h": camera.height,
                "transform_matrix": (pose @ _OPENGL).tolist(),
                **({"mask_path": f"{masks}/{name}{SUFFIX}"} if masks else {}),
            }
        )
    return {"camera_model": "OPENCV", "frames": frames}


def write_transforms(
    path: Path, cameras: Mapping[str, Camera], about: Mapping[str, Any] = {}, *, masks: str = ""
) -> None:
    """Write ``transforms.json``.

    Args:
        path: the file.
        cameras: cameras by view.
        about: additional fields. Other programs ignore fields that they do not know.
        masks: see ``transforms``.
    """
    write_text(path, json.dumps({**transforms(cameras, masks), **about}, indent=1) + "\n")


ALL = Subject(None, "everything")
"""The whole scene as a subject."""


class Presented:
    """Gaussians of a run's subject, with the placement and the provenance of the exported files.

    If the scene is missing, the up axis and the subject are unknown. Then all Gaussians are exported in the axes of the
    scene, with a warning.

    Args:
        run: the run.
        axes: axes of the placement.
        masked: see ``subject_of``.
        reporter: receives a line about removed Gaussians.

    Raises:
        PolarguideError: the presentation cannot be read, or no Gaussian belongs to the subject.
    """

    def __init__(
        self,
        run: OpenedRun,
        *,
        axes: Axes = "upright",
        masked: bool = False,
        reporter: Reporter = SILENT,
    ) -> None:
        self.presentation = run.presentation
        self.subject = ALL
        self.poses = self._known_poses(run)
        if self.poses is not None or self.presentation.crop is not None:
            self.subject = subject_of(run, masked=masked)
        model = run.model
        self.inside = self._members(run, reporter)
        self.gaussians: Parameters = model.state.gaussians.only(self.inside)
        footprints = model.state.footprints
        self.footprints = None if footprints is None else footprints[self.inside]
        chosen = self.presentation.up_axis is not None
        around = run.frame if chosen or (axes == "upright" and self.poses is not None) else None
        self.placement = Placement.of(self.presentation, around)
        scene = run.configuration.scene_digest[:12]
        made_of = (
            f"{run.recipe.name}, {run.steps} steps, scene sha256 {scene}, polarization {run.polarization}"
        )
        self.origin = Origin(self.presentation, made_of)

    @staticmethod
    def _known_poses(run: OpenedRun) -> list[Camera] | None:
        """Return the scene's cameras, or None with a warning if the scene is missing."""
        if run.scene_is_there:
            return [*run.poses.values()]
        warnings.warn(
            f"The scene of {run.folder} is no longer at {run.scene_folder}: files have its own axes and contain all "
            "Gaussians, and normals point away from the center of the Gaussians instead of to the nearest camera. "
            f"{run.new_place}",
            PolarguideWarning,
            stacklevel=5,
        )
        return None

    def _members(self, run: OpenedRun, reporter: Reporter) -> Tensor:
        """Return a mask [N] of the Gaussians that belong to the subject."""
        inside = self.subject.holds(run.model.state.gaussians["means"])
        count = int(inside.sum())
        if not count:
            raise PolarguideError(
                "the crop box" if self.presentation.crop is not None else "the subject",
                expected=f"Gaussians inside ({self.subject.description})",
                found=f"none of {len(inside)}",
                remedy="Move the box with polarguide present RUN --crop or in polarguide view.",
            )
        self.subject.report_removed(inside, run, reporter)
        return inside

    @property
    def centers(self) -> Tensor | None:
        """Camera centers [M, 3] of the scene, which orient surfaces outward; None if they are unknown."""
        return None if self.poses is None else torch.stack([camera.center for camera in self.poses])

    def upright(self, run: OpenedRun) -> Placement:
        """Return the placement for formats with +y up."""
        axes = run.frame.panorama_axes()
        return replace(self.placement, rotation=axes.T, upright=True)

    @property
    def comments(self) -> list[str]:
        """Comments for the header of a file."""
        return comments(self.origin, self.placement)

    def surface_view(self, run: OpenedRun) -> Callable[[Camera], RenderResult]:
        """Return a function that renders the subject's Gaussians, with the surface at each pixel's median depth."""
        model = run.model

        @torch.no_grad()
        def surface_view(camera: Camera) -> RenderResult:
            return render(
                self.gaussians,
                camera,
                model.backend.rasterize,
                RenderRequest(depth=True, at_median_depth=True),
                shading=model.shading,
                light=model.light,
            )

        return surface_view
