"""Which recipes of a comparison are controls of which: the same without what is measured of polarization.

The names say it, here and nowhere else: ``R:unpolarized`` and ``R:unpolarized-...`` are the controls of ``R``.
"""

from __future__ import annotations

from collections.abc import Sequence

CONTROL = "unpolarized"


def controls_of(recipe: str, recipes: Sequence[str]) -> list[str]:
    """The controls of a recipe among others, in their order."""
    first = f"{recipe}:{CONTROL}"
    return [name for name in recipes if name == first or name.startswith(f"{first}-")]


def controlled(recipes: Sequence[str]) -> dict[str, list[str]]:
    """The recipes that have controls among them, each with these."""
    found = {recipe: controls_of(recipe, recipes) for recipe in recipes}
    return {recipe: controls for recipe, controls in found.items() if controls}
