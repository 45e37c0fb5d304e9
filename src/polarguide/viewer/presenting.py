"""Picking of white, up axis and scale in the picture."""

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
"""Request for a click by the picked quantity."""


class Clicks:
    """Clicks into the picture of one browser, received while a tool needs them.

    Attributes:
        wanted: whether clicks are received.

    Args:
        client: viser's handle.
        panel: controls of the session.
        clicked: callback with the place, in shares of the picture's width and height.
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
    """Presentation of one session, and its pending pick.

    Callbacks only record; the rendering thread calls ``take_click`` and ``found``.

    Attributes:
        chosen: white balance, up axis, scale and credit. The panel has the crop box and the exposure.

    Args:
        client: viser's handle.
        panel: controls of the session.
        presentation: the saved presentation.
        gray_world: returns the gains that make the photographs' mean gray.
        save: writes the presentation and returns a message.
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
        """True if a click is pending."""
        return self._clicked is not None

    @property
    def picks(self) -> bool:
        """True if the next click is a pick."""
        return self._clicks.wanted

    def take_click(self) -> tuple[float, float] | None:
        """Return the pending click in shares of the picture's width and height, or None."""
        return None if self._clicked is None else self._clicked[1:]

    def found(self, place: SurfacePoint | None) -> None:
        """Use the surface at the clicked pixel for the pending pick."""
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
        """Start or stop receiving clicks for a quantity."""
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
        """Align the browser's camera with the chosen up axis, if there is one."""
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
