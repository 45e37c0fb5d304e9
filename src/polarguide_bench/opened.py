"""Opening the runs of a comparison, whatever they were trained with."""

from __future__ import annotations

from pathlib import Path

from polarguide.core.options import DeviceName
from polarguide.runs.folder import RunConfiguration
from polarguide.runs.opened import OpenedRun
from polarguide.training.recipe import Recipe
from polarguide_bench.gnerp.runs import FieldRun, open_field
from polarguide_bench.recipes import recipe_named


def open_compared(folder: str | Path, device: DeviceName = "auto") -> OpenedRun | FieldRun:
    """Open a run of a comparison.

    Raises:
        PolarguideError: the folder is no run, is damaged, or belongs to another version.
    """
    recipe = recipe_named(RunConfiguration.load(Path(folder)).recipe)
    if isinstance(recipe, Recipe):
        return OpenedRun.open(folder, recipe=recipe, device=device)
    return open_field(folder, recipe, device=device)
