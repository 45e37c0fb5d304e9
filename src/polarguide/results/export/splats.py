"""Conversion of a PLY file of Gaussians to other formats of splats: Niantic's SPZ, PlayCanvas' SOG, and glTF.

SOG is a ZIP file of pictures. Its specification, version 2, is at
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog

We write SOG ourselves, because GaussForge 0.6 writes 65,000 Gaussians in eight seconds but did not finish
88,623 in six minutes.

glTF uses the extension ``KHR_gaussian_splatting`` (kernel ``ellipse``). It stores linear scales, opacities in [0, 1],
quaternions (x, y, z, w) and the harmonics of 3DGS. Its ``colorSpace`` states the encoding of colors, but programs
ignore it. So one file is written for programs that blend linear colors, and one for programs that blend encoded colors.
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from torch import Tensor

from polarguide.core.errors import PolarguideError, PolarguideWarning, optional_import
from polarguide.core.files import atomic, write_whole
from polarguide.gaussians.ply import read_ply
from polarguide.results.export.model.gltf import Binary
from polarguide.results.export.web_page import curve_places

SPZ_RANGE = 2047.0
"""Largest absolute coordinate in SPZ. It has 24 bits with 12 fractional bits, and larger values wrap around."""


def write_spz(path: Path, ply: Path, version: int = 3) -> None:
    """Convert a PLY file of Gaussians to SPZ, without the fields that only this program uses.

    Gaussians outside the range of SPZ are left out with a warning.

    The axes of SPZ are right, up and back. Positions are rounded to 1/4096 of a unit. Colors and scales have 8 bits,
    harmonics 5 or 4 bits by degree.

    Args:
        path: file to write.
        ply: file from ``write_run_ply`` in the axes of SPZ.
        version: version of the format: 3 (gzip) or 4 (zstd).

    Raises:
        PolarguideError: the converter is not installed or cannot convert the file.
    """
    converter = optional_import("gaussforge", "--format spz").GaussForge()
    content = PlyData.read(ply)
    vertices = content["vertex"].data
    inside = np.all([np.abs(vertices[axis]) <= SPZ_RANGE for axis in "xyz"], axis=0)
    if not inside.all():
        warnings.warn(
            f"{path}: SPZ has no positions beyond {SPZ_RANGE:g} units. {np.count_nonzero(~inside):,} of "
            f"{len(inside):,} Gaussians are left out. Export to ply to keep them.",
            PolarguideWarning,
            stacklevel=2,
        )
        content = PlyData([PlyElement.describe(vertices[inside], "vertex")])
    data = io.BytesIO()
    content.write(data)
    converted = converter.convert(data.getvalue(), "ply", "spz", spz_version=version)
    if "error" in converted:
        raise PolarguideError(
            ply,
            expected="Gaussians that SPZ can represent",
            found=str(converted["error"]),
            remedy="Export to ply instead.",
        )
    write_whole(path, bytes(converted["data"]))


CODES = 256
PALETTE_ROW = 64
"""Number of palette entries per row of a picture."""
LARGEST_PALETTE = 8192
"""Maximum size of the palette of harmonics."""
ROUNDS = 8
"""Number of iterations of Lloyd's algorithm."""
SEED = 0
Pixels = NDArray[np.uint8]


def write_sog(path: Path, ply: Path, asset: Mapping[str, Any] = {}) -> None:
    """Convert a PLY file of Gaussians to SOG, without the fields that only this program uses.

    The signed logarithm of a position has 16 bits. A component of a rotation has 8 bits. Other values are indices into
    a codebook of 256 values. Harmonics of degrees 1 to 3 are indices into a palette of at most 8,192 entries. Equal
    input gives an equal file.

    Args:
        path: the file to write.
        ply: file from ``write_run_ply``.
        asset: fields of the asset in ``meta.json``.
    """
    gaussians = {name: values for name, values in read_ply(ply).items() if name != "extra"}
    order = _morton_order(gaussians["means"])
    gaussians = {name: values[order] for name, values in gaussians.items()}
    width = math.ceil(math.sqrt(len(order)))
    pictures: dict[str, Pixels] = {}
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "polarguide", **asset}, "count": len(order)}
    meta["means"] = _means(gaussians["means"], width, pictures)
    meta["scales"] = _coded("scales.webp", gaussians["log_scales"], None, width, pictures)
    pictures["quats.webp"] = _picture(_smallest_three(gaussians["quaternions"]), width)
    meta["quats"] = {"files": ["quats.webp"]}
    opacity = _bytes(torch.sigmoid(gaussians["opacity_logits"].reshape(-1, 1)))
    meta["sh0"] = _coded("sh0.webp", gaussians["sh_dc"].reshape(-1, 3), opacity, width, pictures)
    meta["shN"] = _harmonics(gaussians["sh_rest"], width, pictures)
    with atomic(path) as temporary, zipfile.ZipFile(temporary, "w") as file:
        _store(file, "meta.json", json.dumps(meta).encode())
        for name, pixels in pictures.items():
            _store(file, name, _lossless(pixels))


def _store(file: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Add a file to the archive without a time stamp, so that equal splats give equal archives."""
    file.writestr(zipfile.ZipInfo(name), data)


def _lossless(pixels: Pixels) -> bytes:
    order = [2, 1, 0, 3][: pixels.shape[2]]
    encoded, data = cv2.imencode(".webp", pixels[..., order], [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert encoded
    return data.tobytes()


def _picture(values: Tensor, width: int) -> Pixels:
    """Arrange N colors, [N, 3 or 4] bytes, as a picture [H, width, 4]. Colors without an alpha become opaque."""
    count, channels = values.shape
    pixels = np.zeros((math.ceil(count / width) * width, 4), dtype=np.uint8)
    pixels[:, 3] = 255
    pixels[:count, :channels] = values.to(torch.uint8).numpy()
    return pixels.reshape(-1, width, 4)


def _bytes(values: Tensor) -> Tensor:
    """Quantize values in [0, 1] to bytes."""
    return (values.clamp(0, 1) * 255).round().to(torch.uint8)


def _means(means: Tensor, width: int, pictures: dict[str, Pixels]) -> dict[str, Any]:
    logs = means.double().sign() * torch.log1p(means.double().abs())
    low = logs.min(dim=0).values
    high = logs.max(dim=0).values
    codes = ((logs - low) / (high - low).clamp(min=1e-12) * 65535).round().to(torch.int32)
    files = ["means_l.webp", "means_u.webp"]
    for name, part in zip(files, (codes & 255, codes >> 8), strict=True):
        pictures[name] = _picture(part, width)
    return {"mins": low.tolist(), "maxs": high.tolist(), "files": files}


def _smallest_three(quaternions: Tensor) -> Tensor:
    """Encode quaternions [N, 4] (w, x, y, z) as the three smallest components and the index of the largest.

    The sign of the quaternion is chosen so that its largest component is positive.
    """
    unit = torch.nn.functional.normalize(quaternions.double(), dim=1)
    largest = unit.abs().argmax(dim=1, keepdim=True)
    unit = torch.where(unit.gather(1, largest) < 0, -unit, unit)
    others = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest[:, 0]]
    three = _bytes(unit.gather(1, others) / math.sqrt(2) + 0.5)
    return torch.cat((three, (252 + largest).to(torch.uint8)), dim=1)


def _coded(
    name: str, values: Tensor, alpha: Tensor | None, width: int, pictures: dict[str, Pixels]
) -> dict[str, Any]:
    """Encode values [N, 3] with one codebook, with an optional alpha [N, 1]."""
    codes, book = _codebook(values)
    pictures[name] = _picture(codes if alpha is None else torch.cat((codes, alpha), dim=1), width)
    return {"codebook": book.tolist(), "files": [name]}


def _codebook(values: Tensor) -> tuple[Tensor, Tensor]:
    """Quantize values to 256 levels with Lloyd's algorithm.

    Returns:
        Two tensors: the index of the level of each value, in the shape of the values, and the levels in ascending
        order.
    """
    flat = values.double().flatten()
    ranks = (torch.arange(CODES, dtype=torch.float64) + 0.5) / CODES * len(flat)
    book = flat.sort().values[ranks.long().clamp(max=len(flat) - 1)]
    for _ in range(ROUNDS):
        codes = torch.bucketize(flat, 0.5 * (book[1:] + book[:-1]))
        count = torch.bincount(codes, minlength=CODES)
        sums = torch.bincount(codes, weights=flat, minlength=CODES)
        book = torch.where(count > 0, sums / count.clamp(min=1), book).sort().values
    codes = torch.bucketize(flat, 0.5 * (book[1:] + book[:-1]))
    return codes.reshape(values.shape).to(torch.uint8), book


def _harmonics(rest: Tensor, width: int, pictures: dict[str, Pixels]) -> dict[str, Any]:
    """Encode harmonics [N, 15, 3] as indices into a palette."""
    count, coefficients, _ = rest.shape
    size = min(LARGEST_PALETTE, count, 1024 * 2 ** max(0, int(math.log2(max(count, 1024) / 1024))))
    labels, palette = _clusters(rest.flatten(1), size)
    codes, book = _codebook(palette)
    gaussians = math.ceil(size / PALETTE_ROW)
    pixels = np.zeros((gaussians * PALETTE_ROW, coefficients, 3), dtype=np.uint8)
    pixels[:size] = codes.reshape(size, coefficients, 3).numpy()
    files = ["shN_centroids.webp", "shN_labels.webp"]
    pictures[files[0]] = pixels.reshape(gaussians, PALETTE_ROW * coefficients, 3)
    split = torch.stack((labels & 255, labels >> 8, torch.zeros_like(labels)), dim=1)
    pictures[files[1]] = _picture(split, width)
    return {
        "count": size,
        "bands": math.isqrt(coefficients + 1) - 1,
        "codebook": book.tolist(),
        "files": files,
    }


def _clusters(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Cluster points [N, D] with Lloyd's algorithm. Return each point's cluster index [N] and the cluster means."""
    generator = torch.Generator().manual_seed(SEED)
    means = points[torch.randperm(len(points), generator=generator)[:count]].clone()
    for _ in range(ROUNDS):
        labels = _nearest(points, means)
        sums = torch.zeros_like(means).index_add_(0, labels, points)
        members = torch.bincount(labels, minlength=count)[:, None]
        means = torch.where(members > 0, sums / members.clamp(min=1), means)
    return _nearest(points, means), means


def _nearest(points: Tensor, means: Tensor) -> Tensor:
    half = 0.5 * means.square().sum(dim=1)
    return torch.cat([(part @ means.T - half).argmax(dim=1) for part in points.split(4096)])


def _morton_order(means: Tensor) -> Tensor:
    """Return the indices that sort points in Morton order. Neighbors in space then lie together and compress well."""
    # Ranks are used instead of positions, because distant Gaussians would compress all others into one cell.
    ranks = means.argsort(dim=0).argsort(dim=0)
    return curve_places((ranks * 1024) // max(1, len(means))).argsort(stable=True)


EXTENSION = "KHR_gaussian_splatting"
Encoding = Literal["srgb", "linear"]
COLOR_SPACES: dict[Encoding, str] = {"srgb": "srgb_rec709_display", "linear": "lin_rec709_display"}
"""Value of ``colorSpace`` by encoding.

Babylon and PlayCanvas blend encoded colors; three.js blends linear colors.
"""


def write_splat_glb(path: Path, ply: Path, asset: dict[str, Any], encoding: Encoding) -> None:
    """Convert a PLY file of Gaussians (+y up) to GLB, without the fields that only this program uses.

    Args:
        path: the file to write.
        ply: file from ``write_run_ply``.
        asset: glTF asset record.
        encoding: encoding of the colors in the PLY.

    Raises:
        PolarguideError: the file cannot be written.
    """
    gaussians = read_ply(ply)
    fields = {
        "ROTATION": torch.nn.functional.normalize(gaussians["quaternions"], dim=1)[:, [1, 2, 3, 0]],
        "SCALE": gaussians["log_scales"].exp(),
        "OPACITY": torch.sigmoid(gaussians["opacity_logits"]),
    }
    harmonics = torch.cat((gaussians["sh_dc"], gaussians["sh_rest"]), dim=1)
    for degree in range(4):
        for k in range(2 * degree + 1):
            fields[f"SH_DEGREE_{degree}_COEF_{k}"] = harmonics[:, degree * degree + k]
    binary = Binary()
    attributes = {"POSITION": binary.array(gaussians["means"].numpy(), bounds=True)}
    attributes |= {f"{EXTENSION}:{name}": binary.array(values.numpy()) for name, values in fields.items()}
    about = {
        "kernel": "ellipse",
        "colorSpace": COLOR_SPACES[encoding],
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"mode": 0, "attributes": attributes, "extensions": {EXTENSION: about}}
    binary.write(path, asset, primitive, {"extensionsUsed": [EXTENSION]})
