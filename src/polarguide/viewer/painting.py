"""Painting of materials on Gaussians, in a disc around a click or on a connected surface, with undo."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from polarguide.capture import View
from polarguide.gaussians.gaussians import Gaussians
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.harmonics import SH_C0
from polarguide.geometry.camera import Camera
from polarguide.geometry.vectors import dot, unit
from polarguide.raster import Rasterize
from polarguide.shading.gbuffer import splats
from polarguide.training.metals.observations import shares
from polarguide.viewer.panel import BRUSH, OFF, Clicks, Panel
from polarguide.visualization.figures import Picture

ASK = "Click on a surface"
TINTS = np.array([(0, 0, 0), (40, 120, 255), (255, 190, 0), (0, 200, 120)], np.float32)
"""Colors in which unpainted parts, dielectrics, metals, and dielectrics with their own index are shown."""
TINTED = 0.5
LOOKED_AT = 360
"""Largest height of the pictures that are rendered to find the clicked Gaussians, in pixels."""
SMALLEST = 0.01
"""Minimum number of pixels that a visible Gaussian fills in such a picture."""
SHARE = 0.25
"""Share of the largest Gaussian's pixels in a disc that a Gaussian must fill so that a surface grows from it."""
NEIGHBORS = 16
"""Number of neighboring Gaussians over which normals and colors are averaged."""
LINKS = 8
"""Number of neighbors of each Gaussian in the graph."""
CHUNK = 1 << 16  # number of Gaussians per batch
TURN = 0.25
"""Standard deviation of the angle between neighboring normals, in radians."""
COLOR = 0.3
"""Standard deviation of the logarithm of neighboring colors.

The length of an edge in the graph is half the sum of the squared differences of normals and colors in these units.
"""
DARK = 0.02  # offset of radiance before the logarithm
MOST_UNDONE = 50


class Materials:
    """Materials of a model's Gaussians that a visitor paints.

    Attributes:
        kinds: [N] uint8: 0 unpainted, 1 dielectric, 2 metal, from 3 on the dielectrics of ``scene.json``.

    Args:
        gaussians: Gaussians of the model.
        rasterize: rasterizer of its backend.
        kinds: function that returns the initial ``kinds``. It is called once.
    """

    def __init__(
        self, gaussians: Gaussians, rasterize: Rasterize, kinds: Callable[[], Tensor] | None = None
    ) -> None:
        self._gaussians = {name: gaussians[name].detach() for name in gaussians.names}
        self._rasterize = rasterize
        count = len(self._gaussians["means"])
        self.kinds = torch.zeros(count, dtype=torch.uint8) if kinds is None else kinds()
        self._before: list[Tensor] = []

    def brush(self, camera: Camera, place: Sequence[float], size: float, kind: int) -> int:
        """Paint the Gaussians that are visible in a disc of a picture, and return their number.

        Args:
            camera: camera of the picture.
            place: center of the disc, as shares of width and height.
            size: radius in percent of the height.
            kind: number of the material.
        """
        inside, all_of_it = self._painted(camera, place, size)
        return self._paint((all_of_it > SMALLEST) & (inside >= 0.5 * all_of_it), kind)

    def surface(self, camera: Camera, place: Sequence[float], size: float, reach: float, kind: int) -> int:
        """Paint the connected surface around the Gaussians that are visible in a disc; see ``brush``.

        A Gaussian belongs to the surface if a path of neighbors leads to it. The length of a step is the difference of
        normals and colors of both Gaussians.

        Args:
            reach: largest length of a path.
        """
        inside, _ = self._painted(camera, place, size)
        hit = (inside > SHARE * inside.max()).nonzero()[:, 0].numpy()
        if not len(hit):
            return 0
        lengths = dijkstra(self._graph, directed=False, indices=hit, min_only=True, limit=reach)
        return self._paint(torch.from_numpy(np.isfinite(lengths)), kind)

    def undo(self) -> bool:
        """Undo the last stroke. Return False if there is no stroke."""
        if self._before:
            self.kinds = self._before.pop()
            return True
        return False

    def picture(self, camera: Camera) -> Tensor:
        """Render the number [H, W] uint8 of the material that fills at least half of each pixel, or 0 without one."""
        numbers = [number for number in self.kinds.unique().tolist() if number]
        if not numbers:
            return torch.zeros(camera.height, camera.width, dtype=torch.uint8)
        device = self._gaussians["means"].device
        features = torch.stack([self.kinds == number for number in numbers], dim=-1).float().to(device)
        with torch.no_grad():
            blended = self._rasterize(splats(self._gaussians, features), camera).features.cpu()
        share, most = blended.max(dim=-1)
        return torch.where(share >= 0.5, torch.tensor(numbers, dtype=torch.uint8)[most], 0).to(torch.uint8)

    def _paint(self, which: Tensor, kind: int) -> int:
        self._before = [*self._before[1 - MOST_UNDONE :], self.kinds]
        self.kinds = torch.where(which, torch.tensor(kind, dtype=torch.uint8), self.kinds)
        return int(which.sum())

    def _painted(self, camera: Camera, place: Sequence[float], size: float) -> tuple[Tensor, Tensor]:
        """Return how many pixels each Gaussian fills, [N], in a disc of a picture and in the whole picture."""
        scale = min(1.0, LOOKED_AT / camera.height)
        small = camera.scaled(
            scale, max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
        )
        x = place[0] * small.width
        y = place[1] * small.height
        columns = torch.arange(small.width) + 0.5
        rows = torch.arange(small.height) + 0.5
        radius = max(0.75, 0.01 * size * small.height)
        disc = (columns[None] - x) ** 2 + (rows[:, None] - y) ** 2 <= radius**2
        target = torch.stack((disc, torch.ones_like(disc)), dim=-1).float()
        device = self._gaussians["means"].device
        inside, all_of_it = shares(self._gaussians, small, target.to(device), self._rasterize).cpu().unbind(1)
        return inside, all_of_it

    @cached_property
    def _graph(self) -> csr_matrix:
        """Graph of neighboring Gaussians with their distances in normal and color.

        Normals and colors are averaged over neighborhoods, because single Gaussians are noisy.
        """
        gaussians = {name: values.cpu() for name, values in self._gaussians.items()}
        means = gaussians["means"]
        axes = shortest_axis_normals(
            means, gaussians["quaternions"], gaussians["log_scales"], means.new_zeros(3), None
        )
        colors = ((gaussians["sh_dc"] * SH_C0 + 0.5).clamp(min=0) + DARK).log()
        places = means.double().numpy()
        count = min(NEIGHBORS + 1, len(places))
        near = torch.from_numpy(cKDTree(places).query(places, k=count, workers=-1)[1].reshape(-1, count))
        axes, colors = _averaged(axes, colors, gaussians["opacity_logits"].sigmoid().view(-1), near)
        first = torch.arange(len(near)).repeat_interleave(min(LINKS, count - 1))
        second = near[:, 1 : LINKS + 1].reshape(-1)
        cosine = dot(axes[first], axes[second]).abs().clamp(max=1)
        color = (colors[first] - colors[second]).square().mean(dim=-1)
        length = 0.5 * (cosine.acos() / TURN) ** 2 + 0.5 * color / COLOR**2
        pairs = first.numpy(), second.numpy()
        return csr_matrix((length.double().numpy() + 1e-6, pairs), shape=(len(places),) * 2)


def _averaged(axes: Tensor, colors: Tensor, weights: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Average axes [N, 3] and colors [N, 3] over the neighbors [N, K] of each Gaussian, with weights [N].

    The averaged axes are normalized. Their sign is arbitrary.
    """
    parts = []
    for some in near.split(CHUNK):
        counts = weights[some][..., None]
        turned = axes[some] * dot(axes[some], axes[some[:, :1]]).sign()[..., None]
        axis = unit((turned * counts).sum(dim=1), 1e-9)
        parts.append((axis, (colors[some] * counts).sum(dim=1) / counts.sum(dim=1).clamp(min=1e-9)))
    first, second = zip(*parts, strict=True)
    return torch.cat(first), torch.cat(second)


def kinds_of(
    gaussians: Gaussians, rasterize: Rasterize, views: Sequence[View], numbers: Mapping[str, Tensor]
) -> Tensor:
    """Determine the material [N] uint8 of each Gaussian from pictures of materials.

    It is the most frequent material in the pixels that the Gaussian fills.

    Args:
        gaussians, rasterize: the model.
        views: views to which the pictures belong.
        numbers: number of the material of each pixel, [H, W] uint8, by view.
    """
    parameters = {name: gaussians[name].detach() for name in gaussians.names}
    named = sorted({0}.union(*(picture.unique().tolist() for picture in numbers.values())))
    weights = parameters["means"].new_zeros(len(parameters["means"]), len(named))
    for view in views:
        if view.name in numbers:
            target = torch.stack([numbers[view.name] == k for k in named], dim=-1).float().to(weights.device)
            weights += shares(parameters, view.camera, target, rasterize)
    return torch.tensor(named, dtype=torch.uint8)[weights.argmax(dim=1).cpu()]


@dataclass(frozen=True, eq=False)
class Paintable:
    """Materials of a run that visitors of the viewer can paint.

    Attributes:
        materials: function that returns the initial materials of a session.
        kinds: numbers of materials by name.
        save: function that writes materials to the run and returns a message.
    """

    materials: Callable[[], Materials]
    kinds: Mapping[str, int]
    save: Callable[[Materials], str]


class Painting:
    """Painting tool of one session.

    Callbacks only record the actions of the visitor. The rendering thread executes them with ``act``.

    Args:
        client: viser's handle.
        panel: controls of the session.
        paintable: materials that can be painted.
        busy: function that returns True if another tool receives the clicks.
    """

    def __init__(self, client: Any, panel: Panel, paintable: Paintable, *, busy: Callable[[], bool]) -> None:
        self._panel = panel
        self._paintable = paintable
        self._busy = busy
        self._materials: Materials | None = None
        self._clicks = Clicks(client, panel, self._click)
        self._todo: list[Callable[[Materials, Camera], str]] = []
        panel.listen("tool", self._tool_chosen)
        panel.listen("undo", lambda: self._later(self._undone))
        panel.listen("save_materials", lambda: self._later(lambda painted, _: paintable.save(painted)))

    @property
    def waits(self) -> bool:
        """True if a recorded action has not been executed yet."""
        return bool(self._todo)

    def act(self, camera: Camera) -> None:
        """Execute the recorded actions.

        Args:
            camera: camera of the picture in which the visitor clicked.
        """
        todo = self._todo
        self._todo = []
        for each in todo:
            if self._materials is None:
                self._materials = self._paintable.materials()
            self._panel.show_note(each(self._materials, camera))

    def tinted(self, picture: Picture, camera: Camera) -> Picture:
        """Tint a picture in the colors of the painted materials."""
        if self._materials is None or not bool(self._materials.kinds.any()):
            return picture
        numbers = self._materials.picture(camera).numpy().clip(max=len(TINTS) - 1)
        share = TINTED * (numbers > 0)[..., None]
        mixed: Picture = ((1 - share) * picture + share * TINTS[numbers] + 0.5).astype(np.uint8)
        return mixed

    def _later(self, do: Callable[[Materials, Camera], str]) -> None:
        if not self._todo:
            self._todo.append(do)
            self._panel.changed()

    @staticmethod
    def _undone(materials: Materials, _: Camera) -> str:
        return "Undone" if materials.undo() else "Nothing is left to undo"

    def _tool_chosen(self) -> None:
        paints = self._panel["tool"].value != OFF
        self._clicks.want(paints)
        self._panel.show_note(ASK if paints else "")

    def _click(self, place: Sequence[float]) -> None:
        tool = self._panel["tool"].value
        kind = self._panel["kind"].value
        if tool == OFF or self._busy():
            return
        size = float(self._panel["size"].value)
        reach = float(self._panel["reach"].value)
        number = self._paintable.kinds[kind]
        at = (float(place[0]), float(place[1]))

        def paint(materials: Materials, camera: Camera) -> str:
            if tool == BRUSH:
                count = materials.brush(camera, at, size, number)
            else:
                count = materials.surface(camera, at, size, reach, number)
            return f"{kind}: {count:,} Gaussians" if count else f"Nothing is there. {ASK}"

        self._later(paint)
