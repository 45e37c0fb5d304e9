"""``polarguide present``."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.console import ConsoleReporter, say, use_threads
from polarguide.core.options import ComputeOptions


def present(
    folder: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    white_balance: str = "",
    chart: str = "",
    exposure: str = "",
    up_axis: str = "",
    points: tuple[str, ...] = (),
    distance: str = "",
    meters_per_unit: str = "",
    crop: str = "",
    title: str = "",
    author: str = "",
    license: str = "",
    provenance: str = "",
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Set how a scene or a run is shown and exported: color, up, scale, crop box, credit. Data and scores stay.

    What is set stands in presentation.json in the folder. A scene's holds for all its runs; a run's goes before it.
    What is not given stays as it is, "none" removes it, and without an option it is printed. `polarguide view RUN` lets
    you pick the same with the mouse. A VIEW,X,Y is a pixel of a photograph, counted from its top left corner.

    Args:
        folder: Folder of a scene or a run.
        white_balance: gray (the photographs' mean becomes gray), gains such as 1.9,1,1.6, or VIEW,X,Y where something
            white or gray is.
        chart: VIEW,X,Y,X,Y,X,Y,X,Y: the centers of the corner patches of a 24-patch color chart in a photograph, around
            it; or the folder of another scene, whose chart it takes. It replaces a white balance.
        exposure: Stops by which all is shown brighter, such as 0.5.
        up_axis: An axis such as z or --up-axis=-y, three numbers, or VIEW,X,Y where a level surface is. Without it, up
            is as the cameras say.
        points: Two points of known distance: X,Y,Z in the scene, VIEW,X,Y on a surface, or VIEW for a camera's place.
        distance: Of the two points, such as 85mm.
        meters_per_unit: How long a unit of the scene is, in place of points and distance.
        crop: Box as --crop=left,right,down,up,front,back in percent of the cameras' distance.
        title: One line.
        author: Whom the capture is owed to.
        license: Such as CC-BY-4.0.
        provenance: Where, when and with what it was captured, or its number in an inventory.
    """
    use_threads(compute.threads)
    presenting = importlib.import_module("polarguide.results.rendering.present")
    presented = presenting.present(
        folder,
        white_balance=white_balance or None,
        chart=chart or None,
        exposure=exposure or None,
        up_axis=up_axis or None,
        points=points,
        distance=distance or None,
        meters_per_unit=meters_per_unit or None,
        crop=crop or None,
        title=title or None,
        author=author or None,
        license=license or None,
        provenance=provenance or None,
        device=compute.device,
        reporter=ConsoleReporter(),
    )
    for line in presenting.described(presented):
        say(line)
