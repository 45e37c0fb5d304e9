"""The data types of a capture: a view with four polarizer angles, and the scene of all views."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from polarguide.camera import Camera
from polarguide.capture.objects import SceneObject
from polarguide.errors import PolarguideError
from polarguide.polarizer import ANGLES as ANGLES

FULL_CODE = 65535
"""The code of linear intensity 1."""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Ground truth of a view. Any field may be None.

    Attributes:
        normal: unit surface normals in the world, zero where there is no surface, [H, W, 3] float32.
        depth: camera z in world units, 0 where there is no surface or it is not known, [H, W] float32.
        mask: foreground, [H, W] bool.
        specular, diffuse: first-surface lobes as linear S0, in the exposure of the pictures, [H, W, 3]
            float32. Pictures are S0 / 2, so compare rendered layers with half of these.
        object_ids: which object each pixel shows, as ``SceneObject.id``; 0 for none, or several, [H, W] int32.
    """

    normal: Tensor | None = None
    depth: Tensor | None = None
    mask: Tensor | None = None
    specular: Tensor | None = None
    diffuse: Tensor | None = None
    object_ids: Tensor | None = None


@dataclass(frozen=True, eq=False)
class View:
    """One camera pose with four pictures behind a polarizer, and masks of their pixels.

    Attributes:
        name: name of the view, unique in its scene.
        camera: pose and intrinsics at the size of the pictures.
        codes: linear intensities behind the analyzer at 0, 45, 90 and 135 degrees, coded as
            round(65535 * intensity), [4, H, W, 3] uint16, RGB. Kept coded because big captures do not fit
            into memory as floats.
        invalid: pixels that the capture marks as unusable (``invalid/<view>.png``), [H, W] bool. Metrics exclude these
            pixels and no others.
        saturated: pixels without polarization information: one angle at full scale in any channel, or all four
            black; [H, W] bool. Priors and losses exclude them.
        mask: the user's foreground mask (``masks/<view>.png``), [H, W] bool, or None.
        ground_truth: or None.
    """

    name: str
    camera: Camera
    codes: Tensor
    invalid: Tensor
    saturated: Tensor
    mask: Tensor | None = None
    ground_truth: GroundTruth | None = None

    def to(self, device: torch.device) -> View:
        """The view on a device, without its ground truth; the view itself if it is already there."""
        if self.codes.device == device:
            return self
        codes, invalid, saturated = (t.to(device) for t in (self.codes, self.invalid, self.saturated))
        mask = None if self.mask is None else self.mask.to(device)
        return View(self.name, self.camera, codes, invalid, saturated, mask)

    def subject_alone(self) -> View:
        """The view with black outside its mask, which it has to have."""
        assert self.mask is not None
        return replace(self, codes=self.codes * self.mask.to(self.codes)[None, ..., None])

    def intensities(self) -> Tensor:
        """Linear intensities in [0, 1] at 0, 45, 90, 135 degrees: [4, H, W, 3] float32."""
        return self.codes.to(torch.float32) / FULL_CODE

    def photograph(self) -> Tensor:
        """The mean of the four pictures: linear S0 / 2 in [0, 1], [H, W, 3] float32."""
        return self.codes.to(torch.float32).mean(dim=0) / FULL_CODE


@dataclass(frozen=True, eq=False)
class Scene:
    """A capture: posed views, sparse points and their origin.

    Attributes:
        root: the folder that was read.
        name: its name.
        views: all views, sorted by name.
        test_names: names of the views held out for evaluation, sorted.
        points: sparse points in the world, [M, 3] float32.
        point_colors: their colors as the COLMAP model gives them (display-encoded), [M, 3] uint8.
        refractive_index: the one index that ``scene.json`` gives, or None if it gives none or several.
        downscale: side of the pixel boxes that were averaged; 1 is full size.
        transfer: the assumed encoding of the files, "linear" or "srgb". The views are always linear.
        digest: SHA-256 over the names and contents of all files that were read, as hexadecimal digits.
        warnings: about possible faults that do not prevent the use of the scene.
        objects: the objects that ``scene.json`` lists, if the ground truth of some view tells objects apart.
    """

    root: Path
    name: str
    views: tuple[View, ...]
    test_names: tuple[str, ...]
    points: Tensor
    point_colors: Tensor
    refractive_index: float | None
    downscale: int
    transfer: str
    digest: str
    warnings: tuple[str, ...]
    objects: tuple[SceneObject, ...] = ()

    @property
    def train_views(self) -> tuple[View, ...]:
        """The training views, sorted by name."""
        return tuple(view for view in self.views if view.name not in self.test_names)

    @property
    def test_views(self) -> tuple[View, ...]:
        """The views held out for evaluation, sorted by name."""
        return tuple(view for view in self.views if view.name in self.test_names)

    def view(self, name: str) -> View:
        """The view called ``name``.

        Raises:
            PolarguideError: there is none; the message lists the names nearest to it.
        """
        for view in self.views:
            if view.name == name:
                return view
        raise unknown_view(self.root, name, [view.name for view in self.views])


def unknown_view(where: object, name: str, names: list[str]) -> PolarguideError:
    """The error that ``name`` is not among the view names, with those nearest to it."""
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.4) or names[:3]
    return PolarguideError(
        where,
        expected=f"the name of one of the {len(names)} views",
        found=repr(name),
        remedy=f"The nearest names are: {', '.join(near)}.",
    )


def listed(names: list[str], limit: int = 4) -> str:
    """The first few names and the number of further ones, for messages."""
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")
