"""Pictures that come as arrays: checked, and brought to what a decoder gives of files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from polarguide.capture.exposures import FOUR, LARGEST, Angle, Exposure, normalized
from polarguide.capture.view import FULL_CODE
from polarguide.core.errors import PolarguideError

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
    if values.ndim not in (3, 4) or 0 in values.shape or (values.ndim == 4 and values.shape[3] not in (1, 3)):
        raise PolarguideError(
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
    if not (low >= 0 and high <= 1):
        raise PolarguideError(
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
    if len(angles) != count:
        raise PolarguideError(
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
    if not abs(degrees) <= LARGEST:
        raise PolarguideError(
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
