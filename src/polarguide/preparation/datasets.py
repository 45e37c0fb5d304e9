"""Names and layouts of published datasets. Their readers are in another package. This module does not import torch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

DatasetName = Literal["pandora", "pisr", "nersp", "neisf", "gnerp", "phygap"]
READER_MODULE = "polarguide_bench.datasets.sources"
"""Module of the readers. Its function ``dataset_source`` opens a dataset."""
LAYOUTS = {
    "nersp": ("s0/", "s1/", "s2/"),
    "pisr": ("raw/", "intrinsics.npz"),
    "neisf": ("images_s0/", "images_s1/", "images_s2/"),
    "gnerp": ("cameras.json", "aop/", "dop/"),
    "phygap": ("camera_params.npz",),
}
"""Files and folders (with /) that identify a dataset, by its name.

PANDORA and RMVP3D, a part of NeRSP, differ in the names of the files in ``STOKES_FOLDERS``.
"""
STOKES_FOLDERS = ("images_stokes", "train_images_stokes")
"""Folders with the Stokes vectors of PANDORA, in the original and in the copies of NeRSP, PolGS and PhyGaP."""


def first_existing(root: Path, names: Sequence[str]) -> Path:
    """Return the path of the first name that exists in a folder. If no name exists, return the path of the first."""
    return next((root / name for name in names if (root / name).exists()), root / names[0])


def detect_dataset(root: Path) -> str | None:
    """Detect a dataset by the layout of a folder, and return its name. Return None for any other layout."""
    folder = first_existing(root, STOKES_FOLDERS)
    if folder.is_dir():
        return "nersp" if any(path.suffix.lower() == ".npz" for path in folder.iterdir()) else "pandora"
    for name, parts in LAYOUTS.items():
        if all((root / part).is_dir() if part[-1] == "/" else (root / part).is_file() for part in parts):
            return name
    return None
