"""White, up, scale: how a visitor picks them in the picture, and what follows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from polarguide.capture.presentation import Presentation, Vector, shown_length
from polarguide.core.errors import PolarguideError
from polarguide.results.rendering.picking import SurfacePoint, gains_of
from polarguide.viewer.messages import Accepts, choice, number, push

AS_PHOTOGRAPHED, GRAY_WORLD, PICKED = WHITES = ("as photographed", "gray world", "picked")
OF_CHART = "color chart"
KNOWN_LENGTH = (0.001, 1e8)  # millimeters
LINE_COLOR = (255, 80, 40)
ASKS = {
    "white": "Click on something white or gray",
    "level": "Click on a level surface",
    "length": "Click on one end of a known length",
}
PICKS = tuple(ASKS)
AS_SHOWN, OF_CAMERAS = UPS = ("as shown", "of cameras")


class Clicks:
    """Clicks into the picture of one browser, taken while a tool wants them.

    Args:
        client: viser's handle. caught: makes callbacks whose faults cost only this browser.
        clicked: called with the place, in shares of the picture's width and height.
    """

    def __init__(
        self,
        client: Any,
        caught: Callable[[Callable[[], None]], Callable[[Any], None]],
        clicked: Callable[[Sequence[float]], None],
    ) -> None:
        self._client = client
        self._wanted = False

        def heard(event: Any) -> None:
            caught(lambda: clicked(event.screen_pos))(None)

        self._heard = heard

    @property
    def wanted(self) -> bool:
        """Whether clicks are taken."""
        return self._wanted

    def want(self, wanted: bool) -> None:
        """Take clicks, or no more."""
        if wanted and not self._wanted:
            self._client.scene.on_click()(self._heard)
        elif self._wanted and not wanted:
            self._client.scene.remove_click_callback(self._heard)
        self._wanted = wanted


class PresentingControls:
    """The controls of one session.

    Attributes:
        accepts: what a browser may set each control to, as of ``Panel``.

    Args:
        gui: viser's handle of the session's controls. presentation: as it was saved. saves: whether saving writes a
            file of the run, rather than one that the browser downloads.
    """

    def __init__(self, gui: Any, presentation: Presentation, *, saves: bool) -> None:
        charted = presentation.chart is not None
        whites = (*WHITES, OF_CHART) if charted else WHITES
        initial = AS_PHOTOGRAPHED if presentation.white_balance is None else PICKED
        with gui.add_folder("White, up, scale", expand_by_default=False):
            self.white = gui.add_dropdown(
                "White",
                whites,
                initial_value=OF_CHART if charted else initial,
                hint="For display; the data stay as they are",
            )
            hint = (
                "Something white or gray; a level surface, whose normal becomes up; or the ends of a length"
            )
            self.pick = gui.add_button_group("Pick", PICKS, hint=hint)
            self.up = gui.add_button_group("Up", UPS, hint="As this picture has it, or as the cameras say")
            self.measured = gui.add_text("Length", "", disabled=True)
            self.length = gui.add_number("Known, mm", 100.0, min=KNOWN_LENGTH[0], max=KNOWN_LENGTH[1])
            self.set_scale = gui.add_button("Set scale", hint="The picked length is as long as known")
            hint = "White, up, scale and crop, for pages, exports and renderings"
            self.save = gui.add_button("Save to the run" if saves else "Download them", hint=hint)
        controls: list[tuple[Any, Accepts]] = [
            (self.white, choice(whites)),
            (self.pick, choice(PICKS)),
            (self.up, choice(UPS)),
            (self.length, number(*KNOWN_LENGTH)),
            (self.set_scale, push),
            (self.save, push),
        ]
        self.accepts = {control._impl.uuid: accepts for control, accepts in controls}


class Presenting:
    """One session's presentation, and its pending pick.

    Callbacks only record; the rendering thread calls ``take_click`` and ``found``.

    Attributes:
        chosen: white, up, scale and credit. The crop box is the panel's.
        note: what the visitor should do or know next, without any name from files.

    Args:
        client: viser's handle. controls: controls of its panel. presentation: as it was saved.
        gray_world: gives the gains of the photographs' mean. save: writes what was chosen, and says what it did.
        distance: distance of the cameras.
        changed: called after every change that affects the picture, and when a click waits. noted: when there is
            another note.
        caught: makes callbacks whose faults cost only this browser.
    """

    def __init__(
        self,
        client: Any,
        controls: PresentingControls,
        presentation: Presentation,
        *,
        gray_world: Callable[[], Vector],
        save: Callable[[], str],
        distance: float,
        changed: Callable[[], None],
        noted: Callable[[], None],
        caught: Callable[[Callable[[], None]], Callable[[Any], None]],
    ) -> None:
        self._client = client
        self._controls = controls
        self._gray_world = gray_world
        self._changed = changed
        self._distance = distance
        self.chosen = presentation
        self.note = ""
        self._noted = noted
        self._picked_white = presentation.white_balance
        self._chart = presentation.chart
        self._picking = ""
        self._clicks = Clicks(client, caught, self._click)
        self._clicked: tuple[str, float, float] | None = None
        self._ends: list[Tensor] = []
        self._line: Any = None
        controls.white.on_update(caught(self._white_chosen))
        controls.pick.on_click(caught(lambda: self._ask(controls.pick.value)))
        controls.up.on_click(caught(self._up_chosen))
        controls.set_scale.on_click(caught(self._set_scale))
        controls.save.on_click(caught(lambda: self._say(save())))

    @property
    def waits(self) -> bool:
        """Whether a click waits to be looked up."""
        return self._clicked is not None

    @property
    def picks(self) -> bool:
        """Whether the next click is a pick."""
        return self._clicks.wanted

    def take_click(self) -> tuple[float, float] | None:
        """Where was clicked, in shares of the picture's width and height; None: nowhere."""
        return None if self._clicked is None else self._clicked[1:]

    def found(self, place: SurfacePoint | None) -> None:
        """The surface at the clicked pixel."""
        if self._clicked is None:
            return
        what = self._clicked[0]
        self._clicked = None
        if place is None:
            self._say("Nothing is there. " + ASKS[what])
        elif what == "white":
            self._white_found(place.color)
        elif what == "level":
            if place.normal is None:
                self._say("No normal is known there. " + ASKS[what])
                return
            x, y, z = place.normal.tolist()
            self._listen("")
            self._set_up((x, y, z))
        else:
            self._end_found(place.point)

    def _say(self, text: str) -> None:
        self.note = text
        self._noted()

    def _ask(self, what: str) -> None:
        if what == "length":
            self._ends = []
            self._draw_line()
        self._listen(what)
        self._say(ASKS[what])

    def _listen(self, what: str) -> None:
        """Take clicks for something, or no more."""
        self._picking = what
        self._clicks.want(bool(what))

    def _click(self, place: Sequence[float]) -> None:
        if self._picking and self._clicked is None:
            self._clicked = self._picking, float(place[0]), float(place[1])
            self._changed()

    def _white_chosen(self) -> None:
        choice = self._controls.white.value
        if choice == PICKED and self._picked_white is None:
            self._ask("white")
            return
        try:
            gains = {AS_PHOTOGRAPHED: None, PICKED: self._picked_white}.get(choice) or (
                self._gray_world() if choice == GRAY_WORLD else None
            )
        except PolarguideError as error:
            self._say(f"Expected {error.expected}")
            return
        self._choose(white_balance=gains, chart=self._chart if choice == OF_CHART else None)

    def _white_found(self, color: Tensor) -> None:
        try:
            self._picked_white = gains_of(color)
        except PolarguideError as error:
            self._say(f"Expected {error.expected}")
            return
        self._listen("")
        self._choose(white_balance=self._picked_white, chart=None)
        self._controls.white.value = PICKED
        self._say("White: gains " + ", ".join(f"{gain:.3g}" for gain in self._picked_white))

    def _up_chosen(self) -> None:
        if self._controls.up.value == OF_CAMERAS:
            self._set_up(None)
            return
        w, x, y, z = (float(value) for value in self._client.camera.wxyz)
        up = -Rotation.from_quat([x, y, z, w]).as_matrix()[:, 1]
        self._set_up((float(up[0]), float(up[1]), float(up[2])))

    def _set_up(self, up: Vector | None) -> None:
        self._choose(up_axis=up)
        self.turn_upright()
        self._say("Up: as the cameras say" if up is None else "Up: chosen")

    def turn_upright(self) -> None:
        """Let the browser's camera turn about the chosen axis, if there is one."""
        if self.chosen.up_axis is not None:
            self._client.camera.up_direction = np.array(self.chosen.up_axis)

    def _end_found(self, point: Tensor) -> None:
        self._ends.append(point)
        self._draw_line()
        if len(self._ends) == 1:
            self._say("Click on the other end")
            return
        self._listen("")
        self._show_length()
        self._say(f"Length: {self._controls.measured.value}")

    def _show_length(self) -> None:
        if len(self._ends) == 2:
            apart = float((self._ends[0] - self._ends[1]).norm())
            self._controls.measured.value = shown_length(apart, self.chosen.meters_per_unit)

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
            self._say("Pick a length first")
            return
        self._choose(meters_per_unit=1e-3 * float(self._controls.length.value) / apart)
        self._show_length()
        self._say(f"1 unit is {shown_length(1.0, self.chosen.meters_per_unit)}")

    def _choose(self, **fields: Any) -> None:
        self.chosen = msgspec.structs.replace(self.chosen, **fields)
        self._changed()
