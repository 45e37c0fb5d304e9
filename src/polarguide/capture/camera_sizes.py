"""The size that a camera was made for, where its file does not state it: that of the pictures it fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from polarguide.capture.formats.arrays import wrong_camera

Size = tuple[int, int]
Sizes = Callable[[str], tuple[Size, ...]]
"""View -> sizes (width, height) that its camera may have been made for, the likeliest first; none where unknown."""
# Share of a side by which principal points lie off the middle: lenses miss it by some percent, while those of pictures
# of half the size lie a quarter off.
_OFF_CENTER = 0.125


def is_centered(size: Size, center: tuple[float | None, float | None]) -> bool:
    """Whether a principal point, as far as it is known, lies near the middle of a picture."""
    return all(
        place is None or abs(place - side / 2) <= _OFF_CENTER * side
        for place, side in zip(center, size, strict=True)
    )


def settled_size(
    where: object, sizes: Sequence[Size], center: tuple[float | None, float | None], *, in_pixels: bool
) -> Size:
    """The size whose middle the principal point lies near.

    Args:
        where: for messages.
        sizes: that it may be, the likeliest first.
        center: the principal point, as far as it is known.
        in_pixels: whether other numbers of the camera are in pixels, too, and mean nothing without the right size.

    Raises:
        PolarguideError: no size is known, the principal point fits none, or several fit.
    """
    expected = "width and height of the pictures that the camera was made for, w and h"
    if not sizes:
        raise wrong_camera(where, expected, "none")
    fitting = [size for size in sizes if is_centered(size, center)]
    named = " or ".join(f"{width}x{height}" for width, height in sizes)
    if not fitting:
        raise wrong_camera(
            where, f"a principal point near the middle of {named}", f"{center[0]}, {center[1]}"
        )
    areas = {width * height for width, height in fitting}
    if len(areas) > 1 and in_pixels:
        raise wrong_camera(where, expected, f"none, for pictures of {named}")
    return fitting[0]
