"""``polarguide scale``."""

from __future__ import annotations

from pathlib import Path

from polarguide.capture.filter.ring_scale import ring_scale
from polarguide.cli.console import console
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder, read_file, write_whole
from polarguide.core.options import check_finite


def scale(*, diameter: float, out: Path = Path("filter-scale.svg")) -> None:
    """Print a scale of angles for the ring of a polarizing filter: an SVG file in exact millimeters.

    The paper ring is fixed to the lens around the filter's turning ring and read from the front, where angles count
    clockwise: as prepare reads them, they count counter-clockwise from behind the camera. docs/how-to/capture.md says
    how to use it.

    Args:
        diameter: Outer diameter of the filter's turning ring in mm: measure it (a 67 mm filter has about 70).
        out: SVG file to write.
    """
    check_finite("diameter", diameter, 20.0, 160.0)
    data = ring_scale(diameter).encode()
    if out.exists() and (out.is_dir() or read_file(out) != data):
        raise PolarguideError(out, expected="a new file", found="another one", remedy="Give another --out.")
    make_folder(out.parent)
    write_whole(out, data)
    console.print(f"scale: {out} (print at 100 %, and measure the 50 mm line)", markup=False)
