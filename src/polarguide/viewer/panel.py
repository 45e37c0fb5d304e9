"""The controls beside the picture, one set for each visitor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from polarguide.shading.result import LAYERS
from polarguide.viewer.appearance import MEASURED, Appearance, Crop

NOWHERE = "(free)"


@dataclass(frozen=True)
class Offer:
    """What a panel has to offer.

    Attributes:
        layers: of the shading model. turns: whether its light can be turned.
        views: names of the photographs.
        trains: whether a training can be made to wait.
    """

    layers: Sequence[str]
    turns: bool
    views: Sequence[str]
    trains: bool


class Panel:
    """Controls of one visitor.

    Names of views come from files, so they are only ever shown as plain text: Markdown in the browser may run code.

    Args:
        gui: viser's interface of the visitor.
        offer: what there is to choose from.
        changed: called after every change that the picture shows.
    """

    def __init__(self, gui: Any, offer: Offer, changed: Callable[[], None]) -> None:
        self._crop: list[Any] = []
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._told = gui.add_markdown("")
        self.pause = gui.add_checkbox("Pause training", False, visible=offer.trains)
        layers = [name for name in LAYERS if name in offer.layers]
        self.layer = gui.add_dropdown("Layer", (*layers, *MEASURED), hint="The last four: at a photograph")
        self.exposure = gui.add_slider("Exposure", -4.0, 4.0, 0.1, 0.0, hint="Stops")
        self.strength = gui.add_slider("Reflection", 0.0, 2.0, 0.05, 1.0, visible="specular" in layers)
        hint = "Degrees, what is far away; what stands near stays"
        self.turn = gui.add_slider("Environment", -180, 180, 1, 0, hint=hint, visible=offer.turns)
        with gui.add_folder("Photographs"):
            self.view = gui.add_dropdown("Go to", (NOWHERE, *offer.views))
            self.step = gui.add_button_group("", ("previous", "next"))
            self.frusta = gui.add_checkbox("Show cameras", True)
        with gui.add_folder("Crop", expand_by_default=False):
            self._use_crop = gui.add_checkbox("Crop", False)
            self.box = gui.add_checkbox("Show box", True)
            for label in ("Left, right", "Down, up", "Front, back"):
                self._crop.append(gui.add_multi_slider(label, -150, 150, 1, (-40, 40), min_range=1))
        with gui.add_folder("Picture and path", expand_by_default=False):
            self.screenshot = gui.add_button("Save picture")
            self.keys = gui.add_text("Poses", "0", disabled=True)
            self.add_key = gui.add_button("Add this pose")
            self.remove_key = gui.add_button("Remove the last")
            self.seconds = gui.add_slider("Seconds each", 0.5, 10.0, 0.5, 2.0)
            self.play = gui.add_button("Play")
            self.save_path = gui.add_button("Save path")
        shown = (self.layer, self.exposure, self.strength, self.turn, self._use_crop, *self._crop)
        for control in shown:
            control.on_update(lambda _: changed())

    def tell(self, *lines: str) -> None:
        """Show some lines, none of them of a user's making."""
        text = "  \n".join(lines)
        if self._told.content != text:
            self._told.content = text

    @property
    def crop(self) -> Crop | None:
        """The box that is chosen, if any."""
        if not self._use_crop.value:
            return None
        sides = [control.value for control in self._crop]
        low = (sides[0][0] / 100, sides[1][0] / 100, sides[2][0] / 100)
        high = (sides[0][1] / 100, sides[1][1] / 100, sides[2][1] / 100)
        return Crop(low, high)

    @property
    def appearance(self) -> Appearance:
        """What is chosen."""
        return Appearance(
            layer=self.layer.value,
            exposure=float(self.exposure.value),
            strength=float(self.strength.value),
            turn=float(self.turn.value),
            crop=self.crop,
        )
