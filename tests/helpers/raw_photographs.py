"""Camera raw files (DNG, RGGB) written from known light."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

WHITE, BLACK = 4095, 64


def write_dng(path: Path, rgb: np.ndarray, *, orientation: int = 1) -> None:
    """Linear [H, W, 3] in [0, 1], seen through a Bayer filter by a sensor of 12 bits with a black level."""
    cfa = rgb[..., 1].copy()
    cfa[0::2, 0::2], cfa[1::2, 1::2] = rgb[0::2, 0::2, 0], rgb[1::2, 1::2, 2]
    codes = np.rint(BLACK + np.clip(cfa, 0, 1) * (WHITE - BLACK)).astype(np.uint16)
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
        (50714, "H", 1, BLACK, True),
        (50717, "H", 1, WHITE, True),
        (50721, "2i", 9, sum(identity, ()), True),  # ColorMatrix1
        (50728, "2I", 3, one * 3, True),  # AsShotNeutral
        (50778, "H", 1, 21, True),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, codes, photometric=32803, extratags=tags, metadata=None, software=None)
