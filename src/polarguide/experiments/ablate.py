"""Compare a recipe with its ablations: the same with one thing changed, each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from polarguide.errors import PolarguideError
from polarguide.experiments.compare import compare
from polarguide.experiments.options import CompareOptions
from polarguide.experiments.results import Results
from polarguide.options import PathLike, check_choice
from polarguide.progress import SILENT, Reporter
from polarguide.recipes.registry import ABLATIONS, ablations_of
from polarguide.training.recipe import Method
from polarguide.training.settings import TrainSettings


def ablate(
    scenes: Sequence[PathLike],
    base: str,
    out: PathLike,
    *,
    only: Sequence[str] = (),
    reference: Sequence[str | Method] = (),
    settings: TrainSettings = TrainSettings(),
    options: CompareOptions = CompareOptions(),
    reporter: Reporter = SILENT,
) -> Results:
    """``compare`` with a recipe and its ablations; it shares runs with a comparison in the same folder.

    Differences are to the recipe, unless ``options.against`` names another.

    Args:
        scenes, out, settings, options, reporter: as for ``compare``.
        base: name of the recipe whose ablations to train.
        only: names of the ablations to take, such as without-normals; all if empty.
        reference: recipes to add as first rows.

    Raises:
        PolarguideError: as ``compare``; or a recipe without ablations, or an ablation that it does not have.
    """
    recipes = [*reference, *ablated(base, only)]
    options = replace(options, against=options.against or base)
    return compare(scenes, recipes, out, settings=settings, options=options, reporter=reporter)


def ablated(base: str, only: Sequence[str] = ()) -> tuple[str, ...]:
    """The names of a recipe and of its ablations, or of those of them that are in ``only``.

    Args:
        base: a recipe.
        only: ablations with or without ``base:`` before the name; all if empty.

    Raises:
        PolarguideError: a recipe without ablations, or an ablation that it does not have.
    """
    variations = ablations_of(base)
    if not variations:
        expected = "a recipe with ablations: " + ", ".join(ABLATIONS)
        remedy = "Take one of these, or use compare."
        raise PolarguideError("base", expected=expected, found=base, remedy=remedy)
    names = [recipe.name for recipe in variations]
    wanted = [name if name.startswith(f"{base}:") else f"{base}:{name}" for name in only]
    for name in only:
        check_choice("only", name.removeprefix(f"{base}:"), [n.partition(":")[2] for n in names])
    return (base, *(name for name in names if not only or name in wanted))
