"""Published polarization datasets: layouts, cameras, and the sense of their angles."""

from pathlib import Path

from polarguide.capture.datasets.dataset import Dataset
from polarguide.capture.datasets.gnerp import is_gnerp, open_gnerp
from polarguide.capture.datasets.neisf import is_neisf, open_neisf
from polarguide.capture.datasets.nersp import is_nersp, open_nersp
from polarguide.capture.datasets.pandora import is_pandora, open_pandora
from polarguide.capture.datasets.pisr import is_pisr, open_pisr

DATASETS = {
    "pandora": is_pandora,
    "pisr": is_pisr,
    "nersp": is_nersp,
    "neisf": is_neisf,
    "gnerp": is_gnerp,
}
"""Names, and functions that tell whether a folder has the layout."""


def detect_dataset(root: Path) -> str | None:
    """The dataset whose layout a folder has, or None."""
    return next((name for name, has_layout in DATASETS.items() if has_layout(root)), None)


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
    return {"pandora": open_pandora, "pisr": open_pisr, "nersp": open_nersp, "neisf": open_neisf}[name](root)
