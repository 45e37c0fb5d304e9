"""A look at all views gives freed memory back view by view."""

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch
from metal_balls import gaussians_of_the_ball, views_of

from polarguide.capture import View
from polarguide.core.system import MemoryBound
from polarguide.raster.cpu import rasterize_cpu
from polarguide.training import priors
from polarguide.training.callbacks import outward_directions
from polarguide.training.metals.observations import contradicted, label_weights
from polarguide.training.metals.search import evidence
from polarguide.training.recipe import MetalRules, MetalViews

RULES, LIMITS = MetalRules(), MetalViews()
GAUSSIANS = gaussians_of_the_ball()
VIEWS = [
    dataclasses.replace(view, materials=torch.where(view.invalid, 0, 2).to(torch.uint8))
    for view in views_of("gold")[:5]
]


class Held(MemoryBound):
    """Memory that every work leaves a piece of behind, until it is given back; ``most`` is the most that was held."""

    def __init__(self) -> None:
        super().__init__()
        self.held = self.most = 0

    def clear(self) -> None:
        self.held = 0

    def works(self, does: Callable[..., Any]) -> Callable[..., Any]:
        def worked(*arguments: Any, **named: Any) -> Any:
            self.held += 1
            self.most = max(self.most, self.held)
            return does(*arguments, **named)

        return worked


def of_metals(views: list[View], memory: Held) -> None:
    without = [dataclasses.replace(view, materials=None) for view in views]
    evidence(GAUSSIANS, without, memory.works(rasterize_cpu), 1.5, RULES, LIMITS, memory)


def of_words(views: list[View], memory: Held) -> None:
    label_weights(GAUSSIANS, views, memory.works(rasterize_cpu), memory)


def of_contradictions(views: list[View], memory: Held) -> None:
    contradicted(GAUSSIANS, views, memory.works(rasterize_cpu), torch.zeros(900, 2), LIMITS, memory)


def of_sides(views: list[View], memory: Held) -> None:
    outward_directions(GAUSSIANS, memory.between(views), memory.works(rasterize_cpu))


def of_flat_surfaces(views: list[View], memory: Held) -> None:
    priors.flat_surfaces(memory.between(views), 1.5, priors.FlatRules())


@pytest.mark.parametrize("look", [of_metals, of_words, of_contradictions, of_sides, of_flat_surfaces])
def test_between_any_two_views_memory_is_given_back(
    look: Callable[[list[View], Held], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    flat_surface, found = priors.flat_surface, []
    for views in (VIEWS[:1], VIEWS):
        memory = Held()
        monkeypatch.setattr(priors, "flat_surface", memory.works(flat_surface))
        look(views, memory)
        found.append((memory.most, memory.held))
    one, all_of_them = found
    assert one[0] > 0
    assert all_of_them == one
    assert memory.held == 0
