"""Read the pictures and masks of views from files, and check pictures in arrays."""

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
from polarguide.capture.formats.pictures import (
    MATERIAL_REMEDY,
    codes_of_floats,
    decode_mask,
    decode_materials,
    decode_picture,
    linear_codes,
    require_full_scale,
)
from polarguide.capture.formats.stored import declared_size, read_picture, require_alike, require_size
from polarguide.capture.layout import CaptureFiles
from polarguide.capture.metadata import GroundTruth, merges_exposures, read_ground_truth
from polarguide.capture.point_exposures import ComparedPoints, PointExposures, PointSamples
from polarguide.capture.view import EVEN, FULL_CODE, Latest, Loader, View
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import LARGEST_FILE, read_file
from polarguide.core.records import LARGEST_RECORD
from polarguide.core.text import canonical
from polarguide.geometry.camera import Camera
from polarguide.optics import Mount

Array = NDArray[Any] | Tensor
"""NumPy array, or torch tensor on any device."""
_PICTURES = "pictures [K, H, W] or [K, H, W, 3] of uint8, uint16, or linear floats from 0 to 1"


def as_numpy(values: ArrayLike | Tensor) -> NDArray[Any]:
    """Convert an array or a tensor to a NumPy array, without a copy if possible."""
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def kind_of(array: NDArray[Any]) -> str:
    """Describe the type and shape of an array for messages."""
    return f"{array.dtype} of shape {list(array.shape)}"


def stored_pictures(pictures: Array, where: str) -> NDArray[Any]:
    """Convert the pictures of a view to uint8 or uint16, [K, H, W, 3]. Floats are converted to 16-bit codes.

    Args:
        pictures: [K, H, W] or [K, H, W, 3].
        where: name of the pictures for messages.

    Raises:
        PolarguideError: the shape or type of the pictures is invalid, or a float is not in [0, 1].
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
        require(
            values.min() >= 0 and values.max() <= 1,
            where,
            expected="floats from 0 to 1, linear, 1 at full scale",
            found=f"{values.min():g} to {values.max():g}",
            remedy="Divide by the value at full scale, and clip negative noise to 0.",
        )
        values = np.rint(values.astype(np.float64) * FULL_CODE).astype(np.uint16)
    elif values.dtype not in (np.uint8, np.uint16):
        raise PolarguideError(
            where,
            expected=_PICTURES,
            found=kind_of(values),
            remedy="Convert them, for example astype(np.uint16).",
        )
    return np.repeat(values, 3, axis=3) if values.shape[3] == 1 else values


def exposures_of(angles: Sequence[Angle], count: int, where: str) -> tuple[Exposure, ...]:
    """Return exposures with the given angles and gain 1.

    Raises:
        PolarguideError: the number of angles is not ``count``, or an angle is invalid.
    """
    require(
        len(angles) == count,
        where,
        expected=f"{count} angles, one per picture",
        found=str(len(angles)),
        remedy="Specify an angle in degrees, unknown or none for each picture.",
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
        remedy="Specify the angle in degrees, or unknown.",
    )
    return Exposure(normalized(degrees))


def in_order(
    stored: NDArray[Any], exposures: tuple[Exposure, ...]
) -> tuple[NDArray[Any], tuple[Exposure, ...]]:
    """Sort four pictures at 0, 45, 90 and 135 degrees by angle. Return pictures at other angles unchanged.

    Returns:
        The pictures, and their exposures in the same order.
    """
    if exposures != FOUR and len(exposures) == len(FOUR) and {*exposures} == {*FOUR}:
        return stored[[exposures.index(each) for each in FOUR]], FOUR
    return stored, exposures


def by_name(
    values: Mapping[str, Any] | Sequence[Any] | Array, kind: str, names: Sequence[str] = ()
) -> dict[str, Any]:
    """Return a mapping from view names to values.

    Args:
        values: a mapping by view name, or a sequence in the order of ``names``.
        kind: name of the values for messages, such as "cameras".
        names: required view names. By default, the values of a sequence get the names v000, v001, ...

    Raises:
        PolarguideError: the names differ from ``names``, or there are no values.
    """
    if isinstance(values, Mapping):
        result = {str(name): value for name, value in values.items()}
    else:
        labels = names if names and len(names) == len(values) else [f"v{k:03d}" for k in range(len(values))]
        result = dict(zip(labels, values, strict=True))
    if not result or (names and sorted(result) != sorted(names)):
        renamed = len(result) == len(names) > 0
        raise PolarguideError(
            kind,
            expected=f"one for each of the {len(names)} views" if names else "at least one view",
            found=f"others: {', '.join(sorted(result)[:4])}" if renamed else str(len(result)),
            remedy="Pass them in the order of the pictures, or by the names of the views.",
        )
    return result


T = TypeVar("T")


class Files:
    """Reader of files that records the SHA-256 of each file, to detect later changes.

    Args:
        known: SHA-256 that each file must have. By default, files are not compared.
    """

    def __init__(self, known: Mapping[Path, str] | None = None) -> None:
        self.digests: dict[Path, str] = {}
        self._known = known

    def read(self, path: Path, largest: int = LARGEST_FILE) -> bytes:
        """Read a file of up to ``largest`` bytes."""
        return self._recorded(path, read_file(path, largest=largest))

    def picture(self, path: Path) -> bytes:
        """Read a picture file."""
        return self._recorded(path, read_picture(path))

    def _recorded(self, path: Path, data: bytes) -> bytes:
        digest = self.digests[path] = hashlib.sha256(data).hexdigest()
        require(
            self._known is None or self._known[path] == digest,
            path,
            expected="the same file as when the scene was read",
            found="other contents",
            remedy="Do not change a scene while it is in use; start again.",
        )
        return data

    def digest(self, root: Path) -> str:
        """Return one SHA-256 of all files that were read, computed from their names in ``root`` and their contents."""
        lines = sorted(
            f"{canonical(path.relative_to(root).as_posix())} {digest}\n"
            for path, digest in self.digests.items()
        )
        return hashlib.sha256("".join(lines).encode()).hexdigest()

    def read_if_there(self, path: Path, default: T) -> bytes | T:
        """Read a JSON file, or return ``default`` if it does not exist. A broken link causes an error."""
        return self.read(path, LARGEST_RECORD) if os.path.lexists(path) else default


@dataclass(frozen=True, eq=False)
class ViewData:
    """Pixels of a view as read from its files.

    The saturated pixels are determined later, because the saturation value depends on all views of the capture.

    Attributes:
        name: name of the view.
        codes: linear codes of the pictures, see ``View.codes``.
        invalid: mask of unusable pixels, see ``View.invalid``.
        mask: foreground mask, see ``View.mask``.
        materials: labels of surfaces, see ``View.materials``.
        material_numbers: labels that occur in the file of materials.
        ground_truth: ground truth, see ``View.ground_truth``.
        size: width and height of the stored pictures.
        peak: largest stored value in each averaged box, over all angles and channels, [H, W]. Radiance is in units of
            16-bit codes.
        black: mask of the averaged boxes with a pixel that is 0 at all angles and in all channels, [H, W].
        histogram: result of ``checks.top_histogram`` for the stored values.
        digests: SHA-256 of each file.
        exposures: polarizer angle and gain of each picture.
        samples: intensities at 3D points, by which exposures of views are compared; None if they are not compared.
    """

    name: str
    size: tuple[int, int]
    codes: NDArray[Any]
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
        """Return the mask ``View.saturated``.

        Args:
            scale: stored value at which pixels are saturated; None if no pixel of the capture is saturated.
        """
        return (
            self.black if scale is None or self.is_radiance else np.asarray(self.black | (self.peak >= scale))
        )

    @property
    def is_radiance(self) -> bool:
        """True if the pictures are floating-point radiance, whose values above full scale are not saturated."""
        return self.peak.dtype == np.float32

    @property
    def largest_value(self) -> int:
        """Largest value that the files can store, 255 or 65535. Radiance counts as 16-bit files."""
        return FULL_CODE if self.is_radiance else int(np.iinfo(self.peak.dtype).max)

    def view(
        self,
        camera: Camera,
        scale: int | None,
        mount: Mount = "sensor",
        files: ViewFiles | None = None,
        gains: tuple[float, float, float] = EVEN,
    ) -> View:
        """Create the view.

        Args:
            camera: camera of the view.
            scale: stored value at which pixels are saturated, see ``saturated``.
            mount: place of the polarizer.
            files: loaders of pictures and ground truth. By default, the view keeps both in memory.
            gains: exposure of R, G and B relative to the other views, see ``View.gains``.
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
    """Factory of loaders, with which views read their pictures and ground truth when they are used.

    Args:
        layout: files of the capture.
        factor: side of the pixel boxes that are averaged.
        transfer: encoding of the pictures.
        digests: SHA-256 of the files when the scene was opened. A loader refuses a file that has changed since.
    """

    def __init__(self, layout: CaptureFiles, factor: int, transfer: str, digests: Mapping[Path, str]) -> None:
        self._layout = layout
        self._factor = factor
        self._transfer = transfer
        self._digests = digests
        self._pictures = Latest()
        self._truths = Latest()

    def codes(self, name: str) -> Loader[Tensor]:
        """Return a loader of the pictures of a view.

        The loader raises an error if a file was changed or deleted after the scene was opened.
        """
        return Loader(functools.partial(self._read_codes, name), self._pictures)

    def ground_truth(self, name: str, size: tuple[int, int]) -> Loader[GroundTruth | None] | None:
        """Return a loader of the ground truth of a view, or None if the view has no ground truth.

        The loader raises an error if the file was changed or deleted after the scene was opened.

        Args:
            name: name of the view.
            size: width and height of the stored pictures.
        """
        path = self._layout.ground_truth.get(name)
        return None if path is None else Loader(functools.partial(self._read_truth, path, size), self._truths)

    def _read_codes(self, name: str) -> Tensor:
        return torch.from_numpy(
            _codes(
                _read_pictures(Files(self._digests), self._layout, name, self._transfer),
                self._transfer,
                self._factor,
            )
        )

    def _read_truth(self, path: Path, size: tuple[int, int]) -> GroundTruth | None:
        return read_ground_truth(
            path, Files(self._digests).read(path), size=(size[1], size[0]), factor=self._factor
        )


def _compact(mask: Tensor) -> Tensor:
    """Convert a mask to a tensor. A mask without marked pixels takes almost no memory."""
    return mask if bool(mask.any()) else torch.zeros((), dtype=torch.bool).expand(mask.shape)


_DECODERS: dict[str, Callable[[Path, bytes], NDArray[Any]]] = {
    "invalid": functools.partial(decode_mask, any_value=True),
    "mask": functools.partial(decode_mask, any_value=False),
    "materials": decode_materials,
}
"""Function that decodes each kind of optional picture of a view, such as its mask."""


def read_view(
    layout: CaptureFiles, name: str, *, factor: int, transfer: str, points: ComparedPoints | None = None
) -> ViewData:
    """Read all files of a view, averaged over boxes of ``factor`` x ``factor`` pixels.

    Args:
        layout: files of the capture.
        name: name of the view.
        factor: side of the boxes.
        transfer: encoding of the pictures.
        points: points at which the full-size pictures are sampled.

    Raises:
        PolarguideError: a file is damaged, or the sizes of the files differ.
    """
    files = Files()
    raw = _read_pictures(files, layout, name, transfer)
    height, width = raw[0].shape[:2]
    require_factor(factor, height, width)
    optional = {
        kind: _read_optional(files, folder, name, (height, width), _DECODERS[kind])
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
        **optional,
        ground_truth=ground_truth,
        digests=files.digests,
    )
    if points is None:
        return data
    return replace(data, samples=points.samples(name, raw, optional["invalid"], transfer))


def require_factor(factor: int, height: int, width: int) -> None:
    """Check that a box of ``factor`` x ``factor`` pixels fits into a picture.

    Raises:
        PolarguideError: the picture is smaller than the box.
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
    """Create the data of a view from stored pictures and masks, averaged over boxes of ``factor`` x ``factor`` pixels.

    Args:
        name: name of the view.
        raw: stored pictures, [H, W, 3] each, all uint8, all uint16, or all float32 in units of full scale.
        exposures: polarizer angle and gain of each picture.
        factor: side of the boxes.
        transfer: encoding of the pictures.
        invalid: mask of unusable pixels at full size, [H, W], or None.
        mask: foreground mask at full size, [H, W], or None.
        materials: labels of surfaces at full size, [H, W], or None.
        ground_truth: ground truth after averaging, or None.
        digests: SHA-256 of each file.
    """
    height, width = raw[0].shape[:2]
    peak = functools.reduce(np.maximum, [pixels[..., channel] for pixels in raw for channel in range(3)])
    if peak.dtype == np.float32:
        peak = linear_codes(peak, transfer)
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


def check_materials(layout: CaptureFiles, views: Iterable[ViewData], indices: Mapping[int, float]) -> None:
    """Refuse labels of dielectrics without a refractive index in ``scene.json``.

    Raises:
        PolarguideError: a picture of materials has a label that ``indices`` lacks.
    """
    for view in views:
        if unknown := view.material_numbers - {0, 1, 2, *indices}:
            raise PolarguideError(
                layout.materials[view.name],
                expected=f"the numbers {', '.join(map(str, (0, 1, 2, *sorted(indices))))}",
                found=str(min(unknown)),
                remedy=MATERIAL_REMEDY,
            )


def _codes(raw: Sequence[NDArray[Any]], transfer: str, factor: int) -> NDArray[Any]:
    """Convert stored pictures to linear codes, and average them over boxes of ``factor`` x ``factor`` pixels."""
    return np.stack([boxes.mean_codes(linear_codes(pixels, transfer), factor) for pixels in raw])


def _read_pictures(files: Files, layout: CaptureFiles, name: str, transfer: str) -> list[NDArray[Any]]:
    """Read the pictures of a view, [H, W, 3] each, and check that they have the same size and bit depth.

    Floating-point pictures are linear radiance if one of them has values above 1. Otherwise they become 16-bit codes,
    whose largest value marks saturated pixels. The median may exceed 1 only if ``prepare`` merged exposures.
    """
    paths = layout.files(name)
    contents = [files.picture(path) for path in paths]
    size = declared_size(contents[0])
    for path, data in zip(paths, contents, strict=True):
        if size is not None:
            require_size(path, data, size[::-1], like=paths[0])
    pictures = [
        decode_picture(path, data, keep_floats=True) for path, data in zip(paths, contents, strict=True)
    ]
    for path, picture in zip(paths, pictures, strict=True):
        require_alike(path, picture, paths[0], pictures[0])
    if pictures[0].dtype != np.float32:
        return pictures
    if all(picture.max() <= 1 for picture in pictures):
        return [codes_of_floats(picture) for picture in pictures]
    scene = layout.root / "scene.json"
    if not (scene.exists() and merges_exposures(scene, read_file(scene, largest=LARGEST_RECORD))):
        for path, picture in zip(paths, pictures, strict=True):
            require_full_scale(path, picture)
    require(
        transfer == "linear",
        paths[0],
        expected="transfer linear for pictures with values above full scale",
        found=transfer,
        remedy="Remove the option.",
    )
    return pictures


def _read_optional(
    files: Files,
    folder: Mapping[str, Path],
    name: str,
    size: Sequence[int],
    decode: Callable[[Path, bytes], NDArray[Any]],
) -> NDArray[Any] | None:
    """Read an optional picture of a view, such as a mask. Return None if the file does not exist.

    The picture must have height and width ``size``.
    """
    if name not in folder:
        return None
    path = folder[name]
    data = files.picture(path)
    require_size(path, data, size)
    return decode(path, data)


@dataclass(frozen=True, eq=False)
class StoredViews:
    """Views of a capture as read from its files, with statistics of all views.

    Attributes:
        data: pixels of the views, sorted by name.
        cameras: camera of each view at the size of its averaged pictures; None for a view without a pose.
        measures: result of ``checks.measure`` for each view.
        largest_value: largest value that the files can store, 255 or 65535.
        full_scale: stored value at which pixels are saturated; None if no pixel is saturated.
        exposures: relative exposures of the views, measured at common 3D points; None if they are not compared.
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
        """Create the statistics of views: brightness, saturation, and exposures at common 3D points.

        Raises:
            PolarguideError: the views differ in bit depth.
        """
        first = {item.largest_value: item.name for item in reversed(data)}
        if len(first) > 1:
            raise PolarguideError(
                "pictures",
                expected="the same bit depth in all views",
                found=f"8 bits in view {first[255]} and 16 bits in view {first[FULL_CODE]}",
                remedy="Save all pictures with the same bit depth.",
            )
        largest_value = data[0].largest_value
        scale = checks.full_scale(np.sum([item.histogram for item in data], axis=0), largest_value)
        measures = [
            checks.measure(item.codes, ~(item.invalid | item.saturated(scale)), four=item.exposures == FOUR)
            for item in data
        ]
        exposures = (
            None if points is None else points.exposures({item.name: item.samples for item in data}, scale)
        )
        return cls(tuple(data), tuple(cameras), tuple(measures), largest_value, scale, exposures)

    def picture_warnings(self, transfer: str) -> list[str]:
        """Return warnings about the exposure, encoding and order of the pictures."""
        names = [item.name for item in self.data]
        scale = self.full_scale
        blown = [
            0.0 if scale is None or item.is_radiance else float((item.peak >= scale).mean())
            for item in self.data
        ]
        warnings = checks.exposure_warnings(
            names, self.measures, blown, max(int(item.peak.max()) for item in self.data), self.largest_value
        )
        return warnings + checks.polarization_warnings(names, self.measures, transfer)
