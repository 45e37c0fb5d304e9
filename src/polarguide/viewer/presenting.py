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
from polarguide.results.rendering.picking import SurfacePoint, white_balance_gains
from polarguide.viewer.panel import GRAY_WORLD, OF_CAMERAS, OF_CHART, PICKED, Panel

LINE_COLOR = (255, 80, 40)
ASKS = {
    "white": "Click on something white or gray",
    "level": "Click on a level surface",
    "length": "Click on one end of a known length",
}
"""Request for a click by what is picked."""


class Clicks:
    """Clicks into the picture of one browser, taken while a tool wants them.

    Attributes:
        wanted: whether clicks are taken.

    Args:
        client: viser's handle. panel: controls of the session.
        clicked: called with the place, in shares of the picture's width and height.
    """

    def __init__(self, client: Any, panel: Panel, clicked: Callable[[Sequence[float]], None]) -> None:
        self._client = client
        self.wanted = False

        def heard(event: Any) -> None:
            panel.caught(lambda: clicked(event.screen_pos))(None)

        self._heard = heard

    def want(self, wanted: bool) -> None:
        """Take clicks, or no more."""
        if wanted and not self.wanted:
            self._client.scene.on_click()(self._heard)
        elif self.wanted and not wanted:
            self._client.scene.remove_click_callback(self._heard)
        self.wanted = wanted


class Presenting:
    """One session's presentation, and its pending pick.

    Callbacks only record; the rendering thread calls ``take_click`` and ``found``.

    Attributes:
        chosen: white, up, scale and credit. The crop box is the panel's.

    Args:
        client: viser's handle. panel: controls of the session. presentation: as it was saved.
        gray_world: gives the gains of the photographs' mean. save: writes what was chosen, and says what it did.
        distance: distance of the cameras.
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
        """Take clicks for something, or no more."""
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
        """Let the browser's camera turn about the chosen axis, if there is one."""
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
