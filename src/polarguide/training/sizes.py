"""The training views at the size of a step: smaller ones at first where they are large, as the recipe says."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from polarguide.capture import View
from polarguide.capture.smaller import SmallerViews
from polarguide.raster import Backend
from polarguide.system import UNBOUNDED, MemoryBound
from polarguide.training.feed import Feed
from polarguide.training.recipe import Recipe
from polarguide.training.view_store import ViewStore


class Sizes:
    """Views, and what a step reads of them, by step.

    Args:
        backend: device and rasterizer. recipe: the method. index: of refraction.
        store: keeps what is computed of the views. views: that are trained on. steps: of the training.
        black: whether nothing is behind the subject. memory: gives back what was freed.
    """

    def __init__(
        self,
        backend: Backend,
        recipe: Recipe,
        index: float,
        store: ViewStore,
        views: Sequence[View],
        steps: int,
        *,
        black: bool,
        memory: MemoryBound = UNBOUNDED,
    ) -> None:
        self.until = coarse_steps(recipe, views, steps)
        small = SmallerViews(views, recipe.coarse.factor) if self.until else views
        self._views = {True: small, False: views}
        self._feeds = {
            coarse: Feed(
                backend,
                recipe.priors,
                index,
                store,
                self._views[coarse],
                black=black,
                label="small " if coarse else "",
                memory=memory,
            )
            for coarse in ((True, False) if self.until else (False,))
        }

    def views(self, step: int) -> Sequence[View]:
        """The views of a step."""
        return self._views[step < self.until]

    def feed(self, step: int) -> Feed:
        """What a step reads of its views. What was kept of smaller ones goes with the last step that reads them."""
        if self.until and step == self.until:
            self._feeds[True].clear()
        return self._feeds[step < self.until]

    def forget(self, names: Collection[str]) -> None:
        """What is believed of these views has changed."""
        for feed in self._feeds.values():
            feed.forget(names)

    def refresh_priors(self) -> None:
        """There is another guide."""
        for feed in self._feeds.values():
            feed.refresh_priors()


def coarse_steps(recipe: Recipe, views: Sequence[View], steps: int) -> int:
    """Steps at the beginning that look at smaller pictures; 0 where those of the capture are small."""
    most = max((view.camera.width * view.camera.height for view in views), default=0)
    return round(recipe.coarse.share * steps) if most > recipe.coarse.pixels else 0
