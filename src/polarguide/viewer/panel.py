"""Control panel of a session, with clicks that select white balance, up axis and scale."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from polarguide.capture.presentation import STOPS, Crop, Presentation, Vector, shown_length
from polarguide.core.errors import PolarguideError
from polarguide.results.rendering.picking import SurfacePoint, white_balance_gains
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
KNOWN_LENGTH = (0.001, 1e8)
"""Valid range of the known length, in millimeters."""
SIZE = (0.5, 20.0)
REACH = (0.5, 30.0)
# Choices of the controls.
AS_PHOTOGRAPHED, GRAY_WORLD, PICKED = WHITES = ("as photographed", "gray world", "picked")
OF_CHART = "color chart"
PICKS = ("white", "level", "length")
AS_SHOWN, OF_CAMERAS = UPS = ("as shown", "of cameras")
OFF, SURFACE, BRUSH = TOOLS = ("off", "surface", "brush")
UNPAINTED, DIELECTRIC, METAL = KINDS = ("not painted", "dielectric", "metal")


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
        kinds: numbers of the materials that can be painted. Without materials, the panel has no painting tool.
    """

    layers: Sequence[str]
    turns: bool
    views: Sequence[str]
    trains: bool
    presentation: Presentation = UNCHANGED
    saves: bool = False
    kinds: Mapping[str, int] = field(default_factory=dict)


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
    whites = WHITES if presentation.chart is None else (*WHITES, OF_CHART)
    white = AS_PHOTOGRAPHED if presentation.white_balance is None else PICKED
    kinds = tuple(options.kinds)
    painting = {
        "tool": Control("dropdown", "Paint", (TOOLS,), choice(TOOLS), {
            "initial_value": OFF, "hint": "A click paints a connected surface, or a disc"}),
        "kind": Control("dropdown", "As", (kinds,), choice(kinds), {"initial_value": METAL}),
        "size": Control("slider", "Size", (*SIZE, 0.5, 1.0), number(*SIZE), {
            "hint": "Size of the disc in percent of the picture's height"}),
        "reach": Control("slider", "Reach", (*REACH, 0.5, 4.0), number(*REACH), {
            "hint": "Tolerated difference of neighbors on a surface"}),
        "undo": Control("button", "Undo"),
        "save_materials": Control("button", "Save materials to the run", options={
            "hint": "polarguide train --resume then goes on with them"}),
    }  # fmt: skip
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
        },
        "White, up, scale": {
            "white": Control("dropdown", "White", (whites,), choice(whites), {
                "initial_value": white if presentation.chart is None else OF_CHART,
                "hint": "For display; the data stay as they are"}),
            "pick": Control("button_group", "Pick", (PICKS,), choice(PICKS), {
                "hint": "Something white or gray; a level surface, whose normal becomes up; or the ends of a length"}),
            "up": Control("button_group", "Up", (UPS,), choice(UPS), {
                "hint": "As this picture has it, or as the cameras say"}),
            "measured": Control("text", "Length", ("",), None, {"disabled": True}),
            "length": Control("number", "Known, mm", (100.0,), number(*KNOWN_LENGTH), {
                "min": KNOWN_LENGTH[0], "max": KNOWN_LENGTH[1]}),
            "set_scale": Control("button", "Set scale", options={"hint": "The picked length is as long as known"}),
            "save": Control("button", "Save to the run" if options.saves else "Download them", options={
                "hint": "White, up, scale and crop, for pages, exports and renderings"}),
        },
        "Materials": painting if options.kinds else {},
        "Picture and camera path": {
            "screenshot": Control("button", "Save picture"),
            "keyframes": Control("text", "Keyframes", ("0",), None, {"disabled": True}),
            "add_keyframe": Control("button", "Add keyframe"),
            "remove_keyframe": Control("button", "Remove last keyframe"),
            "seconds": Control("slider", "Seconds per segment", (*SECONDS, 0.5, 2.0), number(*SECONDS)),
            "play": Control("button", "Play"),
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
        """Wrap a function as a callback that shows errors in the visitor's input as a note.

        Other errors close only the connection of this browser.
        """

        def called(_: Any) -> None:
            try:
                act()
            except PolarguideError as error:
                self.show_note(f"Expected {error.expected}")
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

    def crop(self, up_axis: Vector | None = None) -> Crop | None:
        """Return the crop box, or None without cropping. Without ``up_axis``, the cameras' up axis is used."""
        if not self["crop"].value:
            return None
        if self._saved_crop is not None:
            return self._saved_crop
        left_right, down_up, front_back = (self[name].value for name in SIDES)
        low = (left_right[0] / 100, down_up[0] / 100, front_back[0] / 100)
        # A message may make both ends equal.
        high = tuple(max(side[1], side[0] + 1) / 100 for side in (left_right, down_up, front_back))
        return Crop(low, (high[0], high[1], high[2]), up_axis)

    def presentation(self, chosen: Presentation) -> Presentation:
        """Return a presentation with exposure and crop box from the panel."""
        crop = self.crop(chosen.up_axis)
        exposure = float(self["exposure"].value) or None
        return msgspec.structs.replace(
            chosen, exposure=exposure, crop=crop, whole=chosen.whole and crop is None
        )

    def appearance(self, chosen: Presentation) -> Appearance:
        """Return the appearance of the picture, from the controls of the panel and the visitor's presentation."""
        return Appearance(
            layer=self["layer"].value,
            strength=float(self["strength"].value),
            turn=float(self["turn"].value),
            wipe=float(self["wipe"].value) / 100,
            presentation=self.presentation(chosen),
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


LINE_COLOR = (255, 80, 40)
ASKS = {
    "white": "Click on something white or gray",
    "level": "Click on a level surface",
    "length": "Click on one end of a known length",
}
"""Text that requests a click, for each quantity that a click sets."""


class Clicks:
    """Receiver of clicks into the picture of one browser, active only while a tool needs them.

    Attributes:
        wanted: True if clicks are received.

    Args:
        client: viser's handle.
        panel: controls of the session.
        clicked: callback that receives the position of a click, as shares of the picture's width and height.
    """

    def __init__(self, client: Any, panel: Panel, clicked: Callable[[Sequence[float]], None]) -> None:
        self._client = client
        self.wanted = False

        def heard(event: Any) -> None:
            panel.caught(lambda: clicked(event.screen_pos))(None)

        self._heard = heard

    def want(self, wanted: bool) -> None:
        """Start or stop receiving clicks."""
        if wanted and not self.wanted:
            self._client.scene.on_click()(self._heard)
        elif self.wanted and not wanted:
            self._client.scene.remove_click_callback(self._heard)
        self.wanted = wanted


class Presenting:
    """Presentation that a visitor chooses in one session, by controls and by clicks into the picture.

    Callbacks only record the actions of the visitor. The rendering thread calls ``take_click`` and ``found``.

    Attributes:
        chosen: white balance, up axis, scale and credit. Crop box and exposure are stored in the panel.

    Args:
        client: viser's handle.
        panel: controls of the session.
        presentation: the saved presentation.
        gray_world: function that returns white balance gains which make the mean of the photographs gray.
        save: function that writes the presentation and returns a message.
        distance: distance of the cameras from the scene's center.
    """

    def __init__(
        self,
        client: Any,
        panel: Panel,
        presentation: Presentation,
        *,
        gray_world: Callable[[], Vector],
        save: Callable[[], str],
        distance: float,
    ) -> None:
        self._client = client
        self._panel = panel
        self._gray_world = gray_world
        self._distance = distance
        self.chosen = presentation
        self._picked_white = presentation.white_balance
        self._chart = presentation.chart
        self._picking = ""
        self._clicks = Clicks(client, panel, self._click)
        self._clicked: tuple[str, float, float] | None = None
        self._ends: list[Tensor] = []
        self._line: Any = None
        panel.listen("white", self._white_chosen)
        panel.listen("pick", lambda: self._ask(panel["pick"].value))
        panel.listen("up", self._up_chosen)
        panel.listen("set_scale", self._set_scale)
        panel.listen("save", lambda: panel.show_note(save()))

    @property
    def waits(self) -> bool:
        """True if a click has not been processed yet."""
        return self._clicked is not None

    @property
    def picks(self) -> bool:
        """True if the next click sets a quantity of the presentation."""
        return self._clicks.wanted

    def take_click(self) -> tuple[float, float] | None:
        """Return the pending click as shares of the picture's width and height, or None without a click."""
        return None if self._clicked is None else self._clicked[1:]

    def found(self, place: SurfacePoint | None) -> None:
        """Set the quantity for which the visitor clicked, from the surface at the clicked pixel."""
        if self._clicked is None:
            return
        what = self._clicked[0]
        self._clicked = None
        if place is None:
            self._panel.show_note("Nothing is there. " + ASKS[what])
        elif what == "white":
            self._white_found(place.color)
        elif what == "level":
            if place.normal is None:
                self._panel.show_note("No normal is known there. " + ASKS[what])
                return
            x, y, z = place.normal.tolist()
            self._listen("")
            self._set_up((x, y, z))
        else:
            self._end_found(place.point)

    def _ask(self, what: str) -> None:
        if what == "length":
            self._ends = []
            self._draw_line()
        self._listen(what)
        self._panel.show_note(ASKS[what])

    def _listen(self, what: str) -> None:
        """Start to receive clicks for the quantity ``what``. An empty text stops it."""
        self._picking = what
        self._clicks.want(bool(what))

    def _click(self, place: Sequence[float]) -> None:
        if self._picking and self._clicked is None:
            self._clicked = self._picking, float(place[0]), float(place[1])
            self._panel.changed()

    def _white_chosen(self) -> None:
        choice = self._panel["white"].value
        if choice == PICKED and self._picked_white is None:
            self._ask("white")
            return
        gains = {PICKED: self._picked_white}.get(choice)
        if choice == GRAY_WORLD:
            gains = self._gray_world()
        self._choose(white_balance=gains, chart=self._chart if choice == OF_CHART else None)

    def _white_found(self, color: Tensor) -> None:
        self._picked_white = white_balance_gains(color)
        self._listen("")
        self._choose(white_balance=self._picked_white, chart=None)
        self._panel["white"].value = PICKED
        self._panel.show_note("White: gains " + ", ".join(f"{gain:.3g}" for gain in self._picked_white))

    def _up_chosen(self) -> None:
        if self._panel["up"].value == OF_CAMERAS:
            self._set_up(None)
            return
        w, x, y, z = (float(value) for value in self._client.camera.wxyz)
        up = -Rotation.from_quat([x, y, z, w]).as_matrix()[:, 1]
        self._set_up((float(up[0]), float(up[1]), float(up[2])))

    def _set_up(self, up: Vector | None) -> None:
        self._choose(up_axis=up)
        self.turn_upright()
        self._panel.show_note("Up: as the cameras say" if up is None else "Up: chosen")

    def turn_upright(self) -> None:
        """Align the browser's camera with the chosen up axis. Without one, the camera does not move."""
        if self.chosen.up_axis is not None:
            self._client.camera.up_direction = np.array(self.chosen.up_axis)

    def _end_found(self, point: Tensor) -> None:
        self._ends.append(point)
        self._draw_line()
        if len(self._ends) == 1:
            self._panel.show_note("Click on the other end")
            return
        self._listen("")
        self._show_length()
        self._panel.show_note(f"Length: {self._panel['measured'].value}")

    def _show_length(self) -> None:
        if len(self._ends) == 2:
            apart = float((self._ends[0] - self._ends[1]).norm())
            self._panel["measured"].value = shown_length(apart, self.chosen.meters_per_unit)

    def _draw_line(self) -> None:
        if self._line is not None:
            self._line.remove()
            self._line = None
        if not self._ends:
            return
        ends = torch.stack(self._ends).numpy()
        size = 0.012 * self._distance * np.eye(3)
        marks = [(end - side, end + side) for end in ends for side in size]
        segments = [*marks, *([tuple(ends)] if len(ends) == 2 else [])]
        points = np.array(segments, dtype=np.float32)
        self._line = self._client.scene.add_line_segments(
            "/measured", points, LINE_COLOR, thickness=0.003 * self._distance
        )

    def _set_scale(self) -> None:
        apart = float((self._ends[0] - self._ends[1]).norm()) if len(self._ends) == 2 else 0.0
        if apart <= 0:
            self._panel.show_note("Pick a length first")
            return
        self._choose(meters_per_unit=1e-3 * float(self._panel["length"].value) / apart)
        self._show_length()
        self._panel.show_note(f"1 unit is {shown_length(1.0, self.chosen.meters_per_unit)}")

    def _choose(self, **fields: Any) -> None:
        self.chosen = msgspec.structs.replace(self.chosen, **fields)
        self._panel.changed()
