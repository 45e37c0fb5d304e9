"""Camera raw files (DNG, RGGB) written from known light."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

WHITE, BLACK = 4095, 64


def write_dng(path: Path, rgb: np.ndarray, *, orientation: int = 1, black: int = BLACK) -> None:
    """Linear [H, W, 3] in [0, 1], seen through a Bayer filter by a sensor of 12 bits with a black level."""
    cfa = rgb[..., 1].copy()
    cfa[0::2, 0::2], cfa[1::2, 1::2] = rgb[0::2, 0::2, 0], rgb[1::2, 1::2, 2]
    codes = np.rint(black + np.clip(cfa, 0, 1) * (WHITE - black)).astype(np.uint16)
    one = (1, 1)
    zero = (0, 1)
    identity = [one if row == column else zero for row in range(3) for column in range(3)]
    tags = [
        (271, "s", 0, "maker", True),
        (272, "s", 0, "model", True),
        (274, "H", 1, orientation, True),
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, (0, 1, 1, 2), True),  # CFAPattern: RGGB
        (50706, "B", 4, (1, 4, 0, 0), True),  # DNGVersion
        (50707, "B", 4, (1, 1, 0, 0), True),
        (50708, "s", 0, "maker model", True),
        (50714, "H", 1, black, True),
        (50717, "H", 1, WHITE, True),
        (50721, "2i", 9, sum(identity, ()), True),  # ColorMatrix1
        (50728, "2I", 3, one * 3, True),  # AsShotNeutral
        (50778, "H", 1, 21, True),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, codes, photometric=32803, extratags=tags, metadata=None, software=None)


def write_linear_dng(path: Path, rgb: np.ndarray, *, black: int, white: int = 16380) -> None:
    """Linear [H, W, 3], where 1 is the white level, as a DNG file of three colors at every pixel."""
    codes = np.rint(np.minimum(black + rgb * (white - black), white)).astype(np.uint16)
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True),  # DNGVersion
        (50708, "s", 0, "maker model", True),
        (50714, "H", 3, (black,) * 3, True),
        (50717, "H", 3, (white,) * 3, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),  # ColorMatrix1
        (50728, "2I", 3, (1, 1) * 3, True),  # AsShotNeutral
    ]
    tifffile.imwrite(path, codes, photometric=34892, planarconfig="contig", extratags=tags, metadata=None)
