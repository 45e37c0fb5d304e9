"""Pictures that come as arrays: checked, and brought to what a decoder gives of files."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from polarguide.capture import box_filter as boxes
from polarguide.capture import checks
from polarguide.capture.exposures import FOUR, LARGEST, Angle, Exposure, normalized
from polarguide.capture.formats.headers import declared_size
from polarguide.capture.formats.pictures import (
    MATERIAL_REMEDY,
    decode_mask,
    decode_materials,
    decode_picture,
    linear_codes,
    read_picture,
)
from polarguide.capture.layout import Layout
from polarguide.capture.metadata import GroundTruth, read_ground_truth
from polarguide.capture.point_exposures import ComparedPoints, PointExposures, PointSamples
from polarguide.capture.view import EVEN, FULL_CODE, Latest, Loader, View
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import LARGEST_FILE, read_file
from polarguide.core.records import LARGEST_RECORD
from polarguide.core.text import canonical
from polarguide.geometry.camera import Camera
from polarguide.optics import Mount

Array = NDArray[Any] | Tensor
"""NumPy's or torch's, on any device."""
_PICTURES = "pictures [K, H, W] or [K, H, W, 3] of uint8, uint16, or linear floats from 0 to 1"


def as_numpy(values: ArrayLike | Tensor) -> NDArray[Any]:
    """An array, or a tensor of any device, as NumPy's; no copy where none is needed."""
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def kind_of(array: NDArray[Any]) -> str:
    """Type and shape, for messages."""
    return f"{array.dtype} of shape {list(array.shape)}"


def stored_pictures(pictures: Array, where: str) -> NDArray[Any]:
    """Pictures as a decoder gives them: [K, H, W, 3] uint8 or uint16. Floats become codes of 16 bits.

    Args:
        pictures: [K, H, W] or [K, H, W, 3]. where: what messages call them.

    Raises:
        PolarguideError: the pictures have another shape or type, or floats outside 0 to 1.
    """
    values = as_numpy(pictures)
    require(
        0 not in values.shape and (values.ndim == 3 or (values.ndim == 4 and values.shape[3] in (1, 3))),
        where,
        expected=_PICTURES,
        found=kind_of(values),
        remedy="Put the angles first and the colors last.",
    )
    if values.ndim == 3:
        values = values[..., None]
    if np.issubdtype(values.dtype, np.floating):
        values = codes_of_floats(values, where)
    elif values.dtype not in (np.uint8, np.uint16):
        raise PolarguideError(
            where,
            expected=_PICTURES,
            found=kind_of(values),
            remedy="Convert them, for example astype(np.uint16).",
        )
    return np.repeat(values, 3, axis=3) if values.shape[3] == 1 else values


def codes_of_floats(values: NDArray[Any], where: str) -> NDArray[np.uint16]:
    """Linear floats as codes of 16 bits, 1 at full scale.

    Raises:
        PolarguideError: one is outside 0 to 1, or not a number.
    """
    low = float(values.min())
    high = float(values.max())
    require(
        low >= 0 and high <= 1,
        where,
        expected="floats from 0 to 1, linear, 1 at full scale",
        found=f"{low:g} to {high:g}",
        remedy="Divide by the value at full scale, and clip negative noise to 0.",
    )
    return np.rint(values.astype(np.float64) * FULL_CODE).astype(np.uint16)


def exposures_of(angles: Sequence[Angle], count: int, where: str) -> tuple[Exposure, ...]:
    """The exposures of ``count`` pictures at some angles, in their order.

    Raises:
        PolarguideError: there are more or fewer angles, or one is neither a number nor a word.
    """
    require(
        len(angles) == count,
        where,
        expected=f"{count} angles, one a picture",
        found=str(len(angles)),
        remedy="Name an angle in degrees, unknown or none for each picture.",
    )
    return tuple(_exposure(angle, where) for angle in angles)


def _exposure(angle: Angle, where: str) -> Exposure:
    if angle in ("unknown", "none"):
        return Exposure(filtered=angle == "unknown")
    try:
        degrees = float(angle)
    except (TypeError, ValueError):
        degrees = np.nan
    require(
        abs(degrees) <= LARGEST,
        where,
        expected=f"angles in degrees up to {LARGEST:g}, unknown or none",
        found=repr(angle),
        remedy="Give the angle in degrees, or None where it is not known.",
    )
    return Exposure(normalized(degrees))


def in_order(
    stored: NDArray[Any], exposures: tuple[Exposure, ...]
) -> tuple[NDArray[Any], tuple[Exposure, ...]]:
    """Pictures at 0, 45, 90 and 135 degrees in this order, in which a polarization camera's are; others as they are."""
    if exposures != FOUR and len(exposures) == len(FOUR) and {*exposures} == {*FOUR}:
        return stored[[exposures.index(each) for each in FOUR]], FOUR
    return stored, exposures


def by_name(
    values: Mapping[str, Any] | Sequence[Any] | Array, what: str, names: Sequence[str] = ()
) -> dict[str, Any]:
    """Values by view: of a mapping, or in the order of ``names``; without those, views are called v000, v001, ...

    Raises:
        PolarguideError: there are others than of ``names``, or none.
    """
    if isinstance(values, Mapping):
        found = {str(name): value for name, value in values.items()}
    else:
        labels = names if names and len(names) == len(values) else [f"v{k:03d}" for k in range(len(values))]
        found = dict(zip(labels, values, strict=True))
    if not found or (names and sorted(found) != sorted(names)):
        others = len(found) == len(names) > 0
        raise PolarguideError(
            what,
            expected=f"one for each of the {len(names)} views" if names else "at least one view",
            found=f"others: {', '.join(sorted(found)[:4])}" if others else str(len(found)),
            remedy="Give them in the order of the pictures, or by the names of the views.",
        )
    return found


T = TypeVar("T")


class Files:
    """Reads files and records the SHA-256 of each.

    Args:
        known: SHA-256 that the files have to have; None: any.
    """

    def __init__(self, known: Mapping[Path, str] | None = None) -> None:
        self.digests: dict[Path, str] = {}
        self._known = known

    def read(self, path: Path, largest: int = LARGEST_FILE) -> bytes:
        """The bytes of a file of up to ``largest``."""
        return self._noted(path, read_file(path, largest=largest))

    def picture(self, path: Path) -> bytes:
        """The bytes of a picture file."""
        return self._noted(path, read_picture(path))

    def _noted(self, path: Path, data: bytes) -> bytes:
        digest = self.digests[path] = hashlib.sha256(data).hexdigest()
        require(
            self._known is None or self._known[path] == digest,
            path,
            expected="the file that was there as the scene was read",
            found="other contents",
            remedy="Leave a scene alone while it is worked on; then start again.",
        )
        return data

    def digest(self, root: Path) -> str:
        """SHA-256 over names in ``root`` and contents of all files that were read."""
        lines = sorted(
            f"{canonical(path.relative_to(root).as_posix())} {digest}\n"
            for path, digest in self.digests.items()
        )
        return hashlib.sha256("".join(lines).encode()).hexdigest()

    def read_if_there(self, path: Path, otherwise: T) -> bytes | T:
        """The bytes of a JSON file; ``otherwise`` if there is no such file."""
        there = os.path.lexists(path)  # a link to nowhere is no absence
        return self.read(path, LARGEST_RECORD) if there else otherwise


@dataclass(frozen=True, eq=False)
class ViewData:
    """The pixels of one view, before the full scale of the whole capture is known.

    Attributes:
        name, codes, invalid, mask, materials, ground_truth, exposures: as in ``View``, with arrays instead of tensors.
        material_numbers: that the picture of materials has as stored.
        size: width and height of the pictures as stored.
        peak: largest stored value over angles, channels and the pixels of a box, [H, W].
        black: whether some pixel of the box is 0 in all angles and channels, [H, W].
        histogram: ``checks.top_histogram`` of the stored values.
        digests: SHA-256 of every file read.
        samples: at the points that the view observes; None where they are not compared.
    """

    name: str
    size: tuple[int, int]
    codes: NDArray[np.uint16]
    peak: NDArray[Any]
    black: NDArray[np.bool_]
    histogram: NDArray[np.int64]
    invalid: NDArray[np.bool_]
    mask: NDArray[np.bool_] | None
    ground_truth: GroundTruth | None
    digests: dict[Path, str]
    exposures: tuple[Exposure, ...]
    materials: NDArray[np.uint8] | None = None
    material_numbers: frozenset[int] = frozenset()
    samples: PointSamples | None = None

    def saturated(self, scale: int | None) -> NDArray[np.bool_]:
        """``View.saturated``, given the stored value at which the capture saturates (None: it does not)."""
        return self.black if scale is None else np.asarray(self.black | (self.peak >= scale))

    def view(
        self,
        camera: Camera,
        scale: int | None,
        mount: Mount = "sensor",
        files: ViewFiles | None = None,
        gains: tuple[float, float, float] = EVEN,
    ) -> View:
        """The view with its camera and its saturated pixels.

        Args:
            camera: camera of the view. scale: as for ``saturated``. mount: where the polarizer was.
            files: load codes and ground truth when they are read; None: those that are here stay in memory.
            gains: as in ``View``.
        """
        invalid = torch.from_numpy(self.invalid)
        saturated = torch.from_numpy(self.saturated(scale))
        return View(
            name=self.name,
            camera=camera,
            pictures=torch.from_numpy(self.codes) if files is None else files.codes(self.name),
            invalid=invalid if files is None else _compact(invalid),
            saturated=saturated if files is None else _compact(saturated),
            mask=None if self.mask is None else torch.from_numpy(self.mask),
            truth=self.ground_truth if files is None else files.ground_truth(self.name, self.size),
            exposures=self.exposures,
            mount=mount,
            materials=None if self.materials is None else torch.from_numpy(self.materials),
            gains=gains,
        )


class ViewFiles:
    """Loaders of what the files of views hold.

    Args:
        layout: the files. factor, transfer: as for ``read_view``. digests: SHA-256 of the files as they were read.
    """

    def __init__(self, layout: Layout, factor: int, transfer: str, digests: Mapping[Path, str]) -> None:
        self._layout = layout
        self._factor = factor
        self._transfer = transfer
        self._digests = digests
        self._pictures = Latest()
        self._truths = Latest()

    def codes(self, name: str) -> Loader[Tensor]:
        """Loader of ``View.codes``, which raises an error if a file was changed or deleted."""
        return Loader(functools.partial(self._read_codes, name), self._pictures)

    def ground_truth(self, name: str, size: tuple[int, int]) -> Loader[GroundTruth | None] | None:
        """Loader of ``View.ground_truth``, or None if the scene has no ground truth of this view.

        The loader raises an error if the file was changed or deleted after the scene was opened.

        Args:
            name: view name.
            size: width and height of the stored pictures.
        """
        path = self._layout.ground_truth.get(name)
        return None if path is None else Loader(functools.partial(self._read_truth, path, size), self._truths)

    def _read_codes(self, name: str) -> Tensor:
        raw = _read_pictures(Files(self._digests), self._layout.files(name))
        return torch.from_numpy(_codes(raw, self._transfer, self._factor))

    def _read_truth(self, path: Path, size: tuple[int, int]) -> GroundTruth | None:
        data = Files(self._digests).read(path)
        return read_ground_truth(path, data, size=(size[1], size[0]), factor=self._factor)


def _compact(mask: Tensor) -> Tensor:
    """The mask, without memory where nothing is set."""
    return mask if bool(mask.any()) else torch.zeros((), dtype=torch.bool).expand(mask.shape)


_BESIDE: dict[str, Callable[[Path, bytes], NDArray[Any]]] = {
    "invalid": functools.partial(decode_mask, any_value=True),
    "mask": functools.partial(decode_mask, any_value=False),
    "materials": decode_materials,
}
"""Decoders of the pictures beside those of a view, by their kind."""


def read_view(
    layout: Layout, name: str, *, factor: int, transfer: str, points: ComparedPoints | None = None
) -> ViewData:
    """Read all files of one view, averaged over boxes of ``factor`` x ``factor`` pixels.

    Args:
        layout: the files. name: of the view. transfer: how the pictures are encoded.
        points: what its pictures are sampled at, in full size.

    Raises:
        PolarguideError: a file is damaged, or the sizes of the files differ.
    """
    files = Files()
    raw = _read_pictures(files, layout.files(name))
    height, width = raw[0].shape[:2]
    require_factor(factor, height, width)
    beside = {
        kind: _read_beside(files, folder, name, (height, width), _BESIDE[kind])
        for kind, folder in (
            ("invalid", layout.invalid),
            ("mask", layout.masks),
            ("materials", layout.materials),
        )
    }
    ground_truth = None
    if name in layout.ground_truth:
        path = layout.ground_truth[name]
        ground_truth = read_ground_truth(path, files.read(path), size=(height, width), factor=factor)
    data = view_data(
        name,
        raw,
        layout.exposures(name),
        factor=factor,
        transfer=transfer,
        **beside,
        ground_truth=ground_truth,
        digests=files.digests,
    )
    if points is None:
        return data
    return replace(data, samples=points.samples(name, raw, beside["invalid"], transfer))


def require_factor(factor: int, height: int, width: int) -> None:
    """Check that boxes of ``factor`` x ``factor`` pixels fit into a picture.

    Raises:
        PolarguideError: the boxes do not fit.
    """
    require(
        factor <= min(height, width),
        "downscale",
        expected=f"at most {min(height, width)} for pictures of {width}x{height}",
        found=str(factor),
        remedy="Choose a smaller factor.",
    )


def view_data(
    name: str,
    raw: Sequence[NDArray[Any]],
    exposures: tuple[Exposure, ...],
    *,
    factor: int,
    transfer: str,
    invalid: NDArray[np.bool_] | None = None,
    mask: NDArray[np.bool_] | None = None,
    materials: NDArray[np.uint8] | None = None,
    ground_truth: GroundTruth | None = None,
    digests: Mapping[Path, str] | None = None,
) -> ViewData:
    """A view of its stored pictures [H, W, 3], averaged over boxes of ``factor`` x ``factor`` pixels.

    Args:
        name, exposures, ground_truth, digests: as in ``ViewData``; the ground truth is averaged already.
        raw: uint8 or uint16, all of one shape and type. transfer: how they are encoded.
        invalid, mask, materials: [H, W] of the stored pictures.
    """
    height, width = raw[0].shape[:2]
    peak = functools.reduce(np.maximum, [pixels[..., channel] for pixels in raw for channel in range(3)])
    return ViewData(
        name=name,
        size=(width, height),
        codes=_codes(raw, transfer, factor),
        peak=boxes.maximum(peak, factor),
        black=boxes.maximum(np.asarray(peak == 0), factor),
        histogram=np.sum([checks.top_histogram(pixels) for pixels in raw], axis=0),
        invalid=boxes.maximum(np.zeros((height, width), bool) if invalid is None else invalid, factor),
        mask=None if mask is None else boxes.every(mask, factor),
        ground_truth=ground_truth,
        digests=dict(digests or {}),
        exposures=exposures,
        material_numbers=frozenset() if materials is None else frozenset(np.unique(materials).tolist()),
        materials=None
        if materials is None
        else boxes.agreed(materials.astype(np.int32), factor).astype(np.uint8),
    )


def check_materials(layout: Layout, views: Iterable[ViewData], indices: Mapping[int, float]) -> None:
    """Refuse numbers of materials that nobody explains.

    Raises:
        PolarguideError: a picture has one that ``indices`` have not.
    """
    for view in views:
        if unknown := view.material_numbers - {0, 1, 2, *indices}:
            raise PolarguideError(
                layout.materials[view.name],
                expected=f"the numbers {', '.join(map(str, (0, 1, 2, *sorted(indices))))}",
                found=str(min(unknown)),
                remedy=MATERIAL_REMEDY,
            )


def _codes(raw: Sequence[NDArray[Any]], transfer: str, factor: int) -> NDArray[np.uint16]:
    """Linear codes of stored pictures, averaged over boxes."""
    return np.stack([boxes.mean_codes(linear_codes(pixels, transfer), factor) for pixels in raw])


def _read_pictures(files: Files, paths: list[Path]) -> list[NDArray[Any]]:
    """The stored pictures of a view, [H, W, 3] each, of one size and one depth."""
    pictures: list[NDArray[Any]] = []
    for path in paths:
        data = files.picture(path)
        if pictures:
            require_size(path, data, pictures[0].shape[:2], like=paths[0])
        picture = decode_picture(path, data)
        if pictures:
            require_alike(path, picture, paths[0], pictures[0])
        pictures.append(picture)
    return pictures


def require_size(path: Path, data: bytes, size: Sequence[int], *, like: Path | None = None) -> None:
    """Reject a picture whose header states another size, before memory is allocated to decode it.

    Args:
        path, data: the file and its bytes.
        size: expected height and width. like: the file that has this size, for the message.

    Raises:
        PolarguideError: the header states another size.
    """
    stated = declared_size(data)
    if stated is not None and stated != (size[1], size[0]):
        alike = "the size of the pictures" if like is None else f"the size of {'/'.join(like.parts[-2:])}"
        raise PolarguideError(
            path,
            expected=f"{alike}, {size[1]}x{size[0]}",
            found=f"{stated[0]}x{stated[1]}",
            remedy="Make it anew for these pictures."
            if like is None
            else "Export all pictures of a view with the same settings.",
        )


def require_alike(path: Path, picture: NDArray[Any], first_path: Path, first: NDArray[Any]) -> None:
    """Check that a picture has the size and depth of the first one of its view.

    Raises:
        PolarguideError: size or depth differs.
    """
    if (picture.shape, picture.dtype) != (first.shape, first.dtype):
        own, expected = (
            f"{p.shape[1]}x{p.shape[0]} with {p.dtype.itemsize * 8} bits" for p in (picture, first)
        )
        raise PolarguideError(
            path,
            expected=f"{expected} like {'/'.join(first_path.parts[-2:])}",
            found=own,
            remedy="Export all pictures of a view with the same settings.",
        )


def _read_beside(
    files: Files,
    folder: Mapping[str, Path],
    name: str,
    size: Sequence[int],
    decode: Callable[[Path, bytes], NDArray[Any]],
) -> NDArray[Any] | None:
    """The picture of a view in a folder beside its pictures, which has their size; None where there is none."""
    if name not in folder:
        return None
    path = folder[name]
    data = files.picture(path)
    require_size(path, data, size)
    return decode(path, data)


@dataclass(frozen=True, eq=False)
class StoredViews:
    """The views of a capture as read, with a pose or without.

    Attributes:
        data: the views, sorted by name.
        cameras: cameras of each view at the size of its averaged pictures; None where the model has no pose.
        measures: ``checks.measure`` of each view.
        largest_value: the largest value that the files can store, 255 or 65535.
        full_scale: the stored value at which the capture saturates; None if nothing is saturated.
        exposures: those of each view by points in common; None where they are not compared.
    """

    data: tuple[ViewData, ...]
    cameras: tuple[Camera | None, ...]
    measures: tuple[checks.Measures, ...]
    largest_value: int
    full_scale: int | None
    exposures: PointExposures | None = None

    @classmethod
    def of(
        cls,
        data: Sequence[ViewData],
        cameras: Sequence[Camera | None],
        points: ComparedPoints | None = None,
    ) -> StoredViews:
        """Measure views, find where they saturate, and compare their exposures at points.

        Raises:
            PolarguideError: the views differ in bit depth.
        """
        first = {item.peak.dtype.itemsize: item.name for item in reversed(data)}
        if len(first) > 1:
            raise PolarguideError(
                "pictures",
                expected="the same bit depth in all views",
                found=f"8 bits in view {first[1]} and 16 bits in view {first[2]}",
                remedy="Save all pictures with the same bit depth.",
            )
        largest_value = int(np.iinfo(data[0].peak.dtype).max)
        scale = checks.full_scale(np.sum([item.histogram for item in data], axis=0), largest_value)
        measures = [
            checks.measure(item.codes, ~(item.invalid | item.saturated(scale)), four=item.exposures == FOUR)
            for item in data
        ]
        samples = {item.name: item.samples for item in data}
        exposures = None if points is None else points.exposures(samples, scale)
        return cls(tuple(data), tuple(cameras), tuple(measures), largest_value, scale, exposures)

    def picture_warnings(self, transfer: str) -> list[str]:
        """Warnings about the exposure, encoding and order of the pictures."""
        names = [item.name for item in self.data]
        scale = self.full_scale
        blown = [0.0 if scale is None else float((item.peak >= scale).mean()) for item in self.data]
        largest = max(int(item.peak.max()) for item in self.data)
        warnings = checks.exposure_warnings(names, self.measures, blown, largest, self.largest_value)
        return warnings + checks.polarization_warnings(names, self.measures, transfer)
