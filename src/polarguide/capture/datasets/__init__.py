"""Published polarization datasets: layouts, cameras, and the sense of their angles."""

from pathlib import Path

from polarguide.capture.datasets.dataset import Dataset
from polarguide.capture.datasets.readers import (
    PHYGAP_CAMERAS,
    open_gnerp,
    open_neisf,
    open_nersp,
    open_pandora,
    open_phygap,
    open_pisr,
)

DATASETS = {
    "pandora": ("images_stokes/",),
    "pisr": ("raw/", "intrinsics.npz"),
    "nersp": ("s0/", "s1/", "s2/"),
    "neisf": ("images_s0/", "images_s1/", "images_s2/"),
    "gnerp": ("cameras.json", "aop/", "dop/"),
    "phygap": (PHYGAP_CAMERAS,),
}
"""Names, and the files and folders that a folder with the layout has."""


def detect_dataset(root: Path) -> str | None:
    """The dataset whose layout a folder has, or None."""
    for name, parts in DATASETS.items():
        if all((root / part).is_dir() if part[-1] == "/" else (root / part).is_file() for part in parts):
            return name
    return None


def open_dataset(root: Path, name: str, *, transfer: str = "auto") -> Dataset:
    """A folder of the dataset called ``name``.

    Args:
        root: the folder.
        name: a key of ``DATASETS``.
        transfer: encoding of GNeRP's pictures; ignored for the others.

    Raises:
        PolarguideError: a file is missing, or the cameras are invalid.
    """
    if name == "gnerp":
        return open_gnerp(root, transfer=transfer)
    openers = {
        "pandora": open_pandora, "pisr": open_pisr, "nersp": open_nersp, "neisf": open_neisf, "phygap": open_phygap
    }  # fmt: skip
    return openers[name](root)
