"""Pictures of a scene, its masks and its invalid pixels: headers that lie, and content that nobody means."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import hostile_files as made
import numpy as np
import spoil
from base import HEIGHT, INSPECT, MASK, PICTURE, READ, TRAIN, WIDTH
from case import Case, Change, table
from changes import CHECKED, OF_FILES, SAME, UNUSED, chunk, copy, drawn, edit_bytes, instead, put, several
from tiny_capture import NAMES

CASES: list[Case] = []

ANGLES = ("000", "045", "090", "135")
COLOR = np.full((HEIGHT, WIDTH, 3), 9000, np.uint16)
DARK = np.zeros((HEIGHT, WIDTH), np.uint8)
WHITE = DARK + 255
MASKED = f"{TRAIN} --background masked"
ANIMATED = "an animated PNG file"

for how in spoil.BYTES:
    CASES.append(
        Case(f"{PICTURE} {how}", spoil.bytes_of(PICTURE, how), READ, passes=CHECKED, seeds=2, ci=True)
    )
    file = "scene/masks/v002.png" if how in ("cut", "fill") else "scene/invalid/v001.png"
    CASES.append(Case(f"{file} {how}", spoil.bytes_of(file, how), READ, passes=CHECKED, seeds=2))
CASES += [Case(f"{PICTURE} is a {how}", put(PICTURE, how), READ, ci=True) for how in OF_FILES]
warnings = {
    "gray": "1 of 9 views have gray pictures",
    "black": "1 of 9 views have pictures that are black throughout",
    "white": "are at full scale",
}
reasons = {"noise": "any picture may be noise"}
of_masks = {"black": "a mask may be empty", "floats": "a mask may be of any type"}
CASES += [
    *table("picture", READ, *(
        Case(how, spoil.picture(PICTURE, how), passes=reasons.get(how, ""), warning=warnings.get(how, ""), ci=True)
        for how in spoil.PICTURES)),
    *(Case(f"{file} {how}", spoil.picture(f"scene/{file}", how), READ, passes=of_masks.get(how, ""), ci=how == "wide")
      for file in ("masks/v002.png", "invalid/v001.png") for how in ("wide", "floats", "black")),
    Case("picture fill, inspected", spoil.bytes_of(PICTURE, "fill"), INSPECT, passes=CHECKED, seeds=4),
]  # fmt: skip


CASES += table(
    "picture TIFF", READ,
    Case("of signed sizes", instead(".tif", made.deflated_tiff, 30000, kind=9), ci=True),
    Case("of two sizes", instead(".tif", made.deflated_tiff, 30000, twice=WIDTH), ci=True),
)  # fmt: skip


def _unfolds(data: bytes) -> bytes:
    """With comments and a color profile of 300 MB each."""
    packed = zlib.compressobj(9)
    bomb = b"".join(packed.compress(bytes(10_000_000)) for _ in range(30)) + packed.flush()
    profile = chunk(b"iCCP", b"x\0\0" + bomb)
    return data[:33] + chunk(b"zTXt", b"Comment\0\0" + bomb) + profile + data[33:]


def animated(path: str) -> Change:
    """A PNG file that says that it is of three frames."""
    return edit_bytes(path, lambda data: data[:33] + chunk(b"acTL", struct.pack(">II", 3, 0)) + data[33:])


def _png(width: int = WIDTH, height: int = HEIGHT, at: str = PICTURE, **how: object) -> Change:
    return lambda: made.png(Path(at), width, height, **how)  # type: ignore[arg-type]


second = (b"tEXt", struct.pack(">II", WIDTH, HEIGHT) + b"\x10\0\0\0\0")
CASES += table(
    "picture PNG", READ,
    Case("animated", animated(PICTURE), found=ANIMATED, ci=True),
    Case("with a bomb of text", edit_bytes(PICTURE, _unfolds), passes=UNUSED, ci=True),
    Case("whose size comes second", _png(30000, 30000, bits=1, first=[second]), ci=True),
    Case("that is a JPEG of two sizes", instead(".jpg", made.two_sizes_jpeg, 30000), ci=True),
)  # fmt: skip


def _large(*paths: str) -> Change:
    """Pictures of 12000 pixels a side."""
    return several(_png(12000, 12000, at=paths[0], color=6), copy(paths[0], *paths[1:]))


def _all(folder: str, pixels: object, names: Sequence[str]) -> Change:
    return several(*(drawn(f"scene/{folder}/{name}.png", pixels) for name in names))


twins = several(*(copy(f"scene/polar/v002_{angle}.png", f"scene/polar/v003_{angle}.png") for angle in ANGLES))
CASES += table(
    "pictures", TRAIN,
    Case("transparent everywhere", drawn(PICTURE, np.dstack([COLOR, 0 * COLOR[..., 0]])), READ, expected="opaque",
         ci=True),
    Case("of one view twice", twins, warning=".*have the same pictures", ci=True),
    Case("of which three angles have 12000 pixels a side", _large(*(
        f"scene/polar/{view}_{angle}.png" for view in NAMES for angle in ANGLES[1:])), ci=True),
)  # fmt: skip


LEFT = np.where(np.arange(WIDTH) < WIDTH // 2, WHITE, DARK)


def _in_transparency(colors: np.ndarray) -> Change:
    """A mask whose transparency says that the left half is the object."""
    return drawn(MASK, np.dstack((colors, colors, colors, LEFT)))


training = [view for view in NAMES if view not in ("v000", "v004")]
CASES += table(
    "masks", MASKED,
    Case("animated", animated(MASK), found=ANIMATED, ci=True),
    Case("in their transparency", _in_transparency(WHITE), prints="transparen", ci=True),
    Case("in their colors and their transparency", _in_transparency(LEFT), passes=SAME, ci=True),
    Case("that hide everything", _all("masks", DARK, NAMES), ci=True),
    Case("of another scene", lambda: [os.rename(f"scene/masks/{name}.png", f"scene/masks/x{name}.png")
                                      for name in NAMES], ci=True),
    Case("that hide all of every training view as invalid", _all("invalid", WHITE, training), TRAIN, ci=True),
    Case("that hide all of one training view as invalid", _all("invalid", WHITE, training[:1]), TRAIN, ci=True),
    Case("with links to themselves", several(*(lambda name=name: Path(f"scene/masks/{name}").symlink_to("../masks")
                                               for name in "abcd")), INSPECT, passes=UNUSED, ci=True),
)  # fmt: skip
