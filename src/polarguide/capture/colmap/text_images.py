"""``images.txt`` of a COLMAP model: two lines an image, and names that may hold blanks, which pycolmap cuts."""

from __future__ import annotations

from dataclasses import dataclass

_POSE = 9  # number, quaternion, translation, camera: what stands before the name
_PLACE = 3  # x, y and the number of a point; pycolmap checks all of them, lines of images show in the first


@dataclass(frozen=True)
class TextImages:
    """What pycolmap may read in place of an ``images.txt``.

    Attributes:
        data: the same file with names that have no blanks.
        names: number of an image -> its name.
    """

    data: bytes
    names: dict[int, str]


def read_text_images(data: bytes) -> TextImages:
    """Take the names out of an ``images.txt``.

    An image with one line, as some programs write it, would make pycolmap pass over every other image.

    Raises:
        ValueError: lines are not those of images and their observations in turn, or a name is not in UTF-8.
    """
    out: list[bytes] = []
    names: dict[int, str] = {}
    number: int | None = None  # of the image whose observations come next
    for count, line in enumerate(data.splitlines(), 1):
        cells = line.split()
        if number is not None:
            if len(cells) % _PLACE or not all(map(_is_number, cells[: _POSE + _PLACE])):
                raise ValueError(f"line {count} does not hold the observations of image {number}")
            number = None
            out.append(line)
        elif not cells or line.lstrip().startswith(b"#"):
            out.append(line)
        else:
            head = line.split(None, _POSE)
            if len(head) <= _POSE or not (head[0].isdigit() and all(map(_is_number, head[:_POSE]))):
                raise ValueError(f"line {count} does not hold an image")
            number = int(head[0])
            if number in names:
                raise ValueError(f"image {number} stands there twice")
            names[number] = head[_POSE].decode().strip()
            out.append(b" ".join([*head[:_POSE], b"%d" % number]))
    return TextImages(b"\n".join(out) + b"\n\n", names)


def _is_number(cell: bytes) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
