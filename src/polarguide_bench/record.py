"""The record of a comparison, as ``results.json`` has it: its types, and the check of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta, UnsetType

from polarguide.core.errors import PolarguideError
from polarguide.core.records import read_record, shortened

FORMAT = "polarguide-results-2"
FORMER = "polarguide-results-1"
"""Lacks objects, materials, black pixels, the recipe to compare with, and differences."""
REMEDY = "Give the command again to write the record anew."
_Item = TypeVar("_Item")
_Filled = Annotated[list[_Item], Meta(min_length=1)]
Count = Annotated[int, Meta(ge=0)]
Scores = dict[str, float | None]
"""Metrics by key; None: the recipe or the ground truth gives no value."""


class Provenance(msgspec.Struct):
    """How the record was made. ``sources``: digest of the code that trains and scores; ``date``: ISO 8601, UTC."""

    version: str
    commit: str | None
    sources: str
    command: str
    date: str


class Settings(msgspec.Struct):
    """Settings that all runs share; ``jobs`` of them worked at a time, 0: as many as had room. ``against``: what others
    are compared with.

    The first records lack the last ones: surroundings were taken to be there, and metals not sought.
    """

    steps: int
    seeds: int
    downscale: int
    transfer: str
    refractive_index: float | None
    threads: int
    jobs: int
    against: str | None = None
    background: str = "scene"
    materials: str = "dielectric"

    def __post_init__(self) -> None:
        if self.refractive_index == 0:  # as earlier records have it for null
            self.refractive_index = None


class SceneRecord(msgspec.Struct):
    """A scene: the digest of its files, how many views it has, and the names of those that scores are means over.

    ``black_share`` is the share of black pixels in its first test view, None where that is not known.
    ``warnings``, only where there are some, are what its scores do not mean because ground truth is missing.
    ``refractive_index`` is that of its runs, where ``Settings`` have null: each scene its own.
    """

    name: str
    digest: str
    views: Count
    test_views: list[str]
    black_share: Annotated[float, Meta(ge=0, le=1)] | None = None
    warnings: list[str] | UnsetType = UNSET
    refractive_index: Annotated[float, Meta(gt=1, lt=4)] | UnsetType = UNSET


class RecipeRecord(msgspec.Struct):
    """A recipe with all its values; ``steps`` only where it takes another number of them than ``Settings`` say."""

    name: str
    about: str
    data: dict[str, Any]
    steps: Annotated[int, Meta(ge=1)] | UnsetType = UNSET


class PartScores(msgspec.Struct):
    """Scores of a run on an object, or on all objects of a material.

    ``pixels`` counts those of all test views, ``views`` the test views that show it. ``material`` is the class of
    material, None where it is not known.
    """

    material: str | None
    pixels: Count
    views: Count
    metrics: Scores


class RunRecord(msgspec.Struct, kw_only=True):
    """One training: what it was, the state of its work, and its scores.

    ``metrics`` is None unless the run is done; ``views`` holds those of each test view, ``objects`` of each object by
    name, ``materials`` of each class of material; the last two are empty where the scene has no table of objects.
    ``folder`` is relative to that of the record. ``lpips_reason`` and ``mesh_reason`` say why these have no value;
    records of earlier versions lack the second.
    """

    scene: str
    recipe: str
    seed: Count
    folder: str
    state: Literal["done", "failed", "missing"]
    error: str | None
    metrics: Scores | None
    lpips_reason: str | None
    mesh_reason: str | UnsetType | None = UNSET
    views: dict[str, Scores]
    objects: dict[str, PartScores] = {}
    materials: dict[str, PartScores] = {}


class Record(msgspec.Struct):
    """A comparison: its request, and the scores of every run. Tables and differences follow from it.

    Raises:
        PolarguideError: names that occur twice, or runs of other scenes and recipes.
    """

    format: str
    provenance: Provenance
    settings: Settings
    scenes: _Filled[SceneRecord]
    recipes: _Filled[RecipeRecord]
    runs: _Filled[RunRecord]

    def __post_init__(self) -> None:
        _require("format", self.format, (FORMAT, FORMER))
        self.format = FORMAT
        names = {"scene": [s.name for s in self.scenes], "recipe": [r.name for r in self.recipes]}
        for kind, names_of_kind in names.items():
            if len(set(names_of_kind)) < len(names_of_kind):
                raise _fault(f"{kind}s", "no name more than once", names_of_kind)
        _require("settings.against", self.settings.against, [*names["recipe"], None])
        for index, run in enumerate(self.runs):
            for kind, names_of_kind in names.items():
                _require(f"runs[{index}].{kind}", getattr(run, kind), names_of_kind)
            if (run.metrics is None) == (run.state == "done"):
                raise _fault(
                    f"runs[{index}].metrics",
                    "values for a run that is done and null for another",
                    run.metrics,
                )


def read_results(path: Path) -> Record:
    """Read ``results.json``, of this version or the one before.

    Raises:
        PolarguideError: there is none, or it is not what a comparison writes; the message names the key at fault.
    """
    return read_record(path, Record, remedy=REMEDY)


def _require(where: str, value: object, allowed: object) -> None:
    if value not in allowed:  # type: ignore[operator]
        raise _fault(where, "one of " + ", ".join(str(name) for name in allowed if name is not None), value)  # type: ignore[attr-defined]


def _fault(where: str, expected: str, found: object) -> PolarguideError:
    return PolarguideError(where, expected=expected, found=shortened(found), remedy=REMEDY)
