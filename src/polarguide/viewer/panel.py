"""The control panel of a session."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any

from polarguide.capture.presentation import STOPS, Crop, Presentation, Vector
from polarguide.viewer.messages import Accepts, choice, flag, number, pair, push
from polarguide.viewer.painting import PaintingControls
from polarguide.viewer.presenting import PresentingControls
from polarguide.viewer.scenery import MEASURED, Appearance

FREE_VIEW = "(free)"
STEPS = ("previous", "next")
NOTHING = Presentation()
# Ranges of the controls.
SIDES = ("Left, right", "Down, up", "Front, back")
EXPOSURE = (-STOPS, STOPS)
STRENGTH = (0.0, 2.0)
TURN = (-180, 180)
SECONDS = (0.5, 10.0)
CROP = (-150, 150)
WIPE = 0, 100


@dataclass(frozen=True)
class PanelOptions:
    """The controls that a panel has.

    Attributes:
        layers: layers of the shading model. turns: whether the environment can be rotated.
        views: names of the photographs.
        trains: whether a training runs, which can be paused.
        presentation: as it was saved. saves: whether it can be saved to the run, rather than downloaded.
        kinds: materials that can be painted, with their numbers; none: there is nothing to paint on.
    """

    layers: Sequence[str]
    turns: bool
    views: Sequence[str]
    trains: bool
    presentation: Presentation = NOTHING
    saves: bool = False
    kinds: Mapping[str, int] = field(default_factory=dict)


class Panel:
    """The controls of one session.

    Names of views come from files, so they are shown as plain text only: Markdown in the browser may run code.

    Attributes:
        accepts: what a browser may set each control to, by viser's name of the control.

    Args:
        gui: viser's handle of the session's controls.
        options: the controls to show.
        changed: called after every change that affects the picture.
        folded: whether the controls begin folded, behind the one word that opens them. On a phone viser's panel begins
            open and covers half of the picture, and nothing that a server sends can fold it.
    """

    def __init__(
        self, gui: Any, options: PanelOptions, changed: Callable[[], None], *, folded: bool = False
    ) -> None:
        self._crop: list[Any] = []
        # The box as it was saved, until a slider is moved; its sides are more exact than the sliders' steps.
        self._saved_crop = options.presentation.crop
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._status = gui.add_markdown("")
        self._lines = tuple[str, ...]()
        self._note = ""
        with gui.add_folder("Controls", expand_by_default=False) if folded else nullcontext():
            self._add_controls(gui, options)
        self.accepts = self._accepted([*options.layers, *MEASURED], options.views)
        controls = (
            *(self.layer, self.exposure, self.strength, self.turn, self.wipe),
            *(self._use_crop, *self._crop),
        )
        for control in self._crop:
            control.on_update(lambda _: self._forget_saved())
        for control in controls:
            control.on_update(lambda _: changed())

    def _add_controls(self, gui: Any, options: PanelOptions) -> None:
        self.pause = gui.add_checkbox("Pause training", False, visible=options.trains)
        layers = options.layers
        self.layer = gui.add_dropdown(
            "Layer",
            (*layers, *MEASURED),
            hint=f"From {MEASURED[0]} on, a photograph's pose is needed; stokes, dolp and aolp are predicted",
        )
        self.exposure = gui.add_slider(
            "Exposure", *EXPOSURE, 0.1, options.presentation.exposure or 0.0, hint="In stops"
        )
        self.strength = gui.add_slider("Reflection", *STRENGTH, 0.05, 1.0, visible="specular" in layers)
        hint = "Rotates the environment light, in degrees; the scene stays"
        self.turn = gui.add_slider("Environment", *TURN, 1, 0, hint=hint, visible=options.turns)
        with gui.add_folder("Photographs"):
            self.view = gui.add_dropdown("Go to", (FREE_VIEW, *options.views))
            self.step = gui.add_button_group("", STEPS)
            self.frusta = gui.add_checkbox("Show cameras", True)
            hint = (
                "In percent of the width, from the left: the run beside, else what was measured at this pose"
            )
            self.wipe = gui.add_slider("Wipe", *WIPE, 1, 0, hint=hint)
        with gui.add_folder("Crop", expand_by_default=False):
            self._use_crop = gui.add_checkbox("Crop", self._saved_crop is not None)
            self.box = gui.add_checkbox("Show box", False)
            for label, sides in zip(SIDES, _percent(self._saved_crop), strict=True):
                self._crop.append(gui.add_multi_slider(label, *CROP, 1, sides, min_range=1))
        self.presenting = PresentingControls(gui, options.presentation, saves=options.saves)
        self.painting = PaintingControls(gui, options.kinds) if options.kinds else None
        with gui.add_folder("Picture and camera path", expand_by_default=False):
            self.screenshot = gui.add_button("Save picture")
            self.keyframes = gui.add_text("Keyframes", "0", disabled=True)
            self.add_keyframe = gui.add_button("Add keyframe")
            self.remove_keyframe = gui.add_button("Remove last keyframe")
            self.seconds = gui.add_slider("Seconds per segment", *SECONDS, 0.5, 2.0)
            self.play = gui.add_button("Play")
            self.save_path = gui.add_button("Save path")

    def _forget_saved(self) -> None:
        self._saved_crop = None

    def _accepted(self, layers: Sequence[str], views: Sequence[str]) -> dict[str, Accepts]:
        pushed = (self.screenshot, self.add_keyframe, self.remove_keyframe, self.play, self.save_path)
        controls = [
            (self.layer, choice(layers)),
            (self.exposure, number(*EXPOSURE)),
            (self.strength, number(*STRENGTH)),
            (self.turn, number(*TURN)),
            (self.wipe, number(*WIPE)),
            (self.view, choice([FREE_VIEW, *views])),
            (self.step, choice(STEPS)),
            (self.seconds, number(*SECONDS)),
            *((control, flag) for control in (self.pause, self.frusta, self.box, self._use_crop)),
            *((control, pair(*CROP)) for control in self._crop),
            *((control, push) for control in pushed),
        ]
        painting = {} if self.painting is None else self.painting.accepts
        own = {control._impl.uuid: accepts for control, accepts in controls}
        return own | self.presenting.accepts | painting

    def show_note(self, note: str) -> None:
        """Show another note below the status, of which the same holds."""
        self._note = note
        self.show_status(*self._lines)

    def show_status(self, *lines: str) -> None:
        """Show status lines; they must not contain names from files."""
        self._lines = lines
        text = "  \n".join((*lines, f"**{self._note}**") if self._note else lines)
        if self._status.content != text:
            self._status.content = text

    def crop(self, up_axis: Vector | None = None) -> Crop | None:
        """The crop box along an axis (None: as the cameras say), or None if it is off."""
        if not self._use_crop.value:
            return None
        if self._saved_crop is not None:
            return self._saved_crop
        sides = [control.value for control in self._crop]
        low = (sides[0][0] / 100, sides[1][0] / 100, sides[2][0] / 100)
        high = tuple(max(side[1], side[0] + 1) / 100 for side in sides)  # a message may make them equal
        return Crop(low, (high[0], high[1], high[2]), up_axis)

    def appearance(self, chosen: Presentation = NOTHING) -> Appearance:
        """The current choice of the user, with the white and the up axis that were chosen."""
        return Appearance(
            layer=self.layer.value,
            exposure=float(self.exposure.value),
            strength=float(self.strength.value),
            turn=float(self.turn.value),
            crop=self.crop(chosen.up_axis),
            white_balance=chosen.white_balance,
            chart=chosen.chart,
            up_axis=chosen.up_axis,
            wipe=float(self.wipe.value) / 100,
        )


def _percent(crop: Crop | None) -> list[tuple[int, int]]:
    """Where the sliders of a crop box stand."""
    if crop is None:
        return [(-40, 40)] * 3
    percents = []
    for low, high in zip(crop.low, crop.high, strict=True):
        first = min(max(round(100 * low), CROP[0]), CROP[1] - 1)
        percents.append((first, max(first + 1, min(round(100 * high), CROP[1]))))
    return percents
