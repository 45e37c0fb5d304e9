"""Control panel of a session."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec

from polarguide.capture.presentation import STOPS, Crop, Presentation
from polarguide.viewer.guard import Accepts, choice, flag, number, pair, push
from polarguide.viewer.scenery import MEASURED, UNCHANGED, Appearance

FREE_VIEW = "(free)"
STEPS = ("previous", "next")
# Ranges of the controls.
SIDES = {"left_right": "Left, right", "down_up": "Down, up", "front_back": "Front, back"}
"""Label of each slider of the crop box."""
EXPOSURE = (-STOPS, STOPS)
STRENGTH = (0.0, 2.0)
TURN = (-180, 180)
SECONDS = (0.5, 10.0)
CROP = (-150, 150)
WIPE = (0, 100)


@dataclass(frozen=True)
class PanelOptions:
    """Options of a panel.

    Attributes:
        layers: layers of the shading model.
        turns: True if the environment can be rotated.
        views: names of the photographs.
        trains: True if the panel can pause a training.
        presentation: the saved presentation.
        saves: True if the presentation is saved to the run. Otherwise the browser downloads it.
    """

    layers: Sequence[str]
    turns: bool
    views: Sequence[str]
    trains: bool
    presentation: Presentation = UNCHANGED
    saves: bool = False


class Control(NamedTuple):
    """Description of a control.

    Attributes:
        kind: kind of control: the name of viser's method without ``add_``.
        label: text next to the control.
        arguments: further positional arguments of the method.
        accepts: function that validates a value from a browser, or None if the control is read-only.
        options: keyword arguments of the method.
    """

    kind: str
    label: str
    arguments: tuple[Any, ...] = ()
    accepts: Accepts | None = push
    options: Mapping[str, Any] = {}


def controls_of(options: PanelOptions) -> dict[str, dict[str, Control]]:
    """Return the controls of a panel by folder and name. An empty folder label stands for the panel itself."""
    presentation = options.presentation
    layers = (*options.layers, *MEASURED)
    views = (FREE_VIEW, *options.views)
    return {
        "": {
            "pause": Control("checkbox", "Pause training", (False,), flag, {"visible": options.trains}),
            "layer": Control("dropdown", "Layer", (layers,), choice(layers), {
                "hint": f"From {MEASURED[0]} on, a photograph's pose is needed; stokes, dolp and aolp are predicted"}),
            "exposure": Control("slider", "Exposure", (*EXPOSURE, 0.1, presentation.exposure or 0.0),
                                number(*EXPOSURE), {"hint": "In stops"}),
            "strength": Control("slider", "Reflection", (*STRENGTH, 0.05, 1.0), number(*STRENGTH), {
                "visible": "specular" in layers}),
            "turn": Control("slider", "Environment", (*TURN, 1, 0), number(*TURN), {
                "hint": "Rotates the environment light, in degrees; the scene stays", "visible": options.turns}),
        },
        "Photographs": {
            "view": Control("dropdown", "Go to", (views,), choice(views)),
            "step": Control("button_group", "", (STEPS,), choice(STEPS)),
            "frusta": Control("checkbox", "Show cameras", (True,), flag),
            "wipe": Control("slider", "Wipe", (*WIPE, 1, 0), number(*WIPE), {
                "hint": "In percent of the width, from the left: the run beside, else what was measured at this pose"}),
        },
        "Crop": {
            "crop": Control("checkbox", "Crop", (presentation.crop is not None,), flag),
            "box": Control("checkbox", "Show box", (False,), flag),
            **{
                name: Control("multi_slider", SIDES[name], (*CROP, 1, sides), pair(*CROP), {"min_range": 1})
                for name, sides in zip(SIDES, _percent(presentation.crop), strict=True)
            },
            "save": Control("button", "Save to the run" if options.saves else "Download", options={
                "hint": "Crop and exposure, for pages, exports and renderings"}),
        },
        "Picture and camera path": {
            "screenshot": Control("button", "Save picture"),
            "keyframes": Control("text", "Keyframes", ("0",), None, {"disabled": True}),
            "add_keyframe": Control("button", "Add keyframe"),
            "remove_keyframe": Control("button", "Remove last keyframe"),
            "seconds": Control("slider", "Seconds per segment", (*SECONDS, 0.5, 2.0), number(*SECONDS)),
            "save_path": Control("button", "Save path"),
        },
    }  # fmt: skip


class Panel:
    """Controls of one session. A control is accessed by its name, such as ``panel["layer"].value``.

    Names of views come from files. They are shown as plain text, because Markdown in the browser may run code.

    Attributes:
        accepts: functions that validate values from a browser, by the name of the control in viser.
        changed: callback after every change of the picture.

    Args:
        gui: viser's handle of the session's controls.
        options: options of the panel.
        changed: callback after every change of the picture.
        drop: callback that receives the exception of another callback.
        folded: True to place the controls in a closed folder. On a phone, viser's panel is open at first and covers
            half of the picture, and the server cannot close it.
    """

    def __init__(
        self,
        gui: Any,
        options: PanelOptions,
        changed: Callable[[], None],
        drop: Callable[[Exception], None],
        *,
        folded: bool = False,
    ) -> None:
        self.accepts: dict[str, Accepts] = {}
        self.changed = changed
        self._drop = drop
        self._controls: dict[str, Any] = {}
        self._saved = options.presentation
        # The saved box has more exact sides than the sliders' steps. It applies until a slider moves.
        self._saved_crop = options.presentation.crop
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._status = gui.add_markdown("")
        self._lines = tuple[str, ...]()
        self._note = ""
        with gui.add_folder("Controls", expand_by_default=False) if folded else nullcontext():
            for folder, controls in controls_of(options).items():
                unfolded = folder == "Photographs"
                with (
                    gui.add_folder(folder, expand_by_default=unfolded)
                    if folder and controls
                    else nullcontext()
                ):
                    for name, control in controls.items():
                        self._add(gui, name, control)
        for name in SIDES:
            self.listen(name, self._forget_saved_crop)
        for name in ("layer", "exposure", "strength", "turn", "wipe", "crop", "box", *SIDES):
            self.listen(name, changed)

    def __getitem__(self, name: str) -> Any:
        return self._controls[name]

    def _add(self, gui: Any, name: str, control: Control) -> None:
        handle = getattr(gui, f"add_{control.kind}")(control.label, *control.arguments, **control.options)
        self._controls[name] = handle
        if control.accepts is not None:
            self.accepts[handle._impl.uuid] = control.accepts

    def listen(self, name: str, act: Callable[[], None]) -> None:
        """Call a function when a visitor changes a control or presses a button."""
        control = self._controls[name]
        subscribe = control.on_click if hasattr(control, "on_click") else control.on_update
        subscribe(self.caught(act))

    def caught(self, act: Callable[[], None]) -> Callable[[Any], None]:
        """Wrap a function as a callback whose errors close only the connection of this browser."""

        def called(_: Any) -> None:
            try:
                act()
            except Exception as error:
                self._drop(error)

        return called

    def _forget_saved_crop(self) -> None:
        self._saved_crop = None

    def show_note(self, note: str) -> None:
        """Show a note below the status. The note must not contain names from files."""
        self._note = note
        self.show_status(*self._lines)

    def show_status(self, *lines: str) -> None:
        """Show status lines. The lines must not contain names from files."""
        self._lines = lines
        text = "  \n".join((*lines, f"**{self._note}**") if self._note else lines)
        if self._status.content != text:
            self._status.content = text

    def crop(self) -> Crop | None:
        """Return the crop box, or None without cropping. Its up axis is the up axis of the saved presentation."""
        if not self["crop"].value:
            return None
        if self._saved_crop is not None:
            return self._saved_crop
        left_right, down_up, front_back = (self[name].value for name in SIDES)
        low = (left_right[0] / 100, down_up[0] / 100, front_back[0] / 100)
        # A message may make both ends equal.
        high = tuple(max(side[1], side[0] + 1) / 100 for side in (left_right, down_up, front_back))
        return Crop(low, (high[0], high[1], high[2]), self._saved.up_axis)

    def presentation(self) -> Presentation:
        """Return the saved presentation with exposure and crop box from the panel."""
        crop = self.crop()
        exposure = float(self["exposure"].value) or None
        whole = self._saved.whole and crop is None
        return msgspec.structs.replace(self._saved, exposure=exposure, crop=crop, whole=whole)

    def appearance(self) -> Appearance:
        """Return the appearance of the picture, from the controls of the panel and the saved presentation."""
        return Appearance(
            layer=self["layer"].value,
            strength=float(self["strength"].value),
            turn=float(self["turn"].value),
            wipe=float(self["wipe"].value) / 100,
            presentation=self.presentation(),
        )


def _percent(crop: Crop | None) -> list[tuple[int, int]]:
    """Convert a crop box to the positions of its sliders."""
    if crop is None:
        return [(-40, 40)] * 3
    percents = []
    for low, high in zip(crop.low, crop.high, strict=True):
        first = min(max(round(100 * low), CROP[0]), CROP[1] - 1)
        percents.append((first, max(first + 1, min(round(100 * high), CROP[1]))))
    return percents
