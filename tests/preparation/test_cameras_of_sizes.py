"""Which pictures share a camera in structure from motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from polarguide.capture.colmap.features import match_features
from polarguide.capture.write import write_png
from polarguide.progress import SILENT


@pytest.mark.parametrize(
    ("sizes", "groups"),
    [
        ({"a": (64, 48), "b": (64, 48), "c": (64, 48)}, [{"a", "b", "c"}]),
        ({"a": (64, 48), "b": (48, 64), "c": (64, 48), "d": (48, 64)}, [{"a", "c"}, {"b", "d"}]),
        ({"a": (64, 48), "b": (48, 64)}, [{"a"}, {"b"}]),
    ],
)
def test_pictures_of_one_size_share_a_camera(
    tmp_path: Path, sizes: dict[str, tuple[int, int]], groups: list[set[str]]
) -> None:
    """A camera that was held upright and on its side has two cameras in the model, not one for each picture."""
    rng = np.random.default_rng(0)
    for view, (width, height) in sizes.items():
        write_png(tmp_path / "images" / f"{view}.png", rng.integers(0, 255, (height, width, 3), np.uint8))
    database = tmp_path / "database.db"
    match_features(
        database, tmp_path / "images", sizes, matching="exhaustive", seed=0, reporter=SILENT
    )  # fmt: skip
    found: dict[int, set[str]] = {}
    with pycolmap.Database.open(database) as link:
        for image in link.read_all_images():
            found.setdefault(image.camera_id, set()).add(image.name.removesuffix(".png"))
    assert sorted(found.values(), key=sorted) == groups
