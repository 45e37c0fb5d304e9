"""The axes and units of exported files, what the files say of themselves, and poses as other programs read them."""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from polarguide.core.files import atomic, atomic_folder, write_text
from polarguide.gaussians.harmonics import sh_basis
from polarguide.gaussians.ply import REST_COUNT
from polarguide.geometry.camera import Camera
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.geometry.vectors import spread_directions

HARMONICS = ("f_rest", "linear_rest")
"""Fields of harmonics in our PLY files; the first channel-major, the second with the channel last."""


@dataclass(frozen=True, eq=False)
class Placement:
    """How exported files lie: the scene turned by a rotation, then in other units.

    Attributes:
        rotation: [3, 3] float64, from the scene's axes to the file's.
        scale: the file's units in one unit of the scene, positive.
        metric: whether the file's unit is the meter. upright: whether up is -y in it.
    """

    rotation: Tensor
    scale: float
    metric: bool
    upright: bool

    @classmethod
    def of(cls, presentation: Presentation, around: SceneFrame | None) -> Placement:
        """In meters where the scale is known; up along -y, or in the scene's own axes.

        -y is up in files of Gaussians as in the photographs' own axes: x right, y down, z ahead.

        Args:
            presentation: of the run. around: the scene's frame with its up axis; None: the scene's own axes.
        """
        scale = presentation.meters_per_unit
        rotation = torch.eye(3, dtype=torch.float64)
        if around is not None:
            right, up, back = around.panorama_axes().unbind(1)
            rotation = torch.stack((right, -up, -back))
        return cls(rotation, scale or 1.0, scale is not None, around is not None)

    @property
    def changes(self) -> bool:
        """Whether anything lies otherwise than in the scene."""
        return self.upright or self.scale != 1.0

    def points(self, places: Tensor) -> Tensor:
        """Places [N, 3] of the scene as the file has them."""
        return self.scale * self.directions(places)

    def directions(self, vectors: Tensor) -> Tensor:
        """Directions [N, 3] of the scene as the file has them."""
        return vectors @ self.rotation.T.to(vectors)

    def camera(self, camera: Camera) -> Camera:
        """A camera of the scene as the file has it."""
        return Camera(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
            camera.rotation @ self.rotation.T, self.scale * camera.translation,
        )  # fmt: skip

    def harmonics(self) -> NDArray[np.float64]:
        """Rotation of coefficients of degree 1 to 3 with the scene, [15, 15]: new = matrix @ old.

        Functions of each degree turn into functions of the same degree, so that a fit to samples is exact.
        """
        directions = spread_directions(64)
        before = sh_basis(directions @ self.rotation, 3)[:, 1:]
        turned = torch.linalg.lstsq(sh_basis(directions, 3)[:, 1:], before).solution
        return np.asarray(turned.numpy())

    def place(self, table: NDArray[Any]) -> None:
        """Move the Gaussians of a PLY, a structured array as ``write_ply`` writes it, in place."""
        if not self.changes:
            return
        for fields, scale in ((("x", "y", "z"), self.scale), (("nx", "ny", "nz"), 1.0)):
            values = np.stack([table[name] for name in fields], axis=1).astype(np.float64)
            for name, column in zip(fields, (scale * values @ self.rotation.numpy().T).T, strict=True):
                table[name] = column
        for k in range(3):
            table[f"scale_{k}"] += math.log(self.scale)
        if not self.upright:
            return
        own = np.stack([table[f"rot_{k}"] for k in range(4)], axis=1).astype(np.float64)
        turned = Rotation.from_matrix(self.rotation.numpy()) * Rotation.from_quat(own[:, [1, 2, 3, 0]])
        for k, column in enumerate(turned.as_quat().T[[3, 0, 1, 2]]):
            table[f"rot_{k}"] = column
        matrix = self.harmonics()
        names = table.dtype.names or ()
        for field in HARMONICS:
            if f"{field}_{3 * REST_COUNT - 1}" not in names:
                continue
            for channel in range(3):
                places = [
                    f"{field}_{channel * REST_COUNT + k if field == 'f_rest' else 3 * k + channel}"
                    for k in range(REST_COUNT)
                ]
                values = np.stack([table[name] for name in places]).astype(np.float64)
                for name, column in zip(places, matrix @ values, strict=True):
                    table[name] = column

    def record(self) -> dict[str, Any]:
        """The record in exported files: ``units``, ``up_axis``, and how the scene was turned and scaled."""
        record: dict[str, Any] = {"units": "meters" if self.metric else "units of the scene"}
        if self.upright:
            record["up_axis"] = "-y"
        if self.metric:
            record["meters_per_unit_of_scene"] = self.scale
        if self.upright:
            record["rotation_of_scene"] = self.rotation.flatten().tolist()
        return record


@dataclass(frozen=True)
class Origin:
    """Whom a file is owed to, and where it comes from.

    Attributes:
        presentation: author, license, provenance and title. made_of: recipe, steps and the digest of the scene.
    """

    presentation: Presentation
    made_of: str

    def record(self) -> dict[str, str]:
        """By the names that Sketchfab gave to the extras of a glTF asset; what is not known is left out."""
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
    """The comments of a PLY or COLMAP file, a line each, in ASCII."""
    about = {"generator": GENERATOR, **origin.record(), **placement.record()}
    return [f"{name} {_ascii(value)}" for name, value in about.items()]


def _ascii(value: Any) -> str:
    """In ASCII, as headers of PLY files have to be: without accents, and what is left as numbers of characters."""
    text = " ".join(f"{number:.9g}" for number in value) if isinstance(value, list) else str(value)
    text = unicodedata.normalize("NFKD", text.replace("©", "(c)"))
    return (
        "".join(c for c in text if not unicodedata.combining(c)).encode("ascii", "backslashreplace").decode()
    )


def with_comments(ply: bytes, lines: list[str]) -> bytes:
    """A PLY file with comments after the line of its first element, which the SIBR viewer looks for as the third."""
    match = re.search(rb"^element [^\n]*\n", ply, re.MULTILINE)
    assert match is not None
    added = "".join(f"comment {line}\n" for line in lines).encode("ascii")
    return ply[: match.end()] + added + ply[match.end() :]


def rewrite_splats(
    path: Path, ply: Path, placement: Placement, mask: Tensor | None, lines: list[str]
) -> None:
    """Write a PLY of Gaussians as it is exported.

    Args:
        path: the file to write. ply: as ``write_run_ply`` wrote it.
        mask: [N] bool, which Gaussians are kept; None: all. lines: comments.
    """
    element = PlyData.read(ply)["vertex"]
    table = np.array(element.data if mask is None else element.data[mask.numpy()])
    placement.place(table)
    vertices = PlyElement.describe(table, "vertex", comments=[*element.comments, *lines])
    with atomic(path) as temporary:
        PlyData([vertices], byte_order="<").write(temporary)


IMAGES = "images"
"""Folder of the exported images."""
SUFFIX = ".png"
"""Suffix of the exported images."""
# nerfstudio's cameras look along -z with y up: OpenGL's axes, not OpenCV's.
_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def write_colmap(
    folder: Path,
    cameras: Mapping[str, Camera],
    points: Tensor,
    colors: Tensor,
    *,
    comments: Sequence[str] = (),
) -> None:
    """Write a COLMAP model as text: one camera and one image a view, and points without tracks.

    Args:
        folder: made if there is none. cameras: by view. points: [M, 3]. colors: [M, 3] uint8.
        comments: lines for the head of each file.
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
        _require_whole(temporary, len(cameras), len(points))


def _require_whole(folder: Path, images: int, points: int) -> None:
    """Read a model back: pycolmap does not say where the disk was full.

    Raises:
        OSError: the model is incomplete.
    """
    try:
        model = pycolmap.Reconstruction()
        model.read_text(str(folder))
        whole = (len(model.images), len(model.points3D)) == (images, points)
    except Exception:  # whatever C++ threw
        whole = False
    if not whole:
        raise OSError("a file that was cut short, as on a full disk")


def transforms(cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """The record of ``transforms.json``: intrinsics and camera-to-world matrices in OpenGL's axes, one frame a view."""
    frames = []
    for name, camera in cameras.items():
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = camera.rotation.T, camera.center
        frames.append(
            {
                "file_path": f"{IMAGES}/{name}{SUFFIX}",
                **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
                **{"w": camera.width, "h": camera.height},
                "transform_matrix": (pose @ _OPENGL).tolist(),
            }
        )
    return {"camera_model": "OPENCV", "frames": frames}


def write_transforms(path: Path, cameras: Mapping[str, Camera], about: Mapping[str, Any] = {}) -> None:
    """Write ``transforms.json``; ``about``: further fields, which readers ignore."""
    write_text(path, json.dumps({**transforms(cameras), **about}, indent=1) + "\n")
