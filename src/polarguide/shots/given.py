"""Shots in memory: mosaics and pictures as arrays, in place of files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from polarguide.capture.exposures import Angle, normalized
from polarguide.capture.given_arrays import Array, as_numpy, exposures_of, kind_of, stored_pictures
from polarguide.capture.view import ANGLES
from polarguide.core.errors import PolarguideError
from polarguide.shots.exposures import ExposureSet
from polarguide.shots.options import ShotOptions
from polarguide.shots.sets import require_determined

NAME = "array"
"""What a shot in memory is called where nothing else is said."""
_MOSAIC = "a mosaic [H, W] of uint8 or uint16, as --sensor (ShotOptions.sensor) says"


def array_shot(
    array: Array, options: ShotOptions, angles: Sequence[Angle] = ANGLES, name: str = NAME
) -> ExposureSet:
    """A shot in memory.

    Args:
        array: with a sensor, a raw mosaic [H, W] of uint8 or uint16; else pictures through a filter, [K, H, W] gray or
            [K, H, W, 3] RGB: uint8 or uint16 as stored, or linear floats from 0 to 1. It is not written to.
        options: how it is read. name: of the shot.
        angles: of the K pictures in degrees, counter-clockwise as displayed.

    Raises:
        PolarguideError: shape, type or angles do not fit; its ``where`` is the name.
    """
    values = as_numpy(array)
    if options.sensor is not None:
        return ExposureSet(name, "mosaic", {}, stored=_mosaic(values, options, name))
    if values.ndim == 2:
        remedy = (
            "Name the sensor of a mosaic: ShotOptions(sensor=...); stack the pictures of a filter, [K, H, W]."
        )
        expected = "pictures [K, H, W] or [K, H, W, 3] through a filter, or a sensor of the mosaic"
        raise PolarguideError(name, expected=expected, found=kind_of(values), remedy=remedy)
    if np.issubdtype(values.dtype, np.floating) and options.transfer == "srgb":
        raise PolarguideError(
            name,
            expected="whole numbers, which srgb decodes",
            found=kind_of(values),
            remedy="Floats are linear.",
        )
    stored = stored_pictures(values, name)
    exposures_of(angles, len(stored), f"{name} (angles)")
    known = [angle if isinstance(angle, str) else normalized(float(angle)) for angle in angles]
    if sorted(map(str, known)) == sorted(str(float(angle)) for angle in ANGLES):
        order = [known.index(float(angle)) for angle in ANGLES]
        return ExposureSet(name, "filter", {}, stored=stored[order], angles=tuple(map(float, ANGLES)))
    require_determined(f"{name} (angles)", known)
    return ExposureSet(name, "set", {}, stored=stored, angles=tuple(known))


def is_array(shot: object) -> TypeGuard[Array | Sequence[Array]]:
    """Whether something is an array, or a list of them."""
    first = shot[0] if isinstance(shot, list | tuple) and shot else shot
    return isinstance(first, np.ndarray | Tensor)


def stacked_array(shot: Array | Sequence[Array], name: str = NAME) -> Array:
    """The array itself, or one of a list of pictures.

    Raises:
        PolarguideError: the pictures of the list have several shapes or types.
    """
    if not isinstance(shot, list | tuple):
        return shot  # type: ignore[return-value]
    pictures = [as_numpy(picture) for picture in shot]
    kinds = list(dict.fromkeys(map(kind_of, pictures)))
    if len(kinds) > 1:
        remedy = "Export the pictures of a shot alike."
        raise PolarguideError(
            name, expected="pictures of one shape and type", found=" and ".join(kinds), remedy=remedy
        )
    return np.stack(pictures)


def _mosaic(values: NDArray[Any], options: ShotOptions, name: str) -> NDArray[Any]:
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype not in (np.uint8, np.uint16) or 0 in values.shape:
        remedy = (
            "Give what the sensor delivers, before any demosaicing; without a sensor, pictures [K, H, W]."
        )
        raise PolarguideError(name, expected=_MOSAIC, found=kind_of(values), remedy=remedy)
    found = values.shape[1], values.shape[0]
    wanted = options.width or found[0], options.height or found[1]
    if found != wanted:
        raise PolarguideError(
            name,
            expected=f"{wanted[0]}x{wanted[1]} pixels, as width and height say",
            found=f"{found[0]}x{found[1]}",
            remedy="Leave the two out: an array knows its size.",
        )
    return np.ascontiguousarray(values)
